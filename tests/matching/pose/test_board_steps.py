"""Edges and lines of a board (kernels/board_pose) as numbers of its pose, each against its definition in float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import LINE, RULER, FitBoardLines
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
SOURCE = """
#include "board_pose/board_edge.h"
kernel void edges(global const real *measured, global const BoardRuler *rulers, global real *made) {
    const size_t n = get_global_id(0);
    const board_edge edge = board_edge_of(measured[2 * n], measured[2 * n + 1], rulers + n);
    made[3 * n] = edge.u, made[3 * n + 1] = edge.v, made[3 * n + 2] = edge.sigma;
}
"""


def test_edges_in_the_frames_of_their_lines(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    count = 40
    measured = np.column_stack([rng.uniform(-20.0, 20.0, count), rng.uniform(0.02, 0.5, count)])
    rulers = rng.normal(0.0, 1.0, (count, len(RULER))) * [1e3, 1e3, 1.0, 1.0, 2e-3, 3e-3, 1e-5, 2e-5, 1e-2]
    # The first have no edge: not measured, no finite sigma, sigma 0, a place not finite, seen edge-on, at infinity.
    measured[0, 0] = measured[1, 1] = np.nan
    measured[2, 1], measured[3, 1] = 0.0, np.inf
    rulers[4, RULER.index("u")], rulers[5, RULER.index("v")] = np.inf, np.nan
    rulers[6, [RULER.index("v_per_px"), RULER.index("projective")]] = 0.0
    measured[7, 0], rulers[7, RULER.index("projective")] = 8.0, -0.125
    measured, rulers = measured.astype(np.float32), rulers.astype(np.float32)
    launch = RulerEdges(threshold=20.0, length=40, count=1, variant="work_item").launch(
        device, (100, 100), np.dtype(np.float32)
    )
    (tmp_path / "steps.cl").write_text(SOURCE)
    kernel = build(device, tmp_path, "steps.cl", launch.defines, include_folders=(KERNEL_FOLDER,)).edges
    made = cl.array.zeros(device.queue, (count, 3), np.float32)
    given = [cl.array.to_device(device.queue, each) for each in (measured, rulers)]
    kernel(device.queue, (count,), None, *(each.data for each in given), made.data)
    (position, sigma), columns = measured[8:].astype(np.float64).T, rulers[8:].astype(np.float64).T
    ruler = dict(zip(RULER, columns, strict=True))
    seen = 1.0 + position * ruler["projective"]
    along = (ruler["u"] + position * ruler["u_per_px"]) / seen
    across = (ruler["v"] + position * ruler["v_per_px"]) / seen
    slope = (ruler["v_per_px"] - ruler["v"] * ruler["projective"]) / seen**2
    result = made.get()
    np.testing.assert_array_equal(result[:8], np.tile([0.0, 0.0, np.nan], (8, 1)))
    np.testing.assert_allclose(result[8:].T, [along, across, np.abs(slope) * sigma], rtol=2e-4, atol=1e-8)


def lines_of(rng: np.random.Generator, count: int, each: int) -> tuple[Reals, Reals]:
    """Return edges u, v, certainty (3, lines, each) about lines that are turned a little, and lines of the artwork."""
    u = np.sort(rng.uniform(-3.0, 5.0, (count, each)), axis=-1)
    u[::2] = u[::2, ::-1]
    sigma = rng.uniform(0.02, 0.06, u.shape)
    v = rng.normal(0.0, 0.5, (count, 1)) + rng.normal(0.0, 0.2, (count, 1)) * u + sigma * rng.normal(0.0, 2.0, u.shape)
    angle = rng.uniform(-np.pi, np.pi, count)
    numbers = [np.cos(angle), np.sin(angle), *rng.normal(0.0, 4.0, (2, count)), *rng.uniform(0.01, 0.2, (2, count))]
    return np.stack([u, v, 1.0 / sigma]), np.stack(numbers, axis=-1)


def inputs_of(places: Reals, lines: Reals) -> tuple[NDArray[np.float32], ...]:
    """Return places, sigmas and lines as `FitBoardLines` takes them; edges of certainty 0 are missing."""
    with np.errstate(divide="ignore"):
        sigma = 1.0 / places[2]
    sigma[::2][np.isinf(sigma[::2])] = np.nan  # both are missing
    return tuple(np.ascontiguousarray(each, np.float32) for each in (np.moveaxis(places[:2], 0, -1), sigma, lines))


def huber(z: Reals, constant: float) -> Reals:
    """Return the weights of residuals in units of the scale."""
    return constant / np.maximum(np.abs(z), constant)


def fitted(points: Reals, certainty: Reals, weight_of: Any) -> tuple[Reals, Reals, Reals]:
    """Return middle, direction and robust weights of the line by iteratively reweighted total least squares."""
    robust = np.ones(len(points))
    for _ in range(100):
        weight = certainty**2 * robust
        middle = weight @ points / weight.sum()
        _, axes = np.linalg.eigh((points - middle).T @ (weight[:, None] * (points - middle)))
        along = axes[:, 1] * np.copysign(1.0, axes[0, 1])
        robust = weight_of((along[0] * (points - middle)[:, 1] - along[1] * (points - middle)[:, 0]) * certainty)
    return middle, along, robust


@pytest.mark.parametrize("etch_bias_sigma", [None, 1e-5])
def test_rows_of_lines(device: Device, etch_bias_sigma: float | None, rng: np.random.Generator) -> None:
    """Two rows carry offset and angle of a line; one row carries the offset where there is no angle."""
    count, each, scale, constant = 9, 8, 1.5, 1.1
    places, lines = lines_of(rng, count, each)
    places[2, 2, 3] = 0.0  # a missing edge
    places[2, 3, np.arange(each) != 5] = 0.0  # one edge
    places[2, 4] = 0.0  # none
    places[:2, 5] = places[:2, 5, :1]  # all edges in one place
    inputs, lines = inputs_of(places, lines), lines.astype(np.float32)
    solver = SolvePose(loss="huber", scale=scale, tuning_constant=constant, etch_bias_sigma=etch_bias_sigma)
    result = FitBoardLines(solver=solver)(*inputs, device=device)
    rows = result.rows.reshape(count, 2, -1).astype(np.float64)
    if etch_bias_sigma is not None:
        np.testing.assert_array_equal(rows[..., 7], np.repeat(lines[:, 5:], 2, axis=1))
    everything = FitBoardLines(solver=SolvePose(loss="least_squares", scale=scale))(*inputs, device=device)
    all_edges, sigma = np.moveaxis(places, 0, -1), lines[:, LINE.index("sigma")].astype(np.float64)
    offsets = everything.rows.reshape(count, 2, -1)[:, 0, 6].astype(np.float64) ** 2 - sigma**2
    assert np.sum(result.edge_weights[places[2] > 0.0] < 0.95) > 5
    for number, (edges, row, weights) in enumerate(zip(all_edges, rows, result.edge_weights, strict=True)):
        normal, start = lines[number, :2].astype(np.float64), lines[number, 2:4].astype(np.float64)
        tangent = np.array([normal[1], -normal[0]])
        there = edges[:, 2] > 0.0
        np.testing.assert_array_equal(row[:, :2], [normal, normal])
        np.testing.assert_array_equal(everything.edge_weights[number], there)
        if not there.any():
            assert np.isnan(row[:, 6]).all()
            continue
        points, certainty = edges[there, :2], edges[there, 2]
        if number in (3, 5):
            middle, along, robust = points[0], np.array([1.0, 0.0]), np.ones(len(points))
        else:
            middle, along, robust = fitted(points, certainty, lambda z: huber(z / scale, constant))
        np.testing.assert_allclose(weights[there], robust, rtol=1e-3)
        np.testing.assert_array_equal(weights[~there], 0.0)
        variance = scale**2 / np.sum(certainty**2)
        if number in (3, 5):
            assert offsets[number] == pytest.approx(variance, rel=1e-3)
            assert np.isnan(row[1, 6])
            np.testing.assert_allclose(row[0, 2:4], start + middle[0] * tangent, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(row[0, 4:6], middle[1] * normal, rtol=1e-4, atol=1e-4)
            continue
        assert offsets[number] == pytest.approx(2.0 * variance, rel=1e-3)
        reach = np.sqrt(np.average(((points - middle) @ along) ** 2, weights=certainty**2))
        for sign, one in zip((-1.0, 1.0), row, strict=True):
            place = middle + sign * reach * along
            np.testing.assert_allclose(one[2:4], start + place[0] * tangent, rtol=1e-3, atol=1e-3)
            np.testing.assert_allclose(one[4:6], place[1] * normal, rtol=1e-3, atol=1e-3)
            assert one[6] == row[0, 6] > sigma[number]


def test_boards_of_all_sizes_share_a_program(device: Device) -> None:
    """Numbers of lines and rulers are arguments, not build options."""
    fits = FitBoardLines(solver=SolvePose())
    sizes = [(40, 1), (12, 6), (300, 4), (8, 256)]
    defines = [fits.launch(device, (*size, 2), np.dtype(np.float32)).defines for size in sizes]
    assert defines[1:] == defines[:-1]


@pytest.mark.parametrize("upright", [False, True])
def test_the_least_scale_is_the_rounding_error_of_the_places(device: Device, upright: bool) -> None:
    """All edges but one lie exactly on a line: the scale is the rounding error of the farthest place, in sigmas."""
    u, certainty = np.array([1.0, 3.0, -7.0, 2.0, -1.0, 5.0, 4.0, -2.0]), np.array([2.0, 2, 4, 2, 3, 2, 5, 2])
    scale = np.finfo(np.float32).eps * 28.0
    v, tuning = np.zeros(8), 6.0
    v[6] = 5.0 * scale / certainty[6]
    places = np.stack([v, u, certainty] if upright else [u, v, certainty])[:, None]
    inputs = inputs_of(places, np.array([[0.0, 1.0, 0.0, 0.0, 0.1, 0.0]]))
    solver = SolvePose(loss="tukey", scale=None, tuning_constant=tuning, max_iterations=30)
    weights = FitBoardLines(solver=solver)(*inputs, device=device).edge_weights[0]
    points = np.column_stack([u, v])
    *_, expected = fitted(points, certainty, lambda z: np.maximum(1.0 - (z / scale / tuning) ** 2, 0.0) ** 2)
    assert expected[6] < 0.9
    np.testing.assert_allclose(weights, expected, rtol=1e-3)
