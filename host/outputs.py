"""Output files of a job: checked before the work, written together, and recognised by the next run of the job.

A job may replace a file only if an earlier run of the same job wrote it, or with ``overwrite=True``. It never replaces
a file that it reads. A hidden file `MANIFEST` in each output folder lists the written files with their job, size and
time of modification: a file that was edited or replaced since then is not the job's any more.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from gpuvision.host.files import (
    atomic_folder,
    atomic_write,
    check_writable_file,
    check_writable_folder,
    is_device,
    locked_folder,
)
from gpuvision.host.stages import stage

MANIFEST = ".gpuvision-outputs.json"
"""Name of the hidden file that lists the outputs in a folder."""

# Largest manifest that is read [bytes] (chosen): about 100 000 files.
_MAX_MANIFEST = 1 << 24


# Files that the process writes when it ends, such as a trace: no other output of any job.
_reserved: list[Path] = []


def reserve(path: str | Path) -> None:
    """Reserve a file that is written later: no job may read it or write another output under its name."""
    _reserved.append(Path(path))


def release(path: str | Path) -> None:
    """Release a file that `reserve` was given."""
    _reserved.remove(Path(path))


class Outputs:
    """Output files of a job.

    Parameters
    ----------
    job : str
        Name of the job, such as "scan". Earlier outputs of the same job may be replaced.
    inputs : iterable of path
        Files that the job reads; of a folder, the files in it. None of them is ever replaced, under no name: links are
        followed. Names of files that do not exist are ignored.
    overwrite : bool
        Whether other existing files may be replaced. Default False.

    Raises
    ------
    FileExistsError
        An input is a file that the process writes when it ends (`reserve`).
    """

    def __init__(self, job: str, *, inputs: Iterable[str | Path] = (), overwrite: bool = False) -> None:
        self.job, self.overwrite = job, overwrite
        self._inputs = {_identity(each): each for path in inputs for each in _files(Path(path))}
        self._claimed = {path.resolve(): path for path in _reserved}
        self._manifests: dict[Path, dict[str, Any]] = {}
        self.protect(*_reserved)

    def claim(self, *files: str | Path | None, job: str | None = None) -> None:
        """Check before the work that files can and may be written, and that no two outputs are the same file.

        Parameters
        ----------
        *files : path
            Files to write. None and ``-`` (standard output) are skipped.
        job : str, optional
            Job whose earlier outputs may be replaced. Default: `job`.

        Raises
        ------
        FileExistsError
            A file is an input, or exists and is not an output of the job.
        ValueError
            Two outputs are the same file, or a name is empty.
        OSError
            A file cannot be written.
        """
        checked: set[Path] = set()
        for each in files:
            if each is None or str(each) == "-":
                continue
            if not os.fspath(each) or Path(each).is_dir() or Path(each).parent not in checked:
                check_writable_file(each)
            path = Path(each)
            checked.add(path.parent)
            if is_device(path):
                continue
            self.check_replaceable(path, job=job)
            same = self._claimed.setdefault(path.resolve(), path)
            if same is not path:
                raise ValueError(f"two outputs have the same name {path}; give another name")

    def claim_folder(self, folder: str | Path, names: Iterable[str], *, job: str | None = None) -> None:
        """Check a folder as `check_writable_folder` and its files as `claim`."""
        check_writable_folder(folder)
        for path in _reserved:
            if path.resolve() in (Path(folder).resolve(), *Path(folder).resolve().parents):
                raise ValueError(f"{path} is the folder {folder} of the outputs or one above it; give a file")
        self.claim(*(Path(folder) / name for name in names), job=job)

    def protect(self, *files: Path) -> None:
        """Check that no file is an input.

        Raises
        ------
        FileExistsError
            A file is an input.
        """
        for path in files:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                known = self._inputs.get(_identity(path))
                if known is not None:
                    raise FileExistsError(f"cannot write {path}: it is the input {known}; give another name or folder")

    def check_replaceable(self, path: Path, *, job: str | None = None) -> None:
        """Check that a path is free or that its file may be replaced.

        Raises
        ------
        FileExistsError
            The file is an input, or exists and is not an output of the job.
        """
        self.protect(path)
        if self.overwrite or not path.exists():
            return
        entry = _entry(path, job or self.job)
        if not any(self._manifest(each.parent).get(each.name) == entry for each in (path, path.resolve())):
            raise FileExistsError(
                f"cannot write {path}: the file exists, and is not an unchanged output of an earlier "
                f"{job or self.job}; give another name, or allow it with --overwrite (Python: overwrite=True)"
            )

    @contextlib.contextmanager
    def folder(self, folder: str | Path, *, optional: Iterable[str] = ()) -> Iterator[Path]:
        """Open a temporary folder whose files move to `folder` when the block succeeds; see `atomic_folder`.

        Parameters
        ----------
        folder : path
            Output folder.
        optional : iterable of str
            Names of files that the job does not always write. Where the block does not write one of them, the unchanged
            output of an earlier run of the job is removed: it would seem to belong to the new files.

        Yields
        ------
        pathlib.Path
            The temporary folder.

        Raises
        ------
        FileExistsError
            A file is an input, or exists and is not an output of the job. No file is written.
        """
        with contextlib.ExitStack() as lock:  # released after the files have moved
            with stage("write", str(folder)), atomic_folder(folder) as inside:
                yield inside
                lock.enter_context(locked_folder(Path(folder)))
                self._seal(inside, Path(folder))
                missing = [Path(folder) / name for name in optional if not (inside / name).exists()]
                stale = [each for each in missing if self._is_earlier_output(each)]
            for each in stale:
                each.unlink(missing_ok=True)

    @contextlib.contextmanager
    def file(self, path: str | Path) -> Iterator[BinaryIO]:
        """Open a temporary file that gets the name `path` when the block succeeds; see `atomic_write`.

        Raises
        ------
        FileExistsError
            The file is an input, or exists and is not an output of the job.
        """
        path = Path(path)
        if is_device(path):
            with atomic_write(path) as device:
                yield device
            return
        check_writable_file(path)
        path = path.resolve()  # a symbolic link stays
        with self.folder(path.parent) as inside, atomic_write(inside / path.name) as file:
            yield file

    def write_text(self, path: str | Path, text: str) -> None:
        """Write a text file with `file`."""
        with self.file(path) as file:
            file.write(text.encode())

    def _seal(self, inside: Path, folder: Path) -> None:
        """Check the files in a temporary folder against their targets, and add the manifests."""
        self._manifests.clear()
        for place in (inside, *(each for each in inside.rglob("*") if each.is_dir())):
            target = folder / place.relative_to(inside)
            files = [each for each in place.iterdir() if each.is_file() and each.name != MANIFEST]
            for each in files:
                if not (target / each.name).is_dir():  # the move refuses folders
                    self.check_replaceable(target / each.name)
            if files:
                known = self._manifest(target) | {each.name: _entry(each, self.job) for each in files}
                (place / MANIFEST).write_text(json.dumps({"files": known}, indent=1) + "\n")

    def _is_earlier_output(self, path: Path) -> bool:
        """Return whether a file is an unchanged output of the job, neither a link nor an input."""
        if not path.is_file() or path.is_symlink() or _identity(path) in self._inputs:
            return False
        return bool(self._manifest(path.parent).get(path.name) == _entry(path, self.job))

    def _manifest(self, folder: Path) -> dict[str, Any]:
        if folder not in self._manifests:
            self._manifests[folder] = _read_manifest(folder)
        return self._manifests[folder]


def _identity(path: Path) -> tuple[int, int]:
    """Return device and inode number, which identify a file under all of its names."""
    info = path.stat()
    return info.st_dev, info.st_ino


def _files(path: Path) -> Iterator[Path]:
    """Yield a file, or the files in a folder without the outputs of earlier jobs; nothing for other names."""
    if path.is_file():
        yield path
    elif path.is_dir():
        outputs = _read_manifest(path)
        for each in path.iterdir():
            if each.is_file() and each.name != MANIFEST and not _is_output(each, outputs.get(each.name)):
                yield each


def _is_output(path: Path, entry: Any) -> bool:
    """Return whether a file is as the entry of the manifest says."""
    return isinstance(entry, dict) and entry == _entry(path, entry.get("job", ""))


def _entry(path: Path, job: str) -> dict[str, Any]:
    """Return the entry of a file in the manifest."""
    info = path.stat()
    return {"job": job, "size": info.st_size, "mtime_ns": info.st_mtime_ns}


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return the entries of a folder's manifest by file name; empty without a valid manifest."""
    path = folder / MANIFEST
    try:
        info = path.lstat()
        if not stat.S_ISREG(info.st_mode) or info.st_size > _MAX_MANIFEST:
            return {}
        read = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    files = read.get("files") if isinstance(read, dict) else None
    return files if isinstance(files, dict) else {}
