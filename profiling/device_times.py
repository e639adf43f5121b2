"""Times of the launches of a bound operation on the device, from OpenCL's profiling events."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from gpuvision.host import Bound, Device
from gpuvision.host.sequence import BoundSequence


class DeviceTimes(NamedTuple):
    """Median times of a call; of a sequence the sums over its launches.

    Attributes
    ----------
    queued
        From the enqueue to the submission to the device [s].
    submitted
        From the submission to the start of the kernel [s].
    running
        From the start to the end of the kernel [s].
    """

    queued: float
    submitted: float
    running: float


class Recorder:
    """Recorder of event times: a call launches a bound operation, waits, and records the times of its events.

    The kernels run in new queues with profiling enabled. Like the operation, they run in the thread of the caller or in
    the worker threads of the device. Each launch waits for its event before the next one is enqueued.
    """

    def __init__(self, bound: Bound[Any], device: Device) -> None:
        stages = bound.stages.values() if isinstance(bound, BoundSequence) else [bound]
        self._launches = []
        for stage in stages:
            _, kernel, size, group = stage.enqueue_arguments
            self._launches.append((device.new_queue(profiling=True, inline=stage.inline), kernel, size, group))
        self._bound = bound  # the arrays of the kernels' arguments live as long as it
        self._times: list[tuple[int, int, int]] = []

    def __call__(self) -> None:
        """Launch, wait, and record the times; record nothing where the runtime has none."""
        events = []
        for launch in self._launches:
            events.append(cl.enqueue_nd_range_kernel(*launch))
            events[-1].wait()
        try:
            points = np.array(
                [[each.profile.queued, each.profile.submit, each.profile.start, each.profile.end] for each in events],
                dtype=np.int64,
            )
        except cl.Error:  # CL_PROFILING_INFO_NOT_AVAILABLE
            return
        queued, submitted, running = np.diff(points, axis=1).sum(axis=0)
        self._times.append((queued, submitted, running))

    def medians(self) -> DeviceTimes | None:
        """Return the median times; None without events, or where a runtime gives times that are not in order."""
        times = np.array(self._times)
        if not len(times) or np.any(times < 0) or not np.any(times[:, 2]):
            return None
        return DeviceTimes(*(1e-9 * np.median(times, axis=0)).tolist())
