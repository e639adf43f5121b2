"""Line fits and the pose of a board in Numba, with the strongest form of an expert: problems side by side.

Lines are fitted side by side, 16 elements of a vector each; of the pose the start candidates are side by side, and the
rows of the normal equations. Numba arrays carry no promise about aliases: every loop reads and writes parts of one flat
array at constant offsets, and such loops are vectorised.
"""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np

from gpuvision.profiling.line_fit import EFFICIENCY, STEPS, TUNING_CONSTANT

LANES = 16  # lines side by side
_F, _U = np.float32, np.uint32
_PER = _F(1.0 / TUNING_CONSTANT**2)
_ZERO, _HALF, _ONE, _TWO = _F(0.0), _F(0.5), _F(1.0), _F(2.0)
_FAST = {"contract", "reassoc", "nsz", "arcp"}


@functools.cache
def line_form(each: int) -> Any:
    """Return a Numba function ``(room, pairs)`` that fits up to 16 lines through `each` points each.

    The flat array `room` (`line_room` elements) holds u, v and the inverse standard deviations of point k of line n at
    ``(k + each * 0, 1, 2) * 16 + n``. The function writes centre x, y, direction cosine, sine, and the variances of
    offset and angle of line n behind them, at ``(3 * each + 0..5) * 16 + n``.
    """
    v_at, w_at = _U(each * LANES), _U(2 * each * LANES)
    best = _U(3 * each * LANES)  # x, y, cosine, sine, variance of the offset (or the loss), variance of the angle
    y_at, c_at, s_at, loss_at, turn_at = (_U(best + k * LANES) for k in range(1, 6))

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def start(room, found, pairs):
        """Find the best pair of points by Tukey's loss; `found` is another array, as offsets of pairs vary."""
        for n in range(_U(LANES)):
            found[n], found[_U(1 * LANES) + n], found[_U(2 * LANES) + n], found[_U(3 * LANES) + n] = (
                _ZERO,
                _ZERO,
                _ONE,
                _ZERO,
            )
            found[_U(4 * LANES) + n] = _F(1e30)
        for t in range(pairs.shape[0]):
            i, j = _U(pairs[t, 0] * LANES), _U(pairs[t, 1] * LANES)
            for n in range(_U(LANES)):
                x, y = room[i + n], room[v_at + i + n]
                c, s = room[j + n] - x, room[v_at + j + n] - y
                per = _ONE / np.sqrt(c * c + s * s)
                c, s, loss = c * per, s * per, _ZERO
                for k in range(each):
                    at = _U(k * LANES) + n
                    z = (c * (room[v_at + at] - y) - s * (room[at] - x)) * room[w_at + at]
                    left = max(_ONE - z * z * _PER, _ZERO)
                    loss += _ONE - left * left * left
                is_better = (loss < found[_U(4 * LANES) + n]) & (room[w_at + i + n] * room[w_at + j + n] > _ZERO)
                found[_U(4 * LANES) + n] = loss if is_better else found[_U(4 * LANES) + n]
                found[n] = x if is_better else found[n]
                found[_U(1 * LANES) + n] = y if is_better else found[_U(1 * LANES) + n]
                found[_U(2 * LANES) + n] = c if is_better else found[_U(2 * LANES) + n]
                found[_U(3 * LANES) + n] = s if is_better else found[_U(3 * LANES) + n]

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def step(room):
        """Take a step of iteratively reweighted least squares."""
        for n in range(_U(LANES)):
            x, y, c, s = room[best + n], room[y_at + n], room[c_at + n], room[s_at + n]
            sw, su, sv, suu, suv, svv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            for k in range(each):
                at = _U(k * LANES) + n
                dx, dy, certainty = room[at] - x, room[v_at + at] - y, room[w_at + at]
                a, b = c * dx + s * dy, c * dy - s * dx
                z = b * certainty
                left = certainty * max(_ONE - z * z * _PER, _ZERO)
                weight = left * left
                of_a, of_b = weight * a, weight * b
                sw += weight
                su += of_a
                sv += of_b
                suu += of_a * a
                suv += of_a * b
                svv += of_b * b
            per = _ONE / sw
            a, b = su * per, sv * per
            across, along = _TWO * (suv - su * b), suu - su * a - (svv - sv * b)
            length = np.sqrt(across * across + along * along)
            part = np.sqrt(_HALF + _HALF * along / length)
            turn = _HALF * across / (length * part)
            room[best + n], room[y_at + n] = x + c * a - s * b, y + s * a + c * b
            room[c_at + n], room[s_at + n] = c * part - s * turn, s * part + c * turn

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def fit(room, pairs):
        found = np.empty(5 * LANES, np.float32)
        start(room, found, pairs)
        for n in range(_U(4 * LANES)):
            room[best + n] = found[n]
        for _ in range(STEPS):
            step(room)
        for n in range(_U(LANES)):
            x, y, c, s = room[best + n], room[y_at + n], room[c_at + n], room[s_at + n]
            sw, suu = _ZERO, _ZERO
            for k in range(each):
                at = _U(k * LANES) + n
                dx, dy, certainty = room[at] - x, room[v_at + at] - y, room[w_at + at]
                a, z = c * dx + s * dy, (c * dy - s * dx) * certainty
                weight = certainty * certainty if z * z * _PER < _ONE else _ZERO
                sw += weight
                suu += weight * a * a
            room[loss_at + n], room[turn_at + n] = _ONE / (EFFICIENCY * sw), _ONE / (EFFICIENCY * suu)

    return fit


