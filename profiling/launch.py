"""Launch overhead of a bound operation in Python, compared with pyopencl: a hundred launches of a tiny kernel."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pyopencl as cl

from gpuvision.host import Device
from gpuvision.profiling.harness import Case
from gpuvision.ranging.psd import PsdReadout

_LAUNCHES = 100
_REPEATS = 50


def cases(device: Device) -> Iterator[Case]:
    """Yield `bound`, with fixed arguments, and `given`, with a different input array in each call."""
    bound = PsdReadout(strip_length=6e-3).bind(device, (16, 2), np.float32)
    frames = [device.empty((16, 2), np.float32) for _ in range(2)]
    for frame in frames:
        frame.set(np.ones((16, 2), np.float32))
    # The peer launches the kernel of the bound operation with the same sizes.
    arguments = bound.enqueue_arguments
    queue = arguments[0]

    def plain() -> None:
        for _ in range(_LAUNCHES):
            cl.enqueue_nd_range_kernel(*arguments)
        queue.finish()

    def preset() -> None:
        for _ in range(_LAUNCHES):
            bound()
        queue.finish()

    def given() -> None:
        for number in range(_LAUNCHES):
            bound(frames[number % 2])
        queue.finish()

    for name, call in (("bound", preset), ("given", given)):
        metadata = {"overhead_us": _overhead(call, plain) * 1e6}
        yield Case("launch", name, call, {"pyopencl": plain}, error=0.0, repeats=_LAUNCHES, metadata=metadata)


def _overhead(call: Callable[[], None], plain: Callable[[], None]) -> float:
    """Return the median difference between our time and the time of the peer, for one launch [s]."""
    extra = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        call()
        between = time.perf_counter()
        plain()
        extra.append((between - start - (time.perf_counter() - between)) / _LAUNCHES)
    return float(np.median(extra))
