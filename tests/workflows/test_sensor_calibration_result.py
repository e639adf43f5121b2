"""Report and summary of the calibration of a laser sensor: every entry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from gpuvision.workflows.sensor_calibration_result import SensorCalibration, _picture, sensor_calibration_files


class BendTest(NamedTuple):
    """Test of a bend, with other fields than the one of the library."""

    p_value: float


CAMERA_COVARIANCE = np.diag([1.0, 4.0])
STEP = np.array([3e-5, 0.0, 4e-5])
TRANSPORT: Any = SimpleNamespace(
    step=STEP,
    direction=STEP / 5e-5,
    # The camera's share of the covariance of the step is 1e-18 I, times the trace of its covariance.
    covariance=lambda camera: 1e-18 * np.trace(camera) * np.eye(3),
    residuals=np.full((2, 3), 0.5),
    rotations=np.full((2, 3), 0.25),
    view_ratio=1.5,
)


def line(name: str, count: int, threshold: float) -> Any:
    points = np.arange(2.0 * count).reshape(count, 2)
    return SimpleNamespace(image=Path("in") / name, points=points, threshold=threshold, note=f"note of {name}")


def calibration(transport: Any = TRANSPORT, **sheet: Any) -> SensorCalibration:
    """Return a calibration whose numbers all differ."""
    fit = {
        "origin": np.array([0.1, 0.2, 0.3]),
        "g_axis": np.array([1.0, 0.0, 0.0]),
        "h_axis": np.array([0.0, 0.6, 0.8]),
        "bend": (0.5, 0.25, 0.125),
        "bend_test": BendTest(0.01),
        "names": ("turn", "shift"),
        "covariance": lambda camera: np.diag([4.0, 9.0]) * np.trace(camera),
        "sigma_px": 0.06,
        "rms_px": 0.05,
        "residuals": (np.zeros(30), np.zeros(11)),
        "outliers": 3,
        "view_ratio": 2.5,
    }
    geometry = SimpleNamespace(
        sheet=SimpleNamespace(**{**fit, **sheet}),
        camera_covariance=CAMERA_COVARIANCE,
        transport=transport,
        step=5e-5,
        scene_axes=np.eye(3),
        scene_origin=np.array([0.0, 0.0, 0.5]),
        names=("a", "b"),
        covariance=np.diag([16.0, 25.0]),
        scale_sigma=lambda pixels: (1e-3, 2e-3) if len(pixels) else (9.0, 9.0),
    )
    values: dict[str, Any] = {
        "name": "corner",
        "calibration": SimpleNamespace(report=lambda: {"model": "k1"}),
        "geometry": geometry,
        "along": "columns",
        "channel": "red",
        "lines": (line("a.png", 30, 17.0), None),
        "other_lines": (line("b.png", 11, 18.0),),
        "cell": 1e-4,
        "warnings": ("few views",),
    }
    return SensorCalibration(**values)


def test_report() -> None:
    found = calibration()
    assert found.step_sigma == pytest.approx(np.sqrt(5.0) * 1e-9)
    assert found.report() == {
        "name": "corner",
        "camera": {"model": "k1"},
        "along": "columns",
        "channel": "red",
        "sheet": {
            "origin": [0.1, 0.2, 0.3],
            "g_axis": [1.0, 0.0, 0.0],
            "h_axis": [0.0, 0.6, 0.8],
            "bend": [0.5, 0.25, 0.125],
            "bend_test": {"p_value": 0.01},
            "sigma": pytest.approx({"turn": np.sqrt(20.0), "shift": np.sqrt(45.0)}),
            "sigma_px": 0.06,
            "rms_px": 0.05,
            "readings": 41,
            "outliers": 3,
            "view_ratio": 2.5,
        },
        "laser_images": [
            {"name": "a.png", "readings": 30, "threshold": 17.0, "note": "note of a.png"},
            {"name": "b.png", "readings": 11, "threshold": 18.0, "note": "note of b.png"},
        ],
        "transport": {
            "step_m": STEP.tolist(),
            "step_sigma_m": pytest.approx(np.sqrt(5.0) * 1e-9),
            "residuals": [[0.5] * 3] * 2,
            "rotations": [[0.25] * 3] * 2,
            "view_ratio": 1.5,
        },
        "step_m": 5e-5,
        "scale_sigma": {"height": 1e-3, "lateral": 2e-3},
        "cell_m": 1e-4,
        "scene": {"axes": np.eye(3).tolist(), "origin": [0.0, 0.0, 0.5]},
        "covariance": {"names": ["a", "b"], "matrix": np.diag([16.0, 25.0]).tolist()},
        "warnings": ["few views"],
    }
    flat = calibration(None, bend=None, bend_test=None)
    report = flat.report()
    assert (report["transport"], report["sheet"]["bend"], report["sheet"]["bend_test"]) == (None, None, None)
    assert flat.step_sigma == 0.0


def test_summary() -> None:
    start = "laser line in 2 images, 41 readings (3 rejected): residual 0.05 px rms, sheet "
    end = "; relative sigma of heights 1.0e-03, of x and y 2.0e-03 without the error of the pitch"
    bent = f"{start}bent by 0.5, 0.25, 0.125 /m; step 50 um (+- 2.2 nm){end}"
    assert calibration().summary() == bent
    assert calibration(None, bend=None).summary() == f"{start}flat; step 50 um (given){end}"


def test_pixels_and_files() -> None:
    found = calibration()
    every = np.concatenate([each.points for each in found.readings])
    np.testing.assert_array_equal(found.some_pixels(), every[::16])
    names = [each.name for each in sensor_calibration_files(Path("out/sensor.toml"))]
    assert names == ["sensor.toml", "sensor.json", "sensor.png"]


def test_picture() -> None:
    """The image has a target and the most readings; without a target the most readings; else it is a target view."""
    grids = [np.full((2, 3, 2), value) for value in (1.0, 2.0, 3.0)]
    targets = [SimpleNamespace(image=Path("in") / f"{n}.png", grid=grid) for n, grid in enumerate(grids)]
    camera: Any = SimpleNamespace(detected_targets=targets, summary=lambda: "camera")
    found = replace(
        calibration(coordinates=(np.ones(4), np.zeros(4))),
        calibration=camera,
        lines=(line("a.png", 5, 17.0), None, line("c.png", 6, 17.0)),
        other_lines=(line("b.png", 11, 18.0),),
    )
    picture = _picture(found)
    assert picture.title == f"camera\n{found.summary()}"
    assert picture.image == Path("in") / "c.png"
    np.testing.assert_array_equal(picture.grid, grids[2])
    np.testing.assert_array_equal(picture.line, found.readings[1].points)
    assert [len(each) for each in picture.lines] == [5, 6, 11]
    sheet = found.geometry.sheet
    assert picture.coordinates is sheet.coordinates
    assert picture.residuals is sheet.residuals
    assert picture.sigma_px == 0.06
    for threshold, image, grid in ((18.0, "b.png", np.zeros((0, 0, 2))), (np.nan, "0.png", grids[0])):
        others = (line("d.png", 7, threshold), line("b.png", 11, threshold))
        picture = _picture(replace(found, lines=(None, None, None), other_lines=others))
        assert picture.image == Path("in") / image
        np.testing.assert_array_equal(picture.grid, grid)
        np.testing.assert_array_equal(picture.line, others[1].points)
