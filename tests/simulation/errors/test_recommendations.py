"""Countermeasures against errors: choice of a reflection, and two sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.ranging.psd import PsdNoise
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.errors.error_attribution import attribute_errors
from gpuvision.simulation.errors.recommendations import compare_peak_selections, rank_candidates
from gpuvision.simulation.errors.resampling import resample_reading
from gpuvision.simulation.errors.sensor_fusion import BOTH, FIRST, NONE, SECOND, SensorFusion
from gpuvision.simulation.errors.sensor_pair import attribute_pair_errors
from gpuvision.simulation.sensors.readings import (
    GroundTruth,
    Reading,
    sheet_point,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status
from lights import PITCH, camera, camera_view, gaussian, psd, psd_view

PIXEL = 10e-6


def reading(h, sigma=1e-6, strength=1.0, width=3.0, status=0, g=None) -> Reading:
    h = np.asarray(h, float)
    full = [np.broadcast_to(np.asarray(each, float), h.shape).copy() for each in (sigma, strength, width)]
    places = np.linspace(0.0, 1e-3, h.shape[-1]) if g is None else np.asarray(g, float)
    flags = np.broadcast_to(np.asarray(status, np.uint8), h.shape) | np.where(np.isnan(h), Status.LOW_SIGNAL, 0)
    return Reading(h.copy(), np.broadcast_to(places, h.shape).copy(), h, *full, flags.astype(np.uint8))


# ---- two sensors over a step -----------------------------------------------------------------------------------


def facing(view: SensorView) -> SensorView:
    """Return the same sensor from the other side of the sheet."""
    x, y, z = view.lens
    return SensorView(
        triangulation=view.triangulation,
        transport=StraightTransport(),
        lens=(x, -y, z),
        u_edges=view.u_edges,
        v_edges=view.v_edges,
    )


def thick_line(view: SensorView, sigma: float, factor: np.ndarray, across: np.ndarray) -> Exposure:
    """Return light of a sheet with a Gaussian across on the plane H = 0, times a factor at every position across."""
    weight = np.exp(-0.5 * (across / sigma) ** 2) * factor
    points = np.stack(np.broadcast_arrays(0.0, across, 0.0), axis=-1)
    u, _ = np.moveaxis(view.project(points), -1, 0)
    light = view.dark()
    for v in view.v_centres:
        light = light + view.deposit_spots(u, v, 1e-9 * weight)
    return light


SIGMA, X = 5e-5, 0.4
# Scale on the plane H = 0: 0.1 mm times 170 mm over 40 mm.
PLACES = np.arange(-2, 3) * PITCH * 0.17 / 0.04
ACROSS = (np.arange(-4000, 4000) + 0.5) * (6.0 * SIGMA / 4000)


def phi(x: float) -> float:
    return float(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))


@pytest.fixture
def level() -> GroundTruth:
    return GroundTruth(np.zeros(5), np.zeros(5), np.zeros(5, np.uint8))


def test_reflectivity_step_seen_from_both_sides(level: GroundTruth, device: Device) -> None:
    """Errors of shift / tan(theta) with opposite signs: the mean is correct, no other rule is."""
    view, k = psd_view(), 4.0
    factor = np.where(ACROSS > X * SIGMA, k, 1.0)
    share = float(ndtr(X))
    shift = SIGMA * (k - 1.0) * phi(X) / (share + k * (1.0 - share))
    sensors = [psd(each, readout={"noise": PsdNoise(independent=1e-12)}) for each in (view, facing(view))]
    readings = [each.read({"direct": thick_line(each.view, SIGMA, factor, ACROSS)}, device=device) for each in sensors]
    expected = shift * 0.15 / 0.08
    np.testing.assert_allclose(np.abs(readings[0].h), expected, rtol=2e-3)
    np.testing.assert_allclose(readings[1].h, -readings[0].h, rtol=4e-3)
    flagged = SensorFusion().fuse(*readings)
    assert np.isnan(flagged.h).all()
    assert (flagged.status == Status.AMBIGUOUS).all()
    mean = SensorFusion(rule="mean").fuse(*readings)
    assert np.abs(mean.h).max() < 2e-3 * expected
    assert (mean.source == BOTH).all()
    errors = [
        attribute_errors(each, {"direct": thick_line(each.view, SIGMA, factor, ACROSS)}, level, device=device).error
        for each in sensors
    ]
    predicted = SensorFusion(rule="predicted").fuse(*readings, predicted=(errors[0], errors[1]))
    assert (predicted.source == BOTH).all()


def test_half_a_beam_hidden_from_one(level: GroundTruth, device: Device) -> None:
    """The sensor with the complete beam in view is correct and has more light; the mean has half the error."""
    view = psd_view()
    hidden = (ACROSS < X * SIGMA).astype(float)
    full_beam, half = (
        psd(each).read({"direct": thick_line(each, SIGMA, factor, ACROSS)}, device=device)
        for each, factor in ((view, np.ones_like(ACROSS)), (facing(view), hidden))
    )
    share = float(ndtr(X))
    error = SIGMA * phi(X) / share * 0.15 / 0.08
    np.testing.assert_allclose(np.abs(half.h), error, rtol=2e-3)
    for rule, predicted in (("stronger", None), ("predicted", (1e-9, error))):
        fused = SensorFusion(rule=rule, tolerance=1e-6).fuse(full_beam, half, predicted)
        assert (fused.source == FIRST).all()
        assert np.abs(fused.h).max() < 1e-3 * error
        turned = SensorFusion(rule=rule, tolerance=1e-6).fuse(half, full_beam, predicted and predicted[::-1])
        assert (turned.source == SECOND).all()
    mean = SensorFusion(rule="mean").fuse(full_beam, half)
    np.testing.assert_allclose(np.abs(mean.h), 0.5 * error, rtol=5e-3)


def test_a_part_seen_by_two(level: GroundTruth, device: Device) -> None:
    """Rank a pair together with its single sensors: occlusion hides half of the beam from each at other places."""
    view = psd_view()
    hidden = (ACROSS < X * SIGMA).astype(float)
    found = []
    for each, from_here in ((view, [0, 1]), (facing(view), [3, 4])):
        full_beam, half = (thick_line(each, SIGMA, factor, ACROSS) for factor in (np.ones_like(ACROSS), hidden))
        seen = np.isin(np.arange(5), from_here)[:, None]
        light = Exposure(*(np.where(seen, one, other) for one, other in zip(half, full_beam, strict=True)))
        variants = {
            "direct": light,
            "direct, uniform": light,
            "direct, unoccluded": full_beam,
            "direct, uniform, unoccluded": full_beam,
        }
        found.append(attribute_errors(psd(each), variants, level._replace(g=PLACES), device=device))
    candidates = attribute_pair_errors(*found, SensorFusion(rule="predicted"), max_gap=1.0, g=PLACES)
    order = rank_candidates(candidates, 1e-6)
    assert order[0].name == "both"
    assert [each.failed_fraction for each in order] == [0.0, 0.4, 0.4]
    for each in candidates.values():
        np.testing.assert_allclose(np.sum(list(each.causes.values()), axis=0), each.error, atol=1e-12)
    flagged = attribute_pair_errors(*found, SensorFusion(tolerance=1e-6), max_gap=1.0, g=PLACES)["both"]
    assert np.isfinite(flagged.error).tolist() == [False, False, True, False, False]
    assert flagged.summary(1e-6)["missing"] == 4
    mean = attribute_pair_errors(*found, SensorFusion(rule="mean"), max_gap=1.0, g=PLACES)["both"]
    for each in (flagged, mean):
        np.testing.assert_allclose(np.sum(list(each.causes.values()), axis=0), each.error, atol=1e-12)
    np.testing.assert_allclose(mean.causes["occlusion"][3:], 0.5 * found[1].causes["occlusion"][3:], rtol=1e-3)
    np.testing.assert_allclose(mean.causes["occlusion"][:2], 0.5 * found[0].causes["occlusion"][:2], rtol=1e-3)


def test_what_one_does_not_see_the_other_does(device: Device) -> None:
    """Surfaces hidden from the first sensor count as missing for it, and the second sensor supplies them."""
    view = psd_view()
    u = np.zeros(5)
    truth = GroundTruth(*sheet_point(view.triangulation, u, view.v_centres), np.zeros(5, np.uint8))
    found = []
    for each, hidden in ((view, [0, 1]), (facing(view), [4])):
        lost = np.isin(np.arange(5), hidden)
        seen = GroundTruth(
            truth.g, np.where(lost, np.nan, truth.h), np.where(lost, Status.LOW_SIGNAL, 0).astype(np.uint8)
        )
        found.append(
            attribute_errors(psd(each), {"direct": gaussian(each, u, ~lost * 1e-6, 5e-5)}, seen, device=device)
        )
    pair = attribute_pair_errors(*found, SensorFusion(tolerance=1e-6), max_gap=1.0)
    assert [pair[name].failed_fraction(1e-6) for name in ("first", "second", "both")] == [0.4, 0.2, 0.0]
    # The sensor that reads alone gives its causes; what the other one does not have is no part of them.
    both = pair["both"]
    for name, part in both.causes.items():
        expected = [pair[each].causes[name][k] for k, each in enumerate(["second"] * 2 + [""] * 2 + ["first"]) if each]
        np.testing.assert_array_equal(part[[0, 1, 4]], expected)
    np.testing.assert_allclose(np.sum(list(both.causes.values()), axis=0), both.error, atol=1e-12)
    np.testing.assert_array_equal(both.reading.strength[:2], pair["second"].reading.strength[:2])
    np.testing.assert_array_equal(both.reading.strength[4], pair["first"].reading.strength[4])
    for name, part in both.power.items():
        np.testing.assert_allclose(part, pair["first"].power[name] + pair["second"].power[name], rtol=1e-12)
    blind = found[0].without_flagged(Status.LOW_SIGNAL)
    no_surface = GroundTruth(np.full(5, np.nan), np.full(5, np.nan), np.full(5, Status.LOW_SIGNAL))
    with pytest.raises(ValueError, match="give the positions"):
        attribute_pair_errors(replace(blind, truth=no_surface), found[1], SensorFusion(), max_gap=1.0)


# ---- the rules -------------------------------------------------------------------------------------------------


def test_agreeing_readings_are_weighed_by_their_noise() -> None:
    one, other = reading([1e-3, 1e-3], sigma=[1e-6, 0.0]), reading([1.003e-3, 1e-3], sigma=[2e-6, 0.0])
    fused = SensorFusion(max_sigmas=3.0).fuse(one, other)
    np.testing.assert_allclose(fused.h, [0.8e-3 + 0.2 * 1.003e-3, 1e-3], rtol=1e-12)
    np.testing.assert_allclose(fused.sigma, [2e-6 / np.sqrt(5.0), 0.0], rtol=1e-12)
    assert (fused.source == BOTH).all()
    assert fused.first_weight.tolist() == pytest.approx([0.8, 0.5], rel=1e-12)
    assert not fused.status.any()
    assert np.isnan(SensorFusion(max_sigmas=1.0).fuse(one, other).h).tolist() == [True, False]
    assert np.isfinite(SensorFusion(max_sigmas=0.0, tolerance=4e-6).fuse(one, other).h).all()


def test_readings_agree_up_to_their_sigmas_and_the_tolerance() -> None:
    """Sigmas of 3 and 4 um, two sigmas and 5 um: the limit is 15 um; exact numbers, on the limit and beyond."""
    unit = 2.0**-20
    one = reading([0.0, 0.0, 0.0, 1.0], sigma=3.0 * unit)
    other = reading(np.array([15.0, -15.0, 15.0 + 2.0**-20, 0.0]) * unit + [0.0, 0.0, 0.0, 1.0], sigma=4.0 * unit)
    fused = SensorFusion(max_sigmas=2.0, tolerance=5.0 * unit).fuse(one, other)
    assert fused.source.tolist() == [BOTH, BOTH, NONE, BOTH]
    np.testing.assert_allclose(fused.first_weight, [0.64, 0.64, np.nan, 0.64], rtol=1e-14)
    np.testing.assert_allclose(fused.h[:2], [0.36 * 15.0 * unit, -0.36 * 15.0 * unit], rtol=1e-12)
    np.testing.assert_allclose(fused.sigma[[0, 1, 3]], 2.4 * unit, rtol=1e-12)
    unknown = SensorFusion(tolerance=1.0).fuse(reading([0.0], sigma=np.nan), reading([1.0], sigma=1.0))
    assert (unknown.first_weight.tolist(), unknown.h.tolist()) == ([0.5], [0.5])


@pytest.mark.parametrize("flag", [Status.SATURATED, Status.AMBIGUOUS])
def test_two_doubtful_readings_are_left_to_the_rule(flag: Status) -> None:
    one, other = reading([1e-3] * 2, status=[flag, 0], strength=3.0), reading([2e-3] * 2, status=[flag, flag])
    assert SensorFusion().fuse(one, other).source.tolist() == [NONE, FIRST]
    assert SensorFusion(rule="stronger").fuse(one, other).source.tolist() == [FIRST, FIRST]
    assert SensorFusion().fuse(one, other).status.tolist() == [Status.AMBIGUOUS, 0]
    assert SensorFusion(rule="mean").fuse(one, other).status.tolist() == [flag, 0]


def test_values_on_the_ratio_decide() -> None:
    """The chosen sensor is better by the factor 1.5 or more, in either order; a dark one never wins."""
    one, other = (
        reading([1e-3] * 4, strength=[3.0, 2.0, 3.0, 0.0]),
        reading([2e-3] * 4, strength=[2.0, 3.0, 2.125, 1e-9]),
    )
    assert SensorFusion(rule="stronger").fuse(one, other).source.tolist() == [FIRST, SECOND, NONE, SECOND]
    one, other = reading([1e-3] * 3, width=[2.0, 3.0, 2.0]), reading([2e-3] * 3, width=[3.0, 2.0, 2.875])
    assert SensorFusion(rule="narrower").fuse(one, other).source.tolist() == [FIRST, SECOND, NONE]
    # Errors of the first, of the second, and their mean.
    errors = ([2.0, -5.0, 4.0, np.nan], [3.0, 2.0, -6.0, np.nan])
    found = SensorFusion(rule="predicted").fuse(reading([1e-3] * 4), reading([2e-3] * 4), errors)
    assert found.source.tolist() == [NONE, NONE, BOTH, NONE]
    closer = SensorFusion(rule="predicted", min_ratio=1.25).fuse(reading([1e-3] * 4), reading([2e-3] * 4), errors)
    assert closer.source.tolist() == [FIRST, BOTH, BOTH, NONE]


def test_one_reading_alone() -> None:
    one, other = reading([1e-3, np.nan, np.nan]), reading([np.nan, 2e-3, np.nan])
    fused = SensorFusion().fuse(one, other)
    assert fused.source.tolist() == [FIRST, SECOND, NONE]
    np.testing.assert_array_equal(fused.first_weight, [1.0, 0.0, np.nan])
    np.testing.assert_array_equal(fused.h, [1e-3, 2e-3, np.nan])
    assert fused.status.tolist() == [0, 0, Status.LOW_SIGNAL]
    strict = SensorFusion(accept_single=False).fuse(one, other)
    assert np.isnan(strict.h).all()
    assert (strict.status != 0).all()


def test_doubtful_readings_give_way() -> None:
    """If two readings disagree, a saturated or ambiguous reading is not used."""
    one = reading([1e-3, 1e-3], status=[Status.SATURATED, 0])
    other = reading([2e-3, 2e-3], status=[0, Status.AMBIGUOUS])
    assert SensorFusion().fuse(one, other).source.tolist() == [SECOND, FIRST]


def test_min_ratio() -> None:
    """If neither sensor is clearly better, there is no value."""
    one, other = reading([1e-3] * 3, strength=[1.0, 1.4, 2.0]), reading([2e-3] * 3, strength=[2.0, 1.0, 1.0])
    assert SensorFusion(rule="stronger").fuse(one, other).source.tolist() == [SECOND, NONE, FIRST]
    one, other = reading([1e-3] * 3, width=[3.0, 4.0, 9.0]), reading([2e-3] * 3, width=[6.0, 5.0, 3.0])
    assert SensorFusion(rule="narrower").fuse(one, other).source.tolist() == [FIRST, NONE, SECOND]
    errors = ([1e-6, 9e-6, np.nan], [1e-3, -9e-6, 1e-6])
    assert SensorFusion(rule="predicted").fuse(one, other, errors).source.tolist() == [FIRST, BOTH, SECOND]


def test_what_fusion_refuses() -> None:
    one, other = reading([1e-3]), reading([2e-3], width=np.nan)
    with pytest.raises(ValueError, match="predicted=\\(a, b\\)"):
        SensorFusion(rule="predicted").fuse(one, other)
    with pytest.raises(ValueError, match="only cameras measure"):
        SensorFusion(rule="narrower").fuse(one, other)
    with pytest.raises(ValueError, match="expected the same"):
        SensorFusion().fuse(one, reading([1e-3, 1e-3]))
    with pytest.raises(ValueError, match="rule is 'best'"):
        SensorFusion(rule="best")
    with pytest.raises(ValueError, match=r"min_ratio is 0\.5"):
        SensorFusion(min_ratio=0.5)


# ---- places along the sheet ------------------------------------------------------------------------------------


def test_resampling() -> None:
    """A straight profile stays straight, between its points and at them; holes shrink by at most half a sample."""
    g = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 7.0]) * 1e-4
    h = 2.0 * g + 1e-3
    h[3] = np.nan
    given = reading(h, g=g, status=[0, 0, 0, 0, Status.SATURATED, 0])
    at = np.array([0.0, 0.25, 1.0, 2.0, 2.5, 4.0, 7.0]) * 1e-4
    made = resample_reading(given, at, max_gap=2.5e-4)
    np.testing.assert_allclose(made.h, 2.0 * at + 1e-3, rtol=1e-12)
    np.testing.assert_array_equal(made.g, at)
    assert made.status.tolist() == [0, 0, 0, 0, Status.SATURATED, Status.SATURATED, 0]
    # The median distance of points is 0.15 mm.
    at_holes = resample_reading(given, np.array([-0.7, -0.8, 4.7, 4.8, 6.3, 7.8, np.nan]) * 1e-4, max_gap=2.5e-4)
    np.testing.assert_array_equal(at_holes.h, [h[0], np.nan, h[4], np.nan, h[5], np.nan, np.nan])
    assert at_holes.status.tolist() == [
        0,
        Status.NO_DATA,
        Status.SATURATED,
        Status.NO_DATA,
        0,
        Status.NO_DATA,
        Status.NO_DATA,
    ]
    block = resample_reading(Reading(*(np.stack([each, each]) for each in given)), at, max_gap=2.5e-4)
    np.testing.assert_array_equal(block.h, np.stack([made.h, made.h]))
    alone = resample_reading(reading([np.nan, 1e-3]), np.array([0.0, 1e-3, 1.2e-3]), max_gap=3e-4)
    np.testing.assert_array_equal(alone.h, [np.nan, 1e-3, np.nan])
    assert (resample_reading(reading([np.nan, np.nan]), at, max_gap=1.0).status == Status.NO_DATA).all()


# ---- reflections -----------------------------------------------------------------------------------------------


def test_choice_of_a_peak(device: Device) -> None:
    """A mirror image that outshines the line, always on the same side: the first peak is the line."""
    view = camera_view()
    u = np.full(view.samples, view.u_centres[20])
    light = {
        "direct": gaussian(view, u, 1e-9, PIXEL),
        "diffuse-specular": gaussian(view, u + 25 * PIXEL, 3e-9, PIXEL),
    }
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    truth = GroundTruth(g, h, np.zeros(u.shape, np.uint8))
    found = compare_peak_selections(camera(view, readout={"threshold": 1.0}, gain=5e-5), light, truth, device=device)
    order = rank_candidates(found, 1e-5)
    assert order[0].name == "first"
    assert [each.failed_fraction for each in order] == [0.0, 1.0, 1.0]
    assert order[0].rms < 1e-6
    assert (found["strongest"].dominant_cause(1e-5) == list(found["strongest"].causes).index("secondary")).all()


def test_rank_of_directions(device: Device) -> None:
    """The position with less gloss in view is ranked first; spurious and missing readings have equal weight."""
    view = psd_view()
    u = np.zeros(view.samples)
    truth = GroundTruth(*sheet_point(view.triangulation, u, view.v_centres), np.zeros(5, np.uint8))
    direct = gaussian(view, u, 1e-6, 5e-5)
    gloss = {name: gaussian(view, u + 1e-3, power, 5e-5) for name, power in (("shiny", 1e-6), ("dull", 1e-9))}
    found = {
        name: attribute_errors(psd(view), {"direct": direct, "specular": each}, truth, device=device)
        for name, each in gloss.items()
    }
    no_surface = GroundTruth(truth.g, np.full(5, np.nan), np.full(5, Status.LOW_SIGNAL, np.uint8))
    found["false"] = attribute_errors(psd(view), {"direct": direct}, no_surface, device=device)
    order = rank_candidates(found, 1e-4)
    assert order[0].name == "dull"
    assert {each.name: (each.failed_fraction, each.spurious_fraction) for each in order} == {
        "dull": (0.0, 0.0),
        "shiny": (1.0, 0.0),
        "false": (0.0, 1.0),
    }
    with pytest.raises(ValueError, match="one candidate"):
        rank_candidates({}, 1e-4)
