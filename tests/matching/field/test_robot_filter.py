"""A robot's pose over time: Bayes' rule against SciPy, delayed views, symmetric poses, and kidnapping."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from gpuvision.formats.field_file import read_field
from gpuvision.matching.field import robot_filter
from gpuvision.matching.field.field_pose import PoseCandidate
from gpuvision.matching.field.odometry import PoseEstimate, predict
from gpuvision.matching.field.robot_filter import RobotFilter, RobotFilterLimits
from gpuvision.status import Status

FIELD = read_field("robocup_msl")
VIEW = np.diag([0.03, 0.03, 0.01]) ** 2  # covariance of a view
STEP = np.diag([0.01, 0.01, 0.005]) ** 2  # of the odometry of a step
START = PoseEstimate(np.array([2.0, 1.0, 0.3]), np.diag([0.05, 0.05, 0.02]) ** 2)


def candidate(pose: np.ndarray, covariance: np.ndarray = VIEW, status: Status = Status.OK) -> PoseCandidate:
    return PoseCandidate(np.asarray(pose), covariance, np.linalg.inv(covariance), 0.1, 0.02, 0.9, None, status)


def twin(pose: np.ndarray) -> np.ndarray:
    return np.array([-pose[0], -pose[1], math.remainder(pose[2] + math.pi, 2 * math.pi)])


def moved(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    return predict(PoseEstimate(pose, np.zeros((3, 3))), motion, np.zeros((3, 3))).pose


def drive(robot: RobotFilter, true: np.ndarray, steps: int, rng: np.random.Generator, begin: float) -> list[np.ndarray]:
    """Move a robot along a curve; return its true poses, at intervals of 0.1 s."""
    poses = []
    for number in range(1, steps + 1):
        motion = np.array([0.1, 0.01, 0.03])
        true = moved(true, motion)
        robot.move(begin + 0.1 * number, rng.multivariate_normal(motion, STEP), STEP)
        poses.append(true)
    return poses


def test_probabilities_are_those_of_bayes() -> None:
    limits = RobotFilterLimits(carried=0.2, wrong_view=0.3, dropped=1e-12)
    robot = RobotFilter(FIELD, START, limits=limits)
    seen = [np.add(START.pose, (0.04, -0.05, 0.01)), twin(START.pose)]
    assert robot.see(0.0, [candidate(each) for each in seen])
    anywhere = 1 / (FIELD.length * FIELD.width * 2 * math.pi)
    fits = multivariate_normal(START.pose, START.covariance + VIEW).pdf(seen[0])
    belongs = 0.8 * 0.7 / 2 * fits
    wrong, carried = 0.8 * 0.3 * anywhere, 0.2 * 0.7 / 2 * anywhere
    # The hypotheses of a wrong view, and of a robot carried to the first candidate, are merged into the corrected one.
    whole = belongs + wrong + 2 * carried
    state = robot.state()
    assert state.probability == pytest.approx((belongs + wrong + carried) / whole, rel=1e-12)
    assert state.hypotheses[1].probability == pytest.approx(carried / whole, rel=1e-9)
    assert state.status == Status.OK
    gain = START.covariance @ np.linalg.inv(START.covariance + VIEW)
    np.testing.assert_allclose(state.pose, START.pose + gain @ (seen[0] - START.pose), rtol=1e-9)
    np.testing.assert_allclose(state.covariance, (np.eye(3) - gain) @ START.covariance, rtol=1e-9)


def test_a_delayed_view_counts_at_its_time() -> None:
    """Views that arrive late give the state of views in time, also in the middle of a motion."""
    late, prompt = RobotFilter(FIELD, START), RobotFilter(FIELD, START)
    motion, half = np.array([0.2, 0.0, 0.1]), 0.5
    view = candidate(np.add(START.pose, (0.12, 0.02, 0.06)))
    prompt.move(0.05, half * motion, half * STEP)
    prompt.see(0.05, [view])
    # The other half of the way, in the frame of the robot after half the turn.
    prompt.move(0.1, [0.1 * math.cos(0.05), -0.1 * math.sin(0.05), 0.05], half * STEP)
    prompt.move(0.2, motion, STEP)
    late.move(0.1, motion, STEP)
    late.move(0.2, motion, STEP)
    assert late.see(0.05, [view])
    for ours, theirs in zip(late.state()[1:4], prompt.state()[1:4], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert not late.see(0.05, [view])  # the same view twice
    assert not late.see(0.01, [view])  # older than the last one


def test_a_refused_view_within_a_motion_leaves_the_robot_where_it_is() -> None:
    whole, split = RobotFilter(FIELD, START), RobotFilter(FIELD, START)
    for robot in (whole, split):
        robot.move(1.0, (1.0, -0.2, 1.2), 1e-6 * np.diag([4.0, 1.0, 0.0]))
    for number in range(1, 10):
        assert split.see(0.1 * number, [])
    np.testing.assert_allclose(split.state().pose, whole.state().pose, atol=1e-12)
    np.testing.assert_allclose(split.state().covariance, whole.state().covariance, atol=1e-12)


def test_motions_without_views_are_kept_for_the_longest_delay_of_a_view(monkeypatch: pytest.MonkeyPatch) -> None:
    predicted: list[int] = []
    monkeypatch.setattr(robot_filter, "predict", lambda *of: (predicted.append(1), predict(*of))[1])
    # 0.125 s: exact in binary, so that no motion ends at the limit by rounding.
    robot = RobotFilter(FIELD, START, limits=RobotFilterLimits(view_delay=1.0))
    expected = START
    for number in range(1, 401):
        robot.move(0.125 * number, (0.01, 0.0, 0.01), 1e-8 * np.eye(3))
        expected = predict(expected, (0.01, 0.0, 0.01), 1e-8 * np.eye(3))
    predicted.clear()
    state = robot.state()
    assert len(predicted) == 8
    np.testing.assert_allclose(state.pose, expected.pose, rtol=1e-12)
    np.testing.assert_allclose(state.covariance, expected.covariance, rtol=1e-12)
    assert not robot.see(48.9, [])
    assert robot.see(49.0, [])
    with pytest.raises(ValueError, match="view_delay"):
        RobotFilter(FIELD, START, limits=RobotFilterLimits(view_delay=0.0))


@pytest.mark.slow
def test_errors_are_as_predicted(rng: np.random.Generator) -> None:
    """Squared Mahalanobis distances of 150 independent runs: chi square of 450 degrees of freedom, 5 sigma."""
    total = 0.0
    for _ in range(150):
        robot = RobotFilter(FIELD, START)
        true = rng.multivariate_normal(*START)
        begin = 0.0
        for _ in range(3):
            poses = drive(robot, true, 4, rng, begin)
            seen = rng.multivariate_normal(poses[1], VIEW)  # two steps ago
            robot.see(begin + 0.2, [candidate(twin(seen)), candidate(seen)])
            true, begin = poses[-1], begin + 0.4
        state = robot.state()
        error = state.pose - true
        error[2] = math.remainder(error[2], 2 * math.pi)
        total += error @ np.linalg.solve(state.covariance, error)
        assert state.status == Status.OK
    assert abs(total - 450) < 5 * math.sqrt(2 * 450)


def test_a_symmetric_field_keeps_two_poses_without_a_first_one(rng: np.random.Generator) -> None:
    robot, true, begin = RobotFilter(FIELD), START.pose, 0.0
    assert robot.state().status == Status.NO_DATA
    assert np.isnan(robot.state().pose).all()
    for _ in range(5):
        poses = drive(robot, true, 2, rng, begin)
        true, begin = poses[-1], begin + 0.2
        robot.see(begin, [candidate(true), candidate(twin(true))])
    state = robot.state()
    assert state.status == Status.AMBIGUOUS
    assert state.hypotheses[0].probability == pytest.approx(0.5, abs=0.01)
    assert state.hypotheses[1].probability == pytest.approx(0.5, abs=0.01)
    for each, expected in zip((true, twin(true)), (0, 1), strict=True):
        assert min(np.abs(h.estimate.pose[:2] - each[:2]).max() for h in state.hypotheses[:2]) < 0.1, expected


def test_one_wrong_view_does_not_carry_the_robot_away(rng: np.random.Generator) -> None:
    robot = RobotFilter(FIELD, START)
    for number in range(4):
        robot.see(0.1 * number, [candidate(START.pose if number != 2 else (-3.0, 4.0, 1.0))])
        robot.move(0.1 * (number + 1), np.zeros(3), STEP)
    state = robot.state()
    assert state.status == Status.OK
    assert np.abs(state.pose - START.pose).max() < 0.1


def test_a_kidnapped_robot_is_found_again(rng: np.random.Generator) -> None:
    robot, there = RobotFilter(FIELD, START), np.array([-3.0, 4.0, 1.0])
    robot.see(0.0, [candidate(START.pose)])
    found = []
    for number in range(1, 5):
        robot.move(0.1 * number, np.zeros(3), STEP)
        robot.see(0.1 * number, [candidate(rng.multivariate_normal(there, VIEW))])
        state = robot.state()
        found.append(bool(np.abs(state.pose - there).max() < 0.15 and state.status == Status.OK))
    assert found == [False, True, True, True]
    assert np.abs(robot.state().pose - there).max() < 0.1


def test_refused_views_and_single_lines(rng: np.random.Generator) -> None:
    robot = RobotFilter(FIELD, START)
    robot.see(0.0, [])
    np.testing.assert_array_equal(robot.state().pose, START.pose)
    line = candidate(np.add(START.pose, (1.0, 0.1, 0.0)))._replace(
        information=np.diag([0.0, 1e6, 1e6]), status=Status.AMBIGUOUS
    )
    robot.move(0.1, np.zeros(3), 1e-12 * np.eye(3))
    robot.see(0.1, [line])
    np.testing.assert_allclose(robot.state().pose, np.add(START.pose, (0.0, 0.1, 0.0)), atol=1e-3)
    far = line._replace(pose=np.add(START.pose, (0.0, 5.0, 0.0)))
    robot.move(0.2, np.zeros(3), 1e-12 * np.eye(3))
    robot.see(0.2, [far])
    np.testing.assert_allclose(robot.state().pose, np.add(START.pose, (0.0, 0.1, 0.0)), atol=1e-3)


def test_poses_that_have_not_converged_are_left_out() -> None:
    """A candidate whose refinement is open is no view, also one that determines a part; beside others it is missing."""
    away = np.add(START.pose, (0.06, -0.02, 0.01))
    with_open, without = RobotFilter(FIELD, START), RobotFilter(FIELD, START)
    open_one = candidate(away, status=Status.NOT_CONVERGED)
    assert with_open.see(0.0, [open_one])
    np.testing.assert_array_equal(with_open.state().pose, START.pose)
    for robot in (with_open, without):
        robot.move(0.1, np.zeros(3), STEP)
    partly = candidate(away, status=Status.NOT_CONVERGED | Status.AMBIGUOUS)
    assert with_open.see(0.1, [open_one, partly])
    np.testing.assert_array_equal(with_open.state().pose, without.state().pose)
    for robot, views in ((with_open, [open_one, candidate(away)]), (without, [candidate(away)])):
        robot.move(0.2, np.zeros(3), STEP)
        robot.see(0.2, views)
    for ours, theirs in zip(with_open.state()[1:4], without.state()[1:4], strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_wrong_times_are_refused() -> None:
    robot = RobotFilter(FIELD, START)
    robot.move(0.1, np.zeros(3), STEP)
    with pytest.raises(ValueError, match="expected a time after"):
        robot.move(0.1, np.zeros(3), STEP)
    with pytest.raises(ValueError, match="give the motion first"):
        robot.see(0.2, [])
    with pytest.raises(ValueError, match="time"):
        robot.state(0.5)


def places(robot: RobotFilter) -> list[float]:
    """Return the x of all hypotheses, most probable first."""
    return [round(float(each.estimate.pose[0]), 3) for each in robot.state().hypotheses]


@pytest.mark.parametrize(("factor", "count"), [(0.99, 1), (1.01, 2)])
def test_hypotheses_merge_below_their_distance(factor: float, count: int) -> None:
    """Two candidates of a first view, whose squared distance in the sum of their covariances is 4 times the factor."""
    away = math.sqrt(4.0 * factor * 2.0) * 0.03
    robot = RobotFilter(FIELD, limits=RobotFilterLimits(merged=4.0))
    robot.see(0.0, [candidate((1.0, 2.0, 0.3)), candidate((1.0 + away, 2.0, 0.3))])
    found = robot.state().hypotheses
    assert len(found) == count
    assert sum(each.probability for each in found) == pytest.approx(1.0)
    assert found[0].probability == pytest.approx(1.0 / count)


@pytest.mark.parametrize(("factor", "corrected"), [(0.99, True), (1.01, False)])
def test_candidates_beyond_the_gate_belong_to_no_hypothesis(factor: float, corrected: bool) -> None:
    """Of a candidate that fixes x only, too: a squared distance of 9 times the factor."""
    away = math.sqrt(9.0 * factor * (0.05**2 + 0.03**2))
    seen = np.add(START.pose, (away * math.cos(0.0), 0.0, 0.0))
    limits = RobotFilterLimits(gate=9.0, carried=1e-9, dropped=1e-12)
    robot, partly = RobotFilter(FIELD, START, limits=limits), RobotFilter(FIELD, START, limits=limits)
    robot.see(0.0, [candidate(seen)])
    found = [h for h in robot.state().hypotheses if 1e-3 < h.estimate.pose[0] - START.pose[0] < 0.9 * away]
    assert (len(found) == 1) == corrected
    of_x = candidate(seen)._replace(information=np.diag([0.03**-2, 0.0, 0.0]), status=Status.AMBIGUOUS)
    partly.see(0.0, [of_x._replace(pose=np.add(seen, (3.0, 0.0, 0.0))), of_x])
    moved_by = away * 0.05**2 / (0.05**2 + 0.03**2) if corrected else 0.0
    np.testing.assert_allclose(partly.state().pose, np.add(START.pose, (moved_by, 0.0, 0.0)), atol=1e-9)


def test_the_most_probable_hypotheses_are_kept() -> None:
    """Candidates far apart are equally probable; a second view of two of them makes these more probable."""
    poses = [(x, 1.0, 0.2) for x in (-6.0, -2.0, 2.0, 6.0)]
    for most, count in ((4, 4), (3, 3), (1, 1)):
        robot = RobotFilter(FIELD, limits=RobotFilterLimits(max_hypotheses=most))
        robot.see(0.0, [candidate(each) for each in poses])
        found = robot.state().hypotheses
        assert [each.probability for each in found] == pytest.approx([1.0 / count] * count)
    robot = RobotFilter(FIELD, limits=RobotFilterLimits(dropped=1e-9))
    robot.see(0.0, [candidate(each) for each in poses])
    robot.move(1.0, np.zeros(3), STEP)
    robot.see(1.0, [candidate(poses[1]), candidate(poses[3])])
    first = robot.state().hypotheses
    assert sorted(places(robot)[:2]) == [-2.0, 6.0]
    assert sorted(places(robot)) == [-6.0, -2.0, 2.0, 6.0]
    least = first[-1].probability
    for factor, count in ((0.99, 4), (1.01, 2)):
        robot = RobotFilter(FIELD, limits=RobotFilterLimits(dropped=factor * least))
        robot.see(0.0, [candidate(each) for each in poses])
        robot.move(1.0, np.zeros(3), STEP)
        robot.see(1.0, [candidate(poses[1]), candidate(poses[3])])
        assert len(robot.state().hypotheses) == count


def test_a_pose_is_ambiguous_below_its_least_probability() -> None:
    two = [candidate((1.0, 1.0, 0.0)), candidate((-3.0, 1.0, 0.0))]
    for least, status in ((0.5, Status.OK), (0.5 + 1e-9, Status.AMBIGUOUS)):
        robot = RobotFilter(FIELD, limits=RobotFilterLimits(min_probability=least))
        robot.see(0.0, two)
        assert robot.state().probability == 0.5
        assert robot.state().status == status


def test_state_within_a_motion_is_at_its_share() -> None:
    """The path is a straight line in the frame of the start of the motion, as is the turn; the variance grows."""
    robot = RobotFilter(FIELD, PoseEstimate(np.array([1.0, 2.0, 0.5]), np.zeros((3, 3))), time=3.0)
    robot.move(5.0, (0.8, -0.4, 0.6), np.diag([4e-4, 0.0, 1e-4]))
    found = robot.state(3.5)
    c, s = math.cos(0.5), math.sin(0.5)
    np.testing.assert_allclose(found.pose, [1.0 + 0.2 * c + 0.1 * s, 2.0 + 0.2 * s - 0.1 * c, 0.65], atol=1e-12)
    assert found.time == 3.5
    along = np.array([c, s, 0.0])
    expected = 1e-4 * np.outer(along, along) + np.diag([0.0, 0.0, 0.25e-4])
    np.testing.assert_allclose(found.covariance, expected, atol=1e-15)
    assert robot.state(5.0).time == robot.state().time == 5.0
    with pytest.raises(ValueError, match="time"):
        robot.state(2.999)
    robot.see(4.0, [])
    with pytest.raises(ValueError, match="time"):
        robot.state(3.999)
    assert robot.state(4.0).time == 4.0
