"""Atomic writing of files and folders, and checks that a file or folder can be written."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block succeeds, and is deleted when the block fails.

    Parameters
    ----------
    path : path
        A symbolic link stays and leads to the new file. A device or a pipe (``/dev/null``, ``/dev/stdout``) is written
        directly.

    Yields
    ------
    binary file
        Its bytes are on the disk before the file gets its name: readers of `path` see the old or the complete new file.

    Raises
    ------
    FileNotFoundError
        The folder does not exist.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        with path.open("wb") as device:
            yield device
        return
    path = path.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with beside.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def write_text_atomic(path: Path, text: str) -> None:
    """Write a text file atomically, and make its folder where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
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
    trial = _beside(place)
    try:
        trial.mkdir()
        trial.rmdir()
    except OSError as error:
        raise type(error)(f"cannot write into {folder}: {place}: {error.strerror}; give another folder") from error


def check_writable_file(file: str | Path) -> None:
    """Check that a file can be written at a path.

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
    check_writable_folder(Path(file).parent)


@contextlib.contextmanager
def atomic_folder(folder: str | Path) -> Iterator[Path]:
    """Open a temporary folder whose files move to `folder` when the block succeeds, and are deleted when it fails.

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
    """
    check_writable_folder(folder)
    folder = Path(folder).absolute()
    made = [each for each in (folder.parent, *folder.parent.parents) if not each.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Inside the target folder where it exists: it may be a mount point with a parent that cannot be written.
    inside = _beside(folder if folder.is_dir() else folder.parent)
    try:
        inside.mkdir()
        yield inside
        _check_room(inside, folder)
        _move(inside, folder)
        made = []
    finally:
        shutil.rmtree(inside, ignore_errors=True)
        for each in made:
            each.rmdir()


def _beside(place: Path) -> Path:
    return place / f".gpuvision.{secrets.token_hex(4)}.part"


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


def _move(inside: Path, folder: Path) -> None:
    """Move files into a folder, over files of the same name."""
    folder.mkdir(exist_ok=True)
    for each in list(inside.iterdir()):
        if each.is_dir():
            _move(each, folder / each.name)
        else:
            os.replace(each, folder / each.name)
