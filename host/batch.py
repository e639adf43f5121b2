"""Batches of a stream: consecutive frames with their results, and their default size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from gpuvision.host.arrays import HostArray
from gpuvision.host.ring import map_arrays
from gpuvision.host.sources import Source

R = TypeVar("R", bound=tuple[Any, ...])

# Size of the default batch [bytes]: enough work for a launch, small enough for the last-level cache (speed only).
_DEFAULT_BATCH_BYTES = 1 << 22


@dataclass(slots=True)
class Batch(Generic[R]):
    """Consecutive frames and their results in the memory of the stream.

    The arrays are valid until the next batch is requested; `copy` keeps them.

    Attributes
    ----------
    number : int
        Number of the first frame, counted from 0.
    frames : (count, ...) array
    result : Result of arrays
        Result of the last operation, with the frames along the first axis.
    arrived : (count,) int64 array
        Arrival time of each frame [ns of the stream's clock], as all times here.
    launched, delivered : int
        Times of the launch, and of the arrival of the results in host memory.
    started, ended : int or None
        Start and end of the computation on the device, on the host's clock, where the stream profiles.
    exposure_delay : int
        Time from the middle of the exposure of a frame to its arrival, as the source states it. Default 0.
    """

    number: int
    frames: HostArray
    result: R
    arrived: HostArray
    launched: int
    started: int | None
    ended: int | None
    delivered: int
    exposure_delay: int = 0

    @property
    def exposed(self) -> HostArray:
        """(count,) int64 middle of the exposure of each frame [ns]."""
        return np.asarray(self.arrived - self.exposure_delay)

    @property
    def latency(self) -> HostArray:
        """(count,) int64 time from the middle of the exposure of each frame to its results in host memory [ns]."""
        return np.asarray(self.delivered - self.exposed)

    def __len__(self) -> int:
        return len(self.frames)

    def copy(self) -> Batch[R]:
        """Return a copy of the batch that stays valid."""
        result = map_arrays(self.result, np.copy)
        times = (self.launched, self.started, self.ended, self.delivered, self.exposure_delay)
        return Batch(self.number, self.frames.copy(), result, self.arrived.copy(), *times)


def default_batch(source: Source, ring: int) -> int:
    """Return a batch size of about 4 MB, smaller where a short recording would not fill the ring."""
    size = max(math.prod(source.shape) * source.dtype.itemsize, 1)
    batch = max(_DEFAULT_BATCH_BYTES // size, 1)
    return batch if source.length is None else max(min(batch, -(-source.length // ring)), 1)
