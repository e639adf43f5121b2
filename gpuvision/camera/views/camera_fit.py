"""What a calibration returns: the camera, its uncertainty, and what else would have fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.scheimpflug import TiltedSensor
from gpuvision.camera.tilted_projection import Floats, tilt_matrix
from gpuvision.camera.views.bundle_adjustment import (
    Loss,
    State,
    System,
    Views,
    linearise,
    residuals,
    robust_scale,
    solve,
)
from gpuvision.camera.views.parameters import OPENCV, Chart, internal_of, opencv_of


class Pose(NamedTuple):
    """From a target to the camera: ``rotation @ point + translation``.

    Attributes
    ----------
    rotation
        (3, 3).
    translation
        (3,), in the target's unit (metres).
    """

    rotation: Floats
    translation: Floats


class Alternative(NamedTuple):
    """Another model, fitted to the same points.

    Attributes
    ----------
    model
        Its name, as `fit_camera` takes it.
    rms_px
        Root mean square distance between seen and projected points.
    parameters
        Free numbers of the camera.
    p_value
        Probability of as large a rise of the residual over the largest model's, were this model true (F test).
    aic
        Akaike's criterion.
    centre
        (C_c, R_c).
    centre_distance_px
        How far this centre lies from the chosen model's.
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
    """A calibrated camera.

    Attributes
    ----------
    camera
        The camera, lens and tilt included.
    model
        Name of the model, as `fit_camera` takes it.
    poses
        One per view.
    names
        What was free in the camera, in OpenCV's names; ``f`` is fx = fy.
    covariance
        Of these, (m, m): pixels, radians.
    pose_covariance
        (views, 6, 6): a rotation vector [rad], applied from the left in the camera's frame, and the translation.
    rms_px
        Root mean square distance between seen and projected points, as OpenCV reports it.
    sigma
        Noise of one coordinate, pixels: what was given, else estimated from the residual.
    residuals
        Per view (n, 2): seen minus projected, pixels; NaN where a point was missing.
    iterations
        Steps of the final fit.
    alternatives
        The other models, smallest first.
    warnings
        What these data cannot tell.
    """

    camera: Camera
    model: str
    poses: tuple[Pose, ...]
    names: tuple[str, ...]
    covariance: Floats
    pose_covariance: Floats
    rms_px: float
    sigma: float
    residuals: tuple[Floats, ...]
    iterations: int
    alternatives: tuple[Alternative, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def uncertainties(self) -> Mapping[str, float]:
        """Standard deviation of every free number by its name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def sensor(self) -> TiltedSensor:
        """alpha, f' and the virtual camera of eq. 3.1, for square pixels; alpha is 0 in a model without tilt."""
        return TiltedSensor.from_camera(self.camera)

    @property
    def alpha_sigma(self) -> float:
        """Standard deviation of alpha, radians (to first order; where alpha itself is near 0, an upper bound)."""
        if "tauX" not in self.names:
            return 0.0
        return deviation_of_alpha(self.camera.distortion[12:], self.covariance[-2:, -2:])


def deviation_of_alpha(tau: Sequence[float], covariance: Floats) -> float:
    """Return the standard deviation of alpha from the covariance (2, 2) of tauX and tauY, radians."""
    tau_x, tau_y = tau
    sine = math.sqrt(1.0 - (math.cos(tau_x) * math.cos(tau_y)) ** 2)
    if sine**2 <= covariance.max():
        return float(math.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    slope = np.array([math.sin(tau_x) * math.cos(tau_y), math.cos(tau_x) * math.sin(tau_y)]) / sine
    return float(math.sqrt(slope @ covariance @ slope))


def camera_of(numbers: Floats) -> Camera:
    """Return the camera of `chart.NUMBERS`."""
    fx, fy, cx, cy, *coefficients, tau_x, tau_y = opencv_of(numbers)[0].tolist()
    # Without a tilt, rounding of the virtual camera is no tilt either.
    return Camera(
        matrix=((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)),
        distortion=(*coefficients, *(0.0,) * 7, tau_x + 0.0, tau_y + 0.0),
    )


def lens_poses(state: State) -> tuple[Pose, ...]:
    """Poses in the lens' frame, as `Camera` and OpenCV have them."""
    back = tilt_matrix(*internal_of(state.numbers)[0][4:6]).T
    return tuple(
        Pose(back @ rotation, back @ translation)
        for rotation, translation in zip(state.rotations, state.translations, strict=True)
    )


def noise_of(views: Views, chart: Chart, state: State, loss: Loss) -> float:
    """Estimate the noise of one coordinate from the residual, pixels."""
    if loss.kind != "squared":
        return robust_scale(views, state)
    free = views.coordinates - chart.free - 6 * len(views.seen)
    return math.sqrt(state.cost / free) if free > 0 else math.nan


def covariances(
    views: Views, chart: Chart, state: State, loss: Loss, sigma: float | None
) -> tuple[Floats, Floats, float]:
    """Covariances of the camera's numbers (in OpenCV's names) and of the poses (in the lens' frame), deviation of f.

    To first order; under a robust loss Huber's, for equal points. What the data do not fix at all comes out as a
    number far beyond any camera's. The deviation is relative, of the virtual camera's f: that is fixed even where
    tilt and centre, and with them f', are not.
    """
    system = linearise(views, chart, state, loss, stiffness=True)
    assert system is not None, "the fit ended where every point is seen"
    variance = variance_of(views, chart, state, loss, sigma)
    inverse, on_poses, own = _inverted(system)
    to_names = _names_by_numbers(chart, state)
    camera = variance * to_names @ inverse @ to_names.T
    by_f = chart.spread(state.numbers)[0]
    focus = math.sqrt(max(variance * by_f @ inverse @ by_f, 0.0)) / float(state.numbers[0])
    return camera, variance * _lens_pose_covariance(chart, state, inverse, on_poses, own), focus


def variance_of(views: Views, chart: Chart, state: State, loss: Loss, sigma: float | None = None) -> float:
    """Return what the inverse of the (stiffness) normal equations is multiplied by: the noise squared, if normal."""
    if loss.kind == "squared":
        return (noise_of(views, chart, state, loss) if sigma is None else sigma) ** 2
    length = np.linalg.norm(residuals(views, state), axis=1)[views.weight > 0.0]
    free = views.coordinates - chart.free - 6 * len(views.seen)
    pull = float(np.sum((loss.weight(length) * length) ** 2))
    return pull / free / float(np.mean(loss.slope(length)))


def _inverted(system: System) -> tuple[Floats, Floats, Floats]:
    """Inverse of the normal equations: the camera's block, -(pose by camera) maps, the poses' own inverses."""
    reduced = solve(system, 0.0)[2]
    unit = 1.0 / np.sqrt(np.diag(system.camera))
    values, vectors = np.linalg.eigh(reduced * np.outer(unit, unit))
    # A direction that nothing fixes keeps a variance far beyond any camera's, but a finite one.
    values = np.maximum(values, values[-1] * len(values) * np.finfo(float).eps)
    inverse = (vectors / values) @ vectors.T
    own = np.linalg.inv(system.pose).astype(np.float64)
    return inverse * np.outer(unit, unit), own @ np.swapaxes(system.mixed, 1, 2), own


def _names_by_numbers(chart: Chart, state: State) -> Floats:
    """d(names) / d(free numbers)."""
    rows = [OPENCV.index("fx" if name == "f" else name) for name in chart.names]
    return (opencv_of(state.numbers)[1] @ chart.spread(state.numbers))[rows]


def _lens_pose_covariance(chart: Chart, state: State, inverse: Floats, on_poses: Floats, own: Floats) -> Floats:
    """Covariance of the poses in the lens' frame, which turns with the tilt."""
    internal, turned = internal_of(state.numbers)
    tau = (turned @ chart.spread(state.numbers))[4:6]
    m = tilt_matrix(*internal[4:6])
    # The lens' frame turns by minus this rotation vector when the free numbers move.
    turn = -np.outer(m[:, 0], tau[0]) - np.outer([0.0, 1.0, 0.0], tau[1])
    count = len(state.rotations)
    by_camera = np.zeros((count, 6, len(inverse)))
    by_camera[:, :3] = -turn
    by_camera[:, 3:] = -np.cross(turn.T[None], state.translations[:, None]).swapaxes(1, 2)
    by_camera -= on_poses
    back = np.zeros((6, 6))
    back[:3, :3] = back[3:, 3:] = m.T
    covariance: Floats = back @ (own + by_camera @ inverse @ np.swapaxes(by_camera, 1, 2)) @ back.T
    return covariance
