"""Limits of files that are read, and the handler of exceptions that other libraries raise while they read."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gpuvision.host.errors import GpuVisionError, ReadError, RecordingError
from gpuvision.host.stages import stage
from gpuvision.host.text import printable

_LONGEST_REASON = 200  # characters: a reason stays readable in a line


@dataclass(frozen=True)
class FileLimit:
    """Largest size of one kind in a file that is read. A larger file is refused before it takes memory.

    Each reader defines the limits of its format.

    Attributes
    ----------
    variable : str
        Environment variable that changes the limit.
    default : float
        Limit without this variable.
    """

    variable: str
    default: float

    @property
    def value(self) -> float:
        """Limit in force.

        Raises
        ------
        ReadError
            The value of the environment variable is not a number above 0.
        """
        text = os.environ.get(self.variable)
        if text is None:
            return self.default
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not value > 0.0:
            raise ReadError(f"the environment variable {self.variable} is {text!r}, expected a number above 0")
        return value

    def check(self, size: float, what: str, error: type[Exception] = ReadError) -> None:
        """Check a size of a file against the limit.

        Parameters
        ----------
        size : float
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
        limit = self.value
        if not size <= limit:
            raise error(f"{what}, expected at most {limit:.10g}; set {self.variable} to change this limit")


MAX_PIXELS = FileLimit("GPUVISION_MAX_PIXELS", 1 << 28)
"""Pixels of an image or of a frame. Chosen: 16384 x 16384, which takes 2 GiB with 8 bytes per pixel. The largest area
sensors of industrial cameras have 150 million pixels."""

MAX_UNPACKED_BYTES = FileLimit("GPUVISION_MAX_UNPACKED_BYTES", 1 << 31)
"""Bytes that an archive (NPZ, ZIP of Gerber files) unpacks to. An archive that unpacks to at most twice its size is not
limited. Chosen: 2 GiB."""


def check_pixels(shape: tuple[int, ...], what: str, error: type[Exception] = ReadError) -> None:
    """Check the number of pixels of an image or a frame, by its shape (rows, columns, ...).

    Raises
    ------
    ReadError
        The image has more pixels than `MAX_PIXELS`; or the class of `error`.
    """
    rows, columns = (*shape, 1)[:2] if shape else (1, 1)
    MAX_PIXELS.check(int(rows) * int(columns), f"{what}: {columns} x {rows} pixels", error)


def check_frames(path: Path, shape: tuple[int, ...]) -> None:
    """Check the shape of an array of frames.

    Raises
    ------
    RecordingError
        The array has fewer than 2 axes or no element, or a frame has more pixels than `MAX_PIXELS`.
    """
    if len(shape) < 2 or 0 in shape:
        raise RecordingError(f"{path}: expected frames along the first of 2 or more axes, got shape {shape}")
    check_pixels(shape[1:], f"{path}: a frame", RecordingError)


def check_archive(path: Path, error: type[Exception] = ReadError) -> None:
    """Check the size to which a ZIP or NPZ file unpacks.

    Raises
    ------
    ReadError
        The files in it take more bytes than `MAX_UNPACKED_BYTES` and twice the archive; or the class of `error`.
    zipfile.BadZipFile, OSError
        The file is not a ZIP file, or cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(each.file_size for each in archive.infolist())
    if unpacked > 2 * path.stat().st_size:
        MAX_UNPACKED_BYTES.check(unpacked, f"{path}: unpacks to {unpacked} bytes", error)


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
        with stage("read", str(what)):
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
