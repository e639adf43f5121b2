"""Sources of frames: arrays in memory, iterables, and frames at the rate of a clock.

`gpuvision.host.recordings` has the sources that read files.
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
# Lowest rate of a clock [1/s]. Derived: its wait of 1e9 s for a frame is below the longest one of a lock, 9.2e9 s.
_SLOWEST = 1e-9

_yield = getattr(os, "sched_yield", lambda: time.sleep(0))


class Source:
    """Base class of the sources of frames.

    A camera implements `read_into` and, if a read can block for long, `stop`. One thread reads: a `Pipeline` calls
    `wait`, then `read_into`, in its producer thread. At its end it calls `stop` in the consumer's thread, and `close`
    after the producer has ended.

    Attributes
    ----------
    shape : tuple of int
        Shape of one frame.
    dtype : numpy.dtype
    length : int or None
        Number of frames in all; ``None`` where it is not known beforehand.
    rate : float or None
        Frame rate [1/s]; ``None`` where the source has none.
    exposure_delay : float
        Time from the middle of the exposure of a frame to its arrival [s]: half of the exposure, readout and transfer.
        Default 0.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    length: int | None = None
    rate: float | None = None
    exposure_delay: float = 0.0

    def wait(self) -> bool:
        """Wait until a frame has arrived.

        Returns
        -------
        bool
            False at the end of the frames. A source that cannot know returns True.

        Notes
        -----
        A stream takes a slot for the frame only after this call, which makes its count of dropped frames exact.
        """
        return True

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Fill a batch in place.

        Parameters
        ----------
        out : (batch, ...) array
            Memory of the stream, which the device may read directly.
        arrived : (batch,) int64 array
            Arrival times of the frames to fill in [ns of `time.perf_counter_ns`].

        Returns
        -------
        int
            Number of frames filled; below the batch size where no more frames have arrived, 0 at the end.

        Raises
        ------
        RecordingError
            The next frame cannot be read.
        """
        raise NotImplementedError

    def damaged_frames(self) -> frozenset[int]:
        """Return the numbers of the frames read so far whose content is damaged, from 0."""
        return frozenset()

    def stop(self) -> None:
        """Make a blocked `wait` or `read_into` return soon; called from another thread."""

    def close(self) -> None:
        """Release the resources of the source."""


class ArraySource(Source):
    """Frames of an array in memory or of a memory-mapped file.

    Parameters
    ----------
    frames : (frames, ...) array
    count : int, optional
        Number of frames to give; a larger number than the length of the array repeats its frames. Default: each frame
        once.
    clock : callable
        Clock in nanoseconds.

    Raises
    ------
    TypeError
        The array is masked.
    ValueError
        The array has fewer than 2 axes, or it has no frame to repeat.
    """

    def __init__(self, frames: HostArray, count: int | None = None, *, clock: Clock = time.perf_counter_ns) -> None:
        if isinstance(frames, np.ma.MaskedArray):
            raise TypeError("the frames are a masked array, expected a plain array; fill it with .filled(value)")
        if frames.ndim < 2:
            raise ValueError(f"expected frames along the first axis of 2 or more, got shape {frames.shape}")
        if count and not len(frames):
            raise ValueError(f"there are no frames to make {count} of")
        self._frames, self._clock, self._next = frames, clock, 0
        self.shape, self.dtype = frames.shape[1:], frames.dtype.newbyteorder("=")
        self.length: int = len(frames) if count is None else count

    def wait(self) -> bool:
        """Return whether a frame is left."""
        return self._next < self.length

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Copy the next frames; their arrival time is the time of the copy."""
        frames, filled = self._frames, 0
        count = min(len(out), self.length - self._next)
        while filled < count:
            place = self._next % len(frames)
            copied = min(count - filled, len(frames) - place)
            np.copyto(out[filled : filled + copied], frames[place : place + copied])
            filled += copied
            self._next += copied
        arrived[:filled] = self._clock()
        return filled


class FrameSource(Source):
    """Base class of sources that get one frame at a time: `_ready` waits for a frame, `_decode` writes it.

    An error in the middle of a batch does not lose the frames before it: the batch ends there, and the next call of
    `wait` or `read_into` raises the error.
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], *, clock: Clock = time.perf_counter_ns) -> None:
        self.shape, self.dtype = shape, dtype
        self._clock = clock
        self._error: Exception | None = None

    def wait(self) -> bool:
        """Wait for the next frame; return False at the end.

        Raises
        ------
        RecordingError
            The next frame cannot be read. The error may have occurred in an earlier read.
        """
        if self._error is None:
            try:
                return self._ready()
            except Exception as error:  # stored, because a generator that has raised reports only its end afterwards
                self._error = error
        raise self._error

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Decode frames into the batch, one after the other."""
        for filled in range(len(out)):
            try:
                if not self.wait():
                    return filled
                self._decode(out[filled])
            except Exception as error:  # decoders raise any exception; the previous frames are valid
                self._error = error
                if not filled:
                    raise
                return filled
            arrived[filled] = self._clock()
        return len(out)

    def _ready(self) -> bool:
        """Wait until a frame has arrived; return False at the end."""
        return True

    def _decode(self, out: HostArray) -> None:
        """Write the next frame to `out`; called after `_ready` has returned True."""
        raise NotImplementedError


