"""Light reflected by mirrors: positions against rays, conservation of energy, plane and curved mirrors, sequences."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.mirrors import Mirrors
from mirror_scenes import mirrors_of, quad

TRANSPORT = StraightTransport(step=1e-4)
DULL, MIRROR = Material(diffuse=Lambert(albedo=0.5)), Material(diffuse=Lambert(albedo=0.1), mirror=0.8)
SOURCES = pytest.mark.parametrize("source", [None, (0.004, 0.2)])


def sheet_of(source: tuple[float, float] | None) -> LightSheet:
    return LightSheet(transport=TRANSPORT, g_limits=(-0.02, 0.02), source=source, power=3.0)


def on_mirrors(lit: LitLine, scene: Scene) -> float:
    """Return the power [W] that arrives on mirrors."""
    assert scene.material is not None
    return float(np.sum((lit.lengths * lit.power)[scene.material[lit.triangle] == 1]))


def slanted() -> Scene:
    """Return a mirror at 45 degrees under the sheet, and a wall that it illuminates."""
    mirror = quad([-0.01, -0.005, 0.0], [0.01, -0.005, 0.0], [0.01, 0.005, 0.01], [-0.01, 0.005, 0.01])
    wall = quad([-0.05, -0.03, 0], [0.05, -0.03, 0], [0.05, -0.03, 0.05], [-0.05, -0.03, 0.05])
    return Scene(np.array(mirror + wall), np.array([1, 1, 0, 0]))


@SOURCES
def test_a_mirror_at_45_degrees_throws_the_sheet_onto_a_wall(
    device: Device, source: tuple[float, float] | None
) -> None:
    scene, sheet = slanted(), sheet_of(source)
    lit = sheet.illuminate(scene, 0.0)
    reflected = mirrors_of(scene, (DULL, MIRROR), device).reflected_lines(lit, sheet, 0.0)
    assert (scene.material[reflected.triangle] == 0).all()
    np.testing.assert_allclose(reflected.ends[..., 1:], np.broadcast_to([-0.03, 0.005], (*reflected.ends.shape[:2], 2)))
    np.testing.assert_allclose(reflected.normals, np.tile([0.0, 1.0, 0.0], (len(reflected.power), 1)), atol=1e-15)
    assert reflected.total() == pytest.approx(0.8 * on_mirrors(lit, scene), rel=1e-12)
    ends = np.sort(reflected.ends[..., 0].ravel())
    # The path of the fan's light is 0.195 m down to the mirror and 0.03 m from there.
    expected = np.array([-0.01, 0.01])
    if source:
        expected = source[0] + (expected - source[0]) * (0.195 + 0.03) / 0.195
    np.testing.assert_allclose(ends[[0, -1]], expected, rtol=1e-9)
    covered = np.sum(np.abs(np.diff(reflected.ends[..., 0], axis=1)))
    assert covered == pytest.approx(expected[1] - expected[0], rel=1e-9)


@pytest.mark.double
@SOURCES
def test_plane_mirrors_throw_where_rays_say(
    device: Device, source: tuple[float, float] | None, rng: np.random.Generator
) -> None:
    """A facet over a heap of boxes: each ray ends in a lit piece, and each piece has the power of its rays."""
    boxes = [trimesh.creation.box((0.004, 0.004, rng.uniform(0.004, 0.02))) for _ in range(60)]
    for box in boxes:
        box.apply_translation([*rng.uniform((-0.02, -0.03), (0.02, -0.008)), rng.uniform(0.0, 0.02)])
    mirror = np.array(quad([-0.02, -0.002, 0.0], [0.02, -0.002, 0.001], [0.02, 0.006, 0.012], [-0.02, 0.006, 0.011]))
    wall = np.array(quad([-0.1, -0.04, -0.05], [0.1, -0.04, -0.05], [0.1, -0.04, 0.1], [-0.1, -0.04, 0.1]))
    heap = np.concatenate([np.array(each.triangles) for each in boxes])
    corners = np.concatenate([mirror, heap, wall])
    scene = Scene(corners, np.r_[1, 1, np.zeros(len(corners) - 2, int)])
    sheet = sheet_of(source)
    lit = sheet.illuminate(scene, 0.0)
    reflected = mirrors_of(scene, (DULL, MIRROR), device).reflected_lines(lit, sheet, 0.0)
    assert len(np.unique(reflected.triangle)) > 10
    onto = scene.material[lit.triangle] == 1
    share = (np.arange(400) + 0.5) / 400
    places = lit.ends[onto, :1] + share[:, None] * (lit.ends[onto, 1:] - lit.ends[onto, :1])
    come = np.array([0.0, 0.0, -1.0]) if source is None else places - np.array([source[0], 0.0, source[1]])
    come = np.broadcast_to(come / np.linalg.norm(come, axis=-1, keepdims=True), places.shape)
    normal = lit.normals[onto][:, None]
    on = come - 2.0 * np.sum(come * normal, axis=-1, keepdims=True) * normal
    rays = np.concatenate([places, on], axis=-1).reshape(-1, 6)
    hits = ClosestHit(scene=scene, clearance=1e-9)(rays, device=device)
    power = np.repeat((lit.power * lit.lengths)[onto] / 400 * 0.8, 400)
    by_rays = np.bincount(hits.triangle[hits.triangle >= 0], power[hits.triangle >= 0], minlength=len(corners))
    ours = np.bincount(reflected.triangle, reflected.power * reflected.lengths, minlength=len(corners))
    # One ray more or less at either end of each piece of a triangle.
    pieces = np.bincount(reflected.triangle, minlength=len(corners))
    assert np.all(np.abs(ours - by_rays) <= 2.0 * pieces * power.max())
    assert reflected.total() == pytest.approx(power[hits.triangle >= 0].sum(), rel=5e-3)
    spots = rays[:, :3] + hits.distance[:, None] * rays[:, 3:]
    away = [_distance(reflected, spot, triangle) for spot, triangle in zip(spots, hits.triangle, strict=True)]
    assert np.mean(np.array(away) > 1e-9) < 0.01


def _distance(lines: LitLine, spot: np.ndarray, triangle: int) -> float:
    mine = lines.triangle == triangle
    if not mine.any():
        return np.inf
    start, direction = lines.ends[mine, 0], lines.ends[mine, 1] - lines.ends[mine, 0]
    share = np.clip(np.sum((spot - start) * direction, axis=1) / np.sum(direction * direction, axis=1), 0.0, 1.0)
    return float(np.linalg.norm(spot - start - share[:, None] * direction, axis=1).min())


@SOURCES
def test_in_a_closed_box_no_light_is_lost(device: Device, source: tuple[float, float] | None) -> None:
    """All walls are mirrors: after k reflections, 0.8^k of the power arrives on the next wall."""
    box = trimesh.creation.box((0.03, 0.03, 0.03))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.4, [0.3, 0.5, 0.2]))
    lid = np.abs(box.face_normals[:, 2]) < 2.0
    scene = Scene(np.array(box.triangles)[lid], np.ones(lid.sum(), int))
    sheet = sheet_of(source)
    # Light inside the box is reflected from inside: a line on a wall, lit from the side of the sheet.
    entered = LightSheet(transport=TRANSPORT, g_limits=(-0.004, 0.004), source=source, power=3.0)
    through = Scene(np.array(box.triangles)[box.face_normals[:, 2] < 0.0])
    lit = entered.illuminate(through, 0.0)
    numbers = np.flatnonzero(box.face_normals[:, 2] < 0.0)
    lit = lit._replace(triangle=numbers[lit.triangle])
    for throws in (1, 2, 3, 6):
        reflected = mirrors_of(scene, (DULL, MIRROR), device, max_reflections=throws).reflected_lines(lit, sheet, 0.0)
        expected = lit.total() * sum(0.8**k for k in range(1, throws + 1))
        assert reflected.total() == pytest.approx(expected, rel=1e-9)


def test_a_round_mirror_throws_light_as_it_is_round(device: Device) -> None:
    """A cylinder along y under parallel light: light at angle a is reflected at 2 a; the wall gets dP / dx."""
    radius, height = 5e-3, 0.03
    cylinder = trimesh.creation.cylinder(radius, 0.02, sections=240)
    cylinder.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    wall = quad([0.02, -0.05, -0.05], [0.02, 0.05, -0.05], [0.02, 0.05, height], [0.02, -0.05, height])
    corners = np.concatenate([np.array(cylinder.triangles), np.array(wall)])
    scene = Scene(corners, np.r_[np.ones(len(cylinder.faces), int), 0, 0])
    sheet = LightSheet(transport=TRANSPORT, g_limits=(1e-4, 4.9e-3), power=3.0)
    lit = sheet.illuminate(scene, 0.0)
    reflected = mirrors_of(scene, (DULL, MIRROR), device, steps_per_sample=8.0).reflected_lines(lit, sheet, 0.0)
    assert (reflected.triangle >= len(corners) - 2).all()

    def lands(angle: np.ndarray) -> np.ndarray:
        return radius * np.cos(angle) + (0.02 - radius * np.sin(angle)) / np.tan(2.0 * angle)

    angle = np.linspace(np.arcsin(1e-4 / radius), np.arcsin(4.9e-3 / radius), 200_001)
    at, power = lands(angle), 0.8 * 3.0 * np.diff(radius * np.sin(angle))
    middle = 0.5 * (at[1:] + at[:-1])
    for low, high in ((-0.012, -0.005), (-0.005, 0.0), (0.0, 0.003), (0.003, 0.01), (0.01, 0.028)):
        expected = power[(middle > low) & (middle < high)].sum()
        assert _between(reflected, low, high) == pytest.approx(expected, rel=4e-3)


def _between(lines: LitLine, low: float, high: float) -> float:
    """Return the power between two heights of the wall."""
    z = np.sort(lines.ends[..., 2], axis=1)
    inside = np.maximum(np.minimum(z[:, 1], high) - np.maximum(z[:, 0], low), 0.0) / (z[:, 1] - z[:, 0])
    return float(np.sum(inside * lines.power * lines.lengths))


def test_without_mirrors_or_throws_there_is_none(device: Device) -> None:
    scene, sheet = slanted(), sheet_of(None)
    lit = sheet.illuminate(scene, 0.0)
    assert not len(mirrors_of(scene, (DULL, MIRROR), device, max_reflections=0).reflected_lines(lit, sheet, 0.0).power)
    assert not len(mirrors_of(scene, (DULL, DULL), device).reflected_lines(lit, sheet, 0.0).power)
    # In the opposite direction the light hits no surface.
    away = sheet.illuminate(scene, 0.02)
    assert not len(mirrors_of(scene, (DULL, MIRROR), device).reflected_lines(away, sheet, 0.02).power)
    with pytest.raises(ValueError, match="max_reflections"):
        Mirrors(
            view=mirrors_of(scene, (DULL, MIRROR), device).view,
            scene=scene,
            materials=(DULL, MIRROR),
            max_reflections=-1,
        )
