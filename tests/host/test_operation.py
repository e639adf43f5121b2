"""Bind and call: checks, lifetimes, threads, and memory that is shared or not."""

from __future__ import annotations

import gc
import threading
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import BuildError, Device, Launch, Operation, host_view, to_numpy
from gpuvision.host.arrays import memory_of
from gpuvision.host.program import build, options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation

READOUT = PsdReadout(strip_length=2.0)


@pytest.fixture
def pairs(rng):
    return rng.uniform(0.1, 1.0, (1000, 2)).astype(np.float32)


@pytest.fixture(params=["shared", "copied"])
def memory(request, device):
    """The device as it is, and as a device with separate memory like a graphics card."""
    if request.param == "shared" and not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    if request.param == "shared":
        return device
    separate = Device(device.handle, device.label, device.kind)
    separate.shares_memory = False
    return separate


def expected(pairs):
    left, right = pairs.astype(np.float64).T
    return (right - left) / (right + left)


# A call of 1000 samples copies its arrays, a call of 40 000 samples reads and writes them in place on PoCL.
@pytest.mark.parametrize("count", [1000, 40_000])
def test_numpy_goes_in_and_comes_out(memory, rng, count):
    pairs = rng.uniform(0.1, 1.0, (count, 2)).astype(np.float32)
    position = READOUT(pairs, device=memory).position
    assert isinstance(position, np.ndarray)
    np.testing.assert_allclose(position, expected(pairs), atol=5e-7)


@pytest.mark.parametrize("count", [1000, 40_000])
def test_out_is_written_and_returned(memory, rng, count):
    pairs = rng.uniform(0.1, 1.0, (count, 2)).astype(np.float32)
    first = READOUT(pairs, device=memory)
    addresses = [array.ctypes.data for array in first if array is not None]
    again = READOUT(pairs[::-1].copy(), device=memory, out=first)
    assert again is first
    assert [array.ctypes.data for array in again if array is not None] == addresses
    np.testing.assert_allclose(again.position, expected(pairs[::-1]), atol=5e-7)


def test_numpy_arrays_leave_the_inputs_of_the_caller(device, pairs):
    """Where memory is shared: elsewhere NumPy arrays go through the inputs of the instance."""
    given = device.empty(pairs.shape, pairs.dtype)
    given.set(pairs)
    bound = READOUT.bind(device, pairs.shape, pairs.dtype, inputs=(given,))
    np.testing.assert_allclose(bound.on_host([pairs[::-1].copy()]).position, expected(pairs[::-1]), atol=5e-7)
    assert np.array_equal(given.get(), pairs) == device.shares_memory


def test_a_read_only_input_is_fine(memory, pairs):
    pairs.flags.writeable = False
    np.testing.assert_allclose(READOUT(pairs, device=memory).position, expected(pairs), atol=5e-7)


def test_a_read_only_output_is_refused(memory, pairs):
    out = READOUT(pairs, device=memory)
    before = out.total.copy()
    out.total.flags.writeable = False
    with pytest.raises(ValueError, match=r"out\.total: expected an array that can be written, got a read-only one"):
        READOUT(2.0 * pairs, device=memory, out=out)
    np.testing.assert_array_equal(out.total, before)


def test_device_arrays_stay_on_the_device(memory, pairs):
    frame = memory.empty(pairs.shape, pairs.dtype)
    frame.set(pairs)
    reading = READOUT(frame)
    assert isinstance(reading.position, cl.array.Array)
    np.testing.assert_allclose(reading.position.get(), expected(pairs), atol=5e-7)


def test_an_empty_batch(memory):
    """On a device with separate memory, too, an empty batch has memory, and arrays of pyopencl without memory work."""
    nothing = np.empty((0, 2), np.float32)
    assert READOUT(nothing, device=memory).position.shape == (0,)
    bound = READOUT.bind(memory, nothing.shape, nothing.dtype)
    assert bound.inputs[0].base_data is not None
    assert bound.run().position.get().shape == (0,)
    given = cl.array.Array(memory.queue, nothing.shape, nothing.dtype)
    assert given.base_data is None
    assert READOUT(given).position.get().shape == (0,)
    assert bound.run(given).total.get().shape == (0,)


