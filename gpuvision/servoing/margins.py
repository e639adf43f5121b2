"""Stability margins of a servo loop, and the sensitivity of a predictor and of an observer to a wrong model.

References
----------
.. [1] K. J. Astrom and R. M. Murray, *Feedback Systems*, Princeton University Press 2008, section 9.3 (margins).
.. [2] K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA 2006, section 8.3 (sensitivity of the Smith predictor).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq

from gpuvision.servoing.controllers import PidGains
from gpuvision.servoing.delay import delay_taps, held_axis, lag_gains
from gpuvision.servoing.observer import MotionModel
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]

# Frequencies of the search for margins, from the frame rate / 1e6 to half the frame rate (chosen): the phase changes by
# less than a degree from one to the next for delays up to 20 frames.
_FREQUENCIES = 8192
# Steps of the search for the first unstable error of an observer's model (chosen): the next one lies within 0.5 frames.
_OBSERVER_STEPS = 40
# Steps of the bisection for the tolerated error of a model.
_BISECTIONS = 30


class Margins(NamedTuple):
    """Distance of a loop from instability.

    Attributes
    ----------
    gain : float
        Factor of the gain that makes the loop unstable.
    phase : float
        Additional loss of phase that makes the loop unstable [rad]; below 0 for an unstable loop.
    delay : float
        Additional delay that makes the loop unstable [s], by the phase margin.
    modulus : float
        Smallest distance of the frequency response from -1: 1 over the largest sensitivity.
    crossover : float
        Frequency at which the loop's gain is 1 [Hz].
    """

    gain: float
    phase: float
    delay: float
    modulus: float
    crossover: float


def open_loop(
    gains: PidGains, delay: float, period: float, z: npt.ArrayLike, *, lag: float = 0.0
) -> npt.NDArray[np.complex128]:
    """Return the open loop of controller, integrating plant with hold, and delay, at points of the z plane.

    Parameters
    ----------
    gains : PidGains
        Gains of the controller in series form; the derivative is the difference of two frames.
    delay : float
        Delay from the middle of the exposure to the command [s].
    period : float
        Frame time [s]. Range: above 0.
    z : array_like
        (...,) complex numbers, not 1.
    lag : float
        Time constant with which the plant follows the commanded velocity [s]. Default 0. Range: 0 or more.
    """
    z = np.asarray(z, np.complex128)
    whole, part = delay_taps(delay / finite(period, "period", above=0.0))
    controller = 1.0 + gains.derivative / period * (1.0 - 1.0 / z)
    if math.isfinite(gains.integral):
        controller = controller * (1.0 + period / gains.integral / (1.0 - 1.0 / z))
    if finite(lag, "lag", minimum=0.0) == 0.0:
        taps = z**-whole * (1.0 - part + part / z)
        return np.asarray(gains.proportional * period * controller * taps / (z - 1.0))
    plant = MotionModel(lag=(lag,) * 3)
    last, first = _response(plant, (1.0 - part) * period), _response(plant, part * period)
    older = last[0] @ first[1]  # effect of the command before the newest one that acts in a frame
    position, velocity = (last[1][k] + older[k] / z for k in range(2))
    whole_frame = last[0] @ first[0]
    position = (position + whole_frame[0, 1] * velocity / (z - whole_frame[1, 1])) / (z - 1.0)
    return np.asarray(gains.proportional * controller * z**-whole * position)


def margins(gains: PidGains, delay: float, period: float, *, lag: float = 0.0) -> Margins:
    """Return the stability margins of a loop with a delayed pose and no predictor.

    Parameters
    ----------
    gains, delay, period, lag
        As for `open_loop`.

    Raises
    ------
    ValueError
        The loop's gain is above 1 up to half the frame rate: there is no crossover.
    """
    angles = np.append(np.geomspace(2e-6 * math.pi, math.pi, _FREQUENCIES)[:-1], math.pi)

    def at(angle: float) -> complex:
        return complex(open_loop(gains, delay, period, np.exp(1j * angle), lag=lag))

    response = open_loop(gains, delay, period, np.exp(1j * angles), lag=lag)
    crossing = _first_root(lambda angle: math.log(abs(at(angle))), angles, np.log(np.abs(response)))
    if crossing is None:
        raise ValueError("the gain of the loop is above 1 at all frequencies; give smaller gains")
    phase = float(np.angle(-at(crossing)))
    continuous = float(np.interp(crossing, angles[:-1], np.unwrap(np.angle(-response[:-1]))))
    phase += 2.0 * math.pi * round((continuous - phase) / (2.0 * math.pi))
    # The response crosses the negative real axis where its imaginary part is 0; at half the frame rate it is real.
    real = [float(response[-1].real)]
    for k in np.flatnonzero(np.diff(np.sign(response.imag[:-1]))):
        real.append(at(float(brentq(lambda angle: at(angle).imag, angles[k], angles[k + 1]))).real)
    gain = 1.0 / max(max(-each for each in real), 1e-300)
    modulus = float(np.abs(1.0 + response).min())
    return Margins(gain, phase, phase / crossing * period, modulus, crossing / (2.0 * math.pi * period))


def _first_root(function: Callable[[float], float], angles: Float64, values: Float64) -> float | None:
    places = np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))
    return float(brentq(function, angles[places[0]], angles[places[0] + 1])) if places.size else None


def predictor_polynomial(
    gain: float, delay: float, model_delay: float, plant_gain: float = 1.0, *, lag: float = 0.0
) -> Float64:
    """Return the characteristic polynomial of a proportional loop with a Smith predictor and a wrong model.

    Parameters
    ----------
    gain : float
        Fraction of the predicted error that one frame corrects.
    delay, model_delay : float
        Delay of the plant and of the predictor [frames]; fractions are exact.
    plant_gain : float
        Motion of the plant over motion of the model. Default 1.
    lag : float
        Time constant with which the velocities of plant and model follow the command [frames]. Default 0.

    Returns
    -------
    numpy.ndarray
        Coefficients, highest power first. Without lag, of z^n (z - 1 + gain (1 + plant_gain D(z) - M(z))), where D and
        M are the taps of the two delays. With a right model it is z^n (z - 1 + gain): the loop without delay. With a
        lag, the terms 1, D and M are the positions of `held_axis`.
    """
    true, model = held_axis(delay, lag), held_axis(model_delay, lag)
    own = np.convolve([1.0, -1.0], [1.0, -true.decay] if lag else [1.0])
    polynomial = np.zeros(max(len(true.seen), len(model.seen), len(own)))
    polynomial[: len(own)] = own
    polynomial[: len(true.now)] += gain * true.now
    polynomial[: len(true.seen)] += gain * plant_gain * true.seen
    polynomial[: len(model.seen)] -= gain * model.seen
    return polynomial


class PredictorTolerance(NamedTuple):
    """Errors of the model at which a loop with a Smith predictor becomes unstable.

    Attributes
    ----------
    shorter, longer : float
        Delay of the plant below and above the delay of the model [frames]; ``shorter`` is the model's delay where every
        shorter delay is stable.
    plant_gain : float
        Largest motion of the plant over motion of the model.
    """

    shorter: float
    longer: float
    plant_gain: float


def predictor_tolerance(gain: float, delay: float, *, lag: float = 0.0) -> PredictorTolerance:
    """Return the errors of the model at which a loop with a Smith predictor becomes unstable.

    Parameters
    ----------
    gain : float
        Fraction of the predicted error that one frame corrects, above 0 and below the limit of `lag_gains`: 2 without
        lag.
    delay : float
        Delay of the predictor [frames].
    lag : float
        Time constant with which the velocities of plant and model follow the command [frames]. Default 0.

    Notes
    -----
    The errors are scanned in 200 steps, up to a delay of ``delay + 10`` frames and a gain of 10, and the first unstable
    one is refined by bisection.
    """
    finite(gain, "gain", above=0.0, maximum=lag_gains(lag).limit)

    def is_stable(error: float, factor: float) -> bool:
        polynomial = predictor_polynomial(gain, max(delay + error, 0.0), delay, factor, lag=lag)
        return bool(np.abs(np.roots(polynomial)).max() < 1.0)

    return PredictorTolerance(
        _first_unstable(lambda error: is_stable(-error, 1.0), delay),
        _first_unstable(lambda error: is_stable(error, 1.0), delay + 10.0),
        1.0 + _first_unstable(lambda more: is_stable(0.0, 1.0 + more), 9.0),
    )


def observer_matrix(
    gain: float,
    delay: float,
    *,
    lag: float = 0.0,
    noise_ratio: float = 1.0,
    plant_delay: float | None = None,
    plant_lag: float | None = None,
    plant_gain: float = 1.0,
) -> Float64:
    """Return the closed-loop matrix of a proportional loop with a Kalman observer and a wrong model.

    Parameters
    ----------
    gain : float
        Fraction of the estimated error that one frame corrects.
    delay : float
        Delay of the measurements by their time stamps [frames], 0 or more; fractions are exact.
    lag : float
        Time constant of the velocity in the `MotionModel` of the observer [frames]. Default 0.
    noise_ratio : float
        Standard deviation of the random motion of the model during a frame, over the standard deviation of a
        measurement. Default 1. Range: above 0.
    plant_delay, plant_lag : float, optional
        Delay and time constant of the plant [frames]. Default: the values of the model.
    plant_gain : float
        Motion of the plant over motion of the model. Default 1.

    Returns
    -------
    numpy.ndarray
        Square matrix that maps the state of a frame to the state of the next frame: position and velocity of the plant
        and of the observer at their times of the exposure, and the last commands, newest first. The loop is stable if
        all eigenvalues lie within the unit circle.

    Notes
    -----
    `PoseObserver` has this response in its steady state: the constant gain of the correction follows from the discrete
    algebraic Riccati equation. The model predicts from the exposure to the command.
    """
    model = MotionModel(lag=(lag,) * 3, position_noise=(finite(noise_ratio, "noise_ratio", above=0.0) ** 2,) * 3)
    plant = model if plant_lag is None else MotionModel(lag=(plant_lag,) * 3)
    (whole, part), (true_whole, true_part) = (
        delay_taps(delay),
        delay_taps(delay if plant_delay is None else plant_delay),
    )
    size = 4 + max(whole, true_whole) + 2
    estimated, true, commands = slice(2, 4), slice(0, 2), 3  # columns; the command i frames ago is at commands + i
    rows = np.zeros((4, size))
    moved, driven = _response(plant, 1.0 - true_part), _response(plant, true_part)
    rows[true, true] = moved[0] @ driven[0]
    rows[true, commands + true_whole + 1] = plant_gain * moved[1]
    rows[true, commands + true_whole + 2] = plant_gain * moved[0] @ driven[1]
    first, last = _response(model, part), _response(model, 1.0 - part)
    predicted = np.zeros((2, size))
    predicted[:, estimated] = last[0] @ first[0]
    predicted[:, commands + whole + 1] = last[1]
    predicted[:, commands + whole + 2] = last[0] @ first[1]
    rows[estimated] = predicted + np.outer(_steady_gain(model), rows[0] - predicted[0])
    now = first[0] @ rows[estimated]  # the estimate of the exposure, moved to the time of the command
    now[:, commands + whole + 1] += first[1]
    full = _response(model, 1.0)
    for each in range(whole, 0, -1):
        now = full[0] @ now
        now[:, commands + each] += full[1]
    return np.vstack([rows, -gain * now[:1], np.eye(size)[4:-1]])


@lru_cache
def _response(model: MotionModel, step: float) -> tuple[Float64, Float64]:
    """Return the matrices of position and velocity of one axis (2, 2), and of its command (2,), over a time step."""
    state, command, _ = model.transition(step)
    return state[::3, ::3], command[::3, 0]


@lru_cache
def _steady_gain(model: MotionModel) -> Float64:
    """Return the gain (2,) of the correction by measurements of the variance 1 in every frame."""
    state, _, noise = model.transition(1.0)
    covariance = solve_discrete_are(state[::3, ::3].T, np.eye(2)[:, :1], noise[::3, ::3], np.eye(1))
    return np.asarray(covariance[:, 0] / (covariance[0, 0] + 1.0), np.float64)


class ObserverTolerance(NamedTuple):
    """Errors of the model at which a loop with a Kalman observer becomes unstable.

    Attributes
    ----------
    shorter, longer : float
        Delay of the plant below and above the delay of the time stamps [frames]; ``shorter`` is the whole delay where
        every shorter delay is stable, and 10 is the longest that is searched.
    lag : float
        Time constant of the plant above the time constant of the model [frames]; at most 20 are searched.
    plant_gain : float
        Largest motion of the plant over motion of the model; at most 10 is searched.
    """

    shorter: float
    longer: float
    lag: float
    plant_gain: float


def observer_tolerance(gain: float, delay: float, *, lag: float = 0.0, noise_ratio: float = 1.0) -> ObserverTolerance:
    """Return the errors of the model at which a loop with a Kalman observer becomes unstable.

    Parameters
    ----------
    gain, delay, lag, noise_ratio
        As for `observer_matrix`; the gain is above 0 and below 2.

    Notes
    -----
    Each error is scanned in 40 steps, and the first unstable one is refined by bisection.
    """
    finite(gain, "gain", above=0.0, maximum=2.0)

    def is_stable(**plant: float) -> bool:
        matrix = observer_matrix(gain, delay, lag=lag, noise_ratio=noise_ratio, **plant)
        return bool(np.abs(np.linalg.eigvals(matrix)).max() < 1.0)

    return ObserverTolerance(
        _first_unstable(lambda error: is_stable(plant_delay=max(delay - error, 0.0)), delay, _OBSERVER_STEPS),
        _first_unstable(lambda error: is_stable(plant_delay=delay + error), 10.0, _OBSERVER_STEPS),
        _first_unstable(lambda error: is_stable(plant_lag=lag + error), 20.0, _OBSERVER_STEPS),
        1.0 + _first_unstable(lambda more: is_stable(plant_gain=1.0 + more), 9.0, _OBSERVER_STEPS),
    )


def _first_unstable(is_stable: Callable[[float], bool], largest: float, count: int = 200) -> float:
    """Return the smallest error that is not stable, or the largest one."""
    steps = np.linspace(0.0, largest, count + 1)
    found = next((k for k, each in enumerate(steps) if not is_stable(float(each))), None)
    if found is None:
        return largest
    if found == 0:
        return 0.0
    low, high = float(steps[found - 1]), float(steps[found])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return high
