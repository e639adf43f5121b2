"""Merge of the height maps of two scans: files in, one height map with pictures and a report out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.height_files import read_heights, scanned_map
from gpuvision.formats.json import report_text
from gpuvision.formats.range_image import read_npz, write_npz, write_png16, write_tiff
from gpuvision.host import Device, FloatArray, to_numpy
from gpuvision.host.errors import ReadError
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.plots.range_image import draw_height_map
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.merge_heights import (
    DISAGREES,
    FIRST,
    SECOND,
    UNCONFIRMED,
    Disagreement,
    MergedHeights,
    common_differences,
    merge_height_maps,
    pad_to_grid,
)
from gpuvision.status import Status

MERGE_FILES = ("range_image.tiff", "range_image.png", "range_image.npz", "picture.png", "sources.png", "report.json")
"""Names of the files that `HeightMapMerge.write` writes; ``range_image_sigma.tiff`` is added if sigma is known."""
SIGMA_FILE = "range_image_sigma.tiff"
# Colours and texts of `sources.png`: values of `MergedHeights.source`, apart from 3 (both maps confirm the height).
_SOURCES = (
    ((FIRST,), "#1f77b4", "first scan alone: unconfirmed"),
    ((SECOND,), "#f28c28", "second scan alone: unconfirmed"),
    ((UNCONFIRMED,), "#2ca02c", "one scan alone: dropped"),
    (tuple(DISAGREES | each for each in range(4)), "#d62728", "the scans disagree"),
)
# Median difference of the maps, in standard deviations of one difference, from which a warning names an offset of the
# frames. Chosen: half a standard deviation moves 12 % of the agreeing cells beyond two.
_OFFSET = 0.5
# Share of the common cells that disagree from which a warning asks for a larger tolerance. Chosen.
_MANY = 0.1
# Share of the heights without a standard deviation above which a warning is given. Chosen: more than a border.
_MANY_WITHOUT_SIGMA = 0.05


@dataclass(frozen=True, kw_only=True)
class HeightMapMerge:
    """Merged height map of two scans.

    Attributes
    ----------
    names : (str, str)
        Files of the two scans.
    heights : MergedHeights
        Merged map, NumPy arrays.
    grid : Grid
        Cells of the map.
    differences : numpy.ndarray
        Second minus first height [m] in the cells in which both maps have a height, see `common_differences`.
    settings : dict
        Parameters of the merge.
    phase : numpy.ndarray, optional
        Part of ``heights.sigma`` that neighbouring cells share [m], (rows, columns): the phase of the line in its
        pixel. Default: None, neither scan has it.
    without_sigma : tuple of float
        Share of the heights of each map that have no finite standard deviation above 0 and are therefore missing in the
        merge; 0 if the merge does not use standard deviations. Default 0.
    """

    names: tuple[str, str]
    heights: MergedHeights
    grid: Grid
    differences: npt.NDArray[np.float64]
    settings: dict[str, Any]
    phase: npt.NDArray[np.floating] | None = None
    without_sigma: tuple[float, float] = (0.0, 0.0)

    def counts(self) -> dict[str, int]:
        """Return the number of cells by source.

        ``disagrees`` counts cells where the maps disagree, ``unconfirmed`` cells with the height of one map where the
        other one has none, and ``unconfirmed_dropped`` such heights that ``require_both`` dropped.
        """
        source = to_numpy(self.heights.source)
        taken = source & (FIRST | SECOND)
        return {
            "first": int(np.count_nonzero(taken == FIRST)),
            "second": int(np.count_nonzero(taken == SECOND)),
            "both": int(np.count_nonzero(taken == FIRST | SECOND)),
            "none": int(np.count_nonzero(taken == 0)),
            "unconfirmed": int(np.count_nonzero(np.isin(source, (FIRST, SECOND)))),
            "unconfirmed_dropped": int(np.count_nonzero(source & UNCONFIRMED)),
            "common": len(self.differences),
            "disagrees": int(np.count_nonzero(source & DISAGREES)),
        }

    def offset(self) -> tuple[float, float]:
        """Return the median difference of the two maps and its robust standard deviation [m]; NaN without one."""
        if not len(self.differences):
            return math.nan, math.nan
        middle = float(np.median(self.differences))
        return middle, MAD_TO_SIGMA * float(np.median(np.abs(self.differences - middle)))

    def advice(self) -> tuple[str, ...]:
        """Return what to check: heights without a standard deviation, no common cells, an offset, disagreement."""
        counts, (middle, spread) = self.counts(), self.offset()
        found = [
            f"{name}: {100.0 * share:.0f} % of the heights have no standard deviation and are left out; a sensor file "
            "without a noise model, with --tolerance, keeps them"
            for name, share in zip(self.names, self.without_sigma, strict=True)
            if share > _MANY_WITHOUT_SIGMA
        ]
        if not counts["common"]:
            return (*found, "the two maps have no common cell: are both in one frame?")
        if abs(middle) > _OFFSET * max(spread, np.finfo(np.float64).tiny):
            found.append(
                f"the second map lies {1e6 * middle:+.3g} um from the first one (median; robust deviation "
                f"{1e6 * spread:.3g} um): check that both sensors are calibrated in one frame"
            )
        if counts["disagrees"] > _MANY * counts["common"]:
            found.append(
                f"the maps disagree in {100.0 * counts['disagrees'] / counts['common']:.0f} % of their common cells: "
                "give --tolerance of the calibration's errors, or check the frames"
            )
        return tuple(found)

    def summary(self) -> str:
        """Return one line: size, sources of the heights and disagreement."""
        counts = self.counts()
        cells = max(self.grid.rows * self.grid.columns, 1)
        part = {name: f"{100.0 * number / cells:.1f} %" for name, number in counts.items()}
        return (
            f"{self.grid.columns} x {self.grid.rows} cells: {part['both']} from both, {part['first']} from the first "
            f"alone, {part['second']} from the second alone, {part['none']} without a height; the maps disagree in "
            f"{part['disagrees']}; seen by one sensor and unconfirmed: {part['unconfirmed']}"
            + (f", and {part['unconfirmed_dropped']} dropped" if self.settings["require_both"] else "")
        )

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``."""
        middle, spread = (None if math.isnan(each) else each for each in self.offset())
        return {
            "gpuvision": version("gpuvision"),
            "first": self.names[0],
            "second": self.names[1],
            "max_sigmas": self.settings["max_sigmas"],
            "tolerance_m": self.settings["tolerance"],
            "disagreement": self.settings["disagreement"],
            "require_both": self.settings["require_both"],
            "cells": self.counts(),
            "difference": {"median_m": middle, "robust_sigma_m": spread},
            "weights": "equal" if self.heights.sigma is None else "inverse variance",
            "map": dataclasses.asdict(self.grid),
            "warnings": list(self.advice()),
        }

    def random_sigma(self) -> FloatArray | None:
        """Return the standard deviation of the heights without the phase [m]; None without standard deviations."""
        total = self.heights.sigma
        if total is None or self.phase is None:
            return total
        shared = np.minimum(self.phase / to_numpy(total), 1.0)
        return np.asarray(to_numpy(total) * np.sqrt((1.0 - shared) * (1.0 + shared)))

    def files(self) -> tuple[str, ...]:
        """Return the names of the files that `write` writes."""
        return MERGE_FILES if self.heights.sigma is None else (*MERGE_FILES, SIGMA_FILE)

    def write(self, folder: str | Path, *, inputs: tuple[Path, ...] = (), overwrite: bool = False) -> None:
        """Write the merged map as TIFF, 16-bit PNG and NPZ, two pictures and a report; after an error no file remains.

        Without standard deviations ``range_image_sigma.tiff`` of an earlier merge is removed from the folder.

        Parameters
        ----------
        folder : str or Path
            Output folder; created if it is missing.
        inputs : tuple of Path
            Files that are never replaced.
        overwrite : bool
            Whether files may be replaced that no earlier merge wrote. Default False.

        Raises
        ------
        FileExistsError
            A file exists, and is not an unchanged output of an earlier merge; see `gpuvision.host.outputs`.
        OSError
            The folder cannot be written.
        """
        heights, grid = self.heights, self.grid
        with Outputs("merge", inputs=inputs, overwrite=overwrite).folder(folder, optional=[SIGMA_FILE]) as inside:
            write_tiff(inside / "range_image.tiff", heights.z, grid)
            write_png16(inside / "range_image.png", heights.z, grid)
            held: dict[str, tuple[Any, str]] = {
                "map_x": (grid.x, "m"),
                "map_y": (grid.y, "m"),
                "map_z": (heights.z, "m"),
                "map_status": (heights.status, "flags"),
                "map_intensity": (heights.intensity, ""),
                "map_source": (heights.source, "flags: 1 first, 2 second, 4 disagree, 8 unconfirmed and dropped"),
            }
            if heights.sigma is not None:
                write_tiff(inside / SIGMA_FILE, heights.sigma, grid, quantity="sigma of height (noise and phase)")
                held["map_sigma"] = (self.random_sigma(), "m")
            if self.phase is not None:
                held["map_phase"] = (self.phase, "m")
            arrays, units = ({name: each[part] for name, each in held.items()} for part in (0, 1))
            write_npz(inside / "range_image.npz", arrays, units)
            shown = HeightMap(heights.z, heights.intensity, heights.status)
            draw_height_map(inside / "picture.png", shown, grid, title="Merged height map")
            source = to_numpy(heights.source)
            tints = [(np.isin(source, values), colour, meaning) for values, colour, meaning in _SOURCES]
            draw_height_map(
                inside / "sources.png", shown, grid, style="shaded", title="Sources of the heights", tints=tints
            )
            write_text_atomic(inside / "report.json", report_text(self.report()))