def line_room(each: int) -> int:
    """Return the elements of the flat array of `line_form`."""
    return (3 * each + 6) * LANES


@functools.cache
def pose_form(count: int, trials: int) -> Any:
    """Return a Numba function ``(room, starts, placement, pose, covariance)`` of a pose from `count` rows.

    The flat array `room` (`pose_room` elements) begins with the rows (7, `padded(count)`); rows behind the last one
    have the certainty 0. The arithmetic is that of `gpuvision.profiling.pose.fit_pose`.
    """
    wide = padded(count)
    px_at, py_at, ex_at, ey_at, w_at = (_U(k * wide) for k in (2, 3, 4, 5, 6))
    ny_at, of_trials = _U(wide), 7 * wide
    # Of each trial: its pose (cosine - 1, sine, x, y), whether its equations have a solution, its loss, and 3 x 6
    # values of its rows.
    sine_at, x_at, y_at, good_at, loss_at, rows_at = (_U(of_trials + k * trials) for k in range(1, 7))
    less_at = _U(of_trials)
    least_determinant = _F(1e-6)

    @numba.njit(error_model="numpy", fastmath=_FAST, inline="always")
    def row_at(less, sine, x, y, nx, ny, px, py, ex, ey):
        """Return residual and derivative by the angle of a row at a pose."""
        wx, wy = ex - x - (less * px - sine * py), ey - y - (sine * px + less * py)
        bx, by = wx + less * wx + sine * wy, wy + less * wy - sine * wx
        return nx * bx + ny * by, ny * (px + bx) - nx * (py + by)

    @numba.njit(error_model="numpy", fastmath=_FAST, inline="always")
    def solved(a, b, c, d, e, f, u, v, w):
        """Return the solution of a symmetric system, triangle (00, 10, 11, 20, 21, 22), and its determinant."""
        p, q, r = c * f - e * e, d * e - b * f, b * e - c * d
        s, t, z = a * f - d * d, b * d - a * e, a * c - b * b
        determinant = a * p + b * q + d * r
        per = _ONE / determinant
        return (
            (p * u + q * v + r * w) * per,
            (q * u + s * v + t * w) * per,
            (r * u + t * v + z * w) * per,
            determinant,
        )

    @numba.njit(error_model="numpy", fastmath=_FAST, inline="always")
    def moved(less, sine, x, y, dx, dy, turn):
        """Return a pose after a step in its frame."""
        c = _ONE / np.sqrt(_ONE + turn * turn)
        s = turn * c
        change = -s * s / (_ONE + c)
        x, y = x + dx + less * dx - sine * dy, y + dy + less * dy + sine * dx
        return less + change + less * change - sine * s, sine + s + sine * change + less * s, x, y

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def try_starts(room, starts):
        """Solve the poses of all triples of rows side by side, and sum Tukey's loss of all rows at each pose."""
        for row in range(3):
            for value in range(6):
                to = rows_at + _U((6 * row + value) * trials)
                for t in range(trials):
                    room[to + _U(t)] = room[_U(value * wide + starts[t, row])]
        for t in range(_U(trials)):
            less, sine, x, y, good = _ZERO, _ZERO, _ZERO, _ZERO, _ONE
            for _ in range(3):
                a, b, c, d, e, f = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
                u, v, w = _ZERO, _ZERO, _ZERO
                for row in range(3):
                    at = rows_at + _U(6 * row * trials) + t
                    nx, ny = room[at], room[at + _U(trials)]
                    left, turn = row_at(
                        less,
                        sine,
                        x,
                        y,
                        nx,
                        ny,
                        room[at + _U(2 * trials)],
                        room[at + _U(3 * trials)],
                        room[at + _U(4 * trials)],
                        room[at + _U(5 * trials)],
                    )
                    a += nx * nx
                    b += nx * ny
                    c += ny * ny
                    d += nx * turn
                    e += ny * turn
                    f += turn * turn
                    u += nx * left
                    v += ny * left
                    w += turn * left
                dx, dy, turn, determinant = solved(a, b, c, d, e, f, u, v, w)
                good = good if determinant > least_determinant else _ZERO
                less, sine, x, y = moved(less, sine, x, y, dx, dy, turn)
            room[less_at + t], room[sine_at + t], room[x_at + t], room[y_at + t] = less, sine, x, y
            room[good_at + t], room[loss_at + t] = good, _ZERO
        for i in range(_U(count)):
            nx, ny, px, py = room[i], room[ny_at + i], room[px_at + i], room[py_at + i]
            ex, ey, certainty = room[ex_at + i], room[ey_at + i], room[w_at + i]
            for t in range(_U(trials)):
                left, _ = row_at(
                    room[less_at + t], room[sine_at + t], room[x_at + t], room[y_at + t], nx, ny, px, py, ex, ey
                )
                z = left * certainty
                part = max(_ONE - z * z * _PER, _ZERO)
                room[loss_at + t] += _ONE - part * part * part

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def equations(room, less, sine, x, y, is_last):
        """Return the sums of the weighted normal equations of all rows."""
        a, b, c, d, e, f = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        u, v, w = _ZERO, _ZERO, _ZERO
        for i in range(_U(wide)):
            nx, ny, certainty = room[i], room[ny_at + i], room[w_at + i]
            left, turn = row_at(
                less, sine, x, y, nx, ny, room[px_at + i], room[py_at + i], room[ex_at + i], room[ey_at + i]
            )
            z = left * certainty
            part = max(_ONE - z * z * _PER, _ZERO)
            part = (_ONE if part > _ZERO else _ZERO) if is_last else part
            part *= certainty
            weight = part * part
            wx, wy, wt = weight * nx, weight * ny, weight * turn
            a += wx * nx
            b += wx * ny
            c += wy * ny
            d += wx * turn
            e += wy * turn
            f += wt * turn
            u += wx * left
            v += wy * left
            w += wt * left
        return a, b, c, d, e, f, u, v, w

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def fit(room, starts, placement, pose, covariance):
        per_count, x0, y0, square = _F(1.0 / count), _ZERO, _ZERO, _ZERO
        for i in range(_U(count)):
            x0 += room[px_at + i] * per_count
            y0 += room[py_at + i] * per_count
        for i in range(_U(count)):
            room[px_at + i] -= x0
            room[py_at + i] -= y0
            square += room[px_at + i] * room[px_at + i] + room[py_at + i] * room[py_at + i]
        size = np.sqrt(square * per_count)
        per_size = _ONE / size
        for i in range(_U(count)):
            room[px_at + i] *= per_size
            room[py_at + i] *= per_size
            room[ex_at + i] *= per_size
            room[ey_at + i] *= per_size
            room[w_at + i] *= size
        try_starts(room, starts)
        best, least = _U(0), _F(1e30)
        for t in range(_U(trials)):
            if room[good_at + t] > _ZERO and room[loss_at + t] < least:
                best, least = _U(t), room[loss_at + t]
        less, sine, x, y = room[less_at + best], room[sine_at + best], room[x_at + best], room[y_at + best]
        for _ in range(STEPS):
            a, b, c, d, e, f, u, v, w = equations(room, less, sine, x, y, False)
            dx, dy, turn, _ = solved(a, b, c, d, e, f, u, v, w)
            less, sine, x, y = moved(less, sine, x, y, dx, dy, turn)
        a, b, c, d, e, f, u, v, w = equations(room, less, sine, x, y, True)
        inverse, lever = np.empty((3, 3), np.float32), np.zeros((3, 3), np.float32)
        for i in range(3):
            u, v, w = _F(i == 0), _F(i == 1), _F(i == 2)
            dx, dy, turn, _ = solved(a, b, c, d, e, f, u, v, w)
            inverse[i, 0], inverse[i, 1], inverse[i, 2] = dx / EFFICIENCY, dy / EFFICIENCY, turn / EFFICIENCY
        at_x, at_y, cosine = (placement[0] - x0) * per_size, (placement[1] - y0) * per_size, _ONE + less
        lever[0, 0], lever[0, 1], lever[0, 2] = size * cosine, -size * sine, -size * (at_y * cosine + at_x * sine)
        lever[1, 0], lever[1, 1], lever[1, 2] = size * sine, size * cosine, size * (at_x * cosine - at_y * sine)
        lever[2, 2] = _ONE
        for i in range(3):
            for j in range(3):
                total = _ZERO
                for k in range(3):
                    for n in range(3):
                        total += lever[i, k] * inverse[k, n] * lever[j, n]
                covariance[i, j] = total
        pose[0] = placement[0] + (x + less * at_x - sine * at_y) * size
        pose[1] = placement[1] + (y + less * at_y + sine * at_x) * size
        pose[2] = np.arctan2(sine, cosine)

    return fit


