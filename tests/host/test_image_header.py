"""Sizes of images from the headers of their files, and truncated files."""

from __future__ import annotations

import io
import struct

import cv2
import numpy as np
import pytest

from gpuvision.host.image_header import image_size, is_tiff

SHAPE = (37, 51)
GREY = np.arange(37 * 51, dtype=np.uint32).reshape(SHAPE).astype(np.uint8)


def encoded(suffix: str, image: np.ndarray = GREY) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".pgm", ".webp"])
def test_size_of_every_format(suffix: str) -> None:
    assert image_size(io.BytesIO(encoded(suffix))) == SHAPE


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".ppm", ".webp"])
def test_size_of_colour_images(suffix: str) -> None:
    assert image_size(io.BytesIO(encoded(suffix, np.dstack([GREY] * 3)))) == SHAPE


def test_other_formats_have_no_size() -> None:
    assert image_size(io.BytesIO(encoded(".tiff"))) is None
    assert image_size(io.BytesIO(b"")) is None
    assert is_tiff(encoded(".tiff"))
    assert not is_tiff(encoded(".png"))


def test_a_bitmap_of_the_first_kind_and_one_from_top_to_bottom() -> None:
    core = b"BM" + bytes(12) + struct.pack("<IHHHH", 12, 51, 37, 1, 24) + bytes(8)
    assert image_size(io.BytesIO(core)) == SHAPE
    down = b"BM" + bytes(12) + struct.pack("<Iii", 40, 51, -37) + bytes(30)
    assert image_size(io.BytesIO(down)) == SHAPE


def chunks_of(png: bytes) -> list[int]:
    """Return where each chunk begins, and the end."""
    places = [8]
    while places[-1] < len(png):
        places.append(places[-1] + 12 + int.from_bytes(png[places[-1] : places[-1] + 4]))
    return places


def test_a_truncated_png_is_refused() -> None:
    """At the end of a chunk, and in the first 7 bytes of the next one, there is no end chunk; then a chunk is cut."""
    png = encoded(".png")
    *starts, end = chunks_of(png)
    assert (len(starts) >= 3, end) == (True, len(png))
    for start in starts[1:]:
        for more in range(8):
            with pytest.raises(ValueError, match="it is truncated: there is no end chunk"):
                image_size(io.BytesIO(png[: start + more]))
        length = int.from_bytes(png[start : start + 4])
        for more in (8, 11 + length):
            with pytest.raises(ValueError, match=f"a chunk claims {length} bytes, which go beyond the end of the file"):
                image_size(io.BytesIO(png[: start + more]))
    assert image_size(io.BytesIO(png + b"more")) == SHAPE


def test_a_jpeg_without_its_end_is_refused() -> None:
    """A file that ends before its frame header has no size."""
    jpeg = encoded(".jpg")
    for length in (len(jpeg) - 1, len(jpeg) - 2, len(jpeg) // 2):
        with pytest.raises(ValueError, match="it is truncated: there is no end-of-image marker"):
            image_size(io.BytesIO(jpeg[:length]))
    assert [image_size(io.BytesIO(jpeg[:length])) for length in (3, 5, 21)] == [None, None, None]
    filled = jpeg[:2] + b"\xff\xff" + jpeg[2:]
    assert image_size(io.BytesIO(filled)) == SHAPE


def test_lossless_and_extended_webp() -> None:
    lossless = bytes(cv2.imencode(".webp", np.dstack([GREY] * 3), [cv2.IMWRITE_WEBP_QUALITY, 101])[1])
    assert lossless[12:16] == b"VP8L"
    assert image_size(io.BytesIO(lossless)) == SHAPE
    extended = b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + (50).to_bytes(3, "little") + (69_999).to_bytes(3, "little")
    assert image_size(io.BytesIO(extended)) == (70_000, 51)
    assert image_size(io.BytesIO(extended[:-1])) is None
