"""Common part of the tests of scans: recordings of the shipped sensors, and runs of the command."""

from __future__ import annotations

import re
import sys
from typing import Any

import numpy as np
import pytest

from gpuvision.cli import main as cli
from gpuvision.sensor.sensor import Sensor


def currents(frames: int, height: float = 2e-3, total: float = 1e-6) -> Any:
    """Return codes (frames, 96, 2) of the shipped PSD sensor for a plane at a height [m], without noise."""
    sensor = Sensor.load("psd_line")
    readout: Any = sensor.readout
    (u, _v) = readout.triangulation.to_sensor([0.0, height])
    share = u / readout.strip_length
    pair = np.array([0.5 - share, 0.5 + share]) * total + np.array(readout.dark)
    return np.broadcast_to(np.rint(pair / readout.ampere), (frames, 96, 2)).astype(np.uint16)


def line_frames(rows: Any, sigma: float = 1.2, peak: float = 200.0) -> Any:
    """Return frames (n, 64, 480) of the shipped camera with a Gaussian line at given rows, (n, 480)."""
    distance = np.arange(64)[None, :, None] - np.asarray(rows)[:, None, :]
    return np.rint(peak * np.exp(-0.5 * (distance / sigma) ** 2)).astype(np.uint8)


class Ran:
    """Result of the command ``gpuvision``: exit code, standard output and standard error."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *args: object) -> None:
        monkeypatch.setattr(sys, "argv", ["gpuvision", *map(str, args)])
        try:
            cli.main()
            self.code: Any = 0
        except SystemExit as left:
            self.code = left.code
        self.out, self.err = capsys.readouterr()


def check_refused(ran: Ran, message: str) -> None:
    assert ran.code == 1
    assert ran.err.startswith("gpuvision: ")
    assert ran.err.count("\n") == 1
    assert ran.out == ""
    assert re.search(message, ran.err), ran.err
