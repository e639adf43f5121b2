"""Frames of the servo loop with scripted parts: what each part is told, and when, at late frames and at each limit."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import PlantReading, ServoLoop, SimulatedClock, WallClock
from gpuvision.servoing.observer import MotionEstimate, PoseMeasurement, Verdict

PERIOD, START = 0.25, 2.0
POSE, SPEED = np.array([0.5, -0.25, -3.0]), np.array([0.125, 0.0, -0.5])
VARIANCES = np.array([0.01, 0.04, 0.0009])
WANTED = np.array([8.0, -6.0, 3.0])
AT_REST = np.zeros(3, np.int8)


def measured(exposed: float, pose: Any = POSE, variances: Any = (0.0, 0.0, 0.0)) -> PoseMeasurement:
    return PoseMeasurement(exposed, exposed, np.array(pose, np.float64), np.diag(variances), 0)


def away(x: float, y: float, theta: float) -> np.ndarray:
    """Return a target at a distance from the estimated pose."""
    return np.asarray(POSE + np.array([x, y, theta]))


class Script:
    """All parts of a loop in one: a clock that is late, a plant that integrates its commands, and lists of calls."""

    def __init__(self, **given: Any) -> None:
        self.time = START
        self.late: dict[int, float] = given.pop("late", {})
        self.seen: dict[int, list[tuple[PoseMeasurement, Verdict]]] = given.pop("seen", {})
        self.wanted: Any = given.pop("wanted", lambda frame: WANTED)
        self.watchdog: float = given.pop("watchdog", math.inf)
        self.at_limit: Any = given.pop("at_limit", AT_REST)
        self.computing: float = given.pop("computing", 0.0)
        assert not given
        self.frame = -1
        self.moved, self.last = np.array([7.0, 8.0, 9.0]), (START, np.zeros(3))
        self.calls: dict[str, list[Any]] = {
            name: [] for name in ("wait", "plant", "observer", "control", "applied", "reset", "added")
        }

    def loop(self, limits: LoopLimits | None) -> ServoLoop:
        calls = self.calls
        plant: Any = SimpleNamespace(command=self._command, read=self._read)
        observer: Any = SimpleNamespace(
            add=self._add,
            estimate=lambda time: MotionEstimate(time, POSE, SPEED, np.diag(VARIANCES)),
            command=lambda time, velocity: calls["observer"].append((time, *velocity)),
            predicted_pose="predicted",
        )

        clock: Any = SimpleNamespace(now=lambda: self.time, wait_until=self._wait)
        return ServoLoop(plant, self._sense, observer, _Control(self), clock, period=PERIOD, limits=limits)

    def _wait(self, until: float) -> float:
        self.frame += 1
        self.calls["wait"].append(until)
        self.time = max(self.time, until) + self.late.get(self.frame, 0.0)
        return self.time

    def _sense(self, time: float, predicted: Any) -> list[PoseMeasurement]:
        assert (time, predicted) == (self.time, "predicted")
        return [measurement for measurement, _ in self.seen.get(self.frame, [])]

    def _add(self, measurement: PoseMeasurement) -> Verdict:
        self.calls["added"].append(measurement.exposed)
        return next(verdict for each, verdict in self.seen[self.frame] if each is measurement)

    def _command(self, time: float, velocity: np.ndarray) -> None:
        self._move(time)
        self.last = time, velocity
        self.calls["plant"].append((time, *velocity))
        self.time += self.computing

    def _move(self, time: float) -> None:
        start, velocity = self.last
        self.moved = self.moved + velocity * min(time - start, self.watchdog)
        self.last = time, velocity * (time - start < self.watchdog)

    def _read(self, time: float) -> PlantReading:
        self._move(time)
        return PlantReading(time, self.moved, self.at_limit)


class _Control:
    """Controller of a script."""

    def __init__(self, script: Script) -> None:
        self.script = script

    def __call__(self, error: np.ndarray, rate: np.ndarray, elapsed: float, speed: np.ndarray) -> np.ndarray:
        self.script.calls["control"].append((error, rate, elapsed, speed))
        return np.asarray(self.script.wanted(self.script.frame))

    def applied(self, velocity: np.ndarray) -> None:
        self.script.calls["applied"].append(velocity)

    def reset(self) -> None:
        self.script.calls["reset"].append(self.script.frame)


def test_late_frames_are_left_out() -> None:
    """The second of 5 frames begins 0.6 s late: the next two are missed; then a frame is late by less than a frame."""
    script = Script(late={1: 0.6, 2: 0.2}, computing=0.0625)
    velocity = np.array([0.5, 1.0, -0.25])
    record = script.loop(None).run(lambda time: (np.array([1.0, 2.0, 3.0]) + time * velocity, velocity), 5 * PERIOD)
    times = np.array([2.0, 2.85, 3.2])
    assert script.calls["wait"] == [2.0, 2.25, 3.0, 3.25]
    assert script.calls["reset"] == [-1]
    np.testing.assert_allclose(record.time, times)
    assert (record.outcome, record.missed, record.glitches) == (Outcome.TIME_OVER, 2, 0)
    np.testing.assert_allclose(record.computing, 0.0625)
    target = np.array([1.0, 2.0, 3.0]) + times[:, None] * velocity
    np.testing.assert_allclose(record.target, target)
    np.testing.assert_array_equal(record.pose, [POSE] * 3)
    np.testing.assert_array_equal(record.velocity, [SPEED] * 3)
    np.testing.assert_allclose(record.sigma, [[0.1, 0.2, 0.03]] * 3)
    np.testing.assert_array_equal(record.command, [WANTED] * 3)
    for row, (error, rate, elapsed, speed) in enumerate(script.calls["control"]):
        np.testing.assert_allclose(error, target[row] - POSE - (0.0, 0.0, 2.0 * math.pi))  # to the nearer side
        np.testing.assert_array_equal(rate, velocity - SPEED)
        assert elapsed == (0.25, 0.75, 0.25)[row]
        np.testing.assert_array_equal(speed, velocity)
    sent = [(time, *WANTED) for time in record.time]
    stop = (3.2625, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(script.calls["plant"], [*sent, stop])
    np.testing.assert_allclose(script.calls["observer"], [*sent, stop])
    np.testing.assert_array_equal(script.calls["applied"], [WANTED] * 3)
    moved = np.array([7.0, 8.0, 9.0]) + np.array([0.0, 0.85, 1.2])[:, None] * WANTED
    np.testing.assert_allclose(record.encoder, moved)


@pytest.mark.parametrize(
    ("duration", "frames"),
    [(0.75, 3), (0.75 + 1e-10, 3), (0.75 + 1e-9, 4), (0.76, 4), (0.74, 3), (0.25, 1), (1e-12, 1)],
)
def test_duration_is_whole_frames(duration: float, frames: int) -> None:
    script = Script()
    record = script.loop(None).run((1.0, 2.0, 3.0), duration)
    assert len(record.time) == frames
    assert script.calls["wait"][-1] == START + frames * PERIOD
    np.testing.assert_array_equal(record.target, [(1.0, 2.0, 3.0)] * frames)


def test_measurements_of_another_clock_are_refused() -> None:
    """A measurement is exposed before its frame, or at the same time to 1 ns."""
    poses = [measured(START + each) for each in (-5.0, 0.0, 0.9e-9, 1e-9, 1.2e-9, 1.0)]
    script = Script(seen={0: [(each, Verdict.GATED) for each in poses]})
    record = script.loop(None).run(POSE, PERIOD)
    assert [each for each, _ in record.measurements] == poses
    assert [verdict for _, verdict in record.measurements] == [Verdict.GATED] * 4 + [Verdict.REFUSED] * 2
    assert script.calls["added"] == [each.exposed for each in poses[:4]]


def test_head_moves_between_the_first_trusted_pose_and_the_hold() -> None:
    """Age of the pose at frames 2 to 7: 0.125 s to 1.375 s; hold after 0.625 s, abort after 1.125 s."""
    seen = {
        1: [(measured(START + 0.125), Verdict.GATED)],
        2: [(measured(START + 0.375), Verdict.ACCEPTED)],
    }
    script = Script(seen=seen)
    record = script.loop(LoopLimits(hold_after=0.625, abort_after=1.125)).run(away(99.0, -99.0, 2.5), 5.0)
    assert record.outcome is Outcome.LOST
    np.testing.assert_array_equal(record.time, START + np.arange(8) * PERIOD)
    moves = np.array([False, False, True, True, True, False, False, False])
    np.testing.assert_allclose(record.command[:, :2], moves[:, None] * WANTED[:2])
    assert len(script.calls["plant"]) == 8  # without a command in the last frame; then the stop
    np.testing.assert_array_equal(script.calls["plant"][-1], (START + 1.75, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(script.calls["applied"], record.command[:-1])


def test_age_without_a_pose_counts_from_the_start() -> None:
    script = Script()
    record = script.loop(LoopLimits(hold_after=0.1, abort_after=0.5)).run(POSE, 5.0)
    assert (record.outcome, len(record.time)) == (Outcome.LOST, 4)
    assert not record.command.any()
    record = Script().loop(None).run(POSE, 5.0)
    assert (record.outcome, len(record.time)) == (Outcome.TIME_OVER, 20)
    np.testing.assert_array_equal(record.command, [WANTED] * 20)


def test_travel_is_bounded_with_margin_overshoot_and_lag() -> None:
    """Two frames by hand: the bound for the target at the next frame, less the motion since the exposure."""
    limits = LoopLimits(
        hold_after=9.0, abort_after=9.0, margin_sigmas=2.0, overshoot=(0.1, 0.2, 0.3), lag=(0.5, 0.25, 0.0)
    )
    first, second = measured(START, POSE, VARIANCES), measured(START + 0.125, POSE + 0.01, VARIANCES / 4.0)
    seen = {0: [(first, Verdict.ACCEPTED)], 1: [(second, Verdict.ACCEPTED)]}
    script = Script(seen=seen, wanted=lambda _: np.ones(3) * 1e3)
    velocity = np.array([2.0, 3.0, 0.5])
    record = script.loop(limits).run(lambda time: (POSE + 1.0 + (time - START) * velocity, velocity), 2 * PERIOD)
    sigma = np.array([0.1, 0.2, 0.03])
    bound = 1.0 + PERIOD * velocity + 2.0 * sigma + (0.1, 0.2, 0.3)
    np.testing.assert_allclose(record.command[0], bound / PERIOD)
    speed = record.command[0] * (1.0 - np.exp([-0.125 / 0.5, -0.125 / 0.25, -np.inf]))
    travelled = record.command[0] * 0.125 + np.array([0.5, 0.25, 0.0]) * speed
    bound = 0.99 + 2 * PERIOD * velocity + sigma + (0.1, 0.2, 0.3)
    np.testing.assert_allclose(record.command[1], np.maximum(bound - travelled, 0.0) / PERIOD)
    assert record.command[1].any()


@pytest.mark.parametrize("watchdog", [math.inf, 0.25 - 5e-10, 0.3, 0.125])
def test_watchdog_stops_the_head_for_observer_and_encoders(watchdog: float) -> None:
    """The plant stops itself; the loop knows it, and the encoders agree with the commands that were effective."""
    velocities = np.random.default_rng(3).uniform(-1.0, 1.0, (9, 3))
    script = Script(
        late={2: 0.55},
        wanted=lambda frame: velocities[frame],
        watchdog=watchdog,
        seen={0: [(measured(START), Verdict.ACCEPTED)]},
    )
    limits = LoopLimits(
        hold_after=99.0, abort_after=99.0, watchdog=watchdog, encoder_error=(1e-8, 1e-8, 1e-8), margin_sigmas=0.0
    )
    record = script.loop(limits).run(away(99.0, -99.0, 3.0), 5 * PERIOD)
    np.testing.assert_allclose(record.time - START, [0.0, 0.25, 1.05])
    assert record.missed == 2
    assert record.glitches == 0
    expected: list[float] = []
    for time, until in ((0.0, 0.25), (0.25, 1.05), (1.05, 1.25)):
        expected += [time] + ([time + watchdog] if until > time + watchdog + 1e-9 else [])
    observed = np.array(script.calls["observer"])
    np.testing.assert_allclose(observed[:, 0] - START, [*expected, 1.25], atol=1e-12)
    sent = np.isin(observed[:, 0], record.time)
    np.testing.assert_array_equal(observed[sent][:, 1:], record.command)
    assert not observed[~sent][:, 1:].any()
    assert len(script.calls["plant"]) == 4  # the loop sends no command for the watchdog


def test_encoders_that_do_not_follow_end_the_loop() -> None:
    """The zero of the encoders is the first reading; the plant stands from frame 2 on."""
    script = Script(seen={0: [(measured(START), Verdict.ACCEPTED)]}, wanted=lambda _: np.array([1.0, 0.0, 0.0]))
    limits = LoopLimits(hold_after=99.0, abort_after=99.0, encoder_error=(0.3, 9.0, 9.0), readings=3)
    loop = script.loop(limits)
    moving = script._read
    loop.plant.read = lambda time: moving(min(time, START + 2 * PERIOD))  # type: ignore[method-assign]
    record = loop.run(away(99.0, 0.0, 0.0), 5.0)
    # Differences at frames 3, 4, 5, 6: 0.25, 0.5, 0.75, 1.0.
    assert (record.outcome, len(record.time), record.glitches) == (Outcome.ENCODER, 7, 3)


@pytest.mark.parametrize(("sign", "outcome"), [(1, Outcome.AT_LIMIT), (-1, Outcome.TIME_OVER)])
def test_an_axis_at_its_limit(sign: int, outcome: Outcome) -> None:
    script = Script(at_limit=np.array([0, sign, 0], np.int8))
    record = script.loop(LoopLimits(hold_after=9.0, abort_after=9.0, readings=4)).run(away(0.0, 0.1, 0.0), 2.0)
    assert (record.outcome, len(record.time)) == (outcome, 4 if sign > 0 else 8)


def test_frames_that_are_late_in_a_row_and_gated_measurements() -> None:
    limits = LoopLimits(hold_after=99.0, abort_after=99.0, missed=3, gated=4)
    script = Script(late={1: 0.3, 2: 0.3, 4: 0.3, 5: 0.3, 6: 0.3})
    record = script.loop(limits).run(POSE, 9.0)
    assert (record.outcome, len(record.time), record.missed) == (Outcome.TOO_SLOW, 7, 5)
    verdicts = [Verdict.GATED] * 3 + [Verdict.ACCEPTED] + [Verdict.GATED, Verdict.TOO_OLD] * 9
    script = Script(seen={k: [(measured(START + k * PERIOD), each)] for k, each in enumerate(verdicts)})
    record = script.loop(limits).run(POSE, 9.0)
    assert (record.outcome, len(record.time)) == (Outcome.INCONSISTENT, 11)


def test_settling_ends_the_loop_unless_a_guard_does() -> None:
    asked: list[tuple[float, np.ndarray, np.ndarray]] = []

    def settling(time: float, error: np.ndarray, covariance: np.ndarray) -> bool:
        asked.append((time, error, covariance))
        return len(asked) == 3

    script = Script()
    record = script.loop(None).run(away(0.1, 0.2, 0.3), 9.0, settling=settling)
    assert (record.outcome, len(record.time)) == (Outcome.ARRIVED, 3)
    assert [each[0] for each in asked] == [2.0, 2.25, 2.5]
    np.testing.assert_allclose([each[1] for each in asked], [(0.1, 0.2, 0.3)] * 3)
    np.testing.assert_array_equal(asked[0][2], np.diag(VARIANCES))
    assert len(script.calls["control"]) == 2
    np.testing.assert_array_equal(record.command[2], np.zeros(3))
    asked.clear()
    record = Script().loop(LoopLimits(hold_after=0.4, abort_after=0.4)).run(POSE, 9.0, settling=settling)
    assert (record.outcome, len(record.time), len(asked)) == (Outcome.LOST, 3, 2)


def test_an_error_stops_the_head() -> None:
    def fail(_: int) -> np.ndarray:
        if script.frame == 2:
            raise RuntimeError("no camera")
        return WANTED

    script = Script(wanted=fail)
    with pytest.raises(RuntimeError, match="no camera"):
        script.loop(None).run(POSE, 9.0)
    for part in ("plant", "observer"):
        np.testing.assert_array_equal(script.calls[part][-1], (START + 0.5, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("limits", [None, LoopLimits(hold_after=9.0, abort_after=9.0)])
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_velocity_that_is_not_finite_stops_the_head(limits: LoopLimits | None, wrong: float) -> None:
    """The guards cut an infinite velocity to their bound; without guards it is refused, as a NaN always is."""
    seen = {0: [(measured(START), Verdict.ACCEPTED)]}
    script = Script(wanted=lambda frame: np.array([wrong, 0.5, 0.0]) if frame == 2 else WANTED, seen=seen)
    loop = script.loop(limits)
    if limits is not None and math.isinf(wrong):
        assert loop.run(POSE, 1.0).outcome is Outcome.TIME_OVER
    else:
        with pytest.raises(ValueError, match=r"velocity at 2\.500000 s is \[\s*(nan|inf)"):
            loop.run(POSE, 9.0)
        np.testing.assert_array_equal(script.calls["plant"][-1], (START + 0.5, 0.0, 0.0, 0.0))
    assert np.isfinite(script.calls["plant"]).all()
    assert np.isfinite(script.calls["observer"]).all()


def test_wrong_arguments_of_a_run_are_refused() -> None:
    loop = Script().loop(None)
    for duration in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="duration "):
            loop.run(POSE, duration)
    with pytest.raises(ValueError, match=r"target has shape \(2,\)"):
        loop.run(POSE[:2], 1.0)
    with pytest.raises(ValueError, match=r"spin is -1e-06"):
        WallClock(spin=-1e-6)
    WallClock(spin=0.0)


def test_clocks_do_not_go_back() -> None:
    clock = SimulatedClock()
    assert [clock.now(), clock.wait_until(2.0), clock.wait_until(1.0), clock.now()] == [0.0, 2.0, 2.0, 2.0]
    wall = WallClock()
    assert wall.wait_until(-1.0) < 0.05
    assert wall.wait_until(0.002) >= 0.002
