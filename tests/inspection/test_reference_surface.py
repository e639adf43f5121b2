"""Robust surfaces: exact polynomials, the optimum of Tukey's loss, and Huber's covariance from its definition."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.inspection.reference_surface import fit_reference

LEVEL = np.array([40e-6, -7e-6, 3e-6, 5e-6, -2e-6, 4e-6])  # [m]: 1, u, v, u^2, u v, v^2


def places(rng: np.random.Generator, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(2e-3, 5e-3, count), rng.uniform(-1e-3, 4e-3, count)


def terms(x: np.ndarray, y: np.ndarray, order: int) -> np.ndarray:
    """Return the terms (count, n) about the mean place, in units of the largest distance from it."""
    length = np.hypot(x - x.mean(), y - y.mean()).max()
    u, v = (x - x.mean()) / length, (y - y.mean()) / length
    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)][: {0: 1, 1: 3, 2: 6}[order]]
    return np.stack([u**a * v**b for a, b in powers], axis=1)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_exact_surfaces_beside_cells_of_another_level(order: int, share: float, rng: np.random.Generator) -> None:
    x, y = places(rng)
    design = terms(x, y, order)
    z = design @ LEVEL[: design.shape[1]]
    z[: int(share * len(z))] += 60e-6
    found = fit_reference(x, y, z, order)
    assert found is not None
    np.testing.assert_allclose(found.coefficients, LEVEL[: design.shape[1]], atol=1e-15)
    np.testing.assert_allclose(found.centre, [x.mean(), y.mean()])
    assert found.length == pytest.approx(np.hypot(x - x.mean(), y - y.mean()).max())
    assert (found.order, found.cells) == (order, 300)
    # The scale is that of the first fit, which ends early where cells lie on another level, 60 um away.
    assert found.scale < (1e-9 if share else 1.1e-12)
    grid = np.meshgrid(np.linspace(2e-3, 5e-3, 4), np.linspace(0.0, 3e-3, 5))
    u, v = (grid[0] - x.mean()) / found.length, (grid[1] - y.mean()) / found.length
    every = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])[: design.shape[1]]
    np.testing.assert_allclose(found.basis(*grid), every, atol=1e-14)
    np.testing.assert_allclose(found.heights(*grid), np.tensordot(LEVEL[: len(every)], every, axes=1), atol=1e-14)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_fit_minimises_tukeys_loss(order: int, rng: np.random.Generator) -> None:
    """The gradient of the loss vanishes; the covariance is Huber's, with the factor n / (n - p)."""
    x, y = places(rng)
    design = terms(x, y, order)
    z = design @ LEVEL[: design.shape[1]] + rng.normal(0.0, 1e-6, len(x))
    z[:40] += rng.uniform(3e-6, 30e-6, 40)
    found = fit_reference(x, y, z, order)
    assert found is not None
    residual = z - design @ found.coefficients
    ratio = residual / (4.685 * found.scale)
    inside = np.abs(ratio) < 1.0
    assert 200 < np.count_nonzero(inside) < 300
    psi = np.where(inside, residual * (1.0 - ratio**2) ** 2, 0.0)
    slope = np.where(inside, (1.0 - ratio**2) * (1.0 - 5.0 * ratio**2), 0.0).mean()
    size = np.abs(design).T @ np.abs(psi)
    assert (np.abs(design.T @ psi) < 1e-4 * size).all()
    factor = len(x) / (len(x) - design.shape[1]) * np.mean(psi**2) / slope**2
    np.testing.assert_allclose(found.covariance, factor * np.linalg.inv(design.T @ design), rtol=1e-3, atol=1e-18)
    # The scale is the median absolute deviation of a fit by least absolute deviations.
    assert 0.9e-6 < found.scale < 1.4e-6


def test_cells_that_do_not_determine_a_surface() -> None:
    """As many cells as coefficients leave no residual; cells on a line leave the slope across it open."""
    x, y = np.array([0.0, 1.0, 0.0, 1.0, 0.5, 0.2, 0.9]), np.array([0.0, 0.0, 1.0, 1.0, 0.7, 0.4, 0.1])
    none = np.zeros(0)
    assert fit_reference(none, none, none, 0) is None
    for order, needed in ((0, 2), (1, 4), (2, 7)):
        assert fit_reference(x[: needed - 1], y[: needed - 1], x[: needed - 1], order) is None
        assert fit_reference(x[:needed], y[:needed], np.zeros(needed), order) is not None
    assert fit_reference(x, 2.0 * x, x, 1) is None
    same = fit_reference(np.ones(3), np.ones(3), np.array([1.0, 2.0, 3.0]), 0)
    assert same is not None
    assert (same.length, same.coefficients.tolist()) == (1.0, [2.0])
