"""Sources: every frame once, in order, in place; and errors of one line for unreadable files."""

from __future__ import annotations

import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.host import RecordingError
from gpuvision.host.channels import CHANNELS
from gpuvision.host.recordings import open_recording
from gpuvision.host.sources import ArraySource, FrameSource, IteratedSource, PacedSource, Source
from streams import ManualClock


def read_all(source: Source, batch: int = 3) -> np.ndarray:
    """Read all frames in batches, as a stream does."""
    out = np.zeros((batch, *source.shape), source.dtype)
    arrived = np.zeros(batch, np.int64)
    parts = [out[:0].copy()]
    while source.wait():
        count = source.read_into(out, arrived)
        if not count:
            break
        parts.append(out[:count].copy())
    source.close()
    return np.concatenate(parts)


class Broken(FrameSource):
    """Source that fails at one frame."""

    def __init__(self, fails_at: int) -> None:
        super().__init__((2, 2), np.dtype(np.uint8))
        self._fails_at, self._next = fails_at, 0

    def _decode(self, out: np.ndarray) -> None:
        if self._next == self._fails_at:
            raise RecordingError(f"frame {self._next} is broken")
        out[...] = self._next
        self._next += 1


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 60000, (7, 12, 10), dtype=np.uint16)


# In memory --------------------------------------------------------------------------------------------------------


@given(
    count=st.integers(0, 23),
    frames=st.integers(1, 9),
    batch=st.integers(1, 11),
    dtype=st.sampled_from([np.uint8, np.uint16, np.float32, np.float64, ">u2"]),
)
def test_an_array_is_given_once_or_repeated(count: int, frames: int, batch: int, dtype: Any) -> None:
    array = np.arange(frames * 6).reshape(frames, 3, 2).astype(dtype)
    source = ArraySource(array, count)
    assert source.length == count
    assert source.dtype.isnative
    assert np.array_equal(read_all(source, batch), array[np.arange(count) % frames])


def test_strided_frames_are_taken_in_their_order(frames: np.ndarray) -> None:
    assert np.array_equal(read_all(ArraySource(frames[::-2, :, ::3])), frames[::-2, :, ::3])


def test_an_array_without_a_frame_axis_or_frames_to_repeat_is_refused() -> None:
    with pytest.raises(ValueError, match="frames along the first axis"):
        ArraySource(np.zeros(5))
    with pytest.raises(ValueError, match="no frames to make 4 of"):
        ArraySource(np.zeros((0, 3)), 4)
    with pytest.raises(TypeError, match="the frames are a masked array"):
        ArraySource(np.ma.masked_invalid(np.zeros((2, 3))))


def test_iterated_frames_come_in_order_and_must_be_alike() -> None:
    assert np.array_equal(read_all(IteratedSource(np.full((2, 3), k) for k in range(8)))[:, 0, 0], np.arange(8))
    changing = [np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 4))]
    with pytest.raises(RecordingError, match=r"frame 2: 2x4 float64 where the first frame was 2x3 float64"):
        read_all(IteratedSource(changing), 1)
    with pytest.raises(RecordingError, match="no first frame"):
        IteratedSource([])


@pytest.mark.parametrize("paced", [False, True])
def test_an_error_does_not_lose_the_frames_of_its_batch(paced: bool) -> None:
    source: Source = Broken(fails_at=5)
    if paced:
        source = PacedSource(source, 1e6)
    out, arrived = np.zeros((4, 2, 2), np.uint8), np.zeros(4, np.int64)
    assert source.read_into(out, arrived) == 4
    assert source.read_into(out, arrived) == 1
    assert out[0, 0, 0] == 4
    with pytest.raises(RecordingError, match="frame 5 is broken"):
        source.read_into(out, arrived)


def broken_camera(good: int) -> Iterator[np.ndarray]:
    for k in range(good):
        yield np.full((2, 3), float(k))
    raise OSError("the cable is out")


def changing(good: int) -> Iterator[np.ndarray]:
    yield from np.zeros((good, 2, 3))
    yield np.zeros((2, 4))


def no_array(good: int) -> Iterator[Any]:
    yield from np.zeros((good, 2, 3))
    yield None


@pytest.mark.parametrize("paced", [False, True])
@pytest.mark.parametrize("batch", [1, 2, 4])
@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (broken_camera, "frame 2 did not come: OSError: the cable is out"),
        (changing, "frame 2: 2x4 float64 where the first frame was 2x3"),
        (no_array, "frame 2 is of type NoneType, expected a NumPy array"),
    ],
)
def test_an_error_in_the_last_frame_comes_after_the_good_ones(
    frames: Any, message: str, batch: int, paced: bool
) -> None:
    """A stream calls `wait` first: the end of the iterator must not hide the preceding error."""
    source: Source = IteratedSource(frames(2))
    if paced:
        source = PacedSource(source, 1e6)
    out, arrived = np.zeros((batch, 2, 3)), np.zeros(batch, np.int64)
    got = 0
    while got < 2:
        assert source.wait()
        got += source.read_into(out, arrived)
    for _ in range(2):  # and the error stays
        with pytest.raises(RecordingError, match=message) as caught:
            source.wait() and source.read_into(out, arrived)
    assert got == 2
    assert frames is not broken_camera or isinstance(caught.value.__cause__, OSError)