def padded(count: int) -> int:
    """Return a number of rows rounded up to whole vectors."""
    return -(-count // LANES) * LANES


def pose_room(count: int, trials: int) -> int:
    """Return the elements of the flat array of `pose_form`."""
    return 7 * padded(count) + 24 * trials


def fused_form(measure: Any, lines: int, each: int, trials: int) -> Any:
    """Return a Numba function that computes the pose of a board in one call, with lines and trials side by side.

    Parameters
    ----------
    measure
        Numba function that measures the edges along all rulers.
    lines, each, trials
        Numbers of lines, up to 16, of rulers across each, and of start candidates of the pose.
    """
    fit_lines, fit_pose = line_form(each), pose_form(2 * lines, trials)
    wide, v_at, w_at, best = padded(2 * lines), each * LANES, 2 * each * LANES, 3 * each * LANES
    of_lines, of_pose = line_room(each), pose_room(2 * lines, trials)

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def place_points(rulers, edges, status, smoothing, room):
        """Write the edge points of all lines in the frames of their lines, and their certainties."""
        for i in range(lines):
            for k in range(each):
                ruler, to = i * each + k, k * LANES + i
                s = edges[0, ruler] if status[ruler] == 0 else _ZERO
                width, noise = edges[2, ruler], edges[3, ruler]
                per = _ONE / (_ONE + s * rulers[ruler, 8])
                a, b = (rulers[ruler, 4] + s * rulers[ruler, 6]) * per, (rulers[ruler, 5] + s * rulers[ruler, 7]) * per
                sigma = noise * np.exp(_HALF / (width * width + smoothing))
                across = abs(rulers[ruler, 7] - b * rulers[ruler, 8]) * per * sigma
                room[to], room[v_at + to] = a, b
                room[w_at + to] = _ONE / across if status[ruler] == 0 else _ZERO

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def write_rows(room, lines_of_board, rows):
        """Write two rows of the pose for each line."""
        for i in range(lines):
            x, y, c, s = room[best + i], room[best + LANES + i], room[best + 2 * LANES + i], room[best + 3 * LANES + i]
            of_offset, of_angle = room[best + 4 * LANES + i], room[best + 5 * LANES + i]
            nx, ny, px, py, sigma = (
                lines_of_board[i, 0],
                lines_of_board[i, 1],
                lines_of_board[i, 2],
                lines_of_board[i, 3],
                lines_of_board[i, 4],
            )
            reach = np.sqrt(of_offset / of_angle)
            certainty = _ONE / np.sqrt(_TWO * of_offset + sigma * sigma)
            for side in range(2):
                offset = reach if side else -reach
                on, off, at = x + offset * c, y + offset * s, 2 * i + side
                rows[at], rows[wide + at] = nx, ny
                rows[2 * wide + at], rows[3 * wide + at] = px + on * ny, py - on * nx
                rows[4 * wide + at], rows[5 * wide + at], rows[6 * wide + at] = off * nx, off * ny, certainty

    @numba.njit(error_model="numpy", fastmath=_FAST)
    def fused(
        image,
        pixels,
        adjacent,
        packed,
        plain,
        rulers,
        lines_of_board,
        taps,
        numbers,
        pairs,
        starts,
        edges,
        status,
        pose,
        covariance,
        placement,
    ):
        measure(image, pixels, adjacent, packed, plain, taps, numbers, edges, status)
        room, rows = np.zeros(of_lines, np.float32), np.zeros(of_pose, np.float32)
        place_points(rulers, edges, status, numbers[1], room)
        fit_lines(room, pairs)
        write_rows(room, lines_of_board, rows)
        fit_pose(rows, starts, placement, pose, covariance)

    return fused
