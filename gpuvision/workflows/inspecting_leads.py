"""Inspection of leads and balls in a height map: coplanarity, verdicts, report and files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.height_files import HeightMapFile
from gpuvision.formats.json import json_tree
from gpuvision.host.outputs import Outputs
from gpuvision.inspection.apertures import Aperture, BoardPlacement, make_aperture
from gpuvision.inspection.coplanarity import Coplanarity, measure_coplanarity
from gpuvision.matching.artwork.board_artwork import Pad
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.plots.inspection import draw_regions
from gpuvision.validation import finite
from gpuvision.workflows.inspection_tables import write_tables

LEAD_FILES = ("leads.csv", "report.json", "coplanarity.png")
"""Names of the files that `LeadInspection.write` writes."""


@dataclass(frozen=True, kw_only=True)
class LeadInspection:
    """Coplanarity of leads or balls in a height map.

    Attributes
    ----------
    heights : HeightMapFile
        The height map, leads up.
    regions : tuple of Aperture
        Regions of the leads in the height map.
    leads : Coplanarity
        Tops, gaps and deviations.
    maximum : float or None
        Largest gap that passes [m]; None without a limit.
    files : mapping of str to str
        Names of the input files for the report, such as ``height_map`` and ``board``. Default: none.
    sigma_estimated : bool
        Whether the standard deviation of the heights was estimated from neighbouring cells. Default False.
    """

    heights: HeightMapFile
    regions: tuple[Aperture, ...]
    leads: Coplanarity
    maximum: float | None
    files: Mapping[str, str] = field(default_factory=dict)
    sigma_estimated: bool = False

    def warnings(self) -> tuple[str, ...]:
        """Return what may be wrong with the inspection, one sentence each."""
        if not self.sigma_estimated:
            return ()
        return (
            "the sigma of the heights is estimated from differences of neighbouring cells, which does not see errors "
            "that neighbours share, such as the phase of a laser line: the sigmas of gaps can be several times too "
            "small; give the range_image.npz of a scan with a noise model, or --sigma and --correlation-area",
        )

    def verdicts(self) -> tuple[str, ...]:
        """Return "pass" or "high" of each lead by its gap, or "holes" of a lead without a top."""
        limit = math.inf if self.maximum is None else self.maximum
        return tuple("holes" if not np.isfinite(gap) else "pass" if gap <= limit else "high" for gap in self.leads.gap)

    def rows(self) -> list[dict[str, Any]]:
        """Return one dictionary for each lead, in SI units."""
        leads = self.leads
        names = ("top", "top_sigma", "gap", "gap_sigma", "deviation", "deviation_sigma")
        verdicts = self.verdicts()
        return [
            {
                "name": name,
                "verdict": verdicts[k],
                "seat": name in leads.seats,
                "x_m": float(leads.place[k, 0]),
                "y_m": float(leads.place[k, 1]),
                **{f"{each}_m": float(getattr(leads, each)[k]) for each in names},
            }
            for k, name in enumerate(leads.names)
        ]

    def summary(self) -> str:
        """Return one line: coplanarity with its sigma, the lowest lead, the seats, the noise."""
        leads, verdicts = self.leads, self.verdicts()
        failed = "" if self.maximum is None else f"; {len(verdicts) - verdicts.count('pass')} leads fail"
        spread = float(np.nanstd(leads.deviation))
        return (
            f"{len(leads.names)} leads: coplanarity {1e6 * leads.coplanarity:.3g} um (sigma "
            f"{1e6 * leads.coplanarity_sigma:.2g} um) at {leads.lowest}, seated on {', '.join(leads.seats)}; rms about "
            f"the least-squares plane {1e6 * spread:.3g} um; noise {1e6 * leads.noise:.2g} um{failed}"
        )

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``; None for numbers that are not known."""
        tree = {
            "gpuvision": version("gpuvision"),
            "files": dict(self.files),
            "summary": self.summary(),
            "warnings": list(self.warnings()),
            "coplanarity_m": self.leads.coplanarity,
            "coplanarity_sigma_m": self.leads.coplanarity_sigma,
            "lowest": self.leads.lowest,
            "seats": list(self.leads.seats),
            "maximum_gap_m": self.maximum,
            "noise_m": self.leads.noise,
            "map": asdict(self.heights.grid),
            "leads": self.rows(),
        }
        return dict(json_tree(tree))

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write ``leads.csv``, ``report.json`` and the picture ``coplanarity.png``; see `PasteInspection.write`."""
        gaps = 1e6 * self.leads.gap
        with Outputs("inspect", overwrite=overwrite).folder(folder) as inside:
            write_tables(inside, "leads.csv", self.rows(), self.report())
            draw_regions(
                inside / "coplanarity.png",
                self.heights.z,
                self.heights.grid,
                self.regions,
                gaps,
                (0.0, max(float(np.nanmax(gaps)), 1e-3)),
                [each == "pass" for each in self.verdicts()],
                title=self.summary(),
                label="gap below the seating plane [um]",
                colours="viridis",
            )


def pads_of_part(pads: Sequence[Pad], part: str) -> tuple[Aperture, ...]:
    """Return the pads of a part as regions, named by their pins.

    Raises
    ------
    ValueError
        No pad has this part: the files are not Gerber X2, or the name is another.
    """
    found = [each for each in pads if each.part == part]
    if not found:
        known = sorted({each.part for each in pads if each.part})
        names = ", ".join(known[:12]) or "none: the files do not name parts (Gerber X2 does)"
        raise ValueError(f"no pad belongs to the part {part!r}; known parts: {names}")
    return tuple(make_aperture(each.pin or str(k), [Shape(each.outline)]) for k, each in enumerate(found, 1))


def inspect_leads(
    heights: HeightMapFile,
    regions: Sequence[Aperture],
    *,
    placement: BoardPlacement | None = None,
    sigma: float | None = None,
    correlation_area: float = 1.0,
    centre: tuple[float, float] | None = None,
    maximum: float | None = None,
    files: Mapping[str, str] = MappingProxyType({}),
) -> LeadInspection:
    """Measure the coplanarity of leads or balls in a height map of a component with its leads up.

    Parameters
    ----------
    heights : HeightMapFile
        Height map of `read_heights`.
    regions : sequence of Aperture
        Region of each lead, three or more.
    placement : BoardPlacement, optional
        Place of the regions in the height map. Default: they are in the coordinates of the height map.
    sigma : float, optional
        Random standard deviation of all heights [m]. Default: ``heights.sigma``, or else estimated.
        ``heights.phase`` is added in both cases, as an error that the cells of a lead share. Range: above 0.
    correlation_area : float
        Number of cells whose noise is common, 1 or more. Default 1.
    centre : tuple of float, optional
        Centre of gravity, in the coordinates of the regions [m]. Default: mean of the regions.
    maximum : float, optional
        Largest gap that passes [m].
    files : mapping of str to str
        Names of the input files for the report. Default: none.

    Returns
    -------
    LeadInspection

    Raises
    ------
    ValueError
        Fewer than three tops are measured, the centre of gravity is not between them, or a number is out of range.
    """
    gravity: npt.NDArray[np.float64] | None = None if centre is None else np.array(centre)
    moved = tuple(regions)
    if placement is not None:
        moved = tuple(each.moved(placement) for each in regions)
        gravity = None if gravity is None else placement.to_map(gravity)
    leads = measure_coplanarity(
        heights.z,
        heights.grid,
        moved,
        sigma=heights.sigma if sigma is None else finite(sigma, "sigma", above=0.0),
        phase=heights.phase,
        correlation_area=correlation_area,
        centre=None if gravity is None else (float(gravity[0]), float(gravity[1])),
    )
    return LeadInspection(
        heights=heights,
        regions=moved,
        leads=leads,
        maximum=maximum,
        files=files,
        sigma_estimated=sigma is None and heights.sigma is None,
    )
