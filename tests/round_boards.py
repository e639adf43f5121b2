"""Boards of round pads, with and without traces, as files, and images of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from board_images import BoardPicture, View
from boards import BOARD_MIDDLE, LAYERS
from gpuvision.matching.artwork.artwork import Artwork, read_artwork

PIXEL, SHAPE, NOISE = 40e-6, (300, 400), 2.0
LANDS = ((4, 4), (7, 5), (13, 4.5), (15.5, 7), (5, 9), (9, 11), (12.3, 9.4), (15, 12), (16.6, 10), (16.4, 4))
LANDS += ((7, 12.8), (12, 12.6), (6.8, 10.6), (14.6, 9.4))
FIDUCIALS = ((4.2, 12.1), (10.1, 6.6))
TRACES = ((8.5, 3.4, 11.2, 3.4), (3.6, 5.6, 3.6, 7.6), (6.4, 6.6, 7.8, 9.0), (13.4, 7.2, 13.9, 6.0))
_HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"


def round_board(
    folder: Path,
    *,
    pads: Sequence[tuple[float, float]] = LANDS,
    fiducials: Sequence[tuple[float, float]] = FIDUCIALS,
    traces: Sequence[tuple[float, float, float, float]] = (),
    width: float = 0.5,
    openings: Sequence[tuple[float, float, float]] = (),
    holes: Sequence[tuple[float, float, float]] = (),
) -> Path:
    """Write a board of 20 x 16 mm: covered pads of 1 mm, fiducials of 1 mm in openings of 2.6 mm, traces [mm].

    ``openings`` and ``holes`` are rows of x, y and diameter.
    """

    def at(x: float, y: float, code: str) -> str:
        return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*\n"

    copper = f"%ADD10C,{width}*%\n%ADD11C,1.0*%\nD10*\n"
    copper += "".join(at(*each[:2], "D02") + at(*each[2:], "D01") for each in traces)
    copper += "D11*\n" + "".join(at(*each, "D03") for each in (*pads, *fiducials))
    mask = _flashes([*((*each, 2.6) for each in fiducials), *openings])
    ends = [(0, 0), (20, 0), (20, 16), (0, 16), (0, 0)]
    outline = "%ADD10C,0.1*%\nD10*\n" + "".join(at(*each, "D01" if n else "D02") for n, each in enumerate(ends))
    files = dict(zip(LAYERS, (copper, mask, outline), strict=True)) | {"holes.gbr": _flashes(holes)}
    for name, text in files.items():
        (folder / name).write_text(_HEAD + text + "M02*\n")
    return folder


def _flashes(spots: Sequence[tuple[float, float, float]]) -> str:
    sizes = sorted({each[2] for each in spots})
    text = "".join(f"%ADD{10 + n}C,{size}*%\n" for n, size in enumerate(sizes))
    for x, y, size in spots:
        text += f"D{10 + sizes.index(size)}*\nX{round(x * 1e6)}Y{round(y * 1e6)}D03*\n"
    return text


def round_artwork(folder: Path) -> Artwork:
    """Read the files that `round_board` wrote."""
    return read_artwork(folder, layers=LAYERS | {"holes.gbr": "drill plated"})


def round_picture(artwork: Artwork, **more: Any) -> BoardPicture:
    """Return the board under a camera over its centre, about which it may move."""
    corner = np.array(BOARD_MIDDLE) + (np.array(SHAPE[::-1]) - 1) / 2 * PIXEL * (-1, 1)
    view = View(corner=tuple(corner), pixel=PIXEL, shape=SHAPE, noise=NOISE)
    return BoardPicture(artwork, view, about=BOARD_MIDDLE, **more)


def moved_picture(
    picture: BoardPicture, rng: np.random.Generator, shift: float = 60e-6, angle: float = 3e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Return a uint8 image of the board, moved at random about its centre, and the camera's pose over it."""
    x, y = rng.uniform(-shift, shift, 2)
    turn = float(rng.uniform(-angle, angle))
    seen = np.clip(np.rint(picture.seen((x, y, turn), rng)), 0, 255).astype(np.uint8)
    cos, sin = math.cos(turn), math.sin(turn)
    return seen, np.array([BOARD_MIDDLE[0] - cos * x - sin * y, BOARD_MIDDLE[1] + sin * x - cos * y, -turn])
