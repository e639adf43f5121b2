"""Teams: the calling thread and waiting worker threads of a CPU share the work-items of a launch.

Waking a worker thread takes 5 to 25 us, as long as a short launch. Runtimes for parallel loops, such as OpenMP,
therefore let their threads wait in a loop for some time after each use. A `Team` does so for a kernel that is launched
again and again: workers wait in the kernel for the next launch, see ``kernels/common/team.h``.
"""

from __future__ import annotations

import ctypes
import functools
import math
import os
import platform
import time
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import DeviceArray, HostArray, host_view, memory_of
from gpuvision.host.process import before_fork, is_forked

VARIABLE = "GPUVISION_TEAMS"
# Places of the counters, in the order of Team in kernels/common/team.h.
_COLUMNS, _SHARES, _ITEMS, _CORE, _MEMBERS, _ENDED, _DISMISSED, _BEGUN, _JOINED = 0, 1, 2, 3, 4, 32, 33, 34, 35
_HEAD, _SHARE = 48, 16  # words of Team without its shares, and of a share
_NO_CORE = 0xFFFFFFFF
# Time for which workers wait for the next launch. Chosen: some times the time that waking a thread takes.
_WAITING_NS = 150_000
# Workers begin to wait after two launches with a shorter pause between them: they would wait in vain otherwise.
PAUSE_NS = 75_000
# The same for launches that the caller does not wait for. In longer pauses the caller does other work, beside which the
# workers should run. Chosen: the time that waking them takes.
BRIEF_PAUSE_NS = 20_000
# Launches of one team are shared for this time; then the workers end, so that kernels of other threads get their turn.
# Chosen: a hundred launches or more, beside which the launch or two until they wait again take little.
_SHARING_NS = 10_000_000
# The time of a poll of the counters is measured in a trial of at least this duration: a launch takes 1 to 5 us.
_TRIAL_NS, _MOST_POLLS = 40_000, 1 << 22


def allows_teams() -> bool:
    """Return whether workers may wait for launches: not where the environment says ``GPUVISION_TEAMS=off``."""
    return os.environ.get(VARIABLE) != "off"


