"""Traversal of the light tree by the kernel of `LightClustering`: decisions and bounds as an oracle finds them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gpuvision.host import Device, to_numpy
from gpuvision.simulation.clustering import light_clustering as module
from gpuvision.simulation.clustering.light_cut import BLOCK
from gpuvision.simulation.clustering.light_tree import NODE_SIZES, LightTree
from gpuvision.simulation.scene.scene import Scene
from light_cuts import Block, Traversal, traverse

MIDDLE = np.array([0.25, -0.5, 1.0])
ROUNDING, MARGIN = 2e-3, 1.5e-3
# No axis of the scenes is parallel to a coordinate axis.
TURN = Rotation.from_euler("xyz", [0.5, -0.4, 0.7]).as_matrix()
CAPACITY = 256
TWO_WAYS = pytest.mark.parametrize("variant", ["vector", "work_item"])


def named(rows: NDArray[Any], sizes: dict[str, int]) -> list[dict[str, Any]]:
    """Return the numbers of rows by their names."""
    places = np.cumsum([0, *sizes.values()])
    return [
        {
            name: row[first] if size == 1 else row[first : first + size]
            for (name, size), first in zip(sizes.items(), places, strict=False)
        }
        for row in rows.astype(np.float64)
    ]


def lit_segments(rng: np.random.Generator, count: int, size: float) -> NDArray[Any]:
    """Return short segments of different exitance about the origin, with normals about z."""
    start = rng.normal(size=(count, 3)) * size * [1.0, 1.0, 0.3]
    way = rng.normal(size=(count, 3)) * [0.2, 0.2, 0.02] * size
    normal = [0.0, 0.0, 1.0] + 0.15 * rng.normal(size=(count, 3))
    normal -= way * (np.sum(normal * way, axis=1) / np.sum(way * way, axis=1))[:, None]
    vectors = [each @ TURN.T for each in (start, start + way, normal)]
    return np.hstack([*vectors, rng.uniform(0.2, 1.0, (count, 1))])


def strips_around(rng: np.random.Generator, strips: int, count: int, far: tuple[float, float]) -> NDArray[Any]:
    """Return strips of receivers at distances from the origin; some see the segments at grazing incidence."""
    direction = rng.normal((0.0, 0.0, 0.8), 1.0, (strips, 1, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    place = direction * rng.uniform(*far, (strips, 1, 1)) + rng.normal(size=(strips, count, 3)) * 0.01
    normal = -direction + 0.6 * rng.normal(size=(strips, 1, 3)) + 0.1 * rng.normal(size=(strips, count, 3))
    # Multiples of 2^-20 are exact in single, also after the shift by MIDDLE.
    return np.round(np.concatenate([place @ TURN.T, normal @ TURN.T], axis=2) * 2.0**20) / 2.0**20


def some_triangles(rng: np.random.Generator) -> NDArray[Any]:
    """Return triangles between segments and receivers, and triangles that rise little above the segments' planes."""
    above = rng.normal((0.0, 0.0, 0.06), (0.05, 0.05, 0.02), (4, 1, 3)) + rng.normal(size=(4, 3, 3)) * 0.015
    low = rng.normal(size=(4, 1, 3)) * [0.06, 0.06, 0.004] + rng.normal(size=(4, 3, 3)) * [0.015, 0.015, 0.006]
    return np.concatenate([above, low]) @ TURN.T


class Inputs(NamedTuple):
    """Scene of a traversal: receivers (strips, n, 6) with their costs, and the share of each strip."""

    segments: NDArray[Any]
    receivers: NDArray[Any]
    costs: NDArray[Any]
    shares: NDArray[Any]
    triangles: NDArray[Any] | None = None
    clusters: bool = True


class Task(NamedTuple):
    """Scene, tree and segments relative to the middle of the frame, and the oracle's results of all blocks."""

    scene: Scene | None
    middle: NDArray[Any]
    tree: LightTree
    placed: NDArray[Any]
    expected: list[Traversal]


