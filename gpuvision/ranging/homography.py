"""Plane-to-plane homographies between sensor and sheet of light: a nested family of models, their fit and F tests.

The models map the sheet to the sensor, ``(u, v, 1) ~ N (G, H, 1)``, because the noise of a calibration is on the sensor
coordinates. Each model fixes some elements of N at 0; the inverse of N has the same number of zeros, see
`homography_from_constants`.

- C3: ``u = (a H + b)/(c H + 1)``. A single beam: only u and H.
- C4: also ``v = d G/(c H + 1)``. Symmetric about G = 0 and v = ``symmetry``: De Bakker's four constants,
  ``H = (C1 u + C2)/(u + C3)``, ``G = C4 v/(u + C3)``.
- D6: also ``v = (d G + e H + f)/(c H + 1)``. Sensor and sheet are offset along the profile, and the profile axis is not
  perpendicular to the measuring axis; H still depends on u alone.
- H8: all elements. Any pinhole sensor and any sheet; if the sensor is rolled about its axis, H also depends on v.

The thesis lists C1-C4 and D1-D6 among its symbols without their equations. The equations are derived here: C4 is the
only model with four constants for a symmetric setup. D6 is its smallest extension by offsets that keeps H independent
of v.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3.3 and the
list of symbols. R. Hartley and A. Zisserman, *Multiple View Geometry in Computer Vision*, 2nd ed. 2004, chapter 4
(direct linear transform, maximum likelihood estimate of a homography).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
"""Free elements of N (sheet to sensor) by model name; one of them is the scale."""

_BOTH_SIDES_MESSAGE = "points lie on both sides of the horizon; expected points in front of the sensor"


@dataclass(frozen=True, kw_only=True)
class HomographyLimits:
    """Limits of the fit of homographies.

    Attributes
    ----------
    rank_tolerance : float
        Singular values and denominators below this fraction of the largest one count as 0. Chosen: well above the
        rounding of float64 (2e-16), well below the values of a setup that can be built.
    residual_rounding : float
        Residuals below this fraction of the largest coordinate are rounding errors, which an F test must not compare.
        Chosen: 64 roundings of float64.
    """

    rank_tolerance: float = 1e-10
    residual_rounding: float = 64.0 * float(np.finfo(np.float64).eps)


class DegenerateError(ValueError):
    """Error: the calibration points do not determine the parameters of the model."""


class ModelFit(NamedTuple):
    """Fit of one model of the family.

    Attributes
    ----------
    model : {"C3", "C4", "D6", "H8"}
        Name of the model.
    homography : numpy.ndarray
        Homography from the undistorted sensor to the sheet, (3, 3).
    covariance : numpy.ndarray or None
        Covariance of the displacement parameters over the region (`to_displacement`), (8, 8). None without a given
        sigma if there are no degrees of freedom to estimate it.
    rms : float
        Root mean square residual of a sensor coordinate: in standard deviations, or in sensor units without a given
        sigma.
    degrees_of_freedom : int
        Number of residuals minus number of parameters.
    p_value : float
        p-value of the F test against the largest model that the points determine, 0 to 1. A small value rejects this
        model.
    """

    model: Model
    homography: Float64
    covariance: Float64 | None
    rms: float
    degrees_of_freedom: int
    p_value: float


def shift_and_scale(origin: npt.ArrayLike, unit: npt.ArrayLike) -> Float64:
    """Return the (3, 3) matrix that maps (x, y, 1) to (origin + unit (x, y), 1)."""
    matrix = np.diag([*np.broadcast_to(np.asarray(unit, dtype=np.float64), 2), 1.0])
    matrix[:2, 2] = origin
    return matrix


def project(matrix: Float64, points: Float64) -> Float64:
    """Map points (..., 2) by a homography (3, 3); the result is infinite or NaN on the horizon."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped: Float64 = lifted[..., :2] / lifted[..., 2:]
    return mapped


def inverse(matrix: Float64) -> Float64:
    """Return the inverse (3, 3) of a homography.

    Raises
    ------
    ValueError
        The homography is singular: the sensor sees the sheet of light edge-on.
    """
    try:
        inverted = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on") from None
    return np.asarray(inverted, dtype=np.float64)


