"""Steps of the search for visible parts (kernels/occluded_irradiance): hidden intervals, views and their boxes."""

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
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
# Faults that test too many boxes, or merge intervals late, change only the time of the whole search.
SOURCE = """
#include "occluded_irradiance/segment_view.h"
#include "occluded_irradiance/visible.h"
#define PUT(value) out[to++] = (value)

kernel void intervals(global const real *given, const int each, global const real *windows, global real *made) {
    const size_t n = get_global_id(0);
    global const real *at = given + 2 * each * n;
    global real *out = made + 69 * n;
    hidden all;
    hidden_begin(&all, windows[2 * n], windows[2 * n + 1]);
    for (int k = 0; k < each; k++) {
        const shadows cast = {at[2 * k], at[2 * k + 1]};
        hidden_add_all(&all, &cast);
    }
    hidden_sort(&all);
    int to = 0;
    PUT(all.from), PUT(all.to), PUT(all.count), PUT(all.is_full), PUT(hidden_is_done(&all));
    for (int k = 0; k < all.count; k++) PUT(all.low[k]), PUT(all.high[k]);
}

kernel void views(global const real *given, global const real *boxes, const int each, global real *made,
                  global int *met, const real clearance) {
    const size_t n = get_global_id(0);
    global const real *at = given + 30 * n;
    global real *out = made + 16 * n;
    const segment_axes of = {at[0], at[1], at[2], at[3], at[4],  at[5], at[6],
                             at[7], at[8], at[9], at[10], at[11], at[12]};
    const observer from = {at[13], at[14], at[15], at[16], at[17], at[18]};
    const placement in = {at[19], at[20], at[21], at[22], at[23], at[24], at[25], at[26], at[27]};
    view v = view_from(&of, &in, &from, clearance);
    int to = 0;
    PUT(v.deep_x), PUT(v.deep_y), PUT(v.deep_z), PUT(v.along_x), PUT(v.along_y), PUT(v.along_z);
    PUT(v.across_x), PUT(v.across_y), PUT(v.across_z);
    PUT(v.near), PUT(v.far), PUT(v.lift_deep), PUT(v.lift_along), PUT(v.lift);
    view_set_window(&v, at[28], at[29]);
    view_set_box(&v);
    for (int k = 0; k < each; k++) met[n * each + k] = view_boxes(&v, boxes + (n * each + k) * 6 * WIDTH) != 0;
}
"""


def program_of(device: Device, folder: Path) -> Any:
    (folder / "steps.cl").write_text(SOURCE)
    return build(device, folder, "steps.cl", {"INTERVALS": None, "BVH_DEPTH": 2}, include_folders=(KERNEL_FOLDER,))


def run(device: Device, kernel: Any, count: int, *arguments: Any) -> list[NDArray[Any]]:
    """Return the arrays after the kernel."""
    given = [cl.array.to_device(device.queue, each) if isinstance(each, np.ndarray) else each for each in arguments]
    kernel(device.queue, (count,), None, *(each.data if isinstance(each, cl.array.Array) else each for each in given))
    return [each.get() for each in given if isinstance(each, cl.array.Array)]


# Unit of the ends of intervals: two units are the smallest gap.
UNIT = 2.0**-22


def merged(intervals: NDArray[Any], window: tuple[int, int]) -> tuple[list[int], list[tuple[int, int]]]:
    """Return what is left of a window, and the hidden intervals within it: those at most two units apart are one."""
    joined: list[tuple[int, int]] = []
    for low, high in sorted(map(tuple, intervals.tolist())):
        if not (low < high and low < window[1] and high > window[0]):
            continue
        if joined and low <= joined[-1][1] + 2:
            joined[-1] = joined[-1][0], max(joined[-1][1], high)
        else:
            joined.append((low, high))
    start, stop = window
    if joined and joined[0][0] <= start + 2 and joined[0][1] >= stop - 2:
        return [stop, stop], []
    if joined and joined[0][0] <= start + 2:
        start = joined.pop(0)[1]
    if joined and start < stop and joined[-1][1] >= stop - 2:
        stop = joined.pop()[0]
    return [start, stop], [each for each in joined if each[0] < stop and each[1] > start]


