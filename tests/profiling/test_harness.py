"""Benchmark harness: ratios within rounds, invalid runs, and the result file."""

from __future__ import annotations

import datetime
import itertools
import json
import types
from importlib.metadata import version

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

import gpuvision as gv
from gpuvision.profiling import ceiling, harness, rounds


def case(**changes):
    fields = {
        "operation": "psd",
        "name": "float32/16",
        "ours": lambda: None,
        "peers": {"numpy": lambda: sum(range(2000))},
        "error": 1e-9,
    }
    return harness.Case(**(fields | changes))


class StepClock:
    """Replacement of the module `time`: a reading takes 0.1 ms, and a function of `work` its number of seconds."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += 1e-4
        return self.now

    def work(self, seconds):
        def call():
            self.now += seconds

        return call


@pytest.fixture
def clock(monkeypatch):
    clock = StepClock()
    monkeypatch.setattr(rounds, "time", clock)
    return clock


def test_a_row_holds_a_peer_against_us(clock, device):
    (row,) = harness.measure(case(peers={"numpy": clock.work(3e-4)}), device, seconds=0.01)
    assert (row.peer, row.peer_version, row.case) == ("numpy", np.__version__, "float32/16")
    assert (row.seconds, row.peer_seconds) == pytest.approx((1e-4, 4e-4))
    assert row.ratio == pytest.approx(4.0)
    assert row.fraction is None


def test_a_row_shows_the_fastest_form_of_a_peer(clock, device):
    peers = {
        "numba": {"pairs": clock.work(7e-4), "words": clock.work(3e-4), "loop": clock.work(9e-4)},
        "numba-plain": clock.work(15e-4),
    }
    strongest, plain = harness.measure(case(peers=peers, factors={"numba": 2.0}), device, seconds=0.01)
    assert (strongest.peer, strongest.form) == ("numba", "words")
    assert (plain.peer, plain.form) == ("numba-plain", "")
    assert strongest.peer_version == plain.peer_version == version("numba")
    assert (strongest.peer_seconds, plain.peer_seconds) == pytest.approx((8e-4, 16e-4))
    assert strongest.to_dict()["form"] == "words"


def test_a_row_states_the_spread_of_the_ratio_over_the_rounds(clock, device):
    """The peer takes 200 to 800 times as long as ours; its turn is one call."""
    extra = itertools.cycle([0.1 * k - 1e-4 for k in (5, 5, 2, 8, 3, 7, 4, 6)])

    def uneven():
        clock.now += next(extra)

    few, many = (
        harness.measure(case(ours=clock.work(0.0009), peers={"numpy": uneven}), device, seconds=seconds)[0]
        for seconds in (7.0, 30.0)
    )
    for row in (few, many):
        assert row.ratio == pytest.approx(500.0, rel=0.21)
        assert 199.0 < row.ratio_low < row.ratio < row.ratio_high < 801.0
        assert 0.95 <= row.confidence < 1.0
        assert row.interval[0] < row.ratio_low < row.ratio_high < row.interval[1]
    assert few.rounds < many.rounds <= 101
    assert many.ratio_high - many.ratio_low < few.ratio_high - few.ratio_low


def test_a_slow_peer_is_measured_once_or_twice(clock, device):
    """A peer that alone takes longer than the time of the case takes one turn of one call; one of half of it two."""
    calls = {"numba": 0, "numpy": 0}

    def slow(name, seconds):
        def call():
            calls[name] += 1
            clock.now += seconds

        return call

    peers = {"numba": slow("numba", 5.0), "numpy": slow("numpy", 0.8)}
    once, twice = harness.measure(case(ours=clock.work(0.01), peers=peers), device, seconds=1.0)
    assert (once.rounds, twice.rounds) == (1, 2)
    assert (once.confidence, twice.confidence) == (0.0, 0.5)
    assert (once.interval, twice.interval) == (None, None)
    assert calls == {"numba": 3, "numpy": 4}  # the first call compiles, the second one gives the expected duration
    assert once.ratio == pytest.approx(500.0, rel=0.02)


def test_the_ceiling_moves_the_bytes_of_the_case(clock, monkeypatch, device):
    calls = []

    def move(*bytes_and_repeats):
        calls.append(bytes_and_repeats)
        return clock.work(1.9e-3)

    monkeypatch.setattr(ceiling, "move", move)
    slow = case(ours=clock.work(19.9e-3), traffic=(3 << 20, 1 << 20), repeats=8)
    (row,) = harness.measure(slow, device, seconds=0.05)
    assert calls == [(device, 3 << 20, 1 << 20, 8)]
    assert row.seconds == pytest.approx(20e-3 / 8)
    assert row.fraction == pytest.approx(0.1)  # fraction of the device's limit


def test_a_row_has_the_times_on_the_device(device):
    bound = gv.PsdReadout(strip_length=6e-3, layout="planar").bind(device, (2, 100_000), np.float32)
    (row,) = harness.measure(case(ours=bound.run, flops=4e5, traffic=(8, 16)), device, seconds=0.02)
    assert 0.0 < row.device_seconds < row.seconds * 2.0
    assert min(row.queued_seconds, row.submitted_seconds) >= 0.0
    assert (row.flops, row.bytes) == (4e5, 24)
    (row,) = harness.measure(case(ours=lambda: bound.run(), bound=bound), device, seconds=0.02)
    assert row.device_seconds > 0.0
    (row,) = harness.measure(case(ours=lambda: bound.run()), device, seconds=0.02)
    assert (row.device_seconds, row.queued_seconds, row.submitted_seconds, row.flops, row.bytes) == (None,) * 5


def test_what_moves_bytes_runs(device):
    ceiling.move(device, 1 << 20, 1 << 18, 2)()


def test_facts_stand_beside_the_columns(device):
    (row,) = harness.measure(case(metadata={"p50_us": 12.0}), device, seconds=0.01)
    assert row.to_dict()["p50_us"] == 12.0
    assert "metadata" not in row.to_dict()


def test_a_part_of_a_peers_work_stands_for_all_of_it(clock, device):
    (part,), (complete,) = (
        harness.measure(case(peers={"numpy": clock.work(1.9e-3)}, factors=factors), device, seconds=0.01)
        for factors in ({}, {"numpy": 1e3})
    )
    assert part.peer_seconds == pytest.approx(2e-3)
    assert complete.peer_seconds == pytest.approx(2.0)
    assert complete.ratio == pytest.approx(1e3 * part.ratio)


@pytest.fixture
def fake(monkeypatch):
    """An operation of one empty case, and a machine whose speed the test sets."""
    module = types.SimpleNamespace(cases=lambda device: iter([case()]))
    monkeypatch.setattr(harness.importlib, "import_module", lambda name: module)
    speeds = iter(())

    def set_speeds(*values):
        nonlocal speeds
        speeds = iter((100.0, *values))  # the first one is for the description of the machine

    monkeypatch.setattr(ceiling, "flop_rate", lambda device, **_: next(speeds, 100.0))
    return set_speeds


def test_a_section_is_measured_again_when_the_machine_changed_its_speed(fake, device, tmp_path):
    fake(100.0, 55.0, 100.0, 99.0)
    lines = []
    run = harness.profile(["psd"], [device], seconds=0.01, progress=lines.append)
    assert run.valid
    assert len(run.rows) == 1
    assert sum("changed its speed" in line for line in lines) == 1
    assert [(probe.before, probe.after, probe.steady) for probe in run.probes] == [
        (100.0, 55.0, False),
        (100.0, 99.0, True),
    ]


def test_a_repeated_section_that_fails_keeps_the_earlier_rows(fake, monkeypatch, device):
    attempts = iter((lambda: [case()], lambda: 1 / 0))
    module = types.SimpleNamespace(cases=lambda device: next(attempts)())
    monkeypatch.setattr(harness.importlib, "import_module", lambda name: module)
    fake(100.0, 55.0)
    run = harness.profile(["psd"], [device], seconds=0.01)
    assert [row.case for row in run.rows] == ["float32/16"]
    assert not run.valid
    assert [failure.reason for failure in run.failures] == ["ZeroDivisionError: division by zero"]


def test_a_quick_run_names_a_case_that_its_module_does_not_have(fake, device):
    run = harness.profile(["psd"], [device], seconds=0.01, quick=True)
    assert run.rows == []
    reason = f"LookupError: psd has no case 'float32/1e6' on {device.label}, see QUICK_CASES"
    assert [failure.reason for failure in run.failures] == [reason]


# Numba compiles their peers for more than 10 s.
NIGHTLY = {"blob", "line", "ruler"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "operation",
    [pytest.param(each, marks=[pytest.mark.nightly] * (each in NIGHTLY)) for each in sorted(harness.QUICK_CASES)],
)
def test_the_modules_have_the_cases_of_a_quick_run(operation, device):
    (found,) = harness._cases(operation, device, quick=True)
    assert found.name == harness.QUICK_CASES[operation]


def test_a_section_is_not_repeated_when_the_time_is_over(fake, device):
    fake(*[100.0, 55.0] * 4)
    run = harness.profile(["psd"], [device], seconds=0.01, total=1e-6)
    assert not run.valid
    assert len(run.probes) == len(run.rows) == 1


def test_the_case_of_a_quick_run_keeps_what_its_generator_holds_open(fake, monkeypatch, device):
    """A stream is open as long as its generator."""
    given, is_open = [], True

    def cases(device, **settings):
        nonlocal is_open
        given.append(settings)
        try:
            yield case(ours=lambda: None if is_open else 1 / 0)
        finally:
            is_open = False

    monkeypatch.setattr(harness.importlib, "import_module", lambda name: types.SimpleNamespace(cases=cases))
    run = harness.profile(["stream"], [device], seconds=0.01, quick=True)
    assert (len(run.rows), run.failures) == (1, [])
    assert (given, is_open) == ([harness.QUICK_SETTINGS["stream"]], False)


def test_a_quick_run_measures_one_case_of_each_operation(fake, monkeypatch, device):
    built = []

    def cases(device):
        for name in ("small", "float32/1e6", "never"):
            built.append(name)
            yield case(name=name)

    monkeypatch.setattr(harness.importlib, "import_module", lambda name: types.SimpleNamespace(cases=cases))
    run = harness.profile(["psd", "bvh"], [device], seconds=0.01, quick=True)
    assert [row.case for row in run.rows] == ["float32/1e6", "small"]
    assert built == ["small", "float32/1e6", "small"]


def test_a_machine_that_never_holds_its_speed_voids_the_run(fake, device, tmp_path):
    fake(*[100.0, 55.0] * 4)
    run = harness.profile(["psd"], [device], seconds=0.01)
    assert not run.valid
    run.write(tmp_path / "run.json")
    table = json.loads((tmp_path / "run.json").read_text())
    assert table["valid"] is False
    assert [probe["after"] for probe in table["probes"]] == [55.0] * 4
    assert {"ratio_low", "ratio_high", "confidence", "rounds"} <= set(table["rows"][0])
    expected = {"operation", "case", "device", "seconds", "peer", "peer_version", "peer_seconds", "ratio", "error"}
    assert expected | {"fraction"} <= set(table["rows"][0])
    assert datetime.date.fromisoformat(table["machine"]["date"]).year >= 2026
    assert table["machine"]["devices"][device.label]["driver"] == device.driver


def test_rows_stay_when_another_operation_fails(monkeypatch, device, tmp_path):
    """The others are measured, also after the failed one; its name and the reason are in the file."""

    def fail(device):
        yield case(name="before")
        raise ValueError("no such\ntable")

    modules = {
        name: types.SimpleNamespace(cases=lambda device, name=name: [case(name=name)]) for name in ("psd", "line")
    }
    modules["rays"] = types.SimpleNamespace(cases=fail)
    monkeypatch.setattr(harness.importlib, "import_module", lambda name: modules[name.rpartition(".")[2]])
    monkeypatch.setattr(ceiling, "flop_rate", lambda device, **_: 100.0)
    lines = []
    run = harness.profile(["psd", "bvh", "line"], [device], seconds=0.01, progress=lines.append)
    assert [row.case for row in run.rows] == ["psd", "line"]
    assert run.valid
    run.write(tmp_path / "run.json")
    table = json.loads((tmp_path / "run.json").read_text())
    assert [row["case"] for row in table["rows"]] == ["psd", "line"]
    (failure,) = table["failures"]
    assert (failure["operation"], failure["device"]) == ("bvh", device.label)
    assert failure["reason"] == "ValueError: no such\ntable"
    assert "in fail" in failure["traceback"]
    assert lines == [
        f"psd on {device.label}",
        f"bvh on {device.label}",
        "  failed: ValueError: no such\ntable",
        f"line on {device.label}",
    ]
