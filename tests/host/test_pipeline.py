"""The stream delivers every frame once and in order, on both memory paths of every device."""

from __future__ import annotations

import copy
import gc
import json
from typing import Any, ClassVar

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gpuvision.host import Device, StreamError
from gpuvision.host.batch import default_batch
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.ring import SharedSlot, Step, queues_of
from gpuvision.host.sources import ArraySource, IteratedSource
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation
from streams import READOUT, Gated, currents_of, numbers, producer_ended

# Results ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "batch"), [(1, 1), (7, 1), (23, 4), (24, 4), (3, 8), (50, 50)])
def test_results_are_those_of_direct_calls(memory: dict[str, Any], count: int, batch: int) -> None:
    currents = currents_of(count)
    expected = READOUT(currents, device=memory["device"])
    seen = 0
    with Pipeline(currents, READOUT, batch=batch, ring=3, **memory) as stream:
        for each in stream:
            frames = slice(seen, seen + len(each))
            assert each.number == seen
            assert np.array_equal(each.frames, currents[frames])
            for name in ("position", "total", "status"):
                np.testing.assert_array_equal(getattr(each.result, name), getattr(expected, name)[frames])
            assert each.result.sigma is None
            seen += len(each)
    report = stream.report()
    assert seen == count == report.frames
    assert (report.dropped, report.batches) == (0, -(-count // batch))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(0, 40), batch=st.integers(1, 9), ring=st.integers(2, 5), short=st.integers(1, 9))
def test_any_batch_ring_and_short_reads(device: Device, count: int, batch: int, ring: int, short: int) -> None:
    """The source sometimes gives fewer frames than requested."""

    class Short(ArraySource):
        def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
            return super().read_into(out[:short], arrived[:short])

    currents = currents_of(40)
    parts = [READOUT(currents, device=device).position[:0]]
    source = Short(currents, count)
    Pipeline(source, READOUT, device=device, batch=batch, ring=ring).run(
        lambda each: parts.append(each.result.position.copy())
    )
    np.testing.assert_array_equal(np.concatenate(parts), READOUT(currents, device=device).position[:count])


def test_a_chain_hands_arrays_on(memory: dict[str, Any]) -> None:
    sheet = Triangulation(homography=((1.0, 0.1, 0.0), (0.0, 1.2, 0.1), (0.0, 0.01, 1.0)), region=((-1, 1), (-1, 1)))
    currents = currents_of(19)
    reading = READOUT(currents, device=memory["device"])
    expected = sheet(reading.position, reading.total, device=memory["device"])
    chain = [READOUT, Step(sheet, takes=("position", "total"))]
    points: list[np.ndarray] = []
    Pipeline(currents, chain, batch=4, **memory).run(lambda each: points.append(each.result.g.copy()))
    np.testing.assert_array_equal(np.concatenate(points), expected.g)


def test_a_chain_of_operations_of_one_input_needs_no_names(device: Device) -> None:
    currents = currents_of(9, strips=2)
    expected = READOUT(READOUT(currents, device=device).position, device=device).total
    totals: list[np.ndarray] = []
    Pipeline(currents, [READOUT, READOUT], device=device, batch=2).run(
        lambda each: totals.append(each.result.total.copy())
    )
    np.testing.assert_array_equal(np.concatenate(totals), expected)


def test_a_copied_batch_stays(device: Device) -> None:
    currents = currents_of(12)
    with Pipeline(currents, READOUT, device=device, batch=2, ring=2) as stream:
        kept = [batch.copy() for batch in stream]
    for batch in kept:
        frames = slice(batch.number, batch.number + 2)
        assert np.array_equal(batch.frames, currents[frames])
        np.testing.assert_array_equal(batch.result.total, READOUT(currents, device=device).total[frames])


def test_arrays_of_a_batch_may_outlive_the_stream(memory: dict[str, Any]) -> None:
    currents = currents_of(3)
    with Pipeline(currents, READOUT, batch=3, **memory) as stream:
        batch = next(stream)
    del stream
    gc.collect()
    assert np.array_equal(batch.frames, currents)
    np.testing.assert_array_equal(batch.result.total, READOUT(currents, device=memory["device"]).total)


def test_no_frames(memory: dict[str, Any]) -> None:
    report = Pipeline(np.zeros((0, 4, 2), np.float32), READOUT, **memory).run()
    assert (report.frames, report.batches, report.dropped) == (0, 0, 0)
    assert json.loads(json.dumps(report.to_dict()))["latency"]["p50"] is None


# Queues -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "inline", "queues"), [("intel", False, 4), ("intel", True, 1), ("pocl", False, 1)])
def test_slots_share_a_queue_unless_waiting_would_run_later_work(kind: str, inline: bool, queues: int) -> None:
    """A thread that waits for an event of Intel's runtime leaves when the queue of the event is idle."""
    made: list[bool] = []

    class Paper:
        def __init__(self) -> None:
            self.kind = kind

        def new_queue(self, *, profiling: bool, inline: bool = False) -> object:
            made.append(inline)
            return object()

    device: Any = Paper()
    rings = queues_of(device, 4, zero_copy=True, profiling=False, inline=inline)
    assert len(rings) == 4
    assert len({each.compute for each in rings}) == queues
    assert made == [inline] * queues


@pytest.mark.parametrize("inline", [False, True])
def test_inline_streams_give_the_same_results(memory: dict[str, Any], inline: bool) -> None:
    device = memory["device"]
    if inline and not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    frames = np.random.default_rng(3).integers(0, 200, (9, 40, 3000), dtype=np.uint8)
    readout = LineReadout(method="centroid", threshold=20)
    expected = readout(frames, device=device)
    sheet = Triangulation(homography=((1.0, 0.1, 0.0), (0.0, 1.2, 0.1), (0.0, 0.01, 1.0)), region=((-1, 1), (-1, 1)))
    chains: list[Any] = [readout, [readout, Step(sheet, takes=("position", "peak"))]]
    fields = ("position", "g")
    results = (expected.position, sheet(expected.position, expected.peak, device=device).g)
    for chain, field, want in zip(chains, fields, results, strict=True):
        parts: list[np.ndarray] = []
        stream: Pipeline[Any] = Pipeline(frames, chain, batch=2, ring=3, inline=inline, profile=True, **memory)
        report = stream.run(lambda each, parts=parts, field=field: parts.append(getattr(each.result, field).copy()))
        np.testing.assert_array_equal(np.concatenate(parts), want)
        assert report.inline == inline


def test_an_inline_kernel_is_complete_when_its_launch_returns(device: Device) -> None:
    if not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    source = ArraySource(np.zeros((4, 64, 3000), np.uint8))
    states: list[int] = []

    class Watched(SharedSlot[Any]):
        def launch(self) -> None:
            super().launch()
            states.append(self._done.command_execution_status)

    queues = queues_of(device, 1, zero_copy=True, profiling=False, inline=True)[0]
    slot = Watched([Step(LineReadout())], device, queues, 1, source.shape, source.dtype)
    for _ in range(20):
        slot.launch()
    assert slot.inline
    assert states == [cl.command_execution_status.COMPLETE] * 20


# Policies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ring", [2, 3, 6])
def test_drop_oldest_keeps_the_newest(memory: dict[str, Any], ring: int) -> None:
    source = Gated(40)
    with Pipeline(source, READOUT, batch=1, ring=ring, policy="drop_oldest", **memory) as stream:
        source.let(1)
        batches = [next(stream).copy()]
        source.let(30)  # while the consumer holds the first frame
        source.drained(31)
        source.let(10)  # 9 frames and the end
        source.drained(40)
        batches += [each.copy() for each in stream]
    # The consumer holds one slot; the other slots hold the newest frames, at most as old as the length of the ring.
    assert numbers(batches) == [0, *range(40 - (ring - 1), 40)]
    assert stream.report().dropped == 40 - ring
    for batch in batches:
        assert batch.frames[0, 1] == 1.0 + batch.number  # the number belongs to the frame


class GatedInThrees(Gated):
    """Three frames for each frame that the gate passes, two in the last batch."""

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        count = min(3, self.length - self._next)
        for number in range(count):
            super().read_into(out[number:], arrived[number:])
        return count


def test_dropped_frames_are_counted_not_batches(memory: dict[str, Any]) -> None:
    source = GatedInThrees(38)  # 12 batches of three frames and one of two
    with Pipeline(source, READOUT, batch=3, ring=4, policy="drop_oldest", **memory) as stream:
        source.let(1)
        batches = [next(stream).copy()]
        source.let(12)  # while the consumer holds the first batch
        source.drained(13)
        source.let(1)
        batches += [each.copy() for each in stream]
    assert numbers(batches) == [0, 30, 33, 36]
    report = stream.report()
    assert (report.frames, report.dropped) == (11, 27)


class Watched(PsdReadout):
    """Notes each launch of a slot whose last results nobody has waited for."""

    def bind(self, *args: Any, **kwargs: Any) -> Any:
        return WatchedBound(super().bind(*args, **kwargs))


class WatchedBound:
    unfinished: ClassVar[list[int]] = []

    def __init__(self, bound: Any) -> None:
        self._bound, self._event, self._calls = bound, None, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bound, name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if self._event is not None and not self._event.waited:
            WatchedBound.unfinished.append(self._calls)
        self._calls += 1
        self._event = WatchedEvent(self._bound(*args, **kwargs))
        return self._event


class WatchedEvent:
    def __init__(self, event: Any) -> None:
        self._event, self.waited = event, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._event, name)

    def wait(self) -> None:
        self._event.wait()
        self.waited = True


def test_a_dropped_batch_is_computed_before_its_memory_is_filled_again(device: Device) -> None:
    """The device may still read the frames of the oldest batch: its slot is filled only after its last launch."""
    if not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host; events of copies order the slots there")
    WatchedBound.unfinished.clear()
    source = Gated(20)
    with Pipeline(source, Watched(strip_length=6e-3), device=device, batch=1, ring=3, policy="drop_oldest") as stream:
        source.let(1)
        next(stream)
        source.let(20)
        source.drained(19)
        list(stream)
    assert stream.report().dropped == 17
    assert WatchedBound.unfinished == []


def test_a_burst_that_fits_the_ring_loses_nothing(device: Device) -> None:
    for policy in ("drop_oldest", "raise", "block"):
        source = Gated(12)
        with Pipeline(source, READOUT, device=device, batch=1, ring=5, policy=policy) as stream:
            source.let(1)
            seen = [next(stream).number]
            for _ in range(2):
                source.let(4)  # the producer has four slots while the consumer holds one
                source.drained(1 + len(seen) + 3)
                seen += [next(stream).number for _ in range(4)]
            source.let(4)
            seen += numbers(list(stream))
        assert seen == list(range(12)), policy
        assert stream.report().dropped == 0


def test_raise_names_the_frame_that_found_no_slot(device: Device) -> None:
    source = Gated(40)
    with Pipeline(source, READOUT, device=device, batch=1, ring=3, policy="raise") as stream:
        source.let(1)
        seen = [next(stream).number]
        source.let(5)
        producer_ended()
        with pytest.raises(StreamError, match=r"stopped at frame 3 \(ring\): no slot was free .* a ring of 3 x 1"):
            seen.extend(batch.number for batch in stream)
    assert seen == [0, 1, 2]
    assert source.closed


def test_block_makes_the_source_wait(device: Device) -> None:
    source = Gated(40)
    with Pipeline(source, READOUT, device=device, batch=1, ring=3, policy="block") as stream:
        source.let(41)
        source.drained(2)
        first = next(stream)
        source.drained(3)
        assert source.waiting == 4  # three slots are filled; the fourth frame has no slot
        assert first.number == 0
        assert numbers(list(stream)) == list(range(1, 40))
    assert stream.report().dropped == 0


def test_after_a_stall_the_stream_is_fresh(device: Device) -> None:
    source = Gated(30)
    with Pipeline(source, READOUT, device=device, batch=1, ring=2, policy="drop_oldest") as stream:
        source.let(1)
        next(stream)
        source.let(20)
        source.drained(21)
        assert next(stream).number == 20
        source.let(1)
        assert next(stream).number == 21
        assert stream.report().dropped == 19


# Arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch": 0}, "batch is 0, expected at least 1"),
        ({"ring": 1}, "ring is 1, expected at least 2"),
        ({"policy": "drop_newest"}, "policy is 'drop_newest', expected 'block'"),
    ],
)
def test_options_out_of_range(device: Device, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Pipeline(currents_of(3), READOUT, device=device, **options)


def test_a_ring_that_memory_cannot_hold_is_refused() -> None:
    with pytest.raises(StreamError, match=r"a ring of 1000000000000 x 10 frames takes 930 TB, .* are free") as caught:
        Pipeline(np.zeros((3, 5, 2), np.float32), READOUT, batch=10, ring=10**12)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch": 2.5}, r"Pipeline.batch is 2.5, expected a whole number of at least 1"),
        ({"ring": "4"}, r"Pipeline.ring is '4', expected a whole number of at least 2 slots"),
    ],
)
def test_options_of_another_type(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Pipeline(currents_of(3), READOUT, **options)


@pytest.mark.parametrize("frames", [[np.ones((5, 2))], (np.ones((5, 2)) for _ in range(2)), "frames.npy"])
def test_what_is_no_source_is_told_how_to_become_one(frames: Any) -> None:
    with pytest.raises(TypeError, match=r"takes a source or an array .*IteratedSource\(...\)") as caught:
        Pipeline(frames, READOUT)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("batch", [1, 2, 4])
def test_an_error_in_the_last_frame_is_not_taken_for_the_end(device: Device, batch: int) -> None:
    frames = [*currents_of(2), currents_of(1, strips=4)[0]]
    got: list[int] = []
    stream = Pipeline(IteratedSource(frames), READOUT, device=device, batch=batch)
    with pytest.raises(StreamError, match=r"stopped at frame 2 \(source\): frame 2: 4x2 float32"):
        stream.run(lambda each: got.append(len(each)))
    assert sum(got) == 2


def test_what_a_stream_cannot_run_is_said_before_a_frame_is_taken(device: Device) -> None:
    source = ArraySource(np.zeros((4, 2, 6), np.float32))
    planar = PsdReadout(strip_length=6e-3, layout="planar")
    # For a batch of two, the frame axis could be mistaken for the axis of the pair.
    with pytest.raises(ValueError, match=r"shape|first axis"):
        Pipeline(source, planar, device=device, batch=2)
    with pytest.raises(TypeError, match="float32, float64 or uint16"):
        Pipeline(np.zeros((4, 3, 2), np.int8), READOUT, device=device)
    sheet = Triangulation(homography=((1, 0, 0), (0, 1, 0), (0, 0, 1)), region=((-1, 1), (-1, 1)))
    with pytest.raises(ValueError, match="Triangulation takes 2 arrays, a stream's source gives one"):
        Pipeline(currents_of(4), sheet, device=device)
    with pytest.raises(ValueError, match=r"Triangulation expects .* name what it takes: Step"):
        Pipeline(currents_of(4), [READOUT, sheet], device=device)
    with pytest.raises(ValueError, match="takes 'width', the operation before computes position, total, status"):
        Pipeline(currents_of(4), [READOUT, Step(sheet, takes=("position", "width"))], device=device)
    with pytest.raises(ValueError, match="at least one"):
        Pipeline(currents_of(4), [], device=device)
    unshared = copy.copy(device)
    unshared.shares_memory = False
    with pytest.raises(ValueError, match="does not share memory"):
        Pipeline(currents_of(4), READOUT, device=unshared, zero_copy=True)
    assert source.wait()


def test_the_default_batch_fits_the_frames() -> None:
    assert default_batch(ArraySource(np.zeros((1, 512, 1024), np.uint8), 1000), 4) == 8  # 4 MB
    assert default_batch(ArraySource(np.zeros((1, 4096, 4096), np.uint8), 1000), 4) == 1
    assert default_batch(ArraySource(np.zeros((1, 8), np.uint8), 10), 4) == 3  # so that the ring is used
    assert default_batch(ArraySource(np.zeros((0, 8), np.uint8)), 4) == 1
