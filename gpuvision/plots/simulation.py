"""Pictures of a simulation: range error of each sample, and its dominant cause.

Pictures of several sensors are for comparison: they have a common colour scale (`PictureScale`), a cause has the same
colour in each of them, and the samples run in the direction of increasing g from left to right, whichever way the
sensor reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from gpuvision.plots.figure import new_figure, write_png
from gpuvision.plots.range_image import length_unit, round_length
from gpuvision.simulation.errors.error_attribution import CAUSES, ErrorAttribution

Array = npt.NDArray[Any]

_SIZE = (8.0, 5.5)  # [in]
_NO_READING, _GOOD = "#4b5563", "#e5e7eb"
# Okabe and Ito's palette: distinguishable with colour vision deficiencies, and by lightness. Then, for causes by path,
# colours of Tol's muted palette.
_COLOURS = (
    *("#0072b2", "#e69f00", "#cc79a7", "#d55e00", "#009e73", "#56b4e9", "#f0e442", "#000000"),
    *("#882255", "#332288", "#999933"),
)


class PictureScale(NamedTuple):
    """Scale that the pictures of one or more simulations have in common.

    Attributes
    ----------
    span : float
        Error at the end of the colour scale [m], above 0: a round length.
    limit : float
        Errors up to this limit have no cause in the pictures [m], 0 or more.
    """

    span: float
    limit: float

    @classmethod
    def of(cls, attributions: Sequence[ErrorAttribution], limit: float) -> PictureScale:
        """Return the scale beyond which about 2 % of the samples of all simulations are.

        Parameters
        ----------
        attributions : sequence of ErrorAttribution
            Simulations whose pictures are compared, one or more.
        limit : float
            As in the class.
        """
        error = np.concatenate([each.error.ravel() for each in attributions])
        known = np.abs(error[np.isfinite(error)])
        return cls(round_length(2.0 * max(float(np.percentile(known, 98)) if known.size else 0.0, 1e-9)), limit)


def draw_errors(
    path: Path,
    attribution: ErrorAttribution,
    title: str,
    scale: PictureScale,
    *,
    backward: bool = False,
    overwrite: bool = False,
) -> None:
    """Draw the range error of each sample as a PNG; samples without a reading or without ground truth are dark.

    Parameters
    ----------
    path
        The PNG file.
    attribution
        Errors, (profiles, samples).
    title
        Name of the part or sensor, for the heading.
    scale
        End of the colour scale.
    backward : bool
        Whether the transport decreases with the profile number. Default False.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure, axes = _page(f"{title}: errors")
    unit, name = length_unit(scale.span)
    shown = axes.imshow(
        attribution.error / unit,
        cmap="RdBu_r",
        vmin=-scale.span / unit,
        vmax=scale.span / unit,
        aspect="auto",
        origin="lower",
        interpolation="nearest",
    )
    axes.set_facecolor(_NO_READING)
    _orient(axes, attribution, backward)
    figure.colorbar(shown, label=f"height read minus true height [{name}]; dark: no reading", extend="both")
    write_png(figure, path, overwrite=overwrite)


def draw_causes(
    path: Path,
    attribution: ErrorAttribution,
    title: str,
    scale: PictureScale,
    *,
    backward: bool = False,
    overwrite: bool = False,
) -> None:
    """Draw the dominant cause of each error beyond the limit of the scale as a PNG.

    Parameters
    ----------
    path
        The PNG file.
    attribution
        Errors and their causes, (profiles, samples).
    title
        Name of the part or sensor, for the heading.
    scale
        Limit of the errors without a cause.
    backward : bool
        Whether the transport decreases with the profile number. Default False.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure, axes = _page(f"{title}: dominant cause of each error")
    names = list(attribution.causes)
    cause = attribution.dominant_cause(scale.limit).astype(int)
    cause = np.where(~np.isfinite(attribution.error) & (cause < 0), -2, cause)
    colours = [_NO_READING, _GOOD, *_colours_of(names)]
    entries = ["no reading, or no ground truth", f"within {1e6 * scale.limit:.1f} µm", *names]
    picture = ListedColormap([to_rgb(each) for each in colours])(cause + 2)
    axes.imshow(picture, aspect="auto", origin="lower", interpolation="nearest")
    _orient(axes, attribution, backward)
    parts = [float(np.mean(cause == number - 2)) for number in range(len(entries))]
    handles = [
        Patch(facecolor=colour, edgecolor="#6b7280", label=f"{entry} ({100 * part:.1f} %)")
        for colour, entry, part in zip(colours, entries, parts, strict=True)
        if part > 0.0
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8, frameon=False)
    write_png(figure, path, overwrite=overwrite)


def _colours_of(causes: Sequence[str]) -> list[str]:
    """Return the colours of causes: fixed ones for `CAUSES`, the remaining colours in order for other causes."""
    others = [each for each in causes if each not in CAUSES]
    return [
        _COLOURS[(CAUSES.index(each) if each in CAUSES else len(CAUSES) + others.index(each)) % len(_COLOURS)]
        for each in causes
    ]


def _orient(axes: Axes, attribution: ErrorAttribution, backward: bool) -> None:
    """Let g increase to the right and the transport upwards; the numbers of samples and profiles stay."""
    steps = np.diff(attribution.truth.g, axis=-1)
    if np.isfinite(steps).any() and np.nanmedian(steps) < 0.0:
        axes.invert_xaxis()
    if backward:
        axes.invert_yaxis()


def _page(title: str) -> tuple[Figure, Any]:
    figure = new_figure(*_SIZE)
    axes = figure.add_subplot()
    axes.set(xlabel="sample", ylabel="profile")
    axes.set_title(title, fontsize=9, loc="left")
    return figure, axes
