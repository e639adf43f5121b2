"""Plots of placements: error over time, final error against prediction, and the delay budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gpuvision.host.files import atomic_write

Float64 = npt.NDArray[np.float64]

_DPI = 120
_BINS = 21


def draw_placements(
    path: str | Path,
    *,
    period: float,
    motion: Sequence[Float64],
    error: Float64,
    sigmas: Float64,
    delay: Mapping[str, float],
    tolerance: float,
) -> None:
    """Draw error over time, histogram of the final error with its prediction, and delay budget as PNG.

    Parameters
    ----------
    path : str or Path
        File to write.
    period : float
        Time between two frames [s].
    motion : sequence of numpy.ndarray
        Distance from the target in each frame, (frames, 3) for each placement [m], [m], [rad].
    error : numpy.ndarray
        (n, 3): error at the release; NaN where the part was not released.
    sigmas : numpy.ndarray
        (3,): predicted standard deviations of the error.
    delay : mapping of str to float
        Parts of the delay by name [s].
    tolerance : float
        Tolerance of the position [m].
    """
    figure = Figure(figsize=(15.0, 4.6), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3)
    _draw_motion(panels[0], period, motion, tolerance)
    _draw_errors(panels[1], error, sigmas)
    _draw_delay(panels[2], delay)
    with atomic_write(path) as file:
        figure.savefig(file, format="png")


def _draw_motion(axes: Axes, period: float, motion: Sequence[Float64], tolerance: float) -> None:
    for each in motion:
        distance = np.hypot(each[:, 0], each[:, 1])
        axes.semilogy(1e3 * period * np.arange(len(each)), 1e6 * distance, color="C0", alpha=0.5, linewidth=0.8)
    axes.axhline(1e6 * tolerance, color="0.4", linestyle="--", linewidth=0.8, label="tolerance")
    axes.set(xlabel="time [ms]", ylabel="distance from the target [µm]", title="error over time")
    axes.legend(fontsize=8)


def _draw_errors(axes: Axes, error: Float64, sigmas: Float64) -> None:
    released = error[np.isfinite(error[:, 0]), :2]
    reach = 1e6 * max(4.0 * float(sigmas[:2].max()), float(np.abs(released).max(initial=0.0)))
    edges = np.linspace(-reach, reach, _BINS).tolist()
    places = np.linspace(-reach, reach, 401)
    for column, name in enumerate("xy"):
        axes.hist(1e6 * released[:, column], edges, alpha=0.5, color=f"C{column}", label=f"{name} measured")
        sigma = 1e6 * sigmas[column]
        density = np.exp(-0.5 * (places / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
        expected = len(released) * (edges[1] - edges[0]) * density
        axes.plot(places, expected, color=f"C{column}", label=f"{name} predicted")
    axes.set(xlabel="error at the release [µm]", ylabel="placements", title=f"{len(released)} placements")
    axes.legend(fontsize=8)


def _draw_delay(axes: Axes, delay: Mapping[str, float]) -> None:
    start = 0.0
    for number, time in enumerate(delay.values()):
        axes.barh(number, 1e3 * time, left=1e3 * start, color=f"C{number % 10}")
        start += time
    axes.set_yticks(range(len(delay)), list(delay), fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="time [ms]", title=f"delay budget: {1e3 * start:.2f} ms")