class IteratedSource(FrameSource):
    """Frames of an iterable: a generator, the buffers of a camera.

    Parameters
    ----------
    frames : iterable of array
        Arrays with the shape and dtype of the first one, which is read at once. Exceptions of the iterator become a
        `RecordingError` that names the frame and chains the cause.
    rate : float, optional
        Frame rate [1/s].
    stop : callable, optional
        Function that makes a blocked iterator return; called from another thread.

    Raises
    ------
    TypeError
        `frames` is not iterable.
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
        """Get the next frame from the iterator, unless one is waiting."""
        if self._frame is None:
            self._frame = self._taken()
        return self._frame is not None

    def _taken(self) -> HostArray | None:
        try:
            frame = next(self._iterator)
        except StopIteration:
            return None
        except Exception as error:  # camera drivers raise exceptions of any type
            name = type(error).__name__
            raise RecordingError(f"frame {self._number} did not come: {name}: {error}".rstrip(": ")) from error
        if not isinstance(frame, np.ndarray):
            kind = type(frame).__name__
            raise RecordingError(f"frame {self._number} is of type {kind}, expected a NumPy array")
        return frame

    def _decode(self, out: HostArray) -> None:
        frame, self._frame = self._frame, None
        assert frame is not None  # `_ready` has returned True
        check_frame(frame, self.shape, self.dtype, f"frame {self._number}")
        np.copyto(out, frame)
        self._number += 1

    def stop(self) -> None:
        """Call the function that ends a blocked iterator."""
        if self._stop is not None:
            self._stop()


class PacedSource(Source):
    """Frames of another source at the rate of a clock: frame k is due at ``start + k / rate``, without drift.

    With a repeating `ArraySource` it is a synthetic sensor. The arrival time of a frame is the time at which a waiting
    reader wakes, or the due time if the reader is late.

    Parameters
    ----------
    source : Source
    rate : float
        Frame rate [1/s].
    clock : callable
        Clock in nanoseconds.
    sleep : callable
        Function that sleeps for a number of seconds.

    Attributes
    ----------
    late : int
        Longest delay of a read after the due time of its frame [ns].

    Raises
    ------
    ValueError
        The rate is not between 1e-9 and 1e9.
    """

    def __init__(
        self,
        source: Source,
        rate: float,
        *,
        clock: Clock = time.perf_counter_ns,
        sleep: Callable[[float], object] | None = None,
    ) -> None:
        if not _SLOWEST <= rate < 1e9:
            raise ValueError(f"rate is {rate}, expected frames per second between {_SLOWEST:g} and 1e9")
        self.shape, self.dtype, self.length, self.rate = source.shape, source.dtype, source.length, rate
        self.exposure_delay = source.exposure_delay
        self.late = 0
        self._source, self._clock = source, clock
        self._stopped = threading.Event()
        self._sleep = self._stopped.wait if sleep is None else sleep
        self._start: int | None = None
        self._arrived: int | None = None
        self._taken = self._last = 0
        self._error: Exception | None = None

    def wait(self) -> bool:
        """Wait until the next frame is due; errors are raised as by `FrameSource.wait`."""
        if self._error is not None:
            raise self._error
        if self._arrived is None and self._source.wait():
            self._arrived = self._arrival()
        return self._arrived is not None

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Fill a batch as its frames fall due; overdue frames are read in one call.

        Errors do not lose the frames of their batch, as with `FrameSource`.
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
        count = max(min(len(out), due), 1)
        read = self._source.read_into(out[:count], arrived[:count])
        for k in range(read):
            # The reader may oversleep: frames that fall due before it wakes arrive when it wakes.
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
        """Wait for the next frame and return its arrival time; None when the source is stopped."""
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

    def damaged_frames(self) -> frozenset[int]:
        """Return the damaged frames of the underlying source."""
        return self._source.damaged_frames()

    def stop(self) -> None:
        """End a wait for the due time."""
        self._stopped.set()
        self._source.stop()

    def close(self) -> None:
        """Close the underlying source."""
        self._source.close()


def check_frame(frame: HostArray, shape: tuple[int, ...], dtype: np.dtype[Any], what: str) -> None:
    """Check that a frame has the shape and dtype of the first one.

    Raises
    ------
    RecordingError
        The shape or the dtype differs.
    """
    if frame.shape != shape or frame.dtype != dtype:
        raise RecordingError(
            f"{what}: {_described(frame.shape, frame.dtype)} where the first frame was {_described(shape, dtype)}; "
            "all frames of a recording must be alike"
        )


def _described(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    return f"{'x'.join(map(str, shape))} {dtype}"
