"""Reference of the triangulation: undo the lens or the camera, multiply by the homography, divide.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, equations 3.11-3.13.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpuvision.reference.camera import undistort_pixels

Float64 = NDArray[np.float64]
NOT_FINITE, HORIZON, NOT_INVERTIBLE = 8, 32, 128


def undistort(
    column: Float64, row: Float64, k1: float, k2: float, centre: tuple[float, float]
) -> tuple[Float64, Float64]:
    """Return the undistorted column and row of measured points (F. de Jong, equations 3.11-3.13)."""
    square = (column - centre[0]) ** 2 + (row - centre[1]) ** 2
    factor = 1.0 + k1 * square + k2 * square**2
    return centre[0] + (column - centre[0]) * factor, centre[1] + (row - centre[1]) * factor


def is_beyond_fold(
    column: Float64, row: Float64, k1: float, k2: float, centre: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return where the slope of the lens polynomial is zero or negative at the radius of the point or before."""
    square = (column - centre[0]) ** 2 + (row - centre[1]) ** 2
    roots = np.roots([5.0 * k2, 3.0 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real if len(roots) else roots
    positive = real[real > 0.0]
    return np.asarray(square >= (positive.min() if len(positive) else np.inf))


def triangulate(
    u: ArrayLike,
    v: ArrayLike,
    homography: ArrayLike,
    region: Any,
    *,
    horizon: float = 1e-3,
    lens: tuple[float, float, tuple[float, float]] | None = None,
    camera: tuple[Any, Any] | None = None,
    along: str = "columns",
) -> tuple[Float64, Float64, NDArray[np.uint8]]:
    """Return the coordinates in the sheet of light, and the status.

    Parameters
    ----------
    u, v : array
        Position of the line along the profile, and number of the profile [px].
    homography : array
        (3, 3), from (u, v, 1) to multiples of (G, H, 1).
    region : sequence
        Range of u and range of v [px], two pairs. The homography's denominator is positive in its middle.
    horizon : float
        Smallest denominator, as a fraction of that in the middle of the region; below it the status is HORIZON.
    lens : tuple, optional
        k1, k2, (C_c, R_c).
    camera : tuple, optional
        Camera matrix (3, 3) and OpenCV's 14 coefficients, instead of a lens.
    along : str
        "columns" or "rows": direction of a profile in the image.

    Returns
    -------
    G, H : numpy.ndarray
        Coordinates [m]; NaN where the status is not 0.
    status : numpy.ndarray
        Flags of `gpuvision.Status`.
    """
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    matrix = np.asarray(homography, dtype=np.float64)
    status = np.zeros(u.shape, dtype=np.uint8)
    middle = np.array([np.mean(region[0]), np.mean(region[1]), 1.0])
    straight_u, straight_v = u, v
    with np.errstate(all="ignore"):
        if lens is not None:
            k1, k2, centre = lens
            column, row = (v, u) if along == "columns" else (u, v)
            status = np.where(is_beyond_fold(column, row, k1, k2, centre), NOT_INVERTIBLE, status)
            column, row = undistort(column, row, k1, k2, centre)
            straight_u, straight_v = (row, column) if along == "columns" else (column, row)
        if camera is not None:
            column, row = (v, u) if along == "columns" else (u, v)
            pixels = np.stack([column.ravel(), row.ravel()], -1)
            column, row = undistort_pixels(pixels, *camera).T.reshape(2, *u.shape)
            status = np.where(np.isnan(column), NOT_INVERTIBLE, status)
            straight_u, straight_v = (row, column) if along == "columns" else (column, row)
        g, h, w = (line[0] * straight_u + line[1] * straight_v + line[2] for line in matrix)
        hidden = w / (matrix[2] @ middle) <= horizon
        g, h = g / w, h / w
    status = np.where(hidden & (status == 0), HORIZON, status)
    status = np.where(np.isfinite(u) & np.isfinite(v), status, NOT_FINITE).astype(np.uint8)
    return np.where(status == 0, g, np.nan), np.where(status == 0, h, np.nan), status
