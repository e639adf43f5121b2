"""Place of a board by its paste pattern, against the place that the map was made with."""

from __future__ import annotations

import math
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from gpuvision.inspection.alignment import _fit_rigid, align_apertures
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.paste import PasteSettings
from paste_maps import Cap, board_grid, circle, paste_map, rectangle

SETTINGS = PasteSettings(stencil=120e-6)
PLACES = [(0.3, 0.3), (1.2, 0.35), (2.3, 0.5), (0.4, 1.4), (1.5, 1.1), (2.2, 1.9), (0.9, 2.0), (1.8, 1.6)]


@pytest.mark.parametrize("side", ["top", "bottom"])
def test_a_shifted_and_turned_board_is_found(rng, side):
    """Shift of 0.4 mm and rotation of 2 degrees; one deposit is missing and one is displaced."""
    grid = board_grid(300, 280, cell=15e-6)
    apertures = [circle(str(k), (1e-3 * x, 1e-3 * y), 150e-6) for k, (x, y) in enumerate(PLACES)]
    true = BoardPlacement(x=3.6e-3 if side == "bottom" else 0.9e-3, y=0.8e-3, theta=math.radians(5.0), side=side)
    spots = [(1e-3 * x, 1e-3 * y) for x, y in PLACES[1:]]
    spots[2] = (spots[2][0] + 60e-6, spots[2][1])
    z = paste_map(grid, true, [(Cap(150e-6, 120e-6), place) for place in spots]) + rng.normal(0, 2e-6, grid.shape)
    initial = BoardPlacement(x=true.x + 0.4e-3, y=true.y - 0.1e-3, theta=math.radians(3.0), side=side)
    found = align_apertures(z, grid, apertures, SETTINGS, initial=initial, search_range=(0.6e-3, math.radians(3.0)))
    for corner in ((0.3e-3, 0.3e-3), (2.3e-3, 1.9e-3)):
        error = found.placement.to_map(np.array(corner)) - true.to_map(np.array(corner))
        assert np.hypot(*error) < 1.5e-6
    assert found.placement.side == side
    assert found.count == 6
    assert found.correlation > 0.6
    assert not found.is_ambiguous


def test_the_covariance_is_the_spread(rng):
    """Offsets of every deposit of 3 um: the place scatters as its covariance says, within 3 sigma of 40 draws."""
    grid = board_grid(200, 190, cell=15e-6)
    apertures = [
        circle(str(k), (0.3e-3 + 0.6e-3 * x, 0.3e-3 + 0.6e-3 * y), 150e-6)
        for k, (x, y) in enumerate((x, y) for x in range(4) for y in range(4))
    ]
    true = BoardPlacement(x=0.3e-3, y=0.25e-3, theta=0.0)
    errors = []
    for _ in range(6):
        spots = [(Cap(150e-6, 120e-6), tuple(each.centroid + rng.normal(0, 3e-6, 2))) for each in apertures]
        found = align_apertures(
            paste_map(grid, true, spots), grid, apertures, SETTINGS, initial=true, search_range=(0.1e-3, 0.01)
        )
        shift = found.centre - true.to_map(np.mean([each.centroid for each in apertures], axis=0))
        errors.append(np.append(shift, found.placement.theta) / np.sqrt(np.diag(found.covariance)))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_regular_pattern_is_ambiguous(rng):
    grid = board_grid(300, 120, cell=15e-6)
    apertures = [rectangle(str(k), (0.6e-3 + 0.4e-3 * k, 0.9e-3), (200e-6, 200e-6)) for k in range(8)]
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    spots = [(Cap(120e-6, 120e-6), (0.2e-3 + 0.4e-3 * k, 0.9e-3)) for k in range(11)]
    z = paste_map(grid, here, spots) + rng.normal(0, 1e-6, grid.shape)
    found = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.5e-3, 0.0))
    assert found.is_ambiguous
    near = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.15e-3, 0.0))
    assert not near.is_ambiguous
    assert math.hypot(near.placement.x, near.placement.y) < 1e-6


