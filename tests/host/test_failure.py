"""Full memory, lost contexts and forked processes: one line that says what failed and what to do."""

from __future__ import annotations

import copy
import functools
import gc
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.host import Device, DeviceLimitError, DeviceLostError, DeviceMemoryError, StreamError, failure
from gpuvision.host.kept import kept_bound
from gpuvision.host.pipeline import Pipeline
from gpuvision.ranging.psd import PsdReadout
from streams import READOUT, currents_of


def error_of(code: str, routine: str = "clEnqueueNDRangeKernel") -> cl.Error:
    """Return the error that pyopencl raises for a code of OpenCL."""
    return cl.RuntimeError(cl._cl._ErrorRecord(msg="", code=getattr(cl.status_code, code), routine=routine))


@pytest.fixture
def own(device: Device) -> Device:
    """Return the device in a separate context, which a test may lose."""
    return Device(device.handle, device.label, device.kind, inline_device=device.inline_device)


@pytest.fixture
def lose(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make the launches in the present context of a device fail, as after an illegal access on a GPU."""

    def lose(device: Device, code: str = "OUT_OF_RESOURCES") -> None:
        dead, launch, responds = device.context, cl.enqueue_nd_range_kernel, failure.responds

        def enqueue(queue: Any, *args: Any, **kwargs: Any) -> Any:
            if queue.context == dead:
                raise error_of(code)
            return launch(queue, *args, **kwargs)

        monkeypatch.setattr(cl, "enqueue_nd_range_kernel", enqueue)
        monkeypatch.setattr(failure, "responds", lambda queue: queue.context != dead and responds(queue))

    return lose


def test_an_array_beyond_the_largest_allocation_is_refused(device: Device) -> None:
    with pytest.raises(DeviceMemoryError, match=rf"takes 1.13e\+03 TB, device {device.label} allocates at most .* at"):
        device.empty((1 << 50,), np.uint8)
    assert issubclass(DeviceMemoryError, MemoryError)


def test_memory_that_the_runtime_does_not_have(device: Device) -> None:
    """The runtime refuses the allocation itself."""
    generous = copy.copy(device)
    generous.max_allocation = 1 << 60
    with pytest.raises(DeviceMemoryError, match=r"cannot allocate 1.13e\+03 TB for an array of .*clear_cache\(\)"):
        generous.empty((1 << 50,), np.uint8)


def test_a_call_without_memory_frees_the_kept_arrays_and_tries_again(own: Device, monkeypatch: Any) -> None:
    READOUT(currents_of(3), device=own)
    real, calls = own.empty, []

    def empty(shape: Any, dtype: Any, queue: Any = None) -> Any:
        calls.append(shape)
        if len(calls) == 1:
            raise DeviceMemoryError("full")
        return real(shape, dtype, queue)

    monkeypatch.setattr(own, "empty", empty)
    reading = READOUT(currents_of(4), device=own)
    assert reading.position.shape == (4, 5)
    assert [key[3] for key in kept_bound()] == [(4, 5, 2)]


def test_the_second_attempt_starts_without_the_arrays_of_the_first(own: Device, monkeypatch: Any) -> None:
    READOUT(currents_of(3), device=own)
    real, made, alive = own.empty, [], []

    def empty(shape: Any, dtype: Any, queue: Any = None) -> Any:
        if len(made) == 1:
            made.append(None)
            raise DeviceMemoryError("full")
        alive.extend(each() is not None for each in made[:1])
        array = real(shape, dtype, queue)
        made.append(weakref.ref(array))
        return array

    monkeypatch.setattr(own, "empty", empty)
    assert READOUT(currents_of(4), device=own).position.shape == (4, 5)
    assert alive
    assert not any(alive)


def test_an_array_beyond_the_limit_keeps_the_others(own: Device) -> None:
    """Freed memory would not help: the kept instances stay."""
    READOUT(currents_of(3), device=own)
    kept = [*kept_bound()]
    own.max_allocation = 100
    with pytest.raises(DeviceLimitError, match="allocates at most 100 bytes at once"):
        READOUT(currents_of(4), device=own)
    assert [*kept_bound()] == kept


def test_a_context_lost_at_an_allocation_is_opened_again(own: Device, monkeypatch: Any) -> None:
    own.shares_memory = False
    READOUT(currents_of(3), device=own)
    dead, buffer, responds = own.context, cl.Buffer, failure.responds

    def allocate(context: Any, *args: Any, **kwargs: Any) -> Any:
        if context == dead:
            raise error_of("INVALID_CONTEXT", "create_buffer")
        return buffer(context, *args, **kwargs)

    monkeypatch.setattr(cl, "Buffer", allocate)
    monkeypatch.setattr(failure, "responds", lambda queue: queue.context != dead and responds(queue))
    with pytest.raises(DeviceLostError, match=r"create_buffer failed: INVALID_CONTEXT.*was opened again"):
        READOUT(currents_of(6), device=own)
    assert own.context != dead
    assert READOUT(currents_of(6), device=own).position.shape == (6, 5)


def test_another_error_of_an_allocation_comes_through(own: Device, monkeypatch: Any) -> None:
    def allocate(*args: Any, **kwargs: Any) -> Any:
        raise error_of("INVALID_VALUE", "create_buffer")

    own.shares_memory = False
    monkeypatch.setattr(failure, "responds", lambda queue: True)
    monkeypatch.setattr(cl, "Buffer", allocate)
    with pytest.raises(cl.Error, match="INVALID_VALUE"):
        own.empty((3,), np.float32)


def test_errors_of_the_runtime_in_bind(own: Device, lose: Any, monkeypatch: Any) -> None:
    """First use of new memory, first launch, and launch for the queue beside the inline one."""
    message = "^PsdReadout: device .* has no memory for the launch"
    own.shares_memory = False

    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise error_of("MEM_OBJECT_ALLOCATION_FAILURE")

    faults = {
        "enqueue_fill_buffer": refuse,
        "enqueue_nd_range_kernel": lambda *args, **kwargs: SimpleNamespace(wait=refuse),
    }
    for name, fault in faults.items():
        with monkeypatch.context() as patch:
            patch.setattr(cl, name, fault)
            with pytest.raises(DeviceMemoryError, match=message):
                READOUT.bind(own, (3, 5, 2), np.float32)
    bound = READOUT._bind(own, (3, 5, 2), np.float32, None)
    if bound._inline_site is not None:
        lose(own, "MEM_OBJECT_ALLOCATION_FAILURE")
        with pytest.raises(DeviceMemoryError, match=message):
            bound.prepare_queue()


def test_two_threads_meet_one_loss(own: Device, monkeypatch: Any) -> None:
    """Both find the context dead before one of them opens the device again."""
    both = threading.Barrier(2, timeout=10)

    def responds(queue: Any) -> bool:
        both.wait()
        return False

    monkeypatch.setattr(failure, "responds", responds)
    lost, queue, failures = own.context, own.queue, []

    def meet() -> None:
        failures.append(str(failure.launch_failure(error_of("OUT_OF_RESOURCES"), own, queue, "Psd")))

    threads = [threading.Thread(target=meet) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(failures) == 2
    assert all("was opened again" in each for each in failures)
    assert own.context != lost


def test_a_device_without_vectors_is_opened_again_with_its_original(own: Device) -> None:
    scalar, lost = own.without_vectors(), own.context
    assert scalar.reopen(lost)
    assert scalar.context is own.context
    assert own.context != lost
    assert own.queue.context == own.context
    assert own.reopen(lost), "opened already"
    assert not own.reopen(own.context), "once only"


def test_a_launch_without_memory(own: Device, lose: Any) -> None:
    READOUT(currents_of(3), device=own)
    lose(own, "MEM_OBJECT_ALLOCATION_FAILURE")
    with pytest.raises(DeviceMemoryError, match=r"^PsdReadout: device \w+ has no memory for the launch .*split the in"):
        READOUT(currents_of(3), device=own)


def test_a_launch_with_too_few_resources_keeps_the_context(own: Device, lose: Any, monkeypatch: Any) -> None:
    bound = READOUT.bind(own, (3, 5, 2), np.float32)
    context = own.context
    lose(own)
    monkeypatch.setattr(failure, "responds", lambda queue: True)
    with pytest.raises(DeviceMemoryError, match=r"no resources for the launch .*OUT_OF_RESOURCES.*registers"):
        bound()
    assert own.context is context


def test_a_wrong_call_comes_through(own: Device, lose: Any, monkeypatch: Any) -> None:
    bound = READOUT.bind(own, (3, 5, 2), np.float32)
    lose(own, "INVALID_KERNEL_ARGS")
    monkeypatch.setattr(failure, "responds", lambda queue: True)
    with pytest.raises(cl.Error, match="INVALID_KERNEL_ARGS"):
        bound()


def test_a_working_context_responds(device: Device) -> None:
    assert failure.responds(device.queue)


@pytest.mark.parametrize("code", ["OUT_OF_RESOURCES", "INVALID_COMMAND_QUEUE", "INVALID_CONTEXT"])
def test_a_lost_device_is_opened_again_once(own: Device, lose: Any, code: str) -> None:
    expected = READOUT(currents_of(3), device=own).position
    first = own.context
    kept = weakref.ref(next(reversed(kept_bound().values())))
    lose(own, code)
    with pytest.raises(DeviceLostError, match=rf"^PsdReadout: the context of device \w+ is lost .*{code}.* again: rep"):
        READOUT(currents_of(3), device=own)
    assert own.context != first
    gc.collect()
    assert kept() is None, "arrays of the lost context are freed"
    np.testing.assert_array_equal(READOUT(currents_of(3), device=own).position, expected)
    second = own.context
    lose(own, code)
    with pytest.raises(DeviceLostError, match="start the process again"):
        READOUT(currents_of(3), device=own)
    assert own.context == second


def test_an_instance_bound_before_the_loss_says_so(own: Device, lose: Any) -> None:
    bounds = [READOUT.bind(own, (3, 5, 2), np.float32) for _ in range(2)]
    lose(own)
    for bound in bounds:
        with pytest.raises(DeviceLostError, match="opened again: repeat the call with new arrays, and bind operations"):
            bound.run()
    assert READOUT.bind(own, (3, 5, 2), np.float32).run().position.shape == (3, 5)


def test_a_queue_of_the_caller_is_not_replaced(device: Device, lose: Any) -> None:
    context = cl.Context([device.handle])  # kept: Intel's runtime frees a context while a queue of it exists
    mine = Device.of(cl.CommandQueue(context))
    bound = READOUT.bind(mine, (3, 5, 2), np.float32)
    lose(mine)
    with pytest.raises(DeviceLostError, match="start the process again"):
        bound()


def losing(stream: Pipeline[Any]) -> Pipeline[Any]:
    """Let the queues of an open stream fail when it closes; the producer may still launch work in them."""

    def fail_after(finish: Callable[[], None]) -> None:
        finish()
        raise error_of("OUT_OF_RESOURCES", "clFinish")

    for queues in dict.fromkeys(stream._queues):
        queues.finish = functools.partial(fail_after, queues.finish)
    return stream


def test_closing_does_not_mask_an_exception_of_the_loop(memory: dict[str, Any]) -> None:
    stream = Pipeline(currents_of(9), READOUT, batch=1, **memory)
    with pytest.raises(KeyError, match="mine") as caught, stream:
        {}[f"mine, at {next(losing(stream)).number}"]
    assert "closing the stream failed, too: the device failed" in caught.value.__notes__[0]


def test_closing_reports_a_failure_that_the_loop_did_not(memory: dict[str, Any]) -> None:
    stream = Pipeline(currents_of(9), READOUT, batch=1, **memory)
    message = r"the device failed before the stream's end: Pipeline: device \w+ has no res"
    with pytest.raises(StreamError, match=message), stream:
        next(losing(stream))


class Failing(PsdReadout):
    """Operation whose launches in a stream fail as on a device without memory."""

    def bind(self, *args: Any, **kwargs: Any) -> Any:
        bound = super().bind(*args, **kwargs)

        class Wrapped:
            inline = bound.inline

            def __getattr__(self, name: str) -> Any:
                return getattr(bound, name)

            def __call__(self, *args: Any, **kwargs: Any) -> Any:
                raise error_of("MEM_OBJECT_ALLOCATION_FAILURE")

        return Wrapped()


def test_an_error_of_the_runtime_in_a_stream_is_one_line(memory: dict[str, Any]) -> None:
    stream = Pipeline(currents_of(9), Failing(strip_length=6e-3), batch=1, **memory)
    message = r"stopped at frame 0 \(operation\): Pipeline: device \w+ has no memory for the launch"
    with pytest.raises(StreamError, match=message) as caught, stream:
        next(losing(stream))
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value.__cause__, DeviceMemoryError)


def test_clear_cache_frees_device_memory(own: Device) -> None:
    READOUT(currents_of(3), device=own)
    kept = weakref.ref(next(reversed(kept_bound().values())))
    gv.clear_cache()
    assert kept() is None
    assert not kept_bound()
    assert READOUT(currents_of(3), device=own).position.shape == (3, 5)


_FORK = """
import os, sys, numpy as np, gpuvision as gv
device = gv.Device.named(sys.argv[1])
readout, currents = gv.PsdReadout(strip_length=6e-3), np.ones((3, 2), np.float32)
bound = readout.bind(device, (3, 2), np.float32)
readout(currents, device=device)
calls = [
    lambda: gv.Device.best(),
    lambda: gv.Device.of(device.queue),
    lambda: bound(),
    lambda: bound.run(),
    lambda: readout(currents, device=device),
    lambda: readout(np.ones((4, 2), np.float32), device=device),
]
for call in calls:
    child = os.fork()
    if not child:
        try:
            call()
        except gv.GpuVisionError as error:
            print(error, flush=True)
        os._exit(0)
    os.waitpid(child, 0)
print(readout(currents, device=device).position.shape)
"""


def test_a_process_forked_after_the_first_use_is_told_why(device: Device) -> None:
    command = [sys.executable, "-c", _FORK, device.label]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    *children, parent = ran.stdout.splitlines()
    assert len(children) == 6
    assert all("forked after OpenCL was used" in each and "'spawn'" in each for each in children)
    assert parent == "(3,)", "the parent goes on"


def test_a_process_forked_before_the_first_use_works(device: Device) -> None:
    script = (
        "import os, sys, numpy as np, gpuvision as gv, gpuvision.host\n"
        "child = os.fork()\n"
        "assert gv.PsdReadout(strip_length=6e-3)(np.ones((3, 2), np.float32), device=gv.Device.named(sys.argv[1]))\n"
        "if child:\n    assert os.waitpid(child, 0)[1] == 0\n"
    )
    subprocess.run([sys.executable, "-c", script, device.label], timeout=60, check=True)
