"""Probe of a device: a working device passes; a build failure or a wrong result gives a reason."""

from __future__ import annotations

import json
import sys

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host import Device, discovery, probe


def test_working_device_passes(device: Device) -> None:
    assert probe.probe_device(device.handle) == ""


def test_long_loops_run_to_their_end(device: Device) -> None:
    """A work-item may take more than 65535 iterations: Mesa 22.3 (llvmpipe) ends all loops there, without an error."""
    source = """
    kernel void iterate(global const int *limit, global int *found) {
        uint number = 1;
        int count = 0;
        while (count < limit[0]) {
            number = number * 1664525u + 1013904223u; // no closed form that a compiler knows
            count += number == (uint)limit[0] ? 2 : 1;
        }
        found[0] = count;
    }"""
    iterate = cl.Program(device.context, source).build().iterate
    limit = cl.array.to_device(device.queue, np.array([100_000], np.int32))
    found = cl.array.zeros(device.queue, 1, np.int32)
    iterate(device.queue, (1,), None, limit.data, found.data)
    assert found.get()[0] in (100_000, 100_001)


def test_compiler_that_fails(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_SOURCE", probe._SOURCE.replace("uint16 sum", "no_such_type sum"))
    reason = probe.probe_device(device.handle)
    assert "error" in reason.lower()
    assert len(reason) <= 300
    assert "\n" not in reason


def test_wrong_numbers(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_SOURCE", probe._SOURCE.replace("sub_sat(value, (uchar16)20)", "value - (uchar16)20"))
    assert "wrong numbers" in probe.probe_device(device.handle)


def test_command_line(device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (listed,) = [each for each in discovery.listed_devices() if each.label == device.label]
    monkeypatch.setattr(sys, "argv", ["probe", str(listed.platform_index), str(listed.device_index)])
    probe.main()
    assert json.loads(capsys.readouterr().out) == {"reason": ""}
