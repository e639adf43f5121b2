"""Times, report and timeline of a stream; its plan; constant memory of a long run."""

from __future__ import annotations

import copy
import itertools
import json
import math
import resource
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.host import Device, StreamError
from gpuvision.host.outputs import MANIFEST
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.planning import Cost, Plan, PlanLimits, plan_stream
from gpuvision.host.report import DurationHistogram
from gpuvision.host.ring import Step, slot_bytes
from gpuvision.host.sources import ArraySource, PacedSource, Source
from gpuvision.host.trace import Trace
from streams import READOUT, currents_of

# Times, report, trace ---------------------------------------------------------------------------------------------


def test_times_are_in_order(memory: dict[str, Any]) -> None:
    source = PacedSource(ArraySource(currents_of(4), 60), 2000.0)
    before = 0
    with Pipeline(source, READOUT, batch=2, profile=True, **memory) as stream:
        for batch in stream:
            assert batch.started is not None
            assert batch.ended is not None
            assert (np.diff(batch.arrived) >= 0).all()
            times = [before, batch.arrived[-1], batch.launched, batch.started, batch.ended, batch.delivered]
            assert times == sorted(times)
            before = int(batch.arrived[-1])
    stages = set(stream.report().stages)
    copies = set() if memory["zero_copy"] else {"upload", "download"}
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
    assert report.stages["source"].maximum >= 2e-6  # the time stamp of the source lies between
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
    durations = DurationHistogram()
    for start in range(0, len(values), split):
        durations.add_all(np.array(values[start : start + split]))
    spread = durations.statistics()
    assert spread.count == len(values)
    assert spread.maximum == pytest.approx(max(values) * 1e-9)
    assert spread.mean == pytest.approx(np.mean(values) * 1e-9, rel=1e-9)
    for quantile, value in ((0.5, spread.p50), (0.99, spread.p99), (0.999, spread.p999)):
        exact = np.quantile(values, quantile, method="inverted_cdf") * 1e-9
        assert value == pytest.approx(exact, rel=0.0101, abs=1.01e-9)


def test_bins_are_narrower_than_a_hundredth() -> None:
    """Medians of durations that differ by 1/100 differ, too, wherever the bins begin."""

    def median(nanoseconds: float) -> float:
        durations = DurationHistogram()
        # The maximum, which bounds the quantiles, is far above.
        durations.add_all(np.array([int(nanoseconds), int(nanoseconds), 10**12]))
        return durations.statistics().p50

    for duration in np.geomspace(1e6, 4e6, 300):
        assert median(duration) < median(1.01 * duration)


def test_quantiles_of_a_long_tail() -> None:
    """The quantiles are far apart: 10 000 durations of which one in a hundred and one in a thousand are long."""
    durations = DurationHistogram()
    for nanoseconds, count in ((10**9, 5), (10**3, 9895), (10**6, 95), (10**4, 5)):
        for start in range(0, count, 1000):
            durations.add_all(np.full(min(1000, count - start), nanoseconds))
    statistics = durations.statistics()
    assert statistics.p50 == pytest.approx(1e-6, rel=0.01)
    assert statistics.p99 == pytest.approx(1e-5, rel=0.01)
    assert statistics.p999 == pytest.approx(1e-3, rel=0.01)
    assert statistics.maximum == 1.0


def test_single_durations_count_like_many(rng: np.random.Generator) -> None:
    values = rng.integers(1, 10**6, 5000)
    one, batch = DurationHistogram(), DurationHistogram()
    for value in values:
        one.add(int(value))
    for part in values.reshape(5, 1000):
        batch.add_all(part)
    assert one.statistics() == batch.statistics()
    assert one.statistics().count == 5000


def test_large_batches_are_thinned_and_their_oldest_frame_counts(device: Device) -> None:
    currents = np.ones((30_000, 2), np.float32)
    report = Pipeline(currents, READOUT, device=device, batch=10_000, warm_up=0).run()
    assert report.frames == 30_000
    assert 3 * 500 <= report.latency.count <= 3 * 1024


