"""Measured numbers that are kept in the cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gpuvision.host.cache import cache_folder, read_private, write_private

# Largest number of entries of a file (chosen): more entries than devices, steps and image sizes of a user.
_MAX_ENTRIES = 1000


def driver_key(handle: Any) -> tuple[str, ...]:
    """Return the names and versions of a device and its driver, for keys of kept numbers."""
    return (handle.platform.name, handle.platform.version, handle.name, handle.driver_version)


def kept_number(file: str, key: object, measure: Callable[[], float], *, max_days: int = 0) -> float:
    """Return the number kept under a key. If no number is kept, measure it and keep it.

    Parameters
    ----------
    file : str
        Name of a JSON file of the cache folder.
    key : object
        Key. Two keys are the same if their ``repr`` is equal.
    measure : function
        Returns the number, positive and finite.
    max_days : int
        Number of days after which a kept number is measured again. Default 0: never.

    Notes
    -----
    The count of whole periods of ``max_days`` since 1970 is part of the key: a number is kept for this time or less.
    """
    if max_days:
        key = (key, int(time.time() // (86400 * max_days)))
    digest = hashlib.sha256(repr(key).encode()).hexdigest()[:24]
    path = cache_folder() / file
    kept = _read(path).get(digest)
    if kept is not None:
        return kept
    number = measure()
    entries = _read(path)  # again: another process may have kept numbers during the measurement
    newest = dict([*entries.items(), (digest, number)][-_MAX_ENTRIES:])
    # Without a writable cache each process measures again.
    with contextlib.suppress(OSError):
        write_private(path, json.dumps(newest, indent=1))
    return number


def _read(path: Path) -> dict[str, float]:
    """Return the kept numbers by key, without damaged entries."""
    try:
        read = json.loads(read_private(path) or "{}")
    except (ValueError, RecursionError):
        return {}
    entries = read.items() if isinstance(read, dict) else ()
    return {key: float(each) for key, each in entries if isinstance(each, int | float) and 0.0 < each < math.inf}
