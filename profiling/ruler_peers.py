"""Calipers (rulers) in Numba: forms of an expert, and the loop that a user writes first.

All functions take the arrays of a frame (`Frame`), rulers (n, 4), the taps of the gradient, and three numbers: least
gradient, variance of the smoothing and noise. They fill the edges (4, n), position, amplitude, width and sigma,
and the status (n,). The expert's forms differ in how they load the four pixels of a bilinear sample, which
takes most of the time: two pairs of pixels for the samples of one ruler or of 16 rulers side by side, or one cell of
2 x 2 pixels after all cells of the frame were packed.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

LENGTH, WIDTH = 64, 5
REACH = 3  # taps on each side of a gradient
_SAMPLES, _SLOPES = LENGTH * WIDTH, LENGTH - 2 * REACH
_LANES = 16  # rulers that are measured side by side
_BLOCK = 64  # rulers that a task refines together
_FEW = 100  # largest number of rulers for which a loop without threads may be the fastest
_F, _U = np.float32, np.uint32
_FAST = {"contract", "reassoc", "nsz", "arcp"}
_MAGNITUDE = np.int32(0x7FFFFFFF)


class Frame(NamedTuple):
    """Views of an 8-bit frame.

    Attributes
    ----------
    image
        The frame, (rows, columns).
    pixels
        The frame as a flat array.
    pairs
        Each pixel and its right neighbour as 16 bits: an array with a stride of one byte.
    packed
        Room for the cells of 2 x 2 pixels as 32 bits.
    """

    image: NDArray[np.uint8]
    pixels: NDArray[np.uint8]
    pairs: NDArray[np.uint16]
    packed: NDArray[np.uint32]

    @staticmethod
    def of(image: NDArray[np.uint8]) -> Frame:
        """Return the views of a frame."""
        pixels = image.reshape(-1)
        pairs = np.lib.stride_tricks.as_strided(pixels[:2].view(np.uint16), (image.size - 1,), (1,))
        return Frame(image, pixels, pairs, np.zeros(image.size, np.uint32))


@numba.njit(error_model="numpy", fastmath=_FAST)
def _place_samples(x, y, cosine, sine, pitch, at, share):
    """Write offsets of the pixels of all samples of a ruler, and their fractions: columns, then rows."""
    middle, lines = _F(0.5 * (LENGTH - 1)), _F(0.5 * (WIDTH - 1))
    for line in range(WIDTH):
        from_x = x - middle * cosine + (lines - _F(line)) * sine
        from_y = y - middle * sine - (lines - _F(line)) * cosine
        for i in range(LENGTH):
            k = _U(line * LENGTH + i)
            at_x, at_y = from_x + _F(i) * cosine, from_y + _F(i) * sine
            column, row = np.int32(at_x), np.int32(at_y)
            at[k] = _U(row) * pitch + _U(column)
            share[k] = at_x - _F(column)
            share[_U(_SAMPLES) + k] = at_y - _F(row)


@numba.njit(error_model="numpy", fastmath=_FAST)
def _sum_lines(cells, share, profile):
    """Blend the pixels of each sample, packed in 32 bits, and sum the samples over the lines."""
    for i in range(LENGTH):
        total = _F(0.0)
        for line in range(WIDTH):
            k = _U(line * LENGTH + i)
            cell, dx, dy = cells[k], share[k], share[_U(_SAMPLES) + k]
            a, b = _F(np.int32(cell & _U(255))), _F(np.int32((cell >> _U(8)) & _U(255)))
            c, d = _F(np.int32((cell >> _U(16)) & _U(255))), _F(np.int32(cell >> _U(24)))
            a += dx * (b - a)
            c += dx * (d - c)
            total += a + dy * (c - a)
        profile[i] = total


@numba.njit(error_model="numpy", fastmath=_FAST)
def _find_peak(profile, slopes, bits, taps, peaks, k):
    """Write index and values of the strongest gradient of a profile and its neighbours to column `k` of the peaks.

    The profile is padded: 64 gradients take four vectors, 58 take three and a remainder one by one.
    """
    first, second, third = taps[0], taps[1], taps[2]
    for i in range(LENGTH):
        j = _U(i + REACH)
        slopes[i] = (
            first * (profile[j + _U(1)] - profile[j - _U(1)])
            + second * (profile[j + _U(2)] - profile[j - _U(2)])
            + third * (profile[j + _U(3)] - profile[j - _U(3)])
        )
    # The order of positive floats is that of their bits: a maximum of integers is vectorised, of floats it is not.
    best = np.int32(0)
    for i in range(LENGTH):
        is_inner = (i > 0) & (i < _SLOPES - 1)
        best = max(best, bits[_U(i)] & (_MAGNITUDE if is_inner else np.int32(0)))
    at = np.int32(LENGTH)
    for i in range(LENGTH):
        is_inner = (i > 0) & (i < _SLOPES - 1)
        strength = bits[_U(i)] & (_MAGNITUDE if is_inner else np.int32(0))
        at = min(at, np.int32(i) if strength == best else np.int32(LENGTH))
    peaks[0, k] = _F(at)
    peaks[1, k], peaks[2, k], peaks[3, k] = slopes[at - 1], slopes[at], slopes[at + 1]


@numba.njit(error_model="numpy", fastmath=_FAST)
def _refine(peaks, count, numbers, edges, status, first):
    """Write the edges at the peaks of a block of rulers: a parabola through the logarithms of three gradients."""
    least, smoothing, noise = numbers[0], numbers[1], numbers[2]
    half, one, tiny = _F(0.5), _F(1.0), _F(1e-6)
    for k in range(count):
        here = peaks[2, k]
        size, per = abs(here), one / here
        before, after = math.log(max(peaks[1, k] * per, tiny)), math.log(max(peaks[3, k] * per, tiny))
        variance, tilt = -one / (before + after), half * (after - before)
        shift = tilt * variance
        found = size >= least
        nan = _F(np.nan)
        position = peaks[0, k] + shift + _F(REACH - 0.5 * (LENGTH - 1))
        height = here * math.exp(half * tilt * shift) * math.sqrt(_F(2.0 * math.pi) * variance) * _F(1.0 / WIDTH)
        edges[0, first + k] = position if found else nan
        edges[1, first + k] = height if found else nan
        edges[2, first + k] = math.sqrt(max(variance - smoothing, _F(0.0))) if found else nan
        edges[3, first + k] = noise * variance / size if found else nan
        status[first + k] = np.uint8(not found)


@numba.njit(error_model="numpy")
def _load_pairs(pairs, at, pitch, cells):
    """Load two pairs of pixels for each sample."""
    for k in range(_U(_SAMPLES)):
        place = np.uint64(at[k])
        cells[k] = _U(pairs[place]) | (_U(pairs[place + np.uint64(pitch)]) << _U(16))


@numba.njit(error_model="numpy")
def _load_cells(packed, at, pitch, cells):
    """Load the packed cell of 2 x 2 pixels of each sample."""
    for k in range(_U(_SAMPLES)):
        cells[k] = packed[np.uint64(at[k])]


@numba.njit(error_model="numpy")
def _pack_row(above, below, packed):
    """Pack the cells of a row. Slices at constant offsets are vectorised, indices into the whole frame are not."""
    one = _U(1)
    for k in range(_U(above.size - 1)):
        upper = _U(above[k]) | (_U(above[k + one]) << _U(8))
        packed[k] = upper | (_U(below[k]) << _U(16)) | (_U(below[k + one]) << _U(24))


def _by_ruler(packs: bool, parallel: bool) -> Any:
    """Return the form that places and blends the samples of one ruler after the other."""
    load = _load_cells if packs else _load_pairs

    @numba.njit(parallel=parallel, error_model="numpy")
    def measure(image, pixels, pairs, packed, rulers, taps, numbers, edges, status):
        count, (rows, pitch) = rulers.shape[0], image.shape
        if packs:
            for row in numba.prange(rows - 1):
                begin, end = row * pitch, (row + 1) * pitch
                _pack_row(pixels[begin:end], pixels[end : end + pitch], packed[begin:end])
        source = packed if packs else pairs
        each = min(_BLOCK, (count + 3) // 4)
        for task in numba.prange((count + each - 1) // each):
            at, share, cells = np.empty(_SAMPLES, _U), np.empty(2 * _SAMPLES, _F), np.empty(_SAMPLES, _U)
            profile, slopes = np.zeros(LENGTH + 2 * REACH, _F), np.empty(LENGTH, _F)
            peaks, bits = np.empty((4, _BLOCK), _F), slopes.view(np.int32)
            first = task * each
            used = min(each, count - first)
            for k in range(used):
                r = first + k
                _place_samples(rulers[r, 0], rulers[r, 1], rulers[r, 2], rulers[r, 3], _U(pitch), at, share)
                load(source, at, pitch, cells)
                _sum_lines(cells, share, profile)
                _find_peak(profile, slopes, bits, taps, peaks, k)
            _refine(peaks, used, numbers, edges, status, first)

    return measure


@numba.njit(error_model="numpy", fastmath=_FAST)
def _sample_lanes(pairs, pitch, layout, at, share, cells, profile):
    """Write the profiles of 16 rulers side by side; the samples of all lines at one place are loaded together."""
    for i in range(LENGTH):
        for line in range(WIDTH):
            for n in range(_LANES):
                k, lane = _U(line * _LANES + n), _U(n)
                cosine, sine = layout[_U(2 * _LANES) + lane], layout[_U(3 * _LANES) + lane]
                at_x = layout[lane] + _F(i) * cosine - _F(line) * sine
                at_y = layout[_U(_LANES) + lane] + _F(i) * sine + _F(line) * cosine
                column, row = np.int32(at_x), np.int32(at_y)
                at[k] = _U(row) * pitch + _U(column)
                share[k] = at_x - _F(column)
                share[_U(_LANES * WIDTH) + k] = at_y - _F(row)
        for n in range(_LANES * WIDTH):
            place = np.uint64(at[_U(n)])
            cells[_U(n)] = _U(pairs[place]) | (_U(pairs[place + np.uint64(pitch)]) << _U(16))
        for n in range(_LANES):
            total = _F(0.0)
            for line in range(WIDTH):
                k = _U(line * _LANES + n)
                cell, dx, dy = cells[k], share[k], share[_U(_LANES * WIDTH) + k]
                a, b = _F(np.int32(cell & _U(255))), _F(np.int32((cell >> _U(8)) & _U(255)))
                c, d = _F(np.int32((cell >> _U(16)) & _U(255))), _F(np.int32(cell >> _U(24)))
                a += dx * (b - a)
                c += dx * (d - c)
                total += a + dy * (c - a)
            profile[_U(i * _LANES + n)] = total


@numba.njit(error_model="numpy", fastmath=_FAST)
def _peaks_of_lanes(profile, slopes, taps, where, peaks):
    """Write the strongest gradients of 16 rulers side by side."""
    first, second, third = taps[0], taps[1], taps[2]
    for k in range(_SLOPES * _LANES):
        j = _U(k + REACH * _LANES)
        one, two, three = _U(_LANES), _U(2 * _LANES), _U(3 * _LANES)
        slopes[_U(k)] = (
            first * (profile[j + one] - profile[j - one])
            + second * (profile[j + two] - profile[j - two])
            + third * (profile[j + three] - profile[j - three])
        )
    for n in range(_LANES):
        best, at = _F(0.0), np.int32(1)
        for i in range(1, _SLOPES - 1):
            strength = abs(slopes[_U(i * _LANES + n)])
            at = np.int32(i) if strength > best else at
            best = max(best, strength)
        where[_U(n)] = at
    for n in range(_LANES):
        at = where[n] * _LANES + n
        peaks[0, n] = _F(where[n])
        peaks[1, n], peaks[2, n], peaks[3, n] = slopes[at - _LANES], slopes[at], slopes[at + _LANES]


def _by_lanes(parallel: bool) -> Any:
    """Return the form that measures 16 rulers side by side; the last lanes repeat the last ruler."""

    @numba.njit(parallel=parallel, error_model="numpy", fastmath=_FAST)
    def measure(image, pixels, pairs, packed, rulers, taps, numbers, edges, status):
        count, pitch = rulers.shape[0], image.shape[1]
        middle, lines = _F(0.5 * (LENGTH - 1)), _F(0.5 * (WIDTH - 1))
        for task in numba.prange((count + _LANES - 1) // _LANES):
            at, share = np.empty(WIDTH * _LANES, _U), np.empty(2 * WIDTH * _LANES, _F)
            cells, layout = np.empty(WIDTH * _LANES, _U), np.empty(4 * _LANES, _F)
            profile, slopes = np.empty(LENGTH * _LANES, _F), np.empty(_SLOPES * _LANES, _F)
            where, peaks = np.empty(_LANES, np.int32), np.empty((4, _LANES), _F)
            for n in range(_LANES):
                r = min(task * _LANES + n, count - 1)
                cosine, sine = rulers[r, 2], rulers[r, 3]
                layout[n] = rulers[r, 0] - middle * cosine + lines * sine
                layout[_LANES + n] = rulers[r, 1] - middle * sine - lines * cosine
                layout[2 * _LANES + n], layout[3 * _LANES + n] = cosine, sine
            _sample_lanes(pairs, _U(pitch), layout, at, share, cells, profile)
            _peaks_of_lanes(profile, slopes, taps, where, peaks)
            _refine(peaks, min(_LANES, count - task * _LANES), numbers, edges, status, task * _LANES)

    return measure


@numba.njit(parallel=True)
def _plain(image, pixels, pairs, packed, rulers, taps, numbers, edges, status):
    """Measure one ruler after the other, as a user writes it first."""
    for r in numba.prange(len(rulers)):
        x, y, cosine, sine = rulers[r]
        profile, slopes = np.zeros(LENGTH), np.zeros(LENGTH)
        for i in range(LENGTH):
            for line in range(WIDTH):
                along, across = i - 0.5 * (LENGTH - 1), line - 0.5 * (WIDTH - 1)
                at_x, at_y = x + along * cosine - across * sine, y + along * sine + across * cosine
                column, row = int(at_x), int(at_y)
                dx, dy = at_x - column, at_y - row
                above = (1.0 - dx) * image[row, column] + dx * image[row, column + 1]
                below = (1.0 - dx) * image[row + 1, column] + dx * image[row + 1, column + 1]
                profile[i] += (1.0 - dy) * above + dy * below
        for i in range(REACH, LENGTH - REACH):
            for k in range(REACH):
                slopes[i] += taps[k] * (profile[i + k + 1] - profile[i - k - 1])
        at = np.argmax(np.abs(slopes[REACH + 1 : LENGTH - REACH - 1])) + REACH + 1
        peak = slopes[at]
        status[r] = abs(peak) < numbers[0]
        if status[r]:
            edges[:, r] = np.nan
            continue
        before, after = math.log(max(slopes[at - 1] / peak, 1e-6)), math.log(max(slopes[at + 1] / peak, 1e-6))
        variance, tilt = -1.0 / (before + after), 0.5 * (after - before)
        edges[0, r] = at + tilt * variance - 0.5 * (LENGTH - 1)
        edges[1, r] = peak * math.exp(0.5 * tilt**2 * variance) * math.sqrt(2.0 * math.pi * variance) / WIDTH
        edges[2, r] = math.sqrt(max(variance - numbers[1], 0.0))
        edges[3, r] = numbers[2] * variance / abs(peak)


@functools.cache
def expert_form(name: str, *, parallel: bool = True) -> Any:
    """Return the Numba function "pairs", "cells" or "lanes" of the expert."""
    return _by_lanes(parallel) if name == "lanes" else _by_ruler(name == "cells", parallel)


def expert_forms(count: int) -> dict[str, Any]:
    """Return the expert's Numba functions for a number of rulers by name."""
    if count > _FEW:
        return {name: expert_form(name) for name in ("pairs", "lanes", "cells")}
    forms = {name: expert_form(name) for name in ("pairs", "lanes")}
    return forms | {f"{name}-serial": expert_form(name, parallel=False) for name in ("pairs", "lanes")}


def plain_form() -> Any:
    """Return the loop that a user writes first."""
    return _plain
