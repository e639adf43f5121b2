"""Pictures of inspections: volume of each paste deposit, and gap of each lead, over the height map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize

from gpuvision.inspection.apertures import Aperture
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.plots.range_image import height_span, length_unit
from gpuvision.ranging.height_map import Grid

_MM = 1e3
_MOST_PIXELS = 2000  # along a side of the drawn height map; larger maps are thinned out
_MOST_NAMES = 60  # regions with a name in the picture
_PASSED, _FAILED, _UNKNOWN = "#1a1a1a", "#d62728", "#8a8a8a"


def draw_regions(
    path: str | Path,
    z: npt.NDArray[np.floating],
    grid: Grid,
    regions: Sequence[Aperture],
    values: npt.NDArray[np.float64],
    span: tuple[float, float],
    passed: Sequence[bool],
    *,
    title: str,
    label: str,
    colours: str,
    overwrite: bool = False,
) -> None:
    """Draw regions in the colour of their values over the height map in grey, as PNG.

    Parameters
    ----------
    path : str or Path
        File to write.
    z : numpy.ndarray
        Heights [m], (rows, columns); NaN in holes.
    grid : Grid
        Grid of the heights.
    regions : sequence of Aperture
        Regions in the height map.
    values : numpy.ndarray
        Value of each region; NaN regions are hatched.
    span : (float, float)
        Values at the ends of the colour scale.
    passed : sequence of bool
        Whether each region is drawn without a red border.
    title, label : str
        Title of the picture, and label of the colour scale.
    colours : str
        Name of a colour map of matplotlib.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    wide, high = grid.columns * grid.cell_x, grid.rows * grid.cell_y
    figure = new_figure(10.0, min(max(8.5 * high / wide, 3.0), 14.0) + 0.8)
    axes = figure.add_subplot()
    step = max(-(-max(grid.shape) // _MOST_PIXELS), 1)
    low, top = height_span(np.asarray(z, np.float64))
    left, upper = grid.left - grid.cell_x / 2, grid.top + grid.cell_y / 2
    edges = (_MM * left, _MM * (left + wide), _MM * (upper - high), _MM * upper)
    axes.imshow(z[::step, ::step], cmap="gray", vmin=low, vmax=top, extent=edges, interpolation="nearest")
    scale = Normalize(*span, clip=True)
    known = np.isfinite(values)
    filled: Any = None
    for which in (known, ~known):
        chosen = [int(each) for each in np.flatnonzero(which)]
        outlines = [_MM * shape.outline for index in chosen for shape in regions[index].shapes if shape.dark]
        owners = [index for index in chosen for shape in regions[index].shapes if shape.dark]
        borders = [_PASSED if passed[index] else _FAILED for index in owners]
        areas = PolyCollection(outlines, edgecolors=borders, linewidths=1.0)
        if which is known:
            areas.set(array=values[owners], cmap=colours, norm=scale)
            filled = areas
        else:
            areas.set(facecolors=_UNKNOWN, hatch="///")
        axes.add_collection(areas)
    if len(regions) <= _MOST_NAMES:
        for each in regions:
            axes.annotate(each.name, tuple(_MM * each.centroid), color=_PASSED, fontsize=6, ha="center", va="center")
    figure.colorbar(filled, ax=axes, label=label, shrink=0.8)
    unit, name = length_unit(max(abs(low), abs(top)))
    axes.set(xlabel="x [mm]", ylabel="y [mm]", xlim=edges[:2], ylim=edges[2:], aspect="equal")
    axes.set_title(f"{title}\ngrey: heights {low / unit:.3g} to {top / unit:.3g} {name}", fontsize=8, loc="left")
    write_png(figure, path, overwrite=overwrite)
