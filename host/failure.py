"""Errors of a runtime at a launch, as exceptions of gpuvision; a device whose context is lost is opened again once."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import pyopencl as cl

from gpuvision.host.errors import DeviceLostError, DeviceMemoryError
from gpuvision.host.kept import drop_bound

# Mesa 22.3 refuses the size of an array that it cannot allocate.
_NO_MEMORY = ("MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE")
_NO_RESOURCES = "OUT_OF_RESOURCES"


class Reopenable(Protocol):
    """Part of a `Device` that a lost context concerns."""

    label: str

    @property
    def context(self) -> Any:
        """Context of the device."""

    def reopen(self, lost_context: Any) -> bool:
        """Replace a lost context; return whether the device has another one."""


def launch_failure(error: cl.Error, device: Reopenable, queue: Any, name: str) -> Exception:
    """Return the exception to raise for an error of the runtime at an allocation, a launch, or the wait for it.

    Where the context of the queue does not work any more, the kept bound instances are dropped, and the device is
    opened again, at the first loss only.

    Parameters
    ----------
    error : pyopencl.Error
    device : Device
    queue : pyopencl.CommandQueue
        Queue of the launch.
    name : str
        Operation or stream, for the message.

    Returns
    -------
    DeviceMemoryError
        The device has no memory or no registers left for the launch.
    DeviceLostError
        The context is lost.
    pyopencl.Error
        `error` itself, where the context works: a wrong call.
    """
    reason = str(error).splitlines()[0]
    if any(word in reason for word in _NO_MEMORY):
        return DeviceMemoryError(
            f"{name}: device {device.label} has no memory for the launch ({reason}); split the input, or free the "
            "arrays of earlier shapes with gpuvision.clear_cache()"
        )
    if queue.context != device.context:  # another thread has opened the device again
        return _lost(name, device, reason, reopened=True)
    if not responds(queue):
        drop_bound()
        return _lost(name, device, reason, reopened=device.reopen(queue.context))
    if _NO_RESOURCES in reason:
        return DeviceMemoryError(
            f"{name}: device {device.label} has no resources for the launch ({reason}): registers, local memory or "
            "device memory; split the input, or free the arrays of earlier shapes with gpuvision.clear_cache()"
        )
    return error


def responds(queue: Any) -> bool:
    """Return whether the context of a queue still runs a command."""
    try:
        fresh = cl.CommandQueue(queue.context, queue.device)
        memory = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, 4)
        cl.enqueue_fill_buffer(fresh, memory, np.zeros(1, np.uint32), 0, 4)
        fresh.finish()
    except cl.Error:
        return False
    return True


def _lost(name: str, device: Reopenable, reason: str, *, reopened: bool) -> DeviceLostError:
    remedy = (
        "the device was opened again: repeat the call with new arrays, and bind operations again"
        if reopened
        else "start the process again"
    )
    return DeviceLostError(
        f"{name}: the context of device {device.label} is lost ({reason}), and its arrays with it; {remedy}"
    )
