"""Volume, area, height and offset of solder paste against closed forms, and their sigmas by Monte Carlo."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gpuvision.inspection.aperture_cells import aperture_windows
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.paste import PasteSettings, measure_deposits
from paste_maps import Box, Cap, Frustum, board_grid, circle, paste_map, rectangle

STENCIL = 120e-6
SETTINGS = PasteSettings(stencil=STENCIL)
HERE = BoardPlacement(x=0.0, y=0.0, theta=0.0)


def test_a_box_on_the_cells_has_its_exact_volume_area_and_height():
    grid = board_grid(100, 80)
    box = Box((300e-6, 200e-6), 110e-6)
    z = paste_map(grid, HERE, [(box, (0.5e-3, 0.4e-3))])
    found = measure_deposits(z, grid, [rectangle("1", (0.5e-3, 0.4e-3), (300e-6, 200e-6))], HERE, SETTINGS)
    assert found.status == ("measured",)
    np.testing.assert_allclose(found.volume, box.volume, rtol=1e-9)
    np.testing.assert_allclose(found.area, 300e-6 * 200e-6, rtol=1e-9)
    np.testing.assert_allclose([found.height_mean, found.height_max], 110e-6, rtol=1e-9)
    np.testing.assert_allclose(found.expected_volume, 300e-6 * 200e-6 * STENCIL, rtol=1e-12)
    np.testing.assert_allclose(found.offset, 0, atol=1e-12)
    np.testing.assert_allclose(found.reference, 1e-3 + 0.01 * 0.5e-3 - 0.02 * 0.4e-3, rtol=1e-9)
    np.testing.assert_allclose(found.valid, 1.0)


@pytest.mark.parametrize("shape", [Cap(250e-6, 130e-6), Frustum(250e-6, 200e-6, 130e-6)])
@pytest.mark.parametrize("side", ["top", "bottom"])
def test_round_deposits_with_an_offset_on_a_turned_board(shape, side):
    """Caps and frusta; the offset is in the coordinates of the board's files, also where the board is mirrored."""
    grid = board_grid(160, 150)
    place = BoardPlacement(
        x=1.6e-3 if side == "bottom" else 0.4e-3, y=0.6e-3 if side == "bottom" else 0.1e-3, theta=0.4, side=side
    )
    centre, offset = np.array([0.8e-3, 0.45e-3]), np.array([22e-6, -13e-6])
    z = paste_map(grid, place, [(shape, tuple(centre + offset))])
    found = measure_deposits(z, grid, [circle("1", tuple(centre), 250e-6)], place, SETTINGS)
    np.testing.assert_allclose(found.centre[0], place.to_map(centre), atol=1e-9)
    np.testing.assert_allclose(found.volume, shape.volume, rtol=2e-3)
    np.testing.assert_allclose(found.area, shape.area_above(STENCIL / 2), rtol=5e-3)
    np.testing.assert_allclose(found.offset[0], offset, atol=2e-7)
    np.testing.assert_allclose(found.height_max, 130e-6, rtol=2e-3)


@pytest.mark.double
def test_single_precision_differs_by_rounding(device):
    """A cap with noise: 1 nm of height, 1e-4 of volume and sigma; cells at the threshold count or not."""
    grid = board_grid(160, 150)
    z = paste_map(grid, HERE, [(Cap(250e-6, 130e-6), (0.8e-3, 0.7e-3))])
    z += np.random.default_rng(3).normal(0, 2e-6, z.shape)
    apertures = [circle("1", (0.8e-3, 0.7e-3), 250e-6)]
    single, double = (
        measure_deposits(z, grid, apertures, HERE, SETTINGS, precision=each, device=device)
        for each in ("single", "double")
    )
    assert single.status == double.status == ("measured",)
    for name in ("volume", "volume_sigma", "area_sigma", "height_mean", "height_mean_sigma", "offset_sigma"):
        np.testing.assert_allclose(getattr(single, name), getattr(double, name), rtol=1e-4)
    np.testing.assert_allclose(single.offset, double.offset, atol=1e-9)


def _nine(deposit):
    places = [(0.45e-3 + 0.6e-3 * column, 0.45e-3 + 0.6e-3 * row) for row in range(3) for column in range(3)]
    return [circle(str(number), place, 200e-6) for number, place in enumerate(places, 1)], [
        (deposit, place) for place in places
    ]


def _draws(clean, grid, apertures, count, noise_of, sigma=None):
    """Return the deposits of `count` noisy maps as arrays (draws, deposits, ...), by field."""
    draws = [measure_deposits(clean + noise_of(), grid, apertures, HERE, SETTINGS, sigma=sigma) for _ in range(count)]
    return {name: np.array([getattr(each, name) for each in draws]) for name in draws[0]._fields}


