"""Events of commands: whether they are complete, and queues that must be flushed before another queue waits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pyopencl as cl

COMPLETE = cl.command_execution_status.COMPLETE


def are_complete(events: Sequence[Any]) -> bool:
    """Return whether commands have ended; an error counts as an end."""
    return all(each.command_execution_status <= COMPLETE for each in events)


def flush_queues(events: Sequence[Any], queue: Any) -> None:
    """Flush the other queues of some events before `queue` waits for them.

    OpenCL 3.0, 5.15: a queue may wait forever for an event of another queue that was not flushed. Mesa's rusticl does.
    """
    for event in events:
        if event.command_execution_status > COMPLETE:
            other = event.get_info(cl.event_info.COMMAND_QUEUE)  # None: an event that the user completes
            if other is not None and other != queue:
                other.flush()
