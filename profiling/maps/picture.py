"""Pictures of stability maps: measured error in colour, and the borders of the regions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gpuvision.host.outputs import Outputs
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.profiling.maps.stability import LIMITS, OPERATIONS, StabilityMap

_WIDTH, _HEIGHT = 5.5, 4.3  # of a panel [in]
_COLOURS = ("white", "black")  # of the borders, for LIMITS
_DECADES = (-9.0, 0.0)  # range of the colours

FILES = tuple(f"map-{operation}.png" for operation in OPERATIONS)
"""Names of the files that `draw_maps` writes at most."""


def draw_maps(folder: str | Path, maps: Sequence[StabilityMap], *, overwrite: bool = False) -> list[str]:
    """Draw a PNG for each operation into a folder, with a panel for each device; return the names of the files.

    Solid lines are borders of the regions as measured, dashed lines as the error model predicts them. Places without a
    value are grey. With `overwrite` existing files may be replaced that no earlier command wrote.
    """
    operations = list(dict.fromkeys(each.operation for each in maps))
    names = [f"map-{operation}.png" for operation in operations]
    with Outputs("curves", overwrite=overwrite).folder(folder) as inside:
        for operation, name in zip(operations, names, strict=True):
            _draw(inside / name, [each for each in maps if each.operation == operation])
    return names


def _draw(path: Path, maps: Sequence[StabilityMap]) -> None:
    figure = new_figure(_WIDTH * len(maps), _HEIGHT)
    for axes, each in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
        measured, allowed = (np.log10(np.maximum(values, 1e-12)) for values in (each.errors, each.bounds))
        axes.set_facecolor("0.6")
        shown = axes.pcolormesh(each.x, each.y, measured, vmin=_DECADES[0], vmax=_DECADES[1], shading="nearest")
        for limit, colour in zip(LIMITS, _COLOURS, strict=True):
            for values, style in ((np.nan_to_num(measured, nan=_DECADES[1]), "solid"), (allowed, "dashed")):
                if values.min() < np.log10(limit) < values.max():
                    axes.contour(each.x, each.y, values, [np.log10(limit)], colors=colour, linestyles=style)
        axes.set(
            xscale="log" if each.axes[0].logarithmic else "linear",
            yscale="log" if each.axes[1].logarithmic else "linear",
            xlabel=each.axes[0].name,
            ylabel=each.axes[1].name,
        )
        axes.set_title(
            f"{each.operation} on {each.device}: error / {each.relative_to}\n"
            "borders: 1e-6 white, 1e-3 black; dashed: error model",
            fontsize=8,
            loc="left",
        )
        figure.colorbar(shown, ax=axes, label="log10 of the largest relative error")
    write_png(figure, path)
