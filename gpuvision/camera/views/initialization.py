"""Where a calibration from views of a plane starts: homographies with the lens in them, and Zhang's closed form.

A camera with a tilted sensor and no distortion is a pinhole camera with square pixels (fig. 3.3), so Zhang's closed
form gives f and v of the virtual camera whatever the tilt. Distortion bends the homographies; one radial term about
the image's centre, common to all views, takes most of it out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import MEDIAN_OF_NORM, Views

_ROUNDS = 4
_ROBUST_ROUNDS = 15


class Flat(NamedTuple):
    """Homographies of all views, undistorted about a centre.

    Attributes
    ----------
    homographies
        (views, 3, 3): target's plane to (pixel - centre) / radius.
    radial
        The two coefficients, at that radius.
    noise
        What they leave, pixels per coordinate.
    """

    homographies: Floats
    radial: Floats
    noise: float


def flatten(views: Views, centre: Floats, radius: float, *, robust: bool = False, straight: bool = False) -> Flat:
    """Fit a homography per view and two radial terms for all, by Gauss-Newton from the linear solution.

    Parameters
    ----------
    views
        Points of a flat target, and where they were seen.
    centre, radius
        Where the radial terms have their centre, and the pixels that are 1 in their unit.
    robust
        Whether there may be outliers.
    straight
        Whether the points are undistorted already: no radial terms then.
    """
    seen = (views.seen - centre[:, None]) / radius
    # Targets in units of their own extent, about their own middle.
    plane, back = _plane_units(views)
    weight = views.weight.copy()
    homographies = _direct_linear(plane, seen, weight)
    radial = np.zeros(2)
    rounds = _ROBUST_ROUNDS if robust else _ROUNDS
    for round_ in range(rounds):
        residual, by_radial, by_homography = _bent(plane, seen, homographies, radial)
        by_radial *= not straight
        if robust:
            length = np.linalg.norm(residual, axis=1)
            # Of each view: one that is all wrong shall not lose all its points here.
            middle = np.nanmedian(np.where(views.weight > 0.0, length, np.nan), axis=1)[:, None]
            weight = views.weight / np.maximum(length, 0.3 * middle + 1e-12) * middle
            if round_ > _ROBUST_ROUNDS - 4:  # beyond doubt an outlier by now
                weight *= length < 6.0 * middle + 1e-12
        step, steps = _eliminated(residual, by_radial, by_homography, weight)
        radial = radial + step
        homographies = homographies + np.concatenate([steps, np.zeros((len(steps), 1))], axis=1).reshape(-1, 3, 3)
    residual, _, _ = _bent(plane, seen, homographies, radial)
    length = np.linalg.norm(residual, axis=1)[views.weight > 0.0]
    if robust:
        noise = float(np.median(length)) / MEDIAN_OF_NORM
    else:
        spare = max(views.coordinates - 8 * len(homographies) - 2, 1)
        noise = math.sqrt(float(np.sum(length**2)) / spare)
    return Flat(homographies @ back, radial, noise * radius)


def _plane_units(views: Views) -> tuple[Floats, Floats]:
    """Target points (views, 3, n) as (x, y, 1) of unit size, and the matrices (views, 3, 3) that took them there."""
    total = np.sum(views.weight, axis=1)
    middle = np.sum(views.weight[:, None] * views.target[:, :2], axis=2) / total[:, None]
    offset = (views.target[:, :2] - middle[..., None]) * views.weight[:, None]
    size = np.sqrt(np.sum(offset**2, axis=(1, 2)) / total)
    back = np.zeros((len(total), 3, 3))
    back[:, 0, 0] = back[:, 1, 1] = 1.0 / size
    back[:, :2, 2] = -middle / size[:, None]
    back[:, 2, 2] = 1.0
    return np.concatenate([offset / size[:, None, None], np.ones_like(offset[:, :1])], axis=1), back


def _direct_linear(plane: Floats, seen: Floats, weight: Floats) -> Floats:
    """Homographies of least algebraic error, element (2, 2) equal to 1."""
    x = plane * weight[:, None]
    zero = np.zeros_like(x)
    rows = [
        np.concatenate([x, zero, -seen[:, :1] * x], axis=1),
        np.concatenate([zero, x, -seen[:, 1:] * x], axis=1),
    ]
    scatter = sum(row @ np.swapaxes(row, 1, 2) for row in rows)
    smallest: Floats = np.linalg.eigh(scatter)[1][:, :, 0]
    return (smallest / smallest[:, -1:]).reshape(-1, 3, 3)


def _bent(plane: Floats, seen: Floats, homographies: Floats, radial: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (views, 2, n), derivatives by the radial terms (views, 2, 2, n) and homographies (views, 8, 2, n)."""
    mapped = homographies @ plane
    inverse = 1.0 / mapped[:, 2]
    x, y = mapped[:, 0] * inverse, mapped[:, 1] * inverse
    r2 = x * x + y * y
    growth = 1.0 + r2 * (radial[0] + radial[1] * r2)
    slope = 2.0 * (radial[0] + 2.0 * radial[1] * r2)
    residual = seen - np.stack([x * growth, y * growth], axis=1)
    point = np.stack([x, y], axis=1)
    by_radial = np.stack([point * r2[:, None], point * (r2 * r2)[:, None]], axis=1)
    by_x = np.stack([growth + slope * x * x, slope * x * y], axis=1) * inverse[:, None]
    by_y = np.stack([slope * x * y, growth + slope * y * y], axis=1) * inverse[:, None]
    by_scale = -(by_x * x[:, None] + by_y * y[:, None])
    by_homography = [by * plane[:, None, k] for by in (by_x, by_y, by_scale) for k in range(3)]
    return residual, by_radial, np.stack(by_homography[:8], axis=1)


