"""Pictures of a simulation: how far off every sample is, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gpuvision.host.files import replacing
from gpuvision.ranging.picture import length_unit, round_length

Array = npt.NDArray[Any]

_SIZE, _DPI = (8.0, 5.5), 150
_NO_READING, _GOOD = "#4b5563", "#e5e7eb"
# For people who see few colours: of different lightness, too.
_COLOURS = ("#0072b2", "#e69f00", "#cc79a7", "#d55e00", "#009e73", "#56b4e9", "#f0e442", "#000000")


def draw_errors(path: Path, error: Array, title: str) -> None:
    """Draw how far readings are off, (profiles, samples) [m], as PNG; NaN, where nothing is read or true, is dark.

    The scale ends at a round length that leaves 2 % of the samples beyond.
    """
    figure, axes = _page(title)
    known = np.abs(error[np.isfinite(error)])
    reach = round_length(2.0 * max(float(np.percentile(known, 98)) if known.size else 0.0, 1e-9))
    unit, name = length_unit(reach)
    shown = axes.imshow(
        error / unit,
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


def draw_causes(path: Path, cause: Array, names: Sequence[str], title: str, *, good: str) -> None:
    """Draw which cause is to blame for most of every sample's error, as PNG.

    Parameters
    ----------
    path
        Where to.
    cause
        (profiles, samples): numbers of names; -1 where the sample is good; -2 where there is no reading.
    names
        Of the causes.
    title
        Over the picture.
    good
        What a good sample is.
    """
    figure, axes = _page(title)
    colours = [_NO_READING, _GOOD, *_COLOURS[: len(names)]]
    entries = ["no reading, or no truth", good, *names]
    picture = ListedColormap([to_rgb(each) for each in colours])(np.asarray(cause) + 2)
    axes.imshow(picture, aspect="auto", origin="lower", interpolation="nearest")
    parts = [float(np.mean(np.asarray(cause) == number - 2)) for number in range(len(entries))]
    handles = [
        Patch(facecolor=colour, edgecolor="#6b7280", label=f"{entry} ({100 * part:.1f} %)")
        for colour, entry, part in zip(colours, entries, parts, strict=True)
        if part > 0.0
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8, frameon=False)
    _write(figure, path)


def draw_growth(path: Path, rows: Mapping[str, tuple[Array, Array]], title: str, axis: str) -> None:
    """Draw how times [s] grow with sizes: a line for each name, on logarithmic scales, as PNG."""
    figure, axes = _page(title)
    for colour, (name, (size, seconds)) in zip(_COLOURS, rows.items(), strict=False):
        axes.loglog(size, seconds, "o-", color=colour, label=name, markersize=4)
    axes.set(xlabel=axis, ylabel="s")
    axes.grid(which="both", alpha=0.2)
    axes.legend(fontsize=8, frameon=False)
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
