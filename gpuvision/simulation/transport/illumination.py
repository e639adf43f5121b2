"""Illumination of a scene by a sheet of laser light: the lit line segments and the power that arrives on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.envelope import Pieces, upper_envelope
from gpuvision.simulation.transport.sheet_cut import Cuts, SheetIndex, bend_of, concatenated_ranges
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Least depth of a lit point below the source of a fan, as a fraction of the source's height. Derived: rays then meet
# H = 0 within a thousand heights, so that x stays finite. Part of the definition of `LightSheet.source`.
_MIN_DEPTH_FRACTION = 1e-3
SHORTEST_LINE = 1e-9
"""Length up to which lit lines are omitted, as a fraction of the largest coordinate: rounding decides the direction of
a shorter line. Derived: coordinates are rounded to some 1e-15, and lines must lie in their surfaces to 1e-5
(`SegmentLimits`); a factor of ten. The omitted light is of the same order."""
# Width of a beam, in parts of the largest coordinate across the light, up to which the line that it lights is omitted.
# Derived: a surface along the light catches beams of some 1e-15 by rounding, and its line moves infinitely fast as the
# sheet moves; a factor of a thousand.
_NARROWEST_BEAM = 1e-12


@dataclass(frozen=True, kw_only=True)
class MergeLimits:
    """Tolerances of `LitLine.merged`.

    Attributes
    ----------
    end_gap : float
        Largest distance between two ends that touch, as a fraction of their coordinates. Derived: some roundings of
        double. Default 1e-14.
    agreement : float
        Largest difference between the normals, and relative difference between the powers, of merged segments. Chosen:
        far above rounding, far below the errors of a scan. Default 1e-9.
    """

    end_gap: float = 1e-14
    agreement: float = 1e-9


_MERGE_LIMITS = MergeLimits()


class LitLine(NamedTuple):
    """Lit line segments, each on one triangle.

    Attributes
    ----------
    ends
        float64 (m, 2, 3): start and end in the scene [m].
    normals
        float64 (m, 3): unit normals on the side that the light comes from.
    triangle
        int64 (m,): index of the triangle in the scene.
    power
        float64 (m,): power that arrives per metre of the line [W/m].
    """

    ends: Float64
    normals: Float64
    triangle: Integers
    power: Float64

    @property
    def lengths(self) -> Float64:
        """Lengths of the segments, (m,) [m]."""
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))

    def total(self) -> float:
        """Return the power that arrives on all segments [W]."""
        return float(self.lengths @ self.power)

    def select(self, which: npt.NDArray[Any] | slice) -> LitLine:
        """Return the segments of an index array, a mask or a slice."""
        return LitLine(self.ends[which], self.normals[which], self.triangle[which], self.power[which])

    def merged(self, kind: npt.ArrayLike, *, limits: MergeLimits = _MERGE_LIMITS) -> LitLine:
        """Return the segments with neighbours merged that touch and lie in one plane, with the same power and kind.

        Parameters
        ----------
        kind
            (m,) integers, such as the materials of the segments' triangles. A merged segment keeps its first triangle.
        limits
            Tolerances. Default: ends touch within 1e-14 of their coordinates, normals and powers agree within 1e-9.
        """
        kind = np.asarray(kind)
        gap = np.abs(self.ends[1:, 0] - self.ends[:-1, 1]).max(axis=1, initial=0.0)
        size = np.abs(self.ends[1:, 0]).max(axis=1, initial=0.0)
        normal_change = np.abs(np.diff(self.normals, axis=0)).max(axis=1, initial=0.0)
        mergeable = (gap <= limits.end_gap * size) & (normal_change <= limits.agreement) & (np.diff(kind) == 0)
        mergeable &= np.abs(np.diff(self.power)) <= limits.agreement * self.power[1:]
        first = np.flatnonzero(np.append(True, ~mergeable)[: len(self.power)])
        last = np.append(first[1:], len(self.power))[: len(first)] - 1
        ends = np.stack([self.ends[first, 0], self.ends[last, 1]], axis=1)
        return LitLine(ends, self.normals[first], self.triangle[first], self.power[first])


@dataclass(frozen=True, kw_only=True)
class LightSheet:
    """Sheet of light of a `StraightTransport`, flat or bent. The light travels against the transport's ``h_axis``.

    Parameters
    ----------
    transport : StraightTransport
        Position of the sheet, and its motion over the scene.
    power : float
        Power per metre of G [W/m], 0 or more; of a fan, at H = 0. Default 1.
    sigma : float
        Standard deviation of the light across the sheet, along the transport [m]; 0 (default) is a thin sheet. A thick
        sheet is modelled as parallel thin sheets side by side.
    source : pair of floats, optional
        (G, H) of the point source of a fan [m], H > 0. The fan lights surfaces that lie below the source by more than a
        thousandth of its H; surfaces nearer to the source do not occlude. None (default): parallel light.
    g_limits : pair of floats, optional
        Range of G [m] with light; of a fan, at H = 0. None (default): no limits.
    profile : sequence of pairs of floats, optional
        Rows (G [m], factor) of the power per metre, G ascending, interpolated linearly and 0 beyond the ends; of a fan,
        at H = 0. None (default): even light.
    uniformity : float
        A segment is split where its power per metre changes by more than this share of the largest on it;
        `LitLine.power` is its mean, so the energy is exact. At least 1e-4, default 0.05.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or lies outside its range.

    Notes
    -----
    In a bent sheet (``transport.bend``) light travels along the lines of constant G of the sheet, or from the source
    along straight lines in (G, H). Lit points lie on their surface and within 50 nm (``sheet_cut.BEND_ERROR``) of the
    sheet. The light reaches a surface along the mean plane: its direction is wrong by the slope of the bend.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008: sheet-of-light range
    imaging.
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

    def illuminate(self, scene: Scene, L: float, offset: float = 0.0) -> LitLine:
        """Return the segments that a thin sheet lights.

        Surfaces are lit on the side that the light comes from. Each ray stops at the first surface that it meets.
        Error: a few roundings of the coordinates. Lines up to `SHORTEST_LINE`, and lines on surfaces along
        the light, are omitted.

        Parameters
        ----------
        scene : Scene
            Surfaces.
        L : float
            Transport [m].
        offset : float
            Distance across the sheet, along the transport, added to L [m]. Default 0.0.
        """
        return self.illuminate_all(scene, [L + offset])[0]

    def illuminate_all(self, scene: Scene, transports: npt.ArrayLike) -> tuple[LitLine, Integers]:
        """Return the segments that thin sheets light at several transports.

        Parameters
        ----------
        scene : Scene
            Surfaces.
        transports : array_like
            (k,): transports [m].

        Returns
        -------
        line, first
            All segments; the segments of a sheet are in the order of its rays; and (k + 1,) indices of each sheet's
            first segment, with the end of the last.
        """
        transports = np.atleast_1d(np.asarray(transports, np.float64))
        cuts = SheetIndex.of(scene, self.transport).cuts(transports)
        cuts, x, height = self._to_light_coordinates(cuts)
        lit = self._clip_to_limits(upper_envelope(cuts.sheet, x, height))
        sheet_ends, arriving, lit = self._split_evenly(lit, cuts, x, height)
        sheet, triangle = cuts.sheet[lit.segment], cuts.triangle[lit.segment]
        ends = self._to_scene(sheet_ends, transports[sheet])
        if self.transport.bend is not None:
            ends = _on_planes(ends, scene.corners[triangle])
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        reach = max(
            float(np.abs(each).max(initial=0.0)) for each in (ends, sheet_ends, self.transport.origin, transports)
        )
        is_wide = lit.right - lit.left > _NARROWEST_BEAM * max(reach, float(np.abs(x).max(initial=0.0)))
        good = is_wide & (length > SHORTEST_LINE * reach) & (arriving > 0.0)
        sheet, triangle, ends = sheet[good], triangle[good], ends[good]
        line = LitLine(ends, self._normals(scene, triangle, ends), triangle, arriving[good] / length[good])
        return line, np.searchsorted(sheet, np.arange(len(transports) + 1))

    def direction_to_light(self, points: npt.ArrayLike) -> Float64:
        """Return unit vectors (..., 3) from points (..., 3) towards the light.

        The light of a fan is emitted by its source, in the sheet that contains the point.
        """
        points = np.asarray(points, np.float64)
        if self.source is None:
            up = np.array(self.transport.h_axis)
            return np.broadcast_to(up / np.linalg.norm(up), points.shape)
        towards = self.source_positions(points) - points
        return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))

    def source_positions(self, points: npt.ArrayLike) -> Float64:
        """Return the positions (..., 3) [m] of the fan's source in the sheets that points (..., 3) lie in.

        Raises
        ------
        ValueError
            The light is parallel.
        """
        if self.source is None:
            raise ValueError("LightSheet.source is None: parallel light has no source; use direction_to_light")
        points, move = np.asarray(points, np.float64), self.transport
        axes = np.array([move.g_axis, move.h_axis, move.direction])
        away = np.array([*self.source, 0.0]) - (points - move.origin) @ np.linalg.inv(axes)
        return np.asarray(points + away[..., :2] @ axes[:2])

    def ray_coordinates(self, sheet_points: npt.ArrayLike) -> Float64:
        """Return the G [m] at which the rays through points (G, H) (..., 2) [m] of the sheet meet H = 0, (...,)."""
        G, H = np.moveaxis(np.asarray(sheet_points, np.float64), -1, 0)
        if self.source is None:
            return np.asarray(G)
        return np.asarray(self.source[0] + self.source[1] * (G - self.source[0]) / (self.source[1] - H))

    # ---- light coordinates: x is constant along a ray, the height grows towards the light ----------------------

    def _to_light_coordinates(self, cuts: Cuts) -> tuple[Cuts, Float64, Float64]:
        """Return the cuts that the light can reach, with x and heights (m, 2) of their ends, from left to right.

        A projective map that keeps lines straight turns a fan into parallel light: x is where a ray meets H = 0, and
        the height is 1 / (depth below the source).
        """
        if self.source is not None:
            cuts = _clip_below(cuts, self.source[1] * (1.0 - _MIN_DEPTH_FRACTION))
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

    def _clip_to_limits(self, pieces: Pieces) -> Pieces:
        """Clip pieces to the light's limits, and split them at the knots of its profile."""
        knots = self._knots
        if knots is None:
            return pieces
        low, high = np.maximum(pieces.left, knots[0]), np.minimum(pieces.right, knots[-1])
        kept = low < high
        return _split_at_knots(Pieces(pieces.segment[kept], low[kept], high[kept]), knots)

    def _split_evenly(self, pieces: Pieces, cuts: Cuts, x: Float64, height: Float64) -> tuple[Float64, Float64, Pieces]:
        """Split pieces until the light on each is even; return their ends (G, H), their power [W], and the pieces."""
        if self.source is not None or self.profile is not None:
            ratio = self._relative_densities(pieces, x, height)
            change = np.abs(ratio[:, 1] - ratio[:, 0]) / np.maximum(ratio.max(axis=1), 1e-300)
            count = np.maximum(np.ceil(change / self.uniformity * (1.0 - 1e-9)), 1.0).astype(np.int64)
            member, part = np.repeat(np.arange(len(count)), count), concatenated_ranges(np.zeros_like(count), count)
            width = (pieces.right - pieces.left)[member] / count[member]
            left = pieces.left[member] + part * width
            right = np.where(part + 1 == count[member], pieces.right[member], pieces.left[member] + (part + 1) * width)
            pieces = Pieces(pieces.segment[member], left, right)
        ends = self._points_on_cuts(pieces, cuts, x, height)
        return ends, self._cumulative_power(pieces.right) - self._cumulative_power(pieces.left), pieces

    def _relative_densities(self, pieces: Pieces, x: Float64, height: Float64) -> Float64:
        """Return the power per metre of line at both ends of pieces, up to a factor per piece, (k, 2)."""
        places = np.stack([pieces.left, pieces.right], axis=1)
        density = np.ones(places.shape)
        if self.profile is not None:
            density = np.interp(places, *np.array(self.profile).T)
        if self.source is not None:
            (a, b), (low, high) = x[pieces.segment].T[..., None], height[pieces.segment].T[..., None]
            density = density * (low + (places - a) / (b - a) * (high - low)) ** 2
        return density

    def _points_on_cuts(self, pieces: Pieces, cuts: Cuts, x: Float64, height: Float64) -> Float64:
        """Return (G, H) of both ends of pieces, (k, 2, 2); exact at the ends of the cuts."""
        (a, b), ends = x[pieces.segment].T, cuts.ends[pieces.segment]
        found = np.empty(ends.shape)
        for n, at in enumerate(pieces[1:]):
            share, rest = (at - a) / (b - a), (b - at) / (b - a)
            if self.source is not None:
                share, rest = share * height[pieces.segment, 1], rest * height[pieces.segment, 0]
                share, rest = share / (share + rest), rest / (share + rest)
            from_start, direction = share < 0.5, ends[:, 1] - ends[:, 0]
            found[:, n] = np.where(
                from_start[:, None], ends[:, 0] + share[:, None] * direction, ends[:, 1] - rest[:, None] * direction
            )
        return found

    def _cumulative_power(self, x: Float64) -> Float64:
        """Return the power of the sheet between a fixed x and the given x [W]."""
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
        """Breakpoints of x, ends included, between which the power is linear; None without limits."""
        if self.g_limits is None and self.profile is None:
            return None
        low, high = self.g_limits or (-math.inf, math.inf)
        if self.profile is None:
            return np.array([low, high])
        places = np.array(self.profile)[:, 0]
        low, high = max(low, float(places[0])), min(high, float(places[-1]))
        return np.concatenate([[low], places[(places > low) & (places < high)], [high]])

    def _to_scene(self, ends: Float64, transports: Float64) -> Float64:
        move = self.transport
        points = np.array(move.origin) + ends @ np.array([move.g_axis, move.h_axis])
        if move.bend is not None:
            distance = bend_of(move.bend, ends[..., 0], ends[..., 1])
            points = points + distance[..., None] * np.cross(move.g_axis, move.h_axis)
        return np.asarray(points + transports[:, None, None] * np.array(move.direction))

    def _normals(self, scene: Scene, triangle: Integers, ends: Float64) -> Float64:
        """Return unit normals on the side of the light."""
        normal = _unit_normals(scene.corners[triangle])
        towards = self.direction_to_light(0.5 * (ends[:, 0] + ends[:, 1]))
        side = np.sum(normal * towards, axis=1, keepdims=True)
        return np.where(side < 0.0, -normal, normal)


