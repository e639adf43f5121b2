"""Checks of the device arrays that a call of a bound operation is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpuvision.host.arrays import DeviceArray
from gpuvision.host.device import Device


def mixed_kinds(name: str, inputs: Sequence[Any]) -> TypeError:
    """Return the error of an operation whose inputs are neither all NumPy arrays nor all device arrays."""
    kinds = ", ".join(type(each).__name__ for each in inputs) or "none"
    return TypeError(f"{name}: expected NumPy arrays or pyopencl arrays, all of one kind, got {kinds}")


def check_on_device(array: Any, shape: tuple[int, ...], dtype: np.dtype[Any], device: Device) -> None:
    """Check that an array lies on a device and has the shape and dtype of a bound operation.

    Raises
    ------
    TypeError
        The array is no device array, or has another dtype.
    ValueError
        The array has another shape, or lies on another device.
    """
    if not isinstance(array, cl.array.Array):
        raise TypeError(f"expected a pyopencl array on {device.label}, got {type(array).__name__}")
    if array.dtype != dtype:
        raise TypeError(f"expected dtype {dtype}, got {array.dtype}; bind the operation to it")
    if array.shape != shape:
        raise ValueError(f"expected shape {shape}, got {array.shape}; bind the operation to it")
    if array.context != device.context:
        raise ValueError(f"the array lies on another device than {device.label}; copy it there first")


def same_memory(one: DeviceArray, other: DeviceArray) -> bool:
    """Return whether two arrays have the same memory; pyopencl gives an empty array no memory."""
    return one.base_data is not None and one.base_data is other.base_data


def check_apart(inputs: Sequence[Any], outputs: Sequence[Any], same: Callable[[Any, Any], bool]) -> None:
    """Check that no output is an input or another output, because kernels read and write in any order.

    Raises
    ------
    ValueError
        An output shares its memory with an input or another output.
    """
    for number, output in enumerate(outputs):
        if any(same(output, other) for other in (*inputs, *outputs[:number])):
            raise ValueError("an output shares its memory with an input or another output; expected arrays apart")
