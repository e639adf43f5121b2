"""Pictures of speed-accuracy curves: error over time of each setting, and the Pareto front."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gpuvision.host.outputs import Outputs
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.profiling.curves.curve import OPERATIONS, Point

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
_WIDTH, _HEIGHT = 6.5, 4.5  # of a panel [in]

FILES = tuple(f"curve-{operation}.png" for operation in OPERATIONS)
"""Names of the files that `draw_curves` writes at most."""


def draw_curves(folder: str | Path, points: Sequence[Point], *, overwrite: bool = False) -> list[str]:
    """Draw a PNG for each operation into a folder, with a panel for each device; return the names of the files.

    Settings of the Pareto front are filled and joined by a line; their parameters that differ between the settings are
    named. With `overwrite` existing files may be replaced that no earlier command wrote.
    """
    operations = list(dict.fromkeys(point.operation for point in points))
    names = [f"curve-{operation}.png" for operation in operations]
    with Outputs("curves", overwrite=overwrite).folder(folder) as inside:
        for operation, name in zip(operations, names, strict=True):
            _draw(inside / name, [point for point in points if point.operation == operation])
    return names


def _draw(path: Path, points: Sequence[Point]) -> None:
    devices = list(dict.fromkeys(point.device for point in points))
    figure = new_figure(_WIDTH * len(devices), _HEIGHT)
    for axes, device in zip(figure.subplots(1, len(devices), squeeze=False, sharey=True)[0], devices, strict=True):
        axes.set_title(f"{points[0].operation} on {device}", fontsize=9, loc="left")
        chosen = [point for point in points if point.device == device]
        for colour, data in zip(itertools.cycle(_COLOURS), dict.fromkeys(point.data for point in chosen), strict=False):
            _draw_curve(axes, [point for point in chosen if point.data == data], colour)
        unit = f" [{points[0].unit}]" if points[0].unit else " (relative)"
        axes.set(xlabel="time [ms]", ylabel=f"root mean square error{unit}", xscale="log", yscale="log")
        axes.grid(which="both", alpha=0.2)
        axes.legend(fontsize=7, frameon=False)
    write_png(figure, path)


def _draw_curve(axes: Any, points: Sequence[Point], colour: str) -> None:
    # A logarithmic axis has no place for an error of 0 (the setting that truth was computed with).
    shown = [point for point in points if point.rms > 0.0]
    for point in shown:
        fill = colour if point.best else "none"
        axes.plot(1e3 * point.seconds, point.rms, "o", markersize=4, color=colour, markerfacecolor=fill)
    front = sorted((point for point in shown if point.best), key=lambda point: point.seconds)
    axes.plot([1e3 * each.seconds for each in front], [each.rms for each in front], color=colour, label=points[0].data)
    for point in front:
        place = (1e3 * point.seconds, point.rms)
        axes.annotate(describe(point, points), place, xytext=(4, 3), textcoords="offset points", fontsize=5.5)


def describe(point: Point, points: Sequence[Point]) -> str:
    """Return the parameters of a point that differ between the points, as ``name value``."""
    return ", ".join(
        f"{name} {value}"
        for name, value in point.parameters.items()
        if any(other.parameters.get(name) != value for other in points)
    )
