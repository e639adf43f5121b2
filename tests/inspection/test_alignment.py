"""Place of a board by its paste pattern, against the place that the map was made with."""

from __future__ import annotations

import math
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from gpuvision.inspection import alignment
from gpuvision.inspection.alignment import (
    _coarse_heights,
    _fit_rigid,
    _pattern,
    _peaks,
    _turned,
    align_apertures,
)
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.paste import PasteSettings
from gpuvision.ranging.height_map import Grid
from paste_maps import Cap, board_grid, circle, paste_map, rectangle

SETTINGS = PasteSettings(stencil=120e-6)
PLACES = [(0.3, 0.3), (1.2, 0.35), (2.3, 0.5), (0.4, 1.4), (1.5, 1.1), (2.2, 1.9), (0.9, 2.0), (1.8, 1.6)]


@pytest.mark.parametrize("side", ["top", "bottom"])
def test_a_shifted_and_turned_board_is_found(rng, side, monkeypatch):
    """Shift of 0.4 mm and rotation of 2 degrees; one deposit is missing and one is displaced."""
    grid = board_grid(300, 280, cell=15e-6)
    apertures = [circle(str(k), (1e-3 * x, 1e-3 * y), 150e-6) for k, (x, y) in enumerate(PLACES)]
    true = BoardPlacement(x=3.6e-3 if side == "bottom" else 0.9e-3, y=0.8e-3, theta=math.radians(5.0), side=side)
    spots = [(1e-3 * x, 1e-3 * y) for x, y in PLACES[1:]]
    spots[2] = (spots[2][0] + 60e-6, spots[2][1])
    z = paste_map(grid, true, [(Cap(150e-6, 120e-6), place) for place in spots]) + rng.normal(0, 2e-6, grid.shape)
    initial = BoardPlacement(x=true.x + 0.4e-3, y=true.y - 0.1e-3, theta=math.radians(3.0), side=side)
    found = align_apertures(z, grid, apertures, SETTINGS, initial=initial, search_range=(0.6e-3, math.radians(3.0)))
    for corner in ((0.3e-3, 0.3e-3), (2.3e-3, 1.9e-3)):
        error = found.placement.to_map(np.array(corner)) - true.to_map(np.array(corner))
        assert np.hypot(*error) < 1.5e-6
    assert found.placement.side == side
    assert found.count == 6
    assert found.correlation > 0.6
    assert not found.is_ambiguous
    assert found.converged
    monkeypatch.setattr(alignment, "_ROUNDS", 1)
    first = align_apertures(z, grid, apertures, SETTINGS, initial=initial, search_range=(0.6e-3, math.radians(3.0)))
    assert not first.converged


def test_the_covariance_is_the_spread(rng):
    """Offsets of every deposit of 3 um: the place scatters as its covariance says, within 3 sigma of 40 draws."""
    grid = board_grid(200, 190, cell=15e-6)
    apertures = [
        circle(str(k), (0.3e-3 + 0.6e-3 * x, 0.3e-3 + 0.6e-3 * y), 150e-6)
        for k, (x, y) in enumerate((x, y) for x in range(4) for y in range(4))
    ]
    true = BoardPlacement(x=0.3e-3, y=0.25e-3, theta=0.0)
    errors = []
    for _ in range(6):
        spots = [(Cap(150e-6, 120e-6), tuple(each.centroid + rng.normal(0, 3e-6, 2))) for each in apertures]
        found = align_apertures(
            paste_map(grid, true, spots), grid, apertures, SETTINGS, initial=true, search_range=(0.1e-3, 0.01)
        )
        shift = found.centre - true.to_map(np.mean([each.centroid for each in apertures], axis=0))
        errors.append(np.append(shift, found.placement.theta) / np.sqrt(np.diag(found.covariance)))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_regular_pattern_is_ambiguous(rng):
    grid = board_grid(300, 120, cell=15e-6)
    apertures = [rectangle(str(k), (0.6e-3 + 0.4e-3 * k, 0.9e-3), (200e-6, 200e-6)) for k in range(8)]
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    spots = [(Cap(120e-6, 120e-6), (0.2e-3 + 0.4e-3 * k, 0.9e-3)) for k in range(11)]
    z = paste_map(grid, here, spots) + rng.normal(0, 1e-6, grid.shape)
    found = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.5e-3, 0.0))
    assert found.is_ambiguous
    near = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.15e-3, 0.0))
    assert not near.is_ambiguous
    assert math.hypot(near.placement.x, near.placement.y) < 1e-6


