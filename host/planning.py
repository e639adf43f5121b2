"""Choice of the batch size of a stream: the smallest batch that keeps up with the sensor within a latency."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gpuvision.host.device import Device
from gpuvision.host.errors import StreamError
from gpuvision.host.operation import Operation
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.ring import Step
from gpuvision.host.sources import ArraySource, Source

# Default batch sizes [frames] that are tried, doubling: the chosen one is at most twice the smallest that suffices.
BATCHES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096)


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of `plan_stream`.

    Attributes
    ----------
    min_ring : int
        Least number of slots of the ring, also used in the trials. Chosen: one slot each for the source, the device and
        the consumer, and one spare.
    rounds : int
        Number of throughput measurements of a batch size, of which the best one counts. Chosen: pauses of a shared
        machine hit some of the rounds.
    latency_batches : int
        Number of batches whose median time is measured. Chosen.
    trial_seconds : float
        Duration of a throughput measurement [s]. Chosen.
    patience : int
        Number of batch sizes without a gain after which the search ends. Chosen.
    min_gain : float
        Least ratio of service rates that counts as a gain. Chosen: above the scatter of the measurements.
    max_bytes : int
        Largest memory of the frames of a ring [bytes]. Chosen.
    """

    min_ring: int = 4
    rounds: int = 3
    latency_batches: int = 15
    trial_seconds: float = 0.05
    patience: int = 3
    min_gain: float = 1.05
    max_bytes: int = 1 << 28


@dataclass(frozen=True)
class Trial:
    """Measurement of one batch size.

    Attributes
    ----------
    batch : int
    service_rate : float
        Throughput when frames arrive without pause [frames/s].
    latency : float
        Time from the arrival of the first frame to its result [s]: the time in which the batch fills at the sensor's
        rate, and the median time of one batch through source, device and consumer.
    """

    batch: int
    service_rate: float
    latency: float


