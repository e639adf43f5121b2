"""Straight edges of a board's copper, cut to the parts that a camera can see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host.reading import FileLimit
from gpuvision.matching.artwork.shapes import SAGITTA, Crossings, DrawnObject, Float64, Layer, is_covered

MAX_BOARD_COMPARISONS = FileLimit("GPUVISION_MAX_BOARD_COMPARISONS", 50_000_000)
"""Comparisons of lines with sides of shapes, to find the visible edges of a board. Chosen: 50 million, which take
5 s; the largest board of the tests takes 25 million. Objects that cover each other reach it."""
# Lines are equal where their angle [rad], distance from the origin and width [m] round to the same multiple of this
# number. It is not a decimal fraction, so that the lengths in files never lie between two multiples.
_QUANTUM = math.pi * 1e-8
_CLOSE = 2 * SAGITTA  # distance from an edge of the lines on which the copper is checked [m]
_MIN_LENGTH = 100e-6  # least length of an edge [m]: a ruler of five lines at 20 um


class BoardEdges(NamedTuple):
    """Straight edges between copper and laminate.

    Attributes
    ----------
    start, end : (n, 2)
        Ends of the visible part [m]: it keeps the clearance from silk, from other copper and from mask openings.
    normal : (n, 2)
        Unit normal, out of the copper.
    width : (n,)
        Width of the copper there, to its other edge [m].
    bare : (n,), bool
        True where the mask is open on both sides, False where both sides are under the mask. Under the mask an edge has
        another contrast, and the offset of the mask does not affect it. Where the mask ends, the edge is cut.
    trace : (n,)
        Index of the trace, equal for its two edges; -1 for a side of a pad.
    pad : (n,)
        Index of the pad; -1 for an edge of a trace.
    """

    start: Float64
    end: Float64
    normal: Float64
    width: Float64
    bare: npt.NDArray[np.bool_]
    trace: npt.NDArray[np.int64]
    pad: npt.NDArray[np.int64]

    @property
    def length(self) -> Float64:
        """(n,) lengths [m]."""
        return np.asarray(np.hypot(*(self.end - self.start).T))


class _Candidate(NamedTuple):
    start: Float64
    end: Float64
    normal: Float64
    width: float
    trace: int
    pad: int


def board_edges(
    strokes: Sequence[DrawnObject],
    outlines: Sequence[Float64],
    copper: Layer,
    mask: Layer | None,
    silk: Layer,
    clearance: float,
) -> BoardEdges:
    """Return the edges of strokes with a round aperture and of the straight sides of pads.

    Parameters
    ----------
    strokes
        Strokes of the copper; collinear strokes of equal width are one trace.
    outlines
        Outlines of the pads, counter-clockwise [m].
    copper, mask, silk
        Layers that may hide an edge; without a mask everything is bare.
    clearance
        Free distance on both sides of an edge and at its ends [m].

    Raises
    ------
    ValueError
        The edges take more comparisons than `MAX_BOARD_COMPARISONS`.
    """
    rows = []
    for each in [*_trace_sides(strokes), *_pad_sides(outlines)]:
        for low, high, bare in _visible_parts(each, copper, mask, silk, clearance):
            along = each.end - each.start
            rows.append((each.start + low * along, each.start + high * along, each.normal, each.width, bare, *each[4:]))
    columns: list[Any] = list(zip(*rows, strict=True)) if rows else [[]] * 7
    return BoardEdges(
        np.array(columns[0], dtype=np.float64).reshape(-1, 2),
        np.array(columns[1], dtype=np.float64).reshape(-1, 2),
        np.array(columns[2], dtype=np.float64).reshape(-1, 2),
        np.array(columns[3], dtype=np.float64),
        np.array(columns[4], dtype=np.bool_),
        np.array(columns[5], dtype=np.int64),
        np.array(columns[6], dtype=np.int64),
    )


def _trace_sides(strokes: Sequence[DrawnObject]) -> Iterator[_Candidate]:
    for index, (start, end, width) in enumerate(_joined(strokes)):
        x, y = (end - start) / math.dist(start, end)
        for normal in (np.array([-y, x]), np.array([y, -x])):
            shift = normal * (width / 2)
            yield _Candidate(start + shift, end + shift, normal, width, index, -1)


def _joined(strokes: Sequence[DrawnObject]) -> list[tuple[Float64, Float64, float]]:
    """Return straight strokes as (start, end, width) [m], collinear ones that touch joined."""
    lines: dict[tuple[int, int, int], list[tuple[float, float, DrawnObject]]] = {}
    for each in strokes:
        if each.ends is None or not each.width > 0 or not each.shapes[0].dark:
            continue
        axis = _axis(each.ends)
        offset = float(axis[0] * each.ends[0, 1] - axis[1] * each.ends[0, 0])
        key = tuple(round(value / _QUANTUM) for value in (math.atan2(axis[1], axis[0]), offset, each.width))
        low, high = sorted(float(value) for value in each.ends @ axis)
        lines.setdefault((key[0], key[1], key[2]), []).append((low, high, each))
    return [trace for pieces in lines.values() for trace in _united(sorted(pieces, key=lambda piece: piece[:2]))]


def _axis(ends: Float64) -> Float64:
    """Return the unit vector along a line, the same for both of its directions."""
    along = ends[1] - ends[0]
    backwards = along[0] < 0 or (along[0] == 0 and along[1] < 0)
    return np.asarray((-along if backwards else along) / math.hypot(*along))


def _united(pieces: list[tuple[float, float, DrawnObject]]) -> Iterator[tuple[Float64, Float64, float]]:
    first = pieces[0][2]
    assert first.ends is not None
    axis = _axis(first.ends)
    origin = first.ends[0] - axis * float(first.ends[0] @ axis)
    low, high = pieces[0][:2]
    for start, end, _ in [*pieces[1:], (math.inf, math.inf, first)]:
        if start <= high + _QUANTUM:
            high = max(high, end)
            continue
        yield origin + low * axis, origin + high * axis, first.width
        low, high = start, end


def _pad_sides(outlines: Sequence[Float64]) -> Iterator[_Candidate]:
    for index, outline in enumerate(outlines):
        for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            length = math.dist(start, end)
            if length < _MIN_LENGTH:
                continue
            normal = np.array([end[1] - start[1], start[0] - end[0]]) / length
            width = float(np.max((start - outline) @ normal))
            yield _Candidate(start, end, normal, width, -1, index)


def _visible_parts(
    edge: _Candidate, copper: Layer, mask: Layer | None, silk: Layer, clearance: float
) -> list[tuple[float, float, bool]]:
    """Return the visible parts of an edge, from 0 at its start to 1 at its end, and whether they are bare.

    Copper is checked along lines close to the edge and at the clearance, on both sides; ink and mask openings along the
    edge and at the clearance. Objects wholly between two of these lines are not noticed. Each part is then shortened by
    the clearance at both ends.
    """

    def along(layer: Layer, *offsets: float) -> list[Crossings]:
        shifts = [offset * edge.normal for offset in offsets]
        found = []
        for shift in shifts:
            found.append(layer.crossings(edge.start + shift, edge.end + shift))
            check()
        return found

    def check(places: int = 0) -> None:
        comparisons = places + sum(each.comparisons for each in (copper, mask, silk) if each is not None)
        what = f"do its objects cover each other? Their visible edges take {comparisons} comparisons or more"
        MAX_BOARD_COMPARISONS.check(comparisons, what, ValueError)

    inside, outside = along(copper, -clearance, -_CLOSE), along(copper, _CLOSE, clearance)
    inks = along(silk, -clearance, 0.0, clearance)
    openings = [] if mask is None else along(mask, -clearance, 0.0, clearance)
    crossings = [where for found in (*inside, *outside, *inks, *openings) for _, where in found]
    cuts = np.unique(np.concatenate([np.array([0.0, 1.0]), *crossings]))
    cuts = cuts[(cuts >= 0) & (cuts <= 1)]
    middle = (cuts[1:] + cuts[:-1]) / 2
    check(len(crossings) * len(middle))
    hidden = np.logical_or.reduce([is_covered(each, middle) for each in (*outside, *inks)])
    good = np.logical_and.reduce([is_covered(each, middle) for each in inside]) & ~hidden
    bare = np.ones(len(middle), dtype=np.int64)
    if mask is not None:
        bare = np.sum([is_covered(each, middle) for each in openings], axis=0)
        good &= (bare == 0) | (bare == len(openings))
    return list(_pieces(cuts, good, bare > 0, clearance, math.dist(edge.start, edge.end)))


def _pieces(
    cuts: Float64, good: npt.NDArray[np.bool_], bare: npt.NDArray[np.bool_], clearance: float, length: float
) -> Iterator[tuple[float, float, bool]]:
    """Yield the joined neighbouring good intervals of one kind, shortened at both ends."""
    state = np.where(good, 1 + bare.astype(np.int64), 0)
    starts = np.flatnonzero(np.diff(state, prepend=-1))
    stops = np.append(starts[1:], len(state))
    margin = clearance / length
    for start, stop in zip(starts, stops, strict=True):
        low, high = float(cuts[start]) + margin, float(cuts[stop]) - margin
        if state[start] and (high - low) * length >= _MIN_LENGTH:
            yield low, high, bool(state[start] == 2)
