"""Rays on a board with parts: type of the positions of closest hits, and clearance of shadow rays.

The error of a closest hit is that of its distance, compared with every triangle in float64; that of a shadow ray is 1
if it is wrong. Shadow rays start on the surfaces: without a clearance some are occluded by their own triangle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.profiling.rays import board
from gpuvision.reference import rays as reference
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.scene import Scene

_RAYS, _LAMP = 150, (0.01, 0.02, 0.3)  # position of the lamp [m]
_CLEARANCES = (0.0, 1e-8, 1e-6, 1e-4, 1e-3)  # [m]


def settings(device: Device) -> Iterator[Setting]:
    """Yield types of positions for near and far cameras, and clearances."""
    mesh = board(0)
    corners, scene = np.asarray(mesh.triangles, np.float64), Scene.of(mesh)
    points, faces = trimesh.sample.sample_surface(mesh, _RAYS, seed=5)
    for away in (0.25, 25.0):
        camera = np.broadcast_to([0.0, -0.2 * away, away], points.shape)
        rays = np.hstack([camera, points - camera])
        exact = reference.closest(corners, rays)[1]
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            bound = bind_with(ClosestHit(scene=scene), device, rays.astype(dtype))
            errors = Errors(to_numpy(bound.outputs.distance) - exact)
            yield Setting("rays", f"closest hit, camera {away:g} m away", {"dtype": dtype}, bound.run, errors, "m")
    normals: Any = mesh.face_normals[faces]
    lifted = np.hstack([points + 1e-9 * normals, np.broadcast_to(_LAMP, points.shape)])
    facing = np.einsum("ij,ij->i", np.asarray(_LAMP) - points, normals) > 0.0
    segments = np.hstack([points, np.broadcast_to(_LAMP, points.shape)])[facing].astype(np.float32)
    occluded = reference.occluded(corners, lifted[facing])
    for clearance in _CLEARANCES:
        shadow = bind_with(AnyHit(scene=scene, clearance=clearance), device, segments)
        errors = Errors((to_numpy(shadow.outputs.occluded) != 0) ^ occluded)
        yield Setting("rays", "shadow rays from surfaces", {"clearance": clearance}, shadow.run, errors, "")
