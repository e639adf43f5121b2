"""Start and end of the command: interrupts, termination, and lazy imports."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gpuvision
from gpuvision.cli import main as cli
from scanning import currents

MAIN = "from gpuvision.cli.main import main; main()"
SLOW = """
import sys, time
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            print("loading", flush=True)
            time.sleep(60)
sys.meta_path.insert(0, Slow())
"""

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


def started(code: str, *args: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("module", ["typer", "gpuvision.host", "pyopencl"])
def test_an_interrupt_while_it_loads_is_an_exit_code(module: str, number: int, code: int) -> None:
    ran = started(SLOW.format(name=module) + MAIN, "devices")
    assert ran.stdout is not None
    assert ran.stdout.readline() == "loading\n"
    ran.send_signal(number)
    _, told = ran.communicate(timeout=30)
    assert (ran.returncode, told) == (code, "")


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_that_is_ended_leaves_nothing(number: int, code: int, tmp_path: Path) -> None:
    slow = "import gpuvision.workflows.scanning, time\n"
    slow += "def still(*a, **k):\n    print('writing', flush=True)\n    time.sleep(60)\n"
    slow += "gpuvision.workflows.scanning.write_npz = still\n"
    np.save(tmp_path / "plane.npy", currents(4))
    out = tmp_path / "deep" / "out"
    ran = started(slow + MAIN, "scan", tmp_path / "plane.npy", "--sensor", "psd_line", "--out", out)
    assert ran.stdout is not None
    assert ran.stdout.readline() == "writing\n"
    assert list((tmp_path / "deep").glob(".*.part"))
    ran.send_signal(number)
    _, told = ran.communicate(timeout=30)
    assert (ran.returncode, told) == (code, "")
    assert [each.name for each in tmp_path.iterdir()] == ["plane.npy"]


def test_the_handler_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sys, "argv", ["gpuvision", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_entry_loads_nothing_heavy() -> None:
    heavy = ("numpy", "typer", "pyopencl")
    asked = f"import sys, gpuvision.cli.main; print(*(each for each in {heavy} if each in sys.modules))"
    ran = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == ""


def test_an_error_of_two_files_names_the_one_that_was_asked_for() -> None:
    error = OSError(28, "No space left on device", ".a.part", None, "out/a")
    assert cli.one_line(error) == "out/a: No space left on device"


def test_public_names_are_there_and_the_same_for_type_checkers() -> None:
    for name in gpuvision.__all__:
        assert getattr(gpuvision, name).__name__ == name
    assert set(gpuvision.__all__) <= set(dir(gpuvision))
    with pytest.raises(AttributeError, match="No gpuvision attribute Nothing"):
        _ = gpuvision.Nothing
    stub = ast.parse(Path(gpuvision.__file__).with_suffix(".pyi").read_text())
    listed = {alias.name for node in ast.walk(stub) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(gpuvision.__all__) == listed
