"""Base class of all operations: described once, bound to a device and a shape, then called.

``op(array)`` binds the operation on the first call for a shape and reuses the bound instance. ``op.bind(...)`` is
the fast path: calls of a bound instance compile, allocate and copy nothing.
"""

from __future__ import annotations

import collections
import operator
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import DTypeLike

from gpuvision.host.array_checks import mixed_kinds
from gpuvision.host.arrays import DeviceArray, HostArray
from gpuvision.host.bound import Bound
from gpuvision.host.device import Device
from gpuvision.host.errors import BuildError, DeviceLimitError, DeviceMemoryError
from gpuvision.host.kept import clear_cache, kept_bound
from gpuvision.host.launch import Launch, Specs
from gpuvision.host.process import check_process
from gpuvision.host.stages import stage
from gpuvision.host.trace import records_launches
from gpuvision.host.traced import TracedBound
from gpuvision.host.tuned_settings import Tunable

R = TypeVar("R", bound=tuple[Any, ...])

# Bound instances that each thread keeps for `Operation.__call__`; each of them holds device memory for its arrays.
_KEPT_BOUND = 16


class Operation(Generic[R]):
    """Base class of operations, which are frozen dataclasses of parameters that are validated once.

    A subclass sets its result type `Result` and its `kernel_folder`, and describes in `launch` the kernel to run.

    Attributes
    ----------
    Result : type of named tuple
        Class of the results.
    kernel_folder : pathlib.Path
        Folder of the kernel sources.
    include_folders : tuple of pathlib.Path
        More folders that are searched for headers, such as ``gpuvision.operation.KERNEL_FOLDER``.
    tunable : Tunable or None
        Settings that `gpuvision tune` may change; default None.
    takes_single_frames : bool
        Whether the first input is one frame, without an axis for a batch; default False. A stream then has batches of
        one frame.
    """

    Result: ClassVar[type[Any]]
    kernel_folder: ClassVar[Path | None] = None
    include_folders: ClassVar[tuple[Path, ...]] = ()
    tunable: ClassVar[Tunable | None] = None
    takes_single_frames: ClassVar[bool] = False

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Check shape and dtype of the first input and describe the kernel launch for it.

        Parameters
        ----------
        device : Device
            Device on which the kernel will run.
        shape : tuple of int
            Shape of the first input.
        dtype : numpy.dtype
            Dtype of the first input.

        Returns
        -------
        Launch

        Raises
        ------
        TypeError, ValueError
            The operation does not take such input; the message names the inputs that it takes.
        """
        raise NotImplementedError

    def specs(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Specs:
        """Return the inputs, outputs and memory for a first input of one shape.

        Raises
        ------
        TypeError, ValueError
            The operation does not take such input.
        """
        launch = self.launch(device, shape, dtype)
        inputs = tuple((tuple(each), np.dtype(of)) for each, of in launch.inputs)
        return Specs(inputs, launch.outputs, launch.nbytes)

    def bind(
        self,
        device: Device | None,
        shape: tuple[int, ...],
        dtype: DTypeLike,
        *,
        queue: Any = None,
        inputs: Sequence[DeviceArray] = (),
    ) -> Bound[R]:
        """Prepare the operation for inputs of one shape: build the program, allocate arrays, launch once.

        Parameters
        ----------
        device : Device or None
            ``None`` takes `Device.best`.
        shape : tuple of int
            Shape of the (first) input.
        dtype : dtype
            Dtype of the (first) input, in native byte order.
        queue : pyopencl.CommandQueue, optional
            In-order queue of the device's context to run in; the device's default queue otherwise.
        inputs : sequence of pyopencl.array.Array
            Arrays that calls without arguments read, such as results of another operation; by default new arrays. Calls
            with NumPy arrays overwrite them in sequences, and on devices with memory of their own.

        Returns
        -------
        Bound
            For one thread: threads must not share a bound instance.

        Raises
        ------
        TypeError, ValueError
            The operation does not take such input, or the queue is of another context or runs out of order.
        BuildError
            The kernel does not compile on this device.

        Warns
        -----
        RuntimeWarning
            The vector variant of the kernel does not compile on this device, and its work-item variant runs instead.
        """
        bound = self._bind(device, shape, dtype, queue, inputs)
        bound.prepare_queue()
        if queue is None:  # not the stages of a sequence or a stream
            bound.prepare_team()
        return bound

    def _bind(
        self,
        device: Device | None,
        shape: tuple[int, ...],
        dtype: DTypeLike,
        queue: Any,
        inputs: Sequence[DeviceArray] = (),
    ) -> Bound[R]:
        """Return a bound instance; a short launch is built for the queue only when it first waits for an event."""
        check_process()
        device, dtype = _device(device), np.dtype(dtype)
        if queue is not None:
            device.check_queue(queue)
        if not dtype.isnative:
            raise TypeError(
                f"expected native byte order, got {dtype.str}; convert it with .astype(dtype.newbyteorder('='))"
            )
        shape = tuple(map(operator.index, shape))
        try:
            with stage("bind", type(self).__name__):
                return self._bound_to(device, shape, dtype, queue, inputs)
        except BuildError as error:
            if not device.prefers_vectors:
                raise
            with stage("bind", type(self).__name__):
                bound = self._bound_to(device.without_vectors(), shape, dtype, queue, inputs)
            reason = str(error).splitlines()[0]
            warnings.warn(f"work-items replace vectors on {device.label}: {reason}", RuntimeWarning, stacklevel=2)
            return bound

    def _bound_to(
        self,
        device: Device,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        queue: Any,
        inputs: Sequence[DeviceArray],
    ) -> Bound[R]:
        kind: type[Bound[R]] = TracedBound if records_launches(queue) else Bound
        return kind(self, device, shape, dtype, queue, inputs)

    def __call__(self, *inputs: Any, device: Device | None = None, out: R | None = None) -> R:
        """Run once: on NumPy arrays and wait, or on device arrays and return without waiting.

        Parameters
        ----------
        *inputs : numpy.ndarray or pyopencl.array.Array
            C-contiguous arrays, all NumPy arrays or all device arrays.
        device : Device, optional
            Device to run on; `Device.best` by default. Device arrays are processed on the device and in the queue of
            the array.
        out : Result, optional
            Arrays of the same kind as the inputs to write into; the same object is returned. Fields that the
            operation does not compute are ``None``.

        Returns
        -------
        Result
            NumPy arrays from NumPy inputs, device arrays from device inputs.

        Raises
        ------
        TypeError, ValueError
            Wrong dtype, shape, layout or device. Inputs are never converted.
        """
        if out is not None and not isinstance(out, self.Result):
            raise TypeError(f"out: expected a {self.Result.__name__} of arrays, got {type(out).__name__}")
        if inputs and all(isinstance(each, cl.array.Array) for each in inputs):
            return self._on_device(inputs, device, out)
        if inputs and all(isinstance(each, np.ndarray) for each in inputs):
            return self._bound(_device(device), None, inputs[0]).on_host(inputs, out)
        raise mixed_kinds(type(self).__name__, inputs)

    def input_names(self, count: int) -> list[str]:
        """Return the names of the inputs in messages.

        Parameters
        ----------
        count : int
            Number of inputs.
        """
        return [f"{type(self).__name__}: input {number} of {count}" for number in range(1, count + 1)]

    def _on_device(self, inputs: Sequence[DeviceArray], device: Device | None, out: R | None) -> R:
        home = Device.of(inputs[0])
        if device is not None and _device(device).context != home.context:
            raise ValueError(f"the input lies on {home.label}, not on {device.label}; copy it there first")
        bound = self._bound(home, inputs[0].queue, inputs[0])
        result = bound.allocate() if out is None else out
        # A kernel in another queue may still write the inputs: wait for their events.
        event = bound(*inputs, out=result, wait_for=[event for array in inputs for event in array.events])
        for array in result:
            if array is not None:
                array.add_event(event)
        return result

    def _bound(self, device: Device, queue: Any, first: HostArray | DeviceArray) -> Bound[R]:
        """Return this thread's bound instance for a first input; bind a new instance if no cached instance fits."""
        kept: collections.OrderedDict[Any, Bound[R]] = kept_bound()
        key = (self, device, queue, first.shape, first.dtype)
        if key not in kept:
            bound = self._bind_freeing(device, queue, first)
            kept = kept_bound()  # a new mapping where `_bind_freeing` has cleared the old one
            kept[key] = bound
            if len(kept) > _KEPT_BOUND:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]

    def _bind_freeing(self, device: Device, queue: Any, first: HostArray | DeviceArray) -> Bound[R]:
        """Return a new bound instance; where the memory is full, free the kept arrays and try once more."""
        try:
            return self._bind(device, first.shape, first.dtype, queue)
        except DeviceLimitError:
            raise
        except DeviceMemoryError:
            if not kept_bound():
                raise
        # After the `except` block: its exception refers to the frames of the failed attempt, and so to the arrays.
        clear_cache()
        return self._bind(device, first.shape, first.dtype, queue)


def _device(device: Device | None) -> Device:
    if device is not None and not isinstance(device, Device):
        raise TypeError(f"expected a Device, got {type(device).__name__}; Device.named finds one by name")
    return Device.best() if device is None else device
