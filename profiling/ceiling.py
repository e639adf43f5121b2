"""Measured limits of a device: time of a copy, and rate of multiply-adds."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pyopencl as cl

from gpuvision.host import Bound, Device, Launch, flags
from gpuvision.host.arrays import memory_of
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER, VisionOperation

SIZES = (1 << 20, 8 << 20, 192 << 20)
"""Bytes that the copies of `bandwidths` move."""
_COPIES, _COPYING = 12, 0.03  # least number of copies of a size, and least time for them [s]
_VECTOR = 64  # bytes that a work-item moves per step
# Work-items of a copy for each core, and for each core of a device that runs neighbouring work-items side by side.
_SHARES_PER_CORE, _ITEMS_PER_UNIT = 8, 4096
_TRIALS = 5  # launches of each form of the copy, of which the fastest form is kept
_LAUNCH = 0.2  # a launch of the multiply-adds that takes longer gets no more work-items [s]
_FLOPS_PER_STEP = 8 * 16 * 2  # 8 vectors of 16 floats, one multiplication and one addition each


class Moved(NamedTuple):
    """Result of `Move`: the vectors that it writes."""

    to: Any


@dataclass(frozen=True, kw_only=True)
class Move(VisionOperation[Moved]):
    """Kernel that only reads and writes memory in sequence, in one of the forms that `mover` tries.

    Parameters
    ----------
    writes : int
        Vectors of 64 bytes that it writes; it reads its input once.
    prefetches, past_caches : bool
        Build options of ``ceiling.cl``. Default False.
    """

    Result: ClassVar[type[Any]] = Moved

    writes: int
    prefetches: bool = False
    past_caches: bool = False

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for an input of one shape, as `Operation.launch` says."""
        vectors = device.prefers_vectors
        return Launch(
            source="ceiling/ceiling.cl",
            kernel="move" if vectors else "move_items",
            inputs=[(shape, dtype)],
            outputs={"to": ((max(self.writes, 1) * 16,), dtype)},
            global_size=(device.compute_units * (_SHARES_PER_CORE if vectors else _ITEMS_PER_UNIT),),
            local_size=(1,) if vectors else None,
            defines=flags(PREFETCH=self.prefetches, PAST_CACHES=self.past_caches),
            arguments=[np.int64(shape[0] // 16), np.int64(self.writes)],
            by_team=vectors and not self.past_caches,
        )


def move(device: Device, read: int, written: int, repeats: int = 1) -> Callable[[], None]:
    """Return a function that reads and writes memory sequentially, `repeats` times back to back, and waits.

    The arguments `read` and `written` are numbers of bytes. The copy is the fastest of the forms of `mover`. Its time
    is a lower limit for a kernel with the same traffic in the same cache or memory. It includes the launch, which
    waiting workers share (`gpuvision.host.team`), as launches of operations.
    """
    bound = mover(device, None, read, written)

    def run() -> None:
        for _ in range(repeats - 1):
            bound()
        bound.run()

    run()
    return run


def mover(device: Device, queue: Any, read: int, written: int) -> Bound[Moved]:
    """Return the fastest form of a kernel that reads and writes memory sequentially, bound to a queue.

    Parameters
    ----------
    device : Device
    queue : pyopencl.CommandQueue or None
        As in `Operation.bind`.
    read, written : int
        Traffic [bytes].
    """
    reads, writes = max(read // _VECTOR, 1), written // _VECTOR
    is_large = device.is_cpu and read + written > device.cache_bytes
    options = itertools.product((False, True), (False, True) if is_large else (False,))
    forms = [Move(writes=writes, prefetches=ahead, past_caches=past) for ahead, past in options]
    bound = (form.bind(device, (16 * reads,), np.float32, queue=queue) for form in forms)
    return min(bound, key=_least_time) if device.prefers_vectors else next(bound)


def _least_time(bound: Bound[Moved]) -> float:
    """Return the least time of a few launches, each of which is waited for [s]."""
    times = []
    for _ in range(_TRIALS):
        start = time.perf_counter()
        bound.run()
        times.append(time.perf_counter() - start)
    return min(times)


def bandwidths(device: Device) -> dict[int, float]:
    """Return the rate of the copy kernel [B/s] by the number of bytes that it moves, a third of them writes.

    Small copies stay in the caches, the largest one does not fit into the caches of common devices. The rate is that of
    the fastest of several launches, by the events of the runtime, so that it holds no launch; without events by the
    clock of the host.
    """
    return {size: size / _fastest_move(device, size) for size in SIZES}


def _fastest_move(device: Device, size: int) -> float:
    """Return the least time of a copy of `size` bytes [s]."""
    launch = mover(device, device.new_queue(profiling=True), size - size // 3, size // 3)
    times: list[float] = []
    end = time.perf_counter() + _COPYING
    while len(times) < _COPIES or time.perf_counter() < end:
        start = time.perf_counter()
        event = launch()
        event.wait()
        on_host = time.perf_counter() - start
        on_device = _event_time(event)
        times.append(on_device if on_device > 0.0 else on_host)
    return min(times)


def _event_time(event: Any) -> float:
    """Return the time of a kernel from its start to its end [s]; 0 where the runtime has none."""
    try:
        return float(1e-9 * (event.profile.end - event.profile.start))
    except cl.Error:  # CL_PROFILING_INFO_NOT_AVAILABLE
        return 0.0


def flop_rate(device: Device, *, seconds: float = 0.15) -> float:
    """Return the rate of single-precision multiply-adds on all cores [FLOP/s]: median of short launches.

    Two calls differ if the machine changed its speed between them. A launch has fewer work-items on devices that would
    take long: Mesa's llvmpipe computes multiply-adds in software, at less than 1 GFLOP/s.
    """
    most = device.compute_units * (4 if device.prefers_vectors else 4096)
    items = device.compute_units * 4
    target = device.empty((most * 16,), np.float32)
    kernel = cl.Kernel(build(device, KERNEL_FOLDER, "ceiling/ceiling.cl", {}), "compute")
    steps = 20_000 if device.prefers_vectors else 2_000

    def launch(items: int, steps: int) -> float:
        """Return the time of a launch [s]."""
        kernel.set_args(memory_of(target), np.float32(1.0), np.float32(0.5), np.int32(steps))
        start = time.perf_counter()
        cl.enqueue_nd_range_kernel(device.queue, kernel, (items,), (1,) if device.prefers_vectors else None).wait()
        return time.perf_counter() - start

    launch(items, 1)  # compiles
    while items < most and min(launch(items, steps), launch(items, steps)) < _LAUNCH:
        items = min(4 * items, most)
    rates: list[float] = []
    end = time.perf_counter() + seconds
    while len(rates) < 5 or time.perf_counter() < end:
        rates.append(items * steps * _FLOPS_PER_STEP / launch(items, steps))
    return float(np.median(rates[1:]))
