"""Stages of the host's work, for a recorder such as `gpuvision.host.trace.Trace`; without one they cost nothing."""

from __future__ import annotations

import contextlib
from typing import Protocol


class Recorder(Protocol):
    """Object that records stages."""

    def span(self, name: str, subject: str) -> contextlib.AbstractContextManager[None]:
        """Return a context manager that records its block."""


_recorder: Recorder | None = None
_NOTHING: contextlib.AbstractContextManager[None] = contextlib.nullcontext()


def record_stages(recorder: Recorder | None) -> None:
    """Give all stages of the process to a recorder from now on; None ends this."""
    global _recorder
    _recorder = recorder


def stage(name: str, subject: str = "") -> contextlib.AbstractContextManager[None]:
    """Return a context manager whose block is a stage; without a recorder it does nothing.

    Parameters
    ----------
    name : str
        Name of the stage: "read", "compile", "bind", "upload", "launch", "wait", "download", "write".
    subject : str, optional
        Operation or file of the stage.
    """
    return _NOTHING if _recorder is None else _recorder.span(name, subject)
