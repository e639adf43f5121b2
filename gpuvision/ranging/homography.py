"""Plane-plane homographies between sensor and sheet of light: the nested family, its fit, and the choice.

The family is written for the direction sheet -> sensor, in which the calibration's noise lives:
``(u, v, 1) ~ N (G, H, 1)``. Each member fixes some elements of N at 0 and is closed under inversion.

- C3: ``u = (a H + b)/(c H + 1)``. A single beam: only u and H.
- C4: also ``v = d G/(c H + 1)``. Symmetric about G = 0 and v = ``symmetry``: De Bakker's four constants,
  ``H = (C1 u + C2)/(u + C3)``, ``G = C4 v/(u + C3)``.
- D6: also ``v = (d G + e H + f)/(c H + 1)``. The sensor's and the sheet's middle are offset, the profile axis is
  not square to the measured one; H still follows from u alone.
- H8: all elements. Any pinhole sensor and any sheet; with a sensor rolled about its axis H depends on v too.

F. de Jong lists C1-C4 and D1-D6 among the symbols; their equations are derived here: C4 is the one map of four
constants that a symmetric setup has, D6 the smallest extension of it by offsets that keeps H independent of v.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.optimize
import scipy.special

from gpuvision.camera.lens import Lens
from gpuvision.validation import finite

Model = Literal["C3", "C4", "D6", "H8"]
Float64 = npt.NDArray[np.float64]
Region = tuple[tuple[float, float], tuple[float, float]]

MODELS: dict[str, npt.NDArray[np.bool_]] = {
    name: np.array(rows, dtype=bool)
    for name, rows in {
        "C3": ((0, 1, 1), (0, 0, 0), (0, 1, 1)),
        "C4": ((0, 1, 1), (1, 0, 0), (0, 1, 1)),
        "D6": ((0, 1, 1), (1, 1, 1), (0, 1, 1)),
        "H8": ((1, 1, 1), (1, 1, 1), (1, 1, 1)),
    }.items()
}
"""By name: which elements of sheet -> sensor are free (one of them is the scale)."""

_RANK_LIMIT = 1e-10
_BOTH_SIDES = "points lie on both sides of the horizon; expected points in front of the sensor"
# Residuals below this part of the coordinates are rounding; to test them against each other would be noise.
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)


class DegenerateError(ValueError):
    """The calibration points do not fix the model's parameters."""


class ModelFit(NamedTuple):
    """One member of the family, fitted.

    Attributes
    ----------
    model
        Its name.
    homography
        3 x 3, undistorted sensor -> sheet.
    covariance
        8 x 8 covariance of the displacement parameters over the region (`to_displacement`); None where no
        sigma is known and no residual is left over to estimate one.
    rms
        Root mean square residual of a sensor coordinate: in sigmas, or in sensor units where no sigma is
        known.
    degrees_of_freedom
        Residuals less parameters.
    p_value
        Of the F test against the largest model that the points fix: small where this model does not suffice.
    """

    model: Model
    homography: Float64
    covariance: Float64 | None
    rms: float
    degrees_of_freedom: int
    p_value: float


def shift_and_scale(origin: npt.ArrayLike, unit: npt.ArrayLike) -> Float64:
    """3 x 3 matrix that takes (x, y, 1) to (origin + unit (x, y), 1)."""
    matrix = np.diag([*np.broadcast_to(np.asarray(unit, dtype=np.float64), 2), 1.0])
    matrix[:2, 2] = origin
    return matrix


