"""Files, and folders of them, that are written whole or not at all; and checks that they can be."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file that takes the place of `path` when the block ends well, and vanishes when it does not.

    The bytes are on the disk before the name is: whoever opens `path` sees the old file or the whole new one. A link
    stays, and leads to the new file; a device or a pipe (``/dev/null``, ``/dev/stdout``) is written into.

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


def write_whole(path: Path, text: str) -> None:
    """Write a text in place of what `path` holds, and make its folder where that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(text.encode())


def check_folder(folder: str | Path) -> None:
    """Check that a folder is there to write into, or can be made.

    Raises
    ------
    ValueError
        The name is empty.
    OSError
        There is a file of that name, or one in its place on the way there; or nothing can be written there.
    """
    if not os.fspath(folder):
        raise ValueError("the name of the folder to write into is empty; give one, or . for this folder")
    path = Path(folder).absolute()
    for each in (path, *path.parents):
        if os.path.lexists(each) and not each.is_dir():
            raise NotADirectoryError(f"cannot write into {folder}: {each} is a file, expected a folder")
    place = next(each for each in (path, *path.parents) if each.is_dir())
    # Rights do not tell: who may do everything still cannot write into a read-only or a virtual file system.
    trial = _beside(place)
    try:
        trial.mkdir()
        trial.rmdir()
    except OSError as error:
        raise type(error)(f"cannot write into {folder}: {place}: {error.strerror}; give another folder") from error


def check_file(file: str | Path) -> None:
    """Check that a file can be written there.

    Raises
    ------
    ValueError
        The name is empty.
    OSError
        There is a folder of that name, or its folder cannot be written.
    """
    if not os.fspath(file):
        raise ValueError("the name of the file to write is empty; give one")
    if Path(file).is_dir():
        raise IsADirectoryError(f"cannot write {file}: it is a folder, expected a file")
    check_folder(Path(file).parent)


@contextlib.contextmanager
def whole_folder(folder: str | Path) -> Iterator[Path]:
    """Give a folder to write into whose files appear in `folder` when the block ends well, and vanish if not.

    Raises
    ------
    ValueError, OSError
        See `check_folder`; or something in the folder is in the way of a file.
    """
    check_folder(folder)
    folder = Path(folder).absolute()
    made = [each for each in (folder.parent, *folder.parent.parents) if not each.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Within a folder that is there: it may be a mounted one, and the one above not ours.
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
    """Check that nothing stands in the way of a file, before the first one is moved."""
    for each in sorted(inside.rglob("*")):
        target = folder / each.relative_to(inside)
        if each.is_dir() and target.exists() and not target.is_dir():
            raise NotADirectoryError(f"cannot write into {target}: it is a file, expected a folder; move it away")
        if not each.is_dir() and target.is_dir():
            raise IsADirectoryError(f"cannot write {target}: it is a folder, expected a file; move it away")
        if target.is_dir():
            check_folder(target)


def _move(inside: Path, folder: Path) -> None:
    """Move files over those of the same name, and leave the others."""
    folder.mkdir(exist_ok=True)
    for each in list(inside.iterdir()):
        if each.is_dir():
            _move(each, folder / each.name)
        else:
            os.replace(each, folder / each.name)
