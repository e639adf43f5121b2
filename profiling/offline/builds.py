"""Builds of the kernels for GPUs: representative operations, and the source and macros of their launches."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from gpuvision.host import Device, Operation
from gpuvision.host.launch import Shape
from gpuvision.host.program import Define


class Example(NamedTuple):
    """Operation with a first input that stands for one build of its kernel.

    Attributes
    ----------
    name : str
        Name of the case, unique among the examples of a kernel file.
    operation : Operation
    shape : tuple of int
        Shape of the first input.
    dtype : dtype
        Dtype of the first input.
    has_double : bool
        Whether the GPU computes in double precision.
    """

    name: str
    operation: Operation[Any]
    shape: Shape
    dtype: DTypeLike = np.float32
    has_double: bool = True


@dataclass(frozen=True)
class KernelBuild:
    """Kernel file with macros, as the library builds it for a GPU.

    Attributes
    ----------
    name : str
        Name of the case.
    source : str
        Path of the ``.cl`` file relative to the kernel folder.
    defines : mapping of str to value
        Macros; ``None`` defines a macro without a value.
    group : int
        Work-items of a work-group; 0 where the runtime chooses the size.
    """

    name: str
    source: str
    defines: Mapping[str, Define]
    group: int = 0


class GpuModel(Device):
    """Properties of a GPU without a handle: enough to describe launches, not to run them.

    Parameters
    ----------
    has_double : bool
        Whether the GPU computes in double precision.
    """

    def __init__(self, *, has_double: bool = True) -> None:
        self.label, self.kind, self.name, self.driver = "gpu", "gpu", "model of a GPU", ""
        self.is_cpu = self.prefers_vectors = self.takes_vectors = self.shares_memory = False
        self.has_double, self.has_denormals = has_double, True
        self.has_fast_double = has_double  # there is no device whose rate could be measured
        # An H100 has 132 multiprocessors. The number sets the shares of work-items, not the code.
        self.compute_units = 132
        self.cache_bytes, self.max_allocation = 32 << 20, 16 << 30


def builds_of(examples: Iterable[Example]) -> list[KernelBuild]:
    """Return the builds of examples in their work-item variant, without duplicates of source and macros."""
    found: dict[Any, KernelBuild] = {}
    for example in examples:
        device = GpuModel(has_double=example.has_double)
        launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
        key = (launch.source, tuple(sorted((name, str(value)) for name, value in launch.defines.items())))
        group = math.prod(launch.local_size) if launch.local_size else 0
        found.setdefault(key, KernelBuild(example.name, launch.source, launch.defines, group))
    return list(found.values())
