"""Evidence that a robot sees its field: more points on lines than by chance, and the expected lines in view.

`log_nfa` rates the number of points on lines at a pose, however that pose was found: the number of false alarms of an
a-contrario test [1]_. `expected_crossings` predicts where scan lines cross the field's lines, so that missing lines
count against a pose.

References
----------
.. [1] A. Desolneux, L. Moisan and J.-M. Morel, "Meaningful alignments", International Journal of Computer Vision 40,
   2000.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.field.distance_map import ANGLE_ROUNDING, Field

Float64 = npt.NDArray[np.float64]

# Distances, relative to the scale of the map, at which points count as on a line: octaves (each is one more test).
_DISTANCE_RATIOS = (0.06, 0.12, 0.25, 0.5, 1.0)
_MIN_SINE = 0.5  # of the angle at which a scan line must cross a line to find it surely: 30 degrees (chosen)
_MIN_CROSSING_SINE = 0.02  # of the angle at which a scan line must cross a line to count: 1.1 degrees (chosen)
_MIN_LINE_CROSSINGS = 6  # of a line of which the share seen counts (chosen: 30 % clutter hides 6 of 6 once in 1400)
_MIN_GAP = 3.0  # line widths between crossings that are expected separately (chosen)


class Crossings(NamedTuple):
    """Crossings of scan lines with the lines of a field.

    Attributes
    ----------
    places : (crossings, 2)
        Positions in the robot's frame [m].
    sines : (crossings,)
        Sines of the crossing angles.
    lines : (crossings,)
        Indices of the lines, and after them of the arcs, that are crossed.
    """

    places: Float64
    sines: Float64
    lines: npt.NDArray[np.intp]


class Evidence(NamedTuple):
    """Evidence for a pose.

    Attributes
    ----------
    log_nfa : float
        Natural logarithm of the number of false alarms, see `log_nfa`: the pose is no better than chance where it is
        above 0.
    on_lines : float
        Share of the points within half a line width of a line, 0 to 1.
    expected : int
        Number of crossings of scan lines with lines that should have been seen; 0 where the scan lines are unknown.
    seen : float
        Share of them that was seen, corrected for chance hits of equally dense points; NaN without expected crossings.
    least_seen : float
        The same share of the line that is seen least, of lines with 6 expected crossings or more; NaN without such
        lines. Clutter and gaps thin out all lines alike; a wrong field has lines that are not there at all.
    """

    log_nfa: float
    on_lines: float
    expected: int
    seen: float
    least_seen: float

    @property
    def missing(self) -> float:
        """Share of missing expected crossings, over the share of points on lines; 0 or less if all are found."""
        return (1.0 - self.seen) / max(self.on_lines, 1e-3) if self.expected else 0.0


def evidence(
    points: npt.ArrayLike,
    paths: npt.ArrayLike | None,
    field: Field,
    pose: npt.ArrayLike,
    *,
    half_line_width: float,
    scale: float,
    max_range: float,
    margin: float | None,
) -> Evidence:
    """Compute the evidence for a pose.

    Parameters
    ----------
    points
        (points, 2) in the robot's frame [m].
    paths
        (paths, 4) both ends of the scan lines that found them [m]; None: unknown.
    field, pose
        Field, and pose on it: x, y [m] and heading [rad].
    half_line_width
        Half the width of the lines [m]: largest distance of a point on a line from the line's centre.
    scale, max_range, margin
        As in `log_nfa`.
    """
    found = np.asarray(points, np.float64)
    away = distances_to_lines(field, robot_to_field(found, pose))
    # Points close together belong to one object: only one of them counts, on a line or not.
    _, alone = np.unique(np.floor(found / scale), axis=0, return_index=True)
    nfa = log_nfa(away[alone], field, scale=scale, max_range=max_range, margin=margin)
    on_lines = float(np.mean(away <= half_line_width))
    if paths is None or not np.size(paths):
        return Evidence(nfa, on_lines, 0, math.nan, math.nan)
    crossings = expected_crossings(field, pose, paths, line_width=2.0 * half_line_width)
    ends = np.asarray(paths, np.float64)
    density = len(found) / float(np.sum(np.hypot(*(ends[:, 2:] - ends[:, :2]).T)))
    windows = 2.0 * half_line_width * float(np.mean(1.0 / crossings.sines)) if len(crossings.sines) else 0.0
    by_chance = 1.0 - math.exp(-density * windows)
    hits = _detected(crossings, found, half_line_width)

    def corrected(share: float) -> float:
        return (share - by_chance) / max(1.0 - by_chance, 1e-3)

    shares = [
        float(np.mean(hits[crossings.lines == line]))
        for line in np.unique(crossings.lines)
        if np.count_nonzero(crossings.lines == line) >= _MIN_LINE_CROSSINGS
    ]
    seen = corrected(float(np.mean(hits))) if len(hits) else math.nan
    return Evidence(nfa, on_lines, len(hits), seen, corrected(min(shares)) if shares else math.nan)


def log_nfa(distances: npt.ArrayLike, field: Field, *, scale: float, max_range: float, margin: float | None) -> float:
    """Return the natural logarithm of the number of false alarms.

    That is the expected number of poses, of all that are tested, that random points fit as well.

    Parameters
    ----------
    distances
        Distances of the points from their nearest lines at the best pose [m].
    field
        Lines of the field.
    scale
        Largest distance of a point that counts as on a line [m].
    max_range
        Largest range of the points [m].
    margin
        Border around the field in which poses were searched [m]; None: only near one pose, up to ``scale``.

    Notes
    -----
    A random point on the field lies within t of lines of length l with probability p = 2 t l / area. At least k of n
    independent points do so with a probability of at most exp(-n KL(k/n, p)) (Chernoff bound, KL the Kullback-Leibler
    divergence). The number of poses that differ by more than t is area / t^2 times 2 pi max_range / t. Several t are
    tried, which multiplies the number of tests.
    """
    away = np.abs(np.asarray(distances, np.float64))
    if not away.size:
        return math.inf
    size = math.hypot(field.length, field.width)
    area, turns = (2.0 * scale) ** 2, 2.0 * scale
    if margin is not None:
        area, turns = (field.length + 2.0 * margin) * (field.width + 2.0 * margin), 2.0 * math.pi * min(max_range, size)
    best = math.inf
    for ratio in _DISTANCE_RATIOS:
        t = ratio * scale
        p = min(2.0 * t * total_line_length(field) / (field.length * field.width), 0.99)
        k = float(np.mean(away <= t))
        poses = max(area / t**2, 1.0) * max(turns / t, 1.0) * len(_DISTANCE_RATIOS)
        best = min(best, math.log(poses) - away.size * _divergence(k, p))
    return best


def total_line_length(field: Field) -> float:
    """Return the total length of the lines and arcs of a field [m]."""
    straight = sum(math.hypot(x1 - x0, y1 - y0) for x0, y0, x1, y1 in field.lines)
    return straight + sum(each.radius * (each.end - each.start) for each in field.arcs)


def _divergence(share: float, p: float) -> float:
    """Return the Kullback-Leibler divergence of two Bernoulli distributions, 0 where the share is not above p."""
    if share <= p:
        return 0.0
    rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - p))
    return share * math.log(share / p) + rest


def distances_to_lines(field: Field, places: npt.ArrayLike) -> Float64:
    """Return the distances of places (..., 2) on the field from the nearest line [m]."""
    x, y = np.moveaxis(np.asarray(places, np.float64)[..., None, :], -1, 0)
    away = []  # a field has a line or an arc
    if field.lines:
        x0, y0, x1, y1 = np.array(field.lines).T
        dx, dy = x1 - x0, y1 - y0
        along = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx**2 + dy**2), 0.0, 1.0)
        away.append(np.hypot(x - x0 - along * dx, y - y0 - along * dy).min(axis=-1))
    for each in field.arcs:
        u, v = x[..., 0] - each.x, y[..., 0] - each.y
        in_opening = np.mod(np.arctan2(v, u) - each.start, 2.0 * math.pi) <= each.end - each.start
        ends = [
            np.hypot(u - each.radius * math.cos(end), v - each.radius * math.sin(end)) for end in (each.start, each.end)
        ]
        away.append(np.where(in_opening, np.abs(np.hypot(u, v) - each.radius), np.minimum(*ends)))
    return np.asarray(np.min(away, axis=0))


def robot_to_field(points: npt.ArrayLike, pose: npt.ArrayLike) -> Float64:
    """Return places (..., 2) in the robot's frame as places on the field."""
    x, y, heading = np.asarray(pose, np.float64)
    rotation = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    return np.asarray(np.asarray(points, np.float64) @ rotation.T + (x, y))


