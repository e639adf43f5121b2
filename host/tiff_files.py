"""TIFF files as sources, and checks of their pages before they are decoded."""

from __future__ import annotations

import importlib
import logging
import lzma
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from gpuvision.host.arrays import HostArray
from gpuvision.host.channels import Channel, channel_copier
from gpuvision.host.errors import RecordingError
from gpuvision.host.reading import check_frames, check_pixels, reading
from gpuvision.host.sources import ArraySource, FrameSource, Source, check_frame

TIFF_SUFFIXES = (".tif", ".tiff")
_PACKBITS, _LZMA, _ZSTD = 32773, 34925, (34926, 50000)
# Largest ratio of unpacked to packed bytes, by the number of the TIFF compression: Deflate (RFC 1951) stores 258 bytes
# in 2 bits; PackBits 128 bytes in 2; Zstandard (RFC 8878, section 3.1.1.2) a block of 128 KiB in 4. LZMA has no fixed
# bound, 10 000 exceeds measured ones. tifffile decodes all other compressions with imagecodecs, if that is installed,
# into memory of the size of the segment.
_LARGEST_RATIO = {8: 1032, 32946: 1032, 50013: 1032, _PACKBITS: 64, _LZMA: 10_000, **dict.fromkeys(_ZSTD, 1 << 15)}
_SMALL_SEGMENT = 1 << 26  # bytes: smaller segments are not counted before they are decoded
_CHUNK = 1 << 20
# Photometric interpretations whose stored numbers are the grey levels, or red, green and blue: also raw pixels of
# sensors. tifffile converts YCbCr to RGB in JPEG pages only.
_PHOTOMETRIC = tifffile.PHOTOMETRIC
_DIRECT = (_PHOTOMETRIC.MINISBLACK, _PHOTOMETRIC.RGB, _PHOTOMETRIC.CFA, _PHOTOMETRIC.LINEAR_RAW)
_JPEG = 7

# Exceptions name the defect of a file. Messages of tifffile itself appear only where the application sets up logging.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def open_stack(path: Path, channel: Channel) -> Source:
    """Open a TIFF file as frames: map contiguous planes without decoding, else decode page by page.

    Raises
    ------
    RecordingError
        The file is damaged or truncated, a page is too large, or its numbers are not grey levels or colours; see
        `check_photometric`.
    """
    file = open_tiff(path)
    with reading(path, "TIFF file", RecordingError):
        check_photometric(file.pages[0], f"{path}, page 0")
        series = file.series
        planes = len(series) == 1 and series[0].axes.endswith("YX") and set(series[0].axes[:-2]) <= set("TZQI")
        if not (planes and series[0].ndim >= 3 and series[0].dataoffset is not None):
            return TiffStack(path, file, channel)
        check_frames(path, (1, *series[0].shape[-2:]))
        file.close()
    with reading(path, "TIFF file", RecordingError, hint="is it truncated?"):
        # The planes are contiguous in the file, and several planes may share one page.
        stack = tifffile.memmap(path, mode="r")
        return ArraySource(stack.reshape(-1, *stack.shape[-2:]))


def open_tiff(path: Path) -> tifffile.TiffFile:
    """Open a TIFF file and check its chain of pages.

    Raises
    ------
    RecordingError
        The file is damaged or truncated, or has no page.
    """
    with reading(path, "TIFF file", RecordingError):
        file = tifffile.TiffFile(path)
        pages = len(file.pages)
        if pages and not any(_next_page(file)):
            return file
        file.close()
        raise RecordingError(f"{path}: {f'truncated TIFF: no page after number {pages - 1}' if pages else 'no frames'}")


def _next_page(file: tifffile.TiffFile) -> bytes:
    """Return the link after the last page: zeros in a complete file, other bytes where the file is truncated."""
    file.filehandle.seek(file.pages.next_page_offset or 0)
    link: bytes = file.filehandle.read(file.tiff.offsetsize)
    return link


