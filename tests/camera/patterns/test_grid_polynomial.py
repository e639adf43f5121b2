"""Polynomial of a grid: its degrees and derivatives; predictions of points from their neighbours, by loops."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, _distance_from_prediction, agrees_with_grid, cross


def monomial(shape: tuple[int, int], by_column: int, by_row: int) -> np.ndarray:
    """Return points whose column is 3 u^a v^b and whose row is -2 u^a v^b of the column and row index u, v."""
    v, u = np.indices(shape).astype(float)
    return (u**by_column * v**by_row)[..., None] * np.array([3.0, -2.0])


@pytest.mark.parametrize(
    ("shape", "known", "degrees"),
    [
        ((6, 12), 72, (4, 4)),
        ((12, 6), 50, (4, 4)),  # 2 points for each of 5 x 5 coefficients
        ((12, 6), 49, (3, 3)),
        ((3, 9), 27, (2, 1)),
        ((9, 4), 36, (2, 3)),
        ((2, 30), 60, (4, 0)),
        ((1, 30), 30, (2, 0)),
        ((7, 7), 18, (2, 2)),
        ((7, 7), 17, (1, 1)),
        ((7, 7), 1, (0, 0)),
    ],
)
def test_degrees_follow_the_number_of_points(shape: tuple[int, int], known: int, degrees: tuple[int, int]) -> None:
    """The polynomial reproduces products of powers up to its degrees, with their derivatives, and no other power."""
    missing = np.random.default_rng(7).permutation(shape[0] * shape[1])[known:]
    v, u = np.indices(shape).astype(float)

    def fitted(a: int, b: int) -> tuple[np.ndarray, GridPolynomial]:
        points = monomial(shape, a, b)
        given = points.reshape(-1, 2).copy()
        given[missing] = np.nan
        return points, GridPolynomial(given.reshape(points.shape))

    for a, b in itertools.product(range(degrees[0] + 1), range(degrees[1] + 1)):
        points, model = fitted(a, b)
        size = np.abs(points).max()
        for orders in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
            power = [math.perm(n, k) * at ** max(n - k, 0) for n, k, at in zip((a, b), orders, (u, v), strict=True)]
            expected = (power[0] * power[1])[..., None] * np.array([3.0, -2.0])
            np.testing.assert_allclose(model.derivative(*orders), expected, rtol=0, atol=1e-8 * size)
    if known > 1:
        for a, b in ((degrees[0] + 1, 0), (0, degrees[1] + 1)):
            points, model = fitted(a, b)
            if np.ptp(points) > 0.0:
                assert np.abs(model.derivative(0, 0) - points).max() > 1e-3 * np.abs(points).max()


def predicted_distance(points: np.ndarray, row: int, column: int) -> float:
    """Return the distance of a point from the prediction of its neighbours, which may be missing."""
    rows, columns = points.shape[:2]

    def at(along: tuple[int, int], steps: int) -> np.ndarray:
        i, j = row + steps * along[0], column + steps * along[1]
        return points[i, j] if 0 <= i < rows and 0 <= j < columns else np.full(2, np.nan)

    central, beside = [], []
    for along in ((0, 1), (1, 0)):
        one, two, three = ([at(along, side * steps) for side in (-1, 1)] for steps in (1, 2, 3))
        cubic = (4.0 * (one[0] + one[1]) - two[0] - two[1]) / 6.0
        central.append(cubic if np.isfinite(cubic).all() else 0.5 * (one[0] + one[1]))
        beside += [3.0 * one[side] - 3.0 * two[side] + three[side] for side in (0, 1)]
    for predictions, factor in ((central, 1.0), (beside, 0.5)):
        known = [each for each in predictions if np.isfinite(each).all()]
        if known:
            return factor * float(np.linalg.norm(points[row, column] - np.median(known, axis=0)))
    return math.nan


def test_distances_from_the_predictions_of_neighbours(rng: np.random.Generator) -> None:
    points = np.stack(np.meshgrid(np.arange(9.0), 2.0 * np.arange(7.0)), axis=-1) + rng.normal(0.0, 0.1, (7, 9, 2))
    points[rng.random((7, 9)) < 0.25] = np.nan
    found = _distance_from_prediction(points)
    expected = np.array([[predicted_distance(points, i, j) for j in range(9)] for i in range(7)])
    expected[np.isnan(points[..., 0])] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert 20 < np.count_nonzero(np.isfinite(found)) < np.count_nonzero(np.isfinite(points[..., 0]))


def test_a_deviation_that_is_always_accepted() -> None:
    """In steps: the root of the area of a cell of 4 x 9 px. The prediction of a border point counts half."""
    exact = np.stack(np.meshgrid(4.0 * np.arange(12.0), 9.0 * np.arange(10.0)), axis=-1)
    for node, share in (((5, 5), 1.0), ((5, 0), 1.0)):
        for deviation, is_good in ((0.049, True), (0.051, False)):
            points = exact.copy()
            points[node] += deviation * 6.0 / share * np.array([0.6, 0.8])
            good = agrees_with_grid(points, 0.0, 0.05)
            assert good[node] == is_good
            assert np.count_nonzero(~good) == (not is_good)


def test_area_of_two_steps() -> None:
    steps = np.array([[3.0, 1.0], [2.0, -5.0]])
    np.testing.assert_array_equal(cross(steps, np.array([[1.0, 4.0], [7.0, 1.0]])), [11.0, 37.0])
