"""Timeline of a stream in Chrome's trace format, for chrome://tracing or ui.perfetto.dev."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gpuvision.host.outputs import Outputs

_PRODUCER, _DEVICE, _CONSUMER = "producer", "device", "consumer"
_LANES = {
    "slot": _PRODUCER,
    "source": _PRODUCER,
    "launch": _PRODUCER,
    "upload": f"{_DEVICE} upload",
    "compute": f"{_DEVICE} compute",
    "download": f"{_DEVICE} download",
    "wait": _CONSUMER,
    "sink": _CONSUMER,
}


class Trace:
    """Timeline of the first batches of a stream: start and end of each stage.

    Parameters
    ----------
    path : path
        JSON file that is written when the stream closes.
    limit : int
        Number of batches to keep, which bounds the memory of a long stream.
    overwrite : bool
        Whether an existing file may be replaced that no earlier trace wrote. Default False.
    """

    def __init__(self, path: str | Path, limit: int = 20_000, *, overwrite: bool = False) -> None:
        self.path, self.limit, self.overwrite = Path(path), limit, overwrite
        self._spans: list[tuple[str, int, int, int, int]] = []
        self._batches = 0

    @property
    def is_full(self) -> bool:
        """Whether the limit of batches is reached."""
        return self._batches >= self.limit

    def add(self, spans: dict[str, tuple[int, int]], number: int, count: int) -> None:
        """Add the stages of a batch with their start and end on the host's clock [ns]."""
        if self.is_full:
            return
        self._batches += 1
        self._spans.extend((stage, start, end, number, count) for stage, (start, end) in spans.items())

    def write(self) -> None:
        """Write the file atomically.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier trace; see `gpuvision.host.outputs`.
        """
        lanes = list(dict.fromkeys(_LANES.values()))
        origin = min((start for _, start, *_ in self._spans), default=0)
        events: list[dict[str, Any]] = [
            {"ph": "M", "name": "thread_name", "pid": 1, "tid": tid, "args": {"name": lane}}
            for tid, lane in enumerate(lanes)
        ]
        for stage, start, end, number, count in self._spans:
            event = {"ph": "X", "name": stage, "pid": 1, "tid": lanes.index(_LANES[stage])}
            event |= {"ts": (start - origin) / 1e3, "dur": (end - start) / 1e3}
            events.append(event | {"args": {"frame": number, "frames": count}})
        Outputs("trace", overwrite=self.overwrite).write_text(
            self.path, json.dumps({"traceEvents": events, "displayTimeUnit": "ns"})
        )
