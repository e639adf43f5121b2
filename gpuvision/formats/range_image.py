"""Files of range images: TIFF, 16-bit PNG, PLY and NPZ. On an error no file is left behind.

==========  =================================================================================================
TIFF        float32 heights [m], NaN in holes; the resolution tags and a JSON description hold the cells
16-bit PNG  height = Offset + Scale (code - 1), code 0 is a hole; both numbers are text chunks in the file
PLY         binary, one vertex per sample in scan order (organised): NaN in holes, so that neighbours stay
            neighbours; ``obj_info num_cols`` and ``num_rows`` give the shape
NPZ         all arrays, and their units as JSON
==========  =================================================================================================
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from gpuvision.host import DeviceArray, to_numpy
from gpuvision.host.errors import ReadError
from gpuvision.host.files import atomic_write
from gpuvision.host.image_files import read_image
from gpuvision.host.reading import check_archive, reading
from gpuvision.host.text import printable
from gpuvision.host.tiff_files import check_tiff_page
from gpuvision.ranging.height_map import Grid

_GRID_KEYS = ("left", "top", "cell_x", "cell_y")
_NO_DATA_TAG = 42113  # GDAL_NODATA: value that image and geographic tools read as missing
_CENTIMETRE = 0.01  # [m]: the resolution tags count cells per centimetre
_MAX_CODE = 65535
_MIN_SCALE = 1e-9  # m per code, if all heights are equal
_PNG_HEAD = 8 + 25  # signature and IHDR
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # both byte orders; + is BigTIFF
_PLY_TYPES = {"float32": "float", "float64": "double", "uint8": "uchar", "uint16": "ushort", "uint32": "uint"}
_PLY_DTYPES = {name: np.dtype(dtype).newbyteorder("<") for dtype, name in _PLY_TYPES.items()}
_UNITS_KEY = "units"
_LONGEST_LINE, _MOST_LINES = 1000, 100  # characters and lines of the header of a PLY file; write_ply writes 21 lines

Array = npt.NDArray[Any]
Values: TypeAlias = npt.ArrayLike | DeviceArray


class HeightFile(NamedTuple):
    """Heights and grid of a file.

    Attributes
    ----------
    z
        Heights [m], (rows, columns); NaN in holes.
    grid
        Grid of the heights; None if the file has no grid.
    """

    z: Array
    grid: Grid | None


def _numpy(values: Values) -> Array:
    return to_numpy(values) if isinstance(values, DeviceArray) else np.asarray(values)


def height_array(z: Values, grid: Grid | None) -> Array:
    """Return heights as a NumPy array after a check of their shape.

    Parameters
    ----------
    z : array_like or device array
        Heights [m], (rows, columns).
    grid : Grid, optional
        Grid with the same shape.

    Raises
    ------
    TypeError
        The heights are a masked array.
    ValueError
        The heights do not have two dimensions, or not the shape of the grid.
    """
    if isinstance(z, np.ma.MaskedArray):
        raise TypeError("heights are a masked array, expected a plain array with NaN in holes; use .filled(math.nan)")
    heights = _numpy(z)
    if heights.ndim != 2 or heights.size == 0:
        raise ValueError(f"heights have shape {heights.shape}, expected (rows, columns)")
    if grid is not None and heights.shape != grid.shape:
        raise ValueError(f"heights have shape {heights.shape}, the grid has {grid.shape}; expected the same")
    return heights


def _grid_of(table: Mapping[str, Any], shape: tuple[int, ...]) -> Grid | None:
    if not all(key in table for key in _GRID_KEYS):
        return None
    return Grid(**{key: float(table[key]) for key in _GRID_KEYS}, rows=shape[0], columns=shape[1])


def _grid_table(grid: Grid | None) -> dict[str, float]:
    return {} if grid is None else {key: getattr(grid, key) for key in _GRID_KEYS}


# ---- TIFF ------------------------------------------------------------------------------------------------------


def write_tiff(
    path: str | os.PathLike[str],
    z: Values,
    grid: Grid | None = None,
    *,
    quantity: str = "height",
    overwrite: bool = False,
) -> None:
    """Write heights as float32 TIFF: metres, NaN in holes.

    With a grid the resolution tags hold the cells per centimetre. The description is JSON: unit, value of a hole, grid.

    Parameters
    ----------
    path : path-like
        Output file.
    z : array_like or device array
        Heights [m], (rows, columns); NaN in holes.
    grid : Grid, optional
        Grid of the heights.
    quantity : str
        Name of the quantity in the description, default ``"height"``; for another length over the cells.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        ``z`` does not have two dimensions, or not the shape of the grid.
    """
    z = height_array(z, grid).astype(np.float32)
    cells: dict[str, Any] = (
        {} if grid is None else {"resolution": (_CENTIMETRE / grid.cell_x, _CENTIMETRE / grid.cell_y)}
    )
    with atomic_write(path, overwrite=overwrite) as file:
        tifffile.imwrite(
            file,
            z,
            photometric="minisblack",
            description=json.dumps({"quantity": quantity, "unit": "m", "hole": "NaN", **_grid_table(grid)}),
            metadata=None,
            software="gpuvision",
            resolutionunit="CENTIMETER" if cells else None,
            extratags=[(_NO_DATA_TAG, "s", 0, "nan", True)],
            **cells,
        )


def read_tiff(path: str | os.PathLike[str]) -> HeightFile:
    """Read heights from a TIFF file of `write_tiff`.

    Raises
    ------
    ReadError
        The file is not such a TIFF file, holds another quantity than heights, or has more pixels than
        `gpuvision.host.reading.MAX_PIXELS`.
    """
    with reading(path, "TIFF file of heights"), tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        check_tiff_page(page, str(path))
        z = page.asarray()
        description = json.loads(page.description)
        quantity = description.get("quantity", "height")
        if quantity != "height":
            raise ReadError(f"{path}: its values are the {printable(str(quantity))}, expected heights")
        if z.ndim != 2 or z.dtype.kind not in "iuf":
            raise ReadError(f"{path}: an image of shape {z.shape} and type {z.dtype}, expected heights (rows, columns)")
        return HeightFile(z, _grid_of(description, z.shape))


# ---- 16-bit PNG ------------------------------------------------------------------------------------------------


def write_png16(
    path: str | os.PathLike[str],
    z: Values,
    grid: Grid | None = None,
    *,
    low: float | None = None,
    high: float | None = None,
    overwrite: bool = False,
) -> None:
    """Write heights as 16-bit PNG: ``height = Offset + Scale (code - 1)`` in metres, code 0 is a hole.

    The codes 1 to 65535 span ``low`` to ``high``; the rounding error of a height is at most half of Scale. Offset,
    Scale, the unit and the grid are text chunks of the file.

    Parameters
    ----------
    path, z, grid
        As for `write_tiff`.
    low, high
        Heights of the first and the last code [m]. Default: lowest and highest of the heights. Heights outside become
        holes.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        ``z`` does not have two dimensions, or not the shape of the grid; or ``low`` exceeds ``high``.
    """
    z = height_array(z, grid).astype(np.float64)
    finite = z[np.isfinite(z)]
    low = float(finite.min(initial=math.inf)) if low is None else low
    high = float(finite.max(initial=-math.inf)) if high is None else high
    if not finite.size:
        low = high = 0.0
    if not low <= high:
        raise ValueError(f"low is {low} and high is {high}, expected low below high")
    scale = max((high - low) / (_MAX_CODE - 1), _MIN_SCALE)
    with np.errstate(invalid="ignore"):
        codes = np.where((z >= low) & (z <= high), np.rint((z - low) / scale) + 1, 0).astype(np.uint16)
    done, image = cv2.imencode(".png", codes)
    if not done:
        raise ValueError(f"cannot encode heights of shape {z.shape} as PNG; expected less than 2^31 cells a side")
    text = {
        "Description": "height = Offset + Scale * (code - 1); code 0 is a hole",
        "Unit": "m",
        "Offset": repr(low),
        "Scale": repr(scale),
        **{key: repr(value) for key, value in _grid_table(grid).items()},
    }
    with atomic_write(path, overwrite=overwrite) as file:
        encoded = image.tobytes()
        file.write(encoded[:_PNG_HEAD])
        for key, value in text.items():
            file.write(_text_chunk(key, value))
        file.write(encoded[_PNG_HEAD:])


def _text_chunk(key: str, value: str) -> bytes:
    body = b"tEXt" + key.encode("latin-1") + b"\0" + value.encode("latin-1")
    return struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))


def _text_chunks(encoded: bytes) -> dict[str, str]:
    text, at = {}, 8
    while at + 8 <= len(encoded):
        (length,) = struct.unpack_from(">I", encoded, at)
        if encoded[at + 4 : at + 8] == b"tEXt":
            key, value = encoded[at + 8 : at + 8 + length].split(b"\0", 1)
            text[key.decode("latin-1")] = value.decode("latin-1")
        at += length + 12
    return text


def read_png16(path: str | os.PathLike[str]) -> HeightFile:
    """Read heights from a PNG file of `write_png16`.

    Raises
    ------
    ReadError
        The file is not a 16-bit PNG, or has no Offset or Scale, or has more pixels than
        `gpuvision.host.reading.MAX_PIXELS`.
    """
    with reading(path, "16-bit PNG"):
        codes = read_image(Path(path))
        text = _text_chunks(Path(path).read_bytes())
        if codes.dtype != np.uint16 or codes.ndim != 2 or "Scale" not in text or "Offset" not in text:
            raise ReadError(f"{path} is no 16-bit PNG with Offset and Scale; expected one that write_png16 wrote")
        z = float(text["Offset"]) + float(text["Scale"]) * (codes.astype(np.float64) - 1)
        return HeightFile(np.where(codes == 0, np.nan, z), _grid_of(text, z.shape))


def states_grid(path: str | os.PathLike[str]) -> bool:
    """Return whether a TIFF or PNG file states the grid of its heights, as `write_tiff` and `write_png16` do.

    Raises
    ------
    ReadError
        The file is a damaged TIFF or PNG file.
    OSError
        The file cannot be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        head = file.read(len(_PNG_SIGNATURE))
    table: Any = None
    with reading(path, "image"):
        if head == _PNG_SIGNATURE:
            table = _text_chunks(path.read_bytes())
        elif head[:4] in _TIFF_SIGNATURES:
            with tifffile.TiffFile(path) as tiff, contextlib.suppress(ValueError):
                page: Any = tiff.pages[0]
                table = json.loads(page.description)
    return isinstance(table, dict) and all(key in table for key in _GRID_KEYS)


