"""Steps of the fit of fiducials (kernels/blob): each against its definition in float64.

A fit repairs many faults of its steps: it starts elsewhere, takes more steps, or weights the edges otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.status import Status

Reals = NDArray[np.float64]
SPOKES, PADDED, REACH, OVERLAP = 24, 32, 3.0, 14.0
RATIO = {"ring": 0.6, "square": 0.6, "cross": 0.35}
SHAPES = pytest.mark.parametrize("shape", ["ring", "square", "cross"])
SOURCE = """
#define GROUP_PER_PROBLEM
#include "blob/blob_edges.h"
#include "blob/blob_fit.h"
#include "blob/blob_grey.h"
#include "blob/blob_match.h"
#include "blob/blob_model.h"
#include "blob/blob_start.h"
#define PUT(value) (put(out + to, (value)), to++)
#define PUT_SHAPE(of) PUT((of).x), PUT((of).y), PUT((of).size), PUT((of).angle)

static inline void put(global real *out, real value) {
    if (GROUP_ITEM == 0) *out = value;
}

static inline blob_layout layout_of(constant real *table) {
    return (blob_layout){table, table + PADDED_SPOKES, table + 2 * PADDED_SPOKES, table + 3 * PADDED_SPOKES,
                         table + 4 * PADDED_SPOKES, table + 5 * PADDED_SPOKES};
}

kernel void fits(global const real *given, global const real *shapes, constant real *table, global real *made,
                 const real scale, const real across, const real reach, const real search, const real overlap) {
    const size_t n = get_group_id(0);
    global const real *from = given + n * 7 * PADDED_SPOKES;
    global real *out = made + n * 512;
    const blob_layout layout = layout_of(table);
    const blob_shape shape = {shapes[4 * n], shapes[4 * n + 1], shapes[4 * n + 2], shapes[4 * n + 3]};
    local blob_edges edges;
    local blob_shape start;
    local blob_fit step, fit;
    local blob_quality quality;
    local real distances[PADDED_SPOKES];
    local blob_room room;
    for (int i = GROUP_ITEM; i < PADDED_SPOKES; i += GROUP_ITEMS) {
        edges.x[i] = from[i];
        edges.y[i] = from[PADDED_SPOKES + i];
        edges.amplitude[i] = from[2 * PADDED_SPOKES + i];
        edges.blur[i] = from[3 * PADDED_SPOKES + i];
        edges.noise[i] = from[4 * PADDED_SPOKES + i];
        edges.there[i] = from[5 * PADDED_SPOKES + i];
        edges.flags[i] = (int)from[6 * PADDED_SPOKES + i];
    }
    if (GROUP_ITEM == 0) {
        start = step.shape = fit.shape = shape;
        step.blur = fit.blur = 1;
        step.is_regular = fit.is_regular = 1;
    }
    group_barrier();
    int to = 0;
    const real cosine = cos(shape.angle), sine = sin(shape.angle);
    for (int i = 0; i < SPOKES; i++) {
        const blob_equation each = equation_of(&edges, i, layout, shape, cosine, sine, across);
        PUT(each.residual);
        for (int k = 0; k < FREEDOMS; k++) PUT(each.row[k]);
    }
    start_of(&start, &edges, layout, 1, reach, &room);
    PUT_SHAPE(start);
    PUT(scale_of(&edges, layout, shape, across, reach, distances, &room));
    fit_step(&step, &edges, layout, scale, across, &room);
    PUT(step.is_regular);
    PUT_SHAPE(step.shape);
    PUT(step.blur);
    const real last = fit_shape(&fit, &edges, layout, reach, 1e-3f, across, distances, &room);
    PUT(fit.is_regular);
    PUT_SHAPE(fit.shape);
    PUT(fit.blur);
    PUT(last);
    quality_of(&quality, &edges, layout, shape, scale, across, overlap, &room);
    group_barrier();
    for (int j = 0; j < FREEDOMS; j++)
        for (int k = 0; k < FREEDOMS; k++) PUT(quality.covariance[j][k]);
    PUT(quality.residual), PUT(quality.symmetry), PUT(quality.contrast);
    PUT(quality.inliers), PUT(quality.saturated), PUT(quality.regular);
    const blob_count counted = keep_edges(&edges, layout, shape, search, &room);
    PUT(counted.found), PUT(counted.noise), PUT(counted.blur);
    PUT(counted.outside), PUT(counted.broken);
    for (int i = 0; i < SPOKES; i++) PUT(edges.there[i]);
}

kernel void models(global const real *places, constant real *shape, global real *made) {
    const size_t n = get_global_id(0);
    const blob_shape of = {0, 0, shape[0], shape[1]};
    const blob_model model = model_at(places[2 * n], places[2 * n + 1], of, cos(of.angle), sin(of.angle), shape[2]);
    made[6 * n] = model.level;
    for (int k = 0; k < FREEDOMS + 1; k++) made[6 * n + 1 + k] = model.row[k];
}

