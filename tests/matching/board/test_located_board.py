"""Report and summary of a located board, from numbers that all differ."""

from __future__ import annotations

import dataclasses
import math
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board.fiducial_detection import FoundFiducials
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.measurement_result import (
    BoardMeasurement,
    PoseSolution,
    RulerMeasurements,
    ScaleError,
    count_true,
    refuse_measurement,
)
from gpuvision.status import Status

VIEW = BoardView(scale=20e-6, shape=(200, 300), pose=(12e-3, 34e-3, 0.25))
RULERS = RulerMeasurements(
    point=np.array([[12e-3, 34e-3], [13e-3, 34e-3], [12e-3, 33e-3], [11e-3, 34e-3]]),
    normal=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0], [0.0, -1.0]]),
    length_px=np.array([30.0, 31.0, 32.0, 33.0]),
    position_px=np.array([2.0, -3.0, np.nan, np.nan]),
    sigma=np.array([1e-6, 2e-6, np.nan, np.nan]),
    weight=np.array([0.9, 0.04, 0.0, 0.0]),
    residual=np.array([1e-7, -2e-6, np.nan, np.nan]),
    status=np.array([0, Status.AMBIGUOUS, Status.LOW_SIGNAL, Status.OUT_OF_RANGE], np.uint8),
)
FIDUCIALS = FoundFiducials(
    point=np.array([[10e-3, 33e-3], [11e-3, 35e-3], [14e-3, 36e-3]]),
    radius=np.array([3e-4, 4e-4, 5e-4]),
    seen=np.array([[10e-3, 33e-3], [11e-3, 35e-3], [np.nan, np.nan]]),
    image_px=np.array([[50.0, 60.0], [70.0, 80.0], [np.nan, np.nan]]),
    size=np.array([3.1e-4, 4.1e-4, np.nan]),
    covariance=np.array([np.diag([1e-12, 4e-12]), np.diag([9e-12, 16e-12]), np.full((2, 2), np.nan)]),
    weight=np.array([0.8, 0.0, 0.0]),
    residual=np.array([[1e-7, 2e-7], [3e-7, 4e-7], [np.nan, np.nan]]),
    status=np.array([0, 0, Status.OUT_OF_RANGE], np.uint8),
    in_image=np.array([True, True, False]),
)


def located(**changes: Any) -> LocatedBoard:
    values: dict[str, Any] = {
        "view": VIEW,
        "covariance": np.diag([1.5e-6, 2.5e-6, 1e-4]) ** 2,
        "placement": np.array([12e-3, 33e-3]),
        "placement_px": np.array([150.0, 99.0]),
        "placement_covariance": np.diag([1.0, 2.0, 3.0]),
        "rulers": RULERS,
        "fiducials": FIDUCIALS,
        "features": SimpleNamespace(side="top", covariance=np.diag([4.0, 5.0, 6.0])),
        "etch_bias": math.nan,
        "residual_scale": 1.25,
        "condition": 7.5,
        "copper": "dark",
        "noise": 2.5,
        "threshold": 11.0,
        "reason": "",
        "coarse_registration": None,
        "scale_error": ScaleError(1e-3, 2e-4),
        "device": SimpleNamespace(label="a", name="b", driver="c"),
        "steps": {"rulers": 1},
        "seconds": {"pose": 0.5},
        "warnings": ("one",),
    }
    return LocatedBoard(**values | changes)


def test_summary_of_a_pose_and_of_a_refusal() -> None:
    assert located().summary().splitlines() == [
        "x 12.0000 mm, y 34.0000 mm, theta 14.3239 degrees",
        "sigmas 1.50 µm, 2.50 µm, 0.00573 degrees; 1 of 3 rulers agree, 2 found an edge; 1 of 2 fiducials agree, "
        "2 were found",
    ]
    outside = np.full(4, Status.OUT_OF_RANGE, np.uint8)
    alone = located(rulers=RULERS._replace(status=outside)).summary()
    assert alone.endswith("0.00573 degrees; 1 of 2 fiducials agree, 2 were found")
    none = FIDUCIALS._replace(in_image=np.zeros(3, np.bool_))
    assert located(fiducials=none).summary().endswith("; 1 of 3 rulers agree, 2 found an edge")
    refused = located(reason="too few")
    assert refused.summary() == "refused: too few"
    assert np.isnan(refused.pose).all()
    assert located().pose == VIEW.pose


