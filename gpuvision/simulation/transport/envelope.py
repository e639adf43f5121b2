"""Upper envelope of segments in the plane, for several groups of segments at once; exact to rounding."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Pairs of a segment and an interval in memory at once: some 100 MB. More are divided into halves.
_MAX_PAIRS = 1_000_000
# Relative rounding of a height at a crossing. Derived: some hundred roundings of double.
_HEIGHT_ROUNDING = 1e-13


class Pieces(NamedTuple):
    """Pieces of segments, group by group and from left to right.

    Attributes
    ----------
    segment
        int64 (k,): index of the segment.
    left, right
        float64 (k,): x at which a piece begins and ends. Pieces of one group do not overlap.
    """

    segment: Integers
    left: Float64
    right: Float64


def upper_envelope(group: npt.ArrayLike, x: npt.ArrayLike, height: npt.ArrayLike) -> Pieces:
    """Return the pieces of segments that no other segment of the same group lies above.

    Parameters
    ----------
    group
        (n,) integers.
    x
        (n, 2): begin and end of each segment. Segments whose end is not beyond their begin are ignored.
    height
        (n, 2): heights there.

    Notes
    -----
    All ends of a group divide the x axis into intervals. A segment that is the highest at both ends of an interval is
    the highest in all of it. Otherwise the segments that are highest at either end cross; the interval is divided at
    the crossing and the test is repeated. Of coincident segments the first is taken.

    Where many long segments overlap, the envelopes of two halves are computed first, and then the envelope of the two:
    this takes n log n steps instead of n^2.
    """
    group, x, height = np.asarray(group, np.int64), np.asarray(x, np.float64), np.asarray(height, np.float64)
    kept = np.flatnonzero(x[:, 0] < x[:, 1])
    found = _envelope(group[kept], x[kept], height[kept])
    return Pieces(kept[found.segment], found.left, found.right)


def _envelope(group: Integers, x: Float64, height: Float64) -> Pieces:
    if not len(group):
        return Pieces(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    places, first, last = _breakpoints(group, x)
    if int((last - first).sum()) > max(_MAX_PAIRS, 4 * len(group)) and len(group) > 2:
        return _envelope_of_halves(group, x, height)
    owner = np.repeat(np.arange(len(group)), last - first)
    interval = concatenated_ranges(first, last - first)
    order = np.argsort(interval, kind="stable")
    owner, interval = owner[order], interval[order]
    begin = np.flatnonzero(np.diff(interval, prepend=-1))
    count, interval = np.diff(begin, append=len(owner)), interval[begin]
    left, right = places[interval], places[interval + 1]
    at_left = _heights_at(x[owner], height[owner], np.repeat(left, count))
    at_right = _heights_at(x[owner], height[owner], np.repeat(right, count))
    first_top = owner[_highest_rows(begin, count, at_left, at_right)]
    last_top = owner[_highest_rows(begin, count, at_right, at_left)]
    crossed = np.flatnonzero(first_top != last_top)
    pieces = Pieces(first_top, left, right)
    if len(crossed):
        among = _Crossings(x, height, owner, begin[crossed], count[crossed])
        parts = among.pieces(pieces, last_top, crossed)
        pieces = _concatenate([_select(pieces, first_top == last_top), parts])
        pieces = _select(pieces, np.lexsort((pieces.left, group[pieces.segment])))
    return _merge_touching(pieces)


def _envelope_of_halves(group: Integers, x: Float64, height: Float64) -> Pieces:
    """Compute the envelopes of every second segment and of the others, then the envelope of both."""
    halves = []
    for half in (np.arange(0, len(group), 2), np.arange(1, len(group), 2)):
        found = _envelope(group[half], x[half], height[half])
        halves.append(Pieces(half[found.segment], found.left, found.right))
    parts = _concatenate(halves)
    # At most two pieces overlap at any x now.
    ends = np.stack(
        [_heights_at(x[parts.segment], height[parts.segment], each) for each in (parts.left, parts.right)], axis=1
    )
    found = _envelope(group[parts.segment], np.stack([parts.left, parts.right], axis=1), ends)
    return _merge_touching(Pieces(parts.segment[found.segment], found.left, found.right))


def _breakpoints(group: Integers, x: Float64) -> tuple[Float64, Integers, Integers]:
    """Return all ends of segments in order, and the indices of each segment's own ends among them."""
    ends, groups = x.T.ravel(), np.tile(group, 2)
    order = np.lexsort((ends, groups))
    ends, groups = ends[order], groups[order]
    new = np.ones(len(ends), bool)
    new[1:] = (np.diff(ends) != 0.0) | (np.diff(groups) != 0)
    number = np.empty(len(ends), np.int64)
    number[order] = np.cumsum(new) - 1
    return ends[new], number[: len(group)], number[len(group) :]


