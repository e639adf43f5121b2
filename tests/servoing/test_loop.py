"""Servo loop on a simulated plant: limits of the gain, predictors, and the same code on the wall clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains, SmithPredictor
from gpuvision.servoing.delay import gain_limit, non_oscillating_gain
from gpuvision.servoing.delay_response import root_locus, step_response
from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import LoopRecord, ServoLoop, SimulatedClock, WallClock
from gpuvision.servoing.observer import LatestPose, MotionModel, Observer, PoseObserver
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PERIOD = 1e-3
STEP = np.array([1e-3, 0.0, 0.0])
DELAYS = (0, 2, 6, 2.25)
MORE_DELAYS = (1, 3, 4, 5, 0.3, 1.5, 4.7)


def run(
    delay: float,
    gain: float,
    frames: int,
    *,
    observer: Observer | None = None,
    plant: SimulatedPlant | None = None,
    limits: LoopLimits | None = None,
    noisy: bool = False,
) -> tuple[LoopRecord, np.ndarray]:
    """Return the record, and the true error of x at each frame as a fraction of the step."""
    plant = plant or SimulatedPlant()
    seeing = observer or LatestPose()
    seeing.reset(-1.0, np.zeros(3), 1e-12 * np.eye(3))
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=delay * PERIOD, is_noisy=noisy)
    controller = PidController(PidGains(proportional=gain / PERIOD))
    loop = ServoLoop(plant, sensor, seeing, controller, SimulatedClock(), period=PERIOD, limits=limits)
    record = loop.run(STEP, frames * PERIOD)
    return record, 1.0 - plant.pose(record.time)[:, 0] / STEP[0]


def growth(errors: np.ndarray) -> float:
    """Return the factor of the error's envelope from frame to frame, by its largest values in two windows."""
    half = len(errors) // 2
    quarter = half // 2
    early, late = np.abs(errors[half : half + quarter]).max(), np.abs(errors[-quarter:]).max()
    return float((late / early) ** (1.0 / (len(errors) - quarter - half)))


@pytest.mark.parametrize("delay", [*DELAYS, *(pytest.param(each, marks=pytest.mark.slow) for each in MORE_DELAYS)])
def test_simulated_loop_is_unstable_from_the_limit_on(delay: float) -> None:
    """1 % below the limit the error decays, 1 % above it grows; the factor is that of the slowest root."""
    for factor in (0.99, 1.01):
        gain = factor * gain_limit(delay)
        found, root = growth(run(delay, gain, 400)[1]), float(np.abs(root_locus(delay, gain)).max())
        assert (found > 1.0) == (factor > 1.0)
        assert found == pytest.approx(root, abs=0.1 * abs(root - 1.0) + 2e-4)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.25, 6.0])
def test_simulated_loop_has_the_step_response(delay: float) -> None:
    gain = non_oscillating_gain(delay)
    assert run(delay, gain, 60)[1] == pytest.approx(step_response(delay, gain, 60), abs=1e-9)


def predictors(delay: float) -> list[Observer]:
    model = MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(1e-9, 1e-9, 1e-9))
    return [PoseObserver(model, gate=1e9), SmithPredictor(delay * PERIOD)]


@pytest.mark.parametrize("delay", [1.0, 3.5, 6.0])
def test_predictors_regain_the_loop_without_delay(delay: float) -> None:
    """With an exact model the error is (1 - gain)^k, beyond the limit of the plain loop, too."""
    gain = 0.8
    assert gain > gain_limit(delay) or delay == 1.0
    for observer in predictors(delay):
        errors = run(delay, gain, 25, observer=observer)[1]
        assert errors == pytest.approx((1.0 - gain) ** np.arange(25), abs=1e-9)


def test_observer_with_the_lag_of_the_plant_regains_the_loop_without_delay() -> None:
    """With a lag the reference is the same loop with a camera without delay."""
    axis = Axis(lag=2e-3)
    model = MotionModel(lag=(2e-3,) * 3, acceleration_noise=(1e-2,) * 3)
    reference, found = (
        run(delay, 0.1, 60, observer=PoseObserver(model, gate=1e9), plant=SimulatedPlant((axis, Axis(), Axis())))[1]
        for delay in (0.0, 4.0)
    )
    assert found == pytest.approx(reference, abs=1e-6)
    assert abs(found[-1]) < 0.01


