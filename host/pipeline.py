"""Streams of frames: source -> upload -> operations -> download -> consumer, over a fixed ring of slots.

A stream has two threads and two queues of slots. The *producer* (a thread of the stream) takes a free slot, asks the
source to fill it, launches its operations, and puts it into the queue of launched slots. The *consumer* (the caller's
thread) takes the oldest launched slot, waits for its device event, and reads the results; its next step gives the slot
back. Slots carry their events and times, and no frame allocates, compiles or binds anything. Where host and device
share memory, the source writes the kernel's input and the consumer reads the kernel's output.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import HostArray
from gpuvision.host.batch import Batch, default_batch
from gpuvision.host.device import Device
from gpuvision.host.device_clock import DeviceClock
from gpuvision.host.errors import StreamError
from gpuvision.host.failure import launch_failure
from gpuvision.host.memory import free_bytes
from gpuvision.host.operation import Operation
from gpuvision.host.report import StreamReport, StreamStatistics
from gpuvision.host.ring import (
    SharedSlot,
    Slot,
    StagedSlot,
    Step,
    check_chain,
    queues_of,
    slot_bytes,
    steps_of,
    takes_single_frames,
)
from gpuvision.host.sources import ArraySource, Clock, Source
from gpuvision.host.stalls import StallRecorder
from gpuvision.host.text import size_in_words
from gpuvision.host.trace import Trace, active_trace

Policy = Literal["block", "drop_oldest", "raise"]
R = TypeVar("R", bound=tuple[Any, ...])


@dataclass(frozen=True, kw_only=True)
class PipelineLimits:
    """Limits of `Pipeline`.

    Attributes
    ----------
    stop_timeout : float
        Longest time [s] that the end of a stream waits for the source to return from a read. Chosen. Default 10.0.
    """

    stop_timeout: float = 10.0


class Pipeline(Generic[R]):
    """Stream of frames through operations: ``with Pipeline(source, operation) as stream: for batch in stream: ...``.

    Parameters
    ----------
    source : Source or array
        An array holds frames along its first axis. The stream closes the source.
    operation : Operation, Step, or sequence of both
        Operations of a chain pass their arrays on in device memory; the stream delivers the result of the last one.
        Each result must have the batch as its first axis. Operations of one frame, such as `RulerEdges`, run with a
        batch of 1; their results are delivered with a first axis of length 1. `Step` gives an operation further inputs
        that are the same for all frames.
    device : Device, optional
        `Device.best` by default.
    batch : int, optional
        Frames per launch, see `plan_stream`. Default: about 4 MB of frames, for recordings without a rate; 1 where an
        operation takes single frames.
    ring : int
        Number of slots, at least 2: the consumer holds one, the others are filled, computed, or wait. Under
        ``"drop_oldest"`` the ring bounds the age of the delivered frames.
    policy : {"block", "drop_oldest", "raise"}
        Action when a frame arrives and no slot is free: ``"block"`` makes the frame wait, ``"drop_oldest"`` discards
        the oldest batch that the consumer has not requested, ``"raise"`` ends the stream with a `StreamError`.
    zero_copy : bool, optional
        Whether host and device use the same memory; otherwise pinned memory and copies. Default: True where the device
        shares memory.
    inline : bool
        Whether kernels run in the stream's thread (`Device.new_queue`) instead of the worker threads of the device.
        Small frames take less processor time so, and the stream does not wait for threads that compete with the
        producer for the processor; `plan_stream` measures both. Short launches run inline in any case.
    profile : bool
        Whether to measure the times on the device.
    trace : Trace, optional
        Timeline of this stream, written at its end; turns ``profile`` on. Default: the active trace, if there is one,
        whose block writes the file.
    warm_up : int, optional
        Number of batches at the start that the report leaves out; one per slot by default.
    clock : callable
        Clock in nanoseconds, the same clock as the clock of the source.
    limits : PipelineLimits
        Limits of waiting.

    Raises
    ------
    TypeError, ValueError
        The operation does not take such frames, or a parameter is out of its range.
    StreamError
        The ring takes more memory than is free.
    """

    def __init__(
        self,
        source: Source | HostArray,
        operation: Operation[R] | Step | Sequence[Operation[Any] | Step],
        *,
        device: Device | None = None,
        batch: int | None = None,
        ring: int = 4,
        policy: Policy = "block",
        zero_copy: bool | None = None,
        inline: bool = False,
        profile: bool = False,
        trace: Trace | None = None,
        warm_up: int | None = None,
        clock: Clock = time.perf_counter_ns,
        limits: PipelineLimits = PipelineLimits(),
    ) -> None:
        self._limits = limits
        self.source = _source(source)
        self.ring, self.policy = _whole(ring, "ring", 2, " slots"), policy
        self.trace = active_trace() if trace is None else trace
        self._writes_trace = trace is not None and not trace.is_active
        self.device = Device.best() if device is None else device
        self.zero_copy = self.device.shares_memory if zero_copy is None else zero_copy
        self.inline = inline
        self.profile = profile or self.trace is not None
        self._steps = steps_of(operation)
        usual = 1 if takes_single_frames(self._steps) else default_batch(self.source, self.ring)
        self.batch = usual if batch is None else _whole(batch, "batch", 1)
        self._clock = clock
        self._check()
        self._statistics = StreamStatistics(self.ring if warm_up is None else warm_up)
        self._stalls = StallRecorder(self._clock)
        self._dropped = 0
        self._state: Literal["new", "open", "closed"] = "new"

    def _check(self) -> None:
        if self.policy not in ("block", "drop_oldest", "raise"):
            raise ValueError(f"Pipeline.policy is {self.policy!r}, expected 'block', 'drop_oldest' or 'raise'")
        if self.zero_copy and not self.device.shares_memory:
            raise ValueError(f"device {self.device.label} does not share memory with the host; use zero_copy=None")
        if self.inline and not self.device.has_inline_queues:
            raise ValueError(f"device {self.device.label} has no inline queues; use inline=False")
        source = self.source
        check_chain(self._steps, self.device, self.batch, source.shape, source.dtype)
        size = slot_bytes(self._steps, self.device, self.batch, source.shape, source.dtype, zero_copy=self.zero_copy)
        free = free_bytes(self.device)
        if self.ring * size > free:
            raise StreamError(
                f"a ring of {self.ring} x {self.batch} frames takes {size_in_words(self.ring * size)}, "
                f"{size_in_words(free)} are free; use a smaller ring or batch"
            )

    def __enter__(self) -> Pipeline[R]:
        """Bind the slots and start the producer."""
        if self._state != "new":
            raise StreamError("a stream runs once; make another Pipeline")
        self._state = "open"
        kind = SharedSlot if self.zero_copy else StagedSlot
        source = self.source
        try:
            self._queues = queues_of(
                self.device, self.ring, zero_copy=self.zero_copy, profiling=self.profile, inline=self.inline
            )
            if self.trace is not None:
                self._stream_number = self.trace.begin_stream(*(queue for each in self._queues for queue in each.all))
            slots: list[Slot[R]] = [
                kind(self._steps, self.device, queues, self.batch, source.shape, source.dtype)
                for queues in self._queues
            ]
            self._computes_inline = slots[0].inline
            self._device_clock = DeviceClock(slots[0], self._clock) if self.profile else None
        except BaseException:
            self._state = "closed"
            source.close()
            raise
        # The producer takes the slot that was given back last, because it is still in the cache. Each free slot has a
        # token, for which the producer waits.
        self._free: list[Slot[R]] = []
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[Slot[R] | None] = queue.SimpleQueue()
        for slot in slots:
            self._give_back(slot)
        self._held: Slot[R] | None = None
        self._held_spans: dict[str, tuple[int, int]] = {}
        self._failure: StreamError | None = None
        self._reported = False  # whether the loop has raised an error
        self._stopping = self._ended = False
        self._statistics.started = self._clock()
        self._stalls.start(self._statistics.started)
        self._producer = threading.Thread(target=self._produce, name="gpuvision stream", daemon=True)
        self._producer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the stream; after an exception, a failure to close it becomes a note of the exception."""
        try:
            self.close()
        except Exception as second:
            if error is None:
                raise
            error.add_note(f"closing the stream failed, too: {second}")

    def stop(self) -> None:
        """Stop reading frames; batches in the ring are still delivered, then the loop ends. For any thread."""
        if self._state == "open":
            self._stopping = True
            self._tokens.put(None)
            self.source.stop()

    def close(self) -> None:
        """Stop the source and the producer, wait for the device, and free the slots; the report remains.

        For the consumer's thread, as in ``with``; other threads may call `stop`.

        Raises
        ------
        StreamError
            The source does not return from a read, or the device has failed, unless the loop has reported a failure.
        """
        if self._state != "open":
            self._state = "closed"
            return
        self.stop()
        self._state = "closed"
        self._stalls.stop()
        self._producer.join(self._limits.stop_timeout)
        if self._producer.is_alive():
            raise StreamError(
                f"the source has not returned from a read for {self._limits.stop_timeout:.0f} s after the "
                "stream's end; give it a stop() that ends the read"
            )
        failure: Exception | None = None
        try:
            for queues in dict.fromkeys(self._queues):
                try:
                    queues.finish()
                except cl.Error as error:
                    failure = launch_failure(error, self.device, queues.compute, "Pipeline")
        finally:
            self._release(self._clock())
            # Slots hold device memory: free it even where the caller keeps the stream for its report.
            del self._queues
            self._free.clear()
            self._ready = queue.SimpleQueue()
            self.source.close()
        if self.trace is not None:
            self.trace.end_stream(self._stream_number)
            # The block of an active trace writes the file, also where the stream outlives the block.
            if self._writes_trace:
                self.trace.write()
        if failure is not None and not self._reported:
            raise StreamError(f"the device failed before the stream's end: {failure}") from failure

    # The producer's side ---------------------------------------------------------------------------------------

    def _produce(self) -> None:
        """Fill and launch slots until the source ends or fails, or the stream is closed."""
        number, stage = 0, "source"
        clock, source, ready = self._clock, self.source, self._ready
        try:
            while not self._stopping and source.wait():
                requested_at = clock()
                stage = "ring"
                slot = self._free_slot()
                if slot is None:
                    break
                stage = "source"
                slot.asked, slot.taken = requested_at, clock()
                slot.number, slot.count = number, source.read_into(slot.frames, slot.arrived)
                if not slot.count:
                    break
                stage = "operation"
                slot.filled = clock()
                slot.launch()
                slot.enqueued = clock()
                stage = "source"
                number += slot.count
                ready.put(slot)
        except BaseException as raised:  # raised again in the consumer's thread
            error = raised
            if isinstance(raised, cl.Error):
                error = launch_failure(raised, self.device, self._queues[0].compute, "Pipeline")
            self._failure = _stopped(number, stage, error)
            self._failure.__cause__ = error
        ready.put(None)

    def _free_slot(self) -> Slot[R] | None:
        """Take a slot according to the policy; return None at shutdown."""
        if self.policy == "block":
            self._tokens.get()
            return None if self._stopping else self._free.pop()
        while not self._stopping:
            try:
                self._tokens.get_nowait()
            except queue.Empty:
                pass
            else:
                return None if self._stopping else self._free.pop()
            if self.policy == "raise":
                raise StreamError(
                    f"no slot was free for it: the consumer holds up a ring of {self.ring} x {self.batch} frames"
                )
            try:
                oldest = self._ready.get_nowait()
            except queue.Empty:  # the consumer has just taken it and given another one back
                continue
            assert oldest is not None  # the producer puts None only at its end
            oldest.wait()
            self._dropped += oldest.count
            return oldest
        return None

    # The consumer's side ---------------------------------------------------------------------------------------

    def __iter__(self) -> Pipeline[R]:
        return self

    def __next__(self) -> Batch[R]:
        """Give the memory of the last batch back and deliver the next one.

        Raises
        ------
        StreamError
            A stage failed (the message names the frame, the cause is chained), or the stream is not open.
        """
        if self._state != "open":
            raise StreamError("the stream is not open; use `with Pipeline(...) as stream`")
        if self._ended:
            raise StopIteration
        clock = self._clock
        now = clock()
        self._release(now)
        slot = self._ready.get()
        if slot is None:
            self._ended = True
            if self._failure is not None:
                self._reported = True
                raise self._failure from self._failure.__cause__
            raise StopIteration
        self._held = slot
        taken_at = clock()
        try:
            slot.wait()
        except cl.Error as error:
            self._ended = True
            cause = launch_failure(error, self.device, slot.queue, "Pipeline")
            self._reported = True
            raise _stopped(slot.number, "operation", cause) from cause
        return self._delivered(slot, now, taken_at, clock())

    def _delivered(self, slot: Slot[R], requested: int, taken: int, delivered: int) -> Batch[R]:
        arrived = slot.arrived[: slot.count]
        statistics = self._statistics
        statistics.add_batch(delivered, delivered - arrived, self._ready.qsize() + 1)
        statistics.add_stage("slot", slot.taken - slot.asked)
        statistics.add_stage("source", slot.filled - slot.taken)
        statistics.add_stage("launch", slot.enqueued - slot.filled)
        statistics.add_stage("queue", taken - slot.enqueued)
        statistics.add_stage("wait", delivered - taken)
        started = ended = None
        spans: dict[str, tuple[int, int]] = {}
        if self._device_clock is not None:
            spans = self._device_clock.spans(slot, delivered)
            for stage, (start, end) in spans.items():
                statistics.add_stage(stage, end - start)
            started, ended = spans["compute"]
        self._stalls.add(
            slot.number,
            slot.count,
            arrived=int(arrived[-1]),
            requested=requested,
            launching=slot.filled if self._computes_inline else slot.enqueued,
            launched=slot.enqueued,
            taken=taken,
            computed=min(max(end for _, end in spans.values()), delivered) if spans else delivered,
            delivered=delivered,
        )
        if self.trace is not None:
            spans["slot"] = (slot.asked, slot.taken)
            spans["source"] = (slot.taken, slot.filled)
            spans["launch"] = (slot.filled, slot.enqueued)
            spans["wait"] = (taken, delivered)
        self._held_spans = spans
        slot.delivered = delivered
        frames = slot.frames if slot.count == self.batch else slot.frames[: slot.count]
        times = (arrived, slot.filled, started, ended, delivered)
        return Batch(slot.number, frames, slot.trimmed_result(), *times, round(1e9 * self.source.exposure_delay))

    def _release(self, now: int) -> None:
        """Give the slot that the consumer holds back to the producer."""
        slot = self._held
        if slot is None:
            return
        self._held = None
        if slot.delivered:
            self._statistics.add_stage("sink", now - slot.delivered)
            if self.trace is not None:
                spans = {**self._held_spans, "sink": (slot.delivered, now)}
                offset = 0 if self._device_clock is None else self._device_clock.offset
                self.trace.add(spans, slot.number, slot.count, stream=self._stream_number, offset=offset)
            slot.delivered = 0
        self._give_back(slot)

    def _give_back(self, slot: Slot[R]) -> None:
        self._free.append(slot)
        self._tokens.put(None)

    def run(self, sink: Callable[[Batch[R]], object] | None = None) -> StreamReport:
        """Open the stream, pass every batch to `sink`, close the stream, and return the report.

        Raises
        ------
        StreamError
            The source, an operation or the sink failed; the cause is chained.
        """
        with self:
            for batch in self:
                if sink is None:
                    continue
                try:
                    sink(batch)
                except Exception as error:
                    raise _stopped(batch.number, "sink", error) from error
        return self.report()

    def report(self) -> StreamReport:
        """Return the report of the stream up to now; for the consumer's thread."""
        return self._statistics.report(
            dropped=self._dropped,
            batch=self.batch,
            ring=self.ring,
            policy=self.policy,
            device=self.device.label,
            zero_copy=self.zero_copy,
            inline=self.inline,
            longest_stall=self._stalls.longest,
        )


def _source(given: Source | HostArray) -> Source:
    if isinstance(given, np.ndarray):
        return ArraySource(given)
    if not isinstance(given, Source):
        kind = type(given).__name__
        raise TypeError(
            f"Pipeline takes a source or an array of frames, got a {kind}; wrap what can be iterated as "
            "gpuvision.host.sources.IteratedSource(...), open files with open_recording(...)"
        )
    return given


def _whole(value: object, name: str, least: int, unit: str = "") -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"Pipeline.{name} is {value!r}, expected a whole number of at least {least}{unit}")
    if value < least:
        raise ValueError(f"Pipeline.{name} is {value}, expected at least {least}{unit}")
    return int(value)


def _stopped(number: int, stage: str, error: BaseException) -> StreamError:
    return StreamError(f"the stream stopped at frame {number} ({stage}): {error or type(error).__name__}")
