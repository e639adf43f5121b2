"""Result of a calibration from views: camera, uncertainties and alternative models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.scheimpflug import TiltedSensor
from gpuvision.camera.smooth_field import LackOfFit
from gpuvision.camera.tilted_projection import Floats, tilt_matrix
from gpuvision.camera.views.bundle_adjustment import (
    FitState,
    NormalEquations,
    PackedViews,
    RobustLoss,
    linearise,
    residuals,
    robust_scale,
    solve_step,
)
from gpuvision.camera.views.correlated_errors import CorrelatedErrors
from gpuvision.camera.views.parameters import OPENCV, FreeParameters, internal_parameters, opencv_parameters


class Pose(NamedTuple):
    """Pose of a target in the camera's frame: ``rotation @ point + translation``.

    Attributes
    ----------
    rotation : numpy.ndarray
        (3, 3) float64.
    translation : numpy.ndarray
        (3,) float64 [m], the unit of the target points.
    """

    rotation: Floats
    translation: Floats


class CameraAlternative(NamedTuple):
    """CameraAlternative camera model, fitted to the same points.

    Attributes
    ----------
    model : str
        Name of the model, as in `fit_camera`.
    rms_px : float
        Root mean square distance between measured and projected points [px].
    parameters : int
        Number of free camera parameters.
    p_value : float
        p-value of the F test against the largest model: the probability of at least this increase of the residual if
        this model is true. If the residuals of the largest model are correlated, its further parameters are tested
        against their covariance for correlated errors (Wald's test).
    aic : float
        Akaike information criterion.
    centre : (float, float)
        Column and row of the distortion centre [px].
    centre_distance_px : float
        Distance from the chosen model's centre [px].
    """

    model: str
    rms_px: float
    parameters: int
    p_value: float
    aic: float
    centre: tuple[float, float]
    centre_distance_px: float


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """Calibrated camera.

    Attributes
    ----------
    camera : Camera
        Camera with lens and sensor tilt.
    model : str
        Name of the model, as in `fit_camera`.
    poses : tuple of Pose
        Pose of the target in each view.
    names : tuple of str
        Names of the free camera parameters, as in OpenCV; ``f`` is fx = fy.
    covariance : numpy.ndarray
        (m, m): covariance of these parameters [px], [rad], by ``error_model``.
    pose_covariance : numpy.ndarray
        (views, 6, 6): covariance of a rotation vector [rad], applied from the left in the camera's frame, and of the
        translation [m].
    rms_px : float
        Root mean square distance between measured and projected points [px], as OpenCV reports it.
    sigma_px : float
        Standard deviation of one coordinate [px]: given, or estimated from the residuals.
    residuals : tuple of numpy.ndarray
        Per view (n, 2): measured minus projected points [px]; NaN for missing points.
    iterations : int
        Number of steps of the final fit.
    lack_of_fit : LackOfFit
        Smooth field in the residuals that is fixed in the image: a lens that the model does not describe.
    view_p_value : float
        p-value of the test that one camera explains all views: a bent or moving target makes it small.
    error_model : {"independent", "correlated"}
        "correlated" if one of the two tests has a p-value below `CalibrationLimits.lack_of_fit_significance`: the
        covariance then has clusters by view (five views or more), and the part of the smooth field.
    alternatives : tuple of CameraAlternative
        CameraAlternative models, smallest first.
    warnings : tuple of str
        Parameters that the data do not determine, and other doubts.
    """

    camera: Camera
    model: str
    poses: tuple[Pose, ...]
    names: tuple[str, ...]
    covariance: Floats
    pose_covariance: Floats
    rms_px: float
    sigma_px: float
    residuals: tuple[Floats, ...]
    iterations: int
    lack_of_fit: LackOfFit
    view_p_value: float
    error_model: Literal["independent", "correlated"]
    alternatives: tuple[CameraAlternative, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def uncertainties(self) -> Mapping[str, float]:
        """Standard deviation of every free parameter, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def sensor(self) -> TiltedSensor:
        """Tilted sensor (alpha, f', virtual camera), for square pixels; alpha is 0 in a model without tilt."""
        return TiltedSensor.from_camera(self.camera)

    @property
    def alpha_sigma(self) -> float:
        """Standard deviation of alpha [rad], to first order; an upper bound if alpha is near 0."""
        if "tauX" not in self.names:
            return 0.0
        return alpha_standard_deviation(self.camera.distortion[12:], self.covariance[-2:, -2:])


def alpha_standard_deviation(tau: Sequence[float], covariance: Floats) -> float:
    """Return the standard deviation of alpha [rad] from the covariance (2, 2) of tauX and tauY."""
    tau_x, tau_y = tau
    sine = math.sqrt(1.0 - (math.cos(tau_x) * math.cos(tau_y)) ** 2)
    if sine**2 <= covariance.max():
        return float(math.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    slope = np.array([math.sin(tau_x) * math.cos(tau_y), math.cos(tau_x) * math.sin(tau_y)]) / sine
    return float(math.sqrt(slope @ covariance @ slope))


def camera_from_parameters(values: Floats) -> Camera:
    """Return the camera of parameters in the order of `parameters.FIT_PARAMETERS`."""
    fx, fy, cx, cy, *coefficients, tau_x, tau_y = opencv_parameters(values)[0].tolist()
    # Adding 0.0 turns -0.0 into 0.0.
    return Camera(
        matrix=((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)),
        distortion=(*coefficients, *(0.0,) * 4, tau_x + 0.0, tau_y + 0.0),
    )


def poses_in_lens_frame(state: FitState) -> tuple[Pose, ...]:
    """Return the poses in the lens' frame, the frame of `Camera` and OpenCV."""
    back = tilt_matrix(*internal_parameters(state.values)[0][4:6]).T
    return tuple(
        Pose(back @ rotation, back @ translation)
        for rotation, translation in zip(state.rotations, state.translations, strict=True)
    )


def residual_sigma(views: PackedViews, free_parameters: FreeParameters, state: FitState, loss: RobustLoss) -> float:
    """Estimate the standard deviation of one coordinate [px] from the residuals."""
    if loss.kind != "squared":
        return robust_scale(views, state)
    free = views.coordinates - free_parameters.count - 6 * len(views.image)
    return math.sqrt(state.cost / free) if free > 0 else math.nan


def covariances(
    views: PackedViews,
    free_parameters: FreeParameters,
    state: FitState,
    loss: RobustLoss,
    sigma: float | None,
    correlated: CorrelatedErrors | None = None,
) -> tuple[Floats, Floats, float]:
    """Return the covariances of camera parameters and poses, and the relative standard deviation of f.

    `names` are the names of the camera parameters in OpenCV's order; the poses are in the lens' frame. The covariances
    are valid to first order; under a robust loss they are Huber's, for points of equal noise. Parameters that the data
    do not determine have a very large, finite variance. f is the virtual camera's focal length: the data can determine
    it even if they do not determine tilt, centre and f'. With ``correlated`` the covariance of the camera holds for
    correlated errors; the errors of the points within a view count as independent for the pose of the view.
    """
    system = linearise(views, free_parameters, state, loss, stiffness=True)
    assert system is not None, "the fit ended with every point in front of the camera"
    variance = residual_variance_factor(views, free_parameters, state, loss, sigma)
    inverse, on_poses, pose_inverse = _invert(system)
    to_names = _derivative_of_names(free_parameters, state)
    if correlated is not None:
        inverse = correlated.covariance(variance * inverse) / variance
    camera = variance * to_names @ inverse @ to_names.T
    by_f = free_parameters.derivative(state.values)[0]
    focus = math.sqrt(max(variance * by_f @ inverse @ by_f, 0.0)) / float(state.values[0])
    return camera, variance * _lens_pose_covariance(free_parameters, state, inverse, on_poses, pose_inverse), focus


def free_covariance(
    views: PackedViews,
    free_parameters: FreeParameters,
    state: FitState,
    loss: RobustLoss,
    sigma: float | None,
    correlated: CorrelatedErrors,
) -> Floats:
    """Return the covariance of the free parameters for errors by view, in the coordinates of the fit."""
    system = linearise(views, free_parameters, state, loss, stiffness=True)
    assert system is not None, "the fit ended with every point in front of the camera"
    variance = residual_variance_factor(views, free_parameters, state, loss, sigma)
    return correlated.covariance_by_view(variance * _invert(system)[0])


def residual_variance_factor(
    views: PackedViews, free_parameters: FreeParameters, state: FitState, loss: RobustLoss, sigma: float | None = None
) -> float:
    """Return the factor from the inverse normal equations to the covariance; for normal noise its variance [px^2]."""
    if loss.kind == "squared":
        return (residual_sigma(views, free_parameters, state, loss) if sigma is None else sigma) ** 2
    length = np.linalg.norm(residuals(views, state), axis=1)[views.weight > 0.0]
    free = views.coordinates - free_parameters.count - 6 * len(views.image)
    squared_influence = float(np.sum((loss.weight(length) * length) ** 2))
    return squared_influence / free / float(np.mean(loss.slope(length)))


def _invert(system: NormalEquations) -> tuple[Floats, Floats, Floats]:
    """Invert the normal equations: return the camera's block, -(pose by camera) maps, and the poses' own inverses."""
    reduced = solve_step(system, 0.0)[2]
    unit = 1.0 / np.sqrt(np.diag(system.camera))
    values, vectors = np.linalg.eigh(reduced * np.outer(unit, unit))
    # Clamp the eigenvalues: an undetermined direction gets a very large, but finite variance.
    values = np.maximum(values, values[-1] * len(values) * np.finfo(float).eps)
    inverse = (vectors / values) @ vectors.T
    pose_inverse = np.linalg.inv(system.pose).astype(np.float64)
    return inverse * np.outer(unit, unit), pose_inverse @ np.swapaxes(system.mixed, 1, 2), pose_inverse


def _derivative_of_names(free_parameters: FreeParameters, state: FitState) -> Floats:
    """Return d(named parameters) / d(free parameters)."""
    rows = [OPENCV.index("fx" if name == "f" else name) for name in free_parameters.names]
    return (opencv_parameters(state.values)[1] @ free_parameters.derivative(state.values))[rows]


def _lens_pose_covariance(
    free_parameters: FreeParameters, state: FitState, inverse: Floats, on_poses: Floats, own: Floats
) -> Floats:
    """Return the covariance of the poses in the lens' frame, which rotates with the tilt."""
    internal, turned = internal_parameters(state.values)
    tau = (turned @ free_parameters.derivative(state.values))[4:6]
    m = tilt_matrix(*internal[4:6])
    # Rotation vector of the lens' frame, with negative sign, by the free parameters.
    rotation_derivative = -np.outer(m[:, 0], tau[0]) - np.outer([0.0, 1.0, 0.0], tau[1])
    count = len(state.rotations)
    by_camera = np.zeros((count, 6, len(inverse)))
    by_camera[:, :3] = -rotation_derivative
    by_camera[:, 3:] = -np.cross(rotation_derivative.T[None], state.translations[:, None]).swapaxes(1, 2)
    by_camera -= on_poses
    back = np.zeros((6, 6))
    back[:3, :3] = back[3:, 3:] = m.T
    covariance: Floats = back @ (own + by_camera @ inverse @ np.swapaxes(by_camera, 1, 2)) @ back.T
    return covariance
