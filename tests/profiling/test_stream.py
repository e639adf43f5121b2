"""The stream's benchmark: the row of a rate, and the search for the highest rate."""

from __future__ import annotations

import dataclasses
import functools
import subprocess

import pytest

from gpuvision.host import Device, Stall, StreamError

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


def _command(monkeypatch, runs, *results):
    """Run the command with these results of its runs; an exception is raised."""
    left = iter(results)

    def hold_loaded(frames, device, rate, seconds):
        assert (rate, seconds) == (4000, 0.5)
        result = next(left)
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(stream, "hold_loaded", hold_loaded)
    code = stream.main(["--device", Device.best().label, "--runs", str(runs), "--seconds", "0.5"])
    assert list(left) == []
    return code


def test_the_command_repeats_the_loaded_case_and_prints_a_table(monkeypatch, capsys):
    latency = dataclasses.replace(_report().latency, p50=1.234e-3, p99=5.6e-3)
    stall = Stall(seconds=0.0125, frame=3, producer=0.01, device=0.0025, consumer=0.0, collector=0.0)
    told = dataclasses.replace(_report(), dropped=0, latency=latency, longest_stall=stall)
    assert _command(monkeypatch, 2, stream.Held(4000.0, told, 0.099), _held(4000.0)) == 0
    printed = capsys.readouterr().out
    assert "run 2: 16 frames" in printed
    head, first, second = printed.split("\n\n")[-1].splitlines()
    assert head.split("  ")[0] == "run"
    assert first.split() == ["1", Device.best().label, "0", "1234", "5600", "12.50", "producer", "held"]
    assert second.split()[-1] == "held"


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (lambda: _held(4000.0, dropped=7), "frames lost"),
        (lambda: _held(4000.0, late=0.25), "void: frames were read up to 250 ms late"),
        (lambda: StreamError("no slot\nis free"), "void: no slot"),
    ],
)
def test_a_run_that_lost_frames_or_is_void_gives_exit_code_1(monkeypatch, capsys, result, text):
    """The other runs go on."""
    assert _command(monkeypatch, 3, _held(4000.0), result(), _held(4000.0)) == 1
    results = capsys.readouterr().out.split("\n\n")[-1].splitlines()[1:]
    assert [line.endswith("  held") for line in results] == [True, False, True]
    assert results[1].endswith(f"  {text}")


@pytest.mark.parametrize("words", [["--runs", "0"], ["--seconds", "nan"], ["--seconds", "-1"], ["--runs", "x"]])
def test_runs_and_seconds_are_positive(words, capsys):
    with pytest.raises(SystemExit) as ended:
        stream.main(words)
    assert ended.value.code == 2
    assert words[0] in capsys.readouterr().err


def test_a_second_process_that_ends_early_is_an_error(monkeypatch):
    monkeypatch.setattr(stream, "_LOAD_CODE", "print('ready', flush=True)")
    started, start = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *words, **how: started.append(start(*words, **how)) or started[0])
    with pytest.raises(StreamError, match="second process ended with exit code 0"), stream._half_loaded_core():
        started[0].wait(60.0)
