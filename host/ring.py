"""Slots of a stream: bound operations and the memory of one batch, allocated once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import HostArray, host_view
from gpuvision.host.bound import Bound
from gpuvision.host.device import Device
from gpuvision.host.errors import DeviceMemoryError
from gpuvision.host.launch import Spec, Specs, nbytes_of
from gpuvision.host.operation import Operation
from gpuvision.host.sequence import BoundSequence
from gpuvision.host.text import size_in_words

R = TypeVar("R", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Step:
    """Operation of a chain, and its inputs: fields of the previous result, then fixed arrays.

    Attributes
    ----------
    operation : Operation
    takes : tuple of str
        Fields of the previous result, in the order of the operation's inputs. Default: the first computed field. The
        first step of a chain takes the frames of the source.
    fixed : tuple of numpy.ndarray
        Values of the inputs after those: the same for all frames of the stream, such as the rulers of a `RulerEdges`.
    """

    operation: Operation[Any]
    takes: tuple[str, ...] = ()
    fixed: tuple[HostArray, ...] = ()


def steps_of(operation: Operation[Any] | Step | Sequence[Operation[Any] | Step]) -> list[Step]:
    """Return the steps of an operation or a chain."""
    given = [operation] if isinstance(operation, Operation | Step) else list(operation)
    if not given:
        raise ValueError("expected an operation, or a chain of at least one")
    return [each if isinstance(each, Step) else Step(each) for each in given]


class Queues:
    """Command queues of a stream: one queue where memory is shared, else one each for upload, compute and download.

    With ``inline``, the compute queue runs kernels in the thread that enqueues them.
    """

    def __init__(self, device: Device, *, zero_copy: bool, profiling: bool, inline: bool) -> None:
        self.compute = device.new_queue(profiling=profiling, inline=inline)
        self.upload = self.download = self.compute
        if not zero_copy:
            self.upload = device.new_queue(profiling=profiling)
            self.download = device.new_queue(profiling=profiling)

    @property
    def all(self) -> tuple[Any, Any, Any]:
        """Queues of upload, compute and download, which may be one."""
        return self.upload, self.compute, self.download

    def finish(self) -> None:
        """Wait until all queues are empty."""
        for queue in self.all:
            queue.finish()


def queues_of(device: Device, ring: int, *, zero_copy: bool, profiling: bool, inline: bool) -> list[Queues]:
    """Return the queues of each slot: the same ones for all slots, or separate ones.

    A thread that waits for an event of Intel's CPU runtime joins the worker threads, and leaves when the queue of the
    event is idle. In a queue of all slots it would also compute the batches that the producer adds meanwhile: where
    another process slows down the stream, the queue was never idle for 0.1 to 0.4 s (measured), and no batch was
    delivered. The queue of a slot gets no further work before its batch is delivered.
    """

    def new() -> Queues:
        return Queues(device, zero_copy=zero_copy, profiling=profiling, inline=inline)

    separate = device.kind == "intel" and not inline
    return [new() for _ in range(ring)] if separate else [new()] * ring


def takes_single_frames(steps: Sequence[Step]) -> bool:
    """Return whether an operation of a chain takes one frame instead of a batch of frames."""
    return any(step.operation.takes_single_frames for step in steps)


def check_chain(steps: Sequence[Step], device: Device, batch: int, shape: tuple[int, ...], dtype: Any) -> None:
    """Check that a chain takes such frames and that its results have the batch as their first axis.

    The last batch of a recording may be short: the slot computes the whole batch and trims the results. So results
    must grow with the batch. Results of a chain that takes single frames get the first axis when they are delivered.

    Raises
    ------
    TypeError, ValueError
        An operation does not take its input, or a result has another first axis.
    """
    if takes_single_frames(steps):
        if batch != 1:
            names = ", ".join(_named(step) for step in steps if step.operation.takes_single_frames)
            raise ValueError(f"{names} takes one frame at a time; use batch=1, not {batch}")
        _chain(steps, device, (1, *shape), np.dtype(dtype))
        return
    for size in (batch, batch + 1):
        for name, spec in _chain(steps, device, (size, *shape), np.dtype(dtype))[-1].outputs.items():
            if spec is not None and (not spec[0] or spec[0][0] != size):
                raise ValueError(
                    f"{_named(steps[-1])}: {name} has shape {spec[0]} for a batch of {size} frames; "
                    "a stream needs results with the batch as their first axis"
                )


def slot_bytes(
    steps: Sequence[Step], device: Device, batch: int, shape: tuple[int, ...], dtype: Any, *, zero_copy: bool
) -> int:
    """Return the memory of one slot on host and device together [bytes]."""
    chain = _chain(steps, device, (batch, *shape), np.dtype(dtype))
    arrays = sum(specs.nbytes for specs in chain)
    copies = 0 if zero_copy else nbytes_of((*chain[0].inputs, *chain[-1].outputs.values()))
    return arrays + copies + batch * np.dtype(np.int64).itemsize


def _chain(steps: Sequence[Step], device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> list[Specs]:
    """Return inputs and outputs of each step of a chain for batches of frames of one shape."""
    chain: list[Specs] = []
    for step in steps:
        taken = [(shape, dtype)] if not chain else _taken(step, dict(chain[-1].outputs))
        given = [_frame_spec(step, tuple(taken[0][0]), taken[0][1]), *taken[1:]]
        given += [(each.shape, each.dtype) for each in step.fixed]
        specs = step.operation.specs(device, *given[0])
        if not chain and len(specs.inputs) != len(given):
            raise ValueError(
                f"{_named(step)} takes {len(specs.inputs)} arrays, a stream's source gives one; give the others: "
                "Step(operation, fixed=(...))"
            )
        if list(specs.inputs) != [(tuple(shape), np.dtype(dtype)) for shape, dtype in given]:
            raise ValueError(
                f"{_named(step)} expects {list(specs.inputs)}, is given {given}; name what it takes: "
                "Step(operation, takes=(...))"
            )
        chain.append(specs)
    return chain


def _frame_spec(step: Step, shape: tuple[int, ...], dtype: Any) -> Spec:
    """Return the first input of a step: without the axis of the batch where the operation takes single frames."""
    return (shape[1:] if step.operation.takes_single_frames and shape[:1] == (1,) else shape), np.dtype(dtype)


def _taken(step: Step, fields: Mapping[str, Any]) -> list[Any]:
    """Return the inputs of a step: fields of the previous result."""
    computed = [name for name, value in fields.items() if value is not None]
    takes = step.takes or tuple(computed[:1])
    for name in takes:
        if name not in computed:
            raise ValueError(f"{_named(step)} takes {name!r}, the operation before computes {', '.join(computed)}")
    return [fields[name] for name in takes]


def _named(step: Step) -> str:
    return type(step.operation).__name__


def _set_fixed(step: Step, bound: Bound[Any]) -> None:
    """Copy the fixed arrays of a step to the last inputs of its bound operation."""
    for array, values in zip(bound.inputs[len(bound.inputs) - len(step.fixed) :], step.fixed, strict=True):
        array.set(np.ascontiguousarray(values), queue=bound.queue)


def map_arrays(result: R, change: Callable[[Any], Any]) -> R:
    """Apply a function to each array of a result; fields that are not computed stay ``None``."""
    kind: Any = type(result)
    new: R = kind(*(None if array is None else change(array) for array in result))
    return new


class Slot(Generic[R]):
    """Memory and bound operations of one batch.

    Attributes
    ----------
    frames : (batch, *shape) array
        Host memory that the source writes.
    result : Result of arrays
        Host memory that the consumer reads after `wait`.
    arrived : (batch,) int64 array
        Arrival times [ns].
    number, count : int
        Number of the first frame, and number of frames.
    asked, taken, filled, enqueued, delivered : int
        Times at which the producer requested a slot, got it, had filled it and had launched it, and at which the
        consumer got it [ns].
    """

    def __init__(
        self, steps: Sequence[Step], device: Device, queues: Queues, batch: int, shape: tuple[int, ...], dtype: Any
    ) -> None:
        self._queues = queues
        frame = _frame_spec(steps[0], (batch, *shape), dtype)
        self._first: Bound[Any] = steps[0].operation.bind(device, *frame, queue=queues.compute)
        _set_fixed(steps[0], self._first)
        self._rest: list[tuple[Bound[Any], tuple[Any, ...]]] = []
        last = self._first
        for step in steps[1:]:
            arrays = tuple(_taken(step, last.outputs._asdict()))
            first = _frame_spec(step, arrays[0].shape, arrays[0].dtype)
            last = step.operation.bind(device, *first, queue=queues.compute)
            _set_fixed(step, last)
            given = (arrays[0].reshape(first[0]), *arrays[1:], *last.inputs[len(arrays) :])
            self._rest.append((last, given))
        self._outputs: R = last.outputs
        self.arrived = np.zeros(batch, np.int64)
        self.number = self.count = 0
        self.asked = self.taken = self.filled = self.enqueued = self.delivered = 0
        self._begun: Any = None
        self._done: Any = None
        self.frames, self._host_result = self._host_side()
        self.frames = self.frames.reshape(batch, *shape)
        with_axis = takes_single_frames(steps)
        self.result: R = map_arrays(self._host_result, lambda each: each[None]) if with_axis else self._host_result

    def _host_side(self) -> tuple[HostArray, R]:
        raise NotImplementedError

    @property
    def inline(self) -> bool:
        """Whether all kernels run in the thread that launches the slot."""
        return self._first.inline and all(bound.inline for bound, _ in self._rest)

    @property
    def queue(self) -> Any:
        """Queue of the operations."""
        return self._queues.compute

    @property
    def queued(self) -> int:
        """Time at which the last operation was queued, on the device's clock [ns]; only after `wait`."""
        return int(self._done.profile.queued)

    def launch(self) -> None:
        """Enqueue copies and operations of the batch without waiting."""
        raise NotImplementedError

    def _compute(self, wait_for: Sequence[Any] | None = None) -> None:
        event = self._first(wait_for=wait_for)
        self._begun = self._first.begun if isinstance(self._first, BoundSequence) else event
        for bound, arrays in self._rest:
            event = bound(*arrays)
        self._done = event
        self._queues.compute.flush()

    def wait(self) -> None:
        """Wait until the results of the last launch are in host memory."""
        raise NotImplementedError

    def spans(self) -> dict[str, tuple[int, int]]:
        """Return start and end of each device stage on the device's clock [ns]; only after `wait`."""
        return {"compute": (self._begun.profile.start, self._done.profile.end)}

    def trimmed_result(self) -> R:
        """Return the result for the frames of the batch, which the last batch may not fill."""
        result = self.result
        if self.count == len(self.frames):
            return result
        return map_arrays(result, lambda array: array[: self.count])


