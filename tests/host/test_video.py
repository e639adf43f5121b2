"""Videos: pictures as OpenCV decodes them, and the damaged frames by number."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest

from gpuvision.host import RecordingError, open_recording, video
from gpuvision.host.sources import ArraySource, PacedSource
from gpuvision.ranging.background import ImageSubtracted, PairsSubtracted, PreviousSubtracted

COUNT, ROWS, COLUMNS = 36, 64, 160
ENCODER = {"g": "12", "threads": "1"}  # with more threads the file depends on their timing
CODECS = {"mp4": "libx264", "avi": "mjpeg", "mov": "mpeg4"}


def frames_of_a_line() -> Any:
    """Return frames (36, 64, 160, 3) of a white line that moves down by 1 pixel per frame, with noise."""
    rng = np.random.default_rng(1)
    row = 12.0 + np.arange(COUNT)[:, None] + np.linspace(0.0, 3.0, COLUMNS)
    distance = np.arange(ROWS)[None, :, None] - row[:, None, :]
    frames = 200.0 * np.exp(-0.5 * (distance / 1.5) ** 2) + rng.uniform(0.0, 12.0, distance.shape)
    return np.repeat(np.clip(frames, 0, 255).astype(np.uint8)[..., None], 3, axis=3)


def written(path: Path, codec: str | None = None, frames: Any = None, **options: str) -> Path:
    """Write a video with a key frame in every 12 frames. The options belong to the codec."""
    frames = frames_of_a_line() if frames is None else frames
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec or CODECS[path.suffix[1:]], rate=25)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuvj420p" if stream.name == "mjpeg" else "yuv420p"
        stream.options = {"huffman": "default"} if stream.name == "mjpeg" else ENCODER | options
        for frame in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def read(path: Path) -> tuple[Any, frozenset[int]]:
    """Return the grey frames of a recording and the numbers of its damaged frames."""
    source = open_recording(path)
    out, arrived, frames = np.empty((1, *source.shape), source.dtype), np.zeros(1, np.int64), []
    while source.wait():
        assert source.read_into(out, arrived) == 1
        frames.append(out[0].copy())
    damaged = source.damaged_frames()
    source.close()
    return np.array(frames), damaged


def data_of(content: bytes) -> tuple[int, int]:
    """Return start and end of the pictures in an MP4 or AVI file."""
    if content[:4] == b"RIFF":
        start = content.index(b"movi") + 4
        return start, content.index(b"idx1", start)
    start = content.index(b"mdat") + 4
    return start, start + int.from_bytes(content[start - 8 : start - 4], "big") - 8


def damage(path: Path, count: int, seed: int) -> Path:
    """Write the file again with changed bytes in its pictures."""
    content, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    start, end = data_of(bytes(content))
    for place in rng.integers(start, end, count):
        content[place] ^= int(rng.integers(1, 256))
    changed = path.with_name(f"damaged{path.suffix}")
    changed.write_bytes(content)
    return changed


def positions(frames: Any) -> Any:
    """Return the centroid of the line in each column, (frames, columns)."""
    light = np.maximum(frames.astype(float) - 60.0, 0.0)
    with np.errstate(invalid="ignore"):
        return (light * np.arange(ROWS)[:, None]).sum(axis=1) / light.sum(axis=1)


def read_by_opencv(path: Path) -> Any:
    """Return the grey frames as OpenCV decodes them, (frames, rows, columns)."""
    capture, frames = cv2.VideoCapture(str(path)), []
    while True:
        decoded, picture = capture.read()
        if not decoded:
            return np.array(frames)
        frames.append(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize("suffix", CODECS)
def test_pictures_are_those_of_opencv(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"video.{suffix}")
    frames, damaged = read(path)
    np.testing.assert_array_equal(frames, read_by_opencv(path))
    assert len(frames) == COUNT == open_recording(path).length
    assert open_recording(path).rate == 25.0
    assert damaged == frozenset()


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_bidirectional_pictures_in_an_avi_file(tmp_path: Path, codec: str) -> None:
    """An AVI file has no times of display; a lost packet damages the pictures of its group."""
    path = written(tmp_path / "video.avi", codec, bf="3")
    frames, damaged = read(path)
    np.testing.assert_array_equal(frames, read_by_opencv(path))
    assert len(frames) == COUNT
    assert damaged == frozenset()
    _clear_packet(path, 17)
    lost, damaged = read(path)
    assert len(lost) == COUNT
    wrong = np.any(lost != frames, axis=(1, 2))
    assert np.any(wrong)
    assert set(np.flatnonzero(wrong)) <= damaged <= set(range(9, 24))


@pytest.mark.parametrize(("suffix", "codec"), [("mkv", "libx264"), ("ts", "mpeg2video")])
def test_length_of_a_file_without_a_number_of_pictures(tmp_path: Path, suffix: str, codec: str) -> None:
    """The length follows from the duration: of the whole file in Matroska, of the stream in a transport stream."""
    path = written(tmp_path / f"video.{suffix}", codec)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.frames == 0
        assert (stream.duration is None) == (suffix == "mkv")
    assert open_recording(path).length == COUNT


def test_packets_without_a_time_of_display(tmp_path: Path) -> None:
    """Some Matroska files give the time of decoding only."""
    path = written(tmp_path / "video.mp4", bf="3")

    class WithoutDisplay(video.VideoDecoder):
        def _decode_packet(self, packet: Any) -> Any:
            packet.pts = None
            return super()._decode_packet(packet)

    decoder, frames = WithoutDisplay(path), []
    while decoder.wait():
        frames.append(cv2.cvtColor(decoder.read(), cv2.COLOR_BGR2GRAY))
    decoder.close()
    np.testing.assert_array_equal(frames, read_by_opencv(path))
    assert decoder.damaged() == frozenset()


# The index of FFmpeg marks packets near the edit, and leaves out those far from it.
@pytest.mark.parametrize(("first", "count"), [(10, 26), (0, 20), (13, 2)])
def test_an_edit_list_cuts_pictures_off(tmp_path: Path, first: int, count: int) -> None:
    path = written(tmp_path / "video.mp4")
    whole = read(path)[0]
    content = bytearray(path.read_bytes())
    place = content.index(b"elst") + 4 + 8  # behind version and number of edits
    start = int.from_bytes(content[place + 4 : place + 8], "big")
    # Duration in 1/1000 s of the film; start in 1/12800 s of the stream, 512 for a frame.
    content[place : place + 8] = (40 * count).to_bytes(4, "big") + (start + 512 * first).to_bytes(4, "big")
    path.write_bytes(content)
    frames, damaged = read(path)
    np.testing.assert_array_equal(frames, whole[first : first + count])
    np.testing.assert_array_equal(frames, read_by_opencv(path))
    assert damaged == frozenset()
    source = open_recording(path)
    assert source.length == count
    source.close()


def test_a_picture_that_is_larger_than_the_header_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A JPEG image beyond the limit is not decoded; it counts as damaged."""
    path = tmp_path / "video.avi"
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("mjpeg", rate=25)
        stream.height, stream.width, stream.pix_fmt = ROWS, COLUMNS, "yuvj420p"
        for number, frame in enumerate(frames_of_a_line()[:8]):
            large = np.zeros((8 * ROWS, 8 * COLUMNS), np.uint8)
            packet = av.Packet(cv2.imencode(".jpg", large if number == 5 else frame)[1].tobytes())
            packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, number, number, True
            container.mux(packet)
    decoded = []

    def is_damaged_jpeg(content: bytes) -> bool:
        decoded.append(len(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)))
        return False

    monkeypatch.setattr(video, "is_damaged_jpeg", is_damaged_jpeg)
    monkeypatch.setenv("GPUVISION_MAX_PIXELS", str(2 * ROWS * COLUMNS))
    frames, damaged = read(path)
    assert decoded == [ROWS] * 7
    assert len(frames) == 8
    np.testing.assert_array_equal(frames[5], frames[4])
    assert damaged == frozenset({5})


