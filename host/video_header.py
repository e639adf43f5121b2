"""Check of an AVI file before it is decoded: the decoder allocates the bytes that a chunk claims."""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

_CHUNK = struct.Struct("<4sI")
_MOST_CHUNKS = 10_000  # outside the list of frames; writers make fewer than 100
# Chunks that the decoder skips or reads in small parts. A recording that was cut off ends in one of them.
_LARGE = (b"JUNK", b"idx1")


def check_avi(file: BinaryIO) -> None:
    """Check that each chunk of an AVI file outside its list of frames lies in the file; ignore files of other formats.

    Parameters
    ----------
    file : binary file
        Open at the start of the video.

    Raises
    ------
    ValueError
        A chunk goes beyond the end of the file.
    """
    head = file.read(12)
    if not (head.startswith(b"RIFF") and head[8:] == b"AVI "):
        return
    size = file.seek(0, os.SEEK_END)
    at = 0
    for _ in range(_MOST_CHUNKS):
        file.seek(at)
        chunk = file.read(_CHUNK.size + 4)
        if len(chunk) < _CHUNK.size:
            return
        kind, length = _CHUNK.unpack_from(chunk)
        if kind in (b"RIFF", b"LIST") and not chunk.endswith(b"movi"):
            at += _CHUNK.size + 4
            continue
        at += _CHUNK.size + length + length % 2
        if at - length % 2 > size:
            if kind == b"LIST" or kind in _LARGE:
                return
            raise ValueError(f"a chunk claims {length} bytes, which go beyond the end of the file")
    raise ValueError(f"more than {_MOST_CHUNKS} chunks before its frames")