def _check_spread(found, name):
    """The spread of the values in their sigmas is 1 within 10 %, or 3 standard deviations of so few draws."""
    value, sigma = found[name], found[f"{name}_sigma"]
    ratio = np.std((value - value.mean(axis=0)) / sigma) * math.sqrt(len(value) / (len(value) - 1))
    assert abs(ratio - 1) < max(0.1, 3 / math.sqrt(2 * value.size)), (name, ratio)


def _check_sigmas(rng, count, given):
    grid, noise = board_grid(210, 210), 4e-6
    apertures, deposits = _nine(Cap(210e-6, 130e-6))
    clean = paste_map(grid, HERE, deposits)
    sigma = noise if given else None
    found = _draws(clean, grid, apertures, count, lambda: rng.normal(0, noise, clean.shape), sigma)
    np.testing.assert_allclose(found["noise"], noise, rtol=0 if given else 0.05)
    assert found["correlation_area"].min() >= 1.0
    assert found["correlation_area"].max() < 1.2
    for name in ("volume", "area", "height_mean", "height_max", "offset"):
        _check_spread(found, name)
    np.testing.assert_allclose(np.mean(found["volume"]), Cap(210e-6, 130e-6).volume, rtol=3e-3)
    # The largest of the noisy patches would be 2 sigmas too high.
    bias = np.mean(found["height_max"]) - 130e-6
    assert abs(bias) < 0.5 * np.mean(found["height_max_sigma"])


def test_sigmas_are_the_spread_under_noise(rng):
    _check_sigmas(rng, 12, given=False)


@pytest.mark.nightly
@pytest.mark.parametrize("given", [True, False])
def test_sigmas_are_the_spread_under_noise_of_many_draws(rng, given):
    _check_sigmas(rng, 60, given)


def test_sigmas_contain_the_uncertainty_of_the_reference(rng):
    """A flat cone on a board of few cells: the reference determines area and mean height; 100 draws."""
    grid = board_grid(60, 60)
    apertures = [circle("1", (0.3e-3, 0.3e-3), 180e-6)]
    clean = paste_map(grid, HERE, [(Frustum(180e-6, 10e-6, 60e-6), (0.3e-3, 0.3e-3))])
    away = np.hypot(*np.meshgrid(grid.x - 0.3e-3, grid.y - 0.3e-3))
    clean[away > 191e-6] = np.nan
    settings = PasteSettings(stencil=40e-6, margin=5e-6, ring=40e-6, least_reference=20)
    draws = [
        measure_deposits(
            clean + rng.normal(0, 2e-6, clean.shape), grid, apertures, HERE, settings, sigma=2e-6, correlation_area=1.0
        )
        for _ in range(100)
    ]
    for name in ("volume", "area", "height_mean"):
        values = np.array([getattr(each, name)[0] for each in draws])
        sigmas = np.array([getattr(each, f"{name}_sigma")[0] for each in draws])
        ratio = values.std(ddof=1) / np.sqrt(np.mean(sigmas**2))
        assert abs(ratio - 1) < 3 / math.sqrt(2 * len(draws)), (name, ratio)


def _check_correlated(rng, count):
    """Noise that neighbours share has larger sigmas: its correlation area is found in the board."""
    grid = board_grid(210, 210)
    apertures, deposits = _nine(Cap(210e-6, 130e-6))
    clean = paste_map(grid, HERE, deposits)

    def noise():
        smooth = gaussian_filter(rng.normal(0, 1, clean.shape), 0.8, mode="wrap")
        return 4e-6 * smooth / smooth.std()

    found = _draws(clean, grid, apertures, count, noise)
    np.testing.assert_allclose(np.mean(found["correlation_area"]), 4 * math.pi * 0.8**2, rtol=0.1)
    for name in ("volume", "offset"):
        _check_spread(found, name)


def test_sigmas_of_correlated_noise(rng):
    _check_correlated(rng, 6)


@pytest.mark.nightly
def test_sigmas_of_correlated_noise_of_many_draws(rng):
    _check_correlated(rng, 60)


def test_other_levels_in_the_ring_do_not_move_the_reference(rng):
    """A trace of 35 um under a quarter of the ring, holes, and noise."""
    grid = board_grid(100, 100)
    z = paste_map(
        grid, HERE, [(Cap(200e-6, 130e-6), (0.5e-3, 0.5e-3)), (Box((2e-3, 110e-6), 35e-6), (0.5e-3, 0.19e-3))]
    )
    z += rng.normal(0, 1e-6, z.shape)
    z[rng.random(z.shape) < 0.05] = np.nan
    found = measure_deposits(z, grid, [circle("1", (0.5e-3, 0.5e-3), 200e-6)], HERE, SETTINGS)
    np.testing.assert_allclose(found.volume, Cap(200e-6, 130e-6).volume, rtol=0.01)
    assert found.valid[0] == pytest.approx(0.95, abs=0.02)


