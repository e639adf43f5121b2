"""Local memory and work-group size of a compiled kernel, compared with the limits of its device."""

from __future__ import annotations

import math
from typing import Any

import pyopencl as cl

from gpuvision.host.errors import DeviceLimitError
from gpuvision.host.launch import Launch
from gpuvision.host.work_size import Shape


def fit_work(kernel: Any, handle: Any, launch: Launch, *, name: str, label: str) -> tuple[Shape, Shape | None]:
    """Return the numbers of work-items of a launch, in all and per group, with which its kernel runs on a device.

    The number of work-items stays the same where groups are halved, and the number of groups where each group solves
    a problem (`Launch.problem_per_group`).

    Raises
    ------
    DeviceLimitError
        As in `fit_group`.
    """
    before = launch.local_size
    local_size = fit_group(kernel, handle, before, name=name, label=label, any_size=launch.problem_per_group)
    if before is None or local_size is None or not launch.problem_per_group:
        return launch.global_size, local_size
    groups = (total // each for total, each in zip(launch.global_size, before, strict=True))
    return tuple(count * each for count, each in zip(groups, local_size, strict=True)), local_size


def fit_group(
    kernel: Any, handle: Any, local_size: Shape | None, *, name: str, label: str, any_size: bool = False
) -> Shape | None:
    """Return the work-group size with which a kernel runs on a device.

    Groups are halved until the device has registers for them, in two cases. The work-items of a kernel without local
    memory do not depend on each other. A kernel with local memory may give the same results in groups of any size
    (`any_size`). Both take their group size from ``get_local_size``, not from an argument. Any other kernel with local
    memory is compiled for its group size.

    Parameters
    ----------
    kernel : pyopencl.Kernel
    handle : pyopencl.Device
    local_size : tuple of int or None
        Work-group size of the launch.
    name, label : str
        Names of the operation and of the device in messages.
    any_size : bool
        Whether the results of a kernel with local memory do not depend on the size of its groups. Default False.

    Raises
    ------
    DeviceLimitError
        The kernel needs more local memory or a larger group than the device has.
    """
    needed, largest = _needs_of(kernel, handle)
    available = int(handle.local_mem_size)
    if needed > available:
        raise DeviceLimitError(
            f"{name}: kernel {kernel.function_name} takes {needed} bytes of local memory, device {label} has "
            f"{available}; give fewer elements (rulers, lines, points), or choose another device"
        )
    if local_size is None or math.prod(local_size) <= largest:
        return local_size
    if needed and not any_size:
        raise DeviceLimitError(
            f"{name}: kernel {kernel.function_name} takes groups of {math.prod(local_size)}, device {label} runs "
            f"groups of up to {largest}; choose another device"
        )
    first, *others = local_size
    while first % 2 == 0 and first * math.prod(others) > largest:
        first //= 2
    return (first, *others)


def _needs_of(kernel: Any, handle: Any) -> tuple[int, int]:
    """Return the local memory of a kernel [bytes] and the largest group with which the device runs it."""
    info = cl.kernel_work_group_info
    local_bytes = int(kernel.get_work_group_info(info.LOCAL_MEM_SIZE, handle))
    largest = int(kernel.get_work_group_info(info.WORK_GROUP_SIZE, handle))
    # Measured on rusticl of Mesa 22.3: it reports twice the local memory, and for every kernel groups of up to 32 (the
    # width of a subgroup), while groups of 1024 run.
    if handle.platform.name == "rusticl" and handle.driver_version.startswith("22."):
        return local_bytes // 2, int(handle.max_work_group_size)
    return local_bytes, largest
