"""Common parts of the stream tests: small frames, and a source that the test opens and closes."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from gpuvision.host.batch import Batch
from gpuvision.host.sources import Source
from gpuvision.ranging.psd import PsdReadout

READOUT = PsdReadout(strip_length=6e-3)


def currents_of(count: int, strips: int = 5) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(1e-8, 1e-6, (count, strips, 2)).astype(np.float32)


class ManualClock:
    """Clock that advances only in `sleep`, by assignment, and by a step at each reading, so that loops end."""

    def __init__(self, step: int = 1000) -> None:
        self.now, self.step = 1_000_000_000 if step else 0, step

    def __call__(self) -> int:
        self.now += self.step
        return self.now

    def sleep(self, seconds: float) -> None:
        if seconds < 0.0:  # as `time.sleep`
            raise ValueError("sleep length must be non-negative")
        self.now += round(seconds * 1e9)


class Gated(Source):
    """Source of frames that contain their number and arrive when the test releases them."""

    def __init__(self, count: int) -> None:
        self.shape, self.dtype, self.length = (2,), np.dtype(np.float32), count
        self.waiting = 0  # frames that wait() has requested
        self.closed = False
        self._next = 0
        self._gate = threading.Semaphore(0)
        self._stopped = False
        self._idle = threading.Condition()

    def let(self, frames: int) -> None:
        """Let frames arrive."""
        self._gate.release(frames)

    def drained(self, frames: int) -> None:
        """Wait until the producer has read a number of frames and waits for the next."""
        with self._idle:
            assert self._idle.wait_for(lambda: self.waiting > frames, timeout=30)

    def wait(self) -> bool:
        with self._idle:
            self.waiting += 1
            self._idle.notify_all()
        self._gate.acquire()
        return self._next < self.length and not self._stopped

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        out[0] = (1.0, 1.0 + self._next)
        arrived[0] = self._next
        self._next += 1
        return 1

    def stop(self) -> None:
        self._stopped = True
        self._gate.release()

    def close(self) -> None:
        self.closed = True


def numbers(batches: list[Batch[Any]]) -> list[int]:
    return [batch.number for batch in batches]


def producer_ended() -> None:
    """Wait until the stream's thread has ended."""
    for thread in threading.enumerate():
        if thread.name == "gpuvision stream":
            thread.join(30)
