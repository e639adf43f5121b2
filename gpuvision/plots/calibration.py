"""A picture of a calibration: where the points lie off, and what the lens does to the image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gpuvision.camera.calibration import Calibration
from gpuvision.host.files import replacing

_DPI = 150
# An arrow of the largest usual residual is so long, in parts of the image's width.
_ARROW = 0.02
_ARROWS = 21
_MOST_POINTS = 20_000


def draw_calibration(path: str | Path, calibration: Calibration) -> None:
    """Draw residuals and distortion beside each other, as PNG, whole or not at all."""
    figure = Figure(figsize=(13.0, 5.6), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _draw_residuals(left, calibration)
    _draw_distortion(right, calibration)
    for axes in (left, right):
        columns, rows = calibration.image_size
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
        axes.set(xlabel="column [px]", ylabel="row [px]")
    figure.suptitle(calibration.summary(), fontsize=9, x=0.01, ha="left")
    with replacing(path) as file:
        figure.savefig(file, format="png")


def _draw_residuals(axes: Axes, calibration: Calibration) -> None:
    points = np.concatenate([each for each, _ in calibration.residuals])
    off = np.concatenate([each for _, each in calibration.residuals])
    size = np.abs(off) if off.ndim == 1 else np.hypot(off[:, 0], off[:, 1])
    known = np.flatnonzero(np.isfinite(size))
    known = known[:: max(len(known) // _MOST_POINTS, 1)]
    usual = max(float(np.percentile(size[known], 98)), float(np.finfo(np.float32).tiny))
    # The largest last, on top.
    known = known[np.argsort(size[known])]
    x, y = points[known].T
    shown: Any
    if off.ndim == 1:
        shown = axes.scatter(x, y, c=size[known], s=5.0, cmap="viridis", vmin=0.0, vmax=usual, linewidths=0.0)
        axes.set_title("distance of the points from their lines", fontsize=9)
    else:
        u, v = off[known].T * (_ARROW * calibration.image_size[0] / usual)
        shown = axes.quiver(
            x, y, u, v, size[known], cmap="viridis", clim=(0.0, usual), angles="xy", scale_units="xy", scale=1.0,
            width=1.5e-3,
        )  # fmt: skip
        axes.set_title(
            f"seen less projected, {_ARROW * calibration.image_size[0] / usual:.3g} times as long", fontsize=9
        )
    axes.figure.colorbar(shown, ax=axes, label="residual [px]", extend="max", shrink=0.8)


def _draw_distortion(axes: Axes, calibration: Calibration) -> None:
    columns, rows = calibration.image_size
    model: Any = calibration.model
    x, y = np.meshgrid(np.linspace(0.0, columns - 1.0, 161), np.linspace(0.0, rows - 1.0, 121))
    measured = np.stack([x, y], axis=-1)
    moved = np.zeros_like(measured) if model is None else model.undistort(measured) - measured
    size = np.hypot(moved[..., 0], moved[..., 1])
    if np.nanmax(size) > 0.0:
        shown = axes.contourf(x, y, size, levels=12, cmap="cividis")
        axes.figure.colorbar(shown, ax=axes, label="correction [px]", shrink=0.8)
        some = (slice(None, None, -(-120 // _ARROWS)), slice(None, None, -(-160 // _ARROWS)))
        axes.quiver(
            x[some], y[some], moved[(*some, 0)], moved[(*some, 1)], angles="xy", scale_units="xy", color="white",
            width=1.8e-3,
        )  # fmt: skip
    _mark_centre(axes, calibration)
    axes.set_title("what the model corrects: from measured to ideal places", fontsize=9)


def _mark_centre(axes: Axes, calibration: Calibration) -> None:
    """Mark the centre of distortion with its standard deviations."""
    parameters = calibration.parameters
    for names in (("C_c", "R_c"), ("cx", "cy")):
        if names[0] in parameters and names[1] in parameters:
            (column, column_error), (row, row_error) = (parameters[each] for each in names)
            axes.errorbar(column, row, yerr=row_error, xerr=column_error, fmt="+", color="red", capsize=3.0)
