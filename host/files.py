"""Atomic writing of files and folders, and checks that a file or folder can be written.

New content is written under a temporary name ``.gpuvision.HEX.part`` in the target folder. A temporary file is locked
while its process lives: the next writer into the folder removes the unlocked ones, which killed processes left.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

if sys.platform != "win32":
    import fcntl

_TEMPORARY = re.compile(r"\.gpuvision\.[0-9a-f]{8}\.part")
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
# Temporary files and folders of this process, for `remove_temporaries`.
_live: set[Path] = set()


class DiskFullError(OSError):
    """Error of a full disk, or of an exhausted quota.

    Attributes
    ----------
    wanted, free : int
        Size of the file or folder to write, and free space after its incomplete content was removed [bytes].
    """

    def __init__(self, path: Path, wanted: int) -> None:
        place = next(each for each in (path, *path.absolute().parents) if each.is_dir())
        self.wanted, self.free = wanted, shutil.disk_usage(place).free
        reason = f"disk full: {self.wanted} bytes or more wanted, {self.free} bytes free"
        super().__init__(errno.ENOSPC, reason, os.fspath(path))


class _CountedFile(io.RawIOBase):
    """Binary file that continues to count its size when the disk is full, so that the error can name the required size.

    It has no file descriptor for its users, so that NumPy and Pillow write through `write`, too.

    Parameters
    ----------
    path, target : pathlib.Path
        File to write, and name of the file for errors.
    """

    def __init__(self, path: Path, target: Path) -> None:
        self._file = path.open("wb")
        self._target = target
        self._position = 0
        self.wanted = 0
        self.is_full = False

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        self._unless_full(self._file.write, data)
        self._position += size
        self.wanted = max(self.wanted, self._position)
        return size

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self.wanted}[whence]
        self._unless_full(self._file.seek, self._position)
        return self._position

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        if not self._file.closed:
            self._unless_full(self._file.flush)

    def synchronise(self) -> None:
        """Write the buffered bytes to the disk."""
        self.flush()
        self._unless_full(os.fsync, self._file.fileno())

    def close(self) -> None:
        if not self._file.closed:
            with contextlib.suppress(OSError):  # `synchronise` has reported a full disk before
                self._file.close()
        super().close()

    def _unless_full(self, call: Callable[..., object], *arguments: Any) -> None:
        if self.is_full:
            return
        try:
            call(*arguments)
        except OSError as error:
            if error.errno not in _DISK_FULL:
                _set_name(error, self._target)
                raise
            self.is_full = True


def _set_name(error: OSError, path: Path) -> None:
    """Set the file of an error of the system: an error of writing has no file name."""
    error.filename = os.fspath(path)
    if error.errno == errno.EFBIG:
        error.strerror = "the file is larger than the file system or the limit of the process (ulimit -f) allows"


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str], *, overwrite: bool = False, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Open a temporary file that gets the name `path` when the block succeeds, and is deleted when the block fails.

    Parameters
    ----------
    path : path
        A symbolic link stays and leads to the new file. A device or a pipe (``/dev/null``, ``/dev/stdout``) is written
        directly.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    mode : int
        Access rights of the file, without the bits of the process's umask. Default 0o666.

    Yields
    ------
    binary file
        Its bytes are on the disk before the file gets its name: readers of `path` see the old or the complete new file.

    Raises
    ------
    FileNotFoundError
        The folder does not exist.
    FileExistsError
        The file exists, and `overwrite` is false.
    DiskFullError
        The disk is full; no file is left.
    """
    path = Path(path)
    if is_device(path):
        with _naming(path), path.open("wb") as device:
            yield device
        return
    path = path.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    if not overwrite:
        _check_free(path)
    with _temporary(path.parent, functools.partial(Path.touch, mode=mode)) as temporary:
        with contextlib.closing(_CountedFile(temporary, path)) as file:
            yield cast(BinaryIO, file)
            file.synchronise()
        if not file.is_full:
            if not overwrite:
                _check_free(path)
            os.replace(temporary, path)
    if file.is_full:
        raise DiskFullError(path, file.wanted)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            _set_name(error, path)
        raise


