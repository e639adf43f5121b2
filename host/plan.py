"""Fit a stream to a sensor: the smallest batch that keeps up with its rate, within the latency that is asked for."""

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
    """Limits of `plan`.

    Attributes
    ----------
    min_ring : int
        Least number of slots of the ring, also that of the trials. Chosen: one slot each for the source, the device and
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
    """What was measured for a batch size.

    Attributes
    ----------
    batch : int
    service_rate : float
        Frames per second when they come without pause.
    latency : float
        From the first frame's arrival to its result: the wait for the batch to fill at the sensor's rate, and the
        median time of one batch through source, device and consumer [s].
    """

    batch: int
    service_rate: float
    latency: float


@dataclass(frozen=True)
class Plan:
    """How to set up a stream: ``Pipeline(source, operation, batch=plan.batch, ring=plan.ring)``.

    Attributes
    ----------
    batch, ring : int
    rate : float
        Of the sensor [frames/s].
    trials : tuple of Trial
        The last one is the chosen one.
    """

    batch: int
    ring: int
    rate: float
    trials: tuple[Trial, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as what JSON can hold."""
        return asdict(self)


def plan(
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
    """Choose batch and ring by measuring on blank frames, before one is taken from the source.

    Parameters
    ----------
    source : Source
        Says shape, dtype, and rate; nothing is read from it.
    operation : Operation or sequence of Operation and Step
    rate : float, optional
        Frames per second; the source's own otherwise.
    latency : float, optional
        Longest acceptable time from a frame's arrival to its result, when nothing disturbs the stream [s].
    margin : float
        How many times the sensor's rate the measured service rate must be.
    stall : float
        Pause of the machine or the consumer that the ring must hold the frames of [s], within 256 MB.
    device, zero_copy
        As for `Pipeline`.
    batches : sequence of int
        What to try, ascending.
    measure : callable, optional
        Takes a batch size, returns service rate [frames/s] and time of one batch [s]; instead of the device.
    limits : PlanLimits
        Limits of the measurements and of the memory.

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        There is no rate to plan for.
    StreamError
        No batch keeps up with the rate within the latency; says what the best one does.
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
            break  # larger ones are only later
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
    """Say whether the last trials served more than those before: beyond some size a batch is no faster."""
    rates = [trial.service_rate for trial in trials]
    patience = limits.patience
    return len(rates) <= patience or max(rates[-patience:]) > limits.min_gain * max(rates[:-patience])


def _frame_bytes(source: Source) -> int:
    return max(math.prod(source.shape) * source.dtype.itemsize, 1)


def _ring_for(stall: float, rate: float, batch: int, source: Source, limits: PlanLimits) -> int:
    """Return the slots that hold the frames of a stall, beside the consumer's and the source's."""
    wanted = math.ceil(stall * rate / batch) + 2
    return max(min(wanted, limits.max_bytes // (batch * _frame_bytes(source))), limits.min_ring)


class _Measurement:
    """Runs blank frames through streams of the same make."""

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
        # A shared machine pauses now and then; the best round is what the stream itself can do.
        return max(self._unpaused(batch, batches) for _ in range(self._limits.rounds)), seconds

    def _unpaused(self, batch: int, batches: int) -> float:
        source = ArraySource(self._blank, batch * batches)
        stream = Pipeline(source, self._operation, batch=batch, ring=self._limits.min_ring, **self._setup)
        return stream.run().throughput

    def _one_by_one(self, batch: int) -> float:
        """Return the median time of a batch that finds the stream empty."""
        source = _Stepped(self._blank, batch * self._limits.latency_batches)
        with Pipeline(source, self._operation, batch=batch, ring=2, warm_up=2, **self._setup) as stream:
            for _ in stream:
                source.released.release()
        return stream.report().latency.p50


class _Stepped(ArraySource):
    """Gives the next batch when the one before was delivered."""

    def __init__(self, frames: Any, count: int) -> None:
        super().__init__(frames, count)
        self.released = threading.Semaphore(1)

    def read_into(self, out: Any, arrived: Any) -> int:
        """Wait for the consumer, then copy; the frames arrive before they are copied."""
        self.released.acquire()
        now = time.perf_counter_ns()
        count = super().read_into(out, arrived)
        arrived[:count] = now
        return count

    def stop(self) -> None:
        """End the wait for the consumer."""
        self.released.release()
