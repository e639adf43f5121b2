"""Constant tables of a kernel, compared with the constant memory of its device.

A device guarantees 64 KiB of constant memory only. Tables that take more are read from global memory: the kernel is
built with the address space ``constant`` defined as ``__global``. Constants in the text of a kernel file must be
declared ``__constant``, which the macro does not change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.host.debug import flatten_includes
from gpuvision.host.launch import Launch
from gpuvision.host.program import Define

# Macro of a build that reads its tables from global memory.
_IN_GLOBAL_MEMORY: Mapping[str, Define] = {"constant": "__global"}
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)


def fitting_defines(launch: Launch, handle: Any, folder: Path, include_folders: Sequence[Path]) -> dict[str, Define]:
    """Return the macros of a launch; where its constant tables exceed the device's constant memory, one macro more.

    Parameters
    ----------
    launch : Launch
    handle : pyopencl.Device
    folder : pathlib.Path
    include_folders : sequence of pathlib.Path
        Folders of the kernel sources, as `program.build` takes them.
    """
    available = int(handle.max_constant_buffer_size)
    if sum(each.nbytes for each in launch.arguments if isinstance(each, np.ndarray)) <= available:
        return dict(launch.defines)
    # Runtimes do not keep the address spaces of a cached binary (PoCL: CL_KERNEL_ARG_INFO_NOT_AVAILABLE).
    text = flatten_includes(folder, launch.source, include_folders)
    # The sum, not the largest: on NVIDIA's devices the limit of one table is the limit of all together.
    if sum(constant_sizes(text, launch.kernel, launch.arguments)) <= available:
        return dict(launch.defines)
    return {**launch.defines, **_IN_GLOBAL_MEMORY}


def constant_sizes(text: str, kernel: str, arguments: Sequence[Any]) -> list[int]:
    """Return the bytes of the tables that a kernel takes in constant memory.

    Parameters
    ----------
    text : str
        Source of the kernel, with its headers.
    kernel : str
        Name of the kernel function.
    arguments : sequence
        Last arguments of the kernel, as in `Launch`.

    Notes
    -----
    Where the text has several kernels of the name, as the two variants, a table counts if one of them declares it
    constant. Where a declaration does not match the arguments, as with a macro among the parameters, all tables count.
    """
    tables = [each.nbytes if isinstance(each, np.ndarray) else 0 for each in arguments]
    is_pointer = [each is None or isinstance(each, np.ndarray) for each in arguments]
    constant = [False] * len(tables)
    declared = list(_parameters(_COMMENT.sub("", text), kernel))
    for parameters in declared:
        last = parameters[len(parameters) - len(tables) :]
        if [("*" in each) for each in last] != is_pointer:
            return tables
        constant = [old or "constant" in each.split() for old, each in zip(constant, last, strict=True)]
    if not declared:
        return tables
    return [size for size, counts in zip(tables, constant, strict=True) if counts]


def _parameters(text: str, kernel: str) -> list[list[str]]:
    """Return the parameters of each kernel function of this name."""
    found = []
    for start in re.finditer(rf"\bkernel\s+(?:\w+\s+)?void\s+{re.escape(kernel)}\s*\(", text):
        depth, end = 1, start.end()
        while depth and end < len(text):
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        found.append(text[start.end() : end - 1].split(","))
    return found
