"""Coarse registration, compared with NumPy, Numba and OpenCV.

``search`` is the search of the coarse registration of a board: 81 x 81 shifts by 2 px and 21 headings (+-2 mm and +-5
degrees at 25 um in a frame of 640 x 480) with 512 edges; every candidate returns the smallest cost of 64 adjacent
shifts. Numba and NumPy use our algorithm: an edge is a shift of the map, and rows of the map are added (in 16 bits by
Numba).

``pair`` is a complete registration of two binary images of 640 x 640 with realistic noise and defects, without an
initial pose. OpenCV's findTransformECC starts within 2 px and 0.2 degrees of the true pose, because it does not
converge without an initial pose. ``error`` is the largest error of the four corners [px], ``opencv_error_px`` the error
of OpenCV.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.pose.edge_search import EdgeSearch, cell_offsets
from gpuvision.matching.pose.registration import register_images
from gpuvision.profiling.harness import Case

_ROWS, _HEADINGS, _POINTS, _CELL = 81, 21, 512, 2
_WIDE = 96  # columns of the Numba peer, a compile-time constant: 1.7 times as fast as the necessary 81
_SIDE = 640


def cases(device: Device) -> Iterator[Case]:
    """Yield the grid search, and the registration of a pair of images."""
    yield _search(device)
    yield _pair(device)


# ---- the search ----------------------------------------------------------------------------------------------


@numba.njit(parallel=True, error_model="numpy")
def _numba_search(level, shifts, columns, least, where):
    """Add rows of the map in 16 bits; a task is a row of positions for one heading, padded for vectorisation."""
    turns, rows, blocks = least.shape
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
        for block in range(blocks):
            at = min(block * 64, columns - 64)
            low = total[at]
            for x in range(at, at + 64):
                low = min(low, total[x])
            while total[at] != low:
                at += 1
            least[turn, row, block] = np.float32(low) * scale
            where[turn, row, block] = at


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


def _search(device: Device) -> Case:
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
    return Case("registration", "search", bound.run, peers, error, metadata=metadata)


# ---- a pair --------------------------------------------------------------------------------------------------


def pictures() -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]:
    """Return a template, a picture of it with defects, and the motion (2, 3) between them."""
    rng = np.random.default_rng(12)
    fine = np.full((4 * _SIDE, 4 * _SIDE), 255, np.uint8)
    for _ in range(45):
        x, y = rng.integers(0, 4 * _SIDE, 2)
        direction = [(1, 0), (0, 1), (1, 1), (1, -1)][rng.integers(4)]
        length = int(rng.integers(200, 900))
        end = (int(x + length * direction[0]), int(y + length * direction[1]))
        cv2.line(fine, (int(x), int(y)), end, 0, int(rng.integers(40, 110)))
        cv2.circle(fine, (int(x), int(y)), int(rng.integers(50, 110)), 0, -1)
    angle, shift = math.radians(3.7), np.array([21.3, -16.8])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = np.full(2, (_SIDE - 1) / 2.0)
    motion = np.column_stack([turn, middle + shift - turn @ middle])
    # Motion of the fine pictures: pixel centres lie at (x + 0.5) * 4 - 0.5.
    start = 4.0 * motion[:, 2] + (turn @ np.ones(2) - 1.0) * -1.5
    seen = cv2.warpAffine(fine, np.column_stack([turn, start]), fine.shape, borderValue=255)
    for _ in range(8):
        cv2.circle(seen, tuple(int(each) for each in rng.integers(0, 4 * _SIDE, 2)), 25, int(rng.choice([0, 255])), -1)
    both = [cv2.resize(each, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA) for each in (fine, seen)]
    noisy = [np.asarray(each, np.float64) + rng.normal(0.0, 40.0, each.shape) for each in both]
    template, image = (np.where(each > 127.5, 255, 0).astype(np.uint8) for each in noisy)
    return template, image, motion


def _off(found: NDArray[Any], true: NDArray[np.float64]) -> float:
    """Return the largest error of the four corners [px]."""
    corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * (_SIDE - 1.0)
    return float(np.max(np.linalg.norm(corners @ (found - true)[:, :2].T + (found - true)[:, 2], axis=-1)))


def _pair(device: Device) -> Case:
    template, image, motion = pictures()
    turned = np.array([[math.cos(0.0035), -math.sin(0.0035)], [math.sin(0.0035), math.cos(0.0035)]])
    start = np.column_stack([turned @ motion[:, :2], motion[:, 2] + (1.4, -1.4)]).astype(np.float32)
    white = np.full(template.shape, 255, np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)

    def by_opencv() -> NDArray[Any]:
        warp = start.copy()
        cv2.findTransformECC(template, image, warp, cv2.MOTION_EUCLIDEAN, criteria, white, 5)
        return warp

    def ours() -> NDArray[np.float64]:
        found = register_images(image, template, transform="rigid", device=device)
        c, s = math.cos(found.pose[2]), math.sin(found.pose[2])
        return np.array([[c, -s, found.pose[0]], [s, c, found.pose[1]]])

    metadata = {"opencv_error_px": _off(by_opencv().astype(np.float64), motion)}
    return Case("registration", "pair", ours, {"opencv": by_opencv}, _off(ours(), motion), metadata=metadata)