def expected_crossings(field: Field, pose: npt.ArrayLike, paths: npt.ArrayLike, *, line_width: float) -> Crossings:
    """Return the crossings at which a scan line must find a stripe.

    These are crossings at 30 degrees or more, away from other crossings and from the ends of lines and scan lines.

    Parameters
    ----------
    field
        Lines of the field.
    pose
        (3,): x, y [m] and heading [rad] of the robot.
    paths
        (paths, 4) both ends of the scan lines in the robot's frame [m].
    line_width
        Width of the stripes [m]: crossings nearer than 3 widths to another one are excluded.
    """
    ends = np.asarray(paths, np.float64).reshape(-1, 2, 2)
    start, end = np.moveaxis(robot_to_field(ends, pose), 1, 0)
    length = np.linalg.norm(end - start, axis=-1)
    direction = (end - start) / np.maximum(length, 1e-12)[:, None]
    found = [_across_line(start, direction, each, line_width) for each in field.lines]
    found += [
        _across_arc(start, direction, (each.x, each.y, each.radius, each.start, each.end), sign, line_width)
        for each in field.arcs
        for sign in (-1.0, 1.0)
    ]
    # An arc is in the list twice, for the crossings into and out of its circle.
    numbers = [*range(len(field.lines)), *(len(field.lines) + k for k in range(len(field.arcs)) for _ in range(2))]
    line = np.repeat(np.array(numbers, np.intp), [len(each[0]) for each in found])
    path, away, sines, clear = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.lexsort((away, path))
    path, away, sines, clear, line = (each[order] for each in (path, away, sines, clear, line))
    gap = np.where(path[1:] == path[:-1], away[1:] - away[:-1], np.inf)
    alone = np.minimum(np.append(gap, np.inf), np.append(np.inf, gap)) > _MIN_GAP * line_width
    good = alone & clear & (sines >= _MIN_SINE) & (away > line_width) & (away < length[path] - line_width)
    first, last = ends[path[good], 0], ends[path[good], 1]
    share = (away[good] / length[path[good]])[:, None]
    return Crossings(first + share * (last - first), sines[good], line[good])


