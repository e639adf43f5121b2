"""OpenCL devices: selection of the best device, by name, or from a handle that the caller owns."""

from __future__ import annotations

import copy
import functools
import math
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
from gpuvision.host.double_rate import SLOW_RATIO, double_ratio
from gpuvision.host.errors import DeviceLimitError, DeviceMemoryError, DeviceUnusableError, NoDeviceError
from gpuvision.host.events import COMPLETE
from gpuvision.host.failure import launch_failure
from gpuvision.host.huge_pages import advise_huge_pages
from gpuvision.host.kept import clear_with
from gpuvision.host.process import check_process
from gpuvision.host.runtime import usable_cores
from gpuvision.host.team import TeamSlot, allows_teams
from gpuvision.host.text import printable, size_in_words
from gpuvision.host.trace import active_trace

VARIABLE = "GPUVISION_DEVICE"
# Time for which `Device.wait` polls an event before it sleeps: longer than a small frame takes to compute, so that only
# long kernels pay the delay of waking the calling thread.
_POLLING_NS = 200_000
_LOCAL_THREAD = "cl_intel_exec_by_local_thread"
_LOCAL_THREAD_QUEUE = 1 << 31  # CL_QUEUE_THREAD_LOCAL_EXEC_ENABLE_INTEL
# Lower bound of the last-level cache: Intel's runtime reports the second level only. 32 MiB is a common third level of
# servers. On a processor with less, kernels only begin later to write past the caches.
_MIN_LAST_CACHE = 32 << 20
# Kinds of runtimes whose compilers map vectors of 16 to the registers of a CPU. Mesa's rusticl calls its CPU device a
# CPU too, and ends the process in such kernels ("LLVM ERROR: Unsupported vector type with 64 elements!", Mesa 22.3).
_VECTOR_RUNTIMES = ("pocl", "intel")
_WITHOUT_VECTORS = ("rusticl",)


class _Connection:
    """Context and default queue of a device, shared by its copies (`Device.without_vectors`)."""

    def __init__(self, context: Any, queue: Any, *, may_reopen: bool) -> None:
        self.context, self.queue = context, queue
        self.team_slot = TeamSlot()
        self.may_reopen = may_reopen


