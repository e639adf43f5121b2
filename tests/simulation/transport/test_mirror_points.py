"""MirrorPoints on devices: Alhazen's problem, an ellipsoid by rays, plane mirrors by images; smooth normals."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import trimesh

from canary import Guarded
from gpuvision.host import Device
from gpuvision.reference import mirrors as reference
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.mirror_points import MirrorPoints, TriangleBlocks, max_bulge, smooth_normals
from gpuvision.status import Status

WAYS = pytest.mark.parametrize(
    ("variant", "dtype"),
    [("vector", np.float64), ("work_item", np.float64), ("vector", np.float32), ("work_item", np.float32)],
)
LENS = np.array([-1.0, 3.0, 0.2])


def ball(fineness: int, shape: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles of an ellipsoid and the true normals at their corners."""
    sphere = np.array(trimesh.creation.icosphere(fineness).triangles)
    sphere /= np.linalg.norm(sphere, axis=2, keepdims=True)
    normals = sphere / shape
    return sphere * shape, normals / np.linalg.norm(normals, axis=2, keepdims=True)


def mirrors(fineness: int, shape: tuple[float, float, float] = (1.0, 1.0, 1.0), **more: Any) -> MirrorPoints:
    corners, normals = ball(fineness, shape)
    return MirrorPoints(corners=corners, normals=normals, numbers=np.arange(len(corners)) + 7, **more)


def some_points(rng: np.random.Generator, count: int = 40) -> np.ndarray:
    places = np.array([1.8, 2.0, 0.3]) + rng.normal(0.0, 0.3, (count, 3))
    return np.hstack([places, rng.normal(0.0, 1.0, (count, 3))])


def outside(result: Any, lens: np.ndarray = LENS) -> tuple[np.ndarray, ...]:
    """Return place, move, density of the image on the side of the lens; the other image is inside the ball."""
    shown = result.triangle >= 0
    front = shown & (np.sum(result.place * (lens - result.place), axis=-1) > 0.0)
    assert (front.sum(axis=1) == 1).all()
    return result.place[front], result.move[front], result.density[front]


@WAYS
def test_a_sphere_shows_points_where_alhazen_says(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    points = some_points(rng).astype(dtype)
    result = mirrors(3, variant=variant)(points, LENS.astype(dtype), device=device)
    place, _, density = outside(result)
    for n, point in enumerate(points[:, :3].astype(np.float64)):
        expected, concentration = reference.reflect_in_sphere(point, LENS.astype(dtype).astype(np.float64))
        assert np.linalg.norm(place[n] - expected) < 2e-4
        assert abs(density[n] / concentration - 1.0) < 1.5e-2
    assert not result.status.any()
    assert ((result.triangle >= 7) == (np.arange(8) < result.image_count[:, None])).all()
    assert place.dtype == dtype


@pytest.mark.double
def test_images_converge_to_the_third_order_and_density_to_the_first_or_better(
    device: Device, rng: np.random.Generator
) -> None:
    points = some_points(rng)
    far, thin = [], []
    for fineness in (2, 3, 4):
        place, _, density = outside(mirrors(fineness)(points, LENS, device=device))
        truth = [reference.reflect_in_sphere(point, LENS) for point in points[:, :3]]
        far.append(max(np.linalg.norm(at - one[0]) for at, one in zip(place, truth, strict=True)))
        thin.append(max(abs(value / one[1] - 1.0) for value, one in zip(density, truth, strict=True)))
    # Triangles of half size.
    assert far[0] / far[1] > 6.0
    assert far[1] / far[2] > 6.0
    assert thin[0] / thin[1] > 2.0
    assert thin[1] / thin[2] > 2.0


@pytest.mark.double
def test_an_ellipsoid_shows_points_as_rays_that_it_reflects(device: Device, rng: np.random.Generator) -> None:
    """Rays from the lens next to the image, reflected by the true surface, pass the point at the predicted distance."""
    shape = (1.0, 0.8, 1.3)
    points = some_points(rng, 16)
    place, _, density = outside(mirrors(5, shape)(points, LENS, device=device))
    for n, point in enumerate(points[:, :3]):
        away, area_per_angle = reference.reflect_past_ellipsoid(shape, LENS, place[n], point)
        assert away < 5e-4
        assert abs(density[n] * area_per_angle - 1.0) < 5e-3


@pytest.mark.double
@pytest.mark.parametrize("point_height", [0.012, 0.03, 0.06, 0.2])
def test_a_hollow_mirror_concentrates_as_its_focal_length_says(device: Device, point_height: float) -> None:
    """On the axis of a sphere of radius R: (d + e - 2 d e / R)^2 square metres per steradian; more beyond the focus."""
    radius, lens_height = 0.08, 0.3
    corners, normals = ball(4)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.31, 0.77, 0.23]))[:3, :3]
    corners, normals = radius * corners @ turn + [0.0, 0.0, radius], -normals @ turn
    # Farther out the images form a ring, a caustic.
    bottom = corners[..., 2].max(axis=1) < 0.1 * radius
    op = MirrorPoints(corners=corners[bottom], normals=normals[bottom], numbers=np.flatnonzero(bottom))
    points = np.array([[0.0, 0.0, point_height, 1.0, 0.0, 0.0]])
    result = op(points, np.array([0.0, 0.0, lens_height]), device=device)
    axial = np.linalg.norm(result.place[0, : result.image_count[0], :2], axis=1) < 1e-5
    assert axial.sum() == 1
    spread = lens_height + point_height - 2.0 * lens_height * point_height / radius
    assert np.abs(result.place[0, : result.image_count[0], 2][axial]) < 1e-6
    assert result.density[0, : result.image_count[0]][axial] == pytest.approx(spread**-2, rel=2e-2)
    move = result.move[0, : result.image_count[0], 0][axial]
    # Motion of the image as the point moves sideways: the lens is at e / (e - f) times the distance of its image.
    assert move == pytest.approx(lens_height / spread, rel=1e-2)


