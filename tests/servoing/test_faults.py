"""Faults of frames, camera, encoders and axes: the head never moves further than the last trusted error allows.

The loop recovers, or it ends with the reason. Every run measures the true motion of the plant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains, SmithPredictor
from gpuvision.servoing.guard import LoopLimits, Outcome, TravelGuard
from gpuvision.servoing.loop import LoopRecord, PlantReading, ServoLoop, SimulatedClock
from gpuvision.servoing.observer import MotionModel, Observer, PoseMeasurement, PoseObserver, PosePrediction, Verdict
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import Fault, SimulatedPoseSensor

PERIOD, DELAY = 1e-3, 3e-3
TARGET = np.array([1e-3, -4e-4, 2e-3])
COVARIANCE = 1e-12 * np.eye(3)
MODEL = MotionModel(lag=(1e-3,) * 3, acceleration_noise=(1e-3,) * 3, position_noise=(1e-11,) * 3)
LIMITS = LoopLimits(abort_after=0.05, lag=(1e-3,) * 3, encoder_error=(4e-4, 4e-4, 6e-4))
# True motion beyond the bound: 3 sigma margin, and 5 sigma of the last trusted pose.
SLACK = 8e-6


class GlitchingPlant(SimulatedPlant):
    """Plant whose encoders are wrong in some readings."""

    def __init__(self, axes: Sequence[Axis], wrong: Callable[[float], float]) -> None:
        super().__init__(axes)
        self.wrong = wrong

    def read(self, time: float) -> PlantReading:
        reading = super().read(time)
        return reading._replace(position=reading.position + self.wrong(time))


def run(
    fault: Fault | None = None,
    *,
    axes: Sequence[Axis] = (Axis(lag=1e-3),) * 3,
    wrong: Callable[[float], float] = lambda _: 0.0,
    duration: float = 0.2,
    target: np.ndarray = TARGET,
    limits: LoopLimits | None = LIMITS,
    observer: Observer | None = None,
    gain: float = 150.0,
) -> tuple[LoopRecord, SimulatedPlant]:
    plant = GlitchingPlant(axes, wrong)
    seeing = observer or PoseObserver(MODEL)
    seeing.reset(-DELAY, np.zeros(3), COVARIANCE)
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY, covariance=COVARIANCE, fault=fault, seed=2)
    controller = PidController(PidGains(proportional=gain))
    loop = ServoLoop(plant, sensor, seeing, controller, SimulatedClock(), period=PERIOD, limits=limits)
    return loop.run(target, duration), plant


def check_travel(record: LoopRecord, plant: SimulatedPlant, target: np.ndarray = TARGET) -> None:
    """Check the true motion since the last trusted exposure against the error that it had, at each frame."""
    trusted = [m for m, verdict in record.measurements if verdict is Verdict.ACCEPTED]
    for now in record.time:
        seen = [each for each in trusted if each.arrived <= now + 1e-9]
        if seen:
            last = max(seen, key=lambda each: each.exposed)
            start = plant.pose(last.exposed)
            assert np.all(np.abs(plant.pose(now) - start) <= np.abs(target - start) + SLACK)
        else:
            assert np.all(plant.pose(now) == 0.0)


def check_rest(record: LoopRecord, plant: SimulatedPlant) -> None:
    """Check that the head moved at the end and was stopped."""
    assert np.any(record.command[-3:] != 0.0)
    after = plant.pose(record.time[-1] + np.array([0.03, 0.5]))
    assert after[0] == pytest.approx(after[1], abs=1e-12)


def dropped(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    return [seen] if frame % 3 == 0 else []


def late(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    return [seen._replace(arrived=seen.arrived + 6e-3)] if frame % 4 == 1 else [seen]


def repeated(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    return [seen, seen, seen._replace(arrived=seen.arrived + 2e-3)]


def out_of_order(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    return [seen._replace(arrived=seen.arrived + 1e-3 * (5 - frame % 6))]


def longer_delay(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    return [seen if frame < 8 else seen._replace(arrived=seen.arrived + 5e-3)]


def refused_20(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    nan = np.full(3, np.nan)
    return [seen._replace(pose=nan, covariance=np.full((3, 3), np.nan), status=1) if 8 <= frame < 28 else seen]


def glare(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
    """Return a wrong match far away in every fifth frame."""
    return [seen._replace(pose=seen.pose + 5e-4) if frame % 5 == 2 else seen]


@pytest.mark.parametrize("fault", [None, dropped, late, repeated, out_of_order, longer_delay, refused_20, glare])
def test_loop_recovers_from_faults_of_frames(fault: Fault | None) -> None:
    record, plant = run(fault)
    assert record.outcome is Outcome.TIME_OVER
    check_travel(record, plant)
    assert np.abs(plant.pose(record.time[-1]) - TARGET) == pytest.approx(np.zeros(3), abs=3e-6)
    verdicts = [verdict for _, verdict in record.measurements]
    expected = {repeated: Verdict.DUPLICATE, refused_20: Verdict.REFUSED, glare: Verdict.GATED}
    assert fault not in expected or expected[fault] in verdicts


def test_head_stands_while_the_poses_are_refused() -> None:
    record, _ = run(refused_20)
    blind = (record.time > 0.008 + LIMITS.hold_after) & (record.time < 0.027)
    assert np.count_nonzero(blind) > 5
    assert np.all(record.command[blind] == 0.0)
    assert np.any(record.command[record.time > 0.03] != 0.0)


@pytest.mark.parametrize(
    ("last", "expected"), [(10, Outcome.LOST), (-1, Outcome.LOST)], ids=["after ten frames", "from the start"]
)
def test_camera_that_stays_blind_ends_the_loop(last: int, expected: Outcome) -> None:
    record, plant = run(lambda frame, seen: [seen] if frame <= last else [])
    assert record.outcome is expected
    check_travel(record, plant)
    assert record.time[-1] == pytest.approx(max(last * PERIOD - DELAY, 0.0) + LIMITS.abort_after, abs=2.1e-3)


def test_wrong_match_that_stays_ends_the_loop() -> None:
    record, plant = run(lambda frame, seen: [seen._replace(pose=seen.pose + 5e-4) if frame > 5 else seen])
    assert record.outcome is Outcome.INCONSISTENT
    check_travel(record, plant)


def test_delay_that_the_time_stamps_hide_does_not_carry_the_head_away() -> None:
    """From frame 8 on the poses are 10 ms older than their stamps say."""

    def hidden(plant: list[SimulatedPlant]) -> Fault:
        return lambda frame, seen: [
            seen if frame < 8 else seen._replace(pose=plant[0].pose(seen.exposed - 10e-3), covariance=COVARIANCE)
        ]

    plants: list[SimulatedPlant] = []
    plant = SimulatedPlant((Axis(lag=1e-3),) * 3)
    plants.append(plant)
    observer = PoseObserver(MODEL)
    observer.reset(-DELAY, np.zeros(3), COVARIANCE)
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY, fault=hidden(plants))
    controller = PidController(PidGains(proportional=150.0))
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=LIMITS)
    record = loop.run(TARGET, 0.3)
    assert record.outcome in (Outcome.INCONSISTENT, Outcome.TIME_OVER)
    # The error is seen 10 ms too large at most: the head passes the target by less than this motion.
    past = (plant.pose(record.time) - TARGET) * np.sign(TARGET)
    assert np.all(past <= 10e-3 * np.abs(record.command).max(axis=0))


def test_encoder_glitch_is_ignored_and_counted() -> None:
    record, plant = run(wrong=lambda time: 1e-3 if 0.0095 < time < 0.0125 else 0.0)
    assert record.outcome is Outcome.TIME_OVER
    assert record.glitches == 3
    check_travel(record, plant)
    assert plant.pose(0.2) == pytest.approx(TARGET, abs=3e-6)


def test_encoder_that_stays_wrong_ends_the_loop() -> None:
    record, plant = run(wrong=lambda time: 1e-3 if time > 0.0095 else 0.0)
    assert record.outcome is Outcome.ENCODER
    assert record.time[-1] == pytest.approx(0.014)
    check_travel(record, plant)
    check_rest(record, plant)


def test_head_stops_when_the_time_is_over_and_when_the_camera_fails() -> None:
    record, plant = run(duration=0.006)
    assert record.outcome is Outcome.TIME_OVER
    assert record.command[-1, 0] > 0.0
    check_rest(record, plant)

    class Broken(SimulatedPoseSensor):
        def __call__(self, time: float, predicted: PosePrediction | None = None) -> list[PoseMeasurement]:
            if time > 5e-3:
                raise OSError("no camera")
            return super().__call__(time, predicted)

    observer = PoseObserver(MODEL)
    observer.reset(-DELAY, np.zeros(3), COVARIANCE)
    plant = SimulatedPlant()
    broken = Broken(plant.pose, period=PERIOD, delay=DELAY)
    loop = ServoLoop(
        plant, broken, observer, PidController(PidGains(proportional=150.0)), SimulatedClock(), period=PERIOD
    )
    with pytest.raises(OSError, match="no camera"):
        loop.run(TARGET, 0.2)
    after = plant.pose([0.0061, 0.5])
    assert after[0, 0] > 1e-4
    assert np.array_equal(after[0], after[1])


def test_a_target_that_is_not_a_number_stops_the_head() -> None:
    """The plant gets finite velocities only, and the head rests at its place."""

    class Checked(SimulatedPlant):
        def command(self, time: float, velocity: np.ndarray) -> None:
            assert np.isfinite(velocity).all()
            super().command(time, velocity)

    observer = PoseObserver(MODEL)
    observer.reset(-DELAY, np.zeros(3), COVARIANCE)
    plant = Checked()
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY, covariance=COVARIANCE)
    controller = PidController(PidGains(proportional=150.0))
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=LIMITS)
    with pytest.raises(ValueError, match="finite numbers from the controller"):
        loop.run(lambda time: (TARGET if time < 6e-3 else np.array([np.nan, 0.0, 0.0]), np.zeros(3)), 0.2)
    after = plant.pose([0.0065, 0.5])
    assert after[0, 0] > 1e-4
    assert np.array_equal(after[0], after[1])


def test_blocked_axis_ends_the_loop() -> None:
    """Friction that the drive does not overcome: the camera sees no motion, nor does the encoder."""
    stuck = Axis(lag=1e-3, coulomb=1e9)
    record, plant = run(axes=(stuck, Axis(lag=1e-3), Axis(lag=1e-3)))
    assert record.outcome in (Outcome.ENCODER, Outcome.INCONSISTENT)
    check_travel(record, plant)
    assert plant.pose(0.5)[0] == 0.0


def test_axis_at_its_limit_ends_the_loop() -> None:
    stop = Axis(lag=1e-3, upper=5e-4)
    generous = LoopLimits(gated=10_000, lag=(1e-3,) * 3)
    record, plant = run(axes=(stop, Axis(lag=1e-3), Axis(lag=1e-3)), limits=generous)
    assert record.outcome is Outcome.AT_LIMIT
    check_travel(record, plant)
    assert plant.pose(record.time[-1])[0] == 5e-4


def test_slow_loop_ends() -> None:
    class Slow(SimulatedClock):
        def wait_until(self, time: float) -> float:
            return super().wait_until(max(time, self.now() + 2.5 * PERIOD))

    plant = SimulatedPlant()
    observer = PoseObserver(MODEL)
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY)
    loop = ServoLoop(plant, sensor, observer, PidController(PidGains(proportional=50.0)), Slow(), period=PERIOD)
    record = loop.run(TARGET, 1.0)
    assert record.outcome is Outcome.TOO_SLOW
    assert record.missed >= 10


def test_wrong_predictor_does_not_carry_the_head_away() -> None:
    """A predictor without delay leaves the loop unstable; the guard bounds the motion."""
    free, plant = run(observer=SmithPredictor(0.0), limits=None, gain=500.0)
    assert np.abs(plant.pose(free.time[-1])).max() > 10.0 * np.abs(TARGET).max()
    record, plant = run(observer=SmithPredictor(0.0), limits=LoopLimits(lag=(1e-3,) * 3), gain=500.0)
    check_travel(record, plant)
    assert np.abs(plant.pose(record.time)).max() < 2.0 * np.abs(TARGET).max()
    assert record.outcome is Outcome.TIME_OVER


def test_guard_bounds_the_motion_after_the_exposure() -> None:
    guard = TravelGuard(3.0)
    assert guard.limit(0.0, np.ones(3), np.ones(3), 1e-3).tolist() == [0.0, 0.0, 0.0]
    guard.trust(PoseMeasurement(0.0, 1e-3, np.zeros(3), COVARIANCE, 0))
    target = np.array([1e-3, -1e-3, 0.0])
    first = guard.limit(1e-3, np.array([0.6, -5.0, 1.0]), target, 1e-3)
    assert first == pytest.approx([0.6, -1.003, 3e-3])
    second = guard.limit(2e-3, np.array([0.6, -5.0, -1.0]), target, 1e-3)
    assert second == pytest.approx([0.403, 0.0, -6e-3], abs=1e-12)
    assert guard.limit(3e-3, np.array([-0.1, 0.1, 0.0]), target, 1e-3) == pytest.approx([-0.1, 0.1, 0.0])


def test_glitch_of_the_first_reading_is_ignored() -> None:
    """A wrong first reading does not become the zero of the encoders."""
    record, plant = run(wrong=lambda time: 1e-3 if time == 0.0 else 0.0)
    assert record.outcome is Outcome.TIME_OVER
    assert record.glitches == 1
    check_travel(record, plant)


def test_times_ahead_of_the_loop_are_refused() -> None:
    """A sensor that answers with times of another clock."""
    plant, observer = SimulatedPlant(), PoseObserver(MODEL)
    observer.reset(-DELAY, np.zeros(3), COVARIANCE)
    controller = PidController(PidGains(proportional=50.0))

    def sensor(time: float, _predicted: PosePrediction) -> list[PoseMeasurement]:
        return [PoseMeasurement(time + 5e4, time + 5e4 + DELAY, np.zeros(3), COVARIANCE, 0)]

    record = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD).run(TARGET, 1.0)
    assert record.outcome is Outcome.LOST
    assert {verdict for _, verdict in record.measurements} == {Verdict.REFUSED}
    assert np.all(plant.pose(1.0) == 0.0)


@pytest.mark.parametrize("lag", [0.0, 1e-3])
def test_watchdog_bounds_the_motion_before_a_late_frame(lag: float) -> None:
    """A frame that is 50 ms late, while the head moves fast: it stops, and the loop goes on to the target."""

    class Stalled(SimulatedClock):
        calls = 0

        def wait_until(self, time: float) -> float:
            self.calls += 1
            return super().wait_until(time + 0.05 if self.calls == 7 else time)

    def stalled(watchdog: float) -> tuple[LoopRecord, SimulatedPlant]:
        plant = SimulatedPlant((Axis(lag=lag),) * 3, watchdog=watchdog)
        observer = PoseObserver(MotionModel(lag=(lag,) * 3, position_noise=(1e-11,) * 3))
        observer.reset(-DELAY, np.zeros(3), COVARIANCE)
        sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY, covariance=COVARIANCE)
        controller = PidController(PidGains(proportional=300.0))
        limits = LoopLimits(lag=(lag,) * 3, watchdog=watchdog, encoder_error=(1e-3,) * 3)
        loop = ServoLoop(plant, sensor, observer, controller, Stalled(), period=PERIOD, limits=limits)
        return loop.run(TARGET, 0.15), plant

    record, plant = stalled(PERIOD)
    assert record.missed == 50
    assert record.outcome is Outcome.TIME_OVER
    assert record.glitches == 0
    check_travel(record, plant)
    times = np.arange(0.0, 0.15, 2e-4)
    assert np.all(np.abs(plant.pose(times)) <= np.abs(TARGET) + SLACK)
    assert record.pose[-1] == pytest.approx(TARGET, abs=5e-6)
    assert {verdict for _, verdict in record.measurements} == {Verdict.ACCEPTED}
    free, plant = stalled(np.inf)
    assert free.missed == 50
    assert np.abs(plant.pose(times)).max() > 2.0 * np.abs(TARGET).max()


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan])
def test_watchdog_is_checked(wrong: float) -> None:
    with pytest.raises(ValueError, match="watchdog is"):
        LoopLimits(watchdog=wrong)
    with pytest.raises(ValueError, match="watchdog is"):
        SimulatedPlant(watchdog=wrong)


def test_integral_part_stands_still_while_a_guard_cuts_the_command() -> None:
    """Forty frames without pose, during which the loop holds the head, add no overshoot."""

    def lost(frame: int, seen: PoseMeasurement) -> Sequence[PoseMeasurement]:
        return [] if 5 <= frame < 45 else [seen]

    def overshoot(fault: Fault | None) -> float:
        plant, observer = SimulatedPlant((Axis(lag=1e-3),) * 3), PoseObserver(MODEL)
        observer.reset(-DELAY, np.zeros(3), COVARIANCE)
        sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY, covariance=COVARIANCE, fault=fault, seed=2)
        controller = PidController(PidGains(proportional=100.0, integral=0.05))
        loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=LIMITS)
        record = loop.run(TARGET, 0.3)
        assert record.outcome is Outcome.TIME_OVER
        return float((plant.pose(record.time) / TARGET).max(axis=0).max()) - 1.0

    assert overshoot(lost) < overshoot(None) + 0.01


def test_controller_is_given_the_time_since_its_last_call() -> None:
    """One frame is late by two frames: the integral part grows by three frames."""

    class Late(SimulatedClock):
        def wait_until(self, time: float) -> float:
            return super().wait_until(time + 2.0 * PERIOD if abs(time - 3.0 * PERIOD) < 1e-9 else time)

    periods: list[float] = []

    class Recorder(PidController):
        def __call__(
            self, error: np.ndarray, velocity: np.ndarray, period: float, target_velocity: np.ndarray | None = None
        ) -> np.ndarray:
            periods.append(period)
            return super().__call__(error, velocity, period, target_velocity)

    plant, observer = SimulatedPlant(), PoseObserver(MODEL)
    observer.reset(-DELAY, np.zeros(3), COVARIANCE)
    controller = Recorder(PidGains(proportional=50.0))
    ServoLoop(plant, lambda *_: [], observer, controller, Late(), period=PERIOD).run(TARGET, 8.0 * PERIOD)
    assert periods == pytest.approx([PERIOD] * 3 + [3.0 * PERIOD] + [PERIOD] * 2)
