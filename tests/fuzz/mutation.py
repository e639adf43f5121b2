"""Mutations of bytes: flip, cut, repeat, insert, replace."""

from __future__ import annotations

import random
import re

# Values at the ends of integer types, and texts that mean something to one of the formats.
_BYTES = (b"\0", b"\xff", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x01\0\0\0")
_TEXTS = (b"nan", b"-1", b"1e308", b"9" * 40, b"[[", b"]", b"{", b'"', b"'''", b"%", b"*", b"\n", b"a.b.c", b"\x1b[2J")
_TOKENS = _BYTES + _TEXTS
_LARGEST = 1 << 16  # bytes of a mutated file, or twice its seed


def mutated(seed: bytes, number: int) -> bytes:
    """Return the mutation of a seed with a number: 1 to 8 changes, the same ones in every run."""
    rng = random.Random(number)
    content = bytearray(seed)
    for _ in range(1 << rng.randrange(4)):
        change(content, rng)
    return bytes(content[: max(_LARGEST, 2 * len(seed))])


def change(content: bytearray, rng: random.Random) -> None:
    """Change bytes in place once."""
    at = rng.randrange(len(content) + 1)
    kind = rng.randrange(7)
    if kind == 0 and at < len(content):
        content[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del content[at : at + 1 + int(rng.expovariate(1 / 16))]
    elif kind == 2:
        content[at:at] = content[at : at + rng.randrange(1, 64)] * rng.choice((1, 2, 50))
    elif kind == 3:
        content[at:at] = rng.choice(_TOKENS)
    elif kind == 4:
        token = rng.choice(_TOKENS)
        content[at : at + len(token)] = token
    elif kind == 5:
        del content[at:]
    else:
        _replace_number(content, at, rng)


def _replace_number(content: bytearray, at: int, rng: random.Random) -> None:
    """Replace the next decimal number; if none follows, replace the next byte."""
    found = re.compile(rb"\d+").search(content, at)
    if found:
        value = int(found[0][:18])
        other = rng.choice((0, 1, value + 1, value * 10, value * 1000, 10 ** rng.randrange(12), -value))
        content[found.start() : found.end()] = str(other).encode()
    elif at < len(content):
        content[at] = rng.randrange(256)
