"""Inspection of solder paste in a height map: measurement, verdicts, report and files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gpuvision.formats.height_files import HeightMapFile
from gpuvision.formats.json import json_tree
from gpuvision.host.outputs import Outputs
from gpuvision.inspection.alignment import Alignment, align_apertures
from gpuvision.inspection.apertures import Aperture, BoardPlacement
from gpuvision.inspection.paste import Deposits, PasteSettings, measure_deposits
from gpuvision.matching.artwork.board_artwork import Side
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.plots.inspection import draw_regions
from gpuvision.validation import finite
from gpuvision.workflows.inspection_tables import write_tables

PASTE_FILES = ("paste.csv", "report.json", "volume.png")
"""Names of the files that `PasteInspection.write` writes."""
SEARCH_RANGE = (2e-3, math.radians(3.0))
"""Default search range of a board: shift [m] and rotation [rad]."""
# Correlation of the pattern below which the alignment is doubtful. Chosen: without paste it is below 0.2.
_WEAK_CORRELATION = 0.3
# Units of the settings and of the pose, at the end of their keys in the report.
_SUFFIXES = {**dict.fromkeys(("stencil", "threshold", "margin", "ring", "pad_height", "x", "y"), "_m"), "theta": "_rad"}
_ROUGH = 2.0  # scatter of the board over the sigma of its heights, from which on they disagree. Chosen


@dataclass(frozen=True, kw_only=True)
class VolumeLimits:
    """Limits of the volume of a deposit, as fractions of the expected volume.

    Parameters
    ----------
    minimum, maximum : float
        Least and greatest fraction. Default 0.5 and 1.5. Range: 0 or more.

    Raises
    ------
    ValueError
        A limit is negative, or the minimum is not below the maximum.
    """

    minimum: float = 0.5
    maximum: float = 1.5

    def __post_init__(self) -> None:
        finite(self.minimum, "the minimum volume", minimum=0.0)
        finite(self.maximum, "the maximum volume", above=self.minimum)


@dataclass(frozen=True, kw_only=True)
class ScaleSigma:
    """Relative standard deviations of scales that all deposits share: systematic errors of the sensor.

    Parameters
    ----------
    height : float
        Of heights: 0.002 for 0.2 %. Range: 0 or more.
    lateral : float
        Of lengths in x and in y. Range: 0 or more.

    Raises
    ------
    ValueError
        A number is negative or not finite.
    """

    height: float
    lateral: float

    def __post_init__(self) -> None:
        for name in ("height", "lateral"):
            finite(getattr(self, name), f"ScaleSigma.{name}", minimum=0.0)


@dataclass(frozen=True, kw_only=True)
class PasteInspection:
    """Solder paste of a board in a height map, with verdicts.

    Attributes
    ----------
    heights : HeightMapFile
        The height map.
    apertures : tuple of Aperture
        Apertures in the coordinates of the board.
    settings : PasteSettings
        Settings of the measurement.
    placement : BoardPlacement
        Place of the board in the height map.
    alignment : Alignment or None
        The fit that found the place; None if the place was given.
    deposits : Deposits
        Measured deposits.
    limits : VolumeLimits
        Limits of the verdicts.
    scale_sigma : ScaleSigma or None
        Systematic standard deviations; None if they are not known.
    files : mapping of str to str
        Names of the input files for the report, such as ``height_map`` and ``board``. Default: none.
    """

    heights: HeightMapFile
    apertures: tuple[Aperture, ...]
    settings: PasteSettings
    placement: BoardPlacement
    alignment: Alignment | None
    deposits: Deposits
    limits: VolumeLimits
    scale_sigma: ScaleSigma | None
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def volume_ratio(self) -> Float64:
        """Volume of each deposit over its expected volume; NaN where it is not measured."""
        return self.deposits.volume / self.deposits.expected_volume

    def verdicts(self) -> tuple[str, ...]:
        """Return "pass", "low" or "high" of each deposit by its volume, or the status of one without a volume."""
        found = []
        for status, ratio in zip(self.deposits.status, self.volume_ratio, strict=True):
            if status not in ("measured", "missing"):
                found.append(status)
            elif ratio < self.limits.minimum:
                found.append("low")
            else:
                found.append("high" if ratio > self.limits.maximum else "pass")
        return tuple(found)

    def warnings(self) -> tuple[str, ...]:
        """Return what may be wrong with the inspection, one sentence each."""
        found = []
        if not np.isfinite(self.volume_ratio).any():
            found.append(
                "no deposit has a volume: check the pose of the board, and the unit and the cells of the height map"
            )
        if self.alignment is not None and self.alignment.is_ambiguous:
            found.append(
                "the paste pattern fits about as well at another place of the search range; give --initial-pose and a "
                "smaller --search-range, or --pose"
            )
        if self.alignment is not None and not self.alignment.converged:
            found.append("the fit of the board's place to the deposits did not converge; measure again with --pose")
        if self.alignment is not None and self.alignment.correlation < _WEAK_CORRELATION:
            found.append(
                f"the height map correlates with the paste pattern by {self.alignment.correlation:.2f} only; check the "
                "side of the board and the initial pose"
            )
        if self.deposits.board_scatter > _ROUGH * self.deposits.noise:
            found.append(
                f"the board scatters by {1e6 * self.deposits.board_scatter:.3g} um about the reference surfaces, the "
                f"sigma of the heights is {1e6 * self.deposits.noise:.3g} um: the board is rough, or the sigma is too "
                "small"
            )
        if self.deposits.noise * 4 > self.settings.level:
            found.append(
                f"the noise of the heights is {1e6 * self.deposits.noise:.3g} um, the threshold of the area only "
                f"{1e6 * self.settings.level:.3g} um: areas and mean heights are biased by noise"
            )
        return tuple(found)

    def rows(self) -> list[dict[str, Any]]:
        """Return one dictionary for each deposit, in SI units; offsets are in the coordinates of the board's files."""
        deposits = self.deposits
        height, lateral = (
            (math.nan, math.nan) if self.scale_sigma is None else (self.scale_sigma.height, self.scale_sigma.lateral)
        )
        verdicts, ratio = self.verdicts(), self.volume_ratio
        rows = []
        for k, (name, status) in enumerate(zip(deposits.names, deposits.status, strict=True)):
            volume, mean = float(deposits.volume[k]), float(deposits.height_mean[k])
            rows.append(
                {
                    "name": name,
                    "verdict": verdicts[k],
                    "status": status,
                    "x_m": float(self.apertures[k].centroid[0]),
                    "y_m": float(self.apertures[k].centroid[1]),
                    "expected_area_m2": float(deposits.expected_area[k]),
                    "expected_volume_m3": float(deposits.expected_volume[k]),
                    "volume_m3": volume,
                    "volume_sigma_m3": float(deposits.volume_sigma[k]),
                    "volume_systematic_sigma_m3": abs(volume) * math.hypot(height, 2 * lateral),
                    "volume_ratio": float(ratio[k]),
                    "area_m2": float(deposits.area[k]),
                    "area_sigma_m2": float(deposits.area_sigma[k]),
                    "area_systematic_sigma_m2": 2 * lateral * float(deposits.area[k]),
                    "height_mean_m": mean,
                    "height_mean_sigma_m": float(deposits.height_mean_sigma[k]),
                    "height_mean_systematic_sigma_m": abs(mean) * height,
                    "height_max_m": float(deposits.height_max[k]),
                    "height_max_sigma_m": float(deposits.height_max_sigma[k]),
                    "offset_x_m": float(deposits.offset[k, 0]),
                    "offset_y_m": float(deposits.offset[k, 1]),
                    "offset_x_sigma_m": float(deposits.offset_sigma[k, 0]),
                    "offset_y_sigma_m": float(deposits.offset_sigma[k, 1]),
                    "valid_fraction": float(deposits.valid[k]),
                }
            )
        return rows

    def summary(self) -> str:
        """Return one line: deposits, verdicts, volumes, noise."""
        verdicts = self.verdicts()
        others = {each: verdicts.count(each) for each in dict.fromkeys(verdicts) if each != "pass"}
        counts = ", ".join([f"{verdicts.count('pass')} pass", *(f"{count} {name}" for name, count in others.items())])
        known = self.volume_ratio[np.isfinite(self.volume_ratio)]
        volumes = ""
        if known.size:
            low, middle, high = (100 * float(each) for each in (known.min(), np.median(known), known.max()))
            volumes = f"; volumes {low:.0f} to {high:.0f} % (median {middle:.0f} %)"
        place = self.placement
        pose = f"{1e3 * place.x:.3f} mm, {1e3 * place.y:.3f} mm, {math.degrees(place.theta):.3f} deg"
        how = "given" if self.alignment is None else "fitted to the paste"
        noise = f"; noise {1e6 * self.deposits.noise:.2g} um" if math.isfinite(self.deposits.noise) else ""
        return f"{len(verdicts)} deposits: {counts}{volumes}; board at {pose} ({how}){noise}"

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``; None for numbers that are not known."""
        fitted = self.alignment
        alignment = None
        if fitted is not None:
            alignment = {
                "covariance": fitted.covariance.tolist(),
                "centre_m": fitted.centre.tolist(),
                "residual_scale_m": fitted.residual_scale,
                "deposits": fitted.count,
                "correlation": fitted.correlation,
                "second_correlation": fitted.second_correlation,
            }
        tree = {
            "gpuvision": version("gpuvision"),
            "files": dict(self.files),
            "summary": self.summary(),
            "warnings": list(self.warnings()),
            "settings": {name + _SUFFIXES.get(name, ""): each for name, each in asdict(self.settings).items()},
            "limits": asdict(self.limits),
            "scale_sigma": None if self.scale_sigma is None else asdict(self.scale_sigma),
            "pose": {name + _SUFFIXES.get(name, ""): each for name, each in asdict(self.placement).items()},
            "alignment": alignment,
            "noise_m": self.deposits.noise,
            "board_scatter_m": self.deposits.board_scatter,
            "correlation_area_cells": self.deposits.correlation_area,
            "map": asdict(self.heights.grid),
            "deposits": self.rows(),
        }
        return dict(json_tree(tree))

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write ``paste.csv``, ``report.json`` and the picture ``volume.png`` into a folder, all or none.

        Parameters
        ----------
        folder : str or Path
            Output folder; created if it is missing.
        overwrite : bool
            Whether files may be replaced that no earlier inspection wrote. Default False.

        Raises
        ------
        OSError
            A file exists and is no output of an inspection, or the folder cannot be written.
        """
        ratio = self.volume_ratio
        with Outputs("inspect", overwrite=overwrite).folder(folder) as inside:
            write_tables(inside, "paste.csv", self.rows(), self.report())
            draw_regions(
                inside / "volume.png",
                self.heights.z,
                self.heights.grid,
                [each.moved(self.placement) for each in self.apertures],
                100 * ratio,
                (0.0, 200.0),
                [each == "pass" for each in self.verdicts()],
                title=self.summary(),
                label="volume [% of the aperture times the stencil]",
                colours="RdYlBu",
            )


