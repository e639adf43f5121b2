"""Timeline of a program in Chrome's trace format, for chrome://tracing or ui.perfetto.dev.

``with Trace("trace.json"):`` records all work in the block: the stages of the host in a lane for each thread, the
commands of the device in a lane for each queue. The file is written when the block ends. A `Pipeline` also takes a
`Trace` without such a block; the trace then records this stream alone.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import pyopencl as cl

from gpuvision.host.events import COMPLETE
from gpuvision.host.kept import drop_bound
from gpuvision.host.outputs import Outputs, release, reserve
from gpuvision.host.stages import record_stages

_PRODUCER, _DEVICE, _CONSUMER = "producer", "device", "consumer"
# Lane of each stage of a stream.
_LANES = {
    "slot": _PRODUCER,
    "source": _PRODUCER,
    "launch": _PRODUCER,
    "upload": f"{_DEVICE} upload",
    "compute": f"{_DEVICE} compute",
    "download": f"{_DEVICE} download",
    "wait": _CONSUMER,
    "sink": _CONSUMER,
}
# Allowed contradiction between bounds of the offset of two clocks (chosen): [ns] for the resolution of the times, and
# five times the drift of two oscillators that are 1e-4 off each. Mesa's rusticl 22.3 counts 0, 1, 2, 3 instead of
# nanoseconds.
_OFFSET_ERROR, _CLOCK_DRIFT = 1_000_000, 1e-3
_PENDING = 512  # events whose times are not read yet; more are read as they complete (bounds the memory)


class _Span(NamedTuple):
    """Stage in a lane, with its start and end on the clock of the host [ns]."""

    lane: Hashable
    name: str
    start: int
    end: int
    arguments: dict[str, Any]


class _Enqueued(NamedTuple):
    """Command in a queue: event, and the times before and after the call that enqueued it [ns]."""

    queue: Any
    name: str
    subject: str
    event: Any
    before: int
    after: int


class _Executed(NamedTuple):
    """Completed command: times on the clock of the device [ns]."""

    command: _Enqueued
    queued: int
    start: int
    end: int


class Trace:
    """Timeline of the stages of the host and of the device.

    As a context manager it records everything that the process does in the block, and writes the file at the end. After
    an exception it writes no file. A queue has device times if it was made in the block or with ``profiling=True``;
    a `Device` makes its queue when it is first asked for.

    Parameters
    ----------
    path : path
        JSON file to write.
    limit : int
        Number of spans to keep, which bounds the memory of a long run. Default 200 000.
    overwrite : bool
        Whether an existing file may be replaced that no earlier trace wrote. Default False.

    Notes
    -----
    Recording a launch takes a few microseconds. Operations that are bound while no trace is active run the same code as
    without this class.
    """

    def __init__(self, path: str | Path, limit: int = 200_000, *, overwrite: bool = False) -> None:
        self.path, self.limit, self.overwrite = Path(path), limit, overwrite
        self._lock = threading.Lock()
        self._spans: list[_Span] = []
        self._pending: list[_Enqueued] = []
        self._executed: list[_Executed] = []
        self._count = self._left_out = self._without_times = 0
        self._lanes: dict[Hashable, str] = {}
        self._streams: dict[int, frozenset[Any]] = {}  # queues of the open streams
        # Device stages of the open streams, with the offset of the clocks by which each was moved to the host's clock.
        self._on_device: dict[int, list[tuple[int, _Span]]] = {}

    def __enter__(self) -> Trace:
        """Check that the file can be written, and record from now on."""
        global _active
        if _active is not None:
            raise ValueError(f"a trace is active already, which writes {_active.path}; end it first")
        Outputs("trace", overwrite=self.overwrite).claim(self.path)
        reserve(self.path)
        drop_bound()  # kept instances record nothing
        _active = self
        record_stages(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop, and write the file; after an exception write no file."""
        global _active
        _active = None
        record_stages(None)
        release(self.path)
        drop_bound()
        if error is None:
            self.write()

    @property
    def is_active(self) -> bool:
        """Whether the trace records the work of the process, not only of the streams that it was given to."""
        return _active is self

    @property
    def is_full(self) -> bool:
        """Whether the limit of spans is reached."""
        return self._count >= self.limit

    @contextlib.contextmanager
    def span(self, name: str, subject: str = "") -> Iterator[None]:
        """Record the block as a stage in the lane of this thread.

        Parameters
        ----------
        name : str
            Name of the stage.
        subject : str, optional
            Operation or file of the stage.
        """
        start = time.perf_counter_ns()
        try:
            yield
        finally:
            self.add_span(name, subject, start, time.perf_counter_ns())

    def add_span(self, name: str, subject: str, start: int, end: int) -> None:
        """Add a stage of this thread with its start and end on the clock of the host [ns]."""
        thread = threading.current_thread()
        lane = ("thread", thread.name, thread.ident)
        with self._lock:
            self._lanes.setdefault(lane, "host" if thread is threading.main_thread() else f"thread {thread.name}")
            self._keep(_Span(lane, name, start, end, {"of": subject} if subject else {}))

    def add_event(self, queue: Any, name: str, subject: str, event: Any, before: int, after: int) -> None:
        """Add a command of a queue.

        Parameters
        ----------
        queue : pyopencl.CommandQueue
        name, subject : str
            Name of the stage, and its operation.
        event : pyopencl.Event
            Event of the command. Without device times, the command is left out.
        before, after : int
            Times before and after the call that enqueued the command, on the clock of the host [ns].
        """
        with self._lock:
            if self._has_room(1):
                self._pending.append(_Enqueued(queue, name, subject, event, before, after))
            if len(self._pending) >= _PENDING:
                self._read_times(wait=False)

    def begin_stream(self, *queues: Any) -> int:
        """Return the number of a new stream. Launches in its queues are recorded by the stream alone."""
        with self._lock:
            number = next(each for each in range(1, len(self._streams) + 2) if each not in self._streams)
            self._streams[number] = frozenset(queues)
            return number

    def end_stream(self, number: int) -> None:
        """Free the number, the lanes and the queues of a stream.

        The next stream takes the number and the lanes. An operation that is bound to one of the queues from now on
        records its launches.
        """
        with self._lock:
            self._streams.pop(number, None)
            self._spans += _with_one_offset(self._on_device.pop(number, []))

    def is_of_stream(self, queue: Any) -> bool:
        """Return whether a queue belongs to a stream, which records its launches."""
        with self._lock:
            return any(queue in queues for queues in self._streams.values())

    def add(
        self, spans: dict[str, tuple[int, int]], number: int, count: int, *, stream: int = 1, offset: int = 0
    ) -> None:
        """Add the stages of a batch of a stream.

        Parameters
        ----------
        spans : dict of str to (int, int)
            Start and end of each stage on the clock of the host [ns].
        number, count : int
            Number of the first frame, and number of frames.
        stream : int
            Number of the stream, of `begin_stream`. Default 1.
        offset : int
            Estimated offset of the clocks that the times of the device contain [ns]. Estimates become better: the file
            has all times of the device with the last estimate of the stream. Default 0.
        """
        with self._lock:
            if not self._has_room(len(spans)):
                return
            for stage, (start, end) in spans.items():
                lane = _LANES[stage]
                span = _Span(("stream", stream, lane), stage, start, end, {"frame": number, "frames": count})
                if lane in (_PRODUCER, _CONSUMER):
                    self._spans.append(span)
                else:
                    self._on_device.setdefault(stream, []).append((offset, span))
            self._count += len(spans)
            for each in dict.fromkeys(_LANES.values()):
                self._lanes.setdefault(("stream", stream, each), each if stream == 1 else f"{each}, stream {stream}")

    def _keep(self, span: _Span) -> None:
        if self._has_room(1):
            self._spans.append(span)
            self._count += 1

    def _has_room(self, count: int) -> bool:
        """Return whether `count` more spans fit the limit; if not, count them as left out."""
        fits = self._count + len(self._pending) + count <= self.limit
        self._left_out += 0 if fits else count
        return fits

    def _read_times(self, *, wait: bool) -> None:
        """Read the device times of the completed commands, or wait for all commands.

        Commands of a queue complete in order: the commands after the first incomplete command are not asked.
        """
        left: list[_Enqueued] = []
        busy: set[Any] = set()
        for command in self._pending:
            try:
                if wait:
                    command.event.wait()
                elif command.queue in busy or command.event.command_execution_status > COMPLETE:
                    busy.add(command.queue)
                    left.append(command)
                    continue
                profile = command.event.profile
                times = _Executed(command, profile.queued, profile.start, profile.end)
            except cl.Error:  # the queue does not measure times, or the command failed
                self._without_times += 1
                continue
            self._executed.append(times)
            self._count += 1
        self._pending = left

    def _device_spans(self) -> tuple[list[_Span], int]:
        """Return the commands of all queues on the clock of the host, and the number of commands left out.

        A command is queued during the call that enqueues it. Each command therefore bounds the offset between the
        clocks of a queue and of the host from both sides; the estimate is the middle of the tightest bounds. Spans of a
        queue have one offset, so that they overlap no more than the device reports. Where bounds contradict each other,
        the runtime does not report clock times, and the commands of the queue are left out.
        """
        queues: dict[Any, list[_Executed]] = {}
        for each in self._executed:
            queues.setdefault(each.command.queue, []).append(each)
        spans, left_out = [], 0
        for number, (queue, executed) in enumerate(queues.items(), 1):
            low = max(each.command.before - each.queued for each in executed)
            high = min(each.command.after - each.queued for each in executed)
            begun = [each.command.before for each in executed]
            if low - high > _OFFSET_ERROR + _CLOCK_DRIFT * (max(begun) - min(begun)):
                left_out += len(executed)
                continue
            offset = (low + high) // 2
            self._lanes[queue] = f"{_DEVICE} {queue.device.name.strip()}, queue {number}"
            for each in executed:
                arguments = {"of": each.command.subject}
                spans.append(_Span(queue, each.command.name, each.start + offset, each.end + offset, arguments))
        return spans, left_out

    def write(self) -> None:
        """Write the file atomically.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier trace; see `gpuvision.host.outputs`.
        """
        with self._lock:
            self._read_times(wait=True)
            on_device, without_clock = self._device_spans()
            of_streams = [span for spans in self._on_device.values() for span in _with_one_offset(spans)]
            spans = [*self._spans, *of_streams, *on_device]
            without_times = self._without_times + without_clock
            beyond = self._left_out
            lanes = _lanes_of(spans, self._lanes)
        origin = min((span.start for span in spans), default=0)
        events: list[dict[str, Any]] = [
            {"ph": "M", "name": "thread_name", "pid": 1, "tid": tid, "args": {"name": name}}
            for tid, (name, _) in enumerate(lanes)
        ]
        for tid, (_, inside) in enumerate(lanes):
            for span in inside:
                event = {"ph": "X", "name": span.name, "pid": 1, "tid": tid, "args": span.arguments}
                events.append(event | {"ts": (span.start - origin) / 1e3, "dur": (span.end - span.start) / 1e3})
        left_out = {"spans beyond the limit": beyond, "commands without device times": without_times}
        tree = {"traceEvents": events, "displayTimeUnit": "ns", "otherData": left_out}
        Outputs("trace", overwrite=self.overwrite).write_text(self.path, json.dumps(tree))


