"""Losses, order statistics and steps of the line fit (kernels/common/robust.h, kernels/line_fit), in float64."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
TUNING = 2.25
LOSSES = {
    # psi(z) / z, psi'(z) and rho(z) of residuals up to the tuning constant c, and beyond it
    "": (lambda z: (1.0 + 0.0 * z, 1.0 + 0.0 * z, 0.5 * z**2),) * 2,
    "HUBER": (
        lambda z: (1.0 + 0.0 * z, 1.0 + 0.0 * z, 0.5 * z**2),
        lambda z: (TUNING / np.maximum(np.abs(z), TUNING), 0.0 * z, TUNING * np.abs(z) - 0.5 * TUNING**2),
    ),
    "TUKEY": (
        lambda z: (
            (1.0 - (z / TUNING) ** 2) ** 2,
            (1.0 - (z / TUNING) ** 2) * (1.0 - 5.0 * (z / TUNING) ** 2),
            TUNING**2 / 6.0 * (1.0 - (1.0 - (z / TUNING) ** 2) ** 3),
        ),
        lambda z: (0.0 * z, 0.0 * z, 0.0 * z + TUNING**2 / 6.0),
    ),
    "CUT": (
        lambda z: (1.0 + 0.0 * z, 1.0 + 0.0 * z, 0.5 * z**2),
        lambda z: (0.0 * z, 0.0 * z, 0.0 * z + 0.5 * TUNING**2),
    ),
}
ROBUST = """
#include "common/robust.h"
kernel void losses(global const real *given, global real *made) {
    const size_t n = get_global_id(0);
    made[3 * n] = loss_weight(given[n]);
    made[3 * n + 1] = loss_slope(given[n]);
    made[3 * n + 2] = loss_of(given[n]);
}
kernel void ranks(global const real *given, const int count, global real *made) {
    const size_t n = get_global_id(0);
    real values[64];
    for (int i = 0; i < count; i++) values[i] = given[i];
    made[2 * n] = ranked_of(values, count, (masks)(int)(n + 1), 0);
    made[2 * n + 1] = ranked_of(values, count, (masks)(int)(n + 1), BITS_TO_ONE_PERCENT);
}
"""
LINES = """
#include "line_fit/line_fit.h"
#include "common/least_squares.h"
#define PUT(value) out[to++] = (value)
#define PUT_LINE(of) PUT((of).x), PUT((of).y), PUT((of).c), PUT((of).s)

