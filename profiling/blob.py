"""Blob measurement compared with fused Numba functions of the same method, and with OpenCV blob by blob.

The 8-bit frame shows bright discs with a radius of 8 px, a blur of 1 px, a contrast of 100 and noise of 2 grey levels,
each up to 2 px from its nominal position. Numba uses the same rulers, start, robust fit, match of the pixels, centre of
gravity and covariance on all cores. OpenCV crops each blob, applies Otsu's threshold, and computes the moments of the
grey levels above it, the most accurate of its fast methods; it returns only the centre. The metadata also list the
deviation of `findContours` with `fitEllipse`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.blob import TUNING_CONSTANT, FindBlobs
from gpuvision.profiling.harness import Case, Peer, traffic_of
from gpuvision.profiling.pose import add_flops, factor_flops, solve_flops
from gpuvision.profiling.ruler import frame_bytes, ruler_flops

CELL, RADIUS, BLUR, CONTRAST, NOISE, OFF = 40, 8.0, 1.0, 100.0, 2.0, 2.0
_DIFFERENCE = 0.01  # px: difference of a centre by a match that takes a step more or less
SPOKES, SEARCH, REACH, THRESHOLD = 16, 4.0, 5, 20.0
LENGTH = 2 * (math.ceil(SEARCH) + REACH) + 3
_SLOPES, _PIXELS, _UNKNOWNS = LENGTH - 2 * REACH, 1024, 8
_PATTERNS = np.array([[4, 8], [5, 10], [3, 6], [2, 6]])
_F = np.float32
# Edges of the triples whose circles are start values: 16 triples for each pattern.
_TRIPLES = len(_PATTERNS) * SPOKES
_FIRST = np.tile(np.arange(SPOKES), len(_PATTERNS))
_SECOND, _THIRD = ((_FIRST + np.repeat(_PATTERNS[:, k], SPOKES)) % SPOKES for k in (0, 1))
_SUMS = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _edge(pixels, pitch, x, y, cosine, sine, table, profile, slopes):
    """Return position, amplitude, squared width and variance of the strongest falling edge; zeros without an edge."""
    middle, one = _F(0.5 * (LENGTH - 1)), np.uint32(1)
    first_x, first_y = x - middle * cosine, y - middle * sine
    for i in range(LENGTH):
        at_x, at_y = first_x + _F(i) * cosine, first_y + _F(i) * sine
        column, row = np.int32(at_x), np.int32(at_y)
        dx, dy = at_x - _F(column), at_y - _F(row)
        at = np.uint32(row) * pitch + np.uint32(column)
        a, b = _F(pixels[at]), _F(pixels[at + one])
        c, d = _F(pixels[at + pitch]), _F(pixels[at + pitch + one])
        a += dx * (b - a)
        c += dx * (d - c)
        profile[i] = a + dy * (c - a)
    for i in range(_SLOPES):
        slope = _F(0.0)
        for k in range(1, REACH + 1):
            slope -= table[2 + k] * (profile[i + REACH + k] - profile[i + REACH - k])
        slopes[i] = slope
    best, at_best = _F(0.0), 0
    for i in range(1, _SLOPES - 1):
        if slopes[i] >= table[0] and slopes[i] > slopes[i - 1] and slopes[i] >= slopes[i + 1] and slopes[i] > best:
            best, at_best = slopes[i], i
    if at_best == 0:
        return _F(0.0), _F(0.0), _F(0.0), _F(0.0)
    per = _F(1.0) / best
    before = math.log(max(slopes[at_best - 1] * per, _F(1e-6)))
    after = math.log(max(slopes[at_best + 1] * per, _F(1e-6)))
    variance, tilt = _F(-1.0) / (before + after), _F(0.5) * (after - before)
    shift = tilt * variance
    amplitude = best * math.exp(_F(0.5) * tilt * shift) * math.sqrt(_F(2.0 * math.pi) * variance)
    sigma = table[2] * variance * math.exp(_F(0.5) / variance) * per
    place = _F(at_best) + shift + _F(REACH) - middle
    return place, -amplitude, max(variance - table[1], _F(0.0)), sigma * sigma


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _start(ex, ey, there, count, shape, reach):
    """Return the circle through three edges that has the smallest truncated loss over all edges."""
    best_x, best_y, best_r, least = shape[0], shape[1], shape[2], _F(SPOKES) * reach * reach
    one = _F(1.0)
    for p in range(_PATTERNS.shape[0]):
        for i in range(SPOKES):
            j, k = (i + _PATTERNS[p, 0]) % SPOKES, (i + _PATTERNS[p, 1]) % SPOKES
            if there[i] * there[j] * there[k] == _F(0.0):
                continue
            x, y, r = shape[0], shape[1], shape[2]
            for _ in range(3):
                ux, uy, vx, vy, wx, wy = ex[i] - x, ey[i] - y, ex[j] - x, ey[j] - y, ex[k] - x, ey[k] - y
                u, v, w = math.sqrt(ux * ux + uy * uy), math.sqrt(vx * vx + vy * vy), math.sqrt(wx * wx + wy * wy)
                ux, uy, vx, vy, wx, wy = ux / u, uy / u, vx / v, vy / v, wx / w, wy / w
                u, v, w = u - r, v - r, w - r
                a, b, c = vy - wy, wx - vx, vx * wy - vy * wx
                per = one / (ux * a + uy * b + c)
                x += per * (u * a + v * (wy - uy) + w * (uy - vy))
                y += per * (u * b + v * (ux - wx) + w * (vx - ux))
                r += per * (u * c + v * (wx * uy - wy * ux) + w * (ux * vy - uy * vx))
            loss = _F(0.0)
            for m in range(SPOKES):
                off = math.sqrt((ex[m] - x) ** 2 + (ey[m] - y) ** 2) - r
                square = off * off if there[m] > _F(0.0) else reach * reach
                loss += min(square, reach * reach)
            if loss < least:
                least, best_x, best_y, best_r = loss, x, y, r
    return best_x, best_y, best_r


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _start_in_lanes(ex, ey, there, count, shape, reach):
    """Return the same circle as `_start`: the circles of all triples of edges side by side, as elements of vectors."""
    lanes, one = np.empty((11, _TRIPLES), np.float32), _F(1.0)
    for n in range(_TRIPLES):
        i, j, k = _FIRST[n], _SECOND[n], _THIRD[n]
        lanes[0, n], lanes[1, n], lanes[2, n], lanes[3, n] = ex[i], ey[i], ex[j], ey[j]
        lanes[4, n], lanes[5, n], lanes[10, n] = ex[k], ey[k], there[i] * there[j] * there[k]
    for n in range(_TRIPLES):
        x, y, r = shape[0], shape[1], shape[2]
        for _ in range(3):
            ux, uy, vx, vy = lanes[0, n] - x, lanes[1, n] - y, lanes[2, n] - x, lanes[3, n] - y
            wx, wy = lanes[4, n] - x, lanes[5, n] - y
            u, v, w = math.sqrt(ux * ux + uy * uy), math.sqrt(vx * vx + vy * vy), math.sqrt(wx * wx + wy * wy)
            ux, uy, vx, vy, wx, wy = ux / u, uy / u, vx / v, vy / v, wx / w, wy / w
            u, v, w = u - r, v - r, w - r
            a, b, c = vy - wy, wx - vx, vx * wy - vy * wx
            per = one / (ux * a + uy * b + c)
            x += per * (u * a + v * (wy - uy) + w * (uy - vy))
            y += per * (u * b + v * (ux - wx) + w * (vx - ux))
            r += per * (u * c + v * (wx * uy - wy * ux) + w * (ux * vy - uy * vx))
        lanes[6, n], lanes[7, n], lanes[8, n], lanes[9, n] = x, y, r, _F(0.0)
    most = reach * reach
    for m in range(SPOKES):
        at_x, at_y, found = ex[m], ey[m], there[m]
        for n in range(_TRIPLES):
            x, y = at_x - lanes[6, n], at_y - lanes[7, n]
            off = math.sqrt(x * x + y * y) - lanes[8, n]
            lanes[9, n] += found * min(off * off, most) + (one - found) * most
    best, least = -1, _F(SPOKES) * most
    for n in range(_TRIPLES):
        if lanes[10, n] > _F(0.0) and lanes[9, n] < least:
            best, least = n, lanes[9, n]
    if best < 0:
        return shape[0], shape[1], shape[2]
    return lanes[6, best], lanes[7, best], lanes[8, best]


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _circle_sums(ex, ey, there, widths, shape, blur, per_scale, sums):
    """Sum the weighted normal equations of the edges; return the sums of the weights and of the weighted widths."""
    a, b, c, d, e = _F(0.0), _F(0.0), _F(0.0), _F(0.0), _F(0.0)
    f, g, h, k = _F(0.0), _F(0.0), _F(0.0), _F(0.0)
    weights, wide, one = _F(0.0), _F(0.0), _F(1.0)
    for m in range(SPOKES):
        x, y = ex[m] - shape[0], ey[m] - shape[1]
        square = x * x + y * y
        per = one / math.sqrt(square)
        off = math.sqrt(square + blur + _F(0.5) * blur * blur * per * per) - shape[2]
        x, y, z = x * per, y * per, off * per_scale
        left = max(one - z * z * _F(1.0 / TUNING_CONSTANT**2), _F(0.0))
        weight = there[m] * left * left
        a += weight * x * x
        b += weight * x * y
        c += weight * y * y
        d += weight * x
        e += weight * y
        f += weight * x * off
        g += weight * y * off
        h += weight * off
        weights += weight
        wide += weight * widths[m]
        k += weight * weight * z * z
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7] = a, b, c, d, e, f, g, h
    sums[8] = k
    return weights, wide


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _circle_step(ex, ey, there, widths, shape, blur, scale, sums):
    """Move the circle by a Gauss-Newton step; return the squared blur."""
    weights, wide = _circle_sums(ex, ey, there, widths, shape, blur, _F(1.0) / scale, sums)
    a, b, c, d, e, f, g, h = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
    p, q, r = c * weights - e * e, e * d - b * weights, b * e - c * d
    per = _F(1.0) / (a * p + b * q + d * r)
    shape[0] += per * (f * p + g * q + h * r)
    shape[1] += per * (f * q + g * (a * weights - d * d) + h * (b * d - a * e))
    shape[2] += per * (f * r + g * (b * d - a * e) + h * (a * c - b * b))
    return wide / weights


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _fit(ex, ey, there, widths, noises, shape, count, sums, room):
    """Fit a circle robustly to the edges; return squared blur and residual scale."""
    noise, blur = _F(0.0), _F(0.0)
    for m in range(SPOKES):
        noise += there[m] * noises[m]
        blur += there[m] * widths[m]
    predicted = _F(max(math.sqrt(noise / count), 0.01))
    least, blur = _F(max(_F(0.6 / TUNING_CONSTANT), predicted)), blur / count
    scale = _F(max(_F(1.2 / TUNING_CONSTANT), least))
    for _ in range(12):
        blur = _circle_step(ex, ey, there, widths, shape, blur, scale, sums)
        if scale <= least:
            break
        scale = _F(max(scale * _F(0.5), least))
    for _ in range(2):
        agreeing = 0
        for m in range(SPOKES):
            x, y = ex[m] - shape[0], ey[m] - shape[1]
            square = x * x + y * y
            off = abs(math.sqrt(square + blur + _F(0.5) * blur * blur / square) - shape[2])
            if there[m] > _F(0.0) and off <= _F(TUNING_CONSTANT) * scale:
                room[agreeing] = off
                agreeing += 1
        for i in range(1, agreeing):  # insertion sort is fastest for so few values
            value, j = room[i], i
            while j > 0 and room[j - 1] > value:
                room[j] = room[j - 1]
                j -= 1
            room[j] = value
        measured = _F(1.4826) * (_F(1.0) + _F(1.0) / max(_F(agreeing - 3), _F(1.0))) * room[agreeing // 2]
        scale = _F(min(max(measured, predicted), least))
        blur = _circle_step(ex, ey, there, widths, shape, blur, scale, sums)
    return blur, scale


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _rows_of(pixels, pitch, x, y, shape, grey, slopes, scale, equation):
    """Fill the equations of the pixels, scaled by the root of their weights; return the number of pixels."""
    reach, one = shape[2] + _F(5.0) * grey[2] + _F(2.0), _F(1.0)
    per_blur, per_size, per_scale = one / grey[2], one / shape[2], _F(1.0 / TUNING_CONSTANT) / scale
    curvature = _F(0.5) * grey[2] * per_size
    contrast, n = grey[1], 0
    c0, c1, c2 = _F(1.393465), _F(-2.767476), _F(4.513241)
    c3, c4, c5 = _F(-4.759453), _F(2.831766), _F(-0.711542)
    for row in range(math.ceil(y - reach), int(y + reach) + 1):
        dy = _F(row) - y
        half = math.sqrt(max(reach * reach - dy * dy, _F(0.0)))
        left, right = np.int32(math.ceil(x - half)), np.int32(x + half)
        start = np.uint32(row) * pitch + np.uint32(left)
        for i in range(right - left + 1):
            dx = _F(left + i) - x
            square = dx * dx + dy * dy + _F(1e-12)
            r = math.sqrt(square)
            per = one / r
            t = (shape[2] - r) * per_blur
            v = min(max(t, _F(-3.5)), _F(3.5)) * _F(1.0 / 3.5)
            q = v * v
            step = v * (((((c5 * q + c4) * q + c3) * q + c2) * q + c1) * q + c0) + _F(0.5)
            density = _F(11.0) * c5 * q + _F(9.0) * c4
            density = ((density * q + _F(7.0) * c3) * q + _F(5.0) * c2) * q + _F(3.0) * c1
            density = (density * q + c0) * _F(1.0 / 3.5)
            level, slope = step - density * curvature, contrast * density * per_blur
            residual = _F(pixels[start + np.uint32(i)]) - grey[0] - contrast * level
            residual -= (slopes[0] * dx + slopes[1] * dy) * per_size
            z = residual * per_scale
            root = max(one - z * z, _F(0.0))
            equation[0, n + i] = root * slope * dx * per
            equation[1, n + i] = root * slope * dy * per
            equation[2, n + i] = root * slope
            equation[3, n + i] = -root * t * slope
            equation[4, n + i] = root * level
            equation[5, n + i] = root
            equation[6, n + i] = root * dx * per_size
            equation[7, n + i] = root * dy * per_size
            equation[8, n + i] = root * residual
        n += int(right - left + 1)
    return n


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _factor(matrix):
    for i in range(_UNKNOWNS):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total * matrix[j, j] if j < i else _F(1.0) / math.sqrt(total)


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _solve(matrix, right, to):
    for i in range(_UNKNOWNS):
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * to[k]
        to[i] = total * matrix[i, i]
    for i in range(_UNKNOWNS - 1, -1, -1):
        total = to[i]
        for k in range(i + 1, _UNKNOWNS):
            total -= matrix[k, i] * to[k]
        to[i] = total * matrix[i, i]


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _match(pixels, pitch, x, y, shape, grey, noise, equation, matrix, right, to, covariance):
    """Refine circle, blur and grey levels by a least-squares match of the pixels; fill the covariance."""
    slopes = np.zeros(2, np.float32)
    for step in range(3):
        scale = (_F(0.1) * grey[1] + _F(4.0) * noise) / _F(TUNING_CONSTANT)
        n = _rows_of(pixels, pitch, x + shape[0], y + shape[1], shape, grey, slopes, scale, equation)
        for i in range(_UNKNOWNS + 1):
            for j in range(min(i, _UNKNOWNS - 1) + 1):
                total = _F(0.0)
                for k in range(n):
                    total += equation[i, k] * equation[j, k]
                if i < _UNKNOWNS:
                    matrix[i, j] = total
                else:
                    right[j] = total
        squares, weights = _F(0.0), matrix[5, 5]
        for k in range(n):
            squares += equation[8, k] * equation[8, k]
        _factor(matrix)
        _solve(matrix, right, to)
        less = _F(0.0)
        for i in range(_UNKNOWNS):
            less += to[i] * right[i]
        for i in range(3):
            shape[i] += to[i]
        grey[2] += to[3]
        grey[1] += to[4]
        grey[0] += to[5]
        slopes[0] += to[6]
        slopes[1] += to[7]
        if to[0] ** 2 + to[1] ** 2 + to[2] ** 2 + to[3] ** 2 > _F(0.0025) * grey[2] ** 2 and step < 2:
            continue
        variance = max(squares - less, _F(0.0)) / weights * _F(n) / _F(n - _UNKNOWNS)
        for i in range(3):
            right[:] = _F(0.0)
            right[i] = _F(1.0)
            _solve(matrix, right, to)
            for k in range(3):
                covariance[i, k] = variance * to[k]
        return


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _gravity(pixels, pitch, x, y, reach):
    """Return the centre of gravity within `reach` of (x, y), with the background of the surrounding ring subtracted."""
    outer, zero, one = reach + _F(2.0), _F(0.0), _F(1.0)
    level = _F(pixels[np.uint32(y) * pitch + np.uint32(x)])
    area, total, sum_x, sum_y = zero, zero, zero, zero
    at_x, at_y, about, sum_about = zero, zero, zero, zero
    left, right = np.int32(x - outer), np.int32(x + outer)
    for row in range(int(y - outer), int(y + outer) + 1):
        dy = _F(row) - y
        start = np.uint32(row) * pitch + np.uint32(left)
        for i in range(right - left + 1):
            dx = _F(left + i) - x
            square = dx * dx + dy * dy
            inside = one if square <= reach * reach else zero
            ring = (one if square <= outer * outer else zero) - inside
            grey = _F(pixels[start + np.uint32(i)]) - level
            area += inside
            at_x += inside * dx
            at_y += inside * dy
            total += inside * grey
            sum_x += inside * grey * dx
            sum_y += inside * grey * dy
            about += ring
            sum_about += ring * grey
    background = sum_about / about
    per = one / (total - background * area)
    return (sum_x - background * at_x) * per, (sum_y - background * at_y) * per


@numba.njit(error_model="numpy", fastmath=_SUMS)
def _describe(pixels, pitch, x, y, shape, edges, directions, blur, scale, grey, found):
    """Fill residual, inliers and symmetry of the fit, and the initial grey levels of the match."""
    ex, ey, is_found, heights, room = edges[0], edges[1], edges[2], edges[3], edges[6]
    weights, squares, amplitude, inside, noise_sum = _F(0.0), _F(0.0), _F(0.0), _F(0.0), _F(0.0)
    level, reach = _F(0.0), _F(2.5) * math.sqrt(max(blur - _F(1.0 / 6.0), _F(0.09))) + _F(0.5)
    for m in range(SPOKES):
        dx, dy = ex[m] - shape[0], ey[m] - shape[1]
        square = dx * dx + dy * dy
        z = (math.sqrt(square + blur + _F(0.5) * blur * blur / square) - shape[2]) / scale
        left = max(_F(1.0) - z * z * _F(1.0 / TUNING_CONSTANT**2), _F(0.0))
        weight = is_found[m] * left * left
        room[m] = weight
        weights += weight
        squares += weight * weight * z * z
        amplitude += weight * heights[m]
        inside += _F(1.0) if weight > _F(0.0) else _F(0.0)
        row = np.uint32(y + ey[m] + reach * directions[m, 1] + _F(0.5))
        level += weight * _F(pixels[row * pitch + np.uint32(x + ex[m] + reach * directions[m, 0] + _F(0.5))])
    for m in range(SPOKES // 2):
        a, b = abs(heights[m]), abs(heights[m + SPOKES // 2])
        noise_sum += math.sqrt(room[m] * room[m + SPOKES // 2]) * min(a, b) / max(a, b)
    grey[0], grey[1] = level / weights, -amplitude / weights
    grey[2] = math.sqrt(max(blur - _F(1.0 / 6.0), _F(0.09)))
    found[3], found[4] = scale * math.sqrt(squares / weights), inside
    found[5] = noise_sum / _F(SPOKES // 2)


def _find_form(start: Any, parallel: bool) -> Any:
    """Return a function that measures all blobs: `start` finds the first circle, on all cores under `parallel`."""

    @numba.njit(parallel=parallel, error_model="numpy", fastmath=_SUMS)
    def find(image, places, table, directions, noise, found, covariance, status):
        """Fill blobs (n, 13): x, y, size, residual, inliers, symmetry, gravity, distance, contrast, blur, shift."""
        pixels, pitch = image.reshape(-1), np.uint32(image.shape[1])
        for n in numba.prange(places.shape[0]):
            profile, slopes = np.empty(LENGTH, np.float32), np.empty(_SLOPES, np.float32)
            edges, sums = np.empty((7, SPOKES), np.float32), np.empty(9, np.float32)
            ex, ey, is_found, heights = edges[0], edges[1], edges[2], edges[3]
            widths, noises, room = edges[4], edges[5], edges[6]
            equation = np.empty((_UNKNOWNS + 1, _PIXELS), np.float32)
            matrix, right = np.empty((_UNKNOWNS, _UNKNOWNS), np.float32), np.empty(_UNKNOWNS, np.float32)
            to, shape, grey = np.empty(_UNKNOWNS, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
            x, y, size = places[n, 0], places[n, 1], places[n, 2]
            shape[0], shape[1], shape[2] = _F(0.0), _F(0.0), size
            blur, scale, count = _F(0.0), _F(0.0), _F(0.0)
            for step in range(2):
                from_x, from_y, from_r = shape[0], shape[1], shape[2]
                count = _F(0.0)
                for m in range(SPOKES):
                    c, s = directions[m, 0], directions[m, 1]
                    at_x, at_y = from_x + from_r * c, from_y + from_r * s
                    place, heights[m], widths[m], noises[m] = _edge(
                        pixels, pitch, x + at_x, y + at_y, c, s, table, profile, slopes
                    )
                    ex[m], ey[m] = at_x + place * c, at_y + place * s
                    off = abs(math.sqrt(ex[m] * ex[m] + ey[m] * ey[m]) - size)
                    is_found[m] = _F(1.0) if heights[m] != _F(0.0) and off <= _F(SEARCH) else _F(0.0)
                    count += is_found[m]
                if count < _F(SPOKES // 2):
                    break
                if step == 0:
                    shape[0], shape[1], shape[2] = start(ex, ey, is_found, count, shape, _F(0.6))
                blur, scale = _fit(ex, ey, is_found, widths, noises, shape, count, sums, room)
                if (shape[0] - from_x) ** 2 + (shape[1] - from_y) ** 2 + (shape[2] - from_r) ** 2 < _F(4.0):
                    break
            _describe(pixels, pitch, x, y, shape, edges, directions, blur, scale, grey, found[n])
            _match(pixels, pitch, x, y, shape, grey, noise, equation, matrix, right, to, covariance[n])
            heavy_x, heavy_y = _gravity(
                pixels, pitch, x + shape[0], y + shape[1], shape[2] + _F(2.5) * grey[2] + _F(1.0)
            )
            found[n, 0], found[n, 1], found[n, 2] = x + shape[0], y + shape[1], shape[2]
            found[n, 6], found[n, 7] = found[n, 0] + heavy_x, found[n, 1] + heavy_y
            found[n, 8] = math.sqrt(shape[0] ** 2 + shape[1] ** 2)
            found[n, 9], found[n, 10], found[n, 11], found[n, 12] = grey[1], grey[2], shape[0], shape[1]
            status[n] = np.uint8(found[n, 4] < _F(SPOKES // 2))

    return find


def _cut(image: NDArray[Any], place: NDArray[Any]) -> tuple[NDArray[Any], int, int]:
    half = int(RADIUS + SEARCH + 3.0)
    column, row = int(place[0] + 0.5), int(place[1] + 0.5)
    return image[row - half : row + half + 1, column - half : column + half + 1], column - half, row - half


def _moments(image: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """Return centres from the moments of the grey levels above 0.7 of Otsu's threshold."""
    centres = np.empty((len(places), 2))
    for k, place in enumerate(places):
        part, left, top = _cut(image, place)
        level, _ = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        moments = cv2.moments(cv2.addWeighted(part, 1.0, part, 0.0, -0.7 * level))
        centres[k] = left + moments["m10"] / moments["m00"], top + moments["m01"] / moments["m00"]
    return centres


