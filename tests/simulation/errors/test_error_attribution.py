"""Attribution of errors: contributions in closed form, and their sum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.ranging.psd import PsdNoise
from gpuvision.simulation.errors.error_attribution import CAUSES, ErrorAttribution, ReadingCategory, attribute_errors
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.readings import (
    BEYOND_ENDS,
    UNIFORM,
    UNIFORM_UNOCCLUDED,
    UNOCCLUDED,
    GroundTruth,
    height_secant,
    sheet_point,
    stack_profiles,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status
from lights import LENGTH, camera, camera_view, gaussian, psd, psd_view

PIXEL = 10e-6


def truth_at(view: SensorView, u) -> GroundTruth:
    u = np.broadcast_to(np.asarray(u, float), view.samples)
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    return GroundTruth(g, h, np.where(np.isnan(h), Status.LOW_SIGNAL, 0).astype(np.uint8))


def half_spots(view: SensorView, u: np.ndarray, sigma: float, left: float, right: float, edge: np.ndarray) -> Exposure:
    """Return a Gaussian whose light left of an edge is scaled by one factor, right of it by another."""
    spot = gaussian(view, u, 1.0, sigma)
    below = np.clip((edge[:, None] - view.u_edges[:-1]) / np.diff(view.u_edges), 0.0, 1.0)
    # Edges lie on the bins' borders in these tests.
    assert np.allclose(below, np.rint(below), atol=1e-9)
    factor = np.where(below > 0.5, left, right)
    return Exposure(factor * spot.power, factor * spot.moment)


def check_sum(found: ErrorAttribution) -> None:
    total = np.sum(list(found.causes.values()), axis=0)
    np.testing.assert_allclose(total, found.error, rtol=1e-9, atol=1e-15)


def zero_height(device: Device) -> float:
    """Return the rounding of a height that is 0 [m]: in single precision 3 mm of strip have steps of 2e-10 m."""
    return 1e-9 if device.has_double else 1e-8


@pytest.mark.parametrize("method", ["moments", "shapley"])
def test_secondary_light(method: str, device: Device) -> None:
    """One secondary spot of ratio q at distance D: error q D / (1 + q), all of it secondary."""
    view, q, distance = psd_view(), 0.05, 1.2e-3
    u = np.linspace(-2e-3, 1e-3, view.samples)
    light = {"direct": gaussian(view, u, 1e-6, 5e-5), "multi-bounce": gaussian(view, u + distance, q * 1e-6, 5e-5)}
    found = attribute_errors(psd(view), light, truth_at(view, u), method=method, device=device)
    moved = q * distance / (1.0 + q)
    slope = height_secant(view.triangulation, u, u + moved, view.v_centres)
    np.testing.assert_allclose(found.error, slope * moved, rtol=1e-9 if device.has_double else 1e-3)
    np.testing.assert_allclose(found.causes["secondary"], found.error, rtol=1e-6 if device.has_double else 1e-5)
    assert (found.dominant_cause() == list(found.causes).index("secondary")).all()
    # An error of exactly the least one has no dominant cause.
    for number, error in enumerate(np.abs(found.error).tolist()):
        assert found.dominant_cause(error)[number] == -1
        assert found.dominant_cause(np.nextafter(error, 0.0))[number] == list(found.causes).index("secondary")
    check_sum(found)


def test_moments_are_shares_of_the_light(device: Device) -> None:
    """Every light source, ambient light included, shifts the reading by its share of the light times its distance."""
    view = psd_view()
    u = np.full(view.samples, 5e-4)
    lights = {"specular": (8e-4, 2e-7), "diffuse-specular": (-2e-3, 5e-8), "diffuse-diffuse": (2.5e-3, 3e-8)}
    light = {"direct": gaussian(view, u, 1e-6, 4e-5)}
    light |= {name: gaussian(view, 0.0 * u + place, power, 4e-5) for name, (place, power) in lights.items()}
    found = attribute_errors(psd(view, ambient=1e-7), light, truth_at(view, u), secondary_by_path=True, device=device)
    lights["ambient"] = (0.0, 1e-7)
    everything = 1e-6 + sum(power for _, power in lights.values())
    slope = height_secant(view.triangulation, u, found.reading.position, view.v_centres)
    for name, (place, power) in lights.items():
        np.testing.assert_allclose(found.causes[name], slope * power * (place - 5e-4) / everything, rtol=1e-6)
        np.testing.assert_allclose(found.power[name], power, rtol=1e-9)
    check_sum(found)
    complete = attribute_errors(psd(view, ambient=1e-7), light, truth_at(view, u), device=device)
    np.testing.assert_allclose(
        complete.causes["secondary"], found.causes["diffuse-specular"] + found.causes["diffuse-diffuse"], rtol=1e-9
    )


def test_the_two_methods_agree_for_little_light(device: Device) -> None:
    """They differ to second order in the secondary light's share."""
    view = psd_view()
    u = np.full(view.samples, 5e-4)
    differences = []
    for share in (0.1, 0.01):
        light = {"direct": gaussian(view, u, 1e-6, 4e-5)}
        light["diffuse-specular"] = gaussian(view, 0.0 * u - 2e-3, share * 1e-6, 4e-5)
        light["specular"] = gaussian(view, 0.0 * u + 2e-3, share * 1e-6, 4e-5)
        both = [attribute_errors(psd(view), light, truth_at(view, u), method=each, device=device) for each in METHODS]
        for found in both:
            check_sum(found)
        differences.append(np.abs(both[0].causes["specular"] - both[1].causes["specular"]).max())
    assert differences[0] > 1e-6
    assert differences[1] < differences[0] / 50.0


