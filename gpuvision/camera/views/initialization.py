"""Starting values of a calibration from views of a plane: homographies with distortion, and Zhang's closed form.

A camera with a tilted sensor and no distortion is a pinhole camera with square pixels (F. de Jong, fig. 3.3). Zhang's
closed form therefore gives f and v of the virtual camera for any tilt. Lens distortion biases the homographies; radial
terms about the image's centre, common to all views, remove most of it.

References
----------
Z. Zhang, A flexible new technique for camera calibration, IEEE Trans. PAMI 22 (2000) 1330.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import MEDIAN_OF_NORM, PackedViews

# Gauss-Newton rounds of the homographies: with the squared loss, and with reweighting against outliers.
_ROUNDS = 4
_ROBUST_ROUNDS = 15
# Reweighting, in medians of a view's residual lengths: length below which the weight is constant; length from which a
# point is rejected in the last rounds.
_FULL_WEIGHT = 0.3
_REJECTED = 6.0


class UndistortedHomographies(NamedTuple):
    """Homographies of all views to undistorted image coordinates.

    Attributes
    ----------
    homographies
        (views, 3, 3): from the target's plane to (pixel - centre) / radius.
    radial
        (2,): radial distortion coefficients in these coordinates.
    noise
        Standard deviation of a coordinate of the residuals [px].
    """

    homographies: Floats
    radial: Floats
    noise: float


def fit_homographies(
    views: PackedViews, centre: Floats, radius: float, *, robust: bool = False, undistorted: bool = False
) -> UndistortedHomographies:
    """Fit a homography per view and two common radial terms, by Gauss-Newton from the linear solution.

    Parameters
    ----------
    views : PackedViews
        Points of a flat target, and their measured image points.
    centre : numpy.ndarray
        (2,): centre of the radial terms [px].
    radius : float
        Unit of the radial terms [px].
    robust : bool
        Reweight against outliers. Default False.
    undistorted : bool
        The points are undistorted: omit the radial terms. Default False.
    """
    measured = (views.image - centre[:, None]) / radius
    # Normalise each target to zero mean and unit size.
    plane, normalisation = _normalise_targets(views)
    weight = views.weight.copy()
    homographies = _direct_linear(plane, measured, weight)
    radial = np.zeros(2)
    rounds = _ROBUST_ROUNDS if robust else _ROUNDS
    for round_ in range(rounds):
        residual, by_radial, by_homography = _linearise(plane, measured, homographies, radial)
        by_radial *= not undistorted
        if robust:
            length = np.linalg.norm(residual, axis=1)
            # The median of each view: a view that is wrong as a whole keeps its points here.
            middle = np.nanmedian(np.where(views.weight > 0.0, length, np.nan), axis=1)[:, None]
            weight = views.weight / np.maximum(length, _FULL_WEIGHT * middle + 1e-12) * middle
            if round_ > _ROBUST_ROUNDS - 4:
                weight *= length < _REJECTED * middle + 1e-12
        step, steps = _gauss_newton_step(residual, by_radial, by_homography, weight)
        radial = radial + step
        homographies = homographies + np.concatenate([steps, np.zeros((len(steps), 1))], axis=1).reshape(-1, 3, 3)
    residual, _, _ = _linearise(plane, measured, homographies, radial)
    length = np.linalg.norm(residual, axis=1)[views.weight > 0.0]
    if robust:
        noise = float(np.median(length)) / MEDIAN_OF_NORM
    else:
        spare = max(views.coordinates - 8 * len(homographies) - 2, 1)
        noise = math.sqrt(float(np.sum(length**2)) / spare)
    return UndistortedHomographies(homographies @ normalisation, radial, noise * radius)


def _normalise_targets(views: PackedViews) -> tuple[Floats, Floats]:
    """Return the target points as (x, y, 1) of unit size (views, 3, n), and the normalising matrices (views, 3, 3)."""
    total = np.sum(views.weight, axis=1)
    middle = np.sum(views.weight[:, None] * views.target[:, :2], axis=2) / total[:, None]
    offset = (views.target[:, :2] - middle[..., None]) * views.weight[:, None]
    size = np.sqrt(np.sum(offset**2, axis=(1, 2)) / total)
    normalisation = np.zeros((len(total), 3, 3))
    normalisation[:, 0, 0] = normalisation[:, 1, 1] = 1.0 / size
    normalisation[:, :2, 2] = -middle / size[:, None]
    normalisation[:, 2, 2] = 1.0
    return np.concatenate([offset / size[:, None, None], np.ones_like(offset[:, :1])], axis=1), normalisation


def _direct_linear(plane: Floats, measured: Floats, weight: Floats) -> Floats:
    """Return the homographies of least algebraic error (DLT), with element (2, 2) equal to 1."""
    x = plane * weight[:, None]
    zero = np.zeros_like(x)
    rows = [
        np.concatenate([x, zero, -measured[:, :1] * x], axis=1),
        np.concatenate([zero, x, -measured[:, 1:] * x], axis=1),
    ]
    scatter = sum(row @ np.swapaxes(row, 1, 2) for row in rows)
    smallest: Floats = np.linalg.eigh(scatter)[1][:, :, 0]
    return (smallest / smallest[:, -1:]).reshape(-1, 3, 3)


def _linearise(plane: Floats, measured: Floats, homographies: Floats, radial: Floats) -> tuple[Floats, Floats, Floats]:
    """Return residuals (views, 2, n), derivatives by radials (views, 2, 2, n) and by homographies (views, 8, 2, n)."""
    mapped = homographies @ plane
    inverse = 1.0 / mapped[:, 2]
    x, y = mapped[:, 0] * inverse, mapped[:, 1] * inverse
    r2 = x * x + y * y
    scale = 1.0 + r2 * (radial[0] + radial[1] * r2)
    slope = 2.0 * (radial[0] + 2.0 * radial[1] * r2)
    residual = measured - np.stack([x * scale, y * scale], axis=1)
    point = np.stack([x, y], axis=1)
    by_radial = np.stack([point * r2[:, None], point * (r2 * r2)[:, None]], axis=1)
    by_x = np.stack([scale + slope * x * x, slope * x * y], axis=1) * inverse[:, None]
    by_y = np.stack([slope * x * y, scale + slope * y * y], axis=1) * inverse[:, None]
    by_scale = -(by_x * x[:, None] + by_y * y[:, None])
    by_homography = [by * plane[:, None, k] for by in (by_x, by_y, by_scale) for k in range(3)]
    return residual, by_radial, np.stack(by_homography[:8], axis=1)


def _gauss_newton_step(
    residual: Floats, by_radial: Floats, by_homography: Floats, weight: Floats
) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton steps of the radial terms, homographies eliminated, and of the homographies."""
    count = len(residual)
    jacobian = np.concatenate([by_radial, by_homography], axis=1).reshape(count, 10, -1)
    weighted = jacobian * np.repeat(weight[:, None], 2, axis=1).reshape(count, 1, -1)
    hessian = weighted @ np.swapaxes(jacobian, 1, 2)
    side = weighted @ residual.reshape(count, -1, 1)
    right = np.concatenate([hessian[:, 2:, :2], side[:, 2:]], axis=2)
    solved = np.linalg.solve(hessian[:, 2:, 2:], right)
    reduced = hessian[:, :2, :2].sum(axis=0) - np.sum(hessian[:, :2, 2:] @ solved[..., :2], axis=0)
    rest = side[:, :2].sum(axis=0) - np.sum(hessian[:, :2, 2:] @ solved[..., 2:], axis=0)
    step = np.linalg.lstsq(reduced, rest[:, 0], rcond=1e-12)[0]
    return step, solved[..., 2] - solved[..., :2] @ step