def test_target_that_moves_is_followed_with_feed_forward() -> None:
    speed = np.array([0.02, -0.01, 0.1])

    def error(feed_forward: float) -> np.ndarray:
        plant = SimulatedPlant()
        observer = predictors(3.0)[0]
        observer.reset(-1.0, np.zeros(3), 1e-12 * np.eye(3))
        sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=3e-3, is_noisy=False)
        controller = PidController(PidGains(proportional=0.3 / PERIOD), feed_forward=feed_forward)
        loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD)
        record = loop.run(lambda time: (time * speed, speed), 0.1)
        return record.target[-1] - plant.pose(record.time[-1])

    assert error(1.0) == pytest.approx(np.zeros(3), abs=1e-9)
    assert error(0.0) == pytest.approx(speed * PERIOD / 0.3, rel=1e-6)


def test_noise_of_the_estimate_is_predicted() -> None:
    """The recorded sigma is that of the error of the estimate, over 400 frames of a resting head."""
    model = MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(1e-10, 1e-10, 1e-10))
    plant = SimulatedPlant()
    observer = PoseObserver(model)
    observer.reset(-1.0, np.zeros(3), 1e-12 * np.eye(3))
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=2e-3, seed=4)
    loop = ServoLoop(
        plant, sensor, observer, PidController(PidGains(proportional=100.0)), SimulatedClock(), period=PERIOD
    )
    record = loop.run(np.zeros(3), 0.5)
    ratio = (record.pose - plant.pose(record.time))[100:] / record.sigma[100:]
    # The model expects a random walk that this head does not do: the sigma is an upper bound, by less than 2.
    assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.05
    assert record.outcome is Outcome.TIME_OVER
    assert len(record.measurements) == 500


def test_wall_clock_runs_the_same_loop() -> None:
    plant = SimulatedPlant()
    observer = predictors(1.0)[0]
    clock = WallClock()
    start = clock.now()
    observer.reset(-1.0, np.zeros(3), 1e-12 * np.eye(3))
    sensor = SimulatedPoseSensor(plant.pose, period=5e-3, delay=5e-3)
    loop = ServoLoop(plant, sensor, observer, PidController(PidGains(proportional=60.0)), clock, period=5e-3)
    record = loop.run(STEP, 0.25)
    assert clock.now() - start >= 0.245
    assert np.all(np.diff(record.time) > 0.0)
    assert np.all(record.computing > 0.0)
    if record.outcome is Outcome.TIME_OVER:  # a busy machine may miss ten frames in a row
        assert abs(record.pose[-1, 0] - STEP[0]) < 2e-5
    assert len(record.time) + record.missed == pytest.approx(50, abs=2)


def test_loop_needs_a_frame_time() -> None:
    with pytest.raises(ValueError, match="period is 0"):
        ServoLoop(None, None, None, None, None, period=0.0)
    assert math.isinf(LoopLimits().encoder_error[0])


def test_runs_of_a_loop_do_not_depend_on_earlier_runs() -> None:
    """The second run from the target starts without integral part, and the observer knows that the head was stopped."""
    plant, observer = SimulatedPlant(), predictors(2.0)[0]
    observer.reset(-1.0, np.zeros(3), 1e-12 * np.eye(3))
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=2e-3, is_noisy=False)
    controller = PidController(PidGains(proportional=10.0, integral=0.1))
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=None)
    first = loop.run(STEP, 0.02)
    later = loop.clock.now() + 0.05
    assert first.command[-1, 0] > 1e-3
    assert observer.estimate(later).pose == pytest.approx(plant.pose(later), abs=1e-6)
    second = loop.run(plant.pose(later), 2e-3)
    assert second.command == pytest.approx(np.zeros((2, 3)), abs=1e-4)
