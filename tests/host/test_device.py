"""Devices: selection, names, and adopted handles; a missing requested device is an error."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from fakes import FakeDevice, FakePlatform
from gpuvision.host import Device, DeviceUnusableError, NoDeviceError, discovery, host_view
from gpuvision.host import device as module
from gpuvision.ranging.psd import PsdReadout

Paper = Callable[..., None]
READOUT = PsdReadout(strip_length=6e-3)


@pytest.fixture
def paper(monkeypatch: pytest.MonkeyPatch) -> Paper:
    """Replace the devices by fakes with the given labels; a reason marks a device that does not work."""

    def install(**reasons: str) -> None:
        listed = []
        for label, reason in reasons.items():
            label = label.replace("_", ":")
            handle = FakePlatform(f"Platform of {label}", devices=[FakeDevice(f"Name of {label}")]).devices[0]
            listed.append(discovery.ProbedDevice(label, label.split(":")[0], 0, 0, handle, "", None, reason))
        monkeypatch.setattr(discovery, "probed_devices", lambda: tuple(listed))
        monkeypatch.setattr(module, "_open", lambda candidate: candidate.label)
        monkeypatch.delenv(module.VARIABLE, raising=False)

    return install


def test_best_prefers_pocl_and_skips_the_broken(paper: Paper) -> None:
    paper(other="", intel="", pocl_0="broken", pocl_1="")
    assert Device.all() == ("pocl:1", "intel", "other")
    assert Device.best() == "pocl:1"


@pytest.mark.parametrize(
    ("asked", "label"),
    [("pocl:1", "pocl:1"), ("intel", "intel"), ("INTEL", "intel"), ("name of intel", "intel"), ("nvidia", "nvidia")],
)
def test_named(paper: Paper, monkeypatch: pytest.MonkeyPatch, asked: str, label: str) -> None:
    paper(pocl_0="", pocl_1="", intel="", nvidia="")
    assert Device.named(asked) == label
    monkeypatch.setenv(module.VARIABLE, asked)
    assert Device.best() == label


def test_name_of_a_healthy_and_a_broken_one(paper: Paper) -> None:
    paper(pocl_0="broken", pocl_1="")
    assert Device.named("pocl") == "pocl:1"
    with pytest.raises(DeviceUnusableError, match="pocl:0 does not work: broken; "):
        Device.named("pocl:0")


def test_label_beats_a_part_of_other_names(paper: Paper) -> None:
    paper(intel="", **{"intel-gpu": ""})
    assert Device.named("intel") == "intel"


def test_ambiguous_name(paper: Paper) -> None:
    paper(pocl_0="", pocl_1="", intel="")
    with pytest.raises(NoDeviceError, match=r"2 devices match 'pocl': pocl:0, pocl:1; ask for one"):
        Device.named("pocl")


@pytest.mark.parametrize("name", ["", "  "])
def test_empty_name(paper: Paper, name: str) -> None:
    paper(pocl="")
    with pytest.raises(NoDeviceError, match="no device matches"):
        Device.named(name)


def test_missing_device_names_what_is_there(paper: Paper, monkeypatch: pytest.MonkeyPatch) -> None:
    paper(pocl="", intel="broken")
    expected = r"no device matches 'nvidia'; choose one of pocl, intel, or install one: .*pocl-opencl-icd"
    with pytest.raises(NoDeviceError, match=expected):
        Device.named("nvidia")
    monkeypatch.setenv(module.VARIABLE, "nvidia")
    with pytest.raises(NoDeviceError, match=expected):
        Device.best()


def test_broken_device_gives_its_reason_and_advice(paper: Paper) -> None:
    paper(pocl="unknown target CPU 'generic'")
    expected = r"pocl does not work: unknown target CPU 'generic'; .*apt-get install"
    with pytest.raises(DeviceUnusableError, match=expected):
        Device.named("pocl")
    with pytest.raises(
        NoDeviceError, match=r"no healthy OpenCL device \(pocl: unknown target CPU 'generic'\); install"
    ):
        Device.best()


def test_no_platform_at_all(paper: Paper) -> None:
    paper()
    assert Device.all() == ()
    with pytest.raises(NoDeviceError, match=r"\(no OpenCL platform\); install one: .*apt-get.*gpuvision\[cpu\]"):
        Device.best()
    with pytest.raises(NoDeviceError, match="no device matches 'pocl'; install one"):
        Device.named("pocl")


def test_one_device_one_object(device: Device) -> None:
    assert Device.named(device.label) is device
    assert device in Device.all()
    assert Device.of(device.queue) is device
    assert Device.of(cl.array.Array(device.queue, (3,), np.float32)) is device
    assert device.label in repr(device)


def test_threads_that_open_together_share_a_context(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_opened", {})
    (listed,) = [each for each in discovery.listed_devices() if each.label == device.label]
    barrier, found = threading.Barrier(4), []

    def open_it() -> None:
        barrier.wait()
        found.append(module._open(listed))

    threads = [threading.Thread(target=open_it) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert len(set(map(id, found))) == 1


def test_callers_own_queue(device: Device) -> None:
    context = cl.Context([device.handle])
    queue = cl.CommandQueue(context)
    mine = Device.of(queue)
    assert mine is not device
    assert (mine.queue, mine.context) == (queue, context)
    assert (mine.label, mine.kind, mine.is_cpu) == (device.label, device.kind, device.is_cpu)
    assert Device.of(queue) is mine


def test_callers_own_context(device: Device) -> None:
    context = cl.Context([device.handle])
    mine = Device.of(context)
    assert mine.context == context
    assert Device.of(context) is mine
    array = cl.array.Array(context, (2,), np.uint8)
    assert Device.of(array).context == context


def test_second_queue_of_our_context(device: Device) -> None:
    queue = device.new_queue()
    mine = Device.of(queue)
    assert mine.queue == queue
    assert mine.context == device.context


def test_taking_over_asks_nothing(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adopting a handle that the caller owns does not probe any device."""
    monkeypatch.setattr(discovery, "probed_devices", lambda: pytest.fail("nothing is to be probed"))
    context = cl.Context([device.handle])
    assert Device.of(context).label == device.label


