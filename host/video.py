"""Decoder of videos: pictures with the information which of them are damaged."""

from __future__ import annotations

import heapq
import io
import math
import os
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import VideoReformatter

from gpuvision.host.arrays import HostArray
from gpuvision.host.damage import is_damaged_jpeg
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_header import image_size
from gpuvision.host.reading import MAX_PIXELS, check_pixels

# Bytes of a JPEG image without its data, in which a table of Huffman codes lies.
_JPEG_HEADER = 4096
_HUFFMAN_TABLE = b"\xff\xc4"
_MAX_THREADS = 16  # each holds a picture
_LARGEST_OPTION = (1 << 31) - 1  # of FFmpeg's option max_pixels
# Clockwise rotation of the picture [degrees].
_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


class VideoDecoder:
    """Pictures of a video in the order of display, and the numbers of the damaged ones.

    A picture counts as damaged if

    - the decoder reports an error for it, or conceals one;
    - it is lost: a packet of the file has no picture. The previous picture takes its place;
    - an earlier picture since the last key frame is damaged: later ones build on it; and bidirectional pictures (B)
      build on the picture after them;
    - it is a JPEG image that breaks the format (`is_damaged_jpeg`). This test does not count if most of the images
      fail: some cameras write such files.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    shape : (int, int, 3)
        Rows, columns and channels of a picture.
    length : int or None
        Number of pictures that the file announces.
    rate : float or None
        Pictures per second.

    Raises
    ------
    RecordingError
        No picture of the file can be decoded.
    """

    shape: tuple[int, ...]
    length: int | None
    rate: float | None

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._container = av.open(str(path))
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise self._unreadable() from error
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        if not self._container.streams.video:
            raise self._unreadable()
        stream = self._container.streams.video[0]
        check_pixels((stream.height, stream.width), f"{self._path}: a frame", RecordingError)
        self._context = stream.codec_context
        # Two pictures at a time at least: the H.264 decoder reports more errors so than with one (measured).
        self._context.thread_type = "FRAME"
        self._context.thread_count = min(max(os.cpu_count() or 2, 2), _MAX_THREADS)
        self._intra_only = self._context.codec.intra_only
        # The header gives the size of the first picture only.
        max_pixels = int(min(MAX_PIXELS.value, _LARGEST_OPTION))
        self._context.options = {"err_detect": "crccheck+bitstream+buffer+explode", "max_pixels": str(max_pixels)}
        self._is_jpeg = self._context.name == "mjpeg"
        # Cameras leave out the tables of Huffman codes, which are the same in all images.
        self._completed = av.bitstream.BitStreamFilterContext("mjpeg2jpeg", stream) if self._is_jpeg else None
        self._reformatter = VideoReformatter()
        # An AVI file has no times of display: for some codecs FFmpeg numbers the packets in decoding order.
        self._is_numbered = self._container.format.name == "avi" and not self._intra_only
        self._packets = 0
        self._expected: list[int] = []  # times of the packets whose pictures have not come yet
        self._lost: set[int] = set()  # times of lost pictures
        self._broken_jpegs: set[int] = set()  # numbers of pictures
        self._jpeg_times: set[int] = set()
        self._failed: set[int] = set()  # times of packets that the decoder refused
        self._broken_since_key = False
        self._bidirectional: list[int] = []  # numbers of the pictures since the last one of another kind
        self._damaged: set[int] = set()
        self._number = 0
        self._waiting: deque[HostArray] = deque()
        self._last: HostArray | None = None
        self._pictures = self._decode()
        self.rate = float(stream.average_rate) if stream.average_rate else None
        self.length = self._displayed(stream) or self._announced(stream) or None
        if not self.wait():
            raise self._unreadable()
        assert self._last is not None  # there is a picture
        self.shape = self._last.shape

    def _unreadable(self) -> RecordingError:
        return RecordingError(f"{self._path}: no frame of this video can be decoded: damaged, or of an unknown codec")

    def _displayed(self, stream: Any) -> int:
        """Return the number of pictures by the header, less the pictures that the edit list of an MP4 file cuts off."""
        frames = int(stream.frames)
        if not frames or "mp4" not in self._container.format.name.split(","):
            return frames
        # The index of an MP4 file leaves out packets outside the edit list, or marks them.
        return sum(not entry.is_discard for entry in stream.index_entries)

    def _announced(self, stream: Any) -> int:
        """Return the number of pictures from duration and rate."""
        if stream.duration is not None and stream.time_base is not None:
            seconds: Fraction | None = stream.duration * stream.time_base
        else:
            seconds = None if self._container.duration is None else Fraction(self._container.duration, av.time_base)
        return 0 if seconds is None or self.rate is None else math.floor(float(seconds) * self.rate + 0.5)

    def wait(self) -> bool:
        """Decode until a picture is there; return False at the end of the video."""
        while not self._waiting:
            picture = next(self._pictures, None)
            if picture is None:
                return False
            self._waiting.append(picture)
        return True

    def read(self) -> HostArray:
        """Return the next picture, (rows, columns, 3) uint8 in the order blue, green, red; after `wait` was True."""
        return self._waiting.popleft()

    def damaged(self) -> frozenset[int]:
        """Return the numbers of the damaged pictures so far, in the order of display from 0."""
        doubtful = self._broken_jpegs if 2 * len(self._broken_jpegs) <= self._number else set()
        return frozenset(self._damaged | doubtful)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _decode(self) -> Iterator[HostArray]:
        """Yield each picture; lost pictures are replaced by the previous one."""
        lost = 0
        for picture, damaged in self._decode_packets():
            if picture is None and self._last is None:
                lost += 1
                continue
            if picture is not None:
                self._last = picture
                for _ in range(lost):  # before the first picture
                    yield self._counted(picture, is_damaged=True)
                lost = 0
            assert self._last is not None  # the first case
            yield self._counted(self._last, is_damaged=damaged)

    def _counted(self, picture: HostArray, *, is_damaged: bool) -> HostArray:
        if is_damaged:
            self._damaged |= {self._number, *self._bidirectional}
        self._number += 1
        return picture

    def _decode_packets(self) -> Iterator[tuple[HostArray | None, bool]]:
        """Yield each picture, None for a lost one, and whether it is damaged."""
        packets = self._container.demux(self._container.streams.video[0])
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                break
            except (av.error.FFmpegError, ValueError):  # the container is damaged from here on
                break
            yield from self._decode_packet(packet)
        yield from self._frames(None)
        yield from ((None, True) for _ in self._expected)
        self._expected.clear()

    def _decode_packet(self, packet: Any) -> Iterator[tuple[HostArray | None, bool]]:
        if not packet.size:  # the end of the stream
            return
        self._is_numbered |= self._packets == 0 and packet.pts is None and packet.dts is not None
        if self._is_numbered:
            packet.pts = self._packets  # the decoder gives it to the picture
        self._packets += 1
        time = _time(packet)
        # The decoder drops the pictures of discarded packets, which lie outside the edit list of an MP4 file.
        if time is not None and not packet.is_discard:
            heapq.heappush(self._expected, time)
            if self._is_jpeg and self._is_broken_jpeg(packet):
                self._jpeg_times.add(time)
        self._broken_since_key |= packet.is_corrupt
        yield from self._frames(packet)

    def _is_broken_jpeg(self, packet: Any) -> bool:
        content = bytes(packet)
        if _HUFFMAN_TABLE not in content[:_JPEG_HEADER]:
            try:
                assert self._completed is not None  # this is a JPEG stream
                # The filter takes the packet's data away: give it a copy.
                content = b"".join(bytes(each) for each in self._completed.filter(av.Packet(content)))
            except av.error.FFmpegError:
                return True
        try:
            size = image_size(io.BytesIO(content))
        except ValueError:  # the image ends early
            return True
        if size is None or size[0] * size[1] > MAX_PIXELS.value:
            return True
        return is_damaged_jpeg(content)

    def _frames(self, packet: Any) -> Iterator[tuple[HostArray | None, bool]]:
        """Decode a packet, or the delayed pictures for None."""
        try:
            frames = self._context.decode(packet)
        except av.error.FFmpegError:
            self._broken_since_key = True
            time = None if packet is None else _time(packet)
            if time is not None:
                self._failed.add(time)
            elif packet is not None:
                yield None, True
            return
        for frame in frames:
            time = _time(frame)
            is_bidirectional = frame.pict_type == av.video.frame.PictureType.B
            # Numbered packets are in decoding order: a bidirectional picture is displayed before a picture with a
            # smaller number. Pictures of other kinds are displayed after all that are decoded before them.
            is_after_all = not (self._is_numbered and is_bidirectional)
            while is_after_all and time is not None and self._expected and self._expected[0] < time:
                self._lost.add(heapq.heappop(self._expected))
                self._broken_since_key = True
                yield None, True
            if time in self._lost:  # the picture comes too late: the previous one has taken its place
                continue
            if self._expected and time is None:
                heapq.heappop(self._expected)
            elif time in self._expected:
                self._expected.remove(time)
                heapq.heapify(self._expected)
            if frame.key_frame or self._intra_only:
                self._broken_since_key = False
            self._broken_since_key |= frame.is_corrupt or time in self._failed
            if time in self._jpeg_times:
                self._broken_jpegs.add(self._number)
            yield self._picture(frame), self._broken_since_key
            # `_counted` has counted this picture.
            self._bidirectional = [*self._bidirectional, self._number - 1] if is_bidirectional else []

    def _picture(self, frame: Any) -> HostArray:
        turned = self._reformatter.reformat(frame, format="bgr24")
        plane = turned.planes[0]
        lines = np.asarray(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
        picture: HostArray = lines[: turned.height, : 3 * turned.width].reshape(turned.height, turned.width, 3)
        turn = _TURNS.get(-frame.rotation % 360)
        return picture if turn is None else np.asarray(cv2.rotate(picture, turn))


def _time(part: Any) -> int | None:
    """Return the time of a packet or picture, or None. Equal times match a picture with its packet."""
    time: int | None = part.pts if part.pts is not None else part.dts
    return time
