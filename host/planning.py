"""Choice of the settings of a stream: batch size, threads of the kernels, and a ring that outlasts a stall.

The batch is the smallest one that keeps up with the sensor within a latency. Kernels run in the stream's thread
(inline) if a batch is small and inline kernels take no more processor time per frame than the worker threads of the
device: a stream that waits for fewer threads has fewer stalls when other processes run.
"""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from gpuvision.host.arrays import HostArray
from gpuvision.host.device import Device
from gpuvision.host.device_choice import candidate_devices
from gpuvision.host.errors import GpuVisionError, StreamError
from gpuvision.host.memory import free_bytes
from gpuvision.host.operation import Operation
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.ring import Step, slot_bytes, steps_of, takes_single_frames
from gpuvision.host.sources import ArraySource, Source
from gpuvision.host.text import size_in_words

# Default batch sizes [frames] that are tried, doubling: the chosen one is at most twice the smallest that suffices.
BATCHES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096)


@dataclass(frozen=True, kw_only=True)
class PlanLimits:
    """Limits of `plan_stream`.

    Attributes
    ----------
    min_ring : int
        Least number of slots of the ring, also used in the trials. Chosen: one slot each for the source, the device and
        the consumer, and one spare. Default 4.
    rounds : int
        Number of throughput measurements of a batch size, of which the best one counts. Chosen: pauses of a shared
        machine hit some of the rounds. Default 3.
    latency_batches : int
        Number of batches whose median time is measured. Chosen. Default 15.
    trial_seconds : float
        Duration of a throughput measurement [s]. Chosen. Default 0.05.
    patience : int
        Number of batch sizes without a gain after which the search ends. Chosen. Default 3.
    min_gain : float
        Least ratio of service rates that counts as a gain. Chosen: above the scatter of the measurements. Default 1.05.
    max_inline_seconds : float
        Longest time of a batch that runs inline although worker threads keep up, too [s]. Chosen: a fifth of the time
        after which Python switches threads, because no Python code runs during an inline kernel. Default 1e-3.
    max_inline_cost : float
        Largest ratio of the processor times per frame, inline to worker threads, at which kernels run inline although
        worker threads keep up, too. Chosen: above the scatter of the measurements, so that equal costs give the same
        plan each time. Default 1.1.
    max_bytes : int or None
        Largest memory of a ring [bytes]. ``None``: half of the free memory of the machine, and at most half of the
        memory of the device. Chosen: the other half is for the results of the user.
    """

    min_ring: int = 4
    rounds: int = 3
    latency_batches: int = 15
    trial_seconds: float = 0.05
    patience: int = 3
    min_gain: float = 1.05
    max_inline_seconds: float = 1e-3
    max_inline_cost: float = 1.1
    max_bytes: int | None = None


class Cost(NamedTuple):
    """Measured cost of a batch size.

    Attributes
    ----------
    service_rate : float
        Throughput when frames arrive without pause [frames/s].
    seconds : float
        Median time of one batch through source, device and consumer [s].
    processor_time : float
        Processor time per frame, summed over all threads of the process [s].
    """

    service_rate: float
    seconds: float
    processor_time: float