@pytest.mark.parametrize("case", [*CODECS, "avi-libx264"])
def test_samples_of_damaged_frames_are_known(tmp_path: Path, case: str) -> None:
    """Of the samples that changed bytes move, few lie in frames that count as good."""
    suffix, _, codec = case.partition("-")
    path = written(tmp_path / f"video.{suffix}", codec or None)
    clean = positions(read(path)[0])
    moved = unseen = 0
    for seed in range(12):
        try:
            frames, damaged = read(damage(path, 4, seed))
        except RecordingError:  # a frame is missing at the end
            continue
        wrong = ~(np.abs(positions(frames) - clean) < 0.05)
        moved += np.count_nonzero(wrong)
        unseen += np.count_nonzero(np.delete(wrong, sorted(damaged), axis=0))
        assert len(frames) == COUNT
        assert max(damaged, default=0) < COUNT
    assert moved > 0.02 * 12 * clean.size
    # Measured: 0.2 to 4.4 % of the moved samples (H.264, by the timing of the threads), 0.6 % (JPEG), 2.6 % (MPEG-4).
    # A changed code can be another valid one. Without the flags of bidirectional pictures, 10 % (H.264).
    assert unseen < 0.08 * moved


class Exchanging:
    """Decoder that gives its fifth picture after the sixth one."""

    def __init__(self, context: Any) -> None:
        self._context, self._count, self._held = context, 0, []

    def decode(self, packet: Any) -> list[Any]:
        given = []
        for picture in self._context.decode(packet):
            self._count += 1
            if self._count == 5:
                self._held = [picture]
            else:
                given += [picture, *self._held]
                self._held = []
        return given


