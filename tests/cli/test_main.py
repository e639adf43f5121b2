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


def wait_for_line(ran: subprocess.Popen[str], line: str) -> None:
    assert ran.stdout is not None
    assert ran.stdout.readline() == f"{line}\n"


def end(ran: subprocess.Popen[str], number: int) -> tuple[int, str]:
    """Send a signal; return the exit code and standard error."""
    ran.send_signal(number)
    _, stderr = ran.communicate(timeout=30)
    return ran.returncode, stderr


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("module", ["typer", "gpuvision.host", "pyopencl"])
def test_an_interrupt_while_it_loads_is_an_exit_code(module: str, number: int, code: int) -> None:
    ran = started(SLOW.format(name=module) + MAIN, "devices")
    wait_for_line(ran, "loading")
    assert end(ran, number) == (code, "")


@posix
@pytest.mark.parametrize(
    ("number", "code"), [pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow), (signal.SIGTERM, 143)]
)
def test_a_command_that_is_ended_leaves_nothing(number: int, code: int, tmp_path: Path) -> None:
    slow = "import gpuvision.workflows.scan_result, time\n"
    slow += "def still(*a, **k):\n    print('writing', flush=True)\n    time.sleep(60)\n"
    slow += "gpuvision.workflows.scan_result.write_npz = still\n"
    np.save(tmp_path / "plane.npy", currents(4))
    out = tmp_path / "deep" / "out"
    ran = started(slow + MAIN, "scan", tmp_path / "plane.npy", "--sensor", "psd_line", "--out", out)
    wait_for_line(ran, "writing")
    assert list((tmp_path / "deep").glob(".*.part"))
    assert end(ran, number) == (code, "")
    assert [each.name for each in tmp_path.iterdir()] == ["plane.npy"]


SWALLOWING = """
import sys, time
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "pyopencl":
            print("loading", flush=True)
            {swallow}
sys.meta_path.insert(0, Slow())
import gpuvision.cli.main
gpuvision.cli.main._GRACE = 0.5
"""


@posix
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize(
    "swallow",
    [
        # an extension module that turns every exception into another one
        "\n            try: time.sleep(60)\n            except BaseException: raise ImportError('failed') from None",
        # a loop that ignores all exceptions
        "\n            while True:\n                try: time.sleep(60)\n                except BaseException: pass",
        # a library call that returns only after a minute
        "import ctypes; ctypes.CDLL(None).pause.restype = None; "
        "[ctypes.CDLL(None).pause() for _ in range(2)]; time.sleep(60)",
    ],
    ids=["converted", "swallowed", "blocked"],
)
def test_code_that_swallows_the_interrupt_is_cut_off(swallow: str, number: int, code: int, tmp_path: Path) -> None:
    ran = started(SWALLOWING.format(swallow=swallow) + MAIN, "devices")
    wait_for_line(ran, "loading")
    assert end(ran, number) == (code, "")


@posix
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_an_interrupt_while_a_device_is_probed(
    number: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    slow = "import subprocess, gpuvision.host.discovery\nrun = subprocess.run\n"
    slow += "def still(*a, **k):\n    print('probing', flush=True)\n    return run(['sleep', '60'], **k)\n"
    slow += "subprocess.run = still\n"
    ran = started(slow + MAIN, "devices")
    wait_for_line(ran, "probing")
    assert end(ran, number) == (code, "")
    assert not list((tmp_path / "cache").rglob("*.part"))


@posix
def test_a_swallowed_signal_leaves_no_temporary_file(tmp_path: Path) -> None:
    slow = "import gpuvision.cli.main, gpuvision.workflows.scan_result, time\ngpuvision.cli.main._GRACE = 0.5\n"
    slow += "def still(*a, **k):\n    print('writing', flush=True)\n    while True:\n"
    slow += "        try: time.sleep(60)\n        except BaseException: pass\n"
    slow += "gpuvision.workflows.scan_result.write_npz = still\n"
    np.save(tmp_path / "plane.npy", currents(4))
    ran = started(slow + MAIN, "scan", tmp_path / "plane.npy", "--sensor", "psd_line", "--out", tmp_path)
    wait_for_line(ran, "writing")
    assert list(tmp_path.glob(".*.part"))
    assert end(ran, signal.SIGTERM) == (143, "")
    assert [each.name for each in tmp_path.iterdir()] == ["plane.npy"]


def test_the_handler_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sys, "argv", ["gpuvision", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_entry_loads_nothing_heavy() -> None:
    heavy = ("numpy", "typer", "pyopencl")
    program = f"import sys, gpuvision.cli.main; print(*(each for each in {heavy} if each in sys.modules))"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
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


@pytest.mark.parametrize("error", [ZeroDivisionError("division by zero"), MemoryError("unable to allocate 9 TiB")])
def test_numerical_errors_and_lack_of_memory_are_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.delenv(cli.TRACEBACK, raising=False)
    monkeypatch.setattr(cli, "application", lambda: fail)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    assert capsys.readouterr().err == f"gpuvision: {error}\n"
