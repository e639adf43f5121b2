"""Pictures of a simulation: range error of each sample, and its dominant cause."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gpuvision.host.files import atomic_write
from gpuvision.plots.range_image import length_unit, round_length
from gpuvision.simulation.errors.error_attribution import ErrorAttribution

Array = npt.NDArray[Any]

_SIZE, _DPI = (8.0, 5.5), 150
_NO_READING, _GOOD = "#4b5563", "#e5e7eb"
# Okabe and Ito's palette: distinguishable with colour vision deficiencies, and by lightness.
_COLOURS = ("#0072b2", "#e69f00", "#cc79a7", "#d55e00", "#009e73", "#56b4e9", "#f0e442", "#000000")


def draw_errors(path: Path, attribution: ErrorAttribution, title: str, *, overwrite: bool = False) -> None:
    """Draw the range error of each sample as a PNG; samples without a reading or without ground truth are dark.

    Parameters
    ----------
    path
        The PNG file.
    attribution
        Errors, (profiles, samples).
    title
        Name of the part or sensor, for the heading.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Notes
    -----
    The colour scale ends at a round length, so that about 2 % of the samples are beyond the scale.
    """
    figure, axes = _page(f"{title}: errors")
    known = np.abs(attribution.error[np.isfinite(attribution.error)])
    reach = round_length(2.0 * max(float(np.percentile(known, 98)) if known.size else 0.0, 1e-9))
    unit, name = length_unit(reach)
    shown = axes.imshow(
        attribution.error / unit,
        cmap="RdBu_r",
        vmin=-reach / unit,
        vmax=reach / unit,
        aspect="auto",
        origin="lower",
        interpolation="nearest",
    )
    axes.set_facecolor(_NO_READING)
    figure.colorbar(shown, label=f"height read minus true height [{name}]; dark: no reading", extend="both")
    _write(figure, path, overwrite)


def draw_causes(
    path: Path, attribution: ErrorAttribution, limit: float, title: str, *, overwrite: bool = False
) -> None:
    """Draw the dominant cause of each error beyond a limit as a PNG.

    Parameters
    ----------
    path
        The PNG file.
    attribution
        Errors and their causes, (profiles, samples).
    limit
        Errors up to this limit have no cause in the picture [m].
    title
        Name of the part or sensor, for the heading.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure, axes = _page(f"{title}: dominant cause of each error")
    names = list(attribution.causes)
    cause = attribution.dominant_cause(limit).astype(int)
    cause = np.where(~np.isfinite(attribution.error) & (cause < 0), -2, cause)
    colours = [_NO_READING, _GOOD, *_COLOURS[: len(names)]]
    entries = ["no reading, or no ground truth", f"within {1e6 * limit:.1f} µm", *names]
    picture = ListedColormap([to_rgb(each) for each in colours])(cause + 2)
    axes.imshow(picture, aspect="auto", origin="lower", interpolation="nearest")
    parts = [float(np.mean(cause == number - 2)) for number in range(len(entries))]
    handles = [
        Patch(facecolor=colour, edgecolor="#6b7280", label=f"{entry} ({100 * part:.1f} %)")
        for colour, entry, part in zip(colours, entries, parts, strict=True)
        if part > 0.0
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8, frameon=False)
    _write(figure, path, overwrite)


def _page(title: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xlabel="sample", ylabel="profile")
    axes.set_title(title, fontsize=9, loc="left")
    return figure, axes


def _write(figure: Figure, path: Path, overwrite: bool) -> None:
    with atomic_write(path, overwrite=overwrite) as file:
        figure.savefig(file, format="png")
