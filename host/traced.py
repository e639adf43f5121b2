"""Bound operation that records its launches in the active trace.

An operation binds this class only while a trace is active (`gpuvision.host.trace`). Calls of other bound
instances contain no code of the trace.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import pyopencl as cl

from gpuvision.host.arrays import HostArray
from gpuvision.host.bound import Bound
from gpuvision.host.stages import stage
from gpuvision.host.trace import active_trace

R = TypeVar("R", bound=tuple[Any, ...])


def _name(bound: Bound[Any]) -> str:
    return type(bound.operation).__name__


class TracedBound(Bound[R]):
    """Bound operation that records its launches and waits, on the host and on the device."""

    def _enqueue(self, given: tuple[Any, ...], wait_for: Sequence[Any] | None = None, *, waits: bool = False) -> Any:
        before = time.perf_counter_ns()
        event = super()._enqueue(given, wait_for, waits=waits)
        self._record("launch", "compute", [event], before)
        return event

    def prepare_team(self) -> None:
        """Do nothing: launches that are recorded have an event in the queue."""

    def run(self, *frames: Any, out: R | None = None) -> R:
        """Launch, wait and return the written arrays, as `Bound.run`."""
        with stage("launch and wait", _name(self)):
            return super().run(*frames, out=out)

    def on_host(self, frames: Sequence[HostArray], out: R | None = None) -> R:
        """Run on NumPy arrays and wait, as `Bound.on_host`."""
        with stage("run", _name(self)):
            return super().on_host(frames, out)

    def _run_shared(self, frames: Sequence[HostArray], targets: Sequence[HostArray]) -> Any:
        before = time.perf_counter_ns()
        event = super()._run_shared(frames, targets)
        self._record("launch and wait", "compute", [event], before)
        return event

    def _upload_frames(self, frames: Sequence[HostArray]) -> list[Any]:
        return self._recorded_copies("upload", lambda: super(TracedBound, self)._upload_frames(frames))

    def _download_results(self, targets: Sequence[HostArray]) -> list[Any]:
        return self._recorded_copies("download", lambda: super(TracedBound, self)._download_results(targets))

    def _finish(self) -> None:
        with stage("wait", _name(self)):
            super()._finish()

    def _recorded_copies(self, name: str, copy: Callable[[], list[Any]]) -> list[Any]:
        before = time.perf_counter_ns()
        events = copy()
        self._record(name, name, events, before)
        return events

    def _record(self, host_stage: str, device_stage: str, events: Sequence[Any], before: int) -> None:
        """Record a stage of the host that began at `before` [ns], and its commands in the queue."""
        trace = active_trace()
        if trace is None:
            return
        after = time.perf_counter_ns()
        trace.add_span(host_stage, _name(self), before, after)
        for event in events:
            trace.add_event(
                event.get_info(cl.event_info.COMMAND_QUEUE), device_stage, _name(self), event, before, after
            )
