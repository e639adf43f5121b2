"""Device arrays, their NumPy views, and the types of result fields."""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

DeviceArray: TypeAlias = cl.array.Array
HostArray: TypeAlias = NDArray[Any]
# Fields of results: NumPy arrays from NumPy inputs, device arrays from device inputs.
Array: TypeAlias = NDArray[Any] | cl.array.Array
FloatArray: TypeAlias = NDArray[np.floating[Any]] | cl.array.Array
IntArray: TypeAlias = NDArray[np.int32] | cl.array.Array
StatusArray: TypeAlias = NDArray[np.uint8] | cl.array.Array
FitStatusArray: TypeAlias = NDArray[np.uint16] | cl.array.Array

S = TypeVar("S", bound=np.generic)

SHARED_FLAGS = cl.svm_mem_flags.READ_WRITE | cl.svm_mem_flags.SVM_FINE_GRAIN_BUFFER


class _Shared:
    """NumPy view of shared memory. The NumPy array keeps this object and so the memory alive."""

    def __init__(self, array: DeviceArray, memory: cl.SVMPointer) -> None:
        self.memory = memory
        self.__array_interface__ = {
            "version": 3,
            "shape": array.shape,
            "typestr": array.dtype.str,
            "data": (memory.svm_ptr, False),
        }


def host_view(array: DeviceArray) -> HostArray:
    """Return the NumPy view of a device array in shared memory, without copy or map.

    Parameters
    ----------
    array : pyopencl.array.Array
        Array in shared memory, as `Device.empty` makes it where `Device.shares_memory`.

    Returns
    -------
    numpy.ndarray
        View of the same memory. Read or write it only while no kernel uses the array: wait for the event first.

    Raises
    ------
    ValueError
        The array is in device memory that the host does not share; ``array.get()`` copies it.
    """
    memory = array.base_data
    if not isinstance(memory, cl.SVMPointer):
        raise ValueError("the array lies in device memory; copy it with array.get(), host_view needs shared memory")
    return np.asarray(_Shared(array, memory))


def to_numpy(array: NDArray[S] | DeviceArray | None) -> NDArray[S]:
    """Return a field of a result as a NumPy array: a NumPy array itself, a device array copied to the host.

    Parameters
    ----------
    array : numpy.ndarray or pyopencl.array.Array

    Returns
    -------
    numpy.ndarray

    Raises
    ------
    TypeError
        The value is neither: the field is ``None``, because the operation did not compute it.
    """
    if isinstance(array, np.ndarray):
        return array
    if isinstance(array, cl.array.Array):
        copied: NDArray[S] = array.get()
        return copied
    raise TypeError(f"expected a NumPy array or a pyopencl array, got {type(array).__name__}")


def memory_of(array: DeviceArray) -> Any:
    """Return the memory object of a whole, C-contiguous device array.

    Raises
    ------
    ValueError
        The array is a part of another array, or it is not C-contiguous.
    """
    if array.offset or not array.flags.c_contiguous:
        raise ValueError("expected a whole C-contiguous device array, got a part or another layout; use array.copy()")
    return array.base_data


def launch_memory(device: Any, array: DeviceArray) -> Any:
    """Return the memory object of an array with which launches take the least time.

    Intel's runtime searches for the allocation of an SVM pointer at every launch, but not for the allocation of a
    buffer: there it is a buffer over shared memory.
    """
    memory = memory_of(array)
    if device.kind != "intel" or not array.nbytes or not isinstance(memory, cl.SVMPointer):
        return memory
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return cl.Buffer(device.context, flags, hostbuf=host_view(array))


def check_host(
    array: HostArray, shape: tuple[int, ...], dtype: np.dtype[Any], what: str, *, is_written: bool = False
) -> None:
    """Check dtype, shape and layout of a NumPy array for a kernel.

    Raises
    ------
    TypeError
        The dtype differs, or the array is masked: a kernel does not see the mask.
    ValueError
        The shape differs, or the array is not C-contiguous, not aligned to its dtype, or read-only although it
        `is_written`.
    """
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(f"{what}: expected a plain array, got a masked array; fill it with .filled(value), such as NaN")
    if array.dtype != dtype:
        raise TypeError(f"{what}: expected dtype {dtype}, got {array.dtype}; convert it with .astype")
    if array.shape != shape:
        raise ValueError(f"{what}: expected shape {shape}, got {array.shape}")
    flags = array.flags
    if not flags.c_contiguous:
        raise ValueError(f"{what}: expected a C-contiguous array; use np.ascontiguousarray")
    if not flags.aligned:
        raise ValueError(f"{what}: expected an array aligned to {dtype}; use np.require(array, requirements='A')")
    if is_written and not flags.writeable:
        raise ValueError(f"{what}: expected an array that can be written, got a read-only one; use .copy()")
