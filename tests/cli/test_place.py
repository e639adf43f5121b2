"""The command ``gpuvision place``: refused options, files that are kept."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application


def run(*words: object) -> str:
    done = CliRunner().invoke(application(), ["place", *map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def preset(*names: str) -> str:
    return (resources.files("gpuvision") / "presets").joinpath(*names).read_text(encoding="utf-8")


def test_camera_preset_of_the_machine_file_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    machine, text = preset("machines", "look_while_place.toml"), preset("cameras", "pb1024.toml")
    assert 'sensor = "pb1024"' in machine
    Path("machine.toml").write_text(machine.replace('sensor = "pb1024"', 'sensor = "camera.toml"'))
    Path("camera.toml").write_text(text)
    Path("board").mkdir()
    words = ("board", "--machine", "machine.toml", "--at", "9mm,9mm,0deg", "--out", "out", "--json", "camera.toml")
    with pytest.raises(FileExistsError, match=r"it is the input camera\.toml"):
        run(*words, "--overwrite")
    assert Path("camera.toml").read_text() == text


def test_target_without_units_is_refused_with_an_example(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--at is '9,9,90', expected at most 1 m; numbers need units: 9mm,9mm,90deg"):
        run(tmp_path, "--machine", "look_while_place", "--at", "9,9,90", "--out", tmp_path / "out")
