"""The longest stall of a stream: how long it was, and which part of the stream spent it. No test uses a real clock."""

from __future__ import annotations

import gc
import json
import threading
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.host import Device
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.ring import SharedSlot, Slot, StagedSlot
from gpuvision.host.stalls import CollectorPauses, Stall, StallRecorder
from gpuvision.ranging.line import LineReadout
from streams import READOUT, Gated, ManualClock

MS = 1_000_000


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def recorder(clock: ManualClock) -> Iterator[StallRecorder]:
    recorder = StallRecorder(clock)
    recorder.start(0)
    yield recorder
    recorder.stop()


def add(recorder: StallRecorder, number: int = 0, *, count: int = 1, **times: int) -> Stall:
    """Add a batch with times in milliseconds and return the longest stall."""
    recorder.add(number, count, **{name: value * MS for name, value in times.items()})
    assert recorder.longest is not None
    return recorder.longest


# The recorder -----------------------------------------------------------------------------------------------------


def test_the_parts_of_a_stall(recorder: StallRecorder) -> None:
    """The consumer requests at 3 ms, the frame is launched at 7, taken at 8, computed at 18 and delivered at 20."""
    add(recorder, arrived=0, requested=0, launching=0, launched=0, taken=0, computed=0, delivered=1)
    stall = add(recorder, 1, arrived=2, requested=3, launching=7, launched=7, taken=8, computed=18, delivered=20)
    assert asdict(stall) == pytest.approx(
        {"seconds": 0.018, "frame": 1, "producer": 0.004, "device": 0.01, "consumer": 0.004, "collector": 0.0}
    )
    assert stall.place == "device"
    assert str(stall) == "18 ms, most of it in the device"


def test_a_kernel_in_the_producer_s_thread_counts_as_device(recorder: StallRecorder) -> None:
    stall = add(recorder, arrived=0, requested=0, launching=2, launched=9, taken=10, computed=10, delivered=10)
    assert (stall.producer, stall.device, stall.consumer) == pytest.approx((0.002, 0.007, 0.001))


def test_a_stall_begins_at_the_arrival_or_the_delivery_before(recorder: StallRecorder) -> None:
    times = {"requested": 0, "launching": 60, "launched": 60, "taken": 60, "computed": 61, "delivered": 61}
    assert add(recorder, arrived=60, **times).seconds == pytest.approx(0.001)  # no frame was there for 60 ms
    later = {name: value + 10 for name, value in times.items()}
    assert add(recorder, 1, arrived=50, **later).seconds == pytest.approx(0.01)  # late, but 61 ms saw a delivery


def test_dropped_frames_were_due_since_the_delivery_before(recorder: StallRecorder) -> None:
    add(recorder, count=4, arrived=0, requested=0, launching=0, launched=0, taken=0, computed=1, delivered=1)
    times = {"arrived": 80, "launching": 81, "launched": 81, "taken": 90, "computed": 91, "delivered": 91}
    stall = add(recorder, 24, requested=90, **times)
    assert asdict(stall) == pytest.approx(
        {"seconds": 0.09, "frame": 24, "producer": 0.0, "device": 0.001, "consumer": 0.089, "collector": 0.0}
    )


def test_a_batch_of_several_frames_is_followed_by_the_next_one(recorder: StallRecorder) -> None:
    add(recorder, count=4, arrived=0, requested=0, launching=0, launched=0, taken=0, computed=1, delivered=1)
    times = {"requested": 1, "launching": 81, "launched": 81, "taken": 81, "computed": 83, "delivered": 83}
    assert add(recorder, 4, arrived=80, **times).seconds == pytest.approx(0.003)  # no frame is missing


def test_the_longest_stall_is_the_report_s(recorder: StallRecorder) -> None:
    end = 0
    for number, length in enumerate((3, 9, 9, 5)):
        start, end = end + 1, end + 1 + length
        add(recorder, number, arrived=start, requested=0, launching=0, launched=0, taken=0, computed=end, delivered=end)
    assert recorder.longest is not None
    assert (recorder.longest.frame, recorder.longest.seconds) == (1, pytest.approx(0.009))


