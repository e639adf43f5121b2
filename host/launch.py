"""Description of a kernel launch: source, macros, arrays, arguments and work size for inputs of one shape."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.host.device import Device
from gpuvision.host.program import Define

Precision = Literal["single", "double"] | None
Variant = Literal["auto", "vector", "work_item"]
Shape = tuple[int, ...]
Spec = tuple[Shape, np.dtype[Any]]

# Most elements of an array and most work-items of a launch: kernels count with int.
MAX_COUNT = (1 << 31) - 1


@dataclass(frozen=True)
class Launch:
    """Kernel launch for one shape on one device; the kernel takes inputs, outputs and arguments in this order.

    Attributes
    ----------
    source : str
        Path of the ``.cl`` file relative to the operation's `kernel_folder`.
    kernel : str
        Name of the kernel function in the file.
    inputs : sequence of (shape, dtype)
    outputs : mapping of str to (shape, dtype) or None
        By the names of the result's fields, in the kernel's order. ``None``: the kernel gets a null pointer for this
        argument, and the field stays ``None``.
    global_size, local_size : tuple of int, optional
        Work-items in all and per work-group. ``local_size=None`` leaves the choice to the runtime.
    defines : mapping
        Macros that change the code.
    arguments : sequence
        NumPy scalars, passed by value; NumPy arrays, uploaded once (tables, parameters); ``None``: a null pointer for
        a table that this build does not read.
    passes_once : bool
        Whether the kernel does little more than read and write its memory once, or is known to take as short for
        another reason. Small launches of such kernels run in the calling thread, because waking a worker thread takes
        longer than the work. Default False.
    streams : bool
        Whether the time of the kernel follows from the bytes that it moves: it computes little for each of them. Then
        large launches write past the caches, and short ones of several work-groups run in the calling thread on a
        runtime that gains by it, if the caller waits. Default False.
    problem_per_group : bool
        Whether each work-group of the work-item variant solves one problem, with results that do not depend on the
        size of the group. A device without registers for the groups then runs the same number of smaller groups.
        Default False.
    inline : bool or None
        Whether a launch that `passes_once` and is small runs in the calling thread. ``None``: where the runtime is
        known to gain. Default None.
    by_team : bool
        Whether the kernel takes its work-items as ``kernels/common/team.h`` says, so that the calling thread and
        waiting workers can share a launch. Default False.
    """

    source: str
    kernel: str
    inputs: Sequence[Spec]
    outputs: Mapping[str, Spec | None]
    global_size: Shape
    local_size: Shape | None = None
    defines: Mapping[str, Define] = field(default_factory=dict)
    arguments: Sequence[Any] = ()
    passes_once: bool = False
    streams: bool = False
    problem_per_group: bool = False
    inline: bool | None = None
    by_team: bool = False

    @property
    def groups(self) -> int:
        """Number of work-groups; the number of work-items where the runtime chooses the group size."""
        return math.prod(self.global_size) // math.prod(self.local_size or (1,))

    @property
    def nbytes(self) -> int:
        """Bytes of inputs and outputs."""
        return nbytes_of((*self.inputs, *self.outputs.values()))


def describe_launch(operation: Launchable, device: Device, shape: Shape, dtype: np.dtype[Any]) -> Launch:
    """Return the launch of an operation; check that its kernel can count in 32-bit integers.

    Raises
    ------
    TypeError, ValueError
        The operation does not take such input, or a count is beyond `MAX_COUNT`.
    """
    name = type(operation).__name__
    check_shape(name, shape)
    try:
        launch = operation.launch(device, shape, dtype)
    except OverflowError as error:  # of a NumPy integer among the arguments
        raise ValueError(
            f"{name}: input of shape {shape} takes counts beyond the 32 bits of a kernel argument; split the input"
        ) from error
    check_counts(name, launch)
    return launch


def check_shape(name: str, shape: Shape) -> None:
    """Check that a kernel can count the elements of an array, and each of its axes, in 32-bit integers.

    Raises
    ------
    ValueError
        The array has more than `MAX_COUNT` elements, or an axis is longer.
    """
    if max(math.prod(shape), *shape, 0) > MAX_COUNT:
        raise ValueError(
            f"{name}: an array of shape {tuple(shape)} has more than {MAX_COUNT} elements, which kernels count in 32 "
            "bits; split the input"
        )


def check_counts(name: str, launch: Launch) -> None:
    """Check that a kernel can count the elements of its arrays and its work-items in 32-bit integers.

    Raises
    ------
    ValueError
        An array has more than `MAX_COUNT` elements, or the launch more work-items.
    """
    for spec in (*launch.inputs, *launch.outputs.values()):
        if spec is not None:
            check_shape(name, spec[0])
    items = math.prod(launch.global_size)
    if items > MAX_COUNT:
        raise ValueError(
            f"{name}: input of shape {tuple(launch.inputs[0][0])} takes {items} work-items, more than {MAX_COUNT}, "
            "which kernels count in 32 bits; split the input"
        )


@dataclass(frozen=True)
class Specs:
    """Inputs and outputs of an operation for a first input of one shape, and its memory.

    Attributes
    ----------
    inputs : sequence of (shape, dtype)
    outputs : mapping of str to (shape, dtype) or None
        By the names of the result's fields; ``None``: not computed.
    nbytes : int
        Bytes of all arrays.
    """

    inputs: Sequence[Spec]
    outputs: Mapping[str, Spec | None]
    nbytes: int


def nbytes_of(specs: Iterable[Spec | None]) -> int:
    """Return the bytes of arrays of these shapes and dtypes; ``None`` counts as 0 bytes."""
    return sum(math.prod(spec[0]) * spec[1].itemsize for spec in specs if spec is not None)


def real_of(precision: Precision, dtype: np.dtype[Any], *, narrows: bool = False) -> np.dtype[Any]:
    """Return the floating-point type of an operation's arithmetic and outputs.

    Parameters
    ----------
    precision : {"single", "double", None}
        ``None`` follows the input: double for float64, else single.
    dtype : numpy.dtype
        Dtype of the input.
    narrows : bool
        Whether the kernel itself converts float64 input to single, where this loses least; then "single" takes
        float64 input. Default False.

    Raises
    ------
    TypeError
        The operation does not take float64 input in single precision.
    ValueError
        The precision is unknown.
    """
    if precision is None:
        return np.dtype(np.float64 if dtype == np.float64 else np.float32)
    if precision not in ("single", "double"):
        raise ValueError(f"precision must be 'single', 'double' or None, got {precision!r}")
    if precision == "single" and dtype == np.float64 and not narrows:
        raise TypeError("precision='single' does not take float64 input; convert it, or ask for 'double'")
    return np.dtype(np.float64 if precision == "double" else np.float32)


def real_defines(device: Device, real: np.dtype[Any]) -> dict[str, Define]:
    """Return the macros that select the real type.

    Raises
    ------
    ValueError
        The device has no double precision.
    """
    if real == np.float32:
        return {}
    if not device.has_double:
        raise ValueError(f"device {device.label} has no double precision; use precision='single'")
    return {"REAL_IS_DOUBLE": None}


def two_floats(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return numbers as pairs of floats, for ``kernels/common/two_float.h``.

    Parameters
    ----------
    values : array_like of float
        Numbers (...,); below 3e38.

    Returns
    -------
    numpy.ndarray
        (..., 2) float32: the nearest float, and the rest. The relative error is below 2^-48.

    Examples
    --------
    >>> two_floats([1.0, 0.1]).tolist()
    [[1.0, 0.0], [0.10000000149011612, -1.4901161415892261e-09]]
    """
    wide = np.asarray(values, np.float64)
    high = wide.astype(np.float32)
    return np.stack([high, (wide - high).astype(np.float32)], axis=-1)


class Launchable(Protocol):
    """Interface of an operation to a bound instance: result type, kernel folder, and description of the launch."""

    Result: ClassVar[type[Any]]
    kernel_folder: ClassVar[Path | None]
    include_folders: ClassVar[tuple[Path, ...]]

    def launch(self, device: Device, shape: Shape, dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape and dtype."""

    def input_names(self, count: int) -> list[str]:
        """Return the names of the inputs in messages."""


def uses_vectors(variant: Variant, device: Device) -> bool:
    """Decide between the vector variant of a kernel and one work-item per element."""
    if variant not in ("auto", "vector", "work_item"):
        raise ValueError(f"variant must be 'auto', 'vector' or 'work_item', got {variant!r}")
    if variant == "vector" and not device.takes_vectors:
        raise ValueError(f"device {device.label} does not run the vector variant of kernels; use variant='auto'")
    return device.prefers_vectors if variant == "auto" else variant == "vector"
