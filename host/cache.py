"""Cache folder of gpuvision: verdicts of devices, lists of vendors. Only its user may write into it.

The files in it decide which drivers are loaded and which devices are used. Therefore a file is used only if the user
owns it and nobody else may write it.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
import tempfile
from pathlib import Path

import platformdirs

from gpuvision.host.files import atomic_write

_VARIABLE = "XDG_CACHE_HOME"
# Largest file that is read [bytes] (chosen): the verdicts of a thousand devices take less.
_MAX_FILE = 1 << 20
# Space that the cache needs [bytes]: twice the 2 MiB that the compiled kernels of a scan take (measured, PoCL 3.1).
_ROOM = 1 << 22


def cache_folder() -> Path:
    """Return the user's cache folder of gpuvision.

    A relative ``XDG_CACHE_HOME`` is ignored, as the XDG Base Directory Specification says.
    """
    _drop_relative()
    return platformdirs.user_cache_path("gpuvision")


def _drop_relative() -> None:
    # Remove the variable itself: pyopencl and PoCL read it, too.
    if not os.path.isabs(os.environ.get(_VARIABLE, os.sep)):
        del os.environ[_VARIABLE]


_drop_relative()  # pyopencl makes its cache folder when it is imported


def provide_cache() -> None:
    """Make the cache folder private; set a temporary one for this process where that is not possible.

    The folder gets mode 0700. It must belong to the user. A folder in which other users could write is emptied.
    pyopencl and PoCL keep compiled kernels in the user's cache folder, and fail where the home folder is missing,
    read-only or full. Must run before the first platform query.
    """
    try:
        folder = cache_folder()
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        _make_private(folder)
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(bytes(_ROOM))
            trial.flush()
        return
    except OSError:
        temporary = tempfile.mkdtemp(prefix="gpuvision-cache-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        os.environ[_VARIABLE] = temporary


def _make_private(folder: Path) -> None:
    if sys.platform == "win32":
        return
    mode = folder.stat().st_mode
    if folder.stat().st_uid != os.geteuid():
        raise PermissionError(f"{folder} belongs to another user")
    if mode & 0o077:
        folder.chmod(0o700)
    if mode & 0o022:
        for each in folder.iterdir():
            if each.is_dir() and not each.is_symlink():
                shutil.rmtree(each)
            else:
                each.unlink()


def is_private(path: Path) -> bool:
    """Return whether a path is a file or folder, no link, that the user owns and nobody else may write."""
    try:
        info = path.lstat()
    except OSError:
        return False
    if sys.platform == "win32":
        return True
    is_plain = stat.S_ISREG(info.st_mode) or stat.S_ISDIR(info.st_mode)
    return is_plain and info.st_uid == os.geteuid() and not info.st_mode & 0o022


def read_private(path: Path) -> str | None:
    """Return the text of a private file of the cache; None if it is missing, too large, no text, or not private."""
    content = read_private_bytes(path, _MAX_FILE)
    try:
        return None if content is None else content.decode()
    except UnicodeDecodeError:
        return None


def read_private_bytes(path: Path, max_bytes: int) -> bytes | None:
    """Return the content of a private file of the cache; None if it is missing, too large, or not private."""
    if not is_private(path):
        return None
    try:
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except OSError:
        return None
    return content if len(content) <= max_bytes else None


def write_private(path: Path, text: str) -> None:
    """Write a private file of the cache, whole or not at all, and make its folder where it is missing."""
    write_private_bytes(path, text.encode())


def write_private_bytes(path: Path, content: bytes) -> None:
    """Write a private file of the cache, whole or not at all, and make its folder where it is missing."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with atomic_write(path, overwrite=True, mode=0o600) as file:
        file.write(content)


def private_folder(folder: Path, entries: dict[str, str]) -> Path:
    """Return a folder of the cache with exactly the given files; replace a folder with other files or other owners.

    Parameters
    ----------
    folder : pathlib.Path
        Folder whose name is a hash of its content.
    entries : dict of str to str
        Text of each file by name.
    """
    if not _holds(folder, entries):
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder.parent))
        try:
            for name, text in entries.items():
                write_private(made / name, text)
            if not _renamed(made, folder) and not _holds(folder, entries):
                _remove(folder)
                _renamed(made, folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        if not _holds(folder, entries):
            raise PermissionError(f"{folder} cannot be made private; remove it")
    return folder


def _renamed(made: Path, folder: Path) -> bool:
    """Return whether a folder could be renamed: not where the new name exists, such as by another process.

    A folder that another process made is never removed: its OpenCL loader may be reading the entries.
    """
    try:
        made.rename(folder)
    except OSError:
        return False
    return True


def _remove(path: Path) -> None:
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.is_dir():
        shutil.rmtree(path)


def _holds(folder: Path, entries: dict[str, str]) -> bool:
    if not is_private(folder) or not folder.is_dir() or {each.name for each in folder.iterdir()} != set(entries):
        return False
    return all(read_private(folder / name) == text for name, text in entries.items())