def _with_one_offset(spans: Sequence[tuple[int, _Span]]) -> list[_Span]:
    """Return the device stages of a stream, moved to the host's clock by the last estimate of the offset."""
    last = spans[-1][0] if spans else 0
    return [span._replace(start=span.start + last - used, end=span.end + last - used) for used, span in spans]


def _lanes_of(spans: Sequence[_Span], names: Mapping[Hashable, str]) -> list[tuple[str, list[_Span]]]:
    """Return the name and the spans of each lane in the file.

    The viewers draw a span inside another one as its part. Only stages of a thread of the host nest; commands of a
    device and batches of a stream that overlap are computed at the same time, and go to further lanes of the same name.
    """
    lanes = []
    for lane, name in names.items():
        inside = [each for each in spans if each.lane == lane]
        parts = _nested_parts(inside) if _may_nest(lane) else _disjoint_parts(inside)
        lanes += [(name if not number else f"{name} ({number + 1})", part) for number, part in enumerate(parts)]
    return lanes


def _may_nest(lane: Hashable) -> bool:
    """Return whether the spans of a lane are the stages of one thread."""
    return isinstance(lane, tuple) and lane[0] == "thread"


def _nested_parts(spans: Sequence[_Span]) -> list[list[_Span]]:
    """Return the spans in parts; two spans of a part are apart, or one contains the other."""
    parts: list[list[_Span]] = [[]]
    ends: list[list[int]] = [[]]  # ends of the spans of each part that contain the current time
    for span in sorted(spans, key=lambda each: (each.start, -each.end)):
        for open_ends in ends:
            while open_ends and open_ends[-1] <= span.start:
                open_ends.pop()
        place = next((n for n, each in enumerate(ends) if not each or each[-1] >= span.end), len(parts))
        if place == len(parts):
            parts.append([])
            ends.append([])
        parts[place].append(span)
        ends[place].append(span.end)
    return parts


def _disjoint_parts(spans: Sequence[_Span]) -> list[list[_Span]]:
    """Return the spans in parts; the spans of a part are apart."""
    parts: list[list[_Span]] = [[]]
    for span in sorted(spans, key=lambda each: (each.start, each.end)):
        place = next((part for part in parts if not part or part[-1].end <= span.start), None)
        if place is None:
            place = []
            parts.append(place)
        place.append(span)
    return parts


_active: Trace | None = None


def active_trace() -> Trace | None:
    """Return the trace that records the work of the process; None without one."""
    return _active


def records_launches(queue: Any) -> bool:
    """Return whether an operation bound to the queue must record its launches. A stream records its own launches."""
    return _active is not None and not _active.is_of_stream(queue)
