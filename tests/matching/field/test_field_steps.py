"""Steps of the refinement on a field (kernels/field_pose): equations and steps against their definition in float64.

A wrong derivative or step costs the refinement more steps, and its pose stays.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import field as reference

Reals = NDArray[np.float64]
SOURCE = """
#include "field_pose/field_refinement.h"
#define PUT(value) out[to++] = (value)
#define PUT_MATRIX(of) PUT((of).xx), PUT((of).xy), PUT((of).yy), PUT((of).xt), PUT((of).yt), PUT((of).tt)

kernel void field_steps(global const float *points, global const float *poses, constant float *shapes,
                        global const uchar *nearest, global float *made, const int count, const int rows,
                        const int columns, const float scale_squared, const float max_range_squared,
                        const float damping, const float lever) {
    const size_t n = get_global_id(0);
    global float *out = made + 64 * n;
    int to = 0;
    const field_grid grid = {-2.0f, -1.5f, 4.0f, rows, columns};
    const float3 pose = (float3)(poses[3 * n], poses[3 * n + 1], poses[3 * n + 2]);
    const normal_equations of =
        equations_at(points, count, pose, shapes, nearest, grid, scale_squared, max_range_squared);
    PUT(of.cost), PUT(of.x), PUT(of.y), PUT(of.t);
    PUT_MATRIX(of);
    const float3 step = damped_step(of, damping, lever);
    PUT(step.x), PUT(step.y), PUT(step.z);
    const normal_equations minors = cofactors(of);
    PUT_MATRIX(minors);
    const normal_equations product = sandwich(of, minors, 0.5f);
    PUT_MATRIX(product);
    store_symmetric(out + to, of, 2.0f);
}
"""
LINES = ((-1.8, -0.7, 1.1, 0.4), (0.3, -1.4, 0.9, 1.2))
ARCS = ((-0.6, 0.5, 0.8, -0.4, 1.7), (0.4, -0.3, 0.5, 0.0, 2.0 * np.pi))
# Cells of 0.25 m from (-2, -1.5) on; each has one line or arc.
ROWS, COLUMNS, CELL = 13, 17, 0.25


def shapes() -> NDArray[np.float32]:
    """Return the rows of kernels/distance_map/field.h."""
    rows = []
    for x, y, u, v in LINES:
        half = 0.5 * np.hypot(u - x, v - y)
        rows.append([0.5 * (x + u), 0.5 * (y + v), 0.5 * (u - x) / half, 0.5 * (v - y) / half, half, 0.0, 0.0])
    for x, y, radius, start, end in ARCS:
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        opening = (-2.0, 0.0) if end - start >= 2.0 * np.pi else (np.cos(half), np.sin(half))
        rows.append([x, y, np.cos(middle), np.sin(middle), *opening, radius])
    return np.array(rows, np.float32)


def distances(places: Reals) -> Reals:
    """Return the distances (4, n) of places (n, 2) from each line and arc."""
    lines = [reference.distance_to_line(each, places) for each in LINES]
    return np.array(lines + [reference.distance_to_arc(each, places) for each in ARCS])


def candidates_of(places: Reals, nearest: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the candidates (n, 4) of the cells in which places lie, or of the border's cells."""
    at = np.rint((places - (-2.0, -1.5)) / CELL).astype(int)
    return nearest[np.clip(at[:, 1], 0, ROWS - 1), np.clip(at[:, 0], 0, COLUMNS - 1)]


def residuals(pose: Reals, points: Reals, candidates: NDArray[np.uint8]) -> Reals:
    """Return the distance of each point from the nearest one of its candidates."""
    every = distances(reference.to_field(pose, points))
    return np.array([column[list(set(each))].min() for column, each in zip(every.T, candidates, strict=True)])


