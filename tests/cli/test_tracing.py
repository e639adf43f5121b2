"""Option ``--trace`` of every command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.cli.tracing import with_trace
from gpuvision.host.errors import RecordingError
from scanning import currents


def commands(group: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the name and the object of each command in a tree of commands."""
    for name, each in group.commands.items():
        if hasattr(each, "commands"):
            yield from commands(each, (*names, name))
        else:
            yield " ".join((*names, name)), each


def test_every_command_has_the_option() -> None:
    found = dict(commands(get_command(application())))
    assert len(found) >= 14
    for name, command in found.items():
        assert [each.name for each in command.params if "--trace" in each.opts] == ["trace"], name


def test_a_command_without_overwrite_gets_it_for_the_trace(tmp_path: Path) -> None:
    seen: list[int] = []

    def count(number: int = 1) -> None:
        seen.append(number)

    app = typer.Typer()
    app.command()(with_trace(count))
    file = tmp_path / "t.json"
    file.write_text("a user's")
    words = ["--number", "3", "--trace", str(file)]
    assert isinstance(CliRunner().invoke(app, words).exception, FileExistsError)
    assert seen == []
    assert CliRunner().invoke(app, [*words, "--overwrite"]).exit_code == 0
    assert seen == [3]
    assert traced(file) == ["gpuvision count"]


def traced(path: Path) -> list[str]:
    return [each["name"] for each in json.loads(path.read_text())["traceEvents"] if each["ph"] == "X"]


def test_a_scan_shows_its_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", currents(12))
    words = ["scan", "in.npy", "--sensor", "psd_line", "--out", "out", "--trace", "t.json"]
    ran = CliRunner().invoke(application(), words, catch_exceptions=False)
    assert ran.exit_code == 0
    names = set(traced(Path("t.json")))
    stages = {"gpuvision scan", "bind", "read", "write", "source", "slot", "launch", "compute", "sink", "wait"}
    assert stages <= names


def test_a_command_with_an_exit_code_writes_its_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpuvision.host.discovery.probed_devices", lambda **_: [])
    ran = CliRunner().invoke(application(), ["devices", "--trace", str(tmp_path / "t.json")])
    assert ran.exit_code == 1
    assert traced(tmp_path / "t.json") == ["gpuvision devices"]


def test_a_command_that_fails_writes_no_trace(tmp_path: Path) -> None:
    words = ["scan", str(tmp_path / "absent.npy"), "--sensor", "psd_line", "--out", str(tmp_path / "out")]
    ran = CliRunner().invoke(application(), [*words, "--trace", str(tmp_path / "t.json")])
    assert isinstance(ran.exception, RecordingError)
    assert list(tmp_path.iterdir()) == []
