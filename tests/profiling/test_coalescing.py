"""Coalescing of memory requests: interpreter of PTX, and the factors of the kernels that stream."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import gpuvision as gv
from gpuvision.profiling.offline import targets
from gpuvision.profiling.offline.coalescing import Trace, trace
from gpuvision.profiling.offline.ptx import parse_kernel
from gpuvision.profiling.offline.ptx_operations import compute
from gpuvision.profiling.offline.targets import TARGETS, compile_assembly
from gpuvision.profiling.offline.warp import Group, Memory, Requests

needs_compilers = pytest.mark.skipif(
    targets.shutil.which(targets.CLANG) is None or not TARGETS["sm_90"].bitcode.exists(),
    reason="the offline compilers are not installed",
)

PROGRAM = """
kernel void strided(global const float *from, global float *to, int stride, int count) {
    const int i = get_global_id(0);
    if (i < count) to[i] = from[i * stride] + 1.0f;
}
kernel void pairs(global const float2 *from, global float2 *to) {
    to[get_global_id(0)] = from[get_global_id(0)].yx;
}
kernel void turned(global const int *from, global int *to) {
    local int kept[64];
    const int i = get_local_id(0);
    int sum = 0;
    for (int k = 0; k <= i; k++) sum += from[k];
    kept[i] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    to[i] = kept[63 - i];
}
kernel void parted(global const int *from, global int *to, int count) {
    local int kept[64];
    const int i = get_local_id(0);
    kept[i] = from[i];
    if (i < count) barrier(CLK_LOCAL_MEM_FENCE);
    to[i] = kept[63 - i];
}
kernel void beyond(global const int *from, global int *to, int shift) {
    local int first[64], second[64];
    const int i = get_local_id(0);
    first[i] = from[i];
    second[63 - i] = from[i];
    barrier(CLK_LOCAL_MEM_FENCE);
    to[i] = first[i + shift] - second[63 - i];
}
kernel void kept_alone(global const int *from, global int *to, int shift) {
    int kept[8];
    const int i = get_local_id(0);
    for (int k = 0; k < 8; k++) kept[(k + i) & 7] = from[k];
    to[i] = kept[(i & 7) + shift];
}
"""


def interpreted(
    name: str, source: NDArray[Any], target: NDArray[Any], *scalars: int, offset: int = 0, items: int = 64
) -> dict[tuple[str, str], Requests]:
    kernel = parse_kernel(compile_assembly(PROGRAM, [], TARGETS["sm_90"]), name)
    memory = Memory()
    arguments = [memory.add("from", source, offset), memory.add("to", target), *scalars]
    Group(kernel, memory, arguments, group=(0, 0, 0), groups=(1, 1, 1), size=(items, 1, 1)).run()
    return memory.requests


@needs_compilers
@pytest.mark.parametrize(("stride", "factor"), [(1, 1.0), (2, 2.0), (8, 8.0), (100, 8.0)])
def test_factor_of_a_stride(stride: int, factor: float) -> None:
    source, target = np.arange(64 * stride, dtype=np.float32), np.zeros(64, np.float32)
    requests = interpreted("strided", source, target, stride, 64)
    np.testing.assert_array_equal(target, source[::stride] + 1)
    # 64 work-items are two warps; 32 numbers of 4 bytes fill 4 sectors.
    assert requests["from", "load"] == Requests(2, int(8 * factor), 8, 256)
    assert requests["from", "load"].factor == factor
    assert requests["to", "store"] == Requests(2, 8, 8, 256)


@needs_compilers
def test_items_beyond_the_end_make_no_requests() -> None:
    target = np.zeros(64, np.float32)
    requests = interpreted("strided", np.ones(33, np.float32), target, 1, 33)
    np.testing.assert_array_equal(target, np.repeat([2.0, 0.0], [33, 31]).astype(np.float32))
    assert requests["from", "load"] == Requests(2, 5, 5, 132)


@needs_compilers
def test_barrier_and_loops_of_different_length() -> None:
    source, target = np.arange(64, dtype=np.int32), np.zeros(64, np.int32)
    interpreted("turned", source, target)
    np.testing.assert_array_equal(target, np.cumsum(source)[::-1])


@needs_compilers
def test_access_that_stops_a_gpu_raises() -> None:
    source, target = np.arange(128, dtype=np.float32), np.zeros(128, np.float32)
    interpreted("pairs", source, target)
    np.testing.assert_array_equal(target, source.reshape(-1, 2)[:, ::-1].ravel())
    with pytest.raises(ValueError, match=r"address not aligned to 8 bytes"):
        interpreted("pairs", source, target, offset=4)
    with pytest.raises(IndexError, match="access of 8 bytes"):
        interpreted("pairs", source[:-2], target)
    with pytest.raises(IndexError, match="access of 8 bytes"):
        interpreted("pairs", source, target[:-2])


@needs_compilers
@pytest.mark.parametrize(("kernel", "shift"), [("beyond", 1), ("beyond", -1), ("kept_alone", 1), ("kept_alone", -1)])
def test_access_beyond_an_array_of_local_or_private_memory_raises(kernel: str, shift: int) -> None:
    source, target = np.arange(64, dtype=np.int32), np.ones(64, np.int32)
    interpreted(kernel, source, target, 0)
    np.testing.assert_array_equal(target, 0 * source)
    with pytest.raises(IndexError, match=r"access of 4 bytes at -?\d+, beyond the arrays"):
        interpreted(kernel, source, target, shift)


@needs_compilers
@pytest.mark.parametrize("count", [1, 32, 63])
def test_barrier_that_not_all_items_reach_raises(count: int) -> None:
    source, target = np.arange(64, dtype=np.int32), np.zeros(64, np.int32)
    interpreted("parted", source, target, 64)
    np.testing.assert_array_equal(target, source[::-1])
    with pytest.raises(ValueError, match=f"{count} of 64 work-items reach a barrier"):
        interpreted("parted", source, target, count)


@needs_compilers
def test_part_of_a_parameter_is_not_known() -> None:
    text = compile_assembly(PROGRAM, [], TARGETS["sm_90"])
    kernel = parse_kernel(text.replace("strided_param_2]", "strided_param_2+4]"), "strided")
    memory, array = Memory(), np.zeros(64, np.float32)
    arguments = [memory.add("from", array), memory.add("to", array.copy()), 1, 64]
    with pytest.raises(NotImplementedError, match="part of a parameter"):
        Group(kernel, memory, arguments, group=(0, 0, 0), groups=(1, 1, 1), size=(64, 1, 1)).run()


def test_arithmetic_of_ptx() -> None:
    a, b = np.array([-7, 7, -7, 1 << 30], np.int32), np.array([2, -2, -2, 4], np.int32)
    assert compute(("div", "s32"), [a, b]).tolist() == [-3, -3, 3, 1 << 28]
    assert compute(("rem", "s32"), [a, b]).tolist() == [-1, 1, -1, 0]
    assert compute(("mul", "wide", "s32"), [a, b]).tolist() == [-14, -14, 14, 1 << 32]
    assert compute(("mul", "hi", "s32"), [a, b]).tolist() == [-1, -1, 0, 1]
    assert compute(("shr", "s32"), [a, np.full(4, 40, np.uint32)]).tolist() == [-1, 0, -1, 0]
    assert compute(("bfe", "s32"), [a, np.full(4, 1, np.uint32), np.full(4, 2, np.uint32)]).tolist() == [0, -1, 0, 0]
    x = np.array([np.nan, 1e20, -2.7, 2.5], np.float32)
    assert compute(("cvt", "rzi", "s32", "f32"), [x]).tolist() == [0, (1 << 31) - 1, -2, 2]
    assert compute(("cvt", "rni", "f32", "f32"), [x])[2:].tolist() == [-3.0, 2.0]
    assert compute(("setp", "geu", "f32"), [x, np.float32(2) + 0 * x]).tolist() == [True, True, False, True]
    assert compute(("setp", "ge", "f32"), [x, np.float32(2) + np.zeros_like(x)]).tolist() == [False, True, False, True]
    with pytest.raises(NotImplementedError, match="PTX instruction tanh"):
        compute(("tanh", "approx", "f32"), [x])
    with pytest.raises(NotImplementedError, match=r"PTX instruction add\.sat\.f32"):
        compute(("add", "sat", "f32"), [x, x])


RNG = np.random.default_rng(3)
_TO_SHEET = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 1e-5, 1.0))
_REGION = ((0.0, 511.0), (0.0, 1023.0))
_CAMERA = gv.Camera(
    matrix=((250.0, 0.0, 127.5), (0.0, 250.0, 15.5), (0.0, 0.0, 1.0)),
    distortion=(-0.1, 0.02, 1e-4, -2e-4, *(0.0,) * 10),
)
_POINTS = 1024


def _currents(dtype: Any, *, planar: bool = False) -> NDArray[Any]:
    currents = (1000.0 * RNG.uniform(1.0, 2.0, (_POINTS, 2))).astype(dtype)
    return np.ascontiguousarray(currents.T) if planar else currents


def _frames(dtype: Any, *, along: str = "columns", samples: int = 64, length: int = 256) -> NDArray[Any]:
    """Return a frame with a line that crosses it with a slope of 0.3, as on a tilted surface."""
    centre = length / 2 + 0.3 * np.arange(samples)
    frame = 200.0 * np.exp(-0.5 * ((np.arange(length)[:, None] - centre) / 2.0) ** 2)
    frame += RNG.uniform(0.0, 8.0, frame.shape)
    return np.ascontiguousarray(frame if along == "columns" else frame.T)[None].astype(dtype)


def _image(dtype: Any, channels: int = 1) -> NDArray[Any]:
    image = RNG.integers(0, 256, (32, 256, channels)).astype(dtype)
    return image if channels > 1 else image[..., 0]


def _surface(profiles: int, samples: int) -> list[NDArray[Any]]:
    """Return a wavy surface: coordinate along the profile, z, intensity, status, coordinate across the profiles."""
    profile, sample = np.meshgrid(np.arange(profiles), np.arange(samples), indexing="ij")
    z = (5e-3 * np.sin(0.008 * sample) * np.cos(0.006 * profile)).astype(np.float32)
    along, across = (1e-4 * sample + 0.2 * z).astype(np.float32), (1e-4 * profile + 0.1 * z).astype(np.float32)
    return [along, z, np.ones_like(z), np.zeros(z.shape, np.uint8), across]


def _across(profiles: int, samples: int) -> list[NDArray[Any]]:
    """Return the inputs of the pass along the profiles."""
    _, *values, across = _surface(profiles, samples)
    return [across, *values]


_GRID = gv.Grid(left=1e-3, top=2.8e-3, cell_x=1e-4, cell_y=1e-4, columns=240, rows=24)
_ALONG_SAMPLES, _ALONG_PROFILES = gv.Regrid(grid=_GRID, max_gap=1e-3, max_step=1e-3).passes
_ALONG_X = gv.Regrid(grid=_GRID, max_gap=1e-3, max_step=1e-3, along="y").passes[1]
_PLANE = gv.Triangulation(homography=_TO_SHEET, region=_REGION, sigma=(0.1, 0.1))
_U, _V = (RNG.uniform(0.0, 500.0, _POINTS).astype(np.float32) for _ in range(2))
_XY = RNG.uniform(10.0, 200.0, (_POINTS, 2)).astype(np.float32)
_ROW = _frames(np.uint8, along="rows", samples=16, length=1024)
# Name, operation, inputs, coalescing factor of the loads and of the stores, requests, sectors.
STREAMS: list[tuple[str, Any, list[NDArray[Any]], float, float, int, int]] = [
    ("psd", gv.PsdReadout(strip_length=6e-3), [_currents(np.float32)], 1.0, 1.0, 128, 544),
    ("psd codes", gv.PsdReadout(strip_length=6e-3), [_currents(np.uint16)], 1.0, 1.0, 128, 416),
    ("psd double", gv.PsdReadout(strip_length=6e-3), [_currents(np.float64)], 1.0, 1.0, 128, 1056),
    (
        "psd planar",
        gv.PsdReadout(strip_length=6e-3, layout="planar"),
        [_currents(np.uint16, planar=True)],
        1.0,
        1.0,
        160,
        416,
    ),
    ("triangulation", _PLANE, [_U, _V], 1.0, 1.0, 224, 800),
    ("points", gv.UndistortPoints(model=_CAMERA), [_XY], 1.0, 1.0, 96, 544),
    ("line, columns", gv.LineReadout(threshold=20), [_frames(np.uint8)], 1.86, 1.0, 194, 1089),
    ("line, columns, codes", gv.LineReadout(threshold=20), [_frames(np.uint16)], 1.41, 1.0, 324, 1631),
    ("line, columns, float", gv.LineReadout(threshold=20), [_frames(np.float32)], 1.22, 1.0, 579, 2791),
    (
        "line, columns, ambiguity",
        gv.LineReadout(threshold=20, ambiguity=0.5),
        [_frames(np.uint8)],
        1.45,
        1.0,
        323,
        1606,
    ),
    ("centroid, columns", gv.LineReadout(method="centroid", threshold=20), [_frames(np.uint8)], 1.0, 1.0, 142, 550),
    ("line, rows", gv.LineReadout(threshold=20, along="rows"), [_ROW], 1.75, 1.0, 161, 952),
    ("centroid, rows", gv.LineReadout(method="centroid", threshold=20, along="rows"), [_ROW], 1.06, 1.0, 135, 553),
    ("image", gv.UndistortImage(model=_CAMERA), [_image(np.uint8)], 1.36, 1.0, 578, 2946),
    ("image, float", gv.UndistortImage(model=_CAMERA), [_image(np.float32)], 1.23, 1.0, 2304, 7270),
    ("image, colour", gv.UndistortImage(model=_CAMERA, channels=3), [_image(np.uint8, 3)], 1.42, 1.33, 2309, 8441),
    (
        "image, colour, bicubic",
        gv.UndistortImage(model=_CAMERA, channels=3, interpolation="bicubic"),
        [_image(np.uint8, 3)],
        1.67,
        1.0,
        16080,
        26037,
    ),
    (
        "image, colour, float",
        gv.UndistortImage(model=_CAMERA, channels=3),
        [_image(np.float32, 3)],
        1.15,
        1.0,
        6912,
        20681,
    ),
    (
        "image, computed",
        gv.UndistortImage(model=_CAMERA, coordinates="computed"),
        [_image(np.uint8)],
        1.12,
        1.0,
        388,
        1662,
    ),
    ("regrid, samples", _ALONG_SAMPLES, _surface(32, 256), 1.0, 1.04, 2304, 7600),
    ("regrid, profiles", _ALONG_PROFILES, _across(32, 240), 1.23, 1.33, 1500, 6000),
    ("regrid, profiles, along y", _ALONG_X, _across(256, 24), 1.15, 1.27, 1438, 5033),
]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "concepts" / "kernel_variants.md"


@needs_compilers
@pytest.mark.parametrize(
    ("operation", "inputs", "loads", "stores", "requests", "sectors"),
    [pytest.param(*each[1:], marks=[pytest.mark.slow] * ("colour" in each[0])) for each in STREAMS],
    ids=[each[0] for each in STREAMS],
)
def test_streams_are_coalesced(
    operation: Any, inputs: list[NDArray[Any]], loads: float, stores: float, requests: int, sectors: int
) -> None:
    traced: Trace = trace(operation, inputs)
    factors = [traced.of(kind).factor for kind in ("load", "store")]
    # Another version of Clang may order and join some loads in another way: 2 % more is allowed.
    counted = [*factors, traced.total.count, traced.total.sectors]
    np.testing.assert_array_less(counted, 1.02 * np.array([loads, stores, requests, sectors]))
    for field, value in traced.outputs.items():
        expected = getattr(operation(*inputs), field)
        if operation is _ALONG_SAMPLES and expected.ndim == 3:
            # The vector variant stores sets of 16 lines: (sets, cells, 16) instead of (lines, cells).
            expected = expected.swapaxes(1, 2).reshape(-1, expected.shape[1])[: len(value)]
        if value.dtype.kind == "f":
            # Compilers differ in contraction: a few units in the last place.
            np.testing.assert_allclose(value, expected, rtol=4e-6, atol=4e-6 * np.nanmax(np.abs(expected)))
        else:
            np.testing.assert_array_equal(value, expected)


def test_numbers_of_the_page() -> None:
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in PAGE.read_text().splitlines()]
    begin = next(number for number, row in enumerate(rows) if row[0] == "kernel" and "requests, before" in row) + 2
    now = [(row[0], row[3], row[5], row[7], row[9]) for row in rows[begin : begin + len(STREAMS)]]
    assert now == [(each[0], f"{each[3]:.2f}", f"{each[4]:.2f}", str(each[5]), str(each[6])) for each in STREAMS]
    assert len(rows[begin + len(STREAMS)]) == 1


@needs_compilers
@pytest.mark.parametrize(("group_size", "offset", "count"), [(32, 0, 1), (64, 1, 129), (128, 2, 513), (256, 1, 300)])
@pytest.mark.parametrize("name", ["psd", "psd planar", "triangulation", "points"])
def test_group_sizes_odd_counts_and_unaligned_arrays(name: str, group_size: int, offset: int, count: int) -> None:
    operation, whole = next((each[1], each[2]) for each in STREAMS if each[0] == name)
    planar = name == "psd planar"
    inputs = [np.ascontiguousarray(each[:, :count] if planar else each[:count]) for each in whole]
    outputs = trace(operation, inputs, group_size=group_size, offset=offset).outputs
    # The interpreter runs the work-item variant. The vector variant of the triangulation rounds once more.
    expected = replace(operation, variant="work_item")(*inputs)
    for field, value in outputs.items():
        np.testing.assert_array_equal(value, getattr(expected, field))


@needs_compilers
@pytest.mark.parametrize("group_size", [32, 128])
@pytest.mark.parametrize("name", ["line, columns", "centroid, rows"])
def test_kernels_compiled_for_a_group_size_refuse_another_one(name: str, group_size: int) -> None:
    operation, inputs = next((each[1], each[2]) for each in STREAMS if each[0] == name)
    with pytest.raises(ValueError, match=rf"compiled for groups of 256 work-items, group_size is {group_size}"):
        trace(operation, inputs, group_size=group_size)
    assert trace(operation, inputs, groups=[0], group_size=256).total.count > 0


@needs_compilers
@pytest.mark.slow
@pytest.mark.parametrize("group_size", [32, 16])
def test_a_smaller_group_solves_a_problem(group_size: int) -> None:
    """`FitLines` launches a group of 64 per line: smaller groups are as many, and give the same results."""
    operation = gv.FitLines(variant="work_item")
    along = np.linspace(0.0, 9.0, 40, dtype=np.float32)
    lines = np.stack([np.stack([along, k * along + RNG.normal(0.0, 0.1, 40)], -1) for k in range(5)]).astype(np.float32)
    expected = trace(operation, [lines]).outputs
    outputs = trace(operation, [lines], group_size=group_size).outputs
    for field, value in outputs.items():
        np.testing.assert_array_equal(value, expected[field], err_msg=field)
    with pytest.raises(ValueError, match="compiled for groups of 64 work-items, group_size is 128"):
        trace(operation, [lines], group_size=128)


@needs_compilers
@pytest.mark.slow
@pytest.mark.parametrize("group_size", [64, 16])
@pytest.mark.parametrize(("name", "inputs"), [("samples", _surface(3, 300)), ("profiles", _across(40, 11))])
def test_smaller_groups_resample_lines_in_shorter_tiles(name: str, inputs: list[NDArray[Any]], group_size: int) -> None:
    """A tile of 16 lines in a group of 16 has one sample of each line."""
    grid = replace(_GRID, columns=11 if name == "profiles" else 240)
    regrid = gv.Regrid(grid=grid, max_gap=1e-3, max_step=1e-3)
    operation = regrid.passes[0 if name == "samples" else 1]
    inputs[3][:, ::7] = gv.Status.LOW_SIGNAL
    expected = trace(operation, inputs).outputs
    outputs = trace(operation, inputs, group_size=group_size).outputs
    assert np.isfinite(expected["z"]).mean() > 0.2
    for field, value in outputs.items():
        np.testing.assert_array_equal(value, expected[field], err_msg=field)


@needs_compilers
@pytest.mark.parametrize(
    ("name", "columns", "offset"),
    [
        ("line, columns", 61, 0),
        ("line, columns, ambiguity", 62, 3),
        ("centroid, columns", 1, 1),
        ("line, rows", 1021, 0),
        ("centroid, rows", 1022, 2),
        ("image", 101, 0),
        ("image", 102, 1),
        ("image, computed", 3, 2),
        ("image, colour", 99, 0),
        ("image, colour", 102, 4),
    ],
)
def test_rows_that_are_not_aligned(name: str, columns: int, offset: int) -> None:
    operation, whole = next((each[1], each[2]) for each in STREAMS if each[0] == name)
    inputs = [np.ascontiguousarray(whole[0][:9, :columns] if name.startswith("image") else whole[0][..., :9, :columns])]
    if name.startswith("line") or "columns" in name:
        inputs = [np.ascontiguousarray(whole[0][..., : 11 if "rows" in name else 200, :columns])]
    assert columns in inputs[0].shape
    outputs = trace(operation, inputs, offset=offset).outputs
    for field, value in outputs.items():
        np.testing.assert_array_equal(value, getattr(operation(*inputs), field))
