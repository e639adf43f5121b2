"""The one concept: an operation is described once, bound to a device and a shape, then called.

``op(array)`` is convenience: it binds behind the scene and keeps the bound instance. ``op.bind(...)`` is the hot
path: after it nothing is compiled, allocated or copied.
"""

from __future__ import annotations

import collections
import math
import operator
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import DTypeLike

from gpuvision.host.arrays import DeviceArray, HostArray, check_host, host_view, memory_of
from gpuvision.host.device import Device
from gpuvision.host.program import Define, build

Precision = Literal["single", "double"] | None
Walk = Literal["auto", "strip", "item"]
Spec = tuple[tuple[int, ...], np.dtype[Any]]
R = TypeVar("R", bound=tuple[Any, ...])

_KEPT_BOUND = 16
_COMPLETE = cl.command_execution_status.COMPLETE
# One core of a PC moves so much in the time in which PoCL wakes two.
_SHORT_BYTES = 1 << 20


@dataclass(frozen=True)
class Launch:
    """What to build and run for one shape on one device; the kernel takes inputs, outputs, arguments in order.

    Attributes
    ----------
    source : str
        Path of the ``.cl`` file relative to the operation's `kernel_folder`.
    kernel : str
        Name of the kernel function in the file.
    inputs : sequence of (shape, dtype)
    outputs : mapping of str to (shape, dtype) or None
        By the names of the result's fields, in the kernel's order. ``None``: the kernel has the argument and gets
        a null pointer; the field stays ``None``.
    global_size, local_size : tuple of int, optional
        ``local_size=None`` leaves the choice to the runtime.
    defines : mapping
        What changes the code.
    arguments : sequence
        NumPy scalars, passed by value; NumPy arrays, uploaded once: tables and parameter packs; ``None``: a null
        pointer for a table that this build has no code for.
    passes_once : bool
        Whether the kernel does little more than read and write its memory once: then a little memory takes less time
        than to wake a worker thread.
    """

    source: str
    kernel: str
    inputs: Sequence[Spec]
    outputs: Mapping[str, Spec | None]
    global_size: tuple[int, ...]
    local_size: tuple[int, ...] | None = None
    defines: Mapping[str, Define] = field(default_factory=dict)
    arguments: Sequence[Any] = ()
    passes_once: bool = False

    @property
    def groups(self) -> int:
        """Work-groups; as many as work-items where the runtime chooses their size."""
        return math.prod(self.global_size) // math.prod(self.local_size or (1,))

    @property
    def nbytes(self) -> int:
        """Bytes of inputs and outputs."""
        specs = (*self.inputs, *(each for each in self.outputs.values() if each is not None))
        return sum(math.prod(shape) * dtype.itemsize for shape, dtype in specs)