def test_a_bound_instance_keeps_what_a_running_kernel_uses(memory):
    large = np.ones((400_000, 2), np.float32)
    bound = READOUT.bind(memory, large.shape, large.dtype)
    events = []
    for number in range(8):
        frame = memory.empty(large.shape, large.dtype)
        frame.set(large * np.array([1, number + 1], np.float32))
        events.append(bound(frame))
        del frame
        gc.collect(1)  # the youngest objects, of which the frame is one
    cl.wait_for_events(events)
    np.testing.assert_allclose(bound.outputs.position.get(), 7 / 9, atol=1e-6)


def test_own_input_after_a_given_one(memory, pairs):
    bound = READOUT.bind(memory, pairs.shape, pairs.dtype)
    bound.inputs[0].set(pairs)
    other = memory.empty(pairs.shape, pairs.dtype)
    other.set(pairs[::-1].copy())
    bound(other).wait()
    np.testing.assert_allclose(bound.outputs.position.get(), expected(pairs[::-1]), atol=5e-7)
    bound().wait()
    np.testing.assert_allclose(bound.outputs.position.get(), expected(pairs), atol=5e-7)


def test_calls_wait_for_events(device, pairs):
    gate = cl.UserEvent(device.context)
    bound = READOUT.bind(device, pairs.shape, pairs.dtype)
    event = bound(wait_for=[gate])
    assert event.command_execution_status != cl.command_execution_status.COMPLETE
    gate.set_status(cl.command_execution_status.COMPLETE)
    event.wait()


def test_short_work_runs_inline(device, pairs):
    """Only short inline work is finished on return; long work runs in the worker threads."""
    if device.inline_device is None:
        pytest.skip("only PoCL 3 has such a device")
    complete = cl.command_execution_status.COMPLETE
    large = np.ones((400_000, 2), np.float32)
    for frame, is_inline in ((pairs, True), (large, False)):
        bound = READOUT.bind(device, frame.shape, frame.dtype)
        host_view(bound.inputs[0])[...] = frame
        event = bound()
        assert (event.command_execution_status == complete) or not is_inline
        event.wait()
        assert (event.get_info(cl.event_info.COMMAND_QUEUE).device == device.inline_device) is is_inline
        np.testing.assert_allclose(host_view(bound.outputs.position), expected(frame), atol=5e-7)


def test_work_of_one_group_runs_inline(device):
    if device.kind != "intel":
        pytest.skip("only Intel's runtime does so by the work's groups")
    for count, is_inline in ((16, True), (400_000, False)):
        frame = np.linspace(0.1, 1.0, 2 * count, dtype=np.float32).reshape(count, 2)
        bound = READOUT.bind(device, frame.shape, frame.dtype)
        host_view(bound.inputs[0])[...] = frame
        event = bound()
        assert (event.get_info(cl.event_info.COMMAND_QUEUE) != device.queue) is is_inline
        event.wait()
        np.testing.assert_allclose(host_view(bound.outputs.position), expected(frame), atol=5e-7)


def test_a_short_stream_of_several_groups_runs_inline_where_the_caller_waits(device, rng):
    """On Intel's runtime; on PoCL a call that does not wait runs inline, too."""
    if not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    for count, waits in ((10_000, True), (400_000, False)):
        bound = READOUT.bind(device, (count, 2), np.float32)
        assert bound._launch.groups > 1
        assert bound.inline == (waits and device.kind == "pocl")
        assert bound._run_site.inline == waits
        for _ in range(3):
            frame = rng.uniform(0.1, 1.0, (count, 2)).astype(np.float32)
            bound.inputs[0].set(frame)
            np.testing.assert_allclose(host_view(bound.run().position), expected(frame), atol=5e-7)
            np.testing.assert_allclose(READOUT(frame, device=device).position, expected(frame), atol=5e-7)


def test_only_streams_of_several_groups_run_inline_for_a_caller_that_waits(device):
    """Other short launches compute more for each byte, and gain by all cores of Intel's runtime."""
    if device.kind != "intel":
        pytest.skip("only Intel's runtime does so by the work's groups")
    for streams in (False, True):
        launch = replace(READOUT.launch(device, (10_000, 2), np.dtype(np.float32)), streams=streams)
        operation = replace(READOUT)
        object.__setattr__(operation, "launch", lambda *_, launch=launch: launch)
        assert operation.bind(device, (10_000, 2), np.float32)._run_site.inline == streams