METHODS = ("moments", "shapley")


@pytest.mark.parametrize("method", METHODS)
def test_occlusion(method: str, device: Device) -> None:
    """An occluder that hides a spot beyond x sigma moves its centre by -sigma phi(x) / Phi(x)."""
    view, sigma = psd_view(600), 1e-4
    x = np.array([-0.5, 0.0, 0.5, 1.0, 1.5])
    u = np.full(view.samples, 2e-4)
    edge = u + x * sigma
    light = {
        "direct": half_spots(view, u, sigma, 1e-6, 0.0, edge),
        UNIFORM: half_spots(view, u, sigma, 1.0, 0.0, edge),
        UNOCCLUDED: gaussian(view, u, 1e-6, sigma),
        UNIFORM_UNOCCLUDED: gaussian(view, u, 1.0, sigma),
    }
    found = attribute_errors(psd(view), light, truth_at(view, u), method=method, device=device)
    shift = -sigma * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) / ndtr(x)
    slope = height_secant(view.triangulation, u, u + shift, view.v_centres)
    rounding = 1e-8 if device.has_double else 1e-3
    np.testing.assert_allclose(found.causes["occlusion"], slope * shift, rtol=rounding)
    np.testing.assert_allclose(found.error, slope * shift, rtol=rounding)
    np.testing.assert_allclose(found.causes["reflectivity"], 0.0, atol=1e-9)
    check_sum(found)


@pytest.mark.parametrize("method", METHODS)
def test_reflectivity_step(method: str, device: Device) -> None:
    """A step of ratio k moves it by sigma (k - 1) phi(x) / (Phi(x) + k (1 - Phi(x))), for any albedo."""
    view, sigma, k = psd_view(600), 1e-4, 5.0
    x = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    u = np.full(view.samples, -3e-4)
    direct = half_spots(view, u, sigma, 1e-7, k * 1e-7, u + x * sigma)
    white = gaussian(view, u, 1.0, sigma)
    light = {"direct": direct, UNOCCLUDED: direct, UNIFORM: white, UNIFORM_UNOCCLUDED: white}
    found = attribute_errors(psd(view), light, truth_at(view, u), method=method, device=device)
    shift = sigma * (k - 1.0) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) / (ndtr(x) + k * (1.0 - ndtr(x)))
    slope = height_secant(view.triangulation, u, u + shift, view.v_centres)
    rounding = 1e-8 if device.has_double else 1e-3
    np.testing.assert_allclose(found.causes["reflectivity"], slope * shift, rtol=rounding)
    np.testing.assert_allclose(found.causes["occlusion"], 0.0, atol=zero_height(device))
    np.testing.assert_allclose(found.causes["shape"], 0.0, atol=zero_height(device))
    check_sum(found)
    assert (found.dominant_cause(1e-7) == list(found.causes).index("reflectivity")).all()


