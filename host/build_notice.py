"""Notice on a terminal while kernels compile for longer than 2 s; most drivers compile a kernel in 0.1 to 4 s.

Mesa's rusticl compiles in ``clCreateKernel``, other drivers in ``clBuildProgram``: a notice covers both calls.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import TextIO

_DELAY = 2.0  # time of all builds so far after which the notice appears [s] (chosen)
_PERIOD = 0.5  # [s] between two updates of the seconds
_ERASE = "\r\x1b[K"  # to the start of the line, and delete up to its end


class BuildNotice:
    """One line about kernels that compile, erased at the end of each build.

    Parameters
    ----------
    terminal : text stream
        Terminal on which the line appears.
    delay : float
        Time that all builds together take before the line appears [s]. Default 2.
    clock : callable
        Returns the time [s].
    """

    def __init__(self, terminal: TextIO, *, delay: float = _DELAY, clock: Callable[[], float] = time.monotonic) -> None:
        self._terminal, self._delay, self._clock = terminal, delay, clock
        self._spent = 0.0  # duration of the builds that have ended [s]
        self._busy = threading.Lock()

    @contextlib.contextmanager
    def building(self, source: str) -> Iterator[None]:
        """Show the line while the block builds a kernel; a build beside another one is not shown."""
        if not self._busy.acquire(blocking=False):
            yield
            return
        start, ended = self._clock(), threading.Event()
        ticker = threading.Thread(target=self._tick, args=(source, start, ended), daemon=True)
        ticker.start()
        try:
            yield
        finally:
            ended.set()
            ticker.join()
            self._spent += self._clock() - start
            self._busy.release()

    def _tick(self, source: str, start: float, ended: threading.Event) -> None:
        if ended.wait(max(self._delay - self._spent, 0.0)):
            return
        while not ended.is_set():
            seconds = self._spent + self._clock() - start
            self._write(f"{_ERASE}compiling kernels, {seconds:.0f} s: {source}")
            ended.wait(_PERIOD)
        self._write(_ERASE)

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # the terminal is closed
            self._terminal.write(text)
            self._terminal.flush()


_notice: BuildNotice | None = None
_NOTHING: contextlib.AbstractContextManager[None] = contextlib.nullcontext()


def show_builds(notice: BuildNotice | None) -> None:
    """Give all builds of the process to a notice from now on; None ends this."""
    global _notice
    _notice = notice


def building(source: str) -> contextlib.AbstractContextManager[None]:
    """Return a context manager whose block builds a kernel of a source file; without a notice it does nothing."""
    return _NOTHING if _notice is None else _notice.building(source)
