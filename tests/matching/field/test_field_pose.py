"""Pose of a robot on its field: scores by definition, poses by SciPy, and insufficient views."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from canary import Guarded
from field_maps import large, small
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.distance_map import Arc, DistanceMap, Field
from gpuvision.matching.field.field_pose import (
    FieldPoseRefinement,
    FieldPoseSearch,
    _same,
    find_pose_candidates,
    symmetric_twin,
)
from gpuvision.reference import field as reference
from gpuvision.status import Status

VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
POSE = np.array([3.1, -2.2, 0.7])


def view(
    field_map: DistanceMap,
    pose: Any,
    rng: np.random.Generator,
    count: int = 64,
    sigma: float = 0.03,
    reach: float = 5.0,
) -> np.ndarray:
    return reference.draw_line_points(field_map.field, pose, rng, count, reach, sigma).astype(np.float32)


def pose_errors(pose: Any, other: Any) -> np.ndarray:
    difference = np.asarray(pose, np.float64) - other
    difference[..., 2] = (difference[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return difference


# ---- the search ----------------------------------------------------------------------------------------------


def expected_scores(search: FieldPoseSearch, points: np.ndarray) -> np.ndarray:
    """Return scores from the map, point by point, in integers."""
    field_map, (rows, columns) = search.map, search.map.positions
    result = np.zeros((len(search.angles), rows, columns))
    for turn, heading in enumerate(search.angles):
        c, s = np.float32(np.cos(heading)), np.float32(np.sin(heading))
        x, y = points.T
        per = np.float32(1.0 / field_map.cell)
        at = np.rint(np.stack([s * x + c * y, c * x - s * y], axis=-1) * per).astype(int) + field_map.border
        for row, column in at:
            result[turn] += field_map.cells.level[row : row + rows, column : column + columns]
    return result / (1023.0 * len(points))


@VARIANTS
@pytest.mark.parametrize("count", [1, 63, 65, 300])
def test_scores_are_sums_over_the_map(device: Device, variant: Any, count: int, rng: np.random.Generator) -> None:
    for field_map in (small(device), small(device, 64), small(device, 131)):
        search = FieldPoseSearch(map=field_map, headings=(0.3, -2.0, 1.1), with_scores=True, variant=variant)
        # Not close to half a cell, where a fused multiplication could round to another cell.
        points = rng.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)
        expected = expected_scores(search, points)
        costs = search(points, device=device)
        # At most one point is in another cell.
        assert np.mean(np.abs(costs.scores - expected) < 1e-6) > 0.99 if count > 1 else True
        np.testing.assert_allclose(costs.scores, expected, atol=1.0 / count)
        assert (costs.seen == count).all()
        turn, row, _ = np.indices(costs.least.shape)
        np.testing.assert_array_equal(costs.least, costs.scores[turn, row, costs.column])
        np.testing.assert_array_equal(costs.least.min(axis=-1), costs.scores.min(axis=-1))


@VARIANTS
def test_outputs_stay_within_theirs(device: Device, variant: Any, rng: np.random.Generator) -> None:
    points = rng.uniform(-1.0, 1.0, (65, 2)).astype(np.float32)
    for columns in (7, 131):
        search = FieldPoseSearch(
            map=small(device, columns), headings=(0.3, -2.0, 1.1), with_scores=columns == 7, variant=variant
        )
        guarded = Guarded(search(points, device=device))
        search(points, device=device, out=guarded.out)
        guarded.assert_intact()


@VARIANTS
def test_points_that_are_none_do_not_count(device: Device, variant: Any, rng: np.random.Generator) -> None:
    search = FieldPoseSearch(map=small(device), headings=(0.3, -2.0, 1.1), with_scores=True, variant=variant)
    points = rng.uniform(-1.0, 1.0, (63, 2)).astype(np.float32)
    worse = np.concatenate([points, points[:3]])
    # The last point is less than a cell beyond the range.
    worse[7], worse[64], worse[65] = (np.nan, 0.0), (1e30, np.inf), (2.01, 0.0)
    valid = np.delete(worse, [7, 64, 65], axis=0)
    costs, expected = search(worse, device=device), search(valid, device=device)
    assert (costs.seen == 63).all()
    np.testing.assert_array_equal(costs.scores, expected.scores)
    empty = search(np.full((65, 2), np.nan, np.float32), device=device)
    assert np.isnan(empty.scores).all()
    assert np.isnan(empty.least).all()
    assert (empty.seen == 0).all()
    assert len(search.best(empty).poses) == 0


def test_scores_are_near_the_exact_cost(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    search = FieldPoseSearch(map=field_map, headings=(0.7,), with_scores=True)
    points = view(field_map, POSE, rng)
    scores = search(points, device=device).scores[0]
    x0, y0 = field_map.first_position
    for row, column in rng.integers(0, field_map.positions, (40, 2)):
        pose = (x0 + field_map.cell * column, y0 + field_map.cell * row, 0.7)
        exact = reference.cost(field_map.field, pose, points.astype(np.float64), field_map.scale)
        assert abs(scores[row, column] - exact) <= 0.46 * field_map.cell / field_map.scale + 1.0 / 2046.0


# ---- both tiers ----------------------------------------------------------------------------------------------


def assert_found(field_map: DistanceMap, pose: Any, points: np.ndarray, device: Device) -> None:
    candidates = find_pose_candidates(field_map, points, device=device)
    first = candidates[0]
    assert first.status == Status.OK
    assert first.symmetric_twin is not None
    pair = {0, first.symmetric_twin}
    assert candidates[first.symmetric_twin].score == pytest.approx(first.score, abs=1e-6)
    assert candidates[first.symmetric_twin].symmetric_twin == 0
    assert len(candidates) == 2 or candidates[2].score > first.score + 0.005
    right = min((candidates[number] for number in pair), key=lambda each: np.abs(pose_errors(each.pose, pose)).sum())
    far = pose_errors(right.pose, pose)
    # Chi squared of three degrees beyond 25: one in 65 000.
    assert far @ right.information @ far < 25.0


def test_kidnapped_robots_are_found(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    for _ in range(10):
        pose = rng.uniform([-10.0, -6.0, -np.pi], [10.0, 6.0, np.pi])
        assert_found(field_map, pose, view(field_map, pose, rng, 128, reach=6.0), device)


def test_clutter_of_70_percent(device: Device, rng: np.random.Generator) -> None:
    """Most points are on other lines, people and the ball; every robot is found at its true place."""
    field_map = large(device)
    for _ in range(40):
        pose = rng.uniform([-10.5, -6.5, -np.pi], [10.5, 6.5, np.pi])
        points = view(field_map, pose, rng, 200, reach=6.0)
        angle, far = rng.uniform(-np.pi, np.pi, 140), 6.0 * np.sqrt(rng.uniform(0.0, 1.0, 140))
        points[:140] = np.stack([far * np.cos(angle), far * np.sin(angle)], axis=-1)
        first = find_pose_candidates(field_map, points, device=device)[0]
        assert min(np.abs(pose_errors(each, pose)[:2]).max() for each in (first.pose, symmetric_twin(first.pose))) < 0.3


def test_a_robot_outside_the_field(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    pose = np.array([4.0, 7.8, -1.2])
    assert_found(field_map, pose, view(field_map, pose, rng, 128, reach=6.0), device)


def test_a_compass_tells_twins_apart(device: Device, rng: np.random.Generator) -> None:
    field_map = DistanceMap(field=read_field("robocup_junior"), cell=0.02, scale=0.05, max_range=1.5, device=device)
    pose = np.array([0.31, -0.22, 0.7])
    points = view(field_map, pose, rng, sigma=0.005, reach=1.2)
    first, *others = find_pose_candidates(field_map, points, headings=(0.6,), device=device)
    assert first.symmetric_twin is None
    assert np.abs(pose_errors(first.pose, pose)).max() < 0.02
    assert all(each.score > first.score + 0.05 for each in others)


def test_points_twice_are_the_same_pose(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    points = view(field_map, POSE, rng)
    once, twice = (
        find_pose_candidates(field_map, each, device=device)[0] for each in (points, np.repeat(points, 2, axis=0))
    )
    other = twice.pose if np.abs(pose_errors(twice.pose, once.pose)).sum() < 1.0 else symmetric_twin(twice.pose)
    np.testing.assert_allclose(pose_errors(other, once.pose), 0.0, atol=3e-5)


@pytest.mark.parametrize(
    ("pose", "other", "same"),
    [
        ((1.0, 2.0, 0.5), (1.0, 2.0, 0.5), True),
        ((1.0, 2.0, 0.5), (1.02, 1.98, 0.51), True),  # 28 mm, 10 mrad
        ((1.0, 2.0, 0.5), (1.03, 1.99, 0.5), False),  # 32 mm
        ((1.0, 2.0, 0.5), (1.0, 2.0, 0.525), False),
        ((1.0, 2.0, math.pi - 0.005), (1.0, 2.0, 0.005 - math.pi), True),
        ((1.0, 2.0, math.pi), (1.0, 2.0, 0.0), False),
    ],
)
def test_poses_within_30_mm_and_20_mrad_are_the_same(pose: Any, other: Any, same: bool) -> None:
    assert _same(np.array(pose), np.array(other)) is same
    assert _same(np.array(other), np.array(pose)) is same


def test_a_mirrored_view_is_a_mirrored_pose(device: Device, rng: np.random.Generator) -> None:
    """The field is mirror symmetric, so a mirrored camera finds the mirrored pose with the same score."""
    field_map = large(device)
    points = view(field_map, POSE, rng)
    right, mirrored = (
        find_pose_candidates(field_map, each, device=device)[0] for each in (points, points * np.float32([1, -1]))
    )
    assert mirrored.score == pytest.approx(right.score, abs=1e-5)
    mirror_pose = POSE * [1.0, -1.0, -1.0]
    assert (
        min(np.abs(pose_errors(each, mirror_pose)).max() for each in (mirrored.pose, symmetric_twin(mirrored.pose)))
        < 0.05
    )


def test_a_wrong_scale_shows_in_the_scatter(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    points = view(field_map, POSE, rng, 128, reach=6.0)
    right, wrong = (
        find_pose_candidates(field_map, np.float32(s) * points, initial_pose=POSE, device=device)[0]
        for s in (1.0, 1.05)
    )
    assert wrong.residual_std > 1.5 * right.residual_std
    assert np.abs(pose_errors(wrong.pose, POSE)[:2]).max() < 0.3
    np.testing.assert_array_less(np.diag(right.covariance), np.diag(wrong.covariance))


def test_no_points_no_pose(device: Device) -> None:
    invalid = np.full((8, 2), np.nan, np.float32)
    assert find_pose_candidates(large(device), invalid, device=device) == ()
    assert find_pose_candidates(large(device), invalid, initial_pose=POSE, device=device) == ()


# ---- the local tier ------------------------------------------------------------------------------------------


def test_poses_are_of_least_cost(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    for _ in range(4):
        pose = rng.uniform([-10.0, -6.0, -np.pi], [10.0, 6.0, np.pi])
        points = view(field_map, pose, rng, 96)
        start = (pose + rng.uniform(-1.0, 1.0, 3) * [0.1, 0.1, 0.05]).astype(np.float32)
        fit = FieldPoseRefinement(map=field_map)(points, start[None], device=device)
        expected = reference.refine_pose(field_map.field, start, points.astype(np.float64), field_map.scale)
        # Where two lines are equally near, the cost has a kink at which SciPy sometimes stops. SciPy's result is then
        # not better, and SciPy does not improve the pose of the kernel.
        least, other = (
            reference.cost(field_map.field, each, points.astype(np.float64), field_map.scale)
            for each in (fit.poses[0], expected)
        )
        assert least <= other + 1e-8
        if other < least + 1e-6:
            np.testing.assert_allclose(pose_errors(fit.poses[0], expected), 0.0, atol=3e-5)
        again = reference.refine_pose(field_map.field, fit.poses[0], points.astype(np.float64), field_map.scale)
        np.testing.assert_allclose(pose_errors(fit.poses[0], again), 0.0, atol=3e-5)
        assert fit.score[0] == pytest.approx(least, abs=2e-6)


def test_the_fourth_nearest_line_of_a_cell_can_be_the_nearest_of_a_point(device: Device) -> None:
    """Four lines about the centre of one coarse cell; points on each of them are on a line, not beside one."""
    cell = 0.5
    empty = DistanceMap(field=Field(length=7.0, width=5.0, lines=((0, 0, 1, 0),)), cell=cell, device=device)
    x, y = np.array(empty.first) + cell * np.array([empty.border + 5, empty.border + 4])
    offsets = (-0.10, 0.12, -0.15, 0.19)
    upright = [(x + each, y - 0.9, x + each, y + 0.9) for each in offsets[:2]]
    level = [(x - 0.9, y + each, x + 0.9, y + each) for each in offsets[2:]]
    field = Field(length=7.0, width=5.0, lines=(*upright, *level))
    field_map = DistanceMap(field=field, cell=cell, device=device)
    along = np.linspace(-0.08, 0.08, 5)
    places = [np.column_stack([np.full(5, x + each), y + along]) for each in offsets[:2]]
    places += [np.column_stack([x + along, np.full(5, y + each)]) for each in offsets[2:]]
    pose = np.array([0.4, -0.3, 0.2])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    points = ((np.concatenate(places) - pose[:2]) @ np.array([[c, -s], [s, c]])).astype(np.float32)
    fit = FieldPoseRefinement(map=field_map)(points, pose[None].astype(np.float32), device=device)
    assert fit.score[0] < 1e-8
    np.testing.assert_allclose(pose_errors(fit.poses[0], pose), 0.0, atol=1e-5)


@pytest.mark.parametrize("count", [12, 64])
def test_every_field_of_a_pose_is_that_of_the_reference(device: Device, count: int, rng: np.random.Generator) -> None:
    """Few points, whose covariance is mostly that of equal variances, and many; a fifth of them lie on no line."""
    field_map = large(device)
    points = view(field_map, POSE, rng, count, sigma=0.06)
    points[: count // 6] += 0.4
    fit = FieldPoseRefinement(map=field_map)(points, POSE[None].astype(np.float32), device=device)
    pose = fit.poses[0].astype(np.float64)
    expected = reference.pose_statistics(field_map.field, pose, points.astype(np.float64), field_map.scale, 4.0)
    for name, value in expected.items():
        size = np.sqrt(np.outer(np.diag(value), np.diag(value))) if np.ndim(value) else value
        np.testing.assert_allclose(getattr(fit, name)[0] / size, value / size, atol=1e-3, err_msg=name)


@pytest.mark.slow
def test_covariance_is_the_scatter(device: Device, rng: np.random.Generator) -> None:
    """Normalised errors of 200 views: a chi squared of three degrees, mean 3 within 4 standard errors of 0.17."""
    field_map = large(device)
    refine = FieldPoseRefinement(map=field_map)
    distances = []
    for _ in range(200):
        points = view(field_map, POSE, rng, 96)
        fit = refine(points, POSE[None].astype(np.float32), device=device)
        far = pose_errors(fit.poses[0], POSE)
        distances.append(far @ fit.information[0] @ far)
        np.testing.assert_allclose(fit.information[0] @ fit.covariance[0], np.eye(3), atol=2e-3)
    assert 2.3 < np.mean(distances) < 3.7


@pytest.mark.slow
def test_sigmas_hold_for_noise_that_grows_with_the_distance(device: Device, rng: np.random.Generator) -> None:
    """Far points err more and have more weight in the heading: 400 views, each ratio known to 3.5 %."""
    field_map = large(device)
    refine = FieldPoseRefinement(map=field_map)
    ratios = []
    for _ in range(400):
        exact = view(field_map, POSE, rng, 128, sigma=0.0)
        away = np.hypot(*exact.T)[:, None]
        points = (exact + rng.normal(0.0, 0.002 + 0.03 * (away / away.max()) ** 3, exact.shape)).astype(np.float32)
        fit = refine(points, POSE[None].astype(np.float32), device=device)
        ratios.append(pose_errors(fit.poses[0], POSE) / np.sqrt(np.diag(fit.covariance[0])))
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(ratios), axis=0)), 1.0, atol=0.1)


@pytest.mark.parametrize(
    ("lines", "arcs"),
    [
        (((-5.0, 1.0, 5.0, 1.0),), ()),
        (((-5.0, 1.0, 5.0, 1.0), (-5.0, -1.0, 5.0, -1.0)), ()),
        ((), (Arc(0.0, 0.0, 2.0),)),
    ],
    ids=["one line", "parallel lines", "circle"],
)
def test_views_that_fix_a_part_only(device: Device, lines: Any, arcs: Any, rng: np.random.Generator) -> None:
    field_map = DistanceMap(field=Field(length=10.0, width=6.0, lines=lines, arcs=arcs), cell=0.1, device=device)
    pose = np.array([0.4, -0.3, 0.5])
    points = view(field_map, pose, rng, reach=3.0)
    fit = FieldPoseRefinement(map=field_map)(points, np.float32([pose]), device=device)
    assert fit.status[0] == Status.AMBIGUOUS
    assert np.isnan(fit.covariance).all()
    assert np.isfinite(fit.poses).all()
    values = np.linalg.eigvalsh(fit.information[0].astype(np.float64))
    assert values[0] < 1e-3 * values[2]
    assert values[1] > 10.0


def test_poses_that_are_none(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    points = view(field_map, POSE, rng)
    starts = np.float32([[np.nan, 0, 0], [0, np.inf, 0], POSE, [1e5, 0.0, 0.0]])
    fit = FieldPoseRefinement(map=field_map)(points, starts, device=device)
    # Far away no point is near a line.
    assert fit.status.tolist() == [Status.NOT_FINITE, Status.NOT_FINITE, Status.OK, Status.LOW_SIGNAL]
    for values in (fit.poses, fit.covariance, fit.information, fit.score, fit.residual_std, fit.inlier_fraction):
        np.testing.assert_array_equal(np.isfinite(values.reshape(4, -1)).all(axis=1), [False, False, True, False])
    refined = FieldPoseRefinement(map=field_map)(points[:3], starts[2:3], device=device)
    assert refined.status[0] == Status.LOW_SIGNAL
    assert np.isnan(refined.poses).all()  # few points alone make the pose invalid; it lies within the map


def test_four_exact_points_are_enough(device: Device) -> None:
    """Two points on each of two border lines fix the pose; three are too few."""
    field_map, pose = large(device), np.float32([[8.9375, 4.9375, 0.0]])
    assert (field_map.field.lines[0][0], field_map.field.lines[0][1]) == (-10.9375, -6.9375)
    points = np.float32([[2.0, -1.0], [2.0, 1.0], [-1.0, 2.0], [1.0, 2.0]])
    fit = FieldPoseRefinement(map=field_map)(points, pose, device=device)
    assert fit.status[0] == Status.OK
    np.testing.assert_array_equal(fit.poses, pose)
    refined = FieldPoseRefinement(map=field_map)(points[:3], pose, device=device)
    assert refined.status[0] == Status.LOW_SIGNAL


def test_wrong_inputs_are_refused(device: Device) -> None:
    field_map = large(device)
    search, refine = FieldPoseSearch(map=field_map), FieldPoseRefinement(map=field_map)
    with pytest.raises(TypeError, match="float32"):
        search(np.zeros((4, 2)), device=device)
    with pytest.raises(ValueError, match="points"):
        search(np.zeros((4, 3), np.float32), device=device)
    with pytest.raises(ValueError, match="points"):
        search(np.zeros((5000, 2), np.float32), device=device)
    with pytest.raises(ValueError, match="heading"):
        FieldPoseSearch(map=field_map, headings=0)
    with pytest.raises(ValueError, match="headings has 8193, expected 8192 at most"):
        FieldPoseSearch(map=field_map, headings=8193)
    with pytest.raises(ValueError, match="count"):
        refine.bind(device, (4, 2), np.float32)
    with pytest.raises(ValueError, match="initial_pose"):
        find_pose_candidates(field_map, np.zeros((4, 2), np.float32), initial_pose=(1.0, 2.0), device=device)
    with pytest.raises(TypeError, match="DistanceMap"):
        FieldPoseSearch(map=field_map.field)
    # A single start is short enough for the calling thread.
    for count in (1, 2):
        launch = replace(refine, count=count).launch(device, (4, 2), np.dtype(np.float32))
        assert launch.passes_once == (count == 1)


@pytest.mark.parametrize("separation", [None, (0.25, 0.4)])
def test_best_poses_of_a_grid_suppress_those_near_them(separation: Any, rng: np.random.Generator) -> None:
    """The same by plain loops: least costs first, without poses within both the distance and the angle of a better."""
    far, turned = (0.3, math.radians(20.0)) if separation is None else separation
    field_map: Any = SimpleNamespace(scale=0.15, cell=0.1, first_position=(-1.5, 0.7))
    angles = np.array([-3.0, -2.7, -0.1, 0.15, 1.0, 3.1])
    least = rng.uniform(0.0, 1.0, (6, 7, 2)).astype(np.float32)
    least[2, 3, 1], least[0, 0, 0] = np.nan, np.inf
    column = rng.integers(0, 20, least.shape)
    search: Any = SimpleNamespace(map=field_map, angles=angles)
    costs: Any = SimpleNamespace(least=least, column=column)
    for count in (1, 8, 200):
        found = FieldPoseSearch.best(search, costs, count, separation=separation)
        places = [
            (float(least[k]), -1.5 + 0.1 * column[k], 0.7 + 0.1 * k[1], angles[k[0]])
            for k in np.ndindex(least.shape)
            if math.isfinite(least[k])
        ]
        expected: list[Any] = []
        for cost, x, y, angle in sorted(places):
            if len(expected) < count and not any(
                math.hypot(x - u, y - v) < far and abs(math.remainder(angle - w, 2.0 * math.pi)) < turned
                for _, u, v, w in expected
            ):
                expected.append((cost, x, y, angle))
        np.testing.assert_allclose(found[0], [each[1:] for each in expected], atol=1e-12)
        np.testing.assert_array_equal(found[1], np.float32([each[0] for each in expected]))
    assert 8 < len(expected) < len(places)