def _check_free(path: Path) -> None:
    if path.is_file():
        raise FileExistsError(f"cannot write {path}: the file exists; give another name or overwrite=True")


def write_text_atomic(path: Path, text: str, *, overwrite: bool = False, mode: int = 0o666) -> None:
    """Write a text file with `atomic_write`, and make its folder where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, overwrite=overwrite, mode=mode) as file:
        file.write(text.encode())


def check_writable_folder(folder: str | Path) -> None:
    """Check that a folder exists and can be written, or that it can be made.

    Raises
    ------
    ValueError
        The name is empty.
    OSError
        The path or one of its parents is a file, or the folder cannot be written.
    """
    if not os.fspath(folder):
        raise ValueError("the name of the folder to write into is empty; give one, or . for this folder")
    path = Path(folder).absolute()
    for each in (path, *path.parents):
        if os.path.lexists(each) and not each.is_dir():
            raise NotADirectoryError(f"cannot write into {folder}: {each} is a file, expected a folder")
    place = next(each for each in (path, *path.parents) if each.is_dir())
    # Access rights are not enough: even root cannot write into a read-only or a virtual file system.
    trial = _temporary_name(place)
    try:
        trial.mkdir()
        with contextlib.suppress(FileNotFoundError):  # another process removed the folder as a left-over
            trial.rmdir()
    except OSError as error:
        raise type(error)(f"cannot write into {folder}: {place}: {error.strerror}; give another folder") from error


def is_device(path: Path) -> bool:
    """Return whether a path is a device or a pipe: neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


def check_writable_file(file: str | Path) -> None:
    """Check that a file can be written at a path; a device such as ``/dev/null`` needs no writable folder.

    Raises
    ------
    ValueError
        The name is empty.
    OSError
        The path is a folder, or the folder of the file cannot be written.
    """
    if not os.fspath(file):
        raise ValueError("the name of the file to write is empty; give one")
    if Path(file).is_dir():
        raise IsADirectoryError(f"cannot write {file}: it is a folder, expected a file")
    if not is_device(Path(file)):
        check_writable_folder(Path(file).parent)


@contextlib.contextmanager
def atomic_folder(folder: str | Path) -> Iterator[Path]:
    """Open a temporary folder whose files move to `folder` when the block succeeds, and are deleted when it fails.

    The files of the temporary folder replace files of the same name. A failure while they move restores the replaced
    files.

    Parameters
    ----------
    folder : path
        Folder of the files; made where it is missing. Its other files stay.

    Yields
    ------
    pathlib.Path
        The temporary folder.

    Raises
    ------
    ValueError, OSError
        As `check_writable_folder`; or a file would have to replace a folder, or a folder a file.
    DiskFullError
        The disk is full; no file is left.
    """
    check_writable_folder(folder)
    folder = Path(folder).absolute()
    made = [each for each in (folder.parent, *folder.parent.parents) if not each.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Inside the target folder where it exists: it may be a mount point with a parent that cannot be written.
    place = folder if folder.is_dir() else folder.parent
    remove_stale_temporaries(folder.parent)  # a process that was killed before it made the folder left them there
    full: tuple[Path, int] | None = None
    try:
        with _temporary(place, Path.mkdir) as inside, _temporary(place, Path.mkdir) as replaced:
            try:
                yield inside
                _check_room(inside, folder)
                _move(inside, folder, replaced)
            except OSError as error:
                if error.errno not in _DISK_FULL:
                    is_inside = error.filename is not None and Path(error.filename).is_relative_to(inside)
                    if is_inside or (error.filename is None and error.errno == errno.EFBIG):
                        _set_name(error, _target(error, inside, folder))
                    raise
                full = _target(error, inside, folder), _size(inside) + getattr(error, "wanted", 0)
        if full is not None:
            raise DiskFullError(*full)
        made = []
    finally:
        for each in made:
            each.rmdir()


def _target(error: OSError, inside: Path, folder: Path) -> Path:
    """Return the final path of the file that an error names by its path in the temporary folder."""
    name = Path(str(error.filename or inside))
    return folder / name.relative_to(inside) if name.is_relative_to(inside) else folder


def _size(folder: Path) -> int:
    return sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())


