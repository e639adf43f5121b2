"""Light tree (lightcuts): a binary tree of lit segments with a representative segment and an error bound per node.

The irradiance of a receiver by a cluster is proportional to a sum over the points P of the cluster's segments of
n_r . T(P) n_e, with the receiver's normal n_r, the segment's normal n_e, and T = d d' / |d|^4 of the vector d from P to
the receiver. T is expanded in the step s from the cluster's centre to P. In the plane of d and s,
d d' / |d|^4 = (1 / |z|^2 + R(1 / z*^2)) / 2 with a reflection R and the complex number z = |d| - |s| w, |w| = 1. So the
k-th term of the series in s has a norm of at most (k + 1) |s|^k / |d|^(k + 2).

The representative segment has the cluster's sum of power times normal, its first moment, and the largest part of its
second moment. The error bound is the sum of the norms of the rest: first moments of the normals' parts aside of the
mean normal, the rest of the second moment, and the remainders of third and fourth order. It holds where all of the
cluster faces all receivers without occlusion; the traversal checks both conditions.

References: B. Walter et al., *Lightcuts: a scalable approach to illumination*, ACM Transactions on Graphics 24(3),
2005. Their representative light is one light of the cluster, with a bound of zeroth order; this one matches moments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Numbers of a node in the order of its row; kernels/light_clustering/light_bounds.h reads them by name.
NODE_SIZES = {
    "centre": 3,
    "low": 3,
    "high": 3,
    "normal": 3,
    "radius": 1,
    "spread": 1,
    "max_height": 1,
    "min_height": 1,
    "slab": 1,
    "power": 1,
    "first_order": 1,
    "second_order": 1,
    "third_moment": 1,
    "fourth_moment": 1,
    "arm": 1,
    "length": 1,
}
COLUMNS = sum(NODE_SIZES.values())
# Scale of the normals' axes in the choice of the widest axis, in extents of the segments' midpoints (speed only).
_NORMAL_SCALE = 0.5
# Half length of a representative segment, in radii of the cluster, where all its points coincide: not 0, so that
# its exitance stays finite (chosen; the error bound of the node includes it).
_MIN_LENGTH = 1e-3
# Least cosine between a segment's normal and the mean normal at which a cluster has a representative. Chosen (speed
# only): a cluster without a representative is opened.
_MIN_COSINE = 0.1


@dataclass(frozen=True, eq=False)
class LightTree:
    """Binary tree over lit segments, stored as a heap: node 1 is the root, nodes 2 i and 2 i + 1 are children of i.

    Attributes
    ----------
    order
        int64 (m,): indices of the segments in the order of the leaves.
    spans
        int32 (nodes, 2): position in `order` of the node's first segment, and the number of its segments; 0 for an
        empty node.
    rows
        float64 (nodes, 24): extent, normals, power and error coefficients of each node, in the columns of
        kernels/light_clustering/light_bounds.h; errors are per watt.
    representatives
        float64 (nodes, 10): representative segment of each node: start, end [m], normal, exitance [W/m].
    power
        Power of all segments [W].
    """

    order: Integers
    spans: npt.NDArray[np.int32]
    rows: Reals
    representatives: Reals
    power: float

    @classmethod
    def build(cls, segments: npt.NDArray[Any]) -> LightTree:
        """Build the tree over segments.

        Each node is halved by number along the widest of six axes: three of the midpoint, three of the normal.

        Parameters
        ----------
        segments
            (m, 10): start, end [m], normal, exitance [W/m]. Segments without power do not move a cluster's centre.

        Raises
        ------
        ValueError
            The segments have another shape.
        """
        table = np.asarray(segments, np.float64)
        if table.ndim != 2 or table.shape[1] != 10:
            raise ValueError(f"LightTree.build takes segments (m, 10), got shape {table.shape}")
        lit = _SegmentTable(table)
        levels = max(len(table) - 1, 0).bit_length()
        order = _build_order(lit, levels)
        spans = np.zeros((2 << levels, 2), np.int64)
        for level in range(levels + 1):
            edges = (np.arange((1 << level) + 1) * len(table)) >> level
            spans[1 << level : 2 << level] = np.column_stack([edges[:-1], np.diff(edges)])
        rows, representatives = np.zeros((len(spans), COLUMNS)), np.zeros((len(spans), 10))
        full = np.flatnonzero(spans[:, 1])
        if len(full):
            _fill_nodes(lit, order, full, spans, rows, representatives)
        return cls(order, spans.astype(np.int32), rows, representatives, float(lit.power.sum()))


class _SegmentTable:
    """Segments as columns: start, end, half the way, midpoint, unit normal (m, 3), and power (m,) [W]."""

    def __init__(self, table: Reals) -> None:
        self.start, self.end = table[:, :3], table[:, 3:6]
        self.half = 0.5 * (self.end - self.start)
        self.middle = self.start + self.half
        size = np.linalg.norm(table[:, 6:9], axis=1, keepdims=True)
        self.normal = table[:, 6:9] / np.where(size > 0.0, size, 1.0)
        self.power = np.maximum(table[:, 9], 0.0) * 2.0 * np.linalg.norm(self.half, axis=1)


def _build_order(lit: _SegmentTable, levels: int) -> Integers:
    count = len(lit.power)
    order: Integers = np.arange(count)
    if not count:
        return order
    reach = float(np.ptp(lit.middle, axis=0).max())
    keys = np.column_stack([lit.middle, lit.normal * (_NORMAL_SCALE * reach)])
    for level in range(levels):
        edges = (np.arange((1 << level) + 1) * count) >> level
        sizes = np.diff(edges)
        starts, sizes = edges[:-1][sizes > 0], sizes[sizes > 0]
        owner = np.repeat(np.arange(len(starts)), sizes)
        level_keys = keys[order]
        widest = np.argmax(np.maximum.reduceat(level_keys, starts) - np.minimum.reduceat(level_keys, starts), axis=1)
        order = order[np.lexsort((level_keys[np.arange(count), widest[owner]], owner))]
    return order


class _Members:
    """Segments of all nodes that hold any, one node after another.

    Attributes
    ----------
    begin, owner
        Index of the first segment of each node, and index of the node of each segment.
    power, normal, middle, half
        Columns of `_SegmentTable`.
    """

    def __init__(self, lit: _SegmentTable, order: Integers, spans: Integers) -> None:
        first, size = spans.T
        self.begin = np.cumsum(size) - size
        self.owner = np.repeat(np.arange(len(spans)), size)
        members = order[np.arange(len(self.owner)) + np.repeat(first - self.begin, size)]
        self.power, self.normal, self.middle, self.half = (
            each[members] for each in (lit.power, lit.normal, lit.middle, lit.half)
        )

    def sums(self, values: Reals) -> Reals:
        """Return the sum over each node."""
        return np.asarray(np.add.reduceat(values, self.begin))

    def largest(self, values: Reals) -> Reals:
        """Return the maximum over each node."""
        return np.asarray(np.maximum.reduceat(values, self.begin))

    def smallest(self, values: Reals) -> Reals:
        """Return the minimum over each node."""
        return np.asarray(np.minimum.reduceat(values, self.begin))


def _fill_nodes(
    lit: _SegmentTable, order: Integers, full: Integers, spans: Integers, rows: Reals, representatives: Reals
) -> None:
    """Fill the rows and the representatives of the nodes that hold segments, for all levels at once."""
    some = _Members(lit, order, spans[full])
    total = some.sums(some.power)
    # In a cluster without power all segments have the same weight, so that means exist.
    weight = np.where(total[some.owner] > 0.0, some.power, 1.0)
    mass = some.sums(weight)
    facing, effective = _mean_direction(some.sums(weight[:, None] * some.normal), some.normal[some.begin])
    face = facing[some.owner]
    cosine = _dot(some.normal, face)
    # The centre is the mean of positions weighted by power times cosine: the representative then has the first moment
    # of the cluster. Where normals spread too far, the node has no representative and the centre is any mean.
    lean = some.smallest(cosine)
    parallel = np.where(lean[some.owner] > _MIN_COSINE, weight * cosine, weight)
    centre = some.sums(parallel[:, None] * some.middle) / some.sums(parallel)[:, None]
    at = some.middle - centre[some.owner]
    reach = np.sqrt(
        some.largest(np.maximum(_dot(at - some.half, at - some.half), _dot(at + some.half, at + some.half)))
    )
    arm, rest = _principal_segment(_second_moments(some, at, parallel), facing, effective, reach)
    arm_size = np.linalg.norm(arm, axis=1)
    each = np.where(total > 0.0, 1.0 / mass, 0.0)
    parts = {
        "centre": centre,
        "normal": facing,
        "radius": np.maximum(reach, arm_size),
        "power": total,
        "fourth_moment": 0.2 * effective * arm_size**4 * each,
        "arm": np.where(lean > _MIN_COSINE, arm_size, np.inf),
        "length": 2.0 * np.linalg.norm(some.half, axis=1)[some.begin],
        **_extents(some, at, face, centre, arm),
        **_moments(some, at, weight, some.normal - cosine[:, None] * face, rest, each),
    }
    rows[full] = np.column_stack([parts[name] for name in NODE_SIZES])
    exitance = effective * np.where(total > 0.0, total / mass, 0.0) / np.where(arm_size > 0.0, 2.0 * arm_size, 1.0)
    representatives[full] = np.column_stack(
        [centre - arm, centre + arm, facing, np.where(arm_size > 0.0, exitance, 0.0)]
    )


def _second_moments(some: _Members, at: Reals, parallel: Reals) -> Reals:
    """Return the weighted second moments (nodes, 3, 3) of the segments about the centres."""
    outer = at[:, :, None] * at[:, None, :] + some.half[:, :, None] * some.half[:, None, :] / 3
    return some.sums(parallel[:, None, None] * outer)


def _extents(some: _Members, at: Reals, face: Reals, centre: Reals, arm: Reals) -> dict[str, Reals]:
    """Return the bounds of the nodes: boxes, heights over the receivers' planes, and spread of the normals."""
    one, other = at - some.half, at + some.half
    height = -_dot(some.normal, at)
    deviation = some.normal - face
    return {
        "low": centre + np.minimum(some.smallest(np.minimum(one, other)), -np.abs(arm)),
        "high": centre + np.maximum(some.largest(np.maximum(one, other)), np.abs(arm)),
        "spread": np.sqrt(some.largest(_dot(deviation, deviation))),
        "max_height": some.largest(height),
        "min_height": some.smallest(height),
        "slab": some.largest(np.maximum(np.abs(_dot(one, face)), np.abs(_dot(other, face)))),
    }