def test_the_trace_is_chrome_json(memory: dict[str, Any], tmp_path: Path) -> None:
    stages = {"slot", "source", "launch", "wait", "sink", "compute"}
    stages |= set() if memory["zero_copy"] else {"upload", "download"}
    trace = Trace(tmp_path / "out" / "trace.json", limit=5 * len(stages))
    Pipeline(currents_of(40), READOUT, batch=4, trace=trace, **memory).run()
    events = json.loads((tmp_path / "out" / "trace.json").read_text())["traceEvents"]
    spans = [event for event in events if event["ph"] == "X"]
    assert {span["name"] for span in spans} == stages
    assert len(spans) == 5 * len(stages)
    assert {span["args"]["frame"] for span in spans} == {0, 4, 8, 12, 16}
    assert all(span["ts"] >= 0 and span["dur"] >= 0 for span in spans)
    lanes = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    for tid in lanes:
        intervals = sorted((span["ts"], span["ts"] + span["dur"]) for span in spans if span["tid"] == tid)
        assert all(end <= start + 1e-3 for (_, end), (start, _) in itertools.pairwise(intervals))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [MANIFEST, "trace.json"]


# Plan -------------------------------------------------------------------------------------------------------------


class Sensor(Source):
    """Frames without an end, as a sensor gives them; a plan reads none."""

    def __init__(self, rate: float | None) -> None:
        self.shape, self.dtype, self.rate = (64, 2), np.dtype(np.float32), rate


def frames_source(rate: float | None = None) -> Source:
    return Sensor(rate)


MEASURED = {1: (800.0, 1e-3), 2: (1240.0, 1.5e-3), 4: (3000.0, 1.5e-3), 8: (9000.0, 1.6e-3)}


def measured(batch: int, inline: bool) -> Cost:
    return Cost(*MEASURED[batch], processor_time=1e-4)


def test_the_plan_takes_the_smallest_batch_that_keeps_up() -> None:
    chosen = plan_stream(frames_source(1000.0), READOUT, stall=0.1, inline=False, measure=measured)
    assert chosen.batch == 4  # 1240 frames/s are not 1.25 times the rate
    assert [trial.batch for trial in chosen.trials] == [1, 2, 4]
    assert chosen.trials[-1].latency == pytest.approx(3 / 1000.0 + 1.5e-3)
    assert chosen.ring == 27  # 100 frames of a stall of 0.1 s in batches of 4, plus two slots
    assert plan_stream(frames_source(), READOUT, rate=100.0, measure=measured).batch == 1
    assert json.loads(json.dumps(chosen.to_dict()))["trials"][2]["service_rate"] == 3000.0


def test_a_plan_that_fails_says_what_is_possible() -> None:
    with pytest.raises(StreamError, match=r"1000 frames/s with a margin of 1\.25 within 2 ms: the fastest, 2 frames"):
        plan_stream(frames_source(1000.0), READOUT, latency=2e-3, measure=measured)
    with pytest.raises(StreamError, match=r"keeps up with 1e\+?06|1000000 frames/s"):
        plan_stream(frames_source(1e6), READOUT, batches=(1, 2, 4, 8), measure=measured)
    asked: list[int] = []

    def saturated(batch: int, inline: bool) -> Cost:
        asked.append(batch)
        return Cost(min(1000.0 * batch, 4000.0), batch / 4000.0, 1e-4)

    with pytest.raises(StreamError, match="the fastest, 4 frames, does 4000 frames/s"):
        plan_stream(frames_source(1e6), READOUT, inline=False, measure=saturated)
    assert asked == [1, 2, 4, 8, 16, 32]  # it stops when larger batches are not faster
    with pytest.raises(ValueError, match="rate is None"):
        plan_stream(frames_source(), READOUT)


