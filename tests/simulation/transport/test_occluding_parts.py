"""OccludedIrradiance with convex parts: against rays in float64, from outside, inside, and between touching parts."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.reference import occluded_irradiance as reference
from gpuvision.reference.occluded_irradiance import single
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance

CLEARANCE = 1e-5
WAYS = pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.double)])


@functools.cache
def lit_parts(kind: str) -> tuple[np.ndarray, ...]:
    """Return corners, receivers, segments, the light by rays, and the light without occlusion.

    "apart": turned boxes, balls and posts that intersect; receivers and segments anywhere, also inside. "room": the
    same in a box around all. "standing": boxes and posts on a plate, side by side, with receivers on their surfaces.
    """
    rng = np.random.default_rng(5)
    meshes = [trimesh.creation.icosphere(0), trimesh.creation.cylinder(1.0, 1.5, sections=18), trimesh.creation.box()]
    several = []
    for number in range(12):
        mesh = meshes[number % 3].copy().apply_scale(rng.uniform(0.15, 0.35))
        mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        several.append(mesh.apply_translation(rng.uniform(-0.8, 0.8, 3)))
    if kind == "room":
        several.append(trimesh.creation.box((2.4, 2.4, 2.4)))
    if kind == "standing":
        several = [trimesh.creation.box((2.0, 2.0, 0.1)).apply_translation((0.0, 0.0, -0.05))]
        for x, y in np.ndindex(4, 3):
            size = (0.4, 0.3, rng.uniform(0.1, 0.5))
            mesh = trimesh.creation.box(size) if (x + y) % 2 else trimesh.creation.cylinder(0.15, size[2], sections=18)
            several.append(mesh.apply_translation((0.4 * x - 0.6, 0.5 * y - 0.5, 0.5 * size[2])))
    mesh: Any = trimesh.util.concatenate(several)
    corners = single(mesh.triangles)
    ends = rng.uniform(-1.0, 1.0, (6, 6))
    normals = np.cross(ends[:, 3:] - ends[:, :3], rng.normal(size=(6, 3)))
    places = rng.uniform(-1.0, 1.0, (60, 6))
    if kind == "standing":
        ends[:, [2, 5]], normals[:] = 0.0, (0.0, 0.0, 1.0)
        ends[:, 4] = ends[:, 1]
        points, faces = trimesh.sample.sample_surface(mesh, 60, seed=2)
        places = np.hstack([points, mesh.face_normals[faces]])
    segments = np.hstack([single(ends), single(normals), np.ones((6, 1))])
    receivers = single(places)
    return (corners, receivers, segments, *reference.irradiance(corners, receivers, segments, CLEARANCE))


@WAYS
@pytest.mark.parametrize("kind", ["apart", "room", "standing"])
def test_light_between_parts_as_rays_say(device: Device, dtype: Any, kind: str) -> None:
    corners, receivers, segments, value, largest = lit_parts(kind)
    scene = Scene(corners)
    operation = OccludedIrradiance(scene=scene, segments=len(segments), clearance=CLEARANCE)
    weights = np.zeros((1, len(receivers), 2), dtype)
    result = operation(receivers[None].astype(dtype), weights, segments.astype(dtype), device=device)
    error = np.abs(result.irradiance[0] - value) / np.where(largest > 0.0, largest, 1.0)
    assert not result.status.any()
    assert len(scene.convex_parts.leaves) > 20
    if dtype == np.float64:
        assert error.max() <= 1e-9
    else:
        assert np.quantile(error, 0.95) <= 5e-6
        assert error.max() <= 2e-3
    assert np.mean(value[largest > 0.0] < 0.99 * largest[largest > 0.0]) > 0.3
    assert np.mean(value > 0.01 * largest) > 0.1