def to_displacement(
    matrix: Float64, *, rank: int = 3, rank_tolerance: float = HomographyLimits.rank_tolerance
) -> Float64:
    """Return the displacement parameters of a homography: value at the centre, gradients, and denominator.

    They are (g0, gx, gy, h0, hx, hy, dx, dy) of ``G = g0 + (gx x + gy y)/(1 + dx x + dy y)``, and the same form for H.

    Parameters
    ----------
    matrix : numpy.ndarray
        Homography (3, 3) from (x, y, 1) to (G, H, 1), with x and y in -1 to 1.
    rank : {3, 2}
        Rank that the homography must have: 3, or 2 for a single beam, where only H depends on x.
    rank_tolerance : float
        As `HomographyLimits.rank_tolerance`.

    Returns
    -------
    numpy.ndarray
        Eight parameters; g and h in metres, d without unit.

    Raises
    ------
    ValueError
        x = y = 0 lies on the horizon, or the rank is lower.
    """
    if abs(matrix[2, 2]) <= rank_tolerance * np.max(np.abs(matrix[2])):
        raise ValueError("the middle of the region lies on the horizon; expected a region that sees the sheet")
    scaled = matrix / matrix[2, 2]
    gradients = scaled[:2, :2] - np.outer(scaled[:2, 2], scaled[2, :2])
    singular = np.linalg.svd(gradients, compute_uv=False)
    if singular[rank - 2] <= rank_tolerance * singular[0] or not np.all(np.isfinite(scaled)):
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on")
    return np.array([scaled[0, 2], *gradients[0], scaled[1, 2], *gradients[1], *scaled[2, :2]])


def displacement_jacobian(matrix: Float64, changes: Float64) -> Float64:
    """Return the changes (..., 8) of `to_displacement` for small changes (..., 3, 3) of the matrix (product rule)."""
    scaled = matrix / matrix[2, 2]
    moved = changes / matrix[2, 2]
    moved = moved - scaled * moved[..., 2:, 2:]
    gradients = moved[..., :2, :2] - moved[..., :2, 2:] * scaled[2, :2] - scaled[:2, 2:] * moved[..., 2:, :2]
    blocks = [
        moved[..., :1, 2],
        gradients[..., 0, :],
        moved[..., 1:2, 2],
        gradients[..., 1, :],
        moved[..., 2, :2],
    ]
    return np.concatenate(blocks, axis=-1)


def packed_covariance_factor(covariance: npt.ArrayLike, which: Sequence[int]) -> Float64:
    """Return the lower triangular factor of a block of a covariance, packed by columns; the block may be singular.

    Parameters
    ----------
    covariance : array_like
        Covariance (n, n).
    which : sequence of int
        Indices of the m rows and columns of the block.

    Returns
    -------
    numpy.ndarray
        The m (m + 1) / 2 elements of L, with ``L L^T`` the block.
    """
    block = np.asarray(covariance, dtype=np.float64)[np.ix_(which, which)]
    values, vectors = np.linalg.eigh(block)
    triangle = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r")).T
    return np.concatenate([triangle[column:, column] for column in range(len(which))])


def camera_homography(
    camera_matrix: npt.ArrayLike,
    rotation: npt.ArrayLike,
    translation: npt.ArrayLike,
    plane: Sequence[npt.ArrayLike],
) -> Float64:
    """Return the homography (3, 3) from the sheet to the pixels (column, row) of a pinhole camera.

    Parameters
    ----------
    camera_matrix : array_like
        Camera matrix (3, 3) [px].
    rotation, translation : array_like
        Pose of the camera, world to camera: (3, 3), and (3,) [m].
    plane : sequence of array_like
        G axis, H axis (unit vectors) and origin [m] of the sheet in the world, (3,) each.
    """
    axes = np.asarray(rotation, dtype=np.float64) @ np.column_stack([np.asarray(each, np.float64) for each in plane])
    axes[:, 2] += np.asarray(translation, dtype=np.float64)
    return np.asarray(camera_matrix, dtype=np.float64) @ axes


