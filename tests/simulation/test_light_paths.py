from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.light_paths import LightPaths, _widened, distance_from_path
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert, Phong
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import BEYOND_ENDS
from gpuvision.simulation.sensors.readings import PATHS as READ_PATHS
from gpuvision.simulation.transport.direct import DirectLimits
from gpuvision.simulation.transport.illumination import LightSheet
from sensor_views import sensor_view

GREY = Material(diffuse=Lambert(albedo=0.5))
PATHS = ("direct", "diffuse-diffuse")


def corner(moved: float = 0.0, width: float = 0.2) -> Scene:
    """Return a floor and a wall across the end of the sheet: the line on the floor ends at the wall x = 20 mm."""
    y = 0.5 * width
    floor = np.array([[-0.1, -y, 0.0], [0.02, -y, 0.0], [0.02, y, 0.0], [-0.1, y, 0.0]])
    wall = np.array([[0.02, -y, 0.0], [0.02, y, 0.0], [0.02, y, 0.05], [0.02, -y, 0.05]])
    corners = np.concatenate([floor, wall])
    corners[:, 1] += moved
    return Scene.of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], process=False))


def trough(facets: int) -> Scene:
    """Return a floor along y, bent upwards on both sides: all facets face each other, and each is lit."""
    x = np.linspace(-0.03, 0.03, facets + 1)
    edge = np.column_stack([x, np.full_like(x, 0.1), x * x / 0.1])
    a, b = edge * [1.0, -1.0, 1.0], edge
    quads = np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1)
    return Scene(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def paths(scene, device, **more):
    one = sensor_view()
    sheet = LightSheet(transport=one.transport, power=3.0, g_limits=(-0.02, 0.05))
    values = {"view": one, "sheet": sheet, "scene": scene, "materials": [GREY], "paths": PATHS, "device": device}
    return LightPaths(**(values | more))


def glow(places, normal, length, power, x0):
    """Return the irradiance by a line on the floor, x0 - length to x0, y = 0: points every 1 um, in double."""
    t = x0 - (np.arange(round(length / 1e-6)) + 0.5) * 1e-6
    line = np.stack([t, np.zeros_like(t), np.zeros_like(t)], axis=-1)
    got = []
    for place in places:
        way = line - place
        square = np.sum(way * way, axis=1)
        arrive = np.maximum(way @ normal, 0.0) * np.maximum(-way[:, 2], 0.0)
        got.append(np.sum(0.5 * power / math.pi * arrive / square**2) * 1e-6)
    return np.array(got)


def test_limits_reach_the_direct_light_and_the_mirrors(device):
    """Parts of a glossy lobe change the specular light a little, steps in mirrors are those of `Mirrors`."""
    glossy = [Material(diffuse=Lambert(albedo=0.1), gloss=Phong(albedo=0.3, exponent=200.0))]
    given = {"materials": glossy, "paths": ("direct", "specular")}
    limits = (DirectLimits(), DirectLimits(lobe_turn=4.0, max_lobe_parts=1))
    powers = [
        paths(corner(), device, direct_limits=each, **given).profile(0.0).exposures["specular"].power for each in limits
    ]
    assert powers[0].any()
    assert not np.array_equal(*powers)
    assert paths(corner(), device, mirror_steps=5.0)._mirrors.steps_per_sample == 5.0


def test_damaged_and_repeated_triangles_change_no_light(device):
    """Triangles with NaN and infinity, and triangles that a mesh holds twice, leave all light and the patches' size."""
    clean = Scene(corner().corners.astype(np.float32).astype(np.float64))
    more = clean.corners.copy()
    more[0, 1, 2], more[1, 0], more[2, 2, 0] = np.nan, np.inf, -np.inf
    damaged = Scene(np.concatenate([clean.corners, more[:3], clean.corners]))
    given = {"materials": [Material(diffuse=Lambert(albedo=0.5), mirror=0.3)], "paths": READ_PATHS}
    good, bad = (paths(scene, device, **given).profile(0.0).exposures for scene in (clean, damaged))
    assert good.keys() == bad.keys()
    for name in READ_PATHS:
        np.testing.assert_allclose(bad[name].power, good[name].power, rtol=1e-5, atol=1e-9 * good[name].power.max())


def test_a_wall_glows_as_the_line_before_it_says(device):
    model = paths(corner(), device)
    lines = model.view_rays
    seen = lines.visible_surface(0.0)
    wall = np.argwhere((seen.triangle >= 2) & (seen.receivers[..., 2] > 1e-3))
    assert len(wall) >= 3
    light = model.profile(0.0).exposures["diffuse-diffuse"]
    chosen = wall[:: max(len(wall) // 8, 1)]
    at = tuple(chosen.T)
    expected = glow(seen.receivers[at][:, :3], np.array([-1.0, 0.0, 0.0]), 0.04, 3.0, 0.02)
    # One node per bin: the power of a bin is the power of its element.
    np.testing.assert_allclose(light.power[at], expected * seen.weights[at], rtol=2e-5)
    floor = np.argwhere(seen.triangle[..., :] < 2)
    assert not light.power[tuple(floor.T)].any()


def test_scene_and_sensor_may_move_together(device):
    one, other = paths(corner(), device).profile(0.0), paths(corner(0.03), device).profile(0.03)
    for name in PATHS:
        np.testing.assert_allclose(one.exposures[name].power, other.exposures[name].power, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(one.truth.h, other.truth.h, atol=1e-12)


def test_light_is_proportional_to_power_and_albedo(device):
    one = paths(corner(), device).profile(0.0).exposures
    sheet = LightSheet(transport=sensor_view().transport, power=6.0, g_limits=(-0.02, 0.05))
    white = Material(diffuse=Lambert(albedo=1.0))
    more = paths(corner(), device, sheet=sheet, materials=[white]).profile(0.0).exposures
    np.testing.assert_allclose(more["direct"].power, 4.0 * one["direct"].power, rtol=1e-12)
    # Two diffuse reflections.
    np.testing.assert_allclose(more["diffuse-diffuse"].power, 8.0 * one["diffuse-diffuse"].power, rtol=1e-5)


def test_further_bounces_come_on_top(device):
    model = paths(corner(), device, paths=(*PATHS, "multi-bounce"), patch_size=0.02)
    light = model.profile(0.0).exposures
    first, further = light["diffuse-diffuse"].power.sum(), light["multi-bounce"].power.sum()
    # The wall reflects light to the floor, and so on; each bounce loses half, and the light that leaves the corner.
    assert 0.05 * first < further < first


def test_shared_solvers_serve_equal_scenes_only(device):
    """Another albedo has another radiosity; the same light takes the solution that is there."""
    scene, solvers, bounces = corner(), {}, {"paths": (*PATHS, "multi-bounce"), "patch_size": 0.02}
    for albedo, count in ((0.2, 2), (0.8, 4), (0.2, 4)):  # two sizes of patches each
        material = [Material(diffuse=Lambert(albedo=albedo))]
        shared, own = (
            paths(scene, device, materials=material, solvers=each, **bounces).profile(0.0).exposures["multi-bounce"]
            for each in (solvers, {})
        )
        np.testing.assert_array_equal(shared.power, own.power)
        assert len(solvers) == count


def test_patches_are_a_sixteenth_of_the_diagonal_by_default(device):
    scene, diagonal = corner(width=0.04), math.hypot(0.12, 0.04, 0.05)
    sizes = {None: None, 0.02: 0.02, diagonal: diagonal / 16.0}
    made = {key: paths(scene, device, paths=(*PATHS, "multi-bounce"), patch_size=size) for key, size in sizes.items()}
    power = {size: each.profile(0.0).exposures["multi-bounce"].power for size, each in made.items()}
    np.testing.assert_array_equal(power[None], power[diagonal])
    assert np.any(power[None] != power[0.02])


def test_nothing_lit_is_dark_and_not_zero(device):
    model = paths(corner(), device)
    # Far beyond the part, the sheet intersects no surface.
    profile = model.profile(0.5)
    assert np.isnan(profile.truth.h).all()
    assert (profile.truth.status != 0).all()
    assert not any(each.power.any() for each in profile.exposures.values())
    assert profile.statistics["segments"] == 0.0


def test_what_was_not_asked_for_is_not_there(device):
    assert "diffuse-diffuse" not in paths(corner(), device, paths=("direct",)).profile(0.0).exposures
    with pytest.raises(ValueError, match="unknown path 'defuse'"):
        paths(corner(), device, paths=("defuse",))


@pytest.mark.parametrize("tolerance", [1e-7, 1e-5, 1e-3])
def test_a_tolerance_is_kept(device, tolerance):
    one = sensor_view(u_edges=np.linspace(-3e-3, 3e-3, 129), v_edges=np.linspace(-6e-3, 6e-3, 33))
    exact = paths(trough(160), device, view=one).profile(0.0)
    about = paths(trough(160), device, view=one, tolerance=tolerance).profile(0.0)
    slope = StripErrorModel.from_exposure(one, exact.exposures["direct"]).slope

    def place(profile):
        total = profile.exposures["direct"] + profile.exposures["diffuse-diffuse"]
        return total.first_moment(one.u_edges) / total.total()

    lit = exact.exposures["direct"].total() > 0.0
    error = np.abs(place(about) - place(exact))[lit] * slope[lit]
    # Plus the rounding of the kernel.
    assert error.max() <= about.statistics["bound of pairs left out [m]"] * (1.0 + 1e-6) + 1e-9
    assert about.statistics["bound of pairs left out [m]"] <= tolerance
    assert about.statistics["profiles without clustering (cheaper)"] == 0.0
    assert about.statistics["pairs left out"] + about.statistics["pairs clustered"] > 0.0
    assert about.statistics["pairs exact"] < exact.statistics["pairs exact"]


def test_where_there_is_little_to_leave_out_all_is_computed(device):
    exact, about = (paths(corner(), device, tolerance=tolerance).profile(0.0) for tolerance in (0.0, 1e-3))
    for name in PATHS:
        np.testing.assert_array_equal(about.exposures[name].power, exact.exposures[name].power)
    assert about.statistics["profiles without clustering (cheaper)"] == 1.0
    assert about.statistics["pairs exact"] == about.statistics["pairs"] > 0.0
    assert about.statistics["pairs left out"] == about.statistics["bound of pairs left out [m]"] == 0.0


def test_bounces_are_left_out_where_they_cannot_matter(device):
    dim = Material(diffuse=Lambert(albedo=1e-3))
    model = paths(corner(), device, paths=(*PATHS, "multi-bounce"), materials=[dim], patch_size=0.05, tolerance=1e-3)
    profile = model.profile(0.0)
    assert "multi-bounce" not in profile.exposures
    assert 0.0 < profile.statistics["bound of multi-bounce left out [m]"] <= 0.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.04, 0.02])
def test_the_error_of_the_patches_is_estimated(device, size):
    """The estimate contains the change of the readings when the patches become half as large."""
    large, small = (
        paths(corner(), device, paths=(*PATHS, "multi-bounce"), patch_size=each).profile(0.0)
        for each in (2.0 * size, size)
    )
    one = sensor_view()

    def place(profile):
        total = profile.exposures["direct"] + profile.exposures["multi-bounce"]
        return total.first_moment(one.u_edges) / total.total()

    lit = small.exposures["direct"].total() > 0.0
    slope = StripErrorModel.from_exposure(one, small.exposures["direct"]).slope
    change = (np.abs(place(large) - place(small)) * slope)[lit].max()
    assert small.statistics["estimated error of patches [m]"] == pytest.approx(change, rel=0.05)


@pytest.mark.parametrize("aperture", [1e-3, 0.1, 0.31])
def test_the_bound_of_bounces_is_that_of_the_nearest_surface(device, aperture):
    """The line sends half of its light; the top of the wall is the nearest place, from the edge of the aperture."""
    view = replace(sensor_view(), aperture=aperture)
    materials = [GREY, Material(diffuse=Lambert(albedo=0.25))]
    profile = paths(corner(), device, view=view, materials=materials, min_power=1e-9).profile(0.0)
    assert "estimated error of patches [m]" not in profile.statistics
    assert profile.statistics["power"] == pytest.approx(3.0 * 0.04)
    nearest = math.hypot(0.02, 0.1) - 0.5 * aperture
    opening = 0.25 * math.pi * aperture**2
    solid_angle = min(opening / nearest**2, 2.0 * math.pi) if nearest > 0.0 else 2.0 * math.pi
    power = 0.5 * 3.0 * 0.04 * 0.5 / (1.0 - 0.5) * 0.5 / math.pi * solid_angle
    reading = StripErrorModel.from_exposure(view, profile.exposures["direct"], min_power=1e-9)
    expected = reading.error_bound(power).max()
    assert profile.statistics["bound of multi-bounce left out [m]"] == pytest.approx(expected, rel=1e-9)


def test_light_beyond_the_ends_is_that_of_a_wider_sensor(device):
    """Power and moment beyond either end, about the middle of the first and the last bin; blurred before it is cut."""
    edges = np.linspace(-3e-3, 3e-3, 25)
    narrow = sensor_view(u_edges=edges[6:17])
    ramp = np.array(
        [
            [[-0.1, -0.1, -0.02], [0.1, -0.1, 0.03], [0.1, 0.1, 0.03]],
            [[-0.1, -0.1, -0.02], [0.1, 0.1, 0.03], [-0.1, 0.1, -0.02]],
        ]
    )
    sheet = LightSheet(transport=narrow.transport, power=3.0)
    made, whole = (
        paths(Scene(ramp), device, view=each, sheet=sheet, paths=("direct",), blur=2e-4, end_bins=bins)
        .profile(0.0)
        .exposures
        for each, bins in ((narrow, 5), (replace(sensor_view(u_edges=edges), axis=narrow.axis), 0))
    )
    direct, beyond = made["direct"], made[BEYOND_ENDS]
    np.testing.assert_allclose(direct.power, whole["direct"].power[:, 6:16], rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(direct.moment, whole["direct"].moment[:, 6:16], rtol=1e-7, atol=1e-24)
    centres = 0.5 * (edges[1:] + edges[:-1])
    for place, outer, inner in ((0, slice(1, 6), 6), (-1, slice(16, 21), 15)):
        power, moment = whole["direct"].power[:, outer], whole["direct"].moment[:, outer]
        np.testing.assert_allclose(beyond.power[:, place], power.sum(axis=1), rtol=1e-6, atol=1e-18)
        first = (moment + power * (centres[outer] - centres[inner])).sum(axis=1)
        np.testing.assert_allclose(beyond.moment[:, place], first, rtol=1e-6, atol=1e-22)
    assert beyond.power.sum() > 0.1 * direct.power.sum()
    assert not beyond.power[:, 1:-1].any()
    assert BEYOND_ENDS not in whole


def test_bounces_that_are_not_simulated_have_a_bound(device):
    """The bound without the path is above the shift of the readings by it, also for white surfaces."""
    one = sensor_view()
    for albedo in (0.5, 1.0):
        made_of = [Material(diffuse=Lambert(albedo=albedo))]
        model = paths(corner(), device, paths=(*PATHS, "multi-bounce"), materials=made_of, patch_size=0.04)
        with_patches = model.profile(0.0)
        assert 0.0 < with_patches.statistics["estimated error of patches [m]"] < 1e-3
        with_bounces = with_patches.exposures
        profile = paths(corner(), device, materials=made_of).profile(0.0)
        reading = StripErrorModel.from_exposure(one, profile.exposures["direct"])
        moved = StripErrorModel.from_exposure(one, profile.exposures["direct"] + with_bounces["multi-bounce"])
        error = (np.abs(moved.position - reading.position) * reading.slope)[reading.power > 0.0]
        bound = profile.statistics["bound of multi-bounce left out [m]"]
        assert 0.0 < error.max() <= bound < math.inf


def test_distance_of_the_scene_from_the_path_of_the_lens(rng):
    """The inside of a large triangle, and edges, are nearer than the corners: random points of the triangles."""
    assert distance_from_path(np.zeros((0, 3, 3)), (0, 0, 0), (0, 1, 0)) == math.inf
    floor = np.array([[(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 1.0, 0.0)]])
    assert distance_from_path(floor, (0.1, 5.0, 0.3), (0.0, 2.0, 0.0)) == pytest.approx(0.3, rel=1e-12)
    assert distance_from_path(floor, (0.1, 5.0, 0.3), (0.0, 0.0, 1.0)) == pytest.approx(
        distance_from_path(floor, (0.1, 5.0, 0.0), (0.0, 0.0, -3.0)), rel=1e-12
    )
    assert distance_from_path(floor, (0.1, 0.0, 7.0), (0.0, 0.0, 1.0)) == 0.0
    for _ in range(8):
        corners, start, way = rng.normal((3.0, 0.0, 0.0), 1.0, (2, 3, 3)), rng.normal(size=3), rng.normal(size=3)
        share = rng.dirichlet([0.5, 0.5, 0.5], 200_000)
        across = np.cross(np.concatenate(share @ corners) - start, way / np.linalg.norm(way))
        nearest = np.linalg.norm(across, axis=1).min()
        found = distance_from_path(corners, start, way)
        assert nearest - 0.05 < found <= nearest + 1e-12


@pytest.mark.parametrize("bins", [0, 1, 3])
def test_bins_beyond_the_ends_have_the_width_of_the_last_ones(bins: int) -> None:
    """The first bin is narrower than the last one."""
    edges = np.array([-3e-3, -2.5e-3, -1e-3, 1e-3, 2.8e-3])
    view = sensor_view(u_edges=edges)
    wide = _widened(view, bins).u_edges
    np.testing.assert_array_equal(wide[bins : bins + len(edges)], edges)
    steps = np.diff(wide)
    np.testing.assert_allclose(steps, [*[0.5e-3] * bins, *np.diff(edges), *[1.8e-3] * bins], rtol=1e-9)


def test_multi_bounce_light_has_nodes_of_its_own(device):
    """Light with 4 nodes, and with 1 for multi-bounce light, is the light of either number."""
    found, few, many = (
        paths(corner(), device, paths=(*PATHS, "multi-bounce"), patch_size=0.02, **nodes).profile(0.0).exposures
        for nodes in ({"nodes": (2, 2), "bounce_nodes": (1, 1)}, {"nodes": (1, 1)}, {"nodes": (2, 2)})
    )
    for name, expected, other in (("diffuse-diffuse", many, few), ("multi-bounce", few, many)):
        np.testing.assert_allclose(found[name].power, expected[name].power, rtol=1e-6)
        assert np.abs(found[name].power - other[name].power).max() > 1e-4 * other[name].power.max()
