"""Step 3: the tests on the device, in their fast selection, with the kernel variant that the device uses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from gpuvision.host import Device

_ROOT = Path(__file__).resolve().parents[2]
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
    try:
        ran = subprocess.run(
            command, cwd=_ROOT, env=environment, capture_output=True, text=True, timeout=seconds, check=False
        )
        text, end = ran.stdout, f"exit code {ran.returncode}"
    except subprocess.TimeoutExpired as expired:
        text = expired.stdout.decode(errors="replace") if isinstance(expired.stdout, bytes) else expired.stdout or ""
        end = f"no end within {seconds:.0f} s"
    return {"end": end, **read_summary(text)}


def read_summary(text: str) -> dict[str, Any]:
    """Return the numbers of outcomes and the failed tests of pytest's output."""
    lines = text.splitlines()
    counts = {name: int(number) for line in lines[-3:] for number, name in _OUTCOME.findall(line)}
    return {**counts, "failures": [line for line in lines if line.startswith(("FAILED ", "ERROR "))]}
