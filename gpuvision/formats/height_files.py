"""Height maps of other programs and sensors: CSV files of LMI Gocator sensors, and images with a scale.

`read_heights` also reads the TIFF, PNG and NPZ files that `gpuvision scan` writes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.formats.range_image import HeightFile, read_npz, read_png16, read_tiff, states_grid
from gpuvision.host.errors import ReadError
from gpuvision.host.image_files import read_image
from gpuvision.host.reading import check_pixels, reading
from gpuvision.ranging.height_map import Grid
from gpuvision.validation import finite

_MILLIMETRE = 1e-3
_LONGEST_LINE = 1 << 22  # characters of a line of a CSV file: 4 MiB hold 300 000 heights. Chosen
_SURFACES, _PROFILES, _END = ("Surface", "Part"), "Profile", "End"
_HOLES = ("", "nan", "-")  # cells of a CSV file without a height
# Largest deviation of a position from even spacing, in cells. Chosen: positions are rounded to micrometres in the file.
_UNEVEN = 0.1

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ImageScale:
    """Scale of an image whose grey levels are heights: ``height = offset + step * level``.

    Parameters
    ----------
    cell_x, cell_y : float
        Size of a pixel in x and in y [m], above 0.
    step : float
        Height of one grey level [m], not 0; negative if dark pixels are high.
    offset : float
        Height of the grey level 0 [m]. Default 0.
    hole : float
        Grey level of pixels without a height; NaN for none. Default 0. NaN pixels of a float image are always holes.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    cell_x: float
    cell_y: float
    step: float
    offset: float = 0.0
    hole: float = 0.0

    def __post_init__(self) -> None:
        for name in ("cell_x", "cell_y"):
            object.__setattr__(self, name, finite(getattr(self, name), f"ImageScale.{name}", above=0.0))
        for name in ("step", "offset"):
            object.__setattr__(self, name, finite(getattr(self, name), f"ImageScale.{name}"))
        if self.step == 0:
            raise ValueError("ImageScale.step is 0, expected the height of one grey level [m]")


class HeightMapFile(NamedTuple):
    """Heights of a file with their grid and their standard deviations.

    Attributes
    ----------
    z
        Heights [m], (rows, columns), float32 or float64; NaN in holes.
    grid
        Grid of the heights.
    sigma
        Random standard deviation of each height [m], (rows, columns); None if the file has none.
    phase
        Standard deviation [m] by the phase of the line in its pixel (``map_phase`` of a scan), (rows, columns), NaN
        where it is unknown: neighbouring cells share this error. None if the file has none.
    """

    z: npt.NDArray[Any]
    grid: Grid
    sigma: npt.NDArray[Any] | None = None
    phase: npt.NDArray[Any] | None = None

    @property
    def total_sigma(self) -> npt.NDArray[Any] | None:
        """Standard deviation of each height by ``sigma`` and ``phase`` together [m]; None without ``sigma``."""
        if self.sigma is None or self.phase is None:
            return self.sigma
        both: npt.NDArray[Any] = np.hypot(self.sigma, np.where(np.isfinite(self.phase), self.phase, 0.0))
        return both.astype(self.sigma.dtype)