def _unit_normals(corners: Float64) -> Float64:
    """Return unit normals (n, 3) of triangles (n, 3, 3)."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # One edge is scaled to 1, so that the cross product of very short edges does not underflow.
    normal = np.cross(one, two / np.abs(two).max(axis=1, keepdims=True))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal)


def _on_planes(ends: Float64, corners: Float64) -> Float64:
    """Return the feet of the perpendiculars from points (n, 2, 3) to the planes of triangles (n, 3, 3).

    The lit points of a bent sheet lie up to ``BEND_ERROR`` beside their triangle, which would occlude them.
    """
    normal = _unit_normals(corners)[:, None]
    beside = np.sum((ends - corners[:, :1]) * normal, axis=-1, keepdims=True)
    return np.asarray(ends - beside * normal)


def _clip_below(cuts: Cuts, highest: float) -> Cuts:
    """Return the parts of cuts below a height."""
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


def _split_at_knots(pieces: Pieces, knots: Float64) -> Pieces:
    """Split pieces at ascending places."""
    first = np.searchsorted(knots, pieces.left, side="right")
    count = np.maximum(np.searchsorted(knots, pieces.right, side="left") - first, 0) + 1
    member, part = np.repeat(np.arange(len(count)), count), concatenated_ranges(np.zeros_like(count), count)
    knot = first[member] + part
    left = np.where(part == 0, pieces.left[member], knots[np.minimum(knot - 1, len(knots) - 1)])
    right = np.where(part + 1 == count[member], pieces.right[member], knots[np.minimum(knot, len(knots) - 1)])
    return Pieces(pieces.segment[member], left, right)
