"""Coalescing of the memory requests of kernels, counted without a GPU.

Clang compiles a kernel to PTX for an NVIDIA GPU, and an interpreter runs work-groups of it (``warp.py``). A request is
the execution of one load or store by one warp. It moves whole sectors of 32 bytes. The coalescing factor is the number
of sectors that the requests touch, over the least number that could hold the requested bytes: 1 for work-items that
read adjacent numbers, 8 for work-items that read one number of 4 bytes from each sector. The caches of a GPU can lower
the traffic to memory below the touched sectors: the factor is an upper bound of the traffic, and it counts the work of
the load and store units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpuvision.host.cache import read_private, write_private
from gpuvision.host.launch import Launch
from gpuvision.host.operation import Operation
from gpuvision.host.program import options
from gpuvision.profiling.offline.builds import GpuModel
from gpuvision.profiling.offline.check import kernel_text
from gpuvision.profiling.offline.ptx import PtxKernel, parse_kernel
from gpuvision.profiling.offline.ptx_operations import Values
from gpuvision.profiling.offline.targets import TARGETS, cache_path, compile_assembly
from gpuvision.profiling.offline.warp import Group, Memory, Requests

_TARGET = TARGETS["sm_90"]
_Size = tuple[int, int, int]


@dataclass(frozen=True)
class Trace:
    """Memory requests of some work-groups, and the outputs.

    Attributes
    ----------
    requests : dict of (str, str) to Requests
        By array ("input 0", names of outputs, "table 0") and "load" or "store".
    outputs : dict of str to numpy.ndarray
        Outputs by name; elements that the groups did not write have bits of 1 (NaN in floating point).
    """

    requests: dict[tuple[str, str], Requests]
    outputs: dict[str, Values]

    @property
    def total(self) -> Requests:
        """Sum of the requests to all arrays."""
        return sum(self.requests.values(), Requests())

    def of(self, kind: str) -> Requests:
        """Return the sum of the requests of a kind, "load" or "store"."""
        return Trace({key: value for key, value in self.requests.items() if key[1] == kind}, {}).total


def trace(
    operation: Operation[Any],
    inputs: Sequence[Values],
    *,
    groups: Iterable[int] | None = None,
    group_size: int | None = None,
    offset: int = 0,
) -> Trace:
    """Run work-groups of an operation's work-item variant in the interpreter, and count their memory requests.

    Parameters
    ----------
    operation : Operation
    inputs : sequence of numpy.ndarray
        Inputs of the operation.
    groups : iterable of int, optional
        Numbers of the work-groups to run. Default: all.
    group_size : int, optional
        Work-items of a group along the first axis. Default: as the operation launches it. Another size is for kernels
        without local memory; a smaller one also for kernels whose groups solve a problem each, as in
        `gpuvision.host.limits.fit_group`.
    offset : int
        Elements between an aligned address and the first element of every input and output, default 0.

    Raises
    ------
    CompilerError
        The kernel does not compile.
    ValueError
        The kernel is compiled for another size than `group_size`.
    IndexError, ValueError
        The kernel reads or writes beyond an array of global or local memory, or at an address that is not aligned to
        the access, or not all work-items of a group reach a barrier.
    NotImplementedError
        The operation leaves the group size to the runtime, or the interpreter does not know an instruction.
    """
    launch = operation.launch(GpuModel(), inputs[0].shape, inputs[0].dtype)
    kernel = parse_kernel(_assembly(launch), launch.kernel)
    counts, size = _groups_of(launch, kernel, group_size)
    memory, outputs = Memory(), {}
    values: list[float] = [
        memory.add(f"input {number}", each.copy(), offset * each.itemsize) for number, each in enumerate(inputs)
    ]
    for name, spec in launch.outputs.items():
        if spec is not None:
            outputs[name] = np.full(math.prod(spec[0]) * spec[1].itemsize, 255, np.uint8).view(spec[1]).reshape(spec[0])
        values.append(0 if spec is None else memory.add(name, outputs[name], offset * spec[1].itemsize))
    for number, argument in enumerate(launch.arguments):
        if isinstance(argument, np.ndarray):
            values.append(memory.add(f"table {number}", np.ascontiguousarray(argument)))
        else:
            values.append(0 if argument is None else argument.item())
    x, y, z = counts
    for number in range(x * y * z) if groups is None else groups:
        place = (number % x, number // x % y, number // (x * y))
        Group(kernel, memory, values, group=place, groups=counts, size=size).run()
    return Trace(memory.requests, outputs)


def _groups_of(launch: Launch, kernel: PtxKernel, group_size: int | None) -> tuple[_Size, _Size]:
    """Return the numbers of work-groups and of the work-items of a group along three axes."""
    if launch.local_size is None:
        raise NotImplementedError(f"{launch.kernel} leaves the group size to the runtime")
    first, high, deep, *_ = (*launch.local_size, 1, 1)
    columns, rows, layers, *_ = (*launch.global_size, 1, 1)
    wide = first if group_size is None else group_size
    # PTX from OpenCL C does not state a required size, but arrays of local memory are as large as the group needs.
    is_smaller = launch.problem_per_group and wide < first
    if wide != first and kernel.shared and not is_smaller:
        raise ValueError(f"{launch.kernel} is compiled for groups of {first} work-items, group_size is {wide}")
    x = columns // first if launch.problem_per_group else -(-columns // wide)
    return (x, -(-rows // high), -(-layers // deep)), (wide, high, deep)


def _assembly(launch: Launch) -> str:
    """Return the PTX of a launch, from the cache folder where it was compiled before."""
    text, words = kernel_text(launch.source), options(launch.defines)
    path = cache_path(text, words, _TARGET, ".ptx")
    kept = read_private(path)
    if kept is not None:
        return kept
    assembly = compile_assembly(text, words, _TARGET)
    write_private(path, assembly)
    return assembly
