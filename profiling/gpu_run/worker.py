"""Calls in another process with a time limit: a driver that crashes or hangs ends this process only."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, NamedTuple


class Answer(NamedTuple):
    """Result of a call.

    Attributes
    ----------
    value : object
        Returned value; ``None`` after a failure.
    failure : str
        Error, crash or time-out in one line; empty after success.
    """

    value: Any
    failure: str


class Worker:
    """Process that runs functions of modules, one at a time. It is started again after a crash or a time-out."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None
        self._pipe: Any = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def call(self, function: Callable[..., Any], *arguments: Any, seconds: float) -> Answer:
        """Return the answer of a function of a module.

        Parameters
        ----------
        function : callable
            Function at the top of a module; its arguments and its result can be pickled.
        *arguments : object
        seconds : float
            Time limit [s].
        """
        if self._process is None:
            self._start()
        self._pipe.send((function, arguments))
        try:
            if not self._pipe.poll(seconds):
                self._stop()
                return Answer(None, f"no end within {seconds:g} s")
            return Answer(*self._pipe.recv())
        except (EOFError, ConnectionError):
            self._process.join()
            code = self._process.exitcode
            self._process = None
            return Answer(None, f"the process ended with exit code {code}")

    def _start(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        self._process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def _serve(pipe: Connection) -> None:
    """Answer calls until the other end closes."""
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send((function(*arguments), ""))
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            words = " ".join(str(error).split()) or "no message"
            pipe.send((None, f"{type(error).__name__}: {words[:600]} ({place.name}, line {place.lineno})"))