def _ellipses(image: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """Return centres from ellipses fitted to the contours of the pixels above Otsu's threshold."""
    centres = np.empty((len(places), 2))
    for k, place in enumerate(places):
        part, left, top = _cut(image, place)
        _, mask = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        (x, y), *_ = cv2.fitEllipse(max(contours, key=len))
        centres[k] = left + x, top + y
    return centres


def scene(count: int) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """Return a frame of discs, their nominal positions and radii (count, 3), and their true positions (count, 2)."""
    rng = np.random.default_rng(5)
    across = math.ceil(math.sqrt(count))
    image = np.full((across * CELL, across * CELL), 50.0)
    row, column = np.mgrid[:CELL, :CELL]
    true = np.empty((count, 2))
    for k in range(count):
        top, left = k // across * CELL, k % across * CELL
        x, y = CELL / 2 + rng.uniform(-0.5, 0.5, 2)
        true[k] = left + x, top + y
        distance = (RADIUS - np.hypot(column - x, row - y)) / BLUR
        density = np.exp(-0.5 * distance**2) / math.sqrt(2.0 * math.pi)
        level = 0.5 + 0.5 * np.vectorize(math.erf)(distance / math.sqrt(2.0)) - 0.5 * BLUR / RADIUS * density
        image[top : top + CELL, left : left + CELL] += CONTRAST * level
    image += rng.normal(0.0, NOISE, image.shape)
    nominal = np.column_stack([true + rng.uniform(-1.4, 1.4, true.shape), np.full(count, RADIUS)])
    return np.rint(image).astype(np.uint8), nominal.astype(np.float32), true


# Operations in kernels/blob of a disc. Of a start circle: three edges 36 in each of 3 steps, solution 54; its loss 14
# for each edge. Of an edge in a fit: residual and derivatives 17, weight 6, sums 3. Of a pixel in the match: place 7,
# blurred disc 38, equation 8, weight 5, its squares 4; of the centre of gravity 14.
_START, _LOSS, _FIT_EDGE, _MATCH_PIXEL, _GRAVITY_PIXEL = 3 * 90, 14, 26, 62, 14
_FIT_STEPS = 4  # from twice the reach: two to the least scale, two at the estimated scale


def blob_flops() -> float:
    """Return the operations of a disc with one placement of its rulers and one step of the match: the least number."""
    starts = _TRIPLES * (_START + _LOSS * SPOKES)
    fit = _FIT_STEPS * (SPOKES * (_FIT_EDGE + add_flops(3)) + factor_flops(3) + solve_flops(3))
    matched, weighed = (math.pi * (RADIUS + more) ** 2 for more in (5.0 * BLUR + 2.0, 2.5 * BLUR + 3.0))
    match = matched * (_MATCH_PIXEL + add_flops(_UNKNOWNS)) + factor_flops(_UNKNOWNS) + 4 * solve_flops(_UNKNOWNS)
    return SPOKES * ruler_flops(LENGTH, 1, REACH) + starts + fit + match + weighed * _GRAVITY_PIXEL


def cases(device: Device) -> Iterator[Case]:
    """Yield 16, 100 and 1000 blobs."""
    for count in (16, 100, 1000):
        yield _case(device, count)


def _case(device: Device, count: int) -> Case:
    image, places, true = scene(count)
    operation = FindBlobs(threshold=THRESHOLD, search_px=SEARCH, spokes=SPOKES, noise=NOISE, count=count)
    bound = operation.bind(device, image.shape, image.dtype)
    bound.inputs[0].set(image)
    bound.inputs[1].set(places)
    blobs = bound.run()
    if np.any(to_numpy(blobs.status)):
        raise AssertionError("a blob was not found")
    table = np.asarray(operation.launch(device, image.shape, image.dtype).arguments[0])
    numbers = np.concatenate([table[[0, 3, 2]], table[-REACH:]]).astype(np.float32)
    angle = np.arange(SPOKES) * 2.0 * math.pi / SPOKES
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    found, covariance = np.empty((count, 13), np.float32), np.empty((count, 3, 3), np.float32)
    status, noise = np.empty(count, np.uint8), _F(math.hypot(NOISE, math.sqrt(1.0 / 12.0)))

    calls: dict[str, Callable[[], object]] = {}
    for name, form in _FORMS.items():
        calls[name] = functools.partial(form, image, places, numbers, directions, noise, found, covariance, status)
        found[...], status[...] = np.nan, 255
        calls[name]()
        _check_peer(blobs, found, status)
    ours = np.stack([to_numpy(blobs.x), to_numpy(blobs.y)], axis=-1)
    metadata = {
        "blobs": count,
        "deviation_px": _deviation(ours, true),
        "numba_deviation_px": _deviation(found[:, :2], true),
        "opencv_deviation_px": _deviation(_moments(image, places), true),
        "ellipse_deviation_px": _deviation(_ellipses(image, places), true),
    }
    peers: dict[str, Peer] = {
        "numba": calls,
        "opencv": lambda: _moments(image, places),
    }
    error = float(np.max(np.abs(ours - true)))
    taken = frame_bytes(image, math.ceil(count * math.pi * (RADIUS + 5.0 * BLUR + 2.0) ** 2))
    traffic = (taken + places.nbytes, traffic_of(bound)[1])
    flops = count * blob_flops()
    return Case("blob", str(count), bound.run, peers, error, traffic, metadata=metadata, flops=flops, copied=False)


# Forms of the Numba peer: how the first circle is found, on all cores or on one.
_find_triples = _find_form(_start, True)
_find_lanes = _find_form(_start_in_lanes, True)
_find_lanes_serial = _find_form(_start_in_lanes, False)
_FORMS = {"triples": _find_triples, "lanes": _find_lanes, "lanes-serial": _find_lanes_serial}


def _check_peer(blobs: Any, found: NDArray[Any], status: NDArray[Any]) -> None:
    """Raise an AssertionError if a peer has other results than our measurement.

    A rounding error can take an edge into a fit or out of it: one centre of a hundred may differ by more.
    """
    np.testing.assert_array_equal(status, to_numpy(blobs.status))
    centres = np.stack([to_numpy(blobs.x), to_numpy(blobs.y)], axis=-1)
    if np.mean(np.abs(found[:, :2] - centres).max(axis=1) <= _DIFFERENCE) < 0.99:
        raise AssertionError("a peer measured other centres of blobs")


def _deviation(found: NDArray[Any], true: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean((found - true) ** 2)))
