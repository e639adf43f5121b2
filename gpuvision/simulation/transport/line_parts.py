"""Parts of lit segments: what a lens sees of them, and their division at the edges of a sensor's samples and bins."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.host.arrays import host_view
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LitLine
from gpuvision.simulation.transport.sheet_cut import ranges
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Parts that a segment is seen in; of one that has more, its halves are looked at.
_KEPT, _HALVINGS = 8, 20
# Fans in one go: one kernel, and one copy of the tree on the device, whatever the number of segments.
_FANS = 1024
# What lies this near to a limit of the view, in shares of the farther end's distance, is beyond it.
_LEAST = 1e-9
# Newton's, for distortion.
_STEPS = 3


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

    Notes
    -----
    Ends of parts are good to 1e-10 of a segment (1e-5 on a device without double). Where more parts lie within a
    millionth of a segment than the kernel keeps, they are taken as hidden.
    """

    scene: Scene
    device: Device
    _bound: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        real = np.dtype(np.float64 if self.device.has_double else np.float32)
        fans = VisibleIntervals(scene=self.scene, max_intervals=_KEPT)
        object.__setattr__(self, "_bound", fans.bind(self.device, (_FANS, 11), real))

    def parts(self, line: LitLine, lens: Float64, *, hidden: bool = False) -> Parts:
        """Return the parts of segments that a lens sees, and those it does not if ``hidden``.

        The lens is one for all, (3,), or each segment has its own, (m, 3).
        """
        count = len(line.power)
        lens = np.broadcast_to(lens, (count, 3))
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
        fans = np.zeros((count, 11))
        fans[:, :3], fans[:, 3:9] = lens[parts.segment], parts.ends(line).reshape(-1, 6)
        many = np.zeros(count, bool)
        found = [parts.those(np.zeros(0, np.int64))]
        for first in range(0, count, _FANS):
            intervals, status = self._intervals(fans[first : first + _FANS])
            many[first : first + _FANS] = (status & Status.AMBIGUOUS) != 0
            owner, which = np.nonzero(np.isfinite(intervals[..., 0]))
            low, high = intervals[owner, which].T.astype(np.float64)
            owner += first
            start, size = parts.start[owner], (parts.end - parts.start)[owner]
            end = np.where(high == 1.0, parts.end[owner], start + high * size)
            found.append(Parts(parts.segment[owner], start + low * size, end, np.ones(len(owner), bool)))
        return together(found), many

    def _intervals(self, fans: Float64) -> tuple[npt.NDArray[Any], npt.NDArray[np.uint8]]:
        """Return visible intervals of up to so many fans, and status flags."""
        count, bound = len(fans), self._bound
        given = np.full(bound.inputs[0].shape, np.nan, bound.inputs[0].dtype)
        given[:count] = fans
        if self.device.shares_memory:
            host_view(bound.inputs[0])[:] = given
            result = bound.run()
            return host_view(result.intervals)[:count].copy(), host_view(result.status)[:count].copy()
        bound.inputs[0].set(given)
        result = bound.run()
        return result.intervals.get()[:count], result.status.get()[:count]


def together(parts: list[Parts]) -> Parts:
    """Return all parts as one."""
    segment, start, end, seen = zip(*parts, strict=True)
    return Parts(np.concatenate(segment), np.concatenate(start), np.concatenate(end), np.concatenate(seen))


