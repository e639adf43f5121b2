"""Wrong arguments fail when the operation is made, with one line: texts, bools, NaN, infinities, wrong signs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.pose.edge_search import CellMeans, EdgeCostMap, EdgeSearch
from gpuvision.ranging.focus import DepthFromFocus
from gpuvision.ranging.polygon import PolygonMirror
from gpuvision.validation import finite, integer, numbers

GRID = gv.Grid(left=0.0, top=0.0, cell_x=1e-3, cell_y=1e-3, columns=4, rows=4)
EXAMPLES = [
    gv.Lens(k1=1e-7, k2=1e-14),
    gv.TiltedSensor(focal_length=1e-2, centre=(0.0, 0.0), alpha=0.1, direction=0.2),
    gv.UndistortImage(model=gv.Lens(k1=1e-7)),
    MountedCamera(height=0.3, tilt=0.5, roll=0.1, heading=0.1, focal_px=500.0, centre_px=(1.0, 2.0)),
    BoardView(scale=1e-3, shape=(10, 10), pose=(0.0, 0.0, 0.0)),
    gv.FindBlobs(threshold=20.0),
    gv.Imaging(pixel=25e-6),
    gv.FitLines(),
    gv.RulerEdges(threshold=20.0),
    gv.Field(length=9.0, width=6.0, lines=((0.0, 0.0, 1.0, 1.0),)),
    gv.SolvePose(),
    CellMeans(),
    EdgeCostMap(threshold=20.0),
    EdgeSearch(rows=4, columns=4, headings=4, points=4),
    gv.LineReadout(threshold=5.0, minimum_peak=10.0),
    gv.PsdNoise(),
    gv.PsdReadout(strip_length=6e-3, interelectrode_resistance=1e4),
    DepthFromFocus(first=0.1, spacing=1e-3, focal_length=0.01),
    PolygonMirror(apothem=0.05, facets=8, height=0.1),
    gv.StraightTransport(step=1e-3),
    GRID,
    gv.Regrid(grid=GRID, max_gap=1e-3, max_step=1e-3),
    gv.SampleAxes(),
    gv.Material(diffuse=gv.Lambert(albedo=0.5)),
    gv.Lambert(albedo=0.5),
    gv.OrenNayar(albedo=0.5, roughness=0.3),
    gv.Phong(albedo=0.5, exponent=10.0),
    gv.Ward(albedo=0.5, alpha_x=0.2, alpha_y=0.2),
    gv.Ggx(alpha=0.3, f0=0.5),
    gv.SensorFusion(),
]
# Numbers that may be negative: coefficients, places, angles, and directions of an axis.
SIGNED = {
    *(("Lens", name) for name in ("k1", "k2", "k3", "k4")),
    *(("MountedCamera", name) for name in ("tilt", "roll", "heading")),
    *(("StraightTransport", name) for name in ("step", "start")),
    *(("Grid", name) for name in ("left", "top")),
    *(("SampleAxes", name) for name in ("sample_origin", "sample_pitch", "position_origin", "position_pitch")),
    ("TiltedSensor", "direction"),
    ("UndistortImage", "border_value"),
    ("RulerEdges", "radius_px"),
}


def wrong_numbers(example: Any) -> Iterator[tuple[str, Any]]:
    """Yield a field and a wrong value for it."""
    for field in dataclasses.fields(example):
        number = str(field.type).removesuffix(" | None")
        if number not in ("int", "float"):
            continue
        wrong: list[Any] = ["20", True, np.True_, math.nan, math.inf, [1.0, 2.0]]
        if number == "int":
            wrong.append(2.5)
        if (type(example).__name__, field.name) not in SIGNED:
            wrong.append(-1)
        for value in wrong:
            yield field.name, value


# One test for each class: a test for each of the 900 values would take 5 ms each in collection and reports.
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda each: type(each).__name__)
def test_wrong_numbers_fail_when_the_operation_is_made(example: Any) -> None:
    kind, checked = type(example).__name__, 0
    for name, value in wrong_numbers(example):
        case = f"{kind}.{name}={value!r}"
        try:
            dataclasses.replace(example, **{name: value})
        except (TypeError, ValueError) as error:
            message = str(error)
        else:
            pytest.fail(f"{case} is accepted")
        assert "\n" not in message, case
        assert name in message or kind in message, case
        checked += 1
    assert checked or kind == "Material"


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"threshold": -1}, ValueError, "LineReadout.threshold is -1, expected a number >= 0"),
        ({"threshold": "20"}, TypeError, "LineReadout.threshold must be a number, got '20'"),
        (
            {"threshold": 20, "minimum_peak": 10},
            ValueError,
            "LineReadout.minimum_peak is 10, expected the threshold 20 or more",
        ),
    ],
)
def test_levels_of_the_line_readout(arguments: dict[str, Any], kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=f"^{message}$"):
        gv.LineReadout(**arguments)
    gv.LineReadout(threshold=20, minimum_peak=20)


def test_numbers_in_range_pass() -> None:
    assert finite(np.float32(0.5), "x", minimum=0.5, maximum=0.5) == 0.5
    assert finite(3, "x", above=2) == 3.0
    assert integer(np.int16(3), "x", minimum=3, maximum=3) == 3
    assert numbers([[1, 2.5]], (1, 2), "x") == ((1.0, 2.5),)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"minimum": 3.0}, "x is 2.5, expected a number >= 3"),
        ({"above": 2.5}, "x is 2.5, expected a number > 2.5"),
        ({"maximum": 2.0}, "x is 2.5, expected a number <= 2"),
        ({"above": 0.0, "maximum": 1.0}, "x is 2.5, expected a number > 0 and <= 1"),
    ],
)
def test_limits_of_a_number(limits: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        finite(2.5, "x", **limits)


@pytest.mark.parametrize("values", [["1", "2"], [True, False], [b"1", b"2"], [1j, 2], "12", [None, 1.0]])
def test_texts_and_bools_are_no_numbers(values: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        numbers(values, (2,), "x")
