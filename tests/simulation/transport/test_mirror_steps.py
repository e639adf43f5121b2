"""Steps of the search for reflections (kernels/mirrors/mirrors.cl): each against its definition in float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
# A fault of a step may change only the number of Newton steps, or how many blocks are searched.
SOURCE = """
#include "mirrors/mirrors.cl"
#define PUT(value) out[to++] = (value)
static inline int put_vector(global real *out, int to, Vector v) { PUT(v.x), PUT(v.y), PUT(v.z); return to; }

kernel void reflections(global const real *given, global const MirrorTriangle *table, global real *made) {
    const size_t n = get_global_id(0);
    global const real *at = given + 11 * n;
    global real *out = made + 24 * n;
    const Vector point = {at[0], at[1], at[2]}, lens_wide = {at[3], at[4], at[5]}, step = {at[8], at[9], at[10]};
    const Fixed lens = {at[3], at[4], at[5]};
    const Reflection it = reflection_at(at[6], at[7], point, lens_wide, table + n);
    int to = put_vector(out, 0, it.place);
    to = put_vector(out, to, it.along_x);
    to = put_vector(out, to, it.along_y);
    PUT(it.r1), PUT(it.r2), PUT(it.r1x), PUT(it.r1y), PUT(it.r2x), PUT(it.r2y);
    PUT(dot_of(it.w1, step)), PUT(dot_of(it.w2, step)), PUT(it.up_lens), PUT(it.up_point);
    real x, y;
    PUT(guessed(point, lens, table + n, &x, &y) != 0);
    PUT(x), PUT(y);
    PUT(within_triangle(x, -1)), PUT(within(y, (real)0.5));
}