def _detected(crossings: Crossings, points: npt.ArrayLike, tolerance: float) -> npt.NDArray[np.bool_]:
    """Return which crossings have a point within ``tolerance`` [m] of the line."""
    found = np.asarray(points)
    detected = [
        bool(np.any(np.hypot(*(found - place).T) * sine <= tolerance))
        for place, sine in zip(crossings.places, crossings.sines, strict=True)
    ]
    return np.array(detected, np.bool_)


_Found = tuple[npt.NDArray[np.intp], Float64, Float64, npt.NDArray[np.bool_]]


def _across_line(start: Float64, way: Float64, line: tuple[float, ...], line_width: float) -> _Found:
    """Return which scan lines cross a line, at which distance and sine, and whether away from the line's ends."""
    x0, y0, x1, y1 = line
    size = math.hypot(x1 - x0, y1 - y0)
    ex, ey = (x1 - x0) / size, (y1 - y0) / size
    across = way[:, 0] * ey - way[:, 1] * ex
    dx, dy = x0 - start[:, 0], y0 - start[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (dx * ey - dy * ex) / across
        along = (dx * way[:, 1] - dy * way[:, 0]) / across
    crossed = (np.abs(across) > _MIN_CROSSING_SINE) & (along > -line_width) & (along < size + line_width)
    clear = (along > line_width) & (along < size - line_width)
    return np.flatnonzero(crossed), away[crossed], np.abs(across)[crossed], clear[crossed]


def _across_arc(start: Float64, way: Float64, arc: tuple[float, ...], sign: float, line_width: float) -> _Found:
    """Return the same for an arc: crossings into its circle (sign -1) or out of it (sign 1)."""
    x, y, radius, first, last = arc
    dx, dy = x - start[:, 0], y - start[:, 1]
    ahead, across = dx * way[:, 0] + dy * way[:, 1], dy * way[:, 0] - dx * way[:, 1]
    half = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    away = ahead + sign * half
    angle = np.arctan2(away * way[:, 1] - dy, away * way[:, 0] - dx)
    opening, ends = last - first, line_width / radius
    turned = np.mod(angle - first, 2.0 * math.pi)
    crossed = (np.abs(across) < radius) & (turned <= opening)
    clear = (turned > ends) & (turned < opening - ends) | (opening > 2.0 * math.pi - ANGLE_ROUNDING)
    return np.flatnonzero(crossed), away[crossed], (half / radius)[crossed], clear[crossed]
