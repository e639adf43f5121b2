"""Fit of the homography models between sensor and sheet of light to calibration points, and F tests between them.

`gpuvision.ranging.homography` describes the models.

References
----------
R. Hartley and A. Zisserman, *Multiple View Geometry in Computer Vision*, 2nd ed. 2004, chapter 4 (direct linear
transform, maximum likelihood estimate of a homography).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.optimize
import scipy.special

from gpuvision.camera.distortion import Distortion
from gpuvision.ranging.homography import (
    DEFAULT_LIMITS,
    MODELS,
    HomographyLimits,
    Model,
    Region,
    bounding_box,
    centre_and_half_extent,
    displacement_jacobian,
    inverse,
    project,
    shift_and_scale,
)

Float64 = npt.NDArray[np.float64]

_BOTH_SIDES_MESSAGE = "points lie on both sides of the horizon; expected points in front of the sensor"


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


def fit_models(
    sensor_points: npt.ArrayLike,
    sheet_points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    models: Sequence[Model] | None = None,
    symmetry: float = 0.0,
    region: Region | None = None,
    distortion: Distortion | None = None,
    limits: HomographyLimits = DEFAULT_LIMITS,
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
    distortion : Distortion, optional
        Distortion that is removed before the fit, for points in (u, v) order.
    limits : HomographyLimits, optional
        Limits of rank and rounding.

    Returns
    -------
    tuple of ModelFit
        From small to large, without the models that the points do not determine.

    Raises
    ------
    ValueError
        Shapes differ, a point is not finite or lies beyond the fold of the lens, a model is unknown, or the points
        determine no model.

    Notes
    -----
    The fit minimises the sensor residuals, divided by their standard deviations: direct linear transform, then
    Levenberg-Marquardt. The F test compares the sums of squares of the small and the large model.
    """
    sensor, sheet = _points(sensor_points, "sensor_points"), _points(sheet_points, "sheet_points")
    if len(sensor) != len(sheet):
        raise ValueError(f"got {len(sensor)} sensor points and {len(sheet)} sheet points, expected pairs")
    for unknown in set(models or ()) - set(MODELS):
        raise ValueError(f"the model is {unknown!r}, expected one of {', '.join(MODELS)}")
    data = _calibration(sensor, sheet, sigma, symmetry, distortion)
    frame = shift_and_scale(*centre_and_half_extent(bounding_box(sensor) if region is None else region))
    fits: list[tuple[ModelFit, float]] = []
    reasons: list[DegenerateError] = []
    for model in _determined_family(sensor, sheet) if models is None else models:
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


def _calibration(
    sensor: Float64, sheet: Float64, sigma: npt.ArrayLike | None, symmetry: float, distortion: Distortion | None
) -> _Calibration:
    """Return the undistorted points with the factors of their covariances."""
    undistorted = sensor if distortion is None else distortion.undistort(sensor)
    if not np.all(np.isfinite(undistorted)):
        raise ValueError("a sensor point lies beyond the fold of the lens polynomial; check the lens, or drop it")
    deviation = np.broadcast_to(np.asarray(1.0 if sigma is None else sigma, dtype=np.float64), sensor.shape)
    if not np.all(deviation > 0.0):
        raise ValueError("sigma must be positive everywhere, got a value that is not")
    undistortion = np.eye(2) if distortion is None else distortion.jacobian(sensor)
    return _Calibration(undistorted, sheet, undistortion * deviation[:, None, :], symmetry)


def _determined_family(sensor: Float64, sheet: Float64) -> tuple[Model, ...]:
    """Return the models for the points, from small to large: C3 for a single beam, otherwise C4, D6 and H8."""
    single_beam = np.ptp(sensor[:, 1]) == 0.0 or np.ptp(sheet[:, 0]) == 0.0
    return ("C3",) if single_beam else ("C4", "D6", "H8")


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


