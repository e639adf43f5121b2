"""Dot grids: sub-pixel detection of the dots and their grid index, also under strong lens distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.blobs import BlobLimits, find_pattern_blobs
from gpuvision.camera.patterns.centroids import Centroids, disc_centre_offset, measure_dots
from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, agrees_with_grid, cross
from gpuvision.camera.patterns.lattice import index_grid
from gpuvision.camera.patterns.pattern import (
    Float64,
    PatternGrid,
    estimate_localisation_noise,
    finder_image,
    nan_median,
    trim_empty_border,
)

Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class DotLimits:
    """Thresholds of `find_dots`.

    Attributes
    ----------
    min_dots : int
        Least number of dots in a grid. Default 9.
    max_coverage : float
        Largest fraction of the grid that dots cover. Derived: squares of a chessboard cover 0.5. Default 0.48.
    max_deviation_medians : float
        Largest deviation of a dot from its neighbours, in position and in shape, as a multiple of the median deviation
        in the image. Default 7.0.
    min_position_tolerance : float
        Deviation in position that is always accepted [pitches]. Default 0.003.
    min_shape_tolerance : float
        Deviation of area, width and height that is always accepted (logarithm of the ratio). Default 0.06.
    min_contrast : float
        Least contrast relative to the median contrast of the neighbouring dots. Default 0.25.
    max_background_residual : float
        Largest deviation of the background from a plane [contrasts]. Default 0.5.
    blobs : BlobLimits
        Thresholds of the blob detection.
    """

    min_dots: int = 9
    max_coverage: float = 0.48
    max_deviation_medians: float = 7.0
    min_position_tolerance: float = 0.003
    min_shape_tolerance: float = 0.06
    min_contrast: float = 0.25
    max_background_residual: float = 0.5
    blobs: BlobLimits = BlobLimits()


def find_dots(image: npt.NDArray[Any], *, limits: DotLimits = DotLimits()) -> PatternGrid:
    """Find the dots of a regular grid, dark on light or light on dark.

    A local threshold separates the dots from the background. Their grid index grows from neighbour to neighbour, so
    that lens distortion and perspective may change the steps across the image. Positions are grey-level centres of
    gravity. The centre of gravity of a disc's image differs from the image of its centre under perspective and
    distortion; the difference follows from the curvature of the grid and is subtracted.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, with 9 dots or more of at
        least 4 px diameter and 2 px distance, the grid rotated by at most 45 degrees.
    limits : DotLimits
        Thresholds of the detection.

    Returns
    -------
    PatternGrid
        Missing and hidden dots are NaN, as are dots that deviate from the grid of their neighbours, are partly covered,
        or touch the image's border. Noise and bias are about 0.01 px for dots of 10 px diameter and noise of 1 % of
        their contrast.

    Raises
    ------
    ValueError
        No grid was found, or it consists of separate parts; the message gives the number of dots found.
    TypeError
        The image has another type.
    """
    grey = finder_image(image)
    blobs = find_pattern_blobs(grey, limits.blobs)
    if blobs.coverage > limits.max_coverage:
        raise ValueError(
            f"the blobs found cover {blobs.coverage:.0%} of the grid, dots cover at most {limits.max_coverage:.0%}: "
            "use find_lines for cells between lines, find_chessboard for squares"
        )
    grid = index_grid(blobs.points, limits.min_dots, "dots")
    place, size = (np.where(grid[..., None] < 0, np.nan, each[grid]) for each in (blobs.points, blobs.size))
    found = measure_dots(grey, place, size)
    model = GridPolynomial(found.points)
    points = found.points - disc_centre_offset(model, found.dot_area)
    points[~_agrees_with_neighbours(found, model, limits)] = np.nan
    count = np.count_nonzero(np.isfinite(points[..., 0]))
    if count < limits.min_dots:
        raise ValueError(
            f"only {count} of {grid.size} dots are whole and lie on a grid, expected at least {limits.min_dots}"
        )
    points = trim_empty_border(points)
    return PatternGrid(points, estimate_localisation_noise(points))


def _agrees_with_neighbours(found: Centroids, model: GridPolynomial, limits: DotLimits) -> Bool:
    """Return which dots agree with their neighbours in position, shape and contrast."""
    u, v = model.derivative(1, 0), model.derivative(0, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        sound = agrees_with_grid(found.points, limits.max_deviation_medians, limits.min_position_tolerance)
        # The ratios of a disc's area, width and height to the area, width and height of its grid cell are nearly
        # constant over the image.
        disc = np.stack([found.dot_area / np.abs(cross(u, v)), *np.moveaxis(found.variance / (u**2 + v**2), -1, 0)])
        for each in disc:
            change = np.abs(np.log(each / _neighbourhood_median(each)))
            tolerance = limits.max_deviation_medians * float(np.nanmedian(change))
            sound &= change < max(limits.min_shape_tolerance, tolerance)
        has_contrast = found.contrast / _neighbourhood_median(found.contrast) > limits.min_contrast
        return sound & has_contrast & (found.background_residual < limits.max_background_residual)


def _neighbourhood_median(values: Float64) -> Float64:
    """Return the median over the 5 x 5 neighbourhood of every node."""
    padded = np.pad(values, 2, constant_values=np.nan)
    rows, columns = values.shape
    return nan_median(np.stack([padded[i : i + rows, j : j + columns] for i in range(5) for j in range(5)]))
