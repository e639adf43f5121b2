"""Given normals of mirrors: turned to the side of the triangle that can be visible."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.mirror_surfaces import MirrorLimits, MirrorSurfaces
from mirror_scenes import sensor_view

MATERIALS = (Material(diffuse=Lambert(albedo=0.5)), Material(diffuse=Lambert(albedo=0.0), mirror=0.3))


@pytest.mark.parametrize("is_inverted", [False, True])
def test_given_normals_face_outwards(is_inverted: bool, rng: np.random.Generator) -> None:
    """Triangles of a ball with either winding, and tilted normals of either sign."""
    corners = 0.005 * trimesh.creation.icosphere(1).triangles
    corners = corners[:, ::-1] if is_inverted else corners
    outwards = corners.mean(axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    count = len(corners)
    given = outwards[:, None] * rng.choice([-1.0, 1.0], (count, 1, 1)) + rng.uniform(-0.2, 0.2, (count, 3, 3))
    scene = Scene(corners, np.ones(count, int))
    found = MirrorSurfaces(sensor_view(), scene, MATERIALS, given, MirrorLimits()).normals
    sign = np.sign(np.sum(given.sum(axis=1) * outwards, axis=1))
    np.testing.assert_allclose(found, sign[:, None, None] * given)
    assert 0.2 < np.mean(sign > 0.0) < 0.8


def test_plane_curved_and_other_surfaces() -> None:
    """A ball and a plate of a mirror, a grey plate, and a mirror without area."""
    ball = 0.005 * np.array(trimesh.creation.icosphere(2).triangles)
    plate = np.array([[[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [0.01, 0.01, 0.002]]])
    grey, line = (
        plate + np.array([0.0, 0.03, 0.0]),
        np.array([[[0.0, 0.0, 0.04], [1e-3, 0.0, 0.04], [3e-3, 0.0, 0.04]]]),
    )
    scene = Scene(np.concatenate([plate, ball, grey, line]), np.r_[1, np.ones(len(ball), int), 0, 1])
    found = MirrorSurfaces(sensor_view(), scene, MATERIALS, None, MirrorLimits())
    count = len(ball)
    np.testing.assert_array_equal(found.reflects, [True] * (count + 1) + [False, False])
    np.testing.assert_array_equal(found.flat, [0])
    np.testing.assert_array_equal(found.curved, np.arange(1, count + 1))
    np.testing.assert_allclose(found.reflectance_of(np.array([0, 3, count + 1])), [0.3, 0.3, 0.0])
    # The reach of the triangles with an area, from y = -5 to 40 mm, about their middle.
    assert found.clearance == pytest.approx(1e-7 * 0.0225)
    normal = np.cross(plate[0, 1] - plate[0, 0], plate[0, 2] - plate[0, 0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(found.normal_of[[0, count + 1]], [normal, normal], atol=1e-12)
    np.testing.assert_allclose(found.planes, [[*normal, normal @ plate[0, 0]]], atol=1e-15)
    np.testing.assert_array_equal(found.facets.corners, plate)
    outwards = ball / np.linalg.norm(ball, axis=2, keepdims=True)
    np.testing.assert_allclose(found.normals[1 : count + 1], outwards, atol=1e-12)
    assert not found.normals[count + 1 :].any()
    assert found.bulge.shape == (count + 3,)
    assert found.bulge[0] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("lean", "is_curved"), [(0.9e-6, False), (1.1e-6, True)])
def test_a_normal_that_leans_makes_a_mirror_curved(lean: float, is_curved: bool) -> None:
    plate = np.array([[[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [0.01, 0.01, 0.0]]])
    normals = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [lean, 0.0, 1.0]]])
    surfaces = MirrorSurfaces(sensor_view(), Scene(plate, np.array([1])), MATERIALS, normals, MirrorLimits())
    assert surfaces.is_curved.tolist() == [is_curved]


def test_a_scene_without_materials_has_no_mirrors() -> None:
    nothing = MirrorSurfaces(sensor_view(), Scene(np.zeros((0, 3, 3))), (), None, MirrorLimits())
    assert nothing.reflects.shape == (0,)
    assert nothing.normals.shape == (0, 3, 3)
    assert nothing.clearance == 0.0