@pytest.mark.parametrize(("kinds", "scale"), [(1, 0.3), (4, 0.3), (4, 300.0)])
def test_equations_and_steps(
    device: Device, kinds: int, scale: float, rng: np.random.Generator, tmp_path: Path
) -> None:
    """Cells with one candidate, and cells with up to four of them; points beyond the grid and beyond the range.

    With a scale that is large compared with the distances the costs are far below 1, and have all digits.
    """
    count, reach, damping, lever = 60, 2.2, 0.07, 0.8
    nearest = rng.integers(0, 4, (ROWS, COLUMNS, 4)).astype(np.uint8)
    if kinds == 1:
        nearest[...] = nearest[..., :1]
    else:
        # A repetition of the first candidate ends the list.
        nearest = np.ascontiguousarray(rng.permuted(np.tile(np.arange(4, dtype=np.uint8), (ROWS, COLUMNS, 1)), axis=2))
        nearest[::2, ::2, 2:] = nearest[::2, ::2, :1]
    points = rng.uniform(-2.3, 2.3, (count, 2)).astype(np.float32)
    points[3], points[7] = (np.nan, 0.0), (np.inf, 1.0)
    points[11], points[12] = (np.float32(2.2), 0.0), (np.nextafter(np.float32(2.2), np.float32(3)), 0.0)
    poses = np.column_stack([rng.uniform(-0.6, 0.6, (5, 2)), rng.uniform(-3.0, 3.0, 5)]).astype(np.float32)
    (tmp_path / "steps.cl").write_text(SOURCE)
    program = build(device, tmp_path, "steps.cl", {}, include_folders=(KERNEL_FOLDER,))
    arrays = (points, poses, shapes(), nearest, np.zeros((5, 64), np.float32))
    on_device = [cl.array.to_device(device.queue, each) for each in arrays]
    numbers = [*map(np.int32, (count, ROWS, COLUMNS)), np.float32(scale**2), np.float32(reach) ** 2]
    data = [each.data for each in on_device]
    program.field_steps(device.queue, (5,), None, *data, *numbers, np.float32(damping), np.float32(lever))
    used = points[np.hypot(*points.T.astype(np.float64)) <= np.float32(reach)].astype(np.float64)
    for pose, out in zip(poses.astype(np.float64), on_device[-1].get().astype(np.float64), strict=True):
        places = reference.to_field(pose, used)
        candidates = candidates_of(places, nearest)
        r = residuals(pose, used, candidates)
        moves = 1e-6 * np.eye(3)
        ends = [[residuals(pose + sign * move, used, candidates) for sign in (1.0, -1.0)] for move in moves]
        rows = np.stack([(high - low) / 2e-6 for high, low in ends], axis=-1)
        share = scale**2 / (scale**2 + r**2)
        matrix, right = rows.T @ (share[:, None] ** 2 * rows), rows.T @ (share**2 * r)
        lower = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
        np.testing.assert_allclose(out[0], np.sum(r**2 / (scale**2 + r**2)), rtol=1e-5)
        np.testing.assert_allclose(out[1:4], right, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(out[4:10], [matrix[each] for each in lower], rtol=1e-4, atol=1e-4)
        scales = np.array([1.0, 1.0, lever])
        scaled = matrix * np.outer(scales, scales)
        damped = scaled + damping * np.trace(scaled) * np.eye(3)
        np.testing.assert_allclose(out[10:13], -scales * np.linalg.solve(damped, scales * right), rtol=1e-3, atol=1e-4)
        minors = np.linalg.det(matrix) * np.linalg.inv(matrix)
        np.testing.assert_allclose(out[13:19], [minors[each] for each in lower], rtol=1e-3, atol=1e-2)
        product = 0.5 * matrix @ minors @ matrix
        np.testing.assert_allclose(out[19:25], [product[each] for each in lower], rtol=1e-3, atol=0.05)
        np.testing.assert_allclose(out[25:34].reshape(3, 3), 2.0 * matrix, rtol=1e-4, atol=2e-4)