def test_a_map_without_paste_is_refused(rng):
    grid = board_grid(100, 100)
    apertures = [circle(str(k), (0.3e-3 * k, 0.3e-3), 80e-6) for k in (1, 2)]
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    with pytest.raises(ValueError, match="the board was not found in the height map"):
        align_apertures(
            rng.normal(0, 1e-6, grid.shape), grid, apertures, SETTINGS, initial=here, search_range=(1e-4, 0.0)
        )
    with pytest.raises(ValueError, match="the height map has no height"):
        align_apertures(np.full(grid.shape, np.nan), grid, apertures, SETTINGS, initial=here, search_range=(1e-4, 0.0))


@pytest.mark.parametrize("shape", [(1, 1), (1, 60), (60, 1)])
def test_a_map_smaller_than_a_coarse_cell_is_refused(shape):
    """Cells of 40 um and apertures of 0.4 mm: a coarse cell has several cells."""
    grid = Grid(left=0.0, top=0.0, cell_x=40e-6, cell_y=40e-6, columns=shape[1], rows=shape[0])
    apertures = [circle(str(k), (0.8e-3 * k, 0.0), 0.2e-3) for k in range(3)]
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    with pytest.raises(ValueError, match=r"shows no part of the paste pattern|the board was not found"):
        align_apertures(np.full(shape, 5e-6), grid, apertures, SETTINGS, initial=here, search_range=(1e-3, 0.0))


@pytest.mark.parametrize("count", [4, 12])
def test_the_covariance_of_equal_residuals_has_a_closed_form(count):
    """Deposits on a circle have radial offsets of alternate signs, which no shift or rotation reduces."""
    here, radius, length = BoardPlacement(x=0.0, y=0.0, theta=0.0), 1e-3, 3e-6
    angle = 2 * math.pi * np.arange(count) / count
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offset = length * (-1.0) ** np.arange(count)[:, None] * outward
    fit = _fit_rigid(SimpleNamespace(offset=offset, centre=radius * outward), here)
    median = math.sqrt(2 * math.log(2))  # of the length of two normal coordinates [sigma]
    weight = (1 - (median / 4.685) ** 2) ** 2  # Tukey
    shrinkage = (2 * count * weight - 3) / (2 * count * weight)
    variance = (length / median) ** 2 / shrinkage / (count * weight)
    np.testing.assert_allclose(
        fit.covariance, np.diag([variance, variance, variance / radius**2]), rtol=1e-3, atol=1e-6 * variance
    )


@pytest.mark.parametrize(("part", "converged"), [(0.09, True), (0.11, False)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_round_that_moves_the_place_by_a_tenth_of_a_sigma_has_not_converged(axis, part, converged):
    """A shift along x or y, or a rotation about the centre, on the offsets of the last test."""
    here, radius, length, count = BoardPlacement(x=0.0, y=0.0, theta=0.0), 1e-3, 3e-6, 12
    angle = 2 * math.pi * np.arange(count) / count
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart = length * (-1.0) ** np.arange(count)[:, None] * outward
    rest = _fit_rigid(SimpleNamespace(offset=apart, centre=radius * outward), here)
    assert rest.converged
    assert rest.moved < 1e-12
    motion = np.zeros(3)
    motion[axis] = part * math.sqrt(rest.covariance[axis, axis])
    across = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
    offset = apart + motion[:2] + motion[2] * radius * across
    fit = _fit_rigid(SimpleNamespace(offset=offset, centre=radius * outward), here)
    np.testing.assert_allclose(fit.motion, motion, atol=1e-3 * np.abs(motion).max())
    assert fit.moved == pytest.approx(np.abs(motion * [1.0, 1.0, radius]).max(), rel=1e-3)
    assert fit.moved > 1e-8
    assert fit.converged == converged


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 12])
def test_the_covariance_of_few_deposits_is_their_variance(rng, count):
    """Mean covariance of 250 draws over the variance of the fitted motions: three parameters shrink the residuals."""
    here = BoardPlacement(x=0.0, y=0.0, theta=0.0)
    angle = 2 * math.pi * np.arange(count) / count
    centre = 1e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    errors, variances = [], []
    for _ in range(250):
        found, covariance, _, _, middle, *_ = _fit_rigid(
            SimpleNamespace(offset=rng.normal(0, 1e-6, (count, 2)), centre=centre), here
        )
        shift = found.to_map(middle) - middle
        errors.append([*shift, found.theta])
        variances.append(np.diag(covariance))
    ratio = np.mean(variances, axis=0) / np.mean(np.square(errors), axis=0)
    assert np.all(np.abs(ratio - 1) < 0.3)  # 3 standard deviations of a variance of 250 draws


