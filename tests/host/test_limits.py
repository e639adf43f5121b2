"""Group sizes and local memory of kernels against the limits of devices that the test machine does not have."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.host import Device, DeviceMemoryError
from gpuvision.host.limits import fit_group


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


def test_wrong_numbers_of_mesa_are_corrected() -> None:
    mesa = handle("rusticl", "22.3.6")
    assert fit_group(kernel(65536, largest=32), mesa, (64,), name="Sum", label="rusticl") == (64,)
    with pytest.raises(DeviceMemoryError, match="takes 32770 bytes"):
        fit_group(kernel(65540, largest=32), mesa, (64,), name="Sum", label="rusticl")
    newer = handle("rusticl", "25.0.1")
    with pytest.raises(DeviceMemoryError, match="takes 65536 bytes"):
        fit_group(kernel(65536), newer, (64,), name="Sum", label="rusticl")


def test_bound_operations_ask_the_kernel(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel with registers for groups of 8 runs in groups of 8, with the same results."""
    readout = gv.PsdReadout(strip_length=2.0, variant="work_item")
    pairs = np.linspace(0.1, 1.0, 2000, dtype=np.float32).reshape(1000, 2)
    expected = readout(pairs, device=device)
    real = cl.Kernel.get_work_group_info

    def limited(self: Any, key: Any, of: Any) -> Any:
        return 8 if key == cl.kernel_work_group_info.WORK_GROUP_SIZE else real(self, key, of)

    monkeypatch.setattr(cl.Kernel, "get_work_group_info", limited)
    bound = readout.bind(device, pairs.shape, pairs.dtype)
    found = bound.on_host((pairs,))
    if device.kind != "rusticl":
        assert bound.enqueue_arguments[3] == (8,)
    np.testing.assert_array_equal(found.position, expected.position)
