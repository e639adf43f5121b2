"""What lies on top: the upper envelope of segments in the plane, exact, several scenes of them at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.transport.sheet_cut import ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Pairs of a segment and an interval that are looked at in one go: some 100 MB.
_PAIRS = 1_000_000


class Pieces(NamedTuple):
    """Pieces of segments, in the order of their groups and then from left to right.

    Attributes
    ----------
    member
        (k,): which segment.
    left, right
        (k,): where a piece begins and ends; pieces of one group do not overlap.
    """

    member: Integers
    left: Float64
    right: Float64


def upper_envelope(group: npt.ArrayLike, x: npt.ArrayLike, height: npt.ArrayLike) -> Pieces:
    """Return which pieces of segments nothing of the same group lies above.

    Parameters
    ----------
    group
        (n,) integers.
    x
        (n, 2), where segments begin and end; those that do not end beyond their begin are left out.
    height
        (n, 2), there.

    Notes
    -----
    All the ends of a group cut the line into intervals. In an interval a segment is the highest throughout if it is so
    at both ends; else the two that are highest at either end cross, and what is highest there decides again. Of several
    that coincide the first one is taken. Where many long segments lie above each other, halves are done first: the
    work is n log n, not n^2.
    """
    group, x, height = np.asarray(group, np.int64), np.asarray(x, np.float64), np.asarray(height, np.float64)
    kept = np.flatnonzero(x[:, 0] < x[:, 1])
    found = _envelope(group[kept], x[kept], height[kept])
    return Pieces(kept[found.member], found.left, found.right)


def _envelope(group: Integers, x: Float64, height: Float64) -> Pieces:
    if not len(group):
        return Pieces(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    places, first, last = _intervals(group, x)
    if int((last - first).sum()) > max(_PAIRS, 4 * len(group)) and len(group) > 2:
        return _by_halves(group, x, height)
    owner = np.repeat(np.arange(len(group)), last - first)
    interval = ranges(first, last - first)
    order = np.argsort(interval, kind="stable")
    owner, interval = owner[order], interval[order]
    begin = np.flatnonzero(np.diff(interval, prepend=-1))
    count, interval = np.diff(begin, append=len(owner)), interval[begin]
    left, right = places[interval], places[interval + 1]
    at_left = _height(x[owner], height[owner], np.repeat(left, count))
    at_right = _height(x[owner], height[owner], np.repeat(right, count))
    first_top = owner[_highest(begin, count, at_left, at_right)]
    last_top = owner[_highest(begin, count, at_right, at_left)]
    crossed = np.flatnonzero(first_top != last_top)
    whole = Pieces(first_top, left, right)
    if len(crossed):
        among = _Among(x, height, owner, begin[crossed], count[crossed])
        parts = among.pieces(whole, last_top, crossed)
        whole = _together([_those(whole, first_top == last_top), parts])
        whole = _those(whole, np.lexsort((whole.left, group[whole.member])))
    return _joined(whole)


def _by_halves(group: Integers, x: Float64, height: Float64) -> Pieces:
    """Leave out what is hidden within either half of the segments, and look at what is left."""
    halves = []
    for half in (np.arange(0, len(group), 2), np.arange(1, len(group), 2)):
        found = _envelope(group[half], x[half], height[half])
        halves.append(Pieces(half[found.member], found.left, found.right))
    parts = _together(halves)
    # No more than two lie above each other now.
    ends = np.stack(
        [_height(x[parts.member], height[parts.member], each) for each in (parts.left, parts.right)], axis=1
    )
    found = _envelope(group[parts.member], np.stack([parts.left, parts.right], axis=1), ends)
    return _joined(Pieces(parts.member[found.member], found.left, found.right))


def _intervals(group: Integers, x: Float64) -> tuple[Float64, Integers, Integers]:
    """Return all ends in order, and which of them a segment's are."""
    ends, groups = x.T.ravel(), np.tile(group, 2)
    order = np.lexsort((ends, groups))
    ends, groups = ends[order], groups[order]
    new = np.ones(len(ends), bool)
    new[1:] = (np.diff(ends) != 0.0) | (np.diff(groups) != 0)
    number = np.empty(len(ends), np.int64)
    number[order] = np.cumsum(new) - 1
    return ends[new], number[: len(group)], number[len(group) :]


