"""Sizes of compressed TIFF segments, before they are decoded."""

from __future__ import annotations

import io
import lzma
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile

from gpuvision.host import tiff_files
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_files import read_image
from gpuvision.host.tiff_files import _unpacks_beyond, check_tiff_page, open_stack

PACKBITS, DEFLATE, LZMA = 32773, 8, 34925


def packed_bits(rng: np.random.Generator, parts: int) -> tuple[bytes, int]:
    """Return a PackBits segment of literals, runs and no-operations, and the number of bytes that it unpacks to."""
    packed, size = bytearray(), 0
    for _ in range(parts):
        kind, count = rng.integers(0, 3), int(rng.integers(2, 129))
        if kind == 0:
            packed += bytes([count - 1]) + rng.bytes(count)
        elif kind == 1:
            packed += bytes([257 - count]) + rng.bytes(1)
        else:
            packed += bytes([128])
        size += count if kind < 2 else 0
    return bytes(packed), size


def test_packbits_segments(rng: np.random.Generator) -> None:
    """A byte of a literal that is read as a control would change the sum."""
    for parts in range(1, 40):
        packed, size = packed_bits(rng, parts)
        assert not _unpacks_beyond(packed, PACKBITS, size)
        assert size == 0 or _unpacks_beyond(packed, PACKBITS, size - 1)
    # A literal of one byte, a run of 128, a run of 2.
    for packed, size in ((b"\x00a", 1), (b"\x81a", 128), (b"\xffa", 2), (b"\x7f" + 128 * b"a", 128), (b"\x80", 0)):
        assert not _unpacks_beyond(packed, PACKBITS, size)
        assert size == 0 or _unpacks_beyond(packed, PACKBITS, size - 1)