def test_a_picture_that_comes_too_late_shifts_no_other(tmp_path: Path) -> None:
    """Decoders of damaged H.264 can give pictures out of order. A frame has its transport by its number."""
    path = written(tmp_path / "video.mov")
    clean = read(path)[0]
    decoder, frames = video.VideoDecoder(path), []
    decoder._context = Exchanging(decoder._context)
    while decoder.wait():
        frames.append(cv2.cvtColor(decoder.read(), cv2.COLOR_BGR2GRAY))
    decoder.close()
    assert len(frames) == COUNT
    # The constructor has decoded picture 0.
    assert decoder.damaged() == frozenset(range(5, 12))
    good = np.delete(np.arange(COUNT), 5)
    np.testing.assert_array_equal(np.array(frames)[good], clean[good])


def test_lost_pictures_before_the_first_one_show_it(tmp_path: Path) -> None:
    """They count as damaged; the first picture itself does not."""
    path = written(tmp_path / "video.mov", frames=frames_of_a_line()[:5])
    clean = read(path)[0]

    class Late(video.VideoDecoder):
        def _decode_packets(self) -> Any:
            yield from ((None, True), (None, True))
            yield from super()._decode_packets()

    decoder, frames = Late(path), []
    while decoder.wait():
        frames.append(cv2.cvtColor(decoder.read(), cv2.COLOR_BGR2GRAY))
    decoder.close()
    np.testing.assert_array_equal(frames, clean[[0, 0, 0, 1, 2, 3, 4]])
    assert decoder.damaged() == frozenset({0, 1})


@pytest.mark.parametrize(("pictures", "doubtful"), [(3, False), (4, True), (5, True)])
def test_broken_images_count_unless_most_are_broken(pictures: int, doubtful: bool) -> None:
    decoder: Any = object.__new__(video.VideoDecoder)
    decoder._broken_jpegs, decoder._damaged, decoder._number = {1, 2}, {7}, pictures
    assert decoder.damaged() == ({1, 2, 7} if doubtful else {7})


@pytest.mark.parametrize(
    ("of_stream", "of_file", "rate", "length"),
    [
        (49, None, 25.0, 49),  # 49 / 25 s
        (None, 1_980_000, 25.0, 50),  # us: 49.5 pictures
        (None, 1_979_000, 25.0, 49),
        (None, None, 25.0, 0),
        (49, None, None, 0),
    ],
)
def test_length_by_duration_and_rate(
    of_stream: int | None, of_file: int | None, rate: float | None, length: int
) -> None:
    decoder: Any = object.__new__(video.VideoDecoder)
    decoder.rate, decoder._container = rate, SimpleNamespace(duration=of_file)
    stream = SimpleNamespace(duration=of_stream, time_base=Fraction(1, 25))
    assert decoder._announced(stream) == length
    without_unit = SimpleNamespace(duration=49, time_base=None)
    assert decoder._announced(without_unit) == (0 if of_file is None else length)


def test_discarded_entries_of_an_index_do_not_count() -> None:
    decoder: Any = object.__new__(video.VideoDecoder)
    entries = [SimpleNamespace(is_discard=each) for each in (True, False, False)]
    for name, frames, expected in (("mov,mp4,m4a", 3, 2), ("avi", 3, 3), ("mov,mp4,m4a", 0, 0)):
        decoder._container = SimpleNamespace(format=SimpleNamespace(name=name))
        assert decoder._displayed(SimpleNamespace(frames=frames, index_entries=entries)) == expected


