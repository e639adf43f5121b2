"""Recordings on disk as sources: NPY and NPZ arrays, TIFF stacks, videos, folders of images."""

from __future__ import annotations

import logging
import os
import re
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tifffile

from gpuvision.host.arrays import HostArray
from gpuvision.host.errors import RecordingError
from gpuvision.host.sources import ArraySource, FrameSource, Source, check_frame

Channel = Literal["grey", "red", "green", "blue", "max"]

CHANNELS: tuple[Channel, ...] = ("grey", "red", "green", "blue", "max")
_TIFF = (".tif", ".tiff")
_IMAGES = (".png", ".bmp", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm", ".webp", *_TIFF)
_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".ts")
_NPY, _ZIP = b"\x93NUMPY", b"PK"
_PLACES = {"blue": 0, "green": 1, "red": 2}


# Exceptions name the defect of a file. Messages of tifffile itself appear only where the application sets up logging.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


def open_recording(path: str | Path, *, channel: Channel = "grey", key: str | None = None) -> Source:
    """Open a recording: a folder of images, or a file whose suffix names its format.

    Parameters
    ----------
    path : path
        ``.npy`` or ``.npz`` (frames along the first axis), ``.tif``, a video, or a folder of images of one size, taken
        in natural order (``img2`` before ``img10``).
    channel : {"grey", "red", "green", "blue", "max"}
        Channel of colour frames: ``"grey"`` is the luminance, ``"max"`` the brightest channel of each pixel.
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
    A video that is damaged in its middle raises no exception: the decoder conceals the damage, and the concealed frames
    look like others.
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
    try:
        with path.open("rb") as file:
            begin = file.read(len(_NPY))
        if begin[:2] == _ZIP:
            frames = _member(path, key)
        elif begin == _NPY:
            frames = np.lib.format.open_memmap(path, mode="r")
        else:
            raise RecordingError(f"{path}: not a readable {path.suffix} file: it does not begin as NumPy writes them")
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RecordingError(f"{path}: not a readable {path.suffix} file: {_line(error)}") from error
    if frames.ndim < 2 or not frames.size:
        raise RecordingError(f"{path}: expected frames along the first of 2 or more axes, got shape {frames.shape}")
    return ArraySource(frames)


def _member(path: Path, key: str | None) -> HostArray:
    with np.load(path, allow_pickle=False) as archive:
        names = list(archive.files)
        if not names:
            raise RecordingError(f"{path}: holds no array, expected one of frames")
        if key is None and len(names) == 1:
            key = names[0]
        if key not in names:
            wanted = "several arrays" if key is None else f"no array {key!r}"
            raise RecordingError(
                f"{path}: holds {wanted}; name one of {', '.join(names)} as key, in a sensor file under [recording]"
            )
        member: object = archive[key]
        if not isinstance(member, np.ndarray):
            raise RecordingError(f"{path}: {key} in it is not an array")
        return member


def _tiff_source(path: Path, channel: Channel) -> Source:
    file = _open_tiff(path)
    series = file.series
    planes = len(series) == 1 and series[0].axes.endswith("YX") and set(series[0].axes[:-2]) <= set("TZQI")
    if planes and series[0].ndim >= 3 and series[0].dataoffset is not None:
        file.close()
        try:
            # The planes are contiguous in the file, and several planes may share one page.
            stack = tifffile.memmap(path, mode="r")
            return ArraySource(stack.reshape(-1, *stack.shape[-2:]))
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path}: truncated TIFF: {_line(error)}") from error
    return TiffStack(path, file, channel)


def _open_tiff(path: Path) -> tifffile.TiffFile:
    try:
        file = tifffile.TiffFile(path)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: not a readable TIFF file: {_line(error)}") from error
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
        self._page_shape, page_dtype = first.shape, np.dtype(first.dtype)
        super().__init__(self._page_shape[:2], page_dtype)
        self.length: int = len(file.pages)
        self._pick = _picker(channel, self._page_shape, str(path))

    def _ready(self) -> bool:
        """Return whether a page is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        what = f"{self._path}, page {self._next}"
        try:
            page = self._file.pages[self._next].asarray()
        except (OSError, ValueError, RuntimeError, zlib.error) as error:
            raise RecordingError(f"{what}: cannot be decoded: {_line(error)}") from error
        check_frame(page, self._page_shape, self.dtype, what)
        # The channel order is red, green, blue in TIFF, and blue, green, red in the channel functions.
        self._pick(page if page.ndim == 2 else np.ascontiguousarray(page[:, :, 2::-1]), out)
        self._next += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Video(FrameSource):
    """One channel of the frames of a video; a video that ends before its announced length raises `RecordingError`."""

    def __init__(self, path: str | Path, channel: Channel = "grey") -> None:
        self._path = Path(path)
        self._capture = cv2.VideoCapture(str(path))
        self._grabbed = self._capture.isOpened() and self._capture.grab()
        if not self._grabbed:
            self._capture.release()
            raise RecordingError(f"{path}: no frame of this video can be decoded: damaged, or of an unknown codec")
        announced = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        _, self._colour = self._capture.retrieve()
        super().__init__(self._colour.shape[:2], self._colour.dtype)
        # Containers of unknown length report a number of frames below 1.
        self.length = announced if announced > 0 else None
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS)) or None
        self._pick = _picker(channel, self._colour.shape, str(path))
        self._next = 0

    def _ready(self) -> bool:
        """Grab the next frame and return whether there is one."""
        if not self._grabbed:
            self._grabbed = self._capture.grab()
            if not self._grabbed and self.length is not None and self._next < self.length:
                raise RecordingError(
                    f"{self._path}: truncated video: frame {self._next} of {self.length} cannot be decoded"
                )
        return self._grabbed

    def _decode(self, out: HostArray) -> None:
        decoded, self._colour = self._capture.retrieve(self._colour)
        self._grabbed = False
        if not decoded:
            raise RecordingError(f"{self._path}: frame {self._next} cannot be decoded")
        check_frame(self._colour[:, :, 0], self.shape, self.dtype, f"{self._path}, frame {self._next}")
        self._pick(self._colour, out)
        self._next += 1

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class ImageFolder(FrameSource):
    """Images of a folder in natural order; other files are ignored."""

    def __init__(self, path: str | Path, channel: Channel = "grey") -> None:
        path = Path(path)
        names = [each for each in path.iterdir() if each.suffix.lower() in _IMAGES and not each.name.startswith(".")]
        self._files = sorted(names, key=_natural)
        if not self._files:
            raise RecordingError(f"{path}: no images in this folder; expected some of {' '.join(_IMAGES)}")
        self._channel = channel
        first = read_image(self._files[0])
        super().__init__(first.shape[:2], first.dtype)
        self.length: int = len(self._files)
        self._next = 0

    def _ready(self) -> bool:
        """Return whether an image is left."""
        return self._next < self.length

    def _decode(self, out: HostArray) -> None:
        file = self._files[self._next]
        image = read_image(file)
        check_frame(image if image.ndim == 2 else image[:, :, 0], self.shape, self.dtype, str(file))
        _picker(self._channel, image.shape, str(file))(image, out)
        self._next += 1


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
    if path.suffix.lower() in _TIFF:
        with _open_tiff(path) as file:
            if len(file.pages) != 1:
                raise RecordingError(f"{path}: {len(file.pages)} pages in one image; open the file by itself instead")
    image: HostArray | None = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(f"{path}: not a readable image")
    return image


def _picker(channel: Channel, shape: tuple[int, ...], what: str) -> Callable[[HostArray, HostArray], object]:
    """Return the function that copies one channel of a frame (blue, green, red, ...) to an array."""
    if len(shape) == 2:
        if channel in _PLACES:
            raise RecordingError(f"{what}: has no {channel} channel, the frames are grey; use channel 'grey'")
        return lambda frame, out: np.copyto(out, frame)
    if len(shape) != 3 or shape[2] not in (3, 4):
        raise RecordingError(f"{what}: expected grey or colour frames, got shape {shape}")
    if channel == "grey":
        code = cv2.COLOR_BGR2GRAY if shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return lambda frame, out: cv2.cvtColor(frame, code, out)
    if channel == "max":
        return lambda frame, out: np.max(frame[:, :, :3], axis=2, out=out)
    return lambda frame, out: cv2.extractChannel(frame, _PLACES[channel], out)


def _line(error: BaseException) -> str:
    """Return the first line of the message of another library's exception."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
