"""Inputs and results of the target pattern finders, and helpers that they share."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.image import grey_image
from gpuvision.normal_distribution import MAD_TO_SIGMA

Float64: TypeAlias = npt.NDArray[np.float64]
Float32: TypeAlias = npt.NDArray[np.float32]

LineFamilies: TypeAlias = tuple[tuple[Float64, ...], ...]
"""Families of lines that are parallel in the world; a line is an array (n, 2) of measured (column, row), in order."""

# Standard deviation of a normal distribution over its median absolute deviation.
# Highest order of differences, and least number of differences of an order, for the noise estimate.
_MAX_ORDER = 6
_MIN_DIFFERENCES = 12


class PatternGrid(NamedTuple):
    """Points of a flat, regular target pattern, detected in an image.

    The index is the position on the target: ``points[i, j]`` lies at (j, i) pitches from ``points[0, 0]``. Columns
    increase with x and rows with y in the image. The position of ``points[0, 0]`` on the target is unknown.
    """

    points: Float64
    """(rows, columns, 2): measured (column, row) [px], NaN where missing."""
    sigma: float
    """Standard deviation of one coordinate [px], estimated by `estimate_localisation_noise`."""


def finder_image(image: npt.NDArray[Any]) -> Float32:
    """Return an image of a target pattern as float32 grey levels.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width) or (height, width, 3) of uint8, uint16 or float32; three channels are blue, green, red, as
        OpenCV reads them.

    Raises
    ------
    TypeError
        The image is no array of these types.
    ValueError
        The shape is not accepted, or a pixel is not finite.
    """
    grey = grey_image(image, channels=(3,), min_size=1, convert_float64=False).astype(np.float32)
    if image.dtype == np.float32 and not np.isfinite(grey).all():
        raise ValueError(f"image has {np.count_nonzero(~np.isfinite(grey))} pixels that are no finite numbers")
    return grey


def estimate_localisation_noise(points: npt.ArrayLike) -> float:
    """Estimate the noise of grid points from n-th differences along rows and columns.

    The n-th difference of independent noise has binomial(2n, n) times its variance, and suppresses smooth variation.
    Third differences suffice in a fine grid. In a coarse grid lens distortion contributes to them, so the smallest
    estimate of the third to the sixth differences is used. The median makes the estimate robust.

    Parameters
    ----------
    points : array_like
        (rows, columns, 2); NaN where missing.

    Returns
    -------
    float
        Standard deviation of one coordinate, in the unit of the points; NaN if too few neighbours are known.
    """
    grid = np.asarray(points, dtype=np.float64)
    estimates = [math.nan]
    for order in range(3, _MAX_ORDER + 1):
        steps = [np.diff(grid, order, axis).ravel() for axis in (0, 1)]
        known = np.abs(np.concatenate(steps))
        known = known[np.isfinite(known)]
        if known.size >= _MIN_DIFFERENCES:
            estimates.append(float(np.median(known)) * MAD_TO_SIGMA / math.sqrt(math.comb(2 * order, order)))
    return float(np.fmin.reduce(estimates))


def downsample(grey: Float32, step: int) -> Float32:
    """Downsample by averaging cells of ``step`` x ``step`` pixels; the cells are stretched to cover the image."""
    rows, columns = grey.shape
    size = (-(-columns // step), -(-rows // step))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def box_mean(grey: Float32, side: int) -> Float32:
    """Average over a box of odd side [px] about every pixel."""
    return np.asarray(cv2.blur(grey, (side, side)) if side > 1 else grey, dtype=np.float32)


def nan_mean(values: Float64) -> Float64:
    """Return the mean of the finite values over the first axis; NaN if none is finite."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return np.asarray(np.where(known, values, 0.0).sum(axis=0) / np.where(count, count, np.nan))


def nan_median(values: Float64) -> Float64:
    """Return the median of the values that are not NaN over the first axis; NaN if all are."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2])
    # If all values are NaN, the first one is NaN and is the result.
    return np.asarray(np.take_along_axis(ordered, np.minimum(middle, len(values) - 1), 0).mean(axis=0))


def trim_empty_border(points: Float64) -> Float64:
    """Remove empty rows and columns at the border of a grid (rows, columns, 2)."""
    known = np.isfinite(points[..., 0])
    if not known.any():
        return points[:0, :0]
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    return points[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
