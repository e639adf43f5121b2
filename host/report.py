"""What a stream has to say for itself: how many frames, how fast, how late, and where the time went."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A bin is a float32's exponent and 7 bits of its mantissa, less than a hundredth of the value wide; up to five hours.
_DROPPED_BITS = 16
_LOWEST = int(np.float32(1.0).view(np.int32)) >> _DROPPED_BITS
_BINS = (int(np.float32(2.0**44).view(np.int32)) >> _DROPPED_BITS) - _LOWEST
_PENDING = 1024  # durations that are collected before they are sorted into bins (speed only)


@dataclass(frozen=True)
class Spread:
    """How a duration was spread [s]; quantiles are right to a hundredth. NaN where nothing was counted."""

    count: int = 0
    mean: float = math.nan
    p50: float = math.nan
    p99: float = math.nan
    p999: float = math.nan
    maximum: float = math.nan


class Durations:
    """Counts durations in bounded memory, however long the stream runs."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._pending = np.zeros(_PENDING, np.int64)
        self._filled = 0
        self._total = self._maximum = 0

    def add(self, nanoseconds: int) -> None:
        """Count a duration [ns]."""
        self._pending[self._filled] = nanoseconds
        self._filled += 1
        if self._filled == _PENDING:
            self._fold()

    def add_all(self, nanoseconds: NDArray[np.int64]) -> None:
        """Count at most as many durations [ns] as are kept pending, 1024."""
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

    def spread(self) -> Spread:
        """Return the spread of what was counted so far."""
        if self._filled:
            self._fold()
        count = int(self._counts.sum())
        if not count:
            return Spread()
        upto = np.cumsum(self._counts)

        def quantile(share: float) -> float:
            place = int(np.searchsorted(upto, max(share * count, 1.0)))
            low, high = np.array([place, place + 1], np.int32) + _LOWEST << _DROPPED_BITS
            middle = 0.5 * (float(low.view(np.float32)) + float(high.view(np.float32)))
            return min(middle, self._maximum) * 1e-9

        return Spread(
            count=count,
            mean=self._total / count * 1e-9,
            p50=quantile(0.5),
            p99=quantile(0.99),
            p999=quantile(0.999),
            maximum=self._maximum * 1e-9,
        )


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """The account of a stream, so far or in all.

    Attributes
    ----------
    frames, batches
        Delivered to the consumer.
    dropped
        Frames that arrived and were given up for newer ones.
    throughput
        Delivered frames per second, `warm_up` frames excluded.
    seconds
        From the start to the last delivery, warm-up included [s].
    latency
        From a frame's arrival to its result in host memory, warm-up excluded; of batches of more than 1024 frames,
        so many of them, the oldest one among them.
    warm_up
        Frames at the start that `throughput`, `latency` and `stages` leave out; 0 where the stream was no longer
        than that.
    batch, ring, policy, device, zero_copy
        How the stream was set up.
    fill_mean, fill_maximum
        Batches under way or waiting for the consumer, when one is delivered.
    stages
        Time per batch: on the host ``slot`` (wait for a free one), ``source``, ``launch``, ``queue`` (launched, not
        yet asked for by the consumer), ``wait`` (the consumer waits for the device) and ``sink``; on the device,
        where the stream profiles, ``upload``, ``compute``, ``download``.
    """

    frames: int
    batches: int
    dropped: int
    throughput: float
    seconds: float
    latency: Spread
    warm_up: int
    batch: int
    ring: int
    policy: str
    device: str
    zero_copy: bool
    fill_mean: float
    fill_maximum: int
    stages: dict[str, Spread] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as what JSON can hold; what was not counted is ``None``."""
        plain: dict[str, Any] = _without_nan(asdict(self))
        return plain


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(each) for name, each in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


class Account:
    """Books the delivered batches; forgets the durations of the warm-up when it is over."""

    def __init__(self, warm_up: int) -> None:
        self._left = warm_up
        self.started = self.last = 0
        self.frames = self.batches = 0
        self._warm = 0
        self._restart(0)

    def _restart(self, now: int) -> None:
        self._since, self._warm = now, self.frames
        self._latency = Durations()
        self._stages: dict[str, Durations] = {}
        self._fill = self._fill_maximum = self._fill_count = 0

    def book(self, delivered: int, latencies: NDArray[np.int64], fill: int) -> None:
        """Book a batch at its delivery."""
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

    def add(self, stage: str, nanoseconds: int) -> None:
        """Book the time of a stage."""
        durations = self._stages.get(stage)
        if durations is None:
            durations = self._stages[stage] = Durations()
        durations.add(nanoseconds)

    def report(self, **setup: Any) -> StreamReport:
        """Return the report so far."""
        since = self._since or self.started
        span = (self.last - since) * 1e-9
        return StreamReport(
            frames=self.frames,
            batches=self.batches,
            throughput=(self.frames - self._warm) / span if span > 0 else math.nan,
            seconds=max(self.last - self.started, 0) * 1e-9,
            latency=self._latency.spread(),
            warm_up=self._warm,
            fill_mean=self._fill / self._fill_count if self._fill_count else math.nan,
            fill_maximum=self._fill_maximum,
            stages={stage: durations.spread() for stage, durations in self._stages.items()},
            **setup,
        )