class Operation(Generic[R]):
    """Base of the operations: frozen dataclasses of physics and units, validated once.

    A subclass names its result type in `Result`, its kernel folder in `kernel_folder`, and describes in `launch` which
    kernel runs.

    Attributes
    ----------
    Result : type of named tuple
        Class of the results.
    kernel_folder : pathlib.Path
        Folder of the kernel sources.
    include_folders : tuple of pathlib.Path
        More folders that are searched for headers, such as ``gpuvision.operation.KERNEL_FOLDER``.
    """

    Result: ClassVar[type[Any]]
    kernel_folder: ClassVar[Path | None] = None
    include_folders: ClassVar[tuple[Path, ...]] = ()

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

    def bind(self, device: Device | None, shape: tuple[int, ...], dtype: DTypeLike, *, queue: Any = None) -> Bound[R]:
        """Prepare the operation for frames of one shape: build, allocate, and warm up with a launch.

        Parameters
        ----------
        device : Device or None
            ``None`` takes `Device.best`.
        shape : tuple of int
            Shape of the (first) input.
        dtype : dtype
            Its dtype.
        queue : pyopencl.CommandQueue, optional
            Where it runs; the device's default queue otherwise.

        Returns
        -------
        Bound
            Not safe to share between threads: bind once per thread.

        Raises
        ------
        TypeError, ValueError
            The operation does not take such input.
        BuildError
            The kernel does not compile on this device.
        """
        device, dtype = _device(device), np.dtype(dtype)
        if not dtype.isnative:
            raise TypeError(
                f"expected native byte order, got {dtype.str}; convert it with .astype(dtype.newbyteorder('='))"
            )
        return Bound(self, device, tuple(map(operator.index, shape)), dtype, queue)

    def __call__(self, *inputs: Any, device: Device | None = None, out: R | None = None) -> R:
        """Run once on NumPy arrays (and wait) or on device arrays (and return at once).

        Parameters
        ----------
        *inputs : numpy.ndarray or pyopencl.array.Array
            C-contiguous. All of one kind.
        device : Device, optional
            Where to run; device arrays run where they lie, on their own queue.
        out : Result, optional
            Arrays of the same kind as the inputs to write into; the same object is returned. Fields that the
            operation does not compute are ``None``.

        Returns
        -------
        Result
            NumPy in, NumPy out; device arrays in, device arrays out.

        Raises
        ------
        TypeError, ValueError
            Wrong dtype, shape, layout or device: nothing is converted behind the caller's back.
        """
        if out is not None and not isinstance(out, self.Result):
            raise TypeError(f"out: expected a {self.Result.__name__} of arrays, got {type(out).__name__}")
        if inputs and all(isinstance(each, cl.array.Array) for each in inputs):
            return self._on_device(inputs, device, out)
        if inputs and all(isinstance(each, np.ndarray) for each in inputs):
            return self._bound(_device(device), None, inputs[0]).on_host(inputs, out)
        kinds = ", ".join(type(each).__name__ for each in inputs) or "none"
        raise TypeError(f"expected NumPy arrays or pyopencl arrays, all of one kind, got {kinds}")

    def _on_device(self, inputs: Sequence[DeviceArray], device: Device | None, out: R | None) -> R:
        home = Device.of(inputs[0])
        if device is not None and _device(device).context != home.context:
            raise ValueError(f"the input lies on {home.label}, not on {device.label}; copy it there first")
        bound = self._bound(home, inputs[0].queue, inputs[0])
        result = bound.allocate() if out is None else out
        # Another queue may still be writing the inputs.
        event = bound(*inputs, out=result, wait_for=[event for array in inputs for event in array.events])
        for array in result:
            if array is not None:
                array.add_event(event)
        return result

    def _bound(self, device: Device, queue: Any, first: HostArray | DeviceArray) -> Bound[R]:
        """Return the bound instance of this thread for such an input, from the few kept ones."""
        kept: collections.OrderedDict[Any, Bound[R]] = _kept_bound()
        key = (self, device, queue, first.shape, first.dtype)
        if key not in kept:
            kept[key] = self.bind(device, first.shape, first.dtype, queue=queue)
            if len(kept) > _KEPT_BOUND:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]


# Kernel objects are not safe to share between threads: each thread keeps its own.
_thread = threading.local()


def _kept_bound() -> Any:
    if not hasattr(_thread, "bound"):
        _thread.bound = collections.OrderedDict()
    return _thread.bound


@dataclass(slots=True, eq=False)
class _Site:
    """Where a bound operation runs: a queue, the kernel as compiled for its device, and the arrays set in that.

    The runtime may abort the process on a freed buffer: what the kernel was given stays referenced.
    """

    queue: Any
    kernel: Any
    given: tuple[Any, ...]
    at_once: bool  # in the caller's thread, done when enqueued


