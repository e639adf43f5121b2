"""BVH: every triangle is in one leaf and within all boxes above it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.simulation.scene import bvh
from gpuvision.simulation.scene.bvh import GPU_WIDTH, WIDTH, Bvh, radix_argsort


def corners_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    soup = rng.uniform(-1.0, 1.0, (5003, 1, 3)) + rng.normal(0.0, 0.01, (5003, 3, 3))
    return {
        "none": soup[:0],
        "one": soup[:1],
        "sixteen": soup[:16],
        "seventeen": soup[:17],
        "soup": soup,
        "same": np.repeat(soup[:1], 1000, axis=0),
        "line": np.cumsum(np.ones((3000, 1, 1)), axis=0) + soup[:3000] * [1.0, 0.0, 0.0],
        "clusters": soup * np.where(rng.random((5003, 1, 1)) < 0.5, 1e-6, 1e3),
        "geometric": soup[:300] * 2.0 ** -np.arange(300.0)[:, None, None],
        "sphere": trimesh.creation.icosphere(4).triangles,
    }[kind]


KINDS = ("none", "one", "sixteen", "seventeen", "soup", "same", "line", "clusters", "geometric", "sphere")


def assert_children_in_order(tree: Bvh, node: int) -> None:
    """Assert that the children of a node come first, in the order of their centres along its widest axis."""
    low, high = tree.boxes[node, :3], tree.boxes[node, 3:]
    full = low[0] <= high[0]
    count = np.count_nonzero(full)
    assert full[:count].all()
    if count:
        size = high.max(axis=1) - low.min(axis=1)
        axis = tree.axes[node]
        assert axis == np.argmax(size)
        assert (np.diff(low[axis, :count] + high[axis, :count]) >= 0.0).all()


@pytest.mark.parametrize("width", [WIDTH, GPU_WIDTH])
@pytest.mark.parametrize("kind", KINDS)
def test_each_triangle_in_one_leaf_within_its_boxes(kind: str, width: int, rng: np.random.Generator) -> None:
    corners = corners_of(kind, rng)
    tree = Bvh.build(corners, width=width)
    assert tree.members.shape[1] == tree.children.shape[1] == tree.boxes.shape[2] == width
    np.testing.assert_array_equal(np.sort(tree.members[tree.members >= 0]), np.arange(len(corners)))
    reached, deepest = np.zeros(len(tree.members), int), 0
    todo = [(0, 1, np.full(3, -np.inf), np.full(3, np.inf))]
    while todo:
        node, depth, low, high = todo.pop()
        deepest = max(deepest, depth)
        boxes = tree.boxes[node].T
        assert_children_in_order(tree, node)
        for child, box in zip(tree.children[node], boxes, strict=True):
            if box[0] > box[3]:
                continue
            assert (box[:3] >= low).all()
            assert (box[3:] <= high).all()
            if child >= 0:
                todo.append((child, depth + 1, box[:3], box[3:]))
                continue
            reached[~child] += 1
            points = tree.corners[tree.members[~child][tree.members[~child] >= 0]].reshape(-1, 3)
            np.testing.assert_array_equal(points.min(axis=0), box[:3])
            np.testing.assert_array_equal(points.max(axis=0), box[3:])
    assert deepest == tree.depth
    assert (reached == 1).all() or kind == "none"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_boxes_in_the_real_type_hold_the_rounded_corners(kind: str, real: type, rng: np.random.Generator) -> None:
    tree = Bvh.build(corners_of(kind, rng))
    nodes, children, axes, leaves, triangles = tree.tables(np.dtype(real))
    assert nodes.dtype == leaves.dtype == real
    assert triangles.dtype == children.dtype == axes.dtype == np.int32
    for node, lane in np.argwhere((children < 0) & (nodes[:, 0] < nodes[:, 3])):
        leaf = ~children[node, lane]
        points = leaves[leaf].reshape(3, 3, WIDTH)[:, :, triangles[leaf] >= 0]
        assert (points.min(axis=(0, 2)) > nodes[node, :3, lane]).all()
        assert (points.max(axis=(0, 2)) < nodes[node, 3:, lane]).all()


def half_area(box: np.ndarray) -> float:
    x, y, z = box[3:] - box[:3]
    return float(x * y + y * z + z * x)


class Binary:
    """Binary tree over triangles by the surface-area heuristic: one node, by its definition."""

    def __init__(self, boxes: np.ndarray, members: np.ndarray, bins: int, width: int) -> None:
        mine = boxes[members]
        self.members = members
        self.box = np.concatenate([mine[:, :3].min(axis=0), mine[:, 3:].max(axis=0)])
        self.parts: list[Binary] = []
        if len(members) <= width:
            return
        centre = mine[:, :3] + mine[:, 3:]
        axis = int(np.argmax(np.ptp(centre, axis=0)))
        low, span = centre[:, axis].min(), np.ptp(centre[:, axis])
        number = np.minimum((bins * (1.0 - 1e-6) * (centre[:, axis] - low) / max(span, 1e-36)).astype(int), bins - 1)
        best, cost = None, np.inf
        for cut in range(1, bins):
            sides = members[number < cut], members[number >= cut]
            if len(sides[0]) and len(sides[1]):
                total = 0.0
                for side in sides:
                    box = np.concatenate([boxes[side, :3].min(axis=0), boxes[side, 3:].max(axis=0)])
                    total += half_area(box) * (len(side) + width * -(-len(side) // width))
                if total < cost * (1.0 - 1e-7):
                    best, cost = sides, total
        if best is None:
            best = members[: len(members) // 2], members[len(members) // 2 :]
        self.parts = [Binary(boxes, side, bins, width) for side in best]

    def collapsed(self, width: int) -> Any:
        """Return the triangles of a leaf, or the children of a node of up to `width`, the largest opened first."""
        if not self.parts:
            return frozenset(self.members.tolist())
        children = list(self.parts)
        while len(children) < width and any(each.parts for each in children):
            largest = max((each for each in children if each.parts), key=lambda each: half_area(each.box))
            children.remove(largest)
            children += largest.parts
        return frozenset(each.collapsed(width) for each in children)


def nested(tree: Bvh, node: int = 0) -> Any:
    """Return the nodes of a tree as nested sets down to the triangles of the leaves."""
    found = set()
    for child, low, high in zip(tree.children[node], tree.boxes[node, 0], tree.boxes[node, 3], strict=True):
        if low <= high:
            leaf = tree.members[~child] if child < 0 else None
            found.add(nested(tree, child) if leaf is None else frozenset(leaf[leaf >= 0].tolist()))
    return frozenset(found)


@pytest.mark.parametrize("width", [WIDTH, GPU_WIDTH])
def test_the_tree_has_the_least_cost_of_areas(width: int, rng: np.random.Generator) -> None:
    """Cuts between 64 bins along the widest axis of the centres; cost of the triangles and of full leaves."""
    corners = rng.uniform(-1.0, 1.0, (140, 1, 3)) * [1.0, 0.7, 0.4] + rng.normal(0.0, 0.1, (140, 3, 3))
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    expected = Binary(boxes, np.arange(140), 64, width).collapsed(width)
    assert nested(Bvh.build(corners, width=width)) == expected


def test_triangles_at_one_place_are_halved() -> None:
    """Without a cut between bins the halves have equal numbers: 40 triangles in leaves of 10."""
    tree = Bvh.build(np.repeat(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]), 40, axis=0), width=16)
    assert sorted((tree.members >= 0).sum(axis=1)) == [10, 10, 10, 10]


def test_bundles_are_neighbours_along_the_morton_curve(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four, or else two of two, whose common box has at most 0.8 of the area of their boxes together."""
    monkeypatch.setattr(bvh, "_FEW_TRIANGLES", 10)
    count = 203
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, 0.25, (count, 3, 3))
    low, high = corners.min(axis=1), corners.max(axis=1)
    bundles = bvh._bundles(np.concatenate([low, -high], axis=1).T)
    centre = low + high
    cells = ((centre - centre.min(axis=0)) * 65535.0 / np.ptp(centre, axis=0).max()).astype(int)
    codes = [sum(((int(c[k]) >> bit) & 1) << (3 * bit + k) for bit in range(16) for k in range(3)) for c in cells]
    order = np.argsort(codes, kind="stable")
    np.testing.assert_array_equal(bundles.order, order)

    def is_close(members: np.ndarray, parts: int) -> bool:
        box = np.concatenate([low[members].min(axis=0), high[members].max(axis=0)])
        each = sum(half_area(np.concatenate([low[k], high[k]])) for k in members)
        return len(members) == parts and half_area(box) <= 0.8 * each

    sizes: list[int] = []
    for first in range(0, count, 4):
        four = order[first : first + 4]
        if is_close(four, 4):
            sizes.append(4)
        else:
            for k in (0, 2):
                pair = four[k : k + 2]
                sizes += [2] if is_close(pair, 2) else [1] * len(pair)
    np.testing.assert_array_equal(bundles.size, sizes)
    np.testing.assert_array_equal(bundles.first, np.cumsum(sizes) - sizes)
    assert set(sizes) == {1, 2, 4}
    for n, (first, size) in enumerate(zip(bundles.first, bundles.size, strict=True)):
        mine = order[first : first + size]
        np.testing.assert_allclose(bundles.extents[:3, n], low[mine].min(axis=0), rtol=1e-6)
        np.testing.assert_allclose(-bundles.extents[3:, n], high[mine].max(axis=0), rtol=1e-6)
    tree = Bvh.build(corners, width=16)
    leaf_of = np.empty(count, int)
    for number, members in enumerate(tree.members):
        leaf_of[members[members >= 0]] = number
    for first, size in zip(bundles.first, bundles.size, strict=True):
        assert len(set(leaf_of[order[first : first + size]])) == 1


