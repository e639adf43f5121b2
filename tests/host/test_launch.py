"""Launch descriptions: macros, types and work sizes, against values written by hand."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import (
    Device,
    Launch,
    LaunchBuilder,
    WorkSize,
    capacity,
    ceil_div,
    fitted_groups,
    flags,
    group_per_element,
    opencl_type,
    padded_groups,
    padded_rows,
    real_of,
    round_up,
    strided_groups,
    table_offsets,
    to_numpy,
    type_defines,
    vector_work,
)
from gpuvision.host.launch import check_counts, describe_launch
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout

SINGLE, DOUBLE = np.dtype(np.float32), np.dtype(np.float64)


class Scale:
    """Fake operation: the builder uses only its name."""


class Machine:
    """Fake device with the properties that a launch queries."""

    label = "machine"

    def __init__(self, *, is_cpu: bool = True, has_double: bool = True) -> None:
        self.is_cpu, self.prefers_vectors, self.has_double = is_cpu, is_cpu, has_double
        self.has_denormals = True
        self.takes_vectors = True
        self.compute_units, self.cache_bytes = 2, 32 << 20


def builder(shape: tuple[int, ...], dtype: Any = np.float32, *, machine: Any = None, **options: Any) -> LaunchBuilder:
    return LaunchBuilder(Scale(), machine or Machine(), shape, np.dtype(dtype), **options)


TYPES = {
    "int8": "char",
    "uint8": "uchar",
    "int16": "short",
    "uint16": "ushort",
    "int32": "int",
    "uint32": "uint",
    "int64": "long",
    "uint64": "ulong",
    "float32": "float",
    "float64": "double",
}


@pytest.mark.parametrize(("dtype", "word"), TYPES.items())
def test_opencl_type(dtype: Any, word: str) -> None:
    assert opencl_type(dtype) == word


def test_a_dtype_without_an_opencl_type_is_refused() -> None:
    with pytest.raises(TypeError, match=r"no type for dtype complex64; expected one of int8, .* or float64"):
        opencl_type(np.complex64)


def test_opencl_types_have_the_size_of_their_dtypes(device: Device) -> None:
    """A kernel checks ``sizeof`` and the sign of -1."""
    names = [name for name in TYPES if device.has_double or name != "float64"]
    words = [opencl_type(name) for name in names]
    lines = [
        f"out[{2 * n}] = sizeof({word}); out[{2 * n + 1}] = (({word})(-1)) < (({word})0);"
        for n, word in enumerate(words)
    ]
    program = cl.Program(device.context, f"kernel void sizes(global int *out) {{ {' '.join(lines)} }}").build()
    found = cl.array.zeros(device.queue, 2 * len(names), np.int32)
    cl.Kernel(program, "sizes")(device.queue, (1,), None, found.data)
    expected = [[np.dtype(name).itemsize, np.dtype(name).kind != "u"] for name in names]
    np.testing.assert_array_equal(found.get().reshape(-1, 2), expected)


def test_macros() -> None:
    assert type_defines("INPUT", np.uint8) == {"INPUT": "uchar"}
    assert type_defines("CODE", np.float32, 4, 16) == {"CODE": "float", "CODE4": "float4", "CODE16": "float16"}
    assert flags(A=True, B=False, C=True) == {"A": None, "C": None}


def test_arithmetic_of_work_sizes() -> None:
    counts = [0, 1, 15, 16, 17, 64, 65]
    assert [ceil_div(count, 16) for count in counts] == [0, 1, 1, 1, 2, 4, 5]
    assert [round_up(count, 16) for count in counts] == [0, 16, 16, 16, 32, 64, 80]
    assert [capacity(count) for count in counts] == [1, 1, 16, 16, 32, 64, 128]
    assert [capacity(count, least=32) for count in counts] == [32, 32, 32, 32, 32, 64, 128]


def test_work_sizes() -> None:
    assert vector_work(33, 16) == WorkSize((3,), (1,), 16, vectors=True)
    assert padded_groups(33, 64) == WorkSize((64,), (64,), 1)
    assert padded_groups(65, 64) == WorkSize((128,), (64,), 1)
    assert padded_groups(0, 64) == WorkSize((0,), (64,), 1)
    assert padded_rows(5, 64) == WorkSize((64, 5), (64, 1), 1)
    assert padded_rows(5, 65) == WorkSize((128, 5), (64, 1), 1)
    assert strided_groups(257, 64) == WorkSize((128,), (64,), 256)
    assert strided_groups(256, 64) == strided_groups(1, 64) == WorkSize((64,), (64,), 256)
    assert strided_groups(0, 64) == WorkSize((0,), (64,), 256)
    assert fitted_groups(64, 64) == WorkSize((64,), (64,), 64)
    assert fitted_groups(63, 64) == WorkSize((64,), (16,), 16)
    assert fitted_groups(33, 64) == WorkSize((48,), (16,), 16)
    assert fitted_groups(16, 64) == WorkSize((16,), (16,), 16)
    assert fitted_groups(15, 64) == WorkSize((15,), (1,), 1)
    assert fitted_groups(7, 8) == WorkSize((7,), (1,), 1)
    assert fitted_groups(1, 64) == WorkSize((1,), (1,), 1)
    assert fitted_groups(301, 300) == WorkSize((600,), (300,), 300)
    assert fitted_groups(65, 64) == WorkSize((128,), (64,), 64)
    assert fitted_groups(0, 64) == WorkSize((0,), (1,), 1)
    assert group_per_element(33, 64) == WorkSize((2112,), (64,), 1)


def test_messages_name_the_operation() -> None:
    single = Machine(has_double=False)
    for options, name in (({}, "Scale"), ({"name": "Outer"}, "Outer")):
        with pytest.raises(ValueError, match=f"^{name}: device machine has no double precision and reads no float64"):
            builder((3,), np.float64, machine=single, **options).real  # noqa: B018
        assert builder((3,), machine=single, **options).name == name


def test_variant_follows_the_device_unless_it_is_named() -> None:
    cpu, gpu = Machine(), Machine(is_cpu=False)
    for machine, variant, expected in (
        (cpu, "auto", True),
        (gpu, "auto", False),
        (cpu, "work_item", False),
        (gpu, "vector", True),
    ):
        build = builder((100,), machine=machine, variant=variant)
        assert build.uses_vectors is expected
        assert build.work(100, each=16, group=64) == (vector_work(100, 16) if expected else padded_groups(100, 64))
    assert builder((15,)).work(15, each=16, group=64, least=16, grouping="fitted") == WorkSize((15,), (1,), 1)
    one_each = builder((15,), variant="work_item").work(15, each=16, group=64, grouping="per_element")
    assert one_each == group_per_element(15, 64)
    without = Machine(is_cpu=False)
    without.takes_vectors = False
    assert not builder((100,), machine=without).uses_vectors
    with pytest.raises(ValueError, match="device machine does not run the vector variant of kernels; use"):
        _ = builder((100,), machine=without, variant="vector").uses_vectors
    with pytest.raises(ValueError, match="variant must be"):
        _ = builder((100,), variant="sideways").uses_vectors


def test_shares_of_two_cores() -> None:
    build = builder((1000,))
    assert build.share(1000, per_core=4) == 125
    assert build.share(1001, per_core=4) == 126
    assert build.share(1000, per_core=4, multiple=16) == 128
    assert build.share(1025, per_core=4, multiple=16) == 144
    assert build.share(0, per_core=4, multiple=16) == 0


def test_the_launch_of_a_builder_is_the_one_written_by_hand() -> None:
    build = builder((100, 2), np.float64, precision="double", variant="vector")
    found = build.launch(
        "scale/scale.cl",
        "scale_points",
        work=build.work(100, each=16, group=64),
        more_inputs=[((100,), DOUBLE)],
        outputs=build.outputs({"points": (100, 2), "count": (100,), "sigma": None, "status": (100,)}, count=np.int32),
        defines={**type_defines("INPUT", np.float64), "TERMS": 3, **flags(OFFSET=True, GAIN=False)},
        arguments=[np.int32(100)],
        passes_once=True,
    )
    assert found == Launch(
        source="scale/scale.cl",
        kernel="scale_points",
        inputs=[((100, 2), DOUBLE), ((100,), DOUBLE)],
        outputs={
            "points": ((100, 2), DOUBLE),
            "count": ((100,), np.dtype(np.int32)),
            "sigma": None,
            "status": ((100,), np.dtype(np.uint8)),
        },
        global_size=(7,),
        local_size=(1,),
        defines={"REAL_IS_DOUBLE": None, "VECTOR_VARIANT": None, "INPUT": "double", "TERMS": 3, "OFFSET": None},
        arguments=[np.int32(100)],
        passes_once=True,
    )
    assert found.groups == 7
    assert found.nbytes == 100 * (2 * 8 + 8) + 100 * (2 * 8 + 4 + 1)


@pytest.mark.parametrize("rows", [1 << 20, 4 << 20])
def test_only_a_cpu_writes_much_data_past_its_caches(rows: int) -> None:
    """One input and one output of 4 bytes a row: 8 MB fit into a cache of 32 MB; 32 MB plus a status array do not."""
    for machine, variant in ((Machine(), "vector"), (Machine(), "work_item"), (Machine(is_cpu=False), "vector")):
        build = builder((rows,), machine=machine, variant=variant)
        outputs = build.outputs({"value": (rows,), "status": (rows,)})
        work = build.work(rows, each=16, group=64)
        launch = build.launch("a.cl", "a", work=work, outputs=outputs, streams=True)
        assert ("PAST_CACHES" in launch.defines) == (rows > 1 << 20 and machine.is_cpu and variant == "vector")
        assert launch.streams
        plain = build.launch("a.cl", "a", work=work, outputs=outputs)
        assert "PAST_CACHES" not in plain.defines
        assert not plain.streams


def test_inputs_that_an_operation_does_not_take_are_named() -> None:
    build = builder((3,), np.uint8)
    with pytest.raises(TypeError, match=r"^Scale takes float32, float64 or uint16 points, got uint8$"):
        build.check_dtype("float32", "float64", "uint16", of="points")
    with pytest.raises(TypeError, match=r"^Scale takes float32 means, got uint8$"):
        build.check_dtype("float32", of="means")
    with pytest.raises(ValueError, match=r"^Scale takes points \(\.\.\., 2\), got shape \(3,\)$"):
        build.check_shape(False, "points (..., 2)")
    build.check_dtype("uint8", of="points")
    build.check_shape(True, "points (..., 2)")


def test_doubles_need_a_device_with_doubles() -> None:
    single = Machine(has_double=False)
    build = builder((3,), np.float64, machine=single)
    build.check_dtype("float64", of="points")
    with pytest.raises(ValueError, match=r"^Scale: device machine has no double .*; give float32 input \(array"):
        build.launch("a.cl", "a", work=build.work(3, each=16, group=64), outputs={})
    with pytest.raises(ValueError, match="give float32 input"):
        _ = builder((3,), np.float64, machine=single, precision="single").real
    build = builder((3,), machine=single, precision="double")
    with pytest.raises(ValueError, match="machine has no double precision; use precision='single'"):
        build.launch("a.cl", "a", work=build.work(3, each=16, group=64), outputs={})
    with pytest.raises(ValueError, match="give points as float32"):
        builder((3,), np.float64, machine=single, narrows=True).check_dtype("float64", of="points")


def test_real_types() -> None:
    assert [real_of(None, np.dtype(name)) for name in ("uint8", "float32", "float64")] == [SINGLE, SINGLE, DOUBLE]
    assert real_of("double", SINGLE) == DOUBLE
    assert real_of("single", DOUBLE, narrows=True) == SINGLE
    with pytest.raises(TypeError, match="does not take float64"):
        real_of("single", DOUBLE)
    with pytest.raises(ValueError, match="precision must be"):
        real_of("half", SINGLE)


def test_results_become_numpy_arrays(device: Device) -> None:
    values = np.arange(5, dtype=np.float32)
    assert to_numpy(values) is values
    array = device.empty(values.shape, values.dtype)
    array.set(values)
    np.testing.assert_array_equal(to_numpy(array), values)
    with pytest.raises(TypeError, match="got NoneType"):
        to_numpy(None)


def test_offsets_of_a_table_with_parts_of_several_sizes() -> None:
    offsets = table_offsets("NODE", {"centre": 3, "radius": 1, "normal": 3})
    assert offsets == {"NODE_CENTRE": 0, "NODE_RADIUS": 3, "NODE_NORMAL": 4, "NODE_SIZE": 7}
    assert table_offsets("EMPTY", {}) == {"EMPTY_SIZE": 0}


@pytest.mark.parametrize(
    ("shape", "work", "message"),
    [
        ((1 << 31,), (64,), r"^Scale: an array of shape \(2147483648,\) has more than 2147483647 elements"),
        ((1 << 16, 1 << 16), (64,), r"shape \(65536, 65536\) has more than"),
        ((3,), (1 << 26, 64), r"^Scale: input of shape \(3,\) takes 4294967296 work-items, more than 2147483647"),
    ],
)
def test_counts_beyond_32_bits_are_refused(shape: tuple[int, ...], work: tuple[int, ...], message: str) -> None:
    launch = builder(shape).launch("a.cl", "a", work=WorkSize(work, None), outputs={"sum": ((3,), SINGLE)})
    with pytest.raises(ValueError, match=message):
        check_counts("Scale", launch)
    outputs = builder((3,)).launch("a.cl", "a", work=WorkSize((64,), None), outputs={"x": None, "sum": (shape, SINGLE)})
    if shape != (3,):
        with pytest.raises(ValueError, match=f"shape {re.escape(str(shape))} has more than"):
            check_counts("Scale", outputs)


def test_largest_count_is_allowed() -> None:
    launch = builder(((1 << 31) - 1,)).launch("a.cl", "a", work=WorkSize(((1 << 31) - 1,), None), outputs={})
    check_counts("Scale", launch)


def test_a_batch_of_too_many_samples_is_refused_before_its_memory_is_taken(device: Device) -> None:
    camera = Camera(matrix=((9.0, 0.0, 4.0), (0.0, 9.0, 4.0), (0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match=r"UndistortPoints: an array of shape \(1073741824, 2\).*; split the input"):
        UndistortPoints(model=camera).bind(device, (1 << 30, 2), np.float32)


@pytest.mark.parametrize("shape", [(1 << 33, 2), (3, 1 << 33), (0, 1 << 33), (7, 3)])
def test_counts_are_checked_before_the_launch_is_described(shape: tuple[int, ...]) -> None:
    """An operation converts counts to 32 bits, which may overflow in its description."""

    class Counting(PsdReadout):
        def launch(self, device: Any, shape: Any, dtype: Any) -> Any:
            assert max(shape) < 1 << 31, "refused before"
            return np.int32(shape[0] << 30)

    message = (
        "more than 2147483647 elements" if max(shape) > 7 else r"input of shape \(7, 3\) takes counts beyond the 32"
    )
    with pytest.raises(ValueError, match=rf"^Counting: .*{message}.*; split the input"):
        describe_launch(Counting(strip_length=6e-3), Machine(is_cpu=False), shape, SINGLE)


ODD = 1_000_003  # a prime: without padding, no group of more than one work-item divides it


@pytest.mark.parametrize(
    ("operation", "shape", "dtype", "items"),
    [
        (PsdReadout(strip_length=6e-3), (ODD, 2), np.float32, 0.25),  # a work-item reads 4 samples
        (LineReadout(threshold=20), (64, ODD), np.uint8, 4),  # 4 work-items read a profile
    ],
)
def test_odd_sizes_run_in_whole_groups(operation: Any, shape: tuple[int, ...], dtype: Any, items: float) -> None:
    launch = operation.launch(Machine(is_cpu=False), shape, np.dtype(dtype))
    assert launch.local_size is not None
    assert math.prod(launch.local_size) >= 32
    assert all(each % group == 0 for each, group in zip(launch.global_size, launch.local_size, strict=True))
    assert 1.0 <= math.prod(launch.global_size) / (items * ODD) < 1.001
