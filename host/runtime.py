"""Make the OpenCL runtime that pip installed visible to the loader.

Intel's CPU runtime comes as two wheels (``intel-opencl-rt``, ``intel-cmplr-lib-rt``) that put bare libraries
into the environment and register nothing: the loader looks into ``/etc/OpenCL/vendors``, where only root may
write. So a folder of our own, with the system's entries and one for the wheel, is named in ``OCL_ICD_VENDORS``
before the first platform query.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
import os
import tempfile
from pathlib import Path

import platformdirs

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
_DRIVER = "libintelocl.so"
# The driver finds its siblings by name only; they must be in the process before it is opened.
_SIBLINGS = ("libintlc.so.5", "libirng.so", "libimf.so", "libsvml.so")


def cache_folder() -> Path:
    """Return the folder for what may be lost: verdicts on devices, lists of vendors."""
    return platformdirs.user_cache_path("gpuvision")


def write_whole(path: Path, text: str) -> None:
    """Write `text` so that a reader sees the old file or the new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


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


def expose_installed_runtime() -> None:
    """Name Intel's runtime to the OpenCL loader where its wheels are installed; else do nothing.

    Leaves alone an ``OCL_ICD_VENDORS`` that the user has set. Must run before the first platform query.
    """
    if "OCL_ICD_VENDORS" in os.environ:
        return
    libraries = _wheel_libraries()
    if not libraries:
        return
    try:
        for name in _SIBLINGS:
            if name in libraries:
                ctypes.CDLL(str(libraries[name]), mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return  # another machine's wheel: the system's runtimes stay as they are
    entries = {path.name: path.read_text() for path in SYSTEM_VENDORS.glob("*.icd")}
    entries["gpuvision-intel.icd"] = str(libraries[_DRIVER])
    # The folder's name is its content: a change of drivers makes another folder, never half of one.
    digest = hashlib.sha256(repr(sorted(entries.items())).encode()).hexdigest()[:12]
    try:
        folder = cache_folder() / "vendors" / digest
        for name, text in entries.items():
            if not (folder / name).exists():
                write_whole(folder / name, text)
    except OSError:  # a home that cannot be written: this process only
        folder = Path(tempfile.mkdtemp(prefix="gpuvision-vendors-"))
        for name, text in entries.items():
            write_whole(folder / name, text)
    os.environ["OCL_ICD_VENDORS"] = str(folder)
