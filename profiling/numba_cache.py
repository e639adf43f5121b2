"""Cache of the compiled peers: Numba takes 1 to 20 s for a parallel loop, longer than the measurement."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import time
import warnings
from pathlib import Path
from types import ModuleType

import numba
from numba.core.registry import CPUDispatcher

from gpuvision.host.cache import cache_folder

_KEPT = 30 * 24 * 3600.0  # time for which compiled functions of other sources are kept [s]


def keep_compiled(module: ModuleType) -> None:
    """Make Numba keep the compiled functions of a module in the cache folder of gpuvision.

    Numba compares the file of a function with the cache, but not the files of the functions that it calls. So the
    name of the folder contains a hash of all files of this package.
    """
    loops = [each for each in vars(module).values() if isinstance(each, CPUDispatcher)]
    if loops:
        # A function that uses large global arrays is compiled in each run.
        warnings.filterwarnings("ignore", "Cannot cache compiled function", category=numba.NumbaWarning)
        folder = cache_folder() / f"numba-{_sources_hash()}"
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)  # the time of the last use
        _remove_old_siblings(folder)
        numba.config.CACHE_DIR = os.fspath(folder)  # type: ignore[attr-defined]
        for loop in loops:
            loop.enable_caching()


def _remove_old_siblings(folder: Path) -> None:
    """Remove the folders of other sources that no run has used for 30 days."""
    oldest = time.time() - _KEPT
    for each in folder.parent.glob("numba-*"):
        with contextlib.suppress(FileNotFoundError):  # another run removes it at the same time
            if each != folder and each.stat().st_mtime < oldest:
                shutil.rmtree(each, ignore_errors=True)


def _sources_hash() -> str:
    hashed = hashlib.sha256(numba.__version__.encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()[:16]
