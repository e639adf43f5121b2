"""Blobs in Numba, the strongest form: spokes, start circles and pixels side by side, as elements of vectors.

The method is that of `gpuvision.profiling.blob_peers`. The edges along the 16 spokes are measured together; a pixel and
its right neighbour are loaded as 16 bits. The match takes all pixels of a window of 32 x 32, with the weight 0 outside
the disc, and a pass over the equations sums up to thirty of their products. Numba arrays carry no promise about
aliases: the loops read and write parts of one flat array at constant offsets, and are vectorised.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from gpuvision.matching.features.blob import TUNING_CONSTANT
from gpuvision.profiling.blob_peers import (
    LENGTH,
    REACH,
    SEARCH,
    SLOPES,
    SPOKES,
    SUMS,
    UNKNOWNS,
    describe,
    factor,
    fit_circle,
    solve,
    start_in_lanes,
)

WINDOW = 32  # rows and columns of the window of a match; serves radii up to 9 px with a blur of 1 px
_PIXELS = WINDOW * WINDOW
_F, _U = np.float32, np.uint32
_ZERO, _ONE, _TINY = _F(0.0), _F(1.0), _F(1e-6)
# Offsets in the flat array of a task: profiles and gradients of the spokes, the gradients at the peaks, and directions.
_SLOPES_AT = _U(LENGTH * SPOKES)
_BEST, _PLACE, _BEFORE, _AFTER = (_U((LENGTH + SLOPES + k) * SPOKES) for k in range(4))
_SHARE_X, _SHARE_Y, _COSINE, _SINE = (_U((LENGTH + SLOPES + k) * SPOKES) for k in range(4, 8))
_FROM_X, _FROM_Y = (_U((LENGTH + SLOPES + k) * SPOKES) for k in (8, 9))
_EX, _EY, _FOUND, _HEIGHT, _WIDTH, _NOISE = (_U((LENGTH + SLOPES + k) * SPOKES) for k in range(10, 16))
_SPOKES_ROOM = (LENGTH + SLOPES + 17) * SPOKES
# Offsets in the flat array of the match: grey levels, then the nine numbers of the equation of each pixel.
_EQUATIONS = _U(_PIXELS)
_MATCH_ROOM = (UNKNOWNS + 2) * _PIXELS


@numba.njit(error_model="numpy", fastmath=SUMS)
def _sample_spokes(pairs, pitch, x, y, radius, room, at, cells):
    """Write the profiles along all spokes; the rulers are centred on a circle."""
    middle, spokes = _F(0.5 * (LENGTH - 1)), _U(SPOKES)
    for m in range(spokes):
        room[_FROM_X + m] = x + (radius - middle) * room[_COSINE + m]
        room[_FROM_Y + m] = y + (radius - middle) * room[_SINE + m]
    for i in range(LENGTH):
        to = _U(i * SPOKES)
        for m in range(spokes):
            at_x, at_y = room[_FROM_X + m] + _F(i) * room[_COSINE + m], room[_FROM_Y + m] + _F(i) * room[_SINE + m]
            column, row = np.int32(at_x), np.int32(at_y)
            room[_SHARE_X + m], room[_SHARE_Y + m] = at_x - _F(column), at_y - _F(row)
            at[m] = _U(row) * pitch + _U(column)
        for m in range(spokes):
            place = np.uint64(at[m])
            cells[m] = _U(pairs[place]) | (_U(pairs[place + np.uint64(pitch)]) << _U(16))
        for m in range(spokes):
            cell, dx, dy = cells[m], room[_SHARE_X + m], room[_SHARE_Y + m]
            a, b = _F(np.int32(cell & _U(255))), _F(np.int32((cell >> _U(8)) & _U(255)))
            c, d = _F(np.int32((cell >> _U(16)) & _U(255))), _F(np.int32(cell >> _U(24)))
            a += dx * (b - a)
            c += dx * (d - c)
            room[to + m] = a + dy * (c - a)


@numba.njit(error_model="numpy", fastmath=SUMS)
def _find_falling_edges(room, taps):
    """Write the strongest falling edge of each spoke: gradient (0 without an edge), place, and the neighbours."""
    one, two, three, four, five = taps[0], taps[1], taps[2], taps[3], taps[4]
    spokes = _U(SPOKES)
    for k in range(_U(SLOPES * SPOKES)):
        j = k + _U(REACH * SPOKES)
        room[_SLOPES_AT + k] = -(
            one * (room[j + spokes] - room[j - spokes])
            + two * (room[j + _U(2 * SPOKES)] - room[j - _U(2 * SPOKES)])
            + three * (room[j + _U(3 * SPOKES)] - room[j - _U(3 * SPOKES)])
            + four * (room[j + _U(4 * SPOKES)] - room[j - _U(4 * SPOKES)])
            + five * (room[j + _U(5 * SPOKES)] - room[j - _U(5 * SPOKES)])
        )
    for m in range(spokes):
        room[_BEST + m], room[_PLACE + m], room[_BEFORE + m], room[_AFTER + m] = _ZERO, _ZERO, _ONE, _ONE


@numba.njit(error_model="numpy", fastmath=SUMS)
def _choose_edges(room, least):
    spokes = _U(SPOKES)
    for i in range(1, SLOPES - 1):
        for m in range(spokes):
            at = _SLOPES_AT + _U(i * SPOKES) + m
            here, before, after, best = room[at], room[at - spokes], room[at + spokes], room[_BEST + m]
            is_best = (here >= least) & (here > before) & (here >= after) & (here > best)
            room[_BEST + m] = here if is_best else best
            room[_PLACE + m] = _F(i) if is_best else room[_PLACE + m]
            room[_BEFORE + m] = before if is_best else room[_BEFORE + m]
            room[_AFTER + m] = after if is_best else room[_AFTER + m]


@numba.njit(error_model="numpy", fastmath=SUMS)
def _refine_edges(room, table, from_x, from_y, from_r, size):
    """Write the edges: x, y, whether found, amplitude, squared width, variance; return the number found."""
    smoothing, noise, half = table[1], table[2], _F(0.5)
    count = _ZERO
    for m in range(_U(SPOKES)):
        best = room[_BEST + m]
        per = _ONE / max(best, _TINY)
        before, after = math.log(max(room[_BEFORE + m] * per, _TINY)), math.log(max(room[_AFTER + m] * per, _TINY))
        variance, tilt = -_ONE / (before + after), half * (after - before)
        shift = tilt * variance
        sigma = noise * variance * math.exp(half / variance) * per
        distance = from_r + room[_PLACE + m] + shift + _F(REACH - 0.5 * (LENGTH - 1))
        ex, ey = from_x + distance * room[_COSINE + m], from_y + distance * room[_SINE + m]
        off = abs(math.sqrt(ex * ex + ey * ey) - size)
        found = _ONE if (best > _ZERO) & (off <= _F(SEARCH)) else _ZERO
        room[_EX + m], room[_EY + m], room[_FOUND + m] = ex, ey, found
        room[_HEIGHT + m] = -best * math.exp(half * tilt * shift) * math.sqrt(_F(2.0 * math.pi) * variance)
        room[_WIDTH + m], room[_NOISE + m] = max(variance - smoothing, _ZERO), sigma * sigma
        count += found
    return count


@numba.njit(error_model="numpy", fastmath=SUMS)
def _load_window(pixels, pitch, column, row, room):
    """Write the grey levels of a window as floats."""
    for i in range(WINDOW):
        start = (row + i) * pitch + column
        part = pixels[start : start + WINDOW]
        for k in range(WINDOW):
            room[_U(i * WINDOW + k)] = _F(part[_U(k)])


@numba.njit(error_model="numpy", fastmath=SUMS)
def _equations(room, x, y, shape, grey, slope_x, slope_y, scale):
    """Fill the equations of all pixels of the window, scaled by the root of their weights; return the pixels used."""
    reach = shape[2] + _F(5.0) * grey[2] + _F(2.0)
    per_blur, per_size, per_scale = _ONE / grey[2], _ONE / shape[2], _F(1.0 / TUNING_CONSTANT) / scale
    curvature, size, background, contrast = _F(0.5) * grey[2] * per_size, shape[2], grey[0], grey[1]
    c0, c1, c2 = _F(1.393465), _F(-2.767476), _F(4.513241)
    c3, c4, c5 = _F(-4.759453), _F(2.831766), _F(-0.711542)
    used, most = _ZERO, reach * reach
    for k in range(_U(_PIXELS)):
        dx, dy = _F(np.int32(k & _U(WINDOW - 1))) - x, _F(np.int32(k // _U(WINDOW))) - y
        square = dx * dx + dy * dy + _F(1e-12)
        inside = _ONE if square <= most else _ZERO
        r = math.sqrt(square)
        per = _ONE / r
        t = (size - r) * per_blur
        v = min(max(t, _F(-3.5)), _F(3.5)) * _F(1.0 / 3.5)
        q = v * v
        step = v * (((((c5 * q + c4) * q + c3) * q + c2) * q + c1) * q + c0) + _F(0.5)
        density = _F(11.0) * c5 * q + _F(9.0) * c4
        density = ((density * q + _F(7.0) * c3) * q + _F(5.0) * c2) * q + _F(3.0) * c1
        density = (density * q + c0) * _F(1.0 / 3.5)
        level, slope = step - density * curvature, contrast * density * per_blur
        residual = room[k] - background - contrast * level - (slope_x * dx + slope_y * dy) * per_size
        z = residual * per_scale
        root = inside * max(_ONE - z * z, _ZERO)
        steep = root * slope
        at = _EQUATIONS + k
        room[at] = steep * dx * per
        room[at + _U(_PIXELS)] = steep * dy * per
        room[at + _U(2 * _PIXELS)] = steep
        room[at + _U(3 * _PIXELS)] = -t * steep
        room[at + _U(4 * _PIXELS)] = root * level
        room[at + _U(5 * _PIXELS)] = root
        room[at + _U(6 * _PIXELS)] = root * dx * per_size
        room[at + _U(7 * _PIXELS)] = root * dy * per_size
        room[at + _U(8 * _PIXELS)] = root * residual
        used += inside
    return used


@numba.njit(error_model="numpy", fastmath=SUMS)
def _products_of_first(room, sums):
    """Sum the products of the first four numbers of the equations with all later ones, in one pass."""
    s00, s01, s02, s03, s04, s05, s06, s07, s08 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s11, s12, s13, s14, s15, s16, s17, s18 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s22, s23, s24, s25, s26, s27, s28 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s33, s34, s35, s36, s37, s38 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(_U(_PIXELS)):
        at = _EQUATIONS + k
        e0 = room[at]
        e1 = room[at + _U(1 * _PIXELS)]
        e2 = room[at + _U(2 * _PIXELS)]
        e3 = room[at + _U(3 * _PIXELS)]
        e4 = room[at + _U(4 * _PIXELS)]
        e5 = room[at + _U(5 * _PIXELS)]
        e6 = room[at + _U(6 * _PIXELS)]
        e7 = room[at + _U(7 * _PIXELS)]
        e8 = room[at + _U(8 * _PIXELS)]
        s00 += e0 * e0
        s01 += e0 * e1
        s02 += e0 * e2
        s03 += e0 * e3
        s04 += e0 * e4
        s05 += e0 * e5
        s06 += e0 * e6
        s07 += e0 * e7
        s08 += e0 * e8
        s11 += e1 * e1
        s12 += e1 * e2
        s13 += e1 * e3
        s14 += e1 * e4
        s15 += e1 * e5
        s16 += e1 * e6
        s17 += e1 * e7
        s18 += e1 * e8
        s22 += e2 * e2
        s23 += e2 * e3
        s24 += e2 * e4
        s25 += e2 * e5
        s26 += e2 * e6
        s27 += e2 * e7
        s28 += e2 * e8
        s33 += e3 * e3
        s34 += e3 * e4
        s35 += e3 * e5
        s36 += e3 * e6
        s37 += e3 * e7
        s38 += e3 * e8
    sums[0, 0] = s00
    sums[0, 1] = s01
    sums[0, 2] = s02
    sums[0, 3] = s03
    sums[0, 4] = s04
    sums[0, 5] = s05
    sums[0, 6] = s06
    sums[0, 7] = s07
    sums[0, 8] = s08
    sums[1, 1] = s11
    sums[1, 2] = s12
    sums[1, 3] = s13
    sums[1, 4] = s14
    sums[1, 5] = s15
    sums[1, 6] = s16
    sums[1, 7] = s17
    sums[1, 8] = s18
    sums[2, 2] = s22
    sums[2, 3] = s23
    sums[2, 4] = s24
    sums[2, 5] = s25
    sums[2, 6] = s26
    sums[2, 7] = s27
    sums[2, 8] = s28
    sums[3, 3] = s33
    sums[3, 4] = s34
    sums[3, 5] = s35
    sums[3, 6] = s36
    sums[3, 7] = s37
    sums[3, 8] = s38


@numba.njit(error_model="numpy", fastmath=SUMS)
def _products_of_last(room, sums):
    """Sum the products of the last five numbers of the equations, in one pass."""
    s44, s45, s46, s47, s48 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s55, s56, s57, s58 = _ZERO, _ZERO, _ZERO, _ZERO
    s66, s67, s68 = _ZERO, _ZERO, _ZERO
    s77, s78 = _ZERO, _ZERO
    s88 = _ZERO
    for k in range(_U(_PIXELS)):
        at = _EQUATIONS + k
        e4 = room[at + _U(4 * _PIXELS)]
        e5 = room[at + _U(5 * _PIXELS)]
        e6 = room[at + _U(6 * _PIXELS)]
        e7 = room[at + _U(7 * _PIXELS)]
        e8 = room[at + _U(8 * _PIXELS)]
        s44 += e4 * e4
        s45 += e4 * e5
        s46 += e4 * e6
        s47 += e4 * e7
        s48 += e4 * e8
        s55 += e5 * e5
        s56 += e5 * e6
        s57 += e5 * e7
        s58 += e5 * e8
        s66 += e6 * e6
        s67 += e6 * e7
        s68 += e6 * e8
        s77 += e7 * e7
        s78 += e7 * e8
        s88 += e8 * e8
    sums[4, 4] = s44
    sums[4, 5] = s45
    sums[4, 6] = s46
    sums[4, 7] = s47
    sums[4, 8] = s48
    sums[5, 5] = s55
    sums[5, 6] = s56
    sums[5, 7] = s57
    sums[5, 8] = s58
    sums[6, 6] = s66
    sums[6, 7] = s67
    sums[6, 8] = s68
    sums[7, 7] = s77
    sums[7, 8] = s78
    sums[8, 8] = s88


@numba.njit(error_model="numpy", fastmath=SUMS)
def _match_window(room, sums, x, y, shape, grey, noise, matrix, right, to, covariance):
    """Refine circle, blur and grey levels by a least-squares match of the pixels; fill the covariance."""
    slope_x, slope_y = _ZERO, _ZERO
    for step in range(3):
        scale = (_F(0.1) * grey[1] + _F(4.0) * noise) / _F(TUNING_CONSTANT)
        used = _equations(room, x + shape[0], y + shape[1], shape, grey, slope_x, slope_y, scale)
        _products_of_first(room, sums)
        _products_of_last(room, sums)
        for i in range(UNKNOWNS):
            right[i] = sums[i, UNKNOWNS]
            for j in range(i + 1):
                matrix[i, j] = sums[j, i]
        weights, squares = sums[5, 5], sums[UNKNOWNS, UNKNOWNS]
        factor(matrix)
        solve(matrix, right, to)
        less = _ZERO
        for i in range(UNKNOWNS):
            less += to[i] * right[i]
        for i in range(3):
            shape[i] += to[i]
        grey[2] += to[3]
        grey[1] += to[4]
        grey[0] += to[5]
        slope_x += to[6]
        slope_y += to[7]
        if to[0] ** 2 + to[1] ** 2 + to[2] ** 2 + to[3] ** 2 > _F(0.0025) * grey[2] ** 2 and step < 2:
            continue
        variance = max(squares - less, _ZERO) / weights * used / (used - _F(UNKNOWNS))
        for i in range(3):
            right[:] = _ZERO
            right[i] = _ONE
            solve(matrix, right, to)
            for k in range(3):
                covariance[i, k] = variance * to[k]
        return


@numba.njit(error_model="numpy", fastmath=SUMS)
def _gravity(room, x, y, reach, level):
    """Return the centre of gravity within `reach` of (x, y), with the background of the surrounding ring subtracted."""
    inner, outer = reach * reach, (reach + _F(2.0)) * (reach + _F(2.0))
    area, total, sum_x, sum_y = _ZERO, _ZERO, _ZERO, _ZERO
    at_x, at_y, about, sum_about = _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(_U(_PIXELS)):
        dx, dy = _F(np.int32(k & _U(WINDOW - 1))) - x, _F(np.int32(k // _U(WINDOW))) - y
        square = dx * dx + dy * dy
        inside = _ONE if square <= inner else _ZERO
        ring = (_ONE if square <= outer else _ZERO) - inside
        grey = room[k] - level
        weighed = inside * grey
        area += inside
        at_x += inside * dx
        at_y += inside * dy
        total += weighed
        sum_x += weighed * dx
        sum_y += weighed * dy
        about += ring
        sum_about += ring * grey
    background = sum_about / about
    per = _ONE / (total - background * area)
    return (sum_x - background * at_x) * per, (sum_y - background * at_y) * per


def find_in_lanes(parallel: bool) -> Any:
    """Return a function that measures all blobs, on all cores under `parallel`.

    Besides the arguments of `find_form` it takes `pairs`, the view of `gpuvision.profiling.ruler_peers.Frame`.
    """

    @numba.njit(parallel=parallel, error_model="numpy", fastmath=SUMS)
    def find(image, pairs, places, table, directions, noise, found, covariance, status):
        """Fill blobs (n, 13): x, y, size, residual, inliers, symmetry, gravity, distance, contrast, blur, shift."""
        pixels, pitch = image.reshape(-1), image.shape[1]
        for n in numba.prange(places.shape[0]):
            lanes, room = np.empty(_SPOKES_ROOM, np.float32), np.empty(_MATCH_ROOM, np.float32)
            at, cells = np.empty(SPOKES, np.uint32), np.empty(SPOKES, np.uint32)
            edges, sums = lanes[_EX:].reshape(7, SPOKES), np.empty((UNKNOWNS + 1, UNKNOWNS + 1), np.float32)
            circle_sums = np.empty(9, np.float32)
            matrix, right = np.empty((UNKNOWNS, UNKNOWNS), np.float32), np.empty(UNKNOWNS, np.float32)
            to, shape, grey = np.empty(UNKNOWNS, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
            x, y, size = places[n, 0], places[n, 1], places[n, 2]
            shape[0], shape[1], shape[2] = _ZERO, _ZERO, size
            blur, scale = _ZERO, _ZERO
            for m in range(SPOKES):
                lanes[_COSINE + _U(m)], lanes[_SINE + _U(m)] = directions[m, 0], directions[m, 1]
            for step in range(2):
                from_x, from_y, from_r = shape[0], shape[1], shape[2]
                _sample_spokes(pairs, _U(pitch), x + from_x, y + from_y, from_r, lanes, at, cells)
                _find_falling_edges(lanes, table[3:])
                _choose_edges(lanes, table[0])
                count = _refine_edges(lanes, table, from_x, from_y, from_r, size)
                if count < _F(SPOKES // 2):
                    break
                if step == 0:
                    shape[0], shape[1], shape[2] = start_in_lanes(edges[0], edges[1], edges[2], count, shape, _F(0.6))
                blur, scale = fit_circle(
                    edges[0], edges[1], edges[2], edges[4], edges[5], shape, count, circle_sums, edges[6]
                )
                if (shape[0] - from_x) ** 2 + (shape[1] - from_y) ** 2 + (shape[2] - from_r) ** 2 < _F(4.0):
                    break
            describe(pixels, _U(pitch), x, y, shape, edges, directions, blur, scale, grey, found[n])
            column, row = int(x + shape[0]) - WINDOW // 2 + 1, int(y + shape[1]) - WINDOW // 2 + 1
            _load_window(pixels, pitch, column, row, room)
            in_x, in_y = x - _F(column), y - _F(row)
            _match_window(room, sums, in_x, in_y, shape, grey, noise, matrix, right, to, covariance[n])
            reach = shape[2] + _F(2.5) * grey[2] + _ONE
            heavy_x, heavy_y = _gravity(room, in_x + shape[0], in_y + shape[1], reach, grey[0] + grey[1])
            found[n, 0], found[n, 1], found[n, 2] = x + shape[0], y + shape[1], shape[2]
            found[n, 6], found[n, 7] = found[n, 0] + heavy_x, found[n, 1] + heavy_y
            found[n, 8] = math.sqrt(shape[0] ** 2 + shape[1] ** 2)
            found[n, 9], found[n, 10], found[n, 11], found[n, 12] = grey[1], grey[2], shape[0], shape[1]
            status[n] = np.uint8(found[n, 4] < _F(SPOKES // 2))

    return find
