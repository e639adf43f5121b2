"""Runs of the lit or visible line at levels across a thick sheet of light, followed from level to level.

A thick sheet is divided into slabs, and each slab is represented by the line that a thin sheet lights at one level
across the sheet. Between two levels a shadow, a silhouette or the end of a surface moves along the line. On plane
surfaces it moves along a straight line in (x, t), with x the place along the line and t the place across the sheet. An
edge nearly parallel to the sheet instead ends a whole stretch of the line at one t, which `SheetDivision` finds by
bisection.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# A run of the line shorter than this part of a sample's width does not divide a sheet: its light is a small part of the
# sample's light. Chosen.
_SHORT = 0.1
# Ends of pieces nearer than this part of a sample's width touch. Chosen: above the accuracy of visible parts on devices
# without double, far below a sample.
_TOUCHING = 1e-4
# An end that moves by less than this part of a sample's width does not move. Chosen: above rounding.
SMALLEST_MOTION = 1e-6
# Largest change of height between two levels on one surface, beyond the change along the surface's planes, as part of
# the distance of the levels. Chosen: planes that meet at less than 53 degrees pass.
_SAME_SURFACE = 0.5
# Motion of an end of a run, as part of the distance of the levels, up to which it is taken as straight without a third
# level: 26 degrees between edge and sheet. A faster end must continue on the same straight line at the next level, with
# a slope that agrees within the second number. Chosen: a wrong slope then moves an edge by less than 0.005 sigma.
_SLOW_END, _STRAIGHT = 2.0, 0.01


class Pieces(NamedTuple):
    """Pieces of lines at levels of sheets, in any order.

    Attributes
    ----------
    level
        int64 (n,): index of the level.
    x
        float64 (n, 2): place of both ends along the line, ascending [m].
    height
        float64 (n, 2): height of both ends [m].
    rate
        float64 (n,): change of the height along the piece's plane per sigma across the sheet [m].
    kind
        int64 (n,): material.
    """

    level: Integers
    x: Float64
    height: Float64
    rate: Float64
    kind: Integers

    def select(self, which: Integers) -> Pieces:
        """Return the pieces of an index array."""
        return Pieces(self.level[which], self.x[which], self.height[which], self.rate[which], self.kind[which])


class Runs(NamedTuple):
    """Connected stretches of the line at each level, in the order of levels and from left to right.

    Attributes
    ----------
    level
        int64 (r,): index of the level.
    x
        float64 (r, 2): both ends [m].
    piece_run
        int64 (n,): run of each piece, in the order of the pieces given.
    next
        int64 (r,): run of the next level on the same surface, if there is exactly one and it has only this run of the
        level before; else -1.
    previous
        int64 (r,): inverse of `next`.
    straight
        bool (r, 2): whether each end moves to the next run's end along a straight line.
    moves
        bool (levels,): whether an end of a run moves between a level and the next one.
    open_length
        float64 (levels,): length in view of the runs that change between a level and the next one in another way [m].
    """

    level: Integers
    x: Float64
    piece_run: Integers
    next: Integers
    previous: Integers
    straight: Flags
    moves: Flags
    open_length: Float64


class LineScale(NamedTuple):
    """Lengths on the line [m].

    Attributes
    ----------
    sigma
        Standard deviation of the light across the sheet.
    width
        Width of a sample.
    low, high
        Ends of the view; changes beyond them do not count.
    """

    sigma: float
    width: float
    low: float
    high: float


class _ConnectedPieces(NamedTuple):
    """Pieces in the order of levels and from left to right, and the runs that they form.

    Attributes
    ----------
    pieces
        The pieces in this order.
    piece_run
        int64 (n,): run of each piece, in the order of the pieces given.
    first
        int64 (r,): first piece of each run.
    level
        int64 (r,): level of each run.
    ends
        float64 (r, 2): ends of each run [m].
    """

    pieces: Pieces
    piece_run: Integers
    first: Integers
    level: Integers
    ends: Float64

    def sort_key(self, level: Integers, x: Float64) -> Float64:
        """Return numbers that ascend with the level and, in a level, with x [m].

        The key is the level plus a fraction from 0.25 to 0.75 that is linear in x over all pieces. One binary search in
        the keys then serves all levels.
        """
        low, high = float(self.pieces.x.min(initial=0.0)), float(self.pieces.x.max(initial=0.0))
        return np.asarray(level + np.clip(0.25 + 0.5 * (x - low) / max(high - low, 1e-300), 0.0, 0.9))


def find_runs(pieces: Pieces, place: Float64, sheet: Integers, scale: LineScale) -> Runs:
    """Return the runs of the line at each level, and follow them from level to level.

    Pieces that touch and have the same material form a run. A run continues in a run of the next level if both overlap
    in x, lie on the same surface, and neither has another such partner.

    Parameters
    ----------
    pieces
        The pieces of the lines.
    place
        (levels,): place of the levels across the sheet [sigmas], ascending in each sheet.
    sheet
        (levels,): index of the sheet, ascending.
    scale
        Lengths on the line.
    """
    if not len(pieces.level):
        none, pairs = np.zeros(0, np.int64), np.zeros((0, 2))
        still = np.zeros(len(place))
        return Runs(none, pairs, none, none, none, pairs.astype(bool), still.astype(bool), still)
    line = _connect(pieces, scale.width)
    has_next = np.append(sheet[1:] == sheet[:-1], False)
    lower, upper = _overlapping_runs(line, has_next)
    same = _on_one_surface(line, lower, upper, place, scale.sigma)
    is_long = line.ends[:, 1] - line.ends[:, 0] > _SHORT * scale.width
    following, previous = _single_partners(lower[same], upper[same], is_long)
    straight = _straight_ends(line.ends, place[line.level], following, previous, scale.sigma, scale.width)
    changes = _changes(line, following, previous, straight, is_long, has_next, scale)
    return Runs(line.level, line.ends, line.piece_run, following, previous, straight, *changes)


def _connect(pieces: Pieces, width: float) -> _ConnectedPieces:
    """Connect pieces of a level that touch and have the same material."""
    order = np.lexsort((pieces.x[:, 0], pieces.level))
    ordered = pieces.select(order)
    level, x, height = ordered.level, ordered.x, ordered.height
    apart = np.maximum(x[1:, 0] - x[:-1, 1], np.abs(height[1:, 0] - height[:-1, 1])) > _TOUCHING * width
    begins = np.ones(len(level), bool)
    begins[1:] = (np.diff(level) != 0) | apart | (np.diff(ordered.kind) != 0)
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(level)) - 1
    piece_run = np.empty(len(order), np.int64)
    piece_run[order] = np.cumsum(begins) - 1
    return _ConnectedPieces(ordered, piece_run, first, level[first], np.stack([x[first, 0], x[last, 1]], axis=1))


def _overlapping_runs(line: _ConnectedPieces, has_next: Flags) -> tuple[Integers, Integers]:
    """Return the pairs (run, run of the next level of the same sheet) that overlap in x."""
    level, ends = line.level, line.ends
    asked = np.flatnonzero(has_next[level])
    begin = np.searchsorted(line.sort_key(level, ends[:, 1]), line.sort_key(level[asked] + 1, ends[asked, 0]), "right")
    end = np.searchsorted(line.sort_key(level, ends[:, 0]), line.sort_key(level[asked] + 1, ends[asked, 1]), "left")
    count = np.maximum(end - begin, 0)
    return np.repeat(asked, count), concatenated_ranges(begin, count)


def _on_one_surface(line: _ConnectedPieces, lower: Integers, upper: Integers, place: Float64, sigma: float) -> Flags:
    """Return whether pairs of overlapping runs lie on one surface of one material.

    In the middle of the overlap the height must change from level to level as the planes of both pieces predict (the
    mean of their rates), within `_SAME_SURFACE` of the distance of the levels.
    """
    pieces, ends = line.pieces, line.ends
    at = 0.5 * (np.maximum(ends[lower, 0], ends[upper, 0]) + np.minimum(ends[lower, 1], ends[upper, 1]))
    heights, rates = [], []
    for run in (lower, upper):
        key, asked = line.sort_key(pieces.level, pieces.x[:, 0]), line.sort_key(line.level[run], at)
        piece = np.clip(np.searchsorted(key, asked, side="right") - 1, 0, None)
        x, height = pieces.x[piece], pieces.height[piece]
        share = np.clip((at - x[:, 0]) / np.maximum(x[:, 1] - x[:, 0], 1e-300), 0.0, 1.0)
        heights.append(height[:, 0] + share * (height[:, 1] - height[:, 0]))
        rates.append(pieces.rate[piece])
    step = place[line.level[upper]] - place[line.level[lower]]
    jump = np.abs(heights[1] - heights[0] - 0.5 * (rates[0] + rates[1]) * step)
    kind = pieces.kind[line.first]
    return np.asarray((jump <= _SAME_SURFACE * step * sigma) & (kind[lower] == kind[upper]))


def _single_partners(lower: Integers, upper: Integers, is_long: Flags) -> tuple[Integers, Integers]:
    """Return the partner of each run at the next and at the previous level, -1 unless both have one partner only.

    Short runs are not counted.
    """
    count = len(is_long)
    counted = is_long[lower] & is_long[upper]
    partners_above, partners_below = (np.bincount(each[counted], minlength=count) for each in (lower, upper))
    single = counted & (partners_above[lower] == 1) & (partners_below[upper] == 1)
    following, previous = np.full(count, -1), np.full(count, -1)
    following[lower[single]], previous[upper[single]] = upper[single], lower[single]
    return following, previous


def _straight_ends(
    ends: Float64, place: Float64, following: Integers, previous: Integers, sigma: float, width: float
) -> Flags:
    """Return for both ends of each run whether the end moves to the next level along a straight line, (r, 2)."""
    slope = np.full(ends.shape, np.nan)
    has = np.flatnonzero(following >= 0)
    slope[has] = (ends[following[has]] - ends[has]) / (place[following[has]] - place[has])[:, None]
    straight = np.abs(slope) <= _SLOW_END * sigma
    for other in (following, previous):
        beside = np.where((other >= 0)[:, None], slope[other], np.nan)
        straight |= np.abs(beside - slope) <= _STRAIGHT * np.abs(slope) + SMALLEST_MOTION * width
    return np.asarray(straight, bool)


def _changes(
    line: _ConnectedPieces,
    following: Integers,
    previous: Integers,
    straight: Flags,
    is_long: Flags,
    has_next: Flags,
    scale: LineScale,
) -> tuple[Flags, Float64]:
    """Return `Runs.moves` and `Runs.open_length` of all levels."""
    level, ends, levels = line.level, line.ends, len(has_next)
    shift = np.abs(ends[following] - ends).max(axis=1) > SMALLEST_MOTION * scale.width
    moves = np.bincount(level[(following >= 0) & shift], minlength=levels) > 0
    # Runs that begin or end between two levels, and ends that move, but not along a straight line.
    ends_here = is_long & (following < 0) & has_next[level]
    begins_here = is_long & (previous < 0) & (level > 0)
    begins_here[begins_here] &= has_next[level[begins_here] - 1]
    is_crooked = (following >= 0) & ~straight.all(axis=1)
    in_view = np.clip(ends, scale.low, scale.high)
    length = in_view[:, 1] - in_view[:, 0]
    moved = np.abs(np.where(straight, 0.0, in_view[following] - in_view)).sum(axis=1)
    open_length = np.bincount(level[ends_here], length[ends_here], levels)
    open_length = open_length + np.bincount(level[is_crooked], moved[is_crooked], levels)
    open_length = open_length + np.bincount(level[begins_here] - 1, length[begins_here], levels)
    return moves, np.asarray(open_length, np.float64)


def intervals_to_divide(
    runs: list[Runs], place: Float64, sheet: Integers, smallest: float, most: int, width: float
) -> Integers:
    """Return the levels after which a sheet is to be divided: where runs change, the most light first.

    Parameters
    ----------
    runs
        Runs of the lit line, of the visible line.
    place, sheet
        As of `find_runs`.
    smallest
        Distance of levels below which no more division is needed [sigmas].
    most
        Largest number of intervals per sheet.
    width
        Width of a sample on the line [m].
    """
    changed = np.max([each.open_length for each in runs], axis=0)
    step = np.append(np.diff(place), 0.0)
    share = np.append(np.abs(np.diff(ndtr(place))), 0.0)
    weight = np.where((changed > 0.0) & (step > smallest), np.minimum(changed, width) * share, 0.0)
    order = np.lexsort((-weight, sheet))
    rank = np.arange(len(order)) - np.searchsorted(sheet, sheet[order])
    return np.sort(order[(rank < most) & (weight[order] > 0.0)])


class Levels(NamedTuple):
    """Levels across the sheets of profiles, in order, with their lines.

    Attributes
    ----------
    place
        float64 (levels,): place across the sheet [sigmas].
    profile
        int64 (levels,): index of the profile.
    lines
        Pieces of the visible line, of the lit line.
    """

    place: Float64
    profile: Integers
    lines: tuple[Pieces, ...]

    def joined(self, more: Levels) -> Levels:
        """Return these levels and others in order."""
        place, profile = np.append(self.place, more.place), np.append(self.profile, more.profile)
        order = np.lexsort((place, profile))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        lines = []
        for one, two in zip(self.lines, more.lines, strict=True):
            both = Pieces(*(np.concatenate(each) for each in zip(one, two, strict=True)))
            level = np.concatenate([one.level, two.level + len(self.place)])
            lines.append(both._replace(level=rank[level]))
        return Levels(place[order], profile[order], tuple(lines))

    def runs(self, scale: LineScale) -> list[Runs]:
        """Return the runs of each kind of line."""
        return [find_runs(pieces, self.place, self.profile, scale) for pieces in self.lines]