def project(matrix: Float64, points: Float64) -> Float64:
    """Map points (..., 2) by a homography; infinite or NaN on its horizon."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped: Float64 = lifted[..., :2] / lifted[..., 2:]
    return mapped


def inverse(matrix: Float64) -> Float64:
    """Inverse of a homography.

    Raises
    ------
    ValueError
        If it is singular: the sheet of light is seen edge-on.
    """
    try:
        inverted = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on") from None
    return np.asarray(inverted, dtype=np.float64)


def to_displacement(matrix: Float64, *, rank: int = 3) -> Float64:
    """(g0, gx, gy, h0, hx, hy, dx, dy) of ``G = g0 + (gx x + gy y)/(1 + dx x + dy y)``, H likewise.

    Parameters
    ----------
    matrix
        3 x 3, (x, y, 1) to (G, H, 1), with x and y about -1 to 1.
    rank
        3, or 2 for a single beam, where only H follows from x.

    Raises
    ------
    ValueError
        If x = y = 0 lies on the horizon, or the matrix is singular.
    """
    if abs(matrix[2, 2]) <= _RANK_LIMIT * np.max(np.abs(matrix[2])):
        raise ValueError("the middle of the region lies on the horizon; expected a region that sees the sheet")
    scaled = matrix / matrix[2, 2]
    slopes = scaled[:2, :2] - np.outer(scaled[:2, 2], scaled[2, :2])
    steepness = np.linalg.svd(slopes, compute_uv=False)
    if steepness[rank - 2] <= _RANK_LIMIT * steepness[0] or not np.all(np.isfinite(scaled)):
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on")
    return np.array([scaled[0, 2], *slopes[0], scaled[1, 2], *slopes[1], *scaled[2, :2]])


def displacement_slopes(matrix: Float64, changes: Float64) -> Float64:
    """Change of `to_displacement` for small changes (..., 3, 3) of the matrix, shape (..., 8)."""
    scaled = matrix / matrix[2, 2]
    turned = changes / matrix[2, 2]
    turned = turned - scaled * turned[..., 2:, 2:]
    slopes = turned[..., :2, :2] - turned[..., :2, 2:] * scaled[2, :2] - scaled[:2, 2:] * turned[..., 2:, :2]
    blocks = [
        turned[..., :1, 2],
        slopes[..., 0, :],
        turned[..., 1:2, 2],
        slopes[..., 1, :],
        turned[..., 2, :2],
    ]
    return np.concatenate(blocks, axis=-1)


def packed_factor(covariance: npt.ArrayLike, which: Sequence[int]) -> Float64:
    """Lower triangular factor of a part of a covariance, which may be singular, column after column."""
    part = np.asarray(covariance, dtype=np.float64)[np.ix_(which, which)]
    values, vectors = np.linalg.eigh(part)
    triangle = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r")).T
    return np.concatenate([triangle[column:, column] for column in range(len(which))])


def seen_by_camera(
    camera_matrix: npt.ArrayLike,
    rotation: npt.ArrayLike,
    translation: npt.ArrayLike,
    plane: Sequence[npt.ArrayLike],
) -> Float64:
    """Sheet -> (column, row) for a pinhole camera; ``plane``: G axis, H axis and origin in the world."""
    turned = np.asarray(rotation, dtype=np.float64) @ np.column_stack([np.asarray(each, np.float64) for each in plane])
    turned[:, 2] += np.asarray(translation, dtype=np.float64)
    return np.asarray(camera_matrix, dtype=np.float64) @ turned


def seen_from_beside(baseline: float, stand_off: float, focal_distance: float, tilt: float | None) -> Float64:
    """Sheet -> (u, v) for a lens beside the sheet whose axis meets it at the origin.

    A tilt of None is Scheimpflug's.

    Raises
    ------
    ValueError
        If a length is not positive, or the tilt not within a right angle.
    """
    for name, value in (("baseline", baseline), ("stand_off", stand_off), ("focal_distance", focal_distance)):
        if not finite(value, name) > 0.0:
            raise ValueError(f"{name} is {value}, expected a positive length")
    angle, distance = math.atan2(baseline, stand_off), math.hypot(baseline, stand_off)
    if tilt is None:
        tilt = math.atan2(focal_distance, distance * math.tan(angle))
    if not abs(tilt) < 0.5 * math.pi:
        raise ValueError(f"tilt is {tilt} rad, expected less than a right angle")
    return np.array(
        [
            [0.0, focal_distance * math.sin(angle), 0.0],
            [focal_distance * math.cos(tilt), 0.0, 0.0],
            [0.0, -math.cos(angle - tilt), distance * math.cos(tilt)],
        ]
    )


def of_constants(constants: tuple[float, ...]) -> tuple[tuple[tuple[float, float, float], ...], Model]:
    """Sensor -> sheet and the model's name from its constants: see `Triangulation.from_constants`.

    Raises
    ------
    ValueError
        There are not 3, 4, 6 or 8 of them.
    """
    match constants:
        case (c1, c2, c3):
            return ((0.0, 0.0, 0.0), (c1, 0.0, c2), (c3, 0.0, 1.0)), "C3"
        case (c1, c2, c3, c4):
            return ((0.0, c4, 0.0), (c1, 0.0, c2), (1.0, 0.0, c3)), "C4"
        case (d1, d2, d3, d4, d5, d6):
            return ((d5, d4, d6), (d1, 0.0, d2), (1.0, 0.0, d3)), "D6"
        case (a, b, c, d, e, f, g, h):
            return ((a, b, c), (d, e, f), (g, h, 1.0)), "H8"
    raise ValueError(f"got {len(constants)} constants, expected 3, 4, 6 or 8")


def middle_and_half(region: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Middle of a region and half its larger extent, for both axes: a radius stays a radius."""
    bounds = np.asarray(region, dtype=np.float64)
    return bounds.mean(axis=1), np.full(2, 0.5 * np.max(bounds[:, 1] - bounds[:, 0]))


