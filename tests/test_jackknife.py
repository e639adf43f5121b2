"""Jackknife covariances: against repeated fits, each without one cluster of residuals."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.jackknife import cluster_jackknife, overlapping_jackknife

COUNT, PARAMETERS, CELLS = 60, 3, 4


@pytest.fixture
def line(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a linear problem: columns (parameters, n) and right side (n,)."""
    return rng.normal(size=(PARAMETERS, COUNT)), rng.normal(size=COUNT) + 0.5


def without(columns: np.ndarray, right: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """Return the changes (clusters, parameters) of the solution without each cluster."""
    all_of_it = np.linalg.lstsq(columns.T, right, rcond=None)[0]
    return np.array(
        [
            np.linalg.lstsq(columns[:, cluster != each].T, right[cluster != each], rcond=None)[0] - all_of_it
            for each in np.unique(cluster)
        ]
    )


def problem(columns: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    normal = columns @ columns.T
    return columns, normal, right - columns.T @ np.linalg.solve(normal, columns @ right)


def test_clusters(line: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    cluster = rng.choice([1, 4, 5, 9, 12], COUNT)
    shifts = without(*line, cluster)
    expected = shifts.T @ shifts * 4.0 / 5.0
    np.testing.assert_allclose(cluster_jackknife(*problem(*line), cluster), expected, rtol=1e-9)


@pytest.mark.parametrize("overlap", [1, 2, 3])
def test_blocks(line: tuple[np.ndarray, np.ndarray], overlap: int, rng: np.random.Generator) -> None:
    """Each grid of blocks is shifted by another number of cells; a part of the cells has no residuals."""
    cell = rng.integers(0, CELLS, (COUNT, 2))
    cell[(cell == [0, 3]).all(axis=1)] = [1, 2]
    expected = np.zeros((PARAMETERS, PARAMETERS))
    for shift in np.ndindex(overlap, overlap):
        place = (cell + shift) // overlap
        shifts = without(*line, place[:, 0] + 100 * place[:, 1])
        expected += shifts.T @ shifts * (1.0 - 1.0 / len(shifts)) / overlap**2
    found = overlapping_jackknife(*problem(*line), cell, cells=CELLS, overlap=overlap)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_prior_information(line: tuple[np.ndarray, np.ndarray]) -> None:
    """Two clusters, and a prior that keeps the parameters where they are."""
    columns, normal, residual = problem(*line)
    cluster = np.arange(COUNT) % 2
    found = cluster_jackknife(columns, normal + 1e9 * np.eye(PARAMETERS), residual, cluster)
    scores = np.array([columns[:, cluster == k] @ residual[cluster == k] for k in (0, 1)])
    np.testing.assert_allclose(found, 0.5 * scores.T @ scores * 1e-18, rtol=1e-5)