def test_a_camera_that_fails_at_once() -> None:
    with pytest.raises(RecordingError, match="frame 0 did not come: OSError: the cable is out"):
        IteratedSource(broken_camera(0))


# On a clock -------------------------------------------------------------------------------------------------------


def test_frames_are_due_by_the_clock_and_not_by_the_reader() -> None:
    clock = ManualClock()
    source = PacedSource(ArraySource(np.zeros((1, 2, 2)), 100), 1000.0, clock=clock, sleep=clock.sleep)
    arrived, out = np.zeros(1, np.int64), np.zeros((1, 2, 2))
    times = []
    for k in range(100):
        clock.now += 100_000 * (k % 7)  # a slow reader, still faster than a period
        assert source.wait()
        assert source.read_into(out, arrived) == 1
        times.append(int(arrived[0]))
    assert not source.wait()
    overdue = np.array(times) - times[0] - np.arange(100) * 1_000_000
    assert overdue.min() >= 0
    assert overdue.max() < 10_000  # no drift: the delay of a frame does not affect the next
    assert source.late < 10_000


def test_a_late_reader_gets_what_is_overdue_at_once_and_it_counts_from_when_it_was_due() -> None:
    clock = ManualClock()
    source = PacedSource(ArraySource(np.arange(50.0).reshape(50, 1)), 1000.0, clock=clock, sleep=clock.sleep)
    arrived, out = np.zeros(8, np.int64), np.zeros((8, 1))
    assert source.read_into(out[:1], arrived[:1]) == 1
    start = int(arrived[0])
    clock.now = start + 20_500_000  # a stall of 20 frames
    assert source.read_into(out, arrived) == 8
    assert np.array_equal(out[:, 0], np.arange(1, 9))
    assert np.array_equal(arrived, start + np.arange(1, 9) * 1_000_000)
    assert 19_500_000 <= source.late < 19_510_000
    assert clock.now - start < 20_600_000  # the source did not sleep


def test_a_rate_must_be_one() -> None:
    for rate in (0.0, -1.0, 0.9e-9, 1e9, np.nan, np.inf):
        with pytest.raises(ValueError, match="expected frames per second"):
            PacedSource(ArraySource(np.zeros((1, 1))), rate)


def test_stopping_ends_the_wait_for_a_slow_clock() -> None:
    source = PacedSource(ArraySource(np.zeros((3, 1))), 1e-9)  # the lowest rate
    assert source.wait()
    assert source.read_into(np.zeros((1, 1)), np.zeros(1, np.int64)) == 1
    threading.Timer(0.05, source.stop).start()
    assert not source.wait()  # the next frame is due in 32 years
    assert source.read_into(np.zeros((1, 1)), np.zeros(1, np.int64)) == 0


# Recordings -------------------------------------------------------------------------------------------------------


