"""CSV files of a servo loop's recording: time, commanded position, measured position of one axis."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import FileLimit, reading

MAX_LOOP_SAMPLES = FileLimit("GPUVISION_MAX_LOOP_SAMPLES", 20_000)
"""Samples of a recording of a loop. Chosen: 20 000, 20 s at 1 kHz: they take 8 s; the time grows with the square."""
_COLUMNS = ("time", "command", "measured")
_LONGEST_LINE, _LONGEST_SHOWN = 1000, 60  # characters of a line that is read, and in a message
# Largest magnitude of a time [s] and of a position [m] or [rad] (chosen): squares and products stay far from overflow.
_LARGEST = 1e6


class LoopRecording(NamedTuple):
    """Recording of one axis of a loop.

    Attributes
    ----------
    time : numpy.ndarray
        (n,): times of the samples [s].
    command : numpy.ndarray
        (n,): commanded position [m] or [rad].
    measured : numpy.ndarray
        (n,): newest measured position [m] or [rad]; NaN where the cell is empty or ``nan``.
    """

    time: npt.NDArray[np.float64]
    command: npt.NDArray[np.float64]
    measured: npt.NDArray[np.float64]


def read_loop_recording(path: str | os.PathLike[str]) -> LoopRecording:
    """Read a recording of a loop.

    Parameters
    ----------
    path : path-like
        CSV file with the header ``time,command,measured`` [s], [m] or [rad]; an empty cell or
        ``nan`` in the last column is a frame without a measured position.

    Raises
    ------
    ReadError
        The file has another header, a cell is not a finite number or exceeds 1e6, the time does not increase, or there
        are more than `MAX_LOOP_SAMPLES` rows.
    """
    path = Path(path)
    rows: list[tuple[float, float, float]] = []
    with reading(path, "CSV file of a loop"), path.open(newline="", encoding="utf-8-sig") as file:
        first = file.readline(_LONGEST_LINE)
        if not first:
            raise ReadError(f"{path}: the file is empty; expected the header {','.join(_COLUMNS)}")
        header = tuple(each.strip() for each in first.split(","))
        if header != _COLUMNS:
            raise ReadError(f"{path}: the header is not {','.join(_COLUMNS)} (seconds, and metres or radians)")
        for number, row in enumerate(csv.reader(iter(lambda: file.readline(_LONGEST_LINE), "")), 2):
            if not any(each.strip() for each in row):
                continue
            MAX_LOOP_SAMPLES.check(len(rows) + 1, f"{path}: {len(rows) + 1} samples or more")
            if len(row) != 3:
                raise ReadError(f"{path}: line {number} has {len(row)} cells, expected 3")
            rows.append(_sample(row, f"{path}: line {number}"))
            if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
                raise ReadError(f"{path}: line {number}: time is {row[0]} after {rows[-2][0]:g}, expected a later one")
    if not rows:
        raise ReadError(f"{path}: no sample; expected one line for each frame")
    return LoopRecording(*np.array(rows).T)


def _sample(row: list[str], place: str) -> tuple[float, float, float]:
    """Return the numbers of a row; NaN for a measured position that is missing."""
    try:
        time, command = float(row[0]), float(row[1])
        measured = float(row[2]) if row[2].strip() else math.nan
    except ValueError:
        raise ReadError(f"{place}: {','.join(row)[:_LONGEST_SHOWN]!r}, expected numbers") from None
    if not (math.isfinite(time) and math.isfinite(command)) or math.isinf(measured):
        raise ReadError(f"{place}: expected finite numbers")
    for name, value, unit in zip(_COLUMNS, (time, command, measured), ("s", "m or rad", "m or rad"), strict=True):
        if abs(value) > _LARGEST:
            raise ReadError(f"{place}: {name} is {value:g}, expected a magnitude of at most {_LARGEST:g} {unit}")
    return time, command, measured
