"""Sizes that the headers of mesh files claim, byte by byte."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from gpuvision.host.errors import ReadError
from gpuvision.simulation.scene.mesh_file import check_mesh

SIZES = {
    1: ("char", "uchar", "int8", "uint8"),
    2: ("short", "ushort", "int16", "uint16"),
    4: ("int", "uint", "int32", "uint32", "float", "float32"),
    8: ("double", "float64"),
}


def ply(properties: str, count: int = 3, kind: str = "binary_little_endian") -> bytes:
    """Return the header of a PLY file."""
    return f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}end_header\n".encode()


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("size", SIZES)
def test_a_ply_file_holds_its_numbers(tmp_path: Path, size: int) -> None:
    """One byte less than the header claims and a line end is refused, for each type, alone and as length of a list."""
    for name in SIZES[size]:
        for properties in (f"property {name} x\n", f"property list {name} int vertex_indices\n"):
            header = ply(properties)
            least = 3 * size
            check_mesh(write(tmp_path / "a.ply", header + bytes(least - 1)))
            claimed = f"it has {len(header) + least - 2} bytes, its header claims {len(header) + least} bytes or more"
            with pytest.raises(ValueError, match=claimed):
                check_mesh(write(tmp_path / "a.ply", header + bytes(least - 2)))


def test_properties_of_elements_add_up(tmp_path: Path) -> None:
    """Each property counts for the elements before it; numbers in text take two bytes, unknown types one."""
    two = "property float x\nproperty double y\nelement face 2\nproperty list uchar int i\nproperty odd z\n"
    for kind, least in (("binary_big_endian", 5 * 12 + 2 * 2), ("ascii", 2 * (5 * 2 + 2 * 2))):
        header = ply(two, 5, kind)
        check_mesh(write(tmp_path / "a.ply", header + bytes(least - 1)))
        with pytest.raises(ValueError, match=f"claims {len(header) + least} bytes"):
            check_mesh(write(tmp_path / "a.ply", header + bytes(least - 2)))
    crlf = ply("property float x\n").replace(b"\n", b"\r\n")
    check_mesh(write(tmp_path / "a.ply", crlf + bytes(11)))
    with pytest.raises(ValueError, match=f"claims {len(crlf) + 12} bytes"):
        check_mesh(write(tmp_path / "a.ply", crlf + bytes(10)))


def test_other_ply_headers(tmp_path: Path) -> None:
    check_mesh(write(tmp_path / "a.ply", ply("property float x\n", 0)))
    with pytest.raises(ValueError, match="its header claims -1 elements"):
        check_mesh(write(tmp_path / "a.ply", ply("property float x\n", -1)))
    with pytest.raises(ValueError, match="the header does not end"):
        check_mesh(write(tmp_path / "a.ply", ply("").replace(b"end_header", b"end")))


def test_a_binary_stl_file_has_50_bytes_for_each_triangle(tmp_path: Path) -> None:
    head = b"part".ljust(80, b"\0") + struct.pack("<I", 3)
    check_mesh(write(tmp_path / "a.STL", head + bytes(150)))
    for more in (-1, 1):
        message = f"it has {234 + more} bytes, its header claims 3 triangles and so 234 bytes"
        with pytest.raises(ValueError, match=message):
            check_mesh(write(tmp_path / "a.stl", head + bytes(150 + more)))
    check_mesh(write(tmp_path / "a.stl", b"  SOLID part"))
    with pytest.raises(ValueError, match="it has 5 bytes, its header claims 0 triangles and so 84 bytes"):
        check_mesh(write(tmp_path / "a.stl", b"soli\0"))


def test_files_of_many_triangles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A triangle takes 50 bytes or more: as many as the limit are read, one more is not."""
    monkeypatch.setenv("GPUVISION_MAX_TRIANGLES", "3")
    check_mesh(write(tmp_path / "a.obj", bytes(199)))
    with pytest.raises(ReadError, match=r"a\.obj: 200 bytes, which hold up to 4 triangles"):
        check_mesh(write(tmp_path / "a.obj", bytes(200)))


def glb(tree: Any, *, magic: bytes = b"glTF", version: int = 2, more: int = 0) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", magic, version, 20 + len(text), len(text) + more, 0x4E4F534A) + text


def triangles(mode: int | None = None, *, count: int = 30, instances: int = 1, indexed: bool = False) -> Any:
    """Return a tree with one mesh of corners without data, which some nodes show."""
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0}} | ({} if mode is None else {"mode": mode})
    accessors = [{"count": count, "bufferView": 0}]
    if indexed:
        primitive["indices"] = 1
        accessors = [{"count": 4, "bufferView": 0}, {"count": count, "bufferView": 0}]
    nodes = [{"mesh": 0}] * instances + [{"name": "no mesh"}]
    return {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "nodes": nodes}


@pytest.mark.parametrize(
    ("tree", "count"),
    [
        (triangles(), 10),
        (triangles(4), 10),
        (triangles(5), 30),
        (triangles(instances=3), 30),
        (triangles(indexed=True, count=60), 20),
        ({"meshes": [{"primitives": [{"attributes": {}}]}], "nodes": [{"mesh": 0}]}, 0),
        ({}, 0),
    ],
)
def test_instances_of_triangles_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tree: Any, count: int
) -> None:
    path = write(tmp_path / "a.glb", glb(tree))
    monkeypatch.setenv("GPUVISION_MAX_TRIANGLES", str(max(count, path.stat().st_size // 50, 1)))
    check_mesh(path)
    if count > path.stat().st_size // 50:
        monkeypatch.setenv("GPUVISION_MAX_TRIANGLES", str(count - 1))
        with pytest.raises(ReadError, match=rf"a\.glb: {count} triangles in all instances"):
            check_mesh(path)


def test_numbers_that_a_glb_file_does_not_hold_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_TRIANGLES", "500")
    check_mesh(
        write(tmp_path / "a.glb", glb({"accessors": [{"count": 499}, {"count": 1}, {"count": 900, "bufferView": 0}]}))
    )
    for wrong, message in ((501, "claims 501 numbers that it does not hold"), (-1, "nan"), (2.5, "nan")):
        with pytest.raises(ReadError, match=message):
            check_mesh(write(tmp_path / "a.glb", glb({"accessors": [{"count": wrong}]})))


def test_other_glb_files_are_refused(tmp_path: Path) -> None:
    check_mesh(write(tmp_path / "a.glb", glb({"buffers": [{"byteLength": 3}]})))
    with pytest.raises(ValueError, match="refers to another file"):
        check_mesh(write(tmp_path / "a.glb", glb({"buffers": [{"byteLength": 3}, {"uri": "a.bin"}]})))
    for content in (glb({}, magic=b"glTG"), glb({}, version=1), glb({}, version=3), glb({}, more=21)):
        with pytest.raises(ValueError, match=r"expected a GLB file of glTF 2"):
            check_mesh(write(tmp_path / "a.glb", content))
    with pytest.raises(ValueError, match="it has 19 bytes, expected a GLB file"):
        check_mesh(write(tmp_path / "a.glb", glb({})[:19]))
