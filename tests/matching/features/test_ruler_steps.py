"""Steps of a ruler (kernels/ruler): peaks, pairs, and the parameters of an edge, each against its definition."""

from __future__ import annotations

import itertools
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
from gpuvision.matching.features.ruler import RulerEdges, RulerTable
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import ruler as reference

SOURCE = """
#include "ruler/ruler.h"
#include "ruler/ruler_refine.h"
#define PUT(value) out[to++] = (value)

kernel void ruler_steps(global const real *given, constant real *table, global real *made) {
    const size_t n = get_global_id(0);
    global const real *at = given + 16 * n;
    global real *out = made + 16 * n;
    ruler_place place;
    ruler_layout(1000, 1000, at[8], at[9], at[10], at[11], table, &place);
#ifdef PER_RULER
    ruler_set_kind(at[12], at[13], at[14], table, &place);
#endif
    const ruler_peak first = {at[0], at[1], at[2], at[3]}, second = {at[4], at[5], at[6], at[7]};
    int to = 0;
    const ruler_edge one = ruler_refine(first, &place, table), edge = ruler_edge_at(first, second, &place, table);
    PUT(one.position), PUT(one.amplitude), PUT(one.width), PUT(one.sigma);
    PUT(edge.position), PUT(edge.amplitude), PUT(edge.width), PUT(edge.sigma), PUT(edge.spacing);
    const real strength = ruler_strength(second.here, &place);
    PUT(strength);
    PUT(ruler_is_peak(strength, ruler_strength(second.before, &place), ruler_strength(second.after, &place),
                      table[RULER_THRESHOLD]) != 0);
    real weaker = strength;
    PUT(ruler_closes(first, at[15] > 0 ? -1 : 0, second, &place, table, &weaker) != 0);
    PUT(weaker);
}
"""
RULERS = {
    "pairs": RulerEdges(
        threshold=20.0, length=40, width=4, step_px=0.75, smoothing_px=1.5, pairs=True, polarity="rising",
        spacing_px=(3.0, 5.25), radius_px=30.0, noise=2.0, count=1, variant="work_item",
    ),
    "per ruler": RulerEdges(
        threshold=20.0, length=40, width=4, step_px=0.75, smoothing_px=1.5, per_ruler=True, noise=2.0, count=1,
        variant="work_item",
    ),
}  # fmt: skip


def measured(device: Device, folder: Path, kind: str, given: NDArray[Any]) -> tuple[NDArray[np.float64], RulerTable]:
    """Return the results of the kernel `ruler_steps` for rows (n, 16), and the table of the ruler."""
    launch = RULERS[kind].launch(device, (1000, 1000), np.dtype(np.float32))
    table = np.asarray(launch.arguments[0])
    (folder / "steps.cl").write_text(SOURCE)
    kernel = build(device, folder, "steps.cl", launch.defines, include_folders=(KERNEL_FOLDER,)).ruler_steps
    made = np.zeros((len(given), 16), np.float32)
    arrays = [cl.array.to_device(device.queue, each) for each in (given.astype(np.float32), table, made)]
    kernel(device.queue, (len(given),), None, *(each.data for each in arrays))
    return arrays[-1].get().astype(np.float64), RulerTable(*table[: len(RulerTable._fields)].tolist())


def shift_of(before: float, here: float, after: float) -> float:
    """Return the place of the vertex of a parabola through three logarithms."""
    a, b, c = np.log(np.abs([before, here, after]))
    return float(0.5 * (a - c) / (a - 2.0 * b + c))


def edge_of(peak: NDArray[Any], place: NDArray[Any], ruler: RulerEdges, table: RulerTable) -> NDArray[np.float64]:
    """Return position, amplitude, width and sigma of a Gaussian peak of the gradient, a sum over the lines."""
    at, before, here, after = peak.astype(np.float64)
    taps = math.ceil(3.0 * ruler.smoothing_px / ruler.step_px)
    step, variance = ruler.step_px, 1.0 / (2.0 * math.log(abs(here)) - math.log(before * after))
    shift = shift_of(before, here, after)
    position = (at + taps + shift - 0.5 * (ruler.length - 1)) * step
    size = (ruler.width, ruler.length)
    position -= reference.interpolation_shift(
        place, size, step, position, variance * step**2, table.smoothing * step**2
    )
    amplitude = here * math.exp(0.5 * shift**2 / variance) * math.sqrt(2.0 * math.pi * variance) / ruler.width
    width = math.sqrt(max(variance - table.smoothing, 0.0)) * step
    # An edge of a disc appears displaced towards its centre.
    if ruler.radius_px is not None:
        position -= (width**2 + (ruler.width**2 - 1) / 12.0) / (2.0 * ruler.radius_px)
    # Opposite noise of both neighbours of a symmetric peak.
    beside, by = abs(here) * math.exp(-0.5 / variance), 1e-6 * abs(here)
    slope = (shift_of(beside - by, here, beside + by) - shift_of(beside + by, here, beside - by)) / (2.0 * by)
    return np.array([position, amplitude, width, abs(slope) * step * table.noise])


