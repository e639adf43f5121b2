"""Choice of the settings of a stream: limits on both sides, and what the measurements of a plan run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device, planning
from gpuvision.host.planning import BATCHES, Cost, Plan, PlanLimits, Trial, plan_stream
from gpuvision.host.sources import ArraySource
from streams import READOUT

FREE = PlanLimits(max_bytes=1 << 40)


def test_batch_sizes_double_from_one_frame() -> None:
    """The chosen batch is then at most twice the smallest that suffices."""
    assert [*BATCHES] == [1 << k for k in range(len(BATCHES))]
    assert BATCHES[-1] == 4096


def test_limits_are_given_by_name() -> None:
    assert PlanLimits(min_ring=8).min_ring == 8
    with pytest.raises(TypeError, match="positional argument"):
        PlanLimits(8)


def planned(cost: Any, *, frames: int = 200, **options: Any) -> Plan:
    source = ArraySource(np.zeros((frames, 4, 2), np.float32))
    settings = {"rate": 1000.0, "inline": False, "limits": FREE, "measure": cost, "batches": (1, 2)} | options
    return plan_stream(source, READOUT, **settings)


@pytest.mark.parametrize(("rate", "batch"), [(1250.0, 1), (1249.9, 2)])
def test_a_batch_with_exactly_the_margin_keeps_up(rate: float, batch: int) -> None:
    chosen = planned(lambda size, inline: Cost(rate * size, 1e-4, 1e-5))
    assert chosen.batch == batch


@pytest.mark.parametrize("headroom", [math.nan, math.inf, 1.2, -1.0])
def test_a_headroom_below_the_margin_or_not_finite_is_refused(headroom: float) -> None:
    with pytest.raises(ValueError, match=r"expected a number of the margin 1\.25 or more"):
        planned(lambda size, inline: Cost(1e5, 1e-4, 1e-5), headroom=headroom)


@pytest.mark.parametrize(
    ("headroom", "latency", "batch"),
    [
        (None, None, 2),
        (1.6, None, 2),
        (1.61, None, 4),
        (2.4, None, 4),
        (2.41, None, 8),
        (3.0, None, 8),  # the fastest: a batch of 16 takes longer
        (3.0, 5e-3, 4),
    ],
)
def test_a_larger_batch_gives_the_headroom(headroom: float | None, latency: float | None, batch: int) -> None:
    """A batch of one frame has too little margin. A batch of 8 is complete after 7 ms."""
    rates = {1: 1200.0, 2: 1600.0, 4: 2400.0, 8: 2500.0, 16: 1250.0}
    chosen = planned(
        lambda size, inline: Cost(rates[size], 1e-4, 1e-5), headroom=headroom, latency=latency, batches=(*rates,)
    )
    assert chosen.batch == batch
    assert chosen.trials[-1].batch == batch
    assert chosen.ring == {2: 101, 4: 51, 8: 26}[batch]


@pytest.mark.parametrize(("latency", "batch"), [(2e-3, 2), (1.9999e-3, None)])
def test_a_batch_may_take_exactly_the_latency(latency: float, batch: int | None) -> None:
    """A batch of two frames is complete after 1 ms and takes 1 ms."""

    def cost(size: int, inline: bool) -> Cost:
        return Cost(800.0 * size, 5e-4 * size, 1e-5)

    if batch is None:
        with pytest.raises(planning.StreamError, match="within 2 ms: the fastest, 2 frames, does 1600 frames/s with 2"):
            planned(cost, latency=latency)
    else:
        assert planned(cost, latency=latency).batch == batch


def test_the_latency_is_that_of_the_chosen_threads() -> None:
    trials = tuple(Trial(size, 1e4, latency, inline, 1e-4, 1e-5) for size, latency, inline in (
        (1, 0.1, False), (1, 0.2, True), (2, 0.3, False), (2, 0.4, True)
    ))  # fmt: skip
    for inline, latency in ((False, 0.3), (True, 0.4)):
        plan = Plan(Device.best(), 2, 4, inline, 1.0, 0.5, 100, trials)
        assert plan.latency == latency


@pytest.mark.parametrize(
    ("inline", "is_inline"),
    [
        (Cost(2e3, 1e-3, 1.1e-4), True),  # exactly at both limits
        (Cost(2e3, 1.0001e-3, 1.1e-4), False),
        (Cost(2e3, 1e-3, 1.1001e-4), False),
    ],
)
def test_limits_of_inline_kernels(inline: Cost, is_inline: bool) -> None:
    trials = [
        Trial(1, 2e3, 1e-3, each, cost.seconds, cost.processor_time)
        for each, cost in ((False, Cost(2e3, 1e-3, 1e-4)), (True, inline))
    ]
    assert planning._runs_inline(trials, PlanLimits()) == is_inline
    assert planning._runs_inline(trials[::-1], PlanLimits()) == is_inline
    assert [planning._runs_inline([each], PlanLimits()) for each in trials] == [False, True]


@pytest.mark.parametrize(
    ("rates", "is_gaining"),
    [
        ([], True),
        ([9.0, 1.0, 1.0], True),  # not more batch sizes than the patience
        ([100.0, 104.0, 105.0, 105.0], False),
        ([100.0, 104.0, 105.1, 105.0], True),
        ([100.0, 105.1, 1.0, 1.0], True),
        ([105.1, 100.0, 104.0, 1.0], False),
        ([50.0, 100.0, 105.1, 1.0, 1.0], True),
        ([50.0, 105.1, 100.0, 1.0, 1.0], False),
    ],
)
def test_a_search_ends_after_three_batch_sizes_without_a_gain(rates: list[float], is_gaining: bool) -> None:
    """Of the trials of one batch size the faster one counts; the gain is at least 5 %."""
    trials = [
        Trial(1 << k, rate, 0.0, inline, 0.0, 0.0)
        for k, each in enumerate(rates)
        for inline, rate in ((False, each), (True, 0.5 * each))
    ]
    assert planning._is_gaining(trials, PlanLimits()) == is_gaining


@pytest.mark.parametrize(
    ("stall", "batch", "length", "ring"),
    [(0.5, 4, None, 127), (0.5, 3, None, 169), (0.0, 1, None, 4), (0.003, 1, None, 5), (0.5, 4, 18, 6), (0.5, 4, 8, 4)],
)
def test_slots_of_a_ring(stall: float, batch: int, length: int | None, ring: int) -> None:
    """For the frames of the stall, the source and the consumer; for the batches of a recording, and one."""
    source: Any = SimpleNamespace(length=length)
    assert planning._ring_for(stall, 1000.0, batch, source, PlanLimits()) == ring


# ---- measurements ------------------------------------------------------------------------------------------------


class FakeStream:
    """Stream that notes how it is made, and delivers its batches."""

    made: list[Any]

    def __init__(self, source: Any, steps: Any, **how: Any) -> None:
        self.source, self.how = source, how
        self.made.append(self)

    def __enter__(self) -> FakeStream:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[int]:
        return iter(range(self.source.length // self.how["batch"]))

    def report(self) -> Any:
        return SimpleNamespace(throughput=7000.0, latency=SimpleNamespace(p50=3e-3))


@pytest.fixture
def measurement(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(FakeStream, "made", [], raising=False)
    monkeypatch.setattr(planning, "Pipeline", FakeStream)
    sample = np.zeros((3, 4, 2), np.float32)
    device: Any = "a device"
    return planning._Measurement(sample, [], device, True, PlanLimits())


def test_throughput_of_a_round(measurement: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 13.0])
    clock = SimpleNamespace(process_time=lambda: next(times))
    monkeypatch.setattr(planning, "time", clock)
    assert measurement._round(4, 5, True) == (7000.0, pytest.approx(3.0 / 20))
    (stream,) = FakeStream.made
    assert stream.source.length == 20
    assert stream.how == {"batch": 4, "ring": 4, "inline": True, "device": "a device", "zero_copy": True}


def test_time_of_single_batches(measurement: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifteen batches count, after two; each is read when the one before has been delivered."""
    released: list[int] = []

    class Stepped(ArraySource):
        def __init__(self, frames: Any, count: int) -> None:
            super().__init__(frames, count)
            self.released = SimpleNamespace(release=lambda: released.append(1))

    monkeypatch.setattr(planning, "_Stepped", Stepped)
    assert measurement._one_by_one(4, False) == 3e-3
    (stream,) = FakeStream.made
    assert stream.source.length == 60
    how = {"batch": 4, "ring": 2, "warm_up": 2, "inline": False, "device": "a device", "zero_copy": True}
    assert stream.how == how
    assert len(released) == 15