@WAYS
def test_images_move_as_points_do(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    points = some_points(rng)
    # On one triangle: at the centre of the triangle with the image.
    op, step = mirrors(2, variant=variant, precision=None), 1e-5 if dtype == np.float64 else 1e-2
    lens = LENS.astype(dtype)
    one = points.copy()
    one[:, :3] -= 0.5 * step * points[:, 3:]
    two = points.copy()
    two[:, :3] += 0.5 * step * points[:, 3:]
    results = [op(each.astype(dtype), lens, device=device) for each in (points, one, two)]
    (_, move, _), (start, _, _), (end, _, _) = map(outside, results)
    same = np.all([each.triangle[:, 0] == results[0].triangle[:, 0] for each in results], axis=0)
    assert same.sum() > 20
    tolerance = 1e-6 if dtype == np.float64 else 3e-3
    np.testing.assert_allclose(((end - start) / step)[same], move[same], atol=tolerance)


@pytest.mark.double
def test_a_ball_shows_all_that_it_does_not_hide(device: Device, rng: np.random.Generator) -> None:
    """Up to the silhouette, a point has an image on the outside if the ball is not between it and the lens."""
    directions = rng.normal(0.0, 1.0, (3000, 3))
    points = np.zeros((3000, 6))
    points[:, :3] = rng.uniform(1.05, 4.0, (3000, 1)) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    towards = LENS - points[:, :3]
    share = np.clip(-np.sum(points[:, :3] * towards, axis=1) / np.sum(towards * towards, axis=1), 0.0, 1.0)
    distance = np.linalg.norm(points[:, :3] + share[:, None] * towards, axis=1)
    result = mirrors(3, outside=np.ones(1280, bool))(points, LENS, device=device)
    # Within the bulge of a triangle at the silhouette, rounding of the surface decides.
    sure = np.abs(distance - 1.0) > 3e-3
    missed = sure & (result.image_count != (distance > 1.0))
    assert missed.mean() < 5e-3
    assert np.all(distance[missed] < 1.2)
    assert sure.mean() > 0.98


@WAYS
def test_the_inside_of_a_ball_may_be_left_out(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    points, lens = some_points(rng).astype(dtype), LENS.astype(dtype)
    both = mirrors(3, variant=variant)(points, lens, device=device)
    one = mirrors(3, variant=variant, outside=np.ones(1280, bool))(points, lens, device=device)
    np.testing.assert_array_equal(both.image_count, 2)
    np.testing.assert_array_equal(one.image_count, 1)
    np.testing.assert_array_equal(one.place[:, 0], outside(both)[0])


@WAYS
def test_a_flat_mirror_shows_the_mirror_image(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    corners = np.array([[[-1.0, -1, 0.5], [3, -1, 0.5], [-1, 3, 0.5]]])
    op = MirrorPoints(corners=corners, normals=np.tile([0.0, 0, 1], (1, 3, 1)), numbers=[3], variant=variant)
    points = np.hstack([rng.uniform(0.0, 0.8, (33, 2)), rng.uniform(0.6, 2.0, (33, 1)), rng.normal(size=(33, 3))])
    points[0, 2] = 0.4  # behind
    lens = np.array([0.2, 0.3, 1.5])
    result = op(points.astype(dtype), lens.astype(dtype), device=device)
    np.testing.assert_array_equal(result.image_count, np.arange(33) > 0)
    up = points[1:, 2] - 0.5
    share = (1.0 / (1.0 + up))[:, None]
    image = points[1:, :3] * [1, 1, -1] + [0, 0, 1]
    eps = 2e-6 if dtype == np.float32 else 1e-14
    np.testing.assert_allclose(result.place[1:, 0], lens + share * (image - lens), atol=eps)
    np.testing.assert_allclose(result.density[1:, 0], 1.0 / np.sum((image - lens) ** 2, axis=1), rtol=10 * eps)


def test_normals_of_a_sphere_are_exact_and_edges_stay() -> None:
    sphere = Scene.of(trimesh.creation.icosphere(3))
    radial = sphere.corners / np.linalg.norm(sphere.corners, axis=2, keepdims=True)
    np.testing.assert_allclose(smooth_normals(sphere), radial, atol=1e-13)
    box = Scene.of(trimesh.creation.box())
    faces = np.cross(*(box.corners[:, n] - box.corners[:, 0] for n in (1, 2)))
    flat = faces / np.linalg.norm(faces, axis=1, keepdims=True)
    np.testing.assert_allclose(smooth_normals(box), np.repeat(flat[:, None], 3, axis=1), atol=1e-15)
    assert np.abs(smooth_normals(box, crease=2.0)[:, 0] - flat).max() > 0.3


def test_normals_of_a_cylinder_turn_round_and_of_no_area_are_zero() -> None:
    mesh = trimesh.creation.cylinder(1.0, 2.0, sections=36)
    scene = Scene(np.concatenate([mesh.triangles, np.zeros((1, 3, 3)), np.full((1, 3, 3), np.nan)]))
    normals = smooth_normals(scene)
    assert not normals[-2:].any()
    wall = np.abs(normals[:-2, 0, 2]) < 0.5
    radial = scene.corners[:-2][wall] * [1, 1, 0]
    np.testing.assert_allclose(normals[:-2][wall], radial / np.linalg.norm(radial, axis=2, keepdims=True), atol=1e-12)


@pytest.mark.parametrize("crease", [0.5, 0.7, 1.0])
def test_normals_of_a_soup_are_maxs_means(crease: float, rng: np.random.Generator) -> None:
    """Sums over the corners at one position, weighted by sine over the product of the edges, up to the crease angle."""
    ball = np.array(trimesh.creation.icosphere(0).triangles)
    shape = np.array([[1.0, 0.3, 0.1], [0.0, 0.8, 0.2], [0.1, -0.2, 1.3]])
    corners = ball @ shape.T
    found = smooth_normals(Scene(corners), crease=crease)
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    joined = 0
    for triangle, corner in np.ndindex(len(corners), 3):
        total = np.zeros(3)
        for other, k in np.ndindex(len(corners), 3):
            if np.array_equal(corners[other, k], corners[triangle, corner]) and flat[other] @ flat[triangle] > np.cos(
                crease
            ):
                a, b = (corners[other, (k + step) % 3] - corners[other, k] for step in (1, 2))
                total += np.cross(a, b) / (a @ a * (b @ b))
                joined += 1
        np.testing.assert_allclose(found[triangle, corner], total / np.linalg.norm(total), rtol=0, atol=1e-13)
    assert 60 < joined < 300


def test_the_bulge_is_bounded(rng: np.random.Generator) -> None:
    """The bound by its definition, and the lift of points by half the weighted depths below the tangent planes."""
    corners = rng.uniform(-1.0, 1.0, (40, 3, 3))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None] + rng.normal(
        0, 0.3, (40, 3, 3)
    )
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    found = max_bulge(corners, normals)
    weights = rng.dirichlet([1.0, 1.0, 1.0], 200)
    for triangle, (points, directions) in enumerate(zip(corners, normals, strict=True)):
        heights = [
            abs((points[j] - points[i]) @ directions[i]) + abs((points[j] - points[i]) @ directions[j])
            for i, j in ((0, 1), (1, 2), (2, 0))
        ]
        assert found[triangle] == pytest.approx(max(heights) / 6.0, rel=1e-12)
        place = weights @ points
        depth = np.stack(
            [(each - place) @ direction for each, direction in zip(points, directions, strict=True)], axis=1
        )
        lift = 0.5 * (weights * depth) @ directions
        assert np.linalg.norm(lift, axis=1).max() <= found[triangle] * (1.0 + 1e-12)
    assert max_bulge(np.zeros((0, 3, 3)), np.zeros((0, 3, 3))).shape == (0,)


def test_blocks_bound_their_triangles(rng: np.random.Generator) -> None:
    """Every corner with the bulge is in the ball of its block, every normal in its cone; both bounds are reached."""
    corners, normals = ball(2, (1.0, 0.6, 0.4))
    one_sided = rng.random(len(corners)) < 0.9
    blocks = TriangleBlocks.of(corners, normals, outside=one_sided)
    assert sorted(blocks.order) == list(range(len(corners)))
    assert blocks.start[0] == 0
    assert blocks.start[-1] == len(corners)
    for n, (first, last) in enumerate(itertools.pairwise(blocks.start)):
        mine = blocks.order[first:last]
        points, directions = corners[mine].reshape(-1, 3), normals[mine].reshape(-1, 3)
        np.testing.assert_allclose(blocks.middle[n], 0.5 * (points.min(axis=0) + points.max(axis=0)))
        reach = np.linalg.norm(corners[mine] - blocks.middle[n], axis=2).max(axis=1) + max_bulge(
            corners[mine], normals[mine]
        )
        assert blocks.radius[n] == pytest.approx(reach.max(), rel=1e-12)
        mean = directions.sum(axis=0)
        np.testing.assert_allclose(blocks.axis[n], mean / np.linalg.norm(mean), atol=1e-12)
        assert blocks.cone[n] == pytest.approx(np.arccos(np.clip(directions @ blocks.axis[n], -1, 1)).max(), rel=1e-6)
        assert blocks.outside[n] == one_sided[mine].all()
    rows = blocks.rows(np.array([0.5, -1.0, 2.0]))
    np.testing.assert_allclose(rows.middle, blocks.middle - [0.5, -1.0, 2.0])
    assert np.all(rows.radius > blocks.radius)
    np.testing.assert_allclose(rows.radius, blocks.radius, rtol=2e-5)
    twice = np.minimum(2.0 * blocks.cone * (1.0 + 1e-5) + 1e-6, np.pi)
    np.testing.assert_allclose([rows.cosine_of_twice, rows.sine_of_twice], [np.cos(twice), np.sin(twice)], atol=1e-12)
    np.testing.assert_allclose(rows.sine, np.sin(0.5 * twice), atol=1e-12)
    np.testing.assert_array_equal(rows.one_sided, blocks.outside & (twice < 0.5 * np.pi))
    assert 0.0 < rows.one_sided.mean() < 1.0


def test_normals_that_cancel_have_a_wide_cone() -> None:
    corners = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]).repeat(2, axis=0)
    normals = np.array([[[1.0, 0.0, 0.0]] * 3, [[-1.0, 0.0, 0.0]] * 3])
    blocks = TriangleBlocks.of(corners, normals)
    np.testing.assert_array_equal(blocks.axis, [[0.0, 0.0, 1.0]])
    assert blocks.cone[0] == pytest.approx(0.5 * np.pi)
    assert not blocks.outside.any()
    empty = TriangleBlocks.of(corners[:0], normals[:0])
    assert empty.table(np.zeros(3)).shape == (1, 11)
    assert not empty.table(np.zeros(3)).any()
    assert blocks.table(np.zeros(3)).shape == (1, 11)


