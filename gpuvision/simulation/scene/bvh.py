"""A tree of boxes over triangles with 16 children a node, built with NumPy, and rays through it on devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

WIDTH = 16
# Bins of a cut; of few triangles all are split on their own, into more bins, as that takes no time to speak of.
_BINS, _FINE_BINS, _FEW = 16, 64, 8192
# From here on halves by number, so that the tree stays shallow whatever the triangles.
_DEEP = 48
_UNITS_IN_LAST_PLACE = 4.0
# Neighbours stay together where their box has at most so many times the area of theirs.
_LOOSE = 0.8
# Steps and masks that put two zeros between the bits of a number (16 bits).
_SPREAD = ((16, 0xFF0000FF), (8, 0xF00F00F00F), (4, 0xC30C30C30C3), (2, 0x249249249249))


@dataclass(frozen=True, eq=False)
class Bvh:
    """The tree of kernels/common/bvh.h over some triangles; compared by identity.

    Attributes
    ----------
    corners
        float64 (n, 3, 3), metres: the triangles, from the scene's `middle`.
    middle
        float64 (3,), metres.
    numbers
        int64 (n,): what they are called.
    members
        int64 (m, 16): the triangles of each leaf by their place in `corners`, -1 where it has fewer.
    children
        int32 (k, 16): a node, or ~leaf; -1 behind the last (`boxes` says that nothing is there).
    axes
        int32 (k,): along which a node's children lie in order.
    boxes
        float64 (k, 6, 16): low corners, then high ones; of no child: low is infinity, high minus infinity.
    depth
        How many nodes lie above each other at most.
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
    def build(cls, corners: npt.NDArray[Any], wanted: npt.NDArray[np.bool_] | None = None) -> Bvh:
        """Build the tree over triangles (n, 3, 3), finite, those that are ``wanted`` (n,); there may be none.

        Binary splits by the surface-area heuristic in 16 bins along the widest axis of the centroids, a level at a
        time for all nodes (Wald 2007), where a box costs its triangles and its leaves, in equal parts; to leaves of
        at most 16; then the largest nodes are opened until 16 children stand side by side. What is split are bundles
        of up to four neighbours along Morton's curve, where they lie close: half the time, and a tree as good to 2 %
        (by the areas of its boxes). Up to 8192 triangles are split one by one, in 64 bins.

        Raises
        ------
        ValueError
            The corners have another shape.
        """
        if corners.ndim != 3 or corners.shape[1:] != (3, 3):
            raise ValueError(f"Bvh.build takes triangles (n, 3, 3), got shape {corners.shape}")
        numbers = np.arange(len(corners)) if wanted is None else np.flatnonzero(wanted)
        if not len(numbers):
            return cls._empty()
        corners = corners[numbers]
        # Numbers side by side: NumPy is slow along short axes.
        rows = np.ascontiguousarray(corners.reshape(-1, 9).T, np.float64).reshape(3, 3, -1)
        middle = 0.5 * (rows.min(axis=2).min(axis=0) + rows.max(axis=2).max(axis=0))
        rows -= middle[:, None]
        extents = np.concatenate([rows.min(axis=0), -rows.max(axis=0)])
        moved = rows.reshape(9, -1).T.reshape(-1, 3, 3)
        binary = _binary_tree(extents)
        children, depth = _opened(binary)
        boxes = binary.extents.T[children].transpose(0, 2, 1)
        boxes[:, 3:] *= -1.0
        # In order along the widest axis of what each node holds.
        boxes = np.where(children[:, None] < 0, np.repeat([np.inf, -np.inf], 3)[:, None], boxes)
        axes = np.argmax(boxes[:, 3:].max(axis=2) - boxes[:, :3].min(axis=2), axis=1)
        each = np.arange(len(children))
        with np.errstate(invalid="ignore"):
            centres = boxes[each, axes] + boxes[each, 3 + axes]
        order = np.argsort(np.where(children < 0, np.inf, centres), axis=1, kind="stable")
        children = np.take_along_axis(children, order, axis=1)
        boxes = np.take_along_axis(boxes, order[:, None], axis=2)
        leaf = (children >= 0) & (binary.left[children] < 0)
        members = _members(binary, children[leaf])
        inner = np.flatnonzero((children >= 0) & ~leaf)
        links = np.full(children.size, -1, np.int32)
        # Nodes were numbered as they were opened: level by level, in the order of their parents' lanes before sorting.
        links[inner] = binary.number[children.flat[inner]]
        links[np.flatnonzero(leaf)] = ~np.arange(len(members), dtype=np.int32)
        return cls(moved, middle, numbers, members, links.reshape(children.shape), axes.astype(np.int32), boxes, depth)

    @classmethod
    def _empty(cls) -> Bvh:
        boxes = np.tile(np.repeat([np.inf, -np.inf], 3)[:, None], (1, 1, WIDTH)).astype(np.float64)
        nowhere = np.full((1, WIDTH), -1)
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
        """Of a sphere about the middle that the triangles lie well within, metres."""
        low, high = self.boxes[0, :3].min(axis=1), self.boxes[0, 3:].max(axis=1)
        return 1.01 * float(np.linalg.norm(np.maximum(high, -low))) if len(self.corners) else 0.0

    def tables(self, real: np.dtype[Any]) -> tuple[npt.NDArray[Any], ...]:
        """Return nodes, children, axes, leaves, triangles as kernels/common/bvh.h takes them."""
        reach = float(np.abs(self.corners).max(initial=0.0))
        pad = _UNITS_IN_LAST_PLACE * float(np.finfo(real).eps) * reach
        nodes = self.boxes.copy()
        nodes[:, :3] -= pad
        nodes[:, 3:] += pad
        whole = np.concatenate([self.corners, np.zeros((1, 3, 3))])
        leaves = whole[self.members].transpose(0, 2, 3, 1)
        return (
            nodes.astype(real),
            self.children,
            self.axes,
            np.ascontiguousarray(leaves, real),
            np.append(self.numbers, -1)[self.members].astype(np.int32),
        )


