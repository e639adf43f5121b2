"""Resampling of a range image to a regular grid, compared with a Numba loop, NumPy, and OpenCV's remap.

A million points of a wavy surface, sheared so that no row of the grid is a row of the scan. Numba does the same as
`Regrid`, with its tests for holes, steps and folds. NumPy interpolates along the samples, then along the profiles,
without these tests. OpenCV does only a part of the work: it gets the place in the scan of each cell, which the other
candidates must find.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.ranging.height_map import Grid
from gpuvision.ranging.regrid import Regrid

Array = NDArray[Any]

SHAPE = (1000, 1000)
_STEP = 1e-4  # between samples, and between profiles [m]
_SHEAR = (0.2, 0.1)  # displacement in x and y per height


# The peer numba resamples 16 neighbouring lines side by side, like the vector variant of the kernel. Its indices are
# unsigned: Numba tests signed ones for being negative, and then LLVM makes no vectors. Rows of `state`: last good
# sample (place in cells, height, intensity, other coordinate), this sample, furthest place, lowest place since then.
# Rows of `marks`: first and last cell of the segment, flags of the last good sample and of this sample, whether there
# is a last good sample, whether this sample is good.
_WIDTH = np.uint64(16)


@numba.njit(inline="always")
def _ranges(state, marks, grid, width, cells):
    """Find the cells between the last good sample and this one in each line; return their bounds, and any fold."""
    low, high, folds, top = cells, np.int32(-1), np.int32(0), np.float32(cells)
    for k in range(_WIDTH):
        now, was, rise, infinite = state[4, k], state[0, k], state[5, k] - state[1, k], np.float32(np.inf)
        is_finite = (abs(now) < infinite) & (abs(state[5, k]) < infinite)
        good = np.int32(((marks[3, k] & 0x6D) == 0) & is_finite & (k < width))
        one, two = min(was, now), max(was, now)
        joined = (good & marks[4, k]) & np.int32((two - one <= grid[3]) & (abs(rise) <= grid[4]))
        one, two = min(max(one, np.float32(0)), top), np.float32(-1) if two < 0 else min(two, top - np.float32(1))
        first, last = np.int32(one) + np.int32(np.float32(np.int32(one)) < one), np.int32(two)
        is_covered = (joined != 0) & (first <= last)
        first, last = first if is_covered else cells, last if is_covered else np.int32(-1)
        marks[0, k], marks[1, k], marks[5, k] = first, last, good
        low, high, reached = min(low, first), max(high, last), grid[2] * now
        folds |= (good & marks[4, k]) & np.int32((reached <= state[8, k] - grid[5]) & (reached <= state[9, k]))
    return low, high, folds


@numba.njit(inline="always")
def _fill(cell, begin, width, state, marks, max_step, other, out, status):
    """Fill a cell of the lines whose segment covers it, and keep the higher surface."""
    row = np.uint64(cell)
    for k in range(width):
        n = begin + k
        was, length = state[0, k], state[4, k] - state[0, k]
        part = np.float32(0.0) if length == np.float32(0.0) else (np.float32(cell) - was) / length
        made, old = state[1, k] + part * (state[5, k] - state[1, k]), np.int32(status[row, n])
        is_free = ((old & 64) != 0) | (out[0, row, n] <= made + max_step)
        here = (marks[0, k] <= cell) & (cell <= marks[1, k]) & is_free
        out[0, row, n] = made if here else out[0, row, n]
        light = state[2, k] + part * (state[6, k] - state[2, k])
        out[1, row, n] = light if here else out[1, row, n]
        if other is not None:
            place = state[3, k] + part * (state[7, k] - state[3, k])
            out[2, row, n] = place if here else out[2, row, n]
        status[row, n] = np.uint8(((marks[2, k] | marks[3, k]) & 0x92) | (old & 128) if here else old)


@numba.njit(error_model="numpy")
def _mark_folds(begin, width, state, marks, grid, status):
    """Flag the cells from the furthest place of each line back to this sample."""
    for k in range(width):
        reached, back = grid[2] * state[4, k], state[9, k]
        if marks[5, k] and marks[4, k] and reached <= state[8, k] - grid[5] and reached <= back:
            one, two = min(grid[2] * reached, grid[2] * back), max(grid[2] * reached, grid[2] * back)
            for cell in range(max(int(np.ceil(one)), 0), min(int(np.floor(two)), len(status) - 1) + 1):
                status[cell, begin + k] |= np.uint8(128)


@numba.njit(inline="always")
def _advance(state, marks, grid):
    """Let the good samples become the last good ones."""
    for k in range(_WIDTH):
        reached, furthest, back = grid[2] * state[4, k], state[8, k], state[9, k]
        good = marks[5, k] != 0
        ahead = good & ((marks[4, k] == 0) | (reached > furthest))
        behind = good & (reached <= furthest - grid[5]) & (reached <= back)
        state[8, k] = reached if ahead else furthest
        state[9, k] = reached if ahead | behind else back
        for j in range(np.uint64(4)):
            state[j, k] = state[np.uint64(4) + j, k] if good else state[j, k]
        marks[2, k] = marks[3, k] if good else marks[2, k]
        marks[4, k] = marks[4, k] | marks[5, k]


@numba.njit(parallel=True, error_model="numpy")
def _numba_lines(at, z, intensity, other, given, grid, out, status):
    """Resample lines (n, samples) and their values onto cells: (values, cells, n) and flags (cells, n)."""
    count, cells = np.uint64(at.shape[0]), np.int32(status.shape[0])
    for block in numba.prange((count + _WIDTH - np.uint64(1)) // _WIDTH):
        begin = _WIDTH * np.uint64(block)
        width = min(_WIDTH, count - begin)
        out[:, :, begin : begin + width] = np.float32(np.nan)
        status[:, begin : begin + width] = 64
        state, marks = np.zeros((10, 16), np.float32), np.zeros((6, 16), np.int32)
        for i in range(np.uint64(at.shape[1])):
            for k in range(width):
                n = begin + k
                state[4, k] = (at[n, i] - grid[0]) * grid[1]
                state[5, k], state[6, k], marks[3, k] = z[n, i], intensity[n, i], given[n, i]
                if other is not None:
                    state[7, k] = other[n, i]
            low, high, folds = _ranges(state, marks, grid, width, cells)
            for cell in range(low, high + 1):
                _fill(cell, begin, width, state, marks, grid[4], other, out, status)
            if folds:
                _mark_folds(begin, width, state, marks, grid, status)
            _advance(state, marks, grid)


def _numba_regrid(operation: Regrid, frames: list[Array], given: Array) -> Callable[[], tuple[Array, Array]]:
    """Return a function that resamples like `Regrid`, along x and then along y; for points without folds."""
    x, y, z, intensity = frames
    grid, cell = operation.grid, operation.grid.cell_x
    joined = (operation.max_gap / cell, operation.max_step, operation.fold_tolerance / cell)
    first = np.array([grid.left, 1.0 / cell, 1.0, *joined], np.float32)
    second = np.array([grid.top, -1.0 / cell, -1.0, *joined], np.float32)
    passed, flags = np.empty((3, grid.columns, len(x)), np.float32), np.empty((grid.columns, len(x)), np.uint8)
    out, status = np.empty((2, *grid.shape), np.float32), np.empty(grid.shape, np.uint8)

    def call() -> tuple[Array, Array]:
        _numba_lines(x, z, intensity, y, given, first, passed, flags)
        _numba_lines(passed[2], passed[0], passed[1], None, flags, second, out, status)
        return out, status

    return call


def _numpy_regrid(frames: list[Array], grid: Grid) -> tuple[Array, Array]:
    """Interpolate along the samples, then along the profiles, without a test for holes, steps or folds."""
    x, y, z, intensity = frames
    columns, rows = grid.x, grid.y[::-1]
    lines = [[np.interp(columns, x[n], each[n]) for each in (y, z, intensity)] for n in range(len(x))]
    passed = np.array(lines)
    maps = [[np.interp(rows, passed[:, 0, n], passed[:, k, n]) for k in (1, 2)] for n in range(grid.columns)]
    made = np.array(maps).transpose(1, 2, 0)[:, ::-1]
    return made[0], made[1]


def _height(x: Array, y: Array) -> Array:
    return np.asarray(5e-3 * np.sin(80 * x) * np.cos(60 * y))


def _opencv_regrid(frames: list[Array], grid: Grid) -> Callable[[], tuple[Array, Array]]:
    """Return a function that interpolates height and intensity by ``remap``, from known samples of each cell."""
    _, _, z, intensity = frames
    x, y = np.meshgrid(grid.x, grid.y)
    at_x, at_y = x.copy(), y.copy()
    for _ in range(30):  # a contraction by 0.08 per step
        height = _height(at_x, at_y)
        at_x, at_y = x - _SHEAR[0] * height, y - _SHEAR[1] * height
    columns, rows = (at_x / _STEP).astype(np.float32), (at_y / _STEP).astype(np.float32)

    def call() -> tuple[Array, Array]:
        made = [cv2.remap(each, columns, rows, cv2.INTER_LINEAR) for each in (z, intensity)]
        return made[0], made[1]

    return call


def cases(device: Device) -> Iterator[Case]:
    """Yield the resampling of a million points of a wavy surface to 960 x 960 cells."""
    profile, sample = np.meshgrid(np.arange(SHAPE[0]), np.arange(SHAPE[1]), indexing="ij")
    x, y = sample * _STEP, profile * _STEP
    z = _height(x, y)
    x, y = x + _SHEAR[0] * z, y + _SHEAR[1] * z
    frames: list[Array] = [each.astype(np.float32) for each in (x, y, z, np.ones(SHAPE))]
    grid = Grid(left=0.002, top=0.098, cell_x=1e-4, cell_y=1e-4, columns=960, rows=960)
    operation = Regrid(grid=grid, max_gap=1e-3, max_step=1e-3)
    bound = operation.bind(device, SHAPE, np.float32)
    given = np.zeros(SHAPE, np.uint8)
    for array, values in zip(bound.inputs, [*frames, given], strict=True):
        array.set(values)
    bound().wait()
    looped = _numba_regrid(operation, frames, given)
    (heights, _), status = looped()
    same = np.allclose(heights, to_numpy(bound.outputs.z), rtol=0.0, atol=1e-8, equal_nan=True)
    if not (same and np.array_equal(status, to_numpy(bound.outputs.status))):
        raise AssertionError("the cells of the peer numba differ from ours")
    exact = _numpy_regrid([each.astype(np.float64) for each in frames], grid)
    error = float(np.max(np.abs(to_numpy(bound.outputs.z) - exact[0])))
    remapped = _opencv_regrid(frames, grid)
    if not np.allclose(remapped()[0], exact[0], atol=2e-6):
        raise AssertionError("the heights of the peer opencv differ from ours")
    peers: dict[str, Callable[[], object]] = {
        "numba": looped,
        "numpy": lambda: _numpy_regrid(frames, grid),
        "opencv": remapped,
    }
    cells = grid.columns * grid.rows
    lines = SHAPE[0] * grid.columns
    traffic = (17 * SHAPE[0] * SHAPE[1] + 13 * lines, 13 * lines + 9 * cells)
    yield Case("range_image", "regrid/1e6", lambda: device.wait(bound()), peers, error, traffic)