@WAYS
def test_more_images_than_are_kept_and_numbers_that_are_none(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    points = some_points(rng, 20).astype(dtype)
    points[3, 1], points[5, 4] = np.nan, np.inf
    expected = np.full(20, Status.AMBIGUOUS)
    expected[[3, 5]] = Status.NOT_FINITE
    result = mirrors(2, kept=1, variant=variant)(points, LENS.astype(dtype), device=device)
    np.testing.assert_array_equal(result.status, expected)
    np.testing.assert_array_equal(result.image_count, expected == Status.AMBIGUOUS)
    no_mirrors = MirrorPoints(corners=np.zeros((0, 3, 3)), normals=np.zeros((0, 3, 3)), numbers=[], variant=variant)
    assert not no_mirrors(points, LENS.astype(dtype), device=device).image_count.any()


@pytest.mark.double
def test_writes_only_its_outputs(device: Device, rng: np.random.Generator) -> None:
    op = mirrors(1)
    for shape in ((0,), (1,), (3, 7), (33,)):
        points = some_points(rng, int(np.prod(shape))).reshape(*shape, 6)
        plain = op(points, LENS, device=device)
        guarded = Guarded(plain)
        op(points, LENS, device=device, out=guarded.out)
        guarded.assert_intact()
        np.testing.assert_array_equal(plain.triangle, guarded.out.triangle)


def test_what_it_does_not_take(device: Device) -> None:
    corners, normals = ball(0)
    with pytest.raises(ValueError, match="corners"):
        MirrorPoints(corners=corners[0], normals=normals, numbers=[])
    with pytest.raises(ValueError, match="length"):
        MirrorPoints(corners=corners, normals=normals[1:], numbers=np.arange(len(corners)))
    for kept in (0, 256):
        with pytest.raises(ValueError, match="kept"):
            mirrors(0, kept=kept)
    assert (mirrors(0, kept=1).kept, mirrors(0, kept=255).kept) == (1, 255)
    with pytest.raises(ValueError, match=r"\(\.\.\., 6\)"):
        mirrors(0)(np.zeros((4, 5)), LENS, device=device)
    with pytest.raises(TypeError, match="float32"):
        mirrors(0)(np.zeros((4, 6), np.int32), LENS, device=device)
