from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.simulation.sensors.sensor_view import Exposure
from sensor_views import BASELINE, FOCAL, STAND_OFF, sensor_view

LENSES = [None, Lens(k1=-900.0, centre=(1e-4, -2e-4))]


@pytest.mark.parametrize("tilt", [None, 0.0, 0.2])
@pytest.mark.parametrize("lens", LENSES)
def test_points_of_the_sheet_are_imaged_as_the_triangulation_says(tilt, lens):
    one = sensor_view(tilt=tilt, distortion=lens)
    G, H = np.array([0.0, 0.01, -0.012]), np.array([0.0, 5e-3, -4e-3])
    uv = one.project(np.stack([G, np.full(3, 0.03), H], axis=-1), L=0.03)
    np.testing.assert_allclose(uv, one.triangulation.to_sensor(np.stack([G, H], axis=-1)), atol=1e-15)
    back = one.points_in_sheet(uv[:, 0], uv[:, 1], L=0.03)
    np.testing.assert_allclose(back, np.stack([G, np.full(3, 0.03), H], axis=-1), atol=1e-14)


def test_a_ray_passes_what_is_imaged_where_it_starts():
    one = sensor_view(tilt=0.1, distortion=LENSES[1])
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.01, 0.01, -0.01], [0.01, 0.03, 0.01], (50, 3))
    uv = one.project(points, L=0.02)
    rays = one.rays(uv[:, 0], uv[:, 1], L=0.02)
    way = points - rays[:, :3]
    np.testing.assert_allclose(np.cross(way, rays[:, 3:]), 0.0, atol=1e-14)
    assert (np.sum(way * rays[:, 3:], axis=1) > 0.0).all()


def test_what_is_behind_the_lens_or_over_the_horizon_is_nowhere():
    one = sensor_view()
    # Behind the lens; beside it, on a ray that does not intersect the sheet.
    assert np.isnan(one.project([[0.0, 2 * BASELINE, 2 * STAND_OFF], [0.0, 0.5, 0.2]])).all()
    assert one.aperture_solid_angle([0.0, 2 * BASELINE, 2 * STAND_OFF]) == 0.0

    # In front of the lens, on rays that part from the sheet: the sheet lies 0.1 and 0.9 of the way backwards.
    away = one.lens[1] * np.array([0.0, 1.0, 0.0])  # from the sheet to the lens
    across = away / np.linalg.norm(away)
    axis = np.array(one.axis)
    way = across + (0.1 - across @ axis) * axis
    assert way @ axis > 0.0
    assert way @ across > 0.0
    for share in (0.1, 0.9):
        assert np.isnan(one.project(np.array(one.lens) + one.lens[1] / (share * (way @ across)) * way)).all()


def test_an_untilted_lens_loses_by_the_fourth_power_of_the_cosine():
    one = sensor_view()
    u, v = np.meshgrid([-3e-3, 0.0, 2e-3], [-6e-3, 0.0, 5e-3])
    cosine = FOCAL / np.sqrt(FOCAL**2 + u**2 + v**2)
    opening = 0.25 * math.pi * one.aperture**2
    np.testing.assert_allclose(one.etendue(u, v), opening / FOCAL**2 * cosine**4, rtol=1e-12)


@pytest.mark.parametrize("tilt", [None, 0.0, 0.3])
@pytest.mark.parametrize("lens", LENSES)
def test_a_patch_gives_what_its_image_gets(tilt, lens):
    # A small patch of radiance 1 outside the sheet: its power through the lens equals the power of its image.
    one = sensor_view(tilt=tilt, distortion=lens)
    middle, e1, e2 = np.array([4e-3, 6e-3, 3e-3]), np.array([1.0, 0.2, -0.1]), np.array([0.1, 0.9, 0.3])
    size = 1e-6
    normal = np.cross(e1, e2) * size**2
    towards = one.lens_at(0.0) - middle
    sent = one.aperture_solid_angle(middle) * abs(normal @ towards) / np.linalg.norm(towards)
    corner = one.project([middle, middle + size * e1, middle + size * e2])
    image = abs(np.linalg.det(corner[1:] - corner[0]))
    np.testing.assert_allclose(sent, one.etendue(*corner[0]) * image, rtol=1e-4)


def test_light_is_counted_once_and_its_moment_kept():
    one = sensor_view()
    rng = np.random.default_rng(5)
    u, v, power = rng.uniform(-4e-3, 4e-3, 500), rng.uniform(-7e-3, 7e-3, 500), rng.uniform(0.0, 1.0, 500)
    got = one.deposit_spots(u, v, power)
    inside = (np.abs(u) <= 3e-3) & (np.abs(v) <= 6e-3)
    for k in range(one.samples):
        here = inside & (v >= one.v_edges[k]) & (v < one.v_edges[k + 1])
        np.testing.assert_allclose(got.total()[k], power[here].sum(), rtol=1e-12)
        np.testing.assert_allclose(got.first_moment(one.u_edges)[k], (power * u)[here].sum(), rtol=1e-9, atol=1e-18)
    twice = got + got
    np.testing.assert_array_equal(twice.power, 2.0 * got.power)
    assert isinstance(one.dark(), Exposure)


def test_the_ends_of_the_sensor_belong_to_it():
    one = sensor_view()
    np.testing.assert_array_equal(one.bin_of([-3e-3, 3e-3, 3.1e-3, np.nan]), [0, 11, -1, -1])
    np.testing.assert_array_equal(one.sample_of([-6e-3, 6e-3, -6.1e-3]), [0, 6, -1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lens": (0.0, 0.0, 0.2)}, "lies in the sheet"),
        ({"u_edges": np.array([0.0, 0.0])}, "u_edges"),
        ({"v_edges": np.array([1.0])}, "v_edges"),
        ({"aperture": 0.0}, "aperture"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis"),
    ],
)
def test_wrong_parameters_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        sensor_view(**change)


@pytest.mark.parametrize("sigma", [3e-5, 2.5e-4, 2e-3])
def test_a_blurred_spot_is_a_gaussian(sigma):
    one = sensor_view(u_edges=np.linspace(-3e-3, 3e-3, 61))
    # In one bin each, off its middle; the last one loses light at the sensor's end.
    at, light = np.array([0.37e-3, -1.02e-3, 2.94e-3]), np.array([2.0, 1.0, 0.5])
    got = one.blur(one.deposit_spots(at, [0.0, 0.0, 0.0], light), sigma)
    edge = (one.u_edges[:, None] - at) / sigma
    below = 0.5 * (1.0 + np.vectorize(math.erf)(edge / math.sqrt(2.0)))
    bell = np.exp(-0.5 * edge**2) / math.sqrt(math.tau)
    np.testing.assert_allclose(got.power[3], np.diff(below, axis=0) @ light, atol=1e-11)
    whole = (at * (below[-1] - below[0]) - sigma * (bell[-1] - bell[0])) @ light
    np.testing.assert_allclose(got.first_moment(one.u_edges)[3], whole, atol=1e-14)
    assert (got.power >= 0.0).all()
    assert not got.power[[0, 1, 2, 4, 5, 6]].any()


def test_no_blur_changes_nothing():
    one = sensor_view()
    got = one.deposit_spots([1e-3], [0.0], [1.0])
    assert one.blur(got, 0.0) is got
    assert not one.blur(one.dark(), 1e-4).power.any()