kernel void line_steps(global const real *given, global const real *start, constant int *pairs, global real *made,
                       const int count, const int trials, const real per_scale, const real reach) {
    const size_t n = get_global_id(0);
    real x[COUNT], y[COUNT], certainty[COUNT], distances[COUNT];
    for (int i = 0; i < count; i++) {
        global const real *at = given + 3 * (n * count + i);
        x[i] = at[0], y[i] = at[1], certainty[i] = at[2];
    }
    const laned_points all = {x, y, certainty, distances, count};
    const laned_line line = {start[4 * n], start[4 * n + 1], start[4 * n + 2], start[4 * n + 3]};
    global real *out = made + 40 * n;
    int to = 0;
    masks coincide = 0;
    PUT(line_distance(line, x[0], y[0])), PUT(line_sigmas(line, point_at(all, 0)));
    const laned_line middle = line_middle(all), stepped = line_step(line, all, per_scale, &coincide);
    PUT_LINE(middle);
    PUT_LINE(stepped);
    PUT(coincide != 0);
    PUT(line_scale(line, all, reach, FEW_TRIED, 0.01f)), PUT(line_scale(line, all, reach, FEW_FITTED, 100.0f));
    PUT(line_score(line, all, 7));
    const laned_line first = line_start(all, pairs, trials, 7);
    PUT_LINE(first);
    laned_fit fit = {line, 1 / per_scale, 0, 0, 0, 0, 0, 0};
    line_variances(&fit, all, 1e-30f);
    PUT(fit.variance_of_angle), PUT(fit.variance_of_offset), PUT(fit.inliers), PUT(fit.is_open != 0);
}
"""


def run(device: Device, kernel: Any, count: int, *arguments: Any) -> Reals:
    """Return the last of the arrays after the kernel."""
    given = [cl.array.to_device(device.queue, each) if isinstance(each, np.ndarray) else each for each in arguments]
    kernel(device.queue, (count,), None, *(each.data if isinstance(each, cl.array.Array) else each for each in given))
    arrays = [each for each in given if isinstance(each, cl.array.Array)]
    return np.asarray(arrays[-1].get(), np.float64)


def program_of(device: Device, folder: Path, source: str, loss: str, **more: Any) -> Any:
    (folder / "steps.cl").write_text(source)
    defines = {"TUNING_CONSTANT": TUNING, **({f"LOSS_{loss}": None} if loss else {}), **more}
    return build(device, folder, "steps.cl", defines, include_folders=(KERNEL_FOLDER,))


def of_loss(loss: str, z: Reals) -> tuple[Reals, Reals, Reals]:
    """Return weight, slope and loss of residuals."""
    within, beyond = (each(z) for each in LOSSES[loss])
    return tuple(np.where(np.abs(z) <= TUNING, one, other) for one, other in zip(within, beyond, strict=True))


@pytest.mark.parametrize("loss", list(LOSSES))
def test_losses(device: Device, loss: str, tmp_path: Path) -> None:
    """Small and large residuals of both signs, and the tuning constant itself, which belongs to the inliers."""
    z = np.array([0.01, 0.4, 1.1, 1.9, TUNING, 2.3, 3.7, 50.0])
    z = np.concatenate([z, -z]).astype(np.float32)
    made = run(device, program_of(device, tmp_path, ROBUST, loss).losses, z.size, z, np.zeros((z.size, 3), np.float32))
    np.testing.assert_allclose(made, np.stack(of_loss(loss, z.astype(np.float64)), axis=-1), rtol=2e-6, atol=1e-6)


def test_order_statistics(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """Of zeros, equal values, tiny and huge ones, and infinity; exactly, and rounded down to a part in 128."""
    values = np.concatenate([[0.0, 0.0, 1e-30, 3e30, np.inf, 0.5, 0.5, 0.5], rng.uniform(0.0, 9.0, 20)])
    values = rng.permutation(values).astype(np.float32)
    kernel = program_of(device, tmp_path, ROBUST, "").ranks
    made = run(device, kernel, values.size, values, np.int32(values.size), np.zeros((values.size, 2), np.float32))
    expected = np.sort(values)
    np.testing.assert_array_equal(made[:, 0], expected)
    rounded = (expected.view(np.uint32) & np.uint32(0xFFFF0000)).view(np.float32)
    np.testing.assert_array_equal(made[:, 1], rounded)


def turned_line(points: Reals, weight: Reals, line: Reals) -> Reals:
    """Return the line of least weighted squared distances, turned by at most 90 degrees from a line."""
    middle = weight @ points / weight.sum()
    _, axes = np.linalg.eigh((points - middle).T @ (weight[:, None] * (points - middle)))
    along = axes[:, 1] * np.copysign(1.0, axes[:, 1] @ line[2:])
    return np.array([*middle, *along])


@pytest.mark.parametrize(("loss", "given_scale"), [("TUKEY", None), ("HUBER", 1.5)])
def test_steps_of_the_line_fit(
    device: Device, loss: str, given_scale: float | None, rng: np.random.Generator, tmp_path: Path
) -> None:
    count, trials, scale, reach = 15, 12, 0.8, 4.0
    lines, points, sigmas = [], [], []
    for number in range(30):
        angle, off = rng.uniform(-np.pi, np.pi), rng.normal(0.0, 1.0, count) + rng.choice([0.0, 0.0, 0.0, 6.0], count)
        along, middle = rng.uniform(-8.0, 8.0, count), rng.normal(0.0, 3.0, 2)
        sigma = rng.uniform(0.5, 2.0, count)
        frame = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        points.append(middle + np.column_stack([along, off * sigma]) @ frame)
        sigmas.append(np.where(rng.random(count) < 0.1, np.inf, sigma))
        # Every third line is turned by more than 45 degrees.
        wrong = angle + (1.2 if number % 3 == 0 else 0.15)
        lines.append([*(middle + rng.normal(0.0, 0.3, 2)), np.cos(wrong), np.sin(wrong)])
    pairs = np.array([rng.choice(count, 2, replace=False) for _ in range(trials)], np.int32)
    given = np.concatenate([np.array(points), 1.0 / np.array(sigmas)[..., None]], axis=-1).astype(np.float32)
    starts, efficiency = np.array(lines, np.float32), 0.9
    more = {"COUNT": count, "CAPACITY": count, "EFFICIENCY": efficiency, "INPUT": "float"}
    more |= {} if given_scale is None else {"GIVEN_SCALE": given_scale}
    kernel = program_of(device, tmp_path, LINES, loss, **more).line_steps
    numbers = map(np.float32, (1.0 / scale, reach))
    arrays = (given, starts, pairs, np.zeros((len(lines), 40), np.float32))
    made = run(device, kernel, len(lines), *arrays, np.int32(count), np.int32(trials), *numbers)
    for row, line, out in zip(given.astype(np.float64), starts.astype(np.float64), made, strict=True):
        assert_steps(row, line, out, pairs, loss, given_scale, scale, reach, efficiency)


def assert_steps(
    row: Reals,
    line: Reals,
    out: Reals,
    pairs: NDArray[np.int32],
    loss: str,
    given_scale: float | None,
    scale: float,
    reach: float,
    efficiency: float,
) -> None:
    """Assert that the numbers of the kernel `line_steps` for points (n, 3) and a line have their definition."""
    place, certainty = row[:, :2], row[:, 2]
    there = certainty > 0.0

    def off(of: Reals) -> Reals:
        return np.asarray(of[2] * (place[:, 1] - of[1]) - of[3] * (place[:, 0] - of[0]))

    z = off(line) * certainty
    np.testing.assert_allclose(out[0], off(line)[0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(out[1], np.abs(z)[0] if there[0] else np.inf, rtol=1e-5, atol=1e-5)
    weight = certainty**2
    np.testing.assert_allclose(out[2:6], [*(weight @ place / weight.sum()), 1.0, 0.0], rtol=1e-5, atol=1e-5)
    robust, slope, _ = of_loss(loss, z / scale)
    np.testing.assert_allclose(out[6:10], turned_line(place, weight * robust, line), rtol=1e-4, atol=1e-4)
    assert out[10] == 0.0
    size = np.sort(np.abs(z)[there & (np.abs(z) <= reach)])
    few = [1.4826022185056018 * (1.0 + each / max(size.size - 2, 1)) * size[size.size // 2] for each in (5.0, 1.0)]
    expected = [few[0], max(few[1], 100.0)] if given_scale is None else [given_scale] * 2
    np.testing.assert_allclose(out[11:13], expected, rtol=1e-5)

    def score(of: Reals) -> float:
        if given_scale is None:
            return float(np.sort(np.where(there, np.abs(off(of) * certainty), np.inf))[6])
        return float(np.sum(of_loss(loss, off(of) * certainty / given_scale)[2]))

    assert out[13] == pytest.approx(score(line), rel=0.008 if given_scale is None else 1e-5)
    scores = {}
    for one, other in pairs:
        if there[one] and there[other]:
            way = place[other] - place[one]
            candidate = np.array([*place[one], *(way / np.linalg.norm(way))])
            scores[score(candidate)] = candidate
    best = min(scores)
    if given_scale is None:
        # The kernel rounds distances down by up to 0.8 %.
        assert score(out[14:18]) < best * 1.009
    else:
        np.testing.assert_allclose(out[14:18], scores[best], rtol=1e-5, atol=1e-5)
    is_in = there & (robust > 0.0)
    u = line[2] * (place[:, 0] - line[0]) + line[3] * (place[:, 1] - line[1])
    inlier = weight * is_in
    assert out[20] == is_in.sum()
    factor = scale**2 / efficiency
    if given_scale is None:
        mean, free = np.sum(slope[is_in]) / max(is_in.sum(), 1), is_in.sum() - 2
        if free > 0 and abs(mean) < 0.05:
            return
        psi = np.sum((robust * z / scale)[is_in] ** 2)
        factor = scale**2 * psi / free / mean**2 if free > 0 else math.nan
    np.testing.assert_allclose(out[18:20], [factor / (inlier @ u**2), factor / inlier.sum()], rtol=1e-3)
    # The Newton step to the minimum, in standard deviations, decides on convergence.
    gradient = np.array([np.sum(weight * robust * off(line)), np.sum(weight * robust * u * off(line))])
    mean = max(float(np.sum(slope[is_in]) / is_in.sum()), 0.0)
    square = float(np.sum(gradient**2 / [inlier.sum(), inlier @ u**2])) / factor
    if not 0.9 < square / (0.01 * mean**2 + 1e-30) < 1.1:
        assert out[21] == (square > 0.01 * mean**2)
