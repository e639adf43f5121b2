"""Probe of a device: a working device passes; a build failure or a wrong result gives a reason."""

from __future__ import annotations

import json
import sys

import pytest

from gpuvision.host import Device, discovery, probe


def test_working_device_passes(device: Device) -> None:
    assert probe.probe_device(device.handle) == ""


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
