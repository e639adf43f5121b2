"""Line grids: both families of crossing lines, measured between the crossings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.blobs import BlobLimits, find_pattern_blobs
from gpuvision.camera.patterns.centroids import estimate_steps, sample_bilinear
from gpuvision.camera.patterns.grid_polynomial import agrees_with_grid
from gpuvision.camera.patterns.lattice import index_grid
from gpuvision.camera.patterns.pattern import Float32, Float64, LineFamilies, finder_image, nan_median

# Geometry of a profile across a line, in grid steps: length along the line (the middle half between two crossings),
# half length across, and distance from the line beyond which only background is expected.
_LENGTH = 0.5
_HALF_ACROSS = 0.32
_BACKGROUND_DISTANCE = 0.22
# Samples per pixel across the line, and along it.
_ACROSS = 1.5
_ALONG = 0.7
# Coverage below which a sample counts as background, as for dots: noise of the background gets no weight.
_BACKGROUND_COVER = 0.2
# Samples processed in one pass; limits the memory only.
_CHUNK_SAMPLES = 1 << 18


@dataclass(frozen=True, kw_only=True)
class LinePatternLimits:
    """Thresholds of `find_lines`.

    Attributes
    ----------
    min_cells : int
        Least number of whole cells between lines. Default 9.
    min_points : int
        Least number of points of a line. Derived: two points are always straight. Default 3.
    min_coverage : float
        Least fraction of the grid that cells cover; dots cover less. Default 0.45.
    max_deviation_medians : float
        Largest deviation of a point from its neighbours, in position and line width, as a multiple of the median
        deviation in the image. Default 7.0.
    min_position_tolerance : float
        Deviation in position that is always accepted [grid steps]. Default 0.003.
    min_width_tolerance : float
        Deviation of the line width that is always accepted (logarithm of the ratio). Default 0.1.
    min_contrast : float
        Least contrast relative to the median contrast. Default 0.4.
    blobs : BlobLimits
        Thresholds of the detection of cells.
    """

    min_cells: int = 9
    min_points: int = 3
    min_coverage: float = 0.45
    max_deviation_medians: float = 7.0
    min_position_tolerance: float = 0.003
    min_width_tolerance: float = 0.1
    min_contrast: float = 0.4
    blobs: BlobLimits = BlobLimits()


def find_lines(image: npt.NDArray[Any], *, limits: LinePatternLimits = LinePatternLimits()) -> LineFamilies:
    """Find the lines of a grid of crossing lines, dark on light or light on dark.

    The cells between the lines are detected and indexed like dots. The centre of gravity of a line is measured between
    each pair of neighbouring cells, away from the crossings.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, with at least 9 whole
        cells, lines at most a quarter of a step wide, the grid rotated by at most 45 degrees.
    limits : LinePatternLimits
        Thresholds of the detection.

    Returns
    -------
    tuple
        Two families: lines along the rows, from the top, and lines along the columns, from the left. A line is an
        array (n, 2) of measured (column, row) [px], one point per cell along it, in order. Lines of fewer than three
        points are omitted.

    Raises
    ------
    ValueError
        No grid of cells was found, or it consists of separate parts; the message gives the number of cells found.
    TypeError
        The image has another type.
    """
    grey = finder_image(image)
    blobs = find_pattern_blobs(grey, limits.blobs)
    if blobs.coverage < limits.min_coverage:
        raise ValueError(
            f"the blobs found cover {blobs.coverage:.0%} of the grid, cells between lines cover at least "
            f"{limits.min_coverage:.0%}: use find_dots for a pattern of dots"
        )
    grid = index_grid(blobs.points, limits.min_cells, "cells between lines")
    cells = np.where(grid[..., None] < 0, np.nan, blobs.points[grid])
    columns = _measure_between_columns(grey, cells, blobs.bright, limits)
    rows = _measure_between_columns(grey, cells.swapaxes(0, 1), blobs.bright, limits)
    return _to_family(rows, limits), _to_family(columns, limits)


def _measure_between_columns(grey: Float32, cells: Float64, bright: bool, limits: LinePatternLimits) -> Float64:
    """Measure the lines before, between and after columns of cells: (columns + 1, rows, 2), NaN where none is found."""
    steps = estimate_steps(cells)
    across, along = (np.concatenate([each, each[:, -1:]], axis=1) for each in (steps[:, :, 0], steps[:, :, 1]))
    missing = np.full_like(cells[:, :1], np.nan)
    # Half a step from the cell before the line, and from the cell after it; at the border there is one cell only.
    half = 0.5 * steps[:, :, 0]
    pair = [np.concatenate(each, axis=1) for each in ((missing, cells + half), (cells - half, missing))]
    centre = nan_median(np.stack(pair))
    known = np.isfinite(centre[..., 0])
    points = np.full_like(centre, np.nan)
    points[known] = _measure_line_points(grey, centre[known], across[known], along[known], bright, limits)
    points[~agrees_with_grid(points, limits.max_deviation_medians, limits.min_position_tolerance)] = np.nan
    return points.swapaxes(0, 1)


def _measure_line_points(
    grey: Float32, centre: Float64, across: Float64, along: Float64, bright_cells: bool, limits: LinePatternLimits
) -> Float64:
    """Return centres of gravity (n, 2) of profiles across lines; NaN where contrast or width deviate."""
    long = (float(np.linalg.norm(each, axis=1).max()) for each in (across, along))
    u = np.linspace(-_HALF_ACROSS, _HALF_ACROSS, 2 * math.ceil(_HALF_ACROSS * _ACROSS * next(long)) + 1)
    t = np.linspace(-0.5 * _LENGTH, 0.5 * _LENGTH, math.ceil(_LENGTH * _ALONG * next(long)) + 1)
    profile = np.empty((len(centre), len(u)))
    chunk = max(1, _CHUNK_SAMPLES // (len(u) * len(t)))
    for start in range(0, len(centre), chunk):
        part = slice(start, start + chunk)
        lines = centre[part, None, None] + t[:, None, None] * along[part, None, None]
        profile[part] = sample_bilinear(grey, lines + u[:, None] * across[part, None, None]).mean(axis=1)
    outside = np.abs(u) > _BACKGROUND_DISTANCE
    straight = np.vander(u, 2)
    background = profile[:, outside] @ np.linalg.pinv(straight[outside]).T @ straight.T
    depth = background - profile if bright_cells else profile - background
    contrast = depth.max(axis=1)
    weight = np.maximum(depth / contrast[:, None] - _BACKGROUND_COVER, 0.0)
    width = weight.sum(axis=1)
    change = np.abs(np.log(width / np.nanmedian(width)))
    is_consistent = (contrast > limits.min_contrast * np.nanmedian(contrast)) & (
        change < max(limits.min_width_tolerance, limits.max_deviation_medians * float(np.nanmedian(change)))
    )
    points: Float64 = centre + across * (weight @ u / width)[:, None]
    points[~is_consistent] = np.nan
    return points


def _to_family(lines: Float64, limits: LinePatternLimits) -> tuple[Float64, ...]:
    """Return the lines without missing points; omit lines with too few points."""
    known = (line[np.isfinite(line[:, 0])] for line in lines)
    return tuple(line for line in known if len(line) >= limits.min_points)
