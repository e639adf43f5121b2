"""Margins and sensitivity, against closed forms of the proportional loop and simulated loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains, gains_without_oscillation, simc_gains
from gpuvision.servoing.delay import gain_limit, non_oscillating_gain
from gpuvision.servoing.loop import ServoLoop, SimulatedClock
from gpuvision.servoing.margins import (
    margins,
    observer_matrix,
    observer_tolerance,
    open_loop,
    predictor_polynomial,
    predictor_tolerance,
)
from gpuvision.servoing.observer import MotionModel, PoseMeasurement, PoseObserver, PosePrediction
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PERIOD = 1e-3


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.5, 6.0])
@pytest.mark.parametrize("fraction", [0.2, 0.5])
def test_margins_of_a_proportional_loop(delay: float, fraction: float) -> None:
    """|L| = 1 at 2 asin(K / 2); the phase there is -90 degrees - (delay + 1/2) angle."""
    gain = fraction * gain_limit(delay)
    found = margins(PidGains(proportional=gain / PERIOD), delay * PERIOD, PERIOD)
    assert found.gain == pytest.approx(1.0 / fraction, rel=1e-6)
    if delay % 1.0 == 0.0:
        angle = 2.0 * math.asin(gain / 2.0)
        assert found.crossover == pytest.approx(angle / (2.0 * math.pi * PERIOD), rel=1e-6)
        assert found.phase == pytest.approx(math.pi / 2.0 - (delay + 0.5) * angle, rel=1e-6)
        assert found.delay == pytest.approx(found.phase / angle * PERIOD, rel=1e-6)
    assert 0.0 < found.modulus < 1.0
    # The sensitivity bounds the other margins [1, section 9.3].
    assert found.gain >= 1.0 / (1.0 - found.modulus) - 1e-3
    assert found.phase >= 2.0 * math.asin(found.modulus / 2.0) - 1e-3


def test_delay_margin_is_the_delay_at_which_the_gain_is_the_limit() -> None:
    gain = 0.3
    found = margins(PidGains(proportional=gain / PERIOD), 1e-3, PERIOD)
    assert gain_limit(1.0 + found.delay / PERIOD) == pytest.approx(gain, rel=0.01)


def test_gain_above_all_frequencies_is_an_error() -> None:
    with pytest.raises(ValueError, match="above 1 at all frequencies"):
        margins(PidGains(proportional=3.0 / PERIOD), 0.0, PERIOD)


def test_rules() -> None:
    assert gains_without_oscillation(2e-3, PERIOD).proportional == pytest.approx(non_oscillating_gain(2) / PERIOD)
    gains = simc_gains(2.5e-3, lag=4e-3)
    assert (gains.proportional, gains.integral, gains.derivative) == pytest.approx((200.0, 0.02, 4e-3))
    assert math.isinf(simc_gains(2.5e-3, integral=False).integral)
    found = margins(simc_gains(2.5e-3), 2e-3, PERIOD)
    # Skogestad's rule promises a gain margin of 2.96, a phase margin of 46.9 degrees for a continuous loop.
    assert found.gain == pytest.approx(2.96, rel=0.05)
    assert math.degrees(found.phase) == pytest.approx(46.9, abs=1.5)


@pytest.mark.parametrize(("delay", "factor"), [(3.0, 1.0), (4.4, 1.0), (2.2, 1.0), (3.0, 1.3), (3.6, 0.8)])
def test_polynomial_of_a_wrong_predictor_is_the_loop(delay: float, factor: float) -> None:
    """Decay of a written-out loop whose predictor believes in a delay of 3 frames."""
    gain, frames = 0.5, 400
    times = np.arange(-20.0, frames + 1.0)
    true, model = np.zeros(len(times)), np.zeros(len(times))
    for k in range(20, 20 + frames):
        now = times[k]
        seen = float(np.interp(now - delay, times, true))
        predicted = seen + model[k] - float(np.interp(now - 3.0, times, model))
        step = gain * (1.0 - predicted)
        true[k + 1], model[k + 1] = true[k] + factor * step, model[k] + step
    errors = np.abs(1.0 - true[20:])
    root = float(np.abs(np.roots(predictor_polynomial(gain, delay, 3.0, factor))).max())
    peaks = [errors[a : a + 60].max() for a in (40, 120)]
    if errors[120:180].max() > 1e-12:
        assert (peaks[1] / peaks[0]) ** (1 / 80) == pytest.approx(root, rel=0.01)
    else:
        assert root < 0.8


def test_tolerance_is_where_the_polynomial_leaves_the_circle() -> None:
    found = predictor_tolerance(0.8, 4.0)
    for error in (-found.shorter, found.longer):
        inside, outside = (predictor_polynomial(0.8, 4.0 + factor * error, 4.0) for factor in (0.999, 1.001))
        assert np.abs(np.roots(inside)).max() < 1.0 < np.abs(np.roots(outside)).max()
    inside, outside = (predictor_polynomial(0.8, 4.0, 4.0, 1.0 + f * (found.plant_gain - 1.0)) for f in (0.999, 1.001))
    assert np.abs(np.roots(inside)).max() < 1.0 < np.abs(np.roots(outside)).max()
    slow = predictor_tolerance(0.2, 4.0)
    assert slow.longer > found.longer
    assert slow.plant_gain > found.plant_gain


def test_anti_windup() -> None:
    """A long saturated move leaves no more integral part than a short one."""
    gains, limit = PidGains(proportional=10.0, integral=0.1), (0.1, 0.1, 0.1)
    controller = PidController(gains, limit=limit)
    far = np.array([1.0, -1.0, 0.0])
    for _ in range(1000):
        assert controller(far, np.zeros(3), PERIOD).tolist() == [0.1, -0.1, 0.0]
    assert controller(-1e-3 * far, np.zeros(3), PERIOD) == pytest.approx([-0.01, 0.01, 0.0], rel=0.02)
    free = PidController(gains)
    assert free(far, np.zeros(3), PERIOD) == pytest.approx(far * 10.0 * (1.0 + PERIOD / 0.1))
    assert free(far, np.zeros(3), PERIOD) == pytest.approx(far * 10.0 * (1.0 + 2.0 * PERIOD / 0.1))
    free.reset()
    assert free(far, np.zeros(3), PERIOD) == pytest.approx(far * 10.0 * (1.0 + PERIOD / 0.1))


def test_anti_windup_of_an_applied_velocity() -> None:
    """The integral part grows on an axis with the full velocity, and on one whose error reduces it."""
    controller, far = PidController(PidGains(proportional=10.0, integral=0.1)), np.array([1.0, -1.0, 1.0])
    for _ in range(100):
        command = controller(far, np.zeros(3), PERIOD)
        controller.applied(np.array([0.0, 0.5 * command[1], command[2]]))
    grown = 10.0 * PERIOD / 0.1  # of one frame
    expected = [10.0 + grown, -10.0 - grown, 10.0 + 101.0 * grown]
    assert controller(far, np.zeros(3), PERIOD) == pytest.approx(expected)
    controller.applied(np.zeros(3))
    reduced = controller(np.array([0.0, 0.0, -0.1]), np.zeros(3), PERIOD)
    controller.applied(np.zeros(3))
    assert reduced == pytest.approx([0.0, 0.0, -1.0 + 99.9 * grown])
    assert controller(np.zeros(3), np.zeros(3), PERIOD)[2] == pytest.approx(99.9 * grown)


def test_derivative_and_feed_forward() -> None:
    controller = PidController(PidGains(proportional=10.0, derivative=0.2), feed_forward=0.5)
    error, speed = np.array([1.0, 2.0, 3.0]), np.array([-1.0, 0.0, 1.0])
    assert controller(error, speed, PERIOD, 4.0 * speed) == pytest.approx(10.0 * (error + 0.2 * speed) + 2.0 * speed)


@pytest.mark.parametrize(
    "given", [{"proportional": 0.0}, {"proportional": 1.0, "integral": 0.0}, {"proportional": 1.0, "derivative": -1.0}]
)
def test_gains_are_checked(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected a number"):
        PidGains(**given)


class ScaledPlant(SimulatedPlant):
    """Plant that moves by a multiple of its command."""

    factor = 1.0

    def command(self, time: float, velocity: np.ndarray) -> None:
        super().command(time, self.factor * velocity)


def observer_radius(
    gain: float, delay: float, lag: float, *, plant_delay: float, plant_lag: float, factor: float
) -> float:
    """Return the factor per frame of the error of a simulated loop with a `PoseObserver`, from its last frames."""
    frames = 500
    model = MotionModel(lag=(lag * PERIOD,) * 3, position_noise=(1e-12 / PERIOD,) * 3)
    observer = PoseObserver(model, gate=1e300)
    plant = ScaledPlant((Axis(lag=plant_lag * PERIOD), Axis(), Axis()))
    plant.factor = factor
    observer.reset(-0.02, np.zeros(3), 1e-12 * np.eye(3))
    late = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=plant_delay * PERIOD, is_noisy=False)

    def sensor(time: float, _predicted: PosePrediction) -> list[PoseMeasurement]:
        """Return the measurements with the time stamps of the model's delay."""
        shift = (plant_delay - delay) * PERIOD
        return [each._replace(exposed=each.exposed + shift) for each in late(time)]

    controller = PidController(PidGains(proportional=gain / PERIOD))
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=None)
    error = np.abs(loop.run((1e-3, 0.0, 0.0), frames * PERIOD).pose[:, 0] - 1e-3)
    windows = [error[a : a + 100].max() for a in (200, 400)]
    return float((windows[1] / windows[0]) ** (1 / 200))


