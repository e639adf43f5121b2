from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.ranging.homography_fit import DegenerateError
from gpuvision.servoing.machine_calibration.motion_frame import fit_motion_frame, next_move

X_SCALE, Y_SCALE, SKEW, BETA, CAMERA = 1.0012, 0.9991, 0.8e-3, 0.31, -0.2
OFFSET = np.array([31e-3, -4e-3])
PLANTED = np.array([X_SCALE, Y_SCALE, SKEW, BETA, CAMERA, *OFFSET])
COVARIANCE = np.array([[4e-12, 1e-12, 5e-12], [1e-12, 3e-12, -2e-12], [5e-12, -2e-12, 9e-10]])
COMMANDS = np.array(
    [
        [x, y, a]
        for x, y, a in zip(
            (0, 40e-3, 40e-3, 0, 20e-3, 10e-3, 30e-3),
            (0, 0, 30e-3, 30e-3, 15e-3, 20e-3, 5e-3),
            (0, 0.5, -0.5, 0.2, 1.5, -2, 3),
            strict=True,
        )
    ]
)


def _rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _seen(commands: np.ndarray) -> np.ndarray:
    """Simulate the machine by its parts: axes, then the head, then the camera on it, then the board below."""
    axis_x, axis_y = np.array([X_SCALE, 0]), Y_SCALE * np.array([-math.sin(SKEW), math.cos(SKEW)])
    poses = []
    for x, y, alpha in commands:
        head = x * axis_x + y * axis_y
        camera = head + _rotation(alpha) @ OFFSET
        on_board = _rotation(BETA) @ (camera - (7e-3, 9e-3))
        poses.append([*on_board, (CAMERA + alpha + BETA + math.pi) % (2 * math.pi) - math.pi])
    return np.array(poses)


def _draws(commands: np.ndarray, count: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).multivariate_normal(np.zeros(3), COVARIANCE, (count, len(commands)))
    return _seen(commands) + noise


def test_exact_poses_give_back_the_planted_machine() -> None:
    frame = fit_motion_frame(COMMANDS, _seen(COMMANDS), COVARIANCE)
    np.testing.assert_allclose(frame.parameters, PLANTED, atol=1e-12)
    assert frame.unobservable == ()
    assert frame.head_angle == 0.0
    # Camera positions at the head angle 0, and the command that moves the camera by a vector that it sees.
    commands = np.array([[3e-3, 5e-3, 0.0], [9e-3, -2e-3, 0.0]])
    seen = _seen(commands)
    np.testing.assert_allclose(frame.transform.apply(commands[:, :2]), seen[:, :2], atol=1e-14)
    in_camera = _rotation(-seen[0, 2]) @ (seen[1, :2] - seen[0, :2])
    np.testing.assert_allclose(frame.camera_to_motion.apply(in_camera), commands[1, :2] - commands[0, :2], atol=1e-14)


def test_covariance_is_the_derivative_of_the_fit_by_each_measured_value() -> None:
    seen = _draws(COMMANDS, 1, 9)[0]
    each_pose = COVARIANCE * np.array([1, 7, 2, 9, 3, 1, 5])[:, None, None]
    frame = fit_motion_frame(COMMANDS, seen, each_pose)
    spread, of_moves = np.zeros((7, 7)), np.zeros((6, 6))
    for row in range(len(seen)):
        columns, moved = [], []
        for column in range(3):
            step = np.zeros_like(seen)
            step[row, column] = 1e-6
            more, less = (fit_motion_frame(COMMANDS, seen + sign * step, each_pose) for sign in (1, -1))
            columns.append((more.parameters - less.parameters) / 2e-6)
            moved.append((more.camera_to_motion.matrix - less.camera_to_motion.matrix).ravel() / 2e-6)
        jacobian, by_value = np.stack(columns, axis=1), np.stack(moved, axis=1)
        spread += jacobian @ each_pose[row] @ jacobian.T
        of_moves += by_value @ each_pose[row] @ by_value.T
    unit = frame.sigmas
    np.testing.assert_allclose(frame.covariance / np.outer(unit, unit), spread / np.outer(unit, unit), atol=1e-4)
    linear = np.ix_([0, 1, 3, 4], [0, 1, 3, 4])
    covariance, expected = (each[linear] for each in (frame.camera_to_motion.covariance, of_moves))
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(covariance / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-4)


