"""Description of the machine that a benchmark ran on."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gpuvision.host import Device
from gpuvision.profiling import ceiling


def describe_machine(devices: Sequence[Device]) -> dict[str, Any]:
    """Return date, processor, system, versions and devices, which the times depend on."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "processor": _processor(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("gpuvision", "numpy", "pyopencl", "numba")},
        "devices": {
            each.label: {
                "name": each.name,
                "driver": each.driver,
                "units": each.compute_units,
                "gflops": round(ceiling.flop_rate(each) / 1e9),
                "bandwidths": {str(size): rate for size, rate in ceiling.bandwidths(each).items()},
            }
            for each in devices
        },
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
