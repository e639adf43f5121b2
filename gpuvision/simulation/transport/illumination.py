"""A sheet of laser light on a scene: which line segments it lights, and with how much power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.range_image import StraightTransport
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.envelope import Pieces, upper_envelope
from gpuvision.simulation.transport.sheet_cut import Cuts, SheetIndex, ranges
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# A fan's rays reach no farther from the source than a thousand times its height, on the level H = 0.
_FLATTEST = 1e-3
# What counts as one place, beside its coordinates, and as one direction or power.
_TOUCHING, _EVEN = 1e-14, 1e-9


class LitLine(NamedTuple):
    """Lit line segments, each in one triangle.

    Attributes
    ----------
    ends
        (m, 2, 3), metres, in the scene.
    normals
        (m, 3), unit vectors on the side that the light comes from.
    triangle
        (m,): the number of the triangle in the scene.
    power
        (m,), power that arrives on a metre of the line, W/m.
    """

    ends: Float64
    normals: Float64
    triangle: Integers
    power: Float64

    @property
    def lengths(self) -> Float64:
        """Lengths of the segments, (m,), metres."""
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))

    def total(self) -> float:
        """Return the power that arrives on all segments, W."""
        return float(self.lengths @ self.power)

    def those(self, which: npt.NDArray[Any] | slice) -> LitLine:
        """Return some of the segments."""
        return LitLine(self.ends[which], self.normals[which], self.triangle[which], self.power[which])

    def joined(self, kind: npt.ArrayLike) -> LitLine:
        """Return fewer segments: those that touch, one after another, in one plane, of one power and kind, as one.

        Parameters
        ----------
        kind
            (m,) integers, such as the materials of the segments' triangles. A joined segment keeps the first triangle.
        """
        kind = np.asarray(kind)
        gap = np.abs(self.ends[1:, 0] - self.ends[:-1, 1]).max(axis=1, initial=0.0)
        size = np.abs(self.ends[1:, 0]).max(axis=1, initial=0.0)
        turn = np.abs(np.diff(self.normals, axis=0)).max(axis=1, initial=0.0)
        alike = (gap <= _TOUCHING * size) & (turn <= _EVEN) & (np.diff(kind) == 0)
        alike &= np.abs(np.diff(self.power)) <= _EVEN * self.power[1:]
        first = np.flatnonzero(np.append(True, ~alike)[: len(self.power)])
        last = np.append(first[1:], len(self.power))[: len(first)] - 1
        ends = np.stack([self.ends[first, 0], self.ends[last, 1]], axis=1)
        return LitLine(ends, self.normals[first], self.triangle[first], self.power[first])


@dataclass(frozen=True, kw_only=True)
class LightSheet:
    """A sheet of light in the plane of a `StraightTransport`, which shines against its ``h_axis``.

    Parameters
    ----------
    transport
        Where the sheet stands, and how it moves over the scene.
    power
        Power in a metre of the sheet, W per metre of G; of a fan, where it meets H = 0.
    sigma
        Standard deviation of the light across the sheet, metres along the transport; 0 is a thin sheet. The light of a
        thick one stays in sheets side by side.
    source
        (G, H) of the point that a fan comes from, H > 0: it lights what lies below, by more than a thousandth of H;
        what is nearer to it does not stop its light. None: parallel light.
    g_limits
        Between which G there is light; of a fan, where it meets H = 0. None: everywhere.
    profile
        Rows of G and a factor to the power there, G ascending, straight in between and zero beyond; of a fan, where it
        meets H = 0. None: even light.
    uniformity
        A segment ends where its power has changed by this share of the most in its triangle: `LitLine.power` is
        its mean, the energy is exact.

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.
    """

    transport: StraightTransport
    power: float = 1.0
    sigma: float = 0.0
    source: tuple[float, float] | None = None
    g_limits: tuple[float, float] | None = None
    profile: tuple[tuple[float, ...], ...] | None = None
    uniformity: float = 0.05

    def __post_init__(self) -> None:
        if not isinstance(self.transport, StraightTransport):
            raise TypeError(f"LightSheet.transport is {self.transport!r}, expected a StraightTransport")
        for name, least in (("power", 0.0), ("sigma", 0.0), ("uniformity", 1e-4)):
            number = finite(getattr(self, name), f"LightSheet.{name}")
            if number < least:
                raise ValueError(f"LightSheet.{name} is {number:g}, expected {least:g} or more")
            object.__setattr__(self, name, number)
        if self.source is not None:
            object.__setattr__(self, "source", numbers(self.source, (2,), "LightSheet.source"))
            if self.source[1] <= 0.0:
                raise ValueError(f"LightSheet.source has H = {self.source[1]:g} m, expected it above H = 0")
        if self.g_limits is not None:
            object.__setattr__(self, "g_limits", numbers(self.g_limits, (2,), "LightSheet.g_limits"))
            if self.g_limits[0] >= self.g_limits[1]:
                raise ValueError(f"LightSheet.g_limits are {self.g_limits}, expected the lower one first")
        if self.profile is not None:
            rows = numbers(self.profile, (len(self.profile), 2), "LightSheet.profile")
            table = np.array(rows)
            if len(table) < 2 or np.any(np.diff(table[:, 0]) <= 0.0) or np.any(table[:, 1] < 0.0):
                raise ValueError("LightSheet.profile: expected two rows or more, G ascending, no factor below 0")
            object.__setattr__(self, "profile", rows)

    def lit(self, scene: Scene, L: float, offset: float = 0.0) -> LitLine:
        """Return what a thin sheet lights at a transport [m], moved by so much across [m].

        Surfaces are lit on whichever side the light comes from, down to the first one that it meets. Error: some
        roundings of the coordinates.
        """
        return self.lit_lines(scene, [L + offset])[0]

    def lit_lines(self, scene: Scene, places: npt.ArrayLike) -> tuple[LitLine, Integers]:
        """Return what thin sheets light at several transports (k,) [m], and where each one's segments begin, (k + 1,).

        The segments of one sheet lie in the order in which the light's rays do.
        """
        places = np.atleast_1d(np.asarray(places, np.float64))
        cuts = SheetIndex.of(scene, self.transport).cuts(places)
        cuts, x, height = self._in_light(cuts)
        lit = self._within_light(upper_envelope(cuts.sheet, x, height), x)
        sheet_ends, arriving, lit = self._split(lit, cuts, x, height)
        sheet, triangle = cuts.sheet[lit.member], cuts.triangle[lit.member]
        ends = self._in_scene(sheet_ends, places[sheet])
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        good = (length > 0.0) & (arriving > 0.0)
        sheet, triangle, ends = sheet[good], triangle[good], ends[good]
        line = LitLine(ends, self._normals(scene, triangle, ends), triangle, arriving[good] / length[good])
        return line, np.searchsorted(sheet, np.arange(len(places) + 1))

    def towards(self, points: npt.ArrayLike) -> Float64:
        """Return unit vectors from points towards the light, (..., 3); of a fan, the source in each point's sheet."""
        points = np.asarray(points, np.float64)
        if self.source is None:
            up = np.array(self.transport.h_axis)
            return np.broadcast_to(up / np.linalg.norm(up), points.shape)
        towards = self.source_of(points) - points
        return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))

    def source_of(self, points: npt.ArrayLike) -> Float64:
        """Return where a fan comes from, (..., 3), in the sheets that points lie in.

        Raises
        ------
        ValueError
            The light is parallel.
        """
        if self.source is None:
            raise ValueError("LightSheet.source is None: parallel light comes from nowhere; use `towards`")
        points, move = np.asarray(points, np.float64), self.transport
        axes = np.array([move.g_axis, move.h_axis, move.direction])
        away = np.array([*self.source, 0.0]) - (points - move.origin) @ np.linalg.inv(axes)
        return np.asarray(points + away[..., :2] @ axes[:2])

    # ---- the sheet's own coordinates: x, which does not change along a ray, and a height towards the light ------

    def _in_light(self, cuts: Cuts) -> tuple[Cuts, Float64, Float64]:
        """Return what of the cuts the light can reach, from left to right, with x and heights (m, 2) of their ends.

        A fan becomes parallel by a projection that keeps lines straight: x is where a ray meets H = 0, the height
        is one over the depth below the source.
        """
        if self.source is not None:
            cuts = _below(cuts, self.source[1] * (1.0 - _FLATTEST))
        G, H = cuts.ends[..., 0], cuts.ends[..., 1]
        if self.source is not None:
            above, depth = self.source[1], self.source[1] - H
            G, H = self.source[0] + above * (G - self.source[0]) / depth, 1.0 / depth
        order = np.argsort(G, axis=1, kind="stable")
        ends = np.take_along_axis(cuts.ends, order[..., None], axis=1)
        return (
            cuts._replace(ends=ends),
            np.take_along_axis(G, order, axis=1),
            np.take_along_axis(H, order, axis=1),
        )

    def _within_light(self, pieces: Pieces, x: Float64) -> Pieces:
        """Cut pieces at the light's limits and at the knots of its profile."""
        knots = self._knots
        if knots is None:
            return pieces
        low, high = np.maximum(pieces.left, knots[0]), np.minimum(pieces.right, knots[-1])
        kept = low < high
        return _cut_at(Pieces(pieces.member[kept], low[kept], high[kept]), knots)

    def _split(self, pieces: Pieces, cuts: Cuts, x: Float64, height: Float64) -> tuple[Float64, Float64, Pieces]:
        """Split pieces until each is lit evenly; return their ends (G, H) and the power that arrives on them [W]."""
        if self.source is not None or self.profile is not None:
            ratio = self._densities(pieces, x, height)
            change = np.abs(ratio[:, 1] - ratio[:, 0]) / np.maximum(ratio.max(axis=1), 1e-300)
            count = np.maximum(np.ceil(change / self.uniformity * (1.0 - 1e-9)), 1.0).astype(np.int64)
            member, part = np.repeat(np.arange(len(count)), count), ranges(np.zeros_like(count), count)
            width = (pieces.right - pieces.left)[member] / count[member]
            left = pieces.left[member] + part * width
            right = np.where(part + 1 == count[member], pieces.right[member], pieces.left[member] + (part + 1) * width)
            pieces = Pieces(pieces.member[member], left, right)
        ends = self._at(pieces, cuts, x, height)
        return ends, self._power_up_to(pieces.right) - self._power_up_to(pieces.left), pieces

    def _densities(self, pieces: Pieces, x: Float64, height: Float64) -> Float64:
        """Return the power per metre of line at both ends of pieces, but for a factor of each piece, (k, 2)."""
        places = np.stack([pieces.left, pieces.right], axis=1)
        density = np.ones(places.shape)
        if self.profile is not None:
            density = np.interp(places, *np.array(self.profile).T)
        if self.source is not None:
            (a, b), (low, high) = x[pieces.member].T[..., None], height[pieces.member].T[..., None]
            density = density * (low + (places - a) / (b - a) * (high - low)) ** 2
        return density

    def _at(self, pieces: Pieces, cuts: Cuts, x: Float64, height: Float64) -> Float64:
        """Return (G, H) of both ends of pieces, (k, 2, 2), exact at the ends of the cuts."""
        (a, b), whole = x[pieces.member].T, cuts.ends[pieces.member]
        found = np.empty(whole.shape)
        for n, at in enumerate(pieces[1:]):
            share, rest = (at - a) / (b - a), (b - at) / (b - a)
            if self.source is not None:
                share, rest = share * height[pieces.member, 1], rest * height[pieces.member, 0]
                share, rest = share / (share + rest), rest / (share + rest)
            near, way = share < 0.5, whole[:, 1] - whole[:, 0]
            found[:, n] = np.where(near[:, None], whole[:, 0] + share[:, None] * way, whole[:, 1] - rest[:, None] * way)
        return found

    def _power_up_to(self, x: Float64) -> Float64:
        """Return the power of the sheet left of x, but for a constant, W."""
        if self.profile is None:
            return self.power * x
        knots, factor = np.array(self.profile).T
        before = np.append(0.0, np.cumsum(0.5 * np.diff(knots) * (factor[1:] + factor[:-1])))
        n = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
        inside = np.clip(x - knots[n], 0.0, knots[n + 1] - knots[n])
        slope = (factor[n + 1] - factor[n]) / (knots[n + 1] - knots[n])
        return np.asarray(self.power * (before[n] + inside * (factor[n] + 0.5 * slope * inside)))

    @property
    def _knots(self) -> Float64 | None:
        """Places of x between which the power is a straight line, the light's ends included; None: no ends."""
        if self.g_limits is None and self.profile is None:
            return None
        low, high = self.g_limits or (-math.inf, math.inf)
        if self.profile is None:
            return np.array([low, high])
        places = np.array(self.profile)[:, 0]
        low, high = max(low, float(places[0])), min(high, float(places[-1]))
        return np.concatenate([[low], places[(places > low) & (places < high)], [high]])

    def _in_scene(self, ends: Float64, places: Float64) -> Float64:
        move = self.transport
        flat = np.array(move.origin) + ends @ np.array([move.g_axis, move.h_axis])
        return np.asarray(flat + places[:, None, None] * np.array(move.direction))

    def _normals(self, scene: Scene, triangle: Integers, ends: Float64) -> Float64:
        """Return unit normals on the side of the light, square to the line."""
        corners = scene.corners[triangle]
        one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        # Of whatever size: the cross product of micrometres is not to vanish.
        normal = np.cross(one, two / np.abs(two).max(axis=1, keepdims=True))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        towards = self.towards(0.5 * (ends[:, 0] + ends[:, 1]))
        side = np.sum(normal * towards, axis=1, keepdims=True)
        return np.where(side < 0.0, -normal, normal)