# ---- PLY -------------------------------------------------------------------------------------------------------


def write_ply(
    path: str | os.PathLike[str],
    x: Values,
    y: Values,
    z: Values,
    intensity: Values | None = None,
    status: Values | None = None,
    *,
    scalars: Mapping[str, Values] = MappingProxyType({}),
    organised: bool = True,
    overwrite: bool = False,
) -> None:
    """Write points as binary little-endian PLY, in metres.

    Parameters
    ----------
    path : path-like
        Output file.
    x, y, z : array_like or device array
        Coordinates [m], (profiles, samples), float32 or float64; the file keeps the type.
    intensity, status : array_like or device array, optional
        Intensity and `Status` flags, of the same shape.
    scalars : mapping of str to array_like or device array, optional
        More scalar fields of the points by name, of the same shape.
    organised : bool
        True (default): all samples in scan order, with NaN in holes, and ``obj_info num_cols`` (samples) and
        ``num_rows`` (profiles). False: the valid points only, for viewers that do not support NaN.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        The arrays do not all have the shape (profiles, samples).
    TypeError
        PLY does not support the type of an array.
    """
    arrays = {"x": x, "y": y, "z": z, "intensity": intensity, "status": status, **scalars}
    fields = {name: _numpy(each) for name, each in arrays.items() if each is not None}
    shape = fields["x"].shape
    for name, each in fields.items():
        if each.ndim != 2 or each.shape != shape:
            raise ValueError(f"{name} has shape {each.shape}, expected (profiles, samples), the same for all arrays")
        if each.dtype.name not in _PLY_TYPES:
            raise TypeError(f"{name} is {each.dtype}, a PLY file holds one of {', '.join(_PLY_TYPES)}")
    vertices = np.empty(shape, [(name, each.dtype.newbyteorder("<")) for name, each in fields.items()])
    for name, each in fields.items():
        vertices[name] = each
    if not organised:
        vertices = vertices[np.isfinite(fields["x"]) & np.isfinite(fields["y"]) & np.isfinite(fields["z"])]
    layout = [f"obj_info num_cols {shape[1]}", f"obj_info num_rows {shape[0]}"] if organised else []
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment gpuvision range image, metres" + (", NaN in holes, profile after profile" if organised else ""),
        *layout,
        f"element vertex {vertices.size}",
        *(f"property {_PLY_TYPES[each.dtype.name]} {name}" for name, each in fields.items()),
        "end_header",
    ]
    with atomic_write(path, overwrite=overwrite) as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())