def test_a_map_without_paste_is_refused(rng):
    grid = board_grid(100, 100)
    apertures = [circle(str(k), (0.3e-3 * k, 0.3e-3), 80e-6) for k in (1, 2)]
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    with pytest.raises(ValueError, match="the board was not found in the height map"):
        align_apertures(
            rng.normal(0, 1e-6, grid.shape), grid, apertures, SETTINGS, initial=here, search_range=(1e-4, 0.0)
        )
    with pytest.raises(ValueError, match="the height map has no height"):
        align_apertures(np.full(grid.shape, np.nan), grid, apertures, SETTINGS, initial=here, search_range=(1e-4, 0.0))


@pytest.mark.parametrize("count", [4, 12])
def test_the_covariance_of_equal_residuals_has_a_closed_form(count):
    """Deposits on a circle have radial offsets of alternate signs, which no shift or rotation reduces."""
    here, radius, length = BoardPlacement(x=0.0, y=0.0, theta=0.0), 1e-3, 3e-6
    angle = 2 * math.pi * np.arange(count) / count
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offset = length * (-1.0) ** np.arange(count)[:, None] * outward
    fit = _fit_rigid(SimpleNamespace(offset=offset, centre=radius * outward), here)
    median = math.sqrt(2 * math.log(2))  # of the length of two normal coordinates [sigma]
    weight = (1 - (median / 4.685) ** 2) ** 2  # Tukey
    shrinkage = (2 * count * weight - 3) / (2 * count * weight)
    variance = (length / median) ** 2 / shrinkage / (count * weight)
    np.testing.assert_allclose(
        fit.covariance, np.diag([variance, variance, variance / radius**2]), rtol=1e-3, atol=1e-6 * variance
    )


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 12])
def test_the_covariance_of_few_deposits_is_their_variance(rng, count):
    """Mean covariance of 250 draws over the variance of the fitted motions: three parameters shrink the residuals."""
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    angle = 2 * math.pi * np.arange(count) / count
    centre = 1e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    errors, variances = [], []
    for _ in range(250):
        found, covariance, _, _, middle = _fit_rigid(
            SimpleNamespace(offset=rng.normal(0, 1e-6, (count, 2)), centre=centre), here
        )
        shift = found.to_map(middle) - middle
        errors.append([*shift, found.theta])
        variances.append(np.diag(covariance))
    ratio = np.mean(variances, axis=0) / np.mean(np.square(errors), axis=0)
    assert np.all(np.abs(ratio - 1) < 0.3)  # 3 standard deviations of a variance of 250 draws


def test_memory_does_not_grow_with_the_search_range(rng):
    """A correlation map for each rotation would take 11 MB."""
    grid = board_grid(200, 190, cell=15e-6)
    apertures = [circle(str(k), (0.3e-3 + 0.5e-3 * k, 0.4e-3 * (k % 3 + 1)), 150e-6) for k in range(5)]
    here = BoardPlacement(x=0.1e-3, y=0.1e-3, theta=0.0)
    z = paste_map(grid, here, [(Cap(150e-6, 120e-6), tuple(each.centroid)) for each in apertures])
    peaks = []
    for turn in (0.0, 3.0):
        tracemalloc.start()
        found = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.1e-3, turn))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert abs(found.placement.theta) < 1e-3
    assert peaks[1] < peaks[0] + 5e6


def test_a_rotation_beyond_pi_is_pi(monkeypatch):
    grid = board_grid(40, 40, cell=50e-6)
    apertures = [circle(str(k), (0.4e-3 + 0.5e-3 * k, 0.4e-3 * (k % 3 + 1)), 150e-6) for k in range(3)]
    here = BoardPlacement(x=0.1e-3, y=0.1e-3, theta=0.0)
    z = paste_map(grid, here, [(Cap(150e-6, 120e-6), tuple(each.centroid)) for each in apertures])
    ranges = []
    spread = np.linspace
    monkeypatch.setattr(np, "linspace", lambda *args: ranges.append(args[:2]) or spread(*args[:2], min(args[2], 999)))
    align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.1e-3, 1e6))
    assert (-math.pi, math.pi) in ranges
    for search_range in ((-1e-3, 0.1), (1e-3, -0.1), (math.inf, 0.1), (1e-3, math.nan)):
        with pytest.raises(ValueError, match="of the search range"):
            align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=search_range)
