"""Sides of closed surfaces that are visible from a view point."""

from __future__ import annotations

import numpy as np
import trimesh

from gpuvision.simulation.scene.closed_surfaces import visible_sides
from gpuvision.simulation.scene.scene import Scene

EYE, ALONG = (0.0, 0.0, 5.0), (0.0, 1.0, 0.0)


def test_the_outside_of_what_is_closed_whichever_way_it_is_wound() -> None:
    ball = np.array(trimesh.creation.icosphere(1).triangles)
    box = np.add(trimesh.creation.box().triangles, (3.0, 0.0, 0.0))
    sides = visible_sides(Scene(np.concatenate([ball, box[:, ::-1]])), EYE, ALONG)
    np.testing.assert_array_equal(sides, [1] * len(ball) + [-1] * len(box))


def test_both_sides_of_what_is_open_or_flat_or_shares_an_edge() -> None:
    box = np.array(trimesh.creation.box().triangles)
    assert not visible_sides(Scene(box[1:]), EYE, ALONG).any()
    fin = np.concatenate([box, [[box[0, 0], box[0, 1], [3.0, 3.0, 3.0]]]])
    assert not visible_sides(Scene(fin), EYE, ALONG).any()
    leaf = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0.0, 0, 0], [0, 1, 0], [1, 0, 0]]])
    assert not visible_sides(Scene(leaf), EYE, ALONG).any()
    assert not len(visible_sides(Scene(np.zeros((0, 3, 3))), EYE, ALONG))


def test_both_sides_where_the_eye_may_be_within() -> None:
    room = np.array(trimesh.creation.box((4.0, 4.0, 4.0)).triangles)
    cup = 0.1 * np.array(trimesh.creation.box().triangles)
    sides = visible_sides(Scene(np.concatenate([room, cup])), (0.0, -9.0, 1.5), ALONG)
    np.testing.assert_array_equal(sides, [0] * 12 + [1] * 12)
    assert visible_sides(Scene(room), (0.0, -9.0, 1.5), (1.0, 0.0, 0.0)).all()


def test_what_is_no_triangle_has_no_side() -> None:
    box = np.array(trimesh.creation.box().triangles)
    some = np.concatenate([box, np.full((1, 3, 3), np.nan), np.zeros((1, 3, 3))])
    np.testing.assert_array_equal(visible_sides(Scene(some), EYE, ALONG), [1] * 12 + [0, 0])
