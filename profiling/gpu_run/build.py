"""Step 1: build every kernel on the device: time, registers, spills, stack, local memory."""

from __future__ import annotations

import functools
import re
import time
from collections import Counter
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host import Device
from gpuvision.host.debug import flatten_includes
from gpuvision.host.program import options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.gpu_run.worker import Worker
from gpuvision.profiling.offline import matching_builds, ranging_builds, simulation_builds
from gpuvision.profiling.offline.builds import Example

_SECONDS = 120.0  # time limit of one build
# Lines of NVIDIA's assembler in the build log (option -cl-nv-verbose).
_ENTRY = re.compile(r"entry function '(\w+)'")
_NUMBERS = {
    "registers": re.compile(r"Used (\d+) registers"),
    "stack": re.compile(r"(\d+) bytes stack frame"),
    "spill_stores": re.compile(r"(\d+) bytes spill stores"),
    "spill_loads": re.compile(r"(\d+) bytes spill loads"),
}


def run(device: Device, seconds: float) -> dict[str, Any]:
    """Build all examples, each within 120 s, and return the rows and the failures; stop after `seconds`."""
    rows: list[dict[str, Any]] = []
    end = time.monotonic() + seconds
    with Worker() as worker:
        count = worker.call(example_count, device.label, seconds=_SECONDS).value or 0
        for number in range(count):
            if time.monotonic() > end:
                break
            answer = worker.call(
                build_example, device.label, number, seconds=min(_SECONDS, max(end - time.monotonic(), 1.0))
            )
            rows.append(answer.value or {"case": f"example {number}", "failure": answer.failure})
    outcomes = Counter("refused" if "refused" in row else "failed" if row.get("failure") else "built" for row in rows)
    return {"examples": count, **outcomes, "not_reached": count - len(rows), "rows": rows}


@functools.cache
def _examples(label: str) -> list[Example]:
    """Return the examples with different sources or macros on a device, and the examples that the device refuses."""
    device = Device.named(label)
    found: dict[Any, Example] = {}
    for example in (*ranging_builds.examples(), *matching_builds.examples(), *simulation_builds.examples()):
        try:
            launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
        except (TypeError, ValueError):
            found[example.name, type(example.operation)] = example
        else:
            found.setdefault((launch.source, tuple(options(launch.defines))), example)
    return list(found.values())


def example_count(label: str) -> int:
    """Return the number of builds for a device."""
    return len(_examples(label))


def build_example(label: str, number: int) -> dict[str, Any]:
    """Build an example without the caches of pyopencl and return its row."""
    device, example = Device.named(label), _examples(label)[number]
    try:
        launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
    except (TypeError, ValueError) as error:  # such as float64 on a device without doubles
        return {"case": example.name, "operation": type(example.operation).__name__, "refused": str(error)}
    row: dict[str, Any] = {"case": example.name, "source": launch.source, "kernel": launch.kernel}
    verbose = ["-cl-nv-verbose"] if device.kind == "nvidia" else []
    start = time.perf_counter()
    try:
        program: Any = cl.Program(device.context, flatten_includes(KERNEL_FOLDER, launch.source))
        built = program.build(options=[*options(launch.defines), *verbose], devices=[device.handle], cache_dir=False)
        kernel = cl.Kernel(built, launch.kernel)
    except cl.Error as error:
        return row | {"failure": " ".join(str(error).split())[:600]}
    info = cl.kernel_work_group_info
    row |= {
        "seconds": round(time.perf_counter() - start, 3),
        "group": kernel.get_work_group_info(info.WORK_GROUP_SIZE, device.handle),
        "group_used": launch.local_size,
        "local_bytes": kernel.get_work_group_info(info.LOCAL_MEM_SIZE, device.handle),
        "private_bytes": kernel.get_work_group_info(info.PRIVATE_MEM_SIZE, device.handle),
    }
    return row | read_log(built.get_build_info(device.handle, cl.program_build_info.LOG), launch.kernel)


def read_log(log: str, kernel: str) -> dict[str, int]:
    """Return registers, stack and spills [bytes] of a kernel from the log of NVIDIA's compiler, if it is such a log."""
    parts = _ENTRY.split(log)
    texts = dict(zip(parts[1::2], parts[2::2], strict=True))
    found = {name: pattern.search(texts.get(kernel, "")) for name, pattern in _NUMBERS.items()}
    return {name: int(match[1]) for name, match in found.items() if match}
