"""Robust line fits to sets of points, compared with Numba and OpenCV's ``fitLine``.

The sets contain points along image lines, 30 % outliers, and a standard deviation for each point. A fit starts from the
best of 64 pairs by Tukey's loss, does twelve iterations, and computes the covariance. The Numba peer does the same on
all cores, one line per task, vectorised over its points. OpenCV uses Welsch's loss, which rejects distant points like
Tukey's; it does less work: its starts are random, and it computes no covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.robust import efficiency, sample_subsets
from gpuvision.profiling.harness import Case, traffic_of

_LINES, _SIGMA = 10_000, 0.05  # px
_FEW = 100  # lines that OpenCV fits; its time is extrapolated to all lines (equal numbers of points)
TRIALS, STEPS = 64, 12
TUNING_CONSTANT = 4.685
EFFICIENCY = np.float32(efficiency("tukey", TUNING_CONSTANT))
_PER = np.float32(1.0 / TUNING_CONSTANT**2)
_ZERO, _HALF, _ONE, _TWO = (np.float32(each) for each in (0.0, 0.5, 1.0, 2.0))


def scene(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points (lines, count, 2) and their standard deviations (lines, count), in pixels."""
    rng = np.random.default_rng(1)
    angle, middle = rng.uniform(-np.pi / 2, np.pi / 2, _LINES), rng.uniform(0.0, 1000.0, (_LINES, 1, 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    u, v = rng.uniform(-30.0, 30.0, (_LINES, count, 1)), rng.normal(0.0, _SIGMA, (_LINES, count, 1))
    v[:, : 3 * count // 10] += rng.uniform(1.0, 20.0, (_LINES, 3 * count // 10, 1))
    points = middle + u * along + v * along[..., ::-1] * (-1.0, 1.0)
    return points.astype(np.float32), np.full((_LINES, count), _SIGMA, np.float32)


@numba.njit(error_model="numpy", fastmath={"contract", "reassoc"})
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
    return x, y, c, s, _ONE / (EFFICIENCY * sw), _ONE / (EFFICIENCY * suu)


# Operations in kernels/line_fit/line_fit.h with Tukey's loss and a given scale. Of a point in the score of a pair:
# distance 5, residual 1, loss 7, sum 1. Of a pair: direction 2, its square 3, root and quotient 2, products 2. Of a
# point in a step: place 2, along and across 6, residual 2, weight 4 and 2, moments 11. Of a step: means 3, turn 32,
# line 17. Of a point in the middle of all and in the variances: 7 and 19, its certainty and place 3.
_PAIR_POINT, _PAIR, _STEP_POINT, _STEP, _POINT = 14, 9, 27, 52, 29


def fit_flops(count: int, pairs: int) -> int:
    """Return the operations of a fit to `count` points from `pairs` pairs of them."""
    return pairs * (_PAIR + _PAIR_POINT * count) + STEPS * (_STEP + _STEP_POINT * count) + _POINT * count


@numba.njit(parallel=True, error_model="numpy")
def _numba(points, sigma, pairs, out):
    """Fit the lines one after another in each thread, with separate buffers per thread."""
    threads, lines = numba.get_num_threads(), points.shape[0]
    for part in numba.prange(threads):
        u = np.empty(points.shape[1], np.float32)
        v, w = np.empty_like(u), np.empty_like(u)
        for n in range(part * lines // threads, (part + 1) * lines // threads):
            x, y = points[n, 0, 0], points[n, 0, 1]
            for k in range(points.shape[1]):
                u[k], v[k], w[k] = points[n, k, 0] - x, points[n, k, 1] - y, _ONE / sigma[n, k]
            a, b, c, s, of_offset, of_angle = fit_line(u, v, w, pairs)
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = -s, c, x + a, y + b
            out[n, 4], out[n, 5], out[n, 6] = of_angle, of_offset, c * (y + b) - s * (x + a)


def cases(device: Device) -> Iterator[Case]:
    """Yield ten thousand lines through 20 points, and through 64 points, a multiple of the vector width."""
    for count in (20, 64):
        yield _case(device, count)


def _case(device: Device, count: int) -> Case:
    points, sigma = scene(count)
    operation = FitLines(scale=1.0, weighted=True, max_trials=TRIALS, max_iterations=STEPS)
    bound = operation.bind(device, points.shape, np.float32)
    for array, values in zip(bound.inputs, (points, sigma), strict=True):
        array.set(values)
    pairs, out = sample_subsets(count, 2, TRIALS), np.empty((_LINES, 7), np.float32)
    peers: dict[str, Callable[[], object]] = {
        "numba": lambda: _numba(points, sigma, pairs, out),
        "opencv": lambda: [cv2.fitLine(each, cv2.DIST_WELSCH, 0, 0.01, 0.01) for each in points[:_FEW]],
    }
    bound.run()
    peers["numba"]()
    normal, centre = to_numpy(bound.outputs.normal), to_numpy(bound.outputs.centre)
    difference = np.abs(normal[:, 0] * out[:, 1] - normal[:, 1] * out[:, 0])
    if not np.quantile(difference, 0.99) < 1e-4:
        raise AssertionError("the lines of the peer numba differ from ours")
    error = np.nan
    if device.has_double:
        exact = operation(points.astype(np.float64), sigma.astype(np.float64), device=device)
        away = np.abs(np.sum(to_numpy(exact.normal) * (centre - to_numpy(exact.centre)), axis=-1))
        # If two starts are equally good within rounding, precision decides between them: a few in ten thousand lines.
        error = float(np.quantile(away, 0.99))
    return Case(
        "line_fit",
        f"tukey/1e4x{count}",
        bound.run,
        peers,
        error,
        traffic=traffic_of(bound),
        factors={"opencv": _LINES / _FEW},
        flops=_LINES * fit_flops(count, len(pairs)),
        copied=False,
    )