@pytest.mark.parametrize("count", [1000, 10_000])
@pytest.mark.parametrize("waits", [False, True])
def test_short_work_comes_after_the_long_work_before_it(device, rng, count, waits):
    """Also where the short work waits and runs inline."""
    long = READOUT.bind(device, (400_000, 2), np.float32)
    short = READOUT.bind(device, (count, 2), np.float32)
    both = cl.array.Array(device.queue, (count, 2), np.float32, data=long.outputs.position.base_data)
    frame = device.empty((400_000, 2), np.float32)
    for _ in range(10):
        currents = rng.uniform(0.1, 1.0, frame.shape).astype(np.float32) * np.array([0.1, 1.0], np.float32)
        frame.set(currents)
        long(frame)
        if waits:
            short.run(both)
        else:
            short(both).wait()
        middle = expected(currents)[: 2 * count].reshape(count, 2)
        np.testing.assert_allclose(short.outputs.position.get(), expected(middle), atol=1e-5)


@pytest.mark.parametrize("count", [0, 16, 400_000])
def test_work_in_an_inline_queue_is_done_on_return(device, rng, count):
    queue = device.new_queue(inline=True)
    # PoCL 5 and 6 have no inline device, see `request_inline_device`.
    always = device.prefers_vectors and (device.kind == "intel" or device.driver.startswith("3."))
    assert device.is_inline(queue) or not always
    assert not device.is_inline(device.queue)
    if not device.is_inline(queue):
        pytest.skip(f"{device.label} has no inline queues")
    bound = READOUT.bind(device, (count, 2), np.float32, queue=queue)
    for _ in range(5 if count > 16 else 200):
        frame = rng.uniform(0.1, 1.0, (count, 2)).astype(np.float32)
        host_view(bound.inputs[0])[...] = frame
        assert bound().command_execution_status == cl.command_execution_status.COMPLETE
        np.testing.assert_allclose(host_view(bound.outputs.position), expected(frame), atol=5e-7)
        host_view(bound.outputs.position)[...] = 7.0
        np.testing.assert_allclose(host_view(bound.run().position), expected(frame), atol=5e-7)


def test_an_inline_queue_waits_for_others(device, rng):
    queue = device.new_queue(inline=True)
    workers = READOUT.bind(device, (400_000, 2), np.float32)
    short = READOUT.bind(device, (1000, 2), np.float32, queue=queue)
    both = cl.array.Array(device.queue, (1000, 2), np.float32, data=workers.outputs.position.base_data)
    for _ in range(10):
        currents = rng.uniform(0.1, 1.0, (400_000, 2)).astype(np.float32) * np.array([0.1, 1.0], np.float32)
        workers.inputs[0].set(currents)
        short(both, wait_for=[workers()]).wait()
        middle = expected(currents)[:2000].reshape(1000, 2)
        np.testing.assert_allclose(short.outputs.position.get(), expected(middle), atol=1e-5)


def test_arrays_of_an_inline_queue(device, pairs):
    frame = cl.array.to_device(device.new_queue(inline=True), pairs)
    np.testing.assert_allclose(READOUT(frame).position.get(), expected(pairs), atol=5e-7)


def test_threads_do_not_share_a_kernel(device, rng):
    batches = [rng.uniform(0.1, 1.0, (2000, 2)).astype(np.float32) for _ in range(4)]
    wrong = []

    def work(batch):
        for _ in range(50):
            position = READOUT(batch, device=device).position
            if not np.allclose(position, expected(batch), atol=5e-7):
                wrong.append(batch)

    threads = [threading.Thread(target=work, args=(batch,)) for batch in batches]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_another_dtype_shape_kind_or_number_is_told(device, pairs):
    bound = READOUT.bind(device, pairs.shape, pairs.dtype)
    with pytest.raises(TypeError, match="expected dtype float32, got float64"):
        bound(device.empty(pairs.shape, np.float64))
    with pytest.raises(ValueError, match=r"expected shape \(1000, 2\), got \(999, 2\)"):
        bound(device.empty((999, 2), np.float32))
    with pytest.raises(TypeError, match="expected a pyopencl array"):
        bound(pairs)
    with pytest.raises(TypeError, match="expected 1 input arrays, got 2"):
        bound(bound.inputs[0], bound.inputs[0])
    with pytest.raises(TypeError, match="expected 1 input arrays, got 2"):
        READOUT(pairs, pairs, device=device)
    with pytest.raises(TypeError, match="all of one kind"):
        READOUT(pairs, bound.inputs[0], device=device)
    bound().wait()  # the refused call has not changed the bound instance


