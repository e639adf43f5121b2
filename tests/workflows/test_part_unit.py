from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.scene import Scene
from gpuvision.workflows import part_unit
from gpuvision.workflows.part_unit import doubt_unit

UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "inch": 25.4e-3}


@pytest.mark.parametrize("sensor", ["psd_line", "camera_line"])
@pytest.mark.parametrize("scale", [0.25, 1.0])
@pytest.mark.parametrize(("written", "read", "guessed"), [("mm", "m", "mm"), ("m", "mm", "m"), ("um", "m", "um")])
def test_a_part_in_another_unit_is_doubted(
    tmp_path: Path, sensor: str, scale: float, written: str, read: str, guessed: str
) -> None:
    """A part of 40 x 20 x 5 mm, or 10 mm long, whose file is read in the wrong unit and in the right one."""
    path = tmp_path / "part.stl"
    trimesh.creation.box([each * scale * 1e-3 / UNITS[written] for each in (40.0, 20.0, 5.0)]).export(path)
    doubt = doubt_unit(Scene.load(path, metres=UNITS[read]), Sensor.load(sensor), read, UNITS)
    assert doubt is not None
    assert re.search(rf"with --unit {read}, .* is the mesh in {guessed} \(--unit {guessed}\)\?$", doubt)
    assert doubt_unit(Scene.load(path, metres=UNITS[written]), Sensor.load(sensor), written, UNITS) is None


def test_a_part_without_size_is_not_doubted() -> None:
    assert doubt_unit(Scene.of([]), Sensor.load("psd_line"), "m", UNITS) is None


VIEW = ((0.0, 0.0, 0.0), (0.03, 0.0, 0.04))


def doubt(size: float, unit: str, monkeypatch: pytest.MonkeyPatch, view: Any = VIEW) -> str | None:
    """Return the doubt about a part with a diagonal, in metres, before a view with a diagonal of 50 mm."""
    seen = SimpleNamespace(
        u_edges=np.array([1.0, 2.0, 3.0]),
        v_edges=np.array([5.0, 7.0]),
        points_in_sheet=lambda u, v: np.array(view) if (set(u), set(v)) == ({1.0, 3.0}, {5.0, 7.0}) else None,
    )
    monkeypatch.setattr(part_unit, "make_sensor_view", lambda sensor: seen)
    third = size / 3.0
    first = [[0.0, 0.0, 0.0], [third, 2.0 * third, 0.0], [0.0, np.nan, 9e9]]
    corners = np.array([first, [[0.0, 0.0, 2.0 * third]] * 3])
    part: Any = SimpleNamespace(corners=corners)
    sensor: Any = None
    return part_unit.doubt_unit(part, sensor, unit, UNITS)


def test_a_unit_is_doubted_beyond_half_a_step_from_millimetres_to_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A factor of 31.6 between the diagonals of part and view, to either side."""
    factor = math.sqrt(1000.0)
    for size in (0.99 * factor * 0.05, 1.01 / factor * 0.05, 0.05):
        assert doubt(size, "m", monkeypatch) is None
    text = doubt(1.01 * factor * 0.05, "m", monkeypatch)
    assert text == (
        "the part is 1.6 m across with --unit m, and the sensor sees 0.05 m; is the mesh in mm (--unit mm)?"
    )
    # Of 40 mm in millimetres 40 m were made: millimetres fit, and inches do not.
    assert str(doubt(40.0, "m", monkeypatch)).endswith("is the mesh in mm (--unit mm)?")
    assert str(doubt(1e-4, "mm", monkeypatch)).endswith("is the mesh in m (--unit m)?")  # the first one that fits
    assert doubt(1e9, "um", monkeypatch) is None  # no unit fits


def test_what_has_no_size_is_not_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doubt(0.0, "m", monkeypatch) is None
    point = ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    nowhere = ((np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0))
    for view in (point, nowhere):
        assert doubt(40.0, "m", monkeypatch, view) is None