def triangulation_homography(baseline: float, stand_off: float, focal_distance: float, tilt: float | None) -> Float64:
    """Return the homography (3, 3) from the sheet to the sensor (u, v) of a laser triangulation setup.

    The lens lies beside the sheet. Its axis meets the sheet at the origin.

    Parameters
    ----------
    baseline : float
        Distance of the lens from the sheet [m], positive.
    stand_off : float
        Distance of the lens from the origin along the sheet [m], positive.
    focal_distance : float
        Distance of the sensor from the lens along the axis [m], positive.
    tilt : float or None
        Tilt of the sensor [rad], -pi/2 to pi/2 (exclusive). None: the Scheimpflug condition.

    Raises
    ------
    ValueError
        A length is not positive, or the tilt is out of its range.
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


def homography_from_constants(constants: tuple[float, ...]) -> tuple[tuple[tuple[float, float, float], ...], Model]:
    """Return the homography from sensor to sheet, and the model, for given constants.

    Parameters
    ----------
    constants : tuple of float
        3, 4, 6 or 8 constants, see `Triangulation.from_constants`.

    Returns
    -------
    tuple of tuple of float
        Rows of the homography.
    Model
        "C3", "C4", "D6" or "H8".

    Raises
    ------
    ValueError
        Another number of constants.
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


