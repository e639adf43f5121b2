"""Notice on a terminal while kernels compile."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gpuvision.host import Device, build_notice, clear_cache
from gpuvision.host.build_notice import BuildNotice, show_builds
from gpuvision.ranging.line import LineReadout

_PROGRAM = """
import sys, threading
import gpuvision.cli.main as cli
from gpuvision.host import build_notice

shown = threading.Event()

class Notice(build_notice.BuildNotice):
    def __init__(self, terminal):
        super().__init__(terminal, delay=0.0, clock=lambda: 0.0)

    def _write(self, text):
        super()._write(text)
        shown.set()

build_notice.BuildNotice = Notice

def application():
    def command():
        with build_notice.building("line/line.cl"):
            shown.wait(60.0 if sys.stderr.isatty() else 0.2)
        print("result")
    return command

cli.application = application
cli.main()
"""


class Terminal(io.StringIO):
    """Terminal that says when something is shown on it."""

    def __init__(self) -> None:
        super().__init__()
        self.shown = threading.Event()

    def write(self, text: str) -> int:
        done = super().write(text)
        self.shown.set()
        return done


@pytest.fixture(autouse=True)
def _silent_afterwards() -> Iterator[None]:
    yield
    show_builds(None)


def test_a_long_build_is_shown_with_its_file_and_seconds_and_erased() -> None:
    terminal, times = Terminal(), iter([100.0, 107.3, *[108.0] * 1000])
    with BuildNotice(terminal, delay=0.0, clock=lambda: next(times)).building("line/line.cl"):
        assert terminal.shown.wait(10.0)
    text = terminal.getvalue()
    assert text.startswith("\r\x1b[Kcompiling kernels, 7 s: line/line.cl")
    assert text.endswith("\r\x1b[K")


def test_short_builds_are_not_shown_until_together_they_are_long() -> None:
    terminal, now = Terminal(), [0.0]
    notice = BuildNotice(terminal, delay=1000.0, clock=lambda: now[0])
    for _ in range(2):
        with notice.building("line/line.cl"):
            now[0] += 500.0
    assert terminal.getvalue() == ""
    with notice.building("psd/psd.cl"):
        assert terminal.shown.wait(10.0)
    assert "compiling kernels, 1000 s: psd/psd.cl" in terminal.getvalue()


def test_a_failed_build_erases_the_line_and_a_build_beside_it_is_not_shown() -> None:
    terminal = Terminal()
    notice = BuildNotice(terminal, delay=0.0)

    def fail() -> None:
        with notice.building("a.cl"):
            assert terminal.shown.wait(10.0)
            with notice.building("b.cl"):
                pass
            raise ValueError("fails")

    with pytest.raises(ValueError, match="fails"):
        fail()
    assert terminal.getvalue().endswith("\r\x1b[K")
    assert "b.cl" not in terminal.getvalue()


def test_a_closed_terminal_does_not_stop_a_build() -> None:
    terminal = Terminal()
    terminal.close()
    with BuildNotice(terminal, delay=0.0).building("a.cl"):
        pass


def test_operations_show_their_builds(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    notice = BuildNotice(Terminal())
    plain = notice.building
    monkeypatch.setattr(notice, "building", lambda source: seen.append(source) or plain(source))
    clear_cache()
    show_builds(notice)
    LineReadout(method="centroid").bind(device, (16, 32), np.uint8).run()
    assert seen
    assert set(seen) == {"line/line.cl"}
    assert build_notice._DELAY == 2.0


@pytest.mark.parametrize("is_terminal", [True, False])
def test_commands_show_builds_on_a_terminal_only(tmp_path: Path, is_terminal: bool) -> None:
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM)
    controller, terminal = pty.openpty()
    environment = os.environ | {"TERM": "xterm"}
    done = subprocess.run(
        [sys.executable, str(program)],
        stdout=subprocess.PIPE,
        stderr=terminal if is_terminal else subprocess.PIPE,
        env=environment,
        check=False,
    )
    os.write(terminal, b"end")  # a read of an empty terminal would wait
    shown = os.read(controller, 10_000).decode()
    os.close(controller)
    os.close(terminal)
    assert (done.returncode, done.stdout) == (0, b"result\n")
    assert ("compiling kernels, 0 s: line/line.cl" in shown) == is_terminal
    assert not done.stderr