@pytest.mark.parametrize("inline", [None, False, True])
def test_a_measured_plan_runs(device: Device, inline: bool | None) -> None:
    if inline and not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    chosen = plan_stream(frames_source(10.0), READOUT, inline=inline, device=device)
    assert chosen.batch == 1
    tried = {False, device.has_inline_queues} if inline is None else {inline}
    assert {each.inline for each in chosen.trials} == tried
    for trial in chosen.trials:
        assert trial.service_rate > 12.5
        assert 0.0 < trial.processor_time < 0.1
    source = PacedSource(ArraySource(currents_of(4), 20), 2000.0)
    report = Pipeline(source, READOUT, **chosen.settings).run()
    assert report.frames == 20
    assert (report.batch, report.ring, report.inline) == (chosen.batch, chosen.ring, chosen.inline)


FREE = PlanLimits(max_bytes=1 << 40)


def planned(rate: float = 1000.0, **options: Any) -> Plan:
    options = {"measure": measured, "inline": False, "limits": FREE, **options}
    return plan_stream(frames_source(rate), READOUT, **options)


@pytest.mark.parametrize(
    ("stall", "ring"),
    [(0.5, 127), (0.1, 27), (0.101, 28), (1.0, 252), (0.0, 4)],  # 1000 frames/s in batches of 4, and two slots
)
def test_the_ring_holds_the_frames_of_a_stall(stall: float, ring: int) -> None:
    chosen = planned(stall=stall)
    assert (chosen.batch, chosen.ring, chosen.stall) == (4, ring, stall)
    assert planned().ring == 127


def test_a_recording_needs_no_more_slots_than_it_has_batches() -> None:
    source = ArraySource(np.zeros((30, 64, 2), np.float32))
    assert plan_stream(source, READOUT, rate=1000.0, inline=False, measure=measured).ring == 9  # 8 batches of 4


@pytest.mark.parametrize("zero_copy", [False, True])
def test_the_plan_states_the_memory_of_the_ring(zero_copy: bool, device: Device) -> None:
    chosen = planned(stall=1.0, device=device, zero_copy=zero_copy)
    frame = 64 * 2 * 4  # float32 currents
    results = 64 * (4 + 4 + 1)  # position, total and status
    assert chosen.ring_bytes == 252 * 4 * ((frame + results) * (1 if zero_copy else 2) + 8)
    text = str(chosen)
    assert "a ring of 252 slots" in text
    assert f"({chosen.ring_bytes / 1e6:.3g} MB) for stalls of 1 s at 1000 frames/s" in text


@pytest.mark.parametrize(("zero_copy", "expected"), [(True, 51), (False, 51 + 16 + 9)])
def test_the_memory_of_a_slot_counts_all_operations_of_a_chain(zero_copy: bool, expected: int) -> None:
    """Two strips: 16 bytes of currents, 2 x 9 of results; then their positions, 8 bytes, as one strip, 9 of results."""
    size = slot_bytes([Step(READOUT), Step(READOUT)], Device.best(), 6, (2, 2), np.float32, zero_copy=zero_copy)
    assert size == 6 * (expected + 8)  # and the arrival times


def test_a_ring_that_memory_cannot_hold_is_refused_before_anything_is_measured() -> None:
    asked: list[int] = []

    def counted(batch: int, inline: bool) -> Cost:
        asked.append(batch)
        return measured(batch, inline)

    message = r"stalls of 1e\+06 s at 1000 frames/s .* takes 1\.1 TB, the limit is 1 GB"
    with pytest.raises(StreamError, match=message) as caught:
        planned(stall=1e6, measure=counted, limits=PlanLimits(max_bytes=10**9))
    assert "\n" not in str(caught.value)
    assert asked == []
    with pytest.raises(StreamError, match=r"takes 1\.1e\+03 TB, the limit is"):  # of the memory of this machine
        planned(stall=1e9, limits=PlanLimits())


@pytest.mark.parametrize("stall", [-0.1, math.nan, math.inf])
def test_a_stall_is_a_duration(stall: float) -> None:
    with pytest.raises(ValueError, match=r"stall is .*, expected seconds >= 0"):
        planned(stall=stall)


