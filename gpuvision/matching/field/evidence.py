"""Whether what a robot sees is its field: more points on lines than chance brings, and lines seen where they must be.

`chance` weighs how many points lie on lines at a pose, however that pose was found: the expected number of poses that
random points would fit as well (a-contrario test of Desolneux, Moisan and Morel). `expected_crossings` tells where scan
lines cross the field's lines, so that lines that should be seen and are not count against a pose.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.field.distance_map import Field

Float64 = npt.NDArray[np.float64]

_SHARES = (0.06, 0.12, 0.25, 0.5, 1.0)  # of the map's scale: how near to its line a point is on it
_STEEP = 0.5  # sine of the least angle at which a line must be crossed to be expected


class Crossings(NamedTuple):
    """Where scan lines cross the lines of a field.

    Attributes
    ----------
    places
        (crossings, 2), in the robot's frame [m].
    sines
        (crossings,), of the angles at which they cross.
    """

    places: Float64
    sines: Float64


class Evidence(NamedTuple):
    """What speaks for a pose.

    Attributes
    ----------
    chance
        Logarithm (natural) of how many poses random points would fit as well, see `chance`: above 0 it says nothing.
    on_lines
        Share of the points within a few centimetres of lines.
    expected
        How many crossings of scan lines with the field's lines should have been seen; 0 where that is not known.
    seen
        Share of them that is, beyond what points as dense as these meet by chance; NaN where none is expected.
    """

    chance: float
    on_lines: float
    expected: int
    seen: float

    @property
    def missing(self) -> float:
        """How much should be seen and is not, beside what of the points is explained: 0 (or less) where all is seen."""
        return (1.0 - self.seen) / max(self.on_lines, 1e-3) if self.expected else 0.0


def evidence(
    points: npt.ArrayLike,
    paths: npt.ArrayLike | None,
    field: Field,
    pose: npt.ArrayLike,
    *,
    near: float,
    scale: float,
    reach: float,
    outside: float | None,
) -> Evidence:
    """Return what speaks for a pose.

    Parameters
    ----------
    points
        (points, 2), in the robot's frame [m].
    paths
        (paths, 4), both ends of the scan lines that found them [m]; None: not known.
    field, pose
        The field, and x, y [m] and heading [rad] on it.
    near
        How far from the middle of its line a point on it is at most [m]: half of the stripes' width.
    scale, reach, outside
        As `chance` takes them.
    """
    found = np.asarray(points, np.float64)
    away = distances_to_lines(field, onto_field(found, pose))
    # Points close together are of one thing, on a line or not: one of them counts.
    _, alone = np.unique(np.floor(found / scale), axis=0, return_index=True)
    by_chance = chance(away[alone], field, scale=scale, reach=reach, outside=outside)
    on_lines = float(np.mean(away <= near))
    if paths is None or not np.size(paths):
        return Evidence(by_chance, on_lines, 0, math.nan)
    crossings = expected_crossings(field, pose, paths, line_width=2.0 * near)
    ends = np.asarray(paths, np.float64)
    density = len(found) / float(np.sum(np.hypot(*(ends[:, 2:] - ends[:, :2]).T)))
    windows = 2.0 * near * float(np.mean(1.0 / crossings.sines)) if len(crossings.sines) else 0.0
    met = 1.0 - math.exp(-density * windows)
    seen = (seen_share(crossings, found, near) - met) / max(1.0 - met, 1e-3)
    return Evidence(by_chance, on_lines, len(crossings.sines), seen)


def chance(distances: npt.ArrayLike, field: Field, *, scale: float, reach: float, outside: float | None) -> float:
    """Return the logarithm of how many poses random points would fit as well as these do, of all that are looked at.

    Parameters
    ----------
    distances
        Of the points from their nearest lines at the pose that fits them best [m].
    field
        Its lines.
    scale
        Points further off are on no line [m].
    reach
        How far points are seen [m].
    outside
        How far beside the field poses were looked for [m]; None: only near one, to ``scale``.

    Notes
    -----
    A point anywhere on the field is within t of lines of length l with a probability p = 2 t l / area; k of n
    independent ones are with a probability of at most exp(-n KL(k/n, p)) (Chernoff). Poses that differ by more than t
    are area / t^2 times 2 pi reach / t. Several t are tried, which multiplies the poses.
    """
    away = np.abs(np.asarray(distances, np.float64))
    if not away.size:
        return math.inf
    size = math.hypot(field.length, field.width)
    area, turns = (2.0 * scale) ** 2, 2.0 * scale
    if outside is not None:
        area, turns = (field.length + 2.0 * outside) * (field.width + 2.0 * outside), 2.0 * math.pi * min(reach, size)
    best = math.inf
    for share in _SHARES:
        t = share * scale
        p = min(2.0 * t * line_length(field) / (field.length * field.width), 0.99)
        k = float(np.mean(away <= t))
        poses = max(area / t**2, 1.0) * max(turns / t, 1.0) * len(_SHARES)
        best = min(best, math.log(poses) - away.size * _divergence(k, p))
    return best


def line_length(field: Field) -> float:
    """Return how long the lines of a field are together [m]."""
    straight = sum(math.hypot(x1 - x0, y1 - y0) for x0, y0, x1, y1 in field.lines)
    return straight + sum(each.radius * (each.end - each.start) for each in field.arcs)


def _divergence(share: float, p: float) -> float:
    """Kullback and Leibler's divergence of two coins, 0 where the share is no more than expected."""
    if share <= p:
        return 0.0
    rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - p))
    return share * math.log(share / p) + rest


