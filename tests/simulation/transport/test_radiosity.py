"""Radiosity in rooms and boxes: energy, white walls, occlusion, solvers, graded patches, and inputs."""

from __future__ import annotations

import copy
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.patches import Patches
from gpuvision.simulation.transport.radiosity import Radiosity, refine_corners


def room(*extents: float, lid: bool = False) -> Scene:
    """Return the inside of a box around the origin; the lid can be another material."""
    box = trimesh.creation.box(extents)
    box.invert()
    up = np.asarray(box.triangles)[:, :, 2].min(axis=1) > 0.0
    return Scene(np.asarray(box.triangles), (up & lid).astype(np.int32))


def stripe(*, power: float = 1.0) -> LitSegments:
    """Return a line on the floor of a room of 1 x 0.8 x 0.6, from wall to wall, with a diffuse power."""
    return LitSegments([[[-0.5, 0.1, -0.3], [0.5, 0.1, -0.3]]], [[0.0, 0.0, 1.0]], [power])


def solved(size: float, albedo: Any, device: Device, *, lid: bool = False) -> Radiosity:
    scene = room(1.0, 0.8, 0.6, lid=lid)
    solution = Radiosity.from_scene(scene, albedo, size=size, both_sides=False, device=device)
    return Radiosity(patches=solution.patches, albedo=solution.albedo, device=device)


@pytest.mark.double
def test_no_light_is_lost_in_a_closed_box(device: Device) -> None:
    """The first arriving power equals the emitted power to rounding; the absorbed power equals it to second order."""
    albedo, errors = 0.9, []
    for size in (0.5, 0.25, 0.125):
        box = solved(size, [albedo], device)
        arrival = box.direct_irradiance(stripe(power=2.0))
        assert arrival @ box.patches.area == pytest.approx(2.0, rel=1e-12)
        exitance = box.solve(arrival)
        absorbed = exitance @ box.patches.area * (1.0 - albedo) / albedo
        errors.append(abs(absorbed / 2.0 - 1.0))
        np.testing.assert_allclose(box.form_factors.sum(axis=1), 1.0, rtol=1e-12)
    assert errors[0] < 4e-3
    assert errors[-1] < 1e-3


def test_white_walls_send_everything_out(device: Device) -> None:
    """Albedo 1 under a black lid: the lid absorbs all light, after any number of bounces."""
    errors = []
    for size in (0.5, 0.25):
        box = solved(size, [1.0, 0.0], device, lid=True)
        arrival = box.direct_irradiance(stripe())
        exitance = box.solve(arrival)
        on_the_lid = (arrival + box.form_factors @ exitance)[box.albedo == 0.0] @ box.patches.area[box.albedo == 0.0]
        errors.append(abs(on_the_lid - 1.0))
        assert np.all(exitance[box.albedo == 0.0] == 0.0)
    assert errors[0] < 5e-3
    assert errors[1] < 2e-3


def test_white_walls_without_a_way_out_are_refused(device: Device) -> None:
    for dense in (4096, 0):
        box = solved(0.5, [1.0], device)
        closed = Radiosity(patches=box.patches, albedo=box.albedo, device=device, max_dense=dense)
        with pytest.raises(ValueError, match="no steady state"):
            closed.solve(np.ones(box.patches.count))


def test_solved_is_what_the_series_tends_to(device: Device) -> None:
    box = solved(0.5, [0.6], device)
    arrival = box.direct_irradiance(stripe())
    series, bounce = np.zeros_like(arrival), 0.6 * arrival
    for _ in range(80):
        series, bounce = series + bounce, 0.6 * (box.form_factors @ bounce)
    np.testing.assert_allclose(box.solve(arrival), series, rtol=1e-12)


def test_both_ways_of_solving_agree(device: Device) -> None:
    box = solved(0.3, [0.95], device)
    iterated = Radiosity(patches=box.patches, albedo=box.albedo, device=device, max_dense=0)
    arrival = box.direct_irradiance(stripe())
    np.testing.assert_allclose(iterated.solve(arrival), box.solve(arrival), rtol=3e-5)