def test_npy_and_npz(tmp_path: Path, frames: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", frames)
    np.savez(tmp_path / "one.npz", anything=frames)
    np.savez_compressed(tmp_path / "two.npz", frames=frames, dark=frames[0])
    np.save(tmp_path / "fortran.npy", np.asfortranarray(frames))
    for name in ("a.npy", "one.npz", "fortran.npy"):
        source = open_recording(tmp_path / name)
        assert (source.shape, source.dtype, source.length) == (frames.shape[1:], frames.dtype, 7)
        assert np.array_equal(read_all(source), frames)
    assert np.array_equal(read_all(open_recording(tmp_path / "two.npz", key="frames")), frames)
    with pytest.raises(
        RecordingError, match=r"several arrays; name one of frames, dark as key, in a sensor file under \[recording\]"
    ):
        open_recording(tmp_path / "two.npz")
    with pytest.raises(RecordingError, match=r"no array 'light'; name one of frames, dark"):
        open_recording(tmp_path / "two.npz", key="light")


def test_archives_without_an_array(tmp_path: Path) -> None:
    np.savez(tmp_path / "none.npz")
    with pytest.raises(RecordingError, match=r"none\.npz: holds no array, expected one of frames$"):
        open_recording(tmp_path / "none.npz")
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("notes.txt", "hello")
    with pytest.raises(RecordingError, match=r"text\.npz: notes.txt in it is not an array"):
        open_recording(tmp_path / "text.npz")


def test_currents_that_are_not_finite_are_passed_on(tmp_path: Path) -> None:
    currents = np.array([[1.0, np.nan], [np.inf, 2.0], [3.0, 4.0]], np.float32)
    np.save(tmp_path / "currents.npy", currents)
    assert np.array_equal(read_all(open_recording(tmp_path / "currents.npy")), currents, equal_nan=True)


@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "zlib"}, {"imagej": True}, {"metadata": None}, {"byteorder": ">"}, {"bigtiff": True}],
    ids=str,
)
def test_tiff_stacks(tmp_path: Path, frames: np.ndarray, options: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", frames, **options)
    assert np.array_equal(read_all(open_recording(tmp_path / "a.tif")), frames)


def test_tiff_stacks_written_page_by_page_and_of_one_page(tmp_path: Path, frames: np.ndarray) -> None:
    with tifffile.TiffWriter(tmp_path / "pages.tif") as writer:
        for frame in frames:
            writer.write(frame, contiguous=False)
    tifffile.imwrite(tmp_path / "one.tif", frames[0].astype(np.float32))
    assert np.array_equal(read_all(open_recording(tmp_path / "pages.tif")), frames)
    assert np.array_equal(read_all(open_recording(tmp_path / "one.tif")), frames[:1].astype(np.float32))


def luminance(colour: np.ndarray) -> np.ndarray:
    return colour @ np.array([0.299, 0.587, 0.114])


@pytest.mark.parametrize("channel", CHANNELS)
def test_channels_of_colour_images_and_stacks(tmp_path: Path, rng: np.random.Generator, channel: Any) -> None:
    colour = rng.integers(0, 256, (3, 9, 8, 3), dtype=np.uint8)  # red, green, blue
    tifffile.imwrite(tmp_path / "a.tif", colour, photometric="rgb")
    (tmp_path / "folder").mkdir()
    for k, frame in enumerate(colour):
        cv2.imwrite(str(tmp_path / "folder" / f"{k}.png"), frame[:, :, ::-1])
    expected = {
        "red": colour[..., 0],
        "green": colour[..., 1],
        "blue": colour[..., 2],
        "max": colour.max(axis=-1),
        "grey": luminance(colour),
        "red_difference": (colour[..., 0] - luminance(colour)).clip(0),
        "green_difference": (colour[..., 1] - luminance(colour)).clip(0),
        "blue_difference": (colour[..., 2] - luminance(colour)).clip(0),
    }[channel]
    for name in ("a.tif", "folder"):
        read = read_all(open_recording(tmp_path / name, channel=channel))
        # Luminance is rounded to whole levels.
        is_rounded = channel == "grey" or channel.endswith("_difference")
        assert np.abs(read.astype(float) - expected).max() <= (0.51 if is_rounded else 0.0)


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for k in (10, 2, 1, 33, 9):
        cv2.imwrite(str(tmp_path / f"img{k}.png"), np.full((4, 5), k, np.uint16))
    (tmp_path / "notes.txt").write_text("not an image")
    read = read_all(open_recording(tmp_path))
    assert read.dtype == np.uint16
    assert np.array_equal(read[:, 0, 0], [1, 2, 9, 10, 33])


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A video of 40 uniform frames, 5 grey levels apart."""
    path = tmp_path / "line.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (64, 48))
    for k in range(40):
        writer.write(np.full((48, 64, 3), 5 * k, np.uint8))
    writer.release()
    return path


def test_a_video_is_read_to_its_end(video: Path) -> None:
    source = open_recording(video)
    assert (source.shape, source.dtype, source.length, source.rate) == ((48, 64), np.uint8, 40, 50.0)
    levels = read_all(source, 7).mean(axis=(1, 2))
    assert np.abs(levels - 5 * np.arange(40)).max() <= 2.0  # tolerance of JPEG for a uniform frame


def test_a_truncated_video_names_the_frame(video: Path) -> None:
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    with pytest.raises(RecordingError, match=r"line\.avi: truncated video: frame \d+ of 40 cannot be decoded"):
        read_all(open_recording(video))


@pytest.mark.slow
@pytest.mark.realdata
def test_the_real_video(data: Path) -> None:
    source = open_recording(data / "laser" / "corner_scene_sweep.mp4", channel="red")
    assert (source.shape, source.dtype, source.length) == ((1920, 1080), np.uint8, 128)
    frames = read_all(source, 16)
    assert len(frames) == 128
    assert frames.max(axis=(1, 2)).min() > 150  # the laser is in every frame


# Unreadable files ----------------------------------------------------------------------------------------------


def test_what_is_not_there_or_not_a_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such recording"):
        open_recording(tmp_path / "missing.npy")
    with pytest.raises(RecordingError, match="name is empty; give a file"):
        open_recording("")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RecordingError, match=r"not a recording by its suffix; expected .*\.npy"):
        open_recording(tmp_path / "notes.txt")
    with pytest.raises(ValueError, match="channel is 'pink', expected one of grey, red"):
        open_recording(tmp_path, channel="pink")


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.tif", "a.mp4", "a.avi"])
@pytest.mark.parametrize("content", [b"", b"not what the suffix says" * 50], ids=["empty", "other"])
def test_files_that_are_not_what_they_say(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=name) as caught:
        read_all(open_recording(tmp_path / name))
    assert "\n" not in str(caught.value)
    assert "pickle" not in str(caught.value)


def test_arrays_of_no_frames_no_axis_or_objects(tmp_path: Path) -> None:
    for name, array in (("none", np.zeros((0, 4, 4))), ("flat", np.zeros(9))):
        np.save(tmp_path / f"{name}.npy", array)
        with pytest.raises(RecordingError, match="expected frames along the first of 2 or more axes"):
            open_recording(tmp_path / f"{name}.npy")
    np.save(tmp_path / "objects.npy", np.array([{}, {}]))
    with pytest.raises(RecordingError, match="not a readable"):
        open_recording(tmp_path / "objects.npy")


@pytest.mark.parametrize("share", [0.2, 0.5, 0.95])
@pytest.mark.parametrize("name", ["a.npy", "a.npz", "plain.tif", "packed.tif"])
def test_truncated_files(tmp_path: Path, rng: np.random.Generator, name: str, share: float) -> None:
    frames = rng.integers(0, 60000, (12, 40, 50), dtype=np.uint16)
    path = tmp_path / name
    if path.suffix == ".npy":
        np.save(path, frames)
    elif path.suffix == ".npz":
        np.savez(path, frames=frames)
    else:
        tifffile.imwrite(path, frames, compression="zlib" if name == "packed.tif" else None)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(RecordingError, match=name):
        read_all(open_recording(path))


def test_the_library_that_reads_tiff_keeps_quiet(tmp_path: Path, rng: np.random.Generator) -> None:
    """Run in a separate process: the log handlers of pytest would capture the library's messages."""
    path = tmp_path / "cut.tif"
    tifffile.imwrite(path, rng.integers(0, 60000, (12, 40, 50), dtype=np.uint16), compression="zlib")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    code = "import sys; from gpuvision.host.recordings import *\n"
    code += "try: open_recording(sys.argv[1])\nexcept RecordingError: print('refused')"
    ran = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert (ran.stdout, ran.stderr) == ("refused\n", "")


def test_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no images in this folder"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (np.zeros((4, 6), np.uint8), r"2\.png: 4x6 uint8 where the first frame was 4x5 uint8"),
        (np.zeros((4, 5), np.uint16), r"2\.png: 4x5 uint16 where the first frame was 4x5 uint8"),
    ],
)
def test_images_that_are_not_alike(tmp_path: Path, second: np.ndarray, message: str) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 5), np.uint8))
    cv2.imwrite(str(tmp_path / "2.png"), second)
    with pytest.raises(RecordingError, match=message):
        read_all(open_recording(tmp_path), 1)


