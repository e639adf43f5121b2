"""Files of height maps for surface metrology programs: X3P (ISO 25178-72), SUR (Digital Surf) and SDF (ISO 25178-71).

======  ==============================================================================================================
X3P     float heights [m] in a ZIP with ``main.xml``; NaN in holes; first stored row at the smallest y
SUR     32-bit integers of a step in micrometres; the smallest integer less 2 marks a hole; first stored row at the top
SDF     float heights [m], binary or text; NaN or ``BAD`` in holes; first stored row at the smallest y
======  ==============================================================================================================

X3P and SDF define coordinates that grow with the row, so that the rows of a `Grid` (y falls with the row) are stored in
reverse order. SUR files are images, first row at the top. On an error no file is left behind.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import math
import os
import struct
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, Literal
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from gpuvision.formats.range_image import Values, height_array
from gpuvision.host.files import atomic_write
from gpuvision.ranging.height_map import Grid

SurfaceFormat = Literal["x3p", "sur", "sdf", "sdf-ascii"]

_PRODUCER = "gpuvision"
_MICROMETRE, _MILLIMETRE = 1e-6, 1e-3
_SUR_LEVELS = 1 << 30  # integer of the largest absolute height: half of the range of int32
_SUR_HOLE = -2  # added to the smallest integer (Digital Surf, as read by Gwyddion and SurfaceTopography)
_MAX_SDF_POINTS = 65535  # ISO 25178-71: numbers of points and profiles are unsigned 16-bit integers
_SDF_TYPES = {"float32": 3, "float64": 7}
_X3P_TYPES = {"float32": "F", "float64": "D"}
# The schema of ISO 5436-2:2000 requires a date of calibration in Record2. It is not known here: the comment says so.
_UNKNOWN_DATE = "1970-01-01T00:00:00+00:00"

Array = npt.NDArray[Any]


def _floats(z: Values, grid: Grid) -> Array:
    """Return heights as little-endian float32, or float64 where they have this type."""
    heights = height_array(z, grid)
    return heights.astype("<f8" if heights.dtype == np.float64 else "<f4")


def write_x3p(path: str | os.PathLike[str], z: Values, grid: Grid, *, overwrite: bool = False) -> None:
    """Write a height map as X3P (ISO 25178-72, before ISO 5436-2), with NaN in holes.

    Parameters
    ----------
    path : path-like
        Output file.
    z : array_like or device array
        Heights [m], (rows, columns); NaN in holes. float64 heights stay float64, others become float32.
    grid : Grid
        Grid of the heights.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        ``z`` does not have the shape of the grid.
    """
    heights = _floats(z, grid)[::-1]
    points = heights.tobytes()
    bottom = grid.top - (grid.rows - 1) * grid.cell_y
    axes = "".join(
        f"<{name}><AxisType>I</AxisType><DataType>D</DataType><Increment>{step!r}</Increment><Offset>{first!r}</Offset>"
        f"</{name}>"
        for name, step, first in (("CX", grid.cell_x, grid.left), ("CY", grid.cell_y, bottom))
    )
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    text = (
        '<?xml version="1.0" encoding="UTF-8" standalone="no"?>\n'
        '<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2" '
        'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        'xsi:schemaLocation="http://www.opengps.eu/2008/ISO5436_2 http://www.opengps.eu/2008/ISO5436_2/ISO5436_2.xsd">'
        "<Record1><Revision>ISO5436 - 2000</Revision><FeatureType>SUR</FeatureType>"
        f"<Axes>{axes}<CZ><AxisType>A</AxisType><DataType>{_X3P_TYPES[heights.dtype.name]}</DataType>"
        "<Increment>1</Increment><Offset>0</Offset></CZ></Axes></Record1>"
        f"<Record2><Date>{now}</Date><Instrument><Manufacturer>{escape(_PRODUCER)}</Manufacturer>"
        "<Model>sheet of light</Model><Serial>not available</Serial><Version>not available</Version></Instrument>"
        f"<CalibrationDate>{_UNKNOWN_DATE}</CalibrationDate><ProbingSystem><Type>NonContacting</Type>"
        "<Identification>laser triangulation</Identification></ProbingSystem>"
        "<Comment>The date of calibration is not known</Comment></Record2>"
        f"<Record3><MatrixDimension><SizeX>{grid.columns}</SizeX><SizeY>{grid.rows}</SizeY><SizeZ>1</SizeZ>"
        "</MatrixDimension><DataLink><PointDataLink>bindata/data.bin</PointDataLink>"
        f"<MD5ChecksumPointData>{_md5(points)}</MD5ChecksumPointData></DataLink></Record3>"
        "<Record4><ChecksumFile>md5checksum.hex</ChecksumFile></Record4></p:ISO5436_2>\n"
    ).encode()
    with atomic_write(path, overwrite=overwrite) as file:
        packed = io.BytesIO()  # a ZIP needs a file that can be read back
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("main.xml", text)
            archive.writestr("bindata/data.bin", points)
            archive.writestr("md5checksum.hex", f"{_md5(text)} *main.xml\n")
        file.write(packed.getbuffer())


def _md5(content: bytes) -> str:
    return hashlib.md5(content, usedforsecurity=False).hexdigest().upper()


def write_sur(path: str | os.PathLike[str], z: Values, grid: Grid, *, overwrite: bool = False) -> None:
    """Write a height map as SUR (Digital Surf, MountainsMap): 32-bit integers.

    Parameters
    ----------
    path, z, grid, overwrite
        As for `write_x3p`.

    Raises
    ------
    ValueError
        ``z`` does not have the shape of the grid.

    Notes
    -----
    The step of the heights is the largest absolute height divided by 2^30: 0.1 nm for heights up to 0.1 m. The rounding
    error is half a step. The cell sizes are float32 in the file, with a relative error up to 6e-8.
    """
    heights = height_array(z, grid).astype(np.float64)
    valid = np.isfinite(heights)
    largest = float(np.max(np.abs(heights[valid]), initial=0.0)) / _MICROMETRE
    step = float(np.float32(largest / _SUR_LEVELS if largest > 0 else 1.0))
    levels = np.rint(np.where(valid, heights, 0.0) / _MICROMETRE / step).astype(np.int64)
    low, high = (int(limit(levels[valid], initial=0)) for limit in (np.min, np.max))
    levels[~valid] = low + _SUR_HOLE
    now = datetime.datetime.now(datetime.UTC)

    def text(value: str, size: int) -> bytes:
        return value.encode("latin-1").ljust(size)

    header = struct.pack(
        "<12s4H30s30s5H2fH4iI3f",
        b"DIGITAL SURF",
        *(0, 1, 1, 2),  # little-endian, number of objects, version of the format, surface
        text("height map", 30),
        text(_PRODUCER, 30),
        *(0, 0, 1, 1, 1),  # material, acquisition, range, special points (holes), absolute heights
        *(0.0, 0.0),  # gauge resolution, slope
        32,
        *(low, high, grid.columns, grid.rows),
        grid.columns * grid.rows,
        *(grid.cell_x / _MILLIMETRE, grid.cell_y / _MILLIMETRE, step),
    )
    header += b"".join(text(name, 16) for name in ("X", "Y", "Z", *("mm", "mm", "µm") * 2))
    header += struct.pack("<3f3H3I7Hf2I3H", 1.0, 1.0, 1.0, *(0, 0, 0), *(0, 0, 0), *_clock(now), 0.0, 0, 0, 0, 0, 0)
    offset = (grid.left / _MILLIMETRE, (grid.top - (grid.rows - 1) * grid.cell_y) / _MILLIMETRE, 0.0)
    header += struct.pack("<128s3f34x", b"", *offset)
    with atomic_write(path, overwrite=overwrite) as file:
        file.write(header)
        file.write(levels.astype("<i4").tobytes())


def _clock(now: datetime.datetime) -> tuple[int, ...]:
    """Return second, minute, hour, day, month, year, and day of the week from Sunday."""
    return now.second, now.minute, now.hour, now.day, now.month, now.year, now.isoweekday() % 7


def surface_problem(surface_format: SurfaceFormat, grid: Grid) -> str | None:
    """Return the reason why a format cannot hold a height map over a grid; None if it can."""
    if surface_format in ("sdf", "sdf-ascii") and max(grid.shape) > _MAX_SDF_POINTS:
        return (
            f"the height map has {grid.columns} columns and {grid.rows} rows, an SDF file holds at most "
            f"{_MAX_SDF_POINTS} a side"
        )
    return None


def write_sdf(
    path: str | os.PathLike[str], z: Values, grid: Grid, *, ascii: bool = False, overwrite: bool = False
) -> None:
    """Write a height map as SDF (ISO 25178-71), binary or text.

    Parameters
    ----------
    path, z, grid, overwrite
        As for `write_x3p`.
    ascii : bool
        True: text with 9 digits (17 of float64), ``BAD`` in holes. Default False: binary, NaN in holes.

    Raises
    ------
    ValueError
        ``z`` does not have the shape of the grid, or has more than 65535 rows or columns.

    Notes
    -----
    The format has no place for the position of the grid.
    """
    heights = _floats(z, grid)[::-1]
    if problem := surface_problem("sdf", grid):
        raise ValueError(f"{path}: {problem}")
    now = datetime.datetime.now(datetime.UTC).strftime("%d%m%Y%H%M")
    kind = _SDF_TYPES[heights.dtype.name]
    with atomic_write(path, overwrite=overwrite) as file:
        if ascii:
            table: Mapping[str, object] = {
                "ManufacID": _PRODUCER,
                "CreateDate": now,
                "ModDate": now,
                "NumPoints": grid.columns,
                "NumProfiles": grid.rows,
                "Xscale": repr(grid.cell_x),
                "Yscale": repr(grid.cell_y),
                "Zscale": 1,
                "Zresolution": -1,
                "Compression": 0,
                "DataType": kind,
                "CheckType": 0,
            }
            file.write(
                ("aISO-1.0\n" + "".join(f"{name} = {value}\n" for name, value in table.items()) + "*\n").encode()
            )
            digits = "%.9g" if kind == _SDF_TYPES["float32"] else "%.17g"
            for row in heights.tolist():
                line = " ".join(digits % each if math.isfinite(each) else "BAD" for each in row)
                file.write(f"{line}\n".encode())
            file.write(b"*\n")
        else:
            name, date = _PRODUCER.encode().ljust(10), now.encode()
            sizes = (grid.columns, grid.rows, grid.cell_x, grid.cell_y, 1.0, -1.0, 0, kind, 0)
            file.write(struct.pack("<8s10s12s12s2H4d3B", b"bISO-1.0", name, date, date, *sizes))
            file.write(heights.tobytes())


def _write_sdf_text(path: str | os.PathLike[str], z: Values, grid: Grid) -> None:
    write_sdf(path, z, grid, ascii=True)


SURFACE_WRITERS: Mapping[SurfaceFormat, tuple[str, Callable[[str | os.PathLike[str], Values, Grid], None]]] = {
    "x3p": ("x3p", write_x3p),
    "sur": ("sur", write_sur),
    "sdf": ("sdf", write_sdf),
    "sdf-ascii": ("sdf", _write_sdf_text),
}
"""Extension of the file, and function that writes it, of each format."""
