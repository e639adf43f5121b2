"""Times, report and timeline of a stream; its plan; constant memory of a long run."""

from __future__ import annotations

import itertools
import json
import resource
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.host import Device, StreamError
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.planning import plan_stream
from gpuvision.host.report import DurationHistogram
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
    one, many = DurationHistogram(), DurationHistogram()
    for value in values:
        one.add(int(value))
    for part in values.reshape(5, 1000):
        many.add_all(part)
    assert one.statistics() == many.statistics()
    assert one.statistics().count == 5000


def test_large_batches_are_thinned_and_their_oldest_frame_counts(device: Device) -> None:
    currents = np.ones((30_000, 2), np.float32)
    report = Pipeline(currents, READOUT, device=device, batch=10_000, warm_up=0).run()
    assert report.frames == 30_000
    assert 3 * 500 <= report.latency.count <= 3 * 1024


def test_the_trace_is_chrome_json(memory: dict[str, Any], tmp_path: Path) -> None:
    trace = Trace(tmp_path / "out" / "trace.json", limit=5)
    Pipeline(currents_of(40), READOUT, batch=4, trace=trace, **memory).run()
    events = json.loads((tmp_path / "out" / "trace.json").read_text())["traceEvents"]
    spans = [event for event in events if event["ph"] == "X"]
    stages = {"slot", "source", "launch", "wait", "sink", "compute"}
    stages |= set() if memory["zero_copy"] else {"upload", "download"}
    assert {span["name"] for span in spans} == stages
    assert len(spans) == 5 * len(stages)
    assert {span["args"]["frame"] for span in spans} == {0, 4, 8, 12, 16}
    assert all(span["ts"] >= 0 and span["dur"] >= 0 for span in spans)
    lanes = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    one_by_one = ("producer", "consumer")  # device times differ by the offset of the clocks
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
    chosen = plan_stream(frames_source(1000.0), READOUT, measure=measured.__getitem__)
    assert chosen.batch == 4  # 1240 frames/s are not 1.25 times the rate
    assert [trial.batch for trial in chosen.trials] == [1, 2, 4]
    assert chosen.trials[-1].latency == pytest.approx(3 / 1000.0 + 1.5e-3)
    assert chosen.ring == 27  # 100 frames of a stall of 0.1 s in batches of 4, plus two slots
    assert plan_stream(frames_source(), READOUT, rate=100.0, measure=measured.__getitem__).batch == 1
    assert json.loads(json.dumps(chosen.to_dict()))["trials"][2]["service_rate"] == 3000.0


def test_a_plan_that_fails_says_what_is_possible() -> None:
    measured = {1: (800.0, 1e-3), 2: (1240.0, 1.5e-3), 4: (3000.0, 1.5e-3), 8: (9000.0, 1.6e-3)}
    with pytest.raises(StreamError, match=r"1000 frames/s with a margin of 1\.25 within 2 ms: the fastest, 2 frames"):
        plan_stream(frames_source(1000.0), READOUT, latency=2e-3, measure=measured.__getitem__)
    with pytest.raises(StreamError, match=r"keeps up with 1e\+?06|1000000 frames/s"):
        plan_stream(frames_source(1e6), READOUT, batches=(1, 2, 4, 8), measure=measured.__getitem__)
    asked: list[int] = []

    def saturated(batch: int) -> tuple[float, float]:
        asked.append(batch)
        return min(1000.0 * batch, 4000.0), batch / 4000.0

    with pytest.raises(StreamError, match="the fastest, 4 frames, does 4000 frames/s"):
        plan_stream(frames_source(1e6), READOUT, measure=saturated)
    assert asked == [1, 2, 4, 8, 16, 32]  # it stops when larger batches are not faster
    with pytest.raises(ValueError, match="rate is None"):
        plan_stream(frames_source(), READOUT)


def test_a_measured_plan_runs(device: Device) -> None:
    chosen = plan_stream(frames_source(10.0), READOUT, device=device)
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
def test_a_million_frames_do_not_grow(memory: dict[str, Any], policy: Any) -> None:
    currents = currents_of(1000, strips=1)
    expected = READOUT(currents, device=memory["device"]).total
    sizes: list[int] = []
    taken = 0
    source = ArraySource(currents, 1_000_000)
    with Pipeline(source, READOUT, batch=50, ring=4, policy=policy, **memory) as stream:
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