class Device:
    """OpenCL device with its context and a default queue.

    Get a device from `best`, `named`, `all` or `of`. Two calls for the same device return the same object.

    Attributes
    ----------
    handle : pyopencl.Device
    context : pyopencl.Context
    queue : pyopencl.CommandQueue
        In-order queue on which operations run unless another queue is given.
    label, kind, name, driver : str
        Short unique name, vendor (``pocl``, ``intel``, ``nvidia``, ...), full name, driver version.
    is_cpu : bool
        Whether the device is a CPU.
    prefers_vectors : bool
        Whether kernels run their vector variant by default: on the CPU devices of PoCL and Intel's runtime. Other
        runtimes run one work-item per element: some of them abort the process on vectors of 16, or spill them.
    takes_vectors : bool
        Whether kernels run their vector variant on request: not on Mesa's rusticl, whose compiler ends the process.
    shares_memory : bool
        Whether host and device read and write the same allocations without map or copy (fine-grained SVM).
    compute_units : int
        Cores of a CPU, multiprocessors of a GPU.
    has_double, has_denormals : bool
        Whether the device computes in double precision, and with denormal numbers in single precision.
    max_allocation : int
        Size of the largest array [bytes].
    cache_bytes : int
        Size of the last-level cache, at least 32 MiB [bytes].
    inline_device : pyopencl.Device or None
        PoCL's second device in the same context, which runs a kernel in the thread that enqueues it. A small kernel
        ends there before the worker threads of the first device wake up. Operations use it automatically.
    """

    def __init__(self, handle: Any, label: str, kind: str, *, queue: Any = None, inline_device: Any = None) -> None:
        self.handle = handle
        self.label, self.kind = label, kind
        self.name, self.driver = printable(handle.name).strip(), printable(handle.driver_version)
        # The context is kept for the queue, too: Intel's runtime frees a context while a queue of it exists.
        self.inline_device = inline_device
        context = queue.context if queue is not None else self._new_context()
        own_queue = queue if queue is not None else self._new_queue(context, handle)
        self._connection = _Connection(context, own_queue, may_reopen=queue is None)
        self.is_cpu = bool(handle.type & cl.device_type.CPU)
        self.prefers_vectors = self.is_cpu and kind in _VECTOR_RUNTIMES
        self.takes_vectors = kind not in _WITHOUT_VECTORS
        self.compute_units = int(handle.max_compute_units)
        self.has_double = bool(handle.double_fp_config)
        self.has_denormals = bool(handle.single_fp_config & cl.device_fp_config.DENORM)
        self.max_allocation = int(handle.max_mem_alloc_size)
        self.cache_bytes = max(int(handle.global_mem_cache_size), _MIN_LAST_CACHE)
        self.shares_memory = self.is_cpu and _has_fine_grained_memory(handle)

    @functools.cached_property
    def has_fast_double(self) -> bool:
        """Whether doubles are worth their time inside single-precision work.

        Not on a device without doubles, nor on a GPU with doubles at 1/32 of the float rate or less. The first access
        on a GPU measures the rate, once for each driver; see ``gpuvision.host.double_rate``.
        """
        return double_ratio(self.handle) < SLOW_RATIO

    def _new_context(self) -> Any:
        return cl.Context([self.handle] if self.inline_device is None else [self.handle, self.inline_device])

    @staticmethod
    def _new_queue(context: Any, handle: Any) -> Any:
        """Return a default queue; while a trace is active its events carry device times."""
        properties: Any = cl.command_queue_properties.PROFILING_ENABLE if active_trace() is not None else 0
        return cl.CommandQueue(context, handle, properties=properties)

    @property
    def context(self) -> Any:
        """Context of the device; `reopen` replaces it."""
        return self._connection.context

    @property
    def queue(self) -> Any:
        """Default queue of the device; `reopen` replaces it."""
        return self._connection.queue

    def reopen(self, lost_context: Any) -> bool:
        """Replace a lost context and its queue by new ones, once in the life of the object and its copies.

        Parameters
        ----------
        lost_context : pyopencl.Context
            Context that does not work any more.

        Returns
        -------
        bool
            Whether the device has another context than the lost one, from this call or from another thread. False
            where the caller owns the queue (`of`), where the device was opened again before, and where the driver
            gives no new context.
        """
        connection = self._connection
        with _opening:
            if connection.context != lost_context:
                return True
            if not connection.may_reopen:
                return False
            connection.may_reopen = False
            try:
                context = self._new_context()
                connection.queue, connection.context = self._new_queue(context, self.handle), context
            except cl.Error:
                return False
            return True

    def __repr__(self) -> str:
        return f"Device({self.label}: {self.name}, driver {self.driver})"

    @staticmethod
    def all() -> tuple[Device, ...]:
        """Return all healthy devices, best first; see `best` for the order."""
        healthy = [each for each in discovery.probed_devices() if each.healthy]
        return tuple(_open(each) for each in sorted(healthy, key=lambda each: each.rank))

    @staticmethod
    def best() -> Device:
        """Return the default device.

        The environment variable ``GPUVISION_DEVICE`` names it. Without the variable: a healthy GPU, else PoCL, else
        Intel's CPU runtime, else any other healthy device.

        Returns
        -------
        Device

        Raises
        ------
        NoDeviceError
            There is no healthy device; the message names packages to install.
        """
        requested = requested_device()
        if requested:
            return Device.named(requested)
        healthy = Device.all()
        if not healthy:
            listed = discovery.probed_devices()
            reasons = "; ".join(f"{each.label}: {each.reason}" for each in listed) or "no OpenCL platform"
            raise NoDeviceError(f"no healthy OpenCL device ({reasons}); {discovery.INSTALL_HINT}")
        return healthy[0]

    @staticmethod
    def named(name: str) -> Device:
        """Return the healthy device with this label, or with `name` in its label, name or platform.

        Parameters
        ----------
        name : str
            Label or part of a name, in any case.

        Returns
        -------
        Device

        Raises
        ------
        NoDeviceError
            No device or more than one healthy device matches the name.
        DeviceUnusableError
            The device exists, and its probe failed.
        """
        listed = discovery.probed_devices()
        requested = name.strip().lower()
        matching = [each for each in listed if each.label == requested] or [
            each for each in listed if requested and requested in f"{each.label} {each.name} {each.platform}".lower()
        ]
        healthy = [each for each in matching if each.healthy]
        if len(healthy) == 1:
            return _open(healthy[0])
        if len(healthy) > 1:
            labels = ", ".join(each.label for each in healthy)
            raise NoDeviceError(f"{len(healthy)} devices match {name!r}: {labels}; ask for one of these")
        if matching:
            broken = matching[0]
            raise DeviceUnusableError(f"device {broken.label} does not work: {broken.reason}; {broken.advice}")
        choice = f"choose one of {', '.join(each.label for each in listed)}, or " if listed else ""
        raise NoDeviceError(f"no device matches {name!r}; {choice}{discovery.INSTALL_HINT}")

    @staticmethod
    def of(handle: Any) -> Device:
        """Return the device of a queue, context or device array that the caller owns.

        Parameters
        ----------
        handle : pyopencl.CommandQueue, pyopencl.Context or pyopencl.array.Array

        Returns
        -------
        Device
            Its default queue is the queue of the handle. The device is not probed.

        Raises
        ------
        TypeError
            `handle` has another type.
        ValueError
            The queue executes out of order.
        """
        check_process()
        if isinstance(handle, cl.array.Array):
            handle = handle.queue if handle.queue is not None else handle.context
        if isinstance(handle, cl.Context):
            handle = _default_queue(handle)
        if not isinstance(handle, cl.CommandQueue):
            kind = type(handle).__name__
            raise TypeError(f"expected a pyopencl queue, context or array to take the device from, got {kind}")
        _check_order(handle)
        return _adopt(handle)

    def check_queue(self, queue: Any) -> None:
        """Check that operations on this device can run in a queue.

        Raises
        ------
        TypeError
            The object is no queue.
        ValueError
            The queue belongs to another context or device, or it runs out of order.
        """
        if not isinstance(queue, cl.CommandQueue):
            raise TypeError(f"expected a pyopencl queue, got {type(queue).__name__}; Device.new_queue makes one")
        if queue.context != self.context or queue.device not in (self.handle, self.inline_device):
            raise ValueError(
                f"the queue belongs to another context than device {self.label}; use a queue of device.new_queue(), or "
                "the device Device.of(queue)"
            )
        _check_order(queue)

    @property
    def team_slot(self) -> TeamSlot:
        """Slot for the team of workers that wait for a launch; see `gpuvision.host.team`."""
        return self._connection.team_slot

    @property
    def has_teams(self) -> bool:
        """Whether the calling thread and waiting workers can share a launch, and each of them has a core."""
        has_cores = 1 < self.compute_units <= usable_cores()
        return has_cores and self.shares_memory and self.has_inline_queues and allows_teams()

    @property
    def pins_workers(self) -> bool:
        """Whether each worker thread stays on its core (``POCL_AFFINITY``, set by `gpuvision.host.runtime`)."""
        return self.kind == "pocl" and os.environ.get("POCL_AFFINITY") == "1"

    def without_vectors(self) -> Device:
        """Return this device, with its context and queue, for kernels in one work-item per element."""
        scalar = copy.copy(self)
        scalar.prefers_vectors = False
        return scalar

    def wait(self, event: Any) -> None:
        """Wait for an event with the least delay.

        Parameters
        ----------
        event : pyopencl.Event

        Notes
        -----
        ``event.wait`` of PoCL puts the calling thread to sleep at once, and waking takes longer than computing a small
        frame. This method polls the event for 200 us first. Other runtimes poll by themselves.
        """
        if self.kind == "pocl":
            end = time.perf_counter_ns() + _POLLING_NS
            while event.command_execution_status > COMPLETE and time.perf_counter_ns() < end:
                os.sched_yield()  # a worker thread of the runtime may be waiting for this core
        event.wait()

    def new_queue(self, *, profiling: bool = False, inline: bool = False) -> Any:
        """Return a new in-order queue of the device.

        Parameters
        ----------
        profiling : bool
            Whether events carry device times; while a `Trace` is active they always do. Default False.
        inline : bool
            Whether kernels run in the thread that enqueues them and are complete when the call returns. Useful for
            chains of kernels of a few microseconds each. Runtimes without inline queues (all but PoCL 3 and Intel's
            CPU runtime) return an ordinary queue. Default False.

        Returns
        -------
        pyopencl.CommandQueue
        """
        measures = profiling or active_trace() is not None
        properties = cl.command_queue_properties.PROFILING_ENABLE if measures else 0
        return (self._new_inline_queue(properties) if inline else None) or self._queue(self.handle, properties)

    def inline_queue(self, like: Any) -> Any:
        """Return an inline queue with the properties of a queue, or None where the runtime has no inline queues."""
        return self._new_inline_queue(like.properties)

    def call_gains_inline(self, *, groups: int) -> bool:
        """Return whether a short kernel of some work-groups is better run inline where the caller does not wait for it.

        Intel's runtime, whose workers wake faster than PoCL's, gains with one work-group only.
        """
        return groups == 1 or self.inline_device is not None

    def is_inline(self, queue: Any) -> bool:
        """Return whether kernels of this queue run in the thread that enqueues them."""
        if _LOCAL_THREAD not in self.handle.extensions.split():
            return bool(queue.device == self.inline_device)
        return _LOCAL_THREAD_QUEUE in queue.get_info(cl.command_queue_info.PROPERTIES_ARRAY)

    @property
    def has_inline_queues(self) -> bool:
        """Whether `new_queue` makes queues whose kernels run in the thread that enqueues them."""
        return self.inline_device is not None or _LOCAL_THREAD in self.handle.extensions.split()

    def _new_inline_queue(self, properties: Any) -> Any:
        if self.inline_device is not None:
            return self._queue(self.inline_device, properties)
        if _LOCAL_THREAD in self.handle.extensions.split():
            return self._queue(self.handle, properties | _LOCAL_THREAD_QUEUE)
        return None

    def _queue(self, handle: Any, properties: Any) -> Any:
        return cl.CommandQueue(self.context, handle, properties=properties)

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike, queue: Any = None) -> DeviceArray:
        """Return an uninitialised device array.

        Parameters
        ----------
        shape : tuple of int
        dtype : dtype
        queue : pyopencl.CommandQueue, optional
            Queue of the array; the device's default queue otherwise.

        Returns
        -------
        pyopencl.array.Array
            Where `shares_memory`, `host_view` shows it to NumPy.

        Raises
        ------
        DeviceLimitError
            The array is larger than the device allocates at once.
        DeviceMemoryError
            The memory of the device is full.
        DeviceLostError
            The context is lost.
        """
        queue = self.queue if queue is None else queue
        dtype = np.dtype(dtype)
        # OpenCL refuses allocations of zero bytes; an empty batch needs one byte.
        size = max(math.prod(shape) * dtype.itemsize, 1)
        if size > self.max_allocation:
            raise DeviceLimitError(
                f"an array of shape {tuple(shape)} and dtype {dtype} takes {size_in_words(size)}, device {self.label} "
                f"allocates at most {size_in_words(self.max_allocation)} at once; split the input"
            )
        memory: Any
        try:
            if self.shares_memory:
                memory = cl.SVMAllocation(self.context, size, 0, SHARED_FLAGS, queue)
                advise_huge_pages(memory.svm_ptr, size)
            else:
                memory = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, size)
        except cl.Error as error:
            failure = launch_failure(error, self, queue, f"array of shape {tuple(shape)}")
            if failure is error:
                raise
            if not isinstance(failure, DeviceMemoryError):
                raise failure from error
            raise DeviceMemoryError(
                f"device {self.label} cannot allocate {size_in_words(size)} for an array of shape {tuple(shape)} "
                f"({str(error).splitlines()[0]}); split the input, or free the arrays of earlier shapes with "
                "gpuvision.clear_cache()"
            ) from error
        return cl.array.Array(queue, shape, dtype, data=memory)


