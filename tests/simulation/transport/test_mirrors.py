"""Lit lines in mirrors: image method, points by brute force, Alhazen's sphere; and their effect on a reading."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad as integral

from gpuvision.host import Device
from gpuvision.reference import mirrors as reference
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.mirror_surfaces import MirrorLimits, MirrorSurfaces
from gpuvision.simulation.transport.mirrors import Mirrors
from gpuvision.simulation.transport.plane_mirrors import triangle_planes
from mirror_scenes import mirrors_of, quad, sensor_view

ALBEDO, SHARE = 0.5, 0.8
MATERIALS = (
    Material(diffuse=Lambert(albedo=ALBEDO)),
    Material(diffuse=Lambert(albedo=0.0), mirror=SHARE),
)
FLOOR = quad([-0.1, -0.05, 0], [0.1, -0.05, 0], [0.1, 0.05, 0], [-0.1, 0.05, 0])


def sheet(**more: object) -> LightSheet:
    return LightSheet(**({"transport": sensor_view().transport, "power": 3.0} | more))


def before_a_wall(distance: float) -> Scene:
    """Return a floor, and a vertical mirror on it behind the line."""
    wall = quad([-0.1, -distance, 0], [0.1, -distance, 0], [0.1, -distance, 0.1], [-0.1, -distance, 0.1])
    return Scene(np.array(FLOOR + wall), np.array([0, 0, 1, 1]))


def expected_of_line(sensor: SensorView, y: float, power: float) -> np.ndarray:
    """Return the power on each sample of a diffuse line along x, on the floor at y."""
    u = sensor.project(np.array([0.0, y, 0.0]))[0]
    # Positions of the sample edges on the line.
    rays = sensor.rays(u, sensor.v_edges)
    edges = rays[:, 0] - rays[:, 2] / rays[:, 5] * rays[:, 3]
    lens = np.array(sensor.lens)

    def density(x: float) -> float:
        place = np.array([x, y, 0.0])
        cosine = lens[2] / np.linalg.norm(lens - place)
        return power / np.pi * cosine * float(sensor.aperture_solid_angle(place))

    return np.array([integral(density, a, b, epsrel=1e-13)[0] for a, b in itertools.pairwise(edges)])


def test_surfaces_are_compared_by_identity() -> None:
    """They hold arrays, whose comparison has no single truth value."""
    scene, sensor = before_a_wall(0.004), sensor_view()
    one, other = (MirrorSurfaces(sensor, scene, MATERIALS, None, MirrorLimits()) for _ in range(2))
    assert one != other
    assert len({one, other}) == 2


def test_a_plane_mirror_shows_a_second_line_at_twice_its_distance(device: Device) -> None:
    """A PSD then has the error R' D / (1 + R'): the share of the second line times its distance."""
    sensor, distance = sensor_view(12, 480), 0.004
    scene = before_a_wall(distance)
    mirrors = mirrors_of(scene, MATERIALS, device, view=sensor)
    lit = sheet().illuminate(scene, 0.0)
    seen, direct = mirrors.mirrored_exposure(lit, 0.0), mirrors.direct_exposure(lit, 0.0)
    image = expected_of_line(sensor, -2.0 * distance, SHARE * ALBEDO * 3.0)
    line = expected_of_line(sensor, 0.0, ALBEDO * 3.0)
    rounding = 1e-11 if device.has_double else 1e-4
    np.testing.assert_allclose(seen.total(), image, rtol=rounding)
    np.testing.assert_allclose(direct.total(), line, rtol=rounding)
    u, off = (sensor.project(np.array([0.0, y, 0.0]))[0] for y in (0.0, -2.0 * distance))
    both = direct + seen
    ratio = image / line
    read = both.first_moment(sensor.u_edges) / both.total()
    np.testing.assert_allclose(read, u + ratio * (off - u) / (1.0 + ratio), atol=1e-12)
    assert np.abs(read - u).min() > 1e-4


@pytest.mark.double
def test_a_mirror_of_micrometres_in_a_scene_of_metres(device: Device) -> None:
    """A mirror of 20 um shows the part of the line given by the path lengths before and after it."""
    sensor, distance, low, high = sensor_view(), 0.004, 3e-3, 3.02e-3
    wall = quad([low, -distance, 0], [high, -distance, 0], [high, -distance, 0.1], [low, -distance, 0.1])
    scene = Scene(np.concatenate([10.0 * np.array(FLOOR), wall]), np.array([0, 0, 1, 1]))
    lit = sheet(g_limits=(-0.05, 0.05)).illuminate(scene, 0.0)
    lens = np.array(sensor.lens)
    share = (lens[1] + distance) / (lens[1] + 2.0 * distance)

    def density(x: float) -> float:
        image = np.array([x, -2.0 * distance, 0.0])
        cosine = lens[2] / np.linalg.norm(lens - image)
        return SHARE * ALBEDO * 3.0 / np.pi * cosine * float(sensor.aperture_solid_angle(image))

    expected = integral(density, low / share, high / share)[0]
    seen = mirrors_of(scene, MATERIALS, device, view=sensor).mirrored_exposure(lit, 0.0)
    # Without double precision the corners have rounding errors relative to 1 m.
    assert seen.power.sum() == pytest.approx(expected, rel=1e-9 if device.has_double else 0.05)


@pytest.mark.double
def test_a_mirror_seen_at_89_99_degrees(device: Device) -> None:
    """A mirror 30 um below the line; lens and line are nearly in its plane."""
    sensor, height = sensor_view(12, 480), 3e-5
    lens, point = np.array(sensor.lens), np.zeros(3)
    along = (lens - point) / np.linalg.norm(lens - point)
    up = np.cross([1.0, 0.0, 0.0], along)
    up *= np.sign(up[2])
    below = point - height * up
    one, two = np.array([1.0, 0.0, 0.0]), along
    mirror = [below + a * one + b * two for a, b in ((-0.3, 0.001), (0.3, 0.001), (0.3, 0.16), (-0.3, 0.16))]
    scene = Scene(np.array(quad(*mirror)), np.array([1, 1]))
    line = LitLine(np.array([[[-5e-3, 0.0, 0.0], [5e-3, 0.0, 0.0]]]), up[None], np.zeros(1, int), np.array([3.0]))
    normal = (up + along) / np.sqrt(2.0)
    line = line._replace(normals=normal[None])
    materials = (MATERIALS[0], Material(diffuse=Lambert(albedo=ALBEDO), mirror=SHARE / 2.0))

    def density(x: float) -> float:
        place = np.array([x, 0.0, 0.0])
        image = place - 2.0 * height * up
        spot = lens + 0.5 * (image - lens)
        cosine = normal @ (spot - place) / np.linalg.norm(spot - place)
        return SHARE / 2.0 * ALBEDO * 3.0 / np.pi * cosine * float(sensor.aperture_solid_angle(image))

    seen = mirrors_of(scene, materials, device, view=sensor).mirrored_exposure(line, 0.0)
    assert height / np.linalg.norm(lens - point) < 2e-4
    assert seen.power.sum() == pytest.approx(integral(density, -5e-3, 5e-3)[0], rel=1e-8 if device.has_double else 1e-2)


def test_direct_light_is_what_the_direct_path_says(device: Device, rng: np.random.Generator) -> None:
    heap = trimesh.util.concatenate(
        [
            trimesh.creation.box((0.006, 0.006, 0.01)).apply_translation([*rng.uniform(-0.01, 0.01, 2), 0.0])
            for _ in range(20)
        ]
    )
    scene = Scene(np.concatenate([np.array(FLOOR), np.array(heap.triangles)]))
    # The line on the floor is not imaged onto the edge of a bin.
    sensor, light = sensor_view(120, 241), sheet(source=(0.0, 0.2))
    theirs = DirectLight(view=sensor, scene=scene, materials=MATERIALS, sheet=light, device=device).exposures(1e-4)
    ours = mirrors_of(scene, MATERIALS, device, view=sensor).direct_exposure(light.illuminate(scene, 1e-4), 1e-4)
    np.testing.assert_allclose(ours.power, theirs["direct"].power, atol=1e-6 * ours.power.max())
    np.testing.assert_allclose(ours.moment, theirs["direct"].moment, atol=1e-6 * np.abs(ours.moment).max())


def mirrored_points(scene: Scene, lit: LitLine, sensor: SensorView, device: Device, count: int) -> Exposure:
    """Return the exposure by points of lines: each point with each mirror triangle, both path segments by rays."""
    share = (np.arange(count) + 0.5) / count
    points = lit.ends[:, :1] + share[:, None] * (lit.ends[:, 1:] - lit.ends[:, :1])
    points = points.reshape(-1, 3)
    normals, each = np.repeat(lit.normals, count, axis=0), np.repeat(lit.power * lit.lengths / count, count)
    lens, total = np.array(sensor.lens), sensor.dark()
    for corners in scene.corners[scene.material == 1]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        up, lens_up = (points - corners[0]) @ normal, (lens - corners[0]) @ normal
        image = points - 2.0 * up[:, None] * normal
        spot = lens + (lens_up / (lens_up + up))[:, None] * (image - lens)
        edges = np.roll(corners, -1, axis=0) - corners
        inside = [np.cross(edges[n], spot - corners[n]) @ normal > 0.0 for n in range(3)]
        good = np.all(inside, axis=0) & (up * lens_up > 0.0)
        towards = spot - points
        cosine = np.sum(towards * normals, axis=1) / np.linalg.norm(towards, axis=1)
        good &= cosine > 0.0
        for end in (points, np.broadcast_to(lens, points.shape)):
            path = np.ascontiguousarray(np.hstack([spot, end]))
            good &= AnyHit(scene=scene, clearance=1e-9)(path, device=device).occluded == 0
        power = SHARE * ALBEDO / np.pi * each * cosine * sensor.aperture_solid_angle(image)
        uv = sensor.project(image[good])
        total = total + sensor.deposit_spots(uv[:, 0], uv[:, 1], power[good])
    return total


@pytest.mark.double
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_plane_mirrors_show_what_points_by_brute_force_say(device: Device, seed: int) -> None:
    """Facets before a line, boxes in front of the line and of the facets."""
    rng = np.random.default_rng(seed)
    facets = []
    for x in np.linspace(-0.02, 0.02, 9):
        middle = np.array([x, -0.012, 0.008])
        facets.append(middle + rng.normal(0.0, [4e-3, 5e-4, 4e-3], (3, 3)))
    boxes = [
        trimesh.creation.box((0.0012, 0.0012, 0.006)).apply_translation([x, rng.uniform(-0.01, 0.02), 0.003])
        for x in rng.uniform(-0.02, 0.02, 25)
    ]
    dull = np.concatenate([FLOOR, *(np.array(box.triangles) for box in boxes)])
    scene = Scene(np.concatenate([facets, dull]), np.r_[np.ones(len(facets), int), np.zeros(len(dull), int)])
    sensor = sensor_view(40, 60)
    lit = sheet(g_limits=(-0.022, 0.022)).illuminate(scene, 0.0)
    ours = mirrors_of(scene, MATERIALS, device, view=sensor).mirrored_exposure(lit, 0.0)
    theirs = mirrored_points(scene, lit, sensor, device, 3000)
    assert ours.power.sum() > 0.0
    assert ours.power.sum() == pytest.approx(theirs.power.sum(), rel=2e-3)
    # Points on both sides of an edge: the longest lit segments have 3000 points.
    assert np.abs(ours.power - theirs.power).max() < 2e-2 * ours.power.max()
    u = [each.first_moment(sensor.u_edges).sum() / each.power.sum() for each in (ours, theirs)]
    assert abs(u[0] - u[1]) < 1e-6


def ball_scene(fineness: int, radius: float, middle: np.ndarray) -> Scene:
    ball = np.array(trimesh.creation.icosphere(fineness).triangles)
    ball *= radius / np.linalg.norm(ball, axis=2, keepdims=True)
    return Scene(np.concatenate([FLOOR, ball + middle]), np.r_[0, 0, np.ones(len(ball), int)])


@pytest.mark.double
def test_a_ball_shows_a_line_as_alhazen_says(device: Device) -> None:
    radius, middle = 5e-3, np.array([0.0, -0.007, 5.0e-3])
    sensor, light = sensor_view(240, 480), sheet(g_limits=(-0.015, 0.015))
    x = (np.arange(1500) + 0.5) / 1500 * 0.03 - 0.015
    lens = np.array(sensor.lens)
    spots, power = np.empty((len(x), 3)), np.empty(len(x))
    for n, at in enumerate(x):
        point = np.array([at, 0.0, 0.0])
        spot, density = reference.reflect_in_sphere((point - middle) / radius, (lens - middle) / radius)
        spots[n] = middle + radius * spot
        cosine = spots[n, 2] / np.linalg.norm(spots[n] - point)
        square = np.sum((lens - spots[n]) ** 2) * density / radius**2
        power[n] = SHARE * ALBEDO * 3.0 / np.pi * cosine * 2e-5 * sensor.aperture_solid_angle(spots[n]) * square
    uv = sensor.project(spots)
    expected = sensor.deposit_spots(uv[:, 0], uv[:, 1], power)
    middle_of_it = expected.first_moment(sensor.u_edges).sum() / expected.power.sum()
    for fineness in (3, 4):
        scene = ball_scene(fineness, radius, middle)
        mirrors = mirrors_of(scene, MATERIALS, device, view=sensor, steps_per_sample=4.0)
        # Direct light of the line: the ball must not occlude it.
        ours = mirrors.mirrored_exposure(light.illuminate(scene, 0.0), 0.0)
        assert ours.power.sum() == pytest.approx(expected.power.sum(), rel=2e-2 / 4.0 ** (fineness - 3))
        assert abs(ours.first_moment(sensor.u_edges).sum() / ours.power.sum() - middle_of_it) < 1e-7
        v = [each.total() @ sensor.v_centres / each.power.sum() for each in (ours, expected)]
        assert abs(v[0] - v[1]) < 2e-6


@pytest.mark.double
def test_a_curved_mirror_in_steps_converges_to_the_second_order(device: Device) -> None:
    scene = ball_scene(3, 5e-3, np.array([0.0, -0.007, 5.0e-3]))
    lit = sheet(g_limits=(-0.015, 0.015)).illuminate(scene, 0.0)
    totals = [
        mirrors_of(scene, MATERIALS, device, view=sensor_view(24, 24), steps_per_sample=steps)
        .mirrored_exposure(lit, 0.0)
        .power.sum()
        for steps in (1.0, 2.0, 64.0)
    ]
    assert abs(totals[0] - totals[2]) / abs(totals[1] - totals[2]) > 3.0
    assert abs(totals[1] / totals[2] - 1.0) < 1e-3


@pytest.mark.double
def test_a_mirror_with_leaning_normals_is_as_a_plane_one(device: Device) -> None:
    """Lines whose ends are within samples: each step of the curved mirror's line has its place and its length."""
    sensor, scene = sensor_view(12, 24), before_a_wall(0.004)
    normals = np.repeat(triangle_planes(scene.corners)[:, None, :3], 3, axis=1)
    normals[:, 0, 0] += 1.5e-6
    lit = sheet(g_limits=(-0.0131, 0.0043)).illuminate(scene, 0.0)
    flat, curved = (
        mirrors_of(scene, MATERIALS, device, view=sensor, normals=each).mirrored_exposure(lit, 0.0)
        for each in (None, normals)
    )
    total = flat.total()
    assert np.count_nonzero(total) < 12
    # Steps of half a sample: the power along a step varies by its square.
    np.testing.assert_allclose(curved.total(), total, rtol=2e-4, atol=1e-4 * total.max())
    scale = np.abs(flat.first_moment(sensor.u_edges)).max()
    np.testing.assert_allclose(
        curved.first_moment(sensor.u_edges), flat.first_moment(sensor.u_edges), atol=2e-4 * scale
    )


