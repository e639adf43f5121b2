"""Peak performance of a device."""

from __future__ import annotations

import pyopencl as cl

from gpuvision.profiling import ceiling


def test_the_flop_rate_is_that_of_multiply_adds(device):
    assert 1e8 < ceiling.flop_rate(device, seconds=0.01) < 1e15


def test_a_slow_device_gets_fewer_work_items(device, monkeypatch):
    """Mesa's llvmpipe would compute for minutes, because it computes multiply-adds in software."""
    launched = []
    enqueue = cl.enqueue_nd_range_kernel

    def counted(queue, kernel, items, group):
        launched.append(items[0])
        return enqueue(queue, kernel, items, group)

    monkeypatch.setattr(ceiling, "_LAUNCH", 0.0)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", counted)
    assert ceiling.flop_rate(device.without_vectors(), seconds=0.0) > 0.0
    assert set(launched) == {4 * device.compute_units}


def test_without_times_of_events_the_clock_of_the_host_measures_copies(device, monkeypatch):
    class Event:
        def wait(self):
            pass

        @property
        def profile(self):
            raise cl.RuntimeError("clGetEventProfilingInfo failed: PROFILING_INFO_NOT_AVAILABLE")

    monkeypatch.setattr(ceiling, "SIZES", (1 << 16,))
    monkeypatch.setattr(ceiling, "mover", lambda *_: Event)
    (rate,) = ceiling.bandwidths(device).values()
    assert 0.0 < rate < float("inf")
