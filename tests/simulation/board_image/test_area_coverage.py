"""Exact area coverage, compared with the intersections of shapely."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from gpuvision.simulation.board_image import area_coverage
from gpuvision.simulation.board_image.area_coverage import add_coverage


def covered(rings: list[np.ndarray], shape: tuple[int, int], weight: float = 1.0) -> np.ndarray:
    grid = np.zeros(shape, np.float32)
    add_coverage(grid, rings, weight)
    return grid


def by_intersection(area: shapely.Geometry, shape: tuple[int, int]) -> np.ndarray:
    return np.array(
        [[area.intersection(shapely.box(x, y, x + 1, y + 1)).area for x in range(shape[1])] for y in range(shape[0])]
    )


@pytest.mark.parametrize("rows_at_once", [3, 1024])
def test_areas_are_those_of_the_intersections(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, rows_at_once: int
) -> None:
    monkeypatch.setattr(area_coverage, "_ROWS_AT_ONCE", rows_at_once)
    shape = (9, 11)
    for _ in range(20):
        # A star around a point: larger than the grid, smaller than a cell, and across each border.
        angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 7))
        angle = angle[np.diff(angle, prepend=-1.0) > 1e-3]
        radius = rng.choice([0.3, 3.0, 20.0]) * rng.uniform(0.3, 1.0, len(angle))
        ring = rng.uniform(-1.0, 11.0, 2) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        area = shapely.Polygon(ring)
        if not area.is_valid:
            continue
        sign = 1.0 if shapely.LinearRing(ring).is_ccw else -1.0
        np.testing.assert_allclose(covered([ring], shape), sign * by_intersection(area, shape), atol=1e-6)


def test_borders_on_cell_borders_and_holes_count() -> None:
    square = np.array([[1.0, 1.0], [4.0, 1.0], [4.0, 3.0], [1.0, 3.0]])
    hole = np.array([[2.0, 1.5], [2.0, 2.5], [3.5, 2.5], [3.5, 1.5]])
    expected = np.zeros((4, 6))
    expected[1:3, 1:4] = [[1.0, 0.5, 0.75], [1.0, 0.5, 0.75]]
    np.testing.assert_allclose(covered([square, hole], (4, 6), 2.0), 2.0 * expected, atol=1e-6)
    assert not covered([], (4, 6)).any()
    assert not covered([np.add(square, [0.0, 10.0])], (4, 6)).any()
    assert (covered([np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])], (4, 6)) == 1.0).all()
