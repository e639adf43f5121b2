"""Scenes from files and trimesh, and defects of their triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.host.errors import ReadError
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene, _vertex_numbers


@pytest.fixture
def box() -> np.ndarray:
    return np.array(trimesh.creation.box((1.0, 2.0, 3.0)).triangles)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_files(tmp_path: Path, ending: str, box: np.ndarray) -> None:
    path = tmp_path / f"box.{ending}"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(path)
    scene = Scene.load(path, metres=1e-3)
    assert scene.corners.shape == (12, 3, 3)
    np.testing.assert_allclose(np.ptp(scene.corners, axis=(0, 1)), [1e-3, 2e-3, 3e-3], rtol=1e-6)
    assert str(scene.defects) == "no defects"
    assert not scene.material.any()


def test_meshes_are_materials(tmp_path: Path) -> None:
    one, two = trimesh.creation.box(), trimesh.creation.icosphere(1)
    two.apply_translation([5.0, 0.0, 0.0])
    for given in ([one, two], trimesh.Scene([one, two])):
        scene = Scene.of(given)
        np.testing.assert_array_equal(scene.material, np.repeat([0, 1], [12, 80]))
        np.testing.assert_allclose(scene.corners[12:].mean(axis=(0, 1)), [5.0, 0.0, 0.0], atol=1e-12)
    trimesh.Scene([one, two]).export(tmp_path / "two.glb")
    np.testing.assert_array_equal(np.bincount(Scene.load(tmp_path / "two.glb").material), [12, 80])
    assert len(Scene.of([]).corners) == 0


def test_a_file_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        Scene.load(tmp_path / "none.stl")
    (tmp_path / "part.txt").write_text("solid")
    with pytest.raises(ValueError, match=r"\.stl"):
        Scene.load(tmp_path / "part.txt")
    with pytest.raises(TypeError, match="trimesh"):
        Scene.of([np.zeros((1, 3, 3))])


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
@pytest.mark.parametrize("harm", ["empty", "cut", "garbled"])
def test_a_damaged_file_is_named(tmp_path: Path, ending: str, harm: str) -> None:
    path = tmp_path / f"box.{ending}"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(path)
    content = path.read_bytes()
    path.write_bytes({"empty": b"", "cut": content[: len(content) // 2], "garbled": b"\x92\x00\x81mesh" * 40}[harm])
    with pytest.raises(ValueError, match=rf"box\.{ending}: (not a readable mesh|contains no triangles)"):
        Scene.load(path)


def test_a_file_of_points_is_no_mesh(tmp_path: Path) -> None:
    """A point cloud, such as the range image of a scan, has no triangles."""
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(ReadError, match=r"points\.ply: contains no triangles, expected a mesh of the part"):
        Scene.load(tmp_path / "points.ply")


def test_a_folder_is_no_mesh(tmp_path: Path) -> None:
    (tmp_path / "part.stl").mkdir()
    with pytest.raises(IsADirectoryError, match=r"part\.stl: a folder, expected a file"):
        Scene.load(tmp_path / "part.stl")


def test_no_area(box: np.ndarray) -> None:
    flat = np.array([[[0, 0, 0], [1, 1, 1], [3, 3, 3]], [[1, 2, 3]] * 3, [[0, 0, 0], [1, 0, 0], [1, 0, 0]]], float)
    # Slivers are valid triangles: a nanometre by a metre, and a triangle of a micrometre.
    slivers = np.array([[[0, 0, 9], [1, 0, 9], [0, 1e-9, 9]], [[0, 0, 8], [1e-6, 0, 8], [0, 1e-6, 8]]])
    scene = Scene(np.concatenate([box, flat, slivers]))
    assert scene.defects.degenerate == (12, 13, 14)
    np.testing.assert_array_equal(np.sort(scene.bvh.numbers), [*range(12), 15, 16])
    assert "degenerate: 3 triangles (12, 13, 14)" in str(scene.defects)


def test_not_finite(box: np.ndarray) -> None:
    box[3, 1, 2], box[7, 0, 0] = np.nan, np.inf
    scene = Scene(box)
    assert scene.defects.not_finite == (3, 7)
    assert scene.defects.degenerate == ()
    assert len(scene.bvh.numbers) == 10
    assert np.ptp(scene.corners[[3, 7]], axis=1).max() == 0.0
    assert np.isfinite(scene.corners).all()
    np.testing.assert_array_equal([scene.corners.min(axis=(0, 1)), scene.corners.max(axis=(0, 1))], box_bounds(box))


def box_bounds(box: np.ndarray) -> np.ndarray:
    """Return the bounds of the finite triangles of a box."""
    finite = box[[0, 1, 2, 4, 5, 6, 8, 9, 10, 11]].reshape(-1, 3)
    return np.array([finite.min(axis=0), finite.max(axis=0)])


def test_nothing_finite() -> None:
    scene = Scene(np.full((2, 3, 3), np.nan))
    assert scene.defects.not_finite == (0, 1)
    assert not len(scene.bvh.numbers)


def test_duplicates(box: np.ndarray) -> None:
    """Triangles that a file holds twice leave the box as it is, also where their corners are rotated."""
    scene = Scene(np.concatenate([box, np.roll(box[:5], 1, axis=1), box[[11, 11]]]))
    assert scene.defects.duplicate == tuple(range(12, 19))
    assert (scene.defects.non_manifold, scene.defects.inverted) == ((), ())
    np.testing.assert_array_equal(np.sort(scene.bvh.numbers), range(12))
    assert "duplicate: 7 triangles (12, 13, " in str(scene.defects)


def test_touching_solids_have_no_duplicates(box: np.ndarray) -> None:
    """The common face of two boxes has both windings: each box stays closed."""
    across = np.ptp(box[..., 2])
    other = box * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * box[..., 2].max()]
    scene = Scene(np.concatenate([box, other[:, ::-1]]))
    assert np.ptp(scene.corners[..., 2]) == pytest.approx(2.0 * across)
    assert scene.defects.duplicate == ()


def test_inverted_are_turned(box: np.ndarray) -> None:
    wrong = box.copy()
    wrong[[2, 9]] = wrong[[2, 9]][:, ::-1]
    scene = Scene(wrong)
    assert scene.defects.inverted == (2, 9)
    np.testing.assert_array_equal(scene.corners, box)
    assert Scene(box).defects.inverted == ()


def test_each_piece_by_itself(box: np.ndarray) -> None:
    other = box + 10.0
    other[5] = other[5][::-1]
    assert Scene(np.concatenate([box[:, ::-1], other])).defects.inverted == (17,)


def test_three_on_an_edge(box: np.ndarray) -> None:
    fin = np.concatenate([box[0, :2], [[9.0, 9.0, 9.0]]])[None]
    defects = Scene(np.concatenate([box, fin])).defects
    assert {0, 12} <= set(defects.non_manifold)
    assert len(defects.non_manifold) == 3


def test_the_same_points_have_the_same_number(rng: np.random.Generator) -> None:
    """For both signs of zero; points that differ in the last bit have different numbers."""
    some = np.array([0.0, -0.0, 1.0, -1.0, np.nextafter(1.0, 2.0), 5e-324, 1e300])
    points = rng.choice(some, (3000, 3))
    numbers = _vertex_numbers(points)
    _, first, expected = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(numbers, numbers[first][expected])
    assert len(np.unique(numbers)) == len(first)


@pytest.mark.double
@pytest.mark.slow
def test_a_million_triangles(device: Device, rng: np.random.Generator) -> None:
    """A sphere of 1.3 million: each triangle is in the tree once, flipped ones are found, rays hit the sphere."""
    mesh = trimesh.creation.icosphere(8)
    corners = np.array(mesh.triangles)
    wrong = rng.choice(len(corners), 1000, replace=False)
    corners[wrong] = corners[wrong][:, ::-1]
    scene = Scene(corners)
    assert scene.defects.inverted == tuple(sorted(wrong))
    members = scene.bvh.members
    np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(corners)))
    directions = rng.normal(size=(20_000, 3))
    hits = ClosestHit(scene=scene)(np.hstack([np.zeros((20_000, 3)), directions]), device=device)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    met = scene.corners[hits.triangle]
    weights = np.column_stack([1.0 - hits.barycentric.sum(axis=1), hits.barycentric])
    np.testing.assert_allclose(np.einsum("nc,ncx->nx", weights, met), unit * hits.distance[:, None], atol=1e-12)
    assert not hits.status.any()


def test_a_moebius_strip_has_no_winding() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 31)[:-1]
    across = np.stack([np.cos(turn / 2) * np.cos(turn), np.cos(turn / 2) * np.sin(turn), np.sin(turn / 2)], axis=1)
    middle = 3.0 * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    one, two = middle + across, middle - across
    # After the flip the sides are exchanged.
    next_one, next_two = np.concatenate([one[1:], two[:1]]), np.concatenate([two[1:], one[:1]])
    strip = np.concatenate([np.stack([one, two, next_one], axis=1), np.stack([two, next_two, next_one], axis=1)])
    assert len(Scene(strip).defects.non_manifold) == len(strip)


def test_what_a_scene_does_not_take(box: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"\(n, 3, 3\)"):
        Scene(box[0])
    with pytest.raises(ValueError, match="integers"):
        Scene(box, np.zeros(3, int))
    with pytest.raises(ValueError, match="negative index"):
        Scene(box, np.full(12, -1))