def new_counters(device: Any, size: tuple[int, ...], threads: int) -> DeviceArray:
    """Return the counters of a team of some threads for a launch of a global size in one or two dimensions."""
    counters: DeviceArray = device.empty((_HEAD + threads * _SHARE,), np.uint32)
    values = host_view(counters)
    values[:] = 0
    values[[_COLUMNS, _SHARES, _ITEMS]] = size[0], threads, math.prod(size)
    begin = -(-np.arange(threads + 1) * math.prod(size) // threads)  # rounded up: the first share is never empty
    shares = values[_HEAD:].reshape(threads, _SHARE)
    shares[:, 0], shares[:, 1], shares[:, 2] = begin[1:], begin[:-1], begin[1:]
    return counters


@functools.cache
def core_query() -> Callable[[], int] | None:
    """Return the function of the C library for the core of the calling thread, where kernels know theirs too."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return None
    try:
        query: Callable[[], int] = ctypes.CDLL(None).sched_getcpu
    except (AttributeError, OSError, TypeError):  # no such function, or no C library of that kind
        return None
    return query


class TeamSlot:
    """Slot of a device for the one team whose workers wait, or begin to wait if its launch comes again soon.

    A device has one slot, because waiting workers do nothing else: any other launch dismisses them.

    Attributes
    ----------
    team : weakref.ref of Team, or None
    """

    def __init__(self) -> None:
        self.team: weakref.ref[Team] | None = None

    def clear(self) -> None:
        """Dismiss the waiting workers, so that they run other launches."""
        team = None if self.team is None else self.team()
        self.team = None
        if team is not None:
            team.dismiss()


class Team:
    """Calling thread and waiting workers of one bound launch.

    Parameters
    ----------
    slot : TeamSlot
        Of the device.
    counters : pyopencl.array.Array
        As `new_counters` makes them.
    leader, member : tuple
        Arguments of `pyopencl.enqueue_nd_range_kernel` in the calling thread, and for the workers. The last two
        arguments of the kernels are the counters and the limit of polls.
    used : object
        Memory that the kernels use: it is referenced until the workers have ended.
    core : callable, optional
        Function that returns the core of the calling thread, where the workers stay on their cores: the worker on the
        core of the caller ends at once. ``None``: the operating system finds free cores for all workers.
    """

    def __init__(
        self,
        slot: TeamSlot,
        counters: DeviceArray,
        leader: tuple[Any, ...],
        member: tuple[Any, ...],
        used: object,
        core: Callable[[], int] | None,
    ) -> None:
        self._slot, self._leader, self._member, self._core = slot, leader, member, core
        self._array, self._counters = counters, host_view(counters)
        self._reference = weakref.ref(self)
        self._is_started = False
        self._idle_since = self._ends = 0
        self._events: list[Any] = []
        self._size = self._counters[_MEMBERS] = member[2][0]
        self._counters[_CORE] = _NO_CORE
        for kernel in (leader[1], member[1]):
            kernel.set_arg(kernel.num_args - 2, memory_of(counters))
        _set_poll_limit(member[1], self._polls())
        _set_poll_limit(leader[1], 0)
        weakref.finalize(self, _end, counters, self._events, used)
        _teams.add(self)

    def _polls(self) -> int:
        """Return the polls of the counters that take `_WAITING_NS`, from trials in the calling thread."""

        def duration(polls: int) -> int:
            _set_poll_limit(self._leader[1], polls)
            start = time.perf_counter_ns()
            cl.enqueue_nd_range_kernel(*self._leader).wait()
            return time.perf_counter_ns() - start

        duration(1)  # a first launch takes longer
        polls = 16
        while (taken := duration(polls)) < _TRIAL_NS and polls < _MOST_POLLS:
            polls *= 4
        return polls * _WAITING_NS // taken

    @property
    def waits(self) -> bool:
        """Whether workers wait for the next launch, or will soon, and may still do so."""
        return self._idle_since < self._ends and self._has_members

    @property
    def _has_members(self) -> bool:
        return self._is_started and bool(self._counters[_ENDED] < self._size)

    def lead(self) -> Any:
        """Launch, together with the waiting workers; return the event of the launch, which is complete."""
        event = cl.enqueue_nd_range_kernel(*self._leader)
        self._idle_since = time.perf_counter_ns()
        return event

    def follows(self, pause: int) -> bool:
        """Return whether the last launch of the device was of this team, and ended less than `pause` ago [ns]."""
        return self._slot.team is self._reference and time.perf_counter_ns() - self._idle_since < pause

    def note_launch(self) -> None:
        """Note that a launch without the workers has ended."""
        self._take_slot()
        self._idle_since = time.perf_counter_ns()

    def _take_slot(self) -> None:
        if self._slot.team is not self._reference:
            self._slot.clear()
            self._slot.team = self._reference

    def start(self) -> None:
        """Let workers wait for the next launch.

        Does nothing while workers wait or, dismissed, have not ended yet; nor for a real-time thread: if it came to the
        core of a worker with a begun work-item, both would wait for each other.
        """
        if self._has_members or _is_real_time():
            return
        self._is_started = False  # until the workers are enqueued: this may fail
        self._take_slot()
        self._counters[_CORE] = _NO_CORE if self._core is None else self._core()
        self._counters[_ENDED] = self._counters[_DISMISSED] = self._counters[_BEGUN] = self._counters[_JOINED] = 0
        self._events[:] = [cl.enqueue_nd_range_kernel(*self._member)]
        self._member[0].flush()
        self._is_started = True
        self._idle_since = time.perf_counter_ns()
        self._ends = self._idle_since + _SHARING_NS

    def dismiss(self) -> None:
        """Make waiting workers end."""
        self._counters[_DISMISSED] = 1

    def end(self) -> None:
        """Dismiss waiting workers, and wait until they have ended."""
        _end(self._array, self._events)


def _set_poll_limit(kernel: Any, polls: int) -> None:
    kernel.set_arg(kernel.num_args - 1, np.uint32(polls))


def _is_real_time() -> bool:
    """Return whether ordinary threads do not get the core of the calling thread while it runs."""
    return hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)


def _end(counters: DeviceArray, events: list[Any], _used: object = None) -> None:
    """Dismiss the members and wait for their end: they poll the counters, which must stay as long."""
    if not is_forked():  # a forked process has no workers
        values: HostArray = host_view(counters)
        values[_DISMISSED] = 1
        for event in events:
            event.wait()


_teams: weakref.WeakSet[Team] = weakref.WeakSet()


def _end_all() -> None:
    """Let no worker end during a fork: it could hold a lock of its runtime, which would stay closed in the child."""
    for team in _teams:
        team.end()


before_fork(_end_all)
