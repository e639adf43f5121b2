"""Families of lines from grids, and their packed arrays."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.lines.line_families import grid_lines, pack


def numbered(rows: int, columns: int) -> np.ndarray:
    """Return a grid whose point coordinates are the indices."""
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64)


def test_rows_and_columns() -> None:
    rows, columns = grid_lines(numbered(4, 6))
    assert [len(line) for line in rows] == [6] * 4
    assert [len(line) for line in columns] == [4] * 6
    np.testing.assert_array_equal(rows[2][:, 1], 2.0)
    np.testing.assert_array_equal(columns[5][:, 0], 5.0)


@given(rows=st.integers(1, 7), columns=st.integers(1, 7))
def test_diagonals(rows: int, columns: int) -> None:
    grid = numbered(rows, columns)
    *_, falling, rising = grid_lines(grid, diagonals=True)
    for family, sign in ((falling, -1.0), (rising, 1.0)):
        for line in family:
            assert len(np.unique(line[:, 0] + sign * line[:, 1])) == 1
            np.testing.assert_array_equal(np.abs(np.diff(line, axis=0)), 1.0)
        lengths = [min(rows, columns, each + 1, rows + columns - 1 - each) for each in range(rows + columns - 1)]
        assert sorted(len(line) for line in family) == sorted(each for each in lengths if each >= 3)


def test_missing_points_are_left_out() -> None:
    grid = numbered(4, 6)
    grid[1, 2:] = np.nan
    grid[0, 0, 1] = np.inf  # the row alone
    rows, columns = grid_lines(grid)
    assert [len(line) for line in rows] == [5, 6, 6]
    assert [len(line) for line in columns] == [3, 4, 3, 3, 3, 3]


def test_packed_lines_keep_what_is_finite(rng: np.random.Generator) -> None:
    lines = [rng.normal(500.0, 200.0, (count, 2)) for count in (5, 2, 4, 6)]
    lines[2][:2] = np.nan
    lines[3][4, 1] = np.nan
    packed = pack([lines[:2], [], lines[2:]])
    np.testing.assert_array_equal(packed.counts, [5, 5])
    np.testing.assert_array_equal(packed.family, [0, 2])
    assert packed.families == 3
    expected = np.concatenate([lines[0], lines[3][[0, 1, 2, 3, 5]]])
    found = np.stack([packed.x, packed.y], axis=-1) * packed.unit + packed.origin
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    np.testing.assert_array_equal(np.concatenate(lines)[packed.used], expected)
    assert np.max(np.hypot(packed.x, packed.y)) <= 1.0
    # A point with an unknown row alone is left out, too.
    np.testing.assert_array_equal(packed.starts, [0, 5])
    np.testing.assert_array_equal(packed.line, [0] * 5 + [1] * 5)
    np.testing.assert_array_equal(packed.family_starts, [0, 1])
    low, high = expected.min(axis=0), expected.max(axis=0)
    np.testing.assert_allclose(packed.origin, 0.5 * (low + high))
    assert packed.unit == pytest.approx(0.5 * np.linalg.norm(high - low))
    np.testing.assert_allclose(packed.corner, 0.5 * (high - low) / packed.unit)
    np.testing.assert_allclose(packed.sums(packed.x), [packed.x[:5].sum(), packed.x[5:].sum()], atol=1e-15)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "there are no lines"),
        ([[]], "there are no lines"),
        ([[np.zeros((4, 3))]], r"a line has shape \(4, 3\), expected \(points, 2\)"),
        ([[np.zeros((4, 2)), np.zeros((4, 1))]], r"a line has shape \(4, 1\), expected \(points, 2\)"),
        ([[np.zeros(4)]], r"a line has shape \(4,\), expected \(points, 2\)"),
        ([[np.arange(4.0).reshape(2, 2)]], "no line has three finite points"),
        ([[np.full((4, 2), np.nan)]], "no line has three finite points"),
        ([[np.ones((4, 2))]], "all points lie on one place"),
        ([[np.ones((4, 2)), np.arange(8.0).reshape(4, 2)]], "all points of line 0 lie on one place"),
    ],
)
def test_what_says_nothing_is_refused(lines: list[list[np.ndarray]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pack(lines)


@pytest.mark.parametrize(("part", "is_extended"), [(1.01, True), (0.99, False)])
def test_least_extent_of_a_line(part: float, is_extended: bool) -> None:
    """The points of a line scatter by 1e-7 of half the diagonal of all points, 5 px, or more."""
    side = np.array([0.0, 1.0, 2.0, 3.0])
    long = np.stack([2.0 * side, 8.0 * side / 3.0], axis=1)  # 6 x 8 px
    short = 3.0 + part * 5e-7 / side.std() * np.stack([0.6 * side, 0.8 * side], axis=1)
    if is_extended:
        assert pack([[long, short]]).counts.tolist() == [4, 4]
    else:
        with pytest.raises(ValueError, match="all points of line 1 lie on one place"):
            pack([[long, short]])


@pytest.mark.parametrize("shape", [(3, 2), (3, 3, 1), (3, 3, 3), (3, 3, 2, 1)])
def test_shape_of_a_grid(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=re.escape(f"grid points have shape {shape}")):
        grid_lines(np.zeros(shape))
