"""A small board of traces and pads in many directions, as files."""

from __future__ import annotations

import math
from pathlib import Path

_HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
LAYERS = {"copper.gbr": "top copper", "mask.gbr": "top mask", "outline.gbr": "mechanical outline"}
BOARD_MIDDLE = (10e-3, 8e-3)


def _at(x: float, y: float, code: str) -> str:
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*\n"


def _line(*ends: float) -> str:
    return _at(*ends[:2], "D02") + _at(*ends[2:], "D01")


def board_folder(folder: Path) -> Path:
    """Write a board of 20 x 16 mm: traces 0.5 mm wide, bare and covered pads, and an outline."""
    traces = [(3, 3, 3, 9), (3, 9, 7, 13), (6, 2.5, 12, 2.5), (14, 3, 17, 6), (17, 6, 17, 12), (8, 13.5, 15, 13.5)]
    traces += [(10, 5, 10, 9.5), (12.5, 6, 12.5, 10.7)]
    for turn, (x, y) in ((0.5, (6.5, 7.0)), (2.0, (14.8, 9.0))):
        traces.append((x - math.cos(turn), y - math.sin(turn), x + math.cos(turn), y + math.sin(turn)))
    pads = ((5.0, 5.0), (14.8, 5.9), (10.0, 11.3), (5.0, 11.2))
    copper = "%ADD10C,0.5*%\n%ADD11R,1.2X1.2*%\nD10*\n" + "".join(_line(*each) for each in traces)
    copper += "D11*\n" + "".join(_at(*each, "D03") for each in pads)
    mask = "%ADD10R,2.4X2.4*%\nD10*\n" + "".join(_at(*each, "D03") for each in pads[:2])
    outline = "%ADD10C,0.1*%\nD10*\n" + _line(0, 0, 20, 0) + _at(20, 16, "D01") + _at(0, 16, "D01") + _at(0, 0, "D01")
    for name, text in zip(LAYERS, (copper, mask, outline), strict=True):
        (folder / name).write_text(_HEAD + text + "M02*\n")
    return folder
