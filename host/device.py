"""A device that works: chosen, named, or taken over from the caller."""

from __future__ import annotations

import functools
import os
import threading
import time
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import DTypeLike

from gpuvision.host import discovery
from gpuvision.host.arrays import SHARED_FLAGS, DeviceArray
from gpuvision.host.errors import DeviceUnusableError, NoDeviceError

VARIABLE = "GPUVISION_DEVICE"
_COMPLETE = cl.command_execution_status.COMPLETE
_WATCHED_NS = 200_000
_LOCAL_THREAD = "cl_intel_exec_by_local_thread"
_LOCAL_THREAD_QUEUE = 1 << 31  # CL_QUEUE_THREAD_LOCAL_EXEC_ENABLE_INTEL
_LEAST_LAST_CACHE = 32 << 20  # Intel's runtime tells of the second level only


class Device:
    """An OpenCL device with its context and a default queue.

    Get one from `best`, `named`, `all` or `of`; two calls for one device return one object.

    Attributes
    ----------
    handle : pyopencl.Device
    context : pyopencl.Context
    queue : pyopencl.CommandQueue
        The in-order queue on which operations run unless they are given another.
    label, kind, name, driver : str
        Short unique name, maker (``pocl``, ``intel``, ``nvidia``, ...), full name, driver version.
    is_cpu : bool
        Whether kernels should walk strips with wide vectors (CPU runtimes) or run one item per sample.
    shares_memory : bool
        Whether host and device read and write the same allocations with no map or copy (fine-grained SVM).
    compute_units : int
        Cores of a CPU, multiprocessors of a GPU.
    has_double : bool
        Whether `precision="double"` works here.
    cache_bytes : int
        Size of the last cache; more than that comes from memory and goes there.
    inline_device : pyopencl.Device or None
        PoCL's other device, in the same context: it runs a kernel in the thread that enqueues it, which is done before
        the first one's workers have woken up where there is little to do. Operations go there by themselves.
    """

    def __init__(self, handle: Any, label: str, kind: str, *, queue: Any = None, inline_device: Any = None) -> None:
        self.handle = handle
        self.label, self.kind = label, kind
        self.name, self.driver = handle.name.strip(), handle.driver_version
        # Held for the queue's sake too: Intel's runtime lets a context go while a queue of it lives.
        own = [handle] if inline_device is None else [handle, inline_device]
        self.context = queue.context if queue is not None else cl.Context(own)
        self.inline_device = inline_device
        self.queue = queue if queue is not None else cl.CommandQueue(self.context, handle)
        self.is_cpu = bool(handle.type & cl.device_type.CPU)
        self.compute_units = int(handle.max_compute_units)
        self.has_double = bool(handle.double_fp_config)
        self.cache_bytes = max(int(handle.global_mem_cache_size), _LEAST_LAST_CACHE)
        self.shares_memory = self.is_cpu and _has_fine_grained_memory(handle)

    def __repr__(self) -> str:
        return f"Device({self.label}: {self.name}, driver {self.driver})"

    @staticmethod
    def all() -> tuple[Device, ...]:
        """Return every healthy device, the best first."""
        healthy = [each for each in discovery.candidates() if each.healthy]
        return tuple(_open(each) for each in sorted(healthy, key=lambda each: each.rank))

    @staticmethod
    def best() -> Device:
        """Return the device to use when nobody asked for one.

        The variable ``GPUVISION_DEVICE`` names it; else a healthy GPU, else PoCL, else Intel's CPU runtime,
        else any other.

        Raises
        ------
        NoDeviceError
            Nothing healthy is there; the message says what to install.
        """
        asked = os.environ.get(VARIABLE)
        if asked:
            return Device.named(asked)
        healthy = Device.all()
        if not healthy:
            listed = discovery.candidates()
            seen = "; ".join(f"{each.label}: {each.reason}" for each in listed) or "no OpenCL platform"
            raise NoDeviceError(f"no healthy OpenCL device ({seen}); {discovery.INSTALL_HINT}")
        return healthy[0]

    @staticmethod
    def named(name: str) -> Device:
        """Return the one healthy device of that label, or with `name` in its label, name or platform.

        Raises
        ------
        NoDeviceError
            No device, or more than one healthy device, answers to the name. Never another device instead.
        DeviceUnusableError
            The device is there and its probe failed.
        """
        listed = discovery.candidates()
        asked = name.strip().lower()
        matching = [each for each in listed if each.label == asked] or [
            each for each in listed if asked and asked in f"{each.label} {each.name} {each.platform}".lower()
        ]
        healthy = [each for each in matching if each.healthy]
        if len(healthy) == 1:
            return _open(healthy[0])
        if len(healthy) > 1:
            labels = ", ".join(each.label for each in healthy)
            raise NoDeviceError(f"{len(healthy)} devices answer to {name!r}: {labels}; ask for one of these")
        if matching:
            broken = matching[0]
            raise DeviceUnusableError(f"device {broken.label} does not work: {broken.reason}; {broken.advice}")
        labels = ", ".join(each.label for each in listed) or "none"
        raise NoDeviceError(f"no device answers to {name!r}; there are: {labels}; {discovery.INSTALL_HINT}")

    @staticmethod
    def of(handle: Any) -> Device:
        """Return the device behind a queue, context, or device array that the caller already owns.

        Parameters
        ----------
        handle : pyopencl.CommandQueue, pyopencl.Context or pyopencl.array.Array

        Raises
        ------
        TypeError
            `handle` is none of these.
        ValueError
            The queue runs out of order.
        """
        if isinstance(handle, cl.array.Array):
            handle = handle.queue if handle.queue is not None else handle.context
        if isinstance(handle, cl.Context):
            handle = _default_queue(handle)
        if not isinstance(handle, cl.CommandQueue):
            kind = type(handle).__name__
            raise TypeError(f"expected a pyopencl queue, context or array to take the device from, got {kind}")
        if handle.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
            raise ValueError("the queue runs out of order; operations follow each other, expected an in-order queue")
        return _adopt(handle)

    def wait(self, event: Any) -> None:
        """Wait for an event with the least delay; `event.wait` leaves the processor to others at once.

        PoCL puts the caller to sleep, and an idle processor takes longer to wake than a frame takes to compute: so
        watch the event for a moment first. The other runtimes do so by themselves.
        """
        if self.kind == "pocl":
            end = time.perf_counter_ns() + _WATCHED_NS
            while event.command_execution_status > _COMPLETE and time.perf_counter_ns() < end:
                os.sched_yield()  # to a worker of the runtime that waits for this processor
        event.wait()

    def new_queue(self, *, profiling: bool = False, inline_device: bool = False) -> Any:
        """Return another in-order queue; with `profiling`, its events carry device times.

        With `inline_device`, what is enqueued runs in the thread that enqueues it and is done when that returns: for
        chains of work of a few microseconds each. Where the runtime has no such queue it is one as any other.
        """
        properties = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
        return (self._new_inline_queue(properties) if inline_device else None) or self._queue(self.handle, properties)

    def inline_queue(self, like: Any, *, groups: int) -> Any:
        """Return a queue like another, whose kernels run in the thread that enqueues them; None where there is none.

        Intel's runtime, whose workers are awake sooner than PoCL's, gets one for work of a single group: there is
        nothing to share with a worker.
        """
        worthwhile = groups == 1 or self.inline_device is not None
        return self._new_inline_queue(like.properties) if worthwhile else None

    def is_inline(self, queue: Any) -> bool:
        """Tell whether what is enqueued in a queue of this device is done when that returns."""
        if _LOCAL_THREAD not in self.handle.extensions.split():
            return bool(queue.device == self.inline_device)
        return _LOCAL_THREAD_QUEUE in queue.get_info(cl.command_queue_info.PROPERTIES_ARRAY)

    def _new_inline_queue(self, properties: Any) -> Any:
        if self.inline_device is not None:
            return self._queue(self.inline_device, properties)
        if _LOCAL_THREAD in self.handle.extensions.split():
            return self._queue(self.handle, properties | _LOCAL_THREAD_QUEUE)
        return None

    def _queue(self, handle: Any, properties: Any) -> Any:
        return cl.CommandQueue(self.context, handle, properties=properties)

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, queue: Any = None) -> DeviceArray:
        """Return an uninitialised device array; on shared memory `arrays.host_view` shows it to NumPy."""
        queue = self.queue if queue is None else queue
        dtype = np.dtype(dtype)
        if not self.shares_memory:
            return cl.array.Array(queue, shape, dtype)
        # An allocation of no bytes is an error in OpenCL, and a batch of no frames is none here.
        size = max(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize, 1)
        memory = cl.SVMAllocation(self.context, size, 0, SHARED_FLAGS, queue)
        return cl.array.Array(queue, shape, dtype, data=memory)


def _has_fine_grained_memory(handle: Any) -> bool:
    try:
        return bool(handle.svm_capabilities & cl.device_svm_capabilities.FINE_GRAIN_BUFFER)
    except cl.Error:  # OpenCL 1.x does not know the question
        return False


# One device, one context: arrays of two contexts do not meet. The lock keeps two threads from opening it twice.
_opened: dict[str, Device] = {}
_opening = threading.Lock()


def _open(listed: discovery.Listed) -> Device:
    with _opening:
        if listed.label not in _opened:
            _opened[listed.label] = Device(listed.handle, listed.label, listed.kind, inline_device=listed.inline_device)
        return _opened[listed.label]


@functools.lru_cache(maxsize=32)
def _default_queue(context: Any) -> Any:
    return cl.CommandQueue(context)


@functools.lru_cache(maxsize=32)
def _adopt(queue: Any) -> Device:
    """Give the caller's own queue a device: nothing is probed, and no other device is opened."""
    for each in _opened.values():
        if each.queue == queue:
            return each
    for listed in discovery.listing():
        if listed.handle == queue.device:
            return Device(queue.device, listed.label, listed.kind, queue=queue)
    kind = discovery.kind_of(queue.device)
    return Device(queue.device, kind, kind, queue=queue)
