"""Parts of the robust pose fit (kernels/pose/pose.h): start, scale, sums and covariance, against their definition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
SOURCE = """
#include "pose/pose_input.h"
#include "pose/pose.h"
#include "pose/pose_start.h"
#define PUT(value) out[to++] = (value)
#define PUT_MATRIX(of) PUT((of).dxx), PUT((of).dxy), PUT((of).dyx), PUT((of).dyy)
#define PUT_POSE(of) PUT_MATRIX(of), PUT((of).x), PUT((of).y), PUT((of).etch)

kernel void parts(global const real *given, global const real *poses, constant int *subsets, global real *made,
                  const int trials, const real scale, const real reach, const real etch) {
    const size_t n = get_global_id(0);
    real columns[8][CAPACITY], distances[CAPACITY];
    for (int k = 0; k < 8; k++)
        for (int i = 0; i < CAPACITY; i++) columns[k][i] = given[(n * 8 + k) * CAPACITY + i];
    const pose_rows all = {columns[0], columns[1], columns[2], columns[3], columns[4],
                           columns[5], columns[6], columns[7], CAPACITY,   etch};
    const pose_room room = {distances, 0};
    const laned_pose pose = {poses[7 * n],     poses[7 * n + 1], poses[7 * n + 2], poses[7 * n + 3],
                             poses[7 * n + 4], poses[7 * n + 5], poses[7 * n + 6]};
    global real *out = made + 160 * n;
    int to = 0, present = rows_present(all, room);
    PUT(present);
    PUT(pose_score(pose, all, room, present));
    PUT(pose_scale(pose, all, room, reach, FEW_TRIED, 0.01f));
    PUT(pose_scale(pose, all, room, INFINITY, FEW_FITTED, 9.0f));
    masks bad = 0;
    const laned_pose through = pose_through(pose, all, subsets, &bad);
    PUT(bad != 0);
    PUT_POSE(through);
    laned_pose start = pose;
    pose_start(&start, all, subsets, trials, room, present);
    PUT_POSE(start);
    pose_sums sums, of_rows;
    pose_summed(&pose, all, 1 / scale, WEIGHTED, room, &sums);
    for (int k = 0; k < TRIANGLE; k++) PUT(sums.matrix[k]);
    int is_singular;
    const laned_pose stepped = pose_stepped(pose, &sums, etch, &is_singular);
    PUT_POSE(stepped);
    pose_summed(&pose, all, 1 / scale, EVERY_ROW, room, &of_rows);
    for (int k = 0; k < TRIANGLE; k++) PUT(of_rows.matrix[k]);
    pose_summed(&pose, all, 1 / scale, EVENLY, room, &sums);
    solved_pose fit;
    fit.pose = pose, fit.scale = scale, fit.present = present;
    pose_judged(&fit, &of_rows, &sums, etch, 1e-4f);
    PUT(fit.inliers), PUT(fit.rank), PUT(fit.residual_scale), PUT(fit.variance), PUT(fit.condition);
    PUT(pose_leverage(&fit, all, room));
    for (int i = 0; i < FREEDOMS; i++)
        for (int k = 0; k < FREEDOMS; k++) PUT(fit.covariance[i][k]);
}
"""
FRAMES = """
#include "pose/pose_input.h"
#ifdef IN_GROUP
#include "pose/pose_group_rows.h"
#else
#include "pose/pose_rows.h"
#endif
#define PUT(value) out[to++] = (value)

