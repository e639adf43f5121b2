"""NPY and NPZ files: frames in either order of memory, and files that are no arrays of frames."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.host.array_files import PackedFrames, open_array, read_array
from gpuvision.host.errors import RecordingError
from gpuvision.host.sources import ArraySource

FRAMES = np.arange(4 * 2 * 3, dtype=np.uint16).reshape(4, 2, 3)


def packed(array: Any) -> bytes:
    """Return the bytes of an NPY file."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def archive(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


def all_frames(source: Any) -> Any:
    """Return the frames of a source, read one by one."""
    read, arrived = [], np.zeros(1, np.int64)
    while True:
        frame = np.zeros((1, *source.shape), source.dtype)
        if not source.read_into(frame, arrived):
            return np.concatenate(read)
        read.append(frame)


@pytest.mark.parametrize("frames", [FRAMES, np.asfortranarray(FRAMES), FRAMES.astype(">u2")])
def test_frames_of_an_archive_in_any_order_of_memory(frames: Any, tmp_path: Path) -> None:
    np.savez(tmp_path / "frames.npz", frames)
    source = open_array(tmp_path / "frames.npz", None)
    assert isinstance(source, ArraySource if frames.flags.f_contiguous else PackedFrames)
    assert (source.length, source.shape) == (4, (2, 3))
    np.testing.assert_array_equal(all_frames(source), FRAMES)
    source.close()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (packed(FRAMES)[:-1], "frames.npz: a holds 47 bytes, expected 48: 4x2x3 uint16"),
        (packed(FRAMES) + b"x", "frames.npz: a holds 49 bytes, expected 48: 4x2x3 uint16"),
        (b"\x93NUMPY\x03\x00" + packed(FRAMES)[8:], "NPY version 3.0, expected an array of plain numbers"),
        (b"NUMPY" + packed(FRAMES), "frames.npz: a in it is not an array"),
    ],
)
def test_damaged_arrays_of_an_archive_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    path = archive(tmp_path / "frames.npz", a=content)
    with pytest.raises(RecordingError) as refused:
        open_array(path, None)
    assert message in str(refused.value)


def test_objects_are_no_frames(tmp_path: Path) -> None:
    path = archive(tmp_path / "frames.npz", a=packed(np.array([[[None]]])))
    with pytest.raises(RecordingError, match=r"a holds \d+ bytes, expected 8: 1x1x1 object"):
        open_array(path, None)


def test_an_array_of_several_is_named(tmp_path: Path) -> None:
    path = archive(tmp_path / "frames.npz", a=packed(FRAMES), b=packed(FRAMES[::-1]))
    np.testing.assert_array_equal(all_frames(open_array(path, "b")), FRAMES[::-1])
    for key, content in ((None, "several arrays"), ("c", "no array 'c'")):
        with pytest.raises(RecordingError) as refused:
            open_array(path, key)
        assert f"holds {content}; name one of a, b as key" in str(refused.value)
    with pytest.raises(RecordingError, match="holds no array, expected one of frames"):
        open_array(archive(tmp_path / "none.npz"), None)


def test_a_packed_frame_that_ends_early_is_named(tmp_path: Path) -> None:
    source: Any = open_array(archive(tmp_path / "frames.npz", a=packed(FRAMES)), None)
    source._member = io.BytesIO(FRAMES[:2].tobytes() + b"12345678901")  # as from a damaged archive
    arrived, frame = np.zeros(1, np.int64), np.zeros((1, 2, 3), np.uint16)
    for number in range(2):
        assert source.read_into(frame, arrived) == 1
        np.testing.assert_array_equal(frame[0], FRAMES[number])
    with pytest.raises(RecordingError, match=r"frames\.npz: frame 2 of 4 is truncated"):
        source.read_into(frame, arrived)


def test_single_arrays(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(packed(FRAMES))
    np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), FRAMES)
    for content, reason in ((b"", "it is empty"), (archive(tmp_path / "b", a=b"").read_bytes(), "it is an archive")):
        (tmp_path / "a.npy").write_bytes(content)
        with pytest.raises(RecordingError, match=f"not a readable NPY array: {reason}"):
            read_array(tmp_path / "a.npy")
