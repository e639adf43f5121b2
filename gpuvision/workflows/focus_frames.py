"""Frames of a focus stack: read them one by one and keep the sharpest focus of each pixel."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from gpuvision.host.batch import default_batch
from gpuvision.host.report import StreamReport, StreamStatistics
from gpuvision.host.sources import Source
from gpuvision.ranging.focus_stack import FocusPeak, FocusSearch, FocusStack


def read_focus_peak(
    source: Source, stack: FocusStack, progress: Callable[[int, int | None], object]
) -> tuple[FocusPeak, StreamReport]:
    """Read a focus stack to its end, and close it.

    Parameters
    ----------
    source : Source
        Frames, (rows, columns).
    stack : FocusStack
    progress : callable
        Called with the number of processed frames and the number of all frames (None if unknown).

    Returns
    -------
    FocusPeak
    StreamReport
        Counts and times of the frames; the computation runs on the host.

    Raises
    ------
    RecordingError
        The recording cannot be read.
    ValueError
        The stack has too few frames.
    """
    try:
        search, statistics = FocusSearch(stack, source.dtype), StreamStatistics(0)
        batch = default_batch(source, 1)
        frames, arrived = np.empty((batch, *source.shape), source.dtype), np.zeros(batch, np.int64)
        statistics.started = time.perf_counter_ns()
        while source.wait() and (count := source.read_into(frames, arrived)):
            for frame in frames[:count]:
                search.add(frame)
            now = time.perf_counter_ns()
            statistics.add_batch(now, now - arrived[:count], 1)
            progress(search.frames, source.length)
        peak = search.peak()
    finally:
        source.close()
    setup = {"dropped": 0, "batch": batch, "ring": 1, "policy": "block", "device": "host", "zero_copy": True}
    return peak, statistics.report(**setup)
