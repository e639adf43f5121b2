"""Report and summary of a located robot."""

from __future__ import annotations

import math
from importlib.metadata import version
from typing import Any

import numpy as np
import pytest

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.evidence import Evidence
from gpuvision.matching.field.field_pose import PoseCandidate
from gpuvision.matching.field.located_robot import LocatedRobot
from gpuvision.matching.field.point_scale import PointScale
from gpuvision.status import Status

COVARIANCE = np.diag([4e-4, 9e-4, 1e-4])
KNOWN = PoseCandidate(
    np.array([1.0, 2.0, 0.5]), COVARIANCE, np.diag([1.0, 2.0, 3.0]), 0.125, 0.02, 0.75, None, Status.OK
)
PARTLY = KNOWN._replace(covariance=np.full((3, 3), np.nan), symmetric_twin=0, status=Status.AMBIGUOUS)
EVIDENCE = Evidence(log_nfa=-2.0 * math.log(10.0), on_lines=0.6, expected=40, seen=0.8, least_seen=0.4)


def located(device: Device, **changes: Any) -> LocatedRobot:
    values = {
        "candidates": (KNOWN, PARTLY),
        "doubtful": (),
        "evidence": EVIDENCE,
        "points": np.array([[1.0, 2.0], [3.0, 4.0]], np.float32),
        "field": read_field("robocup_msl"),
        "scale": 0.04,
        "reason": "",
        "device": device,
        "steps": {"search": {"device": device.label, "seconds": {}, "unusable": {}}},
        "seconds": {"lines": 0.5},
        "point_scale": PointScale(0.01, 0.002, 9, np.zeros(3)),
        "warnings": ("a warning",),
    }
    return LocatedRobot(**{**values, **changes})


def test_report(device: Device) -> None:
    names = ("x", "y", "theta")
    known = {
        "pose": dict(zip(names, (1.0, 2.0, 0.5), strict=True)),
        "sigmas": pytest.approx(dict(zip(names, (0.02, 0.03, 0.01), strict=True))),
        "covariance": COVARIANCE.tolist(),
        "information": np.diag([1.0, 2.0, 3.0]).tolist(),
        "score": 0.125,
        "inlier_fraction": 0.75,
        "residual_std": 0.02,
        "symmetric_twin": None,
        "status": "OK",
    }
    partly = {**known, "sigmas": None, "covariance": None, "symmetric_twin": 0, "status": "AMBIGUOUS"}
    assert located(device).report() == {
        "gpuvision": version("gpuvision"),
        "status": "located",
        "reason": None,
        "field": read_field("robocup_msl").name,
        "symmetric": True,
        "candidates": [known, partly],
        "evidence": {"log10_nfa": pytest.approx(-2.0), "on_lines": 0.6, "expected": 40, "seen": 0.8},
        "scale": 0.04,
        "point_scale": {"error": 0.01, "sigma": 0.002},
        "warnings": ["a warning"],
        "points": [[1.0, 2.0], [3.0, 4.0]],
        "device": {"label": device.label, "name": device.name, "driver": device.driver},
        "steps": {"search": {"device": device.label, "seconds": {}, "unusable": {}}},
        "seconds": {"lines": 0.5},
    }
    refused = located(device, candidates=(), evidence=None, reason="no lines").report()
    assert (refused["status"], refused["reason"], refused["evidence"]) == ("refused", "no lines", None)
    assert located(device, point_scale=None, warnings=()).report()["point_scale"] is None
    unseen = located(device, evidence=EVIDENCE._replace(expected=0, seen=math.nan)).report()
    assert unseen["evidence"]["seen"] is None


def test_summary(device: Device) -> None:
    assert located(device).summary().splitlines() == [
        "2 points, 60% of them on lines; 80% of what should be seen of the lines is",
        "1: x 1.000 m, y 2.000 m, heading 28.65 degrees; sigmas 20 mm, 30 mm, 0.57 degrees; score 0.125, 75% of the "
        "points on lines",
        "2: x 1.000 m, y 2.000 m, heading 28.65 degrees; the points fix a part of it only; score 0.125, 75% of the "
        "points on lines; twin of 1",
    ]
    near = located(device, candidates=(KNOWN._replace(status=Status.NOT_CONVERGED),))
    assert "0.57 degrees, not converged; score" in near.summary()
    assert near.report()["candidates"][0]["status"] == "NOT_CONVERGED"
    few = located(device, candidates=(), evidence=EVIDENCE._replace(expected=0, seen=math.nan))
    assert few.summary() == "2 points, 60% of them on lines"
    assert "; 0% of what should be seen" in located(device, evidence=EVIDENCE._replace(seen=-0.5)).summary()
    assert located(device, reason="no lines").summary() == "refused: no lines"