def within_reach(start: Float64, end: Float64, low: Float64, high: Float64) -> Parts:
    """Return the parts of segments on which a vector is shorter than its reach; both change evenly along a segment.

    The vector goes from ``start`` to ``end``, (m, k), the reach from ``low`` to ``high``, (m,).
    """
    # |start + t way|^2 = (low + t growth)^2 is quadratic in t.
    way, growth = end - start, high - low
    square = np.sum(way * way, axis=1) - growth**2
    half = np.sum(start * way, axis=1) - low * growth
    rest = np.sum(start * start, axis=1) - low**2
    with np.errstate(divide="ignore", invalid="ignore"):
        # Without cancellation; where there is no root, anywhere.
        both = -(half + np.copysign(np.sqrt(half * half - square * rest), half))
        places = np.nan_to_num(np.stack([both / square, rest / both]), nan=0.0)
    knots = np.pad(np.sort(np.clip(places, 0.0, 1.0), axis=0), ((1, 1), (0, 0)))
    knots[-1] = 1.0
    each, found = np.arange(len(low)), []
    for first, last in itertools.pairwise(knots):
        middle = 0.5 * (first + last)
        length = np.linalg.norm(start + middle[:, None] * way, axis=1)
        inside = (length < low + middle * growth) & (first < last)
        found.append(Parts(each, first, last, np.ones(len(each), bool)).those(inside))
    return together(found)


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


class Images:
    """Where a sensor images places on straight segments.

    Without distortion (u, v) is a ratio of two functions that are straight along a segment, so that it is known where
    the image of a segment crosses an edge.

    Parameters
    ----------
    view
        The sensor.
    """

    def __init__(self, view: SensorView) -> None:
        move = view.transport
        axes = np.array([move.g_axis, move.h_axis])
        normal, to_sheet = np.cross(*axes), np.array(move.origin) - np.array(view.lens)
        off = float(to_sheet @ normal)
        # From a ray to the sheet's (G, H, 1), and on to the sensor's (u, v, 1), but for factors.
        in_sheet = (off * np.eye(3) - np.outer(normal, to_sheet)) @ np.linalg.pinv(axes)
        homography = np.array(view.triangulation.homography)
        middle = np.append(np.mean(np.array(view.triangulation.region), axis=1), 1.0)
        in_front = np.sign(off) * np.sign(homography[2] @ middle)
        lifting = in_front * np.column_stack([in_sheet, normal]) @ np.linalg.inv(homography).T
        self._view, self._lens = view, view.triangulation.sensor_lens
        self._lifting = lifting
        # In front of the lens, towards the sheet, this side of its horizon: all are positive.
        self._limits = np.column_stack([np.array(view.axis), np.sign(off) * normal, lifting[:, 2]])

    def of(self, ends: Float64, L: float) -> LineImages:
        """Return the images of segments (m, 2, 3) at a transport [m]."""
        rays = ends - self._view.lens_at(L)
        lifted = rays @ self._lifting
        return LineImages(self._lens, self._lifting, rays @ self._limits, lifted[:, 0], lifted[:, 1] - lifted[:, 0])


