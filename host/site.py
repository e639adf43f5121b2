"""Kernel of a bound operation in one queue: its program, its work size, and its arguments."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpuvision.host.argument_table import SIZE_MACRO, ArgumentTable, have_addresses, table_layout
from gpuvision.host.arrays import DeviceArray, host_view, memory_of
from gpuvision.host.build_notice import building
from gpuvision.host.constant_memory import fitting_defines
from gpuvision.host.device import Device
from gpuvision.host.launch import Launch, Launchable
from gpuvision.host.limits import fit_work
from gpuvision.host.program import build, can_read_table


@dataclass(slots=True, eq=False)
class Site:
    """Queue and kernel of a bound operation, with the arrays that are set as the kernel's arguments.

    The arrays stay referenced, because a runtime may abort the process when a kernel uses a freed buffer.

    Attributes
    ----------
    queue : pyopencl.CommandQueue
    kernel : pyopencl.Kernel
    arguments : tuple
        Arguments of `pyopencl.enqueue_nd_range_kernel`: queue, kernel, global size, local size.
    given : tuple of arrays
        Arguments of the last launch.
    inline : bool
        Whether kernels run in the calling thread and are complete when enqueued.
    table : ArgumentTable or None
        Table from which the kernel reads its arguments; None: they are arguments of the kernel.
    """

    queue: Any
    kernel: Any
    arguments: tuple[Any, Any, tuple[int, ...], tuple[int, ...] | None]
    given: tuple[Any, ...]
    inline: bool
    table: ArgumentTable | None

    def set_array(self, place: int, array: Any) -> None:
        """Set an argument of the kernel: a memory object; for a table, an address."""
        if self.table is None:
            self.kernel.set_arg(place, array)
        else:
            self.table.addresses[place] = array


def can_use_table(device: Device, operation: Launchable, launch: Launch, arrays: Iterable[DeviceArray]) -> bool:
    """Return whether kernels in the calling thread read their arguments from a table, with these arrays at first."""
    is_cpu = device.shares_memory and device.has_inline_queues
    if operation.kernel_folder is None or not is_cpu or "VECTOR_VARIANT" not in launch.defines:
        return False
    folders = tuple(operation.include_folders)
    return can_read_table(operation.kernel_folder, launch.source, folders, launch.kernel) and have_addresses(arrays)


def upload_tables(device: Device, launch: Launch, *, shared: bool) -> list[Any]:
    """Return the NumPy arrays among the arguments of a launch in memory of the device.

    Parameters
    ----------
    device : Device
    launch : Launch
    shared : bool
        Whether the result has arrays in shared memory, whose addresses the host knows, and not OpenCL buffers.
    """
    tables = [each for each in launch.arguments if isinstance(each, np.ndarray)]
    if shared:
        arrays = [device.empty(each.shape, each.dtype) for each in tables]
        for array, table in zip(arrays, tables, strict=True):
            host_view(array)[...] = table
        return arrays
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    return [cl.Buffer(device.context, flags, hostbuf=np.ascontiguousarray(table)) for table in tables]


def new_site(
    device: Device, operation: Launchable, launch: Launch, queue: Any, tables: Sequence[Any], *, in_table: bool
) -> Site:
    """Build the kernel for the device of a queue and set the arguments that calls do not change.

    Parameters
    ----------
    device : Device
    operation : Launchable
    launch : Launch
    queue : pyopencl.CommandQueue
    tables : sequence
        As `upload_tables` returns them.
    in_table : bool
        Whether the kernel reads its arguments from a table: `can_use_table`.
    """
    arrays = len(launch.inputs) + len(launch.outputs)
    layout = table_layout(arrays, launch.arguments) if in_table else None
    kernel = _build(device, operation, launch, queue.device, layout)
    size = fit_work(kernel, queue.device, launch, name=type(operation).__name__, label=device.label)
    uploaded = iter(tables)
    others = [next(uploaded) if isinstance(value, np.ndarray) else value for value in launch.arguments]
    table = None if layout is None else ArgumentTable(device, layout, arrays, others)
    if table is not None:
        kernel.set_arg(0, table.memory)
    else:
        for place, spec in enumerate(launch.outputs.values(), len(launch.inputs)):
            if spec is None:
                kernel.set_arg(place, None)
        for place, value in enumerate(others, arrays):
            kernel.set_arg(place, memory_of(value) if isinstance(value, cl.array.Array) else value)
    computed = sum(spec is not None for spec in launch.outputs.values())
    nothing = (None,) * (len(launch.inputs) + computed)
    return Site(queue, kernel, (queue, kernel, *size), nothing, device.is_inline(queue), table)


def _build(device: Device, operation: Launchable, launch: Launch, handle: Any, layout: np.dtype[Any] | None) -> Any:
    """Return the kernel for a device; with a layout it reads its arguments from a table."""
    folder, name = operation.kernel_folder, type(operation).__name__
    if folder is None:
        raise ValueError(f"{name} has no kernel_folder; set it to the folder of its .cl files")
    with building(launch.source):
        defines = fitting_defines(launch, handle, folder, operation.include_folders)
        if layout is not None:
            defines[SIZE_MACRO] = layout.itemsize
        program = build(
            device,
            folder,
            launch.source,
            defines,
            include_folders=operation.include_folders,
            handle=handle,
            in_table=None if layout is None else launch.kernel,
        )
        return cl.Kernel(program, launch.kernel)