@pytest.mark.parametrize(
    ("workers", "inline", "is_inline", "batch"),
    [
        (Cost(5000.0, 1e-4, 3e-4), Cost(2000.0, 2e-4, 1e-4), True, 1),  # both keep up: inline is cheaper
        (Cost(5000.0, 1e-4, 1e-4), Cost(2000.0, 2e-4, 1.09e-4), True, 1),  # equal within the scatter
        (Cost(5000.0, 1e-4, 1e-4), Cost(2000.0, 2e-4, 1.2e-4), False, 1),
        (Cost(5000.0, 1e-4, 3e-4), Cost(2000.0, 1.1e-3, 1e-4), False, 1),  # a large frame
        (Cost(5000.0, 1e-4, 3e-4), Cost(1200.0, 2e-4, 1e-4), False, 1),  # inline has no margin
        (Cost(1200.0, 1e-4, 1e-4), Cost(2000.0, 1.1e-3, 9e-4), True, 1),  # only inline has one
        (Cost(600.0, 1e-4, 3e-4), Cost(500.0, 2e-4, 1e-4), False, 8),  # the first batch at which one keeps up
    ],
)
def test_small_frames_run_inline_by_the_measured_cost(workers: Cost, inline: Cost, is_inline: bool, batch: int) -> None:
    device = copy.copy(Device.best())
    device.inline_device = device.handle  # as on PoCL

    def cost(batch: int, is_inline: bool) -> Cost:
        one = inline if is_inline else workers
        return one._replace(service_rate=one.service_rate * (1.0 + 0.4 * math.log2(batch)))

    chosen = planned(inline=None, measure=cost, device=device)
    assert (chosen.inline, chosen.batch) == (is_inline, batch)
    assert [each.inline for each in chosen.trials] == [False, True] * (len(chosen.trials) // 2)
    place, other = ("inline", "in worker threads") if is_inline else ("in worker threads", "inline")
    spent, instead = (inline, workers) if is_inline else (workers, inline)
    assert f"kernels {place}, {1e6 * spent.processor_time:.3g} us of processor time per frame" in str(chosen)
    assert f"({1e6 * instead.processor_time:.3g} us {other})" in str(chosen)
    for forced in (False, True):
        only = planned(rate=100.0, inline=forced, measure=cost, device=device)
        assert only.inline == forced
        assert {each.inline for each in only.trials} == {forced}
        assert only.settings == {"device": device, "batch": 1, "ring": 52, "inline": forced}


def test_a_device_without_inline_queues_is_measured_with_its_worker_threads() -> None:
    device = copy.copy(Device.best())
    device.inline_device = None
    device.handle = SimpleNamespace(extensions="cl_khr_fp64", global_mem_size=1 << 40)
    assert {each.inline for each in planned(inline=None, device=device).trials} == {False}
    with pytest.raises(ValueError, match=r"has no inline queues; use inline=False"):
        Pipeline(currents_of(3), READOUT, device=device, inline=True)


# A long run -------------------------------------------------------------------------------------------------------


def resident_bytes() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["block", "drop_oldest"])
def test_a_million_frames_do_not_grow(memory: dict[str, Any], policy: Any) -> None:
    currents = currents_of(1000, strips=1)
    expected = READOUT(currents, device=memory["device"]).total
    sizes: list[int] = []
    count = 0
    source = ArraySource(currents, 1_000_000)
    with Pipeline(source, READOUT, batch=50, ring=4, policy=policy, **memory) as stream:
        for batch in stream:
            first = batch.number % 1000
            assert np.array_equal(batch.result.total, expected[first : first + 50])
            count += len(batch)
            if count % 100_000 < 50:
                sizes.append(resident_bytes())
    report = stream.report()
    assert report.frames + report.dropped == 1_000_000
    assert report.frames == count
    assert policy == "drop_oldest" or report.dropped == 0
    if policy == "block":
        # The first tenth fills pools and counters; a byte leaked per frame would show as 0.8 MB after that.
        assert sizes[-1] - sizes[1] < 1 << 19
