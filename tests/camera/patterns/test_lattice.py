"""Indexing of lattices by walking."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from gpuvision.camera.patterns.grid_polynomial import agrees_with_grid
from gpuvision.camera.patterns.lattice import (
    LatticePatch,
    _seed,
    _without_overlap,
    estimate_local_steps,
    index_grid,
    index_patches,
    join_patches,
    patch_grid,
)
from target_images import view


def _consistent(grid: np.ndarray, names: np.ndarray) -> bool:
    """Return whether all points have their true indices (row, column), up to a common shift."""
    i, j = np.nonzero(grid >= 0)
    shift = names[grid[i, j]] - np.stack([i, j], axis=1)
    return bool((shift == shift[0]).all())


_NAMES = ("turn", "tilt", "towards", "barrel", "mirrored", "missing", "seed")
# Regression cases: spurious points next to missing points shifted the indices of parts of the grid by one.
_DRAWN = [
    dict(zip(_NAMES, each, strict=True))
    for each in (
        (-8.679535931937117, 2.920758976806423, 1.2362816287058618, 63.951994543745855, True, 0.0, 1584898745),
        (-37.743953150849116, 21.19434267113786, 1.8455849013266112, 56.311318743219005, True, 0.2, 3544802411),
        (
            6.822829465827816,
            13.485490497539633,
            3.940391544380166,
            -2.4183961515259433,
            False,
            0.1317159725615218,
            2556887436,
        ),
    )
]


@settings(deadline=None, max_examples=100)
@example(**_DRAWN[0])
@example(**_DRAWN[1])
@example(**_DRAWN[2])
@given(
    turn=st.floats(-43, 43),
    tilt=st.floats(0, 45),
    towards=st.floats(0, 6.28),
    barrel=st.floats(-30, 100),
    mirrored=st.booleans(),
    missing=st.floats(0, 0.2),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_point_has_its_place(
    turn: float, tilt: float, towards: float, barrel: float, mirrored: bool, missing: float, seed: int
) -> None:
    """Rotated, tilted, distorted by 10 %, mirrored, shuffled points; 20 % are missing, some are spurious."""
    rng = np.random.default_rng(seed)
    camera = view((1000, 1000), 20, 24, 32.0, turn=turn, tilt=tilt, towards=towards, barrel=barrel, mirrored=mirrored)
    nodes = camera.nodes(20, 24)[:, :: -1 if mirrored else 1]
    names = np.argwhere(np.isfinite(nodes[..., 0]))
    kept = rng.random(len(names)) >= missing
    names = rng.permutation(names[kept])
    points = nodes[tuple(names.T)] + rng.normal(0.0, 0.3, (len(names), 2))
    spurious = rng.uniform(0, 1000, (15, 2))
    far = np.linalg.norm(spurious[:, None] - nodes.reshape(-1, 2), axis=-1).min(axis=1) > 12.0
    points = np.concatenate([points, spurious[far]])
    grid = index_grid(points, 9, "points")
    # Points that are indexed wrongly because of a spurious point lie off the grid, so the detectors reject them.
    grid[~agrees_with_grid(np.where(grid[..., None] < 0, np.nan, points[grid]), 7.0, 0.02)] = -1
    grid[grid >= len(names)] = -1
    assert np.count_nonzero(grid >= 0) > 0.9 * len(names)
    assert _consistent(grid, names)


@pytest.mark.parametrize(
    ("neighbours", "steps"),
    [
        # Half the difference of two opposite steps, 0.82 and 1 long, from the shorter one; their sum is 0.18 long.
        ([(-0.82, 0.0), (1.0, 0.0), (0.0, 2.0), (0.0, -2.02)], [(-0.91, 0.0), (0.0, 2.01)]),
        # The sum of the shorter pair, 0.22, is more than a quarter of 0.78, less than a quarter of 1.
        ([(-0.78, 0.0), (1.0, 0.0), (0.0, 2.0), (0.0, -2.02)], [(0.89, 0.0), (0.0, 2.01)]),
        # Of 0.26 it is too much for both.
        ([(-0.74, 0.0), (1.0, 0.0), (0.0, 2.0), (0.0, -2.02)], None),
        # Two directions span the lattice if the sine of their angle is above 0.4.
        ([(1.0, 0.0), (-1.01, 0.0), (1.82, 0.82), (-1.83, -0.82)], [(1.005, 0.0), (1.825, 0.82)]),
        ([(1.0, 0.0), (-1.01, 0.0), (1.84, 0.79), (-1.85, -0.79)], None),
    ],
)
def test_steps_at_a_point(neighbours: list[tuple[float, float]], steps: list[tuple[float, float]] | None) -> None:
    points = np.add([(0.0, 0.0), *neighbours], (7.0, -3.0))
    found = estimate_local_steps(points, cKDTree(points))[0]
    np.testing.assert_allclose(found, np.full((2, 2), np.nan) if steps is None else steps, atol=1e-12)


def test_steps_lead_to_neighbours_of_the_opposite_orientation() -> None:
    """The nearest neighbours have the same orientation, and the scalar product -0.5 is not enough."""
    points = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (2, 2), (-2, -2), (2, -2.5), (-2, 2.5)], float)
    opposite = np.array([[1.0, 0.0]] * 5 + [[-1.0, 0.0]] * 4)
    found = estimate_local_steps(points, cKDTree(points), opposite)[0]
    np.testing.assert_allclose(np.abs(found), [[2.0, 2.0], [2.0, 2.5]])
    for product, is_found in ((-0.51, True), (-0.49, False)):
        opposite[5:] = product, np.sqrt(1.0 - product**2)
        assert np.isfinite(estimate_local_steps(points, cKDTree(points), opposite)[0]).all() == is_found


def test_smaller_patches_lose_the_points_of_larger_ones() -> None:
    nodes = np.stack([np.arange(9), 2 * np.arange(9)], axis=1)
    large = LatticePatch(np.arange(9), nodes)
    overlapping = LatticePatch(np.arange(5, 13), nodes[:8])
    few = LatticePatch(np.arange(10, 15), nodes[:5])
    found = _without_overlap([few, overlapping, large], 4)
    assert [each.members.tolist() for each in found] == [list(range(9)), [9, 10, 11, 12]]
    assert found[1].nodes.tolist() == nodes[4:8].tolist()
    assert [len(each.members) for each in _without_overlap([few, overlapping, large], 2)] == [9, 4, 2]
    assert [len(each.members) for each in _without_overlap([few, overlapping, large], 5)] == [9, 5]


@pytest.mark.parametrize(
    "change",
    [((1, 0), (0, 1)), ((0, 1), (1, 0)), ((-1, 0), (0, 1)), ((1, 2), (0, 1)), ((2, 1), (1, 1)), ((0, -1), (1, 5))],
)
def test_a_grid_of_any_index_has_rows_and_columns(
    change: tuple[tuple[int, int], ...], rng: np.random.Generator
) -> None:
    """The shortest steps of a sheared lattice, columns along x and rows along y; empty nodes are -1."""
    row, column = (each.ravel() for each in np.indices((5, 7)))
    kept = rng.permutation(35)[:32]
    row, column = row[kept], column[kept]
    points = np.stack([40.0 * column + 6.0 * row, 3.0 * column + 30.0 * row], axis=1)
    nodes = np.stack([column, row], axis=1) @ np.array(change) + (9, -4)
    members = rng.permutation(32)
    found = patch_grid(LatticePatch(members, nodes[members]), points)
    expected = np.full((5, 7), -1)
    expected[row, column] = np.arange(32)
    np.testing.assert_array_equal(found, expected)


def test_a_patch_ends_where_the_orientation_does_not_alternate() -> None:
    """Between the fourth and the fifth column neighbours have the same orientation."""
    row, column = (each.ravel() for each in np.indices((6, 8)))
    points = np.stack([20.0 * column, 20.0 * row], axis=1)
    sign = (-1.0) ** (row + column + (column > 3))
    found = index_patches(points, 6, np.stack([sign, np.zeros(48)], axis=1))
    halves = [np.flatnonzero(column < 4).tolist(), np.flatnonzero(column > 3).tolist()]
    assert sorted(sorted(each.members.tolist()) for each in found) == sorted(halves)
    assert len(index_patches(points, 6)) == 1


def test_the_seed_has_the_median_steps() -> None:
    """Of five points with steps that differ in length and in the angle between them, whichever step comes first."""
    bases = np.array(
        [
            [[10.0, 0.0], [0.0, 10.0]],
            [[0.0, 12.0], [12.0, 0.0]],
            [[0.0, -11.0], [11.0, 0.0]],
            [[14.0, 0.0], [0.0, 14.0]],
            [[9.0, 0.0], [6.0, 7.0]],
        ]
    )
    for left, seed in (([0, 1, 2, 3, 4], 2), ([0, 1, 3], 1), ([3], 3), ([], None)):
        assert _seed(bases, np.isin(np.arange(5), left)) == seed


@pytest.mark.parametrize(
    ("shift", "fits"),
    [
        ((0.0, 0.0), True),
        ((0.37, 0.0), True),
        ((0.43, 0.0), False),
        ((0.0, -0.43), False),
        ((0.18, -0.18), True),
        ((0.22, 0.22), False),
    ],
)
def test_a_patch_continues_the_lattice_of_another_one(shift: tuple[float, float], fits: bool) -> None:
    """Extrapolated indices deviate by 0.2 from whole numbers in the median, and by 0.4 along one axis; other origin."""
    row, column = (each.ravel() for each in np.indices((9, 20)))
    at = np.stack([30.0 * column + 0.02 * row**2, 25.0 * row + 0.01 * column**2], axis=1)
    is_main, is_other = column < 12, column > 13
    points = np.where(is_other[:, None], np.add(at, np.multiply(shift, (30.0, 25.0))), at)
    turned = np.add(np.stack([row, -column], axis=1), (5, 3))
    patches = [
        LatticePatch(np.flatnonzero(is_main), np.stack([column, row], axis=1)[is_main]),
        LatticePatch(np.flatnonzero(is_other), turned[is_other]),
    ]
    joined, separate = join_patches(patches, points)
    assert len(separate) == (0 if fits else 1)
    every = is_main | (is_other & fits)
    assert sorted(joined.members.tolist()) == np.flatnonzero(every).tolist()
    np.testing.assert_array_equal(joined.nodes, np.stack([column, row], axis=1)[joined.members])
    # Nodes that the main patch has already are not joined.
    taken = [patches[0], LatticePatch(patches[1].members, turned[is_other] + (0, 14))]
    moved = np.where(is_other[:, None], at - (30.0 * 14, 0.0), at)
    assert len(join_patches(taken, moved)[1]) == 1


@pytest.mark.parametrize("turn", [-170, -80, -44, 0, 44, 100])
def test_columns_grow_with_x_and_rows_with_y(turn: int, rng: np.random.Generator) -> None:
    points = rng.permutation(view((1000, 1000), 12, 15, 50.0, turn=turn).nodes(12, 15).reshape(-1, 2))
    grid = index_grid(points, 9, "points")
    across, down = points[grid[0, -1]] - points[grid[0, 0]], points[grid[-1, 0]] - points[grid[0, 0]]
    assert across[0] > abs(across[1])
    assert down[1] > abs(down[0])


def test_parts_are_joined_over_a_gap(rng: np.random.Generator) -> None:
    nodes = view((1000, 1000), 20, 24, 35.0, turn=8, tilt=20, barrel=50).nodes(20, 24)
    names = np.argwhere(np.ones((20, 24), bool))
    names = rng.permutation(names[(names[:, 1] < 9) | (names[:, 1] > 12)])
    points = nodes[tuple(names.T)]
    assert len(index_patches(points, 9)) == 2
    grid = index_grid(points, 9, "points")
    assert grid.shape == (20, 24)
    assert _consistent(grid, names)


def test_parts_that_do_not_fit_together_are_told() -> None:
    left = view((1000, 1000), 12, 12, 35.0).nodes(12, 12).reshape(-1, 2)
    right = view((2400, 1000), 10, 10, 35.0, turn=20).nodes(10, 10).reshape(-1, 2)
    with pytest.raises(ValueError, match="broke into 2 parts of 144 and 100 points"):
        index_grid(np.concatenate([left, right]), 9, "points")


@pytest.mark.parametrize("count", [0, 1, 8])
def test_too_few_points(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count or 'no'} points found; expected at least 9"):
        index_grid(np.arange(2.0 * count).reshape(-1, 2), 9, "points")


def test_points_on_no_grid(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="30 points found, but they lie on no grid"):
        index_grid(np.cumsum(rng.uniform(5, 50, (30, 2)), axis=0), 9, "points")


def test_points_in_a_row_are_no_grid() -> None:
    with pytest.raises(ValueError, match="no grid"):
        index_grid(np.stack([np.arange(30.0) * 10, np.zeros(30)], axis=1), 9, "points")
