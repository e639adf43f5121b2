"""Patches and form factors on devices: 60 digits, closed rooms, occlusion, and inputs."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device
from gpuvision.reference import patches as reference
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.patches import Factors, FormFactors, Patches, PatchLight
from gpuvision.status import Status

ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
TWO_WAYS = pytest.mark.parametrize("variant", ["vector", "work_item"])
PRECISIONS = pytest.mark.parametrize("precision", ["single", "double"])
# One strip and one receiver more.
RECEIVERS, SIZES = 17, (3.0, 1.0, 0.1, 1e-3, 1e-6)


@functools.cache
def draws() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return receivers, triangles of very different size, their factors, and the documented bound in roundings."""
    rng = np.random.default_rng(7)
    triangles = np.concatenate([rng.normal(size=(5, 3, 3)) * size for size in SIZES]).astype(np.float32)
    # A sliver, and a triangle at a grazing angle to a receiver nearly in its plane.
    triangles[3] = [[0.0, 0.0, 0.0], [3.0, 1.0, 0.0], [1.5, 0.5001, 0.0]]
    triangles[8] = [[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 1.0, -1.0]]
    receivers = rng.normal(size=(RECEIVERS, 6)).astype(np.float32)
    receivers[5] = [-0.5, -0.5, -0.9998, 1.0, 1.0, 1e-4]
    values, bounds = np.zeros((2, RECEIVERS, len(triangles)))
    for i, receiver in enumerate(receivers):
        for k, corners in enumerate(triangles.astype(float)):
            values[i, k], facing = reference.form_factor(receiver, corners)
            if facing > 0.0:
                bounds[i, k] = 32.0 * facing * _conditioning(receiver[:3].astype(float), corners)
    return receivers, triangles.astype(float), values, bounds


def _conditioning(place: np.ndarray, corners: np.ndarray) -> float:
    edges = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(edges, axis=1)
    front = np.cross(edges[0], edges[1])
    far = np.linalg.norm(corners - place, axis=1).max()
    edge_distance = (np.linalg.norm(np.cross(place - corners, edges), axis=1) / lengths).min()
    height = (place - corners[0]) @ front / np.linalg.norm(front)
    return float(lengths.max() ** 2 / np.linalg.norm(front) + far / edge_distance + far / height)


def room(*extents: float) -> Scene:
    """Return the inside of a box around the origin."""
    box = trimesh.creation.box(extents)
    box.invert()
    return Scene.of(box)


@TWO_WAYS
@PRECISIONS
def test_factors_are_exact_at_any_distance(device: Device, variant: Any, precision: Any) -> None:
    receivers, triangles, values, bounds = draws()
    operation = FormFactors(patches=Patches(triangles), precision=precision, variant=variant)
    result = operation(receivers, device=device)
    assert result.factors.dtype == (np.float32 if precision == "single" else np.float64)
    assert np.all(result.status == 0)
    # Random points with coordinates of both signs: half of the pairs face each other.
    assert 0.2 < (values > 0.0).mean() < 0.4
    eps = float(np.finfo(result.factors.dtype).eps)
    assert np.all(np.abs(result.factors - values) <= bounds * eps)
    np.testing.assert_array_equal(result.factors[bounds == 0.0], 0.0)


@pytest.mark.double
def test_micrometres_stand_in_metres(device: Device) -> None:
    """A corner of ten micrometres far from the centre of a scene of metres has the same light as at the origin."""
    corner = 1e-5 * np.array([[[0, 0, 0], [0, 1, 0], [0, 1, 1]], [[0, 0, 0], [0, 1, 1], [0, 0, 1]]])
    far = np.array([[[-2.0, -1.0, -3.0], [2.0, -1.0, -3.0], [0.0, 1.0, -3.0]]])
    shift = np.array([1.0, 0.5, 0.25])
    receivers = np.array([[1e-6, 5e-6, 0.0, 0, 0, 1], [1e-5, 5e-6, 1e-6, -1, 0, 1], [1e-7, 5e-6, 0.0, 0, 0, 1]])
    at_home = FormFactors(patches=Patches(corner))(receivers, device=device).factors
    assert np.all(at_home.sum(axis=1) > 0.1)
    receivers[:, :3] += shift
    away = FormFactors(patches=Patches(np.concatenate([corner + shift, far])))(receivers, device=device).factors
    np.testing.assert_allclose(away[:, :2], at_home, atol=1e-8)


