"""Grid search of the coarse registration of a board, compared with NumPy and Numba.

81 x 81 shifts by 2 px and 21 headings (+-2 mm and +-5 degrees at 25 um in a frame of 640 x 480) with 512 edges; every
candidate returns the smallest cost of 64 adjacent shifts. Numba and NumPy use our algorithm: an edge is a shift of the
map, and rows of the map are added, in 16 bits by Numba (`gpuvision.profiling.shift_peers`). The first loop of Numba
adds them in 64 bits.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.pose.edge_search import EdgeSearch, cell_offsets
from gpuvision.profiling import shift_peers
from gpuvision.profiling.harness import Case, Peer

_ROWS, _HEADINGS, _POINTS, _CELL = 81, 21, 512, 2


@numba.njit(parallel=True)
def _plain(level, shifts, least, where):
    """Add shifted rows in 64 bits; a task is a row of positions for one heading."""
    turns, rows, blocks = least.shape
    stride, flat = level.shape[2], level.reshape(-1)
    for task in numba.prange(turns * rows):
        turn, row = task // rows, task % rows
        sums, used = np.zeros(_ROWS, np.int64), 0
        for shift in shifts[turn]:
            used += shift >= 0
            for x in range(_ROWS):
                sums[x] += flat[shift + row * stride + x] if shift >= 0 else 0
        for block in range(blocks):
            first = min(64 * block, _ROWS - 64)
            at = first + np.argmin(sums[first : first + 64])
            least[turn, row, block], where[turn, row, block] = sums[at] / (1023.0 * used), at


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
    flat, wide = shift_peers.padded(level, _ROWS)
    # Zero rows of scores: the kernel returns the least scores only.
    given = (flat, cells[2], shifts.astype(np.int64), np.empty((_HEADINGS, 0, _ROWS), np.float32), least, where)
    forms: dict[str, Callable[[], object]] = {
        f"{rays} edges": functools.partial(shift_peers.search_form(rays, wide, is_long=True), *given)
        for rays in (4, 8, 16)
    }

    def by_numpy() -> tuple[NDArray[Any], NDArray[Any]]:
        return _numpy_search(level, shifts)

    plain = functools.partial(_plain, level, shifts, least, where)
    exact, places = by_numpy()
    error = float(np.max(np.abs(to_numpy(ours.least) - exact)))
    if not (np.array_equal(to_numpy(ours.column), places) and error < 1e-6):
        raise AssertionError("the poses of NumPy differ from ours")
    calls: dict[str, Callable[[], object]] = forms | {"first loop": plain}
    for name, call in calls.items():
        least[...], where[...] = np.nan, -1
        call()
        if not (np.array_equal(where, places) and np.allclose(least, exact, rtol=1e-6)):
            raise AssertionError(f"the poses of Numba ({name}) differ from ours")
    peers: dict[str, Peer] = {"numba": forms, "numba-plain": plain, "numpy": by_numpy}
    metadata = {"poses": _HEADINGS * _ROWS**2, "points": _POINTS}
    yield Case("registration", "search", bound.run, peers, error, metadata=metadata)
