"""Bound of the commanded motion: against a simulation of the axes in small steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.guard import FaultCounter, LoopLimits, Outcome, TravelGuard
from gpuvision.servoing.observer import PoseMeasurement, Verdict

LAG = np.array([0.0, 0.03, 0.2])
OVERSHOOT = np.array([0.5, 0.25, 0.125])
POSE, TARGET = np.array([1.0, -2.0, 0.1]), np.array([3.0, -3.0, 0.4])
COVARIANCE = np.diag([0.04, 0.09, 0.01])
# Times and commands; None: the plant stops by itself.
EVENTS: list[tuple[float, tuple[float, float, float] | None]] = [
    (0.0, (0.1, -0.2, 0.3)),
    (0.1, (-0.3, 0.4, 0.1)),
    (0.17, None),
    (0.2, (0.2, 0.1, -0.2)),
    (0.3, (0.0, 0.3, 0.2)),
]
HUGE, PERIOD = 1e6, 0.1


def travel(exposed: float, now: float) -> np.ndarray:
    """Return the integral of the commands since the exposure plus the lag times the velocity at the exposure."""
    step = 1e-3
    decay = np.where(LAG > 0.0, np.exp(-step / np.maximum(LAG, step)), 0.0)
    velocity, at_exposure, total = np.zeros(3), np.zeros(3), np.zeros(3)
    for time in np.arange(0.0, now - 0.5 * step, step):
        if abs(time - exposed) < 0.5 * step:
            at_exposure = velocity.copy()
        given = next(value for start, value in reversed(EVENTS) if start <= time + 0.5 * step)
        command = np.zeros(3) if given is None else np.array(given)
        total += step * command * (time > exposed - 0.5 * step)
        velocity = command + (velocity - command) * decay
    return total + LAG * at_exposure


@pytest.mark.parametrize("exposed", [0.05, 0.12, 0.18, 0.25])
def test_bound_of_the_motion(exposed: float) -> None:
    guard = TravelGuard(2.0, LAG, OVERSHOOT)
    np.testing.assert_array_equal(guard.limit(-1.0, np.ones(3), TARGET, PERIOD), np.zeros(3))
    guard.trust(measurement(-0.01, POSE + 100.0))
    for time, velocity in EVENTS:
        if velocity is None:
            guard.stop(time)
        else:
            np.testing.assert_array_equal(guard.limit(time, np.array(velocity), TARGET, PERIOD), velocity)
    guard.trust(measurement(exposed, POSE))
    guard.trust(measurement(exposed - 0.01, POSE + 100.0))
    assert guard.exposed == exposed
    moved = travel(exposed, 0.35)
    # The error of the pose, two of its sigmas, and the overshoot.
    bound = np.array([2.0, 1.0, 0.3]) + 2.0 * np.array([0.2, 0.3, 0.1]) + OVERSHOOT
    cut = guard.limit(0.35, np.full(3, HUGE), TARGET, PERIOD)
    np.testing.assert_allclose(cut, (bound - moved) / PERIOD, rtol=1e-9)


def test_motion_back_is_bounded_too() -> None:
    guard = TravelGuard(0.0)
    guard.trust(measurement(0.0, np.zeros(3)))
    cut = guard.limit(0.0, np.array([-HUGE, HUGE, -0.5]), np.array([2.0, 1.0, -1.0]), 0.5)
    np.testing.assert_allclose(cut, [-4.0, 2.0, -0.5])
    # 2 m back in 0.5 s: nothing is left to that side, and 4 m to the other.
    cut = guard.limit(0.5, np.array([-HUGE, HUGE, HUGE]), np.array([2.0, 1.0, -1.0]), 0.5)
    np.testing.assert_allclose(cut, [0.0, 0.0, 2.5])


def measurement(exposed: float, pose: np.ndarray) -> PoseMeasurement:
    return PoseMeasurement(exposed, exposed, pose, COVARIANCE, 0)


LIMITS = LoopLimits(gated=3, readings=2, missed=4, abort_after=0.2, encoder_error=(1.0, 2.0, 3.0))
NO_LIMIT = np.zeros(3, np.int8)


def test_measurements_beyond_the_gate_are_counted_until_an_accepted_one() -> None:
    faults = FaultCounter(LIMITS)
    for verdict in (Verdict.GATED, Verdict.GATED, Verdict.ACCEPTED, Verdict.GATED, Verdict.REFUSED, Verdict.GATED):
        faults.verdict(verdict)
        assert faults.outcome(0.0) is None
    faults.verdict(Verdict.GATED)
    assert faults.outcome(0.0) is Outcome.INCONSISTENT


def test_late_frames_are_counted_until_one_in_time() -> None:
    faults = FaultCounter(LIMITS)
    for late in (True, True, True, False, True, True, True):
        faults.tick(late)
        assert faults.outcome(0.0) is None
    faults.tick(True)
    assert faults.outcome(0.0) is Outcome.TOO_SLOW


def test_the_loop_is_lost_beyond_the_age() -> None:
    faults = FaultCounter(LIMITS)
    assert faults.outcome(0.2) is None
    assert faults.outcome(0.2001) is Outcome.LOST


@pytest.mark.parametrize(("axis", "error"), [(0, 1.0), (1, 2.0), (2, 3.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_encoders_may_differ_by_the_limit_of_their_axis(axis: int, error: float, sign: float) -> None:
    """The zero is the first reading; the same difference twice in a row ends the loop."""
    faults, zero, away = FaultCounter(LIMITS), np.array([0.5, -0.25, 0.125]), np.eye(3)[axis] * sign
    commanded = np.array([4.0, 5.0, 6.0])
    for factor, glitches in ((0.0, 0), (error, 0), (1.01 * error, 1), (0.0, 1), (1.01 * error, 2)):
        faults.reading(commanded + zero + factor * away, NO_LIMIT, commanded, np.ones(3))
        assert faults.glitches == glitches
        assert faults.outcome(0.0) is None
    faults.reading(commanded + zero + 1.01 * error * away, NO_LIMIT, commanded, np.ones(3))
    assert faults.glitches == 3
    assert faults.outcome(0.0) is Outcome.ENCODER


def test_an_axis_at_its_limit_counts_only_with_a_target_beyond_it() -> None:
    faults = FaultCounter(LIMITS)
    rows = [
        ([0, -1, 0], [1.0, -1.0, 0.0]),
        ([0, -1, 0], [1.0, 1.0, -2.0]),  # the target is on the other side
        ([0, 0, 1], [1.0, -1.0, 0.5]),
        ([1, 0, 0], [0.0, 1.0, 0.5]),  # the target is reached
        ([1, 0, 0], [0.1, -1.0, -0.5]),
    ]
    for at_limit, error in rows:
        faults.reading(np.zeros(3), np.array(at_limit, np.int8), np.zeros(3), np.array(error))
        assert faults.outcome(0.0) is None
    faults.reading(np.zeros(3), np.array([0, -1, 1], np.int8), np.zeros(3), np.array([1.0, -0.1, -1.0]))
    assert faults.outcome(0.0) is Outcome.AT_LIMIT


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hold_after": 0.2, "abort_after": 0.19}, "abort_after is 0.19, expected a number >= 0.2"),
        ({"encoder_error": (1.0, 1.0)}, "encoder_error must be 3 numbers above 0"),
        ({"encoder_error": (1.0, 0.0, 1.0)}, "encoder_error must be 3 numbers above 0"),
    ],
)
def test_limits_that_cannot_work_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LoopLimits(**given)
    LoopLimits(hold_after=0.2, abort_after=0.2, encoder_error=(1e-9, 1e-9, 1e-9))