def test_the_morton_curve_interleaves_all_bits(rng: np.random.Generator) -> None:
    """Centres on a lattice of 65536 cells along each axis, many of them in neighbouring cells."""
    places = np.concatenate(
        [rng.integers(0, 1 << bits, (60, 3)) for bits in (2, 4, 8, 12, 16)] + [[[0] * 3, [65535] * 3]]
    )
    codes = [sum(((int(c[k]) >> bit) & 1) << (3 * bit + k) for bit in range(16) for k in range(3)) for c in places]
    half = 0.5 * places.T
    np.testing.assert_array_equal(bvh._morton_order(np.concatenate([half, -half])), np.argsort(codes, kind="stable"))


@pytest.mark.parametrize("bits", [1, 15, 16, 17, 33, 48])
def test_radix_sort_is_stable(bits: int, rng: np.random.Generator) -> None:
    keys = rng.integers(0, 1 << bits, 500)
    keys[100:200] = keys[:100]
    np.testing.assert_array_equal(radix_argsort(keys), np.argsort(keys, kind="stable"))
    assert len(radix_argsort(keys[:0])) == 0


def test_radius_and_middle_hold_all_triangles(rng: np.random.Generator) -> None:
    corners = rng.uniform([1.0, 2.0, -3.0], [4.0, 3.0, 5.0], (30, 3, 3))
    tree = Bvh.build(corners)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    np.testing.assert_allclose(tree.middle, 0.5 * (low + high), rtol=1e-12)
    np.testing.assert_allclose(tree.corners, corners - tree.middle, atol=1e-15)
    assert tree.radius == pytest.approx(1.01 * 0.5 * np.linalg.norm(high - low), rel=1e-12)
    assert Bvh.build(corners[:0]).radius == 0.0
    assert tree.stack_size == bvh.MIN_STACK_SIZE
    assert dataclasses.replace(tree, depth=bvh.MIN_STACK_SIZE + 1).stack_size == 2 * bvh.MIN_STACK_SIZE