class SharedSlot(Slot[R]):
    """Slot in memory that host and device share, without copies."""

    def _host_side(self) -> tuple[HostArray, R]:
        return host_view(self._first.inputs[0]), map_arrays(self._outputs, host_view)

    def launch(self) -> None:
        """Enqueue the operations."""
        self._compute()

    def wait(self) -> None:
        """Wait for the last operation."""
        self._done.wait()


class StagedSlot(Slot[R]):
    """Slot with pinned host memory and device memory, and copies in separate queues."""

    def _host_side(self) -> tuple[HostArray, R]:
        self._uploaded: Any = None
        self._downloaded: list[Any] = []
        return self._pinned(self._first.inputs[0]), map_arrays(self._outputs, self._pinned)

    def _pinned(self, array: Any) -> HostArray:
        """Return page-locked host memory, mapped until the last NumPy array over it is freed."""
        queue = self._queues.compute
        access: Any = cl.map_flags.READ | cl.map_flags.WRITE
        page_locked = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        try:
            memory = cl.Buffer(queue.context, page_locked, max(array.nbytes, 1))
            host: HostArray = cl.enqueue_map_buffer(queue, memory, access, 0, array.shape, array.dtype)[0]
        except cl.Error as error:
            raise DeviceMemoryError(
                f"the runtime cannot allocate {size_in_words(array.nbytes)} of page-locked memory "
                f"({str(error).splitlines()[0]}); use a smaller ring or batch"
            ) from error
        host.fill(0)
        return host

    def launch(self) -> None:
        """Enqueue upload, operations and downloads, ordered by events."""
        queues = self._queues
        target: Any = self._first.inputs[0].base_data
        self._uploaded = cl.enqueue_copy(queues.upload, target, self.frames, is_blocking=False)
        queues.upload.flush()
        self._compute([self._uploaded])
        after = [self._done]
        self._downloaded = [
            cl.enqueue_copy(queues.download, host, array.base_data, is_blocking=False, wait_for=after)
            for host, array in zip(self._host_result, self._outputs, strict=True)
            if array is not None
        ]
        queues.download.flush()

    def wait(self) -> None:
        """Wait for the last download."""
        cl.wait_for_events(self._downloaded)

    def spans(self) -> dict[str, tuple[int, int]]:
        """Return start and end of upload, compute and download on the device's clock [ns]."""
        up, down = self._uploaded.profile, self._downloaded
        return {
            "upload": (up.start, up.end),
            **super().spans(),
            "download": (down[0].profile.start, down[-1].profile.end),
        }