class _Bundles(NamedTuple):
    """Triangles that go together into a leaf, whatever the tree: up to four neighbours."""

    order: Integers  # triangles, bundle by bundle
    first: Integers  # where each bundle begins there
    size: Integers
    extents: npt.NDArray[np.float32]  # (6, n)


def _bundles(extents: Reals) -> _Bundles:
    """Take neighbours along a space-filling curve as one where their box is not much more than theirs together."""
    if extents.shape[1] <= _FEW:
        each = np.arange(extents.shape[1])
        return _Bundles(each, each, np.ones_like(each), extents.astype(np.float32))
    order = _along_the_curve(extents)
    one = extents.astype(np.float32)[:, order]
    count = -(-len(order) // 4) * 4
    padded = np.full((6, count), np.inf, np.float32)
    padded[:, : len(order)] = one
    pairs = np.minimum(padded[:, ::2], padded[:, 1::2])
    fours = np.minimum(pairs[:, ::2], pairs[:, 1::2])
    area = _areas(padded)
    both = area[::2] + area[1::2]
    is_pair = _areas(pairs) <= _LOOSE * both
    is_four = np.repeat(_areas(fours) <= _LOOSE * (both[::2] + both[1::2]), 4)
    begins = np.ones(count, bool)
    begins[1::2] = ~is_pair
    begins[is_four] = False
    begins[::4] = True
    first = np.flatnonzero(begins[: len(order)])
    size = np.diff(first, append=len(order))
    whole = np.where(is_four[first], fours[:, first // 4], np.where(size == 2, pairs[:, first // 2], one[:, first]))
    return _Bundles(order, first, size, whole)


def _along_the_curve(extents: Reals) -> Integers:
    """Return triangles in the order of Morton's curve through the middles of their boxes."""
    centre = extents[:3] - extents[3:]
    low = centre.min(axis=1, keepdims=True)
    span = float((centre.max(axis=1, keepdims=True) - low).max())
    cells = ((centre - low) * (65535.0 / span if span > 0.0 else 0.0)).astype(np.int64)
    for shift, mask in _SPREAD:
        cells = (cells | (cells << shift)) & mask
    return radix_argsort(cells[0] | (cells[1] << 1) | (cells[2] << 2))


def radix_argsort(key: Integers) -> Integers:
    """Return in which order keys, none below 0, ascend, equal ones as they stand.

    By digits of 16 bits: those NumPy sorts many times faster than whole numbers.
    """
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in range(16, int(key.max(initial=0)).bit_length(), 16):
        order = order[np.argsort((key >> shift).astype(np.uint16)[order], kind="stable")]
    return order


class _Binary:
    """The binary tree over bundles while it grows: arrays over its nodes.

    ``left`` is -1 for a leaf, the right child is left + 1; ``count`` is of bundles, ``load`` of triangles.
    """

    def __init__(self, size: Integers) -> None:
        self.order: Integers = np.arange(len(size))
        self.start: Integers = np.zeros(1, np.int64)
        self.count: Integers = np.full(1, len(size))
        self.load: Integers = np.full(1, size.sum())
        self.left: Integers = np.full(1, -1)
        self.triangles: Integers = np.zeros(0, np.int64)
        self.begins: Integers = np.zeros(0, np.int64)
        self.extents: Reals = np.zeros((6, 0))
        self.number: Integers = np.zeros(0, np.int64)

    def split(self, nodes: Integers, on_the_left: Integers, load: Integers) -> Integers:
        """Give nodes their two children, the first with so many bundles and triangles; return the new ones."""
        first = len(self.start)
        fresh = first + np.arange(2 * len(nodes))
        self.left[nodes] = fresh[::2]
        begin, number, whole = self.start[nodes], self.count[nodes], self.load[nodes]
        self.start = np.append(self.start, np.column_stack([begin, begin + on_the_left]))
        self.count = np.append(self.count, np.column_stack([on_the_left, number - on_the_left]))
        self.load = np.append(self.load, np.column_stack([load, whole - load]))
        self.left = np.append(self.left, np.full(len(fresh), -1))
        return fresh

    def unbundle(self, bundles: _Bundles) -> None:
        """Set the order of triangles, and where each node begins in it."""
        size = bundles.size[self.order]
        ends = np.cumsum(size)
        self.triangles = bundles.order[np.repeat(bundles.first[self.order] - ends + size, size) + np.arange(ends[-1])]
        self.begins = np.append(0, ends)[self.start]

    def measure(self, extents: Reals, levels: list[Integers]) -> None:
        """Set the nodes' extents from their triangles', the leaves first and then what was split, level by level."""
        leaves = np.flatnonzero(self.left < 0)
        leaves = leaves[np.argsort(self.start[leaves])]
        self.extents = np.empty((6, len(self.start)))
        self.extents[:, leaves] = np.minimum.reduceat(extents[:, self.triangles], self.begins[leaves], axis=1)
        for nodes in reversed(levels):
            left = self.left[nodes]
            self.extents[:, nodes] = np.minimum(self.extents[:, left], self.extents[:, left + 1])


def _binary_tree(extents: Reals) -> _Binary:
    bundles = _bundles(extents)
    tree, levels = _Binary(bundles.size), []
    active = np.flatnonzero(tree.load > WIDTH)
    bins = _FINE_BINS if extents.shape[1] <= _FEW else _BINS
    while len(active):
        levels.append(active)
        fresh = _split_level(tree, active, bundles, bins, halve=len(levels) > _DEEP)
        active = fresh[tree.load[fresh] > WIDTH]
    tree.unbundle(bundles)
    tree.measure(extents, levels)
    return tree


def _split_level(tree: _Binary, active: Integers, bundles: _Bundles, bins: int, *, halve: bool) -> Integers:
    """Split each active node once and put the bundles in order; return the children."""
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
    # Sorting by node and bin also puts the two sides of every cut side by side.
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
    on_the_left = _best_cuts(grid.reshape(6, -1, bins), *held.reshape(2, -1, bins))
    on_the_left = np.where((on_the_left <= 0) | (on_the_left >= count) | halve, count // 2, on_the_left)
    return tree.split(active, on_the_left, sums[first + on_the_left] - sums[first])


def _best_cuts(grid: npt.NDArray[Any], filled: Integers, load: Integers) -> Integers:
    """Return how many bundles go to the left of the best cut between bins.

    Of bins (n, bins): extents (6, n, bins), and how many bundles and triangles they hold.
    """
    left = _areas(np.minimum.accumulate(grid, axis=2))[:, :-1]
    right = _areas(np.minimum.accumulate(grid[:, :, ::-1], axis=2))[:, ::-1][:, 1:]
    below = np.cumsum(load, axis=1)[:, :-1]
    above = load.sum(axis=1, keepdims=True) - below
    cost = np.where((below > 0) & (above > 0), left * _work(below) + right * _work(above), np.inf)
    best: Integers = np.cumsum(filled, axis=1)[np.arange(len(below)), np.argmin(cost, axis=1)]
    return best


def _work(triangles: Integers) -> Integers:
    """Return what a box of so many triangles costs: leaves are looked at whole, and full ones are fewer."""
    return triangles - (-triangles // WIDTH) * WIDTH


def _areas(extents: npt.NDArray[Any]) -> npt.NDArray[Any]:
    with np.errstate(invalid="ignore"):
        x, y, z = np.where(np.isinf(extents[:3]), 0.0, -extents[3:] - extents[:3])
    return np.asarray(x * y + y * z + z * x)


def _members(tree: _Binary, leaves: Integers) -> Integers:
    """Return the triangles of leaves (n, 16), -1 where they have fewer."""
    places = tree.begins[leaves, None] + np.arange(WIDTH)
    members: Integers = tree.triangles[np.minimum(places, len(tree.triangles) - 1)]
    members[np.arange(WIDTH) >= tree.load[leaves, None]] = -1
    return members


def _opened(tree: _Binary) -> tuple[Integers, int]:
    """Return the 16 children of every wide node, as binary nodes (-1: none), and the depth; sets ``tree.number``."""
    area = np.where(tree.left >= 0, _areas(tree.extents), -1.0)
    tree.number = np.full(len(tree.start), -1)
    roots, levels, numbered, depth = np.zeros(1, np.int64), [], 0, 0
    while len(roots):
        tree.number[roots] = numbered + np.arange(len(roots))
        numbered += len(roots)
        depth += 1
        children = np.full((len(roots), WIDTH), -1)
        children[:, 0] = roots
        rows = np.arange(len(roots))
        for column in range(1, WIDTH):
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