def beyond_ends(view: SensorView, u: np.ndarray, power: float, sigma: float) -> Exposure:
    """Return the part of Gaussian spots beyond the ends of the strips: power and first moment, in the end bins."""
    light = view.dark()
    density = np.exp(-0.5 * ((view.u_edges[[0, -1]] - u[:, None]) / sigma) ** 2) / np.sqrt(2.0 * np.pi)
    below, above = ndtr((view.u_edges[0] - u) / sigma), ndtr((u - view.u_edges[-1]) / sigma)
    light.power[:, 0], light.power[:, -1] = power * below, power * above
    light.moment[:, 0] = power * (below * (u - view.u_centres[0]) - sigma * density[:, 0])
    light.moment[:, -1] = power * (above * (u - view.u_centres[-1]) + sigma * density[:, 1])
    return light


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_spots_clipped_by_the_end_of_the_strip(method: str, end: float, device: Device) -> None:
    """The error is sigma phi(c) / Phi(c), all of it clipped, also where the surface is imaged beyond the end."""
    view, sigma = psd_view(600), 5e-5
    c = np.array([2.0, 1.0, 0.0, -1.0, -2.0])
    u = end * (0.5 * LENGTH - c * sigma)
    truth = truth_at(view, u)
    truth.status[c < 0.0] = Status.OUT_OF_RANGE
    light = {"direct": gaussian(view, u, 1e-6, sigma), BEYOND_ENDS: beyond_ends(view, u, 1e-6, sigma)}
    light["diffuse-diffuse"] = view.dark()
    found = attribute_errors(psd(view), light, truth, method=method, device=device)
    shift = -end * sigma * np.exp(-0.5 * c**2) / np.sqrt(2.0 * np.pi) / ndtr(c)
    slope = height_secant(view.triangulation, u, u + shift, view.v_centres)
    rounding = 1e-6 if device.has_double else 1e-2
    np.testing.assert_allclose(found.error, slope * shift, rtol=rounding)
    np.testing.assert_allclose(found.causes["clipped"], slope * shift, rtol=rounding)
    np.testing.assert_allclose(found.causes["shape"], 0.0, atol=zero_height(device))
    assert (found.category == ReadingCategory.VALID).all()
    assert (found.dominant_cause(1e-6) == list(found.causes).index("clipped")).all()
    assert found.summary(1e-6)["surface"] == 5
    check_sum(found)
    # A mask over the end stops the light on both sides of it: nothing is clipped by the end.
    windows = np.tile(np.sort([0.0, end * (0.5 * LENGTH - 4e-5)]), (view.samples, 1))
    masked = attribute_errors(psd(view, mask=Mask(windows=windows)), light, truth, method=method, device=device)
    np.testing.assert_allclose(masked.causes["clipped"], 0.0, atol=1e-12)
    # With a margin these samples have no reading. Surfaces beyond the end are then not expected to have one.
    margin = attribute_errors(psd(view, readout={"margin": 3.0 * sigma}), light, truth, method=method, device=device)
    assert np.isnan(margin.error).all()
    category = np.where(c < 0.0, ReadingCategory.NO_SURFACE, ReadingCategory.MISSING)
    np.testing.assert_array_equal(margin.category, category)
    assert margin.failed_fraction(1e-6) == 1.0
    assert margin.summary(1e-6)["surface"] == 3


