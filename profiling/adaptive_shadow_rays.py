"""Peers of the occluded irradiance: closed form on the visible parts of each segment, found with adaptive shadow rays.

For each pair of a receiver and a segment that face each other, a few shadow rays go to points of the segment. Between
two neighbouring rays with different results the edge of the shadow is found by bisection. The closed form is summed
over the visible parts. Parts that lie between two neighbouring rays with the same result are not found. Embree traces
the shadow rays on all cores. `NUMPY` and `NUMBA` compute the pairs, the rays and the closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.simulation.transport.line_irradiance import LitSegments

F = np.float32
ZERO, HALF, ONE, TINY = F(0.0), F(0.5), F(1.0), F(1e-24)
Free = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.bool_]]
"""Function that returns whether rays (n, 3) from a start, each as long as its step (n, 3), hit nothing."""


class Pairs(NamedTuple):
    """Pairs of a receiver and a segment that face each other, in the order of the receivers.

    Attributes
    ----------
    receiver, segment
        Indices (pairs,).
    low, high
        Interval (pairs,) [m] of the segment in front of the receiver.
    """

    receiver: NDArray[np.int64]
    segment: NDArray[np.int64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]


class Form(NamedTuple):
    """Functions of a peer.

    Attributes
    ----------
    pairs
        Return the `Pairs` of receivers (n, 6) and a `segment_table`.
    rays
        Return start and step (k, 3) of rays from receivers to places [m] on segments, with a clearance [m].
    light
        Return the irradiance (k,) of receivers by parts of segments.
    """

    pairs: Callable[..., Any]
    rays: Callable[..., Any]
    light: Callable[..., Any]


class Setting(NamedTuple):
    """Number of shadow rays of a pair, and of bisections of an edge of a shadow."""

    rays: int
    bisections: int


# Numbers of rays and bisections that are tried for an error, ascending. Parts that no ray hits set the 95th percentile:
# it falls with the rays, and a few bisections are enough.
_RAYS = (2, 4, 6, 8, 9, 10, 11, 12, 16, 24, 32, 40, 48, 56, 64, 96, 128, 192)
_BISECTIONS = (3, 4, 5, 6)


def cheapest_setting(error: Callable[[Setting], float], cost: Callable[[Setting], float], limit: float) -> Setting:
    """Return the setting of least cost whose error is `limit` or less.

    Raises
    ------
    ValueError
        The error of all settings is larger.
    """
    fewest = [_fewest_rays(error, bisections, limit) for bisections in _BISECTIONS]
    settings = [each for each in fewest if each is not None]
    if not settings:
        raise ValueError(f"no setting of the adaptive peer has an error of {limit:.0e} or less")
    return min(settings, key=cost)


def _fewest_rays(error: Callable[[Setting], float], bisections: int, limit: float) -> Setting | None:
    settings = (Setting(rays, bisections) for rays in _RAYS)
    return next((each for each in settings if error(each) <= limit), None)


def segment_table(segments: LitSegments) -> NDArray[np.float32]:
    """Return start, direction, normal, length and exitance over pi of each segment: float32 (segments, 11)."""
    start = segments.ends[:, 0]
    along = segments.ends[:, 1] - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    columns = [start, along / length, segments.normals, length, segments.exitance[:, None] / np.pi]
    return np.hstack(columns).astype(np.float32)


def irradiance_by_adaptive_rays(
    form: Form,
    receivers: NDArray[np.float32],
    table: NDArray[np.float32],
    free: Free,
    setting: Setting,
    clearance: float,
) -> NDArray[np.float32]:
    """Return the irradiance (n,) of receivers.

    Parameters
    ----------
    form
        `NUMPY` or `NUMBA`.
    receivers
        Positions and normals (n, 6) [m].
    table
        Segments, see `segment_table`.
    free
        Function that traces shadow rays.
    setting
        Number of rays and bisections.
    clearance
        Distance of both ends of a ray from the surfaces [m].
    """
    pairs = Pairs(*form.pairs(receivers, table))

    def seen_at(pair: NDArray[np.int64], places: NDArray[np.float32]) -> NDArray[np.bool_]:
        return free(*form.rays(receivers, table, pairs.receiver[pair], pairs.segment[pair], places, F(clearance)))

    share = (np.arange(setting.rays, dtype=np.float32) + HALF) / F(setting.rays)
    places = pairs.low[:, None] + (pairs.high - pairs.low)[:, None] * share
    pair = np.repeat(np.arange(len(pairs.low)), setting.rays)
    seen = seen_at(pair, places.ravel()).reshape(places.shape)

    changed, after = np.nonzero(seen[:, 1:] != seen[:, :-1])
    below, above, below_seen = places[changed, after], places[changed, after + 1], seen[changed, after]
    for _ in range(setting.bisections):
        middle = HALF * (below + above)
        same = seen_at(changed, middle) == below_seen
        below, above = np.where(same, middle, below), np.where(same, above, middle)

    part, begin, end = _visible_parts(pairs, changed, HALF * (below + above), seen[:, 0])
    light = form.light(receivers, table, pairs.receiver[part], pairs.segment[part], begin, end)
    return np.bincount(pairs.receiver[part], light, minlength=len(receivers)).astype(np.float32)


def _visible_parts(
    pairs: Pairs, changed: NDArray[np.int64], cuts: NDArray[np.float32], first_seen: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Return pair, begin and end [m] of the visible parts; `cuts` are the edges of the shadows of pairs `changed`."""
    count = len(pairs.low)
    edges = np.bincount(changed, minlength=count)
    first = np.cumsum(edges + 1) - edges - 1  # first part of each pair
    number = np.arange(count + len(cuts))
    pair = np.repeat(np.arange(count), edges + 1)
    begin, end = pairs.low[pair], pairs.high[pair]
    inner = number != first[pair]
    begin[inner] = cuts
    end[np.flatnonzero(inner) - 1] = cuts
    visible = first_seen[pair] ^ ((number - first[pair]) % 2 == 1)
    return pair[visible], begin[visible], end[visible]