def test_the_height_of_the_pad_is_subtracted():
    grid = board_grid(100, 80)
    z = paste_map(grid, HERE, [(Box((300e-6, 200e-6), 110e-6), (0.5e-3, 0.4e-3))])
    settings = PasteSettings(stencil=STENCIL, pad_height=10e-6, margin=0.0)
    found = measure_deposits(z, grid, [rectangle("1", (0.5e-3, 0.4e-3), (300e-6, 200e-6))], HERE, settings)
    np.testing.assert_allclose(found.volume, 300e-6 * 200e-6 * 100e-6, rtol=1e-9)
    np.testing.assert_allclose(found.height_mean, 100e-6, rtol=1e-9)


def test_cells_of_unknown_sigma_have_the_median():
    grid = board_grid(100, 80)
    z = paste_map(grid, HERE, [(Box((300e-6, 200e-6), 110e-6), (0.5e-3, 0.4e-3))])
    sigma = np.full(grid.shape, 2e-6)
    known = measure_deposits(z, grid, [rectangle("1", (0.5e-3, 0.4e-3), (300e-6, 200e-6))], HERE, SETTINGS, sigma=sigma)
    sigma[30:50, 40:60] = np.nan
    found = measure_deposits(z, grid, [rectangle("1", (0.5e-3, 0.4e-3), (300e-6, 200e-6))], HERE, SETTINGS, sigma=sigma)
    np.testing.assert_array_equal(found.volume_sigma, known.volume_sigma)
    np.testing.assert_array_equal(found.noise, 2e-6)


def test_deposits_that_cannot_be_measured_say_why(rng):
    grid = board_grid(200, 100)
    z = paste_map(grid, HERE, [(Cap(200e-6, 130e-6), (0.5e-3, 0.5e-3)), (Cap(200e-6, 130e-6), (1.5e-3, 0.5e-3))])
    z += rng.normal(0, 1e-6, z.shape)
    z[35:65, 140:160] = np.nan
    apertures = [circle("good", (0.5e-3, 0.5e-3), 200e-6), circle("bare", (1.0e-3, 0.2e-3), 100e-6)]
    apertures += [circle("holes", (1.5e-3, 0.5e-3), 200e-6), circle("edge", (1.95e-3, 0.2e-3), 100e-6)]
    found = measure_deposits(z, grid, apertures, HERE, SETTINGS)
    assert found.names == ("good", "bare", "holes", "edge")
    assert found.status == ("measured", "missing", "holes", "outside")
    assert np.isnan(found.offset[1:]).all()
    assert np.isnan(found.volume[2:]).all()
    assert abs(found.volume[1]) < 4 * found.volume_sigma[1]
    empty = np.full(grid.shape, np.nan)
    empty[45:55, 45:55] = 1e-3
    small = measure_deposits(empty, grid, [circle("1", (0.5e-3, 0.5e-3), 10e-6)], HERE, SETTINGS)
    assert small.status == ("no reference",)


def test_a_cell_belongs_to_the_nearest_aperture_within_the_margin():
    grid = board_grid(60, 32)
    apertures = [
        rectangle("1", (0.2e-3, 0.16e-3), (100e-6, 100e-6)),
        rectangle("2", (0.36e-3, 0.16e-3), (100e-6, 100e-6)),
    ]
    first, second = aperture_windows(apertures, grid, 100e-6)
    assert first is not None
    assert second is not None
    whole = np.zeros(grid.shape, int)
    for number, window in enumerate((first, second), 1):
        assert not np.any(whole[window.rows, window.columns][window.cells])
        whole[window.rows, window.columns][window.cells] = number
    # The gap of 60 um is divided in the middle, at x = 0.28 mm; the margin ends 100 um away from the apertures.
    np.testing.assert_array_equal(whole[15, :51], [0] * 5 + [1] * 23 + [2] * 23)
    assert np.count_nonzero(whole[:, 20]) == 30


def test_wrong_arguments_are_refused():
    grid = board_grid(30, 30)
    with pytest.raises(ValueError, match=r"the grid has \(30, 30\)"):
        measure_deposits(np.zeros((3, 3)), grid, [], HERE, SETTINGS)
    with pytest.raises(ValueError, match="sigma has shape"):
        measure_deposits(np.zeros(grid.shape), grid, [], HERE, SETTINGS, sigma=np.ones(3))
    with pytest.raises(ValueError, match="sigma is negative"):
        measure_deposits(np.zeros(grid.shape), grid, [], HERE, SETTINGS, sigma=-1.0)
    with pytest.raises(ValueError, match=r"PasteSettings\.stencil is 0"):
        PasteSettings(stencil=0.0)
    with pytest.raises(ValueError, match=r"PasteSettings\.reference_order is 3, expected 0 to 2"):
        PasteSettings(stencil=1e-4, reference_order=3)
