"""Convex parts of a scene: which surfaces are parts, their leaves, boxes and cones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gpuvision.simulation.scene.convex_parts import ConvexSurfaces
from gpuvision.simulation.scene.scene import Scene

Reals = NDArray[np.float64]
TURN = trimesh.transformations.euler_matrix(0.3, -0.7, 1.1)


def turned(mesh: Any, x: float) -> Reals:
    """Return the triangles of a mesh that is turned and moved along x."""
    return np.asarray(mesh.copy().apply_transform(TURN).apply_translation((x, 0.0, 0.0)).triangles, np.float64)


def some_parts() -> list[Reals]:
    ball, post = trimesh.creation.icosphere(1), trimesh.creation.cylinder(0.5, 1.0, sections=22)
    return [turned(trimesh.creation.box(), 0.0), turned(ball, 4.0), turned(post, 8.0)]


def test_closed_convex_surfaces_are_parts() -> None:
    several = some_parts()
    surfaces = ConvexSurfaces.of(np.concatenate(several))
    sizes = [len(each) for each in several]
    assert surfaces.is_convex.all()
    assert len(np.unique(surfaces.parts)) == 3
    assert all(len(np.unique(each)) == 1 for each in np.split(surfaces.parts, np.cumsum(sizes)[:-1]))
    np.testing.assert_allclose(surfaces.low[0], several[0].min(axis=(0, 1)))
    np.testing.assert_allclose(surfaces.high[-1], several[2].max(axis=(0, 1)))


def test_other_surfaces_are_no_parts() -> None:
    """Open, inside out, hollow to one side, dented by a thousandth, and with too many triangles."""
    box, torus = trimesh.creation.box(), trimesh.creation.torus(1.0, 0.3, 8, 8)
    dented = trimesh.creation.box().subdivide()
    middle = np.argmin(np.linalg.norm(dented.vertices - (0.5, 0.0, 0.0), axis=1))
    dented.vertices[middle] -= (1e-3, 0.0, 0.0)
    large = trimesh.creation.icosphere(3)
    several = [turned(box, 0.0)[1:], turned(box, 3.0)[:, ::-1], turned(torus, 6.0)]
    several += [turned(dented, 9.0), turned(large, 12.0)]
    assert not ConvexSurfaces.of(np.concatenate(several)).is_convex.any()
    assert not len(ConvexSurfaces.of(np.zeros((0, 3, 3))).parts)
    assert ConvexSurfaces.of(turned(trimesh.creation.box().subdivide(), 9.0)).is_convex.all()


def test_parts_that_share_an_edge_are_no_parts() -> None:
    box = np.array(trimesh.creation.box().triangles)
    assert not ConvexSurfaces.of(np.concatenate([box, np.add(box, (1.0, 0.0, 0.0))])).is_convex.any()


def test_leaves_of_parts(rng: np.random.Generator) -> None:
    """Each leaf has triangles of one part, each triangle is in one leaf; boxes hold parts, cones only points behind."""
    loose = rng.normal(size=(40, 3, 3)) * 0.1 + (4.0, 0.0, 0.0)
    scene = Scene(np.concatenate([*some_parts(), loose]))
    parts, tree = scene.convex_parts, scene.convex_parts.tree
    members = tree.members
    np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(scene.corners)))
    np.testing.assert_allclose(tree.corners + tree.middle, scene.corners, atol=1e-15)
    part = ConvexSurfaces.of(scene.corners).parts
    of_leaf = [np.unique(part[row[row >= 0]]) for row in members]
    assert all(len(each) == 1 for each in of_leaf)
    np.testing.assert_array_equal(parts.leaves, [n for n, each in enumerate(of_leaf) if each[0] >= 0])
    points = rng.uniform(-3.0, 3.0, (4000, 3)) * (3.0, 1.0, 1.0)
    caught = 0
    table = parts.table(np.dtype(np.float64))
    for leaf in parts.leaves:
        row, inside = table[leaf], tree.corners[part == of_leaf[leaf][0]]
        assert (inside >= row[:3] - 1e-12).all()
        assert (inside <= row[4:7] + 1e-12).all()
        np.testing.assert_allclose([row[:3], row[4:7]], [inside.min(axis=(0, 1)), inside.max(axis=(0, 1))], atol=1e-12)
        toward = row[8:11] - points
        along = toward @ row[11:14]
        with np.errstate(invalid="ignore"):
            is_behind = (along > 0.0) & (along**2 >= row[14] * np.sum(toward**2, axis=1))
        corners = tree.corners[members[leaf][members[leaf] >= 0]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        faces = np.einsum("pnk,nk->pn", points[:, None] - corners[:, 0], normals).max(axis=1)
        assert (faces[is_behind] <= 1e-9).all()
        caught += int(is_behind.sum())
        assert is_behind.sum() <= (faces <= 1e-9).sum()
    assert caught > 0.1 * len(points) * len(parts.leaves)


def test_a_scene_without_parts_has_one_tree(rng: np.random.Generator) -> None:
    scene = Scene(rng.normal(size=(50, 3, 3)))
    assert scene.convex_parts.tree is scene.bvh
    table = scene.convex_parts.table(np.dtype(np.float32))
    assert np.isneginf(table[:, :3]).all()
    assert np.isposinf(table[:, 4:7]).all()
    assert not len(Scene(np.zeros((0, 3, 3))).convex_parts.leaves)


def test_a_part_of_single_precision_is_none_in_double() -> None:
    """Corners that were rounded to float32 are convex but for this rounding."""
    ball = turned(trimesh.creation.cylinder(0.5, 1.0, sections=22), 3.0).astype(np.float32).astype(np.float64)
    parts = Scene(ball).convex_parts
    assert len(parts.leaves) == len(parts.tree.members)
    assert np.isfinite(parts.table(np.dtype(np.float32))[:, 0]).all()
    assert not np.isfinite(parts.table(np.dtype(np.float64))[:, 0]).any()


def test_large_scenes_are_not_searched() -> None:
    box = np.array(trimesh.creation.box().triangles)
    several = np.concatenate([box + np.array([3.0 * n, 0.0, 0.0]) for n in range(2731)])
    assert not ConvexSurfaces.of(several).is_convex.any()
    assert ConvexSurfaces.of(several[12:]).is_convex.all()


@pytest.mark.filterwarnings("error")
def test_leaves_with_opposite_normals(rng: np.random.Generator) -> None:
    """The cosine between opposite normals of a turned box may round to less than -1."""
    box = np.asarray(trimesh.creation.box().triangles)
    for turn in Rotation.random(50, random_state=rng).as_matrix():
        assert Scene(box @ turn.T).convex_parts is not None
