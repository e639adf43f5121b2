"""The stream: every frame once and in order whatever happens, on both memory paths of every device."""

from __future__ import annotations

import copy
import gc
import itertools
import json
import resource
import threading
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gpuvision.host import Device, RecordingError, StreamError
from gpuvision.host.pipeline import Batch, Pipeline, default_batch
from gpuvision.host.plan import plan
from gpuvision.host.report import Durations
from gpuvision.host.ring import Step
from gpuvision.host.sources import ArraySource, IteratedSource, PacedSource, Source
from gpuvision.host.trace import Trace
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation

READOUT = PsdReadout(strip_length=6e-3)
PATHS = ("shared", "staged", "separate")


@pytest.fixture(params=PATHS)
def setup(request: pytest.FixtureRequest, device: Device) -> dict[str, Any]:
    """Options for a device and a memory path: shared, copied within shared memory, or copied to memory of its own."""
    if request.param == "separate":
        device = copy.copy(device)
        device.shares_memory = False
    elif request.param == "shared" and not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    return {"device": device, "zero_copy": request.param == "shared"}


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    """No test may leave the stream's thread behind."""
    yield
    left = [thread.name for thread in threading.enumerate() if thread.name == "gpuvision stream"]
    assert not left


def currents_of(count: int, strips: int = 5) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(1e-8, 1e-6, (count, strips, 2)).astype(np.float32)


class Gated(Source):
    """Frames that tell their number and arrive when the test says so."""

    def __init__(self, count: int) -> None:
        self.shape, self.dtype, self.length = (2,), np.dtype(np.float32), count
        self.waiting = 0  # frames that wait() has asked for
        self.closed = False
        self._next = 0
        self._gate = threading.Semaphore(0)
        self._stopped = False
        self._idle = threading.Condition()

    def let(self, frames: int) -> None:
        """Let frames arrive."""
        self._gate.release(frames)

    def drained(self, frames: int) -> None:
        """Wait until the producer has read so many frames and is back to wait for the next."""
        with self._idle:
            assert self._idle.wait_for(lambda: self.waiting > frames, timeout=30)

    def wait(self) -> bool:
        with self._idle:
            self.waiting += 1
            self._idle.notify_all()
        self._gate.acquire()
        return self._next < self.length and not self._stopped

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        out[0] = (1.0, 1.0 + self._next)
        arrived[0] = self._next
        self._next += 1
        return 1

    def stop(self) -> None:
        self._stopped = True
        self._gate.release()

    def close(self) -> None:
        self.closed = True


def numbers(batches: list[Batch[Any]]) -> list[int]:
    return [batch.number for batch in batches]


# Results ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "batch"), [(1, 1), (7, 1), (23, 4), (24, 4), (3, 8), (50, 50)])
def test_results_are_those_of_direct_calls(setup: dict[str, Any], count: int, batch: int) -> None:
    currents = currents_of(count)
    expected = READOUT(currents, device=setup["device"])
    seen = 0
    with Pipeline(currents, READOUT, batch=batch, ring=3, **setup) as stream:
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
    """A source that gives fewer frames than asked for, now and then."""

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


def test_a_chain_hands_arrays_on(setup: dict[str, Any]) -> None:
    sheet = Triangulation(homography=((1.0, 0.1, 0.0), (0.0, 1.2, 0.1), (0.0, 0.01, 1.0)), region=((-1, 1), (-1, 1)))
    currents = currents_of(19)
    reading = READOUT(currents, device=setup["device"])
    expected = sheet(reading.position, reading.total, device=setup["device"])
    chain = [READOUT, Step(sheet, takes=("position", "total"))]
    points: list[np.ndarray] = []
    Pipeline(currents, chain, batch=4, **setup).run(lambda each: points.append(each.result.g.copy()))
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


def test_arrays_of_a_batch_may_outlive_the_stream(setup: dict[str, Any]) -> None:
    currents = currents_of(3)
    with Pipeline(currents, READOUT, batch=3, **setup) as stream:
        batch = next(stream)
    del stream
    gc.collect()
    assert np.array_equal(batch.frames, currents)
    np.testing.assert_array_equal(batch.result.total, READOUT(currents, device=setup["device"]).total)


def test_no_frames(setup: dict[str, Any]) -> None:
    report = Pipeline(np.zeros((0, 4, 2), np.float32), READOUT, **setup).run()
    assert (report.frames, report.batches, report.dropped) == (0, 0, 0)
    assert json.loads(json.dumps(report.to_dict()))["latency"]["p50"] is None


