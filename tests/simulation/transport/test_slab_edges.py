"""Limits of a slab's light at edges that cross a thick sheet, against straight lines drawn one by one."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from gpuvision.simulation.transport.line_runs import Pieces, Runs
from gpuvision.simulation.transport.slab_edges import slanted_limits

WIDTH = 1e-3
SHEETS = np.array([0, 0, 1, 1, 1, 1])
PLACE = np.array([-1.5, 0.25, -2.5, -1.0, 0.5, 1.75])
FIRST, LAST = np.array([0, 2]), np.array([1, 5])


def random_runs(rng: np.random.Generator) -> tuple[Pieces, Runs]:
    """Return up to two runs on each level with random links, and one or two pieces of each run."""
    level, x = [], []
    for number in range(len(PLACE)):
        for middle in (-0.02, 0.03)[: rng.integers(1, 3)]:
            level.append(number)
            x.append(middle + rng.integers(1, 16, 2) * 1e-3 * [-1, 1])
    levels, ends = np.array(level), np.array(x)
    after, before = np.full(len(levels), -1), np.full(len(levels), -1)
    for one, other in ((a, b) for a in range(len(levels)) for b in range(len(levels))):
        follows = levels[other] == levels[one] + 1 and SHEETS[levels[other]] == SHEETS[levels[one]]
        if follows and after[one] < 0 and before[other] < 0 and rng.random() < 0.7:
            after[one], before[other] = other, one
    still = rng.random(len(levels)) < 0.2
    ends[still, 0] = np.where(after[still] >= 0, ends[after[still], 0] - 0.9e-6 * WIDTH, ends[still, 0])
    run, places = [], []
    for number in rng.permutation(len(levels)):
        low, high = ends[number]
        cuts = [low, high] if rng.random() < 0.5 else [low, low + 0.375 * (high - low), high]
        for start, end in itertools.pairwise(cuts):
            run.append(number)
            places.append((start, end))
    nothing = np.zeros((len(run), 2))
    pieces = Pieces(levels[run], np.array(places), nothing, nothing[:, 0], np.zeros(len(run), np.int64))
    straight = rng.random((len(levels), 2)) < 0.7
    none = np.zeros(len(PLACE))
    return pieces, Runs(levels, ends, np.array(run), after, before, straight, none.astype(bool), none)


def edge_beyond(runs: Runs, run: int, side: int, *, above: bool) -> tuple[float, float] | None:
    """Return place and t at which the edge at an end of a run arrives, above or below its level; None if unknown."""
    level = runs.level[run]
    other, back = (runs.next[run], runs.previous[run]) if above else (runs.previous[run], runs.next[run])
    if level in (LAST if above else FIRST):
        # The edge goes on along the line by which it came from the level on the other side.
        if back < 0 or not runs.straight[back if above else run, side]:
            return None
        slope = (runs.x[run, side] - runs.x[back, side]) / (PLACE[level] - PLACE[runs.level[back]])
        t = 4.5 if above else -4.5
        return runs.x[run, side] + slope * (t - PLACE[level]), t
    if other < 0 or not runs.straight[run if above else other, side]:
        return None
    return runs.x[other, side], PLACE[runs.level[other]]


def lines_over(runs: Runs, run: int, *, above: bool) -> list[tuple[float, float, float, int]]:
    """Return place, t, slope and side of each edge that moves into a run, above or below its level."""
    found = []
    for side in (0, 1):
        edge = edge_beyond(runs, run, side, above=above)
        inwards = 1.0 if side == 0 else -1.0
        if edge is not None and inwards * (edge[0] - runs.x[run, side]) > 1e-6 * WIDTH:
            slope = (edge[1] - PLACE[runs.level[run]]) / (edge[0] - runs.x[run, side])
            found.append((*edge, slope, side))
    return found


def limit_at(runs: Runs, run: int, x: float, middle: float, slab: float, *, above: bool) -> float:
    """Return the limit at x of the part of a run around ``middle``."""
    limits = [
        t + (x - place) * slope
        for place, t, slope, side in lines_over(runs, run, above=above)
        if (middle < place if side == 0 else middle > place)
    ]
    return (min if above else max)(limits, default=slab)


def slabs() -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper limits of the slabs of the levels."""
    between = 0.5 * (PLACE[1:] + PLACE[:-1])
    low, high = np.append(-math.inf, between), np.append(between, math.inf)
    low[FIRST], high[LAST] = -math.inf, math.inf
    return low, high


@pytest.mark.parametrize("seed", range(6))
def test_limits_are_lines_between_the_ends_of_runs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pieces, runs = random_runs(rng)
    low, high = slabs()
    found = slanted_limits(pieces, runs, PLACE, low, high, WIDTH)
    assert len(found.piece)
    for piece, run in enumerate(runs.piece_run):
        rows = np.flatnonzero(found.piece == piece)
        edges = [line[0] for above in (False, True) for line in lines_over(runs, run, above=above)]
        if not edges:
            assert not len(rows)
            continue
        start, end = pieces.x[piece]
        cuts = [start, *sorted({each for each in edges if start < each < end}), end]
        rows = rows[np.argsort(found.start[rows])]
        shares = (np.array(cuts) - start) / (end - start)
        np.testing.assert_allclose(found.start[rows], shares[:-1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.end[rows], shares[1:], rtol=0, atol=1e-12)
        level = pieces.level[piece]
        for row, one, other in zip(rows, cuts[:-1], cuts[1:], strict=True):
            for number, x in enumerate((one, other)):
                middle = 0.5 * (one + other)
                lower = limit_at(runs, run, x, middle, low[level], above=False)
                upper = limit_at(runs, run, x, middle, high[level], above=True)
                assert found.low[row, number] == pytest.approx(lower, abs=1e-9)
                assert found.high[row, number] == pytest.approx(max(upper, lower), abs=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_piece_without_width_is_whole(seed: int) -> None:
    """Of a wall along the light, both ends of a piece can round to one x."""
    pieces, runs = random_runs(np.random.default_rng(seed))
    run = int(runs.piece_run[slanted_limits(pieces, runs, PLACE, *slabs(), WIDTH).piece[0]])
    pieces = Pieces(*(np.append(each, each[:1], axis=0) for each in pieces))
    pieces.level[-1], pieces.x[-1] = runs.level[run], runs.x[run].mean()
    found = slanted_limits(pieces, runs._replace(piece_run=np.append(runs.piece_run, run)), PLACE, *slabs(), WIDTH)
    mine = found.piece == len(pieces.x) - 1
    assert (found.start[mine].tolist(), found.end[mine].tolist()) == ([0.0], [1.0])
