"""Figures of matplotlib that need no display, and the PNG files that they are written to."""

from __future__ import annotations

import os
from typing import Literal

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gpuvision.host.files import atomic_write

DPI = 150
"""Resolution of the pictures [pixels per inch]."""


def new_figure(
    width: float, height: float, *, dpi: int = DPI, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """Return an empty figure that is rendered in memory (Agg).

    Parameters
    ----------
    width, height : float
        Size of the page [in].
    dpi : int
        Resolution [pixels per inch]. Default 150.
    layout : {"constrained", None}
        Layout engine of matplotlib; None: the caller places the axes. Default "constrained".
    """
    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def write_png(figure: Figure, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a figure as PNG with `gpuvision.host.files.atomic_write`: an error leaves no file behind.

    Parameters
    ----------
    figure : Figure
        Figure of `new_figure`.
    path : path-like
        File to write.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    with atomic_write(path, overwrite=overwrite) as file:
        figure.savefig(file, format="png")