def test_device_that_the_loader_does_not_list(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "listed_devices", tuple)
    context = cl.Context([device.handle])
    mine = Device.of(context)
    assert mine.label == mine.kind == device.kind


@pytest.mark.parametrize("handle", [None, 3, "pocl", np.zeros(3)])
def test_not_a_handle(handle: Any) -> None:
    with pytest.raises(TypeError, match="expected a pyopencl queue, context or array"):
        Device.of(handle)


@pytest.mark.parametrize("profiling", [False, True])
def test_new_queue(device: Device, profiling: bool) -> None:
    queue = device.new_queue(profiling=profiling)
    assert queue != device.queue
    assert queue.context == device.context
    assert bool(queue.properties & cl.command_queue_properties.PROFILING_ENABLE) is profiling
    assert not queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    event = cl.enqueue_marker(queue)
    event.wait()
    if profiling:
        assert event.profile.end >= event.profile.queued


@pytest.mark.parametrize("shape", [(5,), (2, 3, 4), (), (0,), (3, 0)])
def test_empty(device: Device, shape: tuple[int, ...]) -> None:
    array = device.empty(shape, "float32")
    assert (array.shape, array.dtype, array.context) == (shape, np.float32, device.context)
    if device.shares_memory:
        view = host_view(array)
        view[...] = 7.0
        assert np.all(array.get() == 7.0)
    else:
        with pytest.raises(ValueError, match=r"array\.get"):
            host_view(array)


def test_empty_on_another_queue(device: Device) -> None:
    queue = device.new_queue()
    assert device.empty((4,), np.uint8, queue).queue == queue


def test_queue_of_another_context_is_refused(device: Device) -> None:
    context = cl.Context([device.handle])  # kept: Intel's runtime frees a context while a queue of it exists
    queue = cl.CommandQueue(context)
    with pytest.raises(ValueError, match=f"belongs to another context than device {device.label}"):
        READOUT.bind(device, (4, 2), np.float32, queue=queue)


def test_queue_without_order_is_refused(device: Device) -> None:
    out_of_order = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    queue = cl.CommandQueue(device.context, device.handle, properties=out_of_order)
    with pytest.raises(ValueError, match="out of order"):
        READOUT.bind(device, (4, 2), np.float32, queue=queue)
    with pytest.raises(ValueError, match="out of order"):
        Device.of(queue)


def test_object_that_is_no_queue_is_refused(device: Device) -> None:
    with pytest.raises(TypeError, match=r"expected a pyopencl queue, got Context; Device\.new_queue"):
        READOUT.bind(device, (4, 2), np.float32, queue=device.context)


@pytest.mark.parametrize(
    ("kind", "type_", "expected"),
    [("pocl", "CPU", True), ("intel", "CPU", True), ("rusticl", "CPU", False), ("pocl", "GPU", False)],
)
def test_only_known_cpu_runtimes_prefer_vectors(device: Device, kind: str, type_: str, expected: bool) -> None:
    """PoCL also drives GPUs, and Mesa's rusticl calls a device a CPU whose compiler has no vectors of 16."""

    class Handle:
        type = getattr(cl.device_type, type_)

        def __getattr__(self, name: str) -> Any:
            return getattr(device.handle, name)

    assert Device(Handle(), kind, kind, queue=device.queue).prefers_vectors is expected
    assert not device.without_vectors().prefers_vectors
    assert device.without_vectors().context is device.context