kernel void cones(global const real *given, global const MirrorBlock *blocks, global int *made) {
    const size_t n = get_global_id(0);
    global const real *at = given + 9 * n;
    const Vector one = {at[0], at[1], at[2]}, other = {at[3], at[4], at[5]};
    const Fixed lens = {at[6], at[7], at[8]};
    made[2 * n] = may_show(one, lens, blocks + n) != 0;
    made[2 * n + 1] = may_show_part(one, minus(other, one), lens, blocks + n) != 0;
}
"""


def program_of(device: Device, folder: Path) -> Any:
    (folder / "steps.cl").write_text(SOURCE)
    return build(device, folder, "steps.cl", {"INPUT": "float"}, include_folders=(KERNEL_FOLDER,))


def run(device: Device, kernel: Any, count: int, *arrays: NDArray[Any]) -> NDArray[Any]:
    """Return the last of the arrays after the kernel."""
    given = [cl.array.to_device(device.queue, each) for each in arrays]
    kernel(device.queue, (count,), None, *(each.data for each in given))
    return np.asarray(given[-1].get())


class Case(NamedTuple):
    """Triangle with normals, both (3, 3); point, lens and step (3,); weights of the corners 1 and 2; sides."""

    corners: Reals
    normals: Reals
    point: Reals
    lens: Reals
    step: Reals
    weights: Reals
    one_sided: bool

    def row(self) -> Reals:
        """Return the numbers of `MirrorTriangle` in mirrors.cl."""
        edges = self.corners[1:] - self.corners[0]
        products = edges @ self.normals.T  # (edge, corner)
        firsts = [-products[0, 1], -products[1, 2]]
        parts = (self.corners[0], edges, self.normals, products, firsts, [float(self.one_sided)])
        return np.concatenate([np.ravel(each) for each in parts])

    def surface(self, weights: Reals) -> tuple[Reals, Reals]:
        """Return the point of the surface and its normal: it bulges by half of the depths below the tangent planes."""
        b = np.array([1.0 - weights.sum(), *weights])
        flat = b @ self.corners
        depth = np.sum((flat - self.corners) * self.normals, axis=1)
        return flat - 0.5 * (b * depth) @ self.normals, b @ self.normals

    def law(self, weights: Reals) -> Reals:
        """Return R along both edges: 0 where lens and point are reflections of each other."""
        place, n = self.surface(weights)
        return self.weights_of_point(weights) @ (self.point - place) if n.any() else np.zeros(2)

    def weights_of_point(self, weights: Reals) -> Reals:
        """Return the vectors (2, 3) whose products with the way to the point are R."""
        place, n = self.surface(weights)
        c, edges = self.lens - place, self.corners[1:] - self.corners[0]
        return np.array([n @ n * ((c @ e) * n + (c @ n) * e) - 2.0 * (e @ n) * (c @ n) * n for e in edges])


def slopes(function: Any, at: Reals) -> Reals:
    """Return the derivatives (..., 2) by both weights."""
    moves = 1e-5 * np.eye(2)
    return np.stack([(function(at + move) - function(at - move)) / 2e-5 for move in moves], axis=-1)


def some_cases(rng: np.random.Generator, count: int) -> list[Case]:
    cases = []
    for number in range(count):
        turn = Rotation.random(random_state=number)
        corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 0.9, 0.0]]) + rng.normal(0.0, 0.1, (3, 3))
        normals = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.2, (3, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # On each side of the surface, on both sides of it, and near its plane.
        heights = rng.uniform(0.05, 1.5, 2) * rng.choice([-1.0, 1.0, 1.0], 2)
        point, lens = (np.array([*rng.normal(0.3, 0.8, 2), height]) for height in heights)
        vectors = [turn.apply(each) + np.array([0.3, -0.2, 0.4]) for each in (corners, point, lens)]
        cases.append(
            Case(
                vectors[0], turn.apply(normals), vectors[1], vectors[2],
                rng.normal(size=3), rng.uniform(-0.2, 0.8, 2), bool(number % 2),
            )
        )  # fmt: skip
    return cases


def test_law_of_reflection_and_its_derivatives(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    cases = some_cases(rng, 120)
    given = np.array([[*each.point, *each.lens, *each.weights, *each.step] for each in cases], np.float32)
    table = np.array([each.row() for each in cases], np.float32)
    kernel = program_of(device, tmp_path).reflections
    made = run(device, kernel, len(cases), given, table, np.zeros((len(cases), 24), np.float32))
    near = 0
    for case, out in zip(cases, made.astype(np.float64), strict=True):
        at = case.weights
        place, normal = case.surface(at)
        along = slopes(lambda weights, case=case: case.surface(weights)[0], at)
        of_law = slopes(case.law, at)
        expected = [*place, *along.T.ravel(), *case.law(at), *of_law.ravel(), *(case.weights_of_point(at) @ case.step)]
        expected += [(case.lens - place) @ normal, (case.point - place) @ normal]
        # The sums have terms of up to 20.
        np.testing.assert_allclose(out[:19], expected, rtol=2e-5, atol=2e-5)
        # Start: R interpolated linearly between the corners is 0.
        corners = np.array([case.law(np.array(each)) for each in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))])
        start = np.linalg.solve((corners[1:] - corners[0]).T, -corners[0])
        ups = [np.sum((each - case.corners) * case.normals, axis=1) for each in (case.lens, case.point)]
        facing = all(np.any(up > 0.0) for up in ups)
        facing |= not case.one_sided and all(np.any(up < 0.0) for up in ups)
        least = min(*start, 1.0 - start.sum())
        if abs(least + 0.5) < 1e-3 or np.linalg.cond(corners[1:] - corners[0]) > 1e3:
            continue
        assert out[19] == (facing and least > -0.5)
        np.testing.assert_allclose(out[20:22], start, rtol=1e-3, atol=1e-3)
        limited = [np.clip(start[0], -0.1, 1.1), np.clip(start[1], -0.5, 0.5)]
        np.testing.assert_allclose(out[22:], limited, rtol=1e-3, atol=1e-3)
        near += int(facing and least > -0.5)
    assert 20 < near < 100


def reflected(towards: Reals, axis: Reals) -> Reals:
    """Return the direction in which a mirror with the normal `axis` shows a lens in the direction `towards`."""
    return np.asarray(2.0 * (towards @ axis) * axis - towards)


def turned(direction: Reals, angle: float, rng: np.random.Generator) -> Reals:
    """Return a direction turned by an angle about any axis across it."""
    across = np.cross(direction, rng.normal(size=3))
    return np.asarray(Rotation.from_rotvec(angle * across / np.linalg.norm(across)).apply(direction))


def block_row(middle: Reals, radius: float, axis: Reals, half: float, one_sided: bool) -> list[float]:
    """Return the numbers of `MirrorBlock` in mirrors.cl."""
    return [*middle, radius, *axis, np.cos(2.0 * half), np.sin(2.0 * half), float(one_sided), np.sin(half)]


def unit(rng: np.random.Generator) -> Reals:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def test_cone_of_the_points_that_a_block_may_show(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """Points on both sides of the cone's limit, on it, in the ball; lenses behind the mirror and in the ball."""
    rows, given, expected = [], [], []

    def add(point: Reals, lens: Reals, block: list[float], is_shown: bool) -> None:
        given.append([*point, *unit(rng), *lens])
        rows.append(block)
        expected.append(is_shown)

    for _ in range(60):
        middle, axis, radius, half = rng.normal(0.0, 0.5, 3), unit(rng), rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.7)
        lens_way = rng.uniform(0.5, 2.0) * turned(axis, rng.uniform(0.0, 1.3), rng)
        lens, far = middle + lens_way, np.linalg.norm(lens_way)
        on = reflected(lens_way / far, axis)
        seen = np.arcsin(radius / far)
        away = rng.uniform(1.2, 8.0) * radius
        limit = 2.0 * half + seen + np.arcsin(radius / away)
        open_ = 2.0 * half + seen >= 0.5 * np.pi
        block = block_row(middle, radius, axis, half, False)
        for off, is_shown in ((-1e-3, True), (0.0, True), (1e-3, open_), (0.3, open_)):
            add(middle + away * turned(on, limit + off, rng), lens, block, is_shown)
        # The ball contains the point, or the lens; the normals are in a cone of 45 degrees or more.
        add(middle - 0.99 * radius * on, lens, block, True)
        add(middle - away * on, middle + 0.99 * radius * axis, block, True)
        add(middle - away * on, lens, block_row(middle, radius, axis, 0.79, False), True)
        # A lens behind the planes of all mirrors sees none that reflects on one side only.
        behind = np.sin(half) + radius / far
        for more, one_sided, is_shown in ((1e-3, True, False), (-1e-3, True, True), (1e-3, False, True)):
            if behind < 0.95:
                lens_way = far * turned(axis, np.arccos(-behind - more), rng)
                ray = reflected(lens_way / far, axis)
                block = block_row(middle, radius, axis, half, one_sided)
                add(middle + away * ray, middle + lens_way, block, is_shown)
    blocks, inputs = (np.array(each, np.float32) for each in (rows, given))
    made = run(
        device, program_of(device, tmp_path).cones, len(rows), inputs, blocks, np.zeros((len(rows), 2), np.int32)
    )
    np.testing.assert_array_equal(made[:, 0], expected)
    assert 0.3 < np.mean(expected) < 0.9


