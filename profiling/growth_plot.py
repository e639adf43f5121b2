"""Picture of time against size: a pane for each device, a curve for each operation, with its knees."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpuvision.host.outputs import Outputs
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.profiling.growth import Growth, cache_knee, launch_knee

_SIZE = (9.0, 4.6)  # [in]
_COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#000000",
    "#7f7f7f",
    "#8c564b",
    "#9467bd",
    "#bcbd22",
)
NAME = "sizes.png"
"""Name of the file that `draw_growth` writes."""


def draw_growth(folder: str | Path, growth: Growth, *, overwrite: bool = False) -> str:
    """Draw the curves into a folder, as PNG; return the name of the file.

    A triangle marks the launch knee of a curve, a square its cache knee.

    Raises
    ------
    ValueError
        There are no points.
    """
    if not growth.points:
        raise ValueError("no points to draw: no size of the operations was measured")
    devices = list(dict.fromkeys(point.device for point in growth.points))
    names = list(dict.fromkeys(point.operation for point in growth.points))
    figure = new_figure(*_SIZE)
    for axes, device in zip(figure.subplots(1, len(devices), squeeze=False, sharey=True)[0], devices, strict=True):
        for number, name in enumerate(names):
            curve = growth.curves.get((name, device), [])
            if not curve:
                continue
            items, seconds = (np.array([getattr(point, key) for point in curve]) for key in ("items", "seconds"))
            colour = _COLOURS[number % len(_COLOURS)]
            axes.loglog(items, 1e3 * seconds, "-", color=colour, linewidth=1.2, label=f"{name} [{curve[0].item}s]")
            knees = (launch_knee(curve), cache_knee(curve, growth.caches[device]))
            for knee, marker in zip(knees, ("^", "s"), strict=True):
                if knee is not None:
                    time = np.exp(np.interp(np.log(knee), np.log(items), np.log(1e3 * seconds)))
                    axes.loglog(knee, time, marker, color=colour, markersize=5)
        axes.set_title(f"{device}: triangle twice the launch, square cache full", fontsize=9, loc="left")
        axes.set(xlabel="items", ylabel="time of a call [ms]")
        axes.grid(which="both", alpha=0.2)
        axes.legend(fontsize=6.5, frameon=False)
    with Outputs("profile", overwrite=overwrite).folder(folder) as inside:
        write_png(figure, inside / NAME)
    return NAME
