"""Recordings on disk as sources: NPY and NPZ arrays, TIFF stacks, videos, folders of images."""

from __future__ import annotations

import contextlib
import importlib
import logging
import lzma
import math
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import tifffile

from gpuvision.host.arrays import HostArray
from gpuvision.host.damage import is_damaged_jpeg
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_header import image_size, is_tiff
from gpuvision.host.reading import check_archive, check_pixels, reading
from gpuvision.host.sources import ArraySource, FrameSource, Source, check_frame
from gpuvision.host.video_header import check_avi

Channel = Literal["grey", "red", "green", "blue", "max", "red_difference", "green_difference", "blue_difference"]

CHANNELS: tuple[Channel, ...] = get_args(Channel)
_DIFFERENCE = "_difference"
_TIFF, _JPEG = (".tif", ".tiff"), (".jpg", ".jpeg")
_IMAGES = (".png", ".bmp", *_JPEG, ".pgm", ".ppm", ".pnm", ".webp", *_TIFF)
_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".ts")
_NPY, _ZIP = b"\x93NUMPY", b"PK"
_PLACES = {"blue": 0, "green": 1, "red": 2}
_PACKBITS, _LZMA, _ZSTD = 32773, 34925, (34926, 50000)
# Largest ratio of unpacked to packed bytes, by the number of the TIFF compression: Deflate (RFC 1951) stores 258 bytes
# in 2 bits; PackBits 128 bytes in 2; Zstandard (RFC 8878, section 3.1.1.2) a block of 128 KiB in 4. LZMA has no fixed
# bound, 10 000 exceeds measured ones. tifffile decodes all other compressions with imagecodecs, if that is installed,
# into memory of the size of the segment.
_LARGEST_RATIO = {8: 1032, 32946: 1032, 50013: 1032, _PACKBITS: 64, _LZMA: 10_000, **dict.fromkeys(_ZSTD, 1 << 15)}
_SMALL_SEGMENT = 1 << 26  # bytes: smaller segments are not counted before they are decoded
_CHUNK = 1 << 20


# Exceptions name the defect of a file. Messages of tifffile itself appear only where the application sets up logging.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def open_recording(path: str | Path, *, channel: Channel = "grey", key: str | None = None) -> Source:
    """Open a recording: a folder of images, or a file whose suffix names its format.

    Parameters
    ----------
    path : path
        ``.npy`` or ``.npz`` (frames along the first axis), ``.tif``, a video, or a folder of images of one size, taken
        in natural order (``img2`` before ``img10``).
    channel : {"grey", "red", "green", "blue", "max", "red_difference", "green_difference", "blue_difference"}
        Channel of colour frames: ``"grey"`` is the luma (ITU-R BT.601), ``"max"`` the brightest channel of each pixel,
        ``"red_difference"`` the colour difference red minus luma, 0 where it is negative: white light has none.
    key : str, optional
        Name of the array in an ``.npz`` file that holds more than one.

    Returns
    -------
    Source
        NaN and infinite values are passed on: the operations flag them.

    Raises
    ------
    ValueError
        The channel is unknown.
    RecordingError
        The recording is missing, empty, truncated, of an unknown format, or its frames differ in size or dtype. Defects
        that show only while reading are raised by `Source.wait` and `Source.read_into`.

    Notes
    -----
    A video that is damaged in its middle raises no exception: the decoder conceals the damage. `Source.damaged_frames`
    names the frames, and JPEG images of a folder that are damaged. Codecs without redundancy (VP9, FFV1 without
    checksums, arrays) do not show changed bytes.
    """
    if channel not in CHANNELS:
        raise ValueError(f"channel is {channel!r}, expected one of {', '.join(CHANNELS)}")
    if not os.fspath(path):
        raise RecordingError("the recording's name is empty; give a file or a folder, or . for this one")
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    if path.is_dir():
        return ImageFolder(path, channel)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return _array_source(path, key)
    if suffix in _TIFF:
        return _tiff_source(path, channel)
    if suffix in _VIDEOS:
        return Video(path, channel)
    known = " ".join((".npy", ".npz", *_TIFF, *_VIDEOS))
    raise RecordingError(f"{path}: not a recording by its suffix; expected a folder of images or one of {known}")


