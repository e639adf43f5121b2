"""Argument tables: kernels read the same arguments from memory, of all types, and launches use the right arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from example_inputs import assert_has_numbers, inputs_with_numbers
from gpuvision.host import BuildError, Device, host_view
from gpuvision.host.argument_table import SIZE_MACRO, ArgumentTable, table_layout, takes_table, with_argument_table
from gpuvision.host.bound import Bound
from gpuvision.host.debug import debug_folder
from gpuvision.host.program import build, can_read_table
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.offline.registry import all_examples
from gpuvision.ranging.psd import PsdReadout

READOUT = PsdReadout(strip_length=2.0)
_CANARY = 0xA5
_SIDE = 101  # most elements of an axis
WITHOUT_TABLE = {"undistort", "form_factors", "patch_light"}
KERNEL = """
#define AS_IT_IS __attribute__((vec_type_hint(float)))
#ifdef WITH_DOUBLE
#define REAL double
#else
#define REAL float
#endif
AS_IT_IS kernel void report(global const int *restrict from, // numbers, and a comment ")"
#ifdef SECOND
    global int *restrict second,
#else
    global int *restrict first, global int *restrict unused,
#endif
    global REAL *restrict to, const uchar small, const REAL real, constant int *table, const ushort middle,
    const ulong large, const int last) {
    to[0] = from[0];
    to[1] = small;
    to[2] = real;
    to[3] = table[2];
    to[4] = middle;
    to[5] = large;
    to[6] = last;
#ifdef SECOND
    second[0] = 2;
#else
    first[0] = unused == 0;
#endif
}
"""


@pytest.fixture
def cpu(device: Device) -> Device:
    """A device on which kernels in the calling thread use the memory of the host."""
    if not device.has_inline_queues or not device.shares_memory:
        pytest.skip(f"{device.label} has no inline queues")
    return device


@pytest.mark.parametrize("second", [False, True])
def test_a_kernel_reads_arguments_of_all_types(cpu: Device, tmp_path: Path, second: bool) -> None:
    (tmp_path / "report.cl").write_text(KERNEL)
    defines: dict[str, Any] = {"SECOND": None} if second else {}
    real: Any = np.float64 if cpu.has_double else np.float32
    queue, count = cpu.new_queue(inline=True), 3 if second else 4
    constants = cpu.empty((3,), np.int32)
    host_view(constants)[...] = 3, 4, 5
    numbers = [np.uint8(7), real(0.625), constants, np.uint16(40_000), np.uint64(1 << 40), np.int32(-9)]
    layout = table_layout(count, numbers)
    program = build(
        cpu,
        tmp_path,
        "report.cl",
        {**defines, **({"WITH_DOUBLE": None} if cpu.has_double else {}), SIZE_MACRO: layout.itemsize},
        handle=queue.device,
        in_table="report",
    )
    arrays = [cpu.empty((3,), np.int32), cpu.empty((1,), np.int32), cpu.empty((9,), real)]
    values = [host_view(each) for each in arrays]
    for each in values:
        each.view(np.uint8)[...] = _CANARY
    values[0][0] = 11
    table = ArgumentTable(cpu, layout, count, numbers)
    for place, array in zip((0, 1, 2 if second else 3), arrays, strict=True):
        table.addresses[place] = host_view(array).ctypes.data
    kernel = cl.Kernel(program, "report")
    kernel.set_arg(0, table.memory)
    cl.enqueue_nd_range_kernel(queue, kernel, (1,), (1,)).wait()
    np.testing.assert_array_equal(values[2][:7], [11, 7, 0.625, 5, 40_000, 1 << 40, -9])
    assert values[1][0] == (2 if second else 1)
    assert set(values[2][7:].view(np.uint8)) == {_CANARY}


@pytest.mark.parametrize(
    "text",
    [
        "kernel void other(global int *a) {}",
        "#define BOTH global int *a, global int *b\nkernel void f(BOTH, int c) {}",
        "kernel void f(global int *a, const int n MORE) {}",
        "kernel void f(global int *a\n#if defined(N)\n, const int n\n#endif\n) {}",
        "kernel void f(global float (*restrict m)[3]) {}",
        "kernel void f(local float *a, const int b) {}",
        "kernel void f(void) {}",
        "#ifdef A\nkernel void f(int a) {}\n#else\nkernel __attribute__((noinline))\nvoid f(int a) {}\n#endif",
    ],
)
def test_kernels_that_keep_their_arguments(text: str) -> None:
    """Without the kernel, with macros or parentheses among its parameters, with local memory, with a long attribute."""
    assert not takes_table(text, "f")


def test_each_variant_gets_a_table() -> None:
    text = "#ifdef A\nkernel void f(global int *a TEAM_ARGUMENTS) {}\n#else\nkernel void f(const int b) {}\n#endif\n"
    assert takes_table(text, "f")
    changed = with_argument_table(text, "f")
    assert changed.count("(global const uchar *bytes") == 2
    assert "table->a" in changed
    assert "table->b" in changed


def test_most_kernels_read_tables(cpu: Device) -> None:
    """A kernel that cannot be changed would silently be launched with all its arguments."""
    left_out = set()
    for example in all_examples():
        if example.has_double == cpu.has_double:
            launch = example.operation.launch(cpu, example.shape, np.dtype(example.dtype))
            if not can_read_table(KERNEL_FOLDER, launch.source, (), launch.kernel):
                left_out.add(launch.kernel)
    assert left_out == WITHOUT_TABLE


def _bytes(bound: Bound[Any]) -> dict[str, bytes]:
    return {name: host_view(each).tobytes() for name, each in bound.outputs._asdict().items() if each is not None}


def _kernels() -> list[str]:
    return sorted({type(each.operation).__name__ for each in all_examples()})


@pytest.mark.slow
@pytest.mark.vectors
@pytest.mark.parametrize("name", _kernels())
def test_the_results_of_each_operation_are_the_same_bits(cpu: Device, name: str) -> None:
    """Compared with the kernel that gets its arguments one by one; outputs hold canaries before each launch."""
    example = next(
        each for each in all_examples() if type(each.operation).__name__ == name and each.has_double == cpu.has_double
    )
    rows = (min(example.shape[0], 3), *example.shape[1:]) if len(example.shape) > 2 else example.shape
    shape = tuple(min(size, _SIDE) for size in rows)
    bound = example.operation.bind(cpu, shape, example.dtype, queue=cpu.new_queue(inline=True))
    has_table = "VECTOR_VARIANT" in bound._launch.defines and bound._launch.kernel not in WITHOUT_TABLE
    assert (bound._call_site.table is not None) == has_table
    assert bound._queue_site.table is None
    inputs = inputs_with_numbers(example.operation, bound.inputs, cpu, np.random.default_rng(7))
    for array, values in zip(bound.inputs, inputs, strict=True):
        host_view(array)[...] = values
    found = []
    for site in (bound._call_site, bound._queue_site):
        bound._set_arrays(site, bound._own)
        for each in bound._own_outputs:
            host_view(each).reshape(-1).view(np.uint8)[...] = _CANARY
        cl.enqueue_nd_range_kernel(*site.arguments).wait()
        found.append(_bytes(bound))
    assert found[0] == found[1]
    assert_has_numbers(example.operation, type(bound.outputs)(*map(_view, bound.outputs)))


def _view(array: Any) -> Any:
    return None if array is None else host_view(array)


@pytest.mark.parametrize("inline", [False, True])
def test_launches_use_the_arrays_of_each_call(cpu: Device, inline: bool) -> None:
    """Own arrays, arrays in shared memory, and arrays in buffers, whose addresses the host does not know, in turn."""
    bound = READOUT.bind(cpu, (50, 2), np.float32, queue=cpu.new_queue(inline=inline))
    assert bound._run_site.table is not None
    own, out, in_buffers = bound.inputs[0], bound.allocate(), bound.allocate()
    in_buffers = type(in_buffers)(
        *(None if each is None else cl.array.empty(bound.queue, each.shape, each.dtype) for each in in_buffers)
    )
    shared, buffered = cpu.empty((50, 2), np.float32), cl.array.empty(bound.queue, (50, 2), np.float32)
    for _ in range(3):
        for frame, result, currents, expected in (
            (own, None, (1.0, 3.0), 0.5),
            (shared, out, (3.0, 1.0), -0.5),
            (buffered, in_buffers, (1.0, 1.0), 0.0),
            (shared, None, (1.0, 7.0), 0.75),
            (buffered, out, (7.0, 1.0), -0.75),
        ):
            frame.set(np.broadcast_to(np.float32(currents), (50, 2)).copy())
            target = bound.outputs if result is None else result
            target.position.set(np.full(50, np.nan, np.float32))
            bound.run(frame, out=result)
            has_addresses = frame is not buffered
            assert (bound._run_site.given[0] is frame) == has_addresses
            assert np.all(target.position.get() == expected)
            bound(frame, out=result).wait()
            assert np.all(target.position.get() == expected)


def test_arrays_in_buffers_have_no_table(cpu: Device) -> None:
    frame = cl.array.to_device(cpu.queue, np.full((50, 2), (1.0, 3.0), np.float32))
    bound = READOUT.bind(cpu, (50, 2), np.float32, inputs=[frame])
    assert bound._run_site.table is None
    assert np.all(bound.run().position.get() == 0.5)


@pytest.mark.parametrize("size", [50, 20_000])
def test_numpy_arrays_are_used_in_place_or_copied(cpu: Device, size: int) -> None:
    bound = READOUT.bind(cpu, (size, 2), np.float32)
    assert bound._run_site.table is not None
    for currents, expected in (((1.0, 3.0), 0.5), ((3.0, 1.0), -0.5)):
        frame = np.full((size, 2), currents, np.float32)
        assert np.all(bound.on_host([frame]).position == expected)
        host_view(bound.inputs[0])[...] = 1.0, 1.0
        assert np.all(host_view(bound.run().position) == 0.0)


def test_numbers_of_another_size_are_refused(cpu: Device, tmp_path: Path) -> None:
    """The table would shift all later arguments without a word."""
    (tmp_path / "report.cl").write_text(KERNEL)
    numbers = [np.uint64(7), np.float32(0.625), None, np.uint16(4), np.uint64(5), np.int32(-9)]
    with pytest.raises(BuildError, match="arguments of the launch and the parameters of the kernel differ"):
        build(cpu, tmp_path, "report.cl", {SIZE_MACRO: table_layout(4, numbers).itemsize}, in_table="report")


def test_a_numpy_array_as_input_of_an_instance_is_refused(cpu: Device) -> None:
    with pytest.raises(TypeError, match="expected a pyopencl array"):
        READOUT.bind(cpu, (50, 2), np.float32, inputs=[np.zeros((50, 2), np.float32)])


@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")
def test_a_written_program_is_the_one_that_was_built(
    cpu: Device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "report.cl").write_text(KERNEL)
    monkeypatch.setenv("GPUVISION_DEBUG", str(tmp_path / "debug"))
    assert debug_folder() is not None
    layout = table_layout(3, [np.uint8(7), np.float32(0.0), None, np.uint16(4), np.uint64(5), np.int32(-9)])
    build(cpu, tmp_path, "report.cl", {"SECOND": None, SIZE_MACRO: layout.itemsize}, in_table="report")
    (written,) = (tmp_path / "debug").glob("report-*.cl")
    program = cl.Program(cpu.context, written.read_text()).build()
    assert cl.Kernel(program, "report").num_args == 1
