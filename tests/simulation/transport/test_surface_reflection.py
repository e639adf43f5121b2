"""Light of a sheet that surfaces send into the lens: power by the radiometric formula, and division at glossy lobes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, OrenNayar, Phong, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import Parts
from gpuvision.simulation.transport.surface_reflection import SurfaceReflection, mirrored_power
from sensor_views import sensor_view

VIEW = sensor_view()
MATERIALS = [
    Material(diffuse=Lambert(albedo=0.6)),
    Material(diffuse=OrenNayar(albedo=0.5, roughness=0.4)),
    Material(diffuse=Lambert(albedo=0.1), gloss=Phong(albedo=0.3, exponent=3.0)),
    Material(diffuse=OrenNayar(albedo=0.2, roughness=0.1), gloss=Ggx(alpha=0.15, f0=0.4)),
]


def reflection(source: tuple[float, float] | None, count: int, materials: list[Material]) -> SurfaceReflection:
    triangles = np.array([[[k, 0.0, 0.0], [k + 0.5, 0.0, 0.0], [k, 0.5, 0.0]] for k in range(count)])
    scene = Scene(triangles, np.arange(count) % len(materials))
    sheet = LightSheet(transport=VIEW.transport, source=source)
    return SurfaceReflection(view=VIEW, scene=scene, materials=materials, sheet=sheet)


def line(rng: np.random.Generator, count: int, half: float = 2e-3) -> LitLine:
    """Return segments around the origin, one on each triangle, with normals between the light and the lens."""
    middle, way = rng.uniform(-5e-3, 5e-3, (count, 3)), rng.normal(0.0, half, (count, 3))
    normals = rng.normal([0.0, 0.3, 1.0], 0.3, (count, 3))
    normals[1] = [0.99, 0.01, 0.1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return LitLine(np.stack([middle - way, middle + way], axis=1), normals, np.arange(count), rng.uniform(1, 2, count))


def unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def light_of(points: np.ndarray, source: tuple[float, float] | None) -> np.ndarray:
    if source is None:
        return np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return unit(np.stack(np.broadcast_arrays(source[0], points[..., 1], source[1]), axis=-1) - points)


def value(lobe: Brdf, normal: np.ndarray, light: np.ndarray, eye: np.ndarray) -> float:
    """Return the BRDF in a frame whose z axis is the normal; isotropic: x along the light."""
    x = unit(light - (light @ normal) * normal)
    frame = np.stack([x, np.cross(normal, x), normal])
    return float(lobe.value(np.concatenate([frame @ light, frame @ eye])))


@pytest.mark.parametrize("source", [None, (0.01, 0.3)])
def test_power_is_radiance_times_the_solid_angle_of_the_lens(
    source: tuple[float, float] | None, rng: np.random.Generator
) -> None:
    """Arriving power times BRDF, cosine to the lens and solid angle; nothing behind the surface."""
    count = 24
    surfaces, lit = reflection(source, count, MATERIALS), line(rng, count)
    lit.normals[5] *= -1.0
    segment = np.concatenate([rng.permutation(count), [5, 3]])
    points, arriving = lit.ends[segment].mean(axis=1), rng.uniform(1.0, 3.0, count + 2)
    found = surfaces.power(lit, segment, points, arriving)
    axis = np.array(VIEW.axis)
    seen = 0
    for n, k in enumerate(segment):
        towards = np.array(VIEW.lens) - points[n]
        eye, normal = unit(towards), lit.normals[k]
        solid_angle = 0.25 * math.pi * VIEW.aperture**2 * (-eye @ axis) / (towards @ towards)
        power = arriving[n] * max(normal @ eye, 0.0) * solid_angle
        assert found["even"][n] == pytest.approx(power / math.pi, rel=1e-12, abs=0.0)
        material = MATERIALS[k % 4]
        light = light_of(points[n], source)
        diffuse = power * value(material.diffuse, normal, light, eye) if normal @ light > 0.0 else None
        if diffuse is not None:
            assert found["diffuse"][n] == pytest.approx(diffuse, rel=1e-9)
            gloss = 0.0 if material.gloss is None else power * value(material.gloss, normal, light, eye)
            assert found["gloss"][n] == pytest.approx(gloss, rel=1e-9)
            seen += power > 0.0
    assert seen > 12


@pytest.mark.parametrize("source", [None, (0.01, 0.3)])
def test_parts_on_glossy_surfaces_are_divided_by_the_turn_of_the_half_vector(
    source: tuple[float, float] | None, rng: np.random.Generator
) -> None:
    """Equal pieces, as many as the half vector turns by the given share of the lobe's width, up to the most."""
    lobes: list[tuple[Brdf | None, float]] = [
        (None, math.inf),
        (Phong(albedo=0.3, exponent=3.0), 0.25),
        (Ggx(alpha=0.05, f0=0.4), 0.05),
        (Ward(albedo=0.3, alpha_x=0.04, alpha_y=0.2), 0.04),
        (Ward(albedo=0.3, alpha_x=0.3, alpha_y=0.02), 0.02),
    ]
    materials = [Material(diffuse=Lambert(albedo=0.1), gloss=lobe) for lobe, _ in lobes]
    count = 40
    surfaces, lit = reflection(source, count, materials), line(rng, count, 0.03)
    start, end = rng.uniform(0.0, 0.4, count), rng.uniform(0.6, 1.0, count)
    visible = rng.random(count) < 0.5
    parts = surfaces.split_lobes(Parts(np.arange(count), start, end, visible), lit, lobe_turn=0.5, max_parts=7)
    numbers = []
    for k in range(count):
        mine = parts.segment == k
        ends = lit.ends[k, 0] + np.array([[start[k]], [end[k]]]) * (lit.ends[k, 1] - lit.ends[k, 0])
        half = unit(light_of(ends, source) + unit(np.array(VIEW.lens) - ends))
        turn = np.linalg.norm(half[1] - half[0]) / lobes[k % 5][1]
        number = int(min(max(math.ceil(turn / 0.5), 1), 7))
        edges = start[k] + (end[k] - start[k]) * np.arange(number + 1) / number
        np.testing.assert_allclose(parts.start[mine], edges[:-1], rtol=1e-12)
        np.testing.assert_allclose(parts.end[mine], edges[1:], rtol=1e-12)
        np.testing.assert_array_equal(parts.visible[mine], np.full(number, visible[k]))
        numbers.append(number)
    assert {1, 2, 7} <= set(numbers)
    plain = reflection(source, count, materials[:1])
    whole = Parts(np.arange(count), start, end, visible)
    assert plain.split_lobes(whole, lit, lobe_turn=0.5, max_parts=7) is whole


def test_a_mirror_sends_all_light_as_gloss(rng: np.random.Generator) -> None:
    arriving = np.array([1.0, 2.5])
    found = mirrored_power(line(rng, 2), np.arange(2), np.zeros((2, 3)), arriving)
    np.testing.assert_array_equal(found["gloss"], arriving)
    np.testing.assert_array_equal(found["diffuse"], [0.0, 0.0])
