"""Projection of many views through a camera with a tilted sensor, with derivatives, for bundle adjustment.

The camera frame is the sensor's frame: z is the sensor's normal. Without distortion the camera is the virtual pinhole
S' of F. de Jong, fig. 3.3, with focal length f = f' cos(alpha) (eq. 3.1) and principal point v at the foot of the
perpendicular from the pinhole. The lens is rotated against this frame; the rotation acts through the distortion only.
Data without distortion determine f and v and leave the tilt free in these coordinates. In f', centre and tilt the same
data form a curved valley, which slows down or stops an optimiser.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

INTERNAL = ("f", "aspect", "v_column", "v_row", "tauX", "tauY", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COLUMNS = len(INTERNAL) + 6
"""Number of Jacobian columns: `INTERNAL`, then the pose (a rotation vector applied from the left, a translation)."""


class Projection(NamedTuple):
    """Projected points of all views.

    Attributes
    ----------
    points : numpy.ndarray
        (views, 2, n): columns and rows [px].
    in_front : bool
        Every point lies before the pinhole, on the visible side of lens and sensor.
    jacobian : numpy.ndarray or None
        (views, COLUMNS, 2, n); None if not requested, or if a point is not in front.
    """

    points: Floats
    in_front: bool
    jacobian: Floats | None


def tilt_matrix(tau_x: float, tau_y: float) -> Floats:
    """Return the rotation (3, 3) from the lens' frame to the sensor's of OpenCV's tauX and tauY [rad] (R_y R_x)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    return np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])