@dataclass(frozen=True)
class _ModelProblem:
    """Least squares problem of one model in normalised coordinates.

    Attributes
    ----------
    x
        Sensor points, (n, 2).
    points
        Sheet points (G, H, 1), (n, 3).
    elements
        Row and column (p, 2) of the free elements of N. The last free element is not among them: a denominator of 1 at
        the centre of the points fixes the scale.
    rows
        Sensor coordinates that have residuals.
    whitening
        Matrices (n, r, r) that divide residuals by their standard deviations.
    """

    x: Float64
    points: Float64
    elements: npt.NDArray[np.intp]
    rows: tuple[int, ...]
    whitening: Float64

    def matrix(self, values: Float64) -> Float64:
        """Return N with given values of its free elements."""
        matrix = np.zeros((3, 3))
        matrix[2, 2] = 1.0
        matrix[self.elements[:, 0], self.elements[:, 1]] = values
        return matrix

    def residuals(self, values: Float64) -> Float64:
        """Return the residuals (n r,) in standard deviations."""
        lifted = self.points @ self.matrix(values).T
        difference = (lifted[:, :2] / lifted[:, 2:] - self.x)[:, self.rows]
        return np.asarray(np.einsum("nij,nj->ni", self.whitening, difference)).ravel()

    def jacobian(self, values: Float64) -> Float64:
        """Return the derivatives (n r, p) of the residuals."""
        points, elements = self.points, self.elements
        lifted = points @ self.matrix(values).T
        change = np.zeros((len(points), 3, len(elements)))
        change[:, elements[:, 0], np.arange(len(elements))] = points[:, elements[:, 1]]
        moved = change[:, :2] - (lifted[:, :2] / lifted[:, 2:])[:, :, None] * change[:, 2:]
        moved = (moved / lifted[:, 2:, None])[:, self.rows]
        return np.asarray(np.einsum("nij,njp->nip", self.whitening, moved)).reshape(-1, len(elements))

    def minimise(self, start: Float64) -> tuple[Float64, float, Float64]:
        """Return N, the weighted sum of squared residuals, and the Jacobian at the minimum (Levenberg-Marquardt)."""
        solution = scipy.optimize.least_squares(
            self.residuals,
            start[self.elements[:, 0], self.elements[:, 1]],
            jac=self.jacobian,
            method="lm",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        return self.matrix(solution.x), 2.0 * float(solution.cost), solution.jac


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
    elements = np.argwhere(free)[:-1]
    excess = len(x) * len(rows) - len(elements)
    if excess < 0:
        raise DegenerateError(f"{len(x)} points are too few for the model {model}; measure more")
    _check_places(points, free, rows, model, rank_tolerance)
    start = _direct_linear(x, points, free, rows, model, rank_tolerance)
    problem = _ModelProblem(x, points, elements, rows, _whitening(data.sigma_factor, to_sensor, model))
    matrix, squares, slopes = problem.minimise(start)
    if np.any(points @ matrix[2] <= 0.0):
        raise DegenerateError(_BOTH_SIDES_MESSAGE)
    homography, changes = _invert_model(matrix, elements, to_sensor, to_sheet, model)
    gradient = displacement_jacobian(homography @ frame, changes @ frame)
    # (J^T J)^-1 from the triangular factor of J: the product J^T J would square the condition number.
    factor = gradient.T @ np.linalg.inv(np.linalg.qr(slopes, mode="r"))
    rms = float(np.sqrt(squares / (len(x) * len(rows))))
    return ModelFit(model, homography, factor @ factor.T, rms, excess, 1.0), squares


def _whitening(sigma_factor: Float64, to_sensor: Float64, model: Model) -> Float64:
    """Return the matrices that divide residuals in normalised coordinates by their standard deviations."""
    if model == "C3":
        # Marginal standard deviation of u: the v of a single beam has no residual.
        return np.asarray(to_sensor[0, 0] / np.linalg.norm(sigma_factor[:, :1], axis=-1, keepdims=True))
    return np.asarray(np.linalg.inv(sigma_factor) * np.diag(to_sensor)[:2])


def _conditioning(points: Float64, fixed: tuple[float | None, float | None]) -> Float64:
    """Return the matrix from normalised coordinates (-1 to 1) to points; a fixed origin preserves a symmetry."""
    origin = [np.mean(column) if value is None else value for column, value in zip(points.T, fixed, strict=True)]
    unit = np.max(np.abs(points - origin), axis=0)
    return shift_and_scale(origin, np.where(unit > 0.0, unit, 1.0))


def _check_places(
    points: Float64, free: npt.NDArray[np.bool_], rows: tuple[int, ...], model: Model, rank_tolerance: float
) -> None:
    """Check that the places on the sheet alone determine a model: noise of repeated readings adds false rank.

    The rank of the equations for exact readings is the same for all homographies N of a model: the quotients of two of
    them are closed under products. The simplest member of every model swaps G and H.
    """
    values, _ = _singular_vectors(points[:, 1::-1], points, free, rows)
    needed = np.count_nonzero(free) - 1
    if values[needed - 1] <= rank_tolerance * values[0]:
        # C3 reads H only.
        count = len(np.unique(points[:, 1:] if model == "C3" else points, axis=0))
        what = "heights H" if model == "C3" else "places on the sheet"
        least = -(-needed // len(rows))
        if count < least:
            reason = f"which needs {least} or more"
        elif model == "C3":
            reason = "as they are too close to each other"
        elif model == "C4":
            reason = "which needs places off the line G = 0 at two heights H, or three heights and one such place"
        else:
            reason = "as too many of them lie on one line"
        raise DegenerateError(f"{count} {what} do not fix the model {model}, {reason}")


def _direct_linear(
    x: Float64,
    points: Float64,
    free: npt.NDArray[np.bool_],
    rows: tuple[int, ...],
    model: Model,
    rank_tolerance: float,
) -> Float64:
    """Return N (sheet to sensor) from the right singular vector of the smallest singular value (algebraic error)."""
    values, vectors = _singular_vectors(x, points, free, rows)
    if values[np.count_nonzero(free) - 2] <= rank_tolerance * values[0]:
        raise DegenerateError(f"the points do not fix the model {model}; spread them over the sheet")
    matrix = np.zeros((3, 3))
    matrix[free] = vectors[-1]
    if abs(matrix[2, 2]) <= rank_tolerance:
        raise DegenerateError(_BOTH_SIDES_MESSAGE)
    return np.asarray(matrix / matrix[2, 2])


def _singular_vectors(
    x: Float64, points: Float64, free: npt.NDArray[np.bool_], rows: tuple[int, ...]
) -> tuple[Float64, Float64]:
    """Return the singular values and right singular vectors of the linear equations for the free elements of N."""
    blocks = []
    for row in rows:
        equations = np.zeros((len(points), 3, 3))
        equations[:, row] = points
        equations[:, 2] = -x[:, row, None] * points
        blocks.append(equations[:, free])
    # With one equation fewer than elements, a row of zeros makes the decomposition also return the null vector.
    blocks.append(np.zeros((1, np.count_nonzero(free))))
    _, values, vectors = np.linalg.svd(np.concatenate(blocks), full_matrices=False)
    return values, vectors


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
