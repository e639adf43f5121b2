"""The process that uses OpenCL: a process forked from it cannot use OpenCL."""

from __future__ import annotations

import os
from collections.abc import Callable

from gpuvision.host.errors import DeviceUnusableError

_user: int | None = None  # number of the process that has loaded the OpenCL runtimes


def begin_use() -> None:
    """Record that this process loads the OpenCL runtimes."""
    global _user
    _user = os.getpid()


def is_forked() -> bool:
    """Return whether this process was forked after the first use of OpenCL."""
    return _user is not None and _user != os.getpid()


def check_process() -> None:
    """Check that this process was not forked after the first use of OpenCL.

    Raises
    ------
    DeviceUnusableError
        The process is a forked one: it has no threads of the runtimes, and a kernel would never end.
    """
    if is_forked():
        raise DeviceUnusableError(
            "this process was forked after OpenCL was used, and has no threads of the OpenCL runtime; start processes "
            "with multiprocessing.get_context('spawn'), or fork before the first use of a device"
        )


def before_fork(end: Callable[[], None]) -> None:
    """Register a function that runs before each fork of this process."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=end)


def after_fork(refuse: Callable[[], None]) -> None:
    """Register a function that runs in each process forked after the first use of OpenCL."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: None if _user is None else refuse())
