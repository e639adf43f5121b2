"""Failure and shutdown of a stream: the failing stage and frame are named, and everything is released."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import Device, RecordingError, StreamError
from gpuvision.host.batch import Batch
from gpuvision.host.pipeline import Pipeline, PipelineLimits
from gpuvision.host.ring import SharedSlot, Slot, StagedSlot
from gpuvision.host.sources import ArraySource, IteratedSource
from gpuvision.ranging.psd import PsdReadout
from streams import READOUT, Gated, currents_of, numbers, producer_ended


class FailingSource(ArraySource):
    """Source that raises at a batch."""

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        if self._next >= 6:
            raise RecordingError("tape.npy: frame 6 is torn")
        return super().read_into(out, arrived)


class Worn(PsdReadout):
    """Operation that fails at the second launch of each bound instance."""

    def bind(self, *args: Any, **kwargs: Any) -> Any:
        return FailingBound(super().bind(*args, **kwargs))


class FailingBound:
    def __init__(self, bound: Any) -> None:
        self._bound, self._calls = bound, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bound, name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self._calls += 1
        if self._calls == 2:
            raise RuntimeError("out of resources")
        return self._bound(*args, **kwargs)


def test_a_failing_source_is_named_after_the_good_frames(memory: dict[str, Any]) -> None:
    seen: list[int] = []
    with pytest.raises(StreamError, match=r"stopped at frame 6 \(source\): tape\.npy: frame 6 is torn") as caught:
        Pipeline(FailingSource(currents_of(20)), READOUT, batch=2, **memory).run(lambda each: seen.append(each.number))
    assert seen == [0, 2, 4]
    assert isinstance(caught.value.__cause__, RecordingError)


def test_a_failing_operation_is_named(memory: dict[str, Any]) -> None:
    seen: list[int] = []
    pipeline = Pipeline(currents_of(30), Worn(strip_length=6e-3), batch=2, ring=2, **memory)
    with pytest.raises(StreamError, match=r"stopped at frame \d \(operation\): out of resources") as caught:
        pipeline.run(lambda each: seen.append(each.number))
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert 1 <= len(seen) <= 2  # each slot was used once at most


def test_a_failing_sink_is_named(memory: dict[str, Any]) -> None:
    def sink(batch: Batch[Any]) -> None:
        if batch.number == 8:
            raise OSError("disk full")

    source = ArraySource(currents_of(30))
    with pytest.raises(StreamError, match=r"stopped at frame 8 \(sink\): disk full") as caught:
        Pipeline(source, READOUT, batch=4, **memory).run(sink)
    assert isinstance(caught.value.__cause__, OSError)


def test_an_exception_in_the_loop_comes_through_and_closes(device: Device) -> None:
    source = Gated(30)
    source.let(3)
    with pytest.raises(KeyError, match="mine"), Pipeline(source, READOUT, device=device, batch=1) as stream:
        {}[f"mine, at {next(stream).number}"]
    assert source.closed


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "raise"])
def test_leaving_early_with_the_producer_anywhere(memory: dict[str, Any], policy: Any) -> None:
    for batches in (0, 1, 3):
        source = ArraySource(currents_of(4), 100_000)
        with Pipeline(source, READOUT, batch=1, ring=3, policy=policy, **memory) as stream:
            for _ in range(batches):
                try:
                    next(stream)
                except StreamError:
                    assert policy == "raise"
                    break


def test_shutdown_while_the_producer_waits_for_a_slot(device: Device) -> None:
    source = Gated(30)
    with Pipeline(source, READOUT, device=device, batch=1, ring=2) as stream:
        source.let(30)
        source.drained(2)  # both slots are filled; the third frame has no slot
        stream.close()
    assert source.closed


def test_shutdown_while_the_source_waits_for_a_frame(device: Device) -> None:
    source = Gated(30)
    with Pipeline(source, READOUT, device=device, batch=1):
        source.drained(0)
    assert source.closed


def test_stopping_from_another_thread_ends_the_loop_after_what_is_under_way(device: Device) -> None:
    source = Gated(30)
    with Pipeline(source, READOUT, device=device, batch=1) as stream:
        source.let(2)
        source.drained(2)
        stopper = threading.Thread(target=stream.stop)
        stopper.start()
        assert numbers(list(stream)) == [0, 1]
        stopper.join(30)
    assert not stopper.is_alive()


def test_a_source_that_does_not_return_is_reported(device: Device) -> None:
    gate = threading.Event()

    def blocked() -> Iterator[np.ndarray]:
        yield np.ones(2, np.float32)
        gate.wait(30)

    limits = PipelineLimits(stop_timeout=0.1)
    stream = Pipeline(IteratedSource(blocked()), READOUT, device=device, batch=1, limits=limits)
    with pytest.raises(StreamError, match=r"has not returned from a read .* give it a stop"), stream:
        next(stream)
    gate.set()
    producer_ended()


def test_an_iterated_source_can_be_stopped(device: Device) -> None:
    gate = threading.Event()

    def blocked() -> Iterator[np.ndarray]:
        yield np.ones(2, np.float32)
        gate.wait(30)

    with Pipeline(IteratedSource(blocked(), stop=gate.set), READOUT, device=device, batch=1) as stream:
        assert next(stream).number == 0
        assert not gate.is_set()
    assert gate.is_set()
    assert stream.report().frames == 1


def test_a_stream_runs_once_and_only_when_open(device: Device) -> None:
    stream = Pipeline(currents_of(3), READOUT, device=device)
    with pytest.raises(StreamError, match="not open"):
        next(stream)
    stream.run()
    with pytest.raises(StreamError, match="not open"):
        next(stream)
    with pytest.raises(StreamError, match="runs once"):
        stream.run()


def test_the_device_is_free_after_the_stream(device: Device) -> None:
    with Pipeline(currents_of(3), READOUT, device=device, batch=1) as stream:
        held = next(stream)
        memory = weakref.ref(held.frames.base if held.frames.base is not None else held.frames)
        list(stream)
    del held
    gc.collect()
    assert memory() is None  # although the stream object still exists, for its report
    assert stream.report().frames == 3


def test_an_error_while_the_consumer_waits_for_the_device_ends_the_loop(
    memory: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = SharedSlot if memory["zero_copy"] else StagedSlot
    wait = kind.wait

    def failing(slot: Slot[Any]) -> None:
        wait(slot)
        if slot.number == 2:
            raise cl.RuntimeError("clWaitForEvents failed: EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")

    monkeypatch.setattr(kind, "wait", failing)
    stream = Pipeline(currents_of(9), READOUT, batch=2, **memory)
    with stream:
        assert next(stream).number == 0
        with pytest.raises(StreamError, match=r"stopped at frame 2 \(operation\): ") as caught:
            next(stream)
        assert caught.value.__cause__ is not None
        with pytest.raises(StopIteration):
            next(stream)
    assert stream.report().frames == 2


def test_a_stream_that_ended_stays_at_its_end(device: Device) -> None:
    with Pipeline(currents_of(3), READOUT, device=device, batch=2) as stream:
        assert numbers(list(stream)) == [0, 2]
        assert list(stream) == []
        with pytest.raises(StopIteration):
            next(stream)


def test_a_source_is_closed_if_its_stream_cannot_start(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise MemoryError("no queue")

    monkeypatch.setattr("gpuvision.host.pipeline.queues_of", refuse)
    source = Gated(3)
    stream = Pipeline(source, READOUT, device=device)
    with pytest.raises(MemoryError, match="no queue"), stream:
        pass
    assert source.closed
    with pytest.raises(StreamError, match="runs once"), stream:
        pass
    stream.close()  # nothing is left to close
