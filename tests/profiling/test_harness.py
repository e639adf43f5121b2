"""Benchmark harness: ratios within rounds, invalid runs, and the result file."""

from __future__ import annotations

import datetime
import json
import time
import types

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import ceiling, harness


def case(**changes):
    fields = {
        "operation": "psd",
        "name": "float32/16",
        "ours": lambda: None,
        "peers": {"numpy": lambda: sum(range(2000))},
        "error": 1e-9,
    }
    return harness.Case(**(fields | changes))


def test_a_row_holds_a_peer_against_us(device):
    (row,) = harness.measure(case(), device, seconds=0.01)
    assert (row.peer, row.peer_version, row.case) == ("numpy", np.__version__, "float32/16")
    assert row.ratio > 1.0  # summing 2000 numbers takes measurable time
    assert row.fraction is None


def test_the_ceiling_moves_the_bytes_of_the_case(monkeypatch, device):
    calls = []

    def move(*bytes_and_repeats):
        calls.append(bytes_and_repeats)
        return lambda: time.sleep(2e-3)

    monkeypatch.setattr(ceiling, "move", move)
    slow = case(ours=lambda: time.sleep(20e-3), traffic=(3 << 20, 1 << 20), repeats=8)
    (row,) = harness.measure(slow, device, seconds=0.05)
    assert calls == [(device, 3 << 20, 1 << 20, 8)]
    assert 0.0 < row.fraction < 1.0  # fraction of the device's limit


def test_what_moves_bytes_runs(device):
    ceiling.move(device, 1 << 20, 1 << 18, 2)()


def test_facts_stand_beside_the_columns(device):
    (row,) = harness.measure(case(metadata={"p50_us": 12.0}), device, seconds=0.01)
    assert row.to_dict()["p50_us"] == 12.0
    assert "metadata" not in row.to_dict()


def test_a_part_of_a_peers_work_stands_for_all_of_it(device, monkeypatch):
    # The peer moves the clock by 2 ms: on a busy machine a peer that sleeps takes several times as long.
    waited = 0.0

    def work():
        nonlocal waited
        waited += 2e-3

    clock = types.SimpleNamespace(perf_counter=lambda: time.perf_counter() + waited)
    monkeypatch.setattr(harness, "time", clock)
    (part,), (complete,) = (
        harness.measure(case(peers={"numpy": work}, factors=factors), device, seconds=0.01)
        for factors in ({}, {"numpy": 1e3})
    )
    assert part.peer_seconds == pytest.approx(2e-3, rel=0.9)
    assert complete.peer_seconds == pytest.approx(2.0, rel=0.9)
    assert complete.ratio > 100.0 * part.ratio


@pytest.fixture
def fake(monkeypatch):
    """An operation of one empty case, and a machine whose speed the test sets."""
    module = types.SimpleNamespace(cases=lambda device: iter([case()]))
    monkeypatch.setattr(harness.importlib, "import_module", lambda name: module)
    speeds = iter(())

    def set_speeds(*values):
        nonlocal speeds
        speeds = iter(values)

    monkeypatch.setattr(ceiling, "flop_rate", lambda device, **_: next(speeds, 100.0))
    return set_speeds


def test_a_section_is_measured_again_when_the_machine_changed_its_speed(fake, device, tmp_path):
    fake(100.0, 55.0, 100.0, 99.0)
    lines = []
    run = harness.profile(["psd"], [device], seconds=0.01, progress=lines.append)
    assert run.valid
    assert len(run.rows) == 1
    assert sum("changed its speed" in line for line in lines) == 1


def test_a_machine_that_never_holds_its_speed_voids_the_run(fake, device, tmp_path):
    fake(*[100.0, 55.0] * 4)
    run = harness.profile(["psd"], [device], seconds=0.01)
    assert not run.valid
    run.write(tmp_path / "run.json")
    table = json.loads((tmp_path / "run.json").read_text())
    assert table["valid"] is False
    expected = {"operation", "case", "device", "seconds", "peer", "peer_version", "peer_seconds", "ratio", "error"}
    assert expected | {"fraction"} <= set(table["rows"][0])
    assert datetime.date.fromisoformat(table["machine"]["date"]).year >= 2026
    assert table["machine"]["devices"][device.label]["driver"] == device.driver