def test_a_hollow_mirror_does_not_hide_itself(device: Device) -> None:
    """A line over a bowl: facets protrude from the smooth surface, but do not occlude, for any mesh size."""
    radius, totals = 0.08, []
    for fineness in (3, 5):
        ball = np.array(trimesh.creation.icosphere(fineness).triangles)
        bowl = radius * ball / np.linalg.norm(ball, axis=2, keepdims=True) + [0.0, 0.0, radius]
        bowl = bowl[bowl[..., 2].max(axis=1) < 0.008]
        plate = [[[-6e-3, -1e-5, 0.012], [6e-3, -1e-5, 0.012], [0.0, 1e-5, 0.012]]]
        normals = np.concatenate([np.zeros((1, 3, 3)), ([0.0, 0.0, radius] - bowl) / radius])
        scene = Scene(np.concatenate([plate, bowl]), np.r_[0, np.ones(len(bowl), int)])
        ends = np.array([[[-5e-3, 0.0, 0.012], [5e-3, 0.0, 0.012]]])
        line = LitLine(ends, np.array([[0.0, 0.0, -1.0]]), np.zeros(1, int), np.array([3.0]))
        totals.append(mirrors_of(scene, MATERIALS, device, normals=normals).mirrored_exposure(line, 0.0).power.sum())
    assert totals[0] == pytest.approx(totals[1], rel=2e-3)
    assert totals[0] > 0.0