def box(points: Float64) -> Region:
    """Smallest region around points (n, 2)."""
    (u_min, v_min), (u_max, v_max) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return (u_min, u_max), (v_min, v_max)


def compare(
    sensor_points: npt.ArrayLike,
    sheet_points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    models: Sequence[Model] | None = None,
    symmetry: float = 0.0,
    region: Region | None = None,
    lens: Lens | None = None,
) -> tuple[ModelFit, ...]:
    """Fit every model which the points fix, each tested against the largest of them.

    Parameters
    ----------
    sensor_points, sheet_points
        Measured (u, v) and known (G, H) [m], each (n, 2).
    sigma
        Standard deviation of the sensor coordinates: a number, (sigma_u, sigma_v), or (n, 2). None: equal,
        and estimated from the residuals.
    models
        Names, from small to large; None: "C3" for a single beam (all v, or all G, are equal), else "C4",
        "D6", "H8".
    symmetry
        v of the plane of symmetry, for C4.
    region
        Where the covariance's parameters are defined (`to_displacement`); None: the box around the points.
    lens
        Undone before the fit; its centre in (u, v) order.

    Returns
    -------
    tuple of ModelFit
        From small to large; models that the points do not fix are left out.

    Raises
    ------
    ValueError
        If shapes differ, a point is not finite or lies beyond the lens' fold, or the points fix no model.
    """
    sensor, sheet = _points(sensor_points, "sensor_points"), _points(sheet_points, "sheet_points")
    if len(sensor) != len(sheet):
        raise ValueError(f"got {len(sensor)} sensor points and {len(sheet)} sheet points, expected pairs")
    straight = sensor if lens is None else lens.undistort(sensor)
    if not np.all(np.isfinite(straight)):
        raise ValueError("a sensor point lies beyond the fold of the lens polynomial; check the lens, or drop it")
    spread = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, dtype=np.float64), sensor.shape)
    if not np.all(spread > 0.0):
        raise ValueError("sigma must be positive everywhere, got a value that is not")
    beam = np.ptp(sensor[:, 1]) == 0.0 or np.ptp(sheet[:, 0]) == 0.0
    family: tuple[Model, ...] = ("C3",) if beam else ("C4", "D6", "H8")
    bend = np.eye(2) if lens is None else lens.jacobian(sensor)
    data = _Calibration(straight, sheet, bend * spread[:, None, :], symmetry)
    frame = shift_and_scale(*middle_and_half(box(sensor) if region is None else region))
    fits: list[tuple[ModelFit, float]] = []
    reasons: list[DegenerateError] = []
    for model in family if models is None else models:
        try:
            fits.append(_fit(data, model, frame))
        except DegenerateError as error:
            reasons.append(error)
    if not fits:
        raise reasons[0]
    return _tested(fits, data, sigma is not None)