@pytest.mark.parametrize(
    ("gain", "delay", "lag", "plant"),
    [
        (0.5, 3.0, 0.0, {"plant_delay": 5.4}),
        (0.8, 2.2, 3.0, {"plant_lag": 12.0}),
        (0.8, 2.0, 3.0, {"plant_delay": 2.7, "plant_lag": 2.0}),
        (0.5, 3.6, 0.0, {"plant_gain": 2.2}),
        (0.8, 2.0, 0.0, {"plant_lag": 3.0}),
    ],
)
def test_matrix_of_a_wrong_observer_is_the_loop(gain: float, delay: float, lag: float, plant: dict[str, float]) -> None:
    radius = float(np.abs(np.linalg.eigvals(observer_matrix(gain, delay, lag=lag, **plant))).max())
    found = observer_radius(
        gain,
        delay,
        lag,
        plant_delay=plant.get("plant_delay", delay),
        plant_lag=plant.get("plant_lag", lag),
        factor=plant.get("plant_gain", 1.0),
    )
    assert found == pytest.approx(radius, abs=0.002)


@pytest.mark.parametrize("delay", [0.0, 2.0, 3.4])
def test_right_observer_leaves_the_loop_without_delay(delay: float) -> None:
    """The poles are that of the loop, 1 - K, that of the estimate, which the noise alone determines, and 0.

    The scalar Riccati equation p = p / (p + 1) + q has the solution p = (q + sqrt(q^2 + 4 q)) / 2.
    """
    q = 0.3**2
    prior = 0.5 * (q + math.sqrt(q**2 + 4.0 * q))
    poles = np.sort(np.abs(np.linalg.eigvals(observer_matrix(0.6, delay, noise_ratio=0.3))))[::-1]
    expected = sorted((0.4, 1.0 - prior / (prior + 1.0)), reverse=True)
    assert poles[:2] == pytest.approx(expected, abs=1e-9)
    assert (poles[2:] < 0.02).all()  # multiple poles at 0 are computed with a large error


