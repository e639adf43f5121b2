"""Pose from the rows of edges and fiducials, compared with Numba and NumPy.

The rows are edges in all directions on a board of 100 mm, with a standard deviation each; a fifth of them are gross
errors. A fit starts from the best of 64 triples by Tukey's loss, does twelve iterations, and computes the covariance at
the placement point. The peers do the same: Numba in one thread, because the iterations depend on each other, and NumPy
with arrays over trials and rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.matching.robust import sample_subsets
from gpuvision.profiling.harness import Case, traffic_of
from gpuvision.profiling.line_fit import EFFICIENCY, STEPS, TRIALS, TUNING_CONSTANT

PLACEMENT = (2e-3, -1e-3)  # m
_TRUE_POSE = (3e-5, -2e-5, 0.004)  # m, m, rad
_SIZE, _SIGMA = 0.1, 2e-6  # m
_PER = np.float32(1.0 / TUNING_CONSTANT**2)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_SUMS = {"contract", "reassoc"}


@numba.njit(error_model="numpy")
def _solve3(m, r, d):
    """Solve a symmetric 3 x 3 system, triangle (00, 10, 11, 20, 21, 22), by Cramer's rule; return its determinant."""
    a, b, c = m[2] * m[5] - m[4] * m[4], m[3] * m[4] - m[1] * m[5], m[1] * m[4] - m[2] * m[3]
    e, f, g = m[0] * m[5] - m[3] * m[3], m[1] * m[3] - m[0] * m[4], m[0] * m[2] - m[1] * m[1]
    determinant = m[0] * a + m[1] * b + m[3] * c
    per = _ONE / determinant
    d[0] = (a * r[0] + b * r[1] + c * r[2]) * per
    d[1] = (b * r[0] + e * r[1] + f * r[2]) * per
    d[2] = (c * r[0] + f * r[1] + g * r[2]) * per
    return determinant


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _add(rows, i, pose, weight, m, r):
    """Add the weighted normal equation of a row at a pose (cosine - 1, sine, x, y)."""
    less, sine = pose[0], pose[1]
    wx = rows[4, i] - pose[2] - (less * rows[2, i] - sine * rows[3, i])
    wy = rows[5, i] - pose[3] - (sine * rows[2, i] + less * rows[3, i])
    bx, by = wx + less * wx + sine * wy, wy + less * wy - sine * wx
    left = rows[0, i] * bx + rows[1, i] * by
    turn = rows[1, i] * (rows[2, i] + bx) - rows[0, i] * (rows[3, i] + by)
    a, b, c = weight * rows[0, i], weight * rows[1, i], weight * turn
    m[0] += a * rows[0, i]
    m[1] += b * rows[0, i]
    m[2] += b * rows[1, i]
    m[3] += c * rows[0, i]
    m[4] += c * rows[1, i]
    m[5] += c * turn
    r[0] += a * left
    r[1] += b * left
    r[2] += c * left


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _left(rows, i, pose):
    less, sine = pose[0], pose[1]
    wx = rows[4, i] - pose[2] - (less * rows[2, i] - sine * rows[3, i])
    wy = rows[5, i] - pose[3] - (sine * rows[2, i] + less * rows[3, i])
    return rows[0, i] * (wx + less * wx + sine * wy) + rows[1, i] * (wy + less * wy - sine * wx)


@numba.njit(error_model="numpy")
def _move(pose, d):
    c = _ONE / np.sqrt(_ONE + d[2] * d[2])
    s = d[2] * c
    less = -s * s / (_ONE + c)
    old, sine = pose[0], pose[1]
    pose[2] += d[0] + old * d[0] - sine * d[1]
    pose[3] += d[1] + old * d[1] + sine * d[0]
    pose[0] = old + less + old * less - sine * s
    pose[1] = sine + s + sine * less + old * s


