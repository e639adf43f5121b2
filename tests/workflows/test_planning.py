"""The common entry of plans: each job goes to its planner with all of its fields."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import pytest

import gpuvision as gv
from gpuvision.workflows import planning
from gpuvision.workflows.planning import LocationJob, ScanJob
from gpuvision.workflows.planning_location import plan_location
from gpuvision.workflows.planning_scan import plan_scan

PIECES: Any = {"recording": object(), "sensor": object(), "image": object(), "artwork": object(), "device": object()}


def test_a_job_goes_to_its_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "plan_scan", lambda **given: ("scan", given))
    monkeypatch.setattr(planning, "plan_location", lambda **given: ("location", given))
    asked = {"tolerance": 2e-6, "rate": 50.0, "latency": 0.1, "device": PIECES["device"]}
    scan: Any = gv.plan(gv.ScanJob(recording=PIECES["recording"], sensor=PIECES["sensor"]), **asked)
    assert scan == ("scan", {"recording": PIECES["recording"], "sensor": PIECES["sensor"], **asked})
    job = gv.LocationJob(image=PIECES["image"], artwork=PIECES["artwork"], scale=2e-5, initial_pose=(1.0, 2.0, 3.0))
    name, given = gv.plan(job, tolerance=3e-6)  # type: ignore[misc]
    assert name == "location"
    assert given["initial_pose"] == (1.0, 2.0, 3.0)
    assert (given["tolerance"], given["rate"], given["latency"], given["device"]) == (3e-6, None, None, None)


def test_the_fields_of_a_job_are_the_parameters_of_its_planner() -> None:
    common = {"tolerance", "rate", "latency", "device", "limits", "progress"}
    for job, planner in ((ScanJob, plan_scan), (LocationJob, plan_location)):
        parameters: Any = inspect.signature(planner).parameters
        assert {each.name for each in fields(job)} == set(parameters) - common
        for each in fields(job):
            default = parameters[each.name].default
            if default is not inspect.Parameter.empty:
                assert each.default == default, each.name


def test_another_job_is_refused() -> None:
    other: Any = "recording.npy"
    with pytest.raises(TypeError, match="job is a str, expected a ScanJob or a LocationJob"):
        gv.plan(other, tolerance=1e-6)
