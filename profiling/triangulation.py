"""Triangulation, compared with Numba loops and NumPy: sensor coordinates to sheet coordinates and status.

The peer ``numba`` takes one reciprocal per point, keeps the table in registers, fuses multiply-adds, and runs chunks on
all cores or the whole loop on one; ``numba-plain`` is a parallel loop with the formulas as they stand.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.profiling.harness import Case, Peer
from gpuvision.ranging.triangulation import Triangulation

REGION = ((0.0, 1023.0), (0.0, 1279.0))
# Camera with a focal length of 1700 px, 0.35 m from the sheet, at an angle of 35 degrees.
HOMOGRAPHY = ((1.3e-6, 2.1e-4, -0.134), (2.5e-4, 2.0e-6, -0.131), (-4.2e-4, 8.0e-6, 1.21))
LENS = Lens(k1=-2e-7, k2=5e-14, centre=(650.0, 500.0))
_FAST = {"contract", "arcp"}  # fused multiply-add, division by a reciprocal
_CHUNK = 8192  # points of a chunk of the peer
# Largest difference from the float64 result, in epsilon of the largest coordinate, as in the tests of the operation.
_AGREEMENT = 16.0


@numba.njit(parallel=True, error_model="numpy")
def _plain(u, v, table, g, h, status):
    """Triangulate on all cores with the same conditioned table; branch-free, so that LLVM vectorises it."""
    one, nan = table.dtype.type(1), table.dtype.type(np.nan)
    for i in numba.prange(u.shape[0]):
        x, y = (u[i] - table[0]) * table[1], (v[i] - table[2]) * table[3]
        w = one + table[5] * x + table[6] * y
        p, q = x / w, y / w
        at_g = table[7] + (table[8] * p + table[9] * q)
        at_h = table[10] + (table[11] * p + table[12] * q)
        hidden = w <= table[4]
        lost = not np.isfinite(u[i] + v[i])
        g[i] = nan if hidden | lost else at_g
        h[i] = nan if hidden | lost else at_h
        status[i] = np.uint8(8) if lost else np.uint8(32) * np.uint8(hidden)


@numba.njit(parallel=True, error_model="numpy")
def _plain_lens(u, v, table, g, h, status):
    """Triangulate on all cores, with correction of the lens distortion."""
    one, nan = table.dtype.type(1), table.dtype.type(np.nan)
    for i in numba.prange(u.shape[0]):
        x, y = (u[i] - table[0]) * table[1], (v[i] - table[2]) * table[3]
        along, across = x - table[13], y - table[14]
        square = along * along + across * across
        stretch = square * (table[15] + table[16] * square)
        x, y = x + along * stretch, y + across * stretch
        w = one + table[5] * x + table[6] * y
        p, q = x / w, y / w
        at_g = table[7] + (table[8] * p + table[9] * q)
        at_h = table[10] + (table[11] * p + table[12] * q)
        hidden = w <= table[4]
        folded = square >= table[19]
        lost = not np.isfinite(u[i] + v[i])
        g[i] = nan if hidden | lost | folded else at_g
        h[i] = nan if hidden | lost | folded else at_h
        status[i] = np.uint8(8) if lost else (np.uint8(128) if folded else np.uint8(32) * np.uint8(hidden))


@numba.njit(error_model="numpy", fastmath=_FAST)
def _one_thread(u, v, table, g, h, status):
    """Triangulate on one core. Flags are int32, so that one vector width suits all numbers until they are stored."""
    one, nan, zero, lost_flag, hidden_flag = (
        table.dtype.type(1),
        table.dtype.type(np.nan),
        np.int32(0),
        np.int32(8),
        np.int32(32),
    )
    x0, sx, y0, sy, horizon, wx, wy = table[0], table[1], table[2], table[3], table[4], table[5], table[6]
    g0, gx, gy, h0, hx, hy = table[7], table[8], table[9], table[10], table[11], table[12]
    for i in range(u.shape[0]):
        x, y = (u[i] - x0) * sx, (v[i] - y0) * sy
        w = one + wx * x + wy * y
        per = one / w
        p, q = x * per, y * per
        hidden = w <= horizon
        lost = ~(np.abs(u[i] + v[i]) < np.inf)
        g[i] = nan if hidden | lost else g0 + (gx * p + gy * q)
        h[i] = nan if hidden | lost else h0 + (hx * p + hy * q)
        status[i] = np.uint8(lost_flag if lost else (hidden_flag if hidden else zero))


@numba.njit(error_model="numpy", fastmath=_FAST)
def _one_thread_lens(u, v, table, g, h, status):
    """Triangulate on one core, with correction of the lens distortion."""
    one, nan = table.dtype.type(1), table.dtype.type(np.nan)
    zero, lost_flag, folded_flag, hidden_flag = np.int32(0), np.int32(8), np.int32(128), np.int32(32)
    x0, sx, y0, sy, horizon, wx, wy = table[0], table[1], table[2], table[3], table[4], table[5], table[6]
    g0, gx, gy, h0, hx, hy = table[7], table[8], table[9], table[10], table[11], table[12]
    cx, cy, k1, k2, fold = table[13], table[14], table[15], table[16], table[19]
    for i in range(u.shape[0]):
        x, y = (u[i] - x0) * sx, (v[i] - y0) * sy
        along, across = x - cx, y - cy
        square = along * along + across * across
        stretch = square * (k1 + k2 * square)
        x, y = x + along * stretch, y + across * stretch
        w = one + wx * x + wy * y
        per = one / w
        p, q = x * per, y * per
        hidden, folded = w <= horizon, square >= fold
        lost = ~(np.abs(u[i] + v[i]) < np.inf)
        bad = hidden | folded | lost
        g[i] = nan if bad else g0 + (gx * p + gy * q)
        h[i] = nan if bad else h0 + (hx * p + hy * q)
        status[i] = np.uint8(lost_flag if lost else (folded_flag if folded else (hidden_flag if hidden else zero)))


@functools.cache
def _in_chunks(one_thread: Any) -> Any:
    """Return a loop over chunks on all cores: LLVM vectorises more of `one_thread` than of a parallel loop."""

    @numba.njit(parallel=True, error_model="numpy")
    def chunks(u, v, table, g, h, status):
        for chunk in numba.prange((u.shape[0] + _CHUNK - 1) // _CHUNK):
            first, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, u.shape[0])
            one_thread(u[first:end], v[first:end], table, g[first:end], h[first:end], status[first:end])

    return chunks


def _numpy(u: NDArray[Any], v: NDArray[Any], table: NDArray[Any], lens: bool) -> tuple[NDArray[Any], ...]:
    x, y = (u - table[0]) * table[1], (v - table[2]) * table[3]
    status = np.zeros(u.shape, np.uint8)
    if lens:
        along, across = x - table[13], y - table[14]
        square = along * along + across * across
        stretch = square * (table[15] + table[16] * square)
        x, y = x + along * stretch, y + across * stretch
        status[square >= table[19]] = 128
    w = 1 + table[5] * x + table[6] * y
    x, y = x / w, y / w
    g, h = table[7] + (table[8] * x + table[9] * y), table[10] + (table[11] * x + table[12] * y)
    status[w <= table[4]] = 32
    status[~np.isfinite(u + v)] = 8
    g[status != 0] = np.nan
    h[status != 0] = np.nan
    return g, h, status


# Operations of a point in `_numpy`: 4 for x and y, 4 for w, 2 quotients, 4 each for g and h. The lens: 2 for the place
# beside its centre, 3 for the square, 3 for the stretch, 4 for the new x and y.
_FLOPS, _LENS_FLOPS = 18, 12


def cases(device: Device) -> Iterator[Case]:
    """Yield 1e4, 1e6 and 16e6 points in single precision; 1e6 points with a lens, and in double precision."""
    plain = Triangulation(homography=HOMOGRAPHY, region=REGION)
    lens = Triangulation(homography=HOMOGRAPHY, region=REGION, lens=LENS)
    for count, size in ((10_000, "1e4"), (1_000_000, "1e6"), (16_000_000, "16e6")):
        yield _case(device, plain, "float32", count, f"float32/{size}")
    yield _case(device, lens, "float32", 1_000_000, "float32-lens/1e6")
    if device.has_double:
        yield _case(device, plain, "float64", 1_000_000, "float64/1e6")


def _case(device: Device, operation: Triangulation, dtype: str, count: int, name: str) -> Case:
    rng = np.random.default_rng(1)
    u, v = (rng.uniform(*bounds, count).astype(dtype) for bounds in REGION)
    bound = operation.bind(device, (count,), dtype)
    for array, values in zip(bound.inputs, (u, v), strict=True):
        array.set(values)
    table = operation.packed(dtype)
    bound().wait()
    exact = _numpy(u.astype(np.float64), v.astype(np.float64), operation.packed(np.float64), operation.lens is not None)
    outputs: Any = bound.outputs
    if not np.array_equal(outputs.status.get(), exact[2]):
        raise AssertionError("the triangulation and float64 differ in the valid points")
    points = (outputs.g.get(), outputs.h.get())
    error = max(float(np.nanmax(np.abs(a - b))) for a, b in zip(points, exact, strict=False))
    peers = _peers((u, v, table), exact, operation.lens is not None)
    item = u.itemsize
    flops = (_FLOPS if operation.lens is None else _FLOPS + _LENS_FLOPS) * count
    traffic = (2 * item * count, (2 * item + 1) * count)
    return Case("triangulation", name, bound.run, peers, error, traffic, flops=flops)


def _peers(given: tuple[NDArray[Any], ...], exact: tuple[NDArray[Any], ...], lens: bool) -> dict[str, Peer]:
    """Return the peers, after a comparison of the Numba results with float64."""
    u, v, table = given
    g, h, status = np.empty_like(u), np.empty_like(u), np.empty(u.shape, np.uint8)
    one_thread = _one_thread_lens if lens else _one_thread
    loops = {"one-thread": one_thread, "chunks": _in_chunks(one_thread), "plain": _plain_lens if lens else _plain}
    for loop in loops.values():
        g[:], h[:], status[:] = 0.0, 0.0, 255
        loop(u, v, table, g, h, status)
        np.testing.assert_array_equal(status, exact[2])
        for values, expected in zip((g, h), exact, strict=False):
            limit = _AGREEMENT * np.finfo(u.dtype).eps * np.nanmax(np.abs(exact[:2]))
            np.testing.assert_allclose(values, expected, rtol=0.0, atol=limit)
    calls = {name: functools.partial(loop, u, v, table, g, h, status) for name, loop in loops.items()}
    plain = calls.pop("plain")
    return {"numba": calls, "numba-plain": plain, "numpy": lambda: _numpy(u, v, table, lens)}