def _array_source(path: Path, key: str | None) -> Source:
    with reading(path, f"{path.suffix} file", RecordingError):
        with path.open("rb") as file:
            begin = file.read(len(_NPY))
        if begin[:2] == _ZIP:
            return _archive_source(path, key)
        if begin != _NPY:
            raise RecordingError(f"{path}: not a readable {path.suffix} file: it does not begin as NumPy writes them")
        frames = np.lib.format.open_memmap(path, mode="r")
        _check_frames(path, frames.shape)
        return ArraySource(frames)


def read_array(path: Path) -> HostArray:
    """Read an NPY file of numbers; its size is the size of its array.

    Raises
    ------
    RecordingError
        The file is damaged, holds objects, or is no NPY file.
    """
    with reading(path, "NPY array", RecordingError):
        if path.stat().st_size == 0:
            raise RecordingError(f"{path}: not a readable NPY array: it is empty")
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(mapped, np.ndarray):
            raise RecordingError(f"{path}: not a readable NPY array: it is an archive")
        return np.array(mapped)


def _check_frames(path: Path, shape: tuple[int, ...]) -> None:
    if len(shape) < 2 or 0 in shape:
        raise RecordingError(f"{path}: expected frames along the first of 2 or more axes, got shape {shape}")
    check_pixels(shape[1:], f"{path}: a frame", RecordingError)


def _archive_source(path: Path, key: str | None) -> Source:
    """Return the frames of an array in an NPZ file."""
    archive = zipfile.ZipFile(path)
    try:
        names = {name.removesuffix(".npy"): name for name in archive.namelist()}
        if not names:
            raise RecordingError(f"{path}: holds no array, expected one of frames")
        if key is None and len(names) == 1:
            (key,) = names
        if key not in names:
            content = "several arrays" if key is None else f"no array {key!r}"
            raise RecordingError(
                f"{path}: holds {content}; name one of {', '.join(names)} as key, in a sensor file under [recording]"
            )
        member: Any = archive.open(names[key])
        if member.peek(len(_NPY))[: len(_NPY)] != _NPY:
            raise RecordingError(f"{path}: {key} in it is not an array")
        shape, is_fortran, dtype = _array_header(member, f"{path}: {key}")
        _check_frames(path, shape)
        wanted_bytes, held = math.prod(shape) * dtype.itemsize, archive.getinfo(names[key]).file_size - member.tell()
        if dtype.hasobject or held != wanted_bytes:
            raise RecordingError(
                f"{path}: {key} holds {held} bytes, expected {wanted_bytes}: {'x'.join(map(str, shape))} {dtype}"
            )
        if not is_fortran:
            return PackedFrames(path, archive, member, shape, dtype)
        # The first axis is the fastest in the file: the array is unpacked as a whole.
        check_archive(path, RecordingError)
        frames = np.frombuffer(member.read(), dtype).reshape(shape[::-1]).T
        archive.close()
        return ArraySource(frames)
    except BaseException:
        archive.close()
        raise


