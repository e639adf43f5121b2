"""Files that claim more than they hold, in a process with limited memory and time."""

from __future__ import annotations

import lzma
import os
import re
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from boards import LAYERS, board_folder
from gpuvision.host import GpuVisionError
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.sensor.sensor import Sensor

_MEMORY = 2 << 30  # bytes
_SECONDS = 20
# One process reads all files of a kind: imports take longer than the refusals. It prints a line for each file with the
# processor time [s] and the outcome, and at the end its largest resident memory [KiB]. The peak that resource.getrusage
# gives starts at the memory of the parent; VmHWM starts anew with the program.
_RUNNER = """
import resource, sys, time
from pathlib import Path
from gpuvision.cli.main import one_line
resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}))
for path in map(Path, sys.argv[1:]):
    start = time.process_time()
    try:
        {statement}
        outcome = "accepted"
    except Exception as error:
        outcome = f"{{type(error).__name__}} {{one_line(error)}}"
    print(round(time.process_time() - start, 2), outcome)
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
_READ_RECORDING = """
        from gpuvision.host import open_recording
        import numpy
        source = open_recording(path)
        out = numpy.empty((1, *source.shape), source.dtype)
        while source.wait():
            source.read_into(out, numpy.zeros(1, numpy.int64))
"""
_READ_IMAGE = "from gpuvision.host.image_files import read_image; read_image(path)"
_READ_BOARD = f"from gpuvision.matching.artwork.artwork import read_artwork; read_artwork(path, layers={LAYERS!r})"
_READ_TOML = "from gpuvision.sensor.sensor import Sensor; Sensor.load(path)"
_READ_MESH = "from gpuvision.simulation.scene.scene import Scene; Scene.load(path)"
_READ_NPZ = "from gpuvision.formats.range_image import read_npz; read_npz(path)"


def run(statement: str, *paths: Path) -> tuple[list[str], int]:
    """Return the outcomes of a statement that reads each path, and the peak memory [bytes] of its process."""
    # Addresses are reserved beyond the memory in use: by threads, and by files that are mapped.
    code = _RUNNER.format(memory=2 * _MEMORY, statement=statement.strip())
    command = [sys.executable, "-c", code, *map(os.fspath, paths)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=10 * _SECONDS * len(paths))
    assert ran.returncode == 0, f"{ran.returncode}: {ran.stderr[-2000:]}"
    assert ran.stderr == ""
    *lines, peak = ran.stdout.splitlines()
    outcomes = [line.partition(" ") for line in lines]
    assert len(outcomes) == len(paths)
    assert max(float(seconds) for seconds, _, _ in outcomes) < _SECONDS
    return [outcome for _, _, outcome in outcomes], 1024 * int(peak)


def board(folder: Path, copper: str) -> Path:
    """Write a board of three files with more copper."""
    board_folder(folder)
    path = folder / "copper.gbr"
    path.write_text(path.read_text().replace("M02*", f"{copper}M02*"))
    return folder


def step_repeat(folder: Path) -> Path:
    return board(folder, "%SRX100000Y100000I0.1J0.1*%\nD11*\nX0Y0D03*\n%SR*%\n")


def many_copies(folder: Path) -> Path:
    """Copies that would take more than a minute and 1 GB."""
    return board(folder, "%SRX1000Y1000I0.1J0.1*%\nD11*\nX0Y0D03*\n%SR*%\n")


def large_aperture(folder: Path) -> Path:
    return board(folder, "%ADD50C,100000000*%\nD50*\nX0Y0D03*\nX5000000Y0D01*\n")


def distant_pad(folder: Path) -> Path:
    return board(folder, "D11*\nX1000000000000Y0D03*\n")


def endless_aperture(folder: Path) -> Path:
    return board(folder, "%ADD50C,1e300*%\nD50*\nX0Y0D03*\n")


def polygon(folder: Path) -> Path:
    return board(folder, "%ADD50P,1X1000000000*%\nD50*\nX0Y0D03*\n")


def macro_polygon(folder: Path) -> Path:
    return board(folder, "%AMMACRO*5,1,$1x1000000,0,0,1,0*%\n%ADD50MACRO,1000*%\nD50*\nX0Y0D03*\n")


def macro_text(folder: Path) -> Path:
    return board(folder, '%AMMACRO*1,1,"a"x9999999999,0,0*%\n%ADD50MACRO*%\nD50*\nX0Y0D03*\n')


def long_number(folder: Path) -> Path:
    return board(folder, f"%OFA{'1' * 200_000}Q*%\n")


def no_command(folder: Path) -> Path:
    return board(folder, "x" * 200_000 + "%LPD*%\n")


def repeated_holes(folder: Path) -> Path:
    board_folder(folder)
    (folder / "outline.gbr").write_text("M48\nMETRIC,LZ\nT1C0.5\n%\nT1\nX01.0Y01.0\nR1000000000X0.1\nM30\n")
    return folder


def binary_gerber(folder: Path) -> Path:
    board_folder(folder)
    (folder / "copper.gbr").write_bytes(bytes(range(256)) * 4000)
    return folder


def _claim(path: Path, size: int) -> Path:
    """Let the last member of an archive claim a size: nothing of that size is packed."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("more.npy", bytes(100))
        archive.infolist()[-1].file_size = size
    return path


