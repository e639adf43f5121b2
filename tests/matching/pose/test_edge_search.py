"""Grid search of known edges: cells, costs of edges and scores of poses, by definition."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from canary import Guarded
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.distance_map import DistanceMap
from gpuvision.matching.field.field_pose import FieldPoseSearch, PoseCosts
from gpuvision.matching.pose.edge_search import (
    COST_LEVELS,
    CellMeans,
    EdgeCostMap,
    EdgeCosts,
    EdgeSearch,
    Means,
    cell_offsets,
    find_best_shifts,
)
from gpuvision.reference import registration as reference

VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_cells_and_levels_are_those_of_their_definition(device: Device, dtype: Any, rng: np.random.Generator) -> None:
    for shape, cell, border in (((47, 61), 3, 5), ((13, 9), 1, 0), ((66, 91), 7, 2)):
        image = (rng.uniform(0, 200, shape) * (rng.uniform(size=shape) > 0.5)).astype(dtype)
        if dtype == np.float32:
            image[10, 3] = np.nan
        op = CellMeans(cell_px=cell)
        means = Guarded(Means(np.empty((shape[0] // cell, shape[1] // cell), np.float32)))
        op(image, device=device, out=means.out)
        means.assert_intact()
        exact = reference.cell_means(image, cell)
        # One rounding per pixel.
        np.testing.assert_allclose(means.out.means, exact, rtol=cell**2 * 2.0**-24)
        cells = tuple(each + 2 * border for each in exact.shape)
        level = Guarded(EdgeCosts(np.empty((8, *cells), np.uint16)))
        EdgeCostMap(threshold=25.0, border=border)(means.out.means, device=device, out=level.out)
        level.assert_intact()
        costs = COST_LEVELS * reference.edge_costs(exact, 25.0, border)
        # Half a step of rounding; single precision's 1e-6 is a hundredth of one where the mean is 100 times the step.
        np.testing.assert_allclose(level.out.level, costs, atol=0.51 if dtype != np.float32 else 0.52)
        assert level.out.level.min() < 0.5 * COST_LEVELS


@VARIANTS
@pytest.mark.parametrize(("rows", "columns"), [(9, 7), (5, 64), (1, 1), (3, 131), (2, 96), (2, 97), (2, 270)])
def test_scores_are_sums_of_levels(
    device: Device, variant: Any, rows: int, columns: int, rng: np.random.Generator
) -> None:
    height, stride, points, headings = 21, 300, 77, 3
    level = rng.integers(0, COST_LEVELS + 1, (8, height, stride)).astype(np.uint16)
    limit = 8 * height * stride - (rows - 1) * stride - max(columns, 64) + 1
    shifts = rng.integers(0, limit, (headings, points)).astype(np.int32)
    shifts[0, ::5], shifts[2] = -1, -1
    op = EdgeSearch(rows=rows, columns=columns, headings=headings, points=points, with_scores=True, variant=variant)
    expected = reference.pose_costs(level, shifts, rows, columns)
    # Points beyond the last cell from which all positions lie in the map are not used.
    shifts[0, 0], shifts[0, 5] = limit, 2**31 - 1
    blocks = -(-columns // 64)
    guarded = Guarded(
        PoseCosts(
            np.empty((headings, rows, columns), np.float32),
            np.empty((headings, rows, blocks), np.float32),
            np.empty((headings, rows, blocks), np.int32),
            np.empty(headings, np.int32),
        )
    )
    found = op(level, shifts, device=device, out=guarded.out)
    guarded.assert_intact()
    np.testing.assert_array_equal(found.seen, [np.count_nonzero(shifts[0, 1:] >= 0) - 1, points, 0])
    # Exact sums, one division.
    np.testing.assert_allclose(found.scores, expected, rtol=2e-7)
    assert np.isnan(found.least[2]).all()
    for block in range(blocks):
        first = min(block * 64, max(columns - 64, 0))
        part = expected[:2, :, first : first + 64]
        np.testing.assert_allclose(found.least[:2, :, block], part.min(axis=-1), rtol=2e-7)
        np.testing.assert_array_equal(found.column[:2, :, block], first + part.argmin(axis=-1))


def test_a_shift_is_where_its_edge_is_cheap(device: Device) -> None:
    """A bright square, 3 cells to the right of and 2 cells above its nominal position; its sides have cost 0 there."""
    image = np.zeros((90, 121), np.uint8)
    image[30:60, 40:80] = 200
    cell, border, positions = 2, 9, (13, 11)
    level = EdgeCostMap(threshold=20.0, border=border)(CellMeans(cell_px=cell)(image, device=device).means).level
    along = np.linspace(5.0, 25.0, 11)
    off = np.array([-3.0 * cell, 2.0 * cell])
    sides = [(x, 30.0 + y, 1.0, 0.0) for x in (39.5, 79.5) for y in along]
    sides += [(40.0 + x, y, 0.0, -1.0) for y in (29.5, 59.5) for x in along]
    edges = np.array(sides)
    shifts = cell_offsets((edges[:, :2] + off)[None], edges[None, :, 2:], cell, border, level.shape, positions)
    op = EdgeSearch(rows=13, columns=11, headings=1, points=len(edges))
    best = find_best_shifts(op(level, shifts, device=device), positions, 3, (3, 1))
    # An edge has the same low cost in the neighbouring cells.
    assert np.abs(best.cells[0] - [3, -2]).max() <= 1
    assert best.scores[0] < 0.02 < 0.2 < best.scores[1]
    assert np.all(np.abs(best.cells[1:] - best.cells[0]).max(axis=1) > 3)
    far = cell_offsets((edges[:, :2] + 200.0)[None], edges[None, :, 2:], cell, border, level.shape, positions)
    assert (far == -1).all()


@pytest.mark.vectors
@pytest.mark.parametrize(("points", "is_short"), [(3, False), (2, True)])
def test_short_searches_run_in_the_calling_thread(device: Device, points: int, is_short: bool) -> None:
    """At most 2^22 = 2 x 2^21 additions, in the vector variant: 8 headings x 512 x 512 positions x 2 points."""
    op = EdgeSearch(rows=512, columns=512, headings=8, points=points, variant="vector")
    launch = op.launch(device, (8, 600, 600), np.dtype(np.uint16))
    assert launch.passes_once == is_short
    field_map = DistanceMap(field=read_field("robocup_junior"), cell=0.01, scale=0.05, max_range=1.5, device=device)
    count = (1 << 22) // (2 * math.prod(field_map.positions)) + (not is_short)
    search = FieldPoseSearch(map=field_map, headings=(0.1, 0.2), variant="vector")
    assert search.launch(device, (count, 2), np.dtype(np.float32)).passes_once == is_short
    by_items = replace(search, variant="work_item")
    assert not by_items.launch(device, (count, 2), np.dtype(np.float32)).passes_once