def _check_coverage(count: int) -> None:
    inside, errors, moves = [], [], []
    vector = np.array([2e-3, 1e-3])
    for seen in _draws(COMMANDS, count, 4):
        frame = fit_motion_frame(COMMANDS, seen, COVARIANCE)
        inside.append(np.abs(frame.parameters - PLANTED) <= 3 * frame.sigmas)
        errors.append((frame.parameters - PLANTED) / frame.sigmas)
        moves.append(frame.camera_to_motion.apply(vector))
    assert np.mean(np.all(inside, axis=1)) >= 0.95
    np.testing.assert_allclose(np.std(errors, axis=0), 1.0, atol=4 / math.sqrt(2 * count))
    predicted = np.sqrt(np.diag(frame.camera_to_motion.propagate(vector).covariance))
    np.testing.assert_allclose(np.std(moves, axis=0) / predicted, 1.0, atol=4 / math.sqrt(2 * count))


def test_planted_machine_is_within_three_sigma() -> None:
    _check_coverage(100)


@pytest.mark.slow
def test_planted_machine_is_within_three_sigma_in_95_percent_of_1000_draws() -> None:
    _check_coverage(1000)


def test_without_turns_the_offset_is_named_and_the_rest_is_found() -> None:
    commands = COMMANDS.copy()
    commands[:, 2] = 0.25
    frame = fit_motion_frame(commands, _seen(commands), COVARIANCE)
    assert frame.unobservable == ("camera offset x", "camera offset y")
    assert np.all(np.isnan(frame.parameters[5:]))
    assert np.all(np.isnan(frame.sigmas[5:]))
    np.testing.assert_allclose(frame.parameters[:5], PLANTED[:5], atol=1e-12)
    assert np.all(frame.sigmas[:5] > 0)
    # Camera positions are those at the only angle of the head.
    assert frame.head_angle == 0.25
    there = np.array([[3e-3, 5e-3, 0.25], [9e-3, -2e-3, 0.25]])
    np.testing.assert_allclose(frame.transform.apply(there[:, :2]), _seen(there)[:, :2], atol=1e-14)


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        ((1, 0), "all moves are along x: skew and y scale cannot be found"),
        ((0, 1), "all moves are along y: skew and x scale cannot be found"),
        ((1, 2), "on one slanted line: skew and the ratio of the scales cannot be found"),
        ((0, 0), "at one place: x scale, rotation, skew and y scale cannot be found"),
    ],
)
def test_degenerate_moves_are_refused_in_one_line(direction: tuple[float, float], message: str) -> None:
    commands = np.zeros((5, 3))
    commands[:, :2] = np.linspace(0, 0.04, 5)[:, None] * direction
    with pytest.raises(DegenerateError, match=message):
        fit_motion_frame(commands, _seen(commands), COVARIANCE)


def test_turns_that_follow_the_moves_are_refused_with_names() -> None:
    # Three places, three turns: as many unknowns as equations of position less two.
    commands = COMMANDS[:3]
    with pytest.raises(DegenerateError, match="camera offset x, camera offset y cannot be found"):
        fit_motion_frame(commands, _seen(commands), COVARIANCE)


