"""Parts of lit segments: visibility from a lens, projection to the sensor, division at edges of samples and bins."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.distortion import Distortion
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.host.arrays import host_view
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LitLine
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Fans of rays in one launch: a fixed shape, so that one bound kernel and one copy of the tree serve any number.
_FANS_PER_LAUNCH = 1024
# Points nearer to a limit of the view than this fraction of the farther end's distance count as beyond it. Chosen: a
# million roundings of double; the lost part of a line is far below the resolution of a sensor.
_VIEW_MARGIN = 1e-9
# Points on each edge of the sensor, and the margin, for the circle around its undistorted image. Chosen: between two of
# the points an edge bends by far less than the margin.
_BORDER_POINTS, _BORDER_MARGIN = 33, 1.01
# Newton iterations that find an edge under lens distortion. Chosen: the error of the start value is squared each time.
_NEWTON_ITERATIONS = 3


@dataclass(frozen=True, kw_only=True)
class VisibilityLimits:
    """Limits of `LensVisibility`.

    Attributes
    ----------
    max_intervals : int
        Number of visible intervals of a segment that one run of the kernel returns. Chosen for speed: a segment with
        more intervals is halved. Default 8.
    max_halvings : int
        Largest number of times that a segment is halved; a part that still has too many intervals counts as hidden.
        Derived: 2^-20 is a millionth of the segment. Default 20.
    """

    max_intervals: int = 8
    max_halvings: int = 20


class Parts(NamedTuple):
    """Parts of lit segments.

    Attributes
    ----------
    segment
        int64 (n,): index of the segment.
    start, end
        float64 (n,): begin and end as fractions of the segment's length, 0 to 1.
    visible
        bool (n,): whether the lens sees the part.
    """

    segment: Integers
    start: Float64
    end: Float64
    visible: npt.NDArray[np.bool_]

    def select(self, which: npt.NDArray[Any]) -> Parts:
        """Return the parts of an index array or a mask."""
        return Parts(self.segment[which], self.start[which], self.end[which], self.visible[which])

    def ends(self, line: LitLine) -> Float64:
        """Return both ends of the parts, (n, 2, 3) [m]."""
        at = np.stack([self.start, self.end], axis=1)
        return points_on(line.ends[self.segment][:, None], at)


def points_on(ends: Float64, share: Float64) -> Float64:
    """Return the points at fractions of the lengths of segments (..., 2, 3), exact at both ends."""
    start, end = ends[..., 0, :], ends[..., 1, :]
    from_start = (share < 0.5)[..., None]
    share = share[..., None]
    return np.asarray(np.where(from_start, start + share * (end - start), end - (1.0 - share) * (end - start)))


def whole_parts(line: LitLine) -> Parts:
    """Return the whole segments of a line as parts."""
    count = len(line.power)
    return Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool))


@dataclass(frozen=True, kw_only=True, eq=False)
class LensVisibility:
    """Visibility of segments from the lens; compared by identity.

    Parameters
    ----------
    scene
        Triangles that may occlude.
    device
        Device of the `VisibleIntervals` kernel.
    limits
        Limits of the subdivision.

    Notes
    -----
    Ends of parts are accurate to 1e-10 of a segment (1e-5 on a device without double). Where more visible parts lie
    within a millionth of a segment than the kernel returns, they count as hidden.
    """

    scene: Scene
    device: Device
    limits: VisibilityLimits = VisibilityLimits()
    _bound: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        real = np.dtype(np.float64 if self.device.has_double else np.float32)
        fans = VisibleIntervals(scene=self.scene, max_intervals=self.limits.max_intervals)
        object.__setattr__(self, "_bound", fans.bind(self.device, (_FANS_PER_LAUNCH, 11), real))

    def visible_parts(self, line: LitLine, lens: Float64, *, with_hidden: bool = False) -> Parts:
        """Return the parts of segments that are visible from the lens, and on request the hidden parts.

        Parameters
        ----------
        line
            The segments (m).
        lens
            Position of the lens [m], (3,) for all segments or (m, 3).
        with_hidden
            Whether hidden parts are returned as well, with `Parts.visible` False. Default False.
        """
        count = len(line.power)
        lens = np.broadcast_to(lens, (count, 3))
        todo = whole_parts(line)
        found = [todo.select(np.zeros(0, np.int64))]
        for _ in range(self.limits.max_halvings):
            if not len(todo.segment):
                break
            shown, overflowed = self._visible_once(line, todo, lens)
            found.append(shown)
            todo = _bisect(todo.select(overflowed))
        shown = concatenate_parts(found)
        return concatenate_parts([shown, _hidden_parts(shown, count)]) if with_hidden else shown

    def _visible_once(self, line: LitLine, parts: Parts, lens: Float64) -> tuple[Parts, npt.NDArray[np.bool_]]:
        """Return the visible parts of parts, and a mask of the parts with too many visible intervals."""
        count = len(parts.segment)
        fans = np.zeros((count, 11))
        fans[:, :3], fans[:, 3:9] = lens[parts.segment], parts.ends(line).reshape(-1, 6)
        overflowed = np.zeros(count, bool)
        found = [parts.select(np.zeros(0, np.int64))]
        for first in range(0, count, _FANS_PER_LAUNCH):
            intervals, status = self._intervals(fans[first : first + _FANS_PER_LAUNCH])
            overflowed[first : first + _FANS_PER_LAUNCH] = (status & Status.AMBIGUOUS) != 0
            owner, which = np.nonzero(np.isfinite(intervals[..., 0]))
            low, high = intervals[owner, which].T.astype(np.float64)
            owner += first
            start, size = parts.start[owner], (parts.end - parts.start)[owner]
            end = np.where(high == 1.0, parts.end[owner], start + high * size)
            found.append(Parts(parts.segment[owner], start + low * size, end, np.ones(len(owner), bool)))
        return concatenate_parts(found), overflowed

    def _intervals(self, fans: Float64) -> tuple[npt.NDArray[Any], npt.NDArray[np.uint8]]:
        """Return the visible intervals and status flags of at most `_FANS_PER_LAUNCH` fans."""
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


def concatenate_parts(parts: list[Parts]) -> Parts:
    """Concatenate lists of parts."""
    segment, start, end, visible = zip(*parts, strict=True)
    return Parts(np.concatenate(segment), np.concatenate(start), np.concatenate(end), np.concatenate(visible))


def parts_within_radius(start: Float64, end: Float64, low: Float64, high: Float64) -> Parts:
    """Return the parts of segments on which a vector is shorter than a radius; both vary linearly along a segment.

    Parameters
    ----------
    start, end
        (m, k): the vector at both ends.
    low, high
        (m,): the radius at both ends.
    """
    # |start + t way|^2 = (low + t growth)^2 is quadratic in t.
    direction, radius_change = end - start, high - low
    square = np.sum(direction * direction, axis=1) - radius_change**2
    half = np.sum(start * direction, axis=1) - low * radius_change
    rest = np.sum(start * start, axis=1) - low**2
    with np.errstate(divide="ignore", invalid="ignore"):
        # The stable form of the quadratic formula; without a root the knots are arbitrary and the test below decides.
        both = -(half + np.copysign(np.sqrt(half * half - square * rest), half))
        places = np.nan_to_num(np.stack([both / square, rest / both]), nan=0.0)
    knots = np.pad(np.sort(np.clip(places, 0.0, 1.0), axis=0), ((1, 1), (0, 0)))
    knots[-1] = 1.0
    each, found = np.arange(len(low)), []
    for first, last in itertools.pairwise(knots):
        middle = 0.5 * (first + last)
        length = np.linalg.norm(start + middle[:, None] * direction, axis=1)
        inside = (length < low + middle * radius_change) & (first < last)
        found.append(Parts(each, first, last, np.ones(len(each), bool)).select(inside))
    return concatenate_parts(found)


def _bisect(parts: Parts) -> Parts:
    middle = 0.5 * (parts.start + parts.end)
    return concatenate_parts([parts._replace(end=middle), parts._replace(start=middle)])


def _hidden_parts(shown: Parts, count: int) -> Parts:
    """Return the parts of whole segments that are not among the visible parts."""
    each = np.arange(count)
    first, start = np.append(each, shown.segment), np.append(np.zeros(count), shown.end)
    last, end = np.append(shown.segment, each), np.append(shown.start, np.ones(count))
    one, two = np.lexsort((start, first)), np.lexsort((end, last))
    rest = Parts(first[one], start[one], end[two], np.zeros(len(one), bool))
    return rest.select(rest.start < rest.end)


class LineProjector:
    """Projection of points on straight segments to a sensor.

    Without distortion (u, v) is a ratio of two functions that are linear along a segment, so the point where the image
    of a segment crosses an edge has a closed form.

    Parameters
    ----------
    view
        The sensor.
    """

    def __init__(self, view: SensorView) -> None:
        move = view.transport
        axes = np.array([move.g_axis, move.h_axis])
        normal, to_sheet = np.cross(*axes), np.array(move.origin) - np.array(view.lens)
        distance = float(to_sheet @ normal)
        # Maps a ray to homogeneous (G, H, 1) of the sheet, and that to homogeneous (u, v, 1) of the sensor.
        in_sheet = (distance * np.eye(3) - np.outer(normal, to_sheet)) @ np.linalg.pinv(axes)
        homography = np.array(view.triangulation.homography)
        middle = np.append(np.mean(np.array(view.triangulation.region), axis=1), 1.0)
        in_front = np.sign(distance) * np.sign(homography[2] @ middle)
        lifting = in_front * np.column_stack([in_sheet, normal]) @ np.linalg.inv(homography).T
        self._view, self._lens = view, view.triangulation.distortion
        self._circle = _image_circle(view)
        self._lifting = lifting
        # Linear functions of a ray that are positive where the point is in front of the lens, on the sheet's side, and
        # on the near side of the sheet's horizon.
        self._limits = np.column_stack([np.array(view.axis), np.sign(distance) * normal, lifting[:, 2]])

    def project(self, ends: Float64, L: float) -> ProjectedLines:
        """Return the projections of segments (m, 2, 3) [m] at a transport L [m]."""
        rays = ends - self._view.lens_at(L)
        lifted = rays @ self._lifting
        return ProjectedLines(
            self._lens, self._circle, self._lifting, rays @ self._limits, lifted[:, 0], lifted[:, 1] - lifted[:, 0]
        )


def _image_circle(view: SensorView) -> tuple[Float64, float] | None:
    """Return centre (2,) and radius of a circle of ideal positions (u, v) that have an image; None: all have one.

    Of a lens: within the fold. Of a camera or a polynomial, whose fold is no circle: around the image of the sensor,
    with a margin of 1 % of its radius.
    """
    lens = view.triangulation.distortion
    if lens is None:
        return None
    if isinstance(lens, Lens):
        if math.isinf(lens.fold_radius):
            return None
        return np.array(lens.centre), (1.0 - _VIEW_MARGIN) * lens.undistorted_radius(lens.fold_radius)
    u, v = (np.linspace(edges[0], edges[-1], _BORDER_POINTS) for edges in (view.u_edges, view.v_edges))
    ideal = lens.undistort(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 2)
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    if not len(ideal):
        raise ValueError("SensorView.triangulation: no position of the sensor has an undistorted one")
    centre = 0.5 * (ideal.min(axis=0) + ideal.max(axis=0))
    return centre, _BORDER_MARGIN * float(np.linalg.norm(ideal - centre, axis=1).max())


@dataclass(frozen=True, eq=False)
class ProjectedLines:
    """Projections of segments to a sensor; made by `LineProjector`.

    Attributes
    ----------
    lens
        Distortion of the sensor; None: none.
    circle
        Centre and radius of the ideal positions (u, v) that have an image; None: all.
    lifting
        float64 (3, 3): maps metres to homogeneous (u, v, 1).
    limits
        float64 (m, 2, 3): values of the view's limits at both ends; a point is in view where all are positive.
    start, way
        float64 (m, 3): homogeneous (u, v, 1) of the start of a segment, and the difference from there to its end.
    """

    lens: Distortion | None
    circle: tuple[Float64, float] | None
    lifting: Float64
    limits: Float64
    start: Float64
    way: Float64

    def image_points(self, segment: Integers, share: Float64) -> Float64:
        """Return (u, v) of the points at fractions of segments, (..., 2); NaN beyond the fold of the distortion."""
        lifted = self.start[segment] + share[..., None] * self.way[segment]
        straight = np.asarray(lifted[..., :2] / lifted[..., 2:])
        return straight if self.lens is None else self.lens.distort(straight)

    def u_rates(self, segment: Integers, share: Float64, uv: Float64, moved: Float64) -> Float64:
        """Return the derivative of u along vectors ``moved`` (n, 3) [m] at points that are imaged at ``uv``, (n,)."""
        lifted = self.start[segment] + share[:, None] * self.way[segment]
        straight, per = lifted[:, :2] / lifted[:, 2:], 1.0 / lifted[:, 2]
        change = moved @ self.lifting
        u, v = ((change[:, :2] - straight * change[:, 2:]) * per[:, None]).T
        if self.lens is None:
            return np.asarray(u)
        (a, b), (c, d) = np.moveaxis(self.lens.jacobian(uv), 0, -1)
        return np.asarray((d * u - b * v) / (a * d - b * c))

    def clip_to_view(self, parts: Parts) -> Parts:
        """Clip parts to the points in front of the lens, on the near side of the horizon and within the fold."""
        for start, end in np.moveaxis(self.limits, -1, 0).transpose(0, 2, 1):
            if min(start.min(initial=1.0), end.min(initial=1.0)) > 0.0:
                continue
            least = _VIEW_MARGIN * np.maximum(np.abs(start), np.abs(end))
            share = np.divide(least - start, end - start, out=np.zeros_like(start), where=start != end)
            low = np.where(start > least, 0.0, np.where(end > least, share, 1.0))[parts.segment]
            high = np.where(end > least, 1.0, np.where(start > least, share, 0.0))[parts.segment]
            parts = parts._replace(start=np.maximum(parts.start, low), end=np.minimum(parts.end, high))
        parts = parts.select(parts.start < parts.end)
        return parts if self.circle is None else self._clip_to_circle(parts, *self.circle)

    def _clip_to_circle(self, parts: Parts, centre: Float64, radius: float) -> Parts:
        start, direction = self.start[parts.segment], self.way[parts.segment]
        ends = [start + share[:, None] * direction for share in (parts.start, parts.end)]
        vectors = [each[:, :2] - each[:, 2:] * centre for each in ends]
        found = parts_within_radius(*vectors, *(radius * each[:, 2] for each in ends))
        size, begin = parts.end - parts.start, parts.start
        parts = parts.select(found.segment)
        size, begin = size[found.segment], begin[found.segment]
        end = np.where(found.end == 1.0, parts.end, begin + found.end * size)
        return parts._replace(start=begin + found.start * size, end=end)

    def split_at_edges(self, parts: Parts, edges: Float64, axis: int) -> Parts:
        """Split parts where they cross edges in u (axis 0) or v (axis 1); drop the parts beyond the outer edges."""
        first, last = self.image_points(parts.segment, np.stack([parts.start, parts.end]))[..., axis]
        low, high = np.minimum(first, last), np.maximum(first, last)
        begin = np.searchsorted(edges, low, side="right")
        count = np.maximum(np.searchsorted(edges, high, side="left") - begin, 0)
        if count.any():
            owner, edge = np.repeat(np.arange(len(count)), count), concatenated_ranges(begin, count)
            cuts = self.fractions_at(parts.select(owner), edges[edge], axis)
            parts = _split_parts(parts, count, cuts, last < first)
        middle = self.image_points(parts.segment, 0.5 * (parts.start + parts.end))[:, axis]
        return parts.select((middle >= edges[0]) & (middle <= edges[-1]) & (parts.start < parts.end))

    def fractions_at(self, parts: Parts, value: Float64, axis: int) -> Float64:
        """Return the fraction of each segment at which u (axis 0) or v (axis 1) has a value.

        The value must occur within the part. With distortion Newton's method starts from the solution with the other
        coordinate of the part's middle.
        """
        straight = value
        if self.lens is not None:
            middle = self.image_points(parts.segment, 0.5 * (parts.start + parts.end))
            middle[:, axis] = value
            straight = self.lens.undistort(middle)[:, axis]
        start, direction = self.start[parts.segment], self.way[parts.segment]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = (straight * start[:, 2] - start[:, axis]) / (direction[:, axis] - straight * direction[:, 2])
        found = self._clamp(parts, found)
        for _ in range(0 if self.lens is None else _NEWTON_ITERATIONS):
            step = np.where(2.0 * found < parts.start + parts.end, 1e-4, -1e-4) * (parts.end - parts.start)
            image, moved_image = self.image_points(parts.segment, np.stack([found, found + step]))[..., axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                found = self._clamp(parts, found + (value - image) * step / (moved_image - image))
        return found

    def _clamp(self, parts: Parts, share: Float64) -> Float64:
        middle = 0.5 * (parts.start + parts.end)
        return np.clip(np.where(np.isfinite(share), share, middle), parts.start, parts.end)


def _split_parts(parts: Parts, count: Integers, cuts: Float64, reverse: npt.NDArray[np.bool_]) -> Parts:
    """Split parts at given fractions, sorted ascending; descending for parts in ``reverse``."""
    before = np.cumsum(count) - count
    owner, number = np.repeat(np.arange(len(count)), count + 1), concatenated_ranges(np.zeros_like(count), count + 1)
    last = count[owner]
    left = before[owner] + np.where(reverse[owner], last - number, number - 1)
    right = before[owner] + np.where(reverse[owner], last - 1 - number, number)
    max_parts = len(cuts) - 1
    start = np.where(number == 0, parts.start[owner], cuts[np.clip(left, 0, max_parts)])
    end = np.where(number == last, parts.end[owner], cuts[np.clip(right, 0, max_parts)])
    return parts.select(owner)._replace(start=start, end=end)