def test_memory_does_not_grow_with_the_search_range(rng):
    """A correlation map for each rotation would take 11 MB."""
    grid = board_grid(200, 190, cell=15e-6)
    apertures = [circle(str(k), (0.3e-3 + 0.5e-3 * k, 0.4e-3 * (k % 3 + 1)), 150e-6) for k in range(5)]
    here = BoardPlacement(x=0.1e-3, y=0.1e-3, theta=0.0)
    z = paste_map(grid, here, [(Cap(150e-6, 120e-6), tuple(each.centroid)) for each in apertures])
    peaks = []
    for turn in (0.0, 3.0):
        tracemalloc.start()
        found = align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.1e-3, turn))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert abs(found.placement.theta) < 1e-3
    assert peaks[1] < peaks[0] + 5e6


def test_coarse_heights_are_means_above_the_board(rng):
    """Blocks of 2 x 5 cells, of the cells with a height; the rest of the rows and columns is left out."""
    grid = Grid(left=1e-3, top=2e-3, cell_x=10e-6, cell_y=25e-6, columns=103, rows=61)
    z = 1e-3 + rng.normal(0, 1e-6, grid.shape)
    z[20:24, 40:60] += 80e-6
    z[rng.random(grid.shape) < 0.1] = np.nan
    z[30:32, 50:55] = np.nan  # a block without a height
    apertures = [rectangle(str(k), (1.3e-3, 1.5e-3), (200e-6, 200e-6)) for k in range(3)]
    coarse, above = _coarse_heights(z, grid, apertures)
    # A quarter of the aperture is 50 um: 2 rows of 25 um, 5 columns of 10 um.
    assert (coarse.rows, coarse.columns) == above.shape == (30, 20)
    np.testing.assert_allclose([coarse.cell_x, coarse.cell_y], 50e-6)
    np.testing.assert_allclose([coarse.left, coarse.top], [1e-3 + 20e-6, 2e-3 - 12.5e-6])
    blocks = [[z[2 * r : 2 * r + 2, 5 * c : 5 * c + 5] for c in range(20)] for r in range(30)]
    known = np.array([[np.isfinite(each).any() for each in row] for row in blocks])
    means = np.array([[np.nanmean(each) if np.isfinite(each).any() else np.nan for each in row] for row in blocks])
    assert np.count_nonzero(~known) == 1
    filled = np.where(known, means, np.median(means[known]))
    # The board is the median over five apertures, an odd number of cells: 20 of 50 um and one.
    padded = np.pad(filled, 10, mode="edge")
    board = np.array([[np.median(padded[r : r + 21, c : c + 21]) for c in range(20)] for r in range(30)])
    raised = np.where(known, filled - board, 0.0)
    np.testing.assert_allclose(above, np.clip(raised, 0.0, np.percentile(raised, 99)), atol=1e-12)
    assert above.max() > 50e-6
    flat, zero = _coarse_heights(np.full(grid.shape, 1e-3), grid, apertures)
    assert flat == coarse
    np.testing.assert_array_equal(zero, 0.0)


