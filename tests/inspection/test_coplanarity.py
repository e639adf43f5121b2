"""Seating plane and coplanarity of leads, against brute force over all triangles and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.special import ndtri

from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.coplanarity import _compare_tops, measure_coplanarity, seating_plane
from gpuvision.inspection.top_height import top_height
from paste_maps import Box, Cap, board_grid, circle, paste_map, rectangle

HERE = BoardPlacement(x=0.0, y=0.0, theta=0.0)


def _brute_force(x, y, z, centre):
    """Return the leads of the triangle around the centre whose plane has no top above it."""
    for three in itertools.combinations(range(len(x)), 3):
        index = list(three)
        corners = np.stack([np.ones(3), x[index], y[index]])
        if abs(np.linalg.det(corners)) < 1e-15:
            continue
        share = np.linalg.solve(corners, [1.0, *centre])
        plane = np.linalg.solve(corners.T, z[index])
        if share.min() >= 0 and np.all(plane[0] + plane[1] * x + plane[2] * y >= z - 1e-12):
            return set(three), plane
    raise AssertionError("no seating plane")


def test_the_seating_plane_is_that_of_all_triangles(rng):
    for _ in range(20):
        x, y = rng.uniform(-5e-3, 5e-3, (2, 14))
        z = 2e-3 + 0.03 * x + rng.normal(0, 30e-6, 14)
        centre = (float(np.mean(x)), float(np.mean(y)))
        expected, plane = _brute_force(x, y, z, centre)
        found = seating_plane(x, y, z, centre)
        assert set(found.seats.tolist()) == expected
        np.testing.assert_allclose(found.coefficients, plane, rtol=1e-5, atol=1e-9)


def test_a_component_that_cannot_stand_is_refused():
    x, y = np.array([0.0, 1e-3, 0.0, 1e-3]), np.array([0.0, 0.0, 1e-3, 1e-3])
    with pytest.raises(ValueError, match=r"the centre of gravity .* is not between the leads"):
        seating_plane(x, y, np.zeros(4), (2e-3, 0.5e-3))
    with pytest.raises(ValueError, match="on one line"):
        seating_plane(x, 2 * x, np.zeros(4), (0.5e-3, 0.5e-3))
    # Of four leads in one plane the seats are three around the centre of gravity.
    for corner, centre in enumerate([(0.2e-3, 0.2e-3), (0.8e-3, 0.2e-3), (0.2e-3, 0.8e-3), (0.8e-3, 0.8e-3)]):
        flat = seating_plane(x, y, np.full(4, 7e-6), centre)
        np.testing.assert_allclose(flat.coefficients, [7e-6, 0, 0], atol=1e-12)
        assert corner in flat.seats
        assert len(set(flat.seats.tolist())) == 3


def _component(lows):
    """Regions, and balls of 150 um radius whose tops are lower by the given heights, on a grid of 3 x 3."""
    places = [(0.4e-3 + 0.5e-3 * column, 0.4e-3 + 0.5e-3 * row) for row in range(3) for column in range(3)]
    regions = [circle(f"B{number}", place, 150e-6) for number, place in enumerate(places, 1)]
    return regions, [(Cap(150e-6, 120e-6 - low), place) for low, place in zip(lows, places, strict=True)]


LOWS = np.array([0.0, 12.0, 0.0, 15.0, 20.0, 17.0, 25.0, 0.0, 18.0]) * 1e-6  # balls 1, 3 and 8 carry the component


def test_balls_on_a_tilted_component(rng):
    regions, balls = _component(LOWS)
    grid = board_grid(180, 180)
    z = paste_map(grid, HERE, balls, plane=(1e-3, 0.01, -0.02))
    found = measure_coplanarity(z, grid, regions, sigma=1e-6)
    np.testing.assert_allclose(found.gap, LOWS, atol=0.1e-6)
    assert set(found.seats) == {"B1", "B3", "B8"}
    assert found.lowest == "B7"
    np.testing.assert_allclose(found.coplanarity, 25e-6, atol=0.1e-6)
    assert found.gap_sigma[[0, 2, 7]].max() < 1e-12
    x, y = found.place.T
    design = np.stack([np.ones(9), x, y], axis=1)
    tops = 120e-6 - LOWS
    expected = tops - design @ np.linalg.lstsq(design, tops, rcond=None)[0]
    np.testing.assert_allclose(found.deviation, expected, atol=0.1e-6)


def test_the_sigma_of_gaps_is_their_spread(rng):
    """Standard deviation of normalised errors of 25 draws: 1 within 3 of its standard deviations."""
    regions, balls = _component(LOWS)
    grid, noise = board_grid(180, 180), 2e-6
    clean = paste_map(grid, HERE, balls)
    draws = [measure_coplanarity(clean + rng.normal(0, noise, clean.shape), grid, regions) for _ in range(25)]
    np.testing.assert_allclose([each.noise for each in draws], noise, rtol=0.1)
    lower = [1, 3, 4, 5, 6, 8]
    for name in ("gap", "deviation", "top"):
        value = np.array([getattr(each, name) for each in draws])[:, lower]
        sigma = np.array([getattr(each, f"{name}_sigma") for each in draws])[:, lower]
        ratio = np.std((value - value.mean(axis=0)) / sigma) * math.sqrt(25 / 24)
        assert abs(ratio - 1) < 3 / math.sqrt(2 * value.size), (name, ratio)


def test_leads_without_heights_are_left_out():
    regions, balls = _component(LOWS)
    grid = board_grid(180, 180)
    z = paste_map(grid, HERE, balls)
    z[:, 110:] = np.nan  # the right column of balls
    found = measure_coplanarity(z, grid, regions, sigma=1e-6)
    assert np.isnan(found.gap[[2, 5, 8]]).all()
    assert np.isfinite(found.gap[[0, 1, 3, 4, 6, 7]]).all()
    with pytest.raises(ValueError, match="2 of 2 leads have a measured top"):
        measure_coplanarity(z, grid, [regions[0], regions[1]], sigma=1e-6)
    with pytest.raises(ValueError, match="0 of 9 leads"):
        measure_coplanarity(np.full(grid.shape, np.nan), grid, regions)


def test_a_component_stands_around_the_centre_of_all_its_leads(rng):
    """Leads far from the origin, more at one side, one without a top; also around a centre that is given."""
    place = rng.uniform((30e-3, -12e-3), (40e-3, -2e-3), (14, 2))
    place[:5] = place[5] + rng.uniform(-1e-3, 1e-3, (5, 2))
    regions = [rectangle(str(number), tuple(each), (0.2e-3, 0.3e-3)) for number, each in enumerate(place)]
    tops = np.stack([1e-3 + 0.03 * place[:, 0] + rng.normal(0, 30e-6, 14), rng.uniform(1e-6, 4e-6, 14)], axis=1)
    tops[3] = np.nan
    known = np.arange(14) != 3
    x, y, z = *place[known].T, tops[known, 0]
    names = np.array([each.name for each in regions])[known]
    beside = tuple(0.5 * place.mean(axis=0) + place[[0, 6, 9]].mean(axis=0) / 2)
    for given, centre in ((None, tuple(place.mean(axis=0))), (beside, beside)):
        found = _compare_tops(regions, tops, given, 2e-6)
        seats, plane = _brute_force(x, y, z, centre)
        assert set(found.seats) == set(names[sorted(seats)])
        design = np.stack([np.ones(13), x, y], axis=1)
        gap = design @ plane - z
        np.testing.assert_allclose(found.gap[known], gap, atol=1e-11)
        # A gap is a sum of tops with weights: the shares of the three seats, and -1 of the lead itself.
        index = sorted(seats)
        weights = np.zeros((13, 13))
        weights[:, index] = np.linalg.solve(design[index].T, design.T).T
        spread = np.sqrt(((weights - np.eye(13)) ** 2) @ tops[known, 1] ** 2)
        np.testing.assert_allclose(found.gap_sigma[known], spread, rtol=1e-6, atol=1e-12)
        hat = design @ np.linalg.solve(design.T @ design, design.T)
        np.testing.assert_allclose(found.deviation[known], z - hat @ z, atol=1e-9)
        spread = np.sqrt(((np.eye(13) - hat) ** 2) @ tops[known, 1] ** 2)
        np.testing.assert_allclose(found.deviation_sigma[known], spread, rtol=1e-6)
        worst = int(np.argmax(gap))
        assert (found.lowest, found.noise) == (names[worst], 2e-6)
        assert (found.coplanarity, found.coplanarity_sigma) == (found.gap[known][worst], found.gap_sigma[known][worst])
        np.testing.assert_array_equal(found.top, tops[:, 0])
        np.testing.assert_array_equal(found.top_sigma, tops[:, 1])
        assert np.isnan(found.gap[3])


def test_the_top_of_a_flat_lead_has_no_bias(rng):
    """Of a flat top of 144 cells the largest noisy patch would be 2 sigmas too high."""
    grid = board_grid(24, 24)
    z = paste_map(grid, HERE, [(Box((120e-6, 120e-6), 1e-4), (0.12e-3, 0.12e-3))], plane=(0.0, 0.0, 0.0))
    region = rectangle("1", (0.12e-3, 0.12e-3), (200e-6, 200e-6))
    inside = np.zeros(grid.shape, bool)
    inside[2:22, 2:22] = True
    found = [top_height(z + rng.normal(0, 1e-6, z.shape), inside, np.full(z.shape, 1e-6), 2) for _ in range(200)]
    error = np.array([(each.height - 1e-4) / each.sigma for each in found])
    assert abs(error.mean()) < 3 / math.sqrt(200)
    assert abs(error.std() - 1) < 3 / math.sqrt(400)
    assert region.area == pytest.approx(4e-8)


def _narrow_leads(width):
    """Regions and heights of four leads along y, a number of cells wide."""
    places = [(x, y) for x in (0.3e-3, 0.9e-3) for y in (0.4e-3, 1.4e-3)]
    regions = [rectangle(str(number), place, (10e-6 * width, 0.4e-3)) for number, place in enumerate(places)]
    grid = board_grid(120, 180)
    return regions, grid, paste_map(grid, HERE, [(Box((0.1e-3, 0.5e-3), 1e-4), place) for place in places])


def test_the_noise_of_narrow_leads_along_y(rng):
    """Leads two cells wide have four neighbours along columns only."""
    regions, grid, clean = _narrow_leads(2)
    found = measure_coplanarity(clean + rng.normal(0, 2e-6, clean.shape), grid, regions)
    assert found.noise == pytest.approx(2e-6, rel=0.25)  # 3 sigma of the median of about 300 differences
    assert (found.top_sigma > 0).all()


def test_the_noise_is_the_spread_of_third_differences(rng):
    """A loop over four cells in a row or column, whose ends are in the region; its variance is 20 of one height."""
    regions, grid, clean = _narrow_leads(7)
    z = clean + rng.normal(0, 2e-6, clean.shape)
    z[grid.shape[0] - 40, 25:35] = np.nan
    found = []
    for each in regions:
        (left, bottom), (right, top) = each.bounds
        inside = np.logical_and(*np.meshgrid((left < grid.x) & (grid.x < right), (bottom < grid.y) & (grid.y < top)))
        for row, column in np.argwhere(inside):
            for cells in (np.s_[row, column : column + 4], np.s_[row : row + 4, column]):
                if inside[cells][-1]:
                    a, b, c, d = z[cells]
                    found.append(d - 3 * c + 3 * b - a)
    known = np.array(found)[np.isfinite(found)]
    assert 500 < len(known) < len(found)
    mad = np.median(np.abs(known - np.median(known)))
    assert measure_coplanarity(z, grid, regions).noise == pytest.approx(mad / ndtri(0.75) / math.sqrt(20), rel=1e-9)


def test_the_noise_of_tiny_regions_is_unknown(rng):
    regions, grid, z = _narrow_leads(2)
    tiny = [rectangle(each.name, tuple(each.centroid), (20e-6, 20e-6)) for each in regions]
    found = measure_coplanarity(z, grid, tiny)
    assert math.isnan(found.noise)
    assert math.isnan(found.coplanarity_sigma)
    assert np.isnan(found.gap_sigma).all()
    assert np.isfinite(found.gap).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sigma": -1e-6}, "sigma is negative, expected standard deviations"),
        ({"sigma": np.ones((2, 2))}, r"sigma has shape \(2, 2\), the grid has"),
        ({"correlation_area": 0.5}, "correlation_area is 0.5, expected .*1"),
    ],
)
def test_noise_that_cannot_be_is_refused(given, message):
    regions, grid, z = _narrow_leads(4)
    with pytest.raises(ValueError, match=message):
        measure_coplanarity(z, grid, regions, **given)
