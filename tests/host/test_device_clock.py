"""Offset between the clocks of a device and the host, on a loaded machine."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gpuvision.host.device_clock import DeviceClock

MS = 1_000_000
OFFSET = 5_000 * MS  # the clock of the host is 5 s ahead of the clock of the device


class Slot:
    """Slot on a fake device: a launch returns 2 us after its command was queued, a kernel ends 0.1 ms later.

    A wait returns `late` [ns] after the kernel has ended.
    """

    def __init__(self, late: int) -> None:
        self.now, self.late = OFFSET + 1_000 * MS, late
        self.queued = self.end = self.filled = self.enqueued = 0

    def clock(self) -> int:
        """Return the time on the clock of the host [ns]."""
        return self.now

    def launch(self) -> None:
        """Queue a command."""
        self.filled = self.now
        self.queued = self.now + 1_000 - OFFSET
        self.now += 3_000
        self.enqueued = self.now
        self.end = self.now + MS // 10 - OFFSET

    def wait(self) -> None:
        """Wait for the command."""
        self.now = self.end + OFFSET + self.late

    def spans(self) -> dict[str, tuple[int, int]]:
        """Return the times of the kernel on the clock of the device [ns]."""
        return {"compute": (self.end - MS // 20, self.end)}


def test_the_clocks_are_compared_within_microseconds_where_all_waits_return_late() -> None:
    """Another process has the processor: each wait returns 10 ms after the kernel, an enqueue takes 2 us."""
    slot: Any = Slot(late=10 * MS)
    clock = DeviceClock(slot, slot.clock)
    assert clock.offset == OFFSET + 2_000


def test_a_wait_that_returns_in_time_is_the_tighter_bound() -> None:
    slot: Any = Slot(late=500)
    assert DeviceClock(slot, slot.clock).offset == OFFSET + 500


@pytest.mark.parametrize("late", [200, 10 * MS])
def test_each_delivered_batch_can_improve_the_estimate(late: int) -> None:
    slot: Any = Slot(late=10 * MS)
    clock = DeviceClock(slot, slot.clock)
    slot.launch()
    slot.late, slot.enqueued = late, slot.enqueued - 500  # this call returned 1.5 us after its command was queued
    slot.wait()
    spans = clock.spans(slot, slot.now)
    assert clock.offset == OFFSET + min(late, 1_500)
    start, end = spans["compute"]
    assert (start - slot.filled, end - start) == (3_000 + MS // 20 + clock.offset - OFFSET, MS // 20)


def test_no_stage_begins_before_the_batch_was_filled() -> None:
    slot: Any = SimpleNamespace(filled=100, enqueued=200, queued=190, launch=lambda: None, wait=lambda: None)
    slot.spans = lambda: {"compute": (50, 60)}
    clock = DeviceClock(slot, lambda: 200)
    assert clock.spans(slot, 200) == {"compute": (100, 100)}