def _numpy_pairs(receivers: NDArray[np.float32], table: NDArray[np.float32]) -> Pairs:
    start, along, normals, length = table[:, :3], table[:, 3:6], table[:, 6:9], table[:, 9]
    places, facing = receivers[:, :3], receivers[:, 3:]
    height = places @ normals.T - np.einsum("mk,mk->m", start, normals)
    a = facing @ start.T - np.einsum("nk,nk->n", facing, places)[:, None]
    b = facing @ along.T
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = -a / b
    low = np.where((b > 0.0) & (cut > 0.0), cut, ZERO)
    high = np.where((b < 0.0) & (cut < length), cut, length)
    receiver, segment = np.nonzero((height > 0.0) & (high > low) & ((a > 0.0) | (b != 0.0)))
    return Pairs(receiver, segment, low[receiver, segment], high[receiver, segment])


def _numpy_rays(
    receivers: NDArray[np.float32],
    table: NDArray[np.float32],
    receiver: NDArray[np.int64],
    segment: NDArray[np.int64],
    places: NDArray[np.float32],
    clearance: np.float32,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    start = (receivers[:, :3] + clearance * receivers[:, 3:])[receiver]
    lifted = (table[:, :3] + clearance * table[:, 6:9])[segment]
    return start, lifted + places[:, None] * table[segment, 3:6] - start


def _numpy_light(
    receivers: NDArray[np.float32],
    table: NDArray[np.float32],
    receiver: NDArray[np.int64],
    segment: NDArray[np.int64],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> NDArray[np.float32]:
    from_receiver, from_segment = receivers[receiver].T, table[segment].T
    offset, facing = from_receiver[:3] - from_segment[:3], from_receiver[3:]
    along, normal = from_segment[3:6], from_segment[6:9]
    nearest = (offset * along).sum(axis=0)
    across = nearest * along - offset
    square = (across * across).sum(axis=0) + TINY
    a, b = (facing * across).sum(axis=0), (facing * along).sum(axis=0)
    low, high = low - nearest, high - nearest
    step, per, rho = high - low, ONE / ((low * low + square) * (high * high + square)), np.sqrt(square)
    arc = np.arctan2(step * rho, square + low * high)
    value = a * (step * (square - low * high) * per + arc / rho) / square + b * step * (low + high) * per
    light: NDArray[np.float32] = HALF * (offset * normal).sum(axis=0) * from_segment[10] * value
    return light


@numba.njit(inline="always", error_model="numpy")
def facing_part(receiver, segment):
    """Return the interval of a segment in front of a receiver; empty where the segment shines away from it."""
    dx, dy, dz = receiver[0] - segment[0], receiver[1] - segment[1], receiver[2] - segment[2]
    height = dx * segment[6] + dy * segment[7] + dz * segment[8]
    a = -(receiver[3] * dx + receiver[4] * dy + receiver[5] * dz)
    b = receiver[3] * segment[3] + receiver[4] * segment[4] + receiver[5] * segment[5]
    low, high = ZERO, segment[9]
    if b > ZERO:
        low = max(low, -a / b)
    elif b < ZERO:
        high = min(high, -a / b)
    elif a <= ZERO:
        high = ZERO
    return low, high if height > ZERO else ZERO


@numba.njit(parallel=True, error_model="numpy")
def _numba_pairs(receivers, table):
    counts = np.empty(receivers.shape[0], np.int64)
    for i in numba.prange(receivers.shape[0]):
        n = 0
        for m in range(table.shape[0]):
            low, high = facing_part(receivers[i], table[m])
            n += high > low
        counts[i] = n
    ends = np.cumsum(counts)
    total = ends[-1]
    of_receiver, of_segment = np.empty(total, np.int64), np.empty(total, np.int64)
    lows, highs = np.empty(total, np.float32), np.empty(total, np.float32)
    for i in numba.prange(receivers.shape[0]):
        at = ends[i] - counts[i]
        for m in range(table.shape[0]):
            low, high = facing_part(receivers[i], table[m])
            if high > low:
                of_receiver[at], of_segment[at], lows[at], highs[at] = i, m, low, high
                at += 1
    return of_receiver, of_segment, lows, highs


@numba.njit(parallel=True, error_model="numpy")
def _numba_rays(receivers, table, receiver, segment, places, clearance):
    start, step = np.empty((len(places), 3), np.float32), np.empty((len(places), 3), np.float32)
    for k in numba.prange(len(places)):
        i, m, t = receiver[k], segment[k], places[k]
        for axis in range(3):
            begin = receivers[i, axis] + clearance * receivers[i, 3 + axis]
            start[k, axis] = begin
            step[k, axis] = table[m, axis] + t * table[m, 3 + axis] + clearance * table[m, 6 + axis] - begin
    return start, step


@numba.njit(inline="always", error_model="numpy")
def part_irradiance(at, line, low, high):
    """Return the irradiance of a receiver by the part of a segment from low to high [m], in closed form."""
    dx, dy, dz = at[0] - line[0], at[1] - line[1], at[2] - line[2]
    along = dx * line[3] + dy * line[4] + dz * line[5]
    height = dx * line[6] + dy * line[7] + dz * line[8]
    rx, ry, rz = along * line[3] - dx, along * line[4] - dy, along * line[5] - dz
    square = rx * rx + ry * ry + rz * rz + TINY
    a = at[3] * rx + at[4] * ry + at[5] * rz
    b = at[3] * line[3] + at[4] * line[4] + at[5] * line[5]
    first, last = low - along, high - along
    step, per, rho = last - first, ONE / ((first * first + square) * (last * last + square)), np.sqrt(square)
    arc = np.arctan2(step * rho, square + first * last)
    value = a * (step * (square - first * last) * per + arc / rho) / square + b * step * (first + last) * per
    return HALF * height * line[10] * value


@numba.njit(parallel=True, error_model="numpy")
def _numba_light(receivers, table, receiver, segment, lows, highs):
    light = np.empty(len(lows), np.float32)
    for k in numba.prange(len(lows)):
        light[k] = part_irradiance(receivers[receiver[k]], table[segment[k]], lows[k], highs[k])
    return light


NUMPY = Form(_numpy_pairs, _numpy_rays, _numpy_light)
NUMBA = Form(_numba_pairs, _numba_rays, _numba_light)
