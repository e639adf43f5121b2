"""Test of JPEG images for damage that decoders conceal."""

from __future__ import annotations

import simplejpeg


def is_damaged_jpeg(content: bytes) -> bool:
    """Return whether a JPEG image breaks the format: its data end early, or leave bytes behind the last block.

    The decoders of pictures fill such images without an error.
    """
    try:
        simplejpeg.decode_jpeg(content, "GRAY", min_height=1, min_width=1, min_factor=8, strict=True)
    except ValueError:
        return True
    return False