def test_tolerance_of_an_observer_is_where_the_matrix_leaves_the_circle() -> None:
    found = observer_tolerance(1.5, 4.0)
    cases = [
        ("plant_delay", 4.0, 4.0 - found.shorter),
        ("plant_delay", 4.0, 4.0 + found.longer),
        ("plant_lag", 0.0, found.lag),
        ("plant_gain", 1.0, found.plant_gain),
    ]
    for name, right, limit in cases:
        inside, outside = (observer_matrix(1.5, 4.0, **{name: right + f * (limit - right)}) for f in (0.999, 1.001))
        assert np.abs(np.linalg.eigvals(inside)).max() < 1.0 < np.abs(np.linalg.eigvals(outside)).max()
    assert observer_tolerance(0.2, 4.0).longer > found.longer


def test_observer_that_trusts_the_measurements_alone_is_the_predictor() -> None:
    found, predictor = observer_tolerance(0.8, 4.0, noise_ratio=1e4), predictor_tolerance(0.8, 4.0)
    assert (found.shorter, found.longer) == pytest.approx((predictor.shorter, predictor.longer), abs=1e-4)
    assert found.plant_gain == pytest.approx(predictor.plant_gain, abs=1e-4)
    assert found.longer < observer_tolerance(0.8, 4.0).longer < observer_tolerance(0.8, 4.0, noise_ratio=0.3).longer


