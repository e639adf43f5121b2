"""Sigmas of deposits and leads under an error that whole profiles share: Monte Carlo over its period and phase."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gpuvision.inspection.aperture_cells import Window
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.coplanarity import measure_coplanarity
from gpuvision.inspection.paste import PasteSettings, measure_deposits
from gpuvision.inspection.phase_sigmas import phase_sigmas
from paste_maps import Cap, board_grid, circle, paste_map

HERE = BoardPlacement(x=0.0, y=0.0, theta=0.0)
NOISE, PHASE = 6.7e-6, 5.3e-6
PERIODS = (8, 20, 50, 80, 120)  # cells
GRID = board_grid(210, 210)
SPOTS = [(0.45e-3 + 0.6e-3 * column, 0.45e-3 + 0.6e-3 * row) for row in range(3) for column in range(3)]


def _with_curve(clean: Any, rng: np.random.Generator, period: int, place: float) -> Any:
    """Return heights with noise and an S-curve of a period [cells], a sine that all rows share."""
    turns = np.arange(clean.shape[1]) / period + place
    return clean + rng.normal(0.0, NOISE, clean.shape) + math.sqrt(2.0) * PHASE * np.sin(2.0 * math.pi * turns)


def test_sigmas_are_those_of_a_numerical_jacobian() -> None:
    """A common error of the deposit and another one of the board change the volume and the mean height."""
    height, phase = np.full((6, 8), 100e-6), np.full((6, 8), PHASE)
    grid, cells = board_grid(8, 6), np.zeros((6, 8), bool)
    cells[1:5, 2:7] = True
    window = Window(slice(0, 6), slice(0, 8), cells, cells)
    area = grid.cell_x * grid.cell_y
    places = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)[cells]

    def measured(of_deposit: float, of_board: float) -> np.ndarray:
        above = (height + of_deposit - of_board)[cells]
        return np.array([above.sum() * area, above.mean(), above.max()])

    step = 1e-6
    slopes = np.stack([measured(step, 0.0), measured(0.0, step)]) - measured(0.0, 0.0)
    expected = PHASE * np.hypot(*(slopes / step))
    volume = measured(0.0, 0.0)[0]
    found = phase_sigmas(
        height, phase, grid, window, HERE, threshold=100e-6, volume=volume, centroid=places.mean(axis=0)
    )
    np.testing.assert_allclose([found.volume, found.height_mean, found.height_max], expected, rtol=1e-6)
    # The worst error is proportional to the distance from the centroid along an axis, with the root mean square of the
    # two phases; the area changes by half of the cells at the threshold.
    for axis in (0, 1):
        away = places[:, axis] - places[:, axis].mean()
        worst = math.sqrt(2.0) * PHASE * away / np.sqrt(np.mean(away**2))
        assert found.offset[axis] == pytest.approx(np.sum(worst * away) * area / volume, rel=1e-9)
    assert found.area == pytest.approx(0.5 * 20 * area, rel=1e-12)


@pytest.mark.nightly
def test_sigmas_cover_the_phase_for_every_period(rng: np.random.Generator) -> None:
    deposit = Cap(210e-6, 130e-6)
    apertures = [circle(str(number), place, 200e-6) for number, place in enumerate(SPOTS, 1)]
    clean = paste_map(GRID, HERE, [(deposit, place) for place in SPOTS])
    settings, phase, count = PasteSettings(stencil=120e-6), np.full(clean.shape, PHASE), 24
    true = measure_deposits(clean, GRID, apertures, HERE, settings)
    found = {
        period: [
            measure_deposits(
                _with_curve(clean, rng, period, k / count), GRID, apertures, HERE, settings, sigma=NOISE, phase=phase
            )
            for k in range(count)
        ]
        for period in PERIODS
    }
    for name in ("volume", "height_mean", "height_max", "area", "offset"):
        ratios = {}
        for period, made in found.items():
            errors = [(getattr(each, name) - getattr(true, name)) / getattr(each, f"{name}_sigma") for each in made]
            ratios[period] = math.sqrt(np.mean(np.square(errors)))
        assert max(ratios.values()) < 1.3, (name, ratios)
        assert math.sqrt(np.mean(np.square(list(ratios.values())))) > 0.2, (name, ratios)
    assert found[8][0].noise == pytest.approx(math.hypot(NOISE, PHASE))


def test_sigmas_of_leads_cover_the_phase(rng: np.random.Generator, draws: Any) -> None:
    """Three leads carry the component; the gaps of the others have the errors of four tops."""
    lows = np.array([0.0, 42.0, 0.0, 45.0, 50.0, 47.0, 55.0, 0.0, 48.0]) * 1e-6
    regions = [circle(str(number), place, 150e-6) for number, place in enumerate(SPOTS, 1)]
    balls = [(Cap(150e-6, 160e-6 - low), place) for low, place in zip(lows, SPOTS, strict=True)]
    clean = paste_map(GRID, HERE, balls)
    phase, count, lower = np.full(clean.shape, PHASE), draws(4, 24), [1, 3, 4, 5, 6, 8]
    true = measure_coplanarity(clean, GRID, regions, sigma=NOISE)
    for name in ("top", "gap", "deviation"):
        ratios = {}
        for period in PERIODS:
            made = [
                measure_coplanarity(_with_curve(clean, rng, period, k / count), GRID, regions, sigma=NOISE, phase=phase)
                for k in range(count)
            ]
            errors = [
                ((getattr(each, name) - getattr(true, name)) / getattr(each, f"{name}_sigma"))[lower] for each in made
            ]
            ratios[period] = math.sqrt(np.mean(np.square(errors)))
        assert max(ratios.values()) < 1.3, (name, ratios)
        assert math.sqrt(np.mean(np.square(list(ratios.values())))) > 0.2, (name, ratios)


def test_a_volume_within_the_phase_is_missing() -> None:
    """A deposit of 6 um is significant for the noise, and not for a phase error of 5.3 um."""
    apertures = [circle("1", SPOTS[4], 200e-6)]
    z = paste_map(GRID, HERE, [(Cap(200e-6, 6e-6), SPOTS[4])])
    z += np.random.default_rng(5).normal(0.0, 1e-6, z.shape)
    alone, both = (
        measure_deposits(z, GRID, apertures, HERE, PasteSettings(stencil=120e-6), sigma=1e-6, phase=phase)
        for phase in (None, np.where(np.arange(210) < 100, PHASE, math.nan) + np.zeros((210, 1)))
    )
    assert alone.status == ("measured",)
    assert both.status == ("missing",)
    assert np.isnan(both.offset).all()
    # Unknown sigmas are the median; the deposit has the cells within 50 um of the aperture.
    area = math.pi * 250e-6**2
    assert both.volume_sigma[0] == pytest.approx(
        math.hypot(alone.volume_sigma[0], math.sqrt(2) * PHASE * area), rel=0.02
    )
