"""Numbers of the nodes of a light tree, node by node by their definitions, with integrals over the segments."""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np
import pytest

from gpuvision.simulation.clustering.light_tree import NODE_SIZES, LightTree, _mean_direction


def segments(rng: np.random.Generator, count: int = 11, spread: float = 0.4) -> np.ndarray:
    """Return segments of different length, normal and exitance; one without light, and one without length."""
    middle, half = rng.normal(0.0, [0.02, 0.01, 0.03], (count, 3)), rng.normal(0.0, 4e-3, (count, 3))
    normal = (rng.normal([0.2, 0.5, 1.0], spread, (count, 3))) * rng.uniform(0.5, 2.0, (count, 1))
    table = np.column_stack([middle - half, middle + half, normal, rng.uniform(0.5, 3.0, count)])
    table[3, 9] = 0.0
    table[5, 3:6] = table[5, :3]
    return table


def columns(tree: LightTree, node: int) -> dict[str, np.ndarray]:
    ends = list(accumulate(NODE_SIZES.values()))
    return {name: tree.rows[node, end - size : end] for (name, size), end in zip(NODE_SIZES.items(), ends, strict=True)}


def integrals(at: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return the means of s s', |s|^2 and |s|^4 over a segment, by a Gauss-Legendre rule that is exact for them."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    s = at + nodes[:, None] * half
    square = np.sum(s * s, axis=1)
    weights = 0.5 * weights
    return (s * weights[:, None]).T @ s, float(weights @ square), float(weights @ square**2)


def expected(table: np.ndarray, members: np.ndarray) -> tuple[dict[str, np.ndarray], float]:
    """Return the numbers of a node, and the exitance of its representative."""
    mine = table[members]
    start, end = mine[:, :3], mine[:, 3:6]
    half, middle = 0.5 * (end - start), 0.5 * (start + end)
    normal = mine[:, 6:9] / np.linalg.norm(mine[:, 6:9], axis=1, keepdims=True)
    power = mine[:, 9] * np.linalg.norm(end - start, axis=1)
    total = power.sum()
    weight = power if total > 0.0 else np.ones(len(mine))
    each = 1.0 / weight.sum() if total > 0.0 else 0.0
    summed = weight @ normal
    mass = float(np.linalg.norm(summed))
    face = summed / mass
    cosine = normal @ face
    lean = cosine.min()
    parallel = weight * cosine if lean > 0.1 else weight
    centre = parallel @ middle / parallel.sum()
    at = middle - centre
    points = np.concatenate([start, end]) - centre
    reach = np.linalg.norm(points, axis=1).max()
    means = [integrals(a, b) for a, b in zip(at, half, strict=True)]
    moment = sum(w * m for w, (m, _, _) in zip(parallel, means, strict=True))
    basis = np.linalg.svd(face[None])[2][1:]
    values, vectors = np.linalg.eigh(basis @ moment @ basis.T)
    large, small = values[1], max(values[0], 0.0)
    length = max(math.sqrt(3.0 * large / mass), 1e-3 * reach)
    arm = length * vectors[:, 1] @ basis
    rest = small + abs(face @ moment @ face) + 2.0 * np.linalg.norm(basis @ moment @ face)
    rest += abs(mass * length**2 / 3.0 - large)
    tangential = normal - cosine[:, None] * face
    tilt = np.linalg.norm(tangential, axis=1)
    squares, fourths = (np.array([each[k] for each in means]) for k in (1, 2))
    heights = -np.sum(normal * at, axis=1)
    found = {
        "centre": centre,
        "low": centre + np.minimum(points.min(axis=0), -np.abs(arm)),
        "high": centre + np.maximum(points.max(axis=0), np.abs(arm)),
        "normal": face,
        "radius": max(reach, length),
        "spread": np.linalg.norm(normal - face, axis=1).max(),
        "max_height": heights.max(),
        "min_height": heights.min(),
        "slab": np.abs(points @ face).max(),
        "power": total,
        "first_order": 2.0 * math.sqrt(3.0) * np.linalg.norm((weight[:, None] * tangential).T @ at) * each,
        "second_order": 3.0 * (rest + weight @ (tilt * squares)) * each,
        "third_moment": weight @ np.sqrt(squares * fourths) * each,
        "fourth_moment": 0.2 * mass * length**4 * each,
        "arm": length if lean > 0.1 else math.inf,
        "length": np.linalg.norm(end[0] - start[0]),
    }
    return found, mass / (2.0 * length) if total > 0.0 else 0.0


@pytest.mark.parametrize("spread", [0.1, 1.5])
def test_every_node_has_the_numbers_of_its_segments(spread: float, rng: np.random.Generator) -> None:
    table = segments(rng, spread=spread)
    tree = LightTree.build(table)
    assert tree.power == pytest.approx(float(table[:, 9] @ np.linalg.norm(table[:, 3:6] - table[:, :3], axis=1)))
    assert sorted(tree.order) == list(range(11))
    wide = 0
    for node in range(1, len(tree.spans)):
        first, size = tree.spans[node]
        if not size:
            assert not tree.rows[node].any()
            continue
        members = tree.order[first : first + size]
        numbers, exitance = expected(table, members)
        scale = 1e-12
        found = columns(tree, node)
        for name, value in numbers.items():
            # Powers of lengths of some centimetres: rounding of 1e-15 of the largest terms.
            np.testing.assert_allclose(found[name], np.ravel(value), rtol=1e-6, atol=scale, err_msg=f"{name} of {node}")
        representative = tree.representatives[node]
        ends = representative[:6].reshape(2, 3)
        np.testing.assert_allclose(ends.mean(axis=0), numbers["centre"], atol=1e-12)
        np.testing.assert_allclose(representative[6:9], numbers["normal"], atol=1e-9)
        assert representative[9] == pytest.approx(exitance, rel=1e-6)
        arm = 0.5 * np.linalg.norm(ends[1] - ends[0])
        if np.isfinite(numbers["arm"]):
            assert arm == pytest.approx(numbers["arm"], rel=1e-6)
        wide += not np.isfinite(numbers["arm"])
    assert (wide > 0) == (spread > 1.0)


def test_a_representative_has_a_length_where_all_light_is_in_one_place() -> None:
    """A thousandth of the reach, to a segment without light: the exitance stays finite, and the power is kept."""
    short = [0.0, 0.0, 0.0, 1e-9, 0.0, 0.0, 0.0, 0.0, 1.0, 5.0]
    dark = [0.4, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    tree = LightTree.build(np.array([short, dark]))
    start, end, normal, exitance = np.split(tree.representatives[1], [3, 6, 9])
    assert np.linalg.norm(end - start) == pytest.approx(1e-3, rel=1e-6)
    assert exitance[0] * np.linalg.norm(end - start) == pytest.approx(5e-9, rel=1e-9)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0])


