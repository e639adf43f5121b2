"""Masks of 16 lanes (kernels/common/lanes.h) against the bits of integers: every set of lanes."""

from __future__ import annotations

from pathlib import Path

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
"""


@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize("precision", ["double", "single"])
def test_sets_of_lanes(device: Device, precision: str, variant: str, tmp_path: Path) -> None:
    lanes = 16 if variant == "vector" else 1
    (tmp_path / "read_masks.cl").write_text(SOURCE)
    defines = {"REAL_IS_DOUBLE": None} if precision == "double" else {}
    defines |= {"VECTOR_VARIANT": None} if lanes == 16 else {}
    program = build(device, tmp_path, "read_masks.cl", defines, include_folders=(KERNEL_FOLDER,))
    numbers = np.arange(1 << lanes)
    found = [cl.array.zeros(device.queue, numbers.shape, dtype) for dtype in (np.uint32, *[np.int32] * 3)]
    cl.Kernel(program, "read_masks")(device.queue, numbers.shape, (1,), *(each.data for each in found))
    sets, any_, compared, lowest = (each.get() for each in found)
    np.testing.assert_array_equal(sets, numbers)
    np.testing.assert_array_equal(any_ != 0, numbers != 0)
    np.testing.assert_array_equal(compared != 0, numbers != 0)
    zeros = [(int(n) & -int(n)).bit_length() - 1 for n in numbers[1:]]
    np.testing.assert_array_equal(lowest[1:], zeros)
