"""Polygon mirror with an inclined beam."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gpuvision.ranging.polygon import PolygonMirror, shear_profile
from gpuvision.status import Status

# x/H at phi = -.3, -.1, .1, .3 rad for H/R, H from the polygon's centre: derived and checked by ray tracing.
TABLE = {
    10.0: (-0.62619, -0.18759, 0.18902, 0.64081),
    5.0: (-0.56824, -0.17246, 0.17533, 0.59748),
    1.5: (-0.29781, -0.10189, 0.11145, 0.39530),
    1.1: (-0.15733, -0.06523, 0.07827, 0.29026),
}
ROTATIONS = np.array([-0.3, -0.1, 0.1, 0.3])


def traced(mirror: PolygonMirror, phi: float) -> tuple[float, float]:
    """Return x and the place on the facet by ray tracing: an independent computation."""
    normal = np.array([math.cos(0.25 * math.pi - phi), math.sin(0.25 * math.pi - phi)])
    height = mirror.apothem * math.sqrt(0.5)
    hit = np.array([(mirror.apothem - height * normal[1]) / normal[0], height])
    beam = np.array([-1.0, 0.0])
    out = beam - 2.0 * (beam @ normal) * normal
    tangent = np.array([-normal[1], normal[0]])
    # The outgoing beam points up here; the surface is at the distance `drop` along it.
    landed = hit[0] + mirror.drop * out[0] / out[1]
    middle = mirror.apothem * math.sqrt(0.5)
    return landed - middle, float(hit @ tangent)


@pytest.mark.parametrize("ratio", TABLE)
def test_table(ratio: float) -> None:
    mirror = PolygonMirror(apothem=0.02, facets=6, height=0.02 * ratio)
    np.testing.assert_allclose(mirror.position(ROTATIONS) / mirror.height, TABLE[ratio], rtol=0, atol=5.1e-6)


@pytest.mark.parametrize("height_from", ["centre", "hit"])
@pytest.mark.parametrize("ratio", [10.0, 1.1])
def test_against_a_traced_ray(ratio: float, height_from: str) -> None:
    mirror = PolygonMirror(apothem=0.02, facets=6, height=0.02 * ratio, height_from=height_from)
    for phi in np.linspace(*mirror.limits, 41)[1:-1]:
        x, place = traced(mirror, phi)
        assert mirror.position(phi) == pytest.approx(x, rel=1e-12, abs=1e-16)
        assert mirror.facet_position(phi) == pytest.approx(place, rel=1e-12, abs=1e-16)


def test_both_conventions_of_height_agree() -> None:
    centre = PolygonMirror(apothem=0.03, facets=8, height=0.2)
    hit = PolygonMirror(apothem=0.03, facets=8, height=0.2 - 0.03 * math.sqrt(0.5), height_from="hit")
    np.testing.assert_allclose(hit.position(ROTATIONS), centre.position(ROTATIONS), rtol=1e-14)


@example(ratio=0.72, facets=11, part=1e-15, apothem=1.0)  # rounding: the position is smaller than at the fold
@example(ratio=0.72, facets=52, part=1e-12, apothem=0.8157179605993068)
@given(ratio=st.floats(0.72, 1e4), facets=st.integers(3, 60), part=st.floats(0.0, 1.0), apothem=st.floats(1e-3, 1.0))
def test_round_trip(ratio: float, facets: int, part: float, apothem: float) -> None:
    mirror = PolygonMirror(apothem=apothem, facets=facets, height=apothem * ratio)
    low, high = mirror.limits
    phi = low + part * (high - low)
    x = mirror.position(phi)
    # One ulp of phi moves x by the slope times one ulp: no inverse is more accurate. Near a fold the slope vanishes.
    exact = max(1e-12 * mirror.height, 4.0 * float(mirror.slope(phi)) * np.spacing(abs(phi)))
    assert abs(mirror.position(mirror.rotation(x)) - x) <= exact


def test_out_of_reach_has_no_rotation() -> None:
    for mirror in (
        PolygonMirror(apothem=0.03, facets=12, height=0.2),
        PolygonMirror(apothem=1.0, facets=11, height=0.72),
    ):
        low, high = mirror.position(mirror.limits)
        assert np.isnan(mirror.rotation([low - 1e-12, high + 1e-12])).all()


def test_round_trip_over_a_scan_is_below_1e_12() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=12, height=0.1)
    phi = np.linspace(*mirror.limits, 10_001)
    assert np.max(np.abs(mirror.rotation(mirror.position(phi)) - phi)) < 1e-12
    x = np.linspace(*mirror.position(mirror.limits), 10_001)[1:-1]
    assert np.max(np.abs(mirror.position(mirror.rotation(x)) - x)) < 1e-12


def test_slope_is_twice_the_drop_in_the_middle_and_agrees_with_differences() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=8, height=0.05)
    assert mirror.slope(0.0) == pytest.approx(2.0 * mirror.drop, rel=1e-14)
    step = 1e-6
    difference = (mirror.position(ROTATIONS + step) - mirror.position(ROTATIONS - step)) / (2.0 * step)
    np.testing.assert_allclose(mirror.slope(ROTATIONS), difference, rtol=1e-8)


def test_times_make_equidistant_samples() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=12, height=0.1)
    positions = np.linspace(-0.03, 0.03, 101)
    times = mirror.times(positions, angular_speed=500.0)
    assert np.all(np.diff(times) > 0.0)
    # Not uniform in time: the mirror sweeps faster towards the ends.
    assert np.ptp(np.diff(times)) > 1e-3 * np.mean(np.diff(times))
    np.testing.assert_allclose(mirror.position(500.0 * times), positions, rtol=0, atol=1e-15)


def test_facet_limits() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=12, height=0.1)
    low, high = mirror.limits
    assert high - low == pytest.approx(2.0 * math.pi / 12, rel=1e-13)
    edge = 0.02 * math.tan(math.pi / 12)
    np.testing.assert_allclose(np.abs(mirror.facet_position(mirror.limits)), edge, rtol=1e-12)
    assert np.all(np.isnan(mirror.position([low - 1e-9, high + 1e-9, np.nan])))
    assert np.all(np.isfinite(mirror.position([low, 0.0, high])))


def test_facet_crossing_jumps_back() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=12, height=0.1)
    low, high = mirror.limits
    # The next facet follows by one facet angle: at the jump both are at an edge.
    assert mirror.position(high - 2.0 * math.pi / 12 + 1e-12) < 0.0 < mirror.position(high)
    assert low == pytest.approx(high - 2.0 * math.pi / 12, abs=1e-13)


def test_scan_ends_where_x_turns_back() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=3, height=0.02 * math.sqrt(0.5) + 1e-3)
    low, high = mirror.limits
    # With a drop this small the polygon term exceeds the tangent: the slope vanishes at the lower limit.
    assert mirror.slope(low) == pytest.approx(0.0, abs=1e-9 * mirror.apothem)
    inside = np.linspace(low, high, 1001)[1:-1]
    assert np.all(mirror.slope(inside) > 0.0)
    assert np.all(np.diff(mirror.position(inside)) > 0.0)


def test_positions_out_of_reach_are_nan() -> None:
    mirror = PolygonMirror(apothem=0.02, facets=12, height=0.1)
    first, last = mirror.position(mirror.limits)
    assert np.all(np.isnan(mirror.rotation([first - 1e-6, last + 1e-6, np.nan, np.inf])))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"apothem": 0.0}, "apothem"),
        ({"facets": 2}, "at least 3"),
        ({"height": 0.014}, "more than apothem/sqrt"),
        ({"height_from": "top"}, "'centre' or 'hit'"),
        ({"height": math.nan}, "finite"),
    ],
)
def test_bad_mirrors(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PolygonMirror(**{"apothem": 0.02, "facets": 8, "height": 0.1, **change})


def test_bad_speed() -> None:
    with pytest.raises(ValueError, match="angular_speed"):
        PolygonMirror(apothem=0.02, facets=8, height=0.1).times([0.0], angular_speed=0.0)


def test_sheared_samples() -> None:
    x0 = np.linspace(0.0, 1e-2, 11)
    height = np.where(np.arange(11) < 5, 0.0, 5e-4)
    profile = shear_profile(x0, height)
    np.testing.assert_allclose(profile.x, x0 + height, rtol=1e-14)
    assert not profile.status.any()


def test_fold_over_where_the_surface_falls_faster_than_the_beam() -> None:
    x0 = np.arange(6) * 1e-3
    height = np.array([2e-3, 2e-3, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(shear_profile(x0, height).status, [0, 0, Status.NOT_INVERTIBLE, 0, 0, 0])
    # In the opposite sense beam and scan move together: no fold, but a gap.
    assert not shear_profile(x0, height[::-1].copy()).status.any()
    # A reversed scan folds on the other flank.
    np.testing.assert_array_equal(shear_profile(x0[::-1], height[::-1]).status, [0, 0, 0, 0, Status.NOT_INVERTIBLE, 0])
    np.testing.assert_array_equal(shear_profile(x0[::-1], height).status, [0] * 6)
    np.testing.assert_array_equal(shear_profile(x0[::-1], -height).status, [0, 0, Status.NOT_INVERTIBLE, 0, 0, 0])


def test_samples_that_coincide_are_folded() -> None:
    # Multiples of a power of two, so that the coincidence is exact.
    x0, height = np.arange(4) * 0.25, np.array([0.0, 0.0, -0.25, 0.0])
    np.testing.assert_array_equal(
        shear_profile(x0, height, math.atan(1.0)).status & Status.NOT_INVERTIBLE, [0, 0, Status.NOT_INVERTIBLE, 0]
    )


def test_hole_is_skipped_in_the_comparison() -> None:
    x0, height = np.arange(5) * 1e-3, np.array([0.0, 3e-3, np.nan, 0.0, 0.0])
    profile = shear_profile(x0, height)
    np.testing.assert_array_equal(profile.status, [0, 0, Status.NOT_FINITE, Status.NOT_INVERTIBLE, 0])
    assert np.isnan(profile.x[2])
    first = shear_profile(x0, np.array([np.nan, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(first.status, [Status.NOT_FINITE, 0, 0, 0, 0])


def test_batches_of_profiles_are_independent(rng: np.random.Generator) -> None:
    height = rng.uniform(-2e-3, 2e-3, (3, 4, 50))
    x0 = np.broadcast_to(np.arange(50) * 1e-3, height.shape)
    together = shear_profile(x0, height, 0.6)
    for index in np.ndindex(3, 4):
        alone = shear_profile(x0[index], height[index], 0.6)
        np.testing.assert_array_equal(together.x[index], alone.x)
        np.testing.assert_array_equal(together.status[index], alone.status)


@pytest.mark.parametrize(
    ("x0", "height", "angle", "message"),
    [
        ([0.0, 1.0], [0.0], 0.7, "same"),
        ([0.0, 0.0], [0.0, 0.0], 0.7, "monotone"),
        ([0.0, 1.0, 0.5], [0.0, 0.0, 0.0], 0.7, "monotone"),
        ([0.0, 1.0], [0.0, 0.0], 0.5 * math.pi, "right angle"),
    ],
)
def test_bad_shear(x0: list[float], height: list[float], angle: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        shear_profile(x0, height, angle)
