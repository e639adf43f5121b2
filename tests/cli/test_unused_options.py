"""Options that would have no effect are refused: otherwise a user would believe that they had one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("calibrate", "a.png", "--out", "l.toml", "--inner-corners", "9x6"), "--inner-corners"),
        (("calibrate", "a.png", "--out", "l.toml", "--method", "lines", "--pitch", "0.01"), "--pitch"),
        (("calibrate", "a.png", "--out", "l.toml", "--method", "lines", "--focal-length", "900"), "--focal-length"),
        (("calibrate", "a.png", "--out", "l.toml", "--pattern", "lines", "--pitch", "0.01"), "--pitch"),
        (("undistort", "a.png", "--lens", "l.toml", "--out", "d", "--border-value", "7"), "--border-value"),
        (
            ("undistort", "a.png", "--lens", "l.toml", "--out", "d", "--border", "mask", "--border-value", "7"),
            "--border-value",
        ),
        (("undistort", "a.npy", "--lens", "l.toml", "--out", "d", "--region", "0,0,8,8"), "--region"),
        (("undistort", "a.npy", "--lens", "l.toml", "--out", "d", "--border", "reflect"), "--border"),
        (("undistort", "a.npy", "--lens", "l.toml", "--out", "d", "--interpolation", "bicubic"), "--interpolation"),
        (("simulate", "p.stl", "--sensor", "psd_line", "--out", "d", "--rule", "mean"), "--rule"),
        (("simulate", "p.stl", "--sensor", "psd_line", "--out", "d", "--no-noise", "--seed", "3"), "--seed"),
        (("simulate", "p.stl", "--sensor", "psd_line", "--out", "d", "--rate", "9"), "--rate"),
        (("simulate", "p.stl", "--sensor", "psd_line", "--out", "d", "--patch-size", "1e-3"), "--patch-size"),
        (
            ("simulate", "p.stl", "--sensor", "psd_line", "--out", "d", "--materials", "m.toml", "--albedo", "0"),
            "--albedo",
        ),
        *(
            (("scan", "points.npy", "--sensor", "camera_line", "--out", "d", "--preview", option, value), option)
            for option, value in (("--rate", "9"), ("--json", "-"), ("--ply", "valid"))
        ),
        (("select", "g", "--region", "0,0,1cm,1cm", "--scale", "25um", "--out", "d", "--device", "pocl"), "--device"),
        (("profile", "psd", "--contract", "--quick"), "--quick"),
        (("curves", "psd", "--maps", "--seconds", "1"), "--seconds"),
        (("profile", "psd", "--contract", "--growth"), "--growth"),
        (("profile", "--offline", "sm_90", "--contract"), "--contract"),
        (("profile", "--from", "points.npy", "--plots", "d", "--contract"), "--contract"),
        (("locate-robot", "points.npy", "--field", "robocup_msl", "--scale", "1cm"), "--scale"),
        (("locate-robot", "points.npy", "--field", "robocup_msl", "--camera", "c.toml"), "--camera"),
        (("locate-robot", "points.npy", "--field", "robocup_msl", "--line-width", "5cm"), "--line-width"),
        (("locate-robot", "points.npy", "--field", "robocup_msl", "--blind-radius", "5cm"), "--blind-radius"),
        (("locate-robot", "points.npy", "--field", "robocup_msl", "--threshold", "0"), "--threshold"),
    ],
)
def test_options_without_effect_are_refused(
    words: tuple[str, ...], option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("points.npy", np.zeros((9, 2), np.float32))
    ran = CliRunner().invoke(application(), list(words))
    assert isinstance(ran.exception, ValueError)
    assert str(ran.exception).startswith(f"{option} has no effect ")
    assert str(ran.exception).endswith("; leave it out")
    assert {each.name for each in tmp_path.iterdir()} == {"points.npy"}
