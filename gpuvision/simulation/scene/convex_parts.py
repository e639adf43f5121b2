"""Convex parts of a scene: a convex solid hides one interval of a line from any point outside of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.bvh import Bvh, Integers, rounding_of, unit_normals
from gpuvision.simulation.scene.connected_surfaces import ConnectedSurfaces, Float64, connected_surfaces

# Most triangles of a scene that is searched for parts: the search takes as long as the construction of a tree.
_MAX_SCENE = 1 << 15
# Most triangles of a part: the time of the test of a surface grows with the square of their number.
_MAX_TRIANGLES = 256
# Corners times triangles that are tested at a time (memory only).
_MAX_PAIRS = 1 << 22
# Steps towards the axis of the narrowest cone around the normals of a leaf. Chosen: the error of the ball around the
# normals falls as one over the steps, to a few percent here; any axis is valid.
_CONE_STEPS = 32
# Least cosine between the axis of a cone and the normals. Chosen: leaves with wider cones face nearly all points, and
# the apex is at most 20 times as far from the leaf as its planes.
_MIN_COSINE = 0.05
_ROW = 16  # numbers of a row of `ConvexParts.table`


class ConvexSurfaces(NamedTuple):
    """Convex parts among triangles.

    A convex part is a closed surface of at most 256 connected triangles, whose corners run counterclockwise seen from
    outside, that is convex but for the rounding of its corners to single precision.

    Attributes
    ----------
    parts
        int64 (n,), number of the part of each triangle, -1 for none.
    excess
        float64 (n,), largest distance of a corner of the triangle's surface from the inner side of a plane of the
        surface [m]: 0 or rounding; infinity for surfaces that are not closed, or have too many triangles.
    low, high
        float64 (n, 3), corners of the bounding box of the triangle's surface [m].
    """

    parts: Integers
    excess: Float64
    low: Float64
    high: Float64

    @classmethod
    def of(cls, corners: Float64) -> ConvexSurfaces:
        """Find the convex parts of triangles (n, 3, 3); none among more than 32768 triangles."""
        count = len(corners)
        if not 0 < count <= _MAX_SCENE:
            nowhere = np.zeros((count, 3))
            return cls(np.full(count, -1), np.full(count, np.inf), nowhere, nowhere)
        surfaces = connected_surfaces(corners)
        number = surfaces.number
        excess = _excess(corners, surfaces)[number]
        reach = 0.5 * float(np.ptp(corners, axis=(0, 1)).max())
        parts = np.where(excess <= rounding_of(reach, np.dtype(np.float32)), number, -1)
        return cls(parts, excess, surfaces.low[number], surfaces.high[number])

    @property
    def is_convex(self) -> npt.NDArray[np.bool_]:
        """Whether each triangle belongs to a part, (n,)."""
        return self.parts >= 0


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex parts to which the leaves of a tree belong; compared by identity.

    Attributes
    ----------
    tree
        Tree in which each leaf holds triangles of one part, or of no part.
    leaves
        int64 (n,), leaves that belong to a part.
    excess
        float64 (n,), `ConvexSurfaces.excess` of their parts [m].
    boxes
        float64 (n, 2, 3), lower and upper corners of the boxes around their parts, relative to `Bvh.middle` [m].
    apexes, axes, sines
        float64 (n, 3), (n, 3) and (n,), apexes [m] and axes of cones, and sines of the largest angles between an axis
        and a normal of the leaf. All triangles of the leaf face away from a point p if the angle between p - apex and
        the axis is at least 90 degrees plus this angle. The sine is infinite for leaves without a cone.
    """

    tree: Bvh
    leaves: Integers
    excess: Float64
    boxes: Float64
    apexes: Float64
    axes: Float64
    sines: Float64

    @classmethod
    def of(cls, tree: Bvh, surfaces: ConvexSurfaces) -> ConvexParts:
        """Find the leaves of parts in a tree over the same triangles."""
        first = tree.members[:, 0]
        filled = np.flatnonzero(first >= 0)  # the tree of a scene without triangles has an empty leaf
        leaves = filled[surfaces.is_convex[first[filled]]]
        first = first[leaves]
        # Empty places repeat the first triangle of the leaf.
        members = np.where(tree.members[leaves] < 0, first[:, None], tree.members[leaves])
        boxes = np.stack([surfaces.low[first], surfaces.high[first]], axis=1) - tree.middle
        return cls(tree, leaves, surfaces.excess[first], boxes, *_cones(tree.corners[members]))

    def table(self, real: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return a row for each leaf of the tree, for kernels/occluded_irradiance/visible.h, in a real type.

        (leaves, 16): lower corner of the box, 0, upper corner, 0; apex, axis, squared sine, 0. Boxes grow by the
        rounding of the type. The box is infinite for a leaf of no part, and of a part that is not convex in this type.
        """
        rounding = self.tree.rounding(real)
        rows = np.zeros((len(self.tree.members), _ROW))
        rows[:, :3], rows[:, 4:7] = -np.inf, np.inf
        is_convex = self.excess <= rounding
        leaves = self.leaves[is_convex]
        rows[leaves, :3] = self.boxes[is_convex, 0] - rounding
        rows[leaves, 4:7] = self.boxes[is_convex, 1] + rounding
        rows[leaves, 8:15] = np.column_stack([self.apexes, self.axes, self.sines**2])[is_convex]
        return rows.astype(real)


def _excess(corners: Float64, surfaces: ConnectedSurfaces) -> Float64:
    """Return `ConvexSurfaces.excess` of each surface, (k,)."""
    excess = np.full(len(surfaces.volume), np.inf)
    counts = np.bincount(surfaces.number, minlength=len(excess))
    wanted = surfaces.is_closed & (surfaces.volume > 0.0) & (counts <= _MAX_TRIANGLES)
    order, first = np.argsort(surfaces.number, kind="stable"), np.cumsum(counts) - counts
    for size in np.unique(counts[wanted]):
        alike = np.flatnonzero(wanted & (counts == size))
        for some in np.array_split(alike, -(-len(alike) * 3 * size * size // _MAX_PAIRS)):
            triangles = corners[order[first[some, None] + np.arange(size)]]
            triangles = triangles - triangles[:, :1, :1]
            normals = unit_normals(triangles)
            reach = normals @ triangles.reshape(len(some), -1, 3).transpose(0, 2, 1)
            planes = np.sum(normals * triangles[:, :, 0], axis=2)
            excess[some] = (reach.max(axis=2) - planes).max(axis=1)
    return excess


def _cones(corners: Float64) -> tuple[Float64, Float64, Float64]:
    """Return `ConvexParts.apexes`, `axes` and `sines` of leaves (n, width, 3, 3)."""
    normals = unit_normals(corners)
    each = np.arange(len(corners))
    # Steps towards the farthest normal, smaller and smaller, lead to the centre of the smallest ball around the normals
    # (Badoiu and Clarkson, Smaller core-sets for balls, SODA 2003). Any axis is valid; a narrow cone holds more points.
    centre = normals[:, 0].copy()
    for step in range(2, 2 + _CONE_STEPS):
        farthest = np.argmax(np.sum((normals - centre[:, None]) ** 2, axis=2), axis=1)
        centre += (normals[each, farthest] - centre) / step
    size = np.linalg.norm(centre, axis=1, keepdims=True)
    axes = centre / np.where(size > 0.0, size, 1.0)
    cosine = np.clip(np.einsum("nwk,nk->nw", normals, axes).min(axis=1), -1.0, 1.0)
    is_narrow = cosine > _MIN_COSINE
    # The apex lies on the inner side of all planes: below the mean of the corners, along the axis.
    mean = corners.mean(axis=(1, 2))
    above = np.einsum("nwk,nwk->nw", normals, mean[:, None] - corners[:, :, 0]).max(axis=1)
    apexes = mean - axes * (np.maximum(above, 0.0) / np.where(is_narrow, cosine, 1.0))[:, None]
    return apexes, axes, np.where(is_narrow, np.sqrt(1.0 - cosine * cosine), np.inf)