@pytest.mark.double
def test_arrival_is_the_mean_over_patches(device: Device) -> None:
    """Against receivers all over each patch with the closed form of the lines; also near the ends of the line."""
    box, lit = solved(0.5, [0.5], device), stripe()
    inside = box.patches
    for _ in range(8):
        inside = inside.bisected(np.ones(inside.count, bool))
    places = np.concatenate([inside.corners.mean(axis=1), inside.normals], axis=1)
    light = LineIrradiance(segments=lit)(places, device=device).irradiance
    # The patch of a piece: the patch whose plane and corners contain it.
    owner = _owners(box.patches.corners, places[:, :3])
    mean = np.bincount(owner, light * inside.area) / box.patches.area
    near_line = np.abs(np.abs(box.patches.corners[:, :, 0]).min(axis=1) - 0.5) < 1e-9
    arrival = box.direct_irradiance(lit)
    np.testing.assert_allclose(arrival[~near_line], mean[~near_line], rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(arrival[near_line], mean[near_line], rtol=0.05, atol=1e-4)


@pytest.mark.double
def test_many_short_segments_are_as_one(device: Device) -> None:
    """A line in 2000 pieces, as by a fine mesh, sends the same power to every patch."""
    box = solved(0.3, [0.5], device)
    cuts = np.linspace(-0.5, 0.5, 2001)
    ends = np.zeros((2000, 2, 3))
    ends[:, 0, 0], ends[:, 1, 0], ends[:, :, 1], ends[:, :, 2] = cuts[:-1], cuts[1:], 0.1, -0.3
    pieces = LitSegments(ends, np.tile([0.0, 0.0, 1.0], (2000, 1)), np.ones(2000))
    expected, arrived = box.direct_irradiance(stripe()), box.direct_irradiance(pieces)
    assert arrived @ box.patches.area == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(arrived, expected, atol=0.02 * expected.max())


@pytest.mark.double
@pytest.mark.parametrize("has_double", [False, True])
def test_single_precision_serves_where_doubles_are_slow_or_missing(device: Device, has_double: bool) -> None:
    without = copy.copy(device)
    without.has_double, without.has_fast_double = has_double, False
    double = solved(0.3, [0.9], device)
    single = Radiosity(patches=double.patches, albedo=double.albedo, device=without)
    iterated = Radiosity(patches=double.patches, albedo=double.albedo, device=without, max_dense=0)
    arrival = double.direct_irradiance(stripe())
    assert np.abs(single.form_factors - double.form_factors).max() > 1e-12  # computed in single
    np.testing.assert_allclose(single.direct_irradiance(stripe()), arrival, atol=1e-5 * arrival.max())
    exact = double.solve(arrival)
    np.testing.assert_allclose(single.solve(arrival), exact, rtol=1e-4)
    np.testing.assert_allclose(iterated.solve(arrival), exact, rtol=1e-4)


def _owners(corners: np.ndarray, places: np.ndarray) -> np.ndarray:
    a, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(one, two)
    square = np.sum(normal * normal, axis=1)
    to = places[:, None] - a
    u = np.sum(np.cross(to, two) * normal, axis=2) / square
    v = np.sum(np.cross(one, to) * normal, axis=2) / square
    off = np.abs(np.sum(to * normal, axis=2)) / np.sqrt(square)
    outside = np.maximum(np.maximum(-u, -v), u + v - 1.0)
    return np.asarray(np.argmin(np.maximum(outside, 0.0) + off, axis=1))


@pytest.mark.double  # the faces of the wall are 1 um apart
def test_light_beside_a_screen(device: Device) -> None:
    """A wall across the room keeps the light on one side, except for rays along its seams."""
    scene = room(1.0, 0.8, 0.6)
    screen = np.array([[0.0, -0.4, -0.3], [0.0, 0.4, -0.3], [0.0, 0.4, 0.3], [0.0, -0.4, 0.3]])
    both = np.concatenate([screen[[[0, 1, 2], [0, 2, 3]]], screen[[[0, 2, 1], [0, 3, 2]]] + [1e-6, 0.0, 0.0]])
    lit = LitSegments([[[0.1, 0.1, -0.3], [0.5, 0.1, -0.3]]], [[0.0, 0.0, 1.0]], [1.0])
    shut = Radiosity.from_scene(Scene(np.concatenate([scene.corners, both])), [0.8], size=0.4, device=device)
    exitance = shut.solve(shut.direct_irradiance(lit))
    left = shut.patches.corners[:, :, 0].max(axis=1) <= 0.0
    right = shut.patches.corners[:, :, 0].min(axis=1) >= 0.0
    assert exitance[left].max() < 1e-6 * exitance[right].max()


def test_what_a_body_stands_on_is_not_lit(device: Device) -> None:
    """Partly covered patches conserve light: the uncovered surfaces absorb all of it."""
    part = trimesh.creation.box((0.3, 0.3, 0.3)).apply_translation((0.05, -0.1, -0.15))
    scene = Scene(np.concatenate([room(1.0, 0.8, 0.6).corners, part.triangles]))
    albedo = 0.9
    box = Radiosity.from_scene(scene, [albedo], size=0.2, both_sides=False, device=device)
    arrival = box.direct_irradiance(stripe())
    free = box._surface.area
    assert arrival @ free == pytest.approx(1.0, rel=3e-3)
    absorbed = box.solve(arrival) @ free * (1.0 - albedo) / albedo
    assert absorbed == pytest.approx(1.0, rel=1e-2)
    assert box.patches.area.sum() - free.sum() == pytest.approx(0.3 * 0.3, rel=0.3)


def test_patches_in_corners_are_graded(device: Device) -> None:
    patches = Patches.from_scene(room(1.0, 0.8, 0.6), size=0.5, both_sides=False)
    finer = refine_corners(patches, 3, device=device)
    assert finer.area.sum() == pytest.approx(patches.area.sum(), rel=1e-12)
    assert patches.count < finer.count < 8 * patches.count
    small = finer.area < 0.3 * patches.area.min()
    centres = np.abs(finer.corners.mean(axis=1)) * 2.0 / [1.0, 0.8, 0.6]
    # Distance from the nearest edge of the room: the largest coordinate belongs to the wall, the second largest to the
    # edge.
    from_edge = 1.0 - np.sort(centres, axis=1)[:, 1]
    assert from_edge[small].mean() < 0.6 * from_edge[~small].mean()


@pytest.mark.slow
@pytest.mark.double
def test_graded_patches_in_a_groove(device: Device) -> None:
    """Line across a groove of 90 degrees: the light of all further bounces, integrated along the groove.

    This integral is the light in a groove that is lit evenly, a one-dimensional equation with the closed kernel
    a b / (2 (a^2 + b^2)^(3/2)), solved with nodes that are graded towards the edge.
    """
    width, length, albedo = 0.02, 0.08, 0.8
    side = width / np.sqrt(2.0)
    edge = [(0.0, -length / 2, 0.0), (0.0, length / 2, 0.0)]
    left, right = ([(x, y, side) for y in (-length / 2, length / 2)] for x in (-side, side))
    quads = [(*edge, left[1], left[0]), (edge[0], right[0], right[1], edge[1])]
    scene = Scene(np.array([each for a, b, c, d in quads for each in ((a, b, c), (a, c, d))]))
    node, weight = np.polynomial.legendre.leggauss(200)
    s = 0.5 + 0.5 * node
    b, share = width * s**4, 0.5 * weight * 4.0 * width * s**3

    def kernel(at: np.ndarray) -> Any:
        return 0.5 * at[:, None] * b / (at[:, None] ** 2 + b**2) ** 1.5 * share

    exitance = np.linalg.solve(np.eye(len(b)) - albedo * kernel(b), albedo * kernel(b).sum(axis=1))
    at = np.array([0.5e-3, 1e-3, 2e-3])
    expected = kernel(at) @ exitance
    normals = np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]) / np.sqrt(2.0)
    lit = LitSegments([[[0, 0, 0], [-side, 0, side]], [[0, 0, 0], [side, 0, side]]], normals, [1.0, 1.0])
    y = np.sinh(np.linspace(-7.0, 7.0, 151))
    y *= 0.5 * length / y.max()
    receivers = np.zeros((len(at), len(y), 6))
    receivers[..., 0], receivers[..., 2] = -at[:, None] / np.sqrt(2.0), at[:, None] / np.sqrt(2.0)
    receivers[..., 1], receivers[..., 3:] = y, normals[0]
    worst = {}
    for graded in (False, True):
        groove = Radiosity.from_scene(scene, [albedo], size=5e-3, graded=graded, both_sides=False, device=device)
        light = groove.irradiance(receivers, groove.solve(groove.direct_irradiance(lit))).irradiance
        found = np.trapezoid(np.asarray(light, np.float64), y, axis=1)
        worst[graded] = np.abs(found / expected - 1.0).max()
    assert worst[False] > 0.15
    assert worst[True] < 0.03


