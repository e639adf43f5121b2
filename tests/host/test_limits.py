"""Group sizes and local memory of kernels against the limits of devices that the test machine does not have."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.host import Device, DeviceLimitError, DeviceMemoryError, launch_builder
from gpuvision.host.launch import Launch
from gpuvision.host.limits import fit_group, fit_work
from gpuvision.profiling.offline import ranging_builds, simulation_builds
from gpuvision.profiling.offline.builds import Example, GpuModel


def kernel(local_bytes: int = 0, largest: int = 256) -> Any:
    info = cl.kernel_work_group_info
    sizes = {info.LOCAL_MEM_SIZE: local_bytes, info.WORK_GROUP_SIZE: largest}
    return SimpleNamespace(function_name="centroid", get_work_group_info=lambda key, handle: sizes[key])


def handle(platform: str = "Some GPUs", driver: str = "535.1") -> Any:
    return SimpleNamespace(
        local_mem_size=32768,
        max_work_group_size=1024,
        driver_version=driver,
        platform=SimpleNamespace(name=platform),
    )


@pytest.mark.parametrize(
    ("local_size", "largest", "expected"),
    [
        ((64,), 64, (64,)),
        ((64,), 63, (32,)),
        ((64, 1), 16, (16, 1)),
        ((64, 4), 64, (16, 4)),
        ((64,), 1, (1,)),
        (None, 1, None),
    ],
)
def test_groups_without_local_memory_are_halved(local_size: Any, largest: int, expected: Any) -> None:
    assert fit_group(kernel(largest=largest), handle(), local_size, name="Sum", label="gpu") == expected


def test_local_memory_up_to_the_limit_of_the_device() -> None:
    assert fit_group(kernel(32768), handle(), (64,), name="Sum", label="gpu") == (64,)
    expected = r"^Sum: kernel centroid takes 32772 bytes of local memory, device gpu has 32768; give fewer [^\n]*$"
    with pytest.raises(DeviceMemoryError, match=expected):
        fit_group(kernel(32772), handle(), (64,), name="Sum", label="gpu")


def test_groups_with_local_memory_are_not_divided() -> None:
    expected = r"^Sum: kernel centroid takes groups of 64, device gpu runs groups of up to 32; choose another device$"
    with pytest.raises(DeviceMemoryError, match=expected):
        fit_group(kernel(256, largest=32), handle(), (64,), name="Sum", label="gpu")


def test_groups_that_solve_a_problem_each_are_halved() -> None:
    """The number of groups stays: the kernel takes the number of its problem from the number of its group."""
    of = Launch("sum.cl", "sum", (), {}, global_size=(192, 4), local_size=(64, 1), problem_per_group=True)
    of_runtime = replace(of, local_size=None)
    for needed in (0, 256):
        assert fit_work(kernel(needed, 63), handle(), of, name="Sum", label="gpu") == ((96, 4), (32, 1))
        assert fit_work(kernel(needed, 64), handle(), of, name="Sum", label="gpu") == ((192, 4), (64, 1))
        assert fit_work(kernel(needed, 1), handle(), of_runtime, name="Sum", label="gpu") == ((192, 4), None)
    one_of_many = replace(of, problem_per_group=False)
    assert fit_work(kernel(0, 63), handle(), one_of_many, name="Sum", label="gpu") == ((192, 4), (32, 1))


def test_wrong_numbers_of_mesa_are_corrected() -> None:
    mesa = handle("rusticl", "22.3.6")
    assert fit_group(kernel(65536, largest=32), mesa, (64,), name="Sum", label="rusticl") == (64,)
    with pytest.raises(DeviceMemoryError, match="takes 32770 bytes"):
        fit_group(kernel(65540, largest=32), mesa, (64,), name="Sum", label="rusticl")
    newer = handle("rusticl", "25.0.1")
    with pytest.raises(DeviceMemoryError, match="takes 65536 bytes"):
        fit_group(kernel(65536), newer, (64,), name="Sum", label="rusticl")


def test_limits_of_a_device_are_not_a_full_memory() -> None:
    for of in (kernel(32772), kernel(256, largest=32)):
        with pytest.raises(DeviceLimitError):
            fit_group(of, handle(), (64,), name="Sum", label="gpu")


@pytest.fixture
def small_groups(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let each kernel have registers for groups of 8 work-items, within the context."""
    real = cl.Kernel.get_work_group_info

    def limited(self: Any, key: Any, of: Any) -> Any:
        return 8 if key == cl.kernel_work_group_info.WORK_GROUP_SIZE else real(self, key, of)

    def limit() -> None:
        monkeypatch.setattr(cl.Kernel, "get_work_group_info", limited)

    return limit


def fitted_examples(monkeypatch: pytest.MonkeyPatch) -> dict[str, Example]:
    """Return an example of each operation whose work-groups overlap, or process several elements a group apart."""
    fitted: list[Any] = []
    for name in ("fitted", "strided"):
        real = launch_builder._GROUPINGS[name]
        monkeypatch.setitem(
            launch_builder._GROUPINGS, name, lambda *size, real=real: fitted.append(size) or real(*size)
        )
    found: dict[str, Example] = {}
    seen = set()
    for example in (*ranging_builds.examples(), *simulation_builds.examples()):
        kind = type(example.operation).__name__
        if kind not in seen:
            seen.add(kind)
            fitted.clear()
            example.operation.launch(GpuModel(), example.shape, np.dtype(example.dtype))
            if fitted:
                found[kind] = example
    return found


def test_fitted_kernels_follow_smaller_groups(
    device: Device, rng: np.random.Generator, small_groups: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels compute all elements in halved groups: their index follows the size with which the kernel runs."""
    examples = fitted_examples(monkeypatch)
    assert {"UndistortPoints", "Triangulation", "MergeHeights", "Reflectance", "LineIrradiance"} <= set(examples)
    scalar = device.without_vectors()
    expected = {}
    for name, (_, operation, shape, dtype, _) in examples.items():
        bound = operation.bind(scalar, (301, *shape[1:]), dtype)
        inputs = [
            rng.integers(0, 2, each.shape, np.uint8) if each.dtype == np.uint8 else rng.uniform(0.1, 1.0, each.shape)
            for each in bound.inputs
        ]
        given = [values.astype(each.dtype) for values, each in zip(inputs, bound.inputs, strict=True)]
        expected[name] = (given, bound.on_host(given))
    small_groups()
    for name, (given, result) in expected.items():
        _, operation, shape, dtype, _ = examples[name]
        bound = operation.bind(scalar, (301, *shape[1:]), dtype)
        if device.kind != "rusticl":
            assert bound.enqueue_arguments[3] == (8,), name
        for field, values in zip(result._fields, result, strict=True):
            found = getattr(bound.on_host(given), field)
            np.testing.assert_array_equal(found, values, err_msg=f"{name}.{field}")


def test_bound_operations_ask_the_kernel(device: Device, small_groups: Any) -> None:
    """A kernel with registers for groups of 8 runs in groups of 8, with the same results."""
    readout = gv.PsdReadout(strip_length=2.0, variant="work_item")
    pairs = np.linspace(0.1, 1.0, 2000, dtype=np.float32).reshape(1000, 2)
    expected = readout(pairs, device=device)
    small_groups()
    bound = readout.bind(device, pairs.shape, pairs.dtype)
    found = bound.on_host((pairs,))
    if device.kind != "rusticl":
        assert bound.enqueue_arguments[3] == (8,)
    np.testing.assert_array_equal(found.position, expected.position)