def _array_header(file: Any, what: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether the first axis is the fastest, and dtype from the header of an NPY file."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise RecordingError(f"{what}: NPY version {version[0]}.{version[1]}, expected an array of plain numbers")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(file)
    return tuple(shape), bool(is_fortran), dtype


class PackedFrames(FrameSource):
    """Frames of an array in an NPZ file, unpacked one by one."""

    def __init__(
        self, path: Path, archive: zipfile.ZipFile, member: Any, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        super().__init__(shape[1:], dtype.newbyteorder("="))
        self.length: int = shape[0]
        self._path, self._archive, self._member, self._stored = path, archive, member, dtype
        self._next = 0

    def _ready(self) -> bool:
        """Return whether a frame is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        byte_count = math.prod(self.shape) * self._stored.itemsize
        with reading(f"{self._path}, frame {self._next}", "frame", RecordingError):
            packed = self._member.read(byte_count)
            if len(packed) != byte_count:
                raise RecordingError(f"{self._path}: frame {self._next} of {self.length} is truncated")
            np.copyto(out, np.frombuffer(packed, self._stored).reshape(self.shape))
        self._next += 1

    def close(self) -> None:
        """Close the file."""
        self._archive.close()


def _tiff_source(path: Path, channel: Channel) -> Source:
    file = _open_tiff(path)
    with reading(path, "TIFF file", RecordingError):
        series = file.series
        planes = len(series) == 1 and series[0].axes.endswith("YX") and set(series[0].axes[:-2]) <= set("TZQI")
        if not (planes and series[0].ndim >= 3 and series[0].dataoffset is not None):
            return TiffStack(path, file, channel)
        _check_frames(path, (1, *series[0].shape[-2:]))
        file.close()
    with reading(path, "TIFF file", RecordingError, hint="is it truncated?"):
        # The planes are contiguous in the file, and several planes may share one page.
        stack = tifffile.memmap(path, mode="r")
        return ArraySource(stack.reshape(-1, *stack.shape[-2:]))


def _open_tiff(path: Path) -> tifffile.TiffFile:
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
        self._pick = _picker(channel, self._page_shape, str(path))

    def _ready(self) -> bool:
        """Return whether a page is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        what = f"{self._path}, page {self._next}"
        with reading(what, "TIFF page", RecordingError):
            page = self._file.pages[self._next]
            check_tiff_page(page, what)
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


class Video(FrameSource):
    """One channel of the frames of a video; a video that ends before its announced length raises `RecordingError`."""

    def __init__(self, path: str | Path, channel: Channel = "grey") -> None:
        # Imported here: the library takes 0.3 s, which other commands need not spend.
        from gpuvision.host.video import VideoDecoder

        self._path = Path(path)
        with reading(path, "video", RecordingError):
            with self._path.open("rb") as file:
                check_avi(file)
            self._decoder = VideoDecoder(self._path)
        super().__init__(self._decoder.shape[:2], np.dtype(np.uint8))
        self.length, self.rate = self._decoder.length, self._decoder.rate
        self._pick = _picker(channel, self._decoder.shape, str(path))
        self._next = 0

    def _ready(self) -> bool:
        """Decode the next frame and return whether there is one."""
        is_there = self._decoder.wait()
        if not is_there and self.length is not None and self._next < self.length:
            raise RecordingError(
                f"{self._path}: truncated video: frame {self._next} of {self.length} cannot be decoded"
            )
        return is_there

    def _decode(self, out: HostArray) -> None:
        what = f"{self._path}, frame {self._next}"
        with reading(what, "frame", RecordingError):
            colour = self._decoder.read()
        check_frame(colour[:, :, 0], self.shape, self.dtype, what)
        self._pick(colour, out)
        self._next += 1

    def damaged_frames(self) -> frozenset[int]:
        """Return the numbers of the frames so far that are damaged; see `gpuvision.host.video.VideoDecoder`."""
        return frozenset(number for number in self._decoder.damaged() if number < self._next)

    def close(self) -> None:
        """Close the file."""
        self._decoder.close()


class ImageFolder(FrameSource):
    """Images of a folder in natural order; other files are ignored."""

    def __init__(self, path: str | Path, channel: Channel = "grey") -> None:
        path = Path(path)
        self._files = image_files(path)
        self._channel = channel
        first = read_image(self._files[0])
        super().__init__(first.shape[:2], first.dtype)
        self.length: int = len(self._files)
        self._next = 0
        self._jpegs, self._damaged = 0, set[int]()

    def _ready(self) -> bool:
        """Return whether an image is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        file = self._files[self._next]
        image = read_image(file)
        check_frame(image if image.ndim == 2 else image[:, :, 0], self.shape, self.dtype, str(file))
        _picker(self._channel, image.shape, str(file))(image, out)
        if file.suffix.lower() in _JPEG:
            self._jpegs += 1
            if is_damaged_jpeg(file.read_bytes()):
                self._damaged.add(self._next)
        self._next += 1

    def damaged_frames(self) -> frozenset[int]:
        """Return the numbers of the JPEG images that break the format; none if most of them do, as of some cameras."""
        return frozenset(self._damaged if 2 * len(self._damaged) <= self._jpegs else ())


def image_files(folder: Path) -> list[Path]:
    """Return the image files of a folder in natural order; hidden files and files of other types are ignored.

    Raises
    ------
    RecordingError
        The folder has no images.
    """
    names = [each for each in folder.iterdir() if each.suffix.lower() in _IMAGES and not each.name.startswith(".")]
    if not names:
        raise RecordingError(f"{folder}: no images in this folder; expected some of {' '.join(_IMAGES)}")
    return sorted(names, key=_natural)


def _natural(path: Path) -> list[Any]:
    """Return the sort key of the natural order: img2 before img10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def read_image(path: Path) -> HostArray:
    """Read an image file.

    Returns
    -------
    numpy.ndarray
        (rows, columns) for a grey image, (rows, columns, 3 or 4) in the order blue, green, red (, alpha) for colour.

    Raises
    ------
    RecordingError
        The file is not a readable image, or it holds several images.
    """
    if path.is_dir():
        raise RecordingError(f"{path}: a folder, expected an image; name the images in it")
    with reading(path, "image", RecordingError):
        _check_image(path)
        with _silent_opencv():
            image: HostArray | None = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(f"{path}: not a readable image")
    return image


def read_frame(path: Path, channel: Channel = "grey") -> HostArray:
    """Read an image file as a frame: the channel that `open_recording` gives of the frames of a recording.

    Returns
    -------
    numpy.ndarray
        (rows, columns).

    Raises
    ------
    RecordingError
        As `read_image`; or the image is grey and the channel is a colour.
    """
    image = read_image(path)
    frame = np.empty(image.shape[:2], image.dtype)
    _picker(channel, image.shape, str(path))(image, frame)
    return frame


def _check_image(path: Path) -> None:
    """Check the size of an image before it is decoded, by its content: OpenCV ignores the suffix, too."""
    with path.open("rb") as file:
        head = file.read(4)
        file.seek(0)
        size = image_size(file)
    if path.suffix.lower() in _TIFF or is_tiff(head):
        with _open_tiff(path) as stack:
            if len(stack.pages) != 1:
                raise RecordingError(f"{path}: {len(stack.pages)} pages in one image; open the file by itself instead")
            check_tiff_page(stack.pages[0], str(path))
        return
    if size is None:
        raise RecordingError(f"{path}: not a readable image; expected the content of a {' '.join(_IMAGES)} file")
    check_pixels(size, str(path), RecordingError)


@contextlib.contextmanager
def _silent_opencv() -> Iterator[None]:
    """Suppress the messages of OpenCV, which raises or returns nothing for the same defect."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _picker(channel: Channel, shape: tuple[int, ...], what: str) -> Callable[[HostArray, HostArray], object]:
    """Return the function that copies one channel of a frame (blue, green, red, ...) to an array."""
    if len(shape) == 2:
        if channel not in ("grey", "max"):
            raise RecordingError(f"{what}: has no {channel} channel, the frames are grey; use channel 'grey'")
        return lambda frame, out: np.copyto(out, frame)
    if len(shape) != 3 or shape[2] not in (3, 4):
        raise RecordingError(f"{what}: expected grey or colour frames, got shape {shape}")
    if channel == "grey":
        code = cv2.COLOR_BGR2GRAY if shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return lambda frame, out: cv2.cvtColor(frame, code, out)
    if channel == "max":
        return lambda frame, out: np.max(frame[:, :, :3], axis=2, out=out)
    if channel.endswith(_DIFFERENCE):
        return lambda frame, out: _colour_difference(frame, _PLACES[channel.removesuffix(_DIFFERENCE)], out)
    return lambda frame, out: cv2.extractChannel(frame, _PLACES[channel], out)


def _colour_difference(frame: HostArray, place: int, out: HostArray) -> None:
    """Write one of blue, green, red minus the luma, 0 where it is negative."""
    luma = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY if frame.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    cv2.extractChannel(frame, place, out)
    np.maximum(out, luma, out=out)
    np.subtract(out, luma, out=out)
