"""Parts of lit segments: what a lens sees of them, and their division at the edges of a sensor's samples and bins."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.fans import FanIntervals
from gpuvision.simulation.illumination import LitLine
from gpuvision.simulation.scene import Scene
from gpuvision.simulation.sheet_cut import ranges
from gpuvision.simulation.sight import Sight
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Parts that a segment is seen in; of one that has more, its halves are looked at.
_KEPT, _HALVINGS = 8, 20
_FEWEST_FANS = 256
_BISECTIONS = 50


class Parts(NamedTuple):
    """Parts of lit segments.

    Attributes
    ----------
    segment
        (n,): of which segment.
    start, end
        (n,): from where to where, as shares of its length.
    seen
        (n,) bool: whether nothing is in the way to the lens.
    """

    segment: Integers
    start: Float64
    end: Float64
    seen: npt.NDArray[np.bool_]

    def those(self, which: npt.NDArray[Any]) -> Parts:
        """Return some of them."""
        return Parts(self.segment[which], self.start[which], self.end[which], self.seen[which])

    def ends(self, line: LitLine) -> Float64:
        """Return both ends, (n, 2, 3), metres."""
        at = np.stack([self.start, self.end], axis=1)
        return along(line.ends[self.segment][:, None], at)

    def at(self, line: LitLine, share: Float64) -> Float64:
        """Return places at shares of the parts' own lengths, (..., n) to (..., n, 3)."""
        return along(line.ends[self.segment], self.start + share * (self.end - self.start))


def along(ends: Float64, share: Float64) -> Float64:
    """Return places on segments (..., 2, 3) at shares of their lengths, exact at both ends."""
    start, end = ends[..., 0, :], ends[..., 1, :]
    near = (share < 0.5)[..., None]
    share = share[..., None]
    return np.asarray(np.where(near, start + share * (end - start), end - (1.0 - share) * (end - start)))


@dataclass(frozen=True, kw_only=True, eq=False)
class LineOfSight:
    """What a lens sees of segments; compared by identity.

    Parameters
    ----------
    scene
        What may be in the way.
    device
        Where that is found.
    """

    scene: Scene
    device: Device
    _bound: dict[int, Any] = field(init=False, repr=False, default_factory=dict)

    def parts(self, line: LitLine, lens: Float64, *, hidden: bool = False) -> Parts:
        """Return the parts of segments that a lens (3,) sees, and those it does not if ``hidden``."""
        count = len(line.power)
        todo = Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool))
        found = [todo.those(np.zeros(0, np.int64))]
        for _ in range(_HALVINGS):
            if not len(todo.segment):
                break
            shown, many = self._seen(line, todo, lens)
            found.append(shown)
            todo = _halves(todo.those(many))
        shown = together(found)
        return together([shown, _between(shown, count)]) if hidden else shown

    def _seen(self, line: LitLine, parts: Parts, lens: Float64) -> tuple[Parts, npt.NDArray[np.bool_]]:
        """Return the visible parts of parts, and which had too many of them."""
        count = len(parts.segment)
        bound = self._fans(count)
        fans = np.full(bound.inputs[0].shape, np.nan, bound.inputs[0].dtype)
        fans[:count, :3], fans[:count, 3:9], fans[:count, 9:] = lens, parts.ends(line).reshape(-1, 6), 0.0
        bound.inputs[0].set(fans)
        result = bound.run()
        shown = result.intervals.get()[:count].astype(np.float64)
        owner, which = np.nonzero(np.isfinite(shown[..., 0]))
        low, high = shown[owner, which].T
        start, size = parts.start[owner], (parts.end - parts.start)[owner]
        end = np.where(high == 1.0, parts.end[owner], start + high * size)
        visible = Parts(parts.segment[owner], start + low * size, end, np.ones(len(owner), bool))
        return visible, (result.status.get()[:count] & Status.AMBIGUOUS) != 0

    def _fans(self, count: int) -> Any:
        """Return a bound operation for that many fans or more."""
        size = max(_FEWEST_FANS, 1 << (count - 1).bit_length())
        if size not in self._bound:
            real = np.dtype(np.float64 if self.device.has_double else np.float32)
            self._bound[size] = FanIntervals(scene=self.scene, kept=_KEPT).bind(self.device, (size, 11), real)
        return self._bound[size]


def together(parts: list[Parts]) -> Parts:
    """Return all parts as one."""
    segment, start, end, seen = zip(*parts, strict=True)
    return Parts(np.concatenate(segment), np.concatenate(start), np.concatenate(end), np.concatenate(seen))


def _halves(parts: Parts) -> Parts:
    middle = 0.5 * (parts.start + parts.end)
    return together([parts._replace(end=middle), parts._replace(start=middle)])


