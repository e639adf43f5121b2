"""Masks of 16 lanes (kernels/common/lanes.h) against the bits of integers: every set of lanes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

# Work-item n makes the mask of the lanes whose bits are set in n.
SOURCE = """
#include "common/lanes.h"

kernel void read_masks(global uint *sets, global int *any, global int *compared, global int *lowest) {
    const uint n = get_global_id(0);
    masks mask = 0;
    for (int k = 0; k < LANES; k++) ((bits *)&mask)[k] = n >> k & 1 ? -1 : 0;
    sets[n] = lane_bits(mask);
    any[n] = any_lane(mask);
    compared[n] = any_compared(mask);
    lowest[n] = lowest_bit(n);
}

// Lanes of `a` and `b` by the masks `chosen`; the samples of each work-item, and the first one of its next vector.
kernel void combine(global const real *a, global const real *b, global const int *chosen, global real *made,
                    global int *flags, global ulong *ranges, const ulong each, const ulong count) {
    const uint n = get_global_id(0), at = n * LANES, total = get_global_size(0) * LANES;
    const reals x = load_reals(a + at), y = load_reals(b + at);
    const ints mask = *(global const ints_at *)(chosen + at);
    store_reals(nan_where(to_masks(mask), x), made + at);
    store_reals(zero_where(to_masks(mask), x), made + total + at);
    store_reals(choose_reals(mask, x, y), made + 2 * total + at);
    store_reals(lane_max(x, y), made + 3 * total + at);
    store_reals(lane_min(x, y), made + 4 * total + at);
    store_reals(lane_fma(x, y, x), made + 5 * total + at);
    *(global ints_at *)(flags + at) = flag_where(choose_ints(mask, not_finite_lanes(x), not_finite_lanes(y)), 5);
    const sample_range range = samples_of_item(each, count);
    ranges[3 * n] = range.begin;
    ranges[3 * n + 1] = range.end;
    ranges[3 * n + 2] = whole_vector(range.end, count);
}
"""


def program_of(device: Device, precision: str, variant: str, folder: Path) -> Any:
    (folder / "lanes.cl").write_text(SOURCE)
    defines = {"REAL_IS_DOUBLE": None} if precision == "double" else {}
    defines |= {"VECTOR_VARIANT": None} if variant == "vector" else {}
    return build(device, folder, "lanes.cl", defines, include_folders=(KERNEL_FOLDER,))


@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize("precision", ["double", "single"])
def test_sets_of_lanes(device: Device, precision: str, variant: str, tmp_path: Path) -> None:
    lanes = 16 if variant == "vector" else 1
    program = program_of(device, precision, variant, tmp_path)
    numbers = np.arange(1 << lanes)
    found = [cl.array.zeros(device.queue, numbers.shape, dtype) for dtype in (np.uint32, *[np.int32] * 3)]
    cl.Kernel(program, "read_masks")(device.queue, numbers.shape, (1,), *(each.data for each in found))
    sets, any_, compared, lowest = (each.get() for each in found)
    np.testing.assert_array_equal(sets, numbers)
    np.testing.assert_array_equal(any_ != 0, numbers != 0)
    np.testing.assert_array_equal(compared != 0, numbers != 0)
    zeros = [(int(n) & -int(n)).bit_length() - 1 for n in numbers[1:]]
    np.testing.assert_array_equal(lowest[1:], zeros)


@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize("precision", ["double", "single"])
def test_combined_lanes_and_samples(device: Device, precision: str, variant: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    dtype = np.float64 if precision == "double" else np.float32
    items, lanes, local, count = (5, 16, 1, 200) if variant == "vector" else (32, 1, 8, 27)
    numbers = [*range(-9, 10), np.inf, -np.inf, np.nan]
    a, b = rng.choice(numbers, (2, items * lanes)).astype(dtype)
    chosen = -rng.integers(0, 2, items * lanes).astype(np.int32)
    made, flags = np.empty((6, items * lanes), dtype), np.empty(items * lanes, np.int32)
    ranges = np.empty((items, 3), np.uint64)
    given = [cl.array.to_device(device.queue, each) for each in (a, b, chosen, made, flags, ranges)]
    kernel = cl.Kernel(program_of(device, precision, variant, tmp_path), "combine")
    data = (each.data for each in given)
    kernel(device.queue, (items,), (local,), *data, np.uint64(48), np.uint64(count))
    mask = chosen != 0
    with np.errstate(invalid="ignore"):
        expected = [
            np.where(mask, np.nan, a),
            np.where(mask, 0.0, a),
            np.where(mask, a, b),
            np.where(a > b, a, b),
            np.where(a < b, a, b),
            a * b + a,
        ]
    np.testing.assert_array_equal(given[3].get(), expected)
    np.testing.assert_array_equal(given[4].get(), np.where(np.isfinite(np.where(mask, a, b)), 0, 5))
    if variant == "vector":
        begin = 48 * np.arange(5)
        end = np.minimum(begin + 48, count)
    else:
        # The last group moves back to end with the last sample.
        begin = np.minimum(8 * (np.arange(32) // 8), count - 8) + np.arange(32) % 8
        end = begin + 1
    np.testing.assert_array_equal(given[5].get(), np.stack([begin, end, np.minimum(end, count - lanes)], axis=-1))