def distances_to_lines(field: Field, places: npt.ArrayLike) -> Float64:
    """Return how far places (..., 2) on the field are from its nearest line [m]."""
    x, y = np.moveaxis(np.asarray(places, np.float64)[..., None, :], -1, 0)
    away = [np.full(x.shape[:-1], np.inf)]
    if field.lines:
        x0, y0, x1, y1 = np.array(field.lines).T
        dx, dy = x1 - x0, y1 - y0
        along = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx**2 + dy**2), 0.0, 1.0)
        away.append(np.hypot(x - x0 - along * dx, y - y0 - along * dy).min(axis=-1))
    for each in field.arcs:
        u, v = x[..., 0] - each.x, y[..., 0] - each.y
        within = np.mod(np.arctan2(v, u) - each.start, 2.0 * math.pi) <= each.end - each.start
        ends = [
            np.hypot(u - each.radius * math.cos(end), v - each.radius * math.sin(end)) for end in (each.start, each.end)
        ]
        away.append(np.where(within, np.abs(np.hypot(u, v) - each.radius), np.minimum(*ends)))
    return np.asarray(np.min(away, axis=0))


def onto_field(points: npt.ArrayLike, pose: npt.ArrayLike) -> Float64:
    """Return places (..., 2) in the robot's frame as places on the field."""
    x, y, heading = np.asarray(pose, np.float64)
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    return np.asarray(np.asarray(points, np.float64) @ turn.T + (x, y))


def expected_crossings(field: Field, pose: npt.ArrayLike, paths: npt.ArrayLike, *, line_width: float) -> Crossings:
    """Return where scan lines must find a stripe: crossings at 30 degrees or more, by themselves and off the ends.

    Parameters
    ----------
    field
        Its lines.
    pose
        (3,): x, y [m] and heading [rad] of the robot.
    paths
        (paths, 4), x, y of both ends of the scan lines in the robot's frame [m].
    line_width
        Of the stripes [m]: crossings nearer than 3 of it to another one are left out.
    """
    ends = np.asarray(paths, np.float64).reshape(-1, 2, 2)
    start, end = np.moveaxis(onto_field(ends, pose), 1, 0)
    length = np.linalg.norm(end - start, axis=-1)
    way = (end - start) / np.maximum(length, 1e-12)[:, None]
    found = [_across_line(start, way, each, line_width) for each in field.lines]
    found += [
        _across_arc(start, way, (each.x, each.y, each.radius, each.start, each.end), sign, line_width)
        for each in field.arcs
        for sign in (-1.0, 1.0)
    ]
    path, away, sines, clear = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.lexsort((away, path))
    path, away, sines, clear = (each[order] for each in (path, away, sines, clear))
    gap = np.where(path[1:] == path[:-1], away[1:] - away[:-1], np.inf)
    alone = np.minimum(np.append(gap, np.inf), np.append(np.inf, gap)) > 3.0 * line_width
    good = alone & clear & (sines >= _STEEP) & (away > line_width) & (away < length[path] - line_width)
    first, last = ends[path[good], 0], ends[path[good], 1]
    share = (away[good] / length[path[good]])[:, None]
    return Crossings(first + share * (last - first), sines[good])


def seen_share(crossings: Crossings, points: npt.ArrayLike, tolerance: float) -> float:
    """Return the share of the crossings at which there is a point, ``tolerance`` from the line at most; NaN of none."""
    if not len(crossings.places):
        return math.nan
    seen = [
        bool(np.any(np.hypot(*(np.asarray(points) - place).T) * sine <= tolerance))
        for place, sine in zip(crossings.places, crossings.sines, strict=True)
    ]
    return float(np.mean(seen))


_Found = tuple[npt.NDArray[np.intp], Float64, Float64, npt.NDArray[np.bool_]]


def _across_line(start: Float64, way: Float64, line: tuple[float, ...], line_width: float) -> _Found:
    """Find which scan lines cross a line, how far on, at which sine, and whether off its ends."""
    x0, y0, x1, y1 = line
    size = math.hypot(x1 - x0, y1 - y0)
    ex, ey = (x1 - x0) / size, (y1 - y0) / size
    across = way[:, 0] * ey - way[:, 1] * ex
    dx, dy = x0 - start[:, 0], y0 - start[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (dx * ey - dy * ex) / across
        along = (dx * way[:, 1] - dy * way[:, 0]) / across
    crossed = (np.abs(across) > 0.02) & (along > -line_width) & (along < size + line_width)
    clear = (along > line_width) & (along < size - line_width)
    return np.flatnonzero(crossed), away[crossed], np.abs(across)[crossed], clear[crossed]


def _across_arc(start: Float64, way: Float64, arc: tuple[float, ...], sign: float, line_width: float) -> _Found:
    """Find the same of an arc: where scan lines go into its circle (-1), or out of it (1)."""
    x, y, radius, first, last = arc
    dx, dy = x - start[:, 0], y - start[:, 1]
    ahead, aside = dx * way[:, 0] + dy * way[:, 1], dy * way[:, 0] - dx * way[:, 1]
    half = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
    away = ahead + sign * half
    angle = np.arctan2(away * way[:, 1] - dy, away * way[:, 0] - dx)
    opening, ends = last - first, line_width / radius
    turned = np.mod(angle - first, 2.0 * math.pi)
    crossed = (np.abs(aside) < radius) & (turned <= opening)
    clear = (turned > ends) & (turned < opening - ends) | (opening > 2.0 * math.pi - 1e-9)
    return np.flatnonzero(crossed), away[crossed], (half / radius)[crossed], clear[crossed]
