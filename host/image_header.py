"""Size of an image from the header of its file, before the image is decoded."""

from __future__ import annotations

import os
import re
import struct
from typing import BinaryIO

_PNG = b"\x89PNG\r\n\x1a\n"
_PNM = re.compile(rb"P[1-6]\s(?:\s*#[^\n]*\n)*\s*(\d{1,10})\s+(?:#[^\n]*\n\s*)*(\d{1,10})\s")
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# JPEG markers SOF0 to SOF15 start a frame and hold its size; C4, C8 and CC are other segments (ITU-T T.81, table B.1).
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_HEAD_BYTES = 4096
_JPEG_END = b"\xff\xd9"
_MOST_SEGMENTS = 10_000  # of a JPEG file before its frame; cameras write fewer than 100


def is_tiff(head: bytes) -> bool:
    """Return whether a file starts as a TIFF file."""
    return head.startswith(_TIFF)


def image_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return rows and columns of an image; None for other formats than PNG, BMP, JPEG, PNM and WebP.

    Parameters
    ----------
    file : binary file
        Open at the start of the image.

    Raises
    ------
    ValueError
        The file is truncated.
    """
    head = file.read(_HEAD_BYTES)
    if head.startswith(_PNG) and len(head) >= 24:
        _check_png(file)
        columns, rows = struct.unpack_from(">II", head, 16)
        return rows, columns
    if head.startswith(b"BM") and len(head) >= 26:
        columns, rows = struct.unpack_from("<HH" if head[14] == 12 else "<ii", head, 18)
        return abs(rows), abs(columns)
    if head.startswith(b"\xff\xd8"):
        return _jpeg_size(file)
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return _webp_size(head)
    if found := _PNM.match(head):
        return int(found[2]), int(found[1])
    return None


def _check_png(file: BinaryIO) -> None:
    """Check that each chunk of a PNG file lies in the file: decoders allocate the length that a chunk claims."""
    size = file.seek(0, os.SEEK_END)
    at, kind = len(_PNG), b""
    while kind != b"IEND":
        file.seek(at)
        chunk = file.read(8)
        if len(chunk) < 8:
            raise ValueError("it is truncated: there is no end chunk")
        length, kind = int.from_bytes(chunk[:4]), chunk[4:]
        at += length + 12
        if at > size:
            raise ValueError(f"a chunk claims {length} bytes, which go beyond the end of the file")


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return the size in the first frame header of a JPEG file; refuse a file without the end of its image."""
    file.seek(2)
    for _ in range(_MOST_SEGMENTS):
        segment = file.read(4)
        if len(segment) < 4 or segment[0] != 0xFF:
            return None
        if segment[1] == 0xFF:  # fill byte before a marker
            file.seek(-3, 1)
        elif segment[1] in _FRAMES:
            frame = file.read(5)
            # In compressed data a byte 0xFF is never followed by 0xD9, so the pair ends the image. Without it decoders
            # fill the missing rows with grey.
            if _JPEG_END not in file.read():
                raise ValueError("it is truncated: there is no end-of-image marker")
            return struct.unpack(">xHH", frame) if len(frame) == 5 else None
        else:
            (length,) = struct.unpack_from(">H", segment, 2)
            file.seek(max(length - 2, 0), 1)
    return None


def _webp_size(head: bytes) -> tuple[int, int] | None:
    """Return the size of a WebP image: lossy, lossless or extended (RFC 9649, section 2)."""
    kind = head[12:16]
    if kind == b"VP8 " and len(head) >= 30:
        columns, rows = struct.unpack_from("<HH", head, 26)
        return rows & 0x3FFF, columns & 0x3FFF
    if kind == b"VP8L" and len(head) >= 25:
        (bits,) = struct.unpack_from("<I", head, 21)
        return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1
    if kind == b"VP8X" and len(head) >= 30:
        columns, rows = (int.from_bytes(head[at : at + 3], "little") + 1 for at in (24, 27))
        return rows, columns
    return None
