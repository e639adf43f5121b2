"""Bounding volume hierarchy (BVH) over triangles, built with NumPy, traversed on devices.

Nodes have up to 16 children and leaves up to 16 triangles for CPU runtimes, four of each for rays on GPUs.

References
----------
I. Wald, "On fast construction of SAH-based bounding volume hierarchies", IEEE Symp. Interactive Ray Tracing 2007.
I. Wald, C. Benthin and S. Boulos, "Getting rid of packets: efficient SIMD single-ray traversal using multi-branching
BVHs", IEEE Symp. Interactive Ray Tracing 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import capacity
from gpuvision.validation import integer

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Children of a node and triangles of a leaf: WIDTH is the number of lanes of the kernels' vectors. GPU_WIDTH is the
# number of floats that a work-item of a GPU loads at once (16 bytes).
WIDTH = 16
GPU_WIDTH = 4
# Bins of the surface-area heuristic. Scenes of up to _FEW_TRIANGLES are split triangle by triangle with the finer bins:
# their build time is small anyway.
_BINS, _FINE_BINS, _FEW_TRIANGLES = 16, 64, 8192
# Size of the stack of the kernels that serves most scenes, so that they share programs.
MIN_STACK_SIZE = 8
# Levels after which nodes are halved by count: bounds the depth of the tree for any distribution of triangles.
_MAX_HEURISTIC_DEPTH = 48
# Boxes grow by this many roundings of the largest coordinate: the conversion to the real type moves their corners.
_BOX_PADDING_ULPS = 4.0
# Most triangles of a bundle (`_bundles` pairs them twice). A bundle is not split: a leaf must have room for one.
_MAX_BUNDLE = 4
# Neighbours are bundled if their common box has at most this fraction of the area of their boxes together.
_MAX_BUNDLE_AREA = 0.8
# Shifts and masks that insert two zero bits between the bits of a 16-bit number (Morton code).
_MORTON_STEPS = ((16, 0xFF0000FF), (8, 0xF00F00F00F), (4, 0xC30C30C30C3), (2, 0x249249249249))


@dataclass(frozen=True, eq=False)
class Bvh:
    """BVH over triangles for kernels/common/bvh.h; compared by identity.

    Attributes
    ----------
    corners
        float64 (n, 3, 3), corners of the triangles relative to `middle` [m].
    middle
        float64 (3,), centre of the triangles' bounding box [m].
    numbers
        int64 (n,), numbers of the triangles in the scene.
    members
        int64 (m, width), triangles of each leaf as indices of `corners`; -1: an empty place.
    children
        int32 (k, width), children of each node: a node, or ~leaf. -1 after the last child; its box is empty.
    axes
        int32 (k,), axis along which the children of a node are sorted.
    boxes
        float64 (k, 6, width), lower corners, then upper corners of the children's boxes [m]. The box of an empty place
        is +infinity, -infinity.
    depth
        Number of levels of nodes.
    """

    corners: Reals
    middle: Reals
    numbers: Integers
    members: Integers
    children: npt.NDArray[np.int32]
    axes: npt.NDArray[np.int32]
    boxes: Reals
    depth: int

    @classmethod
    def build(
        cls,
        corners: npt.NDArray[Any],
        wanted: npt.NDArray[np.bool_] | None = None,
        *,
        width: int = WIDTH,
        parts: Integers | None = None,
    ) -> Bvh:
        """Build a BVH.

        Parameters
        ----------
        corners
            (n, 3, 3), triangles with finite corners [m]; n may be 0.
        wanted
            bool (n,), triangles that belong to the tree; None: all.
        width
            Most children of a node and triangles of a leaf, 4 or more, because up to four triangles are bundled.
        parts
            int (n,), number of the convex part of each triangle that belongs to the tree, -1 for none; None: no parts.
            A leaf holds triangles of one part, with similar normals, or triangles of no part.

        Raises
        ------
        ValueError
            The corners have another shape, or `width` is less than 4.

        Notes
        -----
        1. Triangles are bundled, up to four neighbours along the Morton curve whose boxes are close. This halves the
           build time, at a cost of 2 % in the summed area of the boxes. Up to 8192 triangles are not bundled.
        2. A binary tree is built level by level by the surface-area heuristic in bins along the widest axis of the
           centroids (Wald 2007), to leaves of at most `width` triangles. There are 16 bins, 64 for up to 8192
           triangles. The cost of a box counts its triangles and its leaves in equal parts.
        3. The binary tree is collapsed: the child with the largest area is replaced by its two children until a node
           has `width` (Wald, Benthin and Boulos 2008).
        """
        if corners.ndim != 3 or corners.shape[1:] != (3, 3):
            raise ValueError(f"Bvh.build takes triangles (n, 3, 3), got shape {corners.shape}")
        integer(width, "Bvh.build: width", minimum=_MAX_BUNDLE)
        numbers = np.arange(len(corners)) if wanted is None else np.flatnonzero(wanted)
        if not len(numbers):
            return cls._empty(width)
        corners = corners[numbers]
        # Coordinates as rows of a contiguous array: NumPy is slow along short axes.
        rows = np.ascontiguousarray(corners.reshape(-1, 9).T, np.float64).reshape(3, 3, -1)
        middle = 0.5 * (rows.min(axis=2).min(axis=0) + rows.max(axis=2).max(axis=0))
        rows -= middle[:, None]
        extents = np.concatenate([rows.min(axis=0), -rows.max(axis=0)])
        moved = rows.reshape(9, -1).T.reshape(-1, 3, 3)
        bundles = _bundles(extents) if parts is None else _part_bundles(extents, moved, parts, width)
        binary = _binary_tree(extents, bundles, width)
        children, depth = _collapse(binary, width)
        boxes = binary.extents.T[children].transpose(0, 2, 1)
        boxes[:, 3:] *= -1.0
        # Sort the children of each node by their centres along the widest axis of the node.
        boxes = np.where(children[:, None] < 0, np.repeat([np.inf, -np.inf], 3)[:, None], boxes)
        axes = np.argmax(boxes[:, 3:].max(axis=2) - boxes[:, :3].min(axis=2), axis=1)
        each = np.arange(len(children))
        with np.errstate(invalid="ignore"):
            centres = boxes[each, axes] + boxes[each, 3 + axes]
        order = np.argsort(np.where(children < 0, np.inf, centres), axis=1, kind="stable")
        children = np.take_along_axis(children, order, axis=1)
        boxes = np.take_along_axis(boxes, order[:, None], axis=2)
        leaf = (children >= 0) & (binary.left[children] < 0)
        members = _members(binary, children[leaf], width)
        inner = np.flatnonzero((children >= 0) & ~leaf)
        links = np.full(children.size, -1, np.int32)
        # Nodes were numbered when they were collapsed: level by level, by the places in their parents before sorting.
        links[inner] = binary.number[children.flat[inner]]
        links[np.flatnonzero(leaf)] = ~np.arange(len(members), dtype=np.int32)
        return cls(moved, middle, numbers, members, links.reshape(children.shape), axes.astype(np.int32), boxes, depth)

    @classmethod
    def _empty(cls, width: int) -> Bvh:
        boxes = np.tile(np.repeat([np.inf, -np.inf], 3)[:, None], (1, 1, width)).astype(np.float64)
        nowhere = np.full((1, width), -1)
        return cls(
            np.zeros((0, 3, 3)),
            np.zeros(3),
            nowhere[0, :0],
            nowhere,
            nowhere.astype(np.int32),
            np.zeros(1, np.int32),
            boxes,
            1,
        )

    @property
    def radius(self) -> float:
        """Radius of a sphere about `middle` that contains all triangles, with 1 % margin [m]; 0 without triangles."""
        low, high = self.boxes[0, :3].min(axis=1), self.boxes[0, 3:].max(axis=1)
        return 1.01 * float(np.linalg.norm(np.maximum(high, -low))) if len(self.corners) else 0.0

    @property
    def stack_size(self) -> int:
        """Build option ``BVH_DEPTH``: the depth as a power of two, not below `MIN_STACK_SIZE`."""
        return capacity(self.depth, least=MIN_STACK_SIZE)

    def rounding(self, real: np.dtype[Any]) -> float:
        """Return an upper limit of the rounding error of coordinates in a real type [m]; boxes are enlarged by it."""
        return rounding_of(float(np.abs(self.corners).max(initial=0.0)), real)

    def tables(self, real: np.dtype[Any]) -> tuple[npt.NDArray[Any], ...]:
        """Return nodes, children, axes, leaves and triangle numbers for kernels/common/bvh.h, in a real type."""
        pad = self.rounding(real)
        nodes = self.boxes.copy()
        nodes[:, :3] -= pad
        nodes[:, 3:] += pad
        padded = np.concatenate([self.corners, np.zeros((1, 3, 3))])
        leaves = padded[self.members].transpose(0, 2, 3, 1)
        return (
            nodes.astype(real),
            self.children,
            self.axes,
            np.ascontiguousarray(leaves, real),
            np.append(self.numbers, -1)[self.members].astype(np.int32),
        )


class _Bundles(NamedTuple):
    """Groups of one to four neighbouring triangles that stay together in a leaf."""

    order: Integers  # triangles, sorted by bundle
    first: Integers  # index in `order` at which each bundle begins
    size: Integers  # triangles of each bundle
    extents: npt.NDArray[np.float32]  # (6, n): lower corners, negated upper corners


def _bundles(extents: Reals) -> _Bundles:
    """Bundle neighbours along the Morton curve whose common box is not much larger than their boxes together."""
    if extents.shape[1] <= _FEW_TRIANGLES:
        each = np.arange(extents.shape[1])
        return _Bundles(each, each, np.ones_like(each), extents.astype(np.float32))
    order = _morton_order(extents)
    one = extents.astype(np.float32)[:, order]
    count = -(-len(order) // 4) * 4
    padded = np.full((6, count), np.inf, np.float32)
    padded[:, : len(order)] = one
    pairs = np.minimum(padded[:, ::2], padded[:, 1::2])
    fours = np.minimum(pairs[:, ::2], pairs[:, 1::2])
    area = _areas(padded)
    both = area[::2] + area[1::2]
    is_pair = _areas(pairs) <= _MAX_BUNDLE_AREA * both
    is_four = np.repeat(_areas(fours) <= _MAX_BUNDLE_AREA * (both[::2] + both[1::2]), 4)
    begins = np.ones(count, bool)
    begins[1::2] = ~is_pair
    begins[is_four] = False
    begins[::4] = True
    first = np.flatnonzero(begins[: len(order)])
    size = np.diff(first, append=len(order))
    is_bundle = np.where(is_four[first], fours[:, first // 4], np.where(size == 2, pairs[:, first // 2], one[:, first]))
    return _Bundles(order, first, size, is_bundle)


def _morton_order(extents: Reals) -> Integers:
    """Return the order of the triangles along the Morton curve through the centres of their boxes."""
    centre = extents[:3] - extents[3:]
    low = centre.min(axis=1, keepdims=True)
    span = float((centre.max(axis=1, keepdims=True) - low).max())
    cells = ((centre - low) * (65535.0 / span if span > 0.0 else 0.0)).astype(np.int64)
    for shift, mask in _MORTON_STEPS:
        cells = (cells | (cells << shift)) & mask
    return radix_argsort(cells[0] | (cells[1] << 1) | (cells[2] << 2))


def radix_argsort(key: Integers) -> Integers:
    """Return the stable ascending order of keys >= 0, by a radix sort with digits of 16 bits.

    NumPy's stable sort of 16-bit integers is many times faster than the sort of 64-bit integers.
    """
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in range(16, int(key.max(initial=0)).bit_length(), 16):
        order = order[np.argsort((key >> shift).astype(np.uint16)[order], kind="stable")]
    return order


def rounding_of(reach: float, real: np.dtype[Any]) -> float:
    """Return an upper limit of the rounding error [m] of coordinates up to `reach` [m] in a real type."""
    return _BOX_PADDING_ULPS * float(np.finfo(real).eps) * reach


def _part_bundles(extents: Reals, corners: Reals, parts: Integers, width: int) -> _Bundles:
    """Bundle up to `width` triangles of a part with similar normals; bundle other triangles as `_bundles` does.

    Each bundle of a part fills a leaf: its last triangle is repeated. The triangles of a part are split by their
    normals as other triangles are by their places.
    """
    solid, loose = np.flatnonzero(parts >= 0), np.flatnonzero(parts < 0)
    solid = solid[np.argsort(parts[solid], kind="stable")]
    each = np.arange(len(solid))
    normals = unit_normals(corners[solid]).T
    single = _Bundles(each, each, np.ones_like(each), np.concatenate([normals, -normals]).astype(np.float32))
    forest = _BinaryTree(single.size, np.flatnonzero(np.diff(parts[solid], prepend=-1)))
    _split(forest, single, _FINE_BINS, width)
    leaves = np.flatnonzero(forest.left < 0)
    start, last = forest.start[leaves, None], (forest.start + forest.count)[leaves, None] - 1
    groups = solid[forest.order[np.minimum(start + np.arange(width), last)]]
    rest, count = _bundles(extents[:, loose]), len(groups)
    return _Bundles(
        np.append(groups, loose[rest.order]),
        np.append(np.arange(count) * width, groups.size + rest.first),
        np.append(np.full(count, width), rest.size),
        np.concatenate([extents[:, groups].min(axis=2).astype(np.float32), rest.extents], axis=1),
    )


def unit_normals(corners: Reals) -> Reals:
    """Return unit normals (..., 3) of triangles (..., 3, 3)."""
    normals = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


class _BinaryTree:
    """Binary trees over bundles during their construction: arrays over their nodes.

    ``left`` is the left child of a node, -1 for a leaf; the right child is left + 1. ``count`` is the number of bundles
    of a node, ``load`` its number of triangles, ``start`` its first bundle in ``order``.
    """

    def __init__(self, size: Integers, roots: Integers) -> None:
        """Start with one node per tree; `roots`: the first bundle of each."""
        self.order: Integers = np.arange(len(size))
        self.start: Integers = roots
        self.count: Integers = np.diff(roots, append=len(size))
        self.load: Integers = np.add.reduceat(size, roots)
        self.left: Integers = np.full(len(roots), -1)
        self.triangles: Integers = np.zeros(0, np.int64)
        self.begins: Integers = np.zeros(0, np.int64)
        self.extents: Reals = np.zeros((6, 0))
        self.number: Integers = np.zeros(0, np.int64)

    def split(self, nodes: Integers, left_count: Integers, load: Integers) -> Integers:
        """Give nodes two children, the left one with `left_count` bundles and `load` triangles; return the children."""
        first = len(self.start)
        fresh = first + np.arange(2 * len(nodes))
        self.left[nodes] = fresh[::2]
        begin, number, whole = self.start[nodes], self.count[nodes], self.load[nodes]
        self.start = np.append(self.start, np.column_stack([begin, begin + left_count]))
        self.count = np.append(self.count, np.column_stack([left_count, number - left_count]))
        self.load = np.append(self.load, np.column_stack([load, whole - load]))
        self.left = np.append(self.left, np.full(len(fresh), -1))
        return fresh

    def unbundle(self, bundles: _Bundles) -> None:
        """Set the order of the triangles, and the first triangle of each node."""
        size = bundles.size[self.order]
        ends = np.cumsum(size)
        self.triangles = bundles.order[np.repeat(bundles.first[self.order] - ends + size, size) + np.arange(ends[-1])]
        self.begins = np.append(0, ends)[self.start]

    def measure(self, extents: Reals, levels: list[Integers]) -> None:
        """Compute the extents of all nodes: leaves from their triangles, then inner nodes from the last level up."""
        leaves = np.flatnonzero(self.left < 0)
        leaves = leaves[np.argsort(self.start[leaves])]
        self.extents = np.empty((6, len(self.start)))
        self.extents[:, leaves] = np.minimum.reduceat(extents[:, self.triangles], self.begins[leaves], axis=1)
        for nodes in reversed(levels):
            left = self.left[nodes]
            self.extents[:, nodes] = np.minimum(self.extents[:, left], self.extents[:, left + 1])


def _binary_tree(extents: Reals, bundles: _Bundles, width: int) -> _BinaryTree:
    """Build the binary tree over triangles with the given extents, (6, n)."""
    tree = _BinaryTree(bundles.size, np.zeros(1, np.int64))
    levels = _split(tree, bundles, _FINE_BINS if extents.shape[1] <= _FEW_TRIANGLES else _BINS, width)
    tree.unbundle(bundles)
    tree.measure(extents, levels)
    return tree


def _split(tree: _BinaryTree, bundles: _Bundles, bins: int, width: int) -> list[Integers]:
    """Split all nodes with more than `width` triangles; return the nodes that were split, level by level."""
    levels = []
    active = np.flatnonzero(tree.load > width)
    while len(active):
        levels.append(active)
        halve = len(levels) > _MAX_HEURISTIC_DEPTH
        fresh = _split_level(tree, active, bundles, bins, width, halve=halve)
        active = fresh[tree.load[fresh] > width]
    return levels


def _split_level(
    tree: _BinaryTree, active: Integers, bundles: _Bundles, bins: int, width: int, *, halve: bool
) -> Integers:
    """Split each active node once and sort its bundles by child; return the children."""
    start, count = tree.start[active], tree.count[active]
    owner = np.repeat(np.arange(len(active)), count)
    first = np.cumsum(count) - count
    places = np.arange(len(owner)) + np.repeat(start - first, count)
    members = tree.order[places]
    centre = bundles.extents[:3, members] - bundles.extents[3:, members]
    low, high = np.minimum.reduceat(centre, first, axis=1), np.maximum.reduceat(centre, first, axis=1)
    axis = np.argmax(high - low, axis=0)
    each = np.arange(len(active))
    bottom, span = low[axis, each], (high - low)[axis, each]
    scale = np.where(span > 0.0, bins * (1.0 - 1e-6) / np.maximum(span, 1e-36), 0.0).astype(np.float32)
    value = centre[axis[owner], np.arange(len(owner))]
    at = np.clip(((value - bottom[owner]) * scale[owner]).astype(np.int64), 0, bins - 1)
    # Sorted by node and bin: both sides of every cut between bins are contiguous.
    key = owner * bins + at
    order = radix_argsort(key)
    members, key = members[order], key[order]
    tree.order[places] = members
    cuts = np.append(0, np.flatnonzero(key[1:] != key[:-1]) + 1)
    cells = key[cuts]
    grid = np.full((6, len(active) * bins), np.inf, np.float32)
    grid[:, cells] = np.minimum.reduceat(bundles.extents[:, members], cuts, axis=1)
    held = np.zeros((2, len(active) * bins), np.int64)
    sums = np.append(0, np.cumsum(bundles.size[members]))
    held[0, cells] = np.diff(cuts, append=len(key))
    held[1, cells] = np.diff(sums[cuts], append=sums[-1])
    left_count = _best_cuts(grid.reshape(6, -1, bins), *held.reshape(2, -1, bins), width=width)
    left_count = np.where((left_count <= 0) | (left_count >= count) | halve, count // 2, left_count)
    return tree.split(active, left_count, sums[first + left_count] - sums[first])


def _best_cuts(grid: npt.NDArray[Any], filled: Integers, load: Integers, *, width: int) -> Integers:
    """Return the number of bundles to the left of the cut with the least cost, for each node.

    Parameters are the extents of the bins, (6, n, bins), and the number of bundles and triangles in each, (n, bins).
    """
    left = _areas(np.minimum.accumulate(grid, axis=2))[:, :-1]
    right = _areas(np.minimum.accumulate(grid[:, :, ::-1], axis=2))[:, ::-1][:, 1:]
    below = np.cumsum(load, axis=1)[:, :-1]
    above = load.sum(axis=1, keepdims=True) - below
    cost = np.where((below > 0) & (above > 0), left * _work(below, width) + right * _work(above, width), np.inf)
    best: Integers = np.cumsum(filled, axis=1)[np.arange(len(below)), np.argmin(cost, axis=1)]
    return best


def _work(triangles: Integers, width: int) -> Integers:
    """Return the cost of a box by its number of triangles: triangles plus the width for each leaf, with full leaves."""
    return triangles - (-triangles // width) * width


def _areas(extents: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return half the surface areas of boxes with extents (6, ...); 0 for empty boxes."""
    with np.errstate(invalid="ignore"):
        x, y, z = np.where(np.isinf(extents[:3]), 0.0, -extents[3:] - extents[:3])
    return np.asarray(x * y + y * z + z * x)