# Policies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ring", [2, 3, 6])
def test_drop_oldest_keeps_the_newest(setup: dict[str, Any], ring: int) -> None:
    source = Gated(40)
    with Pipeline(source, READOUT, batch=1, ring=ring, policy="drop_oldest", **setup) as stream:
        source.let(1)
        batches = [next(stream).copy()]
        source.let(30)  # while the consumer holds the first frame
        source.drained(31)
        source.let(10)  # 9 frames and the end
        source.drained(40)
        batches += [each.copy() for each in stream]
    # The consumer's slot is not the producer's: the others hold the newest, none older than the ring is long.
    assert numbers(batches) == [0, *range(40 - (ring - 1), 40)]
    assert stream.report().dropped == 40 - ring
    for batch in batches:
        assert batch.frames[0, 1] == 1.0 + batch.number  # the number is the frame's own


def test_a_burst_that_fits_the_ring_loses_nothing(device: Device) -> None:
    for policy in ("drop_oldest", "raise", "block"):
        source = Gated(12)
        with Pipeline(source, READOUT, device=device, batch=1, ring=5, policy=policy) as stream:
            source.let(1)
            seen = [next(stream).number]
            for _ in range(2):
                source.let(4)  # four slots are the producer's while the consumer holds one
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


def producer_ended() -> None:
    """Wait until the stream's thread has ended by itself."""
    for thread in threading.enumerate():
        if thread.name == "gpuvision stream":
            thread.join(30)


def test_block_makes_the_source_wait(device: Device) -> None:
    source = Gated(40)
    with Pipeline(source, READOUT, device=device, batch=1, ring=3, policy="block") as stream:
        source.let(41)
        source.drained(2)
        first = next(stream)
        source.drained(3)
        assert source.waiting == 4  # three slots are filled; the fourth frame is there and has none
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


# Failure and shutdown ---------------------------------------------------------------------------------------------


class FailingSource(ArraySource):
    """Raises at a batch."""

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        if self._next >= 6:
            raise RecordingError("tape.npy: frame 6 is torn")
        return super().read_into(out, arrived)


class Worn(PsdReadout):
    """Fails at the second launch of each bound instance."""

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


def test_a_failing_source_is_named_after_the_good_frames(setup: dict[str, Any]) -> None:
    seen: list[int] = []
    with pytest.raises(StreamError, match=r"stopped at frame 6 \(source\): tape\.npy: frame 6 is torn") as caught:
        Pipeline(FailingSource(currents_of(20)), READOUT, batch=2, **setup).run(lambda each: seen.append(each.number))
    assert seen == [0, 2, 4]
    assert isinstance(caught.value.__cause__, RecordingError)


def test_a_failing_operation_is_named(setup: dict[str, Any]) -> None:
    seen: list[int] = []
    pipeline = Pipeline(currents_of(30), Worn(strip_length=6e-3), batch=2, ring=2, **setup)
    with pytest.raises(StreamError, match=r"stopped at frame \d \(operation\): out of resources") as caught:
        pipeline.run(lambda each: seen.append(each.number))
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert 1 <= len(seen) <= 2  # each slot went round once at most


def test_a_failing_sink_is_named(setup: dict[str, Any]) -> None:
    def sink(batch: Batch[Any]) -> None:
        if batch.number == 8:
            raise OSError("disk full")

    source = ArraySource(currents_of(30))
    with pytest.raises(StreamError, match=r"stopped at frame 8 \(sink\): disk full") as caught:
        Pipeline(source, READOUT, batch=4, **setup).run(sink)
    assert isinstance(caught.value.__cause__, OSError)


def test_an_exception_in_the_loop_comes_through_and_closes(device: Device) -> None:
    source = Gated(30)
    source.let(3)
    with pytest.raises(KeyError, match="mine"), Pipeline(source, READOUT, device=device, batch=1) as stream:
        {}[f"mine, at {next(stream).number}"]
    assert source.closed


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "raise"])
def test_leaving_early_with_the_producer_anywhere(setup: dict[str, Any], policy: Any) -> None:
    for batches in (0, 1, 3):
        source = ArraySource(currents_of(4), 100_000)
        with Pipeline(source, READOUT, batch=1, ring=3, policy=policy, **setup) as stream:
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
        source.drained(2)  # both slots are filled; the third frame is there and has none
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


