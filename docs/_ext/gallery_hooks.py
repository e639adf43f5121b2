"""Functions that sphinx-gallery calls: the order of the examples, and ``__file__`` for each of them."""

from __future__ import annotations

import builtins
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_FIRST = ("scan_a_recording", "calibrate_a_lens", "psd_batch", "simulate_a_part", "choose_a_mask", "locate_a_board")


def place(file: str) -> tuple[int, str]:
    """Return the sort key of an example's file name: the jobs in the order of the guides, then all others by name."""
    stem = file.removesuffix(".py")
    return (_FIRST.index(stem) if stem in _FIRST else len(_FIRST), stem)


def define_file(gallery_conf: Mapping[str, Any], file: str | None) -> None:
    """Define ``__file__`` for the next example: sphinx-gallery does not define it, but scripts use it."""
    vars(builtins)["__file__"] = str(Path(gallery_conf["examples_dirs"][0], file or ""))