def large_zip(folder: Path) -> Path:
    path = folder / "board.zip"
    board_folder(folder)
    with zipfile.ZipFile(path, "w") as archive:
        for name in LAYERS:
            archive.write(folder / name, name)
    return _claim(path, 3_000_000_000)


def many_files(folder: Path) -> Path:
    path = folder / "board.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(2000):
            archive.writestr(f"{number}.gbr", "")
    return path


def bad_zip(folder: Path) -> Path:
    path = folder / "board.zip"
    path.write_bytes(b"PK\x03\x04" + b"no zip" * 100)
    return path


def zeros_npz(folder: Path, frames: int = 100) -> Path:
    """A gigabyte of zeros: 100 frames of 10 MB."""
    path = folder / "zeros.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("frames.npy", "w", force_zip64=True) as member,
    ):
        shape = (frames, 2500, 4000)
        np.lib.format.write_array_header_1_0(member, {"descr": "|u1", "fortran_order": False, "shape": shape})
        for _ in range(frames):
            member.write(bytes(2500 * 4000))
    return path


def large_npz(folder: Path) -> Path:
    path = folder / "large.npz"
    np.savez(path, z=np.zeros(3))
    return _claim(path, 3_000_000_000)


def false_npz(folder: Path) -> Path:
    """An array whose header claims 8 TB."""
    path = folder / "false.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("frames.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": (1000, 10**4, 10**5)}
        )
    return path


def dotted_toml(folder: Path) -> Path:
    path = folder / "sensor.toml"
    path.write_text("a." * 50_000 + "a = 1\n")
    return path


def bracket_toml(folder: Path) -> Path:
    path = folder / "sensor.toml"
    path.write_text("x = " + "[" * 100_000 + "\n")
    return path


def digit_toml(folder: Path) -> Path:
    path = folder / "sensor.toml"
    path.write_text(f"kind = 0x{'f' * 10_000}\n")
    return path


def long_toml(folder: Path) -> Path:
    path = folder / "sensor.toml"
    with path.open("wb") as file:
        file.truncate(1 << 32)  # sparse
    return path


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png(path: Path, columns: int, rows: int) -> Path:
    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    data = _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(b"\0" * 100)) + _chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    return path


def large_png(folder: Path) -> Path:
    return _png(folder / "large.png", 60_000, 60_000)


def large_png_folder(folder: Path) -> Path:
    _png(folder / "1.png", 60_000, 60_000)
    return folder


def large_jpeg(folder: Path) -> Path:
    path = folder / "large.jpg"
    frame = b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, 32_000, 32_000, 3) + b"\x01\x11\0\x02\x11\1\x03\x11\1"
    path.write_bytes(b"\xff\xd8" + frame + b"\xff\xda\x00\x0c" + bytes(10) + b"\xff\xd9")
    return path


def large_pgm(folder: Path) -> Path:
    path = folder / "large.pgm"
    path.write_bytes(b"P5\n# a comment\n100000 100000\n255\n" + bytes(100))
    return path


def large_bmp(folder: Path) -> Path:
    path = folder / "large.bmp"
    path.write_bytes(b"BM" + bytes(8) + struct.pack("<IIiiHH", 54, 40, 60_000, -60_000, 1, 24) + bytes(100))
    return path


def _tiff(path: Path, columns: int, rows: int, compression: int, strip: bytes) -> Path:
    tags = {256: columns, 257: rows, 258: 8, 259: compression, 262: 1, 273: 134, 277: 1, 278: rows, 279: len(strip)}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + bytes(4)
    path.write_bytes(head.ljust(134, b"\0") + strip)
    return path