def test_a_refused_array_leaves_all_arguments_as_they_were(memory, pairs):
    bound = READOUT.bind(memory, pairs.shape, pairs.dtype)
    frame, other = memory.empty(pairs.shape, pairs.dtype), memory.empty(pairs.shape, pairs.dtype)
    frame.set(pairs)
    other.set(pairs[::-1].copy())
    bound.run(frame)
    with pytest.raises(ValueError, match="expected shape"):
        bound(other, out=bound.outputs._replace(total=memory.empty((999,), np.float32)))
    np.testing.assert_allclose(bound.run(frame).position.get(), expected(pairs), atol=5e-7)


class Copies(NamedTuple):
    """Result whose fields are in another order than the kernel's arguments."""

    tripled: Any
    missing: Any
    doubled: Any


class Copy(Operation[Copies]):
    """Operation whose kernel takes its outputs in another order than the fields of the result."""

    Result = Copies

    def launch(self, device, shape, dtype):
        spec = (shape, dtype)
        outputs = {"doubled": spec, "tripled": spec, "missing": None}
        return Launch("copies.cl", "copies", [spec], outputs, shape, (1,))


def test_outputs_follow_the_order_of_the_kernel(memory, tmp_path):
    arguments = "global const float *in, global float *doubled, global float *tripled, global float *missing"
    body = "int i = get_global_id(0); doubled[i] = 2 * in[i]; tripled[i] = 3 * in[i]; if (missing) missing[i] = 0;"
    (tmp_path / "copies.cl").write_text(f"kernel void copies({arguments}) {{ {body} }}")
    operation = Copy()
    operation.kernel_folder = tmp_path
    values = np.arange(8, dtype=np.float32)
    bound = operation.bind(memory, values.shape, values.dtype)
    frame, out = memory.empty(values.shape, values.dtype), bound.allocate()
    frame.set(values)
    for result in (bound.run(frame), bound.run(frame, out=out), bound.on_host((values,))):
        np.testing.assert_array_equal(to_numpy(result.doubled), 2 * values)
        np.testing.assert_array_equal(to_numpy(result.tripled), 3 * values)


def test_run_waits_and_returns_what_was_written(memory, pairs):
    bound = READOUT.bind(memory, pairs.shape, pairs.dtype)
    frame, out = memory.empty(pairs.shape, pairs.dtype), bound.allocate()
    frame.set(pairs)
    bound.inputs[0].set(pairs[::-1].copy())
    assert bound.run() is bound.outputs
    assert bound.run(frame, out=out) is out
    np.testing.assert_allclose(out.position.get(), expected(pairs), atol=5e-7)
    np.testing.assert_allclose(bound.outputs.position.get(), expected(pairs[::-1]), atol=5e-7)


def test_a_wait_outlasts_what_is_watched(device):
    gate = cl.UserEvent(device.context)
    threading.Timer(0.02, lambda: gate.set_status(cl.command_execution_status.COMPLETE)).start()
    device.wait(gate)
    assert gate.command_execution_status == cl.command_execution_status.COMPLETE


def test_foreign_byte_order_is_refused(memory, pairs):
    with pytest.raises(TypeError, match="native byte order"):
        READOUT(pairs.astype(">f4"), device=memory)


def test_outputs_must_lie_apart(memory, pairs):
    out = READOUT(pairs, device=memory)
    with pytest.raises(ValueError, match="shares its memory"):
        READOUT(pairs, device=memory, out=out._replace(total=out.position))
    with pytest.raises(ValueError, match="shares its memory"):
        READOUT(pairs, device=memory, out=out._replace(position=pairs.reshape(-1)[:1000]))
    bound = READOUT.bind(memory, pairs.shape, pairs.dtype)
    with pytest.raises(ValueError, match="shares its memory"):
        bound(out=bound.outputs._replace(total=bound.outputs.position))


def test_out_of_another_kind_is_told(memory, pairs):
    out = READOUT(pairs, device=memory)
    with pytest.raises(TypeError, match="expected a PsdReading"):
        READOUT(pairs, device=memory, out=tuple(out))
    with pytest.raises(ValueError, match=r"out\.total is missing"):
        READOUT(pairs, device=memory, out=out._replace(total=None))
    with pytest.raises(ValueError, match=r"out\.sigma is not computed"):
        READOUT(pairs, device=memory, out=out._replace(sigma=np.empty_like(out.total)))


