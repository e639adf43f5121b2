"""Common part of the tests of direct light: a sheet of light, a lens, and simple surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpuvision.camera.lens import Lens
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet

TRANSPORT = StraightTransport(step=1e-4)
GREY = Material(diffuse=Lambert(albedo=0.5))


def sensor_view(
    *, scale: float = 1.0, bins: int = 12, samples: int = 8, lens: Lens | None = None, **more: Any
) -> SensorView:
    """Return a view with its lens 0.15 m above the plane; ``scale`` scales distance and focal length: same image."""
    baseline, stand_off, focal = 0.08 * scale, 0.15 * scale, 0.04 * scale
    geometry = Triangulation.from_stand_off(
        baseline=baseline, stand_off=stand_off, focal_distance=focal, region=((-3e-3, 3e-3), (-6e-3, 6e-3)), lens=lens
    )
    values = {
        "triangulation": geometry,
        "transport": TRANSPORT,
        "lens": (0.0, baseline, stand_off),
        "u_edges": np.linspace(-3e-3, 3e-3, bins + 1),
        "v_edges": np.linspace(-6e-3, 6e-3, samples + 1),
    }
    return SensorView(**(values | more))


def light_of(corners: Any, materials: Any = (GREY,), *, seen_by: SensorView | None = None, **more: Any) -> DirectLight:
    values = {key: more.pop(key) for key in ("sub_sheets", "device") if key in more}
    scene = corners if isinstance(corners, Scene) else Scene(corners)
    sheet = LightSheet(transport=TRANSPORT, **more)
    return DirectLight(view=seen_by or sensor_view(), scene=scene, materials=materials, sheet=sheet, **values)


def quad(a: Any, b: Any, c: Any, d: Any) -> np.ndarray:
    return np.array([[a, b, c], [a, c, d]], float)


def plate(x: float = 1.0, y: float = 1.0, z: float = 0.0) -> np.ndarray:
    return quad((-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z))


def u_of(exposure: Exposure, seen_by: SensorView) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return exposure.first_moment(seen_by.u_edges) / exposure.total()


def two_plates(before: float, behind: float) -> tuple[Scene, tuple[Material, ...]]:
    """Return a plate with a step of its albedo at y = 0."""
    corners = np.concatenate([plate(1.0, 0.5) + np.array([0.0, y, 0.0]) for y in (-0.5, 0.5)])
    made_of = tuple(Material(diffuse=Lambert(albedo=each)) for each in (before, behind))
    return Scene(corners, np.array([0, 0, 1, 1])), made_of
