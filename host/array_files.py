"""NPY and NPZ files as sources."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.host.arrays import HostArray
from gpuvision.host.errors import RecordingError
from gpuvision.host.reading import check_archive, check_frames, reading
from gpuvision.host.sources import ArraySource, FrameSource, Source

_NPY, _ZIP = b"\x93NUMPY", b"PK"


def open_array(path: Path, key: str | None) -> Source:
    """Open an NPY file, or an array of an NPZ file, as frames along the first axis.

    Raises
    ------
    RecordingError
        The file is damaged, or does not hold the array, or the array is not one of frames.
    """
    with reading(path, f"{path.suffix} file", RecordingError):
        with path.open("rb") as file:
            begin = file.read(len(_NPY))
        if begin[:2] == _ZIP:
            return _archive_source(path, key)
        if begin != _NPY:
            raise RecordingError(f"{path}: not a readable {path.suffix} file: it does not begin as NumPy writes them")
        frames = np.lib.format.open_memmap(path, mode="r")
        check_frames(path, frames.shape)
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
        check_frames(path, shape)
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
