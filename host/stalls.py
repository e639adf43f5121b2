"""Longest stall of a stream, and the part of the stream that spent it."""

from __future__ import annotations

import collections
import gc
from dataclasses import asdict, dataclass

from gpuvision.host.sources import Clock

# Pauses of the garbage collector that are kept. A stall reaches back over few of them: a collection of all objects,
# the only long one, runs when the number of objects has grown by a quarter.
_KEPT_PAUSES = 64


@dataclass(frozen=True, kw_only=True)
class Stall:
    """Time without a delivery, although a batch of frames had arrived.

    A stall begins at the arrival of the last frame of a batch, or at the delivery before, if that is later. It ends at
    the delivery of the batch. Where frames were dropped in between, it begins at the previous delivery, because the
    dropped frames were due. The four parts add up to `seconds`.

    Attributes
    ----------
    seconds : float
        Duration [s].
    frame : int
        Number of the first frame of the batch that ended the stall.
    producer : float
        Time in which the stream's thread waited for a slot, read the frames, launched, or was not run by the system
        [s].
    device : float
        Time in which the consumer waited for the device [s]. Kernels that run inline in the stream's thread count here.
    consumer : float
        Time in which the consumer worked on the batch before, or was not run by the system [s].
    collector : float
        Time in which Python's garbage collector held up both threads [s].
    """

    seconds: float
    frame: int
    producer: float
    device: float
    consumer: float
    collector: float

    @property
    def place(self) -> str:
        """Name of the part that took most of the time: producer, device, consumer or collector."""
        parts = {name: value for name, value in asdict(self).items() if name not in ("seconds", "frame")}
        return max(parts, key=parts.__getitem__)

    def __str__(self) -> str:
        return f"{1e3 * self.seconds:.3g} ms, most of it in the {self.place}"


class CollectorPauses:
    """Times at which Python's garbage collector ran between `start` and `stop`.

    Parameters
    ----------
    clock : callable
        Clock in nanoseconds.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._begun: int | None = None
        self._pauses: collections.deque[tuple[int, int]] = collections.deque(maxlen=_KEPT_PAUSES)

    def start(self) -> None:
        """Begin to listen to the collector."""
        gc.callbacks.append(self._listen)

    def stop(self) -> None:
        """Stop listening."""
        if self._listen in gc.callbacks:
            gc.callbacks.remove(self._listen)

    def _listen(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._begun = self._clock()
        elif self._begun is not None:
            self._pauses.append((self._begun, self._clock()))
            self._begun = None

    def overlap(self, start: int, end: int) -> int:
        """Return the time of the pauses between two times [ns]."""
        return sum(max(min(end, stop) - max(start, begun), 0) for begun, stop in tuple(self._pauses))


class StallRecorder:
    """Recorder of the longest stall of a stream.

    Parameters
    ----------
    clock : callable
        Clock in nanoseconds.
    """

    def __init__(self, clock: Clock) -> None:
        self._pauses = CollectorPauses(clock)
        self._last = self._next = 0
        self._longest = -1
        self._stall: Stall | None = None

    def start(self, now: int) -> None:
        """Begin to record at a time [ns]."""
        self._last = now
        self._pauses.start()

    def stop(self) -> None:
        """Stop recording; `longest` stays."""
        self._pauses.stop()

    @property
    def longest(self) -> Stall | None:
        """Longest stall so far; None before the first delivery."""
        return self._stall

    def add(
        self,
        number: int,
        count: int,
        *,
        arrived: int,
        requested: int,
        launching: int,
        launched: int,
        taken: int,
        computed: int,
        delivered: int,
    ) -> None:
        """Add the delivery of a batch.

        Parameters
        ----------
        number, count : int
            Number of the first frame, and number of frames.
        arrived : int
            Arrival of the last frame [ns], as all times here.
        requested : int
            Time at which the consumer requested the batch.
        launching, launched : int
            Start and end of the time in which the device computed in the stream's thread; both are the time at which
            the batch was ready for the consumer where it computed elsewhere.
        taken : int
            Time at which the consumer took the batch and began to wait for the device.
        computed, delivered : int
            Times at which the device had computed, and the wait for it had ended.
        """
        last = self._last
        begun = last if number != self._next or arrived < last else arrived
        self._last, self._next = delivered, number + count
        if delivered - begun > self._longest:
            self._longest = delivered - begun
            self._stall = self._split(number, (begun, requested, launching, launched, taken, computed, delivered))

    def _split(self, number: int, times: tuple[int, ...]) -> Stall:
        parts = dict.fromkeys(("producer", "device", "consumer", "collector"), 0)
        owners = ("consumer", "producer", "device", "consumer", "device", "consumer")
        now = times[0]
        for owner, end in zip(owners, times[1:], strict=True):
            if end > now:
                pause = self._pauses.overlap(now, end)
                parts["collector"] += pause
                parts[owner] += end - now - pause
                now = end
        seconds = {name: value * 1e-9 for name, value in parts.items()}
        return Stall(seconds=(times[-1] - times[0]) * 1e-9, frame=number, **seconds)
