"""The slots of a stream: each owns bound operations and the memory that they and the host use, made once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import HostArray, host_view
from gpuvision.host.bound import Bound
from gpuvision.host.device import Device
from gpuvision.host.launch import Spec
from gpuvision.host.operation import Operation

R = TypeVar("R", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Step:
    """An operation in a chain and which results of the one before it takes.

    Attributes
    ----------
    operation : Operation
    takes : tuple of str
        Fields of the previous result, in the order of this operation's inputs. May be left out for an operation of
        one input: it takes the first field that is computed.
    """

    operation: Operation[Any]
    takes: tuple[str, ...] = ()


class Queues:
    """The command queues of a stream: one where memory is shared; else uploads and downloads have their own."""

    def __init__(self, device: Device, *, zero_copy: bool, profiling: bool) -> None:
        self.compute = device.new_queue(profiling=profiling)
        self.upload = self.download = self.compute
        if not zero_copy:
            self.upload = device.new_queue(profiling=profiling)
            self.download = device.new_queue(profiling=profiling)

    def finish(self) -> None:
        """Wait for everything that was enqueued."""
        for queue in (self.upload, self.compute, self.download):
            queue.finish()


def check_chain(steps: Sequence[Step], device: Device, batch: int, shape: tuple[int, ...], dtype: Any) -> None:
    """Check that a chain takes such frames and that the batch is the leading axis of what comes out.

    The last batch of a recording may be short: it is computed whole and its results are cut. That needs results
    that grow with the batch.

    Raises
    ------
    TypeError, ValueError
        An operation does not take what it would be given.
    """
    for size in (batch, batch + 1):
        for name, spec in _specs(steps, device, (size, *shape), np.dtype(dtype)).items():
            if spec is not None and (not spec[0] or spec[0][0] != size):
                raise ValueError(
                    f"{_named(steps[-1])}: {name} has shape {spec[0]} for a batch of {size} frames; "
                    "a stream needs results with the batch as their first axis"
                )


def _specs(
    steps: Sequence[Step], device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Mapping[str, Spec | None]:
    launch = steps[0].operation.launch(device, shape, dtype)
    if len(launch.inputs) != 1:
        raise ValueError(f"{_named(steps[0])} takes {len(launch.inputs)} arrays, a stream's source gives one")
    for step in steps[1:]:
        given = _taken(step, dict(launch.outputs))
        launch = step.operation.launch(device, *given[0])
        expected = [(tuple(shape), np.dtype(dtype)) for shape, dtype in launch.inputs]
        if expected != [(tuple(shape), np.dtype(dtype)) for shape, dtype in given]:
            raise ValueError(
                f"{_named(step)} expects {expected}, is given {given}; name what it takes: Step(operation, takes=(...))"
            )
    return launch.outputs


def _taken(step: Step, fields: Mapping[str, Any]) -> list[Any]:
    """Pick what a step takes from the computed fields of the result before it."""
    computed = [name for name, value in fields.items() if value is not None]
    takes = step.takes or tuple(computed[:1])
    for name in takes:
        if name not in computed:
            raise ValueError(f"{_named(step)} takes {name!r}, the operation before computes {', '.join(computed)}")
    return [fields[name] for name in takes]


def _named(step: Step) -> str:
    return type(step.operation).__name__


def rebuilt(result: R, change: Callable[[Any], Any]) -> R:
    """Return the result with each of its arrays changed; what is not computed stays ``None``."""
    kind: Any = type(result)
    new: R = kind(*(None if array is None else change(array) for array in result))
    return new


class Slot(Generic[R]):
    """A place for one batch on its way from the source to the consumer.

    Attributes
    ----------
    frames : (batch, ...) array
        The source writes here.
    result : Result of arrays
        The consumer reads here when `wait` has returned.
    arrived : (batch,) int64 array
    number, count : int
        Of the first frame, and how many there are.
    asked, taken, filled, enqueued, delivered : int
        When the producer asked for a slot, had it, had filled it, had launched it; when the consumer had it [ns].
    """

    def __init__(
        self, steps: Sequence[Step], device: Device, queues: Queues, batch: int, shape: tuple[int, ...], dtype: Any
    ) -> None:
        self._queues = queues
        self._first: Bound[Any] = steps[0].operation.bind(device, (batch, *shape), dtype, queue=queues.compute)
        self._rest: list[tuple[Bound[Any], tuple[Any, ...]]] = []
        last = self._first
        for step in steps[1:]:
            arrays = tuple(_taken(step, last.outputs._asdict()))
            last = step.operation.bind(device, arrays[0].shape, arrays[0].dtype, queue=queues.compute)
            self._rest.append((last, arrays))
        self._outputs: R = last.outputs
        self.arrived = np.zeros(batch, np.int64)
        self.number = self.count = 0
        self.asked = self.taken = self.filled = self.enqueued = self.delivered = 0
        self._begun: Any = None
        self._done: Any = None
        self.frames, self.result = self._host_side()

    def _host_side(self) -> tuple[HostArray, R]:
        raise NotImplementedError

    def launch(self) -> None:
        """Enqueue everything that the batch needs, and return."""
        raise NotImplementedError

    def _compute(self, wait_for: Sequence[Any] | None = None) -> None:
        self._begun = event = self._first(wait_for=wait_for)
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

    def cut(self) -> R:
        """Return the results of the frames that are there."""
        result = self.result
        if self.count == len(self.frames):
            return result
        return rebuilt(result, lambda array: array[: self.count])


class SharedSlot(Slot[R]):
    """Host and device read and write the same memory: nothing is copied."""

    def _host_side(self) -> tuple[HostArray, R]:
        return host_view(self._first.inputs[0]), rebuilt(self._outputs, host_view)

    def launch(self) -> None:
        """Launch the operations on the slot's own memory."""
        self._compute()

    def wait(self) -> None:
        """Wait for the last operation."""
        self._done.wait()


class StagedSlot(Slot[R]):
    """Pinned host memory beside the device's, with copies on queues of their own."""

    def _host_side(self) -> tuple[HostArray, R]:
        self._uploaded: Any = None
        self._downloaded: list[Any] = []
        return self._pinned(self._first.inputs[0]), rebuilt(self._outputs, self._pinned)

    def _pinned(self, array: Any) -> HostArray:
        """Map page-locked memory for good; the mapping ends with the last NumPy array that shows it."""
        queue = self._queues.compute
        access: Any = cl.map_flags.READ | cl.map_flags.WRITE
        page_locked = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        memory = cl.Buffer(queue.context, page_locked, max(array.nbytes, 1))
        host: HostArray = cl.enqueue_map_buffer(queue, memory, access, 0, array.shape, array.dtype)[0]
        host.fill(0)
        return host

    def launch(self) -> None:
        """Enqueue upload, operations and downloads; events keep their order."""
        queues = self._queues
        target: Any = self._first.inputs[0].base_data
        self._uploaded = cl.enqueue_copy(queues.upload, target, self.frames, is_blocking=False)
        queues.upload.flush()
        self._compute([self._uploaded])
        after = [self._done]
        self._downloaded = [
            cl.enqueue_copy(queues.download, host, array.base_data, is_blocking=False, wait_for=after)
            for host, array in zip(self.result, self._outputs, strict=True)
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
