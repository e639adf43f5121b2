"""BVH: every triangle is in one leaf and within all boxes above it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gpuvision.simulation.scene.bvh import GPU_WIDTH, WIDTH, Bvh


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