@cache
def task_of(make: Callable[[], Inputs]) -> Task:
    """Return the task of some inputs; the oracle runs once for all variants of the kernel."""
    return task_for(make(), oracle=True)


def task_for(inputs: Inputs, *, oracle: bool) -> Task:
    """Return the task of some inputs, without the oracle's results if `oracle` is false."""
    scene = None if inputs.triangles is None else Scene(inputs.triangles + MIDDLE)
    middle = MIDDLE if scene is None else scene.bvh.middle
    shift = middle - MIDDLE
    segments = inputs.segments - np.concatenate([shift, shift, np.zeros(4)])
    tree = LightTree.build(segments)
    placed = np.zeros((len(tree.spans) // 2, sum(module._SEGMENT_SIZES.values())), np.float32)
    placed[: len(segments)] = module._segment_rows(segments[tree.order], np.zeros(3))
    nodes, lits = named(tree.rows.astype(np.float32), NODE_SIZES), named(placed, module._SEGMENT_SIZES)
    triangles = None if inputs.triangles is None else inputs.triangles - shift
    expected = []
    blocks = np.ndindex(len(inputs.receivers), -(-inputs.receivers.shape[1] // BLOCK)) if oracle else ()
    for strip, first in blocks:
        here = strip, slice(first * BLOCK, first * BLOCK + BLOCK)
        block = Block.of(inputs.receivers[here], inputs.costs[here], shift)
        limits = inputs.shares[strip], ROUNDING, triangles, MARGIN
        expected.append(traverse(block, nodes, tree.spans, lits, *limits, clusters=inputs.clusters))
    return Task(scene, middle, tree, placed, expected)


def compare(device: Device, variant: Any, make: Callable[[], Inputs]) -> list[Traversal]:
    """Run the kernel, compare all blocks with the oracle, and return the oracle's results.

    The kernel computes in single: the scenes have no bound within 1e-5 of a limit.
    """
    inputs, task = make(), task_of(make)
    found = select(device, variant, inputs, task)
    for selected, errors, count, sums, tallies, each in zip(*found, task.expected, strict=True):
        assert count == len(each.entries)
        np.testing.assert_array_equal(selected[:count], each.entries)
        np.testing.assert_allclose(errors[:count], each.errors, rtol=3e-5)
        np.testing.assert_allclose(sums, each.sums, rtol=3e-5)
        np.testing.assert_array_equal(tallies, each.tallies)
    return task.expected


def select(device: Device, variant: Any, inputs: Inputs, task: Task) -> list[NDArray[Any]]:
    """Run the kernel and return its outputs."""
    operation = module._SelectLights(
        nodes=len(task.tree.spans),
        segments=len(task.placed),
        capacity=CAPACITY,
        scene=task.scene,
        clearance=MARGIN,
        clusters=inputs.clusters,
        variant=variant,
    )
    # The receivers are not relative to the middle of the frame. A device without doubles reads them in single.
    dtype = np.float64 if device.has_double else np.float32
    given = (inputs.receivers + np.append(MIDDLE, np.zeros(3))).astype(dtype)
    costs, shares, rows = (each.astype(np.float32) for each in (inputs.costs, inputs.shares, task.tree.rows))
    frame = np.append(task.middle, ROUNDING).astype(dtype)
    return [
        to_numpy(each)
        for each in operation(given, costs, shares, rows, task.tree.spans, task.placed, frame, device=device)
    ]


def without_occluders() -> Inputs:
    """Return shares from 0, where all single segments are kept, to 1e9 / m^2, where the root is omitted."""
    rng = np.random.default_rng(0)
    near, far = (strips_around(rng, *size) for size in ((24, BLOCK + 5, (0.02, 0.3)), (8, BLOCK + 5, (0.4, 3.0))))
    receivers = np.concatenate([near, far])
    costs = rng.uniform(0.5, 2.0, receivers.shape[:2]) * (rng.random(receivers.shape[:2]) < 0.8)
    receivers[3, 4, 3:] = 0.0
    costs[5, BLOCK:] = 0.0
    shares = np.tile([0.0, 1e9, 0.3, 3.0, 30.0, 0.05], 6)[:32]
    return Inputs(lit_segments(rng, 21, 0.03), receivers, costs, shares)


def with_occluders() -> Inputs:
    """Return a scene whose most distant strips have more clusters to test than a block tests at most."""
    rng = np.random.default_rng(0)
    receivers = np.concatenate([strips_around(rng, 20, BLOCK, (0.1, 0.4)), strips_around(rng, 3, BLOCK, (1.0, 2.0))])
    costs = rng.uniform(0.5, 2.0, receivers.shape[:2])
    triangles = some_triangles(rng)
    shares = np.append(np.tile([0.0, 0.3, 3.0, 0.1], 5), np.full(3, 2e-3))
    return Inputs(lit_segments(rng, 100, 0.03), receivers, costs, shares, triangles)


def without_clusters() -> Inputs:
    """Return a distant strip, which takes clusters where they are allowed."""
    rng = np.random.default_rng(1)
    receivers = strips_around(rng, 2, BLOCK, (1.0, 2.0))
    costs = rng.uniform(0.5, 2.0, receivers.shape[:2])
    return Inputs(lit_segments(rng, 8, 0.03), receivers, costs, np.full(2, 0.1), clusters=False)


@TWO_WAYS
def test_bounds_without_occluders(device: Device, variant: Any) -> None:
    expected = compare(device, variant, without_occluders)
    assert sum(each.tallies[1] > 0 for each in expected) >= 10
    assert sum(0 < each.tallies[0] < 21 for each in expected) >= 10


@TWO_WAYS
def test_triangles_that_may_occlude(device: Device, variant: Any) -> None:
    expected = compare(device, variant, with_occluders)
    assert sum(any(k < 0 for k in each.entries) for each in expected) >= 5
    assert sum(any(k >= 1 << 30 for k in each.entries) for each in expected) >= 3
    assert sum(each.tests == 0 for each in expected) >= 1


@pytest.mark.double
@pytest.mark.slow
def test_clusters_switched_off(device: Device) -> None:
    assert not any(each.tallies[1] for each in compare(device, "vector", without_clusters))


@pytest.mark.vectors
@pytest.mark.parametrize(("wide", "count", "size"), [(6.0, 2000, 1e-3), (20.0, 8000, 3e-4)])
def test_a_group_selects_as_the_vector_variant(device: Device, wide: float, count: int, size: float) -> None:
    """Trees of several levels: 700 segments, and triangles around the light that hide some clusters."""
    rng = np.random.default_rng(1)
    segments = lit_segments(rng, 700, 0.03)
    centres = wide * rng.normal((0.0, 0.0, 0.06), (0.05, 0.05, 0.03), (count, 1, 3))
    triangles = (centres + size * rng.normal(size=(count, 3, 3))) @ TURN.T
    receivers = strips_around(rng, 9, 2 * BLOCK + 5, (0.3, 2.0))
    shares = np.tile([3e-3, 0.3, 0.01], 3)
    inputs = Inputs(segments, receivers, rng.uniform(0.5, 2.0, receivers.shape[:2]), shares, triangles)
    task = task_for(inputs, oracle=False)
    assert task.scene is not None
    assert task.scene.bvh.depth >= 3
    made, truth = (select(device, variant, inputs, task) for variant in ("work_item", "vector"))
    held = np.arange(CAPACITY) < truth[2][:, None]
    assert np.sum(held & (truth[0] < 0)) > 50
    assert np.sum(held & (truth[0] >= 1 << 30)) > 50
    for values, right in zip(made[2:], truth[2:], strict=True):
        np.testing.assert_array_equal(values, right)
    for values, right in zip(made[:2], truth[:2], strict=True):
        np.testing.assert_array_equal(values[held], right[held])
