"""Line readout in Numba: forms of an expert for whole columns, windows and fits, and the first loop of a user."""

from __future__ import annotations

import functools
import math
from typing import Any

import numba
import numpy as np

_STRIP = 512  # columns that a task reads
_BLOCK = 22  # rows whose sums of bytes, and sums of their running sums, fit 16 bits
_CHUNK = 128  # columns of a block that are summed if one of them has light
_LANES = 16  # columns that a task fits together
_F = np.float32
_FAST = {"contract", "reassoc", "nsz", "arcp"}
_UNKNOWNS = 4


# ---- centroid of the whole column --------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def _finish_centroid(sums, tops, n, rows, saturation, position, total, status):
    for c in range(n):
        s, moment = sums[c], np.uint32(rows) * sums[c] - sums[_STRIP + c]
        position[c] = np.float32(moment) / np.float32(s) if s > 0 else np.float32(np.nan)
        total[c] = s
        status[c] = np.uint8(s == 0) | (np.uint8(tops[c] >= saturation) << np.uint8(1))


@numba.njit(error_model="numpy")
def _add_row(line, part, tops, threshold):
    for c in range(np.uint32(line.size)):
        x = line[c]
        s = np.uint16(part[c] + np.uint16(max(x, threshold) - threshold))
        part[c] = s
        part[np.uint32(_STRIP) + c] += s
        tops[c] = max(tops[c], x)


@numba.njit(error_model="numpy")
def _flush(sums, part, n, count):
    """Add the partial sums of `count` rows: the moment is the sum of the running totals."""
    for c in range(np.uint32(n)):
        sums[np.uint32(_STRIP) + c] += np.uint32(count) * sums[c] + np.uint32(part[np.uint32(_STRIP) + c])
        sums[c] += np.uint32(part[c])
        part[c] = np.uint16(0)
        part[np.uint32(_STRIP) + c] = np.uint16(0)


@numba.njit(error_model="numpy")
def _rows_of_strip(frame, first, n, threshold, sums, part, tops):
    """Sum a strip row by row: partial sums of 16 bits in the first-level cache."""
    rows = frame.shape[0]
    for begin in range(0, rows, _BLOCK):
        end = min(begin + _BLOCK, rows)
        for r in range(begin, end):
            _add_row(frame[r, first : first + n], part, tops, threshold)
        _flush(sums, part, n, end - begin)


@numba.njit(error_model="numpy")
def _add_block(flat, at, pitch, n, threshold, sums, tops):
    for c in range(np.uint32(n)):
        s, m, top = np.uint16(0), np.uint16(0), tops[c]
        for k in range(_BLOCK):
            x = flat[at + np.uint64(k) * pitch + np.uint64(c)]
            s = np.uint16(s + np.uint16(max(x, threshold) - threshold))
            m = np.uint16(m + s)
            top = max(top, x)
        sums[np.uint32(_STRIP) + c] += np.uint32(_BLOCK) * sums[c] + np.uint32(m)
        sums[c] += np.uint32(s)
        tops[c] = top


@numba.njit(error_model="numpy")
def _blocks_of_strip(frame, first, n, threshold, sums, part, tops):
    """Sum a strip in blocks of rows, whose partial sums stay in registers."""
    rows, pitch = frame.shape
    flat, whole = frame.reshape(-1), rows // _BLOCK * _BLOCK
    for r in range(0, whole, _BLOCK):
        _add_block(flat, np.uint64(r * pitch + first), np.uint64(pitch), n, threshold, sums, tops)
    for r in range(whole, rows):
        _add_row(frame[r, first : first + n], part, tops, threshold)
    _flush(sums, part, n, rows - whole)


@numba.njit(error_model="numpy")
def _highest_of_block(flat, at, pitch, n, highest, tops):
    for c in range(np.uint32(n)):
        top = flat[at + np.uint64(c)]
        for k in range(1, _BLOCK):
            top = max(top, flat[at + np.uint64(k) * pitch + np.uint64(c)])
        highest[c] = top
    for c in range(np.uint32(n)):
        tops[c] = max(tops[c], highest[c])


