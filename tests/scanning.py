"""What the tests of scans share: recordings of the shipped sensors, and the command as a user calls it."""

from __future__ import annotations

import re
import sys
from typing import Any

import numpy as np
import pytest

from gpuvision.cli import main as cli
from gpuvision.sensor.sensor import Sensor


def currents(frames: int, height: float = 2e-3, total: float = 1e-6) -> Any:
    """Codes of the shipped PSD sensor that looks at a plane of some height; left and right as they divide."""
    sensor = Sensor.load("psd_line")
    readout: Any = sensor.readout
    (u, _v) = readout.triangulation.to_sensor([0.0, height])
    share = u / readout.strip_length
    pair = np.array([0.5 - share, 0.5 + share]) * total + np.array(readout.dark)
    return np.broadcast_to(np.rint(pair / readout.ampere), (frames, 96, 2)).astype(np.uint16)


def line_frames(rows: Any, sigma: float = 1.2, peak: float = 200.0) -> Any:
    """Frames (n, 64, 480) of the shipped camera with a line at a row for each frame and column."""
    distance = np.arange(64)[None, :, None] - np.asarray(rows)[:, None, :]
    return np.rint(peak * np.exp(-0.5 * (distance / sigma) ** 2)).astype(np.uint8)


class Ran:
    """``gpuvision`` with arguments: exit code and what it said."""

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
