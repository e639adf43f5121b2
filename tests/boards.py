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


def narrow_pads(folder: Path, *, rows: int = 2, pitch: float = 1.0) -> Path:
    """Write a board with rows of six pads of 0.34 mm."""
    pads = [(8.6 + 0.5 * column, 7.5 + pitch * row) for column in range(6) for row in range(rows)]
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
    flashes = "".join(f"X{round(1e6 * x)}Y{round(1e6 * y)}D03*\n" for x, y in pads)
    (folder / "copper.gbr").write_text(f"{head}%ADD10R,0.34X0.34*%\nD10*\n{flashes}M02*\n")
    border = "X0Y0D02*\nX20000000Y0D01*\nX20000000Y16000000D01*\nX0Y16000000D01*\nX0Y0D01*\n"
    (folder / "outline.gbr").write_text(f"{head}%ADD10C,0.1*%\nD10*\n{border}M02*\n")
    return folder