def _eliminated(residual: Floats, by_radial: Floats, by_homography: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Gauss-Newton step: radial terms with the homographies eliminated, then the homographies."""
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


def closed_form(homographies: Floats, aspect: bool) -> tuple[float, float, Floats] | None:
    """Zhang's closed form without skew: (f, fy / fx, v) in the homographies' units, or None where it has none.

    Parameters
    ----------
    homographies
        Of two views or more.
    aspect
        Whether fy / fx is sought; 1 otherwise.
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
    """Coefficients of a^T omega b in omega's elements (xx, yy, x, y, 1)."""
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


def closed_form_of_tilt(
    homographies: Floats, direction: float | None, focal_length: float | None
) -> tuple[float, Floats] | None:
    """Return f and v in closed form where the centre is known, in the homographies' units about it, or None.

    Every view gives two equations on the image of the absolute conic, linear in v and f'^2 = f^2 + v^2.

    Parameters
    ----------
    homographies
        Of one view or more, about the centre.
    direction
        In which v lies from the centre (or opposite), where that is known, radians.
    focal_length
        f' where it is known. One view fixes two numbers of f' and v.
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


def poses(homographies: Floats, f: float, aspect: float, v: Floats) -> tuple[Floats, Floats]:
    """Rotations and translations of planes whose homographies a pinhole camera saw."""
    inverse = np.array([[1.0 / f, 0.0, -v[0] / f], [0.0, 1.0 / (aspect * f), -v[1] / (aspect * f)], [0.0, 0.0, 1.0]])
    columns = inverse @ homographies
    lengths = np.linalg.norm(columns[:, :, :2], axis=1)
    # The middle of each target has the weight 1: in front, whatever the scale.
    scale = 2.0 / lengths.sum(axis=1)
    columns = columns * scale[:, None, None]
    third = np.cross(columns[:, :, 0], columns[:, :, 1])
    u, _, vt = np.linalg.svd(np.concatenate([columns[:, :, :2], third[:, :, None]], axis=2))
    return u @ vt, columns[:, :, 2]