def test_what_stands_before_a_curved_mirror_hides_its_image(device: Device) -> None:
    scene = ball_scene(3, 5e-3, np.array([0.0, -0.007, 5.0e-3]))
    lit = sheet(g_limits=(-0.015, 0.015)).illuminate(scene, 0.0)
    complete = mirrors_of(scene, MATERIALS, device).mirrored_exposure(lit, 0.0).power.sum()
    for screen in (
        quad([-0.05, -0.0005, 0], [0.05, -0.0005, 0], [0.05, -0.0005, 0.003], [-0.05, -0.0005, 0.003]),
        quad([-0.05, 0.03, 0.03], [0.05, 0.03, 0.03], [0.05, 0.03, 0.09], [-0.05, 0.03, 0.09]),
    ):
        hidden = Scene(np.concatenate([scene.corners, screen]), np.append(scene.material, [0, 0]))
        assert mirrors_of(hidden, MATERIALS, device).mirrored_exposure(lit, 0.0).power.sum() < 1e-3 * complete


def test_an_image_on_an_edge_counts_once(device: Device) -> None:
    """A cylinder along x whose edge shows a line: lens, edge and line lie in one plane."""
    sensor = sensor_view(24, 24)
    lens, middle = np.array(sensor.lens), np.array([0.0, -0.01, 0.005])
    back = (lens - middle) * [0.0, 1.0, 1.0] / np.linalg.norm((lens - middle)[1:])
    turns, sideways = np.linspace(-0.6, 0.6, 5), np.cross([1.0, 0.0, 0.0], back)
    ring = np.cos(turns)[:, None] * back + np.sin(turns)[:, None] * sideways
    rows, normals = [], []
    for a, b in itertools.pairwise(range(5)):
        left, right = ([middle + [x, 0, 0] + 5e-3 * ring[n] for n in (a, b)] for x in (-0.05, 0.05))
        rows += quad(left[0], right[0], right[1], left[1])
        normals += quad(ring[a], ring[a], ring[b], ring[b])
    scene = Scene(np.array(rows), np.ones(8, int))
    images = mirrors_of(scene, MATERIALS, device, view=sensor, normals=np.array(normals))
    points = np.tile(middle + 0.05 * back, (40, 1))
    points[:, 0] = np.linspace(-0.02, 0.02, 40)
    points = np.hstack([points, np.tile([1e-4, 0.0, 0.0], (40, 1))])
    row, spot, *_ = images._images(points, lens)
    np.testing.assert_array_equal(row, np.arange(40))
    np.testing.assert_allclose((spot - middle) @ back, 5e-3, rtol=1e-6 if device.has_double else 1e-4)
    raw = images._points(8)(points, lens, device=device) if device.has_double else None
    assert raw is None or np.all(raw.image_count == 2)


