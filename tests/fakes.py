"""Fake platforms and devices, for properties that the test machine does not have."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import pyopencl as cl
import pytest

from gpuvision.host import Device, device_choice


@dataclass(eq=False)
class FakeDevice:
    name: str = "Some CPU"
    vendor: str = "Someone"
    driver_version: str = "1.0"
    extensions: str = ""
    type: int = cl.device_type.CPU
    max_compute_units: int = 2
    global_mem_size: int = 8 << 30
    host_unified_memory: bool = True
    platform: FakePlatform | None = None


@dataclass(eq=False)
class FakePlatform:
    name: str = "Portable Computing Language"
    version: str = "OpenCL 3.0 PoCL"
    vendor: str = "The pocl project"
    devices: list[FakeDevice] = field(default_factory=lambda: [FakeDevice()])

    def __post_init__(self) -> None:
        for each in self.devices:
            each.platform = self

    def get_devices(self) -> list[FakeDevice]:
        if not self.devices:
            raise cl.LogicError("clGetDeviceIDs", -1, "DEVICE_NOT_FOUND")
        return self.devices


def list_gpu(device: Device, costs: Mapping[tuple[str, str], float], monkeypatch: pytest.MonkeyPatch) -> Device:
    """List a device named "gpu" before a CPU device, with the costs of steps by step and label; return it."""
    gpu = copy.copy(device)
    gpu.label, gpu.is_cpu = "gpu", False

    def seconds(step: str, run: Callable[[Device], object], size: tuple[object, ...], on: Device) -> float:
        run(on)
        return costs[step, on.label]

    monkeypatch.setattr(device_choice, "candidate_devices", lambda: (gpu, device))
    monkeypatch.setattr(device_choice, "_kept_seconds", seconds)
    return gpu
