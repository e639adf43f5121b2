"""Runs of the line across a thick sheet against their definitions, run by run, and the levels that are divided."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import norm

from gpuvision.simulation.transport.line_runs import Levels, LineScale, Pieces, Runs, find_runs, intervals_to_divide

SCALE = LineScale(sigma=1e-3, width=1e-3, low=0.01, high=0.12)


class Piece(NamedTuple):
    level: int
    x: tuple[float, float]
    height: tuple[float, float]
    rate: float
    kind: int


class Run(NamedTuple):
    level: int
    members: list[Piece]

    @property
    def x(self) -> tuple[float, float]:
        return self.members[0].x[0], self.members[-1].x[1]

    @property
    def is_long(self) -> bool:
        return self.x[1] - self.x[0] > 0.1 * SCALE.width

    def at(self, x: float) -> Piece:
        return max((each for each in self.members if each.x[0] <= x), key=lambda each: each.x[0])


def expected_runs(pieces: list[Piece], levels: int) -> list[Run]:
    """Return the pieces of each level that touch and have the same material."""
    runs: list[Run] = []
    for level in range(levels):
        last = None
        for each in sorted((piece for piece in pieces if piece.level == level), key=lambda piece: piece.x):
            touches = last is not None and (
                each.x[0] - last.x[1] <= 1e-4 * SCALE.width
                and abs(each.height[0] - last.height[1]) <= 1e-4 * SCALE.width
                and each.kind == last.kind
            )
            if touches:
                runs[-1].members.append(each)
            else:
                runs.append(Run(level, [each]))
            last = each
    return runs


def on_one_surface(one: Run, other: Run, place: np.ndarray) -> bool:
    """Return whether the height in the middle of the overlap changes as the planes of both pieces predict."""
    low, high = max(one.x[0], other.x[0]), min(one.x[1], other.x[1])
    if low >= high:
        return False
    middle = 0.5 * (low + high)
    heights, rates = [], []
    for run in (one, other):
        piece = run.at(middle)
        heights.append(np.interp(middle, piece.x, piece.height))
        rates.append(piece.rate)
    step = place[other.level] - place[one.level]
    jump = abs(heights[1] - heights[0] - 0.5 * (rates[0] + rates[1]) * step)
    return bool(jump <= 0.5 * step * SCALE.sigma) and one.members[0].kind == other.members[0].kind


def expected(pieces: list[Piece], place: np.ndarray, sheet: np.ndarray) -> dict[str, Any]:
    """Return the fields of `Runs` by their definitions."""
    runs = expected_runs(pieces, len(place))
    pairs = [
        (i, k)
        for i, one in enumerate(runs)
        for k, other in enumerate(runs)
        if other.level == one.level + 1 and sheet[other.level] == sheet[one.level] and on_one_surface(one, other, place)
        if one.is_long and other.is_long
    ]
    following, previous = [-1] * len(runs), [-1] * len(runs)
    for i, k in pairs:
        if sum(i == pair[0] for pair in pairs) == 1 and sum(k == pair[1] for pair in pairs) == 1:
            following[i], previous[k] = k, i
    slope = np.full((len(runs), 2), np.nan)
    for i, k in enumerate(following):
        if k >= 0:
            slope[i] = np.subtract(runs[k].x, runs[i].x) / (place[runs[k].level] - place[runs[i].level])
    straight = np.zeros((len(runs), 2), bool)
    moves, open_length = np.zeros(len(place), bool), np.zeros(len(place))
    for i, run in enumerate(runs):
        near = [slope[k] for k in (following[i], previous[i]) if k >= 0]
        for end in (0, 1):
            same = [abs(s[end] - slope[i, end]) <= 0.01 * abs(slope[i, end]) + 1e-6 * SCALE.width for s in near]
            straight[i, end] = abs(slope[i, end]) <= 2.0 * SCALE.sigma or any(same)
        x = np.clip(run.x, SCALE.low, SCALE.high)
        if following[i] >= 0:
            other = np.array(runs[following[i]].x)
            moves[run.level] |= np.abs(other - run.x).max() > 1e-6 * SCALE.width
            moved = np.abs(np.clip(other, SCALE.low, SCALE.high) - x)
            open_length[run.level] += moved[~straight[i]].sum()
        elif run.is_long and run.level + 1 < len(place) and sheet[run.level + 1] == sheet[run.level]:
            open_length[run.level] += x[1] - x[0]
        if previous[i] < 0 and run.is_long and run.level > 0 and sheet[run.level - 1] == sheet[run.level]:
            open_length[run.level - 1] += x[1] - x[0]
    return {
        "level": [run.level for run in runs],
        "x": [run.x for run in runs],
        "next": following,
        "previous": previous,
        "straight": straight,
        "moves": moves,
        "open_length": open_length,
    }


def line_of(
    rng: np.random.Generator, level: int, ends: np.ndarray, height: float, rate: float, kind: int
) -> list[Piece]:
    """Return the pieces of one surface; some touch, some do not, one may have another material."""
    count = rng.integers(1, 4)
    cuts = np.sort(rng.uniform(*ends, count - 1))
    low, high = np.append(ends[0], cuts), np.append(cuts, ends[1])
    gap, jump = rng.choice([0.0, 0.5e-7, 2e-7], p=[0.6, 0.2, 0.2], size=(2, count))
    low[1:] += gap[1:]
    slope = rng.uniform(-0.2, 0.2)
    heights = height + slope * (np.stack([low, high], axis=1) - 0.03) + np.cumsum(jump)[:, None]
    kinds = np.where(rng.random(count) < 0.1, 5, kind)
    return [
        Piece(level, (a, b), (c, d), rate, int(k))
        for a, b, (c, d), k in zip(low.tolist(), high.tolist(), heights.tolist(), kinds, strict=True)
        if b > a
    ]


def scene(rng: np.random.Generator) -> tuple[list[Piece], np.ndarray, np.ndarray]:
    """Return pieces, places and sheets: up to three surfaces in slots of 60 mm, over two to nine levels."""
    sheet = np.repeat([0, 1], rng.integers(1, 6, 2))
    place = np.concatenate([np.sort(rng.uniform(-3.0, 3.0, np.count_nonzero(sheet == k))) for k in (0, 1)])
    pieces: list[Piece] = []
    for slot in range(rng.integers(0, 4)):
        slopes = rng.choice([0.0, 1e-3, 4e-3], 2) * rng.choice([-1.0, 1.0], 2)
        rate, wrong = rng.uniform(-1e-3, 1e-3), rng.random() < 0.2
        length = rng.choice([5e-5, 2e-4, 0.03], p=[0.1, 0.1, 0.8])
        for level, t in enumerate(place.tolist()):
            ends = 0.06 * slot + np.array([0.013, 0.013 + length]) + (slopes * t if length > 0.01 else slopes[0] * t)
            ends += rng.choice([0.0, 1e-3], p=[0.8, 0.2]) * np.array([-1.0, 1.0]) * (length > 0.01)
            height = 0.01 * slot + rate * t + wrong * rng.uniform(-2e-3, 2e-3)
            if rng.random() < 0.85:
                pieces += line_of(rng, level, ends, height, rate, kind=slot % 2)
    return [pieces[k] for k in rng.permutation(len(pieces))], place, sheet


def as_arrays(pieces: list[Piece]) -> Pieces:
    level, x, height, rate, kind = zip(*pieces, strict=True) if pieces else ((), (), (), (), ())
    return Pieces(
        np.array(level, np.int64),
        np.array(x, np.float64).reshape(-1, 2),
        np.array(height, np.float64).reshape(-1, 2),
        np.array(rate, np.float64),
        np.array(kind, np.int64),
    )


def test_runs_are_those_of_their_definition(rng: np.random.Generator) -> None:
    kinds = np.zeros(5, int)
    for _ in range(150):
        pieces, place, sheet = scene(rng)
        runs = find_runs(as_arrays(pieces), place, sheet, SCALE)
        wanted = expected(pieces, place, sheet)
        for name, value in wanted.items():
            got = getattr(runs, name)
            np.testing.assert_allclose(got, np.array(value).reshape(got.shape), rtol=1e-9, atol=1e-15, err_msg=name)
        for number, each in enumerate(pieces):
            run = runs.piece_run[number]
            assert runs.level[run] == each.level
            assert runs.x[run, 0] <= each.x[0] < each.x[1] <= runs.x[run, 1]
        straight = runs.straight[runs.next >= 0]
        kinds += [runs.moves.sum(), (runs.open_length > 0).sum(), straight.sum(), (~straight).sum(), len(runs.level)]
    assert (kinds > 50).all()  # every kind occurs


def test_levels_are_divided_where_most_light_changes() -> None:
    """Light is the normal distribution between two levels times the length that changes, at most a sample's width."""
    place, sheet = np.array([-2.0, -1.0, 0.0, 0.5, 0.51, -1.0, 1.0]), np.array([0, 0, 0, 0, 0, 1, 1])
    lengths = np.array([[3.0, 2.0, 1.0, 9.0, 5.0, 0.0, 5.0], [0.0, 0.0, 9.0, 0.0, 0.0, 1e-9, 0.0]]) * 1e-3
    none, pairs = np.zeros(0, np.int64), np.zeros((0, 2))
    runs = [Runs(none, pairs, none, none, none, pairs > 0, np.zeros(7, bool), each) for each in lengths]
    most = lengths.max(axis=0)
    light = np.append(np.minimum(most[:-1], 2.5e-3) * np.diff(norm.cdf(place)), 0.0)
    assert light[1] > light[2] > light[0] > 0.0
    for count, expected_levels in ((1, [1, 5]), (2, [1, 2, 5]), (3, [0, 1, 2, 5]), (9, [0, 1, 2, 5])):
        found = intervals_to_divide(runs, place, sheet, smallest=0.02, most=count, width=2.5e-3)
        assert found.tolist() == expected_levels
    assert intervals_to_divide(runs, place, sheet, smallest=0.005, most=9, width=2.5e-3).tolist() == [0, 1, 2, 3, 5]
    assert intervals_to_divide(runs, place, sheet, smallest=0.5, most=9, width=2.5e-3).tolist() == [0, 1, 5]


def test_levels_of_two_sets_are_joined_in_order(rng: np.random.Generator) -> None:
    pieces, place, sheet = scene(rng)
    while len(pieces) < 10:
        pieces, place, sheet = scene(rng)
    whole = as_arrays(pieces)
    is_first = np.arange(len(place)) % 2 == 0
    parts = []
    for chosen in (is_first, ~is_first):
        number = np.cumsum(chosen) - 1
        some = whole.select(np.flatnonzero(chosen[whole.level]))
        parts.append(Levels(place[chosen], sheet[chosen], (some._replace(level=number[some.level]),)))
    joined = parts[0].joined(parts[1])
    np.testing.assert_array_equal(joined.place, place)
    np.testing.assert_array_equal(joined.profile, sheet)
    (one,), (other,) = joined.runs(SCALE), Levels(place, sheet, (whole,)).runs(SCALE)
    for name in ("level", "x", "next", "previous", "straight", "moves"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.open_length == pytest.approx(other.open_length, rel=1e-12)
