"""Sums of shifted rows of a map in Numba, for the searches of a field and of a board: forms of an expert.

For one heading of the search a ray (or an edge) is a shift of the map, and the sums of a row of positions are the sum
of shifted rows of the map. Levels are below 1024, so that 64 of them are summed in 16 bits without overflow. The forms
differ in how many rays a pass over the sums adds.
"""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

BLOCK = 64  # positions of which the least score is returned
_VECTOR = 32  # levels of a vector of 64 bytes
_CHUNK = 64  # rays whose sum of levels fits 16 bits
_U16, _U32, _U64 = np.uint16, np.uint32, np.uint64


@numba.njit(error_model="numpy", inline="always")
def _add_four(flat, at, i, part, wide):
    """Add rows that begin at four places to the sums of a row; a pass loads and stores the sums once."""
    a, b, c, d = at[i], at[i + 1], at[i + 2], at[i + 3]
    for x in range(_U64(wide)):
        part[x] += (flat[a + x] + flat[b + x]) + (flat[c + x] + flat[d + x])


@numba.njit(error_model="numpy", inline="always")
def _add_eight(flat, at, i, part, wide):
    a, b, c, d = at[i], at[i + 1], at[i + 2], at[i + 3]
    e, f, g, h = at[i + 4], at[i + 5], at[i + 6], at[i + 7]
    for x in range(_U64(wide)):
        first = (flat[a + x] + flat[b + x]) + (flat[c + x] + flat[d + x])
        second = (flat[e + x] + flat[f + x]) + (flat[g + x] + flat[h + x])
        part[x] += first + second


@numba.njit(error_model="numpy", inline="always")
def _add_sixteen(flat, at, i, part, wide):
    a, b, c, d = at[i], at[i + 1], at[i + 2], at[i + 3]
    e, f, g, h = at[i + 4], at[i + 5], at[i + 6], at[i + 7]
    j, k, m, n = at[i + 8], at[i + 9], at[i + 10], at[i + 11]
    o, p, q, r = at[i + 12], at[i + 13], at[i + 14], at[i + 15]
    for x in range(_U64(wide)):
        first = (flat[a + x] + flat[b + x]) + (flat[c + x] + flat[d + x])
        second = (flat[e + x] + flat[f + x]) + (flat[g + x] + flat[h + x])
        third = (flat[j + x] + flat[k + x]) + (flat[m + x] + flat[n + x])
        fourth = (flat[o + x] + flat[p + x]) + (flat[q + x] + flat[r + x])
        part[x] += (first + second) + (third + fourth)


_PASSES = {4: _add_four, 8: _add_eight, 16: _add_sixteen}


@numba.njit(error_model="numpy")
def _least_key(total, begin):
    """Return the smallest (sum << 6) | position of a block: one minimum finds the sum and the first position."""
    key = _U32(0xFFFFFFFF)
    for x in range(_U32(BLOCK)):
        key = min(key, (_U32(total[_U32(begin) + x]) << _U32(6)) | x)
    return key


@functools.cache
def search_form(rays: int, wide: int, *, is_long: bool) -> Any:
    """Return a Numba function ``(flat, stride, shifts, scores, least, where)`` for all poses of a grid.

    Parameters
    ----------
    rays
        Rays that a pass adds: 4, 8 or 16.
    wide
        Columns that a pass adds, at least the columns of the grid; a constant of the program, see `padded`.
    is_long
        Whether there are more than 64 rays, so that sums of 16 bits are added to sums of 32 bits.

    Notes
    -----
    `flat` is a map from `padded`; `shifts` are int64 (headings, rays), negative for rays that are not used. Arrays
    `scores` without rows are not filled.
    """
    add = _PASSES[rays]

    @numba.njit(parallel=True, error_model="numpy")
    def search(flat, stride, shifts, scores, least, where):
        turns, rows, blocks = least.shape
        columns, with_scores = scores.shape[2], scores.shape[1] > 0
        for task in numba.prange(turns * rows):
            turn, row = task // rows, task % rows
            part, at = np.zeros(wide, np.uint16), np.empty(shifts.shape[1] + rays, np.uint64)
            total = np.zeros(wide if is_long else 0, np.uint32)
            used = 0
            for i in range(shifts.shape[1]):
                at[used] = _U64(shifts[turn, i] + row * stride)
                used += shifts[turn, i] >= 0
            for i in range(rays):
                at[used + i] = _U64(flat.size - wide)  # zeros
            for begin in range(0, used, _CHUNK):
                for i in range(begin, min(begin + _CHUNK, used), rays):
                    add(flat, at, i, part, wide)
                if is_long:
                    for x in range(_U64(wide)):
                        total[x] += part[x]
                        part[x] = _U16(0)
            sums = total if is_long else part
            scale = np.float32(1.0 / (1023.0 * used))
            if with_scores:
                out = scores[turn, row]
                for x in range(_U64(columns)):
                    out[x] = np.float32(sums[x]) * scale
            for block in range(blocks):
                first = min(block * BLOCK, columns - BLOCK)
                key = _least_key(sums, first)
                least[turn, row, block] = np.float32(key >> _U32(6)) * scale
                where[turn, row, block] = first + np.int64(key & _U32(63))

    return search


def padded(level: NDArray[np.uint16], columns: int) -> tuple[NDArray[np.uint16], int]:
    """Return a flat map with zeros at its end, and the columns that a pass adds: whole vectors."""
    wide = -(-columns // _VECTOR) * _VECTOR
    return np.concatenate([level.reshape(-1), np.zeros(2 * wide, np.uint16)]), wide
