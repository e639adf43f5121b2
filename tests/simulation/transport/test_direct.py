"""DirectLight: power, rays against every triangle, ground truth, materials and causes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference.rays import occluded
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.reflectance import Ggx, Lambert, OrenNayar, Phong, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import UNIFORM, UNIFORM_UNOCCLUDED, UNOCCLUDED
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet
from gpuvision.simulation.transport.line_parts import LensVisibility
from gpuvision.simulation.transport.specular_highlights import find_specular_highlights
from gpuvision.status import Status
from light_of_a_sheet import GREY, TRANSPORT, light_of, plate, quad, sensor_view, two_plates, u_of

# ---- power, bins, samples ----------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [None, Lens(k1=-900.0, centre=(1e-4, -2e-4))])
@pytest.mark.parametrize("sigma", [0.0, 1e-4])
def test_power_of_a_plate(device: Device, lens: Lens | None, sigma: float) -> None:
    """Each sample gets the light of its part of the line through the lens, at the position of the line."""
    seen_by = sensor_view(lens=lens, samples=16)
    light = light_of(plate(z=3e-3), seen_by=seen_by, power=2.0, sigma=sigma, sub_sheets=5, device=device)
    direct = light.exposures(0.02)["direct"]
    node, weight = np.polynomial.legendre.leggauss(40)
    G = np.linspace(-0.05, 0.05, 200_001)
    uv = seen_by.project(np.stack([G, np.full_like(G, 0.02), np.full_like(G, 3e-3)], axis=-1), 0.02)
    for sample, (low, high) in enumerate(zip(seen_by.v_edges, seen_by.v_edges[1:], strict=False)):
        start, end = np.interp([low, high], uv[:, 1], G)
        at = 0.5 * (start + end) + 0.5 * (end - start) * node
        points = np.stack([at, np.full_like(at, 0.02), np.full_like(at, 3e-3)], axis=-1)
        eye = seen_by.lens_at(0.02) - points
        sent = (
            2.0 * 0.5 / math.pi * eye[:, 2] / np.linalg.norm(eye, axis=1) * seen_by.aperture_solid_angle(points, 0.02)
        )
        sent *= 0.5 * (end - start) * weight
        # The interpolation of the reference is accurate to 1e-8; perspective distorts a Gaussian.
        rough = 1e-7 if sigma == 0.0 else 1e-5
        assert direct.total()[sample] == pytest.approx(sent.sum(), rel=rough)
        place = sent @ seen_by.project(points, 0.02)[:, 0] / sent.sum()
        assert u_of(direct, seen_by)[sample] == pytest.approx(place, abs=1e-9 if sigma == 0.0 else 2e-7)


def test_finer_bins_and_samples_add_up(rng: np.random.Generator) -> None:
    """A steep and broken surface: the light of a sample does not depend on its subdivision."""
    mesh = trimesh.creation.icosphere(3, 0.012)
    mesh.vertices *= 1.0 + 0.05 * rng.normal(size=(len(mesh.vertices), 1))
    gloss = Material(diffuse=OrenNayar(albedo=0.4, roughness=0.5), gloss=Phong(albedo=0.3, exponent=20.0))
    sums = []
    for bins, samples in ((1, 4), (40, 4), (7, 64)):
        light = light_of(
            Scene.of(mesh), (gloss,), seen_by=sensor_view(bins=bins, samples=samples), sigma=1e-5, sub_sheets=3
        )
        found = light.exposures(2e-3)
        assert set(found) == {"direct", "specular"}
        sums.append([found[name].total().reshape(4, -1).sum(axis=1) for name in ("direct", "specular")])
        moments = found["direct"].first_moment(light.view.u_edges).reshape(4, -1).sum(axis=1)
        sums[-1].append(moments / 1e-3)
    np.testing.assert_allclose(sums[1], sums[2], rtol=2e-4, atol=1e-14)
    np.testing.assert_allclose(sums[0], sums[1], rtol=2e-2, atol=1e-14)


# ---- visibility: rays against every triangle -------------------------------------------------------------


@pytest.mark.double
@pytest.mark.parametrize("source", [None, (0.005, 0.3)])
@pytest.mark.parametrize("lens", [None, Lens(k1=-900.0, centre=(1e-4, -2e-4))])
def test_as_rays_to_the_lens_say(device: Device, source: Any, lens: Lens | None, rng: np.random.Generator) -> None:
    """Light of points on the lit line, each with a ray to the lens; true positions are visible points of the line."""
    tips = rng.uniform(-0.02, 0.02, (150, 1, 3)) + rng.normal(0.0, 4e-3, (150, 3, 3))
    scene, seen_by, L = Scene(np.concatenate([tips, plate(0.03, 0.03, -0.02)])), sensor_view(lens=lens, bins=6), 1e-3
    light = light_of(scene, seen_by=seen_by, source=source, device=device)
    line = light.sheet.illuminate(scene, L)
    count = 2000
    share = (np.arange(count) + 0.5) / count
    points = line.ends[:, :1] + share[:, None] * (line.ends[:, 1:] - line.ends[:, :1])
    eye = seen_by.lens_at(L) - points
    cosine = np.sum(line.normals[:, None] * eye, axis=-1) / np.linalg.norm(eye, axis=-1)
    power = (line.power * line.lengths / count)[:, None] * 0.5 / math.pi * seen_by.aperture_solid_angle(points, L)
    power = power * np.maximum(cosine, 0.0)
    rays = np.concatenate([points, np.broadcast_to(seen_by.lens_at(L), points.shape)], axis=-1).reshape(-1, 6)
    hidden = AnyHit(scene=scene, clearance=1e-10)(rays, device=device).occluded != 0
    uv = seen_by.project(points, L).reshape(-1, 2)
    for name, weight in (("direct", ~hidden), (UNOCCLUDED, 1.0)):
        expected = seen_by.deposit_spots(uv[:, 0], uv[:, 1], power.ravel() * weight)
        found = light.exposures(L, causes=True)[name]
        np.testing.assert_allclose(found.power, expected.power, atol=1e-3 * expected.power.max())
        np.testing.assert_allclose(found.moment, expected.moment, atol=1e-6 * expected.power.max())
    truth = light.truth(L)
    known = np.isfinite(truth.h)
    assert known.sum() >= 4
    np.testing.assert_array_equal(truth.status[~known] & (Status.LOW_SIGNAL | Status.OUT_OF_RANGE) != 0, True)
    place = np.stack([truth.g, np.full(len(known), L), truth.h], axis=-1)[known]
    np.testing.assert_allclose(seen_by.project(place, L)[:, 1], seen_by.v_centres[known], atol=1e-12)
    near = np.linalg.norm(place[:, None, None] - points, axis=-1).min(axis=(1, 2))
    assert near.max() < 1e-5
    to_lens = np.concatenate([place, np.broadcast_to(seen_by.lens_at(L), place.shape)], axis=-1)
    assert not occluded(scene.corners, to_lens, 1e-7).any()


def test_very_many_gaps() -> None:
    """A comb before the lens with more teeth than the kernel can store: segments are halved."""
    teeth = np.linspace(-0.01, 0.01, 201)
    screen = np.concatenate(
        [
            quad((a, 5e-3, 0.01), (b, 5e-3, 0.01), (b, 9e-3, 0.01), (a, 9e-3, 0.01))
            for a, b in zip(teeth[::2], teeth[1::2], strict=False)
        ]
    )
    light = light_of(np.concatenate([plate(), screen]), seen_by=sensor_view(samples=1))
    found = light.exposures(0.0, causes=True)
    assert 0.3 < found["direct"].total()[0] / found[UNOCCLUDED].total()[0] < 0.9
    parts = LensVisibility(scene=light.scene, device=Device.best()).visible_parts(
        light.sheet.illuminate(light.scene, 0.0), light.view.lens_at(0.0), with_hidden=True
    )
    assert parts.visible.sum() >= 100
    assert np.sum(parts.end - parts.start) == pytest.approx(parts.segment.max() + 1, rel=1e-12)
    # The plate is 2 m wide, and the lit line is two segments of 1 m; the shadows are projections of the teeth from the
    # lens.
    hidden = np.sum((parts.end - parts.start)[~parts.visible])
    assert hidden == pytest.approx(100 * (teeth[1] - teeth[0]) * 0.15 / 0.14, rel=1e-9)


def test_coincident_faces_are_one() -> None:
    """Coincident faces with other triangles do not occlude or absorb; the material of the first one counts."""
    over = np.array([[(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.0, 0.15, 0)]], float)
    once, twice = Scene(plate()), Scene(np.concatenate([plate(), over]), np.array([0, 0, 1]))
    other = Material(diffuse=Lambert(albedo=0.1))
    found = [light_of(each, (GREY, other)).exposures(1e-3)["direct"] for each in (once, twice)]
    np.testing.assert_allclose(found[1].power, found[0].power, rtol=1e-12)
    truth = light_of(twice, (GREY, other)).truth(1e-3)
    assert not truth.status.any()
    np.testing.assert_array_equal(truth.h, 0.0)


@pytest.mark.parametrize("lean", [80.0, 89.0, 89.99])
def test_grazing_light(lean: float) -> None:
    """On a nearly vertical wall, the power is spread over its height, in the view of the lens."""
    tangent = math.tan(math.radians(lean))
    low, high = -2e-3 / tangent, 2e-3 / tangent
    wall = quad((low, -1, -2e-3), (high, -1, 2e-3), (high, 1, 2e-3), (low, 1, -2e-3))
    seen_by = sensor_view(samples=1, bins=1, lens=None)
    light = light_of(wall, seen_by=seen_by)
    assert light.sheet.illuminate(light.scene, 0.0).total() == pytest.approx(high - low, rel=1e-12)
    share = np.polynomial.legendre.leggauss(30)
    points = np.stack([0.5 * (high - low) * share[0], 0.0 * share[0], 2e-3 * share[0]], axis=-1)
    eye = seen_by.lens_at(0.0) - points
    normal = np.array([-math.sin(math.radians(lean)), 0.0, math.cos(math.radians(lean))])
    cosine = np.maximum(eye @ normal, 0.0) / np.linalg.norm(eye, axis=1)
    expected = 0.5 / math.pi * (high - low) * 0.5 * share[1] @ (cosine * seen_by.aperture_solid_angle(points))
    assert light.exposures(0.0)["direct"].total()[0] == pytest.approx(expected, rel=1e-4)


def test_metres_and_micrometres() -> None:
    """A step of a micrometre on a slab of 20 m, at L = 100 m: the true position is accurate to its rounding."""
    L, fine = 100.0, 1e-6
    ground = plate(10.0, 10.0) + np.array([0.0, L, 0.0])
    tile = plate(5e-6, 1e-5, fine) + np.array([2e-3, L, 0.0])
    seen_by = sensor_view(samples=20001)
    light = light_of(np.concatenate([ground, tile]), seen_by=seen_by)
    truth = light.truth(L)
    on_tile = np.abs(truth.g - 2e-3) < 4.9e-6
    assert on_tile.sum() >= 3
    np.testing.assert_allclose(truth.h[on_tile], fine, atol=1e-13)
    np.testing.assert_allclose(truth.h[np.abs(truth.g - 2e-3) > 5.1e-6], 0.0, atol=1e-13)


@pytest.mark.parametrize("falls", [False, True])
@pytest.mark.parametrize("lens", [None, Lens(k1=-900.0, centre=(1e-4, -2e-4)), Lens(k1=-4e3)])
def test_out_of_view_behind_the_lens_and_beyond_the_fold(lens: Lens | None, falls: bool) -> None:
    """A ramp between below the sensor's range and far above the lens: only points with an image count."""
    ramp = quad((-0.03, -1, -0.05), (0.5, -1, 1.0), (0.5, 1, 1.0), (-0.03, 1, -0.05))
    if falls:
        ramp = quad((-0.5, -1, 1.0), (0.03, -1, -0.05), (0.03, 1, -0.05), (-0.5, 1, 1.0))
    seen_by = sensor_view(
        lens=lens, bins=30, u_edges=np.linspace(-9e-3, 9e-3, 31), v_edges=np.linspace(-9e-3, 9e-3, 10)
    )
    found = light_of(ramp, seen_by=seen_by).exposures(0.0)["direct"]
    line = LightSheet(transport=TRANSPORT).illuminate(Scene(ramp), 0.0)
    share = (np.arange(200_000) + 0.5) / 200_000
    points = (line.ends[:, :1] + share[:, None] * (line.ends[:, 1:] - line.ends[:, :1])).reshape(-1, 3)
    eye = seen_by.lens_at(0.0) - points
    cosine = np.maximum(eye @ line.normals[0], 0.0) / np.linalg.norm(eye, axis=1)
    sent = (
        0.5
        / math.pi
        * cosine
        * seen_by.aperture_solid_angle(points)
        * np.repeat(line.power * line.lengths, 200_000)
        / 200_000
    )
    uv = seen_by.project(points)
    assert 0.01 < np.isfinite(uv[:, 0]).mean() < 0.9
    expected = seen_by.deposit_spots(uv[:, 0], uv[:, 1], sent)
    assert expected.power.max() > 0.0
    # A bin holds 1000 points.
    np.testing.assert_allclose(found.power, expected.power, atol=2e-3 * expected.power.max())