@pytest.mark.parametrize(("compression", "compress"), [(DEFLATE, zlib.compress), (LZMA, lzma.compress)])
@pytest.mark.parametrize("size", [1, 1000, 3_000_000])
def test_other_segments(compression: int, compress: Any, size: int) -> None:
    packed = compress(bytes(size))
    assert not _unpacks_beyond(packed, compression, size)
    assert _unpacks_beyond(packed, compression, size - 1)
    # A segment that is cut unpacks to less.
    assert not _unpacks_beyond(packed[: len(packed) // 2], compression, size)


def test_unpacking_ends_at_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """A segment of many chunks is not unpacked to its end, and a decoder that gives nothing is not asked again."""
    chunk = tiff_files._CHUNK
    asked: list[int] = []

    class Unpacker:
        eof, unconsumed_tail, empty = False, b"rest", False

        def decompress(self, packed: bytes, most: int) -> bytes:
            asked.append(most)
            return b"" if self.empty else bytes(most)

    monkeypatch.setattr(tiff_files.zlib, "decompressobj", Unpacker)
    assert _unpacks_beyond(b"packed", DEFLATE, 3 * chunk)
    assert asked == [chunk] * 4
    asked.clear()
    Unpacker.empty = True
    assert not _unpacks_beyond(b"packed", DEFLATE, 3 * chunk)
    assert asked == [chunk]


def test_pages_whose_segments_unpack_to_too_much_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip may unpack to twice its pixels, and small segments always."""
    strip = zlib.compress(bytes(70_000))
    file = io.BytesIO(b"head" + strip)

    def page(rows: int, columns: int, **changes: Any) -> Any:
        values = {
            "dtype": np.dtype(np.uint16),
            "shape": (rows, columns),
            "chunks": (rows, columns),
            "compression": DEFLATE,
            "dataoffsets": (0, 4),
            "databytecounts": (1, len(strip)),
            "parent": SimpleNamespace(filehandle=file),
        }
        return SimpleNamespace(**(values | changes))

    monkeypatch.setattr(tiff_files, "_SMALL_SEGMENT", 1000)
    check_tiff_page(page(100, 175), "page")  # 2 x 35 000 bytes
    with pytest.raises(RecordingError, match="page: a segment unpacks to more than the 69600 bytes expected"):
        check_tiff_page(page(100, 174), "page")
    with pytest.raises(RecordingError, match="more than the 2000 bytes"):
        check_tiff_page(page(100, 175, chunks=(10, 50)), "page")
    check_tiff_page(page(100, 175, chunks=(10, 50), compression=5), "page")  # not counted
    monkeypatch.setattr(tiff_files, "_SMALL_SEGMENT", 70_000)
    check_tiff_page(page(10, 17), "page")
    with pytest.raises(RecordingError, match="page: pixels of an unknown type"):
        check_tiff_page(page(10, 10, dtype=None), "page")


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_pages_are_frames(tmp_path: Path, rng: np.random.Generator, channels: int, compression: Any) -> None:
    """Grey pages, and the green channel of pages in red, green and blue."""
    pages = rng.integers(0, 60_000, (4, 5, 7, 3)).astype(np.uint16)
    with tifffile.TiffWriter(tmp_path / "stack.tif") as file:
        for page in pages:
            file.write(
                page if channels == 3 else page[..., 1],
                photometric="rgb" if channels == 3 else "minisblack",
                compression=compression,
                contiguous=False,
            )
    source = open_stack(tmp_path / "stack.tif", "green" if channels == 3 else "grey")
    assert (source.shape, source.dtype, source.length) == ((5, 7), np.uint16, 4)
    frames, arrived = np.zeros((6, 5, 7), np.uint16), np.zeros(6, np.int64)
    count = 0
    while source.wait() and (read := source.read_into(frames[count:], arrived[count:])):
        count += read
    source.close()
    assert count == 4
    np.testing.assert_array_equal(frames[:4], pages[..., 1])


@pytest.mark.parametrize("contiguous", [True, False])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("photometric", ["miniswhite", "cielab"])
def test_inverted_grey_levels_are_refused(tmp_path: Path, photometric: str, dtype: Any, contiguous: bool) -> None:
    """The numbers as stored would be taken for light: both as mapped planes and as pages."""
    pages = np.zeros((2, 16, 16, 3), dtype) if photometric == "cielab" else np.zeros((2, 16, 16), dtype)
    with tifffile.TiffWriter(tmp_path / "stack.tif") as file:
        for page in pages:
            file.write(page, photometric=photometric, contiguous=contiguous)
    message = f"page 0: its photometric interpretation is {photometric.upper()}, expected MINISBLACK or RGB"
    with pytest.raises(RecordingError, match=message):
        open_stack(tmp_path / "stack.tif", "grey")


def test_interpretation_of_a_later_page(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "stack.tif") as file:
        for photometric in ("minisblack", "miniswhite"):
            file.write(np.zeros((16, 16), np.uint8), photometric=photometric, contiguous=False)
    source = open_stack(tmp_path / "stack.tif", "grey")
    frames, arrived = np.zeros((1, 16, 16), np.uint8), np.zeros(1, np.int64)
    assert source.read_into(frames, arrived) == 1
    with pytest.raises(RecordingError, match="page 1: its photometric interpretation is MINISWHITE"):
        source.read_into(frames, arrived)


def test_images_with_inverted_grey_levels(tmp_path: Path, rng: np.random.Generator) -> None:
    """OpenCV inverts 8 bits, which TIFF 6.0, section 3, defines as 255 less the number; not 16 bits."""
    stored = rng.integers(0, 256, (16, 16)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "8.tif", stored, photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "8.tif"), 255 - stored)
    for dtype in (np.uint16, np.float32):
        tifffile.imwrite(tmp_path / "16.tif", stored.astype(dtype), photometric="miniswhite")
        with pytest.raises(RecordingError, match=r"16\.tif: its photometric interpretation is MINISWHITE"):
            read_image(tmp_path / "16.tif")