@pytest.mark.slow
def test_proposed_move_beats_a_random_one_by_the_predicted_factor() -> None:
    start = np.array([[0, 0, 0], [5e-3, 0, 0], [0, 5e-3, 0], [5e-3, 5e-3, 0.3], [2e-3, 1e-3, -0.3]], np.float64)
    grid = np.array([[x, y, a] for x in (0, 20e-3, 40e-3) for y in (0, 15e-3, 30e-3) for a in (0.0, 1.5)])
    best = next_move(start, grid, COVARIANCE)
    other = int(np.random.default_rng(5).integers(len(grid)))
    volumes = []
    for index in (best.chosen, other):
        commands = np.vstack([start, grid[index]])
        fits = [fit_motion_frame(commands, seen, COVARIANCE) for seen in _draws(commands, 200, 11)]
        # Axes, place of the board at the head angle 0 and offset: a one-to-one map of the parameters that the choice
        # counts.
        values = [[*fit.parameters[:4], *fit.transform.translation, *fit.parameters[5:]] for fit in fits]
        whitened = np.array(values) / np.std(values, axis=0)
        volumes.append(math.sqrt(np.linalg.det(np.cov(whitened.T))) * float(np.prod(np.std(values, axis=0))))
    measured = volumes[1] / volumes[0]
    predicted = best.volume_factor[best.chosen] / best.volume_factor[other]
    assert predicted > 2
    assert measured == pytest.approx(predicted, rel=0.3)


def test_first_moves_are_proposed_without_a_fit() -> None:
    grid = np.array([[x, y, a] for x in (0, 20e-3) for y in (0, 20e-3) for a in (0.0, 1.0)])
    tried = np.empty((0, 3))
    for _ in range(4):
        tried = np.vstack([tried, grid[next_move(tried, grid, COVARIANCE).chosen]])
    frame = fit_motion_frame(tried, _seen(tried), COVARIANCE)
    assert frame.unobservable == ()


def test_mirrored_and_still_axes_are_refused() -> None:
    """Commands with the wrong sign of y, with x and y exchanged; positions that do not move, or along a line."""
    for change in (np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 0, 2]]):
        with pytest.raises(ValueError, match="the seen axes are mirrored: y is clockwise from x; check the signs"):
            fit_motion_frame(COMMANDS @ change, _seen(COMMANDS), COVARIANCE)
    both = np.diag([-1.0, -1.0, 1.0])  # a turn by half
    assert fit_motion_frame(COMMANDS @ both, _seen(COMMANDS), COVARIANCE).parameters[0] == pytest.approx(X_SCALE)
    for still in (np.diag([0.0, 0.0, 1.0]), np.diag([1.0, 0.0, 1.0])):
        seen = _seen(COMMANDS @ still)
        for noise in (0.0, _draws(COMMANDS, 1, 4)[0] - _seen(COMMANDS)):
            with pytest.raises(DegenerateError, match="do not follow the commands in two directions"):
                fit_motion_frame(COMMANDS, seen + noise, COVARIANCE)


def test_missing_and_infinite_values_are_refused() -> None:
    with pytest.raises(DegenerateError, match="there is no command"):
        fit_motion_frame(np.zeros((0, 3)), np.zeros((0, 3)), COVARIANCE)
    for value in (math.nan, math.inf):
        candidates = COMMANDS.copy()
        candidates[2, 1] = value
        with pytest.raises(ValueError, match="covariance is not finite"):
            fit_motion_frame(COMMANDS, _seen(COMMANDS), np.diag([1.0, 1.0, value]))
        with pytest.raises(ValueError, match="a candidate for the next measurement is not finite"):
            next_move(COMMANDS[:1], candidates, COVARIANCE)


def test_wrong_input_is_refused() -> None:
    with pytest.raises(ValueError, match="seen have shape"):
        fit_motion_frame(COMMANDS, _seen(COMMANDS)[:-1], COVARIANCE)
    with pytest.raises(ValueError, match="finite"):
        fit_motion_frame(COMMANDS * math.nan, _seen(COMMANDS), COVARIANCE)
    for commands in (1.0, COMMANDS[0], COMMANDS[:, :2], COMMANDS[..., None]):
        with pytest.raises(ValueError, match="commands have shape"):
            fit_motion_frame(commands, _seen(COMMANDS), COVARIANCE)