def test_no_input_and_no_device_are_told(memory, pairs):
    with pytest.raises(TypeError, match="got none"):
        READOUT(device=memory)
    with pytest.raises(TypeError, match=r"Device\.named"):
        READOUT(pairs, device="pocl")
    assert READOUT.bind(memory, [1000, 2], "float32").outputs.position.shape == (1000,)


def test_an_input_that_another_queue_still_writes_is_waited_for(device):
    if not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    large = np.tile(np.array([1.0, 3.0], np.float32), (200_000, 1))
    gate = cl.UserEvent(device.context)
    frame = device.empty(large.shape, large.dtype)
    frame.set(large * 0)
    frame.add_event(gate)
    reading = READOUT(frame)
    host_view(frame)[...] = large
    gate.set_status(cl.command_execution_status.COMPLETE)
    np.testing.assert_array_equal(reading.position.get(), 0.5)


def test_an_out_of_order_queue_is_refused(device):
    flags = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    try:
        queue = cl.CommandQueue(device.context, properties=flags)
    except cl.Error:
        pytest.skip("this device has no out-of-order queues")
    with pytest.raises(ValueError, match="in-order"):
        Device.of(queue)


def test_an_array_of_another_device_is_refused(pairs):
    devices = Device.all()
    if len(devices) < 2:
        pytest.skip("there is one device only")
    frame = devices[0].empty(pairs.shape, pairs.dtype)
    with pytest.raises(ValueError, match="copy it there first"):
        READOUT(frame, device=devices[1])
    with pytest.raises(ValueError, match="another device"):
        READOUT.bind(devices[1], pairs.shape, pairs.dtype)(frame)


def test_inputs_of_two_devices_are_refused_by_the_device_of_the_first():
    devices = Device.all()
    if len(devices) < 2:
        pytest.skip("there is one device only")
    sheet = Triangulation(homography=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), region=((-1, 1), (-1, 1)))
    position, light = (each.empty((4, 5), np.float32) for each in devices[:2])
    with pytest.raises(ValueError, match=f"the array lies on another device than {devices[0].label}"):
        sheet(position, light)


def test_a_part_of_an_array_is_refused(device):
    array = device.empty((10, 2), np.float32)
    assert memory_of(array) is array.base_data
    with pytest.raises(ValueError, match="whole C-contiguous"):
        memory_of(array[2:])


def test_host_view_is_the_memory_itself(device):
    if not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    array = device.empty((5, 3), np.float32)
    view = host_view(array)
    view[...] = 7.0
    np.testing.assert_array_equal(array.get(), 7.0)
    del array
    gc.collect()
    view[...] = 8.0  # the view keeps the memory alive
    assert (view == 8.0).all()


def test_host_view_refuses_memory_that_is_not_shared(device):
    buffer = cl.array.Array(device.queue, (4,), np.float32)
    with pytest.raises(ValueError, match=r"array\.get"):
        host_view(buffer)


def test_a_program_is_built_once(device):
    vectors = {f"INPUT{width}": f"float{width}" for width in (2, 4, 16)}
    defines = {"INPUT": "float", **vectors, "WITH_POSITION": None}
    assert build(device, KERNEL_FOLDER, "psd/psd.cl", defines) is build(
        device, KERNEL_FOLDER, "psd/psd.cl", dict(reversed(defines.items()))
    )


def test_a_kernel_that_does_not_compile_is_told_with_its_log(device):
    with pytest.raises(BuildError, match=r"psd/psd\.cl does not build with .*-DINPUT=nonsense"):
        build(device, KERNEL_FOLDER, "psd/psd.cl", {"INPUT": "nonsense", "INPUT16": "float16"})


def test_no_option_gives_up_on_nan():
    words = " ".join(options({"A": 1, "B": None}))
    assert words == "-cl-mad-enable -DA=1 -DB"


def test_the_memory_of_a_caller_without_contiguity_is_refused(device, pairs):
    with pytest.raises(ValueError, match="ascontiguousarray"):
        READOUT(pairs[::2], device=device)


def test_masked_arrays_are_refused(device: Device) -> None:
    """A kernel does not see the mask: it would read the values under it."""
    masked = np.ma.masked_invalid(np.ones((4, 4), np.float32))
    expected = r"LineReadout: input 1 of 1: expected a plain array, got a masked array; fill it with \.filled"
    with pytest.raises(TypeError, match=expected):
        LineReadout()(masked, device=device)