def some_peaks(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return Gaussian peaks (n, 4) of different widths: index, and three gradients."""
    variance, shift = rng.uniform(3.0, 9.0, count), rng.uniform(-0.5, 0.5, count)
    here = rng.uniform(40.0, 400.0, count)
    sides = [here * np.exp((shift**2 - (side - shift) ** 2) / (2.0 * variance)) for side in (-1.0, 1.0)]
    return np.column_stack([rng.integers(2, 25, count), sides[0], here, sides[1]])


@pytest.mark.parametrize("kind", list(RULERS))
def test_parameters_of_edges_and_pairs(device: Device, kind: str, rng: np.random.Generator, tmp_path: Path) -> None:
    count, ruler = 40, RULERS[kind]
    first, second = some_peaks(rng, count), some_peaks(rng, count)
    second[:, 1:] *= -1.0
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    places = np.column_stack([rng.uniform(400.0, 500.0, (count, 2)), np.cos(angle), np.sin(angle)]).astype(np.float32)
    is_pair = np.arange(count) % 2 == 0
    limits = np.where(is_pair[:, None], (3.0, 5.25), 0.0)
    kinds = np.column_stack([np.ones(count), limits, np.ones(count)])
    made, table = measured(device, tmp_path, kind, np.column_stack([first, second, places, kinds]))
    for number, out in enumerate(made):
        one, two = (edge_of(each[number], places[number], ruler, table) for each in (first, second))
        # The sine of the interpolation has an error of 0.1 %.
        np.testing.assert_allclose(out[:4], one, rtol=1e-4, atol=1e-4)
        if kind == "per ruler" and not is_pair[number]:
            np.testing.assert_allclose(out[4:8], two, rtol=1e-4, atol=1e-4)
            assert np.isnan(out[8])
            continue
        mean = 0.5 * (one + two)
        pair = [mean[0], 0.5 * (one[1] - two[1]), mean[2], 0.5 * math.hypot(one[3], two[3]), two[0] - one[0]]
        np.testing.assert_allclose(out[4:9], pair, rtol=1e-4, atol=2e-4)


def test_peaks_and_pairs_at_their_limits(device: Device, tmp_path: Path) -> None:
    """A threshold, neighbours as high as the peak, spacings of 4 and 7 samples, and the wrong signs."""
    rows, expected = [], []
    table = RULERS["pairs"].launch(device, (1000, 1000), np.dtype(np.float32)).arguments[0]
    least = float(np.asarray(table)[0])
    for gap, start, end, has_first in itertools.product((3, 4, 7, 8), (90.0, -90.0), (60.0, -60.0), (0, 1)):
        rows.append([5, 0.5 * start, start, 0.5 * start, 5 + gap, 0.5 * end, end, 0.5 * end, has_first])
        closes = has_first and 4 <= gap <= 7 and start > 0.0 > end
        expected.append([60.0, 1, closes, 60.0])
    for before, here, after, is_peak in (
        (0.5, 1.0, 0.5, 1), (0.5, np.nextafter(np.float32(least), 0) / least, 0.5, 0), (1.0, 1.0, 0.5, 0),
        (0.5, 1.0, 1.0, 1), (0.5, 1.0, np.nextafter(np.float32(1), 2), 0), (-2.0, -2.0, 0.5, 0), (0.1, 3.0, -2.0, 1),
    ):  # fmt: skip
        rows.append([5, 1.0, 1.0, 1.0, 9, before * least, here * least, after * least, 0])
        expected.append([abs(here) * least, is_peak, 0, min(abs(here) * least, 1.0)])
    given = np.zeros((len(rows), 16))
    numbers = np.array(rows)
    given[:, :8], given[:, 15] = numbers[:, :8], numbers[:, 8]
    given[:, 8:12] = (500.0, 500.0, 1.0, 0.0)
    made, _ = measured(device, tmp_path, "pairs", given)
    np.testing.assert_allclose(made[:, 9:13], expected, rtol=1e-6)


def test_kinds_of_rulers_at_their_limits(device: Device, tmp_path: Path) -> None:
    """Polarity and limits of each ruler; a single edge of the wrong sign, and a polarity of 0, have no strength."""
    rows, expected = [], []
    for polarity, gap, start, end in itertools.product((1.0, -1.0, 0.0), (3, 4, 7, 8), (90.0, -90.0), (60.0, -60.0)):
        for farthest in (5.25, 0.0):
            rows.append([5, start, start, start, 5 + gap, 0.5 * end, end, 0.5 * end, polarity, 3.0, farthest, 1.0])
            fits = 4 <= gap <= 7 and start * polarity > 0.0 and end * polarity < 0.0
            is_pair = farthest > 0.0
            strength = abs(end) if is_pair else end * polarity
            is_peak = strength >= 20.0
            expected.append([strength, is_peak, fits or not is_pair, min(strength, 90.0) if is_pair else strength])
    given = np.zeros((len(rows), 16))
    numbers = np.array(rows)
    given[:, :8], given[:, 12:] = numbers[:, :8], numbers[:, 8:]
    given[:, 8:12] = (500.0, 500.0, 1.0, 0.0)
    made, table = measured(device, tmp_path, "per ruler", given)
    assert table.threshold < 60.0
    no_edges = given[:, 12] == 0.0
    np.testing.assert_allclose(made[~no_edges, 9:13], np.array(expected)[~no_edges], rtol=1e-6)
    single = no_edges & (given[:, 14] == 0.0)
    np.testing.assert_array_equal(made[single, 9], 0.0)
