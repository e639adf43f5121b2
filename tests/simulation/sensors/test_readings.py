"""Common parts of simulated sensors: sheet points, slopes, and light by path."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.readings import (
    AMBIENT,
    PATHS,
    UNIFORM,
    AlignmentLimits,
    GroundTruth,
    add_ambient,
    check_sample_axes,
    height_secant,
    height_slope,
    profile_generators,
    sheet_point,
    stack_profiles,
    strongest_points,
    total_exposure,
)
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from lights import LENGTH, PITCH, gaussian, psd_view
from sensor_views import sensor_view

LENSES = [None, Lens(k1=-4000.0), Lens(k1=2000.0, k2=1e7, centre=(1e-4, -2e-4))]


def with_lens(lens: Lens | None) -> Triangulation:
    return replace(psd_view().triangulation, lens=lens)


@pytest.mark.parametrize("lens", LENSES)
def test_sheet_points_are_the_triangulation_s(lens: Lens | None, device: Device, rng: np.random.Generator) -> None:
    triangulation = with_lens(lens)
    u, v = rng.uniform(-0.5 * LENGTH, 0.5 * LENGTH, 64), rng.uniform(-2 * PITCH, 2 * PITCH, 64)
    real = np.float64 if device.has_double else np.float32
    said = triangulation(u.astype(real), v.astype(real), device=device)
    g, h = sheet_point(triangulation, u, v)
    np.testing.assert_allclose(g, said.g, atol=1e-12 if device.has_double else 1e-8)
    np.testing.assert_allclose(h, said.h, atol=1e-12 if device.has_double else 1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_secants(lens: Lens | None, rng: np.random.Generator) -> None:
    """Difference quotients keep their accuracy for distances towards 0."""
    triangulation = with_lens(lens)
    u, other = rng.uniform(-0.5 * LENGTH, 0.5 * LENGTH, (2, 50))
    v = rng.uniform(-2 * PITCH, 2 * PITCH, 50)
    rise = sheet_point(triangulation, other, v)[1] - sheet_point(triangulation, u, v)[1]
    np.testing.assert_allclose(height_secant(triangulation, u, other, v) * (other - u), rise, rtol=1e-9, atol=1e-16)
    step = 1e-6
    slope = (sheet_point(triangulation, u + step, v)[1] - sheet_point(triangulation, u - step, v)[1]) / (2.0 * step)
    for near in (0.0, 1e-15, 1e-11, 1e-9):
        # The secant differs from the derivative by the change of the derivative over the distance.
        np.testing.assert_allclose(height_secant(triangulation, u, u + near, v), slope, rtol=1e-6)


def test_slope_at_the_truth() -> None:
    view = psd_view()
    u = np.linspace(-2e-3, 2e-3, view.samples)
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    h[1] = np.nan
    found, slope = height_slope(view, GroundTruth(g, h, np.zeros(5, np.uint8)))
    known = np.arange(5) != 1
    np.testing.assert_allclose(found[known], u[known], atol=1e-15)
    assert np.isnan(found[1])
    np.testing.assert_allclose(slope[known], height_secant(view.triangulation, u, u, view.v_centres)[known], rtol=1e-10)


def test_beyond_the_horizon_there_is_no_point() -> None:
    triangulation = psd_view().triangulation
    row = triangulation.homography[2]
    horizon = -row[2] / row[0]
    g, h = sheet_point(triangulation, [0.9 * horizon, 1.1 * horizon], 0.0)
    assert np.isnan(h).tolist() == [False, True]
    assert np.isnan(g).tolist() == [False, True]


def test_light_of_profiles() -> None:
    """Paths are summed, variants of the direct light are not; a path that a profile lacks has no light."""
    view = psd_view()
    spots = [gaussian(view, [place], 1e-6, 1e-4) for place in (-1e-3, 0.0, 1e-3)]
    block = stack_profiles([{"direct": spots[0], UNIFORM: spots[2]}, {"direct": spots[1], "multi-bounce": spots[2]}])
    assert not block["multi-bounce"].power[0].any()
    np.testing.assert_array_equal(total_exposure(block).power, [spots[0].power, spots[1].power + spots[2].power])
    np.testing.assert_array_equal(total_exposure(block).moment, [spots[0].moment, spots[1].moment + spots[2].moment])
    bright = add_ambient(view, add_ambient(view, block, 1e-6), 2e-6)
    np.testing.assert_allclose(bright[AMBIENT].total(), 3e-6, rtol=1e-14)
    for wrong in ([], [{}]):
        with pytest.raises(ValueError, match="one or more profiles"):
            stack_profiles(wrong)
    with pytest.raises(ValueError, match="different shapes"):
        total_exposure({"direct": spots[0], "multi-bounce": block["multi-bounce"]})


def test_paths_are_known() -> None:
    view = psd_view()
    spot = gaussian(view, [0.0], 1e-6, 1e-4)
    with pytest.raises(
        ValueError, match=r"unknown path 'glow', expected some of direct, specular, .*, ambient, direct, u"
    ):
        total_exposure({"direct": spot, "glow": spot})
    with pytest.raises(ValueError, match="expected light of one path or more; paths are direct, specular"):
        total_exposure({})
    with pytest.raises(ValueError, match=r"one path or more out of direct, .*, got none"):
        add_ambient(view, {}, 1.0)
    with pytest.raises(ValueError, match=r"multi-bounce, got \['ambient'\]"):
        add_ambient(view, {AMBIENT: spot}, 1.0)
    # Only the hypothetical variants: nothing is received.
    assert not total_exposure({UNIFORM: spot}).power.any()
    assert list(add_ambient(view, {"direct": spot}, 0.0)) == ["direct"]


def test_three_paths_are_summed_and_kept() -> None:
    view = psd_view()
    light = {name: gaussian(view, [k * 5e-4], 1e-6 * (k + 1), 1e-4) for k, name in enumerate(PATHS)}
    before = {name: each.power.copy() for name, each in light.items()}
    total = total_exposure(light)
    np.testing.assert_allclose(total.total(), 15e-6, rtol=1e-12)
    np.testing.assert_allclose(total.moment, sum(each.moment for each in light.values()), rtol=1e-12)
    for name, power in before.items():
        np.testing.assert_array_equal(light[name].power, power)


def test_ambient_light_is_uniform_along_u() -> None:
    """Bins of unequal width get light in proportion to it, and no moment about their middles."""
    view = sensor_view(u_edges=[-3e-3, -2e-3, 1e-3, 1.5e-3])
    dark = view.dark()
    made = add_ambient(view, {"direct": dark}, 4.5)[AMBIENT]
    np.testing.assert_allclose(made.power, np.tile([1.0, 3.0, 0.5], (view.samples, 1)), rtol=1e-12)
    assert not made.moment.any()
    np.testing.assert_allclose(add_ambient(view, {"direct": dark}, 2.0)[AMBIENT].total(), 2.0, rtol=1e-12)


def test_noise_depends_on_the_seed_and_the_number_of_the_profile() -> None:
    first = [each.random() for each in profile_generators(7, 3, (2, 3))]
    assert len(set(first)) == 6
    assert [each.random() for each in profile_generators(7, 5, (4,))] == first[2:6]
    assert profile_generators(8, 3, (1,))[0].random() not in first
    assert first[0] == np.random.default_rng([7, 3]).random()


def test_the_brightest_place_is_the_truth_of_a_sample() -> None:
    """Places on the sensor before places in view; others on the sensor count if they are farther than rounding."""
    sample = np.array([0, 0, 0, 1, 1, 2, 2, 4, 4])
    places = np.array(
        [
            [1.0, 8.0],
            [2.0, 7.0],
            [1.0, 8.0],
            [3.0, 1.0],
            [3.0 + 0.7e-3, 1.0],
            [4.0, 2.0],
            [5.0, 3.0],
            [6.0, 1.0],
            [7.0, 1.5],
        ]
    )
    on = np.array([True, True, True, True, True, False, True, False, False])
    in_view = np.array([True, True, True, True, True, True, True, True, False])
    light = np.array([5.0, 9.0, 1.0, 2.0, 1.0, 8.0, 1.0, 1.0, 9.0])
    found = strongest_points(5, sample, places, on, in_view, light, same=1e-4)
    np.testing.assert_array_equal(found.g, [2.0, 3.0, 5.0, np.nan, 6.0])
    np.testing.assert_array_equal(found.h, [7.0, 1.0, 3.0, np.nan, 1.0])
    assert found.status.tolist() == [Status.AMBIGUOUS, 0, 0, Status.LOW_SIGNAL, Status.OUT_OF_RANGE]
    close = strongest_points(5, sample, places, on, in_view, light, same=0.8e-4)
    assert close.status.tolist() == [Status.AMBIGUOUS, Status.AMBIGUOUS, 0, Status.LOW_SIGNAL, Status.OUT_OF_RANGE]
    nothing = strongest_points(2, *(each[:0] for each in (sample, places, on, in_view, light)), same=1e-4)
    assert nothing.status.tolist() == [Status.LOW_SIGNAL] * 2
    assert np.isnan([nothing.g, nothing.h]).all()


def test_a_path_of_another_shape_is_named() -> None:
    view = psd_view()
    spot = gaussian(view, [0.0], 1e-6, 1e-4)
    samples, bins = spot.power.shape[-2:]
    for power in (spot.power[..., 1:], spot.power[None, 1:]):
        expected = f"direct: light has shape {power.shape}, expected (..., {samples}, {bins})"
        with pytest.raises(ValueError, match=re.escape(expected)):
            add_ambient(view, {"direct": Exposure(power, 0.0 * power)}, 0.0)


def test_samples_at_other_places_are_named() -> None:
    """The readout's axes may run either way; beyond the tolerance both ranges are stated."""
    view = sensor_view(v_edges=[-3.0, -1.0, 1.0, 3.0, 5.0])  # samples at -2, 0, 2 and 4
    limits = AlignmentLimits(pitch_tolerance=0.25)
    for origin, pitch in ((-2.0, 2.0), (4.0, -2.0), (-1.5, 2.0), (-2.5, 2.0), (4.5, -2.0), (3.5, -2.0)):
        check_sample_axes(view, origin, pitch, limits)
    for origin, pitch, low, high in (
        (-1.25, 2.0, "-1.25", "4.75"),
        (3.25, -2.0, "-2.75", "3.25"),
        (-2.0, 2.5, "-2", "5.5"),
    ):
        message = f"the view's samples are at v = -2 ... 4, the readout's axes place them at {low} ... {high}; expected"
        with pytest.raises(ValueError, match=re.escape(message)):
            check_sample_axes(view, origin, pitch, limits)
