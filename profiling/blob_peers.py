"""Blobs in Numba: the method of `FindBlobs` in one fused function, blob after blob.

The first circle is found triple by triple, or from all triples of edges side by side. The strongest form is in
`gpuvision.profiling.blob_lanes`.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from gpuvision.matching.features.blob import TUNING_CONSTANT

SPOKES, SEARCH, REACH = 16, 4.0, 5
LENGTH = 2 * (math.ceil(SEARCH) + REACH) + 3
SLOPES, UNKNOWNS = LENGTH - 2 * REACH, 8
_PIXELS = 1024  # room for the pixels of a blob
_PATTERNS = np.array([[4, 8], [5, 10], [3, 6], [2, 6]])
_F = np.float32
# Edges of the triples whose circles are start values: 16 triples for each pattern.
TRIPLES = len(_PATTERNS) * SPOKES
_FIRST = np.tile(np.arange(SPOKES), len(_PATTERNS))
_SECOND, _THIRD = ((_FIRST + np.repeat(_PATTERNS[:, k], SPOKES)) % SPOKES for k in (0, 1))
SUMS = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(error_model="numpy", fastmath=SUMS)
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
    for i in range(SLOPES):
        slope = _F(0.0)
        for k in range(1, REACH + 1):
            slope -= table[2 + k] * (profile[i + REACH + k] - profile[i + REACH - k])
        slopes[i] = slope
    best, at_best = _F(0.0), 0
    for i in range(1, SLOPES - 1):
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


@numba.njit(error_model="numpy", fastmath=SUMS)
def start(ex, ey, there, count, shape, reach):
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


@numba.njit(error_model="numpy", fastmath=SUMS)
def start_in_lanes(ex, ey, there, count, shape, reach):
    """Return the same circle as `start`: the circles of all triples of edges side by side, as elements of vectors."""
    lanes, one = np.empty((11, TRIPLES), np.float32), _F(1.0)
    for n in range(TRIPLES):
        i, j, k = _FIRST[n], _SECOND[n], _THIRD[n]
        lanes[0, n], lanes[1, n], lanes[2, n], lanes[3, n] = ex[i], ey[i], ex[j], ey[j]
        lanes[4, n], lanes[5, n], lanes[10, n] = ex[k], ey[k], there[i] * there[j] * there[k]
    for n in range(TRIPLES):
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
        for n in range(TRIPLES):
            x, y = at_x - lanes[6, n], at_y - lanes[7, n]
            off = math.sqrt(x * x + y * y) - lanes[8, n]
            lanes[9, n] += found * min(off * off, most) + (one - found) * most
    best, least = -1, _F(SPOKES) * most
    for n in range(TRIPLES):
        if lanes[10, n] > _F(0.0) and lanes[9, n] < least:
            best, least = n, lanes[9, n]
    if best < 0:
        return shape[0], shape[1], shape[2]
    return lanes[6, best], lanes[7, best], lanes[8, best]


@numba.njit(error_model="numpy", fastmath=SUMS)
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


@numba.njit(error_model="numpy", fastmath=SUMS)
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


@numba.njit(error_model="numpy", fastmath=SUMS)
def fit_circle(ex, ey, there, widths, noises, shape, count, sums, room):
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


@numba.njit(error_model="numpy", fastmath=SUMS)
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


@numba.njit(error_model="numpy", fastmath=SUMS)
def factor(matrix):
    """Factor a symmetric matrix (Cholesky); the diagonal holds reciprocals."""
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total * matrix[j, j] if j < i else _F(1.0) / math.sqrt(total)


@numba.njit(error_model="numpy", fastmath=SUMS)
def solve(matrix, right, to):
    """Solve a system by the factors of its matrix."""
    for i in range(UNKNOWNS):
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * to[k]
        to[i] = total * matrix[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        total = to[i]
        for k in range(i + 1, UNKNOWNS):
            total -= matrix[k, i] * to[k]
        to[i] = total * matrix[i, i]


@numba.njit(error_model="numpy", fastmath=SUMS)
def _match(pixels, pitch, x, y, shape, grey, noise, equation, matrix, right, to, covariance):
    """Refine circle, blur and grey levels by a least-squares match of the pixels; fill the covariance."""
    slopes = np.zeros(2, np.float32)
    for step in range(3):
        scale = (_F(0.1) * grey[1] + _F(4.0) * noise) / _F(TUNING_CONSTANT)
        n = _rows_of(pixels, pitch, x + shape[0], y + shape[1], shape, grey, slopes, scale, equation)
        for i in range(UNKNOWNS + 1):
            for j in range(min(i, UNKNOWNS - 1) + 1):
                total = _F(0.0)
                for k in range(n):
                    total += equation[i, k] * equation[j, k]
                if i < UNKNOWNS:
                    matrix[i, j] = total
                else:
                    right[j] = total
        squares, weights = _F(0.0), matrix[5, 5]
        for k in range(n):
            squares += equation[8, k] * equation[8, k]
        factor(matrix)
        solve(matrix, right, to)
        less = _F(0.0)
        for i in range(UNKNOWNS):
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
        variance = max(squares - less, _F(0.0)) / weights * _F(n) / _F(n - UNKNOWNS)
        for i in range(3):
            right[:] = _F(0.0)
            right[i] = _F(1.0)
            solve(matrix, right, to)
            for k in range(3):
                covariance[i, k] = variance * to[k]
        return


@numba.njit(error_model="numpy", fastmath=SUMS)
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


@numba.njit(error_model="numpy", fastmath=SUMS)
def describe(pixels, pitch, x, y, shape, edges, directions, blur, scale, grey, found):
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


def find_form(first_circle: Any, parallel: bool) -> Any:
    """Return a function that measures all blobs: `first_circle` finds the start, on all cores under `parallel`."""

    @numba.njit(parallel=parallel, error_model="numpy", fastmath=SUMS)
    def find(image, places, table, directions, noise, found, covariance, status):
        """Fill blobs (n, 13): x, y, size, residual, inliers, symmetry, gravity, distance, contrast, blur, shift."""
        pixels, pitch = image.reshape(-1), np.uint32(image.shape[1])
        for n in numba.prange(places.shape[0]):
            profile, slopes = np.empty(LENGTH, np.float32), np.empty(SLOPES, np.float32)
            edges, sums = np.empty((7, SPOKES), np.float32), np.empty(9, np.float32)
            ex, ey, is_found, heights = edges[0], edges[1], edges[2], edges[3]
            widths, noises, room = edges[4], edges[5], edges[6]
            equation = np.empty((UNKNOWNS + 1, _PIXELS), np.float32)
            matrix, right = np.empty((UNKNOWNS, UNKNOWNS), np.float32), np.empty(UNKNOWNS, np.float32)
            to, shape, grey = np.empty(UNKNOWNS, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
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
                    shape[0], shape[1], shape[2] = first_circle(ex, ey, is_found, count, shape, _F(0.6))
                blur, scale = fit_circle(ex, ey, is_found, widths, noises, shape, count, sums, room)
                if (shape[0] - from_x) ** 2 + (shape[1] - from_y) ** 2 + (shape[2] - from_r) ** 2 < _F(4.0):
                    break
            describe(pixels, pitch, x, y, shape, edges, directions, blur, scale, grey, found[n])
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