class PaperHandle:
    """Handle of a device with given properties."""

    def __init__(self, **properties: Any) -> None:
        usual = {
            "name": " A device ",
            "driver_version": "1.5",
            "type": cl.device_type.CPU,
            "max_compute_units": 6,
            "double_fp_config": 0,
            "single_fp_config": 0,
            "max_mem_alloc_size": 1 << 30,
            "global_mem_cache_size": 1 << 20,
            "svm_capabilities": cl.device_svm_capabilities.FINE_GRAIN_BUFFER,
            "extensions": "cl_khr_fp64",
        }
        vars(self).update(usual | properties)


class OldHandle(PaperHandle):
    """Handle of OpenCL 1.2, which has no shared virtual memory."""

    svm_capabilities = property(lambda self: self.fail(), lambda self, value: None)

    def fail(self) -> None:
        raise cl.RuntimeError("clGetDeviceInfo failed: INVALID_VALUE")


def paper_device(kind: type[PaperHandle] = PaperHandle, inline_device: Any = None, **properties: Any) -> Device:
    queue: Any = SimpleNamespace(context="a context")
    return Device(kind(**properties), "label", "pocl", queue=queue, inline_device=inline_device)


def test_properties_of_a_device() -> None:
    usual = paper_device()
    assert (usual.name, usual.driver, usual.compute_units, usual.context) == ("A device", "1.5", 6, "a context")
    assert (usual.has_double, usual.has_denormals, usual.is_cpu, usual.takes_vectors) == (False, False, True, True)
    assert repr(usual) == "Device(label: A device, driver 1.5)"
    assert paper_device(double_fp_config=63).has_double
    denorm = cl.device_fp_config.DENORM
    for config, expected in ((denorm, True), (denorm | 6, True), (6 & ~denorm, False)):
        assert paper_device(single_fp_config=config).has_denormals == expected
    assert usual.max_allocation == 1 << 30


@pytest.mark.parametrize(("cache", "expected"), [(0, 32 << 20), (33 << 20, 33 << 20), (31 << 20, 32 << 20)])
def test_the_last_cache_has_32_mib_at_least(cache: int, expected: int) -> None:
    assert paper_device(global_mem_cache_size=cache).cache_bytes == expected


def test_memory_is_shared_on_a_cpu_with_fine_grained_buffers() -> None:
    fine, coarse = (cl.device_svm_capabilities.FINE_GRAIN_BUFFER, cl.device_svm_capabilities.COARSE_GRAIN_BUFFER)
    for capabilities, expected in ((fine, True), (fine | coarse, True), (coarse, False), (0, False)):
        assert paper_device(svm_capabilities=capabilities).shares_memory == expected
        assert not paper_device(svm_capabilities=capabilities, type=cl.device_type.GPU).shares_memory
    assert not paper_device(OldHandle).shares_memory


@pytest.mark.parametrize("extension", ["", "cl_intel_exec_by_local_thread", "cl_intel_exec_by_local_thread_more"])
@pytest.mark.parametrize("has_inline_device", [False, True])
def test_inline_queues(extension: str, has_inline_device: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By PoCL's second device, or by an extension of Intel's runtime, whose calls of one group alone gain."""
    other: Any = "the inline device"
    device = paper_device(inline_device=other if has_inline_device else None, extensions=f"cl_khr_fp64 {extension}")
    monkeypatch.setattr(device, "_queue", lambda handle, properties: (handle, properties))
    is_intel = extension == "cl_intel_exec_by_local_thread"
    assert device.has_inline_queues == (has_inline_device or is_intel)
    like: Any = SimpleNamespace(properties=2)
    expected = (other, 2) if has_inline_device else (device.handle, 2 | 1 << 31) if is_intel else None
    for groups in (1, 2):
        assert device.call_gains_inline(groups=groups) == (groups == 1 or has_inline_device)
    assert device.inline_queue(like) == expected
    assert device.new_queue(inline=True) == (
        (device.handle, 0) if expected is None else (expected[0], expected[1] & ~2)
    )
    profiling = cl.command_queue_properties.PROFILING_ENABLE
    assert device.new_queue(profiling=True) == (device.handle, profiling)
    queue: Any = SimpleNamespace(device=other, get_info=lambda _: [cl.command_queue_info.PROPERTIES, 1 << 31, 0])
    plain: Any = SimpleNamespace(device=device.handle, get_info=lambda _: [cl.command_queue_info.PROPERTIES, 2, 0])
    assert device.is_inline(queue) == (is_intel or has_inline_device)
    assert not device.is_inline(plain)