def _check_room(inside: Path, folder: Path) -> None:
    """Check before any move that no file would replace a folder and no folder a file."""
    for each in sorted(inside.rglob("*")):
        target = folder / each.relative_to(inside)
        if each.is_dir() and target.exists() and not target.is_dir():
            raise NotADirectoryError(f"cannot write into {target}: it is a file, expected a folder; move it away")
        if not each.is_dir() and target.is_dir():
            raise IsADirectoryError(f"cannot write {target}: it is a folder, expected a file; move it away")
        if target.is_dir():
            check_writable_folder(target)


def _move(inside: Path, folder: Path, replaced: Path) -> None:
    """Move files into a folder, over files of the same name; after a failure restore the folder.

    Parameters
    ----------
    inside, folder : pathlib.Path
        Folder of the new files, and folder to move them to.
    replaced : pathlib.Path
        Empty folder on the same file system for the replaced files.
    """
    undo: list[Callable[[], object]] = []
    try:
        for each in (inside, *sorted(inside.rglob("*"))):
            target = folder / each.relative_to(inside)
            if each.is_dir():
                if not target.exists():
                    undo.append(functools.partial(_remove_empty, target))
                    target.mkdir()
            elif os.path.lexists(target):
                kept = replaced / str(len(undo))
                undo.append(functools.partial(_restore, kept, target))
                _keep(target, kept)
                os.replace(each, target)
            else:
                undo.append(functools.partial(_remove, target))
                os.replace(each, target)
    except BaseException:
        for step in reversed(undo):
            step()
        raise


def _keep(target: Path, kept: Path) -> None:
    """Give a file a second name; where the file system has no hard links, move it there."""
    try:
        os.link(target, kept, follow_symlinks=False)
    except OSError:
        os.replace(target, kept)


def _restore(kept: Path, target: Path) -> None:
    if os.path.lexists(kept):
        os.replace(kept, target)


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # another process has written into it
        folder.rmdir()


def _remove(path: Path) -> None:
    """Remove a file or folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _temporary_name(folder: Path) -> Path:
    return folder / f".gpuvision.{secrets.token_hex(4)}.part"


@contextlib.contextmanager
def _temporary(folder: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """Make a temporary file or folder in a folder, lock it, and remove it at the end."""
    remove_stale_temporaries(folder)
    while True:
        path = _temporary_name(folder)
        _live.add(path)
        make(path)
        lock = _lock(path, is_waiting=True)
        # Between its creation and its lock another process may have taken it for a stale one.
        if path.exists():
            break
        _unlock(lock)
        _live.discard(path)
    try:
        yield path
    finally:
        _remove(path)
        _unlock(lock)
        _live.discard(path)


def _lock(path: Path, *, is_waiting: bool = False) -> int | None:
    """Lock a file or folder until its descriptor is closed; None where it is locked, or cannot be locked or opened."""
    if sys.platform == "win32":
        return None
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if is_waiting else fcntl.LOCK_NB))
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _unlock(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder, so that processes change a file in it one after the other."""
    lock = _lock(folder, is_waiting=True)
    try:
        yield
    finally:
        _unlock(lock)


def remove_stale_temporaries(folder: Path) -> None:
    """Remove temporary files and folders of the user that killed processes left in a folder."""
    if sys.platform == "win32":
        return
    try:
        found = [Path(each.path) for each in os.scandir(folder) if _TEMPORARY.fullmatch(each.name)]
    except OSError:
        return
    for path in found:
        lock = _lock(path)
        try:
            if lock is not None and os.fstat(lock).st_uid == os.geteuid():
                _remove(path)
        finally:
            _unlock(lock)


def remove_temporaries() -> None:
    """Remove the temporary files and folders of this process, before it ends without unwinding."""
    for path in tuple(_live):
        with contextlib.suppress(OSError):
            _remove(path)
