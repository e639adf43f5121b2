"""Limits of files that are read, and the handler of exceptions that other libraries raise while they read."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from gpuvision.host.errors import GpuVisionError, ReadError
from gpuvision.host.text import printable

_LONGEST_REASON = 200  # characters: a reason stays readable in a line


@dataclass(frozen=True, kw_only=True)
class FileLimits:
    """Largest sizes of files that are read. Larger files are refused before they take memory.

    Each limit can be changed by an environment variable: ``max_pixels`` by ``GPUVISION_MAX_PIXELS``, and so on.

    Attributes
    ----------
    max_pixels : int
        Pixels of an image or of a frame. Chosen: 16384 x 16384; the largest area sensors of industrial cameras have
        150 million. With 8 bytes per pixel such an image takes 2 GiB.
    max_unpacked_bytes : int
        Bytes that an archive (NPZ, ZIP of Gerber files) unpacks to. An archive that unpacks to at most twice its size
        is not limited. Chosen: 2 GiB.
    max_description_bytes : int
        Bytes of a TOML file. Chosen: 1 MiB, four times the largest file of features.
    max_nesting : int
        Depth of tables and arrays in a TOML file, and parts of a dotted key. Chosen: 32; gpuvision writes 4.
    max_board_files : int
        Files in the folder or ZIP file of a board. Chosen: 1000; boards have 10 to 60.
    max_board_bytes : int
        Bytes of the Gerber and drill files of a board. Chosen: 256 MiB.
    max_board_objects : int
        Objects of a layer, repeated ones included. Chosen: a million, which takes about 1 GiB.
    max_board_size : float
        Largest coordinate of a board [m]. Chosen: 2 m; production panels have up to 1.5 m.
    max_triangles : int
        Triangles of a mesh, instances included. Chosen: 20 million, 1 GB as binary STL.
    """

    max_pixels: int = 1 << 28
    max_unpacked_bytes: int = 1 << 31
    max_description_bytes: int = 1 << 20
    max_nesting: int = 32
    max_board_files: int = 1000
    max_board_bytes: int = 1 << 28
    max_board_objects: int = 1_000_000
    max_board_size: float = 2.0
    max_triangles: int = 20_000_000

    @classmethod
    def current(cls) -> FileLimits:
        """Return the limits with the changes that the environment variables ask for.

        Raises
        ------
        ReadError
            The value of a variable is not a positive number.
        """
        names = [each.name for each in fields(cls) if _variable(each.name) in os.environ]
        given: dict[str, Any] = {name: _of_environment(name) for name in names}
        return cls(**given)


def _variable(name: str) -> str:
    return f"GPUVISION_{name.upper()}"


def _of_environment(name: str) -> float:
    text = os.environ[_variable(name)]
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0.0:
        raise ReadError(f"the environment variable {_variable(name)} is {text!r}, expected a number above 0")
    return value


def check_limit(name: str, value: float, what: str, error: type[Exception] = ReadError) -> None:
    """Check a size of a file against a limit.

    Parameters
    ----------
    name : str
        Field of `FileLimits`.
    value : float
        Size to check; NaN exceeds every limit.
    what : str
        Start of the message: the file, and the object of this size.
    error : type
        Class of the exception.

    Raises
    ------
    ReadError
        The size exceeds the limit; or the class of `error`.
    """
    limit = getattr(FileLimits.current(), name)
    if not value <= limit:
        raise error(f"{what}, expected at most {limit:.10g}; set {_variable(name)} to change this limit")


def check_pixels(shape: tuple[int, ...], what: str, error: type[Exception] = ReadError) -> None:
    """Check the number of pixels of an image or a frame, by its shape (rows, columns, ...).

    Raises
    ------
    ReadError
        The image has more than `FileLimits.max_pixels`; or the class of `error`.
    """
    rows, columns = (*shape, 1)[:2] if shape else (1, 1)
    check_limit("max_pixels", int(rows) * int(columns), f"{what}: {columns} x {rows} pixels", error)


def check_archive(path: Path, error: type[Exception] = ReadError) -> None:
    """Check the size to which a ZIP or NPZ file unpacks.

    Raises
    ------
    ReadError
        The files in it take more than `FileLimits.max_unpacked_bytes` and twice the archive; or the class of `error`.
    zipfile.BadZipFile, OSError
        The file is not a ZIP file, or cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(each.file_size for each in archive.infolist())
    if unpacked > 2 * path.stat().st_size:
        check_limit("max_unpacked_bytes", unpacked, f"{path}: unpacks to {unpacked} bytes", error)


@contextlib.contextmanager
def reading(what: object, kind: str, error: type[Exception] = ReadError, *, hint: str = "") -> Iterator[None]:
    """Turn exceptions of other libraries inside the block into one exception with a message of one line.

    Exceptions of gpuvision, and errors of the operating system that name a file, pass unchanged.

    Parameters
    ----------
    what : object
        Path of the file, or another name of the place, for the message.
    kind : str
        Expected content, such as "image".
    error : type
        Class of the exception.
    hint : str, optional
        Advice at the end of the message.

    Raises
    ------
    ReadError
        Any other exception was raised in the block; or the class of `error`.
    """
    try:
        yield
    except GpuVisionError:
        raise
    except Exception as problem:  # readers of damaged files raise anything, from AssertionError to RecursionError
        if isinstance(problem, OSError) and problem.filename is not None:
            raise
        advice = f"; {hint}" if hint else ""
        raise error(f"{what}: not a readable {kind}: {reason_of(problem)}{advice}") from problem


def reason_of(problem: BaseException) -> str:
    """Return the message of another library's exception as one short line of printable characters."""
    if isinstance(problem, MemoryError):
        return "it needs more memory than is available"
    if isinstance(problem, RecursionError):
        return "it is nested too deeply"
    lines = [line for line in str(problem).splitlines() if line.strip()]
    return one_line(lines[0][:_LONGEST_REASON]) if lines else type(problem).__name__


def one_line(text: str) -> str:
    """Return a text as one line without control characters."""
    return " ".join(printable(text).split())
