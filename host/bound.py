"""Operations bound to a device, a queue and a shape: program, arrays, and the calls that launch the kernel."""

from __future__ import annotations

import collections
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NoReturn, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpuvision.host.argument_table import NoAddressError, address_of
from gpuvision.host.array_checks import check_apart, check_on_device, same_memory
from gpuvision.host.arrays import DeviceArray, HostArray, check_host, host_view, launch_memory, memory_of
from gpuvision.host.device import Device
from gpuvision.host.events import COMPLETE, are_complete, flush_queues
from gpuvision.host.failure import launch_failure
from gpuvision.host.launch import Launch, Launchable, Spec, describe_launch
from gpuvision.host.process import after_fork, check_process
from gpuvision.host.site import Site, can_use_table, new_site, upload_tables
from gpuvision.host.team import BRIEF_PAUSE_NS, PAUSE_NS, Team, core_query, new_counters

R = TypeVar("R", bound=tuple[Any, ...])

# Launches that move fewer bytes run inline. Measured: one core of a PC moves 1 MiB in about the time that PoCL needs to
# wake two worker threads.
_SHORT_BYTES = 1 << 20
# Limit for kernels that stream (`Launch.streams`) in several work-groups on Intel's runtime, if the caller waits
# (`Bound.run`). A caller that does not wait gives them to the workers, which run beside it. Measured on two cores for a
# PSD readout that moves 130 kB: 4 us in the calling thread, 5.5 us by the workers; about equal for 500 kB.
_SHORT_RUN_BYTES = 512 << 10
# Calls copy NumPy arrays of this size or less to and from the arrays of the instance, and read and write others in
# place; with Intel's runtime, which takes long to map memory of the host, they copy all. Measured on two cores beside
# other work, all arrays in place and all copied, for PSD readouts that move 0.17, 0.5, 1.7 and 17 MB: 33 and 22, 38 and
# 32, 101 and 110, 340 and 800 us with PoCL; 85 and 25, 165 and 35, 470 and 80, 4200 and 1000 us with Intel's runtime.
_COPIED_BYTES = 64 << 10
# Limit for launches whose tuned settings ask for the calling thread (`Launch.inline`). Chosen: half the bytes of the
# default batch of a stream, because the host work of a stream should overlap with the kernels.
MAX_INLINE_BYTES = 2 << 20


