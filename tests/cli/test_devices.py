"""``gpuvision devices`` and the error messages of the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fakes import FakeDevice, FakePlatform
from gpuvision.cli import main as cli
from gpuvision.host import BuildError, Device, NoDeviceError, discovery

Paper = Callable[..., list[bool]]


@pytest.fixture
def paper(monkeypatch: pytest.MonkeyPatch) -> Paper:
    """Replace the devices by fakes with the given labels; a reason marks a device that does not work."""

    def install(**reasons: str) -> list[bool]:
        listed = []
        for label, reason in reasons.items():
            handle = FakePlatform(f"Platform of {label}", devices=[FakeDevice(f"Name of {label}")]).devices[0]
            listed.append(discovery.ProbedDevice(label, label, 0, 0, handle, "", None, reason))
        calls: list[bool] = []

        def probed_devices(*, probe_again: bool = False) -> tuple[discovery.ProbedDevice, ...]:
            calls.append(probe_again)
            return tuple(listed)

        monkeypatch.setattr(discovery, "probed_devices", probed_devices)
        return calls

    return install


def _devices(*words: str) -> Result:
    return CliRunner(env={"COLUMNS": "150"}).invoke(cli.application(), ["devices", *words])


def test_table_shows_the_best_first_and_what_to_do(paper: Paper) -> None:
    paper(intel="", nvidia="cannot compile", pocl="")
    ran = _devices()
    assert ran.exit_code == 0
    lines = ran.output.splitlines()
    rows = [line.split("│")[1:-1] for line in lines if line.startswith("│")]
    assert [[cell.strip() for cell in row] for row in rows] == [
        ["pocl", "Name of pocl", "Platform of pocl", "1.0", "yes"],
        ["intel", "Name of intel", "Platform of intel", "1.0", "yes"],
        ["nvidia", "Name of nvidia", "Platform of nvidia", "1.0", "no"],
    ]
    at = lines.index("nvidia does not work: cannot compile")
    assert "update or remove this driver" in lines[at + 1]
    assert "apt-get install pocl-opencl-icd" in lines[at + 1]


def test_json(paper: Paper) -> None:
    paper(intel="cannot compile", pocl="")
    ran = _devices("--json", "-")
    assert ran.exit_code == 0
    pocl, intel = json.loads(ran.output)
    assert pocl == {
        "label": "pocl",
        "kind": "pocl",
        "name": "Name of pocl",
        "platform": "Platform of pocl",
        "driver": "1.0",
        "gpu": False,
        "healthy": True,
        "reason": "",
        "advice": "",
    }
    assert (intel["healthy"], intel["reason"]) == (False, "cannot compile")
    assert "install" in intel["advice"]


@pytest.mark.parametrize("words", [[], ["--json", "-"]])
def test_nothing_healthy_fails(paper: Paper, words: list[str]) -> None:
    paper(pocl="broken", intel="broken too")
    assert _devices(*words).exit_code == 1


def test_no_device_says_what_to_install(paper: Paper) -> None:
    paper()
    ran = _devices()
    assert (ran.exit_code, ran.output) == (1, f"no OpenCL device; {discovery.INSTALL_HINT}\n")
    assert (_devices("--json", "-").exit_code, _devices("--json", "-").output) == (1, "[]\n")


def test_probe_asks_again(paper: Paper) -> None:
    calls = paper(pocl="")
    _devices()
    _devices("--probe")
    assert calls == [False, True]


def test_installed_command(device: Device) -> None:
    command = [Path(sys.executable).with_name("gpuvision"), "devices", "--json", "-"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert device.label in [each["label"] for each in json.loads(ran.stdout) if each["healthy"]]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (NoDeviceError("none here"), "gpuvision: none here"),
        (
            BuildError("kernels/psd/psd.cl does not build:\n  line 3\n\n  line 4"),
            r"gpuvision: kernels/psd/psd.cl does not build: line 3 line 4",
        ),
        (ValueError("sensor.toml: strip_length is -1 m"), "gpuvision: sensor.toml: strip_length is -1 m"),
        (TypeError(), "gpuvision: TypeError"),
        (FileNotFoundError(2, "No such file or directory", "a.npy"), "gpuvision: a.npy: No such file or directory"),
        (OSError("truncated"), "gpuvision: truncated"),
    ],
)
def test_errors_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, line: str
) -> None:
    def app() -> None:
        raise error

    monkeypatch.setattr(cli, "application", lambda: app)
    monkeypatch.delenv(cli.TRACEBACK, raising=False)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 1
    assert capsys.readouterr().err == line + "\n"
    monkeypatch.setenv(cli.TRACEBACK, "1")
    with pytest.raises(type(error)):
        cli.main()


@pytest.mark.parametrize("words", [["no-such-command"], ["devices", "--jsn"], ["devices", "superfluous"]])
def test_wrong_usage(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["gpuvision", *words])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    assert words[-1] in capsys.readouterr().err


def test_defects_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def app() -> None:
        raise KeyError("a defect of ours")

    monkeypatch.setattr(cli, "application", lambda: app)
    with pytest.raises(KeyError):
        cli.main()
