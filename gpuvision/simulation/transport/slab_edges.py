"""Limits of a slab's light at edges that cross a thick sheet of light, between the levels of its slabs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.transport.line_runs import SMALLEST_MOTION, Pieces, Runs

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# Light beyond this place is not divided further [sigmas]: 7e-6 of the light lies beyond.
_OUTER = 4.5


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


class _NeighbourEnds(NamedTuple):
    """Ends of the runs of the neighbouring levels on one side.

    Attributes
    ----------
    x
        float64 (r, 2): ends of the run that continues each run [m]; the run's own ends where that is not known.
    t
        float64 (r,): place of the neighbouring level across the sheet [sigmas].
    inward
        bool (r, 2): whether the neighbouring end lies inside the run.
    is_above
        Whether the neighbouring level is the next one, not the previous one.
    """

    x: Float64
    t: Float64
    inward: Flags
    is_above: bool


def slanted_limits(
    pieces: Pieces, runs: Runs, place: Float64, slab_low: Float64, slab_high: Float64, width: float
) -> SlantedLimits:
    """Return the limits of pieces whose runs end between their level and a neighbouring one.

    A run that ends at x0 at its level t0 and at x1 at the neighbouring level t1 is bounded by the straight line
    t(x) = t0 + (x - x0) / (x1 - x0) (t1 - t0). If x1 lies inside the run, light of the run's level at x between x1 and
    x0 reaches across the sheet up to t(x) (down to t(x), for the previous level). If x1 lies outside of the run, the
    same line limits the light of the neighbouring level. Pieces without such a limit keep the limits of their slabs and
    are not returned.

    Parameters
    ----------
    pieces, runs
        As of `find_runs`.
    place, slab_low, slab_high
        (levels,): place, and limits of the slab of each level [sigmas].
    width
        Width of a sample on the line [m].
    """
    above = _neighbour_ends(runs, place, slab_high == np.inf, width, is_above=True)
    below = _neighbour_ends(runs, place, slab_low == -np.inf, width, is_above=False)
    piece, ends = _split_at_ends(pieces, runs, (above, below))
    run, level = runs.piece_run[piece], pieces.level[piece]
    upper = _limit_between(above, runs, run, place, ends)
    lower = _limit_between(below, runs, run, place, ends)
    high = np.where(np.isfinite(upper), upper, slab_high[level][:, None])
    low = np.where(np.isfinite(lower), lower, slab_low[level][:, None])
    start, end = pieces.x[piece].T
    # A piece whose ends round to one x is not split.
    extent = (end - start)[:, None]
    share = np.where(extent > 0.0, (ends - start[:, None]) / np.where(extent > 0.0, extent, 1.0), (0.0, 1.0))
    return SlantedLimits(piece, share[:, 0], share[:, 1], low, np.maximum(low, high))


def _neighbour_ends(runs: Runs, place: Float64, is_outermost: Flags, width: float, *, is_above: bool) -> _NeighbourEnds:
    """Return where the ends of runs continue at the next (or previous) level.

    Beyond an outermost level (``is_outermost`` (levels,)), an end that came along a straight line moves on along it to
    `_OUTER`.
    """
    other, back = (runs.next, runs.previous) if is_above else (runs.previous, runs.next)
    # Runs.straight belongs to the lower one of two levels.
    straight, straight_back = runs.straight, runs.straight[back]
    if not is_above:
        straight, straight_back = runs.straight[other], runs.straight
    own = place[runs.level]
    x = np.where((other >= 0)[:, None] & straight, runs.x[other], runs.x)
    t = np.where(other >= 0, place[runs.level[other]], 0.0)

    # The runs of an outermost level have no neighbour beyond it.
    continues = (back >= 0) & is_outermost[runs.level]
    reach = _OUTER if is_above else -_OUTER
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (runs.x - runs.x[back]) / (own - place[runs.level[back]])[:, None]
    moved = runs.x + slope * (reach - own)[:, None]
    x = np.where(continues[:, None] & straight_back & np.isfinite(moved), moved, x)
    t = np.where(continues, reach, t)
    least = SMALLEST_MOTION * width
    inward = np.stack([x[:, 0] > runs.x[:, 0] + least, x[:, 1] < runs.x[:, 1] - least], axis=1)
    return _NeighbourEnds(x, t, inward, is_above)


def _split_at_ends(pieces: Pieces, runs: Runs, neighbours: tuple[_NeighbourEnds, ...]) -> tuple[Integers, Float64]:
    """Split the pieces of runs with a neighbouring end inside the run, at these ends; return piece and ends (n, 2)."""
    run = runs.piece_run
    touched = np.any([each.inward.any(axis=1) for each in neighbours], axis=0)
    piece = np.flatnonzero(touched[run])
    start, end = pieces.x[piece].T
    for each in neighbours:
        for side in (0, 1):
            cut = np.where(each.inward[run[piece], side], each.x[run[piece], side], np.nan)
            split = (cut > start) & (cut < end)
            piece = np.concatenate([piece, piece[split]])
            start, end = np.concatenate([start, cut[split]]), np.concatenate([np.where(split, cut, end), end[split]])
    return piece, np.stack([start, end], axis=1)


def _limit_between(neighbour: _NeighbourEnds, runs: Runs, run: Integers, place: Float64, ends: Float64) -> Float64:
    """Return the limit t(x) of `slanted_limits` at the ends (n, 2) of pieces of runs (n,); infinite without a limit."""
    own, middle = place[runs.level[run]][:, None], ends.mean(axis=1)
    nearest = np.minimum if neighbour.is_above else np.maximum
    limit = np.full(ends.shape, np.inf if neighbour.is_above else -np.inf)
    for side in (0, 1):
        far, near = neighbour.x[run, side], runs.x[run, side]
        beyond = neighbour.inward[run, side] & ((middle < far) if side == 0 else (middle > far))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip((ends - near[:, None]) / (far - near)[:, None], 0.0, 1.0)
        line = own + share * (neighbour.t[run][:, None] - own)
        limit = np.where(beyond[:, None], nearest(limit, line), limit)
    return limit
