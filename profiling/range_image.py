"""Assembly and regular resampling of range images, compared with Numba loops and NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.ranging.range_image import RangeImage, RangePoints, RotatingSheet, StraightTransport
from gpuvision.ranging.regrid import Grid, Regrid

Array = NDArray[Any]

STRAIGHT = StraightTransport(step=1e-4, h_axis=(0.0, 0.7, 1.0))
ROTATING = RotatingSheet(
    focal_length_px=1700.0,
    principal_point_px=(511.5, 511.5),
    axis_point=(0.2, 0.0, 0.0),
    axis_direction=(0.0, 1.0, 0.0),
    sheet_normal=(1.0, 0.0, 0.0),
    first_angle=-0.6,
    angle_step=4e-4,
)
SHAPE = (1000, 1000)


@numba.njit(parallel=True, error_model="numpy")
def _numba_straight(g, h, transport, given, table, x, y, z, status):
    nan = table.dtype.type(np.nan)
    for profile in numba.prange(g.shape[0]):
        for sample in range(g.shape[1]):
            a, b, along = g[profile, sample], h[profile, sample], transport[profile]
            px = table[6] + table[15] * along + (table[9] * a + table[12] * b)
            py = table[7] + table[16] * along + (table[10] * a + table[13] * b)
            pz = table[8] + table[17] * along + (table[11] * a + table[14] * b)
            out = (px < table[0]) | (px > table[3]) | (py < table[1]) | (py > table[4])
            out |= (pz < table[2]) | (pz > table[5])
            flags = given[profile, sample]
            if not np.isfinite(a + b + along):
                flags |= np.uint8(8)
            elif out:
                flags |= np.uint8(4)
            good = (flags & np.uint8(0xED)) == 0
            x[profile, sample] = px if good else nan
            y[profile, sample] = py if good else nan
            z[profile, sample] = pz if good else nan
            status[profile, sample] = flags


@numba.njit(parallel=True, error_model="numpy")
def _numba_rotating(position, transport, given, table, x, y, z, status):
    nan = table.dtype.type(np.nan)
    for profile in numba.prange(position.shape[0]):
        cosine, sine = np.cos(transport[profile]), np.sin(transport[profile])
        n0 = table[22] + table[25] * cosine + table[28] * sine
        n1 = table[23] + table[26] * cosine + table[29] * sine
        n2 = table[24] + table[27] * cosine + table[30] * sine
        reach = table[31] + table[32] * cosine + table[33] * sine
        for sample in range(position.shape[1]):
            a = (position[profile, sample] - table[18]) * table[20]
            b = (np.float32(sample) - table[19]) * table[20]
            facing = n0 * a + n1 * b + n2
            depth = reach / facing
            px = table[6] + depth * (table[9] * a + table[12] * b + table[15])
            py = table[7] + depth * (table[10] * a + table[13] * b + table[16])
            pz = table[8] + depth * (table[11] * a + table[14] * b + table[17])
            out = (px < table[0]) | (px > table[3]) | (py < table[1]) | (py > table[4])
            out |= (pz < table[2]) | (pz > table[5])
            flags = given[profile, sample]
            if not np.isfinite(a):
                flags |= np.uint8(8)
            elif facing <= table[21]:
                flags |= np.uint8(32)
            elif out:
                flags |= np.uint8(4)
            good = (flags & np.uint8(0xED)) == 0
            x[profile, sample] = px if good else nan
            y[profile, sample] = py if good else nan
            z[profile, sample] = pz if good else nan
            status[profile, sample] = flags


def _numpy_straight(g: Array, h: Array, transport: Array, given: Array, table: Array) -> RangePoints:
    low, high, origin, first, second, third = table.reshape(-1, 3)
    along = transport[:, None]
    points = [origin[k] + third[k] * along + (first[k] * g + second[k] * h) for k in range(3)]
    return _numpy_flags(points, np.isfinite(g + h + along), given, low, high)


def _numpy_rotating(position: Array, transport: Array, given: Array, table: Array) -> RangePoints:
    low, high, origin, first, second, third = table[:18].reshape(-1, 3)
    cosine, sine = np.cos(transport)[:, None], np.sin(transport)[:, None]
    normal = [table[22 + k] + table[25 + k] * cosine + table[28 + k] * sine for k in range(3)]
    reach = table[31] + table[32] * cosine + table[33] * sine
    a = (position - table[18]) * table[20]
    b = (np.arange(position.shape[1], dtype=position.dtype) - table[19]) * table[20]
    depth = reach / (normal[0] * a + normal[1] * b + normal[2])
    points = [origin[k] + depth * (first[k] * a + second[k] * b + third[k]) for k in range(3)]
    return _numpy_flags(points, np.isfinite(position), given, low, high)


def _numpy_flags(points: list[Array], known: Array, given: Array, low: Array, high: Array) -> RangePoints:
    status = given.copy()
    outside = np.zeros(known.shape, bool)
    for axis, values in enumerate(points):
        outside |= (values < low[axis]) | (values > high[axis])
    status[known & outside] |= 4
    status[~known] |= 8
    bad = (status & 0xED) != 0
    for values in points:
        values[bad] = np.nan
    return RangePoints(points[0], points[1], points[2], status)


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


def cases(device: Device) -> Iterator[Case]:
    """Yield a million points of a straight transport and of a rotating sheet, and a resampling."""
    yield _assembly(device, RangeImage(geometry=STRAIGHT), "straight/1e6", _numba_straight, _numpy_straight)
    yield _assembly(device, RangeImage(geometry=ROTATING), "rotating/1e6", _numba_rotating, _numpy_rotating)
    yield _resampling(device)


def _assembly(
    device: Device,
    operation: RangeImage,
    name: str,
    loop: Callable[..., object],
    plain: Callable[..., RangePoints],
) -> Case:
    rng = np.random.default_rng(1)
    spread = (0.0, 1000.0) if operation.geometry.inputs == 1 else (-0.05, 0.05)
    profiles = [rng.uniform(*spread, SHAPE) for _ in range(operation.geometry.inputs)]
    if operation.geometry.inputs == 1:
        # Visible points only: positions to the right of the direction of the sheet.
        direction = np.tan(operation.geometry.transport(SHAPE[0]))[:, None]
        profiles = [511.5 + 1700.0 * (direction + profiles[0] / 5000 + 0.1)]
    given = np.zeros(SHAPE, np.uint8)
    frames: list[Array] = [each.astype(np.float32) for each in (*profiles, operation.geometry.transport(SHAPE[0]))]
    bound = operation.bind(device, SHAPE, np.float32)
    for array, values in zip(bound.inputs, [*frames, given], strict=True):
        array.set(values)
    table = operation.packed(np.float32)
    out = [np.empty(SHAPE, np.float32) for _ in range(3)] + [np.empty(SHAPE, np.uint8)]
    bound().wait()
    exact = plain(*(each.astype(np.float64) for each in frames), given, operation.packed())
    differences = [
        np.abs(to_numpy(ours) - to_numpy(truth)) for ours, truth in zip(bound.outputs[:3], exact[:3], strict=True)
    ]
    error = max(float(np.max(each)) for each in differences)
    peers: dict[str, Callable[[], object]] = {
        "numba": lambda: loop(*frames, given, table, *out),
        "numpy": lambda: plain(*frames, given, table),
    }
    samples = given.size
    traffic = ((4 * operation.geometry.inputs + 1) * samples, 13 * samples)
    return Case("range_image", name, bound.run, peers, error, traffic)


def _resampling(device: Device) -> Case:
    profile, sample = np.meshgrid(np.arange(SHAPE[0]), np.arange(SHAPE[1]), indexing="ij")
    x, y = sample * 1e-4, profile * 1e-4
    z = 5e-3 * np.sin(80 * x) * np.cos(60 * y)
    x, y = x + 0.2 * z, y + 0.1 * z
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
    peers: dict[str, Callable[[], object]] = {"numba": looped, "numpy": lambda: _numpy_regrid(frames, grid)}
    cells = grid.columns * grid.rows
    lines = SHAPE[0] * grid.columns
    traffic = (17 * SHAPE[0] * SHAPE[1] + 13 * lines, 13 * lines + 9 * cells)
    return Case("range_image", "regrid/1e6", lambda: device.wait(bound()), peers, error, traffic)
