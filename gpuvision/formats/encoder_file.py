"""Encoder files: one position or count for each profile of a scan, as text (CSV), NPY or NPZ."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gpuvision.host.array_files import read_array
from gpuvision.host.errors import RecordingError
from gpuvision.host.reading import FileLimit, check_archive, one_line, reading

Float64 = npt.NDArray[np.float64]

MAX_ENCODER_BYTES = FileLimit("GPUVISION_MAX_ENCODER_BYTES", 1 << 24)
"""Bytes of an encoder file, unpacked. Chosen: 16 MiB, two million positions."""

_DELIMITERS = ",;\t"
_LONGEST_SHOWN = 40  # characters of a value in a message


def read_encoder(path: Path, key: str | None = None) -> Float64:
    """Read the counts or positions of an encoder.

    Parameters
    ----------
    path : Path
        ``.npy`` or ``.npz`` with an array of one axis; any other file is text: one row for each profile, separated by
        comma, semicolon or tabulator. Rows that start with ``#`` and empty rows are ignored, and the first row may name
        the columns.
    key : str, optional
        Name of the array in an NPZ file that holds more than one, or of the column in a text file of several columns.
        An NPY file has no names.

    Returns
    -------
    numpy.ndarray
        Counts, (profiles,) float64, finite.

    Raises
    ------
    OSError
        The file is missing, or cannot be read.
    RecordingError
        The file is damaged, has no such array or column, holds a value that is not a finite number, or is larger than
        `MAX_ENCODER_BYTES`, unpacked.
    """
    with reading(path, "encoder file", RecordingError):
        size = path.stat().st_size
        MAX_ENCODER_BYTES.check(size, f"{path}: {size} bytes", RecordingError)
        suffix = path.suffix.lower()
        if suffix == ".npz":
            values = _from_archive(path, key)
        elif suffix == ".npy":
            if key is not None:
                raise RecordingError(f"{path}: an NPY file holds one array, without a name; leave out encoder_key")
            values = read_array(path)
        else:
            return _from_text(path, key)
        if values.ndim != 1 or not values.size or values.dtype.kind not in "iuf":
            raise RecordingError(
                f"{path}: holds {values.dtype} of shape {values.shape}, expected numbers of shape (profiles,)"
            )
        counts = values.astype(np.float64)
        if not np.all(np.isfinite(counts)):
            place = int(np.argmin(np.isfinite(counts)))
            raise RecordingError(f"{path}: value {place} is {counts[place]}, expected a finite number")
        return counts


def _from_archive(path: Path, key: str | None) -> npt.NDArray[np.generic]:
    check_archive(path, RecordingError)
    with np.load(path, allow_pickle=False) as archive:
        names = archive.files
        if key is None and len(names) == 1:
            (key,) = names
        if key not in names:
            raise RecordingError(f"{path}: {_no_such('array', key, names)}")
        size = max(each.file_size for each in archive.zip.infolist() if each.filename in (key, f"{key}.npy"))
        MAX_ENCODER_BYTES.check(size, f"{path}: an array of {size} bytes", RecordingError)
        values: npt.NDArray[np.generic] = archive[key]
        return values


def _from_text(path: Path, key: str | None) -> Float64:
    with path.open("rb") as file:  # a pipe or a device has no size before it is read
        content = file.read(int(MAX_ENCODER_BYTES.value) + 1)
    MAX_ENCODER_BYTES.check(len(content), f"{path}: {len(content)} bytes or more", RecordingError)
    lines = content.decode("utf-8-sig").splitlines()
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not numbered:
        raise RecordingError(f"{path}: holds no value, expected one for each profile")
    delimiter = max(_DELIMITERS, key=numbered[0][1].count)
    rows = [[cell.strip() for cell in row] for row in csv.reader((line for _, line in numbered), delimiter=delimiter)]
    if len(rows) != len(numbered):
        raise RecordingError(f"{path}: a quoted value spans several lines, expected numbers")
    names = rows[0] if not all(map(_is_number, rows[0])) else None
    width = len(rows[0])
    column = _column(path, names, width, key)
    first = 0 if names is None else 1
    values = []
    for (line, _), row in zip(numbered[first:], rows[first:], strict=True):
        if len(row) != width or not _is_number(row[column]):
            shown = one_line(row[column][:_LONGEST_SHOWN]) if len(row) == width else f"{len(row)} values"
            wanted = "a finite number" if len(row) == width else str(width)
            raise RecordingError(f"{path}: line {line} has {shown or 'nothing'}, expected {wanted}")
        values.append(float(row[column]))
    if not values:
        raise RecordingError(f"{path}: holds no value, expected one for each profile")
    return np.array(values)


def _column(path: Path, names: list[str] | None, width: int, key: str | None) -> int:
    if key is not None and key in (names or ()):
        assert names is not None  # it holds the key
        return names.index(key)
    if key is None and width == 1:
        return 0
    raise RecordingError(f"{path}: {_no_such('column', key, names or [])}")


def _no_such(kind: str, key: str | None, names: list[str]) -> str:
    content = f"several {kind}s" if key is None else f"no {kind} {one_line(key[:_LONGEST_SHOWN])!r}"
    known = ", ".join(one_line(each[:_LONGEST_SHOWN]) for each in names[:8]) or f"no named {kind}"
    return f"holds {content}; name one of them as [transport] encoder_key ({known})"


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