@given(
    steps=st.lists(st.integers(0, 50), min_size=7, max_size=7),
    requested=st.integers(0, 400),
    pauses=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 60)), max_size=3),
)
def test_the_parts_add_up(steps: list[int], requested: int, pauses: list[tuple[int, int]]) -> None:
    clock = ManualClock(step=0)
    recorder = StallRecorder(clock)
    recorder.start(0)
    try:
        for start, length in sorted(pauses):
            clock.now = max(clock.now, start * MS)
            collect(clock, length * MS)
        arrived, launching, launched, taken, computed, delivered = (int(each) for each in np.cumsum(steps)[:6])
        stall = add(
            recorder,
            arrived=arrived,
            requested=min(requested, taken),
            launching=launching,
            launched=launched,
            taken=taken,
            computed=computed,
            delivered=delivered,
        )
    finally:
        recorder.stop()
    parts = (stall.producer, stall.device, stall.consumer, stall.collector)
    assert sum(parts) == pytest.approx(stall.seconds, abs=1e-12)
    assert min(parts) >= 0.0
    assert stall.seconds == pytest.approx((delivered - arrived) * 1e-3)


def collect(clock: ManualClock, nanoseconds: int) -> None:
    """Run the garbage collector, which takes some time by the clock."""

    def slow(phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            clock.now += nanoseconds

    gc.callbacks.append(slow)
    try:
        gc.collect(0)  # the youngest objects: the shortest run with callbacks
    finally:
        gc.callbacks.remove(slow)


def test_the_collector_s_pause_is_named(clock: ManualClock, recorder: StallRecorder) -> None:
    clock.now = 4 * MS
    collect(clock, 30 * MS)
    times = {"launching": 35, "launched": 35, "taken": 35, "computed": 36, "delivered": 36}
    stall = add(recorder, arrived=1, requested=2, **times)
    assert stall.collector == pytest.approx(0.03, abs=1e-5)
    assert stall.producer == pytest.approx(0.003, abs=1e-5)
    assert stall.place == "collector"


def test_pauses_outside_a_stall_do_not_count(clock: ManualClock) -> None:
    pauses = CollectorPauses(clock)
    pauses.start()
    clock.now = 10 * MS
    collect(clock, 5 * MS)
    pauses.stop()
    clock.now = 50 * MS
    collect(clock, 5 * MS)
    assert pauses.overlap(0, 10 * MS) == 0
    assert pauses.overlap(12 * MS, 13 * MS) == MS
    assert pauses.overlap(20 * MS, 30 * MS) == 0
    assert pauses.overlap(0, 100 * MS) == pytest.approx(5 * MS, abs=10_000)
    assert not any(getattr(each, "__self__", None) is pauses for each in gc.callbacks)


# In a stream ------------------------------------------------------------------------------------------------------


class Timed(Gated):
    """Frames whose arrival is the clock's time."""

    def __init__(self, count: int, clock: ManualClock) -> None:
        super().__init__(count)
        self.clock = clock

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        arrived[0] = self.clock.now
        out[0] = self._next
        self._next += 1
        return 1


class RequestClock(ManualClock):
    """Clock that knows when the consumer, the thread of the test, has looked at it."""

    def __init__(self) -> None:
        super().__init__()
        self.requested = threading.Event()

    def __call__(self) -> int:
        now = super().__call__()
        if threading.current_thread() is threading.main_thread():
            self.requested.set()
        return now


class SlowTape(Timed):
    """Source whose frame 1 takes 70 ms to read, all of them after the consumer has requested it."""

    clock: RequestClock

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        number = self._next
        if number == 1:
            assert self.clock.requested.wait(30)
        count = super().read_into(out, arrived)
        self.clock.now += 70 * MS if number == 1 else 0
        return count


def test_a_stalled_consumer_is_named(device: Device, clock: ManualClock) -> None:
    source = Timed(12, clock)
    with Pipeline(
        source, READOUT, device=device, batch=1, ring=3, policy="drop_oldest", clock=clock, zero_copy=False
    ) as stream:
        source.let(1)
        assert next(stream).number == 0
        clock.now += 400 * MS  # the consumer works
        source.let(8)
        source.drained(9)
        assert next(stream).number == 7  # 6 frames were dropped
        report = stream.report()
    stall = report.longest_stall
    assert stall is not None
    assert (report.dropped, stall.frame, stall.place) == (6, 7, "consumer")
    assert stall.consumer == pytest.approx(0.4, abs=1e-3)
    assert stall.seconds == pytest.approx(0.4, abs=1e-3)


def test_a_stalled_source_is_named(device: Device) -> None:
    clock = RequestClock()
    source = SlowTape(3, clock)
    with Pipeline(source, READOUT, device=device, batch=1, ring=3, clock=clock) as stream:
        source.let(1)
        next(stream)
        clock.requested.clear()
        source.let(3)
        list(stream)
    stall = stream.report().longest_stall
    assert stall is not None
    assert (stall.frame, stall.place) == (1, "producer")
    assert stall.producer == pytest.approx(0.07, abs=1e-3)


def test_a_stalled_device_is_named(memory: dict[str, Any], clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = SharedSlot if memory["zero_copy"] else StagedSlot
    wait = kind.wait

    def slow(slot: Slot[Any]) -> None:
        wait(slot)
        clock.now += 250 * MS if slot.number == 2 else 0

    monkeypatch.setattr(kind, "wait", slow)
    source = Timed(5, clock)
    with Pipeline(source, READOUT, batch=1, ring=3, clock=clock, **memory) as stream:
        for _ in range(5):
            source.let(1)
            next(stream)
    report = stream.report()
    assert report.longest_stall is not None
    assert (report.longest_stall.frame, report.longest_stall.place) == (2, "device")
    assert report.longest_stall.device == pytest.approx(0.25, abs=1e-3)
    plain = json.loads(json.dumps(report.to_dict()))["longest_stall"]
    assert set(plain) == {"seconds", "frame", "place", "producer", "device", "consumer", "collector"}
    assert plain["place"] == "device"
    assert "longest stall 250 ms, most of it in the device" in str(report)


@pytest.mark.parametrize("inline", [False, True])
def test_a_slow_launch_is_the_device_s_where_kernels_run_inline(
    device: Device, inline: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    clock = RequestClock()
    launch = SharedSlot.launch

    def slow(slot: Slot[Any]) -> None:
        if slot.number == 1:
            assert clock.requested.wait(30)
            clock.now += 90 * MS
        launch(slot)

    monkeypatch.setattr(SharedSlot, "launch", slow)
    source = Timed(3, clock)
    readout = LineReadout(method="centroid")
    source.shape, source.dtype = (600, 2000), np.dtype(np.uint8)  # too large to run inline by default
    with Pipeline(source, readout, device=device, batch=1, ring=3, inline=inline, clock=clock) as stream:
        source.let(1)
        next(stream)
        clock.requested.clear()
        source.let(3)
        list(stream)
    stall = stream.report().longest_stall
    assert stall is not None
    assert (stall.frame, stall.place) == (1, "device" if inline else "producer")
    assert getattr(stall, stall.place) == pytest.approx(0.09, abs=1e-3)


def test_with_device_times_the_wake_up_after_the_kernel_is_the_consumer_s(
    device: Device, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device computes for 10 ms, on the host's clock; the wait for it returns 240 ms later."""
    kind = SharedSlot if device.shares_memory else StagedSlot
    wait = kind.wait

    def slow(slot: Slot[Any]) -> None:
        wait(slot)
        clock.now += 250 * MS

    monkeypatch.setattr(kind, "wait", slow)
    monkeypatch.setattr(kind, "queued", property(lambda slot: clock.now - 251 * MS))
    monkeypatch.setattr(kind, "spans", lambda slot: {"compute": (clock.now - 250 * MS, clock.now - 240 * MS)})
    source = Timed(2, clock)
    with Pipeline(source, READOUT, device=device, batch=1, ring=2, clock=clock, profile=True) as stream:
        stream._device_clock.offset = 0
        source.let(1)
        next(stream)
    stall = stream.report().longest_stall
    assert stall is not None
    assert stall.place == "consumer"
    assert stall.consumer == pytest.approx(0.24, abs=1e-3)
    assert stall.device == pytest.approx(0.01, abs=1e-3)


def test_a_stall_begins_when_the_batch_is_complete(device: Device, clock: ManualClock) -> None:
    class Pairs(Timed):
        def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
            arrived[:] = clock.now - 60 * MS, clock.now
            self._next += 2
            return 2

    source = Pairs(2, clock)
    with Pipeline(source, READOUT, device=device, batch=2, ring=2, clock=clock) as stream:
        clock.now += 100 * MS
        source.let(1)
        next(stream)
    report = stream.report()
    assert report.latency.maximum > 0.06
    assert report.longest_stall is not None
    assert report.longest_stall.seconds < 1e-3


def test_a_stream_without_a_delivery_has_no_stall(device: Device) -> None:
    report = Pipeline(np.zeros((0, 4, 2), np.float32), READOUT, device=device).run()
    assert report.longest_stall is None
    assert report.to_dict()["longest_stall"] is None
    assert "stall" not in str(report)


def test_a_closed_stream_leaves_the_collector_alone(device: Device) -> None:
    before = list(gc.callbacks)
    with Pipeline(np.ones((3, 4, 2), np.float32), READOUT, device=device) as stream:
        assert len(gc.callbacks) == len(before) + 1
        next(stream)
    assert gc.callbacks == before
