"""Reference of image undistortion: interpolation by its definition, with taps, weights and borders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

NO_DATA, NOT_INVERTIBLE = 64, 128


def cubic(distance: Float64) -> Float64:
    """Return the weight of a tap at a distance: cubic convolution with slope -0.75 at 1."""
    a, d = -0.75, np.abs(distance)
    inner = (a + 2) * d**3 - (a + 3) * d**2 + 1
    far = a * d**3 - 5 * a * d**2 + 8 * a * d - 4 * a
    return np.where(d <= 1, inner, np.where(d < 2, far, 0.0))


def linear(distance: Float64) -> Float64:
    """Return the weight of a tap at a distance: linear interpolation."""
    return np.asarray(np.maximum(1.0 - np.abs(distance), 0.0))


def border_index(place: NDArray[np.int_], size: int, border: str) -> NDArray[np.int_]:
    """Return the row or column that a place takes its value from; places beyond the image depend on the border."""
    if border != "reflect":
        return np.clip(place, 0, size - 1)
    period = max(2 * (size - 1), 1)
    folded = np.abs(place) % period
    return np.asarray(np.minimum(folded, period - folded))


def interpolate(
    image: NDArray[Any], positions: Float64, *, interpolation: str, border: str, border_value: float
) -> Float64:
    """Return the values of one image (rows, columns, channels) at positions (..., 2) that are finite."""
    kernel, taps = (cubic, range(-1, 3)) if interpolation == "bicubic" else (linear, range(2))
    rows, columns = image.shape[:2]
    # Clip to 1e9: farther positions differ for a reflected border only, and integers stay exact.
    x, y = np.moveaxis(np.clip(np.nan_to_num(positions), -1e9, 1e9), -1, 0)
    whole_x, whole_y = np.floor(x).astype(int), np.floor(y).astype(int)
    result = np.zeros((*x.shape, image.shape[2]))
    for j in taps:
        for i in taps:
            column, row = whole_x + i, whole_y + j
            weight = kernel(x - column) * kernel(y - row)
            seen = image[border_index(row, rows, border), border_index(column, columns, border)]
            if border == "constant":
                outside = (column < 0) | (column >= columns) | (row < 0) | (row >= rows)
                seen = np.where(outside[..., None], border_value, seen)
            result += weight[..., None] * seen
    return result


def undistort(
    image: NDArray[Any],
    positions: Float64,
    *,
    interpolation: str = "bilinear",
    border: str = "mask",
    border_value: float = 0.0,
    missing: int = NO_DATA,
) -> tuple[Float64, NDArray[np.uint8]]:
    """Return the values of one image at positions, and the status.

    Parameters
    ----------
    image : numpy.ndarray
        (rows, columns, channels).
    positions : numpy.ndarray
        Measured (column, row) of each pixel of the result [px], (r, c, 2); NaN where the lens has none.
    interpolation, border, border_value
        As for `gpuvision.UndistortImage`.
    missing : int
        Status where the position is not finite.

    Returns
    -------
    values : numpy.ndarray
        (r, c, channels); NaN where undefined, or ``border_value``.
    status : numpy.ndarray
        (r, c), flags of `gpuvision.Status`.
    """
    rows, columns = image.shape[:2]
    x, y = np.moveaxis(positions, -1, 0)
    with np.errstate(invalid="ignore"):
        hole = (x < -0.5) | (x > columns - 0.5) | (y < -0.5) | (y > rows - 0.5)
    lost = ~np.isfinite(x + y)
    status = np.where(lost, missing, np.where(hole, NO_DATA, 0)).astype(np.uint8)
    result = interpolate(image, positions, interpolation=interpolation, border=border, border_value=border_value)
    blank = lost | hole if border == "mask" else lost
    result[blank] = border_value if border == "constant" else np.nan
    return result, status