def _below(cuts: Cuts, highest: float) -> Cuts:
    """Return what of the cuts lies below a height."""
    H = cuts.ends[..., 1]
    kept = H.min(axis=1) < highest
    cuts = Cuts(*(each[kept] for each in cuts))
    over = cuts.ends[..., 1] > highest
    if not over.any():
        return cuts
    ends, (rows, which) = cuts.ends.copy(), np.nonzero(over)
    low, high = cuts.ends[rows, 1 - which], cuts.ends[rows, which]
    share = (highest - low[:, 1]) / (high[:, 1] - low[:, 1])
    ends[rows, which] = low + share[:, None] * (high - low)
    return cuts._replace(ends=ends)


def _cut_at(pieces: Pieces, knots: Float64) -> Pieces:
    """Cut pieces at ascending places."""
    first = np.searchsorted(knots, pieces.left, side="right")
    count = np.maximum(np.searchsorted(knots, pieces.right, side="left") - first, 0) + 1
    member, part = np.repeat(np.arange(len(count)), count), ranges(np.zeros_like(count), count)
    knot = first[member] + part
    left = np.where(part == 0, pieces.left[member], knots[np.minimum(knot - 1, len(knots) - 1)])
    right = np.where(part + 1 == count[member], pieces.right[member], knots[np.minimum(knot, len(knots) - 1)])
    return Pieces(pieces.member[member], left, right)