def requested_device() -> str | None:
    """Return the device that the environment variable ``GPUVISION_DEVICE`` names; ``None`` without the variable."""
    return os.environ.get(VARIABLE)


def _check_order(queue: Any) -> None:
    if queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
        raise ValueError("the queue runs out of order; operations follow each other, expected an in-order queue")


def _has_fine_grained_memory(handle: Any) -> bool:
    try:
        return bool(handle.svm_capabilities & cl.device_svm_capabilities.FINE_GRAIN_BUFFER)
    except cl.Error:  # OpenCL 1.x has no such query
        return False


# One context per device, because kernels cannot mix arrays of two contexts. The lock serialises opening.
_opened: dict[str, Device] = {}
_opening = threading.Lock()


def _open(listed: discovery.ListedDevice) -> Device:
    with _opening:
        if listed.label not in _opened:
            _opened[listed.label] = Device(listed.handle, listed.label, listed.kind, inline_device=listed.inline_device)
        return _opened[listed.label]


@functools.lru_cache(maxsize=32)
def _default_queue(context: Any) -> Any:
    return cl.CommandQueue(context)


@functools.lru_cache(maxsize=32)
def _adopt(queue: Any) -> Device:
    """Return the device of a queue that the caller owns, without probing it or opening other devices."""
    for each in _opened.values():
        if each.queue == queue:
            return each
    for listed in discovery.listed_devices():
        if listed.handle == queue.device:
            return Device(queue.device, listed.label, listed.kind, queue=queue)
    kind = discovery.kind_of(queue.device)
    return Device(queue.device, kind, kind, queue=queue)


clear_with(_adopt.cache_clear)
clear_with(_default_queue.cache_clear)
