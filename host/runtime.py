"""Make the OpenCL runtime that pip installed visible to the loader.

Intel's CPU runtime comes as two wheels (``intel-opencl-rt``, ``intel-cmplr-lib-rt``) that put bare libraries
into the environment and register nothing: the loader looks into ``/etc/OpenCL/vendors``, where only root may
write. So a folder of our own, with the system's entries and one for the wheel, is named in ``OCL_ICD_VENDORS``
before the first platform query.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
import tempfile
from pathlib import Path

import platformdirs

from gpuvision.host.files import write_whole

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
_VARIABLE = "OCL_ICD_VENDORS"
_ENTRY = "gpuvision-intel.icd"
_DRIVER = "libintelocl.so"
_POCL_3 = re.compile(r"libpocl\.so\.2\.(9|10)\.")  # 3.0 and 3.1
# The driver finds its siblings by name only; they must be in the process before it is opened.
_SIBLINGS = ("libintlc.so.5", "libirng.so", "libimf.so", "libsvml.so")


def cache_folder() -> Path:
    """Return the folder for what may be lost: verdicts on devices, lists of vendors."""
    return platformdirs.user_cache_path("gpuvision")


def provide_cache() -> None:
    """Give this process a cache folder of its own where the user's cannot be written.

    pyopencl keeps compiled kernels there, and fails rather than does without on a home that is missing or read-only.
    Must run before the first platform query.
    """
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache_folder()):
            return
    except OSError:
        folder = tempfile.mkdtemp(prefix="gpuvision-cache-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["XDG_CACHE_HOME"] = folder


def pin_workers() -> None:
    """Have PoCL keep each worker thread on a core of its own, unless the user decided otherwise.

    After a while of Python's own work on one core, Linux puts both workers of a two-core machine on the other one,
    where they take turns: kernels took 1.7 times as long. Must run before the first platform query.
    """
    os.environ.setdefault("POCL_AFFINITY", "1")


def request_inline_device() -> None:
    """Have PoCL list the device that runs kernels in the caller's thread beside the one with worker threads.

    To wake a worker takes longer than a frame takes to compute. Left alone where the user decided, and where there is
    a PoCL of another series than 3: others name their devices otherwise, and a PoCL that is asked for a name that it
    does not know has none. Must run before the first platform query, after `expose_installed_runtime`.
    """
    folder = Path(os.environ.get(_VARIABLE, SYSTEM_VENDORS))
    installed = [text for text in _entries(folder).values() if "pocl" in text]
    from_pip = importlib.util.find_spec("pocl_binary_distribution") is not None
    if installed and not from_pip and all(map(_POCL_3.search, installed)):
        os.environ.setdefault("POCL_DEVICES", "pthread basic")


def _wheel_libraries() -> dict[str, Path]:
    """Find the libraries of the two wheels; empty where either is not installed."""
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
        return False  # another machine's wheel: the system's runtimes stay as they are
    return True


def _entries(folder: Path) -> dict[str, str]:
    entries = {}
    for path in folder.glob("*.icd"):
        with contextlib.suppress(OSError):  # what this user may not read, the loader may not either
            entries[path.name] = path.read_text()
    return entries


def _vendors_folder(entries: dict[str, str]) -> Path:
    # The folder's name is its content: a change of drivers makes another folder, never half of one.
    digest = hashlib.sha256(repr(sorted(entries.items())).encode()).hexdigest()[:12]
    folder = cache_folder() / "vendors" / digest
    for name, text in entries.items():
        if not (folder / name).exists():
            write_whole(folder / name, text)
    return folder


def expose_installed_runtime() -> None:
    """Name Intel's runtime to the OpenCL loader where its wheels are installed; else do nothing.

    Leaves alone an ``OCL_ICD_VENDORS`` that the user has set. Must run before the first platform query.
    """
    named = os.environ.get(_VARIABLE)
    if named is not None and not Path(named, _ENTRY).exists():
        return
    libraries = _wheel_libraries()
    if not libraries or not _load_siblings(libraries):
        return
    if named is None:  # else it is inherited from a process of ours
        os.environ[_VARIABLE] = str(_vendors_folder(_entries(SYSTEM_VENDORS) | {_ENTRY: str(libraries[_DRIVER])}))