class Bound(Generic[R]):
    """An operation bound to a device, a queue and a shape: call it with frames.

    Attributes
    ----------
    inputs : tuple of pyopencl.array.Array
        Its own input slot: fill it (`arrays.host_view` where memory is shared) and call with no arguments.
    outputs : Result of pyopencl.array.Array
        What each call writes, unless it is given ``out``; ``None`` where nothing is computed.
    """

    def __init__(
        self, operation: Operation[R], device: Device, shape: tuple[int, ...], dtype: np.dtype[Any], queue: Any
    ) -> None:
        launch = operation.launch(device, shape, dtype)
        self.operation, self.device = operation, device
        self.queue = device.queue if queue is None else queue
        self._launch = launch
        self._computed_specs = {name: spec for name, spec in launch.outputs.items() if spec is not None}
        self._global, self._local = launch.global_size, launch.local_size
        # What `Device.wait` comes to, found out once: a call of short work is a few microseconds in all.
        self._wait: Callable[[Any], object] = device.wait if device.kind == "pocl" else cl.Event.wait
        self._empty = not all(launch.global_size)
        self.inputs = tuple(device.empty(shape, dtype, self.queue) for shape, dtype in launch.inputs)
        self.outputs = self.allocate()
        self._tables = [self._upload(each) for each in launch.arguments if isinstance(each, np.ndarray)]
        self._in_flight: collections.deque[tuple[Any, Any]] = collections.deque()
        after_inputs = enumerate(launch.outputs.values(), len(launch.inputs))
        # Of the arrays that calls bind, among the kernel's arguments.
        self._places = [*range(len(launch.inputs)), *(place for place, spec in after_inputs if spec is not None)]
        self._own = (*self.inputs, *self._computed(self.outputs))
        # Intel's runtime looks an SVM pointer up at every launch; a buffer over the same memory it knows.
        known = self._own if device.kind == "intel" and device.shares_memory else ()
        self._known = {id(each): _buffer_over(device.context, each) for each in known}
        self._site_of_queue = self._site_on(self.queue)
        self._here: _Site | None = None
        if not self._site_of_queue.at_once and launch.passes_once and launch.nbytes <= _SHORT_BYTES:
            own = device.callers_queue(self.queue, groups=launch.groups)
            self._here = None if own is None else self._site_on(own)
        for array in self.inputs:
            self._clear(array)
        self().wait()
        if self._here is not None and not self._empty:
            self._set_arrays(self._site_of_queue, self._own)
            cl.enqueue_nd_range_kernel(self.queue, self._site_of_queue.kernel, self._global, self._local).wait()

    def allocate(self) -> R:
        """Return fresh device arrays for the outputs."""
        arrays = {
            name: self.device.empty(shape, dtype, self.queue) for name, (shape, dtype) in self._computed_specs.items()
        }
        return self._result(arrays)

    def __call__(self, *frames: DeviceArray, out: R | None = None, wait_for: Sequence[Any] | None = None) -> Any:
        """Enqueue the operation and return its event.

        Parameters
        ----------
        *frames : pyopencl.array.Array
            Device arrays of the bound shape and dtype; none: the instance's own `inputs`.
        out : Result of pyopencl.array.Array, optional
            Where to write instead of `outputs`.
        wait_for : sequence of pyopencl.Event, optional

        Returns
        -------
        pyopencl.Event

        Raises
        ------
        TypeError, ValueError
            A frame is not what the instance was bound to.
        """
        return self._enqueue(self._own if not frames and out is None else self._given(frames, out), wait_for)

    def run(self, *frames: DeviceArray, out: R | None = None) -> R:
        """Call, wait with the least delay, and return what was written: `out`, or `outputs`."""
        event = self._enqueue(self._own if not frames and out is None else self._given(frames, out))
        if not self._site_of_queue.at_once:
            self._wait(event)
        return self.outputs if out is None else out

    def _given(self, frames: tuple[DeviceArray, ...], out: R | None) -> tuple[Any, ...]:
        """Return the arrays of a call in the kernel's order, its own in place of what is not given."""
        if out is not None and out is not self.outputs:
            self._check_fields(out)
        return (*(frames or self.inputs), *self._computed(self.outputs if out is None else out))

    def _enqueue(self, given: tuple[Any, ...], wait_for: Sequence[Any] | None = None) -> Any:
        site = self._site_of_queue if self._here is None else self._site(wait_for)
        if given is not site.given:
            self._set_arrays(site, given)
        if self._empty:
            return cl.enqueue_marker(self.queue, wait_for=wait_for)
        if site.at_once:
            if wait_for:
                cl.wait_for_events(wait_for)
            return cl.enqueue_nd_range_kernel(site.queue, site.kernel, self._global, self._local)
        event = cl.enqueue_nd_range_kernel(site.queue, site.kernel, self._global, self._local, wait_for=wait_for)
        if given is not self._own:
            self._hold(event, given)
        return event

    def _site(self, wait_for: Sequence[Any] | None = None) -> _Site:
        """Return where to run: short work in the caller's thread, once all before it in the queue is done.

        Work that must wait is left to the workers: PoCL hangs where one of its devices waits for an event of the other.
        """
        if self._here is None or (wait_for and any(each.command_execution_status > _COMPLETE for each in wait_for)):
            return self._site_of_queue
        self.queue.finish()
        return self._here

    def on_host(self, frames: Sequence[HostArray], out: R | None = None) -> R:
        """Run on NumPy arrays and wait; on shared memory the kernel reads and writes them in place."""
        if len(frames) != len(self.inputs):
            raise TypeError(f"expected {len(self.inputs)} input arrays, got {len(frames)}")
        for number, (frame, (shape, dtype)) in enumerate(zip(frames, self._launch.inputs, strict=True)):
            check_host(frame, shape, dtype, f"input {number}")
        if out is None:
            out = self._result({k: np.empty(shape, dtype) for k, (shape, dtype) in self._computed_specs.items()})
        targets = self._computed(out)
        self._check_fields(out)
        for (name, (shape, dtype)), array in zip(self._computed_specs.items(), targets, strict=True):
            check_host(array, shape, dtype, f"out.{name}")
        _check_apart(frames, targets, np.may_share_memory)
        if self._empty:
            return out
        if self.device.shares_memory:
            self._run_in_place(frames, targets)
        else:
            self._run_with_copies(frames, targets)
        return out

    def _run_in_place(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> None:
        flags, context = cl.mem_flags, self.device.context
        read = [cl.Buffer(context, flags.READ_ONLY | flags.USE_HOST_PTR, hostbuf=each) for each in frames]
        write = [cl.Buffer(context, flags.WRITE_ONLY | flags.USE_HOST_PTR, hostbuf=each) for each in targets]
        site = self._site()
        site.given = (None,) * len(self._own)
        for index, memory in zip(self._places, (*read, *write), strict=True):
            site.kernel.set_arg(index, memory)
        cl.enqueue_nd_range_kernel(site.queue, site.kernel, self._global, self._local)
        for memory, array in zip(write, targets, strict=True):
            # The map is what makes the kernel's writes visible to the host; the address stays the same.
            mapped, _ = cl.enqueue_map_buffer(
                site.queue, memory, cl.map_flags.READ, 0, array.shape, array.dtype, is_blocking=False
            )
            mapped.base.release(site.queue)
        site.queue.finish()
        # The next call binds others before these go away: a preset argument must never dangle.
        self._set_arrays(site, self._own)

    def _run_with_copies(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> None:
        for array, frame in zip(self.inputs, frames, strict=True):
            cl.enqueue_copy(self.queue, memory_of(array), frame, is_blocking=False)
        self()
        for array, target in zip(self._computed(self.outputs), targets, strict=True):
            cl.enqueue_copy(self.queue, target, memory_of(array), is_blocking=False)
        self.queue.finish()

    def _computed(self, result: R) -> tuple[Any, ...]:
        return tuple(getattr(result, name) for name in self._computed_specs)

    def _result(self, arrays: Mapping[str, Any]) -> R:
        result: R = self.operation.Result(**{name: arrays.get(name) for name in self.operation.Result._fields})
        return result

    def _set_arrays(self, site: _Site, given: tuple[Any, ...]) -> None:
        specs = (*self._launch.inputs, *self._computed_specs.values())
        if len(given) != len(specs):
            raise TypeError(
                f"expected {len(self.inputs)} input arrays, got {len(given) - len(specs) + len(self.inputs)}"
            )
        for array, before, spec in zip(given, site.given, specs, strict=True):
            if array is not before:
                self._check(array, *spec)
        inputs = len(self.inputs)
        _check_apart(given[:inputs], given[inputs:], lambda a, b: a.base_data is b.base_data)
        for place, array, before in zip(self._places, given, site.given, strict=True):
            if array is not before:
                site.kernel.set_arg(place, self._known.get(id(array)) or memory_of(array))
        site.given = given

    def _check_fields(self, out: R) -> None:
        for name, array in zip(self.operation.Result._fields, out, strict=True):
            if (array is not None) != (name in self._computed_specs):
                what = "is missing" if array is None else "is not computed; expected None"
                raise ValueError(f"out.{name} {what}")

    def _check(self, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if not isinstance(array, cl.array.Array):
            raise TypeError(f"expected a pyopencl array on {self.device.label}, got {type(array).__name__}")
        if array.dtype != dtype:
            raise TypeError(f"expected dtype {dtype}, got {array.dtype}; bind the operation to it")
        if array.shape != shape:
            raise ValueError(f"expected shape {shape}, got {array.shape}; bind the operation to it")
        if array.context != self.device.context:
            raise ValueError(f"the array lies on another device than {self.device.label}; copy it there first")

    def _clear(self, array: DeviceArray) -> None:
        if self.device.shares_memory:
            host_view(array).fill(0)
        elif array.nbytes:
            cl.enqueue_fill_buffer(self.queue, memory_of(array), np.zeros(1, np.uint8), 0, array.nbytes)

    def _site_on(self, queue: Any) -> _Site:
        """Compile the kernel for a queue's device and set what no call changes."""
        launch, operation = self._launch, self.operation
        if operation.kernel_folder is None:
            raise ValueError(f"{type(operation).__name__} has no kernel_folder; set it to the folder of its .cl files")
        program = build(
            self.device,
            operation.kernel_folder,
            launch.source,
            launch.defines,
            include_folders=operation.include_folders,
            handle=queue.device,
        )
        kernel = cl.Kernel(program, launch.kernel)
        after_inputs = len(launch.inputs)
        after_outputs = after_inputs + len(launch.outputs)
        for place, spec in enumerate(launch.outputs.values(), after_inputs):
            if spec is None:
                kernel.set_arg(place, None)
        tables = iter(self._tables)
        for place, value in enumerate(launch.arguments, after_outputs):
            kernel.set_arg(place, next(tables) if isinstance(value, np.ndarray) else value)
        return _Site(queue, kernel, (None,) * len(self._own), self.device.is_callers(queue))

    def _upload(self, table: HostArray) -> Any:
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.device.context, flags, hostbuf=np.ascontiguousarray(table))

    def _hold(self, event: Any, given: tuple[Any, ...]) -> None:
        """Keep what a running kernel uses until it has run; its own arrays the instance keeps anyway."""
        flight = self._in_flight
        while flight and flight[0][0].command_execution_status <= _COMPLETE:
            flight.popleft()
        flight.append((event, given))


def _buffer_over(context: Any, array: DeviceArray) -> Any:
    """Return a buffer that is an array's shared memory."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return cl.Buffer(context, flags, hostbuf=host_view(array)) if array.nbytes else None


def _device(device: Device | None) -> Device:
    if device is not None and not isinstance(device, Device):
        raise TypeError(f"expected a Device, got {type(device).__name__}; Device.named finds one by name")
    return Device.best() if device is None else device


def _check_apart(inputs: Sequence[Any], outputs: Sequence[Any], same: Callable[[Any, Any], bool]) -> None:
    """Check that no output is an input or another output: kernels read and write in an order of their own."""
    for number, output in enumerate(outputs):
        if any(same(output, other) for other in (*inputs, *outputs[:number])):
            raise ValueError("an output shares its memory with an input or another output; expected arrays apart")


def real_of(precision: Precision, dtype: np.dtype[Any], *, narrows: bool = False) -> np.dtype[Any]:
    """Return the real type of an operation: asked for, or following the input (float64 computes in double).

    Parameters
    ----------
    precision, dtype
        What was asked for, and the input's.
    narrows
        The kernel makes float64 input single by itself, where that loses least: "single" takes it, too.

    Raises
    ------
    TypeError, ValueError
        It does not take float64 input in single precision; the word is unknown.
    """
    if precision is None:
        return np.dtype(np.float64 if dtype == np.float64 else np.float32)
    if precision not in ("single", "double"):
        raise ValueError(f"precision must be 'single', 'double' or None, got {precision!r}")
    if precision == "single" and dtype == np.float64 and not narrows:
        raise TypeError("precision='single' does not take float64 input; convert it, or ask for 'double'")
    return np.dtype(np.float64 if precision == "double" else np.float32)


def real_defines(device: Device, real: np.dtype[Any]) -> dict[str, Define]:
    """Return the defines that select the real type.

    Raises
    ------
    ValueError
        The device does not compute in double.
    """
    if real == np.float32:
        return {}
    if not device.has_double:
        raise ValueError(f"device {device.label} has no double precision; use precision='single'")
    return {"REAL_IS_DOUBLE": None}


def in_strips(walk: Walk, device: Device) -> bool:
    """Decide between wide strips (CPU runtimes) and one item per sample; both are tested on every device."""
    if walk not in ("auto", "strip", "item"):
        raise ValueError(f"walk must be 'auto', 'strip' or 'item', got {walk!r}")
    return device.is_cpu if walk == "auto" else walk == "strip"


__all__ = [
    "Bound",
    "Launch",
    "Operation",
    "Precision",
    "Spec",
    "Walk",
    "host_view",
    "in_strips",
    "real_defines",
    "real_of",
]
