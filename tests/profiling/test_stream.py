"""The stream's benchmark: the row of a rate, and the search for the highest rate."""

from __future__ import annotations

import dataclasses
import functools

import pytest

from gpuvision.host import Device, StreamError

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


@pytest.mark.slow
def test_rows_for_each_rate_and_the_highest(device):
    cases = list(stream.cases(device, run_seconds=0.05))
    assert [case.name for case in cases] == ["1000", "4000", "4000_loaded", "highest"]
    for case in cases:
        assert case.operation == "stream"
        assert case.error < 1e-4  # single precision of a position below 512 is 3e-5
        metadata = case.metadata
        assert metadata["frames"] + metadata["dropped"] == pytest.approx(metadata["rate"] * 0.05, abs=1)
        assert 0.0 < metadata["p50_us"] <= metadata["p99_us"] <= metadata["p999_us"] <= metadata["max_us"]
        assert metadata["stall_place"] in ("producer", "device", "consumer", "collector")
        assert metadata["stall_ms"] > 0.0
        case.peers["pyopencl"]()
    with pytest.raises(StreamError, match="not open"):
        cases[0].ours()  # its stream was closed when the next case was requested
    frames = 201 * 512 * 1024  # slots for 200 frames
    assert frames < cases[2].metadata["ring_bytes"] < 1.1 * frames
    assert cases[3].metadata["holds"]


def test_the_command_repeats_the_loaded_case_and_reports_loss(monkeypatch, capsys):
    losses = iter([0, 7, 0, 0])

    def hold_loaded(frames, device, rate, seconds):
        assert (rate, seconds) == (4000, 0.5)
        return _held(4000.0, dropped=next(losses))

    monkeypatch.setattr(stream, "hold_loaded", hold_loaded)
    command = ["--device", Device.best().label, "--runs", "2", "--seconds", "0.5"]
    assert stream.main(command) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "run 2: 16 frames, 7 dropped" in lines[2]
    assert stream.main(command) == 0