def test_a_source_that_does_not_return_is_reported(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpuvision.host.pipeline._PATIENCE_S", 0.1)
    gate = threading.Event()

    def blocked() -> Iterator[np.ndarray]:
        yield np.ones(2, np.float32)
        gate.wait(30)

    stream = Pipeline(IteratedSource(blocked()), READOUT, device=device, batch=1)
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
        next(stream)


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
    assert memory() is None  # though the stream itself is still here, for its report
    assert stream.report().frames == 3


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


def test_what_a_stream_cannot_run_is_said_before_a_frame_is_taken(device: Device) -> None:
    source = ArraySource(np.zeros((4, 2, 6), np.float32))
    planar = PsdReadout(strip_length=6e-3, layout="planar")
    # For a batch of two the frame axis would pass for the pair's.
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


# Times, report, trace ---------------------------------------------------------------------------------------------


def test_times_are_in_order(setup: dict[str, Any]) -> None:
    source = PacedSource(ArraySource(currents_of(4), 60), 2000.0)
    before = 0
    with Pipeline(source, READOUT, batch=2, profile=True, **setup) as stream:
        for batch in stream:
            assert batch.started is not None
            assert batch.ended is not None
            assert (np.diff(batch.arrived) >= 0).all()
            times = [before, batch.arrived[-1], batch.launched, batch.started, batch.ended, batch.delivered]
            assert times == sorted(times)
            before = int(batch.arrived[-1])
    stages = set(stream.report().stages)
    copies = set() if setup["zero_copy"] else {"upload", "download"}
    assert stages == {"slot", "source", "launch", "queue", "wait", "sink", "compute"} | copies


def test_without_profiling_there_are_no_device_times(device: Device) -> None:
    with Pipeline(currents_of(3), READOUT, device=device) as stream:
        batch = next(stream)
        assert (batch.started, batch.ended) == (None, None)


def test_the_report_leaves_out_the_warm_up_and_counts_by_the_clock(device: Device) -> None:
    ticks = iter(range(0, 10**9, 1000))
    lock = threading.Lock()

    def clock() -> int:
        with lock:
            return next(ticks)

    source = ArraySource(currents_of(4), 100, clock=clock)
    report = Pipeline(source, READOUT, device=device, batch=5, ring=2, clock=clock).run()
    assert (report.frames, report.batches, report.warm_up) == (100, 20, 10)
    assert report.latency.count == 90
    assert report.stages["source"].count == 18
    assert report.stages["source"].maximum >= 2e-6  # the source's own look at the clock lies between
    assert report.latency.maximum <= report.seconds < 1.0
    assert report.throughput > 0
    assert 1 <= report.fill_mean <= report.fill_maximum <= 3
    plain = json.loads(json.dumps(report.to_dict()))
    assert plain["frames"] == 100
    assert plain["stages"]["wait"]["count"] == 18
    assert plain["device"] == device.label


def test_a_short_stream_is_reported_whole(device: Device) -> None:
    report = Pipeline(currents_of(3), READOUT, device=device, batch=1, ring=4).run()
    assert report.warm_up == 0
    assert report.latency.count == 3


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=300), st.integers(1, 40))
def test_quantiles_are_right_to_a_hundredth(values: list[int], split: int) -> None:
    durations = Durations()
    for start in range(0, len(values), split):
        durations.add_all(np.array(values[start : start + split]))
    spread = durations.spread()
    assert spread.count == len(values)
    assert spread.maximum == pytest.approx(max(values) * 1e-9)
    assert spread.mean == pytest.approx(np.mean(values) * 1e-9, rel=1e-9)
    for quantile, value in ((0.5, spread.p50), (0.99, spread.p99), (0.999, spread.p999)):
        exact = np.quantile(values, quantile, method="inverted_cdf") * 1e-9
        assert value == pytest.approx(exact, rel=0.0101, abs=1.01e-9)


def test_single_durations_count_like_many(rng: np.random.Generator) -> None:
    values = rng.integers(1, 10**6, 5000)
    one, many = Durations(), Durations()
    for value in values:
        one.add(int(value))
    for part in values.reshape(5, 1000):
        many.add_all(part)
    assert one.spread() == many.spread()
    assert one.spread().count == 5000


def test_large_batches_are_thinned_and_their_oldest_frame_counts(device: Device) -> None:
    currents = np.ones((30_000, 2), np.float32)
    report = Pipeline(currents, READOUT, device=device, batch=10_000, warm_up=0).run()
    assert report.frames == 30_000
    assert 3 * 500 <= report.latency.count <= 3 * 1024