class Bound(Generic[R]):
    """Operation bound to a device, a queue and a shape; a call launches the kernel and allocates nothing.

    Attributes
    ----------
    inputs : tuple of pyopencl.array.Array
        Input arrays of the instance, or the arrays that `Operation.bind` was given: fill them (with `host_view` where
        memory is shared) and call without arguments.
    outputs : Result of pyopencl.array.Array
        Arrays that calls without ``out`` write; ``None`` for fields that the operation does not compute.
    """

    def __init__(
        self,
        operation: Launchable,
        device: Device,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        queue: Any,
        inputs: Sequence[DeviceArray] = (),
    ) -> None:
        launch = describe_launch(operation, device, shape, dtype)
        self.operation, self.device = operation, device
        self.queue = device.queue if queue is None else queue
        self._launch = launch
        self._set_specs(launch.inputs, launch.outputs)
        # `Device.wait` with its branch on the runtime resolved here: a short call takes only a few microseconds in
        # total.
        self._wait: Callable[[Any], object] = device.wait if device.kind == "pocl" else cl.Event.wait
        self._empty = not all(launch.global_size)
        self._team_slot = device.team_slot
        self.inputs = tuple(inputs) or self._new_inputs(launch.inputs)
        self.outputs = self.allocate()
        self._in_flight: collections.deque[tuple[Any, Any]] = collections.deque()
        after_inputs = enumerate(launch.outputs.values(), len(launch.inputs))
        # Indices of the input and output arrays among the kernel's arguments.
        self._places = [*range(len(launch.inputs)), *(place for place, spec in after_inputs if spec is not None)]
        self._own_outputs = self._computed(self.outputs)
        self._own = (*self.inputs, *self._own_outputs)
        # Largest NumPy array that calls copy [bytes]; none, where `inputs` are arrays of the caller.
        self._copied_bytes = 0 if inputs else sys.maxsize if device.kind == "intel" else _COPIED_BYTES
        self._array_specs = (*launch.inputs, *self._computed_specs.values())
        self._inline_site: Site | None = None
        self._site_beside_queue: Site | None = None  # the inline site, where the queue is not inline itself
        self._team: Team | None = None  # of launches that the caller waits for
        self._called_team: Team | None = None  # of others
        self._calls_inline = False  # whether a call that does not wait uses the inline site
        try:
            self._connect(launch)
            self._run_site = self._queue_site if self._inline_site is None else self._inline_site
            self._call_site = self._run_site if self._calls_inline else self._queue_site
            self._enqueue(self._own, waits=True).wait()
        except cl.Error as error:
            self._raise(error)

    def _set_specs(self, inputs: Sequence[Spec], outputs: Mapping[str, Spec | None]) -> None:
        """Set the specifications of the arrays, and which fields of the result are computed."""
        self._input_specs = inputs
        self._computed_specs = {name: spec for name, spec in outputs.items() if spec is not None}
        fields = self.operation.Result._fields
        self._absent = [outputs.get(name) is None for name in fields]
        self._computed_fields = [fields.index(name) for name in self._computed_specs]

    def _connect(self, launch: Launch) -> None:
        """Upload the tables, and build the kernel for calls that run inline."""
        device = self.device
        self._has_tables = can_use_table(device, self.operation, launch, self._own)
        self._tables = upload_tables(device, launch, shared=self._has_tables)
        known = [each for each in self._own if device.kind == "intel" and isinstance(each, cl.array.Array)]
        self._known = {id(each): launch_memory(device, each) for each in known}
        self._queue_is_inline = device.is_inline(self.queue)
        self._finish_queue = self.queue.finish
        if self._queue_is_inline and self._has_tables:
            self._inline_site, self._calls_inline = self._site_on(self.queue, in_table=True), True
        if self._queue_is_inline or not launch.passes_once or launch.inline is False:
            return
        is_short = launch.nbytes <= (_SHORT_BYTES if launch.inline is None else MAX_INLINE_BYTES)
        call_gains = device.call_gains_inline(groups=1 if launch.inline else launch.groups)
        self._calls_inline = is_short and call_gains and device.has_inline_queues
        if self._calls_inline or (launch.streams and launch.nbytes <= _SHORT_RUN_BYTES):
            inline_queue = device.inline_queue(self.queue)
            self._inline_site = None if inline_queue is None else self._site_on(inline_queue, in_table=self._has_tables)
            self._site_beside_queue = self._inline_site

    @functools.cached_property
    def _queue_site(self) -> Site:
        """Site of launches in the queue; with an inline site only launches that wait for an event need it."""
        return self._site_on(self.queue)

    def prepare_queue(self) -> None:
        """Build the kernel for the queue and launch it once, so that no later call compiles."""
        if self._site_beside_queue is not None and not self._empty:
            try:
                self._set_arrays(self._queue_site, self._own)
                cl.enqueue_nd_range_kernel(*self._queue_site.arguments).wait()
            except cl.Error as error:
                self._raise(error)

    def prepare_team(self) -> None:
        """Build the kernel for launches that the calling thread and waiting workers share (`Launch.by_team`)."""
        launch, device = self._launch, self.device
        if not launch.by_team or launch.groups == 1 or self._queue_is_inline or not device.has_teams:
            return
        try:
            self._team = self._new_team()
            # Intel's workers wake quickly: launches in the queue take no longer there.
            self._called_team = self._team if device.inline_device is not None else None
        except cl.Error as error:
            self._raise(error)

    def _new_inputs(self, specs: Sequence[Spec]) -> tuple[DeviceArray, ...]:
        """Return new input arrays, filled with zeros."""
        arrays = tuple(self.device.empty(shape, dtype, self.queue) for shape, dtype in specs)
        try:
            for array in arrays:
                self._clear(array)
        except cl.Error as error:
            self._raise(error)
        return arrays

    @property
    def inline(self) -> bool:
        """Whether a call runs the kernel in the calling thread.

        A call that must wait for an event runs in the queue. So does a call with an array in an OpenCL buffer where the
        kernel reads its arguments from a table (`gpuvision.host.argument_table`). On Intel's runtime `run` and calls
        with NumPy arrays run more kernels there, see `_SHORT_RUN_BYTES`.
        """
        return self._queue_is_inline or self._calls_inline

    @property
    def enqueue_arguments(self) -> tuple[Any, Any, tuple[int, ...], tuple[int, ...] | None]:
        """Arguments of `pyopencl.enqueue_nd_range_kernel` for a launch: queue, kernel, global size, local size.

        The arguments of the kernel are set. It may have one argument, a table of all: `gpuvision.host.argument_table`.
        """
        return self._call_site.arguments

    @functools.cached_property
    def _input_names(self) -> list[str]:
        """Names of the inputs in messages."""
        return self.operation.input_names(len(self.inputs))

    def allocate(self) -> R:
        """Return new device arrays for the outputs."""
        arrays = {
            name: self.device.empty(shape, dtype, self.queue) for name, (shape, dtype) in self._computed_specs.items()
        }
        return self._result(arrays)

    def __call__(self, *frames: DeviceArray, out: R | None = None, wait_for: Sequence[Any] | None = None) -> Any:
        """Enqueue the kernel and return its event.

        Parameters
        ----------
        *frames : pyopencl.array.Array
            Device arrays of the bound shape and dtype; without arguments, the instance's `inputs`.
        out : Result of pyopencl.array.Array, optional
            Arrays to write instead of `outputs`.
        wait_for : sequence of pyopencl.Event, optional
            Events that must be complete before the kernel starts.

        Returns
        -------
        pyopencl.Event

        Raises
        ------
        TypeError, ValueError
            Shape, dtype or device of an array differ from the bound shape, dtype or device.
        DeviceMemoryError, DeviceLostError
            The device has no memory or registers for the launch, or its context is lost.
        """
        given = self._own if not frames and out is None else self._given(frames, out)
        try:
            if self._called_team is not None and given is self._own and not wait_for:
                return self._call_team(self._called_team)
            return self._enqueue(given, wait_for)
        except cl.Error as error:
            self._raise(error)

    def run(self, *frames: DeviceArray, out: R | None = None) -> R:
        """Launch, wait with the least delay, and return the written arrays: `out` or `outputs`."""
        given = self._own if not frames and out is None else self._given(frames, out)
        try:
            if self._team is None or given is not self._own:
                self._run_alone(given)
            else:
                self._run_team(self._team)
        except cl.Error as error:
            self._raise(error)
        return self.outputs if out is None else out

    def _run_alone(self, given: tuple[Any, ...]) -> None:
        """Launch and wait."""
        event = self._enqueue(given, waits=True)
        if self._empty or not self._run_site.inline:
            self._wait(event)

    def _run_team(self, team: Team) -> None:
        """Launch and wait, with the waiting workers if there are any; after two quick launches they begin to wait."""
        if team.waits:
            self._finish_queue()
            team.lead()
            return
        follows = team.follows(PAUSE_NS)
        self._run_alone(self._own)
        team.note_launch()
        if follows:
            team.start()

    def _call_team(self, team: Team) -> Any:
        """Launch with the waiting workers if the caller does nothing else between launches; return the event."""
        follows = team.follows(BRIEF_PAUSE_NS)
        if follows and team.waits:
            self._finish_queue()
            return team.lead()
        event = self._enqueue(self._own)
        if follows:
            team.start()
        return event

    def _raise(self, error: cl.Error) -> NoReturn:
        """Raise the exception of gpuvision for an error of the runtime."""
        failure = launch_failure(error, self.device, self.queue, type(self.operation).__name__)
        if failure is error:
            raise error
        raise failure from error

    def _given(self, frames: tuple[DeviceArray, ...], out: R | None) -> tuple[Any, ...]:
        """Return the arrays of a call in the kernel's order; the instance's arrays if no arrays are given."""
        outputs = self._own_outputs if out is None or out is self.outputs else self._computed(out)
        return (*(frames or self.inputs), *outputs)

    def _enqueue(self, given: tuple[Any, ...], wait_for: Sequence[Any] | None = None, *, waits: bool = False) -> Any:
        """Launch the kernel and return its event; `waits`: the caller waits for the event at once."""
        if wait_for or self._empty:
            return self._enqueue_after(given, wait_for or ())
        site = self._run_site if waits else self._call_site
        if site is self._site_beside_queue:
            self._finish_queue()
        if given is not site.given:
            site = self._site_with(given, site)
        if self._team_slot.team is not None:
            self._team_slot.clear()
        event = cl.enqueue_nd_range_kernel(*site.arguments)
        if given is not self._own and not site.inline:
            self._hold(event, given)
            if waits and site is not self._run_site:
                self._wait(event)
        return event

    def _enqueue_after(self, given: tuple[Any, ...], wait_for: Sequence[Any]) -> Any:
        """Launch the kernel after some events, or enqueue a marker where there is nothing to compute.

        Launches that must wait for an event run in the queue, because PoCL hangs when one of its devices waits for an
        event of the other.
        """
        site = self._call_site
        if site is self._site_beside_queue and are_complete(wait_for):
            self._finish_queue()
        elif site is self._site_beside_queue:
            site = self._queue_site
        if given is not site.given:
            site = self._site_with(given, site)
        flush_queues(wait_for, self.queue)
        if self._empty:
            return cl.enqueue_marker(self.queue, wait_for=wait_for)
        if site.inline:
            cl.wait_for_events(wait_for)
            return cl.enqueue_nd_range_kernel(*site.arguments)
        self._team_slot.clear()
        event = cl.enqueue_nd_range_kernel(*site.arguments, wait_for=wait_for)
        if given is not self._own:
            self._hold(event, given)
        return event

    def on_host(self, frames: Sequence[HostArray], out: R | None = None) -> R:
        """Run on NumPy arrays and wait.

        The arrays are copied to `inputs` and from `outputs`, whose contents are lost; but where memory is shared, the
        kernel may read and write large arrays in place. A single kernel does so with all arrays if `inputs` were given
        to `bind`; a sequence overwrites these.
        """
        if len(frames) != len(self.inputs):
            raise self._wrong_count(len(frames))
        for name, frame, (shape, dtype) in zip(self._input_names, frames, self._input_specs, strict=True):
            check_host(frame, shape, dtype, name)
        if out is None:
            out = self._result({k: np.empty(shape, dtype) for k, (shape, dtype) in self._computed_specs.items()})
        targets = self._computed(out)
        for (name, (shape, dtype)), array in zip(self._computed_specs.items(), targets, strict=True):
            check_host(array, shape, dtype, f"out.{name}", is_written=True)
        check_apart(frames, targets, np.may_share_memory)
        if self._empty:
            return out
        try:
            if self.device.shares_memory:
                self._run_shared(frames, targets)
            else:
                self._run_with_copies(frames, targets)
        except cl.Error as error:
            self._raise(error)
        return out

    def _run_shared(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> Any:
        """Run in shared memory, wait, and return the event of the kernel: large arrays in place, others copied."""
        site, count = self._run_site, len(frames)
        self._team_slot.clear()
        self.queue.finish()  # an earlier call may still read the inputs
        if site.given is not self._own:
            self._set_arrays(site, self._own)
        for own, frame in zip(self.inputs, frames, strict=True):
            if 0 < frame.nbytes <= self._copied_bytes:
                host_view(own)[...] = frame
        in_place = {
            number: array for number, array in enumerate((*frames, *targets)) if array.nbytes > self._copied_bytes
        }
        site.given = tuple([None if number in in_place else array for number, array in enumerate(self._own)])
        if site.table is not None:
            for number, array in in_place.items():
                site.set_array(self._places[number], address_of(array))
            event = cl.enqueue_nd_range_kernel(*site.arguments)
        else:
            event = self._launch_in_buffers(site, in_place, count)
        site.queue.finish()
        # Replace the arguments before their arrays are freed: they must never dangle.
        self._set_arrays(site, self._own)
        for own, target in zip(self._own_outputs, targets, strict=True):
            if 0 < target.nbytes <= self._copied_bytes:
                target[...] = host_view(own)
        return event

    def _launch_in_buffers(self, site: Site, in_place: Mapping[int, HostArray], inputs: int) -> Any:
        """Launch with temporary buffers over NumPy arrays, by their number among all arrays; return the event."""
        buffers = {number: self._buffer_in_place(array, is_input=number < inputs) for number, array in in_place.items()}
        for number, buffer in buffers.items():
            site.set_array(self._places[number], buffer)
        event = cl.enqueue_nd_range_kernel(*site.arguments)
        for number, array in in_place.items():
            if number >= inputs:
                # Mapping makes the kernel's writes visible to the host; the address stays the same.
                mapped, _ = cl.enqueue_map_buffer(
                    site.queue, buffers[number], cl.map_flags.READ, 0, array.shape, array.dtype, is_blocking=False
                )
                mapped.base.release(site.queue)
        return event

    def _buffer_in_place(self, array: HostArray, *, is_input: bool) -> Any:
        flags = cl.mem_flags
        access = flags.READ_ONLY if is_input else flags.WRITE_ONLY
        return cl.Buffer(self.device.context, access | flags.USE_HOST_PTR, hostbuf=array)

    def _run_with_copies(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> None:
        self._upload_frames(frames)
        self()
        self._download_results(targets)
        self._finish()

    def _upload_frames(self, frames: Sequence[HostArray]) -> list[Any]:
        """Enqueue the copies to the inputs and return their events."""
        return [
            cl.enqueue_copy(self.queue, memory_of(array), frame, is_blocking=False)
            for array, frame in zip(self.inputs, frames, strict=True)
            if frame.size  # OpenCL refuses copies of zero bytes
        ]

    def _download_results(self, targets: Sequence[HostArray]) -> list[Any]:
        """Enqueue the copies from the outputs and return their events."""
        return [
            cl.enqueue_copy(self.queue, target, memory_of(array), is_blocking=False)
            for array, target in zip(self._computed(self.outputs), targets, strict=True)
            if target.size
        ]

    def _finish(self) -> None:
        self.queue.finish()

    def _computed(self, result: R) -> tuple[Any, ...]:
        """Return the computed fields of a result in the kernel's order; check that only the others are ``None``."""
        if [array is None for array in result] != self._absent:
            self._check_fields(result)
        return tuple([result[index] for index in self._computed_fields])

    def _result(self, arrays: Mapping[str, Any]) -> R:
        result: R = self.operation.Result(**{name: arrays.get(name) for name in self.operation.Result._fields})
        return result

    def _site_with(self, given: tuple[Any, ...], site: Site) -> Site:
        """Set the arrays of a launch at a site and return it; the queue's site, where an array has no known address."""
        try:
            self._set_arrays(site, given)
        except NoAddressError:
            site = self._queue_site
            self._set_arrays(site, given)
        return site

    def _set_arrays(self, site: Site, given: tuple[Any, ...]) -> None:
        """Set the arrays that the last launch at a site did not have as arguments of its kernel, after all checks."""
        if len(given) != len(self._array_specs):
            raise self._wrong_count(len(given) - len(self._array_specs) + len(self.inputs))
        context, known, in_table = self.device.context, self._known, site.table is not None
        changed: list[tuple[int, Any]] = []
        for array, before, place, (shape, dtype) in zip(
            given, site.given, self._places, self._array_specs, strict=True
        ):
            if array is not before:
                # The conditions of `check_on_device`, which costs as much again for its call.
                is_array = isinstance(array, cl.array.Array)
                if not is_array or array.dtype != dtype or array.shape != shape or array.context != context:
                    check_on_device(array, shape, dtype, self.device)
                changed.append((place, address_of(array) if in_table else known.get(id(array)) or memory_of(array)))
        # A memory object is repeated for three reasons: the same input twice and empty arrays are allowed, an output
        # that shares memory with another array is refused. Without a repetition the comparison of arrays is skipped.
        if changed and len({id(array.base_data) for array in given}) < len(given):
            inputs = len(self.inputs)
            check_apart(given[:inputs], given[inputs:], same_memory)
        for place, memory in changed:
            site.set_array(place, memory)
        site.given = given

    def _wrong_count(self, given: int) -> TypeError:
        return TypeError(f"{type(self.operation).__name__}: expected {len(self.inputs)} input arrays, got {given}")

    def _check_fields(self, out: R) -> None:
        for name, array in zip(self.operation.Result._fields, out, strict=True):
            if (array is not None) != (name in self._computed_specs):
                defect = "is missing" if array is None else "is not computed; expected None"
                raise ValueError(f"out.{name} {defect}")

    def _new_team(self) -> Team:
        launch, device = self._launch, self.device
        counters = new_counters(device, launch.global_size, device.compute_units)
        core = core_query() if device.pins_workers else None
        leading = replace(
            launch,
            global_size=(1,),
            local_size=(1,),
            defines={**launch.defines, "TEAM": None},
        )
        waiting = replace(leading, global_size=(device.compute_units - (core is None),))
        leader = self._site_on(device.inline_queue(self.queue), leading, in_table=self._has_tables)
        member = self._site_on(device.new_queue(), waiting, in_table=self._has_tables)
        for site in (leader, member):
            self._set_arrays(site, self._own)
        used = (leader, member, self._own)
        return Team(self._team_slot, counters, leader.arguments, member.arguments, used, core)

    def _clear(self, array: DeviceArray) -> None:
        if self.device.shares_memory:
            host_view(array).fill(0)
        elif array.nbytes:
            cl.enqueue_fill_buffer(self.queue, memory_of(array), np.zeros(1, np.uint8), 0, array.nbytes)

    def _site_on(self, queue: Any, launch: Launch | None = None, *, in_table: bool = False) -> Site:
        """Build the kernel for the device of a queue and set the arguments that calls do not change."""
        return new_site(self.device, self.operation, launch or self._launch, queue, self._tables, in_table=in_table)

    def _hold(self, event: Any, given: tuple[Any, ...]) -> None:
        """Keep references to arrays of the caller until the kernel has run."""
        flight = self._in_flight
        while flight and flight[0][0].command_execution_status <= COMPLETE:
            flight.popleft()
        flight.append((event, given))


def _refuse_calls() -> None:
    """Make the bound instances of a forked process raise: their kernels would never end. Costs nothing elsewhere."""

    def refuse(*_: object, **__: object) -> None:
        check_process()

    for name in ("_enqueue", "_run_team", "_call_team", "on_host"):
        setattr(Bound, name, refuse)


after_fork(_refuse_calls)