def height_map_file(path: str | Path) -> Path:
    """Return the file with the height map of a scan: the path, or ``range_image.npz`` in a folder."""
    file = Path(path)
    return file / "range_image.npz" if file.is_dir() else file


def read_height_map(path: str | Path) -> tuple[HeightMap, Grid]:
    """Read the height map of a scan.

    Parameters
    ----------
    path : str or Path
        Folder of ``gpuvision scan`` or ``gpuvision merge``, its NPZ file, or another file that
        `gpuvision.formats.height_files.read_heights` reads (without intensity and standard deviation).

    Raises
    ------
    OSError
        The file cannot be read.
    ReadError
        The file holds no height map with a grid.
    """
    return _read_scan(path)[0]


def _read_scan(path: str | Path) -> tuple[tuple[HeightMap, Grid], npt.NDArray[Any] | None]:
    """Read the height map of a scan, and the part of its standard deviation that neighbouring cells share [m]."""
    file = height_map_file(path)
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file")
    arrays = read_npz(file)[0] if file.suffix.lower() == ".npz" else {}
    read = scanned_map(arrays, file) if arrays else read_heights(file)
    z, sigma = read.z, read.total_sigma
    for name, kinds in (("map_status", "iu"), ("map_intensity", "iuf")):
        if name in arrays and arrays[name].dtype.kind not in kinds:
            expected = "real numbers" if "f" in kinds else "integers"
            raise ReadError(f"{file}: {name} has the type {arrays[name].dtype}, expected {expected}")
    for name in ("map_status", "map_intensity"):
        if name in arrays and arrays[name].shape != z.shape:
            raise ReadError(f"{file}: {name} has shape {arrays[name].shape}, expected {z.shape} as map_z")
    status = arrays.get("map_status", np.where(np.isfinite(z), Status.OK, Status.NO_DATA)).astype(np.uint8)
    intensity = np.asarray(arrays.get("map_intensity", np.where(np.isfinite(z), 0.0, z)))
    return (HeightMap(z, intensity, status, sigma), read.grid), None if sigma is None else read.phase