@pytest.mark.double
def test_pieces_add_up_to_the_whole(device: Device) -> None:
    rng = np.random.default_rng(3)
    triangle = rng.normal(size=(1, 3, 3))
    receivers = rng.normal(size=(64, 6))
    pieces = Patches(triangle)
    for _ in range(4):
        pieces = pieces.bisected(np.ones(pieces.count, bool))
    together = Patches(pieces.corners, np.zeros(len(pieces.corners), int))
    complete = FormFactors(patches=Patches(triangle))(receivers, device=device).factors
    assert complete.any()
    np.testing.assert_allclose(FormFactors(patches=together)(receivers, device=device).factors, complete, atol=1e-14)


@pytest.mark.double
@given(st.integers(0, 2**32 - 1))
@ON_DEVICES
def test_a_closed_room_fills_the_view(device: Device, seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 10.0 ** (rng.uniform(-6.0, 3.0) + rng.uniform(-1.0, 1.0, 3))
    scene = room(*size)
    patches = Patches.from_scene(scene, size=float(size.max()), both_sides=False)
    receivers = np.concatenate([rng.uniform(-0.5, 0.5, (16, 3)) * size, rng.normal(size=(16, 3))], axis=1)
    factors = FormFactors(patches=patches)(receivers, device=device).factors
    np.testing.assert_allclose(factors.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.double
def test_a_surface_gets_nothing_from_its_own_plane(device: Device) -> None:
    """A surface gets no light from its own plane, even if rounding of large coordinates lifts a receiver above it."""
    rng = np.random.default_rng(5)
    for offset in (0.0, 1.0, 1e3):
        corners = rng.normal(size=(200, 3, 3)) * 1e-3 + offset
        patches = Patches(corners)
        receivers = np.concatenate([corners.mean(axis=1), patches.normals], axis=1)
        for dtype in (np.float32, np.float64):
            factors = FormFactors(patches=patches)(receivers.astype(dtype), device=device).factors
            diagonal = np.diagonal(factors)
            assert np.all(diagonal <= (1e-5 if dtype == np.float64 or offset == 0.0 else 1.0))
            if dtype == np.float64:
                assert np.all(diagonal < 1e-10)


@pytest.mark.double
def test_at_an_edge_the_factor_is_that_of_the_angle(device: Device) -> None:
    """A wall that begins at distance 0 has the form factor (1 + cos(angle)) / 2; on the edge at most that."""
    long = 1e6
    for angle in np.radians([30.0, 90.0, 150.0]):
        out = np.array([np.cos(angle), 0.0, np.sin(angle)])
        a, b = np.array([0.0, -long, 0.0]), np.array([0.0, long, 0.0])
        quad = np.array([[a, b, b + long * out], [a, b + long * out, a + long * out]])
        wall = Patches(quad, np.zeros(2, int))
        np.testing.assert_allclose(wall.normals[0], [np.sin(angle), 0.0, -np.cos(angle)], atol=1e-12)
        receivers = np.array([[10.0**-k, 0.0, 0.0, 0.0, 0.0, 1.0] for k in range(9)])
        result = FormFactors(patches=wall)(np.concatenate([receivers, receivers * [0, 0, 0, 0, 0, 1]]), device=device)
        np.testing.assert_allclose(result.factors[:9, 0], 0.5 * (1.0 + np.cos(angle)), rtol=0, atol=5e-6)
        assert np.all(result.status == 0)
        assert np.all((result.factors[9:] >= 0.0) & (result.factors[9:] <= 1.0))


@pytest.mark.double
@TWO_WAYS
def test_light_is_the_sum_of_factors(device: Device, variant: Any) -> None:
    rng = np.random.default_rng(11)
    patches = Patches.from_scene(room(1.0, 2.0, 3.0), size=1.0, both_sides=False)
    receivers = np.concatenate([rng.uniform(-0.5, 0.5, (3, 7, 3)), rng.normal(size=(3, 7, 3))], axis=2)
    exitance = rng.uniform(0.0, 2.0, patches.count)
    exitance[::3] = 0.0
    factors = FormFactors(patches=patches)(receivers, device=device).factors
    result = PatchLight(patches=patches, variant=variant)(receivers, exitance, device=device)
    assert result.irradiance.shape == (3, 7)
    np.testing.assert_allclose(result.irradiance, factors @ exitance, rtol=1e-13)


@pytest.mark.double
@TWO_WAYS
def test_what_stands_between_hides(device: Device, variant: Any) -> None:
    """A half plane hides half of a small square patch, by rays to subdivisions of it."""
    side = 0.2
    square = side * (np.array([[0, 0], [0, 1], [1, 1], [1, 0]]) - 0.5)
    ceiling = np.column_stack([square, np.ones(4)])
    patch = Patches(ceiling[[[0, 1, 2], [0, 2, 3]]], np.zeros(2, int))
    receivers = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (RECEIVERS, 1))
    free = FormFactors(patches=patch)(receivers, device=device).factors
    errors = []
    for rays in (0.0, 1e3, 1e5):
        worst = 0.0
        for covered in (0.0, 0.3, 0.62, 1.0):
            edge = 0.5 * side * (covered - 0.5)
            sheet = np.array([[-9.0, -9.0, 0.5], [edge, -9.0, 0.5], [edge, 9.0, 0.5], [-9.0, 9.0, 0.5]])
            scene = Scene(np.concatenate([sheet[[[0, 1, 2], [0, 2, 3]]], patch.corners]))
            seen = FormFactors(patches=patch, scene=scene, rays=rays, variant=variant)(receivers, device=device).factors
            if covered in (0.0, 1.0):
                np.testing.assert_allclose(seen, free * (1.0 - covered), rtol=1e-14)
            worst = max(worst, float(np.abs(seen / free - (1.0 - covered)).max()))
        errors.append(worst)
    assert errors[0] > 0.1
    assert errors[1] < 0.1
    assert errors[2] < 0.02


@pytest.mark.double
def test_one_ray_agrees_with_any_hit(device: Device, rng: np.random.Generator) -> None:
    plate = trimesh.creation.box((0.1, 0.1, 0.002))
    parts = [
        trimesh.creation.box((0.01, 0.01, 0.02)).apply_translation((*at, 0.01))
        for at in rng.uniform(-0.04, 0.04, (6, 2))
    ]
    scene = Scene.of(trimesh.util.concatenate([plate.apply_translation((0.0, 0.0, -0.001)), *parts]))
    patches = Patches.from_scene(scene, size=0.05)
    points = patches.quadrature[0]
    single = Patches(patches.corners)
    free = FormFactors(patches=single)(points, device=device).factors
    seen = FormFactors(patches=single, scene=scene, rays=0.0)(points, device=device).factors
    # Triangles completely above the receiver's plane: rays end at the centres of the subdivisions.
    heights = np.einsum("rmkd,rd->rmk", single.corners[None] - points[:, None, None, :3], points[:, 3:])
    is_complete = (heights > 0.0).all(axis=2) & (free > 0.0)
    a, b, c = np.moveaxis(single.corners, 1, 0)
    middles = 0.25 * (a + b) + 0.5 * c
    segments = np.concatenate(np.broadcast_arrays(points[:, None, :3], middles[None]), axis=2)[is_complete]
    occluded = AnyHit(scene=scene, clearance=1e-12)(np.ascontiguousarray(segments), device=device).occluded
    assert 0.1 < occluded.mean() < 0.9
    # Segments along edges may count as visible or hidden.
    assert np.mean((seen[is_complete] > 0.0) == (occluded == 0)) > 0.995
    np.testing.assert_array_equal(seen[seen > 0.0], free[seen > 0.0])


@TWO_WAYS
def test_receivers_that_are_not_finite_are_flagged(device: Device, variant: Any) -> None:
    patches = Patches.from_scene(room(1.0, 1.0, 1.0), size=1.0, both_sides=False)
    receivers = np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 1.0], (RECEIVERS, 1)).astype(np.float32)
    receivers[3, 0], receivers[5, 4], receivers[7, 3:] = np.nan, np.inf, 0.0
    wrong = np.isin(np.arange(RECEIVERS), (3, 5, 7))
    factors = FormFactors(patches=patches, variant=variant)(receivers, device=device)
    light = PatchLight(patches=patches, variant=variant)(receivers, np.ones(patches.count, np.float32), device=device)
    for values, status in ((factors.factors, factors.status), (light.irradiance[:, None], light.status)):
        np.testing.assert_array_equal(status, np.where(wrong, Status.NOT_FINITE, 0))
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), wrong)