def _between(shown: Parts, count: int) -> Parts:
    """Return what of whole segments is not among the parts."""
    each = np.arange(count)
    first, start = np.append(each, shown.segment), np.append(np.zeros(count), shown.end)
    last, end = np.append(shown.segment, each), np.append(shown.start, np.ones(count))
    one, two = np.lexsort((start, first)), np.lexsort((end, last))
    rest = Parts(first[one], start[one], end[two], np.zeros(len(one), bool))
    return rest.those(rest.start < rest.end)


def in_view(parts: Parts, line: LitLine, sight: Sight, L: float) -> Parts:
    """Cut parts down to what lies in front of the lens and this side of the sheet's horizon."""
    known = np.isfinite(sight.project(parts.ends(line), L)).all(axis=-1)
    if known.all():
        return parts
    parts, known = parts.those(known.any(axis=1)), known[known.any(axis=1)]
    start, end = parts.start.copy(), parts.end.copy()
    cut = np.flatnonzero(~known.all(axis=1))
    from_start = known[cut, 0]
    good, bad = np.where(from_start, start[cut], end[cut]), np.where(from_start, end[cut], start[cut])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (good + bad)
        fine = np.isfinite(sight.project(along(line.ends[parts.segment[cut]], middle), L)).all(axis=-1)
        good, bad = np.where(fine, middle, good), np.where(fine, bad, middle)
    start[cut], end[cut] = np.where(from_start, start[cut], good), np.where(from_start, good, end[cut])
    return parts._replace(start=start, end=end)


def split_at(parts: Parts, line: LitLine, sight: Sight, edges: Float64, axis: int, L: float) -> Parts:
    """Split parts where their images cross edges in u (axis 0) or v (axis 1); drop what lies beyond the outer ones."""
    place = sight.project(parts.ends(line), L)[..., axis]
    low, high = place.min(axis=1), place.max(axis=1)
    on = (high >= edges[0]) & (low <= edges[-1])
    parts, place, low, high = parts.those(on), place[on], low[on], high[on]
    first = np.searchsorted(edges, low, side="right")
    count = np.maximum(np.searchsorted(edges, high, side="left") - first, 0)
    if count.any():
        owner, edge = np.repeat(np.arange(len(count)), count), ranges(first, count)
        cuts = where_imaged(parts.those(owner), line, sight, edges[edge], axis, L)
        parts = _cut(parts, count, cuts, place[:, 1] < place[:, 0])
    middle = sight.project(parts.at(line, np.full(len(parts.start), 0.5)), L)[..., axis]
    return parts.those((middle >= edges[0]) & (middle <= edges[-1]) & (parts.start < parts.end))


def _cut(parts: Parts, count: Integers, cuts: Float64, reverse: npt.NDArray[np.bool_]) -> Parts:
    """Cut parts, each at some places; those of parts that are to be reversed lie in descending order."""
    before = np.cumsum(count) - count
    owner, number = np.repeat(np.arange(len(count)), count + 1), ranges(np.zeros_like(count), count + 1)
    last = count[owner]
    left = before[owner] + np.where(reverse[owner], last - number, number - 1)
    right = before[owner] + np.where(reverse[owner], last - 1 - number, number)
    most = len(cuts) - 1
    start = np.where(number == 0, parts.start[owner], cuts[np.clip(left, 0, most)])
    end = np.where(number == last, parts.end[owner], cuts[np.clip(right, 0, most)])
    return parts.those(owner)._replace(start=start, end=end)


def where_imaged(parts: Parts, line: LitLine, sight: Sight, value: Float64, axis: int, L: float) -> Float64:
    """Return where on its segment each part's image has a coordinate u (axis 0) or v (1), which it has within the part.

    Exact without distortion, where the image of a straight line is a ratio of straight lines; with it, two secants
    from there.
    """
    place = sight.project(parts.at(line, np.array([[0.0], [0.5], [1.0]])), L)[..., axis]
    one, two = place[1] - place[0], place[2] - place[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        lean = np.where(one * two > 0.0, one / two, 1.0)
        low, high = value - place[0], lean * (place[2] - value)
        share = np.where(low + high != 0.0, low / (low + high), 0.5)
    share = np.clip(share, 0.0, 1.0)
    if sight.triangulation.sensor_lens is not None:
        for step in (1e-3, 1e-5):
            beside = np.where(share < 0.5, share + step, share - step)
            here, there = sight.project(parts.at(line, np.stack([share, beside])), L)[..., axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                better = share + (value - here) * (beside - share) / (there - here)
            share = np.where(np.isfinite(better), np.clip(better, 0.0, 1.0), share)
    return np.asarray(parts.start + share * (parts.end - parts.start))
