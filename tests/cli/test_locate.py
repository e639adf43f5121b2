"""The command ``gpuvision locate``: refused options."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from gpuvision.cli.main import application


def test_gcode_on_standard_output_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("image.tif", np.zeros((8, 8), np.uint8))
    words = ["locate", "image.tif", "--board", ".", "--scale", "25um", "--gcode", "-", "--camera-at", "0mm,0mm,0deg"]
    done = CliRunner().invoke(application(), words)
    assert isinstance(done.exception, ValueError), done.output
    assert str(done.exception) == "--gcode is '-', expected the name of a file"