def read_ply(path: str | os.PathLike[str]) -> dict[str, Array]:
    """Read the arrays of a PLY file of `write_ply`, by name; (profiles, samples) if organised, otherwise (points,).

    Raises
    ------
    ReadError
        The file is not a binary little-endian PLY of points, or its size differs from that in its header.
    """
    with reading(path, "PLY file of points"):
        return _points_of_ply(Path(path))


def _points_of_ply(path: Path) -> dict[str, Array]:
    with path.open("rb") as file:
        lines = []
        while (line := file.readline(_LONGEST_LINE).decode("ascii", "replace").strip()) not in ("end_header", ""):
            lines.append(line.split())
            if len(lines) > _MOST_LINES:
                raise ReadError(f"{path}: its header does not end; expected a PLY file that write_ply wrote")
        content = file.read()
    if ["format", "binary_little_endian", "1.0"] not in lines or any("list" in each for each in lines):
        raise ReadError(f"{path} is no binary little-endian PLY of points; expected one that write_ply wrote")
    layout = [(each[2], _PLY_DTYPES[each[1]]) for each in lines if each[0] == "property"]
    (count,) = (int(each[2]) for each in lines if each[:2] == ["element", "vertex"])
    if len(content) != count * np.dtype(layout).itemsize:
        raise ReadError(f"{path} holds {len(content)} bytes of points, its header says {count} points; it was cut")
    vertices = np.frombuffer(content, layout)
    sides = {each[1]: int(each[2]) for each in lines if each[0] == "obj_info"}
    shape = (sides["num_rows"], sides["num_cols"]) if sides else (count,)
    return {name: vertices[name].reshape(shape) for name, _ in layout}


