"""Settings of a thread with small and steady delays: garbage collection, processor core, real-time priority.

References
----------
.. [1] Linux manual pages sched(7), sched_setaffinity(2) and sched_setscheduler(2).
.. [2] Python documentation, module ``gc``: `gc.freeze`, `gc.disable`.
"""

from __future__ import annotations

import contextlib
import gc
import os
import threading
from collections.abc import Iterator

from gpuvision.validation import integer

_PERMISSION_HINT = (
    "run as root, give the interpreter CAP_SYS_NICE, or allow it for the user: 'USER - rtprio 50' in "
    "/etc/security/limits.conf"
)


@contextlib.contextmanager
def low_latency(*, core: int | None = None, priority: int = 0) -> Iterator[None]:
    """Run the body without garbage collection of the process, on request on one core and with real-time priority.

    Parameters
    ----------
    core : int, optional
        Core on which the calling thread runs. Default: the cores that it may use now. Range: 0 or more.
    priority : int
        Real-time priority (SCHED_FIFO) of the calling thread, 1 (lowest) to 99; 0 (default) keeps the ordinary
        scheduling. Other programs then interrupt the thread only with a higher priority. 1 to 50 is usual: interrupt
        threads of Linux have 50.

    Raises
    ------
    ValueError
        A parameter is out of range, or the process may not use the core.
    PermissionError
        The user may not use real-time priorities.
    OSError
        The operating system cannot set a core or a real-time priority; Linux can.

    Notes
    -----
    Start the devices and bind all operations before: the worker threads of an OpenCL runtime would inherit core and
    priority. Core and priority change for the calling thread only, until the end of the body.

    Garbage collection is a setting of the whole process: it is off for all threads while at least one thread is
    inside, and the last one that leaves restores it. Objects that exist at the start are not searched for garbage
    inside the body, even by `gc.collect` (`gc.freeze`); cyclic garbage that the body makes is freed after it. Where the
    caller froze objects before, they stay frozen, and no others are frozen.

    A thread with real-time priority must sleep or wait in each frame. If it computes without a pause, Linux stops
    it for 50 ms in each second.

    References
    ----------
    .. [1] Linux manual page sched(7).

    Examples
    --------
    >>> import gc
    >>> with low_latency():
    ...     gc.isenabled()
    False
    """
    with contextlib.ExitStack() as settings:
        settings.enter_context(_COLLECTION_PAUSE)
        if core is not None:
            settings.enter_context(_on_core(integer(core, "core", minimum=0)))
        if integer(priority, "priority", minimum=0, maximum=99):
            settings.enter_context(_with_priority(priority))
        yield


def real_time_is_allowed() -> bool:
    """Return whether `low_latency` may set a real-time priority for this process."""
    try:
        with _with_priority(1):
            return True
    except OSError:
        return False


class _CollectionPause:
    """Pause of the garbage collection of the process: from the first user that enters to the last one that leaves."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._was_enabled = self._has_frozen = False

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._was_enabled, self._has_frozen = gc.isenabled(), gc.get_freeze_count() == 0
                gc.collect()
                gc.disable()
                if self._has_frozen:
                    gc.freeze()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                if self._has_frozen:
                    gc.unfreeze()
                if self._was_enabled:
                    gc.enable()


_COLLECTION_PAUSE = _CollectionPause()


@contextlib.contextmanager
def _on_core(core: int) -> Iterator[None]:
    if not hasattr(os, "sched_setaffinity"):
        raise OSError("this operating system cannot set the core of a thread; use core=None")
    before = os.sched_getaffinity(0)
    if core not in before:
        raise ValueError(f"core is {core}, expected one of {', '.join(map(str, sorted(before)))}")
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def _with_priority(priority: int) -> Iterator[None]:
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this operating system has no real-time priorities; use priority=0")
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError as error:
        raise PermissionError(f"the priority {priority} is not permitted: {_PERMISSION_HINT}") from error
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
