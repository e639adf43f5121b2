"""Work-groups of kernels that run one element per work-item fit every GPU."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from canary import Guarded, shifted_copy
from gpuvision.host import Device

# A warp has 32 work-items (NVIDIA) or 32 to 64 (AMD, Intel); AMD's groups have at most 256.
_WARP, _LARGEST_GROUP = 32, 256
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_UNIT = ((0.0, 1.0), (0.0, 1.0))
CASES = [
    (gv.Triangulation(homography=_IDENTITY, region=_UNIT, variant="work_item"), (100_000,), np.float32),
    (gv.FitLines(variant="work_item"), (1000, 8, 2), np.float32),
    (gv.LineReadout(threshold=5.0, variant="work_item"), (4, 100, 200), np.float32),
    (gv.PsdReadout(strip_length=6e-3, variant="work_item"), (10_000, 2), np.float32),
]


@pytest.mark.parametrize(("operation", "shape", "dtype"), CASES, ids=lambda each: type(each).__name__)
def test_work_groups_are_whole_warps_of_at_most_256(operation: Any, shape: tuple[int, ...], dtype: Any) -> None:
    launch = operation.launch(Device.best(), shape, np.dtype(dtype))
    assert launch.local_size is not None
    group = math.prod(launch.local_size)
    assert group % _WARP == 0
    assert group <= _LARGEST_GROUP
    assert all(total % local == 0 for total, local in zip(launch.global_size, launch.local_size, strict=True))


STREAMS: list[tuple[Any, Any, int]] = [
    (gv.PsdReadout(strip_length=6e-3, minimum_total=1.0, variant="work_item"), (2,), 1),
    (gv.Triangulation(homography=_IDENTITY, region=_UNIT, variant="work_item"), (), 2),
    (gv.UndistortPoints(model=gv.Lens(k1=1e-3), variant="work_item"), (2,), 1),
]


@pytest.mark.parametrize("count", [1, 255, 1001])
@pytest.mark.parametrize(("operation", "last", "inputs"), STREAMS, ids=[type(each[0]).__name__ for each in STREAMS])
def test_items_with_four_samples_on_odd_counts_and_unaligned_arrays(
    operation: Any, last: tuple[int, ...], inputs: int, count: int, device: Device
) -> None:
    rng = np.random.default_rng(count)
    given = [rng.uniform(0.1, 2.0, (count, *last)).astype(np.float32) for _ in range(inputs)]
    expected = operation(*given, device=device)
    guarded = Guarded(expected)
    reading = operation(*(shifted_copy(each, 1) for each in given), device=device, out=guarded.out)
    guarded.assert_intact()
    for one, other in zip(reading, expected, strict=True):
        assert (one is None) == (other is None)
        if other is not None:
            np.testing.assert_array_equal(one, other)
    # One sample after the other: the same work-item then has one sample.
    for number in sorted({0, count // 2, count - 1}):
        alone = operation(*(np.ascontiguousarray(each[number : number + 1]) for each in given), device=device)
        for one, other in zip(alone, expected, strict=True):
            if other is not None:
                np.testing.assert_array_equal(one[0], other[number])