class _Calibration(NamedTuple):
    """Undistorted (u, v); (G, H); matrices that take unit variance to the sensor's; the symmetry's v."""

    sensor: Float64
    sheet: Float64
    spread: Float64
    symmetry: float


def _points(values: npt.ArrayLike, name: str) -> Float64:
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        raise ValueError(f"{name} has shape {points.shape}, expected (n, 2)")
    if not np.all(np.isfinite(points)):
        raise ValueError(f"{name} has a value that is not finite; drop such points first")
    return points


def _tested(fits: Sequence[tuple[ModelFit, float]], data: _Calibration, sigma_known: bool) -> tuple[ModelFit, ...]:
    """Add the F test against the last fit; scale the covariance by the residuals where no sigma is known."""
    reach = np.max(np.abs(np.linalg.solve(data.spread, data.sensor[..., None])))
    floor = (_ROUNDING * float(reach)) ** 2
    full, full_sum = fits[-1]
    variance = max(full_sum / max(full.degrees_of_freedom, 1), floor)
    tested = []
    for fit, squares in fits:
        spare = fit.degrees_of_freedom
        extra = spare - full.degrees_of_freedom
        # Without a residual to spare the full model fits anything and refutes nothing.
        if extra and full.degrees_of_freedom:
            ratio = max(squares - full_sum, 0.0) / (extra * variance)
            fit = fit._replace(p_value=float(scipy.special.fdtrc(extra, full.degrees_of_freedom, ratio)))
        if not sigma_known and fit.covariance is not None:
            fit = fit._replace(covariance=fit.covariance * (squares / spare) if spare else None)
        tested.append(fit)
    return tuple(tested)