@dataclass(frozen=True, eq=False)
class LineImages:
    """Images of lit segments; `Images` makes them.

    Attributes
    ----------
    lens
        The sensor's distortion.
    lifting
        (3, 3): from metres to (u, v, 1) but for a factor.
    limits
        (m, 2, 3): of both ends of the segments; what is imaged has positive ones.
    start, way
        (m, 3): the lifted start of a segment, and from there to its end.
    """

    lens: Lens | None
    lifting: Float64
    limits: Float64
    start: Float64
    way: Float64

    def at(self, segment: Integers, share: Float64) -> Float64:
        """Return (u, v) of places on segments, (..., 2); NaN where the distortion folds."""
        lifted = self.start[segment] + share[..., None] * self.way[segment]
        straight = np.asarray(lifted[..., :2] / lifted[..., 2:])
        return straight if self.lens is None else self.lens.distort(straight)

    def speed(self, segment: Integers, share: Float64, uv: Float64, moved: Float64) -> Float64:
        """Return how fast u of places imaged at (u, v) changes as they move, in metres, (n, 3)."""
        lifted = self.start[segment] + share[:, None] * self.way[segment]
        straight, per = lifted[:, :2] / lifted[:, 2:], 1.0 / lifted[:, 2]
        change = moved @ self.lifting
        u, v = ((change[:, :2] - straight * change[:, 2:]) * per[:, None]).T
        if self.lens is None:
            return np.asarray(u)
        (a, b), (c, d) = np.moveaxis(self.lens.jacobian(uv), 0, -1)
        return np.asarray((d * u - b * v) / (a * d - b * c))

    def in_view(self, parts: Parts) -> Parts:
        """Cut parts down to what lies in front of the lens, this side of the horizon, and before the lens' fold."""
        for start, end in np.moveaxis(self.limits, -1, 0).transpose(0, 2, 1):
            if min(start.min(initial=1.0), end.min(initial=1.0)) > 0.0:
                continue
            least = _LEAST * np.maximum(np.abs(start), np.abs(end))
            share = np.divide(least - start, end - start, out=np.zeros_like(start), where=start != end)
            low = np.where(start > least, 0.0, np.where(end > least, share, 1.0))[parts.segment]
            high = np.where(end > least, 1.0, np.where(start > least, share, 0.0))[parts.segment]
            parts = parts._replace(start=np.maximum(parts.start, low), end=np.minimum(parts.end, high))
        parts = parts.those(parts.start < parts.end)
        return (
            parts if self.lens is None or math.isinf(self.lens.fold_radius) else self._before_the_fold(parts, self.lens)
        )

    def _before_the_fold(self, parts: Parts, lens: Lens) -> Parts:
        fold = lens.fold_radius
        radius = (1.0 - _LEAST) * fold * (1.0 + fold**2 * (lens.k1 + lens.k2 * fold**2))
        start, way = self.start[parts.segment], self.way[parts.segment]
        ends = [start + share[:, None] * way for share in (parts.start, parts.end)]
        vectors = [each[:, :2] - each[:, 2:] * np.array(lens.centre) for each in ends]
        found = within_reach(*vectors, *(radius * each[:, 2] for each in ends))
        size, begin = parts.end - parts.start, parts.start
        parts = parts.those(found.segment)
        size, begin = size[found.segment], begin[found.segment]
        end = np.where(found.end == 1.0, parts.end, begin + found.end * size)
        return parts._replace(start=begin + found.start * size, end=end)

    def split(self, parts: Parts, edges: Float64, axis: int) -> Parts:
        """Split parts where they cross edges in u (axis 0) or v (axis 1); drop what lies beyond the outer ones."""
        first, last = self.at(parts.segment, np.stack([parts.start, parts.end]))[..., axis]
        low, high = np.minimum(first, last), np.maximum(first, last)
        begin = np.searchsorted(edges, low, side="right")
        count = np.maximum(np.searchsorted(edges, high, side="left") - begin, 0)
        if count.any():
            owner, edge = np.repeat(np.arange(len(count)), count), ranges(begin, count)
            cuts = self.where(parts.those(owner), edges[edge], axis)
            parts = _cut(parts, count, cuts, last < first)
        middle = self.at(parts.segment, 0.5 * (parts.start + parts.end))[:, axis]
        return parts.those((middle >= edges[0]) & (middle <= edges[-1]) & (parts.start < parts.end))

    def where(self, parts: Parts, value: Float64, axis: int) -> Float64:
        """Return where on its segment each part has a coordinate u (axis 0) or v (1), which it has within the part.

        With distortion, Newton's steps from where it would be if the other coordinate were that of the part's middle.
        """
        straight = value
        if self.lens is not None:
            middle = self.at(parts.segment, 0.5 * (parts.start + parts.end))
            middle[:, axis] = value
            straight = self.lens.undistort(middle)[:, axis]
        start, way = self.start[parts.segment], self.way[parts.segment]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = (straight * start[:, 2] - start[:, axis]) / (way[:, axis] - straight * way[:, 2])
        found = self._within(parts, found)
        for _ in range(0 if self.lens is None else _STEPS):
            step = np.where(2.0 * found < parts.start + parts.end, 1e-4, -1e-4) * (parts.end - parts.start)
            here, there = self.at(parts.segment, np.stack([found, found + step]))[..., axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                found = self._within(parts, found + (value - here) * step / (there - here))
        return found

    def _within(self, parts: Parts, share: Float64) -> Float64:
        middle = 0.5 * (parts.start + parts.end)
        return np.clip(np.where(np.isfinite(share), share, middle), parts.start, parts.end)


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
