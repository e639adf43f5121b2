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

MAX_LOOP_SAMPLES = FileLimit("GPUVISION_MAX_LOOP_SAMPLES", 1_000_000)
"""Samples of a recording of a loop. Chosen: 1 000 000, a quarter of an hour at 1 kHz."""
_COLUMNS = ("time", "command", "measured")
_LONGEST_LINE = 1000


class LoopRecording(NamedTuple):
    """Recording of one axis of a loop.

    Attributes
    ----------
    time : numpy.ndarray
        (n,): times of the samples [s].
    command : numpy.ndarray
        (n,): commanded position [m] or [rad].
    measured : numpy.ndarray
        (n,): newest measured position [m] or [rad]; NaN where the cell is empty.
    """

    time: npt.NDArray[np.float64]
    command: npt.NDArray[np.float64]
    measured: npt.NDArray[np.float64]


def read_loop_recording(path: str | os.PathLike[str]) -> LoopRecording:
    """Read a recording of a loop.

    Parameters
    ----------
    path : path-like
        CSV file with the header ``time,command,measured`` [s], [m] or [rad]; an empty cell of the last column is a
        frame without a measured position.

    Raises
    ------
    ReadError
        The file has another header, a cell is not a finite number, or there are more than `MAX_LOOP_SAMPLES` rows.
    """
    path = Path(path)
    rows: list[tuple[float, float, float]] = []
    with reading(path, "CSV file of a loop"), path.open(newline="", encoding="utf-8-sig") as file:
        header = tuple(each.strip() for each in file.readline(_LONGEST_LINE).split(","))
        if header != _COLUMNS:
            raise ReadError(f"{path}: the header is not {','.join(_COLUMNS)} (seconds, and metres or radians)")
        for number, row in enumerate(csv.reader(iter(lambda: file.readline(_LONGEST_LINE), "")), 2):
            if not any(each.strip() for each in row):
                continue
            MAX_LOOP_SAMPLES.check(len(rows) + 1, f"{path}: {len(rows) + 1} samples or more")
            if len(row) != 3:
                raise ReadError(f"{path}: line {number} has {len(row)} cells, expected 3")
            time, command = float(row[0]), float(row[1])
            measured = float(row[2]) if row[2].strip() else math.nan
            if not (math.isfinite(time) and math.isfinite(command)) or (row[2].strip() and not math.isfinite(measured)):
                raise ReadError(f"{path}: line {number}: expected finite numbers")
            rows.append((time, command, measured))
    if not rows:
        raise ReadError(f"{path}: no sample; expected one line for each frame")
    return LoopRecording(*np.array(rows).T)