# ---- the truth ---------------------------------------------------------------------------------------------


def test_truth_at_a_step() -> None:
    """A narrow strip of tape over a plate: the higher surface is magnified.

    Where it ends right of the middle, samples contain both surfaces (ambiguous); on the left they contain no surface.
    """
    for at, flag in ((8e-3, Status.AMBIGUOUS), (-8e-3, Status.LOW_SIGNAL)):
        seen_by = sensor_view(samples=2000)
        tape = quad((-1, -2e-4, 5e-3), (at, -2e-4, 5e-3), (at, 2e-4, 5e-3), (-1, 2e-4, 5e-3))
        light = light_of(np.concatenate([plate(), tape]), seen_by=seen_by)
        truth = light.truth(0.0)
        ends = np.sort(seen_by.project([[at, 0.0, 5e-3], [at, 0.0, 0.0]])[:, 1])
        between = (seen_by.v_centres > ends[0]) & (seen_by.v_centres < ends[1])
        assert between.sum() > 3
        np.testing.assert_array_equal(truth.status, np.where(between, flag, 0))
        expected = np.where(truth.g < at, 5e-3, 0.0)
        np.testing.assert_allclose(truth.h[~between], expected[~between], atol=1e-15)
        assert np.isfinite(truth.h[between]).all() == (flag == Status.AMBIGUOUS)