def test_the_trace_is_chrome_json(setup: dict[str, Any], tmp_path: Path) -> None:
    trace = Trace(tmp_path / "out" / "trace.json", limit=5)
    Pipeline(currents_of(40), READOUT, batch=4, trace=trace, **setup).run()
    events = json.loads((tmp_path / "out" / "trace.json").read_text())["traceEvents"]
    spans = [event for event in events if event["ph"] == "X"]
    stages = {"slot", "source", "launch", "wait", "sink", "compute"}
    stages |= set() if setup["zero_copy"] else {"upload", "download"}
    assert {span["name"] for span in spans} == stages
    assert len(spans) == 5 * len(stages)
    assert {span["args"]["frame"] for span in spans} == {0, 4, 8, 12, 16}
    assert all(span["ts"] >= 0 and span["dur"] >= 0 for span in spans)
    lanes = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    one_by_one = ("producer", "consumer")  # the device's times are off by the clocks' difference
    for tid in lanes:
        own = sorted((span["ts"], span["ts"] + span["dur"]) for span in spans if span["tid"] == tid)
        assert all(end <= start + 1e-3 for (_, end), (start, _) in itertools.pairwise(own) if lanes[tid] in one_by_one)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["trace.json"]


# Plan -------------------------------------------------------------------------------------------------------------


def frames_source(rate: float | None = None) -> Source:
    source = ArraySource(np.zeros((1, 64, 2), np.float32))
    source.rate = rate
    return source


def test_the_plan_takes_the_smallest_batch_that_keeps_up() -> None:
    measured = {1: (800.0, 1e-3), 2: (1240.0, 1.5e-3), 4: (3000.0, 1.5e-3), 8: (9000.0, 1.6e-3)}
    chosen = plan(frames_source(1000.0), READOUT, measure=measured.__getitem__)
    assert chosen.batch == 4  # 1240 frames/s are not 1.25 times the rate
    assert [trial.batch for trial in chosen.trials] == [1, 2, 4]
    assert chosen.trials[-1].latency == pytest.approx(3 / 1000.0 + 1.5e-3)
    assert chosen.ring == 27  # 100 frames of a stall of 0.1 s in batches of 4, the consumer's and the source's
    assert plan(frames_source(), READOUT, rate=100.0, measure=measured.__getitem__).batch == 1
    assert json.loads(json.dumps(chosen.to_dict()))["trials"][2]["service_rate"] == 3000.0


def test_a_plan_that_fails_says_what_is_possible() -> None:
    measured = {1: (800.0, 1e-3), 2: (1240.0, 1.5e-3), 4: (3000.0, 1.5e-3), 8: (9000.0, 1.6e-3)}
    with pytest.raises(StreamError, match=r"1000 frames/s with a margin of 1\.25 within 2 ms: the fastest, 2 frames"):
        plan(frames_source(1000.0), READOUT, latency=2e-3, measure=measured.__getitem__)
    with pytest.raises(StreamError, match=r"keeps up with 1e\+?06|1000000 frames/s"):
        plan(frames_source(1e6), READOUT, batches=(1, 2, 4, 8), measure=measured.__getitem__)
    asked: list[int] = []

    def saturated(batch: int) -> tuple[float, float]:
        asked.append(batch)
        return min(1000.0 * batch, 4000.0), batch / 4000.0

    with pytest.raises(StreamError, match="the fastest, 4 frames, does 4000 frames/s"):
        plan(frames_source(1e6), READOUT, measure=saturated)
    assert asked == [1, 2, 4, 8, 16, 32]  # it gives up when larger batches gain nothing
    with pytest.raises(ValueError, match="rate is None"):
        plan(frames_source(), READOUT)


def test_a_measured_plan_runs(device: Device) -> None:
    chosen = plan(frames_source(10.0), READOUT, device=device)
    assert chosen.batch == 1
    assert chosen.trials[0].service_rate > 12.5
    source = PacedSource(ArraySource(currents_of(4), 20), 2000.0)
    report = Pipeline(source, READOUT, device=device, batch=chosen.batch, ring=chosen.ring).run()
    assert report.frames == 20


# A long run -------------------------------------------------------------------------------------------------------


def resident_bytes() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["block", "drop_oldest"])
def test_a_million_frames_do_not_grow(setup: dict[str, Any], policy: Any) -> None:
    currents = currents_of(1000, strips=1)
    expected = READOUT(currents, device=setup["device"]).total
    sizes: list[int] = []
    taken = 0
    source = ArraySource(currents, 1_000_000)
    with Pipeline(source, READOUT, batch=50, ring=4, policy=policy, **setup) as stream:
        for batch in stream:
            first = batch.number % 1000
            assert np.array_equal(batch.result.total, expected[first : first + 50])
            taken += len(batch)
            if taken % 100_000 < 50:
                sizes.append(resident_bytes())
    report = stream.report()
    assert report.frames + report.dropped == 1_000_000
    assert report.frames == taken
    assert policy == "drop_oldest" or report.dropped == 0
    if policy == "block":
        # The first tenth fills pools and counters; a byte leaked per frame would show as 0.8 MB after that.
        assert sizes[-1] - sizes[1] < 1 << 19