@pytest.mark.parametrize(("delay", "gain"), [(10.0, 1.5), (10.0, 0.5), (20.0, 1.9), (3.0, 0.6)])
def test_margins_of_an_unstable_loop_are_below_those_of_a_stable_one(delay: float, gain: float) -> None:
    """The phase at the crossover is more than one turn behind for the long delays."""
    assert gain > gain_limit(delay)
    found = margins(PidGains(proportional=gain / PERIOD), delay * PERIOD, PERIOD)
    assert found.phase == pytest.approx(math.pi / 2.0 - (2.0 * delay + 1.0) * math.asin(gain / 2.0), rel=1e-6)
    assert found.phase < 0.0
    assert found.delay < 0.0
    assert found.gain < 1.0


def test_pid_cancels_the_lag() -> None:
    """With the zero of a series PID at the lag, a fast-sampled loop is that of an integrator and a delay."""
    delay, lag, period = 2e-3, 10e-3, 2e-5
    found = margins(simc_gains(delay, lag=lag), delay, period, lag=lag)
    alone = margins(simc_gains(delay), delay, period)
    assert found.gain == pytest.approx(alone.gain, rel=0.02)
    assert found.phase == pytest.approx(alone.phase, rel=0.02)
    # Closed form of the continuous loop: a zero at the integral time, two integrators and the delay.
    gains = simc_gains(delay)
    angle = 2.0 * math.pi * alone.crossover
    expected = math.atan(gains.integral * angle) - delay * angle
    assert alone.phase == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("delay", [2.0, 2.3])
def test_open_loop_with_a_lag_is_the_simulated_plant(delay: float) -> None:
    """Response of a plant to a commanded sine, by its gain and phase at the frames."""
    lag, angle, frames = 2.5 * PERIOD, 0.37, 400
    plant = SimulatedPlant((Axis(lag=lag), Axis(), Axis()), history=1000)
    for k in range(frames):
        plant.command(k * PERIOD, np.array([math.cos(angle * k), 0.0, 0.0]))
    k = np.arange(100, frames)
    seen = plant.pose((k - delay) * PERIOD)[:, 0]
    basis = np.column_stack([np.cos(angle * k), -np.sin(angle * k), np.ones(len(k))])
    real, imaginary, _ = np.linalg.lstsq(basis, seen, rcond=None)[0]
    found = open_loop(PidGains(proportional=1.0), delay * PERIOD, PERIOD, np.exp(1j * angle), lag=lag)
    assert complex(real, imaginary) == pytest.approx(complex(found), rel=1e-5)
    small = open_loop(PidGains(proportional=1.0), delay * PERIOD, PERIOD, np.exp(1j * angle), lag=1e-9)
    none = open_loop(PidGains(proportional=1.0), delay * PERIOD, PERIOD, np.exp(1j * angle))
    assert complex(small) == pytest.approx(complex(none), rel=1e-5)


def test_controller_is_in_series_form() -> None:
    """A constant error 1 that grows by 1 /s: 1 (1 + 1), and its integral over 0.1 s with the time constant 1 s."""
    controller = PidController(PidGains(proportional=1.0, integral=1.0, derivative=1.0))
    assert controller(np.ones(3), np.ones(3), 0.1) == pytest.approx(2.2)
