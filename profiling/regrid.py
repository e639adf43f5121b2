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
from gpuvision.ranging.regrid import Grid, Regrid

Array = NDArray[Any]

SHAPE = (1000, 1000)
_STEP = 1e-4  # between samples, and between profiles [m]
_SHEAR = (0.2, 0.1)  # displacement in x and y per height


@numba.njit(error_model="numpy")
def _fill(n, a, b, one, two, flags, grid, out, status):
    """Fill the cells between two neighbouring points at a and b, if they are close enough to be joined."""
    length, rise, cells = b - a, two[0] - one[0], status.shape[0]
    if (abs(length) > grid[3]) | (abs(rise) > grid[4]):
        return
    low, high = max(min(a, b), np.float32(0.0)), min(max(a, b), np.float32(cells - 1))
    for cell in range(int(np.ceil(low)), int(np.floor(high)) + 1):
        part = np.float32(0.0) if length == 0.0 else (np.float32(cell) - a) / length
        height = one[0] + part * rise
        if (status[cell, n] & 64) | (out[0, cell, n] <= height + grid[4]):
            out[0, cell, n] = height
            for k in range(1, out.shape[0]):
                out[k, cell, n] = one[k] + part * (two[k] - one[k])
            status[cell, n] = flags | (status[cell, n] & 128)


@numba.njit(parallel=True, error_model="numpy")
def _numba_lines(at, values, given, grid, out, status):
    """Resample lines (n, samples) and their values (k, n, samples) onto cells: (k, cells, n) and flags (cells, n)."""
    for n in numba.prange(at.shape[0]):
        one, two = np.empty(values.shape[0], np.float32), np.empty(values.shape[0], np.float32)
        out[:, :, n] = np.float32(np.nan)
        status[:, n] = 64
        before, flags, started = np.float32(0.0), np.uint8(0), False
        furthest, back = np.float32(0.0), np.float32(0.0)
        for i in range(at.shape[1]):
            now = (at[n, i] - grid[0]) * grid[1]
            if (given[n, i] & 0x6D) or not np.isfinite(now + values[0, n, i]):
                continue
            for k in range(values.shape[0]):
                two[k] = values[k, n, i]
            if started:
                _fill(n, before, now, one, two, (flags | given[n, i]) & np.uint8(0x92), grid, out, status)
            reached = grid[2] * now
            if not started or reached > furthest:
                furthest = back = reached
            elif (reached <= furthest - grid[5]) & (reached <= back):
                ends = grid[2] * reached, grid[2] * back
                first, last = max(int(np.ceil(min(ends))), 0), min(int(np.floor(max(ends))), status.shape[0] - 1)
                for cell in range(first, last + 1):
                    status[cell, n] |= 128
                back = reached
            before, flags, started = now, given[n, i], True
            one, two = two, one


def _numba_regrid(operation: Regrid, frames: list[Array], given: Array) -> Callable[[], tuple[Array, Array]]:
    """Return a function that resamples like `Regrid`, along x and then along y; for points without folds."""
    x, y, z, intensity = frames
    grid, cell, values = operation.grid, operation.grid.cell_x, np.stack([z, intensity, y])
    joined = (operation.max_gap / cell, operation.max_step, operation.fold_tolerance / cell)
    first = np.array([grid.left, 1.0 / cell, 1.0, *joined], np.float32)
    second = np.array([grid.top, -1.0 / cell, -1.0, *joined], np.float32)
    passed, flags = np.empty((3, grid.columns, len(x)), np.float32), np.empty((grid.columns, len(x)), np.uint8)
    out, status = np.empty((2, *grid.shape), np.float32), np.empty(grid.shape, np.uint8)

    def call() -> tuple[Array, Array]:
        _numba_lines(x, values, given, first, passed, flags)
        _numba_lines(passed[2], passed[:2], flags, second, out, status)
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
    if not np.array_equal(looped()[1], to_numpy(bound.outputs.status)):
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