@numba.njit(error_model="numpy")
def _largest(line):
    top = np.uint8(0)
    for c in range(np.uint32(line.size)):
        top = max(top, line[c])
    return top


@numba.njit(error_model="numpy")
def _add_lit_block(flat, at, pitch, n, threshold, later, sums):
    """Add a block after which `later` rows follow: running totals of each of them contain its sum."""
    for c in range(np.uint32(n)):
        s, m = np.uint16(0), np.uint16(0)
        for k in range(_BLOCK):
            x = flat[at + np.uint64(k) * pitch + np.uint64(c)]
            s = np.uint16(s + np.uint16(max(x, threshold) - threshold))
            m = np.uint16(m + s)
        sums[np.uint32(_STRIP) + c] += np.uint32(later) * np.uint32(s) + np.uint32(m)
        sums[c] += np.uint32(s)


@numba.njit(error_model="numpy")
def _lit_blocks_of_strip(frame, first, n, threshold, sums, part, tops):
    """Find the largest samples of blocks of rows, and sum only the parts of them that have light."""
    rows, pitch = frame.shape
    flat, whole = frame.reshape(-1), rows // _BLOCK * _BLOCK
    highest = np.zeros(_STRIP, np.uint8)
    for r in range(0, whole, _BLOCK):
        at = np.uint64(r * pitch + first)
        _highest_of_block(flat, at, np.uint64(pitch), n, highest, tops)
        for c in range(0, n, _CHUNK):
            width = min(_CHUNK, n - c)
            if _largest(highest[c : c + width]) > threshold:
                later = rows - r - _BLOCK
                _add_lit_block(flat, at + np.uint64(c), np.uint64(pitch), width, threshold, later, sums[c:])
    for r in range(whole, rows):
        _add_row(frame[r, first : first + n], part, tops, threshold)
    _flush(sums, part, n, 0)


@numba.njit(error_model="numpy")
def _centroid_strip(add, frame, first, levels, position, total, status):
    n = min(_STRIP, frame.shape[1] - first)
    sums, part = np.zeros(2 * _STRIP, np.uint32), np.zeros(2 * _STRIP, np.uint16)
    tops = np.zeros(_STRIP, np.uint8)
    add(frame, first, n, levels[0], sums, part, tops)
    end = first + n
    _finish_centroid(sums, tops, n, frame.shape[0], levels[1], position[first:end], total[first:end], status[first:end])


@functools.cache
def _centroid_form(add: Any, parallel: bool) -> Any:
    @numba.njit(parallel=parallel, error_model="numpy")
    def centroid(frames, levels, window, position, total, status):
        strips = (frames.shape[2] + _STRIP - 1) // _STRIP
        for item in numba.prange(frames.shape[0] * strips):
            f, first = item // strips, item % strips * _STRIP
            _centroid_strip(add, frames[f], first, levels, position[f], total[f], status[f])

    return centroid


# ---- peak of each column -----------------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def _raise_tops(line, row, tops, at):
    for c in range(np.uint32(line.size)):
        x = line[c]
        at[c] = row if x > tops[c] else at[c]
        tops[c] = max(tops[c], x)


@numba.njit(error_model="numpy")
def _peaks_by_rows(frame, first, n, tops, at):
    """Find the peaks row by row: largest sample and its row."""
    tops[:n], at[:n] = frame[0, first : first + n], 0
    for r in range(1, frame.shape[0]):
        _raise_tops(frame[r, first : first + n], np.int16(r), tops, at)


_SEARCHED = 16  # rows of a block of the search


@numba.njit(error_model="numpy")
def _raise_block(flat, at, pitch, n, number, tops, blocks):
    for c in range(np.uint32(n)):
        top = flat[at + np.uint64(c)]
        for k in range(1, _SEARCHED):
            top = max(top, flat[at + np.uint64(k) * pitch + np.uint64(c)])
        blocks[c] = number if top > tops[c] else blocks[c]
        tops[c] = max(top, tops[c])


