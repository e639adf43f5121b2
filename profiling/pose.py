"""Fused board pose, compared with the same method in NumPy and OpenCV, and in one fused Numba function.

A hundred calipers (rulers) of 64 samples and 5 lines, ten across each of ten edges of the artwork, in an 8-bit frame of
640 x 480: edge positions, a robust line through the edge points of each artwork edge, a robust pose from the lines, and
its covariance at the placement point. One line is displaced, and every tenth ruler crosses a spot brighter than its
edge.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator, place_rulers
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.matching.robust import efficiency, sample_subsets
from gpuvision.profiling import ruler as of_ruler
from gpuvision.profiling.harness import Case

LINES, EACH, TRIALS, STEPS = 10, 10, 64, 12
PIXEL, PATCH = 10e-6, 160  # m, px
PLACEMENT = (2e-3, -1e-3)
TRUE_POSE = np.array([3e-5, -2e-5, 0.004])
TUNING_CONSTANT = 4.685
_PER = np.float32(1.0 / TUNING_CONSTANT**2)
_PLACE = np.array(PLACEMENT, np.float32)
_EFFICIENCY = np.float32(efficiency("tukey", TUNING_CONSTANT))
_ZERO, _HALF, _ONE, _TWO = (np.float32(each) for each in (0.0, 0.5, 1.0, 2.0))
_SUMS = {"contract", "reassoc"}
_rulers = of_ruler._compiled(of_ruler._sample_flat)


def scene() -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Return a frame, and rulers and lines of `BoardPoseEstimator`; every edge has a separate patch of the frame."""
    rng = np.random.default_rng(11)
    columns, rows = of_ruler.COLUMNS // PATCH, of_ruler.ROWS // PATCH
    matrix = np.array([[1.0 / PIXEL, 0.0, 320.0], [0.0, -1.0 / PIXEL, 240.0], [2.0, 1.0, 1.0]])
    angle = rng.permutation(np.arange(LINES)) * np.pi / LINES
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    middle = [((i % columns + 0.5) * PATCH, (i // columns + 0.5) * PATCH) for i in range(LINES)]
    back = np.linalg.inv(matrix)
    point = np.column_stack([middle, np.ones(LINES)]) @ back.T
    point = point[:, :2] / point[:, 2:]
    along = np.tile(np.linspace(-30.0, 30.0, EACH) * PIXEL, (LINES, 1))
    rulers, lines = place_rulers(normal, point, along, matrix)
    row, column = np.mgrid[: of_ruler.ROWS, : of_ruler.COLUMNS]
    seen = np.stack([column, row, np.ones_like(row)], axis=-1) @ back.T
    seen = seen[..., :2] / seen[..., 2:] - TRUE_POSE[:2]
    cosine, sine = np.cos(TRUE_POSE[2]), np.sin(TRUE_POSE[2])
    seen = seen @ np.array([[cosine, -sine], [sine, cosine]])
    which = np.minimum(row // PATCH, rows - 1) * columns + column // PATCH
    image = np.full(row.shape, 100.0)
    for number in range(LINES):
        away = (seen - point[number]) @ normal[number] / PIXEL - (9.0 if number == 4 else 0.0)
        image = np.where(which == number, 100.0 + 40.0 * np.tanh(away / 1.5), image)
    for x, y in rulers.reshape(-1, rulers.shape[-1])[::10, :2]:
        image[np.hypot(column - x - 8.0, row - y - 8.0) < 5.0] = 240.0
    image += rng.normal(0.0, 2.0, image.shape)
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8), rulers, lines


# ---- Numba ---------------------------------------------------------------------------------------------------------


@numba.njit(error_model="numpy", fastmath=_SUMS)
def fit_line(u, v, w, pairs):
    """Return centre, direction and variances of the robust line through points with inverse standard deviations."""
    best_x, best_y, best_c, best_s, least = _ZERO, _ZERO, _ONE, _ZERO, np.float32(np.inf)
    for t in range(pairs.shape[0]):
        i, j = pairs[t, 0], pairs[t, 1]
        x, y = u[j] - u[i], v[j] - v[i]
        per = _ONE / np.sqrt(x * x + y * y)
        c, s = x * per, y * per
        loss = _ZERO
        for k in range(u.shape[0]):
            z = (c * (v[k] - v[i]) - s * (u[k] - u[i])) * w[k]
            left = max(_ONE - z * z * _PER, _ZERO)
            loss += _ONE - left * left * left
        if (loss < least) & (w[i] * w[j] > _ZERO):
            least, best_x, best_y, best_c, best_s = loss, u[i], v[i], c, s
    x, y, c, s = best_x, best_y, best_c, best_s
    for _ in range(STEPS):
        sw, su, sv, suu, suv, svv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        for k in range(u.shape[0]):
            dx, dy = u[k] - x, v[k] - y
            a, b = c * dx + s * dy, c * dy - s * dx
            z = b * w[k]
            left = max(_ONE - z * z * _PER, _ZERO)
            weight = w[k] * w[k] * left * left
            sw += weight
            su += weight * a
            sv += weight * b
            suu += weight * a * a
            suv += weight * a * b
            svv += weight * b * b
        a, b = su / sw, sv / sw
        across, along = _TWO * (suv - su * b), suu - su * a - (svv - sv * b)
        length = np.sqrt(across * across + along * along)
        part = np.sqrt(_HALF + _HALF * along / length)
        turn = _HALF * across / (length * part)
        x, y = x + c * a - s * b, y + s * a + c * b
        c, s = c * part - s * turn, s * part + c * turn
    sw, suu = _ZERO, _ZERO
    for k in range(u.shape[0]):
        dx, dy = u[k] - x, v[k] - y
        a, z = c * dx + s * dy, (c * dy - s * dx) * w[k]
        weight = w[k] * w[k] if z * z * _PER < _ONE else _ZERO
        sw += weight
        suu += weight * a * a
    return x, y, c, s, _ONE / (_EFFICIENCY * sw), _ONE / (_EFFICIENCY * suu)


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
def _fit_pose(rows, starts, placement, pose, covariance):
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
        inverse[i] = d / _EFFICIENCY
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


@numba.njit(parallel=True, error_model="numpy", fastmath=_SUMS)
def _fused(image, plain, rulers, lines, taps, numbers, pairs, starts, edges, status, pose, covariance):
    """Compute the board pose in one call: edges along all rulers and line fits on all cores, then the pose."""
    _rulers(image, plain, taps, numbers, edges, status)
    count = lines.shape[0]
    rows = np.empty((7, 2 * count), np.float32)
    for i in numba.prange(count):
        u, v, w = np.empty(EACH, np.float32), np.empty(EACH, np.float32), np.empty(EACH, np.float32)
        for k in range(EACH):
            at = i * EACH + k
            found, s = status[at] == 0, edges[0, at]
            per = _ONE / (_ONE + s * rulers[at, 8])
            a, b = (rulers[at, 4] + s * rulers[at, 6]) * per, (rulers[at, 5] + s * rulers[at, 7]) * per
            u[k] = a if found else _ZERO
            v[k] = b if found else _ZERO
            sigma = edges[3, at] * np.exp(_HALF / (edges[2, at] * edges[2, at] + numbers[1]))
            across = abs(rulers[at, 7] - b * rulers[at, 8]) * per * sigma
            w[k] = _ONE / across if found else _ZERO
        x, y, c, s, of_offset, of_angle = fit_line(u, v, w, pairs)
        reach = np.sqrt(of_offset / of_angle)
        for side in range(2):
            offset = reach if side else -reach
            on, off, at = x + offset * c, y + offset * s, 2 * i + side
            rows[0, at], rows[1, at] = lines[i, 0], lines[i, 1]
            rows[2, at], rows[3, at] = lines[i, 2] + on * lines[i, 1], lines[i, 3] - on * lines[i, 0]
            rows[4, at], rows[5, at] = off * lines[i, 0], off * lines[i, 1]
            rows[6, at] = _ONE / np.sqrt(_TWO * of_offset + lines[i, 4] * lines[i, 4])
    _fit_pose(rows, starts, _PLACE, pose, covariance)


# ---- NumPy and OpenCV ----------------------------------------------------------------------------------------------


def _left_over(z: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.maximum(1.0 - z * z * (1.0 / TUNING_CONSTANT**2), 0.0))


def _numpy_lines(u: NDArray[Any], v: NDArray[Any], w: NDArray[Any], pairs: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Fit all lines at once; the arrays have the shape (lines, rulers per line)."""
    i, j = pairs.T
    x, y = u[:, j] - u[:, i], v[:, j] - v[:, i]
    per = 1.0 / np.hypot(x, y)
    c, s = (x * per)[..., None], (y * per)[..., None]
    z = (c * (v[:, None] - v[:, i, None]) - s * (u[:, None] - u[:, i, None])) * w[:, None]
    loss = np.sum(1.0 - _left_over(z) ** 3, axis=-1)
    best = np.argmin(np.where(w[:, i] * w[:, j] > 0, loss, np.inf), axis=1)
    each = np.arange(len(u))
    x, y, c, s = u[each, i[best]], v[each, i[best]], c[each, best, 0], s[each, best, 0]
    for _ in range(STEPS):
        dx, dy = u - x[:, None], v - y[:, None]
        a, b = c[:, None] * dx + s[:, None] * dy, c[:, None] * dy - s[:, None] * dx
        weight = (w * _left_over(b * w)) ** 2
        sw, su, sv = weight.sum(1), (weight * a).sum(1), (weight * b).sum(1)
        mean_a, mean_b = su / sw, sv / sw
        across = 2.0 * ((weight * a * b).sum(1) - su * mean_b)
        along = (weight * (a * a - b * b)).sum(1) - su * mean_a + sv * mean_b
        turn = 0.5 * np.arctan2(across, along)
        x, y = x + c * mean_a - s * mean_b, y + s * mean_a + c * mean_b
        c, s = c * np.cos(turn) - s * np.sin(turn), s * np.cos(turn) + c * np.sin(turn)
    dx, dy = u - x[:, None], v - y[:, None]
    weight = w * w * (_left_over((c[:, None] * dy - s[:, None] * dx) * w) > 0)
    a = c[:, None] * dx + s[:, None] * dy
    return x, y, c, s, 1.0 / (_EFFICIENCY * weight.sum(1)), 1.0 / (_EFFICIENCY * (weight * a * a).sum(1))


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


def _numpy_pose(rows: NDArray[Any], starts: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
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
    loss = np.sum(1.0 - _left_over(_numpy_equations(rows, tried)[1] * rows[:, 6]) ** 3, axis=-1)
    pose = tried[np.argmin(np.where(good, loss, np.inf))]
    for _ in range(STEPS):
        equations, left = _numpy_equations(rows, pose)
        weighted = equations * ((rows[:, 6] * _left_over(left * rows[:, 6])) ** 2)[:, None]
        pose = _numpy_moved(pose, np.linalg.solve(weighted.T @ equations, weighted.T @ left))
    equations, left = _numpy_equations(rows, pose)
    counted = equations * (rows[:, 6] * (_left_over(left * rows[:, 6]) > 0))[:, None]
    inverse = np.linalg.inv(counted.T @ counted) / _EFFICIENCY
    at = (np.array(PLACEMENT) - middle) / size
    (x, y, theta), c, s = pose[0], np.cos(pose[0, 2]), np.sin(pose[0, 2])
    turned = np.array([[c, -s], [s, c]])
    lever = np.eye(3)
    lever[:2] = np.column_stack([turned, turned @ [-at[1], at[0]]]) * size
    place = np.array(PLACEMENT) + (np.array([x, y]) + turned @ at - at) * size
    return np.array([*place, theta]), lever @ inverse @ lever.T


class _Numpy:
    """Board poses by NumPy, with samples from OpenCV's remap."""

    def __init__(self, image: NDArray[Any], rulers: NDArray[Any], lines: NDArray[Any], noise: float) -> None:
        self.image, self.lines, self.noise = image, lines.astype(np.float64), noise
        self.plain, self.rulers = np.ascontiguousarray(rulers[..., :4].reshape(-1, 4)), rulers.astype(np.float64)
        self.matrix = of_ruler._gradient_matrix(np.float32)
        self.pairs, self.starts = sample_subsets(EACH, 2, TRIALS), sample_subsets(2 * LINES, 3, TRIALS)

    def __call__(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return self._pose(of_ruler._opencv(self.image, self.plain, self.matrix))

    def exact(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the pose from samples in double; OpenCV rounds samples to whole grey levels."""
        matrix = of_ruler._gradient_matrix(np.float64)
        return self._pose(of_ruler._numpy(self.image, self.plain.astype(np.float64), matrix))

    def _pose(self, found: tuple[NDArray[Any], ...]) -> tuple[NDArray[Any], NDArray[Any]]:
        position, width, sigma, dark = (found[i].reshape(LINES, EACH).astype(np.float64) for i in (0, 2, 3, 4))
        sigma = sigma * np.exp(0.5 / (width * width + of_ruler._VARIANCE))
        *_, u0, v0, du, dv, projective = np.moveaxis(self.rulers, -1, 0)
        per = 1.0 / (1.0 + position * projective)
        u, v = (u0 + position * du) * per, (v0 + position * dv) * per
        w = np.where(dark > 0, 0.0, 1.0 / (np.abs(dv - v * projective) * per * sigma * self.noise))
        x, y, c, s, of_offset, of_angle = _numpy_lines(u, v, w, self.pairs)
        reach = np.sqrt(of_offset / of_angle)[:, None] * [-1.0, 1.0]
        on, off = x[:, None] + reach * c[:, None], y[:, None] + reach * s[:, None]
        nx, ny, px, py, of = (np.repeat(each[:, None], 2, axis=1) for each in self.lines.T[:5])
        certainty = 1.0 / np.sqrt(2.0 * of_offset[:, None] + of**2)
        rows = np.stack([nx, ny, px + on * ny, py - on * nx, off * nx, off * ny, certainty], axis=-1)
        return _numpy_pose(rows.reshape(-1, 7), self.starts)


def cases(device: Device) -> Iterator[Case]:
    """Yield the fused board pose from a hundred rulers."""
    image, rulers, lines = scene()
    edges = RulerEdges(
        threshold=of_ruler.THRESHOLD,
        length=of_ruler.LENGTH,
        width=of_ruler.WIDTH,
        smoothing_px=of_ruler.SMOOTHING,
        noise=2.0,
    )
    solver = SolvePose(placement=PLACEMENT, max_trials=TRIALS, max_iterations=STEPS)
    bound = BoardPoseEstimator(ruler=edges, lines=LINES, rulers_per_line=EACH, solver=solver).bind(
        device, image.shape, image.dtype
    )
    inputs: tuple[NDArray[Any], ...] = (image, rulers, lines)
    for array, values in zip(bound.inputs, inputs, strict=True):
        array.set(values)
    bound.run()
    result = bound.outputs
    noise = edges._packed(image.dtype)[2]
    by_numpy = _Numpy(image, rulers, lines, float(noise) / of_ruler.WIDTH)
    flat, plain = rulers.reshape(-1, rulers.shape[-1]), by_numpy.plain
    numbers = np.array([of_ruler._LEAST * of_ruler.WIDTH, of_ruler._VARIANCE, noise], np.float32)
    taps = of_ruler._TAPS.astype(np.float32)
    found, status = np.empty((4, len(flat)), np.float32), np.empty(len(flat), np.uint8)
    pose, covariance = np.empty(3, np.float32), np.empty((3, 3), np.float32)

    def by_numba() -> None:
        pairs, starts = by_numpy.pairs, by_numpy.starts
        _fused(image, plain, flat, lines, taps, numbers, pairs, starts, found, status, pose, covariance)

    by_numba()
    (exact, exact_covariance), (rounded, _) = by_numpy.exact(), by_numpy()
    ours = np.array([*to_numpy(result.placement), to_numpy(result.pose)[2]])
    sigma = np.sqrt(np.diag(exact_covariance))
    of_ours = to_numpy(result.covariance)
    for name, each, of in (
        ("gpuvision", ours, of_ours),
        ("numba", pose, covariance),
        ("numpy", rounded, exact_covariance),
    ):
        if np.any(np.abs(each - exact) > 0.5 * sigma) or np.any(np.abs(np.sqrt(np.diag(of)) / sigma - 1.0) > 0.1):
            raise AssertionError(
                f"the pose of {name} differs from that in double: {each} and {exact}, standard deviations {sigma}"
            )
    metadata = {"p50_us": _median(bound.run) * 1e6, "sigma_m": float(sigma[0]), "numba_error": _worst(pose, exact)}
    metadata["numpy_error"] = _worst(rounded, exact)
    peers: dict[str, Callable[[], object]] = {"numpy": by_numpy, "numba": by_numba}
    yield Case("pose", "local-fix", bound.run, peers, _worst(ours, exact), metadata=metadata)


def _worst(pose: NDArray[Any], exact: NDArray[Any]) -> float:
    """Return the largest error of the placement point [m]."""
    return float(np.max(np.abs(pose[:2] - exact[:2])))


def _median(call: Callable[[], object]) -> float:
    """Return the median time of a call in a sequence of calls [s]."""
    times = []
    for _ in range(300):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))
