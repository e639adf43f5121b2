"""Error budget of a placement: calibration, vision, sampling, etch bias, servo and thermal drift.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.4 and
   8.7.
.. [2] K. J. Astrom, *Introduction to Stochastic Control Theory*, Academic Press 1970, chapter 5, section 2.
.. [3] Y. Bar-Shalom, X. R. Li and T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, Wiley
   2001, section 5.2 (Kalman filter).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.delay import closed_loop
from gpuvision.servoing.margins import margins, observer_tolerance, predictor_tolerance
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import REMAINDER, predicted_frames, swing_limit
from gpuvision.servoing.placement.plan import PlacementPlan

Float64 = npt.NDArray[np.float64]


class ErrorBudget(NamedTuple):
    """Covariances of the sources of the placement error.

    Attributes
    ----------
    sources : mapping of str to numpy.ndarray
        Covariance (3, 3) of the pose of the nozzle on the board by source: "calibration", "vision", "sampling",
        "etch bias", "servo", "drift".
    total : numpy.ndarray
        (3, 3): sum of all sources.
    """

    sources: Mapping[str, Float64]
    total: Float64

    @property
    def sigmas(self) -> dict[str, Float64]:
        """Standard deviations (3,) of x, y [m] and theta [rad] by source, and of the "total"."""
        each = {**self.sources, "total": self.total}
        return {name: np.sqrt(np.diag(covariance)) for name, covariance in each.items()}


def noise_gain(
    delay: float, gain: float, *, integral: float = math.inf, derivative: float = 0.0, lag: float = 0.0
) -> float:
    """Return the variance of the position of a servo loop at rest over the variance of a measured position.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more.
    gain : float
        Fraction of the error that one frame corrects; the loop must be stable.
    integral, derivative : float
        Time constants of a PI or PID controller [frames], as for `closed_loop`. Default: a proportional controller.
    lag : float
        Time constant with which the velocity of the plant follows the command [frames], default 0.

    Notes
    -----
    Independent errors of the frames add: the sum of the squared steps of the step response, in closed form by the
    recursion of Astrom (1970). Without delay it is ``gain / (2 - gain)``.

    Raises
    ------
    ValueError
        The loop is not stable, or the gain is 0.
    """
    loop = closed_loop(delay, gain, integral=integral, derivative=derivative, lag=lag)
    return _variance(loop.numerator, loop.denominator, f"the loop with delay {delay:g} frames and gain {gain:g}")


def _variance(zeros: Float64, poles: Float64, name: str) -> float:
    """Return the variance behind a transfer function of white noise with the variance 1."""
    total = 0.0
    while len(poles) > 1:
        if abs(poles[-1]) >= poles[0]:
            raise ValueError(f"{name} is not stable: no variance")
        total += zeros[-1] ** 2 / poles[0]
        mirrored = poles[::-1] / poles[0]
        poles, zeros = (poles - poles[-1] * mirrored)[:-1], (zeros - zeros[-1] * mirrored)[:-1]
    return float(total + zeros[0] ** 2 / poles[0])


def _noise_gains(machine: Machine) -> Float64:
    """Return the covariances (3, 3) of the positions of the axes over the covariances of a measured pose.

    With the transfer functions H and G of two axes, the covariance is a quarter of the difference of the variances of
    ``H + G`` and ``H - G``.
    """
    lags, gain, delay = machine.control_lags, machine.loop_gain, machine.control_delay
    name = f"the loop with gain {gain:g}"
    gains = np.zeros((3, 3))
    for row, column in np.ndindex(3, 3):
        if lags[row] == lags[column]:
            gains[row, column] = noise_gain(delay, gain, **machine.time_constants(lags[row]))
            continue
        one, other = (closed_loop(delay, gain, **machine.time_constants(lags[each])) for each in (row, column))
        first, second = np.convolve(one.numerator, other.denominator), np.convolve(other.numerator, one.denominator)
        poles = np.convolve(one.denominator, other.denominator)
        gains[row, column] = (_variance(first + second, poles, name) - _variance(first - second, poles, name)) / 4.0
    return gains


def noise_covariance(machine: Machine, reported: Float64, noise: Float64, frames: int) -> Float64:
    """Return the covariance of the pose of the head by independent errors of the measured poses.

    Parameters
    ----------
    machine : Machine
        Observer and controller.
    reported : numpy.ndarray
        (3, 3): covariance of a measured pose as the observer gets it.
    noise : numpy.ndarray
        (3, 3): covariance of its part that is independent from frame to frame.
    frames : int
        Number of frames from the first measured pose to the release; used for the Kalman filter only.

    Returns
    -------
    numpy.ndarray
        (3, 3)

    Notes
    -----
    The latest pose and the Smith predictor pass the error of a pose on to the controller: `noise_gain` times the noise,
    the limit for many frames. With the Smith predictor each axis has its lag, and two axes with different lags have the
    sum of the products of their impulse responses. The Kalman filter has the correction K_j in frame j: 1 in the first
    frame, then smaller from frame to frame, by the recursion of the covariance. The error of its estimate, ``e_k = (1 -
    K_k) e_(k-1) + K_k noise_k``, drives a loop without delay that has the impulse response h. The error at the release
    in frame n is the sum of ``A_j K_j noise_j`` with ``A_j = h_(n-j) + A_(j+1) (1 - K_(j+1))``.
    """
    if machine.control.motion_sigma is None:
        return _noise_gains(machine) * noise
    corrections = _corrections(reported, np.diag(machine.control.motion_sigma) ** 2, frames)
    response = -np.diff(machine.error_after(frames + 1)[:, 0])  # h_1 ... h_n, the same for all axes
    covariance, later, unit = np.zeros((3, 3)), np.zeros((3, 3)), np.eye(3)
    for frame in range(frames - 1, -1, -1):
        later = later + response[frames - 1 - frame] * unit
        covariance += later @ corrections[frame] @ noise @ corrections[frame].T @ later.T
        later = later @ (unit - corrections[frame])
    return covariance


def _corrections(reported: Float64, motion: Float64, frames: int) -> list[Float64]:
    """Return the corrections (3, 3) of the Kalman filter in the frames from the first measured pose on."""
    found, covariance = [np.eye(3)], reported
    while len(found) < frames:
        predicted = covariance + motion
        found.append(predicted @ np.linalg.inv(predicted + reported))
        covariance = predicted - found[-1] @ predicted
    return found


class ModelTolerance(NamedTuple):
    """Errors of the model of the machine at which its loop becomes unstable.

    Attributes
    ----------
    plant_gain : float
        Motion of the head over the commanded motion.
    longer_delay : float
        Delay above the one in the machine file [s].
    """

    plant_gain: float
    longer_delay: float


def model_tolerance(machine: Machine, plan: PlacementPlan) -> ModelTolerance | None:
    """Return the errors of the model at which the loop becomes unstable; None for a predictor with PI or PID.

    With a predictor, each axis counts with its lag, and the least errors of the axes are returned.
    """
    gain, delay, period = machine.loop_gain, machine.delay.frames, machine.period
    observer = machine.control.observer
    if observer == "latest":
        found = margins(machine.gains, machine.response_frames * period, period)
        return ModelTolerance(found.gain, found.delay)
    if machine.control.controller != "p":
        return None
    if machine.control.motion_sigma is None:
        lags = dict.fromkeys(machine.control_lags)
        predictors = [predictor_tolerance(gain, delay, lag=lag) for lag in lags]
        return ModelTolerance(
            min(each.plant_gain for each in predictors), min(each.longer for each in predictors) * period
        )
    ratios = np.array(machine.control.motion_sigma) / np.sqrt(np.diag(plan.reported))
    observers = [
        observer_tolerance(gain, delay, lag=axis.lag / period, noise_ratio=float(ratio))
        for axis, ratio in zip(machine.axes, ratios, strict=True)
    ]
    return ModelTolerance(min(each.plant_gain for each in observers), min(each.longer for each in observers) * period)


def predict_budget(machine: Machine, plan: PlacementPlan, frames: npt.ArrayLike | None = None) -> ErrorBudget:
    """Predict the error of a placement at the release.

    Parameters
    ----------
    machine : Machine
        Machine; its calibration has a covariance.
    plan : PlacementPlan
        Plan of the placement.
    frames : array_like, optional
        (n,) numbers of frames from the first measured pose to the release, over which the noise is averaged; used for
        the Kalman filter only. Default: the predicted number for a start at the edge of the landing zone.

    Notes
    -----
    Calibration, etch bias and drift are common to all frames of a placement. "vision" is the motion by the errors of
    the measured poses, which the loop follows: it averages the noise from frame to frame (`noise_covariance`), but not
    the differences between the pixels, which are the same in all frames of a head at rest. The Kalman filter weights
    the frames by `PlacementPlan.reported`. "sampling" is the error of the bilinear sampling, `PlacementPlan.sampling`:
    it is the same in all frames of a head at rest, and is not averaged. It is an upper estimate: 0.02 px in each ruler.
    "servo" is the rest of the step response that `ReleaseRule` allows, evenly distributed, and the step of the encoder.
    With the rule "vibration" an axis that swings adds a swing at a random phase, with the largest amplitude that the
    rule allows. With the rule "fixed" the rest is the error that a start in the landing zone leaves after the fixed
    time; a vibration is not included.
    """
    turn, tolerance = plan.camera_to_board, machine.tolerance
    zone = np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
    counts = [predicted_frames(machine, zone)] if frames is None else np.asarray(frames, np.int64).tolist()
    temporal = (1.0 - plan.fixed_pattern) * plan.vision
    moved = np.mean([noise_covariance(machine, plan.reported, temporal, each) for each in counts], axis=0)
    steps = np.array([axis.encoder for axis in machine.axes])
    sources = {
        "calibration": turn @ machine.pipette_in_camera.pose_covariance @ turn.T,
        "etch bias": plan.etch_bias,
        "drift": turn @ machine.drift.covariance @ turn.T,
        "vision": moved + plan.fixed_pattern * plan.vision,
        "sampling": plan.sampling,
        "servo": np.diag(_servo_variance(machine) + steps**2 / 12.0),
    }
    return ErrorBudget(sources, np.sum(list(sources.values()), axis=0))


def _servo_variance(machine: Machine) -> Float64:
    """Return the variances (3,) of the rest of the motion at the release."""
    tolerance, settling = machine.tolerance, machine.settling
    limit = np.array([tolerance.position] * 2 + [tolerance.angle])
    if settling.wait is not None:
        zone = np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
        left = machine.error_after(math.ceil(settling.wait * machine.rate) + 1)[-1]
        return np.asarray((left * zone) ** 2 / 3.0)
    swings = np.array(settling.frequency or (0.0, 0.0, 0.0)) > 0.0
    return np.asarray((REMAINDER * limit) ** 2 / 3.0 + np.where(swings, swing_limit(machine) ** 2 / 2.0, 0.0))