def test_only_those_wanted_under_their_own_numbers(rng: np.random.Generator) -> None:
    corners = corners_of("soup", rng)
    wanted = rng.random(len(corners)) < 0.3
    triangles = Bvh.build(corners, wanted).tables(np.dtype(np.float32))[-1]
    np.testing.assert_array_equal(np.sort(triangles[triangles >= 0]), np.flatnonzero(wanted))


def test_a_tree_is_good_where_triangles_are_spread(rng: np.random.Generator) -> None:
    """The boxes of a sphere have at least its projected areas; tilted squares fill half of their boxes."""
    tree = Bvh.build(corners_of("sphere", rng))
    size = tree.boxes[:, 3:] - tree.boxes[:, :3]
    leaf = (tree.children < 0) & (size[:, 0] >= 0.0)
    x, y, z = size.transpose(1, 0, 2)[:, leaf]
    assert np.sum(x * y + y * z + z * x) < 2.0 * 1.5 * 4.0 * np.pi
    assert (tree.members >= 0).mean() > 0.5


def test_a_tree_without_triangles_is_empty() -> None:
    tree = Bvh.build(np.zeros((0, 3, 3)))
    assert len(tree.numbers) == 0
    assert (tree.members < 0).all()


def test_triangles_of_another_shape() -> None:
    with pytest.raises(ValueError, match=r"\(n, 3, 3\)"):
        Bvh.build(np.zeros((4, 3)))


@pytest.mark.parametrize("width", [3, 0, 4.5])
def test_a_node_has_room_for_a_bundle(width: int) -> None:
    with pytest.raises((TypeError, ValueError), match=r"Bvh\.build: width"):
        Bvh.build(np.zeros((10, 3, 3)), width=width)
