"""Checks of mesh files before they are parsed: their headers must agree with their sizes."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from gpuvision.host.reading import FileLimit

SUFFIXES = (".stl", ".ply", ".obj", ".glb")
MAX_TRIANGLES = FileLimit("GPUVISION_MAX_TRIANGLES", 20_000_000)
"""Triangles of a mesh, instances included. Chosen: 20 million, 1 GB as binary STL."""
_TRIANGLE_BYTES = 50  # of a triangle in a binary STL file, and fewer than a face and its corners take in other formats
_LONGEST_HEADER = 1 << 16  # bytes of the header of a PLY file
_PLY_SIZES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}
_PLY_SIZES |= {"int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8}
_GLB_HEADER = struct.Struct("<4sIIII")


def check_mesh(path: Path) -> None:
    """Check the size of a mesh file, and the sizes that its header claims.

    Raises
    ------
    ReadError
        The file has more triangles than `MAX_TRIANGLES`.
    ValueError
        The size of the file differs from the size that its header claims, or there is no such header.
    """
    size = path.stat().st_size
    count = size // _TRIANGLE_BYTES
    MAX_TRIANGLES.check(count, f"{path}: {size} bytes, which hold up to {count} triangles")
    with path.open("rb") as file:
        if path.suffix.lower() == ".ply":
            _check_ply(file, size)
        elif path.suffix.lower() == ".glb":
            _check_glb(file, size, path)
        elif path.suffix.lower() == ".stl":
            _check_stl(file, size)


def _check_stl(file: BinaryIO, size: int) -> None:
    head = file.read(84)
    if head.lstrip().lower().startswith(b"solid"):  # text; trimesh compares the size of a binary file that starts so
        return
    (count,) = struct.unpack_from("<I", head.ljust(84, b"\0"), 80)
    expected = 84 + count * _TRIANGLE_BYTES
    if size != expected:
        raise ValueError(f"it has {size} bytes, its header claims {count} triangles and so {expected} bytes")


def _check_ply(file: BinaryIO, size: int) -> None:
    header = file.read(_LONGEST_HEADER)
    end = re.search(rb"end_header\r?\n", header)
    if end is None:
        raise ValueError("the header does not end")
    is_text = b"format ascii" in header[: end.start()]
    least = 0
    count = 0
    for line in header[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3:
            count = int(words[2])
            if count < 0:
                raise ValueError(f"its header claims {count} elements")
        elif words[:1] == ["property"] and len(words) >= 3:
            # Of a list at least its length is stored; a number in text takes a digit and a space.
            least += count * (2 if is_text else _PLY_SIZES.get(words[2] if words[1] == "list" else words[1], 1))
    if least > size - end.end() + 1:
        raise ValueError(f"it has {size} bytes, its header claims {end.end() + least} bytes or more")


def _check_glb(file: BinaryIO, size: int, path: Path) -> None:
    head = file.read(_GLB_HEADER.size)
    if len(head) < _GLB_HEADER.size:
        raise ValueError(f"it has {size} bytes, expected a GLB file")
    magic, version, _, length, _ = _GLB_HEADER.unpack(head)
    if magic != b"glTF" or version != 2 or length > size:
        raise ValueError("expected a GLB file of glTF 2")
    tree = json.loads(file.read(length))
    for buffer in tree.get("buffers", ()):
        if "uri" in buffer:
            raise ValueError("it refers to another file, expected a GLB file that holds its data")
    accessors = tree.get("accessors", ())
    empty = sum(_count(each) for each in accessors if "bufferView" not in each)
    MAX_TRIANGLES.check(empty, f"{path}: claims {empty:.0f} numbers that it does not hold")
    meshes = [sum(_triangles(each, accessors) for each in mesh["primitives"]) for mesh in tree.get("meshes", ())]
    triangles = sum(meshes[each["mesh"]] for each in tree.get("nodes", ()) if "mesh" in each)
    MAX_TRIANGLES.check(triangles, f"{path}: {triangles:.0f} triangles in all instances")


def _count(accessor: Mapping[str, Any]) -> float:
    count = accessor["count"]
    return count if isinstance(count, int) and count >= 0 else math.nan


def _triangles(primitive: Mapping[str, Any], accessors: Any) -> float:
    """Return the number of triangles of a primitive, as a list of triangles or as a strip."""
    corners = primitive.get("indices", primitive["attributes"].get("POSITION"))
    count = 0.0 if corners is None else _count(accessors[corners])
    return count / 3 if primitive.get("mode", 4) == 4 else count