def test_it_writes_nothing_but_its_outputs(device: Device) -> None:
    patches = Patches.from_scene(room(1.0, 1.0, 1.0), size=1.0, both_sides=False)
    receivers = np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 1.0], (RECEIVERS, 1)).astype(np.float32)
    operation = FormFactors(patches=patches)
    plain = operation(receivers, device=device)
    guarded = Guarded(plain)
    result = operation(receivers, device=device, out=guarded.out)
    guarded.assert_intact()
    np.testing.assert_array_equal(result.factors, plain.factors)
    assert operation(np.zeros((0, 6), np.float32), device=device).factors.shape == (0, patches.count)
    assert isinstance(result, Factors)


def test_what_is_refused() -> None:
    patches, device = Patches(np.eye(3)[None]), Device.best()
    with pytest.raises(TypeError, match="float32 or float64"):
        FormFactors(patches=patches)(np.zeros((4, 6), int), device=device)
    with pytest.raises(ValueError, match=r"receivers \(\.\.\., 6\)"):
        FormFactors(patches=patches)(np.zeros((4, 5)), device=device)
    with pytest.raises(ValueError, match="expected a number, 0 or more"):
        FormFactors(patches=patches, rays=-1.0)
    with pytest.raises(ValueError, match="rays"):
        FormFactors(patches=patches, rays=np.inf)
    with pytest.raises(ValueError, match="clearance"):
        PatchLight(patches=patches, clearance=np.nan)
    with pytest.raises(TypeError, match="expected Patches"):
        FormFactors(patches=None)
    with pytest.raises(TypeError, match="expected a Scene"):
        FormFactors(patches=patches, scene=patches)
    with pytest.raises(ValueError, match="no area"):
        Patches(np.zeros((1, 3, 3)))
    with pytest.raises(ValueError, match="ascend from 0"):
        Patches(np.tile(np.eye(3), (2, 1, 1)), np.array([0, 2]))
    with pytest.raises(ValueError, match="not finite"):
        Patches(np.full((1, 3, 3), np.nan))
    with pytest.raises(ValueError, match="expected integers"):
        Patches(np.eye(3)[None], np.zeros(1))
    with pytest.raises(ValueError, match="more than 0"):
        Patches.from_scene(room(1.0, 1.0, 1.0), size=0.0)
    with pytest.raises(ValueError, match="no triangles"):
        Patches.from_scene(Scene(np.zeros((0, 3, 3))), size=1.0)
    with pytest.raises(ValueError, match=r"mask \(1,\) of patches, got shape \(2,\)"):
        patches.bisected(np.zeros(2, bool))


