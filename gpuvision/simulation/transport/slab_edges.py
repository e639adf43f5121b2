"""Edges across a thick sheet of light: where the lit or visible line changes between the levels of a sheet.

A thick sheet is divided into slabs, and each slab is represented by the line that a thin sheet lights at one level
across the sheet. Between two levels a shadow, a silhouette or the end of a surface moves along the line. On plane
surfaces it moves along a straight line in (x, t), with x the place along the line and t the place across the sheet. An
edge nearly parallel to the sheet instead ends a whole stretch of the line at one t, which `SheetLevels` finds by
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
_STILL = 1e-6
# Largest change of height between two levels on one surface, beyond the change along the surface's planes, as part of
# the distance of the levels. Chosen: planes that meet at less than 53 degrees pass.
_SAME_SURFACE = 0.5
# Motion of an end of a run, as part of the distance of the levels, up to which it is taken as straight without a third
# level: 26 degrees between edge and sheet. A faster end must continue on the same straight line at the next level, with
# a slope that agrees within the second number. Chosen: a wrong slope then moves an edge by less than 0.005 sigma.
_SLOW_END, _STRAIGHT = 2.0, 0.01
# Light beyond this place is not divided further [sigmas]: 7e-6 of the light lies beyond.
_OUTER = 4.5


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


def find_runs(pieces: Pieces, place: Float64, sheet: Integers, scale: LineScale) -> Runs:
    """Return the runs of the line at each level, and follow them from level to level.

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
    sigma, width = scale.sigma, scale.width
    if not len(pieces.level):
        none, pairs = np.zeros(0, np.int64), np.zeros((0, 2))
        still = np.zeros(len(place))
        return Runs(none, pairs, none, none, none, pairs.astype(bool), still.astype(bool), still)
    order = np.lexsort((pieces.x[:, 0], pieces.level))
    level, kind, rate = pieces.level[order], pieces.kind[order], pieces.rate[order]
    x, height = pieces.x[order], pieces.height[order]
    new = np.ones(len(level), bool)
    apart = np.maximum(x[1:, 0] - x[:-1, 1], np.abs(height[1:, 0] - height[:-1, 1])) > _TOUCHING * width
    new[1:] = (np.diff(level) != 0) | apart | (np.diff(kind) != 0)
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(level)) - 1
    run = np.cumsum(new) - 1
    piece_run = np.empty(len(order), np.int64)
    piece_run[order] = run
    ends, of = np.stack([x[first, 0], x[last, 1]], axis=1), level[first]
    count = len(first)

    # Candidates: runs of the next level of the same sheet that overlap in x.
    has_next = np.append(sheet[1:] == sheet[:-1], False)
    low, high = float(x.min(initial=0.0)), float(x.max(initial=0.0))

    def key(at: Integers, where: Float64) -> Float64:
        """Return numbers that ascend with the level and, in a level, with x."""
        return np.asarray(at + np.clip(0.25 + 0.5 * (where - low) / max(high - low, 1e-300), 0.0, 0.9))

    asked = np.flatnonzero(has_next[of])
    begin = np.searchsorted(key(of, ends[:, 1]), key(of[asked] + 1, ends[asked, 0]), side="right")
    end = np.searchsorted(key(of, ends[:, 0]), key(of[asked] + 1, ends[asked, 1]), side="left")
    number = np.maximum(end - begin, 0)
    one, two = np.repeat(asked, number), concatenated_ranges(begin, number)
    at = 0.5 * (np.maximum(ends[one, 0], ends[two, 0]) + np.minimum(ends[one, 1], ends[two, 1]))
    heights, rates = [], []
    for each in (one, two):
        piece = np.clip(np.searchsorted(key(level, x[:, 0]), key(of[each], at), side="right") - 1, 0, None)
        span = np.maximum(x[piece, 1] - x[piece, 0], 1e-300)
        share = np.clip((at - x[piece, 0]) / span, 0.0, 1.0)
        heights.append(height[piece, 0] + share * (height[piece, 1] - height[piece, 0]))
        rates.append(rate[piece])
    step = place[of[two]] - place[of[one]]
    jump = np.abs(heights[1] - heights[0] - 0.5 * (rates[0] + rates[1]) * step)
    same = (jump <= _SAME_SURFACE * step * sigma) & (kind[first[one]] == kind[first[two]])
    one, two, step = one[same], two[same], step[same]

    long = ends[:, 1] - ends[:, 0] > _SHORT * width
    counted = long[one] & long[two]
    uses = [np.bincount(each[counted], minlength=count) for each in (one, two)]
    single = counted & (uses[0][one] == 1) & (uses[1][two] == 1)
    following, previous = np.full(count, -1), np.full(count, -1)
    following[one[single]], previous[two[single]] = two[single], one[single]
    straight = _straight_ends(ends, place[of], following, previous, sigma, width)

    bad = long & (following < 0) & has_next[of]
    bad_before = long & (previous < 0) & (of > 0)
    bad_before[bad_before] &= has_next[of[bad_before] - 1]
    crooked = (following >= 0) & ~straight.all(axis=1)
    in_view = np.clip(ends, scale.low, scale.high)
    length = in_view[:, 1] - in_view[:, 0]
    moved = np.abs(np.where(straight, 0.0, in_view[following] - in_view)).sum(axis=1)
    levels = len(place)
    shift = np.abs(ends[following] - ends).max(axis=1) > _STILL * width
    moves = np.bincount(of[(following >= 0) & shift], minlength=levels) > 0
    open_length = np.bincount(of[bad], length[bad], levels) + np.bincount(of[crooked], moved[crooked], levels)
    open_length = open_length + np.bincount(of[bad_before] - 1, length[bad_before], levels)
    return Runs(of, ends, piece_run, following, previous, straight, moves, np.asarray(open_length, np.float64))


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
        straight |= np.abs(beside - slope) <= _STRAIGHT * np.abs(slope) + _STILL * width
    return np.asarray(straight, bool)


