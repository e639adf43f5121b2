"""Text from files, drivers and other programs, made safe for a terminal; sizes in words."""

from __future__ import annotations

import re
import unicodedata

# Escape sequences of a terminal: CSI (colours, cursor), OSC (title, links), and sequences of two characters.
_ESCAPES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)|\x1b[ -/]*[0-~]")
_UNSAFE = ("Cc", "Cf", "Cs")  # control characters, format characters (such as changes of direction), surrogates


def printable(text: str) -> str:
    """Return a text without escape sequences of terminals and with "?" for other control characters.

    Line feeds and tabulators stay.
    """
    if text.isascii() and text.isprintable():
        return text
    plain = _ESCAPES.sub("", text)
    return "".join(each if each in "\n\t" or unicodedata.category(each) not in _UNSAFE else "?" for each in plain)


def size_in_words(size: int) -> str:
    """Return a number of bytes with a decimal unit."""
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"
