"""Flag NOT_CONVERGED of fits: it follows the distance to the minimum that a general minimiser finds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from field_maps import large
from gpuvision.host import Device
from gpuvision.matching.features.line_fit import FitLines, LineFits
from gpuvision.matching.field.field_pose import FieldPoseRefinement
from gpuvision.matching.pose.pose import BoardPose, SolvePose, line_rows
from gpuvision.reference import field as field_reference
from gpuvision.reference import robust
from gpuvision.status import Status

Reals = NDArray[np.float64]
ON_DEVICES = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
DTYPES = pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.double)])
NOISE, SIGMA, PLACE = 0.05, 2e-6, (0.01, -0.01)
# Distances to the minimum [standard deviations] from which on the flag must be absent or present. The limit is 0.1; the
# Newton step takes the mean curvature of the loss for the curvature in each direction.
NEAR, FAR = 0.05, 0.25


def assert_follows(status: Any, distance: Reals) -> None:
    """Assert that results far from the minimum have the flag, and results near it do not; NaN: no result."""
    is_open = (np.asarray(status) & Status.NOT_CONVERGED) != 0
    assert is_open[distance > FAR].all(), distance[~is_open]
    assert not is_open[distance < NEAR].any(), distance[is_open]
    assert not is_open[np.isnan(distance)].any()


def point_sets(rng: np.random.Generator, sets: int, count: int, bad: float) -> Reals:
    """Return points (sets, count, 2) along lines; a share of them are gross errors."""
    angle, middle = rng.uniform(-np.pi / 2, np.pi / 2, (sets, 1)), rng.uniform(0.0, 100.0, (sets, 1, 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    u, v = rng.uniform(-30.0, 30.0, (sets, count, 1)), rng.normal(0.0, NOISE, (sets, count, 1))
    far = int(bad * count)
    v[:, :far] += NOISE * rng.uniform(2.0, 30.0, (sets, far, 1)) * rng.choice([-1.0, 1.0], (sets, far, 1))
    return np.asarray(middle + u * along + v * normal)


def distances_of_lines(operation: FitLines, points: Any, fits: LineFits) -> Reals:
    """Return the distance of each line from the minimum of its loss [standard deviations]; NaN without a line."""
    found = np.full(len(points), np.nan)
    for number in np.flatnonzero(np.isfinite(fits.distance)):
        known = points[number].astype(np.float64)
        angle = float(np.arctan2(-fits.normal[number, 0], fits.normal[number, 1]))
        start, scale = (angle, float(fits.distance[number])), float(fits.scale[number])
        assert operation.tuning_constant is not None
        least = robust.fit_line(known, np.ones(len(known)), scale, operation.loss, operation.tuning_constant, start)
        offset = fits.centre[number].astype(np.float64) @ [-np.sin(least[0]), np.cos(least[0])] - least[1]
        variance = np.diag(fits.covariance[number]).astype(np.float64)
        found[number] = np.hypot((angle - least[0]) / np.sqrt(variance[0]), offset / np.sqrt(variance[1]))
    return found


@VARIANTS
@DTYPES
@pytest.mark.parametrize(("loss", "scale"), [("tukey", NOISE), ("huber", NOISE), ("tukey", None)])
def test_flags_of_lines(
    device: Device, loss: Any, scale: Any, dtype: Any, variant: Any, rng: np.random.Generator
) -> None:
    points = point_sets(rng, 20, 20, 0.3).astype(dtype)
    share = {}
    for steps, trials in ((1, 1), (1, 64), (12, 64), (60, 64)):
        operation = FitLines(loss=loss, scale=scale, max_iterations=steps, max_trials=trials, variant=variant)
        fits = operation(points, device=device)
        assert_follows(fits.status, distances_of_lines(operation, points, fits))
        share[steps, trials] = np.mean((fits.status & Status.NOT_CONVERGED) != 0)
    assert share[1, 1] > 0.3
    assert share[60, 64] == 0.0


@ON_DEVICES
@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 40),
    st.sampled_from(["tukey", "huber", "least_squares"]),
    st.sampled_from([NOISE, None]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
)
def test_converged_lines_never_have_the_flag(
    device: Device, seed: int, count: int, loss: Any, scale: Any, bad: float, size: float
) -> None:
    """Exact points, and coordinates from 1e-6 to 1e4 times the noise; more iterations change no line."""
    rng = np.random.default_rng(seed)
    points = (size * point_sets(rng, 16, count, bad) if size else np.rint(point_sets(rng, 16, count, bad))).astype(
        np.float32
    )
    operation = FitLines(loss=loss, scale=scale and scale * (size or 1.0), max_iterations=200)
    fits = operation(points, device=device)
    open_ones = np.flatnonzero(fits.status & Status.NOT_CONVERGED)
    assert not len(open_ones), distances_of_lines(operation, points[open_ones], take(fits, open_ones))


def take(result: Any, numbers: Any) -> Any:
    """Return some elements of a batch of results."""
    return type(result)(*(None if each is None else each[numbers] for each in result))


def boards(rng: np.random.Generator, count: int, rows: int, bad: float, turn: float) -> Reals:
    """Return rows (count, rows, 7) of edges of boards, the first ones gross errors."""
    angle = rng.uniform(0.0, np.pi, (count, rows))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    point = rng.uniform(-0.015, 0.015, (count, rows, 2))
    error = rng.normal(0.0, SIGMA, (count, rows))
    far = int(bad * rows)
    error[:, :far] += SIGMA * rng.uniform(2.0, 30.0, (count, far)) * rng.choice([-1.0, 1.0], (count, far))
    made = []
    for number in range(count):
        matrix, shift = robust.transform_of(rng.uniform(-1.0, 1.0, 3) * [1e-3, 1e-3, turn])
        seen = (point[number] + error[number, :, None] * normal[number]) @ matrix.T + shift
        made.append(line_rows(normal[number], point[number], seen, SIGMA))
    return np.stack(made)


def distances_of_poses(operation: SolvePose, rows: Any, result: BoardPose) -> Reals:
    """Return the distance of each pose from the minimum of its loss [standard deviations]; NaN without a pose."""
    found = np.full(len(rows), np.nan)
    for number in np.flatnonzero(np.isfinite(result.pose[:, 0])):
        start, scale = result.pose[number].astype(np.float64), float(result.scale[number])
        assert operation.tuning_constant is not None
        least = robust.solve_pose(
            rows[number].astype(np.float64), 3, scale, operation.loss, operation.tuning_constant, start
        )
        matrix, shift = robust.transform_of(least)
        moved = np.array([*result.placement[number], start[2]]) - [*(matrix @ operation.placement + shift), least[2]]
        found[number] = np.sqrt(moved @ np.linalg.solve(result.covariance[number].astype(np.float64), moved))
    return found


@VARIANTS
@DTYPES
@pytest.mark.parametrize(
    ("loss", "scale", "bad", "turn"),
    [("tukey", 1.0, 0.3, 0.03), ("huber", None, 0.2, 0.03), ("least_squares", None, 0.0, 0.3)],
)
def test_flags_of_poses(
    device: Device,
    loss: Any,
    scale: Any,
    bad: float,
    turn: float,
    dtype: Any,
    variant: Any,
    rng: np.random.Generator,
) -> None:
    rows = boards(rng, 16, 24, bad, turn).astype(dtype)
    share = {}
    for steps in (1, 2, 3, 12, 60):
        operation = SolvePose(loss=loss, scale=scale, max_iterations=steps, placement=PLACE, variant=variant)
        result = operation(rows, device=device)
        assert_follows(result.status, distances_of_poses(operation, rows, result))
        share[steps] = np.mean(result.status == Status.NOT_CONVERGED)
    assert share[1] > 0.3
    assert share[60] == 0.0


@ON_DEVICES
@given(
    st.integers(0, 2**32 - 1),
    st.integers(3, 40),
    st.sampled_from(["tukey", "huber", "least_squares"]),
    st.sampled_from([1.0, None]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 1e-3, 0.4]),
    st.booleans(),
)
def test_converged_poses_never_have_the_flag(
    device: Device, seed: int, count: int, loss: Any, scale: Any, bad: float, turn: float, exact: bool
) -> None:
    """Also of exact rows, whose residuals are rounding, and of as many rows as unknowns."""
    rows = boards(np.random.default_rng(seed), 16, count, bad, turn)
    if exact:
        rows[..., 4:6] = 0.0
    operation = SolvePose(loss=loss, scale=scale, max_iterations=200, placement=PLACE)
    result = operation(rows.astype(np.float32), device=device)
    open_ones = np.flatnonzero(result.status == Status.NOT_CONVERGED)
    assert not len(open_ones), distances_of_poses(operation, rows[open_ones], take(result, open_ones))


def test_flags_of_poses_on_a_field(device: Device, rng: np.random.Generator) -> None:
    field_map = large(device)
    pose = np.array([3.1, -2.2, 0.7])
    points = field_reference.draw_line_points(field_map.field, pose, rng, 96, 5.0, 0.03).astype(np.float32)
    starts = (pose + rng.uniform(-1.0, 1.0, (12, 3)) * [0.1, 0.1, 0.05]).astype(np.float32)
    share = {}
    for steps in (1, 2, 3, 40):
        fits = FieldPoseRefinement(map=field_map, max_iterations=steps)(points, starts, device=device)
        distance = np.full(len(starts), np.nan)
        for number, found in enumerate(fits.poses.astype(np.float64)):
            least = field_reference.refine_pose(field_map.field, found, points.astype(np.float64), field_map.scale)
            distance[number] = np.sqrt((found - least) @ fits.information[number].astype(np.float64) @ (found - least))
        assert_follows(fits.status, distance)
        share[steps] = np.mean((fits.status & Status.NOT_CONVERGED) != 0)
    assert share[1] > 0.5
    assert share[40] == 0.0


@ON_DEVICES
@given(st.integers(0, 2**32 - 1), st.sampled_from([6, 24, 96]), st.sampled_from([0.0, 0.03, 0.1]))
def test_converged_poses_on_a_field_never_have_the_flag(device: Device, seed: int, count: int, noise: float) -> None:
    rng, field_map = np.random.default_rng(seed), large(device)
    pose = rng.uniform([-8.0, -5.0, -np.pi], [8.0, 5.0, np.pi])
    points = field_reference.draw_line_points(field_map.field, pose, rng, count, 5.0, noise).astype(np.float32)
    starts = (pose + rng.uniform(-1.0, 1.0, (8, 3)) * [0.1, 0.1, 0.05]).astype(np.float32)
    fits = FieldPoseRefinement(map=field_map, max_iterations=200)(points, starts, device=device)
    assert not (fits.status & Status.NOT_CONVERGED).any()