def test_report_of_a_pose() -> None:
    names = ("x", "y", "theta")
    report = located().report()
    rulers, fiducials = report.pop("rulers"), report.pop("fiducials")
    assert report == {
        "gpuvision": version("gpuvision"),
        "status": "located",
        "reason": None,
        "warnings": ["one"],
        "side": "top",
        "pose": dict(zip(names, VIEW.pose, strict=True)),
        "sigmas": pytest.approx(dict(zip(names, (1.5e-6, 2.5e-6, 1e-4), strict=True))),
        "covariance": (np.diag([1.5e-6, 2.5e-6, 1e-4]) ** 2).tolist(),
        "placement": {
            "board": [12e-3, 33e-3],
            "image_px": [150.0, 99.0],
            "covariance": np.diag([1.0, 2.0, 3.0]).tolist(),
        },
        "predicted_covariance": np.diag([4.0, 5.0, 6.0]).tolist(),
        "etch_bias": None,
        "residual_scale": 1.25,
        "condition": 7.5,
        "scale": 20e-6,
        "scale_error": {"value": 1e-3, "sigma": 2e-4},
        "copper": "dark",
        "noise": 2.5,
        "threshold": 11.0,
        "coarse_registration": None,
        "counts": {
            "in_image": 3,
            "found": 2,
            "used": 1,
            "fiducials_in_image": 2,
            "fiducials_found": 2,
            "fiducials_used": 1,
        },
        "device": {"label": "a", "name": "b", "driver": "c"},
        "steps": {"rulers": 1},
        "seconds": {"pose": 0.5},
    }
    # The places of edges: 2 px, 40 um, along x; -3 px along the other normal; without an edge the ruler's centre.
    places = RULERS.point + np.array([[40e-6, 0.0], [-36e-6, -48e-6], [0.0, 0.0], [0.0, 0.0]])
    for number, entry in enumerate(rulers):
        np.testing.assert_allclose(entry.pop("image_px"), VIEW.to_measured_pixels(places)[number])
        np.testing.assert_allclose(entry.pop("point"), RULERS.point[number])
    assert rulers == [
        {"found": True, "weight": 0.9, "residual": 1e-7, "sigma": 1e-6, "status": "OK"},
        {"found": True, "weight": 0.04, "residual": -2e-6, "sigma": 2e-6, "status": "AMBIGUOUS"},
        {"found": False, "weight": 0.0, "residual": None, "sigma": None, "status": "LOW_SIGNAL"},
        {"found": False, "weight": 0.0, "residual": None, "sigma": None, "status": "OUT_OF_RANGE"},
    ]
    first, second, third = fiducials
    assert first == {
        "point": [10e-3, 33e-3],
        "image_px": [50.0, 60.0],
        "found": True,
        "weight": 0.8,
        "residual": [1e-7, 2e-7],
        "sigmas": pytest.approx([1e-6, 2e-6]),
        "radius": 3.1e-4,
        "status": "OK",
    }
    assert (second["found"], second["weight"], second["sigmas"]) == (True, 0.0, pytest.approx([3e-6, 4e-6]))
    assert (third["found"], third["image_px"], third["radius"], third["status"]) == (
        False,
        [None, None],
        None,
        "OUT_OF_RANGE",
    )


def test_report_of_a_refusal_and_of_a_registration() -> None:
    coarse: Any = SimpleNamespace(score=0.75, runner_up=np.nan)
    report = located(reason="too few", coarse_registration=coarse, etch_bias=3e-6, warnings=()).report()
    assert (report["status"], report["reason"], report["warnings"]) == ("refused", "too few", [])
    assert report["pose"] == {"x": None, "y": None, "theta": None}
    assert report["coarse_registration"] == {"score": 0.75, "runner_up": None}
    assert report["etch_bias"] == 3e-6


def test_counts_of_a_measurement() -> None:
    assert RULERS.in_image.tolist() == [True, True, True, False]
    assert RULERS.found.tolist() == [True, True, False, False]
    assert RULERS._replace(weight=np.array([0.05, 0.051, 0.0, 1.0])).used.tolist() == [False, True, False, True]
    assert count_true(RULERS.used, FIDUCIALS.used, FIDUCIALS.found) == 1 + 1 + 2
    refused = refuse_measurement(RULERS, FIDUCIALS, "why")
    assert np.isnan(refused.pose).all()
    assert (refused.pose.shape, refused.covariance.shape) == ((3,), (3, 3))
    assert np.isnan([*refused.covariance.ravel(), refused.etch_bias, refused.residual_scale, refused.condition]).all()
    assert (refused.reason, refused.warnings) == ("why", ())
    assert np.isnan(refused.scale_error).all()
    solution: PoseSolution = refused._replace(reason="")
    measurement = BoardMeasurement(VIEW, dataclasses.replace(VIEW, scale=1.0), solution)
    assert (measurement.agreeing, measurement.reason, measurement.rulers) == (2, "", RULERS)
