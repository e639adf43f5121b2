"""Line grids: both families of crossing lines, measured between the crossings."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.blobs import find_pattern_blobs
from gpuvision.camera.patterns.centroids import lattice_steps, sampled
from gpuvision.camera.patterns.grid_polynomial import on_grid
from gpuvision.camera.patterns.lattice import whole_grid
from gpuvision.camera.patterns.pattern import Float32, Float64, LineFamilies, finder_image, nan_median

_FEWEST_CELLS = 9
_FEWEST_POINTS = 3
# Cells cover at least this part of the grid; dots cover less.
_LEAST_COVER = 0.45
# A line is measured in the middle half between two crossings, within this part of a step to either side; beyond the
# second part there is ground.
_LENGTH = 0.5
_REACH = 0.32
_GROUND_FROM = 0.22
# Samples per pixel across the line, and along it.
_ACROSS = 1.5
_ALONG = 0.7
# As for dots: less of the line than this counts as ground.
_GROUND = 0.2
# Limits of what a point may differ from the others: times what is usual, but a small part of a step (of the width)
# always; in contrast.
_OFF_USUAL = 7.0
_OFF_STEP = 0.003
_OFF_WIDTH = 0.1
_LEAST_CONTRAST = 0.4
_CHUNK_SAMPLES = 1 << 18


def find_lines(image: npt.NDArray[Any]) -> LineFamilies:
    """Find the lines of a grid of crossing lines, dark on light or light on dark.

    The cells between the lines are found and indexed as dots are; between two neighbouring cells lies a line, and
    its centre of gravity is measured there, away from the crossings.

    Parameters
    ----------
    image
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, at least 9 whole cells,
        lines at most a quarter of a step wide, the grid turned by at most 45 degrees.

    Returns
    -------
    tuple
        Two families: lines along the rows, from the top, and lines along the columns, from the left. A line is an
        array (n, 2) of measured (column, row), one for every cell along it, in order; lines of fewer than three
        points are left out.

    Raises
    ------
    ValueError
        If there is no grid of cells, or it falls into parts; says how many cells were found.
    TypeError
        If the image is of another type.
    """
    grey = finder_image(image)
    blobs = find_pattern_blobs(grey)
    if blobs.cover < _LEAST_COVER:
        raise ValueError(
            f"what was found covers {blobs.cover:.0%} of the grid, cells between lines cover at least "
            f"{_LEAST_COVER:.0%}: is it a pattern of dots?"
        )
    grid = whole_grid(blobs.points, _FEWEST_CELLS, "cells between lines")
    cells = np.where(grid[..., None] < 0, np.nan, blobs.points[grid])
    columns = _between_columns(grey, cells, blobs.bright)
    rows = _between_columns(grey, cells.swapaxes(0, 1), blobs.bright)
    return _family(rows), _family(columns)


def _between_columns(grey: Float32, cells: Float64, bright: bool) -> Float64:
    """Measure the lines before, between and after columns of cells: (columns + 1, rows, 2), NaN where there is none."""
    steps = lattice_steps(cells)
    across, along = (np.concatenate([each, each[:, -1:]], axis=1) for each in (steps[:, :, 0], steps[:, :, 1]))
    none = np.full_like(cells[:, :1], np.nan)
    # Half a step from the cell before the line, and from the one behind it; at the border there is only one.
    half = 0.5 * steps[:, :, 0]
    pair = [np.concatenate(each, axis=1) for each in ((none, cells + half), (cells - half, none))]
    centre = nan_median(np.stack(pair))
    known = np.isfinite(centre[..., 0])
    points = np.full_like(centre, np.nan)
    points[known] = _measured(grey, centre[known], across[known], along[known], bright)
    points[~on_grid(points, _OFF_USUAL, _OFF_STEP)] = np.nan
    return points.swapaxes(0, 1)


def _measured(grey: Float32, centre: Float64, across: Float64, along: Float64, bright_cells: bool) -> Float64:
    """Centres of gravity (n, 2) of profiles across lines; NaN where there is no line like the others."""
    long = (float(np.linalg.norm(each, axis=1).max()) for each in (across, along))
    u = np.linspace(-_REACH, _REACH, 2 * math.ceil(_REACH * _ACROSS * next(long)) + 1)
    t = np.linspace(-0.5 * _LENGTH, 0.5 * _LENGTH, math.ceil(_LENGTH * _ALONG * next(long)) + 1)
    profile = np.empty((len(centre), len(u)))
    chunk = max(1, _CHUNK_SAMPLES // (len(u) * len(t)))
    for start in range(0, len(centre), chunk):
        part = slice(start, start + chunk)
        lines = centre[part, None, None] + t[:, None, None] * along[part, None, None]
        profile[part] = sampled(grey, lines + u[:, None] * across[part, None, None]).mean(axis=1)
    outside = np.abs(u) > _GROUND_FROM
    straight = np.vander(u, 2)
    ground = profile[:, outside] @ np.linalg.pinv(straight[outside]).T @ straight.T
    depth = ground - profile if bright_cells else profile - ground
    contrast = depth.max(axis=1)
    weight = np.maximum(depth / contrast[:, None] - _GROUND, 0.0)
    width = weight.sum(axis=1)
    change = np.abs(np.log(width / np.nanmedian(width)))
    alike = (contrast > _LEAST_CONTRAST * np.nanmedian(contrast)) & (
        change < max(_OFF_WIDTH, _OFF_USUAL * float(np.nanmedian(change)))
    )
    points: Float64 = centre + across * (weight @ u / width)[:, None]
    points[~alike] = np.nan
    return points


def _family(lines: Float64) -> tuple[Float64, ...]:
    """Lines without what is missing in them, and without those that are too short."""
    known = (line[np.isfinite(line[:, 0])] for line in lines)
    return tuple(line for line in known if len(line) >= _FEWEST_POINTS)