def inspect_paste(
    heights: HeightMapFile,
    apertures: Sequence[Aperture],
    settings: PasteSettings,
    *,
    side: Side = "top",
    pose: tuple[float, float, float] | None = None,
    initial_pose: tuple[float, float, float] | None = None,
    search_range: tuple[float, float] = SEARCH_RANGE,
    sigma: float | None = None,
    correlation_area: float | None = None,
    limits: VolumeLimits = VolumeLimits(),
    scale_sigma: ScaleSigma | None = None,
    files: Mapping[str, str] = MappingProxyType({}),
) -> PasteInspection:
    """Measure the solder paste of a board in a height map.

    Parameters
    ----------
    heights : HeightMapFile
        Height map of `read_heights`.
    apertures : sequence of Aperture
        Apertures of `read_apertures`.
    settings : PasteSettings
        Stencil, margins and reference surface.
    side : {"top", "bottom"}
        Side of the board that the height map shows. Default "top".
    pose : tuple of float, optional
        Known place of the board: position of the origin of its files in the height map [m], and direction of its x axis
        [rad]. Default: found by the paste.
    initial_pose : tuple of float, optional
        Place where the search begins. Default: the centre of the apertures in the centre of the height map.
    search_range : tuple of float
        Largest shift [m] and rotation [rad] of the search. Default 2 mm and 3 degrees.
    sigma : float, optional
        Random standard deviation of all heights [m]. Default: ``heights.sigma``, or else estimated; see
        `measure_deposits`. ``heights.phase`` is added in both cases, as an error that neighbouring cells share. Range:
        above 0.
    correlation_area : float, optional
        Number of cells whose noise is common. Default: estimated; see `measure_deposits`.
    limits : VolumeLimits
        Limits of the verdicts.
    scale_sigma : ScaleSigma, optional
        Systematic standard deviations of the scales.
    files : mapping of str to str
        Names of the input files for the report. Default: none.

    Returns
    -------
    PasteInspection

    Raises
    ------
    ValueError
        The board is not found in the height map, both poses are given, or a number is out of range.
    """
    if pose is not None and initial_pose is not None:
        raise ValueError("pose and initial_pose are both given; expected a known pose or the beginning of a search")
    noise = heights.sigma if sigma is None else finite(sigma, "sigma", above=0.0)
    alignment = None
    if pose is None:
        if initial_pose is None:
            initial = _centred(heights, apertures, side)
        else:
            initial = BoardPlacement(x=initial_pose[0], y=initial_pose[1], theta=initial_pose[2], side=side)
        alignment = align_apertures(
            heights.z, heights.grid, apertures, settings, initial=initial, search_range=search_range
        )
        placement = alignment.placement
    else:
        placement = BoardPlacement(x=pose[0], y=pose[1], theta=pose[2], side=side)
    deposits = measure_deposits(
        heights.z,
        heights.grid,
        apertures,
        placement,
        settings,
        sigma=noise,
        phase=heights.phase,
        correlation_area=correlation_area,
    )
    return PasteInspection(
        heights=heights,
        apertures=tuple(apertures),
        settings=settings,
        placement=placement,
        alignment=alignment,
        deposits=deposits,
        limits=limits,
        scale_sigma=scale_sigma,
        files=files,
    )


def _centred(heights: HeightMapFile, apertures: Sequence[Aperture], side: Side) -> BoardPlacement:
    """Return the place in which the centre of the apertures is the centre of the height map."""
    bounds = np.concatenate([each.bounds for each in apertures])
    middle = (bounds.min(axis=0) + bounds.max(axis=0)) / 2
    grid = heights.grid
    here = np.array([grid.left + (grid.columns - 1) / 2 * grid.cell_x, grid.top - (grid.rows - 1) / 2 * grid.cell_y])
    shift = here - BoardPlacement(x=0.0, y=0.0, theta=0.0, side=side).to_map(middle)
    return BoardPlacement(x=float(shift[0]), y=float(shift[1]), theta=0.0, side=side)
