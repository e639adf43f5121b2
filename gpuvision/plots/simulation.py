"""Pictures of a simulation: how far off every sample is, and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gpuvision.host.files import replacing
from gpuvision.plots.range_image import length_unit, round_length
from gpuvision.simulation.errors.error_attribution import ErrorAttribution

Array = npt.NDArray[Any]

_SIZE, _DPI = (8.0, 5.5), 150
_NO_READING, _GOOD = "#4b5563", "#e5e7eb"
# For people who see few colours: of different lightness, too.
_COLOURS = ("#0072b2", "#e69f00", "#cc79a7", "#d55e00", "#009e73", "#56b4e9", "#f0e442", "#000000")


def draw_errors(path: Path, told: ErrorAttribution, title: str) -> None:
    """Draw how far readings are off as PNG; where nothing is read, or nothing is true, it is dark.

    The scale ends at a round length that leaves about 2 % of the samples beyond.
    """
    figure, axes = _page(f"{title}: errors")
    known = np.abs(told.error[np.isfinite(told.error)])
    reach = round_length(2.0 * max(float(np.percentile(known, 98)) if known.size else 0.0, 1e-9))
    unit, name = length_unit(reach)
    shown = axes.imshow(
        told.error / unit,
        cmap="RdBu_r",
        vmin=-reach / unit,
        vmax=reach / unit,
        aspect="auto",
        origin="lower",
        interpolation="nearest",
    )
    axes.set_facecolor(_NO_READING)
    figure.colorbar(shown, label=f"height read less true height [{name}]; dark: no reading", extend="both")
    _write(figure, path)


def draw_causes(path: Path, told: ErrorAttribution, limit: float, title: str) -> None:
    """Draw which cause is to blame for most of every error beyond a limit [m], as PNG."""
    figure, axes = _page(f"{title}: what most of each error comes from")
    names = list(told.causes)
    cause = told.dominant(limit).astype(int)
    cause = np.where(~np.isfinite(told.error) & (cause < 0), -2, cause)
    colours = [_NO_READING, _GOOD, *_COLOURS[: len(names)]]
    entries = ["no reading, or no truth", f"within {1e6 * limit:.1f} µm", *names]
    picture = ListedColormap([to_rgb(each) for each in colours])(cause + 2)
    axes.imshow(picture, aspect="auto", origin="lower", interpolation="nearest")
    parts = [float(np.mean(cause == number - 2)) for number in range(len(entries))]
    handles = [
        Patch(facecolor=colour, edgecolor="#6b7280", label=f"{entry} ({100 * part:.1f} %)")
        for colour, entry, part in zip(colours, entries, parts, strict=True)
        if part > 0.0
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8, frameon=False)
    _write(figure, path)


def _page(title: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xlabel="sample", ylabel="profile")
    axes.set_title(title, fontsize=9, loc="left")
    return figure, axes


def _write(figure: Figure, path: Path) -> None:
    with replacing(path) as file:
        figure.savefig(file, format="png")