def deepest(start: Reals, end: Reals, axis: Reals, half: float) -> float:
    """Return the largest depth y axis - |y| cos(half) of a line's points in a cone with its apex at 0."""
    y = start + np.linspace(0.0, 1.0, 4001)[:, None] * (end - start)
    return float(np.max(y @ axis - np.cos(half) * np.linalg.norm(y, axis=1)))


def test_cone_of_the_lines_that_a_block_may_show(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """No line that touches the cone is left out; a line that misses it by 5 mm is."""
    rows, given, depths = [], [], []
    for _ in range(500):
        middle, axis, radius, half = rng.normal(0.0, 0.5, 3), unit(rng), rng.uniform(0.02, 0.1), rng.uniform(0.02, 0.3)
        way = rng.uniform(0.5, 2.0) * turned(axis, rng.uniform(0.0, 1.2), rng)
        far = np.linalg.norm(way)
        on, whole = reflected(way / far, axis), 2.0 * half + np.arcsin(radius / far)
        apex = middle - radius / np.sin(whole) * on
        # Lines that pass the limit of the cone at a small distance, inside or outside, at any place of the line.
        point = turned(on, whole + rng.normal(0.0, 0.1), rng) * rng.uniform(0.3, 2.0)
        along, share = unit(rng) * rng.uniform(0.3, 3.0), rng.uniform(-0.1, 1.1)
        start = point - share * along
        end = start + along
        rows.append(block_row(middle, radius, axis, half, False))
        given.append([*(apex + start), *(apex + end), *(middle + way)])
        depths.append(deepest(start, end, on, whole))
    # Wide cones leave no line out, in any direction: of the normals, of both together, and of a lens in the ball.
    for radius, half, far in ((0.1, 0.8, 1.0), (0.5, 0.6, 0.8), (0.5, 0.1, 0.4)):
        for start in (unit(rng), -unit(rng)):
            rows.append(block_row(np.zeros(3), radius, np.array([0.0, 0.0, 1.0]), half, False))
            given.append([*(3.0 * start), *(-start), 0.0, 0.0, far])
            depths.append(np.inf)
    blocks, inputs, depth = (np.array(each, np.float32) for each in (rows, given, depths))
    made = run(
        device, program_of(device, tmp_path).cones, len(rows), inputs, blocks, np.zeros((len(rows), 2), np.int32)
    )
    seen = made[:, 1] != 0
    assert seen[depth > 1e-4].all()
    assert np.sum(depth > 1e-4) > 100
    # Four tangents decide about all lines that miss it clearly.
    assert not seen[depth < -5e-3].any()
    assert np.sum(depth < -5e-3) > 100