def centre_and_half_extent(region: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return the centre (2,) of a region and half its larger extent, twice: equal scales keep circles circles."""
    bounds = np.asarray(region, dtype=np.float64)
    return bounds.mean(axis=1), np.full(2, 0.5 * np.max(bounds[:, 1] - bounds[:, 0]))


def bounding_box(points: Float64) -> Region:
    """Return the smallest region that contains points (n, 2)."""
    (u_min, v_min), (u_max, v_max) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return (u_min, u_max), (v_min, v_max)


def fit_models(
    sensor_points: npt.ArrayLike,
    sheet_points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    models: Sequence[Model] | None = None,
    symmetry: float = 0.0,
    region: Region | None = None,
    lens: Lens | None = None,
    limits: HomographyLimits = HomographyLimits(),
) -> tuple[ModelFit, ...]:
    """Fit every model that the points determine; test each against the largest of them.

    Parameters
    ----------
    sensor_points, sheet_points : array_like
        Measured (u, v) [sensor units] and known (G, H) [m], each (n, 2).
    sigma : array_like, optional
        Standard deviation of the sensor coordinates: a number, (sigma_u, sigma_v), or (n, 2). Default: equal for all
        coordinates and estimated from the residuals.
    models : sequence of str, optional
        Names, from small to large. Default: "C3" for a single beam (all v, or all G, are equal), otherwise "C4", "D6",
        "H8".
    symmetry : float
        v of the plane of symmetry, for C4. Default 0.
    region : ((u_min, u_max), (v_min, v_max)), optional
        Region that defines the parameters of the covariance (`to_displacement`). Default: the bounding box of the
        points.
    lens : Lens, optional
        Distortion that is removed before the fit; its centre in (u, v) order.
    limits : HomographyLimits, optional
        Limits of rank and rounding.

    Returns
    -------
    tuple of ModelFit
        From small to large, without the models that the points do not determine.

    Raises
    ------
    ValueError
        Shapes differ, a point is not finite or lies beyond the fold of the lens polynomial, or the points determine no
        model.

    Notes
    -----
    The fit minimises the sensor residuals, divided by their standard deviations: direct linear transform, then
    Levenberg-Marquardt. The F test compares the sums of squares of the small and the large model.
    """
    sensor, sheet = _points(sensor_points, "sensor_points"), _points(sheet_points, "sheet_points")
    if len(sensor) != len(sheet):
        raise ValueError(f"got {len(sensor)} sensor points and {len(sheet)} sheet points, expected pairs")
    undistorted = sensor if lens is None else lens.undistort(sensor)
    if not np.all(np.isfinite(undistorted)):
        raise ValueError("a sensor point lies beyond the fold of the lens polynomial; check the lens, or drop it")
    deviation = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, dtype=np.float64), sensor.shape)
    if not np.all(deviation > 0.0):
        raise ValueError("sigma must be positive everywhere, got a value that is not")
    single_beam = np.ptp(sensor[:, 1]) == 0.0 or np.ptp(sheet[:, 0]) == 0.0
    family: tuple[Model, ...] = ("C3",) if single_beam else ("C4", "D6", "H8")
    undistortion = np.eye(2) if lens is None else lens.jacobian(sensor)
    data = _Calibration(undistorted, sheet, undistortion * deviation[:, None, :], symmetry)
    frame = shift_and_scale(*centre_and_half_extent(bounding_box(sensor) if region is None else region))
    fits: list[tuple[ModelFit, float]] = []
    reasons: list[DegenerateError] = []
    for model in family if models is None else models:
        try:
            fits.append(_fit_model(data, model, frame, limits.rank_tolerance))
        except DegenerateError as error:
            reasons.append(error)
    if not fits:
        raise reasons[0]
    return _add_f_tests(fits, data, sigma is not None, limits.residual_rounding)


class _Calibration(NamedTuple):
    """Data of a fit.

    Attributes
    ----------
    sensor, sheet
        Undistorted (u, v) [sensor units] and (G, H) [m], (n, 2) each.
    sigma_factor
        Factors (n, 2, 2) of the covariances of the undistorted sensor points: factor times its transpose.
    symmetry
        v of the plane of symmetry.
    """

    sensor: Float64
    sheet: Float64
    sigma_factor: Float64
    symmetry: float


def _points(values: npt.ArrayLike, name: str) -> Float64:
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        raise ValueError(f"{name} has shape {points.shape}, expected (n, 2)")
    if not np.all(np.isfinite(points)):
        raise ValueError(f"{name} has a value that is not finite; drop such points first")
    return points


def _add_f_tests(
    fits: Sequence[tuple[ModelFit, float]], data: _Calibration, sigma_known: bool, residual_rounding: float
) -> tuple[ModelFit, ...]:
    """Add the F test against the last fit; without a given sigma, scale the covariances by the residual variance."""
    largest = np.max(np.abs(np.linalg.solve(data.sigma_factor, data.sensor[..., None])))
    floor = (residual_rounding * float(largest)) ** 2
    full, full_sum = fits[-1]
    variance = max(full_sum / max(full.degrees_of_freedom, 1), floor)
    tested = []
    for fit, squares in fits:
        freedom = fit.degrees_of_freedom
        extra = freedom - full.degrees_of_freedom
        # Without degrees of freedom the largest model fits any points, and no test is possible.
        if extra and full.degrees_of_freedom:
            ratio = max(squares - full_sum, 0.0) / (extra * variance)
            fit = fit._replace(p_value=float(scipy.special.fdtrc(extra, full.degrees_of_freedom, ratio)))
        if not sigma_known and fit.covariance is not None:
            fit = fit._replace(covariance=fit.covariance * (squares / freedom) if freedom else None)
        tested.append(fit)
    return tuple(tested)


def _fit_model(data: _Calibration, model: Model, frame: Float64, rank_tolerance: float) -> tuple[ModelFit, float]:
    """Fit a model: direct linear transform, then Levenberg-Marquardt on the sensor residuals.

    Return the fit and its weighted sum of squared residuals.
    """
    free = MODELS[model]
    rows = (0,) if model == "C3" else (0, 1)
    to_sensor = _conditioning(data.sensor, (None, data.symmetry if model == "C4" else None))
    to_sheet = _conditioning(data.sheet, (0.0 if model == "C4" else None, None))
    x = project(inverse(to_sensor), data.sensor)
    points = np.column_stack([project(inverse(to_sheet), data.sheet), np.ones(len(data.sheet))])
    # The scale is fixed by a denominator of 1 at the centre of the points.
    elements = np.argwhere(free)[:-1]
    excess = len(x) * len(rows) - len(elements)
    if excess < 0:
        raise DegenerateError(f"{len(x)} points are too few for the model {model}; measure more")
    start = _direct_linear(x, points, free, rows, model, rank_tolerance)
    if model == "C3":
        # Marginal standard deviation of u: the v of a single beam has no residual.
        whitening = to_sensor[0, 0] / np.linalg.norm(data.sigma_factor[:, :1], axis=-1, keepdims=True)
    else:
        whitening = np.linalg.inv(data.sigma_factor) * np.diag(to_sensor)[:2]

    def assemble(values: Float64) -> Float64:
        matrix = np.zeros((3, 3))
        matrix[2, 2] = 1.0
        matrix[elements[:, 0], elements[:, 1]] = values
        return matrix

    def residuals(values: Float64) -> Float64:
        lifted = points @ assemble(values).T
        difference = (lifted[:, :2] / lifted[:, 2:] - x)[:, rows]
        return np.asarray(np.einsum("nij,nj->ni", whitening, difference)).ravel()

    def jacobian(values: Float64) -> Float64:
        lifted = points @ assemble(values).T
        change = np.zeros((len(points), 3, len(elements)))
        change[:, elements[:, 0], np.arange(len(elements))] = points[:, elements[:, 1]]
        moved = change[:, :2] - (lifted[:, :2] / lifted[:, 2:])[:, :, None] * change[:, 2:]
        moved = (moved / lifted[:, 2:, None])[:, rows]
        return np.asarray(np.einsum("nij,njp->nip", whitening, moved)).reshape(-1, len(elements))

    solution = scipy.optimize.least_squares(
        residuals,
        start[elements[:, 0], elements[:, 1]],
        jac=jacobian,
        method="lm",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    squares = 2.0 * float(solution.cost)
    matrix = assemble(solution.x)
    if np.any(points @ matrix[2] <= 0.0):
        raise DegenerateError(_BOTH_SIDES_MESSAGE)
    homography, changes = _invert_model(matrix, elements, to_sensor, to_sheet, model)
    gradient = displacement_jacobian(homography @ frame, changes @ frame)
    # (J^T J)^-1 from the triangular factor of J: the product J^T J would square the condition number.
    factor = gradient.T @ np.linalg.inv(np.linalg.qr(solution.jac, mode="r"))
    rms = float(np.sqrt(squares / (len(x) * len(rows))))
    return ModelFit(model, homography, factor @ factor.T, rms, excess, 1.0), squares


def _conditioning(points: Float64, fixed: tuple[float | None, float | None]) -> Float64:
    """Return the matrix from normalised coordinates (-1 to 1) to points; a fixed origin preserves a symmetry."""
    origin = [np.mean(column) if value is None else value for column, value in zip(points.T, fixed, strict=True)]
    unit = np.max(np.abs(points - origin), axis=0)
    return shift_and_scale(origin, np.where(unit > 0.0, unit, 1.0))


def _direct_linear(
    x: Float64,
    points: Float64,
    free: npt.NDArray[np.bool_],
    rows: tuple[int, ...],
    model: Model,
    rank_tolerance: float,
) -> Float64:
    """Return N (sheet to sensor) from the right singular vector of the smallest singular value (algebraic error)."""
    blocks = []
    for row in rows:
        equations = np.zeros((len(points), 3, 3))
        equations[:, row] = points
        equations[:, 2] = -x[:, row, None] * points
        blocks.append(equations[:, free])
    # With one equation fewer than elements, a row of zeros makes the decomposition also return the null vector.
    blocks.append(np.zeros((1, np.count_nonzero(free))))
    _, values, vectors = np.linalg.svd(np.concatenate(blocks), full_matrices=False)
    if values[np.count_nonzero(free) - 2] <= rank_tolerance * values[0]:
        raise DegenerateError(f"the points do not fix the model {model}; spread them over the sheet")
    matrix = np.zeros((3, 3))
    matrix[free] = vectors[-1]
    if abs(matrix[2, 2]) <= rank_tolerance:
        raise DegenerateError(_BOTH_SIDES_MESSAGE)
    return np.asarray(matrix / matrix[2, 2])


def _invert_model(
    matrix: Float64, elements: npt.NDArray[np.intp], to_sensor: Float64, to_sheet: Float64, model: Model
) -> tuple[Float64, Float64]:
    """Return the homography from sensor to sheet, and its derivatives (p, 3, 3) by the p parameters of N."""
    if model == "C3":
        # A single beam does not determine v: any nonzero element makes N invertible, and G is set to the G of the
        # points.
        matrix = matrix.copy()
        matrix[1, 0] = 1.0
    inverted = inverse(matrix)
    unit = np.zeros((len(elements), 3, 3))
    unit[np.arange(len(elements)), elements[:, 0], elements[:, 1]] = 1.0
    changes = -inverted @ unit @ inverted
    if model == "C3":
        inverted[0] = 0.0
        changes[:, 0] = 0.0
    from_sensor = inverse(to_sensor)
    return to_sheet @ inverted @ from_sensor, np.asarray(to_sheet @ changes @ from_sensor)