def test_patches_of_a_scene_cover_it() -> None:
    bar = trimesh.creation.box((1.0, 1e-3, 0.2))
    ball = trimesh.creation.icosphere(5, 0.1).apply_translation((0, 1, 0))
    flat = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    scene = Scene(np.concatenate([bar.triangles, ball.triangles, flat]))
    size = 0.05
    patches = Patches.from_scene(scene, size=size)
    of_ball = np.asarray(patches.origin) >= 12
    edges = np.linalg.norm(np.roll(patches.corners, -1, axis=1) - patches.corners, axis=2)
    assert edges[~of_ball].max() <= size * (1.0 + 1e-12)
    pieces = np.bincount(np.asarray(patches.origin), patches._areas)[:12]
    np.testing.assert_allclose(pieces, bar.area_faces, rtol=1e-9)
    # 20480 triangles of the ball become few patches; the thin sides of the bar give only the patches along their
    # length.
    assert patches._areas[of_ball].sum() == pytest.approx(ball.area, rel=1e-12)
    assert np.count_nonzero(of_ball) < 2000
    assert np.count_nonzero(~of_ball) < 2500
    points, owner, weight = patches.quadrature
    np.testing.assert_allclose(np.bincount(owner, weight), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points[:, 3:], axis=1), 1.0, rtol=1e-12)
    assert np.all(np.diff(owner) >= 0)
    # On the ball, above the outlines.
    of_points = of_ball[np.searchsorted(np.asarray(patches.patch), owner)]
    away = np.linalg.norm(points[of_points, :3] - [0.0, 1.0, 0.0], axis=1)
    assert away.min() > 0.0999 * np.cos(0.02)


