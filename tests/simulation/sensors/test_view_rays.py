from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.view_rays import ViewRays, unit_normals
from sensor_views import sensor_view

GREY = Material(diffuse=Lambert(albedo=0.5))
WHITE = Material(diffuse=Lambert(albedo=1.0))


def floor(z: float = 0.0, size: float = 0.2) -> trimesh.Trimesh:
    corners = np.array([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize("spreads_rays", [False, True])
@pytest.mark.parametrize("nodes", [(1, 1), (2, 3)])
def test_elements_lie_on_what_is_seen_where_its_image_is(device, nodes, spreads_rays):
    one, more = sensor_view(tilt=0.1), {"nodes": nodes, "spreads_rays": spreads_rays}
    lines = ViewRays(view=one, scene=Scene.of(floor(1e-3)), materials=[GREY], device=device, **more)
    seen = lines.visible_surface(0.02)
    assert seen.receivers.shape == (one.samples, one.bins * nodes[0] * nodes[1], 6)
    np.testing.assert_allclose(seen.receivers[..., 2], 1e-3, atol=1e-15)
    np.testing.assert_allclose(seen.receivers[..., 3:], np.broadcast_to([0, 0, 1], seen.receivers[..., 3:].shape))
    uv = one.project(seen.receivers[..., :3], L=0.02)
    np.testing.assert_allclose(uv[..., 0], np.broadcast_to(lines.u, uv.shape[:-1]), atol=1e-14)
    bins = np.repeat(np.arange(one.bins), nodes[0] * nodes[1])
    np.testing.assert_array_equal(one.bin_of(uv[..., 0]), np.broadcast_to(bins, uv.shape[:-1]))
    np.testing.assert_array_equal(one.sample_of(uv[..., 1]), np.broadcast_to(np.arange(7)[:, None], uv.shape[:-1]))


@pytest.mark.parametrize("spreads_rays", [False, True])
def test_uniform_light_gives_the_etendue_and_its_moment(device, spreads_rays):
    one, more = sensor_view(), {"nodes": (4, 4), "spreads_rays": spreads_rays}
    lines = ViewRays(view=one, scene=Scene.of(floor()), materials=[GREY], device=device, **more)
    seen = lines.visible_surface(0.0)
    got = lines.exposure(seen, np.full(seen.weights.shape, 3.0))
    # Radiance 3 * 0.5 / pi everywhere: an independent sum over a fine grid of the sensor.
    u = -3e-3 + (np.arange(600) + 0.5) * 1e-5
    v = -6e-3 + (np.arange(840) + 0.5) * (12e-3 / 840)
    fine = one.etendue(u[None, :], v[:, None]) * 1e-5 * (12e-3 / 840) * 1.5 / math.pi
    held = fine.reshape(7, 120, 600)
    np.testing.assert_allclose(got.total(), held.sum(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_allclose(got.first_moment(one.u_edges), (held * u).sum(axis=(1, 2)), rtol=1e-3, atol=1e-22)


@pytest.mark.parametrize("nodes", [(1, 1), (2, 4), (1, 8)])
def test_spread_rays_lie_one_in_each_cell_and_evenly_over_a_sample(device, nodes):
    """No gap along v between neighbours is more than 2.7 times the mean one: the three gaps of the golden ratio."""
    one = sensor_view()
    lines = ViewRays(view=one, scene=Scene.of(floor()), materials=[GREY], nodes=nodes, spreads_rays=True, device=device)
    v = one.project(lines.visible_surface(0.0).receivers[..., :3])[..., 1]
    cells = one.v_edges[:-1, None] + np.diff(one.v_edges)[0] * np.append(0.0, 0.5 * _weights(nodes[1]).cumsum())
    by_cell = (
        v.reshape(one.samples, one.bins, nodes[1], nodes[0]).transpose(0, 2, 1, 3).reshape(*cells[:, 1:].shape, -1)
    )
    assert np.all((by_cell > cells[:, :-1, None]) & (by_cell < cells[:, 1:, None]))
    gaps = np.diff(np.sort(by_cell, axis=-1)) / (cells[:, 1:] - cells[:, :-1])[..., None]
    assert gaps.max() < 2.7 / by_cell.shape[-1]


def _weights(count):
    return np.polynomial.legendre.leggauss(count)[1]


def test_the_error_at_an_edge_falls_where_rays_are_spread(device):
    """Half of a sample is white floor: a single ray per bin tells 0 or 1, spread rays tell the half within 2 bins."""
    one = sensor_view()
    edge = one.points_in_sheet(0.0, one.v_centres[3])[0] + 1e-9
    scene = Scene.of(floor().slice_plane([edge, 0.0, 0.0], [1.0, 0.0, 0.0]))
    shares = []
    for spreads_rays in (False, True):
        of = {"materials": [WHITE], "spreads_rays": spreads_rays, "device": device}
        whole, half = (ViewRays(view=one, scene=each, **of).visible_surface(0.0) for each in (Scene.of(floor()), scene))
        shares.append(half.weights[3].sum() / whole.weights[3].sum())
    assert shares[0] in (pytest.approx(0.0), pytest.approx(1.0))
    assert shares[1] == pytest.approx(0.5, abs=2.0 / one.bins)


def test_the_side_that_the_lens_sees_counts_and_the_nearer_surface(device):
    under, over = floor(-5e-3), floor(4e-3, size=0.004)
    over.invert()
    scene = Scene(np.concatenate([under.triangles, over.triangles]), np.array([0, 0, 1, 1], np.int32))
    one = sensor_view()
    lines = ViewRays(view=one, scene=scene, materials=[GREY, WHITE], device=device)
    seen = lines.visible_surface(0.0)
    near = seen.receivers[..., 2] > 0.0
    assert near.any()
    assert not near.all()
    np.testing.assert_array_equal(seen.triangle[near] >= 2, True)
    assert (np.abs(seen.receivers[near][:, :2]) <= 0.004 + 1e-9).all()
    assert (seen.receivers[..., 5] == 1.0).all()
    # The albedo of the surface over pi, times the etendue of the bin.
    etendue = one.etendue(one.u_centres, one.v_centres[:, None]) * 5e-4 * (12e-3 / 7)
    albedo = np.where(near, WHITE.albedo, GREY.albedo)
    np.testing.assert_allclose(seen.weights, etendue * albedo / math.pi, rtol=1e-12)


def test_where_nothing_is_seen_nothing_comes(device):
    one = sensor_view()
    lines = ViewRays(view=one, scene=Scene.of(floor(size=0.003)), materials=[GREY], device=device)
    seen = lines.visible_surface(0.0)
    assert seen.triangle.shape == (one.samples, one.bins)  # one ray through each bin is the default
    missed = seen.triangle < 0
    assert missed.any()
    assert not missed.all()
    np.testing.assert_array_equal(seen.weights[missed], 0.0)
    np.testing.assert_array_equal(seen.receivers[missed], 0.0)
    got = lines.exposure(seen, np.where(missed, np.nan, 1.0))
    assert np.isfinite(got.power).all()
    assert got.power.sum() > 0.0


def test_a_material_for_every_number(device):
    scene = Scene(floor().triangles, np.array([0, 2], np.int32))
    with pytest.raises(ValueError, match="materials 0 to 2"):
        ViewRays(view=sensor_view(), scene=scene, materials=[GREY], device=device)


def test_an_empty_scene_shows_nothing(device):
    lines = ViewRays(view=sensor_view(), scene=Scene(np.zeros((0, 3, 3))), materials=[], device=device)
    seen = lines.visible_surface(1e-3)
    assert (seen.triangle < 0).all()
    assert not seen.weights.any()
    assert not lines.exposure(seen, np.ones(seen.weights.shape)).power.any()


def test_normals_of_triangles_without_area_are_zero():
    corners = np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]],
            [[1.0, 2.0, 3.0]] * 3,
            [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0]],
        ]
    )
    np.testing.assert_array_equal(unit_normals(Scene(corners)), [[1.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3])