class TiffStack(FrameSource):
    """Pages of a TIFF file, decoded one by one."""

    def __init__(self, path: Path, file: tifffile.TiffFile, channel: Channel) -> None:
        self._path, self._file, self._channel = path, file, channel
        self._next = 0
        first = file.pages[0]
        check_tiff_page(first, f"{path}, page 0")
        self._page_shape, page_dtype = first.shape, np.dtype(first.dtype)
        super().__init__(self._page_shape[:2], page_dtype)
        self.length: int = len(file.pages)
        self._pick = channel_copier(channel, self._page_shape, str(path))

    def _ready(self) -> bool:
        """Return whether a page is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        what = f"{self._path}, page {self._next}"
        with reading(what, "TIFF page", RecordingError):
            page = self._file.pages[self._next]
            check_tiff_page(page, what)
            check_photometric(page, what)
            frame = page.asarray()
        check_frame(frame, self._page_shape, self.dtype, what)
        # The channel order is red, green, blue in TIFF, and blue, green, red in the channel functions.
        self._pick(frame if frame.ndim == 2 else np.ascontiguousarray(frame[:, :, 2::-1]), out)
        self._next += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def check_tiff_page(page: Any, what: str) -> None:
    """Check before decoding the pixels of a TIFF page, and the bytes to which its segments unpack.

    Raises
    ------
    RecordingError
        The page or a tile of it has more pixels than `MAX_PIXELS`, or a segment unpacks to more than its pixels.
    """
    if page.dtype is None:
        raise RecordingError(f"{what}: pixels of an unknown type")
    check_pixels(page.shape, what, RecordingError)
    unit = page.chunks
    check_pixels(unit, f"{what}: a tile or strip", RecordingError)
    expected = max(2 * math.prod(unit) * page.dtype.itemsize, _SMALL_SEGMENT)
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False):
        ratio = _LARGEST_RATIO.get(int(page.compression))
        if ratio is not None and count * ratio > expected:
            page.parent.filehandle.seek(offset)
            if _unpacks_beyond(page.parent.filehandle.read(count), int(page.compression), expected):
                raise RecordingError(f"{what}: a segment unpacks to more than the {expected} bytes expected")


def check_photometric(page: Any, what: str) -> None:
    """Check that the numbers of a TIFF page are grey levels, or red, green and blue.

    Raises
    ------
    RecordingError
        The photometric interpretation is another one, such as inverted grey levels (MinIsWhite) or a palette.
    """
    tag = page.tags.get("PhotometricInterpretation")
    jpeg_colours = page.photometric == _PHOTOMETRIC.YCBCR and page.compression == _JPEG
    if tag is not None and page.photometric not in _DIRECT and not jpeg_colours:
        name = getattr(page.photometric, "name", page.photometric)
        raise RecordingError(
            f"{what}: its photometric interpretation is {name}, expected MINISBLACK or RGB; convert the file"
        )


def _unpacks_beyond(packed: bytes, compression: int, size: int) -> bool:
    """Return whether a compressed segment unpacks to more bytes than a size."""
    if compression == _PACKBITS:
        return _packbits_beyond(packed, size)
    unpacker: Any
    if compression in _ZSTD:
        try:
            unpacker = importlib.import_module("compression.zstd").ZstdDecompressor()
        except ModuleNotFoundError:  # before Python 3.14 tifffile decodes Zstandard only with imagecodecs
            return False
    else:
        unpacker = lzma.LZMADecompressor() if compression == _LZMA else zlib.decompressobj()
    total = 0
    while total <= size and not unpacker.eof:
        part = unpacker.decompress(packed, _CHUNK)
        packed = getattr(unpacker, "unconsumed_tail", b"")  # the other two keep the rest of their input
        if not part:
            break
        total += len(part)
    return total > size


def _packbits_beyond(packed: bytes, size: int) -> bool:
    """Return whether a PackBits segment (TIFF 6.0, section 9) unpacks to more bytes than a size."""
    total = at = 0
    while at < len(packed) and total <= size:
        control = packed[at]
        if control < 128:
            total += control + 1
            at += control + 2
        else:  # 128 is no operation
            total += 257 - control if control > 128 else 0
            at += 2 if control > 128 else 1
    return total > size