def test_the_coarse_grid_is_limited_by_its_length_and_by_the_cells():
    """1024 cells along the longer side at most, and no finer than the heights."""
    for grid, aperture, size in (
        (Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=1e-5, columns=4096, rows=8), 20e-6, (1024, 2)),
        (Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=1e-5, columns=8, rows=4096), 20e-6, (2, 1024)),
        (Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=3e-5, columns=30, rows=9), 20e-6, (10, 9)),
    ):
        coarse, _ = _coarse_heights(np.zeros(grid.shape), grid, [rectangle("1", (0.0, 0.0), (aperture, aperture))])
        assert (coarse.columns, coarse.rows) == size


def test_peaks_of_a_correlation():
    """The second peak is more than half an aperture away from the first one; signs are those of the shifts."""
    grid = Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=2e-5, columns=8, rows=6)
    rows, columns = np.array([0, 1, 2, -3, -2, -1])[:, None], np.array([0, 1, 2, 3, -4, -3, -2, -1])[None, :]
    for size, second in ((1e-5, 0.4), (9.9e-5, 0.4), (10.1e-5, 0.3), (15.9e-5, 0.3), (16.1e-5, 0.0)):
        correlation = np.zeros((6, 8))
        correlation[4, 6] = 0.9  # rows -2, columns -2
        correlation[4, 2] = 0.5  # two cells of the longer side away, 4e-5 m: near for any size
        correlation[4, 3] = 0.4  # 5e-5 m
        correlation[2, 6] = 0.3  # 8e-5 m
        assert _peaks(correlation, rows, columns, grid, size) == (-2, -2, second), size
    correlation[:] = -0.2
    correlation[0, 3] = -0.1
    assert _peaks(correlation, rows, columns, grid, 1e-5) == (0, 3, 0.0)


def test_a_placement_turns_about_a_point():
    placement, point = BoardPlacement(x=3e-3, y=-1e-3, theta=0.4, side="bottom"), np.array([2e-3, 5e-3])
    turned = _turned(placement, point, 0.25)
    np.testing.assert_allclose(turned.to_map(point), placement.to_map(point), rtol=1e-12)
    assert (turned.theta, turned.side) == (pytest.approx(0.65), "bottom")


def test_the_pattern_is_1_in_apertures():
    """Also where apertures overlap, and beyond the grid."""
    grid = Grid(left=0.0, top=90e-6, cell_x=10e-6, cell_y=10e-6, columns=12, rows=10)
    apertures = [
        rectangle("1", (25e-6, 65e-6), (30e-6, 20e-6)),
        rectangle("2", (35e-6, 65e-6), (30e-6, 20e-6)),
        rectangle("3", (110e-6, 10e-6), (40e-6, 60e-6)),
        rectangle("4", (300e-6, 10e-6), (40e-6, 60e-6)),
    ]
    x, y = np.meshgrid(grid.x, grid.y)
    expected = (np.abs(x - 30e-6) < 20e-6) & (np.abs(y - 65e-6) < 10e-6)
    expected |= (np.abs(x - 110e-6) < 20e-6) & (np.abs(y - 10e-6) < 30e-6)
    assert np.count_nonzero(expected) == 8 + 12
    np.testing.assert_array_equal(_pattern(grid, apertures, BoardPlacement(x=0.0, y=0.0, theta=0.0)), expected)


def test_a_rotation_beyond_pi_is_pi(monkeypatch):
    grid = board_grid(40, 40, cell=50e-6)
    apertures = [circle(str(k), (0.4e-3 + 0.5e-3 * k, 0.4e-3 * (k % 3 + 1)), 150e-6) for k in range(3)]
    here = BoardPlacement(x=0.1e-3, y=0.1e-3, theta=0.0)
    z = paste_map(grid, here, [(Cap(150e-6, 120e-6), tuple(each.centroid)) for each in apertures])
    ranges = []
    spread = np.linspace
    monkeypatch.setattr(np, "linspace", lambda *args: ranges.append(args[:2]) or spread(*args[:2], min(args[2], 999)))
    align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=(0.1e-3, 1e6))
    assert (-math.pi, math.pi) in ranges
    for search_range in ((-1e-3, 0.1), (1e-3, -0.1), (math.inf, 0.1), (1e-3, math.nan)):
        with pytest.raises(ValueError, match="of the search range"):
            align_apertures(z, grid, apertures, SETTINGS, initial=here, search_range=search_range)