@numba.njit(error_model="numpy")
def _peaks_by_blocks(frame, first, n, tops, at):
    """Find the largest sample in blocks of rows that stay in registers, then its row in the block."""
    rows, pitch = frame.shape
    flat, whole = frame.reshape(-1), rows // _SEARCHED * _SEARCHED
    blocks = np.zeros(_STRIP, np.uint8)
    tops[:n], at[:n] = 0, 0
    for r in range(0, whole, _SEARCHED):
        start = np.uint64(r * pitch + first)
        _raise_block(flat, start, np.uint64(pitch), n, np.uint8(r // _SEARCHED), tops, blocks)
    for c in range(n):
        row = int(blocks[c]) * _SEARCHED
        while row < whole - 1 and frame[row, first + c] != tops[c]:
            row += 1
        at[c] = row
    for r in range(whole, rows):
        _raise_tops(frame[r, first : first + n], np.int16(r), tops, at)


@numba.njit(error_model="numpy")
def _middle_of_top(frame, column, row):
    """Return the middle of the flat top that begins at the row."""
    last = row
    while last + 1 < frame.shape[0] and frame[last + 1, column] == frame[row, column]:
        last += 1
    return (row + last) // 2


@numba.njit(error_model="numpy")
def _window_sums(frame, column, at, threshold, window):
    total, moment = np.int32(0), np.int32(0)
    for k in range(max(at - window, 0), min(at + window + 1, frame.shape[0])):
        v = max(np.int32(frame[k, column]) - np.int32(threshold), np.int32(0))
        total += v
        moment += v * np.int32(k - at)
    return total, moment


@numba.njit(error_model="numpy")
def _flags(top, at, rows, window, threshold, saturation):
    dark, cut = top <= threshold, (at < window) | (at + window >= rows)
    return np.uint8(dark) | (np.uint8(top >= saturation) << np.uint8(1)) | (np.uint8(cut & (not dark)) << np.uint8(2))


@numba.njit(error_model="numpy")
def _peak_strip(find, read, frame, first, levels, window, position, total, status):
    n, rows = min(_STRIP, frame.shape[1] - first), frame.shape[0]
    tops, at = np.empty(_STRIP, np.uint8), np.empty(_STRIP, np.int16)
    find(frame, first, n, tops, at)
    for c in range(n):
        at[c] = _middle_of_top(frame, first + c, int(at[c]))
    read(frame, first, n, tops, at, levels, window, position, total)
    for c in range(n):
        status[first + c] = _flags(tops[c], int(at[c]), rows, window, levels[0], levels[1])
        if status[first + c] & np.uint8(5):
            position[first + c] = _F(np.nan)


@numba.njit(error_model="numpy")
def _windowed_columns(frame, first, n, tops, at, levels, window, position, total):
    for c in range(n):
        s, moment = _window_sums(frame, first + c, int(at[c]), levels[0], window)
        position[first + c] = _F(at[c]) + _F(moment) / _F(max(s, 1))
        total[first + c] = s


@numba.njit(error_model="numpy")
def _gauss3_columns(frame, first, n, tops, at, levels, window, position, total):
    threshold = levels[0]
    for c in range(n):
        row = min(max(int(at[c]), 1), frame.shape[0] - 2)
        a = math.log(_F(max(frame[row - 1, first + c], threshold) - threshold))
        b = math.log(_F(max(frame[row, first + c], threshold) - threshold))
        d = math.log(_F(max(frame[row + 1, first + c], threshold) - threshold))
        total[first + c] = _window_sums(frame, first + c, int(at[c]), threshold, window)[0]
        position[first + c] = _F(at[c]) + _F(0.5) * (a - d) / (a - _F(2.0) * b + d)


@numba.njit(error_model="numpy")
def _fir_columns(frame, first, n, tops, at, levels, window, position, total):
    """Zero crossing of the derivative filter nearest to the peak; the filter slides along the window."""
    rows = frame.shape[0]
    for c in range(n):
        middle, column, best = int(at[c]), first + c, _F(1e6)
        begin = min(max(middle - window, 2), rows - 3)
        before = np.int32(frame[begin - 2, column]) + frame[begin - 1, column]
        before -= np.int32(frame[begin + 1, column]) + frame[begin + 2, column]
        for k in range(begin + 1, min(middle + window + 1, rows - 2)):
            after = before - frame[k - 3, column] + frame[k - 1, column] + frame[k, column] - frame[k + 2, column]
            if before < 0 and after >= 0:
                here = _F(k - 1 - middle) + _F(before) / _F(before - after)
                best = here if abs(here) < abs(best) else best
            before = after
        position[column] = _F(middle) + best
        total[column] = _window_sums(frame, column, middle, levels[0], window)[0]


@functools.cache
def _peak_form(find: Any, read: Any, parallel: bool) -> Any:
    """Return a readout of frames: `levels` are threshold and saturation."""

    @numba.njit(parallel=parallel, error_model="numpy")
    def readout(frames, levels, window, position, total, status):
        strips = (frames.shape[2] + _STRIP - 1) // _STRIP
        for item in numba.prange(frames.shape[0] * strips):
            f, first = item // strips, item % strips * _STRIP
            _peak_strip(find, read, frames[f], first, levels, window, position[f], total[f], status[f])

    return readout


# ---- likelihood fit ----------------------------------------------------------------------------------------------

_SUMS = 15  # sums of a column: see `_add_sample`
_FIT_STEPS = 6


@numba.njit(error_model="numpy", fastmath=_FAST)
def _start(samples, window, shape):
    """Fill position, sigma, amplitude and background of the lanes, from moments of the light above a quarter."""
    for c in range(_LANES):
        background = _F(0.5) * (samples[0, c] + samples[2 * window, c])
        height = max(samples[window, c] - background, _F(1.0))
        least, s, m, q = background + _F(0.25) * height, _F(0.0), _F(0.0), _F(0.0)
        for k in range(-window, window + 1):
            v = max(samples[k + window, c] - least, _F(0.0))
            s += v
            m += v * _F(k)
            q += v * _F(k * k)
        shape[0, c], shape[3, c] = m / s, background
        shape[1, c] = math.sqrt(max(q / s - (m / s) ** 2, _F(0.3)) * _F(1.0 / 0.46327))
        shape[2, c] = s / (shape[1, c] * _F(1.4336))


@numba.njit(error_model="numpy", fastmath=_FAST)
def _sum_samples(samples, window, shape, noise, second, sums):
    """Fill the sums of the normal equations of all lanes; g changes from sample to sample by a running factor."""
    g, r, q, z = sums[15], sums[16], sums[17], sums[18]
    sums[:_SUMS] = _F(0.0)
    for side in range(2):
        sign = _F(1.0 - 2.0 * side)
        for c in range(_LANES):
            h = sign / shape[1, c]
            z[c] = -abs(h) * shape[0, c]
            g[c], q[c] = math.exp(_F(-0.5) * z[c] * z[c]), math.exp(-h * h)
            r[c] = math.exp(-z[c] * h - _F(0.5) * h * h)
        for k in range(window + 1):
            line = samples[window + k] if side == 0 else samples[window - k]
            for c in range(_LANES):
                counts = _F(1.0) if k > 0 or side == 0 else _F(0.0)
                model = shape[3, c] + shape[2, c] * g[c]
                w = counts / (noise[0] + noise[1] * max(model, _F(0.0)))
                e = w * (line[c] - model)
                w += second * noise[1] * w * e
                gz, wg = g[c] * z[c], w * g[c]
                gzz, wgz = gz * z[c], wg * z[c]
                sums[0, c] += w
                sums[1, c] += wg
                sums[2, c] += wgz
                sums[3, c] += wgz * z[c]
                sums[4, c] += wg * g[c]
                sums[5, c] += wgz * g[c]
                sums[6, c] += wgz * gz
                sums[7, c] += wgz * gzz
                sums[8, c] += wgz * z[c] * gzz
                sums[9, c] += e
                sums[10, c] += e * g[c]
                sums[11, c] += e * gz
                sums[12, c] += e * gzz
                sums[13, c] += e * gzz * z[c]
                sums[14, c] += e * gzz * z[c] * z[c]
                g[c] *= r[c]
                r[c] *= q[c]
                z[c] += sign / shape[1, c]


@numba.njit(error_model="numpy", fastmath=_FAST)
def _step(sums, shape, second):
    """Solve the equations of all lanes; return the largest movement of a position and a sigma [px]."""
    most = _F(0.0)
    for c in range(_LANES):
        per = second / shape[2, c]
        h, h0, h1, h2, g0 = sums[0, c], sums[1, c], sums[2, c], sums[3, c], sums[4, c]
        e, e0, e1, e2 = sums[9, c], sums[10, c], sums[11, c], sums[12, c]
        m00, m01 = sums[6, c] - per * (e2 - e0), sums[7, c] - per * (sums[13, c] - _F(2.0) * e1)
        m11 = sums[8, c] - per * (sums[14, c] - _F(2.0) * e2)
        m02, m12 = sums[5, c] - per * e1, sums[6, c] - per * e2
        d = _F(1.0) / (g0 * h - h0 * h0)
        a, b = (m02 * h - h1 * h0) * d, (h1 * g0 - m02 * h0) * d
        p, q = (m12 * h - h2 * h0) * d, (h2 * g0 - m12 * h0) * d
        s00, s01, s11 = m00 - a * m02 - b * h1, m01 - a * m12 - b * h2, m11 - p * m12 - q * h2
        r0, r1 = e1 - a * e0 - b * e, e2 - p * e0 - q * e
        f = _F(1.0) / (s00 * s11 - s01 * s01)
        x0, x1 = (r0 * s11 - r1 * s01) * f, (r1 * s00 - r0 * s01) * f
        r2, r3 = e0 - m02 * x0 - m12 * x1, e - h1 * x0 - h2 * x1
        move, growth = x0 / shape[2, c] * shape[1, c], x1 / shape[2, c]
        shape[0, c] += move
        shape[1, c] *= _F(1.0) + growth * (_F(1.0) + _F(0.5) * growth)
        shape[2, c] += (r2 * h - r3 * h0) * d
        shape[3, c] += (r3 * g0 - r2 * h0) * d
        most = max(most, max(abs(move), abs(growth) * shape[1, c]))
    return most


@numba.njit(error_model="numpy", fastmath=_FAST)
def _ml_lanes(frame, first, n, tops, at, levels, window, position, total):
    """Fit a Gaussian to 16 columns side by side: a step of Fisher scoring, then Newton's method."""
    samples, shape = np.empty((2 * window + 1, _LANES), np.float32), np.empty((4, _LANES), np.float32)
    sums, noise, rows = np.empty((19, _LANES), np.float32), levels[2:].astype(np.float32), frame.shape[0]
    for begin in range(0, n, _LANES):
        for c in range(_LANES):
            column = min(begin + c, n - 1)
            top = min(max(int(at[column]), window), rows - 1 - window) - window
            for k in range(2 * window + 1):
                samples[k, c] = _F(frame[top + k, first + column])
        _start(samples, window, shape)
        for step in range(_FIT_STEPS):
            second = _F(0.0) if step == 0 else _F(1.0)
            _sum_samples(samples, window, shape, noise, second, sums)
            if _step(sums, shape, second) < _F(0.01) and step > 0:
                break
        for c in range(min(_LANES, n - begin)):
            column = first + begin + c
            position[column] = _F(at[begin + c]) + shape[0, c]
            total[column] = _window_sums(frame, column, int(at[begin + c]), levels[0], window)[0]


# ---- lines along rows --------------------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def _top_of(line):
    top = np.uint8(0)
    for k in range(np.uint32(line.size)):
        top = max(top, line[k])
    return top


@numba.njit(error_model="numpy")
def _peak_by_row(line):
    """Find the largest sample of the whole row, then its first place."""
    top, k = _top_of(line), 0
    while line[k] != top:
        k += 1
    return top, k


@numba.njit(error_model="numpy")
def _peak_by_parts(line):
    """Find the largest sample of each part of 64 samples, then its first place in the first part that has it."""
    top, part = np.uint8(0), 0
    for begin in range(0, line.size, 64):
        highest = _top_of(line[begin : begin + 64])
        if highest > top:
            top, part = highest, begin
    while line[part] != top:
        part += 1
    return top, part


@functools.cache
def _row_form(find: Any) -> Any:
    @numba.njit(parallel=True, error_model="numpy")
    def readout(frames, levels, window, position, total, status):
        count, rows, length = frames.shape
        for item in numba.prange(count * 8):
            f = item // 8
            for r in range(rows * (item % 8) // 8, rows * (item % 8 + 1) // 8):
                line = frames[f, r]
                top, at = find(line)
                last = at
                while last + 1 < length and line[last + 1] == top:
                    last += 1
                middle = (at + last) // 2
                s, moment = np.int32(0), np.int32(0)
                for k in range(max(middle - window, 0), min(middle + window + 1, length)):
                    v = max(np.int32(line[k]) - np.int32(levels[0]), np.int32(0))
                    s += v
                    moment += v * np.int32(k - middle)
                flags = _flags(top, middle, length, window, levels[0], levels[1])
                total[f, r], status[f, r] = s, flags
                place = _F(middle) + _F(moment) / _F(max(s, np.int32(1)))
                position[f, r] = _F(np.nan) if flags & np.uint8(5) else place

    return readout


# ---- first loops of a user: one column after the other, in plain Python operations ---------------------------------


@numba.njit()
def _plain_window(x, levels, window):
    """Return the row of the peak, the total in the window and the status of a column."""
    at = np.argmax(x)
    last = at
    while last + 1 < len(x) and x[last + 1] == x[at]:
        last += 1
    top, at = x[at], (at + last) // 2
    total = 0.0
    for k in range(max(at - window, 0), min(at + window + 1, len(x))):
        total += max(x[k] - levels[0], 0.0)
    cut = at < window or at + window >= len(x)
    return at, total, (total == 0.0) * 1 + (top >= levels[1]) * 2 + (cut and total > 0.0) * 4


@numba.njit()
def _plain_centroid(x, levels, window):
    total, moment, top = 0.0, 0.0, 0.0
    for k in range(len(x)):
        v = max(x[k] - levels[0], 0.0)
        total += v
        moment += v * k
        top = max(top, x[k])
    status = (total == 0.0) * 1 + (top >= levels[1]) * 2
    return (moment / total if total > 0.0 else np.nan), total, status


@numba.njit()
def _plain_windowed(x, levels, window):
    at, total, status = _plain_window(x, levels, window)
    if status & 5:
        return np.nan, total, status
    moment = 0.0
    for k in range(at - window, at + window + 1):
        moment += max(x[k] - levels[0], 0.0) * (k - at)
    return at + moment / total, total, status


@numba.njit()
def _plain_gauss3(x, levels, window):
    at, total, status = _plain_window(x, levels, window)
    if status & 5:
        return np.nan, total, status
    a, b, c = math.log(x[at - 1] - levels[0]), math.log(x[at] - levels[0]), math.log(x[at + 1] - levels[0])
    return at + 0.5 * (a - c) / (a - 2.0 * b + c), total, status


@numba.njit()
def _plain_fir(x, levels, window):
    at, total, status = _plain_window(x, levels, window)
    if status & 5:
        return np.nan, total, status
    best = np.inf
    for k in range(at - window, at + window):
        before = x[k - 2] + x[k - 1] - x[k + 1] - x[k + 2]
        after = x[k - 1] + x[k] - x[k + 2] - x[k + 3]
        if before < 0.0 <= after:
            place = k - at + before / (before - after)
            best = place if abs(place) < abs(best) else best
    return at + best, total, status


@numba.njit()
def _plain_ml(x, levels, window):
    """Fisher scoring of a Gaussian integrated over pixels, until a step moves less than 1e-4 px."""
    at, total, status = _plain_window(x, levels, window)
    if status & 5:
        return np.nan, total, status
    y = x[at - window : at + window + 1]
    background = (y[0] + y[-1]) / 2.0
    amplitude, s, m = y.max() - background, 0.0, 0.0
    for k in range(2 * window + 1):
        v = max(y[k] - background - amplitude / 4.0, 0.0)
        s, m = s + v, m + v * (k - window)
    place, sigma, column = m / s, s / (1.434 * amplitude), np.empty(_UNKNOWNS)
    for _ in range(12):
        matrix, right = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
        for k in range(2 * window + 1):
            a, b = (k - window - 0.5 - place) / sigma, (k - window + 0.5 - place) / sigma
            slope_a, slope_b = math.exp(-0.5 * a * a), math.exp(-0.5 * b * b)
            light = sigma * math.sqrt(math.pi / 2.0) * (math.erf(b / math.sqrt(2.0)) - math.erf(a / math.sqrt(2.0)))
            column[0], column[1] = (
                amplitude * (slope_a - slope_b),
                amplitude * (light / sigma - b * slope_b + a * slope_a),
            )
            column[2], column[3] = light, 1.0
            model = background + amplitude * light
            weight = 1.0 / (levels[2] + levels[3] * max(model, 0.0)) if y[k] < levels[1] else 0.0
            for i in range(_UNKNOWNS):
                right[i] += weight * column[i] * (y[k] - model)
                for j in range(_UNKNOWNS):
                    matrix[i, j] += weight * column[i] * column[j]
        step = np.linalg.solve(matrix, right)
        place, sigma = place + step[0], sigma + step[1]
        amplitude, background = amplitude + step[2], background + step[3]
        if max(abs(step[0]), abs(step[1])) < 1e-4:
            break
    return at + place, total, status


@functools.cache
def _plain_form(method: Any) -> Any:
    @numba.njit(parallel=True)
    def readout(frames, levels, window, position, total, status):
        for f in numba.prange(frames.shape[0]):
            for c in range(frames.shape[2]):
                x = frames[f, :, c].astype(np.float64)
                position[f, c], total[f, c], status[f, c] = method(x, levels, window)

    return readout


# ---- forms by method ------------------------------------------------------------------------------------------------

_COLUMNS = {"windowed": _windowed_columns, "gauss3": _gauss3_columns, "fir": _fir_columns, "ml": _ml_lanes}
_PLAIN = {
    "centroid": _plain_centroid,
    "windowed": _plain_windowed,
    "gauss3": _plain_gauss3,
    "fir": _plain_fir,
    "ml": _plain_ml,
}


def expert_forms(method: str, along: str, count: int) -> dict[str, Any]:
    """Return the Numba functions of an expert by name; without threads, too, for one frame.

    They take (frames, levels, window, position, total, status), the levels threshold, saturation, and for "ml" variance
    of a dark sample and gain.
    """
    if along == "rows":
        return {"row": _row_form(_peak_by_row), "parts": _row_form(_peak_by_parts)}
    forms = {}
    for threads in (True, False) if count == 1 else (True,):
        name = "" if threads else "-serial"
        if method == "centroid":
            forms["rows" + name] = _centroid_form(_rows_of_strip, threads)
            forms["blocks" + name] = _centroid_form(_blocks_of_strip, threads)
            forms["lit-blocks" + name] = _centroid_form(_lit_blocks_of_strip, threads)
        else:
            forms["rows" + name] = _peak_form(_peaks_by_rows, _COLUMNS[method], threads)
            forms["blocks" + name] = _peak_form(_peaks_by_blocks, _COLUMNS[method], threads)
    return forms


def plain_form(method: str) -> Any:
    """Return the Numba function that a user writes first; see `expert_forms` for its arguments."""
    return _plain_form(_PLAIN[method])