Measure = Callable[[int, bool], Cost]


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
        rate, and `seconds`.
    inline : bool
        Whether the kernels ran in the stream's thread.
    seconds : float
        Median time of one batch through source, device and consumer [s].
    processor_time : float
        Processor time per frame, summed over all threads of the process [s].
    """

    batch: int
    service_rate: float
    latency: float
    inline: bool
    seconds: float
    processor_time: float


@dataclass(frozen=True)
class Plan:
    """Settings of a stream: ``Pipeline(source, operation, **plan.settings)``.

    ``str(plan)`` states the plan in one line.

    Attributes
    ----------
    device : Device
        Device of the stream.
    batch, ring : int
        Frames per launch, and slots.
    inline : bool
        Whether the kernels run in the stream's thread.
    rate : float
        Frame rate of the sensor [1/s].
    stall : float
        Pause whose frames the ring holds [s].
    ring_bytes : int
        Memory of the slots, on host and device together [bytes].
    trials : tuple of Trial
        Measurements on the device; the last ones measured the chosen batch.
    other_devices : mapping of str to float or None
        Latency of the plan for each other measured device by its label [s]; ``None`` where it does not keep up.
    unusable : mapping of str to str
        First line of the error of each device that cannot run the operation, by its label.
    """

    device: Device
    batch: int
    ring: int
    inline: bool
    rate: float
    stall: float
    ring_bytes: int
    trials: tuple[Trial, ...]
    other_devices: Mapping[str, float | None] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters of `Pipeline`: device, batch, ring and inline."""
        return {"device": self.device, "batch": self.batch, "ring": self.ring, "inline": self.inline}

    @property
    def latency(self) -> float:
        """Time from the arrival of the first frame of a batch to its result [s]."""
        return next(each.latency for each in reversed(self.trials) if each.inline == self.inline)

    def __str__(self) -> str:
        costs = {each.inline: each.processor_time for each in self.trials if each.batch == self.batch}
        names = {True: "inline", False: "in worker threads"}
        chosen = f"kernels {names[self.inline]}, {1e6 * costs[self.inline]:.3g} us of processor time per frame"
        other = costs.get(not self.inline)
        against = "" if other is None else f" ({1e6 * other:.3g} us {names[not self.inline]})"
        others = [
            f"{label} {'does not keep up' if seconds is None else f'{1e3 * seconds:.3g} ms'}"
            for label, seconds in self.other_devices.items()
        ] + [f"{label} is not usable: {reason}" for label, reason in self.unusable.items()]
        latency = f" with a latency of {1e3 * self.latency:.3g} ms ({', '.join(others)})" if others else ""
        return (
            f"on {self.device.label}{latency}: batches of {self.batch}, a ring of {self.ring} slots "
            f"({size_in_words(self.ring_bytes)}) for stalls of "
            f"{self.stall:g} s at {self.rate:g} frames/s, {chosen}{against}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        trials = [asdict(each) for each in self.trials]
        others = {"other_devices": dict(self.other_devices), "unusable": dict(self.unusable)}
        return {**vars(self), "device": self.device.label, "trials": trials, **others}


def plan_stream(
    source: Source,
    operation: Operation[Any] | Step | Sequence[Operation[Any] | Step],
    *,
    rate: float | None = None,
    latency: float | None = None,
    margin: float = 1.25,
    headroom: float | None = None,
    stall: float = 0.5,
    inline: bool | None = None,
    device: Device | None = None,
    zero_copy: bool | None = None,
    batches: Sequence[int] = BATCHES,
    measure: Measure | None = None,
    sample: HostArray | None = None,
    limits: PlanLimits = PlanLimits(),
) -> Plan:
    """Choose batch size, ring and threads by measurements, before the stream reads from the source.

    Parameters
    ----------
    source : Source
        Gives shape, dtype and rate; no frame is read.
    operation : Operation, Step, or sequence of both
    rate : float, optional
        Frame rate [1/s]; the rate of the source by default.
    latency : float, optional
        Longest acceptable time from the arrival of a frame to its result in an undisturbed stream [s].
    margin : float
        Least ratio of the measured service rate to the frame rate. Default 1.25.
    headroom : float, optional
        Ratio of the measured service rate to the frame rate that a larger batch than the smallest sufficient one may
        give, for streams beside other work. Where no batch gives it, the fastest one is chosen. Default: ``margin``.
    stall : float
        Pause of the machine or the consumer whose frames the ring must hold [s]. A source that knows its length needs
        no more slots than it has batches. Default 0.5.
    inline : bool, optional
        Whether kernels run in the stream's thread instead of the worker threads of the device. Default: inline where
        this keeps up, a batch takes at most ``limits.max_inline_seconds``, and the processor time per frame is at most
        ``limits.max_inline_cost`` times the time of the worker threads; inline, too, where only this keeps up.
    device : Device, optional
        Device of the stream. Default: of the best GPU and the best CPU device the one with the lower latency, where
        both exist and ``GPUVISION_DEVICE`` is not set. Frames with little work are often faster on the CPU.
    zero_copy : bool, optional
        As for `Pipeline`.
    batches : sequence of int
        Batch sizes to try, ascending; 1 only where an operation takes single frames.
    measure : callable, optional
        Function that takes a batch size and whether kernels run inline, and returns a `Cost`; it replaces the
        measurement on the device, and the choice between devices.
    sample : (frames, ...) array, optional
        Frames to measure on; default: a blank frame. Give some where the time depends on the content: on a blank frame
        an iterative fit ends at once. Shape and dtype of the source's frames, in any byte order.
    limits : PlanLimits
        Limits of the measurements and of the memory.

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        Neither the source nor the caller gives a rate, the stall is negative or not finite, the device has no inline
        queues, or the sample is empty or not of the source's shape and dtype.
    StreamError
        No batch keeps up with the rate within the latency (the message gives the figures of the fastest batch), or the
        ring takes more memory than the limit.

    Notes
    -----
    The ring has ``stall * rate / batch`` slots, one for the consumer and one for the source.
    """
    rate = source.rate if rate is None else rate
    if rate is None or not 0.0 < rate < math.inf:
        raise ValueError(f"rate is {rate}, expected the sensor's frames per second, > 0")
    if not 0.0 <= stall < math.inf:
        raise ValueError(f"stall is {stall}, expected seconds >= 0")
    headroom = margin if headroom is None else headroom
    if not margin <= headroom < math.inf:
        raise ValueError(f"headroom is {headroom}, expected a number of the margin {margin} or more")
    sample = np.zeros((1, *source.shape), source.dtype) if sample is None else sample
    _check_sample(sample, source)
    plan = functools.partial(
        _plan_on,
        source,
        operation,
        rate=rate,
        latency=latency,
        margin=margin,
        headroom=headroom,
        stall=stall,
        inline=inline,
        zero_copy=zero_copy,
        batches=batches,
        measure=measure,
        sample=sample,
        limits=limits,
    )
    if device is not None or measure is not None:
        return plan(Device.best() if device is None else device)
    return _fastest(plan, candidate_devices())


def _check_sample(sample: HostArray, source: Source) -> None:
    """Check shape and dtype of a sample. The byte order is free: a source of these frames converts it.

    Raises
    ------
    ValueError
        The source's frames have another shape or dtype, or the sample is empty.
    """
    given, expected = (np.dtype(each.dtype).newbyteorder("=") for each in (sample, source))
    if not sample.ndim or sample.shape[1:] != source.shape or given != expected:
        shape = ", ".join(map(str, ("frames", *source.shape)))
        raise ValueError(
            f"sample has shape {sample.shape} and dtype {given}, expected shape ({shape}) and dtype {expected}, as the "
            "frames of the source"
        )
    if not len(sample):
        raise ValueError(f"sample has shape {sample.shape}, expected one frame or more")


def _fastest(plan: Callable[[Device], Plan], devices: Sequence[Device]) -> Plan:
    """Return the plan of the device with the lowest latency.

    Raises
    ------
    GpuVisionError, ValueError
        No device runs the operation and keeps up; the error is the first device's.
    """
    plans: dict[str, Plan | None] = {}
    unusable: dict[str, str] = {}
    failures: list[Exception] = []
    for device in devices:
        try:
            plans[device.label] = plan(device)
        except StreamError as error:
            plans[device.label] = None
            failures.append(error)
        except (GpuVisionError, ValueError) as error:
            unusable[device.label] = str(error).partition("\n")[0]
            failures.append(error)
    best = min((each for each in plans.values() if each is not None), key=lambda each: each.latency, default=None)
    if best is None:
        raise failures[0]
    others = {label: None if each is None else each.latency for label, each in plans.items() if each is not best}
    return replace(best, other_devices=others, unusable=unusable)


def _plan_on(
    source: Source,
    operation: Operation[Any] | Step | Sequence[Operation[Any] | Step],
    device: Device,
    *,
    rate: float,
    latency: float | None,
    margin: float,
    headroom: float,
    stall: float,
    inline: bool | None,
    zero_copy: bool | None,
    batches: Sequence[int],
    measure: Measure | None,
    sample: HostArray,
    limits: PlanLimits,
) -> Plan:
    """Return the plan for one device; parameters as in `plan_stream`."""
    zero_copy = device.shares_memory if zero_copy is None else zero_copy
    modes = _modes(inline, device)
    steps = steps_of(operation)
    measure = _Measurement(sample, steps, device, zero_copy, limits) if measure is None else measure
    max_bytes = free_bytes(device) // 2 if limits.max_bytes is None else limits.max_bytes
    trials: list[Trial] = []
    plans: dict[float, Plan] = {}  # by service rate
    for batch in (1,) if takes_single_frames(steps) else batches:
        ring = _ring_for(stall, rate, batch, source, limits)
        ring_bytes = ring * slot_bytes(steps, device, batch, source.shape, source.dtype, zero_copy=zero_copy)
        if ring_bytes > max_bytes and not trials:
            raise _too_large(ring, batch, ring_bytes, max_bytes, f"stalls of {stall:g} s at {rate:g} frames/s")
        if ring_bytes > max_bytes or not _is_gaining(trials, limits):
            break
        new = [_tried(measure, batch, mode, rate) for mode in modes]
        trials += new
        quick = [each for each in new if latency is None or each.latency <= latency]
        if not quick:
            break  # larger batches have longer latencies
        sufficient = [each for each in quick if each.service_rate >= margin * rate]
        if sufficient:
            mode = _runs_inline(sufficient, limits)
            service_rate = next(each.service_rate for each in sufficient if each.inline == mode)
            plans[service_rate] = Plan(device, batch, ring, mode, rate, stall, ring_bytes, tuple(trials))
            if service_rate >= headroom * rate:
                break
    if plans:
        return plans[max(plans)]
    request = f"{rate:.0f} frames/s with a margin of {margin:g}"
    raise _too_slow(trials, request if latency is None else f"{request} within {latency * 1e3:.3g} ms")


def _modes(inline: bool | None, device: Device) -> tuple[bool, ...]:
    """Return the values of `inline` to try."""
    if inline is None:
        return (False, True) if device.has_inline_queues else (False,)
    return (inline,)


def _tried(measure: Measure, batch: int, inline: bool, rate: float) -> Trial:
    cost = measure(batch, inline)
    latency = (batch - 1) / rate + cost.seconds
    return Trial(batch, cost.service_rate, latency, inline, cost.seconds, cost.processor_time)


def _runs_inline(sufficient: Sequence[Trial], limits: PlanLimits) -> bool:
    """Return whether kernels run inline, from the trials of one batch size that keep up with the sensor."""
    by_mode = {trial.inline: trial for trial in sufficient}
    if len(by_mode) == 1:
        return sufficient[0].inline
    inline, workers = by_mode[True], by_mode[False]
    is_small = inline.seconds <= limits.max_inline_seconds
    return is_small and inline.processor_time <= limits.max_inline_cost * workers.processor_time


def _too_slow(trials: Sequence[Trial], asked: str) -> StreamError:
    best = max(trials, key=lambda trial: trial.service_rate)
    return StreamError(
        f"no batch keeps up with {asked}: the fastest, {best.batch} frames, does {best.service_rate:.0f} frames/s with "
        f"{best.latency * 1e3:.3g} ms; lower the rate, allow more latency, or use a faster device"
    )


def _too_large(ring: int, batch: int, ring_bytes: int, max_bytes: int, asked: str) -> StreamError:
    return StreamError(
        f"a ring for {asked} has {ring} x {batch} frames and takes {size_in_words(ring_bytes)}, the limit is "
        f"{size_in_words(max_bytes)}; plan for a shorter stall, or raise PlanLimits.max_bytes"
    )


def _is_gaining(trials: Sequence[Trial], limits: PlanLimits) -> bool:
    """Return whether the last batches were faster than all before: beyond some size a larger batch is not."""
    best: dict[int, float] = {}
    for trial in trials:
        best[trial.batch] = max(best.get(trial.batch, 0.0), trial.service_rate)
    rates, patience = list(best.values()), limits.patience
    return len(rates) <= patience or max(rates[-patience:]) > limits.min_gain * max(rates[:-patience])


def _ring_for(stall: float, rate: float, batch: int, source: Source, limits: PlanLimits) -> int:
    """Return the number of slots for the frames of a stall, one for the consumer and one for the source."""
    needed = math.ceil(stall * rate / batch) + 2
    if source.length is not None:
        needed = min(needed, -(-source.length // batch) + 1)
    return max(needed, limits.min_ring)


class _Measurement:
    """Measurement of batch sizes on streams of the sampled frames, repeated."""

    def __init__(
        self, sample: HostArray, steps: Sequence[Step], device: Device, zero_copy: bool, limits: PlanLimits
    ) -> None:
        self._steps = steps
        self._limits = limits
        self._setup: dict[str, Any] = {"device": device, "zero_copy": zero_copy}
        self._sample = sample

    def __call__(self, batch: int, inline: bool) -> Cost:
        seconds = self._one_by_one(batch, inline)
        batches = max(int(self._limits.trial_seconds / seconds), 2 * self._limits.min_ring)
        rounds = [self._round(batch, batches, inline) for _ in range(self._limits.rounds)]
        # Pauses of a shared machine slow down some of the rounds: the best round measures the stream itself.
        return Cost(max(rate for rate, _ in rounds), seconds, min(spent for _, spent in rounds))

    def _round(self, batch: int, batches: int, inline: bool) -> tuple[float, float]:
        """Return the throughput [frames/s] and the processor time per frame [s]."""
        source = ArraySource(self._sample, batch * batches)
        ring = self._limits.min_ring
        stream: Pipeline[Any] = Pipeline(source, self._steps, batch=batch, ring=ring, inline=inline, **self._setup)
        with stream:
            begun = time.process_time()
            for _ in stream:
                pass
            spent = time.process_time() - begun
        return stream.report().throughput, spent / (batch * batches)

    def _one_by_one(self, batch: int, inline: bool) -> float:
        """Return the median time of a batch through an empty stream [s]."""
        source = _Stepped(self._sample, batch * self._limits.latency_batches)
        stream: Pipeline[Any] = Pipeline(
            source, self._steps, batch=batch, ring=2, warm_up=2, inline=inline, **self._setup
        )
        with stream:
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
