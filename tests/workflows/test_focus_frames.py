"""Frames of a focus stack: each is added once, the source is closed, and the report has their times."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host.sources import ArraySource
from gpuvision.ranging.focus_stack import FocusStack, StageFocus
from gpuvision.workflows import focus_frames
from gpuvision.workflows.focus_frames import read_focus_peak

STACK = FocusStack(geometry=StageFocus(start=0.0, step=1e-3, pixel_size=1e-5))


class Watched(ArraySource):
    """Frames that arrive at the 100th nanosecond, one or two in a read; notes when it is closed."""

    closed = False

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        count = super().read_into(out[:2], arrived[:2])
        arrived[:count] = 100
        return count

    def close(self) -> None:
        self.closed = True
        super().close()


def test_each_frame_is_added_once(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """Frames (5, 6, 8) in reads of two, two and one; reads end at 3100, 6100 and 9100 ns."""
    times = iter([100, 3100, 6100, 9100])
    monkeypatch.setattr(focus_frames, "time", SimpleNamespace(perf_counter_ns=lambda: next(times)))
    monkeypatch.setattr(focus_frames, "default_batch", lambda *_: 3)
    added: list[np.ndarray] = []

    class Search:
        frames = 0

        def __init__(self, stack: Any, dtype: Any) -> None:
            assert (stack, dtype) == (STACK, np.dtype(np.uint8))

        def add(self, frame: np.ndarray) -> None:
            added.append(frame.copy())
            self.frames += 1

        def peak(self) -> str:
            return "peak"

    monkeypatch.setattr(focus_frames, "FocusSearch", Search)
    frames = rng.integers(0, 256, (5, 6, 8)).astype(np.uint8)
    source, steps = Watched(frames), []
    peak, report = read_focus_peak(source, STACK, lambda *given: steps.append(given))
    assert peak == "peak"
    np.testing.assert_array_equal(added, frames)
    assert steps == [(2, 5), (4, 5), (5, 5)]
    assert source.closed
    assert (report.frames, report.batches, report.dropped, report.batch, report.ring) == (5, 3, 0, 3, 1)
    assert (report.policy, report.device, report.zero_copy) == ("block", "host", True)
    assert report.latency.count == 5
    assert report.latency.maximum == pytest.approx(9000e-9)
    assert report.latency.mean == pytest.approx((2 * 3000 + 2 * 6000 + 9000) / 5 * 1e-9)
    assert report.seconds == pytest.approx(9000e-9)


def test_the_source_of_a_failed_search_is_closed() -> None:
    source = Watched(np.zeros((1, 6, 8), np.uint8))
    with pytest.raises(ValueError, match="frame"):
        read_focus_peak(source, STACK, lambda *_: None)
    assert source.closed