def test_all_causes_at_once(device: Device, rng: np.random.Generator) -> None:
    """For any light, the contributions, noise included, add up to the error."""
    view = psd_view(60)
    u = rng.uniform(-1e-3, 1e-3, (4, view.samples))
    light = {
        name: gaussian(view, u + rng.normal(scale=2e-4, size=u.shape), rng.uniform(0.1, 1.0, u.shape) * 1e-6, 1e-4)
        for name in (
            "direct",
            "specular",
            "diffuse-specular",
            "diffuse-diffuse",
            "multi-bounce",
            UNIFORM,
            UNOCCLUDED,
            UNIFORM_UNOCCLUDED,
        )
    }
    outer = np.full(u.shape, view.u_edges[-1])
    light[BEYOND_ENDS] = gaussian(view, outer, rng.uniform(0.1, 0.2, u.shape) * 1e-6, 1e-4)
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    simulator = psd(view, ambient=1e-7, readout={"noise": PsdNoise(independent=1e-9)})
    for method in METHODS:
        found = attribute_errors(
            simulator, light, GroundTruth(g, h, np.zeros(u.shape, np.uint8)), method=method, seed=3, device=device
        )
        check_sum(found)
        assert tuple(sorted(found.causes)) == tuple(sorted(CAUSES))
        assert all(np.abs(part).max() > 1e-7 for part in found.causes.values())
        quiet = simulator.read(light, device=device)
        np.testing.assert_allclose(found.causes["noise"], found.reading.h - quiet.h, atol=1e-9)


def test_a_camera_with_a_window(device: Device) -> None:
    """Secondary light shifts a windowed reading only if it is inside the window."""
    view = camera_view()
    pixels = np.full(view.samples, 24.0)
    u = view.u_centres[0] + PIXEL * pixels
    glow = u + PIXEL * np.array([3.0, 4.0, 5.0, 6.0, 20.0, 25.0, 30.0, 35.0])
    light = {"direct": gaussian(view, u, 1e-9, PIXEL), "diffuse-diffuse": gaussian(view, glow, 2e-11, PIXEL)}
    found = attribute_errors(
        camera(view, readout={"window": 8, "threshold": 0.0}, gain=1e-3, bits=16),
        light,
        truth_at(view, u),
        device=device,
    )
    slope = height_secant(view.triangulation, u, u, view.v_centres)
    expected = slope * 0.02 * (glow - u) / 1.02
    np.testing.assert_allclose(found.causes["secondary"][:4], expected[:4], rtol=0.05)
    np.testing.assert_allclose(found.causes["secondary"][4:], 0.0, atol=1e-8)
    check_sum(found)
    with pytest.raises(ValueError, match="cameras take 'shapley'"):
        attribute_errors(camera(view), light, truth_at(view, u), method="moments", device=device)


def test_categories(device: Device) -> None:
    """A surface without a reading, a reading without a surface, no surface and no reading, several surfaces."""
    view = psd_view()
    u = np.array([0.0, 0.0, np.nan, np.nan, np.nan])
    power = np.array([1e-6, 0.0, 0.0, 0.0, 0.0])
    glow = np.array([0.0, 0.0, 1e-7, 0.0, 1e-7])
    light = {"direct": gaussian(view, np.zeros(5), power, 1e-4)}
    light["diffuse-specular"] = gaussian(view, np.full(5, 1e-3), glow, 1e-4)
    truth = truth_at(view, u)
    truth.status[4] = Status.AMBIGUOUS
    found = attribute_errors(psd(view), light, truth, device=device)
    assert found.category.tolist() == [
        ReadingCategory.VALID,
        ReadingCategory.MISSING,
        ReadingCategory.SPURIOUS,
        ReadingCategory.NO_SURFACE,
        ReadingCategory.AMBIGUOUS,
    ]
    assert np.isfinite(found.error).tolist() == [True, False, False, False, False]
    secondary = list(found.causes).index("secondary")
    assert found.dominant_cause(1e-9).tolist() == [-1, -1, secondary, -1, -1]
    assert found.failed_fraction(1e-6) == 0.5
    # An error equal to the limit is within it.
    assert found.failed_fraction(abs(float(found.error[0]))) == 0.5
    summary = found.summary(1e-6)
    assert (summary["surface"], summary["valid"], summary["missing"], summary["spurious"], summary["ambiguous"]) == (
        2,
        1,
        1,
        1,
        1,
    )
    assert summary["causes"]["secondary"]["spurious"] == 1
    assert summary["beyond_limit"] == 0


