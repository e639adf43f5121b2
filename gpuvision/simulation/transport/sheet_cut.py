"""Cuts of a sheet of light through the triangles of a scene, at any transport.

A point of the scene is ``origin + G g_axis + H h_axis + L direction``. In these coordinates the sheet at a transport L
is the plane of constant L, and a cut through a triangle is a segment in (G, H).

A bent sheet is flat in other coordinates: ``origin + G g_axis + H h_axis + d(G, H) normal + L direction``. In these
coordinates a triangle is curved; it is divided until a flat one deviates from it by less than ``BEND_ERROR``.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.sheet import BentSheet
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.triangle_division import longest_edges, subdivide_to

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Triangles are sorted into levels of lengths along the transport, 2^-n of the longest; the last level holds all shorter
# ones. A search then looks only a short way back in each level.
_MAX_LEVELS = 24
# `parallel_edges`. Largest slope of an edge that lies in a sheet, and, in parts of the scene's length, largest distance
# of edges at one transport. Chosen: far above rounding, far below a step of the transport.
_MAX_EDGE_SLOPE = 1e-9
# Cosine of the angle between two triangles below which their common edge is sharp. Chosen: 0.2 rad is more than between
# the facets of a finely meshed curved surface. Only places where the integral over the sheet is divided depend on it.
_MIN_SMOOTH_COSINE = math.cos(0.2)
BEND_ERROR = 5e-8
"""Largest distance of the simulated light of a bent sheet from the sheet [m]. Chosen: far below noise."""
# A quadratic surface with a second derivative c deviates from a triangle through three of its points, with edges of at
# most s, by up to c s^2 / 6 (the triangle fits into a circle of radius s / sqrt(3)), and a curve in it from a chord by
# up to c s^2 / 8; both together have this factor.
_DEVIATION = 1.0 / 6.0 + 1.0 / 8.0
MAX_PIECES = 1 << 20
"""Largest value of the lower bound of the number of triangles into which a bent sheet divides a scene. The division has
up to 3.5 times as many. Chosen: bounds the memory, about 1.5 GB."""
# Fixed-point steps for the coordinates of a bent sheet; the error of the start value is multiplied each time by the
# slope of the sheet times the component of its normal across the transport. Chosen: enough for a factor of 0.8.
_BEND_STEPS = 160
# Largest last step, in parts of the largest coordinate. Chosen: rounding.
_BEND_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)
_INDEX_CACHE: WeakKeyDictionary[Scene, dict[tuple[object, ...], SheetIndex]] = WeakKeyDictionary()


class Cuts(NamedTuple):
    """Segments in which sheets cut triangles.

    Attributes
    ----------
    sheet
        int64 (m,): index of the sheet.
    triangle
        int64 (m,): index of the triangle in the scene.
    ends
        float64 (m, 2, 2): (G, H) of both ends [m]. Two triangles that share an edge get bit-equal points on it.
    """

    sheet: Integers
    triangle: Integers
    ends: Float64


@dataclass(frozen=True, eq=False)
class SheetIndex:
    """Triangles of a scene in the transport's coordinates, sorted so that a sheet's cuts are found quickly.

    A triangle with a corner in the sheet is cut as if the sheet were just before the corner. A triangle that lies in
    the sheet is not cut. Instances are compared by identity. For a bent sheet each triangle is a part of a triangle of
    the scene.

    Attributes
    ----------
    triangle
        int64 (n,): indices in the scene, level by level, in a level by `start`.
    corners
        float64 (n, 3, 3): (G, H, L) of the corners [m].
    start
        float64 (n,): least L of each triangle [m].
    levels
        int64 (levels + 1,): index of the first triangle of each level.
    length
        float64 (levels,): largest length along the transport of a level's triangles [m].
    material
        int32 (n,): material of each triangle.
    """

    triangle: Integers
    corners: Float64
    start: Float64
    levels: Integers
    length: Float64
    material: npt.NDArray[np.int32]

    @classmethod
    def of(cls, scene: Scene, transport: StraightTransport) -> SheetIndex:
        """Return the index of a scene for a transport. It is built at the first use and kept as long as the scene.

        Raises
        ------
        ValueError
            The sheet is bent too much for the scene: the division has more than `MAX_PIECES` triangles, or the sheet is
            nearly parallel to the transport.
        """
        mine = _INDEX_CACHE.setdefault(scene, {})
        key = (transport.origin, transport.g_axis, transport.h_axis, transport.direction, transport.bend)
        if key not in mine:
            mine[key] = cls._build(scene, transport)
        return mine[key]

    @classmethod
    def _build(cls, scene: Scene, transport: StraightTransport) -> SheetIndex:
        good = np.ones(len(scene.corners), bool)
        good[scene.defects.without_area] = False
        triangle, corners = np.arange(len(good)), np.where(good[:, None, None], scene.corners, 0.0)
        if transport.bend is not None:
            longest_edge = math.sqrt(BEND_ERROR / (_DEVIATION * max(_curvature(transport.bend), 1e-300)))
            _check_pieces(corners, longest_edge)
            corners, triangle = subdivide_to(corners, triangle, longest_edge)
            good = good[triangle]
        corners = _sheet_coordinates(corners, transport)
        start, end = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
        length = end - start
        chosen = np.flatnonzero(good & (length > 0.0))
        longest = float(length[chosen].max(initial=0.0)) or 1.0
        level = np.clip(-np.floor(np.log2(length[chosen] / longest)), 0, _MAX_LEVELS - 1).astype(np.int64)
        order = np.lexsort((start[chosen], level))
        chosen, level = chosen[order], level[order]
        bounds = np.searchsorted(level, np.arange(_MAX_LEVELS + 1))
        longest_of = [float(length[chosen[a:b]].max(initial=0.0)) for a, b in itertools.pairwise(bounds)]
        assert scene.material is not None  # set by Scene itself
        material = scene.material[triangle[chosen]]
        return cls(triangle[chosen], corners[chosen], start[chosen], bounds, np.array(longest_of), material)

    @functools.cached_property
    def parallel_edges(self) -> tuple[Float64, Float64]:
        """Transports, ascending, and lengths [m] of edges in a sheet at which the lit surface changes at once.

        An edge counts where a surface ends, turns by more than 0.2 rad, or changes its material. Edges at one transport
        are added up.
        """
        edges, rows = self._edges_in_sheets()
        order = np.lexsort(edges.reshape(-1, 6).T)
        edges, rows = edges[order], rows[order]
        new = np.ones(len(edges), bool)
        new[1:] = (edges[1:] != edges[:-1]).any(axis=(1, 2))
        first = np.flatnonzero(new)
        uses = np.diff(first, append=len(edges))
        one, two = rows[first], rows[first + (uses > 1)]
        corners = self.corners[np.stack([one, two])]
        normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        smooth = (uses == 2) & (np.sum(normal[0] * normal[1], axis=-1) > _MIN_SMOOTH_COSINE)
        sharp = edges[first[~smooth | (self.material[one] != self.material[two])]]
        places, lengths = sharp[:, 0, 2], np.linalg.norm(sharp[:, 1] - sharp[:, 0], axis=1)
        order = np.argsort(places, kind="stable")
        places, lengths = places[order], lengths[order]
        is_new_place = np.diff(places, prepend=-np.inf) > _MAX_EDGE_SLOPE * np.abs(self.corners[..., 2]).max(
            initial=0.0
        )
        begin = np.flatnonzero(is_new_place)
        return places[begin], np.add.reduceat(lengths, begin) if len(begin) else lengths

    def _edges_in_sheets(self) -> tuple[Float64, Integers]:
        """Return edges that lie in a sheet, (k, 2, 3), and their triangles, (k,).

        An edge of two triangles is listed twice, both times in the same direction.
        """
        edges, rows = [], []
        for n in range(3):
            both = self.corners[:, [n, (n + 1) % 3]]
            span = np.abs(both[:, 1] - both[:, 0])
            found = np.flatnonzero(span[:, 2] <= _MAX_EDGE_SLOPE * np.maximum(span[:, 0], span[:, 1]))
            edges.append(both[found])
            rows.append(found)
        all_edges = np.concatenate(edges)
        span = all_edges[:, 1, :2] - all_edges[:, 0, :2]
        backward = (span[:, 0] < 0.0) | ((span[:, 0] == 0.0) & (span[:, 1] < 0.0))
        return np.where(backward[:, None, None], all_edges[:, ::-1], all_edges), np.concatenate(rows)

    def cuts(self, transports: npt.ArrayLike) -> Cuts:
        """Return the cuts of the sheets at transports (k,) [m], sheet by sheet."""
        transports = np.atleast_1d(np.asarray(transports, np.float64))
        rows, sheet = self._candidates(transports)
        corners, at = self.corners[rows], transports[sheet]
        below = corners[..., 2] < at[:, None]
        count = below.sum(axis=1)
        cut = (count == 1) | (count == 2)
        rows, sheet, corners, at, below, count = (each[cut] for each in (rows, sheet, corners, at, below, count))
        # One corner is alone on its side of the sheet; the sheet cuts the two edges that meet in it.
        alone_below = count == 1
        alone = np.where(alone_below, np.argmax(below, axis=1), np.argmin(below, axis=1))
        each = np.arange(len(rows))
        tip = corners[each, alone]
        ends = np.empty((len(rows), 2, 2))
        for n in (0, 1):
            other = corners[each, (alone + 1 + n) % 3]
            low, high = np.where(alone_below[:, None], tip, other), np.where(alone_below[:, None], other, tip)
            ends[:, n] = _interpolate(low, high, at)
        return Cuts(sheet, self.triangle[rows], ends)

    def _candidates(self, transports: Float64) -> tuple[Integers, Integers]:
        """Return indices of triangles that sheets may cut, and the index of the sheet for each."""
        first, last = [], []
        for n, length in enumerate(self.length):
            start = self.start[self.levels[n] : self.levels[n + 1]]
            # A margin for the rounding of the difference.
            reach = length + 4.0 * np.finfo(np.float64).eps * (np.abs(transports) + length)
            first.append(self.levels[n] + np.searchsorted(start, transports - reach, side="left"))
            last.append(self.levels[n] + np.searchsorted(start, transports, side="left"))
        begin, count = np.array(first).T.ravel(), (np.array(last) - np.array(first)).T.ravel()
        sheet = np.repeat(np.arange(len(transports)), _MAX_LEVELS)
        return concatenated_ranges(begin, count), np.repeat(sheet, count)


def bend_of(sheet: BentSheet, G: Float64, H: Float64) -> Float64:
    """Return the distance of a bent sheet from its mean plane at (G, H) [m], along the normal ``g_axis x h_axis``."""
    gg, gh, hh = sheet.terms
    return np.asarray(gg * G * G + gh * G * H + hh * H * H)


def _curvature(sheet: BentSheet) -> float:
    """Return the largest second derivative of the sheet's surface [1/m]."""
    gg, gh, hh = sheet.terms
    return abs(gg + hh) + math.hypot(gg - hh, gh)