@numba.njit(error_model="numpy", fastmath=_SUMS)
def fit_pose(rows, starts, placement, pose, covariance):
    """Solve the pose from rows (7, n), relative to their centre, and its covariance at the placement point."""
    count = rows.shape[1]
    m, r, d = np.empty(6, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    x, y = np.mean(rows[2]), np.mean(rows[3])
    rows[2] -= x
    rows[3] -= y
    size = np.sqrt(np.mean(rows[2] * rows[2] + rows[3] * rows[3]))
    rows[2:6] /= size
    rows[6] *= size
    tried, best, least = np.zeros(4, np.float32), np.zeros(4, np.float32), np.float32(np.inf)
    for t in range(starts.shape[0]):
        tried[:] = _ZERO
        good = True
        for _ in range(3):
            m[:] = _ZERO
            r[:] = _ZERO
            for k in range(3):
                _add(rows, starts[t, k], tried, _ONE, m, r)
            good &= _solve3(m, r, d) > np.float32(1e-6)
            _move(tried, d)
        loss = _ZERO
        for i in range(count):
            z = _left(rows, i, tried) * rows[6, i]
            part = max(_ONE - z * z * _PER, _ZERO)
            loss += _ONE - part * part * part
        if good & (loss < least):
            least = loss
            best[:] = tried
    for step in range(STEPS + 1):
        m[:] = _ZERO
        r[:] = _ZERO
        for i in range(count):
            z = _left(rows, i, best) * rows[6, i]
            part = max(_ONE - z * z * _PER, _ZERO)
            weight = part * part if step < STEPS else np.float32(part > _ZERO)
            _add(rows, i, best, weight * rows[6, i] * rows[6, i], m, r)
        if step < STEPS:
            _solve3(m, r, d)
            _move(best, d)
    inverse = np.empty((3, 3), np.float32)
    for i in range(3):
        r[:] = _ZERO
        r[i] = _ONE
        _solve3(m, r, d)
        inverse[i] = d / EFFICIENCY
    at_x, at_y = (placement[0] - x) / size, (placement[1] - y) / size
    lever = np.zeros((3, 3), np.float32)
    lever[0, 0], lever[0, 1], lever[0, 2] = _ONE + best[0], -best[1], -at_y * (_ONE + best[0]) - at_x * best[1]
    lever[1, 0], lever[1, 1], lever[1, 2] = best[1], _ONE + best[0], at_x * (_ONE + best[0]) - at_y * best[1]
    lever[:2] *= size
    lever[2, 2] = _ONE
    for i in range(3):
        for j in range(3):
            total = _ZERO
            for k in range(3):
                for n in range(3):
                    total += lever[i, k] * inverse[k, n] * lever[j, n]
            covariance[i, j] = total
    pose[0] = placement[0] + (best[2] + best[0] * at_x - best[1] * at_y) * size
    pose[1] = placement[1] + (best[3] + best[1] * at_x + best[0] * at_y) * size
    pose[2] = np.arctan2(best[1], _ONE + best[0])


def factor_flops(unknowns: int) -> int:
    """Return the operations of a Cholesky factorisation in kernels/common/least_squares.h."""
    return sum(i * i + 2 * i + 2 for i in range(unknowns))


def solve_flops(unknowns: int) -> int:
    """Return the operations of a solution by the factors."""
    return 2 * unknowns * unknowns


def add_flops(unknowns: int) -> int:
    """Return the operations that add a weighted equation to the normal equations."""
    return unknowns * (unknowns + 4)


# Operations in kernels/pose of a rigid pose with Tukey's loss and a given scale. Of a row at a pose: displacement 10,
# its inverse rotation 8, residual 3, and the derivatives 5. Of a pose: its inverse 6, a step 34. Of a row in a score:
# the residual in sigmas 1, loss 7, sum 1; in a sum of normal equations also residual 2, weight 6, psi 12.
_RESIDUAL, _EQUATION, _INVERSE, _MOVE, _LOSS, _WEIGHED = 21, 26, 6, 34, 9, 20
# Of a row: the largest leverage: residual 3, weight 4, product with the covariance 29. Of a pose: eigenvalues of two
# matrices by 15 rotations of 49 operations, their Cholesky factors and quotients 71, covariances 200.
_LEVERAGE, _QUALITY = _EQUATION + 36, 2 * 15 * 49 + 71 + 200
_START_STEPS = 3


def fit_flops(rows: int, trials: int) -> int:
    """Return the operations of a pose from rows, with `trials` start candidates through three rows each."""
    solution = _INVERSE + factor_flops(3) + solve_flops(3) + _MOVE
    candidate = _START_STEPS * (3 * (_EQUATION + add_flops(3)) + solution) + rows * (_RESIDUAL + _LOSS)
    normal_equations = rows * (_EQUATION + _WEIGHED + add_flops(3))
    of_steps = STEPS * (normal_equations + solution)
    return trials * candidate + of_steps + 2 * normal_equations + rows * _LEVERAGE + _QUALITY


def tukey_root(z: NDArray[Any]) -> NDArray[Any]:
    """Return the square root of Tukey's weight at residuals in standard deviations."""
    return np.asarray(np.maximum(1.0 - z * z * (1.0 / TUNING_CONSTANT**2), 0.0))


def _numpy_equations(rows: NDArray[Any], pose: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return Jacobian (..., n, 3) and residuals (..., n) of rows (..., n, 7), linearised at poses (..., 1, 3)."""
    x, y, less, sine = pose[..., 0], pose[..., 1], -2.0 * np.sin(0.5 * pose[..., 2]) ** 2, np.sin(pose[..., 2])
    nx, ny, px, py, ex, ey, _ = np.moveaxis(rows, -1, 0)
    wx, wy = ex - x - (less * px - sine * py), ey - y - (sine * px + less * py)
    bx, by = wx + less * wx + sine * wy, wy + less * wy - sine * wx
    turn = ny * (px + bx) - nx * (py + by)
    return np.stack(np.broadcast_arrays(nx, ny, turn), axis=-1), nx * bx + ny * by


def _numpy_moved(pose: NDArray[Any], step: NDArray[Any]) -> NDArray[Any]:
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    change = [c * step[..., 0] - s * step[..., 1], s * step[..., 0] + c * step[..., 1], step[..., 2]]
    return np.asarray(pose + np.stack(np.broadcast_arrays(*change), axis=-1))


def numpy_pose(
    rows: NDArray[Any], starts: NDArray[Any], placement: tuple[float, float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return x, y [m] and theta [rad] of the placement point, and their covariance."""
    middle = rows[:, 2:4].mean(axis=0)
    rows = np.column_stack([rows[:, :2], rows[:, 2:4] - middle, rows[:, 4:]])
    size = np.sqrt(np.mean(np.sum(rows[:, 2:4] ** 2, axis=-1)))
    rows = rows * np.array([1, 1, 1 / size, 1 / size, 1 / size, 1 / size, size])
    tried = np.zeros((len(starts), 1, 3))
    for _ in range(3):
        equations, left = _numpy_equations(rows[starts], tried)
        good = np.abs(np.linalg.det(equations)) > 1e-3
        safe = np.where(good[:, None, None], equations, np.eye(3))
        tried = _numpy_moved(tried, np.linalg.solve(safe, left[..., None])[:, None, :, 0])
    loss = np.sum(1.0 - tukey_root(_numpy_equations(rows, tried)[1] * rows[:, 6]) ** 3, axis=-1)
    pose = tried[np.argmin(np.where(good, loss, np.inf))]
    for _ in range(STEPS):
        equations, left = _numpy_equations(rows, pose)
        weighted = equations * ((rows[:, 6] * tukey_root(left * rows[:, 6])) ** 2)[:, None]
        pose = _numpy_moved(pose, np.linalg.solve(weighted.T @ equations, weighted.T @ left))
    equations, left = _numpy_equations(rows, pose)
    counted = equations * (rows[:, 6] * (tukey_root(left * rows[:, 6]) > 0))[:, None]
    inverse = np.linalg.inv(counted.T @ counted) / EFFICIENCY
    at = (np.array(placement) - middle) / size
    (x, y, theta), c, s = pose[0], np.cos(pose[0, 2]), np.sin(pose[0, 2])
    turned = np.array([[c, -s], [s, c]])
    lever = np.eye(3)
    lever[:2] = np.column_stack([turned, turned @ [-at[1], at[0]]]) * size
    place = np.array(placement) + (np.array([x, y]) + turned @ at - at) * size
    return np.array([*place, theta]), lever @ inverse @ lever.T


def edge_rows(count: int) -> NDArray[np.float32]:
    """Return rows of edges (count, 7) of `SolvePose`; a fifth of them are gross errors."""
    rng = np.random.default_rng(2)
    angle, point = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-0.5 * _SIZE, 0.5 * _SIZE, (count, 2))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x, y, theta = _TRUE_POSE
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    away = rng.normal(0.0, _SIGMA, (count, 1))
    away[: count // 5] += rng.uniform(50.0, 200.0, (count // 5, 1)) * _SIGMA
    seen = (point + away * normal) @ turn.T + (x, y)
    return line_rows(normal, point, seen, np.full(count, _SIGMA)).astype(np.float32)


def cases(device: Device) -> Iterator[Case]:
    """Yield poses from 20 and from 200 rows."""
    for count in (20, 200):
        yield _case(device, count)


def _case(device: Device, count: int) -> Case:
    rows = edge_rows(count)
    operation = SolvePose(placement=PLACEMENT, max_trials=TRIALS, max_iterations=STEPS)
    bound = operation.bind(device, rows.shape, np.float32)
    bound.inputs[0].set(rows)
    starts, place = sample_subsets(count, 3, TRIALS), np.array(PLACEMENT, np.float32)
    of_numba, covariance = np.empty(3, np.float32), np.empty((3, 3), np.float32)

    plain = rows.astype(np.float64)
    plain[:, 6] = 1.0 / plain[:, 6]  # the peers take the inverse of the standard deviation
    single = plain.T.astype(np.float32)

    def by_numba() -> None:
        fit_pose(single.copy(), starts, place, of_numba, covariance)  # it changes the rows

    def by_numpy() -> tuple[NDArray[Any], NDArray[Any]]:
        return numpy_pose(plain, starts, PLACEMENT)

    bound.run()
    by_numba()
    exact, exact_covariance = by_numpy()
    sigma = np.sqrt(np.diag(exact_covariance))
    ours = np.array([*to_numpy(bound.outputs.placement), to_numpy(bound.outputs.pose)[2]])
    for name, each in (("gpuvision", ours), ("numba", of_numba)):
        if np.any(np.abs(each - exact) > 0.1 * sigma):
            raise AssertionError(f"the pose of {name} differs from the pose in double: {each} and {exact}")
    error = float(np.max(np.abs(ours[:2] - exact[:2])))
    peers: dict[str, Callable[[], object]] = {"numpy": by_numpy, "numba": by_numba}
    return Case(
        "pose",
        f"solve/{count}",
        bound.run,
        peers,
        error,
        traffic=traffic_of(bound),
        metadata={"sigma_m": float(sigma[0])},
        flops=fit_flops(count, len(starts)),
        copied=False,
    )
