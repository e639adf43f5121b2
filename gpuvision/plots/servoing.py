"""Pictures of a servo loop: budget of the delay, step response, root locus, delay over frame time, measured delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from gpuvision.plots.figure import new_figure, write_png
from gpuvision.servoing.delay_measurement import MeasuredDelay
from gpuvision.servoing.delay_response import FrameTimeCurve

Float64 = npt.NDArray[np.float64]

_MS = 1e3


@dataclass(frozen=True, kw_only=True)
class DelayPicture:
    """Data of the picture of a delay.

    Attributes
    ----------
    title : str
        Summary of the analysis.
    parts : mapping of str to float
        Parts of the total delay [s].
    steps : sequence of (str, numpy.ndarray)
        Label and error in each frame of step responses.
    locus : numpy.ndarray
        (m, order): complex roots for rising gains.
    marked : sequence of (str, numpy.ndarray)
        Label and roots (order,) of the gains to mark.
    curve : FrameTimeCurve
        Delay and bandwidth against the frame time.
    period : float
        Frame time of the loop [s].
    """

    title: str
    parts: Mapping[str, float]
    steps: Sequence[tuple[str, Float64]]
    locus: npt.NDArray[np.complex128]
    marked: Sequence[tuple[str, npt.NDArray[np.complex128]]]
    curve: FrameTimeCurve
    period: float


def draw_delay(path: str | Path, picture: DelayPicture, *, overwrite: bool = False) -> None:
    """Draw budget, step response, root locus and delay against frame time of a loop, as PNG.

    Parameters
    ----------
    path : str or Path
        File to write. On an error no file is left behind.
    picture : DelayPicture
        Data to draw.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(12.0, 8.5)
    (budget, step), (locus, curve) = figure.subplots(2, 2)
    _draw_budget(budget, picture)
    _draw_steps(step, picture)
    _draw_locus(locus, picture)
    _draw_curve(curve, picture)
    figure.suptitle(picture.title, fontsize=9, x=0.01, ha="left")
    write_png(figure, path, overwrite=overwrite)


def draw_measured_delay(
    path: str | Path,
    time: Float64,
    command: Float64,
    measured: Float64,
    delay: MeasuredDelay,
    *,
    overwrite: bool = False,
) -> None:
    """Draw commanded and measured positions, and the distribution of the delay if it has jitter, as PNG.

    Parameters
    ----------
    path : str or Path
        File to write. On an error no file is left behind.
    time, command, measured : numpy.ndarray
        (n,) samples of the recording [s], [m], [m].
    delay : MeasuredDelay
        Delay of the recording.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(12.0, 4.5)
    # Without jitter all samples have the same delay: no histogram.
    differ = delay.delays.size > 0
    left, *right = figure.subplots(1, 2 if differ else 1, width_ratios=(2, 1) if differ else (1,), squeeze=False)[0]
    unit = 1e6
    left.plot(_MS * time, unit * command, color="tab:blue", linewidth=0.9, label="commanded")
    left.plot(_MS * (time + delay.mean), unit * command, color="tab:blue", linewidth=0.7, ls=":", label="delayed")
    left.plot(_MS * time, unit * measured, ".", color="tab:red", markersize=2.0, label="measured")
    left.set(xlabel="time [ms]", ylabel="position [um] or [urad]")
    left.legend(fontsize=7)
    for axes in right:
        axes.hist(_MS * delay.delays, bins=40, color="tab:grey")
        axes.axvline(_MS * delay.mean, color="tab:red", linewidth=1.0)
        axes.set(xlabel="delay of single samples [ms]", ylabel="number of samples")
    figure.suptitle(
        f"delay {_MS * delay.mean:.4g} ms ({delay.frames:.3g} frames), sigma {_MS * delay.mean_sigma:.2g} ms; "
        f"jitter {_MS * delay.jitter:.2g} ms",
        fontsize=9,
        x=0.01,
        ha="left",
    )
    write_png(figure, path, overwrite=overwrite)


def _draw_budget(axes: Axes, picture: DelayPicture) -> None:
    left = 0.0
    for name, time in picture.parts.items():
        axes.barh([name], [_MS * time], left=_MS * left)
        left += time
    axes.invert_yaxis()
    axes.set(xlabel="time since the middle of the exposure [ms]", title=f"total delay {_MS * left:.4g} ms")


def _draw_steps(axes: Axes, picture: DelayPicture) -> None:
    for label, errors in picture.steps:
        axes.plot(errors, ".-", linewidth=0.9, markersize=4.0, label=label)
    axes.axhline(0.0, color="black", linewidth=0.5)
    axes.set(xlabel="frame", ylabel="error / step", title="step response")
    axes.legend(fontsize=7)


def _draw_locus(axes: Axes, picture: DelayPicture) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    axes.plot(np.cos(angle), np.sin(angle), color="black", linewidth=0.5)
    axes.plot(picture.locus.real.ravel(), picture.locus.imag.ravel(), ".", color="tab:grey", markersize=1.5)
    for label, roots in picture.marked:
        axes.plot(roots.real, roots.imag, "o", markersize=4.0, label=label)
    axes.set(xlabel="Re z", ylabel="Im z", title="root locus", aspect="equal", xlim=(-1.6, 1.6), ylim=(-1.3, 1.3))
    axes.legend(fontsize=7)


def _draw_curve(axes: Axes, picture: DelayPicture) -> None:
    curve = picture.curve
    axes.plot(_MS * curve.period, _MS * curve.total, color="tab:blue")
    axes.set_xscale("log")
    axes.set(xlabel="frame time [ms]", title="delay against frame time, latency unchanged")
    axes.set_ylabel("total delay [ms]", color="tab:blue")
    axes.axvline(_MS * picture.period, color="tab:grey", linewidth=0.8, ls=":")
    beside = axes.twinx()
    beside.plot(_MS * curve.period, curve.bandwidth, color="tab:red")
    beside.set_ylabel("bandwidth without oscillation [Hz]", color="tab:red")
