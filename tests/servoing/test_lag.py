"""Loops of axes with a lag: gains, response and Smith predictor against an independent sampled state space (SciPy)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete

from gpuvision.servoing.delay import characteristic_polynomial, closed_loop, gain_limit, lag_gains
from gpuvision.servoing.delay_response import settling_frames, step_response
from gpuvision.servoing.margins import predictor_polynomial, predictor_tolerance
from gpuvision.servoing.placement.budget import noise_gain

STEPS = 20  # steps of a frame: delays are multiples of 0.05 frames
LAGS = [0.05, 0.4, 1.0, 3.0, 25.0]


def sampled(lag: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices of position and velocity, and of the command, by SciPy."""
    slope, drive = np.array([[0.0, 1.0], [0.0, -1.0 / lag]]), np.array([[0.0], [1.0 / lag]])
    state, command, *_ = cont2discrete((slope, drive, np.eye(2), np.zeros((2, 1))), step, "zoh")
    return state, command[:, 0]


def simulated(
    gain: float,
    lag: float,
    frames: int,
    *,
    delay: float = 0.0,
    model_delay: float | None = None,
    plant_gain: float = 1.0,
    integral: float = math.inf,
    derivative: float = 0.0,
) -> np.ndarray:
    """Return the error at each frame after a step of 1; with a Smith predictor where ``model_delay`` is given."""
    state, command = sampled(lag, 1.0 / STEPS)
    plant, model = [np.zeros(2)], [np.zeros(2)]
    summed, errors = 0.0, []
    for _ in range(frames):
        now = len(plant) - 1
        errors.append(1.0 - plant[now][0])
        seen = plant[max(now - round(delay * STEPS), 0)][0]
        velocity = 0.0
        if model_delay is not None:
            seen += model[now][0] - model[max(now - round(model_delay * STEPS), 0)][0]
            velocity = model[now][1]
        part = 1.0 - seen - derivative * velocity
        summed += part / integral
        u = gain * (part + summed)
        for _ in range(STEPS):
            plant.append(state @ plant[-1] + plant_gain * command * u)
            model.append(state @ model[-1] + command * u)
    return np.array(errors)


@pytest.mark.parametrize("lag", LAGS)
def test_gains_of_a_lag_separate_stable_and_swinging_loops(lag: float) -> None:
    state, command = sampled(lag, 1.0)

    def poles(gain: float) -> np.ndarray:
        return np.linalg.eigvals(state - gain * np.outer(command, (1.0, 0.0)))

    gains = lag_gains(lag)
    for factor, is_stable in ((0.999, True), (1.001, False)):
        assert (np.abs(poles(factor * gains.limit)).max() < 1.0) == is_stable
        assert (np.abs(poles(factor * gains.critical).imag).max() == 0.0) == is_stable
    assert poles(0.999 * gains.critical).real.min() > 0.0


def test_gains_without_a_lag_are_the_limit_of_a_short_lag() -> None:
    assert lag_gains(0.0) == (2.0, 1.0)
    # The largest gain without oscillation is 1 - 2 sqrt(lag) for a short lag.
    assert lag_gains(1e-6) == pytest.approx((2.0, 1.0 - 2e-3), abs=1e-5)
    assert lag_gains(1e3).critical == pytest.approx(0.25e-3, rel=1e-3)
    for bad in (-1.0, 1e4, math.nan):
        with pytest.raises(ValueError, match="lag"):
            lag_gains(bad)


@pytest.mark.parametrize("delay", [0.0, 0.35, 2.0, 3.6])
@pytest.mark.parametrize("lag", [0.4, 3.0])
@pytest.mark.parametrize("integral", [math.inf, 15.0])
def test_response_of_an_axis_with_a_lag_is_that_of_the_state_space(delay: float, lag: float, integral: float) -> None:
    found = step_response(delay, 0.08, 60, integral=integral, lag=lag)
    np.testing.assert_allclose(found, simulated(0.08, lag, 60, delay=delay, integral=integral), atol=1e-10)


@pytest.mark.parametrize("lag", [0.4, 3.0])
@pytest.mark.parametrize(("integral", "derivative"), [(math.inf, 0.0), (20.0, 0.0), (20.0, 2.0), (math.inf, 2.0)])
def test_a_smith_predictor_leaves_the_loop_of_the_lag(lag: float, integral: float, derivative: float) -> None:
    """The delay of 3.6 frames has no effect on the errors."""
    constants = {"integral": integral, "derivative": derivative}
    seen = simulated(0.15, lag, 60, delay=3.6, model_delay=3.6, **constants)
    np.testing.assert_allclose(step_response(0.0, 0.15, 60, lag=lag, **constants), seen, atol=1e-10)
    settled = int(np.flatnonzero(np.abs(simulated(0.15, lag, 400, **constants, model_delay=0.0)) > 0.02)[-1]) + 1
    assert settling_frames(0.0, 0.15, 0.02, lag=lag, **constants) == settled


@pytest.mark.parametrize("lag", [0.4, 3.0])
def test_noise_of_a_loop_with_a_lag_is_that_of_the_lyapunov_equation(lag: float) -> None:
    state, command = sampled(lag, 1.0)
    closed = state - 0.2 * np.outer(command, (1.0, 0.0))
    covariance, drive = np.zeros((2, 2)), 0.04 * np.outer(command, command)
    for _ in range(3000):
        covariance = closed @ covariance @ closed.T + drive
    assert noise_gain(0.0, 0.2, lag=lag) == pytest.approx(covariance[0, 0], rel=1e-9)


@pytest.mark.parametrize(("lag", "gain"), [(0.4, 0.4), (3.0, 0.3)])
def test_a_wrong_model_is_unstable_beyond_the_tolerance(lag: float, gain: float) -> None:
    """The growth of the simulated error is the largest root of the polynomial."""
    delay = 4.0
    tolerated = predictor_tolerance(gain, delay, lag=lag)
    cases = [
        (delay + 2.0, 1.0),
        (delay - 2.0, 1.0),
        (delay, 0.9 * tolerated.plant_gain),
        (delay, 1.2 * tolerated.plant_gain),
    ]
    for true, plant_gain in cases:
        root = np.abs(np.roots(predictor_polynomial(gain, true, delay, plant_gain, lag=lag))).max()
        error = np.abs(simulated(gain, lag, 260, delay=true, model_delay=delay, plant_gain=plant_gain))
        windows = [error[a : a + 80].max() for a in (100, 180)]
        assert (windows[1] / windows[0]) ** (1 / 80) == pytest.approx(root, abs=6e-3)
    for factor, is_stable in ((0.98, True), (1.02, False)):
        more = predictor_polynomial(gain, delay, delay, 1.0 + factor * (tolerated.plant_gain - 1.0), lag=lag)
        assert (np.abs(np.roots(more)).max() < 1.0) == is_stable
    without = predictor_polynomial(gain, delay, delay, lag=lag)
    loop = closed_loop(0.0, gain, lag=lag).denominator
    np.testing.assert_allclose(without[: len(loop)], loop, atol=1e-15)
    assert not without[len(loop) :].any()


def test_a_loop_without_lag_has_the_polynomials_as_before() -> None:
    np.testing.assert_array_equal(characteristic_polynomial(2.25, 0.1), [1.0, -1.0, 0.0, 0.1 * 0.75, 0.1 * 0.25])
    np.testing.assert_array_equal(characteristic_polynomial(2.0, 0.1), [1.0, -1.0, 0.0, 0.1])
    assert gain_limit(2.0) == pytest.approx(0.6180339887498949)
