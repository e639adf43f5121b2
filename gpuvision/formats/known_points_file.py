"""CSV files of known points: image points with their places in the frame of a fixture."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import reading

Float64 = npt.NDArray[np.float64]

_COLUMNS = "column,row,x,y,z"
# Largest number of points, and longest line [characters], that are read: far above files that people write.
_MAX_POINTS, _LONGEST_LINE = 10_000, 1000


def read_known_points(path: str | os.PathLike[str]) -> tuple[Float64, Float64]:
    """Read image points and their known places.

    Parameters
    ----------
    path : path-like
        CSV file with the header ``column,row,x,y,z``; column and row [px], x, y and z [m].

    Returns
    -------
    numpy.ndarray
        (n, 2): (column, row) [px].
    numpy.ndarray
        (n, 3): places [m].

    Raises
    ------
    OSError
        The file cannot be read.
    ReadError
        The file has another header, no points, too many, or a row without five finite numbers.
    """
    path = Path(path)
    with reading(path, "CSV file of known points"), path.open(encoding="utf-8-sig") as file:
        header = ",".join(each.strip() for each in file.readline(_LONGEST_LINE).split(","))
        if header != _COLUMNS:
            raise ReadError(f"{path}: the header is not {_COLUMNS}; column and row in pixels, x, y and z in metres")
        lines = islice(iter(lambda: file.readline(_LONGEST_LINE), ""), 2 * _MAX_POINTS)
        rows = [(number, line.split(",")) for number, line in enumerate(lines, 2) if line.strip()]
        if not 0 < len(rows) <= _MAX_POINTS:
            raise ReadError(f"{path}: {len(rows)} points, expected 1 to {_MAX_POINTS}")
        table = np.array([_numbers(path, number, cells) for number, cells in rows])
    return table[:, :2].copy(), table[:, 2:].copy()


def _numbers(path: Path, number: int, cells: list[str]) -> list[float]:
    values = [float(each) for each in cells]
    if len(values) != len(_COLUMNS.split(",")) or not np.isfinite(values).all():
        raise ReadError(f"{path}: line {number} has not five finite numbers, expected {_COLUMNS}")
    return values
