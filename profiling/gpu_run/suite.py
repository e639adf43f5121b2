"""Step 3: the tests on the device, in their fast selection, with the kernel variant that the device uses."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from gpuvision.host import Device

_ROOT = Path(__file__).resolve().parents[2]
_SUMMARY_SECONDS = 20.0  # time in which interrupted tests end the current test and print the summary (chosen)
_OUTCOME = re.compile(r"(\d+) (passed|failed|errors?|skipped|xfailed|deselected)\b")


def run(device: Device, seconds: float, *selection: str) -> dict[str, Any]:
    """Run the tests of the checkout that run kernels on the device, in at most `seconds`.

    The process has ``GPUVISION_DEVICE`` set to the device: the best device of the tiers, which runs the whole fast
    tier. Vector variants run only where the device takes them.
    """
    if not (_ROOT / "tests" / "conftest.py").exists():
        return {"failure": f"{_ROOT} has no tests: run from a checkout"}
    command = [sys.executable, "-m", "pytest", "-q", "-rfE", "--tier", "fast"]
    command += selection or ["-k", f"[{device.label}"]
    environment = os.environ | {"GPUVISION_DEVICE": device.label, "PYTHONPATH": str(_ROOT)}
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(command, cwd=_ROOT, env=environment, stdout=log, stderr=subprocess.DEVNULL) as tests,
    ):
        end = _end_of(tests, seconds)
        log.seek(0)
        return {"end": end, **read_summary(log.read())}


def _end_of(tests: subprocess.Popen[bytes], seconds: float) -> str:
    """Wait for the tests and return how they ended; tests that are interrupted before the limit print a summary."""
    try:
        return f"exit code {tests.wait(max(seconds - _SUMMARY_SECONDS, 0.5 * seconds))}"
    except subprocess.TimeoutExpired:
        tests.send_signal(signal.SIGINT)
    try:
        tests.wait(_SUMMARY_SECONDS)
    except subprocess.TimeoutExpired:  # a kernel or the driver does not return
        tests.kill()
    return f"no end within {seconds:.0f} s"


def read_summary(text: str) -> dict[str, Any]:
    """Return the numbers of outcomes and the failed tests of pytest's output."""
    lines = text.splitlines()
    counts = {name: int(number) for line in lines[-3:] for number, name in _OUTCOME.findall(line)}
    return {**counts, "failures": [line for line in lines if line.startswith(("FAILED ", "ERROR "))]}