def _fit(data: _Calibration, model: Model, frame: Float64) -> tuple[ModelFit, float]:
    """Direct linear transform, then Levenberg-Marquardt on the sensor residuals; with the sum of squares."""
    free = MODELS[model]
    seen = (0,) if model == "C3" else (0, 1)
    to_sensor = _conditioning(data.sensor, (None, data.symmetry if model == "C4" else None))
    to_sheet = _conditioning(data.sheet, (0.0 if model == "C4" else None, None))
    x = project(inverse(to_sensor), data.sensor)
    points = np.column_stack([project(inverse(to_sheet), data.sheet), np.ones(len(data.sheet))])
    # The scale is free: the denominator in the middle of the points is 1.
    elements = np.argwhere(free)[:-1]
    excess = len(x) * len(seen) - len(elements)
    if excess < 0:
        raise DegenerateError(f"{len(x)} points are too few for the model {model}; measure more")
    start = _direct_linear(x, points, free, seen, model)
    if model == "C3":
        # The marginal spread of u: a beam's v is not compared.
        white = to_sensor[0, 0] / np.linalg.norm(data.spread[:, :1], axis=-1, keepdims=True)
    else:
        white = np.linalg.inv(data.spread) * np.diag(to_sensor)[:2]

    def assemble(values: Float64) -> Float64:
        matrix = np.zeros((3, 3))
        matrix[2, 2] = 1.0
        matrix[elements[:, 0], elements[:, 1]] = values
        return matrix

    def residuals(values: Float64) -> Float64:
        lifted = points @ assemble(values).T
        missed = (lifted[:, :2] / lifted[:, 2:] - x)[:, seen]
        return np.asarray(np.einsum("nij,nj->ni", white, missed)).ravel()

    def slopes(values: Float64) -> Float64:
        lifted = points @ assemble(values).T
        change = np.zeros((len(points), 3, len(elements)))
        change[:, elements[:, 0], np.arange(len(elements))] = points[:, elements[:, 1]]
        moved = change[:, :2] - (lifted[:, :2] / lifted[:, 2:])[:, :, None] * change[:, 2:]
        moved = (moved / lifted[:, 2:, None])[:, seen]
        return np.asarray(np.einsum("nij,njp->nip", white, moved)).reshape(-1, len(elements))

    solution = scipy.optimize.least_squares(
        residuals,
        start[elements[:, 0], elements[:, 1]],
        jac=slopes,
        method="lm",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    squares = 2.0 * float(solution.cost)
    matrix = assemble(solution.x)
    if np.any(points @ matrix[2] <= 0.0):
        raise DegenerateError(_BOTH_SIDES)
    homography, changes = _to_sheet(matrix, elements, to_sensor, to_sheet, model)
    slope = displacement_slopes(homography @ frame, changes @ frame)
    # (J' J)^-1 by the triangular factor of J: squaring J would square its condition.
    spread = slope.T @ np.linalg.inv(np.linalg.qr(solution.jac, mode="r"))
    rms = float(np.sqrt(squares / (len(x) * len(seen))))
    return ModelFit(model, homography, spread @ spread.T, rms, excess, 1.0), squares


def _conditioning(points: Float64, fixed: tuple[float | None, float | None]) -> Float64:
    """Matrix from coordinates about -1 to 1 to the points' own; a fixed origin keeps a model's symmetry."""
    origin = [np.mean(column) if value is None else value for column, value in zip(points.T, fixed, strict=True)]
    unit = np.max(np.abs(points - origin), axis=0)
    return shift_and_scale(origin, np.where(unit > 0.0, unit, 1.0))


def _direct_linear(
    x: Float64, points: Float64, free: npt.NDArray[np.bool_], seen: tuple[int, ...], model: Model
) -> Float64:
    """Sheet -> sensor by the smallest right singular vector of the linearised equations."""
    blocks = []
    for row in seen:
        equations = np.zeros((len(points), 3, 3))
        equations[:, row] = points
        equations[:, 2] = -x[:, row, None] * points
        blocks.append(equations[:, free])
    # The row of zeros makes sure of a last singular vector where the equations are one too few to need the fit.
    blocks.append(np.zeros((1, np.count_nonzero(free))))
    _, values, vectors = np.linalg.svd(np.concatenate(blocks), full_matrices=False)
    if values[np.count_nonzero(free) - 2] <= _RANK_LIMIT * values[0]:
        raise DegenerateError(f"the points do not fix the model {model}; spread them over the sheet")
    matrix = np.zeros((3, 3))
    matrix[free] = vectors[-1]
    if abs(matrix[2, 2]) <= _RANK_LIMIT:
        raise DegenerateError(_BOTH_SIDES)
    return np.asarray(matrix / matrix[2, 2])


def _to_sheet(
    matrix: Float64, elements: npt.NDArray[np.intp], to_sensor: Float64, to_sheet: Float64, model: Model
) -> tuple[Float64, Float64]:
    """Invert sheet -> sensor: the homography sensor -> sheet, and its change (p, 3, 3) for each parameter."""
    if model == "C3":
        # A beam has no v: any will do to invert, and G stays where the points have it.
        matrix = matrix.copy()
        matrix[1, 0] = 1.0
    inside = inverse(matrix)
    unit = np.zeros((len(elements), 3, 3))
    unit[np.arange(len(elements)), elements[:, 0], elements[:, 1]] = 1.0
    changes = -inside @ unit @ inside
    if model == "C3":
        inside[0] = 0.0
        changes[:, 0] = 0.0
    outside = inverse(to_sensor)
    return to_sheet @ inside @ outside, np.asarray(to_sheet @ changes @ outside)
