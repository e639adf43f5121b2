"""Launch overhead of a bound operation in Python, compared with pyopencl: a hundred launches of a tiny kernel."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpuvision.host import Device
from gpuvision.host.arrays import memory_of
from gpuvision.profiling.harness import Case
from gpuvision.ranging.psd import PsdReadout

_LAUNCHES = 100
_REPEATS = 50


def cases(device: Device) -> Iterator[Case]:
    """Yield `bound`, with fixed arguments, `given`, with a new input in each call, and `given-out`, with new arrays.

    The peer sets the same arguments of the kernel of the bound operation, and launches it with the same sizes.
    """
    bound = PsdReadout(strip_length=6e-3).bind(device, (16, 2), np.float32)
    frames = [device.empty((16, 2), np.float32) for _ in range(2)]
    for frame in frames:
        frame.set(np.ones((16, 2), np.float32))
    results = [bound.allocate() for _ in range(2)]
    inputs = [{0: memory_of(frame)} for frame in frames]
    # Arguments of the kernel: the input, then the fields of the result, of which the computed ones are the first.
    arrays = [
        dict(enumerate(memory_of(array) for array in (frame, *result) if isinstance(array, cl.array.Array)))
        for frame, result in zip(frames, results, strict=True)
    ]
    site = bound._site_on(bound.enqueue_arguments[0])  # where arrays and numbers are arguments of the kernel
    bound._set_arrays(site, bound._own)
    queue, kernel, *sizes = site.arguments
    calls: dict[str, tuple[Callable[[int], object], list[dict[int, Any]]]] = {
        "bound": (lambda _: bound(), [{}, {}]),
        "given": (lambda number: bound(frames[number]), inputs),
        "given-out": (lambda number: bound(frames[number], out=results[number]), arrays),
    }
    for name, (launch, arguments) in calls.items():
        ours = _repeated(launch, queue)
        plain = _repeated(functools.partial(_launch_plainly, queue, kernel, sizes, arguments), queue)
        metadata = {"overhead_us": _overhead(ours, plain) * 1e6}
        yield Case("launch", name, ours, {"pyopencl": plain}, error=0.0, repeats=_LAUNCHES, metadata=metadata)


def _launch_plainly(queue: Any, kernel: Any, sizes: list[Any], arguments: list[dict[int, Any]], number: int) -> None:
    """Set the arguments of one call and launch the kernel, with pyopencl alone."""
    for place, memory in arguments[number].items():
        kernel.set_arg(place, memory)
    cl.enqueue_nd_range_kernel(queue, kernel, *sizes)


def _repeated(launch: Callable[[int], object], queue: Any) -> Callable[[], None]:
    """Return a function that launches many times, with the arrays 0 and 1 in turn, and waits."""

    def launches() -> None:
        for number in range(_LAUNCHES):
            launch(number % 2)
        queue.finish()

    return launches


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
