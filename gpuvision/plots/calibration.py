"""Plot of a calibration: residuals of the points, the distortion over the image, and its uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from gpuvision.camera.calibration import Calibration
from gpuvision.plots.figure import new_figure, write_png

# Length of the arrow of a 98th percentile residual, as a fraction of the image's width.
_ARROW_LENGTH = 0.02
# Distortion arrows along an image side.
_ARROW_COUNT = 21
# Above this count, every n-th residual is drawn.
_MAX_POINTS = 20_000
# Percentile of the residuals at the upper end of the colour scale.
_SCALE_PERCENTILE = 98


def draw_calibration(path: str | Path, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Draw residuals, distortion and its uncertainty side by side as PNG. On an error no file is left behind.

    Parameters
    ----------
    path : str or Path
        File to write.
    calibration : Calibration
        Calibration to draw.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(19.0, 5.6)
    panels = figure.subplots(1, 3)
    _draw_residuals(panels[0], calibration)
    _draw_distortion(panels[1], calibration)
    _draw_uncertainty(panels[2], calibration)
    for axes in panels:
        columns, rows = calibration.image_size
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
        axes.set(xlabel="column [px]", ylabel="row [px]")
    figure.suptitle(calibration.summary(), fontsize=9, x=0.01, ha="left")
    write_png(figure, path, overwrite=overwrite)


def _draw_residuals(axes: Axes, calibration: Calibration) -> None:
    points = np.concatenate([each for each, _ in calibration.residuals])
    errors = np.concatenate([each for _, each in calibration.residuals])
    size = np.abs(errors) if errors.ndim == 1 else np.hypot(errors[:, 0], errors[:, 1])
    known = np.flatnonzero(np.isfinite(size))
    known = known[:: max(len(known) // _MAX_POINTS, 1)]
    largest = max(float(np.percentile(size[known], _SCALE_PERCENTILE)), float(np.finfo(np.float32).tiny))
    # Draw the largest residuals last, on top.
    known = known[np.argsort(size[known])]
    x, y = points[known].T
    shown: Any
    if errors.ndim == 1:
        shown = axes.scatter(x, y, c=size[known], s=5.0, cmap="viridis", vmin=0.0, vmax=largest, linewidths=0.0)
        axes.set_title("distance of the points from their lines", fontsize=9)
    else:
        magnification = _ARROW_LENGTH * calibration.image_size[0] / largest
        u, v = errors[known].T * magnification
        shown = axes.quiver(
            x, y, u, v, size[known], cmap="viridis", clim=(0.0, largest), angles="xy", scale_units="xy", scale=1.0,
            width=1.5e-3,
        )  # fmt: skip
        axes.set_title(f"measured minus projected, magnified {magnification:.3g} times", fontsize=9)
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
        some = (slice(None, None, -(-120 // _ARROW_COUNT)), slice(None, None, -(-160 // _ARROW_COUNT)))
        axes.quiver(
            x[some], y[some], moved[(*some, 0)], moved[(*some, 1)], angles="xy", scale_units="xy", color="white",
            width=1.8e-3,
        )  # fmt: skip
    _mark_centre(axes, calibration)
    axes.set_title("correction by the model: from measured to ideal positions", fontsize=9)


def _draw_uncertainty(axes: Axes, calibration: Calibration) -> None:
    found = calibration.correction_map
    x, y = np.moveaxis(found.points, -1, 0)
    known = np.isfinite(found.sigma_px)
    largest = float(found.sigma_px[known].max()) if known.any() else 0.0
    if largest > 0.0:
        least = max(float(found.sigma_px[known].min()), 1e-3 * largest)
        # Distinct levels, also where all uncertainties are equal.
        levels = np.geomspace(least, max(largest, 1.001 * least), 13)
        shown = axes.contourf(
            x, y, np.ma.masked_where(~known, np.maximum(found.sigma_px, least)), levels=levels,
            cmap="cividis", norm=LogNorm(levels[0], levels[-1]), extend="max",
        )  # fmt: skip
        axes.figure.colorbar(shown, ax=axes, label="1 sigma of the correction [px]", shrink=0.8, format="%.2g")
    axes.contourf(
        x, y, found.extrapolated.astype(float), levels=[0.5, 1.5], colors="none", hatches=["///"]
    )  # fmt: skip
    axes.set_title("uncertainty of the correction; hatched: extrapolated", fontsize=9)


def _mark_centre(axes: Axes, calibration: Calibration) -> None:
    """Draw the distortion centre with its standard deviations as error bars."""
    parameters = calibration.parameters
    for names in (("C_c", "R_c"), ("cx", "cy")):
        if names[0] in parameters and names[1] in parameters:
            (column, column_error), (row, row_error) = (parameters[each] for each in names)
            axes.errorbar(column, row, yerr=row_error, xerr=column_error, fmt="+", color="red", capsize=3.0)
