"""Times on the device from the events of the runtime."""

from __future__ import annotations

import time

import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.profiling.device_times import Recorder


def recorded(device, samples, calls=9):
    bound = gv.PsdReadout(strip_length=6e-3, layout="planar").bind(device, (2, samples), np.float32)
    bound.inputs[0].set(np.full((2, samples), 1e3, np.float32))
    recorder = Recorder(bound, device)
    spent = []
    for _ in range(calls):
        begun = time.perf_counter()
        recorder()
        spent.append(time.perf_counter() - begun)
    return recorder.medians(), np.median(spent)


def test_the_times_on_the_device_are_within_the_time_on_the_host(device):
    times, host = recorded(device, 1_000_000)
    assert min(times) >= 0.0
    assert 0.0 < times.running < host
    # A busy machine only adds time.
    few = min(recorded(device, 1000)[0].running for _ in range(3))
    assert few < 0.5 * times.running


class Event:
    """Event with given times, or of a runtime without times."""

    def __init__(self, *times):
        self.times = times

    def wait(self):
        pass

    @property
    def profile(self):
        if not self.times:
            raise cl.RuntimeError("clGetEventProfilingInfo failed: PROFILING_INFO_NOT_AVAILABLE")
        return type("Profile", (), dict(zip(("queued", "submit", "start", "end"), self.times, strict=True)))


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ([(10, 12, 15, 115), (20, 24, 27, 147), (30, 31, 36, 236)], (2e-9, 3e-9, 120e-9)),
        ([(), (), ()], None),
        ([(0, 0, 0, 0)] * 3, None),
        ([(10, 12, 9, 15)] * 3, None),  # the start before the submission
    ],
)
def test_medians_of_the_events(monkeypatch, device, events, expected):
    bound = gv.PsdReadout(strip_length=6e-3, layout="planar").bind(device, (2, 16), np.float32)
    recorder = Recorder(bound, device)
    given = iter(Event(*times) for times in events)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *_: next(given))
    for _ in events:
        recorder()
    times = recorder.medians()
    assert times == (None if expected is None else pytest.approx(expected))
