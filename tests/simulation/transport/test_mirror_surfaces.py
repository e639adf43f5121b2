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