def _check_pieces(corners: Float64, longest_edge: float) -> None:
    """Refuse triangles (n, 3, 3), all finite, that have to be divided into more than `MAX_PIECES`."""
    edges = np.roll(corners, -1, axis=1) - corners
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # No piece is larger than an equilateral triangle.
    least = np.maximum(area / (0.25 * math.sqrt(3.0) * longest_edge**2), longest_edges(corners)[0] / longest_edge)
    if least.sum() > MAX_PIECES:
        raise ValueError(
            f"the bent sheet of light divides the part into at least {least.sum():.3g} triangles, expected at most "
            f"{MAX_PIECES}; their edges are at most {1e3 * longest_edge:.3g} mm. Simulate a smaller part"
        )


def _sheet_coordinates(points: Float64, transport: StraightTransport) -> Float64:
    """Return the coordinates (G, H, L) of points (..., 3) of the scene, in which the sheet is a plane of constant L."""
    axes = np.linalg.inv(np.array([transport.g_axis, transport.h_axis, transport.direction]))
    x, y, z = np.moveaxis(points - transport.origin, -1, 0)
    # Not a matrix product: its rounding can depend on the position in the array, and shared corners must stay equal.
    G, H, L = (x * a + y * b + z * c for a, b, c in axes.T)
    if transport.bend is not None:
        # The normal has components along all three axes: G and H of the sheet follow by a fixed point.
        normal = np.cross(transport.g_axis, transport.h_axis) @ axes
        G, H = _bent_place(G, H, transport.bend, normal)
        L = L - normal[2] * bend_of(transport.bend, G, H)
    return np.stack([G, H, L], axis=-1)