def test_more_images_than_there_is_room_for_are_sought_again(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    balls = [np.array(trimesh.creation.icosphere(2).triangles) * 1e-3 + [x, -0.007, 2e-3] for x in np.arange(9) * 3e-3]
    corners = np.concatenate([FLOOR, *balls])
    scene = Scene(corners, np.r_[0, 0, np.ones(len(corners) - 2, int)])
    lit = sheet(g_limits=(-0.005, 0.03)).illuminate(scene, 0.0)
    plenty = mirrors_of(scene, MATERIALS, device).mirrored_exposure(lit, 0.0)
    monkeypatch.setattr("gpuvision.simulation.transport.mirrors._FIRST_IMAGES", 2)
    np.testing.assert_allclose(
        mirrors_of(scene, MATERIALS, device).mirrored_exposure(lit, 0.0).power, plenty.power, rtol=1e-12
    )
    assert plenty.power.sum() > 0.0


def test_light_that_meets_a_mirror_head_on_comes_back_and_is_lost(device: Device) -> None:
    """The reflected light stays in the plane of the sheet and hits no surface; all results are finite."""
    mirror = quad([-0.1, -0.05, 0], [0.1, -0.05, 0], [0.1, 0.05, 0], [-0.1, 0.05, 0])
    scene = Scene(np.array(mirror), np.array([1, 1]))
    both = (MATERIALS[0], Material(diffuse=Lambert(albedo=0.2), mirror=0.7))
    mirrors, light = mirrors_of(scene, both, device), sheet()
    lit = light.illuminate(scene, 0.0)
    assert not len(mirrors.reflected_lines(lit, light, 0.0).power)
    exposure = mirrors.exposure(lit, 0.0, light)
    assert not exposure.power.any()
    assert np.isfinite(exposure.moment).all()


def test_a_lens_that_looks_into_a_mirror_head_on(device: Device) -> None:
    """A mirror perpendicular to the ray of the lens: the image is behind it, with the brightness of its path length."""
    sensor, width = sensor_view(24, 24), 2e-3
    lens, axis = np.array(sensor.lens), np.array(sensor.axis)
    one = np.array([1.0, 0.0, 0.0])
    two = np.cross(axis, one)
    # Beyond the sheet; the line lies 2 mm beside the axis and faces the mirror.
    middle = lens + 0.2 * axis
    mirror = [middle + 0.05 * (a * one + b * two) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    scene = Scene(np.array(quad(*mirror)), np.array([1, 1]))
    place = lens + 0.17 * axis + width * two
    line = LitLine(
        np.stack([place - 1e-3 * one, place + 1e-3 * one])[None], axis[None], np.zeros(1, int), np.array([3.0])
    )
    materials = (MATERIALS[0], Material(diffuse=Lambert(albedo=ALBEDO), mirror=SHARE / 2.0))
    seen = mirrors_of(scene, materials, device, view=sensor).mirrored_exposure(line, 0.0)
    image = place + 0.06 * axis
    towards = image - lens
    cosine = towards @ axis / np.linalg.norm(towards)
    expected = SHARE / 2.0 * ALBEDO / np.pi * 3.0 * 2e-3 * cosine * float(sensor.aperture_solid_angle(image))
    assert seen.power.sum() == pytest.approx(expected, rel=1e-4)


def test_exposure_is_the_sum_of_its_ways(device: Device) -> None:
    slope = quad([-0.01, -0.005, 0.0], [0.01, -0.005, 0.0], [0.01, 0.005, 0.01], [-0.01, 0.005, 0.01])
    wall = quad([-0.05, -0.012, 0], [0.05, -0.012, 0], [0.05, -0.012, 0.05], [-0.05, -0.012, 0.05])
    scene = Scene(np.array(slope + wall), np.array([1, 1, 0, 0]))
    mirrors, light = mirrors_of(scene, MATERIALS, device), sheet()
    lit = light.illuminate(scene, 0.0)
    reflected = mirrors.reflected_lines(lit, light, 0.0)
    parts = (
        mirrors.mirrored_exposure(lit, 0.0)
        + mirrors.direct_exposure(reflected, 0.0)
        + mirrors.mirrored_exposure(reflected, 0.0)
    )
    complete = mirrors.exposure(lit, 0.0, sheet=light)
    assert mirrors.direct_exposure(reflected, 0.0).power.sum() > 0.0
    np.testing.assert_array_equal(complete.power, parts.power)
    matt = mirrors_of(scene, (MATERIALS[0],) * 2, device)
    assert not matt.has_mirrors
    assert not matt.exposure(lit, 0.0, sheet=light).power.any()
    assert mirrors_of(scene, MATERIALS, device).has_mirrors


def test_what_it_does_not_take() -> None:
    scene = before_a_wall(0.01)
    with pytest.raises(ValueError, match="materials 0 to 1"):
        Mirrors(view=sensor_view(), scene=scene, materials=MATERIALS[:1])
    with pytest.raises(ValueError, match="normals"):
        Mirrors(view=sensor_view(), scene=scene, materials=MATERIALS, normals=np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="steps_per_sample"):
        Mirrors(view=sensor_view(), scene=scene, materials=MATERIALS, steps_per_sample=0.0)
