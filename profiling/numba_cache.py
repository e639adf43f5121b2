"""Cache of the compiled peers: Numba takes 1 to 20 s for a parallel loop, longer than the measurement."""

from __future__ import annotations

import hashlib
import os
import warnings
from pathlib import Path
from types import ModuleType

import numba
from numba.core.registry import CPUDispatcher

from gpuvision.host.cache import cache_folder


def keep_compiled(module: ModuleType) -> None:
    """Make Numba keep the compiled functions of a module in the cache folder of gpuvision.

    Numba compiles a function again when its own file changes, but not when a function that it calls changes in another
    file. Therefore the folder is named after a hash of all files of this package.
    """
    loops = [each for each in vars(module).values() if isinstance(each, CPUDispatcher)]
    if loops:
        # A function that uses large global arrays is compiled in each run.
        warnings.filterwarnings("ignore", "Cannot cache compiled function", category=numba.NumbaWarning)
        numba.config.CACHE_DIR = os.fspath(cache_folder() / f"numba-{_sources_hash()}")  # type: ignore[attr-defined]
        for loop in loops:
            loop.enable_caching()


def _sources_hash() -> str:
    hashed = hashlib.sha256(numba.__version__.encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()[:16]