def zhang_closed_form(homographies: Floats, aspect: bool) -> tuple[float, float, Floats] | None:
    """Return (f, fy / fx, v) by Zhang's closed form without skew, in the homographies' units; None without solution.

    Parameters
    ----------
    homographies : numpy.ndarray
        (views, 3, 3), two views or more.
    aspect : bool
        Estimate fy / fx; otherwise it is 1.
    """
    first, second = homographies[:, :, 0], homographies[:, :, 1]
    scale = 1.0 / np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))[:, None]
    rows = np.concatenate(
        [_conic_row(first, second) * scale, 0.5 * (_conic_row(first, first) - _conic_row(second, second)) * scale]
    )
    if not aspect:
        rows = np.concatenate([rows[:, :1] + rows[:, 1:2], rows[:, 2:]], axis=1)
    conic = np.linalg.svd(rows)[2][-1]
    xx, yy = (conic[0], conic[1]) if aspect else (conic[0], conic[0])
    x, y, rest = conic[-3:] / xx if xx != 0.0 else np.full(3, np.nan)
    ratio2 = xx / yy if yy != 0.0 else np.nan
    v = np.array([-x, -y * ratio2])
    f2 = rest - x * x - y * y * ratio2
    if not (np.isfinite(f2) and f2 > 0.0 and ratio2 > 0.0):
        return None
    return float(np.sqrt(f2)), float(np.sqrt(ratio2)), v