def _height(x: Float64, height: Float64, at: Float64) -> Float64:
    """Return heights of segments at places, exact at their ends."""
    (a, b), (low, high) = x.T, height.T
    return np.asarray(np.where(at >= b, high, low + (at - a) / (b - a) * (high - low)))


def _highest(begin: Integers, count: Integers, here: Float64, there: Float64) -> Integers:
    """Return the row of the highest in every run of rows; of several the one that is highest at the other place."""
    best = here == np.repeat(np.maximum.reduceat(here, begin), count)
    there = np.where(best, there, -np.inf)
    best &= there == np.repeat(np.maximum.reduceat(there, begin), count)
    rows = np.where(best, np.arange(len(here)), len(here))
    return np.asarray(np.minimum.reduceat(rows, begin))


class _Among:
    """Intervals in which segments cross, and all that there are in them."""

    def __init__(self, x: Float64, height: Float64, owner: Integers, begin: Integers, count: Integers) -> None:
        self.x, self.height, self.owner, self.begin, self.count = x, height, owner, begin, count

    def pieces(self, whole: Pieces, last_top: Integers, crossed: Integers) -> Pieces:
        """Cut the intervals where what is highest at the left crosses what is highest at the right."""
        run = np.arange(len(crossed))
        left, right, one, two = whole.left[crossed], whole.right[crossed], whole.member[crossed], last_top[crossed]
        done: list[Pieces] = []
        while len(run):
            at = self._crossing(left, right, one, two)
            top = self._top(run, at)
            level = _height(self.x[top], self.height[top], at)
            known = np.maximum(*(_height(self.x[each], self.height[each], at) for each in (one, two)))
            inside = (at > left) & (at < right)
            more = inside & (level > known + 1e-13 * np.abs(level)) & (top != one) & (top != two)
            ended = ~more
            done.append(Pieces(one[ended], left[ended], at[ended]))
            done.append(Pieces(two[ended], at[ended], right[ended]))
            run, top, at = np.tile(run[more], 2), top[more], at[more]
            left, right = np.concatenate([left[more], at]), np.concatenate([at, right[more]])
            one, two = np.concatenate([one[more], top]), np.concatenate([top, two[more]])
        joined = _together(done)
        return _those(joined, joined.left < joined.right)

    def _crossing(self, left: Float64, right: Float64, one: Integers, two: Integers) -> Float64:
        above = _height(self.x[one], self.height[one], left) - _height(self.x[two], self.height[two], left)
        below = _height(self.x[two], self.height[two], right) - _height(self.x[one], self.height[one], right)
        both = above + below
        share = np.divide(above, both, out=np.ones_like(both), where=both > 0.0)
        return np.clip(left + share * (right - left), left, right)

    def _top(self, run: Integers, at: Float64) -> Integers:
        """Return the highest of what there is in the runs at a place."""
        count = self.count[run]
        owner = self.owner[ranges(self.begin[run], count)]
        level = _height(self.x[owner], self.height[owner], np.repeat(at, count))
        return np.asarray(owner[_highest(np.cumsum(count) - count, count, level, level)])


def _those(pieces: Pieces, which: npt.NDArray[np.generic]) -> Pieces:
    return Pieces(pieces.member[which], pieces.left[which], pieces.right[which])


def _together(parts: list[Pieces]) -> Pieces:
    member, left, right = zip(*parts, strict=True)
    return Pieces(np.concatenate(member), np.concatenate(left), np.concatenate(right))


def _joined(pieces: Pieces) -> Pieces:
    """Join pieces of one segment that touch."""
    new = np.ones(len(pieces.member), bool)
    new[1:] = (np.diff(pieces.member) != 0) | (pieces.left[1:] != pieces.right[:-1])
    begin = np.flatnonzero(new)
    ends = np.append(begin[1:], len(new)) - 1
    return Pieces(pieces.member[begin], pieces.left[begin], pieces.right[ends])
