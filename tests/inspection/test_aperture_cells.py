"""Cells of apertures against distances to all cells of all apertures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.inspection.aperture_cells import aperture_windows, cells_of, owner_map
from gpuvision.inspection.apertures import Aperture
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.ranging.height_map import Grid

GRID = Grid(left=-1e-3, top=2e-3, cell_x=20e-6, cell_y=30e-6, columns=90, rows=70)
MARGIN = 130e-6


def box(left: float, bottom: float, right: float, top: float) -> Any:
    """Return a rectangular aperture [mm]."""
    outline = 1e-3 * np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    shape = Shape(outline=outline, holes=(), dark=True)
    return Aperture(name="", shapes=(shape,), area=0.0, centroid=outline.mean(axis=0))


APERTURES = [
    box(-0.507, 1.007, -0.207, 1.207),
    box(-0.057, 0.907, 0.107, 1.407),
    box(-0.89, 0.7, -0.7, 0.8),  # its margin leaves the map on the left
    box(-0.865, 0.107, -0.707, 0.307),  # its margin ends at the border
    box(0.3, 1.0, 0.305, 1.005),  # between the centres of cells
    box(0.4, 1.88, 0.5, 1.9),  # its margin leaves the map at the top
]


def test_cells_are_those_of_the_nearest_aperture() -> None:
    windows = aperture_windows(APERTURES, GRID, MARGIN)
    assert [each is None for each in windows] == [False, False, True, False, True, True]
    x, y = GRID.left + GRID.cell_x * np.arange(90), GRID.top - GRID.cell_y * np.arange(70)
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    cores = []
    for each in APERTURES:
        low, high = each.shapes[0].outline.min(axis=0), each.shapes[0].outline.max(axis=0)
        cores.append(((centres > low) & (centres < high)).all(axis=-1))
    distances = np.stack(
        [
            np.linalg.norm(centres[:, :, None] - centres[core], axis=-1).min(axis=2)
            if core.any()
            else np.full((70, 90), 1.0)
            for core in cores
        ]
    )
    owner = owner_map(windows, GRID.shape)
    assert owner.dtype == np.int32
    nearest = distances.min(axis=0)
    for number, (window, core) in enumerate(zip(windows, cores, strict=True)):
        if window is None:
            assert not np.isin([number + 1, -number - 1], owner).any()
            continue
        whole = np.zeros(GRID.shape, bool)
        whole[window.rows, window.columns] = window.core
        np.testing.assert_array_equal(whole, core)
        whole[window.rows, window.columns] = window.cells
        clear = (distances[number] == nearest) & (np.sum(distances == nearest, axis=0) == 1)
        within = distances[number] <= MARGIN
        np.testing.assert_array_equal(whole[clear], within[clear])
        assert not whole[distances[number] > nearest].any()
        np.testing.assert_array_equal(owner[core], number + 1)
        np.testing.assert_array_equal(owner == -number - 1, whole & ~core)


@pytest.mark.parametrize("margin", [0.0, 45e-6])
def test_rows_and_columns_whose_centres_lie_in_bounds(margin: float) -> None:
    x, y = GRID.left + GRID.cell_x * np.arange(90), GRID.top - GRID.cell_y * np.arange(70)
    for low, high in (
        ((-0.5e-3, 1.0e-3), (-0.21e-3, 1.2e-3)),
        ((-5e-3, -5e-3), (5e-3, 5e-3)),
        ((0.7e-3, 1.9e-3), (9e-3, 9e-3)),
        ((3e-3, 0.0), (4e-3, 1e-3)),
        ((0.0, 3e-3), (0.1e-3, 4e-3)),
        ((0.0, -3e-3), (0.1e-3, -2e-3)),
    ):
        rows, columns = cells_of(np.array([low, high]), GRID, margin)
        inside = (x >= low[0] - margin - 1e-12) & (x <= high[0] + margin + 1e-12)
        np.testing.assert_array_equal(np.arange(90)[columns], np.flatnonzero(inside))
        inside = (y >= low[1] - margin - 1e-12) & (y <= high[1] + margin + 1e-12)
        np.testing.assert_array_equal(np.arange(70)[rows], np.flatnonzero(inside))


@pytest.mark.parametrize("margin", [0.0, 35e-6])
def test_an_aperture_with_its_margin_lies_within_the_map(margin: float) -> None:
    """The map ends at the outer edges of its cells, of 20 x 30 um; each side a nanometre within and beyond."""
    ends = np.array([[GRID.left, GRID.top - 69 * GRID.cell_y], [GRID.left + 89 * GRID.cell_x, GRID.top]])
    ends += 0.5 * np.array([[-1.0], [1.0]]) * (GRID.cell_x, GRID.cell_y)
    for side in (0, 1):
        for end, inwards in ((0, 1.0), (1, -1.0)):
            for shift, fits in ((1e-9, True), (-1e-9, False)):
                centre = ends.mean(axis=0)
                centre[side] = ends[end, side] + inwards * (60e-6 + margin + shift)
                low, high = 1e3 * (centre - 60e-6), 1e3 * (centre + 60e-6)
                (window,) = aperture_windows([box(*low, *high)], GRID, margin)
                assert (window is not None) == fits, (side, end, shift)
