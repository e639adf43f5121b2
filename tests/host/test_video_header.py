"""Chunks of AVI files: one that goes beyond the end of the file is refused, unless the decoder skips it."""

from __future__ import annotations

import io
import struct

import pytest

from gpuvision.host.video_header import check_avi

HEAD = struct.pack("<4sI4s", b"RIFF", 4000, b"AVI ")


def chunk(kind: bytes, length: int, content: bytes | None = None) -> bytes:
    return struct.pack("<4sI", kind, length) + (bytes(length) if content is None else content)


def check(data: bytes) -> None:
    check_avi(io.BytesIO(data))


MOVIE = struct.pack("<4sI4s", b"LIST", 10**9, b"movi") + bytes(10)
HEADERS = struct.pack("<4sI4s", b"LIST", 10**9, b"hdrl")


def test_whole_chunks() -> None:
    for data in (
        HEAD,
        HEAD + chunk(b"strh", 4) + MOVIE,
        HEAD + HEADERS + chunk(b"strh", 4) + chunk(b"strf", 5) + b"\0" + MOVIE,  # odd lengths are padded
        HEAD + chunk(b"strf", 5),  # the last one may lack its padding
        HEAD + chunk(b"strh", 0) + b"abcdefg",  # too short for another chunk
    ):
        check(data)


def test_a_chunk_beyond_the_end() -> None:
    for content, length in ((b"abcd", 5), (b"abc", 4), (b"", 1), (b"", 4 * 10**9)):
        for before in (b"", HEADERS, chunk(b"strh", 6), chunk(b"strh", 5) + b"\0"):
            with pytest.raises(ValueError, match=f"a chunk claims {length} bytes, which go beyond the end of the file"):
                check(HEAD + before + chunk(b"strf", length, content))


def test_chunks_that_the_decoder_skips() -> None:
    """A recording that was cut off ends in its frames, in padding, or in its index."""
    for kind in (b"JUNK", b"idx1"):
        check(HEAD + chunk(kind, 100, b"abc"))
    check(HEAD + MOVIE)
    with pytest.raises(ValueError, match="claims 100 bytes"):
        check(HEAD + chunk(b"JUNX", 100, b"abc"))


def test_too_many_chunks() -> None:
    """At most 9999 chunks, as the head of the file counts too."""
    check(HEAD + chunk(b"strh", 0) * 9998)
    with pytest.raises(ValueError, match="more than 10000 chunks before its frames"):
        check(HEAD + chunk(b"strh", 0) * 10_000)


def test_other_files_are_not_checked() -> None:
    bad = chunk(b"strf", 100, b"")
    with pytest.raises(ValueError, match="beyond the end"):
        check(HEAD + bad)
    for head in (b"", b"RIFF", HEAD[:11], b"RIFX" + HEAD[4:], HEAD[:8] + b"WAVE"):
        check(head + (bad if len(head) == 12 else b""))
