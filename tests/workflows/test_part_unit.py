from __future__ import annotations

import re
from pathlib import Path

import pytest
import trimesh

from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.scene import Scene
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