def merge_scans(
    first: str | Path,
    second: str | Path,
    *,
    max_sigmas: float = 3.0,
    tolerance: float = 0.0,
    disagreement: Disagreement = "drop",
    require_both: bool = False,
    device: Device | None = None,
) -> HeightMapMerge:
    """Merge the height maps of two scans of one part, by two sensors or by one sensor in two positions.

    Parameters
    ----------
    first, second : str or Path
        Scans, see `read_height_map`. Both are in one frame, with cells of one size.
    max_sigmas, tolerance, disagreement, require_both, device
        As for `gpuvision.merge_height_maps`.

    Raises
    ------
    OSError, ReadError
        A file cannot be read.
    ValueError
        The cells do not fit together, or neither standard deviations nor a tolerance are given.
    """
    one, other = _read_scan(first), _read_scan(second)
    maps = one[0], other[0]
    if tolerance <= 0.0 and any(each.sigma is None for each, _ in maps):
        raise ValueError(
            "a scan has no standard deviations (a noise model in its sensor file gives them); give a tolerance, the "
            "largest difference of heights that agree"
        )
    settings: dict[str, Any] = {
        "max_sigmas": max_sigmas,
        "tolerance": tolerance,
        "disagreement": disagreement,
        "require_both": require_both,
    }
    merged, grid = merge_height_maps(*maps, **settings, device=device)
    return HeightMapMerge(
        names=(str(first), str(second)),
        heights=merged,
        grid=grid,
        differences=common_differences(*maps, merged, grid),
        settings=settings,
        phase=_merged_phase(maps, (one[1], other[1]), merged, grid),
        without_sigma=(0.0, 0.0) if merged.sigma is None else (_share_missing(maps[0][0]), _share_missing(maps[1][0])),
    )