kernel void framed(global const PoseRow *rows, global real *out, const int count, const real etch) {
    int to = 0;
#ifdef IN_GROUP
    local real sums[ROOM_FOR(3)];
    const pose_rows all = framed_rows(rows, count, etch, sums);
    const pose_frame frame = all.frame;
    if (get_local_id(0) > 0) return;
#else
    real numbers[POSE_COLUMNS][CAPACITY];
    pose_rows all = rows_in(numbers, count, etch);
    for (int i = 0; i < count; i++) put_row(all, i, read_row(rows + i, 1));
    const pose_frame frame = centre_rows(&all);
#endif
    PUT(frame.x), PUT(frame.y), PUT(frame.size), PUT(frame.per_size), PUT(all.etch);
    PUT(read_row(rows, 0).certainty);
    for (int i = 0; i < count; i++) {
        const laned_row row = row_of(all, i);
        PUT(row.nx), PUT(row.ny), PUT(row.px), PUT(row.py), PUT(row.ex), PUT(row.ey), PUT(row.certainty);
        PUT(row.etch_factor);
    }
}
"""
CAPACITY, TUNING, EFFICIENCY, ROWS = 24, 4.0, 0.9, 21
BUILDS = [(3, False, 1.5), (4, True, None), (6, True, None)]


def tukey(z: Reals) -> Reals:
    return np.where(np.abs(z) < TUNING, (1.0 - (z / TUNING) ** 2) ** 2, 0.0)


def tukey_slope(z: Reals) -> Reals:
    part = (z / TUNING) ** 2
    return np.where(part < 1.0, (1.0 - part) * (1.0 - 5.0 * part), 0.0)


def tukey_loss(z: Reals) -> Reals:
    return TUNING**2 / 6.0 * (1.0 - np.maximum(1.0 - (z / TUNING) ** 2, 0.0) ** 3)


class Problem:
    """Rows of a pose (8, n): normal, place, displacement, certainty and etch factor; as many parameters."""

    def __init__(self, rows: Reals, parameters: int, has_etch: bool) -> None:
        self.rows, self.parameters, self.has_etch = rows, parameters, has_etch
        self.there = rows[6] > 0.0

    def residuals(self, pose: Reals) -> Reals:
        """Return n (T^-1(p + e) - p) - g etch at a pose (7,): matrix less 1, translation, etch bias."""
        normal, point, away = self.rows[:2].T, self.rows[2:4].T, self.rows[4:6].T
        back = np.linalg.inv(np.eye(2) + pose[:4].reshape(2, 2))
        return np.asarray(
            np.sum(normal * ((point + away - pose[4:6]) @ back.T - point), axis=1) - self.rows[7] * pose[6]
        )

    def after(self, pose: Reals, step: Reals) -> Reals:
        """Return the pose after a step: turned by the angle whose tangent the step has, then stretched."""
        turn = np.array([[1.0, -step[2]], [step[2], 1.0]]) / np.hypot(1.0, step[2])
        stretch = np.eye(2)
        if self.parameters == 6:
            stretch += np.array([[step[3], step[5]], [0.0, step[4]]])
        elif self.parameters == 4:
            stretch *= 1.0 + step[3]
        matrix = np.eye(2) + pose[:4].reshape(2, 2)
        etch = pose[6] + step[self.parameters] if self.has_etch else 0.0
        moved = pose[4:6] + matrix @ step[:2]
        return np.array([*(matrix @ turn @ stretch - np.eye(2)).ravel(), *moved, etch])

    def slopes(self, pose: Reals) -> Reals:
        """Return by how much a step reduces the residuals, (n, unknowns)."""
        moves = 1e-6 * np.eye(self.parameters + self.has_etch)
        by = [
            (self.residuals(self.after(pose, -each)) - self.residuals(self.after(pose, each))) / 2e-6 for each in moves
        ]
        return np.stack(by, axis=-1)

    def normal(self, pose: Reals, weight: Reals, etch: float) -> tuple[Reals, Reals]:
        """Return the normal equations with the prior of the etch bias."""
        slopes = self.slopes(pose)
        matrix, right = slopes.T @ (weight[:, None] * slopes), slopes.T @ (weight * self.residuals(pose))
        if self.has_etch:
            matrix[-1, -1] += etch**2
            right[-1] -= etch**2 * pose[6]
        return matrix, right

    def through(self, pose: Reals, subset: NDArray[np.int32], etch: float) -> Reals | None:
        """Return the pose through some rows after three steps; None if they determine none."""
        chosen = Problem(self.rows[:, subset], self.parameters, self.has_etch)
        weight = chosen.rows[6] ** 2 if self.has_etch else chosen.there.astype(float)
        for _ in range(3):
            matrix, right = chosen.normal(pose, weight, etch)
            if np.linalg.cond(matrix) > 1e5:
                return None
            pose = chosen.after(pose, np.linalg.solve(matrix, right))
        return pose


def some_problem(rng: np.random.Generator, parameters: int, has_etch: bool) -> tuple[Problem, Reals]:
    """Return rows about a pose, a fifth of them outliers, some missing; and a pose a little beside it."""
    stretch = {3: (0.0, 0.0, 0.0), 4: (0.02, 0.02, 0.0), 6: (0.02, -0.01, 0.015)}[parameters]
    angle, shift, etch = rng.normal(0.0, 0.05), rng.normal(0.0, 0.1, 2), 0.03 if has_etch else 0.0
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ (np.eye(2) + np.array([[stretch[0], stretch[2]], [0.0, stretch[1]]]))
    direction, point = rng.uniform(0.0, 2.0 * np.pi, ROWS), rng.normal(0.0, 0.8, (ROWS, 2))
    normal, sigma = np.stack([np.cos(direction), np.sin(direction)], axis=-1), rng.uniform(0.01, 0.03, ROWS)
    factor = rng.choice([0.0, 1.0, 1.0], ROWS)
    off = sigma * rng.normal(0.0, 1.0, ROWS) + np.where(rng.random(ROWS) < 0.2, rng.choice([-0.4, 0.5], ROWS), 0.0)
    seen = (point + (off + factor * etch)[:, None] * normal) @ matrix.T + shift
    rows = np.zeros((8, CAPACITY))
    certainty = np.where(rng.random(ROWS) < 0.1, 0.0, 1.0 / sigma)
    rows[:, :ROWS] = np.vstack([normal.T, point.T, (seen - point).T, certainty, factor * has_etch])
    pose = np.array([*(matrix - np.eye(2)).ravel(), *shift, etch])
    near = pose + np.append(0.01 * rng.normal(size=6), 0.0)
    return Problem(rows.astype(np.float32).astype(np.float64), parameters, has_etch), near


@pytest.mark.parametrize(("parameters", "has_etch", "given_scale"), BUILDS)
def test_parts_of_the_fit(
    device: Device, parameters: int, has_etch: bool, given_scale: float | None, rng: np.random.Generator, tmp_path: Path
) -> None:
    freedoms, trials, scale, reach, etch = parameters + has_etch, 10, 1.5, 3.0, 20.0
    problems = [some_problem(rng, parameters, has_etch) for _ in range(8)]
    subsets = np.array([rng.choice(ROWS, freedoms, replace=False) for _ in range(trials)], np.int32)
    # One row twice determines no pose.
    subsets[4, 1] = subsets[4, 0]
    defines: dict[str, Any] = {"INPUT": "float", "POSE_PARAMETERS": parameters, "FREEDOMS": freedoms, "START_STEPS": 3}
    defines |= {"CAPACITY": CAPACITY, "LOSS_TUKEY": None, "TUNING_CONSTANT": TUNING, "EFFICIENCY": EFFICIENCY}
    defines |= ({"WITH_ETCH_BIAS": None} if has_etch else {}) | ({"GIVEN_SCALE": given_scale} if given_scale else {})
    (tmp_path / "parts.cl").write_text(SOURCE)
    kernel = build(device, tmp_path, "parts.cl", defines, include_folders=(KERNEL_FOLDER,)).parts
    arrays = [np.array([each.rows for each, _ in problems]), np.array([pose for _, pose in problems])]
    arrays = [*(each.astype(np.float32) for each in arrays), subsets, np.zeros((len(problems), 160), np.float32)]
    given = [cl.array.to_device(device.queue, each) for each in arrays]
    numbers = (np.int32(trials), *map(np.float32, (scale, reach, etch)))
    kernel(device.queue, (len(problems),), None, *(each.data for each in given), *numbers)
    poses = arrays[1].astype(np.float64)
    starts = 0
    for (problem, _), pose, out in zip(problems, poses, given[-1].get().astype(np.float64), strict=True):
        sizes = (4, 1, 7, 7, freedoms * (freedoms + 1) // 2, 7, freedoms * (freedoms + 1) // 2, 6, freedoms**2)
        parts = np.split(out, np.cumsum(sizes))
        starts += assert_starts(problem, pose, parts, subsets, given_scale, reach, etch)
        assert_sums(problem, pose, parts, given_scale, scale, etch)
    assert starts > 4


def assert_starts(
    problem: Problem,
    pose: Reals,
    parts: list[Reals],
    subsets: Any,
    given_scale: float | None,
    reach: float,
    etch: float,
) -> bool:
    """Assert score, scales, the pose through the first rows and the start; return whether the start is compared."""
    there, certainty, freedoms = problem.there, problem.rows[6], problem.parameters + problem.has_etch
    present = int(there.sum())

    def sigmas(at: Reals) -> Reals:
        return np.where(there, np.abs(problem.residuals(at) * certainty), np.inf)

    def score(at: Reals) -> float:
        if given_scale is None:
            return float(np.sort(sigmas(at))[(present + freedoms + 1) // 2 - 1])
        return float(np.sum(tukey_loss(problem.residuals(at) * certainty / given_scale)))

    counts, bad, through, start = parts[0], parts[1], parts[2], parts[3]
    assert counts[0] == present
    slack = 1.0 / 128.0 if given_scale is None else 1e-4
    assert score(pose) * (1.0 - slack) * (1.0 - 1e-4) <= counts[1] <= score(pose) * (1.0 + 1e-4)
    z = sigmas(pose)
    for found, few, most, least in ((counts[2], 5.0, reach, 0.01), (counts[3], 1.0, np.inf, 9.0)):
        within = int(np.sum(there & (z <= most)))
        middle = float(np.sort(z)[within // 2])
        scale = 1.4826022185056018 * (1.0 + few / max(within - freedoms, 1)) * middle
        low, high = (max(least, scale * part) for part in (1.0 - 1.0 / 128.0, 1.0))
        if given_scale is not None:
            low = high = given_scale
        assert low * (1.0 - 1e-4) <= found <= high * (1.0 + 1e-4)
    first = problem.through(pose, subsets[0], etch)
    if first is not None:
        assert bad[0] == 0.0
        np.testing.assert_allclose(through, first, rtol=1e-2, atol=2e-3)
    candidates = [problem.through(pose, each, etch) for each in subsets]
    scores = sorted((score(each), number) for number, each in enumerate(candidates) if each is not None)
    if len(scores) < 2 or scores[1][0] < 1.05 * scores[0][0]:
        return False
    np.testing.assert_allclose(start, candidates[scores[0][1]], rtol=1e-2, atol=3e-3)
    return True


def assert_sums(
    problem: Problem, pose: Reals, parts: list[Reals], given_scale: float | None, scale: float, etch: float
) -> None:
    """Assert the sums over the rows, a step, and the quality of a pose."""
    weighted, stepped, every, quality, covariance = parts[4:9]
    freedoms, certainty = problem.parameters + problem.has_etch, problem.rows[6]
    lower = np.tril_indices(freedoms)
    z = problem.residuals(pose) * certainty / scale
    weight = tukey(z)
    plain, _ = problem.normal(pose, certainty**2 * weight, 0.0)
    size = np.sqrt(np.diag(plain))
    unit = np.outer(size, size)[lower]
    np.testing.assert_allclose(weighted / unit, plain[lower] / unit, rtol=0, atol=1e-3)
    matrix, right = problem.normal(pose, certainty**2 * weight, etch)
    np.testing.assert_allclose(stepped, problem.after(pose, np.linalg.solve(matrix, right)), rtol=5e-3, atol=5e-4)
    full, _ = problem.normal(pose, certainty**2, etch)
    np.testing.assert_allclose(
        every / unit, (full - _prior(freedoms, problem, etch))[lower] / unit, rtol=1e-3, atol=1e-3
    )
    is_in = (certainty > 0.0) & (weight > 0.0)
    inner, _ = problem.normal(pose, certainty**2 * is_in, etch)
    count = int(is_in.sum())
    mean = np.sum(tukey_slope(z)[is_in]) / count
    spread = scale * np.sqrt(np.sum((weight * z)[is_in] ** 2) / (count - freedoms)) / mean
    whole = scale**2 / EFFICIENCY if given_scale is not None else spread**2
    part = np.linalg.inv(np.linalg.inv(inner)[: problem.parameters, : problem.parameters])
    values = np.linalg.eigvalsh(part)
    condition = np.sqrt(values[-1] / values[0])
    rows = problem.slopes(pose)[is_in] * certainty[is_in, None]
    leverage = np.einsum("ni,ij,nj->n", rows, np.linalg.inv(inner), rows).max()
    np.testing.assert_allclose(quality, [count, problem.parameters, spread, whole, condition, leverage], rtol=5e-3)
    expected = whole * np.linalg.inv(inner)
    size = np.sqrt(np.diag(expected))
    scaled = covariance.reshape(freedoms, freedoms) / np.outer(size, size)
    np.testing.assert_allclose(scaled, expected / np.outer(size, size), rtol=0, atol=5e-3)


def _prior(freedoms: int, problem: Problem, etch: float) -> Reals:
    prior = np.zeros((freedoms, freedoms))
    prior[-1, -1] = etch**2 if problem.has_etch else 0.0
    return prior


@pytest.mark.parametrize("group", [0, 16])
@pytest.mark.parametrize("has_etch", [False, True])
def test_frames_of_rows(device: Device, group: int, has_etch: bool, rng: np.random.Generator, tmp_path: Path) -> None:
    """Rows are relative to their centre, in units of their size; rows without numbers or sigma are missing."""
    count, etch, wrong = 90, 20.0, (0, 5, 9, 14, 17, 22, 31, 40, 44)
    numbers = rng.uniform([-1, -1, 3, -9, -0.1, -0.2, 0.01, -2], [1, 1, 7, -3, 0.1, 0.2, 0.03, 2], (count, 8))
    numbers = numbers[:, : 7 + has_etch]
    for column, row in enumerate(wrong[: 7 + has_etch]):
        numbers[row, column] = np.nan if column % 2 else np.inf
    numbers[wrong[-1], 6], numbers[50, 6] = 0.0, -0.01
    numbers = numbers.astype(np.float32)
    defines: dict[str, Any] = {"INPUT": "float", "POSE_PARAMETERS": 3, "FREEDOMS": 3 + has_etch}
    defines |= {"CAPACITY": count, "TUNING_CONSTANT": TUNING}
    defines |= ({"WITH_ETCH_BIAS": None} if has_etch else {}) | ({"GROUP_PER_PROBLEM": None} if group else {})
    (tmp_path / "frames.cl").write_text(FRAMES)
    kernel = build(device, tmp_path, "frames.cl", defines, include_folders=(KERNEL_FOLDER,)).framed
    rows = cl.array.to_device(device.queue, numbers)
    made = cl.array.zeros(device.queue, 6 + 8 * count, np.float32)
    size = (group,) if group else (1,)
    kernel(device.queue, size, size, rows.data, made.data, np.int32(count), np.float32(etch))
    out = made.get().astype(np.float64)
    there = np.isfinite(numbers).all(axis=1) & (numbers[:, 6] > 0.0)
    assert np.sum(~there) == 9 + has_etch
    expected = np.zeros((count, 8))
    expected[:, : 7 + has_etch] = np.where(there[:, None], numbers, 0.0)
    centre = expected[there, 2:4].mean(axis=0)
    extent = np.sqrt(np.mean(np.sum((expected[there, 2:4] - centre) ** 2, axis=1)))
    np.testing.assert_allclose(out[:6], [*centre, extent, 1.0 / extent, etch * extent, 0.0], rtol=1e-5)
    expected[there, 2:4] -= centre
    expected[:, 2:6] /= extent
    expected[there, 6] = extent / expected[there, 6]
    np.testing.assert_allclose(out[6:].reshape(count, 8), expected, rtol=1e-4, atol=1e-5)
