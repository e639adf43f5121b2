"""Height of a top from the two colours of a chessboard, against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.inspection.top_height import top_height


def reference(z: np.ndarray, allowed: np.ndarray, sigma: np.ndarray, half: int) -> tuple[float, float]:
    """Return height and sigma by loops over all patches."""
    rows, columns = z.shape
    found = []
    for colour in (0, 1):
        best, place = -math.inf, None
        for row in range(rows):
            for column in range(columns):
                cells = [
                    (r, c)
                    for r in range(row - half, row + half + 1)
                    for c in range(column - half, column + half + 1)
                    if 0 <= r < rows and 0 <= c < columns and (r + c) % 2 == colour and np.isfinite(z[r, c])
                ]
                if not allowed[row, column] or len(cells) < 0.3 * (2 * half + 1) ** 2 - 1e-9:
                    continue
                mean = float(np.mean([z[each] for each in cells]))
                if mean > best + 1e-15:
                    best, place = mean, (row, column)
        if place is None:
            return math.nan, math.nan
        near = [
            (r, c)
            for r in range(max(place[0] - half, 0), min(place[0] + half + 1, rows))
            for c in range(max(place[1] - half, 0), min(place[1] + half + 1, columns))
            if (r + c) % 2 != colour and np.isfinite(z[r, c])
        ]
        if not near:
            return math.nan, math.nan
        v, u = (np.array(each, float) for each in zip(*((r - place[0], c - place[1]) for r, c in near), strict=True))
        design = np.stack([np.ones_like(u), v, u, v * v, u * v, u * u], axis=1)
        weights = (
            np.linalg.lstsq(design.T, np.eye(6)[0], rcond=None)[0] if len(u) >= 10 else np.full(len(u), 1 / len(u))
        )
        heights, sigmas = (np.array([each[place] for place in near]) for each in (z, sigma))
        found.append((weights @ heights, np.sum((weights * sigmas) ** 2)))
    return float(np.mean([each[0] for each in found])), math.sqrt(found[0][1] + found[1][1]) / 2


@pytest.mark.parametrize("half", [1, 2, 3])
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_against_loops(half: int, holes: float, rng: np.random.Generator) -> None:
    for shape in ((9, 14), (13, 8)):
        z = 5e-6 * rng.normal(size=shape) + 1e-3
        z[3, 4] += 60e-6
        z[rng.random(shape) < holes] = np.nan
        sigma = rng.uniform(1e-6, 3e-6, shape)
        allowed = rng.random(shape) < 0.8
        found, expected = top_height(z, allowed, sigma, half), reference(z, allowed, sigma, half)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_paraboloid_is_exact() -> None:
    """The top lies on a cell: both colours give its height, wherever the patch is."""
    row, column = np.mgrid[:15, :17]
    z = 80e-6 - 1e-6 * (row - 6) ** 2 - 2e-6 * (column - 9) ** 2 + 0.5e-6 * (row - 6) * (column - 9)
    found = top_height(z, np.ones(z.shape, bool), np.full(z.shape, 1e-6), 2)
    assert found.height == pytest.approx(80e-6, rel=1e-9)
    assert 0.1e-6 < found.sigma < 0.5e-6


def test_no_patch_with_enough_cells() -> None:
    z = np.full((7, 7), 1e-3)
    sigma = np.ones_like(z)
    assert np.isnan(top_height(z, np.zeros(z.shape, bool), sigma, 1)).all()
    z[::2, ::2] = z[1::2, 1::2] = np.nan  # cells of one colour
    assert np.isnan(top_height(z, np.ones(z.shape, bool), sigma, 1)).all()
    assert np.isnan(top_height(np.full((7, 7), np.nan), np.ones(z.shape, bool), sigma, 2)).all()
