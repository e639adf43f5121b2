"""Result of a simulated scan: summary, report and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.json import report_text
from gpuvision.formats.range_image import write_npz, write_ply, write_png16, write_tiff
from gpuvision.host import Device
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.plots.range_image import draw_height_map
from gpuvision.plots.simulation import PictureScale, draw_causes, draw_errors
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.range_image import RangePoints
from gpuvision.simulation.errors.error_attribution import ErrorAttribution
from gpuvision.simulation.sensors.masks import MaskOptimisation
from gpuvision.simulation.sensors.readings import PATHS, Reading
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.simulated_recording import RECORDING_FILES

Array = npt.NDArray[Any]

_FILES = (
    "range_image.tiff",
    "range_image.png",
    "range_image.ply",
    "simulation.npz",
    "picture.png",
    "errors.png",
    "causes.png",
    "report.json",
)
_MASK_FILE = "mask.txt"


def simulation_files(*, has_mask: bool) -> tuple[str, ...]:
    """Return the names of the files that `Simulation.write` writes; one more with a mask that was optimised."""
    return (*_FILES, _MASK_FILE) if has_mask else _FILES


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Simulated scan of a part.

    Attributes
    ----------
    task
        Part, sensor and light paths.
    threshold
        Threshold of a camera's readout [grey levels], estimated with ``threshold = "auto"``; None for PSDs.
    attribution
        Readings, truth, errors and their causes, (profiles, samples).
    points
        Organised range image that the sensor makes.
    heights, grid
        Height map over regular cells, and the position of the cells.
    limit
        Smallest error that counts as wrong [m].
    mask
        Optimised mask, if one was requested; else None.
    statistics
        Numbers of segments, pairs and bounds (`ProfileLight.statistics`), summed over the profiles; of bounds the
        largest.
    device
        Device on which the readings were computed.
    seconds
        Duration of the steps by name [s].
    computed_blocks
        Number of blocks of profiles that were computed, and not read from the store.
    """

    task: SimulationTask
    threshold: float | None
    attribution: ErrorAttribution
    points: RangePoints
    heights: HeightMap
    grid: Grid
    limit: float
    mask: MaskOptimisation | None
    statistics: dict[str, float]
    device: Device
    seconds: dict[str, float]
    computed_blocks: int

    def summary(self) -> str:
        """Return a summary of errors in one line, and one more line for a mask."""
        errors = self.attribution.summary(self.limit)
        worst = max(errors["causes"], key=lambda name: errors["causes"][name]["dominant"])
        um = 1e6
        text = (
            f"{len(self.task.transports)} profiles, {errors['valid']} of {errors['surface']} samples read, errors "
            f"{um * (errors['median'] or 0.0):.1f} µm median, {um * (errors['p95'] or 0.0):.0f} µm p95, "
            f"{errors['beyond_limit']} beyond {um * self.limit:.1f} µm (mostly {worst}), {errors['spurious']} spurious "
            "(a reading, but no lit surface in view)"
        )
        if self.mask is None:
            return text
        before, after = (float(np.nanmax(np.abs(each))) for each in (self.mask.error_before, self.mask.error_after))
        return f"{text}\nlargest error of the centroid: {um * before:.0f} µm without, {um * after:.0f} µm with the mask"

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``: lengths in metres, times in seconds."""
        task = self.task
        return {
            "gpuvision": version("gpuvision"),
            "sensor": task.sensor.name,
            "kind": task.sensor.kind,
            "threshold": self.threshold,
            "profiles": len(task.transports),
            "triangles": len(task.part.corners),
            "defects": {each.name: len(getattr(task.part.defects, each.name)) for each in fields(task.part.defects)},
            "paths": list(task.paths),
            "tolerance": task.tolerance,
            "errors": self.attribution.summary(self.limit),
            "mask": None if self.mask is None else _mask_report(self.mask),
            "light_statistics": self.statistics,
            "not_in_bounds": self.not_in_bounds(),
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "light_fingerprint": task.fingerprint,
            "computed_blocks": self.computed_blocks,
            "seconds": self.seconds,
        }

    def not_in_bounds(self) -> list[str]:
        """Return the approximations and light paths that no bound in the statistics covers."""
        task, light = self.task, self.task.sensor.light
        omitted = [name for name in PATHS if name not in task.paths]
        if "bound of multi-bounce left out [m]" in self.statistics:
            omitted = [name for name in omitted if name != "multi-bounce"]
        found = [f"light path {name} (not simulated)" for name in omitted]
        if {"diffuse-diffuse", "multi-bounce"} & set(task.paths):
            found.append("quadrature of indirect light (nodes per bin)")
        if light is not None and light.thickness > 0.0:
            found.append("slabs of the sheet of light (sub_sheets)")
        if "estimated error of patches [m]" in self.statistics:
            found.append("patches of multi-bounce light (estimated error: see light_statistics)")
        elif "multi-bounce" in task.paths:
            found.append("patches of multi-bounce light")
        return [*found, "rounding"]

    @property
    def moves_backward(self) -> bool:
        """Whether the transport decreases with the profile number."""
        return bool(self.task.transports[-1] < self.task.transports[0])

    def write(
        self,
        folder: str | Path,
        *,
        inputs: Sequence[str | Path] = (),
        overwrite: bool = False,
        scale: PictureScale | None = None,
    ) -> None:
        """Write the range image, pictures and the report into a folder, all or nothing.

        ``range_image.tiff``, ``range_image.png`` (16 bit) and ``picture.png`` hold the height map as it will be
        measured, ``range_image.ply`` the organised points, ``errors.png`` and ``causes.png`` the errors and their
        causes, ``simulation.npz`` the arrays, ``report.json`` the report. ``mask.txt`` holds a mask that was optimised;
        the unchanged mask and recording of an earlier simulation are removed.

        Parameters
        ----------
        folder : str or Path
            Output folder; created if it is missing.
        inputs : sequence of path
            Files that were read, such as a mask; with the files of the sensor they are never replaced or removed.
        overwrite : bool
            Whether files may be replaced that no earlier simulation wrote. Default False.
        scale : PictureScale, optional
            Scale of the pictures of errors and causes. Default: the scale for this simulation alone.

        Raises
        ------
        FileExistsError
            A file exists, and is not an unchanged output of an earlier simulation; see `gpuvision.host.outputs`.
        OSError
            The folder cannot be written.
        """
        attribution = self.attribution
        title = self.task.sensor.name or "Simulation"
        scale = PictureScale.of([attribution], self.limit) if scale is None else scale
        outputs = Outputs("simulate", inputs=[*inputs, *self.task.sensor.files], overwrite=overwrite)
        # The mask and the recording of an earlier simulation would seem to belong to these readings.
        with outputs.folder(folder, optional=[_MASK_FILE, *RECORDING_FILES]) as inside:
            write_tiff(inside / "range_image.tiff", self.heights.z, self.grid)
            write_png16(inside / "range_image.png", self.heights.z, self.grid)
            write_ply(
                inside / "range_image.ply", *self.points[:3], light_strength(attribution.reading), self.points.status
            )
            write_npz(inside / "simulation.npz", *self._arrays())
            draw_height_map(inside / "picture.png", self.heights, self.grid, title=f"{title}: as measured")
            draw_errors(inside / "errors.png", attribution, title, scale, backward=self.moves_backward)
            draw_causes(inside / "causes.png", attribution, title, scale, backward=self.moves_backward)
            if self.mask is not None:
                self.mask.mask.save(inside / _MASK_FILE)
            write_text_atomic(inside / "report.json", report_text(self.report()))

    def _arrays(self) -> tuple[dict[str, Array], dict[str, str]]:
        attribution = self.attribution
        held: dict[str, tuple[Any, str]] = {
            **{name: (getattr(self.points, name), "m") for name in ("x", "y", "z")},
            "status": (self.points.status, "flags"),
            "true_g": (attribution.truth.g, "m"),
            "true_h": (attribution.truth.h, "m"),
            "error": (attribution.error, "m"),
            "category": (attribution.category, "flags"),
            **{f"cause_{name}": (part, "m") for name, part in attribution.causes.items()},
            "sigma": (attribution.reading.sigma, "m"),
            "transport": (self.task.transports, "m"),
        }
        return {name: array for name, (array, _) in held.items()}, {name: unit for name, (_, unit) in held.items()}


def light_strength(reading: Reading) -> Array:
    """Return the light of readings for a range image: 0 where it is not known, float32."""
    return np.nan_to_num(reading.strength).astype(np.float32)


def _mask_report(plan: MaskOptimisation) -> dict[str, Any]:
    def worst(values: Array) -> float | None:
        known = np.abs(values[np.isfinite(values)])
        return float(known.max()) if known.size else None

    kept = plan.passed_fraction[np.isfinite(plan.passed_fraction)]
    return {
        "worst_without": worst(plan.error_before),
        "worst_with": worst(plan.error_after),
        "light_kept": float(kept.min()) if kept.size else None,
    }