class SlantedLimits(NamedTuple):
    """Limits across the sheet of pieces of lines, linear along each piece [sigmas].

    Attributes
    ----------
    piece
        int64 (n,): index of the piece.
    start, end
        float64 (n,): begin and end as fractions of the piece in x, 0 to 1.
    low, high
        float64 (n, 2): limits at the begin and the end.
    """

    piece: Integers
    start: Float64
    end: Float64
    low: Float64
    high: Float64


def slanted_limits(
    pieces: Pieces, runs: Runs, place: Float64, slab_low: Float64, slab_high: Float64, width: float
) -> SlantedLimits:
    """Return the limits of pieces whose runs end between their level and a neighbouring one.

    Where a run is longer than the next level's run, light of its level reaches up to the straight line between the two
    ends, and below that line the other way round. Other pieces keep the limits of their slabs and are not returned.

    Parameters
    ----------
    pieces, runs
        As of `find_runs`.
    place, slab_low, slab_high
        (levels,): place, and limits of the slab of each level [sigmas].
    width
        Width of a sample on the line [m].
    """
    run, least = runs.piece_run, _STILL * width
    neighbours = []
    for other, up in ((runs.next, True), (runs.previous, False)):
        # End of the neighbouring run, for each run (r, 2); without one, the same end.
        good = runs.straight if up else np.where((other >= 0)[:, None], runs.straight[other], False)
        known = (other >= 0)[:, None] & good
        x = np.where(known, runs.x[other], runs.x)
        t = np.where(other >= 0, place[runs.level[other]], 0.0)
        # Beyond the outermost level an end moves on along its line.
        outer = other < 0
        back = runs.previous if up else runs.next
        outer &= (back >= 0) & (slab_high[runs.level] == np.inf if up else slab_low[runs.level] == -np.inf)
        back_good = np.where((back >= 0)[:, None], runs.straight if not up else runs.straight[back], False)
        own = place[runs.level]
        reach = _OUTER if up else -_OUTER
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (runs.x - runs.x[back]) / (own - place[runs.level[back]])[:, None]
        moved = runs.x + slope * (reach - own)[:, None]
        x = np.where(outer[:, None] & back_good & np.isfinite(moved), moved, x)
        t = np.where(outer, reach, t)
        inward = np.stack([x[:, 0] > runs.x[:, 0] + least, x[:, 1] < runs.x[:, 1] - least], axis=1)
        neighbours.append((x, t, inward, up))
    touched = np.flatnonzero(np.any([each[2].any(axis=1) for each in neighbours], axis=0)[run])
    piece, x = touched, pieces.x[touched]
    start, end = x[:, 0], x[:, 1]
    for x_other, _, inward, _ in neighbours:
        for side in (0, 1):
            cut = np.where(inward[run[piece], side], x_other[run[piece], side], np.nan)
            split = (cut > start) & (cut < end)
            piece = np.concatenate([piece, piece[split]])
            start, end = np.concatenate([start, cut[split]]), np.concatenate([np.where(split, cut, end), end[split]])
    of, level = run[piece], pieces.level[piece]
    low = np.repeat(slab_low[level][:, None], 2, axis=1)
    high = np.repeat(slab_high[level][:, None], 2, axis=1)
    ends, middle, own = np.stack([start, end], axis=1), 0.5 * (start + end), place[level][:, None]
    for x_other, t, inward, up in neighbours:
        limit = np.full(ends.shape, np.inf if up else -np.inf)
        for side in (0, 1):
            far, near = x_other[of, side], runs.x[of, side]
            beyond = inward[of, side] & ((middle < far) if side == 0 else (middle > far))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.clip((ends - near[:, None]) / (far - near)[:, None], 0.0, 1.0)
            line = own + share * (t[of][:, None] - own)
            limit = np.where(beyond[:, None], np.minimum(limit, line) if up else np.maximum(limit, line), limit)
        if up:
            high = np.where(np.isfinite(limit), limit, high)
        else:
            low = np.where(np.isfinite(limit), limit, low)
    span = pieces.x[piece, 1] - pieces.x[piece, 0]
    return SlantedLimits(
        piece,
        (start - pieces.x[piece, 0]) / span,
        (end - pieces.x[piece, 0]) / span,
        low,
        np.maximum(low, high),
    )


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
