"""Where frames come from: arrays in memory, anything that can be iterated, and a true rate clock over either.

`recordings` has the sources that read files.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.host.arrays import HostArray
from gpuvision.host.errors import RecordingError

Clock = Callable[[], int]
Arrivals = NDArray[np.int64]

# Last part of a wait [ns] in which the processor is yielded, because sleeping overshoots: by some 80 us on a common
# kernel (measured).
_SPIN_NS = 200_000

_yield = getattr(os, "sched_yield", lambda: time.sleep(0))


class Source:
    """Base of the sources; a camera needs `read_into` and, if it can block for long, `stop`.

    One thread reads: a `Pipeline` calls `wait`, then `read_into`, from its producer thread, and at its end `stop`
    (from the consumer's thread) and `close` (when the producer has ended).

    Attributes
    ----------
    shape : tuple of int
        Of one frame.
    dtype : numpy.dtype
    length : int or None
        How many frames there are in all, where that is known beforehand.
    rate : float or None
        Frames per second, where the source has a rate.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    length: int | None = None
    rate: float | None = None

    def wait(self) -> bool:
        """Wait until a frame is there; ``False`` at the end.

        The stream takes a slot for the frame only after that: what makes a drop count exact. A source that cannot
        know says ``True``.
        """
        return True

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Fill a batch in place.

        Parameters
        ----------
        out : (batch, ...) array
            Memory of the stream; the device may read it directly.
        arrived : (batch,) int64 array
            When each frame came [ns of `time.perf_counter_ns`].

        Returns
        -------
        int
            Frames filled; fewer than the batch: no more are there just now; 0: the source has ended.

        Raises
        ------
        RecordingError
            The next frame cannot be read.
        """
        raise NotImplementedError

    def stop(self) -> None:
        """Make a blocked `wait` or `read_into` return soon; called from another thread."""

    def close(self) -> None:
        """Release what the source holds."""


class ArraySource(Source):
    """Frames that lie in memory, or in a mapped file, along the first axis.

    Parameters
    ----------
    frames : (frames, ...) array
    count : int, optional
        How many to give; more than there are: over and over again.
    clock : callable
        Nanoseconds.

    Raises
    ------
    ValueError
        There is no frame, or no frame axis.
    """

    def __init__(self, frames: HostArray, count: int | None = None, *, clock: Clock = time.perf_counter_ns) -> None:
        if frames.ndim < 2:
            raise ValueError(f"expected frames along the first axis of 2 or more, got shape {frames.shape}")
        if count and not len(frames):
            raise ValueError(f"there are no frames to make {count} of")
        self._frames, self._clock, self._next = frames, clock, 0
        self.shape, self.dtype = frames.shape[1:], frames.dtype.newbyteorder("=")
        self.length: int = len(frames) if count is None else count

    def wait(self) -> bool:
        """Say whether a frame is left."""
        return self._next < self.length

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Copy the next frames; they arrive when they are copied."""
        frames, filled = self._frames, 0
        wanted = min(len(out), self.length - self._next)
        while filled < wanted:
            place = self._next % len(frames)
            taken = min(wanted - filled, len(frames) - place)
            np.copyto(out[filled : filled + taken], frames[place : place + taken])
            filled += taken
            self._next += taken
        arrived[:filled] = self._clock()
        return filled


class FrameSource(Source):
    """Base of the sources that get one frame at a time: `_ready` says whether one is there, `_decode` puts it in place.

    An error in the middle of a batch does not lose the frames before it: the batch is cut short there, and the
    error comes with the next call, of `wait` or of `read_into`.
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], *, clock: Clock = time.perf_counter_ns) -> None:
        self.shape, self.dtype = shape, dtype
        self._clock = clock
        self._error: Exception | None = None

    def wait(self) -> bool:
        """Wait for the next frame; ``False`` at the end.

        Raises
        ------
        RecordingError
            The next frame cannot be read: found out now, or while the frames before it were.
        """
        if self._error is None:
            try:
                return self._ready()
            except Exception as error:  # it stays: a generator that has raised would only say that it is at its end
                self._error = error
        raise self._error

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Decode frames into the batch, one after the other."""
        for filled in range(len(out)):
            try:
                if not self.wait():
                    return filled
                self._decode(out[filled])
            except Exception as error:  # whatever a decoder or a camera says, the frames before are good
                self._error = error
                if not filled:
                    raise
                return filled
            arrived[filled] = self._clock()
        return len(out)

    def _ready(self) -> bool:
        """Wait until a frame is there; ``False`` at the end."""
        return True

    def _decode(self, out: HostArray) -> None:
        """Put the next frame, which `_ready` has promised, into `out`."""
        raise NotImplementedError


class IteratedSource(FrameSource):
    """Frames from anything that can be iterated: a generator, a camera's buffers.

    Parameters
    ----------
    frames : iterable of array
        All of the shape and dtype of the first one, which is taken at once. What the iterator raises becomes a
        `RecordingError` that names the frame, with the cause chained.
    rate : float, optional
        Frames per second, if they come at a rate.
    stop : callable, optional
        Makes the iterator return if it is blocked; called from another thread.

    Raises
    ------
    TypeError
        Not something to iterate.
    RecordingError
        There is no first frame.
    """

    def __init__(
        self,
        frames: Iterable[HostArray],
        *,
        rate: float | None = None,
        stop: Callable[[], object] | None = None,
        clock: Clock = time.perf_counter_ns,
    ) -> None:
        self._iterator, self._number = iter(frames), 0
        self._frame = self._taken()
        if self._frame is None:
            raise RecordingError("the source has no first frame to tell shape and dtype from")
        super().__init__(self._frame.shape, self._frame.dtype, clock=clock)
        self.rate, self._stop = rate, stop

    def _ready(self) -> bool:
        """Get the next frame from the iterator, if there is none in hand."""
        if self._frame is None:
            self._frame = self._taken()
        return self._frame is not None

    def _taken(self) -> HostArray | None:
        try:
            frame = next(self._iterator)
        except StopIteration:
            return None
        except Exception as error:  # a camera's driver raises what it likes
            name = type(error).__name__
            raise RecordingError(f"frame {self._number} did not come: {name}: {error}".rstrip(": ")) from error
        if not isinstance(frame, np.ndarray):
            kind = type(frame).__name__
            raise RecordingError(f"frame {self._number} is of type {kind}, expected a NumPy array")
        return frame

    def _decode(self, out: HostArray) -> None:
        frame, self._frame = self._frame, None
        assert frame is not None  # `_ready` has said so
        check_frame(frame, self.shape, self.dtype, f"frame {self._number}")
        np.copyto(out, frame)
        self._number += 1

    def stop(self) -> None:
        """Call what was given to end a blocked iterator."""
        if self._stop is not None:
            self._stop()


class PacedSource(Source):
    """Another source's frames on a true rate clock: frame k is due at ``start + k / rate``, whatever happened before.

    With an `ArraySource` that repeats it is the synthetic sensor. A frame arrives when the clock says so if the
    reader waited for it, and counts from when it was due if the reader came late.

    Parameters
    ----------
    source : Source
    rate : float
        Frames per second.
    clock : callable
        Nanoseconds.
    sleep : callable
        Takes seconds.

    Attributes
    ----------
    late : int
        The longest that a frame was overdue when it was read [ns].
    """

    def __init__(
        self,
        source: Source,
        rate: float,
        *,
        clock: Clock = time.perf_counter_ns,
        sleep: Callable[[float], object] | None = None,
    ) -> None:
        if not 0.0 < rate < 1e9:
            raise ValueError(f"rate is {rate}, expected frames per second between 0 and 1e9")
        self.shape, self.dtype, self.length, self.rate = source.shape, source.dtype, source.length, rate
        self.late = 0
        self._source, self._clock = source, clock
        self._stopped = threading.Event()
        self._sleep = self._stopped.wait if sleep is None else sleep
        self._start: int | None = None
        self._arrived: int | None = None
        self._taken = self._last = 0
        self._error: Exception | None = None

    def wait(self) -> bool:
        """Wait until the next frame is due; an error as `FrameSource.wait`."""
        if self._error is not None:
            raise self._error
        if self._arrived is None and self._source.wait():
            self._arrived = self._arrival()
        return self._arrived is not None

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Fill a batch as its frames fall due; frames that are overdue are read in one go.

        An error does not lose the frames of its batch, as with `FrameSource`.
        """
        if self._error is not None:
            raise self._error
        filled = 0
        while filled < len(out):
            try:
                read = self._read_due(out[filled:], arrived[filled:]) if self.wait() else 0
            except Exception as error:  # as in `FrameSource`
                self._error = error
                if not filled:
                    raise
                break
            if not read:
                break
            filled += read
        return filled

    def _read_due(self, out: HostArray, arrived: Arrivals) -> int:
        first, now = self._taken, self._clock()
        self.late = max(self.late, now - self._due(first))
        due = int((now - self._due(0)) * self._rate_ns) + 1 - first
        wanted = max(min(len(out), due), 1)
        read = self._source.read_into(out[:wanted], arrived[:wanted])
        for k in range(read):
            # The reader may oversleep: frames that fall due before it wakes come when it does.
            self._last = arrived[k] = max(self._due(first + k), self._last, self._arrived or 0)
            self._arrived = None
        self._taken += read
        return read

    @property
    def _rate_ns(self) -> float:
        assert self.rate is not None
        return self.rate * 1e-9

    def _due(self, number: int) -> int:
        assert self._start is not None  # the first `_arrival` sets it
        return self._start + round(number / self._rate_ns)

    def _arrival(self) -> int | None:
        """Wait for the next frame and return when it arrived; ``None`` when stopped."""
        now = self._clock()
        if self._start is None:
            self._start = now
        due = self._due(self._taken)
        if now >= due:
            return None if self._stopped.is_set() else due
        while now < due:
            if self._stopped.is_set():
                return None
            if due - now > _SPIN_NS:
                self._sleep((due - now - _SPIN_NS) * 1e-9)
            else:
                _yield()
            now = self._clock()
        return now

    def stop(self) -> None:
        """End a wait for the clock."""
        self._stopped.set()
        self._source.stop()

    def close(self) -> None:
        """Close the source under the clock."""
        self._source.close()


def check_frame(frame: HostArray, shape: tuple[int, ...], dtype: np.dtype[Any], what: str) -> None:
    """Check that a frame is like the first one.

    Raises
    ------
    RecordingError
        It changed its size or its dtype.
    """
    if frame.shape != shape or frame.dtype != dtype:
        raise RecordingError(
            f"{what}: {_described(frame.shape, frame.dtype)} where the first frame was {_described(shape, dtype)}; "
            "all frames of a recording must be alike"
        )


def _described(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    return f"{'x'.join(map(str, shape))} {dtype}"
