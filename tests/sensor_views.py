"""Sensor for a sheet of light, with selectable tilt, lens and edges."""

from __future__ import annotations

import math

import numpy as np

from gpuvision.camera.lens import Lens
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.sensor_view import SensorView

BASELINE, STAND_OFF, FOCAL = 0.08, 0.15, 0.04
DISTANCE = math.hypot(BASELINE, STAND_OFF)


def sensor_view(*, tilt: float | None = 0.0, distortion: Lens | None = None, **more: object) -> SensorView:
    geometry = Triangulation.from_stand_off(
        baseline=BASELINE,
        stand_off=STAND_OFF,
        focal_distance=FOCAL,
        tilt=tilt,
        region=((-3e-3, 3e-3), (-6e-3, 6e-3)),
        lens=distortion,
    )
    values: dict[str, object] = {
        "triangulation": geometry,
        "transport": StraightTransport(step=1e-4),
        "lens": (0.0, BASELINE, STAND_OFF),
        "u_edges": np.linspace(-3e-3, 3e-3, 13),
        "v_edges": np.linspace(-6e-3, 6e-3, 8),
    }
    return SensorView(**(values | more))