def _merged_phase(
    maps: Sequence[tuple[HeightMap, Grid]],
    phases: Sequence[npt.NDArray[Any] | None],
    merged: MergedHeights,
    grid: Grid,
) -> npt.NDArray[Any] | None:
    """Return the part of the merged standard deviation that neighbouring cells share [m]; None without any.

    The phases of the two maps are independent, as their noise is. A mean has the weight ``merged sigma^2 / sigma^2`` of
    each map, a height of one map alone has the weight 1.
    """
    if merged.sigma is None or all(each is None for each in phases):
        return None
    source, total = to_numpy(merged.source), to_numpy(merged.sigma)
    variance = np.zeros(grid.shape)
    for bit, (heights, own), phase in zip((FIRST, SECOND), maps, phases, strict=True):
        if phase is not None:
            sigma = pad_to_grid(to_numpy(heights.sigma), own, grid, math.nan, np.dtype(np.float64))
            sigma[sigma == 0.0] = math.nan  # a missing height
            shared = pad_to_grid(np.where(np.isfinite(phase), phase, 0.0), own, grid, 0.0, np.dtype(np.float64))
            weight = np.where(source & (FIRST | SECOND) == bit, 1.0, (total / sigma) ** 2)
            variance += np.where(source & bit != 0, (weight * shared) ** 2, 0.0)
    return np.where(np.isfinite(total), np.sqrt(variance), math.nan).astype(total.dtype)


def _share_missing(heights: HeightMap) -> float:
    """Return the share of the heights that have no finite standard deviation above 0."""
    valid, sigma = np.isfinite(to_numpy(heights.z)), to_numpy(heights.sigma)
    known = valid & np.isfinite(sigma) & (sigma > 0.0)
    return 1.0 - float(np.count_nonzero(known)) / max(int(np.count_nonzero(valid)), 1) if valid.any() else 0.0
