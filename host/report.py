"""Report of a stream: number of frames, throughput, latency, and time of each stage."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.host.stalls import Stall

# A bin is the exponent of a float32 and 7 bits of its mantissa: narrower than 1/100 of the value. The last bin ends at
# 2**44 ns, five hours.
_DROPPED_BITS = 16
_LOWEST = int(np.float32(1.0).view(np.int32)) >> _DROPPED_BITS
_BINS = (int(np.float32(2.0**44).view(np.int32)) >> _DROPPED_BITS) - _LOWEST
_PENDING = 1024  # durations that are collected before they are sorted into bins (speed only)


@dataclass(frozen=True)
class DurationStatistics:
    """Statistics of a duration [s]; NaN where nothing was counted.

    Attributes
    ----------
    count : int
        Number of durations. Default 0.
    mean, maximum : float
        Mean and largest duration [s].
    p50, p99, p999 : float
        Quantiles 0.5, 0.99 and 0.999 [s], with a relative error below 1/100.
    """

    count: int = 0
    mean: float = math.nan
    p50: float = math.nan
    p99: float = math.nan
    p999: float = math.nan
    maximum: float = math.nan


class DurationHistogram:
    """Histogram of durations with logarithmic bins, in memory that does not grow with their number."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._pending = np.zeros(_PENDING, np.int64)
        self._filled = 0
        self._total = self._maximum = 0

    def add(self, nanoseconds: int) -> None:
        """Add a duration [ns]."""
        self._pending[self._filled] = nanoseconds
        self._filled += 1
        if self._filled == _PENDING:
            self._fold()

    def add_all(self, nanoseconds: NDArray[np.int64]) -> None:
        """Add durations [ns], at most 1024 in a call."""
        count = len(nanoseconds)
        if self._filled + count > _PENDING:
            self._fold()
        self._pending[self._filled : self._filled + count] = nanoseconds
        self._filled += count

    def _fold(self) -> None:
        values = self._pending[: self._filled]
        bins = (np.maximum(values, 1).astype(np.float32).view(np.int32) >> _DROPPED_BITS) - _LOWEST
        self._counts += np.bincount(np.minimum(bins, _BINS - 1), minlength=_BINS)
        self._total += int(values.sum())
        self._maximum = max(self._maximum, int(values.max()))
        self._filled = 0

    def statistics(self) -> DurationStatistics:
        """Return the statistics of all durations so far."""
        if self._filled:
            self._fold()
        count = int(self._counts.sum())
        if not count:
            return DurationStatistics()
        upto = np.cumsum(self._counts)

        def quantile(share: float) -> float:
            place = int(np.searchsorted(upto, max(share * count, 1.0)))
            low, high = np.array([place, place + 1], np.int32) + _LOWEST << _DROPPED_BITS
            middle = 0.5 * (float(low.view(np.float32)) + float(high.view(np.float32)))
            return min(middle, self._maximum) * 1e-9

        return DurationStatistics(
            count=count,
            mean=self._total / count * 1e-9,
            p50=quantile(0.5),
            p99=quantile(0.99),
            p999=quantile(0.999),
            maximum=self._maximum * 1e-9,
        )


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """Report of a stream up to now.

    Attributes
    ----------
    frames, batches : int
        Number of frames and batches delivered to the consumer.
    dropped : int
        Number of frames that arrived and were discarded for newer ones.
    throughput : float
        Delivered frames per second, without the warm-up.
    seconds : float
        Time from the start to the last delivery, with the warm-up [s].
    latency : DurationStatistics
        Time from the arrival of a frame to its result in host memory, without the warm-up. Batches of more than 1024
        frames are sampled: at most 1024 frames count, the oldest one among them.
    warm_up : int
        Number of frames at the start that `throughput`, `latency` and `stages` leave out; 0 in a stream that was not
        longer than its warm-up.
    batch, ring, policy, device, zero_copy, inline
        Settings of the stream.
    fill_mean : float
    fill_maximum : int
        Mean and largest number of launched batches at a delivery, the delivered one included.
    longest_stall : Stall or None
        Longest time without a delivery although a batch of frames had arrived, and the parts of the stream that spent
        it. The warm-up counts, because a stall loses frames there as well. ``None`` before the first delivery.
    stages : dict of str to DurationStatistics
        Time per batch. On the host: ``slot`` (wait for a free slot), ``source``, ``launch``, ``queue`` (launched, not
        yet requested by the consumer), ``wait`` (the consumer waits for the device) and ``sink``. On the device, where
        the stream profiles: ``upload``, ``compute``, ``download``.
    """

    frames: int
    batches: int
    dropped: int
    throughput: float
    seconds: float
    latency: DurationStatistics
    warm_up: int
    batch: int
    ring: int
    policy: str
    device: str
    zero_copy: bool
    fill_mean: float
    fill_maximum: int
    inline: bool = False
    longest_stall: Stall | None = None
    stages: dict[str, DurationStatistics] = field(default_factory=dict)

    def __str__(self) -> str:
        latency = self.latency
        stall = "" if self.longest_stall is None else f"; longest stall {self.longest_stall}"
        return (
            f"{self.frames} frames, {self.dropped} dropped, latency p50 {1e3 * latency.p50:.3g} ms, "
            f"p99 {1e3 * latency.p99:.3g} ms{stall}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the report as dictionaries, lists and numbers for JSON; ``None`` for NaN."""
        plain: dict[str, Any] = _without_nan(asdict(self))
        if self.longest_stall is not None:
            plain["longest_stall"]["place"] = self.longest_stall.place
        return plain


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(each) for name, each in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


class StreamStatistics:
    """Running statistics of a stream, which forget the durations of the warm-up at its end."""

    def __init__(self, warm_up: int) -> None:
        self._left = warm_up
        self.started = self.last = 0
        self.frames = self.batches = 0
        self._warm = 0
        self._restart(0)

    def _restart(self, now: int) -> None:
        self._since, self._warm = now, self.frames
        self._latency = DurationHistogram()
        self._stages: dict[str, DurationHistogram] = {}
        self._fill = self._fill_maximum = self._fill_count = 0

    def add_batch(self, delivered: int, latencies: NDArray[np.int64], fill: int) -> None:
        """Add a batch at its delivery.

        Parameters
        ----------
        delivered : int
            Time of the delivery [ns].
        latencies : (frames,) int64 array
            Latencies of its frames [ns].
        fill : int
            Number of launched batches, this one included.
        """
        if self._left == 0 and self.batches:
            self._restart(self.last)
        self._left -= 1
        self.frames += len(latencies)
        self.batches += 1
        self.last = delivered
        self._latency.add_all(latencies[:: max(-(-len(latencies) // _PENDING), 1)])
        self._fill += fill
        self._fill_count += 1
        if fill > self._fill_maximum:
            self._fill_maximum = fill

    def add_stage(self, stage: str, nanoseconds: int) -> None:
        """Add the duration of a stage [ns]."""
        durations = self._stages.get(stage)
        if durations is None:
            durations = self._stages[stage] = DurationHistogram()
        durations.add(nanoseconds)

    def report(self, **setup: Any) -> StreamReport:
        """Return the report up to now, with the settings of the stream."""
        since = self._since or self.started
        span = (self.last - since) * 1e-9
        return StreamReport(
            frames=self.frames,
            batches=self.batches,
            throughput=(self.frames - self._warm) / span if span > 0 else math.nan,
            seconds=max(self.last - self.started, 0) * 1e-9,
            latency=self._latency.statistics(),
            warm_up=self._warm,
            fill_mean=self._fill / self._fill_count if self._fill_count else math.nan,
            fill_maximum=self._fill_maximum,
            stages={stage: durations.statistics() for stage, durations in self._stages.items()},
            **setup,
        )
