"""Pose that observers predict for the exposure of a frame."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gpuvision.servoing.controllers import SmithPredictor
from gpuvision.servoing.observer import LatestPose, MotionModel, Observer, PoseMeasurement, PoseObserver

LAG = (0.0, 1.5e-3, 4e-3)
COVARIANCE = 1e-14 * np.eye(3)
COMMANDS = ((1e-3, (0.1, -0.2, 0.3)), (2e-3, (0.0, 0.3, 0.1)), (3e-3, (-0.2, 0.1, 0.0)))  # time [s], velocity
POSE = np.array([1e-3, 2e-3, 0.1])


def motion(start: float, end: float) -> np.ndarray:
    """Return the motion (3,) of the axes from one time to another, by numerical integration of their equations."""

    def commanded(time: float) -> np.ndarray:
        return np.array([(0.0, 0.0, 0.0), *(velocity for begin, velocity in COMMANDS if begin <= time)][-1])

    def slope(time: float, state: np.ndarray) -> np.ndarray:
        u = commanded(time)
        v = np.where(np.array(LAG) > 0.0, state[3:], u)
        return np.concatenate([v, (u - v) / np.maximum(LAG, 1e-3)])

    edges, state, positions = [0.0, 1e-3, 2e-3, 3e-3, 10e-3], np.zeros(6), {}
    for first, last in itertools.pairwise(edges):
        times = sorted({each for each in (start, end, last) if first < each <= last})
        middle = 0.5 * (first + last)
        found = solve_ivp(
            lambda _, y, at=middle: slope(at, y), (first, last), state, t_eval=times, rtol=1e-10, atol=1e-14
        )
        positions |= dict(zip(times, found.y[:3].T, strict=True))
        state = found.y[:, -1]
    return np.asarray(positions[end] - positions[start])


def followed(observer: Observer, exposed: float) -> Observer:
    observer.reset(0.0, np.zeros(3), np.eye(3))
    for time, velocity in COMMANDS:
        observer.command(time, np.array(velocity))
    observer.add(PoseMeasurement(exposed, 3.2e-3, POSE, COVARIANCE, 0))
    return observer


@pytest.mark.parametrize("time", [1.7e-3, 2.9e-3, 5e-3])
@pytest.mark.parametrize("observer", [SmithPredictor(2e-3, lag=LAG), PoseObserver(MotionModel(lag=LAG))])
def test_the_pose_of_an_exposure_is_the_last_pose_and_the_motion_since(observer: Observer, time: float) -> None:
    """Exposures before and after the last command."""
    exposed = 1.4e-3
    found = followed(observer, exposed).predicted_pose(time)
    assert found is not None
    # The Kalman filter keeps 1e-14 of its prior.
    np.testing.assert_allclose(found - POSE, motion(exposed, time), atol=1e-10)


@pytest.mark.parametrize("observer", [LatestPose(), SmithPredictor(2e-3), PoseObserver(MotionModel(lag=LAG))])
def test_there_is_no_prediction_before_the_first_measurement(observer: Observer) -> None:
    observer.reset(-np.inf if not isinstance(observer, PoseObserver) else 0.0, POSE, COVARIANCE)
    assert observer.predicted_pose(1e-3) is None


def test_an_observer_without_a_model_predicts_the_latest_pose() -> None:
    np.testing.assert_array_equal(followed(LatestPose(), 1.4e-3).predicted_pose(5e-3), POSE)


def test_a_prediction_before_the_history_is_none() -> None:
    assert followed(PoseObserver(MotionModel(lag=LAG)), 1.4e-3).predicted_pose(-1e-3) is None