def large_tiff(folder: Path) -> Path:
    return _tiff(folder / "large.tif", 60_000, 60_000, 1, bytes(100))


def unpacking_tiff(folder: Path) -> Path:
    """A page of 10 000 pixels whose strip unpacks to 3 GB."""
    packer = zlib.compressobj(9)
    start = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    # After a full flush the same bytes unpack to the same block again.
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    packed = start + 191 * block
    return _tiff(folder / "packed.tif", 100, 100, 8, packed)


def packbits_tiff(folder: Path) -> Path:
    """A page of 10 000 pixels whose strip unpacks to 3 GB."""
    return _tiff(folder / "packbits.tif", 100, 100, 32773, b"\x81\0" * 24_000_000)


def lzma_tiff(folder: Path) -> Path:
    """A page of 10 000 pixels whose strip unpacks to 150 MB."""
    return _tiff(folder / "lzma.tif", 100, 100, 34925, lzma.compress(bytes(150_000_000), preset=0))


def claiming_avi(folder: Path) -> Path:
    """A text in the header of a video claims 808 MB; found by fuzzing."""
    path = folder / "video.avi"
    content = (Path(__file__).parents[1] / "fuzz" / "seeds" / "frames.avi").read_bytes()
    at = content.index(b"ISFT") + 4
    path.write_bytes(content[:at] + struct.pack("<I", 0x30303030) + content[at + 4 :])
    return path


def claiming_stl(folder: Path) -> Path:
    path = folder / "part.stl"
    path.write_bytes(bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(500))
    return path


def claiming_ply(folder: Path) -> Path:
    path = folder / "part.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 20000000000\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.encode() + bytes(200))
    return path


def claiming_glb(folder: Path) -> Path:
    """A mesh of numbers that the file does not hold, in ten thousand instances."""
    path = folder / "part.glb"
    text = (
        '{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":['
        + ",".join(['{"mesh":0}'] * 10_000)
        + '],"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],"accessors":['
        '{"componentType":5126,"count":300000,"type":"VEC3"},{"componentType":5125,"count":300000,"type":"SCALAR"}]}'
    ).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    return path