@pytest.mark.parametrize(("seconds", "batches"), [(4e-3, 12), (6.25e-3, 8), (0.1, 8), (1e-3, 50)])
def test_the_best_of_three_rounds_counts(
    seconds: float, batches: int, measurement: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A round takes 0.05 s, and has twice as many batches as the ring has slots at least."""
    rounds = iter([(5.0, 0.3), (9.0, 0.2), (7.0, 0.1)])
    asked: list[Any] = []
    monkeypatch.setattr(measurement, "_one_by_one", lambda *given: asked.append(given) or seconds)
    monkeypatch.setattr(measurement, "_round", lambda *given: asked.append(given) or next(rounds))
    assert measurement(4, True) == Cost(9.0, seconds, 0.1)
    assert asked == [(4, True)] + [(4, batches, True)] * 3


def test_a_stepped_source_stamps_frames_before_it_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gives one batch; the next one waits for the consumer, or for the end."""
    monkeypatch.setattr(planning.time, "perf_counter_ns", lambda: 77)
    source = planning._Stepped(np.arange(12.0).reshape(6, 2), 6)
    out, arrived = np.zeros((2, 2)), np.zeros(2, np.int64)
    assert source.read_into(out, arrived) == 2
    np.testing.assert_array_equal(out, [[0.0, 1.0], [2.0, 3.0]])
    np.testing.assert_array_equal(arrived, [77, 77])
    assert not source.released.acquire(blocking=False)
    source.stop()
    assert source.read_into(out, arrived) == 2
    np.testing.assert_array_equal(out, [[4.0, 5.0], [6.0, 7.0]])