@pytest.mark.double
def test_materials_and_receivers(device: Device) -> None:
    scene = room(1.0, 0.8, 0.6, lid=True)
    box = Radiosity.from_scene(scene, [0.7, 0.2], size=0.5, refinements=1, both_sides=True, device=device)
    assert set(box.albedo) == {0.7, 0.2}
    outside = np.sum(box.patches.normals * box.patches.corners.mean(axis=1), axis=1) > 0.0
    assert outside.mean() == pytest.approx(0.5, abs=0.2)
    exitance = box.solve(box.direct_irradiance(stripe()))
    # All light stays inside.
    np.testing.assert_allclose(exitance[outside], 0.0, atol=1e-12)
    receivers = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    twice = box.irradiance(receivers, exitance)
    single = box.irradiance(receivers.astype(np.float32), exitance)
    assert twice.irradiance[0] != twice.irradiance[1]
    np.testing.assert_allclose(single.irradiance, twice.irradiance, rtol=1e-4)
    assert single.irradiance.dtype == np.float32
    least = 0.5 * float(exitance.max())
    some = box.irradiance(receivers, exitance, min_exitance=least)
    assert np.all(some.irradiance < twice.irradiance)
    assert np.all(some.irradiance > twice.irradiance - least)


def test_no_light_at_all(device: Device) -> None:
    box = solved(0.5, [0.5], device)
    dark = LitSegments(np.zeros((1, 2, 3)), [[0.0, 0.0, 1.0]], [1.0])
    np.testing.assert_array_equal(box.solve(box.direct_irradiance(dark)), 0.0)