def _heights_at(x: Float64, height: Float64, at: Float64) -> Float64:
    """Return heights of segments at places, exact at their ends."""
    (a, b), (low, high) = x.T, height.T
    return np.asarray(np.where(at >= b, high, low + (at - a) / (b - a) * (high - low)))


def _highest_rows(begin: Integers, count: Integers, here: Float64, there: Float64) -> Integers:
    """Return the row with the largest ``here`` in each run; of equal rows, the row with the largest ``there``."""
    best = here == np.repeat(np.maximum.reduceat(here, begin), count)
    there = np.where(best, there, -np.inf)
    best &= there == np.repeat(np.maximum.reduceat(there, begin), count)
    rows = np.where(best, np.arange(len(here)), len(here))
    return np.asarray(np.minimum.reduceat(rows, begin))


class _Crossings:
    """Intervals in which segments cross, with all segments that reach over them."""

    def __init__(self, x: Float64, height: Float64, owner: Integers, begin: Integers, count: Integers) -> None:
        self.x, self.height, self.owner, self.begin, self.count = x, height, owner, begin, count

    def pieces(self, whole: Pieces, last_top: Integers, crossed: Integers) -> Pieces:
        """Divide intervals where the segment that is highest at the left crosses the one highest at the right."""
        run = np.arange(len(crossed))
        left, right, one, two = whole.left[crossed], whole.right[crossed], whole.segment[crossed], last_top[crossed]
        done: list[Pieces] = []
        while len(run):
            at = self._crossing(left, right, one, two)
            top = self._top(run, at)
            level = _heights_at(self.x[top], self.height[top], at)
            known = np.maximum(*(_heights_at(self.x[each], self.height[each], at) for each in (one, two)))
            inside = (at > left) & (at < right)
            # A third segment counts as higher only beyond the rounding of the heights.
            more = inside & (level > known + _HEIGHT_ROUNDING * np.abs(level)) & (top != one) & (top != two)
            ended = ~more
            done.append(Pieces(one[ended], left[ended], at[ended]))
            done.append(Pieces(two[ended], at[ended], right[ended]))
            run, top, at = np.tile(run[more], 2), top[more], at[more]
            left, right = np.concatenate([left[more], at]), np.concatenate([at, right[more]])
            one, two = np.concatenate([one[more], top]), np.concatenate([top, two[more]])
        joined = _concatenate(done)
        return _select(joined, joined.left < joined.right)

    def _crossing(self, left: Float64, right: Float64, one: Integers, two: Integers) -> Float64:
        above = _heights_at(self.x[one], self.height[one], left) - _heights_at(self.x[two], self.height[two], left)
        below = _heights_at(self.x[two], self.height[two], right) - _heights_at(self.x[one], self.height[one], right)
        both = above + below
        share = np.divide(above, both, out=np.ones_like(both), where=both > 0.0)
        return np.clip(left + share * (right - left), left, right)

    def _top(self, run: Integers, at: Float64) -> Integers:
        """Return the highest segment of each run at a place."""
        count = self.count[run]
        owner = self.owner[concatenated_ranges(self.begin[run], count)]
        level = _heights_at(self.x[owner], self.height[owner], np.repeat(at, count))
        return np.asarray(owner[_highest_rows(np.cumsum(count) - count, count, level, level)])


def _select(pieces: Pieces, which: npt.NDArray[np.generic]) -> Pieces:
    return Pieces(pieces.segment[which], pieces.left[which], pieces.right[which])


def _concatenate(parts: list[Pieces]) -> Pieces:
    member, left, right = zip(*parts, strict=True)
    return Pieces(np.concatenate(member), np.concatenate(left), np.concatenate(right))


def _merge_touching(pieces: Pieces) -> Pieces:
    """Merge neighbouring pieces of one segment that touch."""
    new = np.ones(len(pieces.segment), bool)
    new[1:] = (np.diff(pieces.segment) != 0) | (pieces.left[1:] != pieces.right[:-1])
    begin = np.flatnonzero(new)
    ends = np.append(begin[1:], len(new)) - 1
    return Pieces(pieces.segment[begin], pieces.left[begin], pieces.right[ends])
