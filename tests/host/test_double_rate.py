"""Rate of double precision: measured on GPUs once for each driver, and kept."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import Device, LaunchBuilder, double_rate
from gpuvision.ranging.psd import PsdReadout

READOUT = PsdReadout(strip_length=6e-3)


def handle_of(driver: str = "1", *, doubles: int = 63, kind: int = cl.device_type.GPU) -> Any:
    """Return a device handle with a driver, floating-point capabilities and a type."""
    platform = SimpleNamespace(name="maker", version="OpenCL 3.0")
    return SimpleNamespace(platform=platform, name="card", driver_version=driver, double_fp_config=doubles, type=kind)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Drivers that were measured, one a measurement; double precision takes 32 times the time on driver 1."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    drivers: list[str] = []

    def timed_launch(handle: Any, real: type[Any]) -> Callable[[], float]:
        drivers.append(handle.driver_version)
        slow = 32.0 if handle.driver_version == "1" else 2.0
        return lambda: slow if real is np.float64 else 1.0

    monkeypatch.setattr(double_rate, "_timed_launch", timed_launch)
    return drivers


def test_a_gpu_is_measured_once_for_each_driver(measured: list[str], tmp_path: Path) -> None:
    assert [double_rate.double_ratio(handle_of(driver)) for driver in ("1", "2", "1", "2")] == [32.0, 2.0, 32.0, 2.0]
    assert measured == ["1", "1", "2", "2"]  # single and double of each
    kept = json.loads((tmp_path / "gpuvision" / "double_rates.json").read_text())
    assert sorted(kept.values()) == [2.0, 32.0]


@pytest.mark.parametrize("damage", ["", "[]", "{", '{"k": "fast"}'])
def test_a_damaged_file_is_measured_again(measured: list[str], tmp_path: Path, damage: str) -> None:
    double_rate.double_ratio(handle_of())
    (tmp_path / "gpuvision" / "double_rates.json").write_text(damage)
    assert double_rate.double_ratio(handle_of()) == 32.0
    assert len(measured) == 4


def test_a_cpu_and_a_device_without_doubles_are_not_measured(measured: list[str]) -> None:
    assert double_rate.double_ratio(handle_of(kind=cl.device_type.CPU)) == 2.0
    assert double_rate.double_ratio(handle_of(doubles=0)) == math.inf
    assert not measured


def test_the_kernel_of_the_measurement_runs(device: Device) -> None:
    reals = (np.float32, np.float64)[: 1 + device.has_double]
    launches = [double_rate._timed_launch(device.handle, real) for real in reals]
    assert all(1e-6 < launch() < 10.0 for launch in launches)


def test_launches_of_both_precisions_alternate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first launch of each precision does not count, and of the others the fastest."""
    order: list[Any] = []
    times = {np.float64: [0.1, 9.0, 8.0, 10.0], np.float32: [0.1, 2.0, 3.0, 4.0]}

    def timed_launch(handle: Any, real: Any) -> Callable[[], float]:
        def launch() -> float:
            order.append(real)
            return times[real].pop(0)

        return launch

    monkeypatch.setattr(double_rate, "_timed_launch", timed_launch)
    assert double_rate._measured_ratio(handle_of()) == 4.0
    assert order == 4 * [np.float64, np.float32]


def test_a_failed_measurement_means_slow_doubles_and_is_not_kept(
    measured: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(handle: Any, real: Any) -> Any:
        raise cl.RuntimeError("build failed\nlog")

    with monkeypatch.context() as patch:
        patch.setattr(double_rate, "_timed_launch", refuse)
        assert double_rate.double_ratio(handle_of()) == math.inf
    assert not (tmp_path / "gpuvision" / "double_rates.json").exists()
    assert double_rate.double_ratio(handle_of()) == 32.0


def test_cpu_runtimes_with_doubles_have_fast_doubles(device: Device) -> None:
    assert device.has_fast_double == device.has_double


@pytest.mark.parametrize(("ratio", "is_fast"), [(1.0, True), (2.0, True), (16.0, True), (32.0, False), (64.0, False)])
def test_fast_doubles_run_at_more_than_a_32nd_of_the_float_rate(
    device: Device, ratio: float, is_fast: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GPUs have doubles at 1/2, 1/16, 1/32 or 1/64 of the float rate."""
    monkeypatch.setattr("gpuvision.host.device.double_ratio", lambda handle: ratio)
    gpu = copy.copy(device)
    gpu.__dict__.pop("has_fast_double", None)
    assert gpu.has_fast_double is is_fast


WIDE_INPUT = [("work_item", "single", False), ("work_item", None, True), ("vector", "single", True)]


@pytest.mark.parametrize("precision", ["single", "double"])
def test_positions_of_single_precision_follow_the_rate(device: Device, precision: Any) -> None:
    slow = copy.copy(device)
    slow.has_double, slow.has_fast_double = True, False
    build = LaunchBuilder(READOUT, slow, (3, 2), np.dtype(np.float32), precision=precision)
    in_double = precision == "double"
    assert build.doubles_positions == in_double
    assert set(build.position_defines) == {"DOUBLE_POSITIONS" if in_double else "TWO_FLOAT_POSITIONS"}
    table = build.positions(np.array([[0.1, 2.0]]))
    assert (table.shape, table.dtype) == (((1, 2), np.float64) if in_double else ((1, 2, 2), np.float32))


@pytest.mark.parametrize(("variant", "precision", "in_double"), WIDE_INPUT)
def test_positions_of_float64_input_follow_the_rate(
    device: Device, variant: Any, precision: Any, in_double: bool
) -> None:
    """Work-items split the numbers into two floats, where doubles are slow; vectors run on CPUs."""
    slow = copy.copy(device)
    slow.has_double, slow.has_fast_double, slow.takes_vectors = True, False, True
    build = LaunchBuilder(
        READOUT, slow, (3, 2), np.dtype(np.float64), precision=precision, narrows=True, variant=variant
    )
    assert build.doubles_positions is in_double