def _bent_place(flat_g: Float64, flat_h: Float64, sheet: BentSheet, normal: Float64) -> tuple[Float64, Float64]:
    """Return (G, H) for which ``(G, H) + normal[:2] d(G, H)`` are given places; all take the same number of steps."""
    G, H = flat_g, flat_h
    rounding = _BEND_ROUNDING * max(np.abs(flat_g).max(initial=0.0), np.abs(flat_h).max(initial=0.0))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_BEND_STEPS):
            distance = bend_of(sheet, G, H)
            before = G, H
            G, H = flat_g - normal[0] * distance, flat_h - normal[1] * distance
            if max(np.abs(G - before[0]).max(initial=0.0), np.abs(H - before[1]).max(initial=0.0)) <= rounding:
                return G, H
    raise ValueError(
        "the bent sheet of light is nearly parallel to the transport on a part of the scene; expected [transport] "
        "direction farther from the sheet, or a smaller part"
    )


def concatenated_ranges(begin: Integers, count: Integers) -> Integers:
    """Return the integers ``begin[0], begin[0] + 1, ...`` (``count[0]`` of them), then from ``begin[1]``, and so on."""
    before = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(begin - before, count))


def _interpolate(low: Float64, high: Float64, at: Float64) -> Float64:
    """Return (G, H) where L is ``at``, between corners ``low`` and ``high``; exact at either corner."""
    height = high[:, 2] - low[:, 2]
    up, down = (at - low[:, 2]) / height, (high[:, 2] - at) / height
    direction = high[:, :2] - low[:, :2]
    return np.where((up < 0.5)[:, None], low[:, :2] + up[:, None] * direction, high[:, :2] - down[:, None] * direction)