def read_heights(path: str | os.PathLike[str], scale: ImageScale | None = None) -> HeightMapFile:
    """Read a height map.

    Parameters
    ----------
    path : path-like
        TIFF, 16-bit PNG or NPZ file of `gpuvision scan`; CSV file of a Gocator; with `scale`, any grey image.
    scale : ImageScale, optional
        Scale of an image whose grey levels are heights.

    Raises
    ------
    ReadError, RecordingError
        The file is damaged, has another content, has no grid, or exceeds a `gpuvision.host.FileLimit`.
    ValueError
        A scale is given for a file that has one.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if path.is_dir():
        raise ReadError(f"{path}: a folder, expected a file of heights")
    if scale is not None:
        if ending in (".npz", ".csv") or states_grid(path):
            raise ValueError(f"{path}: the file states its scale; leave out the scale of images")
        return read_scaled_image(path, scale)
    if ending == ".npz":
        return scanned_map(read_npz(path)[0], path)
    found = {".csv": read_gocator, ".png": read_png16}.get(ending, read_tiff)(path)
    if found.grid is None:
        raise ReadError(f"{path}: states no grid; expected a height map with the size of its cells")
    return HeightMapFile(found.z, found.grid)


def scanned_map(arrays: Mapping[str, npt.NDArray[Any]], path: Path) -> HeightMapFile:
    """Return the height map of the arrays in the NPZ file of a scan.

    Parameters
    ----------
    arrays : mapping of str to numpy.ndarray
        Arrays of `read_npz`.
    path : Path
        File of the arrays, for messages.

    Raises
    ------
    ReadError
        An array of the map is missing, has another shape or no numbers, or the positions are not evenly spaced.
    """
    with reading(path, "NPZ file of a scan"):
        x, y, z = (arrays[name] for name in ("map_x", "map_y", "map_z"))
        sigma, phase = arrays.get("map_sigma"), arrays.get("map_phase")
        for name in ("map_x", "map_y", "map_z", "map_sigma", "map_phase"):
            if name in arrays and arrays[name].dtype.kind not in "iuf":
                raise ReadError(f"{path}: {name} has the type {arrays[name].dtype}, expected real numbers")
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
            raise ReadError(f"{path}: a position of map_x or map_y is not a finite number; expected metres")
        if (
            (x.ndim, y.ndim, z.ndim) != (1, 1, 2)
            or z.shape != (len(y), len(x))
            or any(each is not None and each.shape != z.shape for each in (sigma, phase))
        ):
            raise ReadError(f"{path}: map_z has shape {z.shape}, expected one row per map_y and one column per map_x")
        return HeightMapFile(z, _even_grid(x.astype(np.float64), y.astype(np.float64), path), sigma, phase)


def _even_grid(x: Float64, y: Float64, path: Path) -> Grid:
    """Return the grid of increasing x and falling y [m]; one row or column has square cells."""
    steps = [np.diff(each) for each in (x, -y)]
    cells = [float(np.mean(each)) if each.size else math.nan for each in steps]
    cell_x, cell_y = (cell if math.isfinite(cell) else other for cell, other in (cells, cells[::-1]))
    for name, values, cell in (("x", x, cell_x), ("y", -y, cell_y)):
        if not cell > 0 or np.any(np.abs(values - values[0] - cell * np.arange(len(values))) > _UNEVEN * cell):
            raise ReadError(f"{path}: positions in {name} are not evenly spaced; expected a uniform height map")
    return Grid(left=float(x[0]), top=float(y[0]), cell_x=cell_x, cell_y=cell_y, columns=len(x), rows=len(y))


def read_scaled_image(path: str | os.PathLike[str], scale: ImageScale) -> HeightMapFile:
    """Read an image whose grey levels are heights; the centre of the lower left pixel is the origin of the grid.

    Parameters
    ----------
    path : path-like
        Grey image of 8 or 16 bits or of floats.
    scale : ImageScale
        Size of a pixel and of a grey level.

    Raises
    ------
    RecordingError, ReadError
        The file is not a readable image, is coloured, or has more pixels than `gpuvision.host.reading.MAX_PIXELS`.
    """
    levels = read_image(Path(path))
    if levels.ndim != 2:
        raise ReadError(f"{path}: a colour image, expected grey levels that are heights")
    z = scale.offset + scale.step * levels.astype(np.float64)
    z[(levels == scale.hole) | ~np.isfinite(z)] = np.nan
    rows, columns = levels.shape
    cells = {"cell_x": scale.cell_x, "cell_y": scale.cell_y}
    return HeightMapFile(z, Grid(left=0.0, top=(rows - 1) * scale.cell_y, rows=rows, columns=columns, **cells))


# ---- Gocator ---------------------------------------------------------------------------------------------------


def read_gocator(path: str | os.PathLike[str]) -> HeightFile:
    """Read the height map of a CSV file that a Gocator sensor exported.

    Read are the sections ``Surface`` or ``Part`` (a uniform surface: the first row holds x, the first column y), or
    ``Profile`` (uniform profiles: one row for each frame, evenly spaced in y). All numbers are millimetres.

    Raises
    ------
    ReadError
        The file has no such section, or the section does not end with ``End``, or its rows differ in length, or the
        positions are not evenly spaced, or the map has more cells than `gpuvision.host.reading.MAX_PIXELS`.

    References
    ----------
    LMI Technologies, *Gocator Line Profile Sensors: User Manual*, "CSV File Format".
    """
    path = Path(path)
    with reading(path, "CSV file of a Gocator"):
        rows = _rows(path)
        for row in rows:
            if row[0] in (*_SURFACES, _PROFILES) and not any(row[1:]):
                x, y, z = _profiles(rows, path) if row[0] == _PROFILES else _surface(rows, path)
                break
        else:
            raise ReadError(f"{path}: no section Surface, Part or Profile; expected the CSV export of a Gocator")
        if len(x) > 1 and x[0] > x[1]:
            x, z = x[::-1], z[:, ::-1]
        if len(y) > 1 and y[0] < y[1]:
            y, z = y[::-1], z[::-1]
        grid = _even_grid(x * _MILLIMETRE, y * _MILLIMETRE, path)
        return HeightFile(np.ascontiguousarray(z) * _MILLIMETRE, grid)


def _rows(path: Path) -> Iterator[list[str]]:
    """Yield the cells of the lines that are not empty."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        while line := file.readline(_LONGEST_LINE):
            if len(line) == _LONGEST_LINE:
                raise ReadError(f"{path}: a line of {_LONGEST_LINE} characters or more, expected rows of a height map")
            cells = [each.strip() for each in line.split(",")]
            if any(cells):
                yield cells


