"""Huge pages: which pages of an array are asked for, and that the arrays of a device have them."""

from __future__ import annotations

import mmap
import re
from pathlib import Path

import numpy as np
import pytest

from conftest import HUGE_PAGES
from gpuvision.host import Device, host_view
from gpuvision.host.huge_pages import LEAST_BYTES, advise_huge_pages


def is_advised(address: int) -> bool:
    """Return whether the mapping that holds an address has the flag "hg" (huge pages advised) in /proc/self/smaps."""
    holds = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if found := re.match(r"([0-9a-f]+)-([0-9a-f]+) ", line):
            holds = int(found[1], 16) <= address < int(found[2], 16)
        elif holds and line.startswith("VmFlags:"):
            return "hg" in line.split()
    raise AssertionError(f"no mapping holds {address:x}")


@pytest.fixture(autouse=True)
def huge_pages() -> None:
    if not HUGE_PAGES.exists():
        pytest.skip("the system has no huge pages")


def test_large_arrays_of_a_device_are_advised(device: Device) -> None:
    if not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    array = device.empty((LEAST_BYTES,), np.uint8)
    view = host_view(array)
    assert is_advised(view.ctypes.data + LEAST_BYTES // 2)
    view[:] = 7
    assert np.all(array.get() == 7)


def test_only_whole_pages_inside_the_memory_are_advised() -> None:
    """The pages before and after may be those of other data."""
    page = mmap.PAGESIZE
    pages = 2 * LEAST_BYTES // page
    with mmap.mmap(-1, pages * page) as memory:
        memory.madvise(mmap.MADV_NOHUGEPAGE)
        address = np.frombuffer(memory, np.uint8).ctypes.data
        advise_huge_pages(address + page + 1, LEAST_BYTES - 1)
        assert not is_advised(address + 3 * page)
        advise_huge_pages(address + page + 1, LEAST_BYTES)
        last = (page + 1 + LEAST_BYTES) // page
        advised = [is_advised(address + number * page) for number in (0, 1, 2, last - 1, last)]
        assert advised == [False, False, True, True, False]
