"""Check and measure a GPU in five steps, each in another process and under ten minutes; write one results file."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gpuvision.host import Device
from gpuvision.profiling.gpu_run import breakage, build, streams, suite, times

STEPS: dict[str, Callable[[Device, float], dict[str, Any]]] = {
    "build": build.run,
    "breakage": breakage.run,
    "suite": suite.run,
    "streams": streams.run,
    "times": times.run,
}
_SECONDS = 570.0  # time limit of a step
_GRACE = 25.0  # time for the end of a step after its limit


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the steps and return 1 if a step did not end."""
    parser = argparse.ArgumentParser(prog="python -m gpuvision.profiling.gpu_run", description=__doc__)
    parser.add_argument("--device", help="label of the device; default: the best one")
    parser.add_argument("--out", type=Path, default=Path("gpu_run.json"), help="results file; a step replaces its part")
    parser.add_argument("--step", action="append", choices=STEPS, help="step to run; repeat for several; default: all")
    parser.add_argument("--seconds", type=float, default=_SECONDS, help="time limit of a step [s]")
    parser.add_argument("--here", action="store_true", help="run in this process")
    parser.add_argument("--begun", type=float, help="start of the time limit, seconds since 1970; default: now")
    options = parser.parse_args(arguments)
    # NVIDIA's driver keeps binaries: a cached one has no log with registers and no time of compilation.
    os.environ.setdefault("CUDA_CACHE_DISABLE", "1")
    device = Device.best() if options.device is None else Device.named(options.device)
    failed = 0
    for step in options.step or STEPS:
        if options.here:
            start = time.monotonic()
            # Starting this process took some of the time: many seconds on a busy machine, or with a slow driver.
            left = options.seconds - (0.0 if options.begun is None else time.time() - options.begun)
            result = STEPS[step](device, max(left, 1.0))
            write_part(options.out, device, step, result | {"step_seconds": round(time.monotonic() - start, 1)})
        else:
            failed += _run_apart(step, device, options.out, options.seconds)
    return int(failed > 0)


def _run_apart(step: str, device: Device, out: Path, seconds: float) -> bool:
    """Run a step in another process and return whether it failed; its end is written all the same."""
    command = [sys.executable, "-m", "gpuvision.profiling.gpu_run", "--here", "--step", step]
    command += ["--device", device.label, "--out", str(out), "--seconds", str(seconds), "--begun", str(time.time())]
    print(f"{step} ...", flush=True)
    try:
        ran = subprocess.run(command, timeout=seconds + _GRACE, check=False)
        failure = f"the step ended with exit code {ran.returncode}" if ran.returncode else ""
    except subprocess.TimeoutExpired:
        failure = f"no end within {seconds + _GRACE:.0f} s"
    if failure:
        write_part(out, device, step, {"failure": failure})
        print(f"{step}: {failure}", flush=True)
    return bool(failure)


def write_part(out: Path, device: Device, step: str, result: dict[str, Any]) -> None:
    """Write the result of a step to the results file, beside the results of the other steps."""
    whole: dict[str, Any] = json.loads(out.read_text()) if out.exists() else {}
    whole["machine"] = {
        "device": device.label,
        "name": device.name,
        "driver": device.driver,
        "compute_units": device.compute_units,
        "memory": int(device.handle.global_mem_size),
        "has_double": device.has_double,
        "system": platform.platform(),
        "pyopencl": version("pyopencl"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    whole[step] = result
    temporary = out.with_suffix(".part")
    temporary.write_text(json.dumps(whole, indent=1) + "\n")
    temporary.replace(out)


if __name__ == "__main__":
    sys.exit(main())
