"""Sums and products of two floats (kernels/common/two_float.h) against fractions: the stated error bounds."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host import Device, two_floats
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

# Each work-item computes all operations of LANES pairs (a + a_low, b + b_low).
SOURCE = """
#include "common/two_float.h"

static inline void put(two_floats value, global float *high, global float *low) {
    store_reals(value.high, high);
    store_reals(value.low, low);
}

kernel void two_float(global const float *a, global const float *b, global float *high, global float *low,
                      const int count) {
    const int i = get_global_id(0) * LANES;
    const two_floats one = {load_reals(a + i), load_reals(a + count + i)};
    const two_floats other = {load_reals(b + i), load_reals(b + count + i)};
    const two_floats found[7] = {
        two_sum(one.high, other.high), two_product(one.high, other.high), two_plus_real(one, other.high),
        two_plus(one, other), two_times_real(one, other.high), two_times(one, other),
        two_dot_plus(one, other, one, one, other, other, other)
    };
    for (int k = 0; k < 7; k++) put(found[k], high + k * count + i, low + k * count + i);
}
"""
# Bounds of the header, relative to the exact result; of the last operation, to the sum of the absolute terms.
BOUNDS = (0.0, 0.0, 2.0**-47, 3.01 * 2.0**-48, 2.0**-47, 5.0 * 2.0**-48, 2.0**-43)


def numbers(rng: np.random.Generator, count: int) -> npt.NDArray[np.float64]:
    """Return numbers of any sign from 1e-6 to 1e6."""
    values: npt.NDArray[np.float64] = rng.choice([-1.0, 1.0], count) * 10.0 ** rng.uniform(-6.0, 6.0, count)
    return values


def computed(device: Device, variant: str, a: Any, b: Any, folder: Path) -> npt.NDArray[np.float32]:
    """Return high and low parts (2, operations, count) from the device for pairs (count, 2)."""
    (folder / "two_float.cl").write_text(SOURCE)
    lanes = 16 if variant == "vector" else 1
    defines: dict[str, Any] = {"VECTOR_VARIANT": None} if variant == "vector" else {}
    program = build(device, folder, "two_float.cl", defines, include_folders=(KERNEL_FOLDER,))
    count = len(a)
    inputs = [cl.array.to_device(device.queue, np.ascontiguousarray(each.T)) for each in (a, b)]
    outputs = [cl.array.zeros(device.queue, (len(BOUNDS), count), np.float32) for _ in range(2)]
    cl.Kernel(program, "two_float")(
        device.queue, (count // lanes,), (1,), *(each.data for each in (*inputs, *outputs)), np.int32(count)
    )
    return np.stack([each.get() for each in outputs])


@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_errors_are_below_the_stated_bounds(
    device: Device, variant: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Half of the pairs cancel in their first 24 to 40 bits."""
    first, second = numbers(rng, 512), numbers(rng, 512)
    second[::2] = -first[::2] * (1.0 + 2.0 ** rng.uniform(-40.0, -24.0, 256))
    a, b = two_floats(first), two_floats(second)
    high, low = computed(device, variant, a, b, tmp_path)
    one, other = ([(Fraction(float(x)), Fraction(float(y))) for x, y in each] for each in (a, b))
    for n, ((x, x_low), (y, y_low)) in enumerate(zip(one, other, strict=True)):
        a_whole, b_whole = x + x_low, y + y_low
        sums = (x + y, x * y, a_whole + y, a_whole + b_whole, a_whole * y, a_whole * b_whole)
        terms = (a_whole * b_whole, a_whole**2, b_whole**2, b_whole)
        for k, (exact, scale) in enumerate([*((each, each) for each in sums), (sum(terms), sum(map(abs, terms)))]):
            error = abs(Fraction(float(high[k, n])) + Fraction(float(low[k, n])) - exact)
            assert error <= BOUNDS[k] * abs(scale), f"operation {k}, pair {n}: {float(error)} of {float(scale)}"
            assert abs(low[k, n]) <= 2.0**-24 * abs(high[k, n])


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_no_result_from_numbers_that_are_not_finite(device: Device, bad: float, tmp_path: Path) -> None:
    a = np.array([[bad, 0.0], [1.0, 0.0]], np.float32)
    high, _ = computed(device, "work_item", a, a[::-1].copy(), tmp_path)
    assert not np.any(np.isfinite(high))


def test_two_floats_of_numbers(rng: np.random.Generator) -> None:
    values = numbers(rng, 1000)
    pairs = two_floats(values.reshape(10, 100))
    assert pairs.shape == (10, 100, 2)
    assert pairs.dtype == np.float32
    np.testing.assert_allclose(pairs.astype(np.float64).sum(axis=-1).ravel(), values, rtol=2.0**-48, atol=0)
    assert np.all(np.abs(pairs[..., 1]) <= 2.0**-24 * np.abs(pairs[..., 0]))
