"""Sequence of operations that runs as one operation: all launches are enqueued without work of the host in between.

The stages of a sequence pass arrays on in device memory. The inputs of a stage are inputs of the sequence or outputs of
any earlier stage, so that several stages read the same frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pyopencl as cl

from gpuvision.host import stages
from gpuvision.host.arrays import DeviceArray, HostArray, host_view
from gpuvision.host.bound import Bound
from gpuvision.host.device import Device
from gpuvision.host.launch import Spec, Specs, check_shape, nbytes_of
from gpuvision.host.operation import Operation
from gpuvision.host.trace import records_launches

R = TypeVar("R", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Stage:
    """Operation of a sequence, and the arrays that it reads.

    Attributes
    ----------
    name : str
        Name of the stage; its outputs are the arrays ``NAME.FIELD``.
    operation : Operation
    takes : tuple of str
        Arrays in the order of the operation's inputs: inputs of the sequence by their names, or ``NAME.FIELD`` of an
        earlier stage.
    """

    name: str
    operation: Operation[Any]
    takes: tuple[str, ...]


@dataclass(frozen=True)
class Layout:
    """Stages of a sequence for inputs of one shape.

    Attributes
    ----------
    inputs : mapping of str to (shape, dtype)
        Inputs of the sequence by name; the first one is the frame.
    stages : sequence of Stage
        In the order in which they run.
    outputs : mapping of str to str or None
        Array ``NAME.FIELD`` of each field of the result; ``None`` for a field that is not computed.
    """

    inputs: Mapping[str, Spec]
    stages: Sequence[Stage]
    outputs: Mapping[str, str | None]


class OperationSequence(Operation[R]):
    """Base class of operations that consist of several launches.

    A subclass sets `Result` and describes in `layout` its inputs, its stages, and where its results come from. It is
    called and bound like any other operation.
    """

    def layout(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Layout:
        """Check shape and dtype of the first input, and return the stages for it.

        Raises
        ------
        TypeError, ValueError
            The sequence does not take such input.
        """
        raise NotImplementedError

    def specs(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Specs:
        """Return the inputs and outputs, and the memory of all stages; see `Operation.specs`."""
        layout = self.layout(device, shape, dtype)
        arrays: dict[str, Spec | None] = dict(layout.inputs)
        for stage in layout.stages:
            found = stage.operation.specs(device, *_first(stage, arrays))
            given = tuple(arrays.get(name) for name in stage.takes)
            if given != tuple(found.inputs):
                raise ValueError(f"stage {stage.name!r} expects {found.inputs}, is given {given}")
            arrays |= {f"{stage.name}.{field}": spec for field, spec in found.outputs.items()}
        outputs = {field: None if name is None else arrays[name] for field, name in layout.outputs.items()}
        return Specs(tuple(layout.inputs.values()), outputs, nbytes_of(arrays.values()))

    def _bound_to(
        self,
        device: Device,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        queue: Any,
        inputs: Sequence[DeviceArray],
    ) -> Bound[R]:
        kind: type[BoundSequence[R]] = TracedSequence if records_launches(queue) else BoundSequence
        return kind(self, device, shape, dtype, queue, inputs)


class BoundSequence(Bound[R]):
    """Sequence bound to a device, a queue and a shape; a call enqueues all launches and allocates nothing.

    Attributes
    ----------
    inputs, outputs
        As in `Bound`, of the whole sequence.
    stages : mapping of str to Bound
        Bound operation of each stage, by name.
    begun : pyopencl.Event
        Event of the first launch of the last call.
    """

    def __init__(
        self,
        operation: OperationSequence[R],
        device: Device,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        queue: Any,
        inputs: Sequence[DeviceArray] = (),
    ) -> None:
        check_shape(type(operation).__name__, shape)
        layout = operation.layout(device, shape, dtype)
        specs = operation.specs(device, shape, dtype)
        self.operation, self.device = operation, device
        self.queue = device.queue if queue is None else queue
        self._empty = False
        self._layout = layout
        self._set_specs(specs.inputs, specs.outputs)
        self.inputs = tuple(inputs) or self._new_inputs(specs.inputs)
        arrays: dict[str, Any] = dict(zip(layout.inputs, self.inputs, strict=True))
        self.stages: dict[str, Bound[Any]] = {}
        for stage in layout.stages:
            given = tuple(arrays[name] for name in stage.takes)
            first = _first(stage, {stage.takes[0]: (given[0].shape, given[0].dtype)})
            bound = stage.operation.bind(device, *first, queue=self.queue, inputs=given)
            self.stages[stage.name] = bound
            arrays |= {f"{stage.name}.{field}": array for field, array in bound.outputs._asdict().items()}
        self._bounds = tuple(self.stages.values())
        self.begun: Any = None
        self.outputs = self._result({field: arrays[name] for field, name in layout.outputs.items() if name is not None})

    def prepare_queue(self) -> None:
        """Do nothing: `Operation.bind` has prepared the stages."""

    def prepare_team(self) -> None:
        """Do nothing: stages follow each other too quickly for workers to wait for one of them."""

    @property
    def inline(self) -> bool:
        """Whether all stages run in the calling thread."""
        return all(bound.inline for bound in self._bounds)

    @property
    def enqueue_arguments(self) -> tuple[Any, Any, tuple[int, ...], tuple[int, ...] | None]:
        """Raise an error: a sequence has several launches; see `stages`."""
        raise TypeError("a sequence has several launches; use enqueue_arguments of each of its stages")

    def __call__(self, *frames: DeviceArray, out: R | None = None, wait_for: Sequence[Any] | None = None) -> Any:
        """Enqueue all stages and return the event of the last one; arguments as in `Bound`."""
        if frames or out is not None:
            return self._with(frames or self.inputs, self.outputs if out is None else out, wait_for)
        self.begun = event = self._bounds[0](wait_for=wait_for)
        for bound in self._bounds[1:]:
            event = bound()
        return event

    def _with(self, frames: tuple[DeviceArray, ...], out: R, wait_for: Sequence[Any] | None) -> Any:
        """Enqueue all stages on arrays of the caller."""
        if len(frames) != len(self.inputs):
            raise self._wrong_count(len(frames))
        self._check_fields(out)
        arrays: dict[str, Any] = dict(zip(self._layout.inputs, frames, strict=True))
        wanted = {name: getattr(out, field) for field, name in self._layout.outputs.items() if name is not None}
        event = None
        for stage, bound in zip(self._layout.stages, self._bounds, strict=True):
            own = bound.outputs._asdict()
            result = type(bound.outputs)(
                **{field: wanted.get(f"{stage.name}.{field}", array) for field, array in own.items()}
            )
            given = tuple(arrays[name] for name in stage.takes)
            is_first = event is None
            event = bound(*given, out=result, wait_for=wait_for if is_first else None)
            self.begun = event if is_first else self.begun
            arrays |= {f"{stage.name}.{field}": array for field, array in result._asdict().items()}
        return event

    def run(self, *frames: DeviceArray, out: R | None = None) -> R:
        """Enqueue all stages, wait, and return the written arrays: `out` or `outputs`."""
        event = self(*frames, out=out)
        try:
            self.device.wait(event)
        except cl.Error as error:
            self._raise(error)
        return self.outputs if out is None else out

    def _run_shared(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> Any:
        """Copy to the inputs, run, and copy from the outputs: stages keep the arrays to which they are bound."""
        self.queue.finish()  # an earlier call may still read the inputs
        for array, frame in zip(self.inputs, frames, strict=True):
            host_view(array)[...] = frame
        event = self()
        self.device.wait(event)
        for array, target in zip(self._computed(self.outputs), targets, strict=True):
            target[...] = host_view(array)
        return event


class TracedSequence(BoundSequence[R]):
    """Bound sequence that records its calls; its stages record their launches."""

    def __call__(self, *frames: Any, out: R | None = None, wait_for: Sequence[Any] | None = None) -> Any:
        """Enqueue all stages, as `BoundSequence.__call__`."""
        with stages.stage("launch sequence", type(self.operation).__name__):
            return super().__call__(*frames, out=out, wait_for=wait_for)

    def run(self, *frames: Any, out: R | None = None) -> R:
        """Enqueue all stages, wait and return the written arrays, as `BoundSequence.run`."""
        with stages.stage("launch and wait", type(self.operation).__name__):
            return super().run(*frames, out=out)

    def on_host(self, frames: Sequence[HostArray], out: R | None = None) -> R:
        """Run on NumPy arrays and wait, as `Bound.on_host`."""
        with stages.stage("run", type(self.operation).__name__):
            return super().on_host(frames, out)


def _first(stage: Stage, arrays: Mapping[str, Spec | None]) -> Spec:
    """Return shape and dtype of the first input of a stage."""
    spec = arrays.get(stage.takes[0])
    if spec is None:
        raise ValueError(f"stage {stage.name!r} takes {stage.takes[0]!r}, which no earlier stage computes")
    return spec
