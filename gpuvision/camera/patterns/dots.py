"""Dot grids: thousands of dots, found sub-pixel and told apart, whatever the lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.blobs import find_pattern_blobs
from gpuvision.camera.patterns.centroids import Centroids, disc_shift, measure_dots
from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, cross, on_grid
from gpuvision.camera.patterns.lattice import whole_grid
from gpuvision.camera.patterns.pattern import (
    Float64,
    PatternGrid,
    finder_image,
    localisation_noise,
    nan_median,
    trimmed,
)

Bool = npt.NDArray[np.bool_]

_FEWEST = 9
# Dots cover at most this part of the grid; squares of a chessboard cover half.
_MOST_COVER = 0.48
# Limits of what a dot may differ from its neighbours. In place and shape: as many times what is usual in this image,
# but a small part of the pitch (of the size) always; in contrast; and its ground from a plane, in units of contrast.
_OFF_USUAL = 7.0
_OFF_PITCH = 0.003
_OFF_SHAPE = 0.06
_LEAST_CONTRAST = 0.25
_UNEVEN = 0.5


def find_dots(image: npt.NDArray[Any]) -> PatternGrid:
    """Find the dots of a regular grid, dark on light or light on dark.

    Dots are told from the ground by a threshold that follows the illumination, indexed by walking from neighbour to
    neighbour, and measured by the centre of gravity of their grey levels; a step of the grid may vary as lenses and
    perspective make it. Missing and hidden dots are NaN, as are those that lie off their neighbours' grid, are cut
    by something, or touch the border. The centre of gravity of a disc that is seen askew is not its centre: the
    difference follows from the grid's own curvature, and is taken off.

    Parameters
    ----------
    image
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, 9 dots or more, of at
        least 4 pixels across and 2 pixels apart, the grid turned by at most 45 degrees.

    Returns
    -------
    PatternGrid
        Noise and bias are about 0.01 px where dots are 10 px across and the noise is 1 % of their contrast.

    Raises
    ------
    ValueError
        If there is no grid, or it falls into parts; says how many dots were found.
    TypeError
        If the image is of another type.
    """
    grey = finder_image(image)
    blobs = find_pattern_blobs(grey)
    if blobs.cover > _MOST_COVER:
        raise ValueError(
            f"what was found covers {blobs.cover:.0%} of the grid, dots cover at most {_MOST_COVER:.0%}: "
            "use find_lines for cells between lines, find_chessboard for squares"
        )
    grid = whole_grid(blobs.points, _FEWEST, "dots")
    place, size = (np.where(grid[..., None] < 0, np.nan, each[grid]) for each in (blobs.points, blobs.size))
    found = measure_dots(grey, place, size)
    bent = GridPolynomial(found.points)
    points = found.points - disc_shift(bent, found.mass)
    points[~_sound(found, bent)] = np.nan
    count = np.count_nonzero(np.isfinite(points[..., 0]))
    if count < _FEWEST:
        raise ValueError(f"only {count} of {grid.size} dots are whole and lie on a grid, expected at least {_FEWEST}")
    points = trimmed(points)
    return PatternGrid(points, localisation_noise(points))


def _sound(found: Centroids, bent: GridPolynomial) -> Bool:
    """Which dots lie, look and stand out as their neighbours do."""
    u, v = bent.derivative(1, 0), bent.derivative(0, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        sound = on_grid(found.points, _OFF_USUAL, _OFF_PITCH)
        # A disc's area, width and height, but for how the grid is bent: about the same everywhere.
        disc = np.stack([found.mass / np.abs(cross(u, v)), *np.moveaxis(found.spread / (u**2 + v**2), -1, 0)])
        for each in disc:
            change = np.abs(np.log(each / _around(each)))
            sound &= change < max(_OFF_SHAPE, _OFF_USUAL * float(np.nanmedian(change)))
        return sound & (found.contrast / _around(found.contrast) > _LEAST_CONTRAST) & (found.unevenness < _UNEVEN)


def _around(values: Float64) -> Float64:
    """Median of a node and of the 24 around it."""
    padded = np.pad(values, 2, constant_values=np.nan)
    rows, columns = values.shape
    return nan_median(np.stack([padded[i : i + rows, j : j + columns] for i in range(5) for j in range(5)]))
