"""Controllers and Smith predictor, in closed form on asymmetric errors, commands and lags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.controllers import (
    PidController,
    PidGains,
    SmithPredictor,
    gains_without_oscillation,
    simc_gains,
)
from gpuvision.servoing.observer import PoseMeasurement, Verdict

COVARIANCE = np.diag([1e-12, 4e-12, 9e-12])
POSE = np.array([7.0, -8.0, 0.5])
LAG = np.array([0.0, 2.0, 0.5])


@pytest.mark.parametrize("integral", [math.inf, 1e9])
def test_a_command_is_cut_to_the_limit_of_its_axis(integral: float) -> None:
    controller = PidController(PidGains(proportional=2.0, integral=integral), limit=(1.0, 3.0, 0.5))
    rows = [
        ([5.0, 1.4, -5.0], [1.0, 2.8, -0.5]),
        ([-5.0, -1.6, 0.2], [-1.0, -3.0, 0.4]),
        ([0.5, -1.5, -0.25], [1.0, -3.0, -0.5]),
    ]
    for error, command in rows:
        assert controller(np.array(error), np.zeros(3), 1e-3) == pytest.approx(command, rel=1e-6)


def test_feed_forward_adds_its_part_of_the_velocity_of_the_target() -> None:
    error, speed = np.array([1.0, -2.0, 3.0]), np.array([0.3, 0.5, -0.7])
    for part in (0.0, 0.25, 1.0):
        controller = PidController(PidGains(proportional=2.0), feed_forward=part)
        assert controller(error, speed, 0.1, speed) == pytest.approx(2.0 * error + part * speed)
    assert PidController(PidGains(proportional=2.0))(error, speed, 0.1, speed) == pytest.approx(2.0 * error + speed)


@pytest.mark.parametrize("limit", [(1.0, 1.0), (1.0, 0.0, 1.0), (1.0, -1.0, 1.0), (1.0, math.nan, 1.0)])
def test_limits_of_a_controller_are_checked(limit: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="limit must be 3 numbers above 0"):
        PidController(PidGains(proportional=1.0), limit=limit)


def test_gains_of_the_rules() -> None:
    for found, expected in (
        (simc_gains(3e-3, lag=5e-3, closed_loop=7e-3), (100.0, 0.04, 5e-3)),
        (simc_gains(3e-3), (1.0 / 6e-3, 0.024, 0.0)),
        (simc_gains(3e-3, integral=False), (1.0 / 6e-3, math.inf, 0.0)),
        (gains_without_oscillation(2e-3, 1e-3), (4000.0 / 27.0, math.inf, 0.0)),
    ):
        assert (found.proportional, found.integral, found.derivative) == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"integral is 0\.0, expected a number > 0, or infinity for no integral part"):
        PidGains(proportional=1.0, integral=0.0)


def moved(time: float, plant_gain: float, commands: list[tuple[float, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity (3,) of axes with the lags: each command adds its step response."""
    position, velocity, before = np.zeros(3), np.zeros(3), np.zeros(3)
    for start, command in commands:
        if start <= time:
            step = plant_gain * (command - before)
            decay = np.where(LAG > 0.0, np.exp(-(time - start) / np.where(LAG > 0.0, LAG, 1.0)), 0.0)
            velocity = velocity + step * (1.0 - decay)
            position = position + step * (time - start - LAG * (1.0 - decay))
            before = command
    return position, velocity


def predictor(**given: Any) -> tuple[SmithPredictor, list[tuple[float, np.ndarray]]]:
    """Return a predictor with a delay of 1.7 s after three commands and one pose, and the commands."""
    commands = [
        (0.5, np.array([1.0, -2.0, 3.0])),
        (2.0, np.array([0.5, 1.0, -1.0])),
        (3.1, np.array([-2.0, 0.0, 0.25])),
    ]
    found = SmithPredictor(1.7, lag=LAG, **given)
    found.reset(-math.inf, np.zeros(3), np.eye(3))
    for time, velocity in commands:
        found.command(time, velocity)
    assert found.add(PoseMeasurement(2.4, 3.3, POSE, COVARIANCE, 0)) is Verdict.ACCEPTED
    return found, commands


@pytest.mark.parametrize("plant_gain", [1.0, 1.3])
@pytest.mark.parametrize("time", [3.1, 3.4, 4.75])
def test_estimate_is_the_pose_moved_by_the_step_responses_of_the_last_delay(time: float, plant_gain: float) -> None:
    observer, commands = predictor(plant_gain=plant_gain)
    found = observer.estimate(time)
    (position, velocity), (before, _) = (moved(each, plant_gain, commands) for each in (time, time - 1.7))
    assert found.time == time
    np.testing.assert_allclose(found.pose, POSE + position - before, atol=1e-12)
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-12)
    np.testing.assert_array_equal(found.covariance, COVARIANCE)
    assert observer.exposed == 2.4
    exposed, _ = moved(2.4, plant_gain, commands)
    np.testing.assert_allclose(observer.predicted_pose(time), POSE + position - exposed, atol=1e-12)


def test_motion_before_the_oldest_kept_command_counts_as_none() -> None:
    observer, commands = predictor(history=2)
    for start, end in ((0.0, 2.0), (1.0, 1.9)):
        observer.delay = end - start
        np.testing.assert_array_equal(observer.estimate(end).pose, POSE)
        np.testing.assert_array_equal(observer.estimate(1.9).velocity, np.zeros(3))
    observer.delay = 2.5
    position, start = moved(4.0, 1.0, commands)[0], moved(2.0, 1.0, commands)[0]
    np.testing.assert_allclose(observer.estimate(4.0).pose, POSE + position - start, atol=1e-12)


def test_a_reset_predictor_forgets_commands_and_poses() -> None:
    observer, _ = predictor()
    observer.reset(5.0, [1.0, 2.0, 3.0], 2.0 * COVARIANCE)
    found = observer.estimate(6.0)
    np.testing.assert_array_equal(found.pose, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(found.velocity, np.zeros(3))
    np.testing.assert_array_equal(found.covariance, 2.0 * COVARIANCE)
    assert observer.exposed == 5.0
