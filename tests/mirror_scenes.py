"""A sensor, a sheet of light, and mirrors in front of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpuvision.host import Device
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.mirrors import Mirrors

LENS = (0.0, 0.08, 0.15)


def sensor_view(samples: int = 120, bins: int = 240) -> SensorView:
    """Return a sensor of 12 mm x 12 mm, 80 mm beside the sheet and 150 mm above; it views some 50 mm of the sheet."""
    geometry = Triangulation.from_stand_off(
        baseline=LENS[1],
        stand_off=LENS[2],
        focal_distance=0.04,
        tilt=0.0,
        region=((-6e-3, 6e-3), (-6e-3, 6e-3)),
    )
    return SensorView(
        triangulation=geometry,
        transport=StraightTransport(step=1e-4),
        lens=LENS,
        u_edges=np.linspace(-6e-3, 6e-3, bins + 1),
        v_edges=np.linspace(-6e-3, 6e-3, samples + 1),
    )


def mirrors_of(scene: Scene, materials: Sequence[Material], device: Device, **more: Any) -> Mirrors:
    """Return the mirrors of a scene in front of that sensor."""
    return Mirrors(view=more.pop("view", sensor_view()), scene=scene, materials=materials, device=device, **more)


def quad(*corners: Sequence[float]) -> list[list[Sequence[float]]]:
    """Return the two triangles of four corners."""
    a, b, c, d = corners
    return [[a, b, c], [a, c, d]]
