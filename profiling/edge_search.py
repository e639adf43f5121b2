"""Grid search of the coarse registration of a board, compared with NumPy and Numba.

81 x 81 shifts by 2 px and 21 headings (+-2 mm and +-5 degrees at 25 um in a frame of 640 x 480) with 512 edges; every
candidate returns the smallest cost of 64 adjacent shifts. Numba and NumPy use our algorithm: an edge is a shift of the
map, and rows of the map are added (in 16 bits by Numba).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.pose.edge_search import EdgeSearch, cell_offsets
from gpuvision.profiling.harness import Case

_ROWS, _HEADINGS, _POINTS, _CELL = 81, 21, 512, 2
_WIDE = 96  # columns of the Numba peer, a compile-time constant: 1.7 times as fast as the necessary 81


@numba.njit(error_model="numpy", inline="always")
def least_in_blocks(total, columns, scale, least, where):
    """Write the smallest sum of each block of 64 columns, scaled, and its column; the last block ends with the row."""
    for block in range(least.shape[0]):
        at = min(block * 64, columns - 64)
        low = total[at]
        for x in range(at, at + 64):
            low = min(low, total[x])
        while total[at] != low:
            at += 1
        least[block] = np.float32(low) * scale
        where[block] = at


@numba.njit(parallel=True, error_model="numpy")
def _numba_search(level, shifts, columns, least, where):
    """Add rows of the map in 16 bits; a task is a row of positions for one heading, padded for vectorisation."""
    turns, rows, _ = least.shape
    stride = level.shape[2]
    flat = level.reshape(-1)
    for task in numba.prange(turns * rows):
        turn, row = task // rows, task % rows
        total, part = np.zeros(_WIDE, np.uint32), np.empty(_WIDE, np.uint16)
        used = 0
        for first in range(0, shifts.shape[1], 64):
            for x in range(_WIDE):
                part[x] = 0
            for i in range(first, min(first + 64, shifts.shape[1])):
                shift = shifts[turn, i]
                if shift >= 0:
                    used += 1
                    source = flat[shift + row * stride : shift + row * stride + _WIDE]
                    for x in range(_WIDE):
                        part[x] += source[x]
            for x in range(_WIDE):
                total[x] += part[x]
        scale = np.float32(1.0 / (1023.0 * used))
        least_in_blocks(total, columns, scale, least[turn, row], where[turn, row])


def _numpy_search(level: NDArray[Any], shifts: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Add shifted maps."""
    stride, least, where = level.shape[2], [], []
    flat = level.ravel()
    for each in shifts:
        used = each[each >= 0]
        total = np.zeros((_ROWS, _ROWS), np.uint32)
        for shift in used:
            total += np.lib.stride_tricks.as_strided(flat[shift:], (_ROWS, _ROWS), (2 * stride, 2))
        blocks = np.stack([total[:, first : first + 64] for first in (0, _ROWS - 64)], axis=1)
        least.append(blocks.min(axis=-1) * np.float32(1.0 / (1023.0 * len(used))))
        where.append(blocks.argmin(axis=-1) + np.array([0, _ROWS - 64]))
    return np.stack(least), np.stack(where)


def cases(device: Device) -> Iterator[Case]:
    """Yield the grid search."""
    rng = np.random.default_rng(3)
    border = _ROWS // 2 + 20
    cells = (8, 480 // _CELL + 2 * border, 640 // _CELL + 2 * border)
    level = rng.integers(0, 1024, cells).astype(np.uint16)
    points, normals = rng.uniform(0.0, 1.0, (_POINTS, 2)) * (639.0, 479.0), rng.normal(size=(_POINTS, 2))
    turned = []
    for angle in np.linspace(-1.0, 1.0, _HEADINGS) * math.radians(5.0):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        turned.append(((points - (319.5, 239.5)) @ turn + (319.5, 239.5), normals @ turn))
    seen, directions = (np.stack(each) for each in zip(*turned, strict=True))
    shifts = cell_offsets(seen, directions, _CELL, border, cells, (_ROWS, _ROWS))
    op = EdgeSearch(rows=_ROWS, columns=_ROWS, headings=_HEADINGS, points=_POINTS)
    bound = op.bind(device, cells, np.uint16)
    bound.inputs[0].set(level)
    bound.inputs[1].set(shifts)
    ours = bound.run()
    least, where = np.empty((_HEADINGS, _ROWS, 2), np.float32), np.empty((_HEADINGS, _ROWS, 2), np.int64)

    def by_numba() -> None:
        _numba_search(level, shifts, _ROWS, least, where)

    def by_numpy() -> tuple[NDArray[Any], NDArray[Any]]:
        return _numpy_search(level, shifts)

    by_numba()
    exact, places = by_numpy()
    error = float(np.max(np.abs(to_numpy(ours.least) - exact)))
    same = np.array_equal(where, places) and np.array_equal(to_numpy(ours.column), places)
    if not (same and np.allclose(least, exact, rtol=1e-6) and error < 1e-6):
        raise AssertionError("the poses of a peer differ from ours")
    peers: dict[str, Callable[[], object]] = {"numba": by_numba, "numpy": by_numpy}
    metadata = {"poses": _HEADINGS * _ROWS**2, "points": _POINTS}
    yield Case("registration", "search", bound.run, peers, error, metadata=metadata)