# ---- NPZ -------------------------------------------------------------------------------------------------------


def write_npz(
    path: str | os.PathLike[str], arrays: Mapping[str, Values], units: Mapping[str, str], *, overwrite: bool = False
) -> None:
    """Write arrays and their units as NPZ.

    Parameters
    ----------
    path : path-like
        Output file.
    arrays : mapping of str to array_like or device array
        Arrays by name.
    units : mapping of str to str
        Unit of each array, by the same names; ``""`` for an array without a unit.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        The names of arrays and units differ.
    """
    if _UNITS_KEY in arrays or set(units) != set(arrays):
        odd = ", ".join(sorted(set(units) ^ set(arrays))) or _UNITS_KEY
        raise ValueError(f"arrays and units do not belong together: {odd}; expected one unit for every array")
    with atomic_write(path, overwrite=overwrite) as file:
        held: dict[str, Any] = {name: _numpy(each) for name, each in arrays.items()}
        held[_UNITS_KEY] = np.array(json.dumps(dict(units)))
        np.savez(file, **held)


def read_npz(path: str | os.PathLike[str]) -> tuple[dict[str, Array], dict[str, str]]:
    """Read the arrays and their units, by name, from an NPZ file of `write_npz`.

    Raises
    ------
    ReadError
        The file is not such an NPZ file, or unpacks to more bytes than
        `gpuvision.host.reading.MAX_UNPACKED_BYTES`.
    """
    with reading(path, "NPZ file of arrays and units"):
        check_archive(Path(path))
        with np.load(path, allow_pickle=False) as file:
            units: dict[str, str] = json.loads(str(file[_UNITS_KEY]))
            return {name: file[name] for name in file.files if name != _UNITS_KEY}, units
