"""Assembly of range images, compared with Numba loops and NumPy; their resampling (`gpuvision.profiling.regrid`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling import regrid
from gpuvision.profiling.harness import Case
from gpuvision.ranging.range_image import RangeImage, RangePoints
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport

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


# Operations of a sample: two products and two sums for each of x, y, z. The travel along the transport and the origin
# are one number for each axis and profile.
_STRAIGHT_FLOPS = 12


def cases(device: Device) -> Iterator[Case]:
    """Yield a million points of a straight transport and of a rotating sheet, and a resampling."""
    yield _assembly(device, RangeImage(geometry=STRAIGHT), "straight/1e6", _numba_straight, _numpy_straight)
    yield _assembly(device, RangeImage(geometry=ROTATING), "rotating/1e6", _numba_rotating, _numpy_rotating)
    yield from regrid.cases(device)


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
    flops = _STRAIGHT_FLOPS * samples if name.startswith("straight") else None
    return Case("range_image", name, bound.run, peers, error, traffic, flops=flops)
