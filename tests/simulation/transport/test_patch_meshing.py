"""Geometry of the meshing of surfaces into patches, against distances by hand."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gpuvision.simulation.transport.patch_meshing import _distance_to_triangles


def test_distances_to_triangles(rng: np.random.Generator) -> None:
    """Points over the inside, beside edges and beside corners of a right triangle, in random orientations."""
    points = [(0.5, 0.5, 0.7), (0.5, 0.5, -0.7), (1.0, -0.3, 0.4), (1.5, 1.5, 0.0), (-3.0, -4.0, 0.0), (2.0, 0.0, 1.0)]
    expected = [0.7, 0.7, 0.5, np.sqrt(0.5), 5.0, 1.0]
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    for turn in Rotation.random(3, random_state=rng).as_matrix():
        shift = rng.uniform(-1.0, 1.0, 3)
        triangles = np.broadcast_to(corners @ turn.T + shift, (len(points), 3, 3))
        found = _distance_to_triangles(np.array(points) @ turn.T + shift, triangles)
        np.testing.assert_allclose(found, expected, atol=1e-12)