def _section(rows: Iterator[list[str]], path: Path) -> Iterator[list[str]]:
    """Yield the rows of a section, without its two rows of attributes, and check that the section ends."""
    next(rows, None), next(rows, None)
    for row in rows:
        if row[0] == _END:
            return
        yield row
    raise ReadError(f"{path}: the section of heights does not end with {_END}; the file was cut")


def _surface(rows: Iterator[list[str]], path: Path) -> tuple[Float64, Float64, Float64]:
    """Return x, y and heights [mm] of the rows of a surface; the first row holds x, the first column y."""
    section = _section(rows, path)
    x = _numbers(next(section, []), 1)
    table = [(_numbers(row[:1], 0)[0], _heights(row, 1, len(x), path)) for row in _limited(section, len(x), path)]
    return _table(x, table, path)


def _profiles(rows: Iterator[list[str]], path: Path) -> tuple[Float64, Float64, Float64]:
    """Return x, y and heights [mm] of the rows of profiles whose column ``Axis`` is Z."""
    section = _section(rows, path)
    header = next(section, [])
    if "Axis" not in header or "Y" not in header:
        raise ReadError(f"{path}: its section Profile has no columns Y and Axis; expected the CSV export of a Gocator")
    axis, place = header.index("Axis"), header.index("Y")
    first = max(axis, place) + 1
    x = _numbers(header, first)
    table = [
        (_numbers(row[place : place + 1], 0)[0], _heights(row, first, len(x), path))
        for row in _limited(section, len(x), path)
        if row[axis : axis + 1] == ["Z"]
    ]
    return _table(x, table, path)


def _limited(section: Iterator[list[str]], columns: int, path: Path) -> Iterator[list[str]]:
    for count, row in enumerate(section, 1):
        check_pixels((count, columns), str(path))
        yield row


def _numbers(row: list[str], first: int) -> Float64:
    return np.array([float(each) for each in row[first:]])


def _heights(row: list[str], first: int, columns: int, path: Path) -> Float64:
    """Return the heights of a row; cells at its end may be missing where they hold no height."""
    if len(row) > first + columns:
        raise ReadError(f"{path}: a row of {len(row) - first} heights, expected {columns} as in its first row")
    given = [math.nan if each.lower() in _HOLES else float(each) for each in row[first:]]
    return np.array(given + [math.nan] * (columns - len(given)))


def _table(x: Float64, table: list[tuple[float, Float64]], path: Path) -> tuple[Float64, Float64, Float64]:
    if not (len(x) and len(table) and len(x) * len(table) > 1):
        raise ReadError(f"{path}: {len(table)} rows of {len(x)} heights, expected a height map")
    y = np.array([each for each, _ in table])
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise ReadError(f"{path}: a position is not a finite number; expected millimetres")
    return x, y, np.stack([each for _, each in table])