def test_tiff_pages_that_are_not_alike(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(np.zeros((8, 8), np.uint8))
        writer.write(np.zeros((8, 9), np.uint8))
    with pytest.raises(RecordingError, match=r"a\.tif, page 1: 8x9 uint8 where the first frame was 8x8 uint8"):
        read_all(open_recording(tmp_path / "a.tif"))


def test_a_damaged_image_and_a_stack_in_a_folder(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 5), np.uint8))
    (tmp_path / "2.png").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match=r"2\.png: not a readable image"):
        read_all(open_recording(tmp_path))
    (tmp_path / "2.png").unlink()
    tifffile.imwrite(tmp_path / "2.tif", np.zeros((3, 4, 5), np.uint8), photometric="minisblack")
    with pytest.raises(RecordingError, match=r"2\.tif: 3 pages in one image"):
        read_all(open_recording(tmp_path))


def test_a_colour_channel_of_grey_frames(tmp_path: Path, frames: np.ndarray) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 5), np.uint8))
    with pytest.raises(RecordingError, match="has no red channel, the frames are grey"):
        read_all(open_recording(tmp_path, channel="red"))


def test_a_truncated_tiff_names_its_last_page(tmp_path: Path) -> None:
    """Pages are numbered from 0; the file ends before the third page."""
    path = tmp_path / "cut.tif"
    with tifffile.TiffWriter(path) as writer:
        for number in range(4):
            writer.write(np.full((16, 16), number, np.uint8), contiguous=False, metadata=None)
    with tifffile.TiffFile(path) as file:
        place = file.pages[2].offset
    path.write_bytes(path.read_bytes()[:place])
    with pytest.raises(RecordingError, match=r"truncated TIFF: no page after number 1$"):
        open_recording(path)
