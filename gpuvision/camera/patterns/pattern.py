"""Calibration patterns in images: what a finder takes and what it returns."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.image import grey_image

Float64: TypeAlias = npt.NDArray[np.float64]
Float32: TypeAlias = npt.NDArray[np.float32]

LineFamilies: TypeAlias = tuple[tuple[Float64, ...], ...]
"""Families of lines that are parallel in the world; a line is an array (n, 2) of measured (column, row), in order."""

# A normal distribution's sigma in units of its median absolute deviation.
_SIGMA_OF_MAD = 1.4826
_HIGHEST_DIFFERENCE = 6
_FEWEST_DIFFERENCES = 12


class PatternGrid(NamedTuple):
    """The points of a flat, regular pattern, found in an image.

    The index is the place on the pattern: ``points[i, j]`` lies at (j, i) pitches from ``points[0, 0]``. Columns
    grow with x and rows with y in the image; which point of the pattern is the first is not known.
    """

    points: Float64
    """(rows, columns, 2): measured (column, row) in pixels, NaN where none was found."""
    sigma: float
    """Noise of one coordinate in pixels, as `localisation_noise` estimates it from the points."""


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


def localisation_noise(points: npt.ArrayLike) -> float:
    """Estimate the noise of a grid's points from the grid itself: what is not smooth along rows and columns.

    The n-th differences of neighbours hold little but noise, binomial(2n, n) times its variance. Third differences
    serve where a grid is fine; in a coarse one a lens shows in them, so that the smallest estimate of the third to
    the sixth counts. The median makes it robust.

    Parameters
    ----------
    points
        (rows, columns, 2); NaN where missing.

    Returns
    -------
    float
        Standard deviation of one coordinate, in the points' units; NaN where too few neighbours are there.
    """
    grid = np.asarray(points, dtype=np.float64)
    estimates = [math.nan]
    for order in range(3, _HIGHEST_DIFFERENCE + 1):
        steps = [np.diff(grid, order, axis).ravel() for axis in (0, 1)]
        known = np.abs(np.concatenate(steps))
        known = known[np.isfinite(known)]
        if known.size >= _FEWEST_DIFFERENCES:
            estimates.append(float(np.median(known)) * _SIGMA_OF_MAD / math.sqrt(math.comb(2 * order, order)))
    return float(np.fmin.reduce(estimates))


def shrunk(grey: Float32, step: int) -> Float32:
    """Mean over cells of so many pixels, the last ones stretched to fit."""
    rows, columns = grey.shape
    size = (-(-columns // step), -(-rows // step))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def boxed(grey: Float32, side: int) -> Float32:
    """Mean over a box about every pixel; the side is odd."""
    return np.asarray(cv2.blur(grey, (side, side)) if side > 1 else grey, dtype=np.float32)


def nan_mean(values: Float64) -> Float64:
    """Mean over the first axis of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return np.asarray(np.where(known, values, 0.0).sum(axis=0) / np.where(count, count, np.nan))


def nan_median(values: Float64) -> Float64:
    """Median over the first axis of what is not NaN; NaN where nothing is left."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2])
    # Where there is nothing, the first is NaN itself.
    return np.asarray(np.take_along_axis(ordered, np.minimum(middle, len(values) - 1), 0).mean(axis=0))


def trimmed(points: Float64) -> Float64:
    """Cut rows and columns at the border that hold nothing."""
    known = np.isfinite(points[..., 0])
    if not known.any():
        return points[:0, :0]
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    return points[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