def test_backs_of_open_surfaces() -> None:
    box = np.asarray(trimesh.creation.box((1.0, 1.0, 1.0)).triangles)
    sheet = np.array([[[3.0, 0.0, 0.0], [4.0, 0.0, 0.0], [3.0, 1.0, 0.0]]])
    scene = Scene(np.concatenate([box, sheet]))
    assert Patches.from_scene(scene, size=2.0, both_sides=False).count == 13
    assert Patches.from_scene(scene, size=2.0).count == 14
    assert Patches.from_scene(scene, size=2.0, both_sides=True).count == 26
    assert Patches.from_scene(Scene(box[1:]), size=2.0).count == 22
    assert Patches.from_scene(Scene(box[:, ::-1]), size=2.0).count == 24
    fine = trimesh.creation.icosphere(4, 0.1)
    both = Patches.from_scene(Scene(np.asarray(fine.triangles)), size=0.05, both_sides=True)
    assert both.area.sum() == pytest.approx(2.0 * fine.area, rel=1e-12)
    np.testing.assert_allclose((both.normals * both._areas[:, None]).sum(axis=0), 0.0, atol=1e-3)


@pytest.mark.double
def test_a_fine_mesh_shines_as_a_coarse_one(device: Device) -> None:
    """A finely meshed plate and ball: outlines against the original triangles, beside them and in their shadows."""
    plate = trimesh.creation.box((1.0, 1.0, 0.1))
    ball = trimesh.creation.icosphere(3, 0.3).apply_translation((0.0, 0.0, 0.5))
    both = trimesh.util.concatenate([plate, ball])
    fine = both.subdivide_to_size(0.06)
    scene = Scene.of(fine)
    patches = Patches.from_scene(scene, size=0.2)
    exact = Patches(np.asarray(fine.triangles))
    assert len(patches.corners) < 0.7 * len(exact.corners)
    receivers = np.array([[0.5, 0.5, 0.4, -1, -1, -0.5], [0.3, -0.1, 0.06, 0, 0, 1], [0, 0, 1.5, 0.1, 0, -1]])
    receivers = np.concatenate([receivers] * 6)
    of_patches = PatchLight(patches=patches, scene=scene)(receivers, np.ones(patches.count), device=device).irradiance
    of_triangles = PatchLight(patches=exact, scene=scene)(receivers, np.ones(exact.count), device=device).irradiance
    np.testing.assert_allclose(of_patches, of_triangles, rtol=0.05)


def test_halving_leaves_the_rest_alone() -> None:
    patches = Patches.from_scene(room(1.0, 1.0, 1.0), size=1.0, both_sides=False)
    selected = np.zeros(patches.count, bool)
    selected[[1, 4]] = True
    finer = patches.bisected(selected)
    assert finer.count == patches.count + 2
    assert finer.area.sum() == pytest.approx(6.0, rel=1e-12)
    np.testing.assert_allclose(finer.area[-4:], 0.5 * patches.area[1], rtol=1e-12)
    np.testing.assert_allclose(finer.normals @ finer.normals.T, np.rint(finer.normals @ finer.normals.T), atol=1e-12)
