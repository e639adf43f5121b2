"""Image files, and folders of images as sources."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gpuvision.host.arrays import HostArray
from gpuvision.host.channels import Channel, channel_copier
from gpuvision.host.damage import is_damaged_jpeg
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_header import image_size, is_tiff
from gpuvision.host.reading import check_pixels, reading
from gpuvision.host.sources import FrameSource, check_frame
from gpuvision.host.tiff_files import TIFF_SUFFIXES, check_photometric, check_tiff_page, open_tiff

_JPEG = (".jpg", ".jpeg")
_IMAGES = (".png", ".bmp", *_JPEG, ".pgm", ".ppm", ".pnm", ".webp", *TIFF_SUFFIXES)


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
        channel_copier(self._channel, image.shape, str(file))(image, out)
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
    channel_copier(channel, image.shape, str(path))(image, frame)
    return frame


def _check_image(path: Path) -> None:
    """Check the size of an image before it is decoded, by its content: OpenCV ignores the suffix, too."""
    with path.open("rb") as file:
        head = file.read(4)
        file.seek(0)
        size = image_size(file)
    if path.suffix.lower() in TIFF_SUFFIXES or is_tiff(head):
        with open_tiff(path) as stack:
            if len(stack.pages) != 1:
                raise RecordingError(f"{path}: {len(stack.pages)} pages in one image; open the file by itself instead")
            page: Any = stack.pages[0]
            check_tiff_page(page, str(path))
            # OpenCV converts palettes, other colours and inverted grey levels of up to 8 bits.
            if page.bitspersample > 8:
                check_photometric(page, str(path))
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
