"""Plots of placements: error over time, final error, delay budget, and repeatability of the measured pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from gpuvision.plots.figure import new_figure, write_png

Float64 = npt.NDArray[np.float64]

_DPI = 120
_BINS = 21


def draw_placements(
    path: str | Path,
    *,
    period: float,
    motion: Sequence[Float64],
    response: Float64,
    error: Float64,
    sigmas: Float64,
    delay: Mapping[str, float],
    tolerance: tuple[float, float],
) -> None:
    """Draw error over time, histograms of the final error with its prediction, and delay budget as PNG.

    Parameters
    ----------
    path : str or Path
        File to write.
    period : float
        Time between two frames [s].
    motion : sequence of numpy.ndarray
        Distance from the target in each frame, (frames, 3) for each placement [m], [m], [rad].
    response : numpy.ndarray
        (frames, 3): errors in each frame by theory, as fractions of the start errors; drawn for the first placement.
    error : numpy.ndarray
        (n, 3): error at the release; NaN where the part was not released.
    sigmas : numpy.ndarray
        (3,): predicted standard deviations of the error.
    delay : mapping of str to float
        Parts of the delay by name [s].
    tolerance : (float, float)
        Tolerances of position [m] and angle [rad].
    """
    figure = new_figure(15.0, 9.2, dpi=_DPI)
    panels = figure.subplot_mosaic([["motion x, y", "error x, y", "delay"], ["motion theta", "error theta", "delay"]])
    for quantity, limit in zip((_POSITION, _ANGLE), tolerance, strict=True):
        coordinates = ", ".join(quantity.names)
        _draw_motion(panels[f"motion {coordinates}"], period, motion, response, limit, quantity)
        _draw_errors(panels[f"error {coordinates}"], error, sigmas, quantity)
    _draw_delay(panels["delay"], delay)
    write_png(figure, path)


def draw_repeatability(
    path: str | Path, *, error: Float64, frame_sigma: Float64, pixel_sigma: Float64, period: float
) -> None:
    """Draw the measured pose of a head at rest over time, with a histogram and the prediction, as PNG.

    Parameters
    ----------
    path : str or Path
        File to write.
    error : numpy.ndarray
        (n, 3): measured pose less the true one [m], [m], [rad].
    frame_sigma : numpy.ndarray
        (3,): predicted standard deviation from frame to frame.
    pixel_sigma : numpy.ndarray
        (3,): predicted standard deviation of the mean error.
    period : float
        Time between two frames [s].
    """
    figure = new_figure(13.0, 9.2, dpi=_DPI)
    panels = figure.subplots(3, 2, width_ratios=(3.0, 1.0), sharey="row", squeeze=False)
    units = (("x", 1e6, "µm"), ("y", 1e6, "µm"), ("theta", 1e3, "mrad"))
    for row, (name, factor, unit) in enumerate(units):
        values, sigma, common = (factor * each for each in (error[:, row], frame_sigma[row], pixel_sigma[row]))
        mean, measured = float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
        time, histogram = panels[row]
        time.plot(1e3 * period * np.arange(len(values)), values, ".", markersize=3)
        time.axhspan(mean - 3.0 * sigma, mean + 3.0 * sigma, color="0.92", zorder=0, label="3 predicted sigmas")
        time.axhline(mean, color="0.4", linewidth=0.8, label=f"mean {mean:.3f} {unit}, predicted sigma {common:.3f}")
        title = f"{name}: sigma {measured:.3f} {unit}, predicted {sigma:.3f} {unit}"
        time.set(ylabel=f"error of {name} [{unit}]", title=title)
        time.legend(fontsize=8, loc="upper right")
        edges = np.linspace(mean - 4.0 * sigma, mean + 4.0 * sigma, _BINS)
        histogram.hist(values, edges.tolist(), orientation="horizontal", histtype="step")
        places = np.linspace(edges[0], edges[-1], 201)
        density = np.exp(-0.5 * ((places - mean) / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
        histogram.plot(len(values) * (edges[1] - edges[0]) * density, places, linestyle="--", label="predicted")
        histogram.legend(fontsize=8)
    panels[2, 0].set_xlabel("time [ms]")
    panels[2, 1].set_xlabel("number of frames")
    write_png(figure, path)


class _Quantity(NamedTuple):
    """Position or angle: names of its coordinates, their columns, and its unit."""

    names: tuple[str, ...]
    columns: slice
    factor: float
    unit: str
    title: str


_POSITION = _Quantity(("x", "y"), slice(0, 2), 1e6, "µm", "distance from the target")
_ANGLE = _Quantity(("theta",), slice(2, 3), 1e3, "mrad", "angle from the target")


def _draw_motion(
    axes: Axes, period: float, motion: Sequence[Float64], response: Float64, tolerance: float, quantity: _Quantity
) -> None:
    for each in motion:
        distance = np.linalg.norm(each[:, quantity.columns], axis=1)
        axes.semilogy(
            1e3 * period * np.arange(len(each)), quantity.factor * distance, color="C0", alpha=0.5, linewidth=0.8
        )
    first = motion[0][0, quantity.columns]
    theory = quantity.factor * np.linalg.norm(first * response[: len(motion[0]), quantity.columns], axis=1)
    axes.semilogy(1e3 * period * np.arange(len(theory)), theory, color="C1", linestyle=":", label="theory, placement 1")
    axes.axhline(quantity.factor * tolerance, color="0.4", linestyle="--", linewidth=0.8, label="tolerance")
    axes.legend(fontsize=8)
    axes.set(xlabel="time [ms]", ylabel=f"{quantity.title} [{quantity.unit}]", title="error over time")


def _draw_errors(axes: Axes, error: Float64, sigmas: Float64, quantity: _Quantity) -> None:
    """Draw outlines of the histograms, which do not hide each other, and the expected numbers of placements."""
    released = quantity.factor * error[np.isfinite(error[:, 0]), quantity.columns]
    predicted = quantity.factor * sigmas[quantity.columns]
    reach = max(4.0 * float(predicted.max()), float(np.abs(released).max(initial=0.0)))
    edges = np.linspace(-reach, reach, _BINS).tolist()
    places = np.linspace(-reach, reach, 401)
    for column, (name, sigma) in enumerate(zip(quantity.names, predicted, strict=True)):
        axes.hist(released[:, column], edges, histtype="step", color=f"C{column}", label=f"{name} measured")
        density = np.exp(-0.5 * (places / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
        expected = len(released) * (edges[1] - edges[0]) * density
        axes.plot(places, expected, color=f"C{column}", linestyle="--", label=f"{name} predicted")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    title = f"{len(released)} placements"
    axes.set(xlabel=f"error at the release [{quantity.unit}]", ylabel="number of placements", title=title)
    axes.legend(fontsize=8)


def _draw_delay(axes: Axes, delay: Mapping[str, float]) -> None:
    start = 0.0
    for number, time in enumerate(delay.values()):
        axes.barh(number, 1e3 * time, left=1e3 * start, color=f"C{number % 10}")
        start += time
    axes.set_yticks(range(len(delay)), list(delay), fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="time [ms]", title=f"delay budget: {1e3 * start:.2f} ms")
