"""LightTree of lit segments: a binary tree, and one segment that stands for each cluster, to a proven error.

The light of a cluster at a receiver is a sum over its pieces of n_r . T(P) n_e, T = d d' / |d|^4 of the vector d from a
piece at P. In the plane of d and of a step s, d d' / |d|^4 = (1 / |z|^2 + R(1 / z*^2)) / 2, R a reflection, with the
complex number z = |d| - |s| w, |w| = 1: so the k-th term of its series in s has the norm (k + 1) |s|^k / |d|^(k + 2) at
most. A cluster is replaced by one segment of the same power times normal, the same first moment, and the largest part
of its second moment; what is left of the series is the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Of a row of kernels/light_clustering/light_clustering.cl.
COLUMNS = 24
# A normal turned by one is as far away as half of what is lit is long.
_NORMALS_REACH = 0.5
# A cluster of points becomes a segment as long as this part of its reach.
_SHORTEST = 1e-3
_MOST_LEAN = 0.1


@dataclass(frozen=True, eq=False)
class LightTree:
    """A tree over lit segments in the order of a heap: the children of node i are 2 i and 2 i + 1; 1 is the root.

    Attributes
    ----------
    order
        int64 (m,): the segments as they lie in the tree.
    spans
        int32 (nodes, 2): the first place in `order`, and how many; none where a node is empty.
    rows
        float64 (nodes, 24): what kernels/light_clustering/light_clustering.cl knows of each; bounds of errors are by a
        watt.
    aggregates
        float64 (nodes, 10): the segment that stands for each: start, end, normal, exitance.
    power
        W, all of it.
    """

    order: Integers
    spans: npt.NDArray[np.int32]
    rows: Reals
    aggregates: Reals
    power: float

    @classmethod
    def build(cls, segments: npt.NDArray[Any]) -> LightTree:
        """Build the tree over segments (m, 10): start, end, normal, exitance (W/m); those without light count little.

        Halved by number along the widest of six axes, three of the place and three of the normal.

        Raises
        ------
        ValueError
            The segments have another shape.
        """
        table = np.asarray(segments, np.float64)
        if table.ndim != 2 or table.shape[1] != 10:
            raise ValueError(f"LightTree.build takes segments (m, 10), got shape {table.shape}")
        lit = _Lit(table)
        levels = max(len(table) - 1, 0).bit_length()
        order = _sorted_by_place(lit, levels)
        spans = np.zeros((2 << levels, 2), np.int64)
        for level in range(levels + 1):
            edges = (np.arange((1 << level) + 1) * len(table)) >> level
            spans[1 << level : 2 << level] = np.column_stack([edges[:-1], np.diff(edges)])
        rows, aggregates = np.zeros((len(spans), COLUMNS)), np.zeros((len(spans), 10))
        full = np.flatnonzero(spans[:, 1])
        if len(full):
            _describe(lit, order, full, spans, rows, aggregates)
        return cls(order, spans.astype(np.int32), rows, aggregates, float(lit.power.sum()))


class _Lit:
    """The segments' numbers that the sums take."""

    def __init__(self, table: Reals) -> None:
        self.start, self.end = table[:, :3], table[:, 3:6]
        self.half = 0.5 * (self.end - self.start)
        self.middle = self.start + self.half
        size = np.linalg.norm(table[:, 6:9], axis=1, keepdims=True)
        self.normal = table[:, 6:9] / np.where(size > 0.0, size, 1.0)
        self.power = np.maximum(table[:, 9], 0.0) * 2.0 * np.linalg.norm(self.half, axis=1)


def _sorted_by_place(lit: _Lit, levels: int) -> Integers:
    count = len(lit.power)
    order: Integers = np.arange(count)
    if not count:
        return order
    reach = float(np.ptp(lit.middle, axis=0).max())
    keys = np.column_stack([lit.middle, lit.normal * (_NORMALS_REACH * reach)])
    for level in range(levels):
        edges = (np.arange((1 << level) + 1) * count) >> level
        sizes = np.diff(edges)
        starts, sizes = edges[:-1][sizes > 0], sizes[sizes > 0]
        owner = np.repeat(np.arange(len(starts)), sizes)
        here = keys[order]
        widest = np.argmax(np.maximum.reduceat(here, starts) - np.minimum.reduceat(here, starts), axis=1)
        order = order[np.lexsort((here[np.arange(count), widest[owner]], owner))]
    return order