def _moments(some: _Members, at: Reals, weight: Reals, tangential: Reals, rest: Reals, each: Reals) -> dict[str, Reals]:
    """Return the moments that bound the error of the representatives; ``each`` is one over the nodes' weights."""
    square, fourth = _mean_distance_powers(at, some.half)
    tilt = np.sqrt(_dot(tangential, tangential))
    skew = some.sums((weight[:, None] * tangential)[:, :, None] * at[:, None, :])
    return {
        "first_order": 2.0 * np.sqrt(3.0) * np.linalg.norm(skew, axis=(1, 2)) * each,
        "second_order": 3.0 * (rest + some.sums(weight * tilt * square)) * each,
        "third_moment": some.sums(weight * np.sqrt(square * fourth)) * each,
    }


def _dot(a: Reals, b: Reals) -> Reals:
    """Return the dot products of rows; several times as fast as `np.sum` over an axis of 3."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _mean_direction(summed: Reals, first: Reals) -> tuple[Reals, Reals]:
    """Return the unit direction of summed normals, and the length of the sum; the first normal where they cancel."""
    length = np.linalg.norm(summed, axis=1)
    facing = summed / np.where(length > 0.0, length, 1.0)[:, None]
    facing[length == 0.0] = first[length == 0.0]
    return facing, length


def _mean_distance_powers(at: Reals, half: Reals) -> tuple[Reals, Reals]:
    """Return the means of |s|^2 and |s|^4 over segments from ``at - half`` to ``at + half``."""
    far, across, along = (_dot(a, b) for a, b in ((at, at), (half, half), (at, half)))
    return far + across / 3.0, far * far + (4.0 * along * along + 2.0 * far * across) / 3.0 + across * across / 5.0


def _principal_segment(spread: Reals, facing: Reals, mass: Reals, reach: Reals) -> tuple[Reals, Reals]:
    """Return half of the representative segment, along the principal axis in the plane, and the rest.

    The rest is the nuclear norm of the second moment that the segment does not represent.
    """
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
    length = np.maximum(length, _MIN_LENGTH * reach)
    rest = small + np.abs(up) + 2.0 * lean + np.abs(mass * length**2 / 3.0 - large)
    return axis * length[:, None], rest