_LIMIT = r"set GPUVISION_MAX_\w+ to change this limit"
_BAD: dict[str, tuple[str, list[tuple[Callable[[Path], Path], str]]]] = {
    "board": (
        _READ_BOARD,
        [
            (step_repeat, rf"copper.gbr: a step-and-repeat of 10000000000 copies, .* 100000; {_LIMIT}"),
            (many_copies, rf"copper.gbr: a step-and-repeat of 1000000 copies, .* 100000; {_LIMIT}"),
            (distant_pad, rf"copper.gbr: .* an object that extends to 10\d\d m, expected at most 2; {_LIMIT}"),
            (endless_aperture, "copper.gbr: .* radius of 5e.296 m, which is too large for a board"),
            (polygon, "copper.gbr: a polygon aperture of 1000000000 corners, expected 3 to 12"),
            (macro_polygon, "copper.gbr: .* aperture macro MACRO: a polygon of more than 1000 corners"),
            (macro_text, "copper.gbr: an aperture macro with .*, expected numbers and variables"),
            (long_number, "copper.gbr: a number of more than 100 digits"),
            (no_command, "copper.gbr: .* characters or more that are no command, expected Gerber"),
            (repeated_holes, rf"outline.gbr: 1000000008 holes, expected at most 100000; {_LIMIT}"),
            (binary_gerber, "not a readable board: .*codec can't decode"),
            (large_zip, rf"board.zip: unpacks to \d{{10}} bytes, expected at most 2147483648; {_LIMIT}"),
            (many_files, rf"board.zip: 2000 files, expected at most 1000; {_LIMIT}"),
            (bad_zip, "board.zip: not a readable ZIP of Gerber files: File is not a zip file"),
        ],
    ),
    "recording": (
        _READ_RECORDING,
        [
            (false_npz, rf"false.npz: a frame: 100000 x 10000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_png_folder, rf"1.png: 60000 x 60000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_tiff, rf"large.tif, page 0: 60000 x 60000 pixels, expected at most 268435456; {_LIMIT}"),
            (unpacking_tiff, "packed.tif, page 0: a segment unpacks to more than the 67108864 bytes"),
            (packbits_tiff, "packbits.tif, page 0: a segment unpacks to more than the 67108864 bytes"),
            (claiming_avi, "video.avi: not a readable video: a chunk claims 808464432 bytes, which go beyond the end"),
            (lzma_tiff, "lzma.tif, page 0: a segment unpacks to more than the 67108864 bytes"),
        ],
    ),
    "result": (
        _READ_NPZ,
        [
            (large_npz, rf"large.npz: unpacks to 30000\d{{5}} bytes, expected at most 2147483648; {_LIMIT}"),
        ],
    ),
    "description": (
        _READ_TOML,
        [
            (dotted_toml, rf"sensor.toml: a key of 50001 parts, expected at most 32; {_LIMIT}"),
            (bracket_toml, rf"sensor.toml: nested 100000 deep, expected at most 32; {_LIMIT}"),
            (digit_toml, "sensor.toml: kind is a number of 40000 bits, expected one of"),
            (long_toml, rf"sensor.toml: 1048577 bytes, expected at most 1048576; {_LIMIT}"),
        ],
    ),
    "image": (
        _READ_IMAGE,
        [
            (large_png, rf"large.png: 60000 x 60000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_jpeg, rf"large.jpg: 32000 x 32000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_pgm, rf"large.pgm: 100000 x 100000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_bmp, rf"large.bmp: 60000 x 60000 pixels, expected at most 268435456; {_LIMIT}"),
            (large_tiff, rf"large.tif: 60000 x 60000 pixels, expected at most 268435456; {_LIMIT}"),
        ],
    ),
    "mesh": (
        _READ_MESH,
        [
            (claiming_stl, "part.stl: not a readable mesh: it has 584 bytes, its header claims 4294967295 tri"),
            (claiming_ply, "part.ply: not a readable mesh: it has 379 bytes, its header claims 240000000180 bytes"),
            (claiming_glb, rf"part.glb: 1000000000 triangles in all instances, expected at most 20000000; {_LIMIT}"),
        ],
    ),
}


@pytest.mark.parametrize("kind", _BAD)
def test_bad_files_are_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    statement, cases = _BAD[kind]
    paths = []
    for number, (make, _) in enumerate(cases):
        (tmp_path / str(number)).mkdir()
        paths.append(make(tmp_path / str(number)))
    outcomes, peak = run(statement, *paths)
    for (_, message), outcome in zip(cases, outcomes, strict=True):
        assert re.search(message, outcome), outcome
    assert peak < _MEMORY / 4  # nothing large was held


@pytest.mark.slow
def test_a_recording_is_unpacked_frame_by_frame(tmp_path: Path) -> None:
    """An archive of a gigabyte of zeros is a good recording, and needs memory for one frame of 10 MB."""
    outcomes, peak = run(_READ_RECORDING, zeros_npz(tmp_path))
    assert outcomes == ["accepted"]
    assert peak < _MEMORY / 4


def test_pads_that_cover_each_other_end_the_search_for_edges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of 400 pads lies in the boxes of up to 400 others: the comparisons grow with the square of the number."""
    folder = board(tmp_path, "%SRX20Y20I0.01J0.01*%\nD11*\nX0Y0D03*\n%SR*%\n")
    monkeypatch.setenv("GPUVISION_MAX_BOARD_COMPARISONS", "1e6")
    message = rf"cover each other. Their visible edges take \d{{7}} comparisons .* at most 1000000; {_LIMIT}"
    with pytest.raises(GpuVisionError, match=message):
        read_artwork(folder, layers=LAYERS)


@pytest.mark.nightly
def test_a_crowded_board_is_refused_in_time(tmp_path: Path) -> None:
    """The largest allowed number of copies, all upon each other."""
    outcomes, peak = run(_READ_BOARD, board(tmp_path, "%SRX200Y200I0.01J0.01*%\nD11*\nX0Y0D03*\n%SR*%\n"))
    assert re.search(rf"Their visible edges take \d+ comparisons .* {_LIMIT}", outcomes[0]), outcomes
    assert peak < _MEMORY


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("39", "nested 40 deep, expected at most 39"),
        ("40", "key 'kind' is missing"),
        ("zero", "GPUVISION_MAX_NESTING is 'zero', expected a number above 0"),
    ],
)
def test_a_limit_can_be_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, message: str) -> None:
    monkeypatch.setenv("GPUVISION_MAX_NESTING", value)
    path = tmp_path / "sensor.toml"
    path.write_text("x = " + "[" * 40 + "]" * 40 + "\n")
    with pytest.raises(GpuVisionError, match=message):
        Sensor.load(path)
