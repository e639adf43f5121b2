"""Peak performance of a device."""

from __future__ import annotations

import itertools

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
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


def test_the_kernels_compute_what_they_are_counted_for(device, rng):
    """All reads enter the sum that is written, and all chains of multiply-adds the result."""
    program = build(device, KERNEL_FOLDER, "ceiling/ceiling.cl", {})
    reads, writes, items = 37, 8, 4
    given = rng.integers(0, 9, (reads, 16)).astype(np.float32)
    source, made = (cl.array.to_device(device.queue, each) for each in (given, np.zeros((writes, 16), np.float32)))
    sizes = np.int64(reads), np.int64(writes)
    program.move(device.queue, (items,), None, source.data, made.data, *sizes)
    edges = reads * np.arange(items + 1) // items
    shares = np.array([given[first:last].sum(axis=0) for first, last in itertools.pairwise(edges)])
    np.testing.assert_array_equal(made.get(), np.repeat(shares, writes // items, axis=0))
    program.move_items(device.queue, (items,), None, source.data, made.data, *sizes)
    sums = [given.ravel()[item::items].sum() for item in range(items)]
    np.testing.assert_array_equal(made.get().ravel(), np.resize(sums, 16 * writes))
    chains = cl.array.zeros(device.queue, 32, np.float32)
    program.compute(device.queue, (2,), None, chains.data, np.float32(0.25), np.float32(0.5), np.int32(3))
    values = 0.25 + np.arange(8.0)
    for _ in range(3):
        values = 0.5 * values + 0.5
    np.testing.assert_allclose(chains.get(), values.sum(), rtol=1e-6)


@pytest.mark.parametrize(
    "form", ["", *(pytest.param(each, marks=pytest.mark.vectors) for each in ("PREFETCH", "PAST_CACHES"))]
)
def test_a_copy_takes_turns_of_reads_and_writes(device, rng, form):
    """Of 16 reads, and of the writes up to the same part of the share; the sum of all reads so far is written."""
    reads, writes = 100, 75
    given = rng.integers(0, 9, (reads, 16)).astype(np.float32)
    source, made = (cl.array.to_device(device.queue, each) for each in (given, np.zeros((writes, 16), np.float32)))
    kernel = cl.Kernel(build(device, KERNEL_FOLDER, "ceiling/ceiling.cl", {form: None} if form else {}), "move")
    kernel(device.queue, (1,), None, source.data, made.data, np.int64(reads), np.int64(writes))
    read_until = np.minimum(16 * np.arange(1, 8), reads)
    sums = np.cumsum(given, axis=0)[read_until - 1]
    counts = np.diff(writes * read_until // reads, prepend=0)
    np.testing.assert_array_equal(made.get(), np.repeat(sums, counts, axis=0))