def rotation_matrix(vector: npt.ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]: Rodrigues' formula, exact near zero."""
    w = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    cross = np.zeros((*w.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    cross -= np.swapaxes(cross, -1, -2)
    # sinc keeps both coefficients finite at angle 0.
    half = np.sinc(angle / (2.0 * np.pi))
    rotation: Floats = np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross)
    return rotation


def project(
    internal: Floats, rotations: Floats, translations: Floats, target: Floats, derivatives: bool = False
) -> Projection:
    """Project target points through the poses of all views and a tilted camera.

    Parameters
    ----------
    internal : numpy.ndarray
        (14,): the parameters named in `INTERNAL` [px], [rad], and OpenCV's distortion coefficients.
    rotations, translations : numpy.ndarray
        (views, 3, 3) and (views, 3): from the target to the *sensor's* frame.
    target : numpy.ndarray
        (views, 3, n): target points, in the unit of the translations.
    derivatives : bool
        Compute the Jacobian as well. Default False.

    Returns
    -------
    Projection
    """
    f, aspect, v_column, v_row, tau_x, tau_y, k1, k2, p1, p2, k3, k4, k5, k6 = internal.tolist()
    m = tilt_matrix(tau_x, tau_y)
    rotated = rotations @ target
    p = rotated + translations[:, :, None]
    q = m.T @ p
    with np.errstate(all="ignore"):
        depth = 1.0 / q[:, 2]
        x, y = q[:, 0] * depth, q[:, 1] * depth
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        divisor = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * divisor
        xd = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
        yd = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
        inverse = 1.0 / (m[2, 0] * xd + m[2, 1] * yd + m[2, 2])
        u = (m[0, 0] * xd + m[0, 1] * yd + m[0, 2]) * inverse
        w = (m[1, 0] * xd + m[1, 1] * yd + m[1, 2]) * inverse
        points = np.stack([f * u + v_column, aspect * f * w + v_row], axis=1)
    in_front = bool((depth > 0.0).all() and (inverse > 0.0).all() and np.isfinite(points).all())
    if not derivatives or not in_front:
        return Projection(points, in_front, None)
    jacobian = _jacobian(internal, m, rotated, p, _Rays(depth, x, y, radial, divisor, inverse, u, w))
    return Projection(points, in_front, jacobian)


class _Rays(NamedTuple):
    """Intermediate results of `project`, (views, n) each.

    Attributes
    ----------
    depth
        1 / z in the lens' frame.
    x, y
        Undistorted normalised coordinates.
    radial
        Factor of the radial distortion.
    divisor
        1 / denominator of that factor (k4, k5, k6).
    inverse
        1 / denominator of the projection on the tilted sensor.
    u, w
        Coordinates on the tilted sensor, for f = 1.
    """

    depth: Floats
    x: Floats
    y: Floats
    radial: Floats
    divisor: Floats
    inverse: Floats
    u: Floats
    w: Floats


def _jacobian(internal: Floats, m: Floats, rotated: Floats, p: Floats, rays: _Rays) -> Floats:
    """Return the derivatives (views, columns, 2, n) of the image points."""
    f, aspect, _, _, _, _, k1, k2, p1, p2, k3, k4, k5, k6 = internal.tolist()
    depth, x, y, radial, divisor, inverse, u, w = rays
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    jacobian = np.zeros((len(rotated), COLUMNS, 2, rotated.shape[-1]))
    # Derivative of the factor by r^2, for a quotient of polynomials.
    slope = (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) * divisor
    # The 2 x 2 Jacobian of the distortion is symmetric.
    lens_xx = radial + 2.0 * xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
    lens_yy = radial + 2.0 * yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
    lens_xy = 2.0 * (xy * slope + p1 * x + p2 * y)
    r4 = r2 * r2
    p1_x, p1_y, p2_x, p2_y = 2.0 * xy, r2 + 2.0 * yy, r2 + 2.0 * xx, 2.0 * xy
    for row, (coordinate, focal) in enumerate(((u, f), (w, aspect * f))):
        out = jacobian[:, :, row]
        scale = focal * inverse
        by_xd, by_yd = scale * (m[row, 0] - coordinate * m[2, 0]), scale * (m[row, 1] - coordinate * m[2, 1])
        along = (by_xd * x + by_yd * y) * divisor
        out[:, 6] = along * r2
        out[:, 7] = along * r4
        out[:, 8] = by_xd * p1_x + by_yd * p1_y
        out[:, 9] = by_xd * p2_x + by_yd * p2_y
        out[:, 10] = out[:, 7] * r2
        out[:, 11:14] = -radial[:, None] * out[:, (6, 7, 10)]
        by_x, by_y = (by_xd * lens_xx + by_yd * lens_xy) * depth, (by_xd * lens_xy + by_yd * lens_yy) * depth
        g = m @ np.stack([by_x, by_y, -(by_x * x + by_y * y)], axis=1)
        out[:, 17:] = g
        _cross(rotated, g, out[:, 14:17])
        _tilt_columns(m, focal * _by_ray_rotation(row, u, w), p, g, out[:, 4:6])
    jacobian[:, 0, 0], jacobian[:, 0, 1] = u, aspect * w
    jacobian[:, 1, 1] = f * w
    jacobian[:, 2, 0] = jacobian[:, 3, 1] = 1.0
    return jacobian


def _cross(a: Floats, b: Floats, out: Floats) -> None:
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _by_ray_rotation(row: int, u: Floats, w: Floats) -> Floats:
    """Return the derivative of u (row 0) or w (row 1) by a rotation vector applied to the outgoing ray (u, w, 1)."""
    if row == 0:
        return np.stack([-u * w, 1.0 + u * u, -w], axis=1)
    return np.stack([-1.0 - w * w, u * w, u], axis=1)


def _tilt_columns(m: Floats, turn: Floats, p: Floats, g: Floats, out: Floats) -> None:
    """Write the derivatives by tauX and tauY: both the incoming ray in the lens' frame and the outgoing ray rotate."""
    about_x = turn[:, 0] - (p[:, 1] * g[:, 2] - p[:, 2] * g[:, 1])
    about_y = turn[:, 1] - (p[:, 2] * g[:, 0] - p[:, 0] * g[:, 2])
    about_z = turn[:, 2] - (p[:, 0] * g[:, 1] - p[:, 1] * g[:, 0])
    # tauX rotates about the x axis that tauY has rotated already; both have the opposite sense of a rotation vector.
    out[:, 0] = -(m[0, 0] * about_x + m[2, 0] * about_z)
    out[:, 1] = -about_y
