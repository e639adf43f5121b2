"""Settings of the OpenCL runtimes before the first platform query.

Intel's CPU runtime comes as two wheels (``intel-opencl-rt``, ``intel-cmplr-lib-rt``) that install bare libraries and do
not register them with the ICD loader: the loader reads ``/etc/OpenCL/vendors``, where only root may write.
`expose_installed_runtime` makes a folder with the system's entries and one for the wheel, and names it in
``OCL_ICD_VENDORS``.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib.metadata
import importlib.util
import os
import re
from pathlib import Path

from gpuvision.host.cache import cache_folder, private_folder

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
_VARIABLE = "OCL_ICD_VENDORS"
_ENTRY = "gpuvision-intel.icd"
_DRIVER = "libintelocl.so"
# Variables that limit the number of PoCL's workers, by version.
_WORKER_COUNTS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT", "POCL_MAX_COMPUTE_UNITS")
_POCL_3 = re.compile(r"libpocl\.so\.2\.(9|10)\.")  # 3.0 and 3.1
# The driver finds these libraries by name only: they must be loaded before the driver is.
_SIBLINGS = ("libintlc.so.5", "libirng.so", "libimf.so", "libsvml.so")


def usable_cores() -> int:
    """Return the number of cores that the process may use; 0 where the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0


def pin_workers() -> None:
    """Make PoCL pin each worker thread to a core, where it has one worker for each core of the machine.

    While Python works on one core of a two-core machine, Linux puts both worker threads on the other core, where they
    take turns: kernels took 1.7 times as long (measured). PoCL pins worker k to core k of the machine. With fewer
    workers than cores, all processes would share the first cores, and a process that is restricted to some cores would
    have workers on other cores: the function does nothing there, and nothing where the user has set
    ``POCL_AFFINITY``. Must run before the first platform query.
    """
    if usable_cores() == os.cpu_count() and set(_WORKER_COUNTS).isdisjoint(os.environ):
        os.environ.setdefault("POCL_AFFINITY", "1")


def request_inline_device() -> None:
    """Make PoCL also list its inline device, which runs kernels in the calling thread instead of worker threads.

    Waking a worker thread takes longer than computing a small frame. The function does nothing where the user has set
    ``POCL_DEVICES``, and where a PoCL of another series than 3 is installed: other series use other device names, and
    PoCL lists no device at all for an unknown name. Must run before the first platform query, after
    `expose_installed_runtime`.
    """
    folder = Path(os.environ.get(_VARIABLE, SYSTEM_VENDORS))
    installed = [text for text in _entries(folder).values() if "pocl" in text]
    from_pip = importlib.util.find_spec("pocl_binary_distribution") is not None
    if installed and not from_pip and all(map(_POCL_3.search, installed)):
        os.environ.setdefault("POCL_DEVICES", "pthread basic")


def _wheel_libraries() -> dict[str, Path]:
    """Return the libraries of the two wheels by name; empty unless both wheels are installed."""
    found: dict[str, Path] = {}
    for wheel in ("intel-opencl-rt", "intel-cmplr-lib-rt"):
        try:
            files = importlib.metadata.files(wheel) or []
        except importlib.metadata.PackageNotFoundError:
            return {}
        for file in files:
            if file.name == _DRIVER or file.name in _SIBLINGS:
                found[file.name] = Path(str(file.locate())).resolve()
    return found if _DRIVER in found else {}


def _load_siblings(libraries: dict[str, Path]) -> bool:
    try:
        for name in _SIBLINGS:
            if name in libraries:
                ctypes.CDLL(str(libraries[name]), mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False  # a wheel for another machine: leave the system's runtimes unchanged
    return True


def _entries(folder: Path) -> dict[str, str]:
    entries = {}
    for path in folder.glob("*.icd"):
        with contextlib.suppress(OSError):  # the loader cannot read such a file either
            entries[path.name] = path.read_text()
    return entries


def _vendors_folder(entries: dict[str, str]) -> Path:
    # The folder is named by a hash of its content: other drivers give another folder, and no folder is ever changed.
    digest = hashlib.sha256(repr(sorted(entries.items())).encode()).hexdigest()[:12]
    # The folder is verified all the same: the loader loads every entry in it.
    return private_folder(cache_folder() / "vendors" / digest, entries)


def expose_installed_runtime() -> None:
    """Register Intel's CPU runtime with the OpenCL loader, if its wheels are installed.

    The function does nothing where the user has set ``OCL_ICD_VENDORS``. Must run before the first platform query.
    """
    named = os.environ.get(_VARIABLE)
    if named is not None and not Path(named, _ENTRY).exists():
        return
    libraries = _wheel_libraries()
    if not libraries or not _load_siblings(libraries):
        return
    if named is None:  # otherwise a parent process of gpuvision has set it
        entries = _entries(SYSTEM_VENDORS) | {_ENTRY: str(libraries[_DRIVER])}
        with contextlib.suppress(OSError):  # without a folder of the cache the wheel's runtime is not listed
            os.environ[_VARIABLE] = str(_vendors_folder(entries))