def _members(tree: _BinaryTree, leaves: Integers, width: int) -> Integers:
    """Return the triangles of leaves, (n, width); -1 in empty places."""
    places = tree.begins[leaves, None] + np.arange(width)
    members: Integers = tree.triangles[np.minimum(places, len(tree.triangles) - 1)]
    members[np.arange(width) >= tree.load[leaves, None]] = -1
    is_repeated = members[:, 1:] == members[:, :-1]
    members[:, 1:][is_repeated] = -1
    return members


def _collapse(tree: _BinaryTree, width: int) -> tuple[Integers, int]:
    """Collapse the binary tree to nodes of `width` children.

    Returns the children of every wide node as nodes of the binary tree, (k, width) (-1: none), and the depth. Sets
    ``tree.number``, the number of the wide node of a binary node.
    """
    area = np.where(tree.left >= 0, _areas(tree.extents), -1.0)
    tree.number = np.full(len(tree.start), -1)
    roots, levels, numbered, depth = np.zeros(1, np.int64), [], 0, 0
    while len(roots):
        tree.number[roots] = numbered + np.arange(len(roots))
        numbered += len(roots)
        depth += 1
        children = np.full((len(roots), width), -1)
        children[:, 0] = roots
        rows = np.arange(len(roots))
        for column in range(1, width):
            largest = np.argmax(np.where(children >= 0, area[children], -1.0), axis=1)
            chosen = children[rows, largest]
            able = rows[area[chosen] >= 0.0]
            opened = tree.left[chosen[able]]
            children[able, largest[able]] = opened
            children[able, column] = opened + 1
        levels.append(children)
        inside = children[children >= 0]
        roots = inside[tree.left[inside] >= 0]
    return np.concatenate(levels), depth