def test_truth_follows_the_transport(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(6, 0.02)
    light = light_of(
        Scene.of(ball),
        seen_by=sensor_view(
            samples=64, lens=Lens(k1=-900.0, centre=(1e-4, -2e-4)), bins=1, u_edges=np.array([-9e-3, 9e-3])
        ),
    )
    for L in rng.uniform(-5e-3, 5e-3, 4):
        truth = light.truth(float(L))
        seen = np.isfinite(truth.h)
        assert seen.sum() > 30
        radius = np.sqrt(truth.g**2 + L**2 + truth.h**2)[seen]
        np.testing.assert_allclose(radius, 0.02, atol=0.02 * 4e-4)


def test_beside_the_sensor() -> None:
    """Light imaged beyond the ends of the strips is out of range, also if a lid hides a part; it is not low signal."""
    for corners in (np.concatenate([plate(0.02, 0.02), plate(0.03, 0.03, 0.03)]), plate(z=-0.2)):
        light = light_of(corners)
        truth = light.truth(0.0)
        np.testing.assert_array_equal(truth.status, Status.OUT_OF_RANGE)
        assert np.isnan(truth.h).all()
        assert light.exposures(0.0)["direct"].total().sum() == 0.0
    away = light_of(plate(0.01, 0.01))
    np.testing.assert_array_equal(away.truth(5.0).status, Status.LOW_SIGNAL)
    assert away.exposures(5.0)["direct"].power.shape == (8, 12)


@pytest.mark.parametrize("sigma", [0.0, 2e-4])
def test_several_profiles_at_once(device: Device, sigma: float) -> None:
    """Profiles together, in any order, also beside the part, equal profiles one by one; with mirrors and lobes."""
    ball = trimesh.creation.icosphere(3, 0.02)
    made_of = Material(diffuse=Lambert(albedo=0.2), gloss=Phong(albedo=0.2, exponent=30.0), mirror=0.3)
    seen_by = sensor_view(bins=5, aperture=0.02)
    light = light_of(Scene.of(ball), (made_of,), seen_by=seen_by, sigma=sigma, source=(0.01, 0.2), device=device)
    places = np.array([3e-3, -0.5, 1e-2, *np.linspace(-4e-3, 4e-3, 9), 0.0])
    together, truths = light.exposures_of_profiles(places, causes=True), light.truths_of_profiles(places)
    for k, L in enumerate(places):
        for name, alone in light.exposures(float(L), causes=True).items():
            np.testing.assert_allclose(together[name].power[k], alone.power, rtol=1e-9, atol=1e-20)
            np.testing.assert_allclose(together[name].moment[k], alone.moment, rtol=1e-9, atol=1e-20)
        for both, one in zip(truths, light.truth(float(L)), strict=True):
            np.testing.assert_array_equal(both[k], one)
    assert (together["specular"].total().sum(axis=1) > 0.0).sum() > 5
    assert light.exposures_of_profiles([])["direct"].power.shape == (0, 8, 5)
    assert light.truths_of_profiles([]).h.shape == (0, 8)


def test_in_a_slit_is_dark() -> None:
    """A part in a deep slit, lit from above: only the upper edges of the walls are visible from the lens."""
    walls = [quad((-1, y, -0.05), (1, y, -0.05), (1, y, 0.0), (-1, y, 0.0)) for y in (-2e-3, 2e-3)]
    scene = np.concatenate([plate(1.0, 2e-3, -0.05), *walls])
    truth = light_of(scene, seen_by=sensor_view(bins=1, u_edges=np.array([-0.1, 0.1]))).truth(0.0)
    np.testing.assert_array_equal(truth.status, Status.LOW_SIGNAL)
    assert np.isnan(truth.g).all()


# ---- materials and causes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lobe",
    [Phong(albedo=0.4, exponent=2000.0), Ggx(alpha=0.02, f0=0.5), Ward(albedo=0.4, alpha_x=0.02, alpha_y=0.3)],
)
def test_lobes_are_resolved(lobe: Any) -> None:
    """A lobe narrower than a sample agrees with a sum over 200 000 points of the line."""
    tilt = 0.25
    fall = math.tan(tilt)
    slope = quad((-1, -1, fall), (1, -1, fall), (1, 1, -fall), (-1, 1, -fall))
    made_of = Material(diffuse=Lambert(albedo=0.2), gloss=lobe)
    seen_by = sensor_view(samples=2, bins=1)
    light = light_of(slope, (made_of,), seen_by=seen_by)
    found = light.exposures(0.0)
    G = np.linspace(-0.03, 0.03, 200_001)
    points = np.stack([G, 0.0 * G, 0.0 * G], axis=-1)
    eye = seen_by.lens_at(0.0) - points
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    normal, across = np.array([0.0, math.sin(tilt), math.cos(tilt)]), np.array([0.0, math.cos(tilt), -math.sin(tilt)])
    local = np.stack([eye[:, 0], eye @ across, eye @ normal], axis=-1)
    towards = np.broadcast_to([0.0, across[2], normal[2]], local.shape)
    sent = lobe.value(np.concatenate([towards, local], axis=-1)) * local[:, 2] * seen_by.aperture_solid_angle(points)
    uv = seen_by.project(points)
    expected = seen_by.deposit_spots(uv[:, 0], uv[:, 1], sent * (G[1] - G[0]))
    np.testing.assert_allclose(found["specular"].total(), expected.total(), rtol=1e-4)
    assert expected.total().min() > 0.0


