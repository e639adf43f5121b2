"""The common entry of plans: each job goes to its planner with all of its fields."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import pytest

import gpuvision as gv
from gpuvision.workflows import planning
from gpuvision.workflows.planning import LocationJob, PlacementJob, ScanJob, SimulationJob
from gpuvision.workflows.planning_location import plan_location
from gpuvision.workflows.planning_placement import plan_placement_settings
from gpuvision.workflows.planning_scan import plan_scan
from gpuvision.workflows.planning_simulation import plan_simulation

NAMES = ("recording", "sensor", "image", "artwork", "machine", "device")
PIECES: Any = {name: object() for name in NAMES}


def test_a_job_goes_to_its_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "plan_scan", lambda **given: ("scan", given))
    monkeypatch.setattr(planning, "plan_location", lambda **given: ("location", given))
    monkeypatch.setattr(planning, "plan_placement_settings", lambda **given: ("placement", given))
    monkeypatch.setattr(planning, "plan_simulation", lambda **given: ("simulation", given))
    asked = {"tolerance": 2e-6, "rate": 50.0, "latency": 0.1, "device": PIECES["device"]}
    scan: Any = gv.plan(gv.ScanJob(recording=PIECES["recording"], sensor=PIECES["sensor"]), **asked)
    assert scan == ("scan", {"recording": PIECES["recording"], "sensor": PIECES["sensor"], **asked})
    job = gv.LocationJob(image=PIECES["image"], artwork=PIECES["artwork"], scale=2e-5, initial_pose=(1.0, 2.0, 3.0))
    found: Any = gv.plan(job, tolerance=3e-6)
    name, given = found
    assert name == "location"
    assert given["initial_pose"] == (1.0, 2.0, 3.0)
    assert (given["tolerance"], given["rate"], given["latency"], given["device"]) == (3e-6, None, None, None)
    placement = gv.PlacementJob(artwork=PIECES["artwork"], target=(1.0, 2.0, 3.0), machine=PIECES["machine"], budget=9)
    found = gv.plan(placement, **asked)
    name, given = found
    assert name == "placement"
    assert (given["target"], given["machine"], given["budget"]) == ((1.0, 2.0, 3.0), PIECES["machine"], 9)
    assert given["rate"] == 50.0
    simulation = gv.SimulationJob(part=PIECES["image"], materials=(), sensor=PIECES["sensor"], paths=("direct",))
    found = gv.plan(simulation, **asked)
    name, given = found
    assert name == "simulation"
    assert (given["part"], given["paths"], given["rate"]) == (PIECES["image"], ("direct",), 50.0)


def test_the_fields_of_a_job_are_the_parameters_of_its_planner() -> None:
    common = {"tolerance", "rate", "latency", "device", "limits", "progress"}
    pairs = (
        (ScanJob, plan_scan),
        (LocationJob, plan_location),
        (PlacementJob, plan_placement_settings),
        (SimulationJob, plan_simulation),
    )
    for job, planner in pairs:
        parameters: Any = inspect.signature(planner).parameters
        assert {each.name for each in fields(job)} == set(parameters) - common
        for each in fields(job):
            default = parameters[each.name].default
            if default is not inspect.Parameter.empty:
                assert each.default == default, each.name


def test_another_job_is_refused() -> None:
    other: Any = "recording.npy"
    expected = "a ScanJob, a LocationJob, a PlacementJob or a SimulationJob"
    with pytest.raises(TypeError, match=f"job is a str, expected {expected}"):
        gv.plan(other, tolerance=1e-6)