def test_nodes_are_halved_along_the_widest_axis(rng: np.random.Generator) -> None:
    """By number, and by the order along one of the midpoint's axes, or of the normal's, times half of the extent."""
    table = segments(rng, 13, 1.0)
    tree = LightTree.build(table)
    assert tree.spans.shape == (32, 2)
    np.testing.assert_array_equal(tree.spans[1], [0, 13])
    normal = table[:, 6:9] / np.linalg.norm(table[:, 6:9], axis=1, keepdims=True)
    middle = 0.5 * (table[:, :3] + table[:, 3:6])
    keys = np.column_stack([middle, 0.5 * np.ptp(middle, axis=0).max() * normal])
    axes = set()
    for node in range(1, 16):
        (first, size), (one, left), (two, right) = tree.spans[node], tree.spans[2 * node], tree.spans[2 * node + 1]
        assert (one, two, left + right) == (first, first + left, size)
        assert abs(int(left) - int(right)) <= 1
        widest = int(np.argmax(np.ptp(keys[tree.order[first : first + size]], axis=0))) if size else 0
        axes.add(widest)
        if left and right:
            halves = keys[tree.order[one : one + left], widest], keys[tree.order[two : two + right], widest]
            assert halves[0].max() <= halves[1].min()
    assert any(axis > 2 for axis in axes)
    assert any(axis < 3 for axis in axes)


@pytest.mark.parametrize("count", [0, 1, 2, 4, 5])
def test_small_trees_have_a_node_for_each_segment(count: int, rng: np.random.Generator) -> None:
    table = segments(rng)[:count]
    tree = LightTree.build(table)
    levels = max(count - 1, 0).bit_length()
    assert tree.spans.shape == (2 << levels, 2)
    leaves = tree.spans[1 << levels :]
    assert leaves[:, 1].sum() == count
    assert leaves[:, 1].max(initial=0) <= 1
    assert tree.rows.shape == (2 << levels, sum(NODE_SIZES.values()))
    for wrong in (np.zeros((3, 9)), np.zeros(10)):
        with pytest.raises(ValueError, match=r"segments \(m, 10\), got shape"):
            LightTree.build(wrong)


def test_normals_that_cancel_have_the_direction_of_the_first() -> None:
    """Sums of one and of two normals keep their direction, also at the length 1."""
    summed = np.array([[0.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 2.0]])
    first = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    facing, length = _mean_direction(summed, first)
    np.testing.assert_allclose(facing, [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]], rtol=1e-15)
    np.testing.assert_allclose(length, [0.0, 1.0, 2.0], rtol=1e-15)