@dataclass(frozen=True)
class Plan:
    """Settings of a stream: ``Pipeline(source, operation, batch=plan.batch, ring=plan.ring)``.

    Attributes
    ----------
    batch, ring : int
        Frames per launch, and slots.
    rate : float
        Frame rate of the sensor [1/s].
    trials : tuple of Trial
        Measurements; the last one measured the chosen batch.
    """

    batch: int
    ring: int
    rate: float
    trials: tuple[Trial, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return asdict(self)


def plan_stream(
    source: Source,
    operation: Operation[Any] | Sequence[Operation[Any] | Step],
    *,
    rate: float | None = None,
    latency: float | None = None,
    margin: float = 1.25,
    stall: float = 0.1,
    device: Device | None = None,
    zero_copy: bool | None = None,
    batches: Sequence[int] = BATCHES,
    measure: Callable[[int], tuple[float, float]] | None = None,
    limits: PlanLimits = PlanLimits(),
) -> Plan:
    """Choose batch size and ring by measurements on blank frames, before the stream reads from the source.

    Parameters
    ----------
    source : Source
        Gives shape, dtype and rate; no frame is read.
    operation : Operation or sequence of Operation and Step
    rate : float, optional
        Frame rate [1/s]; the rate of the source by default.
    latency : float, optional
        Longest acceptable time from the arrival of a frame to its result in an undisturbed stream [s].
    margin : float
        Least ratio of the measured service rate to the frame rate.
    stall : float
        Pause of the machine or the consumer whose frames the ring must hold [s], within ``limits.max_bytes``.
    device, zero_copy
        As for `Pipeline`.
    batches : sequence of int
        Batch sizes to try, ascending.
    measure : callable, optional
        Function that takes a batch size and returns service rate [frames/s] and time of one batch [s]; it replaces the
        measurement on the device.
    limits : PlanLimits
        Limits of the measurements and of the memory.

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        Neither the source nor the caller gives a rate.
    StreamError
        No batch keeps up with the rate within the latency; the message gives the figures of the fastest batch.
    """
    rate = source.rate if rate is None else rate
    if rate is None or not rate > 0.0:
        raise ValueError(f"rate is {rate}, expected the sensor's frames per second, > 0")
    if measure is None:
        device = Device.best() if device is None else device
        measure = _Measurement(source, operation, device, zero_copy, limits)
    trials: list[Trial] = []
    for batch in batches:
        ring_bytes = batch * limits.min_ring * _frame_bytes(source)
        if trials and (ring_bytes > limits.max_bytes or not _is_gaining(trials, limits)):
            break
        service_rate, seconds = measure(batch)
        trials.append(Trial(batch, service_rate, (batch - 1) / rate + seconds))
        if latency is not None and trials[-1].latency > latency:
            break  # larger batches have longer latencies
        if service_rate >= margin * rate:
            return Plan(batch, _ring_for(stall, rate, batch, source, limits), rate, tuple(trials))
    asked = f"{rate:.0f} frames/s with a margin of {margin:g}"
    raise _too_slow(trials, asked if latency is None else f"{asked} within {latency * 1e3:.3g} ms")


def _too_slow(trials: Sequence[Trial], asked: str) -> StreamError:
    best = max(trials, key=lambda trial: trial.service_rate)
    return StreamError(
        f"no batch keeps up with {asked}: the fastest, {best.batch} frames, does {best.service_rate:.0f} frames/s with "
        f"{best.latency * 1e3:.3g} ms; lower the rate, allow more latency, or use a faster device"
    )


def _is_gaining(trials: Sequence[Trial], limits: PlanLimits) -> bool:
    """Return whether the last trials were faster than all before: beyond some size a larger batch is not."""
    rates = [trial.service_rate for trial in trials]
    patience = limits.patience
    return len(rates) <= patience or max(rates[-patience:]) > limits.min_gain * max(rates[:-patience])


def _frame_bytes(source: Source) -> int:
    return max(math.prod(source.shape) * source.dtype.itemsize, 1)


def _ring_for(stall: float, rate: float, batch: int, source: Source, limits: PlanLimits) -> int:
    """Return the number of slots for the frames of a stall, one for the consumer and one for the source."""
    wanted = math.ceil(stall * rate / batch) + 2
    return max(min(wanted, limits.max_bytes // (batch * _frame_bytes(source))), limits.min_ring)


class _Measurement:
    """Measurement of batch sizes on streams of blank frames."""

    def __init__(
        self, source: Source, operation: Any, device: Device, zero_copy: bool | None, limits: PlanLimits
    ) -> None:
        self._operation = operation
        self._limits = limits
        self._setup: dict[str, Any] = {"device": device, "zero_copy": zero_copy}
        self._blank = np.zeros((1, *source.shape), source.dtype)

    def __call__(self, batch: int) -> tuple[float, float]:
        seconds = self._one_by_one(batch)
        batches = max(int(self._limits.trial_seconds / seconds), 2 * self._limits.min_ring)
        # Pauses of a shared machine slow down some of the rounds: the best round measures the stream itself.
        return max(self._unpaused(batch, batches) for _ in range(self._limits.rounds)), seconds

    def _unpaused(self, batch: int, batches: int) -> float:
        source = ArraySource(self._blank, batch * batches)
        stream = Pipeline(source, self._operation, batch=batch, ring=self._limits.min_ring, **self._setup)
        return stream.run().throughput

    def _one_by_one(self, batch: int) -> float:
        """Return the median time of a batch through an empty stream [s]."""
        source = _Stepped(self._blank, batch * self._limits.latency_batches)
        with Pipeline(source, self._operation, batch=batch, ring=2, warm_up=2, **self._setup) as stream:
            for _ in stream:
                source.released.release()
        return stream.report().latency.p50


class _Stepped(ArraySource):
    """Source that gives the next batch after the delivery of the previous batch."""

    def __init__(self, frames: Any, count: int) -> None:
        super().__init__(frames, count)
        self.released = threading.Semaphore(1)

    def read_into(self, out: Any, arrived: Any) -> int:
        """Wait for the consumer, then copy; the arrival time is that before the copy."""
        self.released.acquire()
        now = time.perf_counter_ns()
        count = super().read_into(out, arrived)
        arrived[:count] = now
        return count

    def stop(self) -> None:
        """End the wait for the consumer."""
        self.released.release()