kernel void hiding(global const real *places, global real *made) {
    const size_t n = get_global_id(0);
    local blob_hidden hidden;
    if (GROUP_ITEM == 0) {
        hidden.x[0] = 2, hidden.y[0] = 1, hidden.nx[0] = 0, hidden.ny[0] = 1;
        hidden.x[1] = -5, hidden.y[1] = -3, hidden.nx[1] = 1, hidden.ny[1] = 0;
        hidden.half_width = 2, hidden.half_length = 3, hidden.count = 2;
    }
    group_barrier();
    made[n] = hidden_at(&hidden, places[2 * n], places[2 * n + 1]) != 0;
}

kernel void greys(global const CODE *image, global const real *given, global const real *weights, constant real *table,
                  global real *made, const int rows, const int columns, const real scale) {
    const size_t n = get_group_id(0);
    global const real *at = given + 14 * n;
    global real *out = made + n * 128;
    const real x = at[0], y = at[1];
    const blob_shape shape = {at[2], at[3], at[4], at[5]};
    const blob_grey grey = {at[6], at[7], at[8]};
    const real reach = at[11];
    int to = 0;
    local blob_edges edges;
    local blob_hidden hidden;
    local blob_room room;
    local real own[PADDED_SPOKES];
    real to_x, to_y;
    const blob_layout layout = layout_of(table);
    for (int i = GROUP_ITEM; i < PADDED_SPOKES; i += GROUP_ITEMS) {
        edges.x[i] = shape.x + shape.size * layout.bx[i];
        edges.y[i] = shape.y + shape.size * layout.by[i];
        own[i] = weights[i];
    }
    group_barrier();
    PUT(background_of(image, rows, columns, x, y, shape, &edges, own, layout, grey.blur, &room));
    PUT(gravity_of(image, rows, columns, x, y, reach, 1, &room, &to_x, &to_y));
    PUT(to_x), PUT(to_y);
    if (GROUP_ITEM == 0) hide(shape, own, layout, (real)0.3f, grey.blur, &hidden);
    group_barrier();
    PUT(hidden.count), PUT(hidden.half_width), PUT(hidden.half_length);
    PUT(hidden.x[0]), PUT(hidden.y[0]), PUT(hidden.nx[0]), PUT(hidden.ny[0]);
    group_barrier();
    if (GROUP_ITEM == 0 && at[12] == 0) hidden.count = 0;
    group_barrier();
    reals sums[MATCH_SUMS];
    match_summed(image, rows, columns, x + shape.x, y + shape.y, shape, grey, at[9], at[10], scale, reach, &hidden,
                 GROUP_ITEM, sums);
    group_add_up(sums, MATCH_SUMS, ROUND_SUMS, room.sums);
    PUT(sums[MATCH_PIXELS]), PUT(sums[MATCH_COUNT]), PUT(sums[MATCH_WEIGHT]), PUT(sums[MATCH_SQUARE]);
    for (int i = 0; i < UNKNOWNS; i++) PUT(sums[MATCH_RIGHT + i]);
    for (int i = 0; i < UNKNOWN_CELLS; i++) PUT(sums[i]);
}

