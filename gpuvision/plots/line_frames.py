"""Picture of camera frames with the laser line that the readout finds in them."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from gpuvision.plots.figure import new_figure, write_png
from gpuvision.status import SAMPLE_FLAGS, Status

Array = npt.NDArray[Any]

_PAGE_INCHES, _TITLE_INCHES = 12.0, 0.25  # width of the page, height of the title of a frame
_WIDTH_TO_HEIGHT = 1.4  # of the page, about
_DPI = 110
# Status flags, colour and text; a sample has the first that applies.
_MARKS: tuple[tuple[Status, str, str], ...] = (
    (Status.AMBIGUOUS, "#c77dff", "ambiguous: several candidates"),
    (Status.SATURATED, "#ffd60a", "saturated"),
    (Status.OK, "#39ff14", "line found"),
)
_LOST = "#ff5d5d"  # marks of samples without a line, at the border of the frame


@dataclass(frozen=True, kw_only=True)
class LineFrame:
    """Frame of a recording with the line that was found in it.

    Attributes
    ----------
    number : int
        Number of the frame in the recording.
    image : numpy.ndarray
        Frame as the readout sees it, (rows, columns).
    position : numpy.ndarray
        Position of the line for each sample, (samples,) [px]; NaN where no line was found.
    status : numpy.ndarray
        `Status` flags of the samples, (samples,) uint8.
    """

    number: int
    image: Array
    position: Array
    status: npt.NDArray[np.uint8]

    @property
    def found_fraction(self) -> float:
        """Fraction of the samples with a position, 0 to 1."""
        return float(np.mean(np.isfinite(self.position)))


def draw_line_frames(
    path: str | os.PathLike[str],
    frames: Sequence[LineFrame],
    *,
    along: Literal["columns", "rows"],
    title: str,
    overwrite: bool = False,
) -> None:
    """Draw frames as PNG with the line found over them; written atomically.

    All frames have one grey scale. The title of each frame gives its number and its most frequent flag.

    Parameters
    ----------
    path : path-like
        Output file.
    frames : sequence of LineFrame
        At least one.
    along : {"columns", "rows"}
        Image axis along which the samples run: ``"columns"`` for one position (a row) per column.
    title : str
        Title above the picture.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    rows, columns = frames[0].image.shape
    # Wide frames lie below each other, tall frames side by side.
    across = min(max(round(math.sqrt(_WIDTH_TO_HEIGHT * len(frames) * rows / columns)), 1), len(frames))
    down = math.ceil(len(frames) / across)
    height = max(_PAGE_INCHES / across * rows / columns, 0.3) + _TITLE_INCHES
    figure = new_figure(_PAGE_INCHES, down * height + 1.0, dpi=_DPI)
    figure.suptitle(title)
    low, high = _grey_scale(frames)
    for number, frame in enumerate(frames):
        axes = figure.add_subplot(down, across, number + 1)
        axes.imshow(frame.image, cmap=mpl.colormaps["gray"], vmin=low, vmax=high, interpolation="nearest")
        _draw_line(axes, frame, along, 0.06 * (rows if along == "columns" else columns))
        axes.set_title(_frame_title(frame), fontsize=8)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlim(-0.5, columns - 0.5)
        axes.set_ylim(rows - 0.5, -0.5)
    marks = [(colour, meaning) for _, colour, meaning in _MARKS[::-1]] + [(_LOST, "no line: mark at the border")]
    handles = [Line2D([], [], color=colour, marker="o", linestyle="", label=meaning) for colour, meaning in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8)
    write_png(figure, path, overwrite=overwrite)


def _grey_scale(frames: Sequence[LineFrame]) -> tuple[float, float]:
    """Return the levels of black and white: 0, and the 99.9 % percentile of all frames."""
    values = np.concatenate([frame.image.ravel()[:: max(frame.image.size // 100_000, 1)] for frame in frames])
    values = values[np.isfinite(values)]
    return 0.0, max(float(np.percentile(values, 99.9)), 1.0) if values.size else 1.0


def _draw_line(axes: Any, frame: LineFrame, along: str, length: float) -> None:
    sample = np.arange(len(frame.position))
    left = np.isfinite(frame.position)
    for flag, colour, _ in _MARKS:
        chosen = left & ((frame.status & flag) != 0) if flag else left
        places = (sample[chosen], frame.position[chosen])
        axes.scatter(*(places if along == "columns" else places[::-1]), s=5.0, color=colour, linewidths=0)
        left = left & ~chosen
    lost = sample[~np.isfinite(frame.position)]
    draw = axes.vlines if along == "columns" else axes.hlines
    draw(lost, -0.5, length, color=_LOST, linewidth=1.0)


def _frame_title(frame: LineFrame) -> str:
    flags = {flag: float(np.mean((frame.status & flag) != 0)) for flag in SAMPLE_FLAGS}
    worst = max(flags, key=lambda flag: flags[flag])
    text = f"frame {frame.number}: line in {100 * frame.found_fraction:.0f} %"
    return text + (f", {worst.name} {100 * flags[worst]:.0f} %" if flags[worst] > 0 else "")