def test_what_is_refused() -> None:
    patches = Patches.from_scene(room(1.0, 1.0, 1.0), size=1.0, both_sides=False)
    with pytest.raises(TypeError, match="expected Patches"):
        Radiosity(patches=None, albedo=[0.5])
    with pytest.raises(ValueError, match=r"expected \(\d+,\)"):
        Radiosity(patches=patches, albedo=np.zeros(3))
    with pytest.raises(ValueError, match="outside 0 to 1"):
        Radiosity(patches=patches, albedo=np.full(patches.count, 1.1))
    with pytest.raises(ValueError, match="takes finite irradiances"):
        Radiosity(patches=patches, albedo=np.zeros(patches.count)).solve(np.zeros(2))
    with pytest.raises(ValueError, match="1 albedos for 2 materials"):
        Radiosity.from_scene(room(1.0, 1.0, 1.0, lid=True), [0.5], size=1.0)


@pytest.mark.double
def test_convergence_of_light_in_a_room(device: Device) -> None:
    """At points of a room with grey walls, errors halve at least when the patch size is halved."""
    receivers = np.array([[0.2, 0.1, 0.0, 0.3, 0.2, 0.9], [-0.1, -0.2, 0.1, 1.0, 0.0, 0.0], [0, 0.3, -0.1, 0, -1, 1]])
    values = []
    for size in (0.5, 0.25, 0.125):
        box = solved(size, [0.5], device)
        values.append(box.irradiance(receivers, box.solve(box.direct_irradiance(stripe()))).irradiance)
    steps = [np.abs(fine - coarse).max() for coarse, fine in pairwise(values)]
    assert steps[0] > 2.0 * steps[1]
    assert steps[1] < 5e-3 * values[-1].min()
