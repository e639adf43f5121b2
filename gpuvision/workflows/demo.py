"""A small recording with a known truth: a part under a sheet of light, seen by a camera and by PSD strips.

`gpuvision.workflows.simulating` makes it: direct light, shadows, the glow of surfaces that light each other, noise and
steps of the converter.
"""

from __future__ import annotations

from typing import Any

import trimesh

from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.simulating import prepare_simulation

SENSORS = ("camera_line", "psd_line")
_ALBEDO = 0.5  # of the demo's part: matt grey plastic (chosen)


def part() -> trimesh.Trimesh:
    """Return a plate with a box, a disc, a ball sunk into it, and three steps: 46 x 36 mm, 6 mm high."""
    create, mm = trimesh.creation, 1e-3
    solids = [
        _placed(create.box((46 * mm, 36 * mm, 2 * mm)), 0, 0, -1),
        _placed(create.box((12 * mm, 10 * mm, 6 * mm)), -13, 9, 3),
        _placed(create.cylinder(5 * mm, 4 * mm, sections=64), -13, -9, 2),
        _placed(create.icosphere(3, 8 * mm), 10, 8, -3),
    ]
    solids += [
        _placed(create.box((6 * mm, 12 * mm, height * mm)), x, -9, height / 2)
        for x, height in ((4, 1), (10, 2), (16, 3))
    ]
    joined: Any = trimesh.util.concatenate(solids)
    made: trimesh.Trimesh = joined
    return made


def _placed(solid: trimesh.Trimesh, x_mm: float, y_mm: float, z_mm: float) -> trimesh.Trimesh:
    solid.apply_translation((1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm))
    return solid


def scanned_part(sensor: str, profiles: int | None = None) -> SimulationTask:
    """Return the task of scanning the part with one of the `SENSORS`."""
    scene = Scene.of(part())
    material = Material(diffuse=Lambert(albedo=_ALBEDO), name="matt")
    return prepare_simulation(
        scene, [material], Sensor.load(sensor), paths=("direct", "diffuse-diffuse"), profiles=profiles
    )
