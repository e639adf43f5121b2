"""Divided triangles: same area and orientation, short edges, common points on common edges."""

from __future__ import annotations

import numpy as np

from gpuvision.simulation.transport.triangle_division import bisect_triangles, longest_edges, subdivide_to


def normals(corners: np.ndarray) -> np.ndarray:
    """Return twice the area of triangles (n, 3, 3) times their normals."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_longest_edges_and_their_starts() -> None:
    first = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    corners = np.stack([np.roll(first, shift, axis=0) for shift in range(3)])
    lengths, starts = longest_edges(corners)
    np.testing.assert_array_equal(lengths, 5.0)
    np.testing.assert_array_equal(starts, [1, 2, 0])
    halves = bisect_triangles(corners)
    np.testing.assert_allclose(normals(halves), np.tile([0.0, 0.0, 6.0], (6, 1)))
    for half in halves:
        assert (half == [1.5, 2.0, 0.0]).all(axis=1).any()
    assert longest_edges(corners[:0])[0].shape == (0,)


def test_pieces_cover_their_triangles(rng: np.random.Generator) -> None:
    corners = rng.uniform(0.0, 1.0, (4, 3, 3))
    corners[1, :2] = corners[0, 1::-1]  # neighbours with a common edge
    size = 0.3
    pieces, numbers = subdivide_to(corners, np.array([7, 8, 9, 7]), size)
    assert longest_edges(pieces)[0].max() <= size
    # No edge is halved without need: the triangles before the last halving had longer edges.
    assert longest_edges(pieces)[0].max() > 0.5 * size
    for number in (7, 8, 9):
        whole = normals(corners[np.array([7, 8, 9, 7]) == number]).sum(axis=0)
        np.testing.assert_allclose(normals(pieces[numbers == number]).sum(axis=0), whole, atol=1e-12)
    a, b = corners[0, :2]

    def on_common_edge(points: np.ndarray) -> set[tuple[float, ...]]:
        points = points.reshape(-1, 3)
        apart = np.linalg.norm(np.cross(points - a, b - a), axis=1) / np.linalg.norm(b - a)
        return {tuple(point) for point in points[apart < 1e-12].tolist()}

    first = subdivide_to(corners[:1], np.zeros(1, np.int64), size)[0]
    second = subdivide_to(corners[1:2], np.zeros(1, np.int64), size)[0]
    assert on_common_edge(first) == on_common_edge(second)
    exact = np.array([[[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.1, 0.0]]])
    assert len(subdivide_to(exact, np.zeros(1, np.int64), longest_edges(exact)[0][0])[0]) == 1
