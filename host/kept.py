"""Objects kept between calls: bound instances of each thread, built programs, adopted devices."""

from __future__ import annotations

import collections
import gc
import threading
from collections.abc import Callable
from typing import Any

# OpenCL kernel objects are not thread-safe: each thread has separate bound instances.
_thread = threading.local()
# Current generation of bound instances. Each thread drops its instances of earlier generations at its next call.
_generation = 0
_clearers: list[Callable[[], None]] = []


def kept_bound() -> collections.OrderedDict[Any, Any]:
    """Return the bound instances of this thread by their keys, least recently used first."""
    if getattr(_thread, "generation", None) != _generation:
        _thread.bound = collections.OrderedDict()
        _thread.generation = _generation
    bound: collections.OrderedDict[Any, Any] = _thread.bound
    return bound


def drop_bound() -> None:
    """Drop the bound instances of all threads: of this thread now, of another thread at its next call."""
    global _generation
    _generation += 1
    if hasattr(_thread, "bound"):
        _thread.bound.clear()


def clear_with(clear: Callable[[], None]) -> None:
    """Register a function that `clear_cache` calls to empty another cache."""
    _clearers.append(clear)


def clear_cache() -> None:
    """Free the device memory and the programs that are kept for repeated calls.

    Calls such as ``operation(frames)`` keep arrays on the device for the last 16 shapes of each thread. This function
    frees the arrays of the calling thread, and the built programs of all threads; other threads free their arrays at
    their next call. Bound instances of the caller (`Operation.bind`), open streams and files of the cache folder stay.

    Notes
    -----
    The next call of an operation binds it again, in about a millisecond, and reads the compiled kernel from the disk.
    """
    drop_bound()
    for clear in _clearers:
        clear()
    gc.collect()
