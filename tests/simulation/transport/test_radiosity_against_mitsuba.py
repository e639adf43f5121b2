"""All bounces in a room with a body, against the independent path tracer Mitsuba."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.radiosity import Radiosity

mitsuba = pytest.importorskip("mitsuba", reason="the extra 'profile' is not installed")

pytestmark = pytest.mark.slow

SEEDS, SAMPLES, VECTOR_VARIANT, METER = 8, 1 << 16, 1e-3, 1e-2
ALBEDO_OF_ROOM, ALBEDO_OF_BODY = 0.8, 0.4
# Position and normal of the meters: in the air, on the far side of the body, below the ceiling.
METERS = np.array(
    [
        [-0.2, 0.25, 0.1, 0.0, 0.0, 1.0],
        [0.05, -0.27, 0.0, 0.0, -1.0, 0.0],
        [0.3, 0.0, 0.29, 0.0, 0.0, -1.0],
        [0.0, 0.3, -0.1, 0.6, 0.0, -0.8],
    ]
)


def room() -> Any:
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    box.invert()
    return box


def body() -> Any:
    return trimesh.creation.box((0.3, 0.3, 0.3)).apply_translation((0.05, -0.1, -0.15))


def measured() -> np.ndarray:
    """Return the irradiance of each meter (seeds, n) by indirect light of a strip on the floor, 1 W/m."""
    mitsuba.set_variant("scalar_rgb")
    move = mitsuba.ScalarTransform4f

    def mesh(shape: Any, albedo: float, name: str) -> Any:
        made = mitsuba.Mesh(name, 8, 12, props=_diffuse(albedo))
        parameters = mitsuba.traverse(made)
        parameters["vertex_positions"] = np.asarray(shape.vertices, np.float32).ravel()
        parameters["faces"] = np.asarray(shape.faces, np.uint32).ravel()
        parameters.update()
        return made

    # Half of the strip's length and width; height above the floor equal to the ray clearance.
    place = move().translate([0.0, 0.2, -0.3 + 2e-4]).scale([0.5, 0.5 * VECTOR_VARIANT, 1.0])
    light = {"type": "area", "radiance": {"type": "rgb", "value": 1.0 / (VECTOR_VARIANT * math.pi)}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 80, "hide_emitters": True},
        "strip": {"type": "rectangle", "to_world": place, "emitter": light},
        "room": mesh(room(), ALBEDO_OF_ROOM, "room"),
        "body": mesh(body(), ALBEDO_OF_BODY, "body"),
    }
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    results = []
    for x, y, z, *normal in METERS:
        up = [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0]
        look = move().look_at(origin=[x, y, z], target=[x + normal[0], y + normal[1], z + normal[2]], up=up)
        sensor = {"type": "irradiancemeter", "film": film, "sampler": {"type": "independent"}}
        meter = {"type": "rectangle", "to_world": look.scale([0.5 * METER, 0.5 * METER, 1.0]), "sensor": sensor}
        loaded = mitsuba.load_dict({**scene, "meter": meter})
        results.append(
            [float(np.asarray(mitsuba.render(loaded, spp=SAMPLES, seed=seed)).ravel()[0]) for seed in range(SEEDS)]
        )
    return np.array(results).T


def _diffuse(albedo: float) -> Any:
    properties = mitsuba.Properties()
    properties["bsdf"] = mitsuba.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}})
    return properties


def test_all_bounces_are_what_mitsuba_finds() -> None:
    device = Device.best()
    scene = Scene.of([room(), body()])
    lit = LitSegments([[[-0.5, 0.2, -0.3], [0.5, 0.2, -0.3]]], [[0.0, 0.0, 1.0]], [1.0])
    box = Radiosity.from_scene(scene, [ALBEDO_OF_ROOM, ALBEDO_OF_BODY], size=0.1, both_sides=False, device=device)
    bounced = box.irradiance(METERS, box.solve(box.direct_irradiance(lit))).irradiance
    found = measured()
    noise = found.std(axis=0, ddof=1) / math.sqrt(SEEDS)
    assert np.all(noise < 5e-3 * found.mean(axis=0))
    # Patches of 0.1 m cause an error of some parts per thousand.
    assert np.all(np.abs(found.mean(axis=0) - bounced) < 4.0 * noise + 5e-3 * bounced)
