"""Arrays that are aligned to an element only: vector loads of kernels must not rely on more."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array
import pytest

from example_inputs import assert_has_numbers, inputs_with_numbers
from gpuvision.host import Device, Operation
from gpuvision.profiling.offline.registry import all_examples
from gpuvision.ranging.psd import PsdReadout

OPERATIONS = (
    *("AnyHit", "CellMeans", "ClosestHit", "DistanceMapBuilder", "EdgeCostMap", "EdgeSearch"),
    *("FieldPoseRefinement", "FieldPoseSearch", "FindBlobs", "FitBoardLines", "FitLines", "FormFactors"),
    *(
        "LineIrradiance",
        "LineReadout",
        "MeasureBoardEdges",
        "MeasureDeposits",
        "MergeHeights",
        "MirrorFacets",
        "MirrorPoints",
        "OccludedIrradiance",
    ),
    *("PatchLight", "PlaceFeatures", "PsdReadout", "RangeImage", "Reflectance", "RenderBoard", "RulerEdges"),
    *("SolveBoardLines", "SolveFeatures", "SolvePose", "Triangulation"),
    *("UndistortImage", "UndistortPoints", "VisibleIntervals", "_AlongProfiles", "_AlongSamples", "_SelectLights"),
)
# Alignment of the memory of aligned and of unaligned arrays [bytes]: more than a vector of 16 doubles.
_ALIGNMENT = 256
_SIDE = 101  # most elements of an axis: a prime, so that work-groups do not divide it; rulers of 64 samples fit


def placed(like: npt.NDArray[Any], offset: int) -> npt.NDArray[Any]:
    """Return a copy whose memory begins `offset` elements after an aligned address."""
    room = np.empty(like.nbytes + 2 * _ALIGNMENT, np.uint8)
    begin = -room.ctypes.data % _ALIGNMENT + offset * like.itemsize
    copied = room[begin : begin + like.nbytes].view(like.dtype).reshape(like.shape)
    copied[...] = like
    assert copied.ctypes.data % _ALIGNMENT == offset * like.itemsize
    return copied


def assert_any_offset(operation: Operation[Any], device: Device, shape: Any, dtype: Any) -> None:
    """Check that results on arrays at any element are bit-equal to the results on aligned arrays."""
    rng, bound = np.random.default_rng(7), operation.bind(device, shape, dtype)
    inputs = inputs_with_numbers(operation, bound.inputs, device, rng)
    found = []
    for offset in (0, 1, 7):
        outputs = [None if each is None else np.zeros(each.shape, each.dtype) for each in bound.outputs]
        out = type(bound.outputs)(*(None if each is None else placed(each, offset) for each in outputs))
        found.append(bound.on_host([placed(each, offset) for each in inputs], out))
    for result in found[1:]:
        for name, expected, values in zip(result._fields, found[0], result, strict=True):
            np.testing.assert_array_equal(values, expected, err_msg=name)
    assert_has_numbers(operation, found[0])


def test_readout_of_arrays_at_any_element(device: Device) -> None:
    assert_any_offset(PsdReadout(strip_length=6e-3), device, (1001, 2), np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation_on_arrays_at_any_element(device: Device, name: str) -> None:
    example = next(
        each
        for each in all_examples()
        if type(each.operation).__name__ == name and each.has_double == device.has_double
    )
    shape = (min(example.shape[0], 3), *example.shape[1:]) if len(example.shape) > 2 else example.shape
    assert_any_offset(example.operation, device, tuple(min(size, _SIDE) for size in shape), example.dtype)


@pytest.mark.slow
def test_the_list_of_operations_is_complete() -> None:
    assert {type(each.operation).__name__ for each in all_examples()} == set(OPERATIONS)


def test_arrays_in_a_part_of_a_buffer(device: Device, rng: np.random.Generator) -> None:
    """A buffer may be a part of another one; an array that begins within its buffer is refused."""
    readout, currents = PsdReadout(strip_length=6e-3), rng.uniform(0.5, 1.0, (1001, 2)).astype(np.float32)
    step = device.handle.mem_base_addr_align // 8
    whole = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 3 * step + currents.nbytes)
    part = cl.array.Array(
        device.queue, currents.shape, np.float32, data=whole.get_sub_region(3 * step, currents.nbytes)
    )
    part.set(currents)
    expected = readout(currents, device=device)
    np.testing.assert_array_equal(readout(part).position.get(), expected.position)
    longer = cl.array.to_device(device.queue, np.concatenate([currents[:1], currents]))
    with pytest.raises(ValueError, match=r"^expected a whole C-contiguous device array, got a part [^\n]*$"):
        readout(longer[1:])