def mirror_to_the_lens(turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a plane through the origin that mirrors light from above to the lens, up to a rotation, and its normal."""
    lens = np.array([0.0, 0.08, 0.15])
    half_way = lens / np.linalg.norm(lens) + (0.0, math.sin(turn), math.cos(turn))
    normal = half_way / np.linalg.norm(half_way)
    fall = normal[1] / normal[2]
    return quad((-1, -1, fall), (1, -1, fall), (1, 1, -fall), (-1, 1, -fall)), normal


def test_a_mirror_throws_the_light_into_the_lens(device: Device) -> None:
    """The lens gets parallel light over its opening, times the reflectance; at one degree off, no light."""
    made_of = Material(diffuse=Lambert(albedo=0.0), mirror=0.7)
    seen_by = sensor_view(samples=9)
    corners, _ = mirror_to_the_lens()
    glint = light_of(corners, (made_of,), seen_by=seen_by, power=3.0, device=device).exposures(0.0)
    np.testing.assert_allclose(glint["specular"].total()[4], 3.0 * 0.7 * seen_by.aperture, rtol=1e-9)
    assert glint["specular"].total().sum() == pytest.approx(glint["specular"].total()[4], rel=1e-15)
    np.testing.assert_allclose(u_of(glint["specular"], seen_by)[4], 0.0, atol=1e-9)
    assert not glint["direct"].power.any()
    away, _ = mirror_to_the_lens(math.radians(2.0))
    assert not light_of(away, (made_of,), seen_by=seen_by).exposures(0.0)["specular"].power.any()
    screen = quad((-0.1, 0.04, 0.06), (0.1, 0.04, 0.06), (0.1, 0.04, 0.09), (-0.1, 0.04, 0.09))
    hidden = light_of(np.concatenate([corners, screen]), (made_of,), seen_by=seen_by)
    assert not hidden.exposures(0.0)["specular"].power.any()


def test_a_thick_sheet_in_a_mirror() -> None:
    """The beam is wider than the opening: the light is the integral of its density over a disc."""
    made_of = Material(diffuse=Lambert(albedo=0.0), mirror=1.0)
    seen_by, sigma = sensor_view(samples=9, aperture=2e-4), 1e-4
    corners, normal = mirror_to_the_lens()
    light = light_of(corners, (made_of,), seen_by=seen_by, sigma=sigma, sub_sheets=400)
    off = np.linspace(-1e-4, 1e-4, 20001)
    # A mirrored beam keeps its width; distances perpendicular to the axis of the lens do not change.
    chord = 2.0 * np.sqrt(np.maximum(1e-8 - off**2, 0.0))
    through = np.trapezoid(chord * np.exp(-0.5 * (off / sigma) ** 2), off) / (sigma * math.sqrt(2.0 * math.pi))
    assert light.exposures(0.0)["specular"].total().sum() == pytest.approx(through, rel=2e-3)
    assert normal[2] > 0.9


@pytest.mark.parametrize("source", [None, (0.01, 0.2), (-0.02, 0.1)])
def test_glints_as_rays_say(source: Any, rng: np.random.Generator) -> None:
    """Facets with random tilts of some degrees: the share of a thousand rays on each that hit the opening."""
    seen_by = sensor_view(aperture=0.02)
    turns = rng.normal(0.0, 0.1, (300, 2))
    made_of = Material(diffuse=Lambert(albedo=0.0), mirror=1.0)
    facets, G = [], np.linspace(-0.02, 0.02, 301)
    for (a, b), left, right in zip(turns, G, G[1:], strict=False):
        fall = 0.245 + b
        rise = a * (right - left)
        facets.append(
            quad(
                (left, -0.01, 0.01 * fall),
                (right, -0.01, 0.01 * fall + rise),
                (right, 0.01, -0.01 * fall + rise),
                (left, 0.01, -0.01 * fall),
            )
        )
    light = light_of(np.concatenate(facets), (made_of,), seen_by=seen_by, source=source)
    line = light.sheet.illuminate(light.scene, 0.0)
    parts = find_specular_highlights(line, light.sheet, seen_by, 0.0)
    share = np.bincount(parts.segment, parts.end - parts.start, minlength=len(line.power))
    at = (np.arange(2000) + 0.5) / 2000
    points = line.ends[:, :1] + at[:, None] * (line.ends[:, 1:] - line.ends[:, :1])
    arrives = -light.sheet.direction_to_light(points)
    normal = line.normals[:, None]
    goes = arrives - 2.0 * np.sum(arrives * normal, axis=-1, keepdims=True) * normal
    to_lens, axis = np.array(seen_by.lens) - points, np.array(seen_by.axis)
    way = (to_lens @ axis) / (goes @ axis)
    miss = np.linalg.norm(to_lens - way[..., None] * goes, axis=-1)
    inside = (way > 0.0) & (miss < 0.5 * seen_by.aperture)
    np.testing.assert_allclose(share, inside.mean(axis=1), atol=1.1e-3)
    assert 3 < (share > 0.0).sum() < 200


def test_causes() -> None:
    """With uniform surfaces and no occluder, the variants without a screen and with white surfaces are equal."""
    scene, materials = two_plates(0.2, 0.8)
    light = light_of(scene, materials, seen_by=sensor_view(), sigma=1e-4, sub_sheets=[0.0])
    found = light.exposures(0.0, causes=True)
    assert set(found) == {"direct", "specular", UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED}
    np.testing.assert_array_equal(found[UNOCCLUDED].power, found["direct"].power)
    np.testing.assert_array_equal(found[UNIFORM].power, found[UNIFORM_UNOCCLUDED].power)
    ratio = found["direct"].total() / found[UNIFORM].total()
    np.testing.assert_allclose(ratio, 0.5, rtol=1e-3)
    assert not found["specular"].power.any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"sub_sheets": 0}, "DirectLight.sub_sheets is 0"), ({"sub_sheets": [1.0, 0.0]}, "ascending places in sigmas")],
)
def test_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        light_of(plate(), sigma=1e-4, **wrong)
    with pytest.raises(ValueError, match="expected one for each"):
        light_of(plate(), ())
    with pytest.raises(ValueError, match="different transports"):
        DirectLight(
            view=sensor_view(), scene=Scene(plate()), materials=(GREY,), sheet=LightSheet(transport=StraightTransport())
        )
