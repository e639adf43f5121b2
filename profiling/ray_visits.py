"""Numbers of boxes and triangles that rays are tested against in the traversal of kernels/common/bvh.h.

The traversal is written again in Numba, one ray after the other, in double precision. The order of the children, the
early end of an occluded ray and the second test of boxes behind a hit are those of the kernel. The leaf that
occluded the ray before, which the kernel tries first, is not tried. Empty places of nodes and leaves do not count.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.simulation.scene.bvh import Bvh

_DEPTH = 128
# Operations in kernels/common/bvh.h. Of a ray: direction 3, length 6, reciprocals 4, bounds 15, shear 2. Of a box: six
# planes 12, slack 1. Of a triangle: corners 21, edge functions 18, their sum 2, ray parameter 6, its limits 2.
_RAY_FLOPS, _BOX_FLOPS, _TRIANGLE_FLOPS = 30, 13, 49


class Visits(NamedTuple):
    """Tests of rays, (n,) each.

    Attributes
    ----------
    boxes, triangles
        Number of boxes and of triangles.
    is_hit
        Whether the ray meets a triangle.
    """

    boxes: NDArray[np.int64]
    triangles: NDArray[np.int64]
    is_hit: NDArray[np.bool_]

    def mean_flops(self) -> float:
        """Return the mean number of operations of a ray."""
        return float(np.mean(_RAY_FLOPS + _BOX_FLOPS * self.boxes + _TRIANGLE_FLOPS * self.triangles))


def visits(tree: Bvh, rays: NDArray[Any], *, end: float, any_hit: bool) -> Visits:
    """Trace rays (n, 6), origin and direction, up to `end` in multiples of the direction."""
    nodes, children, axes, leaves, triangles = tree.tables(np.dtype(np.float64))
    moved = rays.astype(np.float64)
    moved[:, :3] -= tree.middle
    counts = np.zeros((len(rays), 3), np.int64)
    boxes, places = np.isfinite(nodes[:, 0]).sum(axis=1), (triangles >= 0).sum(axis=1)
    _trace(nodes, children, axes, leaves, boxes, places, moved, end, any_hit, counts)
    return Visits(counts[:, 0], counts[:, 1], counts[:, 2] != 0)


@numba.njit(error_model="numpy")
def _met(node, ray, per, end):
    """Return the boxes that the ray meets before `end`, one bit for each."""
    bits = 0
    for lane in range(node.shape[1]):
        enter, leave = 0.0, end
        for k in range(3):
            one, two = (node[k, lane] - ray[k]) * per[k], (node[3 + k, lane] - ray[k]) * per[k]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
        if enter <= leave and node[0, lane] <= node[3, lane]:
            bits |= 1 << lane
    return bits


@numba.njit(error_model="numpy")
def _nearest(leaf, count, ray, end):
    """Return the smallest parameter below `end` at which the ray meets a triangle of a leaf; `end` if it meets none."""
    for lane in range(count):
        ax, ay, az = leaf[0, 0, lane], leaf[0, 1, lane], leaf[0, 2, lane]
        ux, uy, uz = leaf[1, 0, lane] - ax, leaf[1, 1, lane] - ay, leaf[1, 2, lane] - az
        vx, vy, vz = leaf[2, 0, lane] - ax, leaf[2, 1, lane] - ay, leaf[2, 2, lane] - az
        px, py, pz = ray[4] * vz - ray[5] * vy, ray[5] * vx - ray[3] * vz, ray[3] * vy - ray[4] * vx
        per = 1.0 / (px * ux + py * uy + pz * uz)
        tx, ty, tz = ray[0] - ax, ray[1] - ay, ray[2] - az
        a = (tx * px + ty * py + tz * pz) * per
        qx, qy, qz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
        b, t = (ray[3] * qx + ray[4] * qy + ray[5] * qz) * per, (vx * qx + vy * qy + vz * qz) * per
        if a >= 0.0 and b >= 0.0 and a + b <= 1.0 and 0.0 < t < end:
            end = t
    return end


@numba.njit(error_model="numpy")
def _next(met, backward, width):
    """Return the first child of the set along the axis, or the last one for a ray against the axis."""
    for k in range(width):
        lane = width - 1 - k if backward else k
        if met >> lane & 1:
            return lane
    return -1


@numba.njit(error_model="numpy")
def _trace(nodes, children, axes, leaves, boxes, triangles, rays, last, any_hit, counts):
    """Fill the numbers of boxes and triangles, and whether the ray meets a triangle, of each ray."""
    stack, left, per = np.empty(_DEPTH, np.int64), np.empty(_DEPTH, np.int64), np.empty(3)
    for i in range(rays.shape[0]):
        ray, end, node, depth = rays[i], last, 0, 0
        for k in range(3):
            per[k] = 1.0 / ray[3 + k]
        met = _met(nodes[0], ray, per, end)
        counts[i, 0] = boxes[0]
        while met or depth:
            if not met:
                depth -= 1
                node, met = stack[depth], left[depth]
                if not any_hit:
                    met &= _met(nodes[node], ray, per, end)
                    counts[i, 0] += boxes[node]
                continue
            lane = _next(met, per[axes[node]] < 0.0, children.shape[1])
            met ^= 1 << lane
            child = children[node, lane]
            if child < 0:
                counts[i, 1] += triangles[~child]
                found = _nearest(leaves[~child], triangles[~child], ray, end)
                if found < end:
                    counts[i, 2] = 1
                    if any_hit:
                        break
                    end = found
                    met &= _met(nodes[node], ray, per, end)
                    counts[i, 0] += boxes[node]
                continue
            if met:
                stack[depth], left[depth] = node, met
                depth += 1
            node = child
            met = _met(nodes[node], ray, per, end)
            counts[i, 0] += boxes[node]
