"""Constant tables on devices with little constant memory: the same results with the tables in global memory."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from example_inputs import assert_has_numbers, inputs_with_numbers
from gpuvision.host import Device, Launch, site
from gpuvision.host.constant_memory import constant_sizes, fitting_defines
from gpuvision.host.debug import flatten_includes
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.offline import ranging_builds
from gpuvision.profiling.offline.builds import Example
from gpuvision.profiling.offline.registry import all_examples

# Kernel functions with constant tables.
KERNELS_WITH_TABLES = (
    *("psd_readout", "line_readout", "triangulate", "undistort", "undistort_points", "assemble_profiles", "resample"),
    *(
        "ruler_edges",
        "find_blobs",
        "line_fit_sets",
        "pose_sets",
        "board_edges",
        "board_lines",
        "place_features",
        "feature_pose",
    ),
    *("distance_map", "field_pose_search", "field_pose_refinement", "edge_levels", "closest_hit", "any_hit"),
    *("fan_intervals", "reflectance", "line_irradiance", "occluded_irradiance", "mirror_points", "mirror_facets"),
    "board_image",
)

KERNELS = """
// kernel void sums(constant float *wrong)
__attribute__((reqd_work_group_size(64, 1, 1)))
kernel void sums(global const float *in, global float *out, constant float *table, global const int *list, int count) {}
kernel void vectors(global float *out, TABLES, const int count) {}
#ifdef VECTOR_VARIANT
kernel void two(global float *out, constant float *a, __attribute__((unused)) global float *b, int n) {}
#else
kernel void two(global float *out, global float *a,
                constant /* all */ float *b, int n) {}
#endif
"""
SMALL, LARGE, COUNT = np.zeros(3, np.float32), np.zeros(1000, np.int32), np.int32(4)


@pytest.mark.parametrize(
    ("kernel", "arguments", "expected"),
    [
        ("sums", (SMALL, LARGE, COUNT), [12]),
        ("sums", (LARGE, None, COUNT), [4000]),
        ("two", (SMALL, LARGE, COUNT), [12, 4000]),
        ("vectors", (SMALL, LARGE, COUNT), [12, 4000, 0]),  # a macro: all tables
        ("absent", (SMALL, COUNT), [12, 0]),
    ],
)
def test_sizes_of_constant_tables(kernel: str, arguments: tuple[Any, ...], expected: list[int]) -> None:
    assert constant_sizes(KERNELS, kernel, arguments) == expected


@pytest.mark.parametrize(("available", "moves"), [(4012, False), (4011, False), (12, False), (11, True)])
def test_tables_move_beyond_the_limit_of_the_device(tmp_path: Path, available: int, moves: bool) -> None:
    (tmp_path / "sums.cl").write_text(KERNELS)
    launch = Launch("sums.cl", "sums", [], {}, (1,), defines={"A": 1}, arguments=(SMALL, LARGE, COUNT))
    found = fitting_defines(launch, SimpleNamespace(max_constant_buffer_size=available), tmp_path, ())
    assert found == {"A": 1, **({"constant": "__global"} if moves else {})}


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let each device have 2 bytes of constant memory, within the context."""
    return lambda: monkeypatch.setattr(cl.Device, "max_constant_buffer_size", property(lambda _: 2))


def results_of(example: Example, device: Device) -> Any:
    """Return the results of an example."""
    rng = np.random.default_rng(3)
    bound: Any = example.operation.bind(device, (min(301, example.shape[0]), *example.shape[1:]), example.dtype)
    for array, values in zip(
        bound.inputs, inputs_with_numbers(example.operation, bound.inputs, device, rng), strict=True
    ):
        array.set(values)
    bound().wait()
    return type(bound.outputs)(*(None if each is None else each.get() for each in bound.outputs))


def assert_the_same(example: Example, device: Device, moved: list[str], little_memory: Callable[[], None]) -> None:
    """Check that results are bit-equal with tables in global memory, and that there are numbers to compare."""
    expected = results_of(example, device)
    assert not moved
    little_memory()
    found = results_of(example, device)
    assert moved
    for name, before, after in zip(found._fields, expected, found, strict=True):
        np.testing.assert_array_equal(after, before, err_msg=name)
    assert_has_numbers(example.operation, expected)


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files of the kernels that were built with their tables in global memory."""
    files: list[str] = []

    def recorded(device: Device, folder: Path, source: str, defines: dict[str, Any], **options: Any) -> Any:
        files.extend([source] if "constant" in defines else [])
        return build(device, folder, source, defines, **options)

    monkeypatch.setattr(site, "build", recorded)
    return files


def test_results_with_tables_in_global_memory(
    device: Device, moved: list[str], little_memory: Callable[[], None]
) -> None:
    example = next(each for each in ranging_builds.examples() if type(each.operation).__name__ == "Triangulation")
    assert_the_same(example, device, moved, little_memory)


@functools.cache
def example_of_each_kernel(device: Device) -> dict[str, Example]:
    """Return the first example of each kernel function; to make all examples takes a second."""
    found: dict[str, Example] = {}
    for example in all_examples():
        if example.has_double == device.has_double:
            launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
            found.setdefault(launch.kernel, example)
    return found


# PoCL compiles each of the others twice, for 2 to 8 s.
SHORT = {"psd_readout", "line_readout", "triangulate", "undistort", "reflectance", "mirror_facets", "edge_levels"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kernel",
    [pytest.param(each, marks=[pytest.mark.nightly] * (each not in SHORT)) for each in KERNELS_WITH_TABLES],
)
def test_every_kernel_with_constant_tables(
    device: Device, kernel: str, moved: list[str], little_memory: Callable[[], None]
) -> None:
    """Also constants of the kernel file, and functions that take tables, compile with tables in global memory."""
    assert_the_same(example_of_each_kernel(device)[kernel], device, moved, little_memory)


def test_constants_of_kernel_files_stay_constant() -> None:
    """Constants outside of functions are ``__constant``: the macro must not move them, OpenCL C 1.2 has no globals."""
    files = [path for path in sorted(KERNEL_FOLDER.rglob("*")) if path.suffix in (".cl", ".h")]
    assert [path.name for path in files if "\nconstant " in path.read_text()] == []


@pytest.mark.slow
def test_declarations_of_all_kernels_are_read(device: Device) -> None:
    """The list of the test above is complete, and no kernel hides its constant tables in a macro."""
    found = set()
    for example in all_examples():
        if example.has_double == device.has_double:
            launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
            text = flatten_includes(KERNEL_FOLDER, launch.source)
            sizes = constant_sizes(text, launch.kernel, launch.arguments)
            if 0 < len(sizes) < len(launch.arguments):
                found.add(launch.kernel)
    assert found == set(KERNELS_WITH_TABLES)