def _conic_row(a: Floats, b: Floats) -> Floats:
    """Return the coefficients of a^T omega b in the elements (xx, yy, x, y, 1) of omega."""
    return np.stack(
        [
            a[:, 0] * b[:, 0],
            a[:, 1] * b[:, 1],
            a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
            a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 2],
        ],
        axis=1,
    )


def tilt_closed_form(
    homographies: Floats, direction: float | None, focal_length: float | None
) -> tuple[float, Floats] | None:
    """Return f and v in closed form for a known centre, in the homographies' units about it; None without solution.

    Every view gives two equations on the image of the absolute conic, linear in v and f'^2 = f^2 + v^2.

    Parameters
    ----------
    homographies : numpy.ndarray
        (views, 3, 3) about the centre, one view or more.
    direction : float or None
        Known direction from the centre to v, or its opposite [rad].
    focal_length : float or None
        Known f'. One view determines two of the three parameters f' and v.
    """
    h1, h2 = homographies[:, :, 0], homographies[:, :, 1]
    scale = 1.0 / np.sqrt(np.sum(h1**2, axis=1) * np.sum(h2**2, axis=1))
    constant = np.concatenate([np.sum((h1 * h2)[:, :2], axis=1), 0.5 * np.sum((h1**2 - h2**2)[:, :2], axis=1)])
    by_v = np.concatenate(
        [-h1[:, :2] * h2[:, 2:] - h2[:, :2] * h1[:, 2:], h2[:, :2] * h2[:, 2:] - h1[:, :2] * h1[:, 2:]]
    )
    by_square = np.concatenate([h1[:, 2] * h2[:, 2], 0.5 * (h1[:, 2] ** 2 - h2[:, 2] ** 2)])
    basis = np.eye(2) if direction is None else np.array([[math.cos(direction)], [math.sin(direction)]])
    weight = np.concatenate([scale, scale])
    along, by_square, side = (by_v @ basis) * weight[:, None], by_square * weight, -constant * weight
    if focal_length is None:
        found = np.linalg.lstsq(np.column_stack([along, by_square]), side, rcond=None)[0]
        square, v = float(found[-1]), basis @ found[:-1]
    else:
        square = focal_length**2
        v = basis @ np.linalg.lstsq(along, side - by_square * square, rcond=None)[0]
    f2 = square - float(v @ v)
    return (math.sqrt(f2), v) if f2 > 0.0 else None


def poses_from_homographies(homographies: Floats, f: float, aspect: float, v: Floats) -> tuple[Floats, Floats]:
    """Return rotations and translations of the planes from their homographies and a pinhole camera."""
    inverse = np.array([[1.0 / f, 0.0, -v[0] / f], [0.0, 1.0 / (aspect * f), -v[1] / (aspect * f)], [0.0, 0.0, 1.0]])
    columns = inverse @ homographies
    lengths = np.linalg.norm(columns[:, :, :2], axis=1)
    # The mean of each target has the homogeneous weight 1: the target lies in front of the camera for any scale.
    scale = 2.0 / lengths.sum(axis=1)
    columns = columns * scale[:, None, None]
    third = np.cross(columns[:, :, 0], columns[:, :, 1])
    u, _, vt = np.linalg.svd(np.concatenate([columns[:, :, :2], third[:, :, None]], axis=2))
    return u @ vt, columns[:, :, 2]