def test_summary_counts_causes(device: Device) -> None:
    view = psd_view()
    u = np.zeros(view.samples)
    light = {"direct": gaussian(view, u, 1e-6, 4e-5)}
    light["specular"] = gaussian(view, u + 1e-3, [0.0, 1e-8, 2e-7, 0.0, 0.0], 4e-5)
    light["multi-bounce"] = gaussian(view, u - 1e-3, [0.0, 0.0, 1e-8, 3e-7, 0.0], 4e-5)
    found = attribute_errors(
        psd(view),
        stack_profiles([light] * 2),
        GroundTruth(*(np.stack([each] * 2) for each in truth_at(view, u))),
        device=device,
    )
    summary = found.summary(1e-4)
    assert summary["causes"]["specular"]["dominant"] == 2
    assert summary["causes"]["secondary"]["dominant"] == 2
    assert summary["beyond_limit"] == 4
    assert summary["max"] == pytest.approx(np.abs(found.error).max())
    assert summary["rms"] == pytest.approx(np.sqrt(np.mean(found.error**2)))
    assert "occlusion" not in summary["causes"]


def test_what_flags_take_out(device: Device) -> None:
    """A reading that is dropped because of a flag counts as missing."""
    view = psd_view()
    u = np.zeros(view.samples)
    light = {"direct": gaussian(view, u, [1e-6, 1e-6, 2e-5, 1e-6, 1e-6], 4e-5)}
    found = attribute_errors(psd(view, ambient=1e-8), light, truth_at(view, u), device=device)
    found.reading.status[2] = Status.AMBIGUOUS
    kept = found.without_flagged(Status.AMBIGUOUS)
    assert np.isnan(kept.error).tolist() == [False, False, True, False, False]
    assert kept.category.tolist() == [0, 0, ReadingCategory.MISSING, 0, 0]
    assert np.isfinite(found.error).all()
    assert kept.summary(1.0)["valid"] == 4


def test_signals_add_up_to_the_reading(device: Device) -> None:
    """The signals from which Shapley values are computed add up to the reading."""
    for simulator in (psd(ambient=1e-7), camera(gain=1e-4, offset=3.0, ambient=1e-12, readout={"threshold": 1.0})):
        view = simulator.view
        u = np.broadcast_to(view.u_centres[view.bins // 3], view.samples)
        light = {"direct": gaussian(view, u, 1e-9, 2.0 * np.diff(view.u_edges)[0])}
        light["multi-bounce"] = gaussian(view, u + 3.0 * np.diff(view.u_edges)[0], 1e-10, np.diff(view.u_edges)[0])
        signals = [simulator.signal(each) for each in simulator.detected_light(light).values()]
        assert len(signals) == 3
        heights = simulator.heights(sum(signals[1:], start=signals[0]), device)
        np.testing.assert_allclose(heights, simulator.read(light, device=device).h, rtol=1e-5, atol=1e-8)


def test_a_part_in_shadow_says_nothing(device: Device) -> None:
    """Without light the errors are flagged, not zero, and a report can still be written."""
    view = psd_view()
    found = attribute_errors(psd(view), {"direct": view.dark()}, truth_at(view, np.nan), device=device)
    assert (found.category == ReadingCategory.NO_SURFACE).all()
    assert np.isnan(found.error).all()
    summary = found.summary(1e-6)
    assert (summary["rms"], summary["max"], summary["median"], summary["failed_fraction"]) == (None, None, None, 0.0)


def test_what_is_refused(device: Device) -> None:
    view = psd_view()
    light = {"direct": gaussian(view, [0.0], 1e-6, 1e-4)}
    truth = truth_at(view, 0.0)
    with pytest.raises(ValueError, match="or none of them"):
        attribute_errors(psd(view), light | {UNIFORM: light["direct"]}, truth, device=device)
    with pytest.raises(ValueError, match="expected the same"):
        attribute_errors(psd(view), light, GroundTruth(*(each[:3] for each in truth)), device=device)
