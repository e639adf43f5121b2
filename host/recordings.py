"""Recordings on disk as sources: NPY and NPZ arrays, TIFF stacks, videos, folders of images."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gpuvision.host.array_files import open_array
from gpuvision.host.arrays import HostArray
from gpuvision.host.channels import CHANNELS, Channel, channel_copier
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_files import ImageFolder
from gpuvision.host.reading import reading
from gpuvision.host.sources import FrameSource, Source, check_frame
from gpuvision.host.tiff_files import TIFF_SUFFIXES, open_stack
from gpuvision.host.video_header import check_avi

_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".ts")


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
        return open_array(path, key)
    if suffix in TIFF_SUFFIXES:
        return open_stack(path, channel)
    if suffix in _VIDEOS:
        return Video(path, channel)
    known = " ".join((".npy", ".npz", *TIFF_SUFFIXES, *_VIDEOS))
    raise RecordingError(f"{path}: not a recording by its suffix; expected a folder of images or one of {known}")


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
        self._pick = channel_copier(channel, self._decoder.shape, str(path))
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