def _clear_packet(path: Path, number: int) -> None:
    """Fill a packet of a video with zeros."""
    with av.open(str(path)) as container:
        packet = next(each for n, each in enumerate(container.demux(video=0)) if n == number)
        assert packet.pos is not None
        place, size = packet.pos, packet.size
    content = bytearray(path.read_bytes())
    content[place : place + size] = bytes(size)
    path.write_bytes(content)


def test_only_frames_since_the_last_key_frame_are_damaged(tmp_path: Path) -> None:
    path = written(tmp_path / "video.mov")
    _clear_packet(path, 17)
    frames, damaged = read(path)
    assert len(frames) == COUNT
    assert damaged == frozenset(range(17, 24))


def test_a_rotated_video_is_turned_as_by_opencv(tmp_path: Path) -> None:
    path = written(tmp_path / "video.mp4")
    content = bytearray(path.read_bytes())
    place = content.index(b"tkhd") + 4 + 40  # behind version, times and volume
    one = 1 << 16
    assert content[place : place + 4] == one.to_bytes(4, "big")
    for matrix in ((0, one, 0, -one, 0, 0), (-one, 0, 0, 0, -one, 0), (0, -one, 0, one, 0, 0)):
        content[place : place + 24] = b"".join(each.to_bytes(4, "big", signed=True) for each in matrix)
        path.write_bytes(content)
        decoded, picture = cv2.VideoCapture(str(path)).read()
        assert decoded
        np.testing.assert_array_equal(read(path)[0][0], cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


def jpegs(folder: Path, count: int = 8) -> list[Path]:
    files = [folder / f"{number}.jpg" for number in range(count)]
    for file, frame in zip(files, frames_of_a_line(), strict=False):
        cv2.imwrite(str(file), frame)
    return files


def test_damaged_images_of_a_folder(tmp_path: Path) -> None:
    files = jpegs(tmp_path)
    assert read(tmp_path)[1] == frozenset()
    content = bytearray(files[5].read_bytes())
    content[len(content) // 2 : len(content) // 2 + 9] = bytes(9)
    files[5].write_bytes(content)
    assert read(tmp_path)[1] == frozenset({5})
    for file in files[:5]:  # as some cameras write them
        file.write_bytes(file.read_bytes()[:-2] + bytes(30) + b"\xff\xd9")
    assert read(tmp_path)[1] == frozenset()


def test_images_of_cameras_without_tables(tmp_path: Path) -> None:
    """A video of JPEG images that leave out the standard tables of Huffman codes is not damaged."""
    path = written(tmp_path / "video.avi")
    content = path.read_bytes()
    start = content.index(b"\xff\xc4")
    size = int.from_bytes(content[start + 2 : start + 4], "big") + 2
    table = content[start : start + size]
    assert content.count(table) == COUNT
    # A comment of the same size takes the place of the tables; FFmpeg writes the standard ones.
    bare = tmp_path / "bare.avi"
    bare.write_bytes(content.replace(table, b"\xff\xfe" + table[2:4] + bytes(size - 4)))
    frames, damaged = read(bare)
    np.testing.assert_array_equal(frames, read(path)[0])
    assert damaged == frozenset()


class Scratched(ArraySource):
    """Array with damaged frames."""

    def damaged_frames(self) -> frozenset[int]:
        return frozenset({3, 6})


def test_sources_that_change_frames_pass_the_damage_on() -> None:
    frames = np.zeros((10, 4, 5), np.uint8)
    assert ArraySource(frames).damaged_frames() == frozenset()
    assert PacedSource(Scratched(frames), 10.0).damaged_frames() == {3, 6}
    assert ImageSubtracted(Scratched(frames), frames[0]).damaged_frames() == {3, 6}
    assert PreviousSubtracted(Scratched(frames)).damaged_frames() == {3, 4, 6, 7}
    assert PairsSubtracted(Scratched(frames)).damaged_frames() == {1, 3}


@pytest.mark.parametrize("content", [b"", b"no video", b"RIFF\x04\x00\x00\x00AVI "])
def test_files_without_a_picture(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "video.avi"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"video\.avi: no frame of this video can be decoded"):
        open_recording(path)
