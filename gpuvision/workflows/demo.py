"""Demo scene: a part of known shape under a sheet of light, for a camera and for PSD strips.

`gpuvision.workflows.simulating` simulates its recording: direct light, shadows, diffuse interreflection, noise and
quantisation.
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
_ALBEDO = 0.5  # diffuse reflectance of the part: matt grey plastic (chosen)


def make_part() -> trimesh.Trimesh:
    """Make a plate of 46 mm x 36 mm with a box, a disc, a spherical cap and three steps, up to 6 mm high [m]."""
    create, mm = trimesh.creation, 1e-3
    solids = [
        _translated(create.box((46 * mm, 36 * mm, 2 * mm)), 0, 0, -1),
        _translated(create.box((12 * mm, 10 * mm, 6 * mm)), -13, 9, 3),
        _translated(create.cylinder(5 * mm, 4 * mm, sections=64), -13, -9, 2),
        _translated(create.icosphere(3, 8 * mm), 10, 8, -3),
    ]
    solids += [
        _translated(create.box((6 * mm, 12 * mm, height * mm)), x, -9, height / 2)
        for x, height in ((4, 1), (10, 2), (16, 3))
    ]
    joined: Any = trimesh.util.concatenate(solids)
    mesh: trimesh.Trimesh = joined
    return mesh


def _translated(solid: trimesh.Trimesh, x_mm: float, y_mm: float, z_mm: float) -> trimesh.Trimesh:
    solid.apply_translation((1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm))
    return solid


def make_scan_task(sensor: str, profiles: int | None = None) -> SimulationTask:
    """Make the simulation task of a scan of the part.

    Parameters
    ----------
    sensor : str
        One of `SENSORS`.
    profiles : int, optional
        Number of profiles about the middle of the part. Default: all profiles that meet the part.

    Returns
    -------
    SimulationTask
    """
    scene = Scene.of(make_part())
    material = Material(diffuse=Lambert(albedo=_ALBEDO), name="matt")
    return prepare_simulation(
        scene, [material], Sensor.load(sensor), paths=("direct", "diffuse-diffuse"), profiles=profiles
    )
