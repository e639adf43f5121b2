"""Order of the examples in the gallery."""

from __future__ import annotations

_FIRST = ("scan_a_recording", "calibrate_a_lens", "psd_batch", "simulate_a_part", "choose_a_mask", "locate_a_board")


def place(file: str) -> tuple[int, str]:
    """Return the sort key of an example's file name: the jobs in the order of the guides, then all others by name."""
    stem = file.removesuffix(".py")
    return (_FIRST.index(stem) if stem in _FIRST else len(_FIRST), stem)
