"""Run all kernels in oclgrind, a simulator that reports accesses beyond an array and data races (``make sanitize``).

The operations are the examples of ``gpuvision profile --offline``, in their work-item variant, on small arrays: first
on zeros, then on random numbers, which point beyond images and fields. Integer arrays that a kernel uses as indices
stay zero. A kernel file fails if oclgrind reports an error, and if its process crashes or takes too long.

oclgrind 21.10 (Debian) knows no ``noalias`` scopes, which Clang makes where it inlines functions: kernels are built
with ``-cl-opt-disable``, and the attribute ``always_inline`` is replaced. Its option ``--uninitialized`` is not used:
it takes arrays that ``clEnqueueFillBuffer`` filled for uninitialised.

Usage: ``python tests/sanitize.py [KERNEL...]``, such as ``python tests/sanitize.py psd line``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.offline.builds import Example
from gpuvision.profiling.offline.registry import all_examples

_SIDE = 37  # most elements of an axis: a prime, so that work-groups do not divide it
_SECONDS = 1800  # limit of a kernel file (chosen); with a free core the longest takes some minutes
_LAUNCHED = "launched "
# Reports that are no errors of the kernels: pattern of the report, and the reason.
FALSE_POSITIVES: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Finding:
    """Result of a kernel file.

    Attributes
    ----------
    kernel : str
        Stem of the kernel file.
    launched : int
        Builds that ran.
    reports : list of str
        Reports of oclgrind that are not in `FALSE_POSITIVES`, each once, and crashes.
    seconds : float
        Time [s].
    """

    kernel: str
    launched: int
    reports: list[str]
    seconds: float


def small(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return a shape with at most `_SIDE` elements along every axis, and 3 along the first of three or more."""
    sizes = [min(size, _SIDE) for size in shape]
    return (min(sizes[0], 3), *sizes[1:]) if len(sizes) > 2 and sizes[0] > 2 else tuple(sizes)


def launch(example: Example, device: Device, rng: np.random.Generator) -> None:
    """Bind an example on a small shape, which launches it on zeros, and launch it again on random numbers."""
    bound: Any = example.operation.bind(device, small(example.shape), example.dtype)
    for array in bound.inputs:
        if array.dtype.kind == "f":
            array.set(rng.uniform(-10.0, 1.5 * _SIDE, array.shape).astype(array.dtype))
        elif array.dtype.itemsize < 4:  # grey levels, codes and flags; integers of 4 bytes are indices
            array.set(rng.integers(0, 256, array.shape).astype(array.dtype))
    bound().wait()


def examples_of(kernel: str, device: Device) -> list[Example]:
    """Return the examples of a kernel file that this device takes."""
    found = []
    for example in all_examples():
        if example.has_double == device.has_double:
            described = example.operation.launch(device, example.shape, np.dtype(example.dtype))
            if Path(described.source).stem == kernel:
                found.append(example)
    return found


def run_inside(kernel: str) -> None:
    """Launch the examples of a kernel file; runs within oclgrind."""
    device, rng = Device.best(), np.random.default_rng(5)
    assert device.kind == "oclgrind", device
    for example in examples_of(kernel, device):
        launch(example, device, rng)
        print(f"{_LAUNCHED}{example.name}", flush=True)


def reports_of(log: str) -> list[str]:
    """Return the distinct reports of a log: first line, kernel and place in the source."""
    found = []
    for part in re.split(r"\n\s*\n", log):
        lines = [line.strip() for line in part.strip().splitlines()]
        chosen = [line for line in lines if line.startswith(("At line", "Kernel"))]
        if lines and lines[0]:
            found.append("; ".join([re.sub(r" address 0x\w+", "", lines[0]), *chosen]))
    unknown = [each for each in found if not any(re.search(pattern, each) for pattern, _ in FALSE_POSITIVES)]
    return list(dict.fromkeys(unknown))


def sanitize(kernel: str) -> Finding:
    """Run the examples of a kernel file in a process of oclgrind."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="gpuvision-sanitize-") as folder:
        log = Path(folder, "log.txt")
        options = [
            "--data-races",
            "--max-errors",
            "1000",
            "--build-options",
            "-cl-opt-disable -Dalways_inline=unused",
            "--log",
            str(log),
        ]
        command = ["oclgrind", *options, sys.executable, __file__, "--inside", kernel]
        # A separate cache: other runtimes must not read the programs and verdicts of the simulator.
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=_SECONDS, env=environment, check=False
            )
            output = done.stdout
            fatal = re.search(r"OCLGRIND FATAL ERROR.*\n(.*)", done.stderr)
            reason = fatal[1] if fatal else done.stderr.strip()[-300:]
            failures = [f"exit code {done.returncode}: {reason}"] if done.returncode else []
        except subprocess.TimeoutExpired as late:
            output = (late.stdout or b"").decode()
            failures = [f"took more than {_SECONDS} s"]
        reports = reports_of(log.read_text()) if log.exists() else []
    return Finding(kernel, output.count(_LAUNCHED), reports + failures, time.monotonic() - started)


def main(kernels: list[str]) -> int:
    """Run oclgrind over kernel files, print a line for each, and return the exit code."""
    if shutil.which("oclgrind") is None:
        print("oclgrind is missing; install it: apt-get install oclgrind", file=sys.stderr)
        return 1
    model = Device.best()
    known = sorted(
        {
            Path(each.operation.launch(model, each.shape, np.dtype(each.dtype)).source).stem
            for each in all_examples()
            if each.has_double == model.has_double
        }
    )
    is_clean = True
    for kernel in kernels or known:
        found = sanitize(kernel)
        print(f"{kernel:22} {found.launched:3} builds, {len(found.reports)} reports, {found.seconds:.0f} s", flush=True)
        for report in found.reports:
            print(f"    {report}")
        is_clean = is_clean and not found.reports and found.launched > 0
    return 0 if is_clean else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        run_inside(sys.argv[2])
    else:
        sys.exit(main(sys.argv[1:]))
