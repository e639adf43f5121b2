"""Reference of OpenCV's lens model with 14 coefficients, written out as its documentation does, in extended precision.

``distortion`` is (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tauX, tauY). Coordinates may be
complex, for derivatives by complex steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[Any]


def distort(x: Points, y: Points, distortion: ArrayLike) -> tuple[Points, Points]:
    """Return (x', y') of normalised ideal coordinates, before the tilt."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.asarray(distortion, np.longdouble)[:12]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
    )


def tilt(x: Points, y: Points, tau_x: float, tau_y: float) -> tuple[Points, Points]:
    """Return (x'', y''): the projection of the rotated (x, y, 1) along the new axis, element by element."""
    cx, sx, cy, sy = (f(np.longdouble(t)) for t in (tau_x, tau_y) for f in (np.cos, np.sin))
    # R = Ry(tauY) Rx(tauX).
    r = [[cy, sy * sx, -sy * cx], [0, cx, sx], [sy, -cy * sx, cy * cx]]
    u, v, w = (row[0] * x + row[1] * y + row[2] for row in r)
    return (r[2][2] * u - r[0][2] * w) / w, (r[2][2] * v - r[1][2] * w) / w


def distort_pixels(
    points: ArrayLike, matrix: ArrayLike, distortion: ArrayLike, ideal_matrix: ArrayLike | None = None
) -> Points:
    """Return the measured pixels of ideal pixels.

    Parameters
    ----------
    points : array
        Pixels of a camera without distortion, (n, 2).
    matrix : array
        Camera matrix, (3, 3).
    distortion : array
        The 14 coefficients.
    ideal_matrix : array, optional
        Camera matrix of the ideal pixels; default ``matrix``.
    """
    coefficients = np.asarray(distortion, np.longdouble)
    (fx, _, cx), (_, fy, cy), _ = np.asarray(matrix, np.longdouble)
    (gx, _, dx), (_, gy, dy), _ = np.asarray(matrix if ideal_matrix is None else ideal_matrix, np.longdouble)
    u, v = np.asarray(points, np.longdouble).T
    x, y = tilt(*distort((u - dx) / gx, (v - dy) / gy, coefficients), *coefficients[12:])
    return np.stack([fx * x + cx, fy * y + cy], -1)


def determinant(x: Points, y: Points, distortion: ArrayLike) -> Points:
    """Return the determinant of d(x', y') / d(x, y), by complex steps."""
    tiny = np.longdouble(1e-30)
    by_x, by_y = distort(x + 1j * tiny, y + 0j, distortion), distort(x + 0j, y + 1j * tiny, distortion)
    return np.asarray((by_x[0].imag * by_y[1].imag - by_y[0].imag * by_x[1].imag) / tiny**2)


def fold_radius(angle: float, distortion: ArrayLike, farthest: float, steps: int = 20_000) -> float:
    """Return the radius along a ray at which the determinant turns negative, or inf if beyond ``farthest``."""
    radii = np.linspace(0.0, farthest, steps).astype(np.longdouble)
    negative = determinant(radii * np.cos(angle), radii * np.sin(angle), distortion) <= 0
    return float(radii[np.argmax(negative)]) if negative.any() else np.inf


def undistort_pixels(points: ArrayLike, matrix: ArrayLike, distortion: ArrayLike, steps: int = 32) -> Points:
    """Return the ideal pixels (same camera matrix) of measured pixels (n, 2); NaN where there is none.

    The target moves from the centre to the measured point in ``steps`` parts; Newton steps with derivatives by complex
    steps follow it, so that the solution stays on the branch of the centre. Pixels behind the tilted sensor, and pixels
    whose path meets a determinant that is not positive, have no ideal pixel.
    """
    coefficients = np.asarray(distortion, np.longdouble)
    (fx, _, cx), (_, fy, cy), _ = np.asarray(matrix, np.longdouble)
    u, v = np.asarray(points, np.longdouble).T
    a, b, behind = _untilt((u - cx) / fx, (v - cy) / fy, *coefficients[12:])
    x, y = np.zeros_like(a), np.zeros_like(b)
    lost, tiny = behind.copy(), np.longdouble(1e-30)
    with np.errstate(all="ignore"):
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            for _ in range(4 if share < 1.0 else 8):
                at = distort(x, y, coefficients)
                by_x = [each.imag / tiny for each in distort(x + 1j * tiny, y + 0j, coefficients)]
                by_y = [each.imag / tiny for each in distort(x + 0j, y + 1j * tiny, coefficients)]
                area = by_x[0] * by_y[1] - by_y[0] * by_x[1]
                p, q = share * a - at[0], share * b - at[1]
                x, y = x + (by_y[1] * p - by_y[0] * q) / area, y + (by_x[0] * q - by_x[1] * p) / area
                lost |= ~(area > 0)
        at = distort(x, y, coefficients)
        lost |= ~(np.hypot(at[0] - a, at[1] - b) <= 1e-15 * (1 + np.hypot(a, b)))
    return np.stack([np.where(lost, np.nan, fx * x + cx), np.where(lost, np.nan, fy * y + cy)], -1)


def _untilt(x: Points, y: Points, tau_x: Any, tau_y: Any) -> tuple[Points, Points, NDArray[np.bool_]]:
    """Return the inverse of `tilt`, and where the ray through the sensor's point does not meet the untilted plane."""
    cx, sx, cy, sy = (f(np.longdouble(t)) for t in (tau_x, tau_y) for f in (np.cos, np.sin))
    # R = Ry(tauY) Rx(tauX); the sensor's plane lies at distance r22 along its own axis, shifted by (r02, r12).
    r = [[cy, sy * sx, -sy * cx], [0, cx, sx], [sy, -cy * sx, cy * cx]]
    s, t, w = x + r[0][2], y + r[1][2], r[2][2]
    back = [r[0][i] * s + r[1][i] * t + r[2][i] * w for i in range(3)]
    with np.errstate(all="ignore"):
        return back[0] / back[2], back[1] / back[2], ~(back[2] > 0)