def _describe(lit: _Lit, order: Integers, full: Integers, spans: Integers, rows: Reals, aggregates: Reals) -> None:
    """Fill the rows and the aggregates of the nodes that hold segments, all levels at once."""
    first, size = spans[full].T
    begin = np.cumsum(size) - size
    owner = np.repeat(np.arange(len(full)), size)
    members = order[np.arange(len(owner)) + np.repeat(first - begin, size)]

    def sums(values: Reals) -> Reals:
        return np.asarray(np.add.reduceat(values, begin))

    power, normal, middle, half = (each[members] for each in (lit.power, lit.normal, lit.middle, lit.half))
    total = sums(power)
    # Where nothing shines any weights do.
    weight = np.where(total[owner] > 0.0, power, 1.0)
    mass = sums(weight)
    facing, effective = _facing(sums(weight[:, None] * normal), normal[begin])
    face = facing[owner]
    cosine = _dot(normal, face)
    # Left without a centre of its own where normals cancel; it has no aggregate there.
    lean = np.minimum.reduceat(cosine, begin)
    parallel = np.where(lean[owner] > _MOST_LEAN, weight * cosine, weight)
    centre = sums(parallel[:, None] * middle) / sums(parallel)[:, None]
    at = middle - centre[owner]
    aside = normal - cosine[:, None] * face
    square, fourth = _powers(at, half)
    tilt = np.sqrt(_dot(aside, aside))
    skew = sums((weight[:, None] * aside)[:, :, None] * at[:, None, :])
    spread = sums(parallel[:, None, None] * (at[:, :, None] * at[:, None, :] + half[:, :, None] * half[:, None, :] / 3))
    one, other = at - half, at + half
    reach = np.sqrt(np.maximum.reduceat(np.maximum(_dot(one, one), _dot(other, other)), begin))
    arm, rest = _principal(spread, facing, effective, reach)
    arm_size = np.linalg.norm(arm, axis=1)
    height = -_dot(normal, at)
    slab = np.maximum.reduceat(np.maximum(np.abs(_dot(one, face)), np.abs(_dot(other, face))), begin)
    low = np.minimum.reduceat(np.minimum(one, other), begin)
    high = np.maximum.reduceat(np.maximum(one, other), begin)
    turn = normal - face
    scale, each = np.where(total > 0.0, total / mass, 0.0), np.where(total > 0.0, 1.0 / mass, 0.0)
    table = np.column_stack(
        [
            centre,
            centre + np.minimum(low, -np.abs(arm)),
            centre + np.maximum(high, np.abs(arm)),
            facing,
            np.maximum(reach, arm_size),
            np.sqrt(np.maximum.reduceat(_dot(turn, turn), begin)),
            np.maximum.reduceat(height, begin),
            np.minimum.reduceat(height, begin),
            slab,
            total,
            2.0 * np.sqrt(3.0) * np.linalg.norm(skew, axis=(1, 2)) * each,
            3.0 * (rest + sums(weight * tilt * square)) * each,
            sums(weight * np.sqrt(square * fourth)) * each,
            0.2 * effective * arm_size**4 * each,
            np.where(lean > _MOST_LEAN, arm_size, np.inf),
            2.0 * np.linalg.norm(half, axis=1)[begin],
        ]
    )
    rows[full] = table
    exitance = effective * scale / np.where(arm_size > 0.0, 2.0 * arm_size, 1.0)
    aggregates[full] = np.column_stack([centre - arm, centre + arm, facing, np.where(arm_size > 0.0, exitance, 0.0)])


def _dot(a: Reals, b: Reals) -> Reals:
    """Return the products of rows: several times as fast as a sum over so short an axis."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _facing(summed: Reals, first: Reals) -> tuple[Reals, Reals]:
    """Return the direction of summed normals, and their length; the first normal's direction where they cancel."""
    length = np.linalg.norm(summed, axis=1)
    facing = summed / np.where(length > 0.0, length, 1.0)[:, None]
    facing[length == 0.0] = first[length == 0.0]
    return facing, length


def _powers(at: Reals, half: Reals) -> tuple[Reals, Reals]:
    """Return the means over segments, from at - half to at + half, of the distance to the power of 2 and of 4."""
    far, across, along = (_dot(a, b) for a, b in ((at, at), (half, half), (at, half)))
    return far + across / 3.0, far * far + (4.0 * along * along + 2.0 * far * across) / 3.0 + across * across / 5.0


def _principal(spread: Reals, facing: Reals, mass: Reals, reach: Reals) -> tuple[Reals, Reals]:
    """Return the half of the segment whose second moment comes nearest, in the plane, and what it leaves (nuclear)."""
    sign = np.copysign(1.0, facing[:, 2])
    a = -1.0 / (sign + facing[:, 2])
    b = facing[:, 0] * facing[:, 1] * a
    one = np.column_stack([1.0 + sign * facing[:, 0] ** 2 * a, sign * b, -sign * facing[:, 0]])
    two = np.column_stack([b, sign + facing[:, 1] ** 2 * a, -facing[:, 1]])
    by_one, by_two, by_normal = (np.einsum("nij,nj->ni", spread, v) for v in (one, two, facing))
    s11, s12, s22 = (_dot(u, v) for u, v in ((one, by_one), (one, by_two), (two, by_two)))
    angle = 0.5 * np.arctan2(2.0 * s12, s11 - s22)
    axis = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * two
    gap = np.hypot(s11 - s22, 2.0 * s12)
    large, small = 0.5 * (s11 + s22 + gap), np.maximum(0.5 * (s11 + s22 - gap), 0.0)
    up = _dot(facing, by_normal)
    lean = np.hypot(_dot(one, by_normal), _dot(two, by_normal))
    length = np.sqrt(3.0 * large / np.where(mass > 0.0, mass, np.inf))
    length = np.maximum(length, _SHORTEST * reach)
    rest = small + np.abs(up) + 2.0 * lean + np.abs(mass * length**2 / 3.0 - large)
    return axis * length[:, None], rest
