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


def size_of(data: bytes) -> tuple[int, int] | None:
    return image_size(io.BytesIO(data))


SHORTEST = {
    "BMP": (b"BM" + bytes(12) + struct.pack("<IHHHH", 12, 40_000, 50_000, 1, 24)[:12], (50_000, 40_000)),
    "BMP from the top, mirrored": (b"BM" + bytes(12) + struct.pack("<Iii", 40, -51, -37), (37, 51)),
    # Two bits above the 14 of each size state how to scale the picture.
    "WebP, lossy": (b"RIFF\0\0\0\0WEBPVP8 " + bytes(10) + struct.pack("<HH", 0x7FFF, 0xBFFE), (0x3FFE, 0x3FFF)),
    "WebP, lossless": (b"RIFF\0\0\0\0WEBPVP8L" + bytes(5) + struct.pack("<I", 0xCFFFBFFE), (0x3FFE + 1, 0x3FFE + 1)),
    "WebP, extended": (b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + bytes([1, 2, 3, 4, 5, 6]), (0x060504 + 1, 0x030201 + 1)),
}


@pytest.mark.parametrize("name", SHORTEST)
def test_the_shortest_header_with_a_size(name: str) -> None:
    """The fields lie where the formats say; a header that is one byte shorter has no size."""
    data, size = SHORTEST[name]
    assert size_of(data) == size
    assert size_of(data + b"more") == size
    assert size_of(data[:-1]) is None


def test_a_webp_of_another_kind_has_no_size() -> None:
    for kind in (b"ALPH", b"VP8A", b"VP8Y", b"ANIM"):
        assert size_of(b"RIFF\0\0\0\0WEBP" + kind + bytes(30)) is None


def test_a_png_without_a_whole_header_has_no_size() -> None:
    png = encoded(".png")
    assert size_of(png[:23]) is None
    with pytest.raises(ValueError, match="go beyond the end of the file"):
        size_of(png[:24])


def test_segments_of_a_jpeg() -> None:
    """A length includes its own two bytes, a smaller one moves nothing; other bytes than 0xFF begin no segment."""
    jpeg = encoded(".jpg")
    start, rest = jpeg[:2], jpeg[2:]
    for segment in (b"\xff\xe1\0\2", b"\xff\xe1\0\5abc", b"\xff\xe1\0\0", b"\xff\xe1\0\1", b"\xff"):
        assert size_of(start + segment + rest) == SHAPE
    for byte in (b"\0", b"\x01", b"\xfe"):
        assert size_of(start + byte + rest[1:]) is None
    segment = b"\xff\xe1\0\2"
    at = jpeg.index(b"\xff\xc0")
    assert size_of(start + segment * 9_999 + jpeg[at:]) == SHAPE
    assert size_of(start + segment * 10_000 + jpeg[at:]) is None
    # Tables of Huffman codes and of arithmetic coding, and JPG itself, are no frames.
    for marker in (0xC4, 0xC8, 0xCC):
        assert size_of(start + bytes([0xFF, marker, 0, 9, 8, 0, 1, 0, 1, 0, 0]) + jpeg[at:]) == SHAPE
    for marker in {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}:
        assert size_of(start + bytes([0xFF, marker]) + jpeg[at + 2 :]) == SHAPE


def test_comments_of_a_pnm() -> None:
    for head in (b"P5 51 37 255\n", b"P2\n# a\n51 37\n", b"P6\n# a\n # b\n51\n# c\n37\n255\n", b"P4\t51\t37\n"):
        assert size_of(head + b"\0") == SHAPE
    for head in (b"P0 51 37 255\n", b"P7 51 37 255\n", b"P5 51", b"P5 a 37 "):
        assert size_of(head) is None
