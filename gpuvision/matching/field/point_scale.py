"""Scale of a robot's points as one more unknown of its pose: a test of the nested model.

A pose is found for points in metres. Where their scale is wrong, the residuals of the points depend on it: solve again
about the pose with the scale as a fourth unknown, and compare its error with its standard deviation.

References
----------
.. [1] P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2nd edition, Wiley 2009, section 7.6 (covariance of an
   M-estimator).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.field.distance_map import Field

Float64 = npt.NDArray[np.float64]

# Largest number of Gauss-Newton steps, and the step of the scale that ends them (chosen: a hundredth of a permille).
_MAX_ITERATIONS, _MIN_STEP = 30, 1e-5
# Least ratio of eigenvalues of the information at which the points determine the scale (chosen: single precision).
_MIN_EIGENVALUE_RATIO = 1e-7
# A point is on a line within this many standard deviations of the points near lines (chosen: 99 % of normal errors).
_ON_LINE = 2.5


class PointScale(NamedTuple):
    """Relative error of the scale of points, above 0 where the points are too far from the robot.

    Attributes
    ----------
    error, sigma : float
        Error and its standard deviation, relative.
    gained : int
        Number of points on lines, more than without an error of the scale.
    pose : (3,)
        Pose that is fitted with the scale: x, y [m] and heading [rad].
    """

    error: float
    sigma: float
    gained: int
    pose: Float64


def point_scale(points: npt.ArrayLike, field: Field, pose: npt.ArrayLike, *, scale: float) -> PointScale | None:
    """Fit pose and scale of points to the lines of a field.

    Parameters
    ----------
    points
        (points, 2) in the robot's frame [m].
    field, pose
        Field, and pose at which the fit begins: x, y [m] and heading [rad].
    scale
        c of a point's cost r^2 / (c^2 + r^2), with r its distance from the nearest line [m].

    Returns
    -------
    PointScale, optional
        None where the points do not determine the scale, for example points on two lines that meet, or where the fit
        does not converge.

    Notes
    -----
    Gauss-Newton steps with the weights c^4 / (c^2 + r^2)^2 of the Geman-McClure loss, the loss of the pose. The
    covariance is the covariance of an M-estimator: H^-1 (sum psi^2 j j^T) H^-1 n / (n - 4), H the curvature of the
    cost, with psi the derivative of a point's cost and n the sum of the weights.

    Points in clutter are beside other lines at other scales. Where the points on lines hardly determine the scale, such
    a scale is found with a small standard deviation, but it gains few points.
    """
    found = np.asarray(points, np.float64)
    x, y, heading = np.asarray(pose, np.float64)
    unknowns = np.array([x, y, heading, 0.0])
    size = np.array([1.0, 1.0, *[1.0 / max(float(np.median(np.hypot(*found.T))), 1e-12)] * 2])  # similar units
    start: Float64 | None = None
    for _ in range(_MAX_ITERATIONS):
        rows, left = _linearised(found, field, unknowns)
        start = left if start is None else start
        weights = (scale**2 / (scale**2 + left**2)) ** 2
        rows = rows * size
        information = rows.T @ (weights[:, None] * rows)
        if not _is_determined(information):
            return None
        step = -size * np.linalg.solve(information, rows.T @ (weights * left))
        unknowns += step
        if abs(step[3]) < _MIN_STEP:
            break
    else:
        return None
    slopes = weights * (scale**2 - 3.0 * left**2) / (scale**2 + left**2)
    curvature = rows.T @ (slopes[:, None] * rows)
    count = float(weights.sum())
    if count <= 4.0 or not _is_determined(curvature):
        return None
    inverse = np.linalg.inv(curvature)
    covariance = inverse @ (rows.T @ (((weights * left) ** 2)[:, None] * rows)) @ inverse * count / (count - 4.0)
    # The model scales the points by exp(unknown): points that are too far need a factor below 1.
    error = math.exp(-unknowns[3]) - 1.0
    sigma = (1.0 + error) * float(size[3]) * math.sqrt(covariance[3, 3])
    assert start is not None
    return PointScale(error, sigma, _gained(start, left, scale), unknowns[:3])


def _gained(before: Float64, after: Float64, scale: float) -> int:
    """Return how many more points lie on lines, from the distances before and after a fit."""
    near = [each[each < scale] for each in (np.abs(before), np.abs(after))]
    sigma = min((1.4826 * float(np.median(each)) for each in near if len(each)), default=0.0)
    first, last = (int(np.count_nonzero(each < _ON_LINE * sigma)) for each in near)
    return last - first


def _is_determined(information: Float64) -> bool:
    values = np.linalg.eigvalsh(information)
    return bool(values[0] > _MIN_EIGENVALUE_RATIO * values[-1])


def _linearised(points: Float64, field: Field, unknowns: Float64) -> tuple[Float64, Float64]:
    """Return the Jacobian (n, 4) and the signed distances (n,) of the points beside lines, at x, y, heading, scale."""
    x, y, heading, log_scale = unknowns
    c, s = (math.exp(log_scale) * f(heading) for f in (math.cos, math.sin))
    arm = points @ np.array([[c, s], [-s, c]])
    left, normals = _nearest_lines(field, arm + np.array([x, y]))
    kept = np.isfinite(left)
    arm, left, normals = arm[kept], left[kept], normals[kept]
    turned = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
    return np.column_stack([normals, turned, np.sum(normals * arm, axis=1)]), left


def _nearest_lines(field: Field, places: Float64) -> tuple[Float64, Float64]:
    """Return the signed distance (n,) of places from the nearest line or arc beside them, and its normal (n, 2).

    Infinity where a place is beyond the ends of all lines.
    """
    left, normals = [], []
    if field.lines:
        start, end = np.split(np.array(field.lines), 2, axis=1)
        length = np.hypot(*(end - start).T)
        along = (end - start) / length[:, None]
        across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        is_beside = np.abs(places @ along.T - np.sum(start * along, axis=1) - 0.5 * length) <= 0.5 * length
        left.append(np.where(is_beside, places @ across.T - np.sum(start * across, axis=1), np.inf))
        normals.append(np.broadcast_to(across, (*left[0].shape, 2)))
    for arc in field.arcs:
        away = places - (arc.x, arc.y)
        distance = np.hypot(*away.T)
        turned = np.mod(np.arctan2(away[:, 1], away[:, 0]) - arc.start, 2.0 * math.pi)
        left.append(np.where(turned <= arc.end - arc.start, distance - arc.radius, np.inf)[:, None])
        normals.append((away / np.maximum(distance, 1e-12)[:, None])[:, None])
    distances, directions = np.concatenate(left, axis=1), np.concatenate(normals, axis=1)
    nearest = np.argmin(np.abs(distances), axis=1)
    index = np.arange(len(places))
    return distances[index, nearest], directions[index, nearest]
