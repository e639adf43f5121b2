"""The stream's benchmark: the row of a rate, and the search for the highest rate."""

from __future__ import annotations

import dataclasses
import functools

import pytest

from gpuvision.host import StreamError

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import stream


class Machine:
    """Fake machine that keeps up with every rate up to a limit, with occasional stalls."""

    def __init__(self, limit: float, stalls: tuple[int, ...] = ()) -> None:
        self.limit, self.stalls, self.asked = limit, stalls, []

    def hold(self, frames, device, rate, seconds, batch):
        self.asked.append(rate)
        return _held(rate, dropped=int(rate > self.limit or len(self.asked) in self.stalls))


@functools.cache
def _report():
    return stream.Pipeline(stream.line_frames(), stream.READOUT).run()


def _held(rate, dropped=0, late=0.0):
    return stream.Held(rate, dataclasses.replace(_report(), dropped=dropped), late)


@pytest.mark.parametrize("limit", [9000.0, 20_000.0, 300.0])
@pytest.mark.parametrize("stalls", [(), (1,), (1, 4, 8)])
def test_the_highest_rate_is_found_though_the_machine_stalls(monkeypatch, limit, stalls):
    machine = Machine(limit, stalls)
    monkeypatch.setattr(stream, "hold", machine.hold)
    found = stream.highest(None, None, {1: 8000.0, 4: 16_000.0})
    assert found.holds
    assert limit * 0.96 < found.rate <= limit
    assert len(machine.asked) < 40


def test_a_rate_does_not_hold_with_drops_or_a_sensor_that_overflows():
    assert _held(1000.0).holds
    assert not _held(1000.0, dropped=1).holds
    assert not _held(1000.0, late=0.2).holds


def test_rows_for_each_rate_and_the_highest(device):
    cases = list(stream.cases(device, run_seconds=0.05))
    assert [case.name for case in cases] == ["1000", "4000", "highest"]
    for case in cases:
        assert case.operation == "stream"
        assert case.error < 1e-4  # single precision of a position below 512 is 3e-5
        metadata = case.metadata
        assert metadata["frames"] + metadata["dropped"] == pytest.approx(metadata["rate"] * 0.05, abs=1)
        assert 0.0 < metadata["p50_us"] <= metadata["p99_us"] <= metadata["p999_us"] <= metadata["max_us"]
        case.peers["pyopencl"]()
    with pytest.raises(StreamError, match="not open"):
        cases[0].ours()  # its stream was closed when the next case was requested
    assert cases[2].metadata["holds"]
