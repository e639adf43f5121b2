"""Correlation of the noise of a height map: against a sum over all pairs of cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gpuvision.inspection.aperture_cells import Window
from gpuvision.inspection.height_noise import Ring, correlation_area
from gpuvision.inspection.reference_surface import ReferenceSurface
from gpuvision.ranging.height_map import Grid

GRID = Grid(left=1e-3, top=5e-3, cell_x=2e-5, cell_y=3e-5, columns=42, rows=36)
NONE: Any = np.zeros((0, 0), bool)
SURFACE = ReferenceSurface(np.array([1.2e-3, 4.5e-3]), 5e-4, 1, np.array([1e-4, 2e-5, -3e-5]), np.eye(3), 2e-6, 99)
PARTS = ((slice(0, 12), slice(0, 13)), (slice(14, 33), slice(11, 34)))


def of_pairs(parts: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the sum of the significant correlations up to 4 cells, by loops over pairs of cells."""
    sums: dict[tuple[int, int], list[float]] = {}
    cells: list[float] = []
    for values, used in parts:
        places = np.argwhere(used)
        cells += [float(values[row, column]) ** 2 for row, column in places]
        for row, column in places:
            for other_row, other_column in places:
                lag = int(other_row - row), int(other_column - column)
                if max(map(abs, lag)) <= 4 and lag != (0, 0):
                    entry = sums.setdefault(lag, [0.0, 0.0])
                    entry[0] += values[row, column] * values[other_row, other_column]
                    entry[1] += 1.0
    variance = float(np.mean(cells))
    correlations = [total / count / variance for total, count in sums.values()]
    limits = [3.0 / np.sqrt(count) for _, count in sums.values()]
    return 1.0 + sum(each for each, limit in zip(correlations, limits, strict=True) if abs(each) >= limit)


def test_correlation_area_is_the_sum_over_pairs() -> None:
    """Two rings, one at the border of the map, of which cells are missing or do not belong to the noise."""
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(GRID.x, GRID.y)
    noise = gaussian_filter(rng.normal(size=x.shape), (0.7, 1.1))
    noise[20, 20:24] += 40.0
    z = SURFACE.heights(x, y) + 2e-6 * noise / noise[:15].std()
    free = rng.random(x.shape) < 0.8
    rings = [
        Ring(Window(slice(1, 8), slice(2, 9), NONE, NONE), SURFACE, 7e-5),
        Ring(Window(slice(17, 30), slice(14, 31), NONE, NONE), SURFACE, 5e-5),
        Ring(Window(slice(0, 9), slice(30, 40), NONE, NONE), SURFACE._replace(scale=0.0), 5e-5),
    ]
    parts = []
    # 7e-5 m are 4 cells of the smaller size of 2e-5 m, 5e-5 m are 3.
    for rows, columns in PARTS:
        values = (z - SURFACE.heights(x, y))[rows, columns] / 2e-6
        parts.append((values, free[rows, columns] & (np.abs(values) <= 3.0)))
    found, expected = correlation_area(z, free, GRID, rings), of_pairs(parts)
    assert 3.0 < expected < 15.0
    assert found == pytest.approx(expected, rel=1e-6)
    # The unit of the deviations does not matter: a scale that is far too large clips nothing.
    wide = rings[0]._replace(surface=SURFACE._replace(scale=0.02))
    whole = [(parts[0][0], free[PARTS[0]])]
    assert correlation_area(z, free, GRID, [wide]) == pytest.approx(of_pairs(whole), rel=1e-6)


def test_noise_of_single_cells_and_no_noise() -> None:
    x, y = np.meshgrid(GRID.x, GRID.y)
    flat = SURFACE.heights(x, y)
    ring = Ring(Window(slice(4, 30), slice(4, 36), NONE, NONE), SURFACE, 5e-5)
    every = np.ones(x.shape, bool)
    assert correlation_area(flat, every, GRID, [ring]) == 1.0
    assert correlation_area(flat, every, GRID, []) == 1.0
    # Alternating cells are correlated negatively: the area is not below 1.
    checks = flat + 2e-6 * np.where((np.arange(36)[:, None] + np.arange(42)) % 2, 1.0, -1.0)
    assert correlation_area(checks, every, GRID, [ring]) >= 1.0