def test_hidden_intervals(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """Ends that coincide, or are one to three units apart, in the window and at its ends."""
    count, each, window = 400, 12, (1000, 1060)
    low = rng.integers(990, 1062, (count, each))
    given = np.stack([low, low + rng.integers(-1, 9, (count, each))], axis=-1)
    given[::3, 6:] = given[::3, :6]
    given[:50, 0] = (1003, 1057)
    given[:25, 1], given[:25, 2] = (995, 1001), (1059, 1062)
    given[0, :3] = ((1002, 1058), (1002, 1058), (1058, 1059))
    windows = np.tile(np.array(window) * UNIT, (count, 1)).astype(np.float32)
    arrays = (given * UNIT).astype(np.float32), np.int32(each), windows, np.zeros((count, 69), np.float32)
    made = run(device, program_of(device, tmp_path).intervals, count, *arrays)[-1]
    left = 0
    for intervals, out in zip(given, made / UNIT, strict=True):
        (start, stop), hidden = merged(intervals, window)
        is_done = start >= stop
        assert (out[4] != 0.0) == is_done
        if is_done:
            continue
        left += 1
        np.testing.assert_array_equal(out[:4], [start, stop, len(hidden) / UNIT, 0.0])
        np.testing.assert_array_equal(out[5 : 5 + 2 * len(hidden)], np.ravel(hidden))
    assert left > 150


def test_more_hidden_intervals_than_there_is_room_for(device: Device, tmp_path: Path) -> None:
    """32 intervals and a 33rd one, in any order."""
    low = np.random.default_rng(1).permutation(33) * 8 + 100
    given = np.stack([low, low + 4], axis=-1) * UNIT
    given = np.stack([np.append(given[:32], given[:1], axis=0), given]).astype(np.float32)
    windows = np.tile(np.array((10, 1000)) * UNIT, (2, 1)).astype(np.float32)
    arrays = given, np.int32(33), windows, np.zeros((2, 69), np.float32)
    made = run(device, program_of(device, tmp_path).intervals, 2, *arrays)[-1]
    np.testing.assert_array_equal(made[:, 2:5], [[32, 0, 0], [32, 1, 1]])
    expected = np.sort(given[:, :32], axis=1).reshape(2, 64)
    np.testing.assert_array_equal(made[:, 5:69], expected)


def unit(vectors: Reals) -> Reals:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def test_views_and_their_boxes(device: Device, rng: np.random.Generator, tmp_path: Path) -> None:
    """Boxes in the window, beside it, before and behind the plane, below both surfaces, and around the point."""
    count, each, clearance = 60, 60, 0.05
    start, along = rng.normal(size=(count, 3)), unit(rng.normal(size=(count, 3)))
    off = unit(np.cross(along, rng.normal(size=(count, 3))))
    across, length = np.cross(along, off), rng.uniform(0.3, 2.0, count)
    way = np.column_stack([rng.uniform(-0.5, 2.5, count), rng.choice([0.07, 0.5, 1.5], count), rng.normal(size=count)])
    point = start + way[:, :1] * along + way[:, 1:2] * off + way[:, 2:] * across
    middle = start + 0.5 * length[:, None] * along
    normal = unit(unit(middle - point) + 0.7 * rng.normal(size=(count, 3)))
    ends = np.stack([start, start + length[:, None] * along], axis=1)
    toward = np.einsum("nek,nk->ne", ends - point[:, None], normal)
    by = [np.sum(normal * axis, axis=1) for axis in (along, off, across)]
    numbers = (way[:, 0], way[:, 1], way[:, 2], length - way[:, 0], *by, toward[:, 0], toward[:, 1])
    window = np.sort(rng.uniform(0.0, 1.0, (count, 2)), axis=1)
    given = np.column_stack([start, along, off, across, length, point, normal, *numbers, window])[
        toward.max(axis=1) > 0.02
    ]
    rows = np.flatnonzero(toward.max(axis=1) > 0.02)
    boxes = np.zeros((len(rows), each, 6, 16))
    t = rng.uniform(-0.3, 1.3, (len(rows), each, 1))
    places = point[rows, None] + rng.uniform(-0.2, 1.3, (len(rows), each, 1)) * (
        start[rows, None] + t * (length[rows, None] * along[rows])[:, None] - point[rows, None]
    )
    places += rng.normal(0.0, 0.3, places.shape)
    half = rng.uniform(0.0, 0.2, places.shape)
    boxes[:, :, :3, 0], boxes[:, :, 3:, 0] = places - half, places + half
    arrays = given.astype(np.float32), boxes.astype(np.float32), np.int32(each)
    made, met = np.zeros((len(rows), 16), np.float32), np.zeros((len(rows), each), np.int32)
    *_, made, met = run(
        device, program_of(device, tmp_path).views, len(rows), *arrays, made, met, np.float32(clearance)
    )
    shown = 0
    for out, hits, number, some in zip(made.astype(np.float64), met, rows, boxes[:, :, :, 0], strict=True):
        x, n, e = point[number], normal[number], off[number]
        height, most = way[number, 1], toward[number].max()
        depth = np.hypot(*way[number, 1:])
        deep, beside, plane = out[:3], out[3:6], out[6:9]
        foot = start[number] + way[number, 0] * along[number]
        np.testing.assert_allclose(deep, (foot - x) / depth, rtol=0, atol=2e-6)
        for share, end in zip((0.0, 1.0), ends[number], strict=True):
            assert beside @ (end - x) == pytest.approx(share * (deep @ (end - x)), abs=1e-5)
        np.testing.assert_allclose([plane @ plane, plane @ deep, plane @ along[number]], [1.0, 0.0, 0.0], atol=2e-6)
        over, lift = min(clearance, 0.5 * height), min(clearance, 0.5 * most)
        expected = [depth * lift / most, depth * (1.0 - over / height), lift]
        np.testing.assert_allclose(out[[9, 10, 13]], expected, rtol=2e-5)
        for end, above in zip(ends[number], toward[number], strict=True):
            height_of = out[11] * (deep @ (end - x)) + out[12] * (beside @ (end - x))
            assert height_of == pytest.approx(above, abs=1e-5)
        low, high = window[number]
        halves = [
            (beside - low * deep, 0.0), (high * deep - beside, 0.0), (plane, 0.0), (-plane, 0.0),
            (e, over - height), (n, lift),
        ]  # fmt: skip
        seen = [x, *(ends[number][0] + share * (ends[number][1] - ends[number][0]) for share in (low, high))]
        around = np.min(seen, axis=0), np.max(seen, axis=0)
        for box, hit in zip(some, hits, strict=True):
            one, other = box[:3], box[3:]
            reach = [np.sum(np.where(w > 0.0, other - x, one - x) * w) - least for w, least in halves]
            margin = min(*reach, *(around[1] - one), *(other - around[0]))
            if abs(margin) > 1e-5:
                assert hit == (margin > 0.0)
                shown += int(hit)
    assert 0.05 < shown / met.size < 0.6
