"""Times of a device on the clock of the host."""

from __future__ import annotations

from typing import Any

from gpuvision.host.ring import Slot
from gpuvision.host.sources import Clock

# Empty launches that measure the offset between the clocks of device and host; the result is the best of them.
_LAUNCHES = 3


class DeviceClock:
    """Offset from the clock of a device to the clock of the host, measured with a few empty launches.

    No stage ends after the wait for it has returned, and no command is queued after the call that enqueues it has
    returned: each batch gives two upper bounds of the offset. The smallest bound is the estimate. Where other processes
    take the processor, waits return milliseconds late, but the calls that enqueue are short.

    Parameters
    ----------
    slot : Slot
        Slot of a stream whose queues measure times.
    clock : callable
        Clock of the host in nanoseconds.

    Attributes
    ----------
    offset : int
        Estimate of the offset, to add to times of the device [ns].
    """

    def __init__(self, slot: Slot[Any], clock: Clock) -> None:
        offsets = []
        for _ in range(_LAUNCHES):
            slot.launch()
            enqueued = clock()
            slot.wait()
            offsets.append(_bound(slot, slot.spans(), enqueued, clock()))
        self.offset = min(offsets)

    def spans(self, slot: Slot[Any], delivered: int) -> dict[str, tuple[int, int]]:
        """Return start and end of each device stage of a slot on the clock of the host [ns].

        Parameters
        ----------
        slot : Slot
            Slot after `Slot.wait`.
        delivered : int
            Time at which the wait for the slot returned [ns].
        """
        spans = slot.spans()
        self.offset = min(self.offset, _bound(slot, spans, slot.enqueued, delivered))
        low, offset = slot.filled, self.offset
        return {stage: (max(start + offset, low), max(end + offset, low)) for stage, (start, end) in spans.items()}


def _bound(slot: Slot[Any], spans: dict[str, tuple[int, int]], enqueued: int, delivered: int) -> int:
    """Return the upper bound of the offset that the last launch of a slot gives [ns]."""
    return min(enqueued - slot.queued, delivered - max(end for _, end in spans.values()))