// The match; its numbers come behind the numbers of `greys`.
kernel void matches(global const CODE *image, global const real *given, global const real *weights,
                    constant real *table, global real *made, const int rows, const int columns, const real scale) {
    const size_t n = get_group_id(0);
    global const real *at = given + 14 * n;
    global real *out = made + n * 128;
    int to = 15 + UNKNOWNS + UNKNOWN_CELLS;
    local blob_hidden hidden;
    local blob_match match;
    local blob_room room;
    if (GROUP_ITEM == 0) {
        const blob_shape shape = {at[2], at[3], at[4], at[5]};
        const blob_grey grey = {at[6], at[7], at[8]};
        match.first = match.shape = shape;
        match.grey = grey;
        match.slope_x = match.slope_y = 0;
        match.state = MATCH_RUNS;
        hidden.count = 0;
    }
    group_barrier();
    match_image(&match, image, rows, columns, at[0], at[1], at[13], (real)1, &hidden, &room);
    PUT(match.state == MATCH_ENDS);
    PUT_SHAPE(match.shape);
    PUT(match.grey.background), PUT(match.grey.contrast), PUT(match.grey.blur);
    for (int j = 0; j < FREEDOMS; j++)
        for (int k = 0; k < FREEDOMS; k++) PUT(match.covariance[j][k]);
}
"""


def level_of(kind: str, dx: Reals, dy: Reals, numbers: Reals, curvature: float = 1.0) -> Reals:
    """Return the level (0 to 1) at a distance from the nominal place, of x, y, size, angle and blur.

    The curvature of an edge lowers the level by its density times half of blur / radius.
    """
    x, y, size, angle, blur = numbers

    def band(along: Reals, half: float) -> Reals:
        return np.asarray(ndtr((half - np.abs(along)) / blur))

    if kind == "ring":
        r = np.hypot(dx - x, dy - y)

        def disc(radius: float) -> Reals:
            t = (radius - r) / blur
            density = np.exp(-0.5 * t**2) / math.sqrt(2.0 * math.pi)
            return np.asarray(ndtr(t) - curvature * density * 0.5 * blur / radius)

        return disc(size) - disc(RATIO[kind] * size)
    u = math.cos(angle) * (dx - x) + math.sin(angle) * (dy - y)
    v = math.cos(angle) * (dy - y) - math.sin(angle) * (dx - x)
    long, wide = size, RATIO[kind] * size
    if kind == "square":
        return band(u, long) * band(v, long)
    return band(u, long) * band(v, wide) + band(u, wide) * (band(v, long) - band(v, wide))


def slopes_of(kind: str, dx: Reals, dy: Reals, numbers: Reals) -> Reals:
    """Return the derivatives of the level without curvature by x, y, size, angle (not of a ring) and blur."""

    def flat(move: Reals) -> Reals:
        return level_of(kind, dx, dy, numbers + move, curvature=0.0)

    by = [(flat(each) - flat(-each)) / 2e-4 for each in 1e-4 * np.eye(5)]
    return np.stack([each for k, each in enumerate(by) if kind != "ring" or k != 3], axis=-1)


@SHAPES
def test_levels_and_their_derivatives(device: Device, shape: str, rng: np.random.Generator, tmp_path: Path) -> None:
    """The polynomial of the step has an error of 2.4e-4; so the product of two steps has twice that."""
    program, _ = prepared(device, tmp_path, shape)
    numbers = np.array([0.0, 0.0, 9.0, 0.0 if shape == "ring" else 0.35, 1.2])
    places = rng.uniform(-15.0, 15.0, (3000, 2)).astype(np.float32)
    shape_numbers = np.array([*numbers[2:]], np.float32)
    made = run(device, (cl.Kernel(program, "models"),), 3000, places, shape_numbers, np.zeros((3000, 6), np.float32))
    dx, dy = places.astype(np.float64).T
    np.testing.assert_allclose(made[:, 0], level_of(shape, dx, dy, numbers), rtol=0, atol=8e-4)
    expected = slopes_of(shape, dx, dy, numbers)
    # Of x, y, size, angle (in units of the size) and blur.
    bounds = np.array([4e-3, 4e-3, 4e-3, 0.02, 0.015])[[k for k in range(5) if shape != "ring" or k != 3]]
    assert np.all(np.abs(made[:, 1 : 1 + len(bounds)] - expected) <= bounds)


def operation(shape: Any) -> FindBlobs:
    return FindBlobs(
        threshold=20.0, shape=shape, ratio=RATIO[shape], spokes=SPOKES, polarity="either", count=1, variant="work_item"
    )


def prepared(device: Device, folder: Path, shape: str) -> tuple[Any, Reals]:
    """Return the program of the steps, and the table of the rulers: (6, PADDED)."""
    launch = operation(shape).launch(device, (64, 64), np.dtype(np.float32))
    (folder / "steps.cl").write_text(SOURCE)
    program = build(device, folder, "steps.cl", launch.defines, include_folders=(KERNEL_FOLDER,))
    return program, np.asarray(launch.arguments[1])


def run(device: Device, kernels: tuple[Any, ...], count: int, *arguments: Any, group: int = 1) -> Reals:
    """Return the last array argument after the kernels have run with `count` groups, or items with a group of 1."""
    given = [cl.array.to_device(device.queue, each) if isinstance(each, np.ndarray) else each for each in arguments]
    data = [each.data if isinstance(each, cl.array.Array) else each for each in given]
    for kernel in kernels:
        kernel(device.queue, (count * group,), (group,) if group > 1 else None, *data)
    arrays = [each for each in given if isinstance(each, cl.array.Array)]
    return np.asarray(arrays[-1].get(), np.float64)


def grey_kernels(program: Any) -> tuple[Any, Any]:
    """Return the kernels of the steps on grey levels: sums over the pixels, and the match."""
    return cl.Kernel(program, "greys"), cl.Kernel(program, "matches")


def tukey(z: Reals) -> Reals:
    return np.where(np.abs(z) < 6.0, (1.0 - (z / 6.0) ** 2) ** 2, 0.0)


def tukey_slope(z: Reals) -> Reals:
    return np.where(np.abs(z) < 6.0, (1.0 - (z / 6.0) ** 2) * (1.0 - 5.0 * (z / 6.0) ** 2), 0.0)


@dataclass
class Edges:
    """Edges of a fiducial (SPOKES,), and the normals (SPOKES, 2) and heights of their sides for a size of 1."""

    x: Reals
    y: Reals
    amplitude: Reals
    blur: Reals
    noise: Reals
    there: Reals
    flags: NDArray[np.int_]
    table: Reals
    is_round: bool
    freedoms: int = field(init=False)

    def __post_init__(self) -> None:
        self.freedoms = 3 if self.is_round else 4

    def normals(self, angle: float) -> Reals:
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return np.asarray(self.table[2:4, :SPOKES].T @ turn.T)

    def residuals(self, shape: Reals, bent: float) -> tuple[Reals, Reals]:
        """Return the distances outside of a shape (x, y, size, angle), and their derivatives with the sign turned."""
        way, height = np.column_stack([self.x, self.y]) - shape[:2], self.table[4, :SPOKES]
        if self.is_round:
            square = np.sum(way**2, axis=1)
            off = np.sqrt(square + bent + 0.5 * bent**2 / square) - shape[2] * height
            return off, np.column_stack([way / np.sqrt(square)[:, None], height])
        normal = self.normals(shape[3])
        lever = normal[:, 1] * way[:, 0] - normal[:, 0] * way[:, 1]
        return np.sum(normal * way, axis=1) - shape[2] * height, np.column_stack([normal, height, lever])

    def step(self, shape: Reals, scale: float, bent: float) -> tuple[Reals, float]:
        """Return the next shape of the reweighted fit, and the weighted mean of the blurs."""
        off, rows = self.residuals(shape, bent)
        weight = self.there * tukey(off / scale)
        move = np.linalg.solve((rows * weight[:, None]).T @ rows, rows.T @ (weight * off))
        return shape + np.append(move, np.zeros(4 - self.freedoms)), float(weight @ self.blur / weight.sum())

    def scale(self, shape: Reals, bent: float, reach: float) -> float:
        """Return the scale by the median deviation, which the kernel rounds down by 0.8 % at most."""
        size = np.abs(self.residuals(shape, bent)[0])
        within = np.sort(size[(self.there > 0.0) & (size <= reach)])
        few = 1.0 + 1.0 / max(len(within) - self.freedoms, 1)
        return 1.4826022185056018 * few * float(within[len(within) // 2])

    def start(self, near: Reals, reach: float) -> tuple[float, Reals]:
        """Return the least sum of truncated squares of the shapes through three edges, and that shape."""
        least, best = SPOKES * reach**2, near
        for one, other in ((4, 8), (5, 10), (3, 6), (2, 6)):
            for i in range(SPOKES):
                three = np.array([i, i + one * SPOKES // 16, i + other * SPOKES // 16]) % SPOKES
                if not self.there[three].all() or np.linalg.cond(self.residuals(near, 0.0)[1][three, :3]) > 1e6:
                    continue
                shape = near.copy()
                for _ in range(3):
                    off, rows = self.residuals(shape, 0.0)
                    shape[:3] += np.linalg.solve(rows[three, :3], off[three])
                square = self.residuals(shape, 0.0)[0] ** 2
                loss = float(np.sum(np.where((self.there > 0.0) & (square < reach**2), square, reach**2)))
                if loss < least:
                    least, best = loss, shape
        return least, best


def some_edges(rng: np.random.Generator, table: Reals, shape: Reals, is_round: bool) -> Edges:
    """Return noisy edges about a shape: outliers, absent edges, amplitudes of both signs, no two equal numbers."""
    turn = np.array([[math.cos(shape[3]), -math.sin(shape[3])], [math.sin(shape[3]), math.cos(shape[3])]])
    base, normal = (shape[2] * table[:2, :SPOKES].T @ turn.T, table[2:4, :SPOKES].T @ turn.T)
    off = rng.normal(0.0, 0.15, SPOKES) + np.where(rng.random(SPOKES) < 0.2, rng.uniform(-4.0, 4.0, SPOKES), 0.0)
    place = shape[:2] + base + off[:, None] * normal
    there = (rng.random(SPOKES) > 0.1).astype(float)
    amplitude = -rng.uniform(40.0, 120.0, SPOKES) * np.where(rng.random(SPOKES) < 0.2, -1.0, 1.0) * there
    numbers = (amplitude, rng.uniform(0.5, 2.0, SPOKES), rng.uniform(0.01, 0.04, SPOKES), there)
    flags = (rng.random((3, SPOKES)) < 0.1).astype(int)
    every_flag = Status.SATURATED * flags[0] + Status.OUT_OF_RANGE * flags[1] + Status.NOT_FINITE * flags[2]
    return Edges(*place.T, *numbers, every_flag, table, is_round)


@SHAPES
def test_steps_of_the_fit_to_edges(device: Device, shape: str, rng: np.random.Generator, tmp_path: Path) -> None:
    program, table = prepared(device, tmp_path, shape)
    table64, is_round = table.astype(np.float64), shape == "ring"
    scale, across, search = 0.4, 0.6 if is_round else 0.0, 2.0
    edges, shapes = [], []
    for _ in range(4):
        true = np.array([*rng.normal(0.0, 1.0, 2), rng.uniform(8.0, 12.0), 0.0 if is_round else rng.normal(0.3, 0.3)])
        edges.append(some_edges(rng, table64, true, is_round))
        shapes.append(true + np.append(rng.normal(0.0, 0.2, 3), 0.0 if is_round else 0.02))
    given = np.zeros((len(edges), 7, PADDED), np.float32)
    for row, each in zip(given, edges, strict=True):
        row[:, :SPOKES] = (each.x, each.y, each.amplitude, each.blur, each.noise, each.there, each.flags)
    numbers = (np.float32(value) for value in (scale, across, REACH, search, OVERLAP))
    inputs = (given, np.array(shapes, np.float32), table, np.zeros((len(edges), 512), np.float32))
    made = run(device, (cl.Kernel(program, "fits"),), len(edges), *inputs, *numbers, group=64)
    for each, near, out in zip(edges, shapes, made, strict=True):
        assert_fits(each, near, out, scale, across, search)


def assert_fits(each: Edges, near: Reals, out: Reals, scale: float, across: float, search: float) -> None:
    """Assert that the numbers of the kernel `fits` for some edges, near a shape, have the values of `Edges`."""
    freedoms, bent = each.freedoms, across
    parts = np.split(out, np.cumsum([SPOKES * (freedoms + 1), 4, 1, 6, 7, freedoms**2, 6, 5, SPOKES]))
    equations, start, scale_, step, fit, covariance, quality, kept, there, _ = parts
    off, rows = each.residuals(near, bent)
    np.testing.assert_allclose(equations.reshape(SPOKES, -1), np.column_stack([off, rows]), rtol=1e-5, atol=1e-5)
    least, best = each.start(near, REACH)
    np.testing.assert_allclose(start, best, rtol=0, atol=2e-4)
    assert least < SPOKES * REACH**2
    exact = each.scale(near, bent, REACH)
    assert exact * (1.0 - 1.0 / 128.0) < scale_[0] * (1.0 + 1e-4)
    assert scale_[0] < exact * (1.0 + 1e-4)
    # The blur before the step is 1.
    blur_first = 1.0 + across if each.is_round else 0.0
    moved, blur = each.step(near, scale, blur_first)
    np.testing.assert_allclose(step, [1.0, *moved, blur], rtol=1e-4, atol=1e-4)
    assert_converged(each, near, fit, across)
    weight, slope = each.there * tukey(off / scale), tukey_slope(off / scale)
    is_in = weight > 0.0
    count, z = np.sum(is_in), off / scale
    mean = slope[is_in].sum() / count
    squares = np.sum(weight**2 * z**2)
    measured = scale**2 * squares / ((count - freedoms) * mean**2)
    efficiency = float(operation("ring").launch(Device.best(), (64, 64), np.dtype(np.float32)).defines["EFFICIENCY"])
    predicted = each.noise[is_in].sum() / (count * efficiency)
    variance = max(measured, predicted) * max(OVERLAP / near[2], 1.0)
    expected = variance * np.linalg.inv(rows[is_in].T @ rows[is_in])
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        covariance.reshape(freedoms, -1) / np.outer(size, size), expected / np.outer(size, size), rtol=0, atol=2e-3
    )
    strength = np.abs(each.amplitude)
    opposite = np.roll(strength, SPOKES // 2)
    alike = np.minimum(strength, opposite) / np.maximum(np.maximum(strength, opposite), 1e-30)
    numbers = [
        scale * math.sqrt(squares / weight.sum()),
        np.sum(np.sqrt(weight * np.roll(weight, SPOKES // 2)) * alike) / SPOKES,
        -np.sum(weight * each.amplitude) / weight.sum(),
        count,
        np.any(each.flags[is_in] & Status.SATURATED),
        1.0,
    ]
    np.testing.assert_allclose(quality, numbers, rtol=1e-3, atol=1e-5)
    at_start = each.residuals(near, 0.0)[0]
    sign = math.copysign(1.0, each.amplitude.sum())
    keeps = (each.there > 0.0) & (np.abs(at_start) <= search) & (sign * each.amplitude > 0.0)
    np.testing.assert_array_equal(there, keeps)
    counts = [np.sum(each.flags & flag > 0) for flag in (Status.OUT_OF_RANGE, Status.NOT_FINITE)]
    means = [each.noise[keeps].mean(), each.blur[keeps].mean()]
    np.testing.assert_allclose(kept, [keeps.sum(), *means, *counts], rtol=1e-5)


def assert_converged(each: Edges, near: Reals, fit: Reals, across: float) -> None:
    """Assert that a fit has halved its scale from the reach to 0.6 px, then estimated it twice."""
    predicted = math.sqrt(1e-3)
    least = max(0.6 / 6.0, predicted)
    scale, shape, blur = max(REACH / 6.0, least), near, 1.0

    def bent() -> float:
        return blur + across if each.is_round else 0.0

    for _ in range(12):
        shape, blur = each.step(shape, scale, bent())
        if scale <= least:
            break
        scale = max(scale / 2.0, least)
    for _ in range(2):
        scale = min(max(each.scale(shape, bent(), 6.0 * scale), predicted), least)
        shape, blur = each.step(shape, scale, bent())
    # The kernel rounds its scale down by up to 0.8 %.
    np.testing.assert_allclose(fit, [1.0, *shape, blur, scale], rtol=0.01, atol=0.01)


SIZE = (61, 72)


@SHAPES
@pytest.mark.parametrize("is_hidden", [False, True])
def test_steps_of_the_fit_to_grey_levels(
    device: Device, shape: Any, is_hidden: bool, rng: np.random.Generator, tmp_path: Path
) -> None:
    """Sums over the pixels, with slopes of the background, parts that are hidden, and pixels beyond the image."""
    program, table = prepared(device, tmp_path, shape)
    freedoms, is_round = 3 if shape == "ring" else 4, shape == "ring"
    weights = np.ones(PADDED)
    weights[[3, 17]] = 0.49, 0.5
    weights[SPOKES:] = 0.0
    kernels = grey_kernels(program)
    rows, columns = np.indices(SIZE).astype(np.float64)
    for x, y, reach in ((40.0, 33.0, 13.0), (11.45, 22.75, 15.5)):
        numbers = np.array([0.4, -0.3, 9.0, 0.0 if is_round else 0.3, 1.2])
        background, contrast, slope_x, slope_y = 50.0, 80.0, 0.11, -0.07
        centre = np.array([x, y]) + numbers[:2]
        dx, dy = columns - centre[0], rows - centre[1]
        at = np.concatenate([[0.0, 0.0], numbers[2:]])
        level = level_of(shape, dx, dy, at)
        plane = slope_x * dx / 9.0 + slope_y * dy / 9.0
        image = (background + contrast * (level + plane) + rng.normal(0.0, 12.0, SIZE)).astype(np.float32)
        given = [x, y, *numbers[:4], background, contrast, numbers[4], slope_x, slope_y, reach, is_hidden, 3.0]
        arguments = (np.array(given, np.float32), weights.astype(np.float32), table, np.zeros(128, np.float32))
        scale = 0.2
        out = run(device, kernels, 1, image, *arguments, *map(np.int32, SIZE), np.float32(scale), group=64)
        # Background: the nearest pixels 2.5 blurs and half a pixel beyond the edges.
        turn = np.array([[math.cos(numbers[3]), -math.sin(numbers[3])], [math.sin(numbers[3]), math.cos(numbers[3])]])
        beyond = 2.5 * numbers[4] + 0.5
        base, normal = table[:2, :SPOKES].T.astype(np.float64), table[2:4, :SPOKES].T.astype(np.float64)
        place = np.rint(np.array([x, y]) + numbers[:2] + 9.0 * base + beyond * normal @ turn.T).astype(int)
        inside = np.all((place >= 0) & (place < SIZE[::-1]), axis=1)
        levels = image[place[inside, 1], place[inside, 0]].astype(np.float64)
        assert out[0] == pytest.approx(np.average(levels, weights=weights[:SPOKES][inside]), rel=1e-5)
        # Hidden: about the edge whose weight is below a half.
        edge, out_of = 9.0 * turn @ base[3], turn @ normal[3]
        half_width, half_length = 0.3 * 9.0, 5.0 * numbers[4] + 2.0 + 1.0
        np.testing.assert_allclose(out[4:11], [1, half_width, half_length, *edge, *out_of], rtol=1e-5, atol=1e-5)
        along = (dx - edge[0]) * out_of[0] + (dy - edge[1]) * out_of[1]
        beside = (dx - edge[0]) * out_of[1] - (dy - edge[1]) * out_of[0]
        hidden = is_hidden & (np.abs(along) < half_length) & (np.abs(beside) < half_width)
        used = (np.hypot(dx, dy) <= reach) & ~hidden
        # The kernel's centre has rounding errors.
        equations = np.stack(
            [*np.moveaxis(slopes_of(shape, dx, dy, at), -1, 0), level, np.ones(SIZE), dx / 9.0, dy / 9.0], axis=-1
        )[used]
        residual = (image[used] - background) / contrast - level[used] - plane[used]
        weight = tukey(residual / scale)
        expected = [np.sum(used), np.sum(weight > 0.0), weight.sum(), np.sum(weight * residual**2)]
        np.testing.assert_allclose(out[11:13], expected[:2], rtol=0, atol=2)
        np.testing.assert_allclose(out[13:15], expected[2:], rtol=3e-3)
        matrix = (equations * weight[:, None]).T @ equations
        right = equations.T @ (weight * residual)
        size = np.sqrt(np.diag(matrix))
        unknowns, lower = freedoms + 5, np.tril_indices(freedoms + 5)
        start = 15 + unknowns
        np.testing.assert_allclose(out[15:start] / size, right / size, rtol=0, atol=6e-3)
        found = out[start : start + len(lower[0])] / np.outer(size, size)[lower]
        np.testing.assert_allclose(found, (matrix / np.outer(size, size))[lower], rtol=0, atol=3e-3)


@SHAPES
def test_the_match_finds_all_unknowns(device: Device, shape: Any, rng: np.random.Generator, tmp_path: Path) -> None:
    """From a start that is off in all of them; its covariance is that of least squares over the pixels."""
    program, table = prepared(device, tmp_path, shape)
    is_round = shape == "ring"
    kernels = grey_kernels(program)
    rows, columns = np.indices(SIZE).astype(np.float64)
    numbers = np.array([0.4, -0.3, 9.0, 0.0 if is_round else 0.3, 1.2])
    dx, dy = columns - 36.0, rows - 30.0
    level = level_of(shape, dx, dy, numbers)
    plane = 50.0 + 0.3 * (dx - numbers[0]) - 0.2 * (dy - numbers[1])
    off = np.array([0.2, -0.15, 0.25, 0.0 if is_round else 0.03])
    for noise, contrast in ((0.0, 80.0), (2.0, -80.0)):
        image = (plane + contrast * level + rng.normal(0.0, noise, SIZE)).astype(np.float32)
        start = [36.0, 30.0, *(numbers[:4] + off), 56.0, 0.9 * contrast, 1.35, 0.0, 0.0, 8.0, 0.0, noise]
        arguments = (np.array(start, np.float32), np.ones(PADDED, np.float32), table, np.zeros(128, np.float32))
        out = run(device, kernels, 1, image, *arguments, *map(np.int32, SIZE), np.float32(0.2), group=64)
        freedoms = 3 if is_round else 4
        at = 15 + freedoms + 5 + (freedoms + 5) * (freedoms + 6) // 2
        found = out[at : at + 8]
        assert found[0] == 1.0
        if noise == 0.0:
            np.testing.assert_allclose(found[1:5], numbers[:4], rtol=0, atol=2e-3)
            np.testing.assert_allclose(found[5:], [50.0, contrast, numbers[4]], rtol=3e-3)
            continue
        reach = numbers[2] + off[2] + 5.0 * 1.35 + 2.0
        used = np.hypot(dx - numbers[0], dy - numbers[1]) <= reach
        columns_of = [*np.moveaxis(contrast * slopes_of(shape, dx, dy, numbers), -1, 0), level, np.ones(SIZE), dx, dy]
        equations = np.stack(columns_of, axis=-1)[used]
        expected = noise**2 * np.linalg.inv(equations.T @ equations)[:freedoms, :freedoms]
        size = np.sqrt(np.diag(expected))
        covariance = out[at + 8 : at + 8 + freedoms**2].reshape(freedoms, freedoms)
        # Tukey's weights cost up to a sixth of the variance.
        np.testing.assert_allclose(covariance / np.outer(size, size), expected / np.outer(size, size), atol=0.2)
        assert np.all(np.abs(found[1 : 1 + freedoms] - numbers[:freedoms]) < 4.0 * size)


@pytest.mark.parametrize(("lost", "off", "is_found"), [(0.25, 0.2, 1), (0.34, 0.2, 0), (0.0, 0.9, 1), (0.0, 1.2, 0)])
def test_a_match_of_few_pixels_or_far_from_its_start_fails(
    device: Device, lost: float, off: float, is_found: int, tmp_path: Path
) -> None:
    """30 % of the pixels may be outliers, and the fiducial may lie 1 px from the shape fitted to the edges."""
    program, table = prepared(device, tmp_path, "square")
    rows, columns = np.indices(SIZE).astype(np.float64)
    dx, dy = columns - 36.0, rows - 30.0
    image = 50.0 + 80.0 * level_of("square", dx, dy, np.array([0.0, 0.0, 8.0, 0.1, 1.2]))
    distance, reach = np.hypot(dx - off, dy), 8.0 + 5.0 * 1.2 + 2.0
    outside = np.sort(distance[distance <= reach])
    image[distance > outside[int((1.0 - lost) * (outside.size - 1))]] += 500.0 if lost else 0.0
    start = [36.0, 30.0, off, 0.0, 8.0, 0.1, 50.0, 80.0, 1.2, 0.0, 0.0, 8.0, 0.0, 2.0]
    arguments = (np.array(start, np.float32), np.ones(PADDED, np.float32), table, np.zeros(128, np.float32))
    kernels = grey_kernels(program)
    out = run(device, kernels, 1, image.astype(np.float32), *arguments, *map(np.int32, SIZE), np.float32(0.2), group=64)
    assert out[15 + 9 + 45] == is_found


@pytest.mark.parametrize("off", [0.092, 0.108])
@pytest.mark.parametrize("unknown", range(5))
def test_a_match_ends_with_the_first_small_step(
    device: Device, unknown: int, off: float, rng: np.random.Generator, tmp_path: Path
) -> None:
    """A step of less than 0.05 blurs is the last one, whether it is of x, y, size, angle or blur."""
    program, table = prepared(device, tmp_path, "cross")
    rows, columns = np.indices(SIZE).astype(np.float64)
    numbers, background, contrast, noise = np.array([0.4, -0.3, 9.0, 0.3, 2.0]), 50.0, 80.0, 3.0
    dx, dy = columns - 36.0, rows - 30.0
    image = (background + contrast * level_of("cross", dx, dy, numbers)).astype(np.float32)
    start = numbers.copy()
    start[unknown] += off / (9.0 if unknown == 3 else 1.0)
    scale, reach = (0.1 + 4.0 * noise / contrast) / 6.0, start[2] + 5.0 * start[4] + 2.0
    given = [36.0, 30.0, *start[:4], background, contrast, start[4], 0.0, 0.0, reach, 0.0, noise]
    arguments = (np.array(given, np.float32), np.ones(PADDED, np.float32), table, np.zeros(128, np.float32))
    out = run(device, grey_kernels(program), 1, image, *arguments, *map(np.int32, SIZE), np.float32(scale), group=64)
    unknowns = 9
    matrix = np.zeros((unknowns, unknowns))
    matrix[np.tril_indices(unknowns)] = out[15 + unknowns : 15 + unknowns + 45]
    step = np.linalg.solve(matrix + np.tril(matrix, -1).T, out[15 : 15 + unknowns])[:5]
    found = out[15 + unknowns + 45 + 1 :]
    found = np.array([*found[:4], found[6]])
    is_last = np.linalg.norm(step * [1.0, 1.0, 1.0, 9.0, 1.0]) < 0.05 * (start[4] + step[4])
    assert is_last == (off < 0.1)
    further = np.abs(found - start - step).max()
    assert further < 1e-5 if is_last else further > 5e-4


def gravity(image: Reals, x: float, y: float, reach: float) -> Reals:
    """Return the centroid of the levels over the mean level of a ring of 2 px, relative to (x, y)."""
    rows, columns = np.indices(image.shape)
    dx, dy = columns - x, rows - y
    square = dx**2 + dy**2
    disc, ring = square <= reach**2, (square > reach**2) & (square <= (reach + 2.0) ** 2)
    level = image[disc] - image[ring].mean()
    return np.array([level @ dx[disc], level @ dy[disc]]) / level.sum()


def test_centroids(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """Pixels at the limits of disc and ring belong to them; no other pixel matters, and the ring is in the image."""
    program, table = prepared(device, tmp_path, "square")
    kernels = grey_kernels(program)
    rows, columns = np.indices(SIZE)
    last_x, last_y = SIZE[1] - 1, SIZE[0] - 1
    off = 1.0 / 64.0
    cases = {
        (30.0, 27.0, 5.0): 1,
        (31.25, 40.75, 6.0): 1,
        (7.0, 20.0, 5.0): 1,
        (7.0 - off, 20.0, 5.0): 0,
        (20.0, 7.0, 5.0): 1,
        (20.0, 7.0 - off, 5.0): 0,
        (last_x - 7.0, 20.0, 5.0): 1,
        (last_x - 7.0 + off, 20.0, 5.0): 0,
        (20.0, last_y - 7.0, 5.0): 1,
        (20.0, last_y - 7.0 + off, 5.0): 0,
    }
    for (x, y, reach), is_inside in cases.items():
        image = rng.uniform(0.0, 90.0, SIZE) + 60.0 * (np.hypot(columns - x - 0.5, rows - y) < 3.0)
        image[np.hypot(columns - x, rows - y) > reach + 2.0] = np.nan
        image = image.astype(np.float32)
        given = [x, y, 0.0, 0.0, 9.0, 0.0, 50.0, 80.0, 1.2, 0.0, 0.0, reach, 0.0, 3.0]
        arguments = (np.array(given, np.float32), np.ones(PADDED, np.float32), table, np.zeros(128, np.float32))
        out = run(device, kernels, 1, image, *arguments, *map(np.int32, SIZE), np.float32(0.2), group=64)
        assert out[1] == is_inside
        if is_inside:
            np.testing.assert_allclose(out[2:4], gravity(image.astype(np.float64), x, y, reach), rtol=1e-4, atol=1e-4)


def test_a_centroid_outside_of_the_disc_is_none(device: Device, tmp_path: Path) -> None:
    program, table = prepared(device, tmp_path, "square")
    rows, columns = np.indices(SIZE).astype(np.float64)
    for to_x, to_y in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        for slope, is_found in ((0.5, 1), (1.5, 0)):
            # The mean square of a coordinate in a disc is a quarter of the square of its radius.
            plane = slope * 4.0 / 5.0 * (to_x * (columns - 30.0) + to_y * (rows - 28.0))
            image = np.where(np.hypot(columns - 30.0, rows - 28.0) <= 5.0, 80.0 * (1.0 + plane), 0.0)
            given = [30.0, 28.0, 0.0, 0.0, 9.0, 0.0, 50.0, 80.0, 1.2, 0.0, 0.0, 5.0, 0.0, 3.0]
            arguments = (np.array(given, np.float32), np.ones(PADDED, np.float32), table, np.zeros(128, np.float32))
            kernels = grey_kernels(program)
            out = run(
                device,
                kernels,
                1,
                image.astype(np.float32),
                *arguments,
                *map(np.int32, SIZE),
                np.float32(0.2),
                group=64,
            )
            assert out[1] == is_found


def test_hidden_parts_of_the_contour(device: Device, tmp_path: Path) -> None:
    """Two rectangles across and along x; their border is not hidden."""
    program, _ = prepared(device, tmp_path, "square")
    places = np.stack(np.meshgrid(np.arange(-9.0, 10.0), np.arange(-9.0, 10.0)), axis=-1).reshape(-1, 2)
    x, y = places.T
    arguments = (places.astype(np.float32), np.zeros(len(places), np.float32))
    made = run(device, (cl.Kernel(program, "hiding"),), len(places), *arguments)
    one, other = (np.abs(y - 1.0) < 3.0) & (np.abs(x - 2.0) < 2.0), (np.abs(x + 5.0) < 3.0) & (np.abs(y + 3.0) < 2.0)
    np.testing.assert_array_equal(made, one | other)
