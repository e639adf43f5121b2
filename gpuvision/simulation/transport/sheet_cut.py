"""A sheet of light through the triangles of a scene: where it cuts them, at any transport.

A point of the scene is ``origin + G g_axis + H h_axis + L direction``: in these coordinates the sheet at a transport L
is a plane of constant L, and what it cuts are segments in (G, H).
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

from gpuvision.ranging.range_image import StraightTransport
from gpuvision.simulation.scene.scene import Scene

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Triangles as long as 2^-n of the longest one are sought together; the shortest with all that are shorter.
_LEVELS = 24
# Edges that lean out of a sheet by no more lie in it; a surface that turns by less than 0.2 rad does not end.
_PARALLEL, _SMOOTH = 1e-9, math.cos(0.2)
_known: WeakKeyDictionary[Scene, dict[tuple[object, ...], SheetIndex]] = WeakKeyDictionary()


class Cuts(NamedTuple):
    """Where sheets cut triangles.

    Attributes
    ----------
    sheet
        (m,): which of the sheets.
    triangle
        (m,): its number in the scene.
    ends
        (m, 2, 2): G and H of both ends [m]. Two triangles that share an edge share the point on it to the last bit.
    """

    sheet: Integers
    triangle: Integers
    ends: Float64


@dataclass(frozen=True, eq=False)
class SheetIndex:
    """The triangles of a scene, sorted so that those are found which a sheet cuts; compared by identity.

    A triangle of which a corner lies in the sheet is cut as if the sheet stood just before it; one that lies in the
    sheet altogether is not cut.

    Attributes
    ----------
    triangle
        (n,): numbers in the scene, those of one length along the transport together, each such level by its start.
    corners
        (n, 3, 3): G, H, L of the corners.
    start
        (n,): the least L.
    levels
        (levels + 1,): where each level begins.
    length
        (levels,): how long the triangles of a level are along the transport at most.
    material
        (n,): of the triangles.
    """

    triangle: Integers
    corners: Float64
    start: Float64
    levels: Integers
    length: Float64
    material: npt.NDArray[np.int32]

    @classmethod
    def of(cls, scene: Scene, transport: StraightTransport) -> SheetIndex:
        """Return the index of a scene, built at the first use for every transport."""
        mine = _known.setdefault(scene, {})
        key = (transport.origin, transport.g_axis, transport.h_axis, transport.direction)
        if key not in mine:
            mine[key] = cls._built(scene, transport)
        return mine[key]

    @classmethod
    def _built(cls, scene: Scene, transport: StraightTransport) -> SheetIndex:
        good = np.ones(len(scene.corners), bool)
        good[[*scene.defects.not_finite, *scene.defects.degenerate]] = False
        axes = np.linalg.inv(np.array([transport.g_axis, transport.h_axis, transport.direction]))
        x, y, z = np.moveaxis(np.where(good[:, None, None], scene.corners, 0.0) - transport.origin, -1, 0)
        # Not as a product of matrices: what a corner becomes must not hang on where it stands in the array.
        corners = np.stack([x * a + y * b + z * c for a, b, c in axes.T], axis=-1)
        start, end = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
        length = end - start
        chosen = np.flatnonzero(good & (length > 0.0))
        longest = float(length[chosen].max(initial=0.0)) or 1.0
        level = np.clip(-np.floor(np.log2(length[chosen] / longest)), 0, _LEVELS - 1).astype(np.int64)
        order = np.lexsort((start[chosen], level))
        chosen, level = chosen[order], level[order]
        bounds = np.searchsorted(level, np.arange(_LEVELS + 1))
        longest_of = [float(length[chosen[a:b]].max(initial=0.0)) for a, b in itertools.pairwise(bounds)]
        assert scene.material is not None  # set by Scene itself
        material = scene.material[chosen]
        return cls(chosen, corners[chosen], start[chosen], bounds, np.array(longest_of), material)

    @functools.cached_property
    def steps(self) -> tuple[Float64, Float64]:
        """Transports at which what a sheet lights changes at once, ascending, and how long the edges there are [m].

        Edges that lie in a sheet from end to end, where a surface ends, turns sharply, or changes its material.
        """
        edges, rows = self._in_a_sheet()
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
        smooth = (uses == 2) & (np.sum(normal[0] * normal[1], axis=-1) > _SMOOTH)
        sharp = edges[first[~smooth | (self.material[one] != self.material[two])]]
        places, lengths = sharp[:, 0, 2], np.linalg.norm(sharp[:, 1] - sharp[:, 0], axis=1)
        order = np.argsort(places, kind="stable")
        places, lengths = places[order], lengths[order]
        apart = np.diff(places, prepend=-np.inf) > _PARALLEL * np.abs(self.corners[..., 2]).max(initial=0.0)
        begin = np.flatnonzero(apart)
        return places[begin], np.add.reduceat(lengths, begin) if len(begin) else lengths

    def _in_a_sheet(self) -> tuple[Float64, Integers]:
        """Return edges that lie in a sheet, (k, 2, 3), each as often as it is used and always alike, and the rows."""
        edges, rows = [], []
        for n in range(3):
            both = self.corners[:, [n, (n + 1) % 3]]
            way = np.abs(both[:, 1] - both[:, 0])
            found = np.flatnonzero(way[:, 2] <= _PARALLEL * np.maximum(way[:, 0], way[:, 1]))
            edges.append(both[found])
            rows.append(found)
        whole = np.concatenate(edges)
        way = whole[:, 1, :2] - whole[:, 0, :2]
        backward = (way[:, 0] < 0.0) | ((way[:, 0] == 0.0) & (way[:, 1] < 0.0))
        return np.where(backward[:, None, None], whole[:, ::-1], whole), np.concatenate(rows)

    def cuts(self, places: npt.ArrayLike) -> Cuts:
        """Return what the sheets at some transports (k,) [m] cut, in the order of the sheets."""
        places = np.atleast_1d(np.asarray(places, np.float64))
        rows, sheet = self._near(places)
        corners, at = self.corners[rows], places[sheet]
        below = corners[..., 2] < at[:, None]
        count = below.sum(axis=1)
        cut = (count == 1) | (count == 2)
        rows, sheet, corners, at, below, count = (each[cut] for each in (rows, sheet, corners, at, below, count))
        # One corner stands alone on its side; the sheet cuts the two edges from it.
        alone_below = count == 1
        alone = np.where(alone_below, np.argmax(below, axis=1), np.argmin(below, axis=1))
        each = np.arange(len(rows))
        tip = corners[each, alone]
        ends = np.empty((len(rows), 2, 2))
        for n in (0, 1):
            other = corners[each, (alone + 1 + n) % 3]
            low, high = np.where(alone_below[:, None], tip, other), np.where(alone_below[:, None], other, tip)
            ends[:, n] = _between(low, high, at)
        return Cuts(sheet, self.triangle[rows], ends)

    def _near(self, places: Float64) -> tuple[Integers, Integers]:
        """Return rows that may be cut, and by which sheets."""
        first, last = [], []
        for n, length in enumerate(self.length):
            start = self.start[self.levels[n] : self.levels[n + 1]]
            # Beyond rounding of the difference.
            reach = length + 4.0 * np.finfo(np.float64).eps * (np.abs(places) + length)
            first.append(self.levels[n] + np.searchsorted(start, places - reach, side="left"))
            last.append(self.levels[n] + np.searchsorted(start, places, side="left"))
        begin, count = np.array(first).T.ravel(), (np.array(last) - np.array(first)).T.ravel()
        sheet = np.repeat(np.arange(len(places)), _LEVELS)
        return ranges(begin, count), np.repeat(sheet, count)


def ranges(begin: Integers, count: Integers) -> Integers:
    """Return begin[0], begin[0] + 1, ... (count[0] numbers), begin[1], ..."""
    before = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(begin - before, count))


def _between(low: Float64, high: Float64, at: Float64) -> Float64:
    """Return G and H where L is ``at``, between corners of which it lies not below the first; exact in either."""
    whole = high[:, 2] - low[:, 2]
    up, down = (at - low[:, 2]) / whole, (high[:, 2] - at) / whole
    way = high[:, :2] - low[:, :2]
    return np.where((up < 0.5)[:, None], low[:, :2] + up[:, None] * way, high[:, :2] - down[:, None] * way)
