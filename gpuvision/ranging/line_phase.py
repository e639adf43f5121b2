"""Error of the line position by the phase of the line in its pixel: the same for all noise, and in all frames.

A peak estimator reads a line from samples one pixel apart. Its error without noise depends on the place of the line
between two pixels (the S-curve), and on the line: where a threshold cuts the flanks of the line, a sample enters or
leaves the sum as the line moves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.special

from gpuvision.host import Device, to_numpy
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet import SampleAxes

Float64 = npt.NDArray[np.float64]

# Phases at which a line is read, and peaks between which the error is interpolated. Chosen: the mean square over 64
# phases has every harmonic of the error up to the 31st. The error oscillates with the width of the line over the
# threshold, a period per pixel.
_PHASES, _PEAKS = 64, 48
# Samples whose peak is this close to the median peak determine the shape of the line. Chosen: one surface.
_SAME_SURFACE = 0.2
# Part of the peaks, at either end, that the table of peaks leaves out. Chosen.
_TAIL = 0.01
# Half widths of the line over the threshold, in standard deviations of the line, among which the shape is sought.
_HALF_WIDTHS = np.linspace(0.3, 6.0, 400)


class LineShape(NamedTuple):
    """Gaussian laser line in a profile.

    Attributes
    ----------
    sigma : float
        Standard deviation of the line [px].
    background : float
        Level beside the line [grey levels].
    """

    sigma: float
    background: float


def estimate_line_shape(
    peak: npt.ArrayLike, width: npt.ArrayLike, total: npt.ArrayLike, threshold: float
) -> LineShape | None:
    """Estimate the shape of the line from the outputs of its readout.

    Parameters
    ----------
    peak, width, total : array_like
        Outputs of `gpuvision.LineReadout` of good samples, of one shape: largest sample [grey levels], number of
        samples over the threshold, and sum of the light over the threshold [grey levels].
    threshold : float
        Threshold of the readout [grey levels].

    Returns
    -------
    LineShape or None
        None without a sample whose line exceeds the threshold.

    Notes
    -----
    A Gaussian of amplitude A and standard deviation s over a level b exceeds the threshold ``t = b + A q``,
    ``q = exp(-a^2 / 2)``, over the width ``2 a s``. The largest of its samples has the mean ``b + A m``, where m is the
    mean of the Gaussian over the pixel of the peak. Total over peak less threshold and width is thus a function of a:
    ``(sqrt(2 pi) erf(a / sqrt 2) - 2 a q) / (2 a (m - q))``.
    """
    levels, widths, sums = (np.asarray(each, np.float64).ravel() for each in (peak, width, total))
    lit = np.isfinite(levels) & np.isfinite(sums) & (levels > threshold) & (widths > 0)
    if not lit.any():
        return None
    middle = float(np.median(levels[lit]))
    lit &= np.abs(levels - middle) <= _SAME_SURFACE * (middle - threshold)
    # A whole number exceeds a whole threshold where the level before rounding exceeds it by half a grey level.
    rounding = 0.5 if np.all(levels[lit] == np.rint(levels[lit])) and threshold == round(threshold) else 0.0
    edge = threshold + rounding
    over, run, light = (float(np.mean(each[lit])) for each in (levels - edge, widths, sums - rounding * widths))
    cut = np.exp(-0.5 * _HALF_WIDTHS**2)
    area = math.sqrt(2.0 * math.pi) * scipy.special.erf(_HALF_WIDTHS / math.sqrt(2.0)) - 2.0 * _HALF_WIDTHS * cut
    sigmas = 0.5 * run / _HALF_WIDTHS
    top = math.sqrt(2.0 * math.pi) * sigmas * scipy.special.erf(0.5 / (math.sqrt(2.0) * sigmas))
    best = np.argmin(np.abs(area / (2.0 * _HALF_WIDTHS * (top - cut)) - light / (over * run)))
    amplitude = over / (top[best] - cut[best])
    return LineShape(float(sigmas[best]), float(edge - amplitude * cut[best]))


def phase_error(
    readout: LineReadout, shape: LineShape, peak: npt.ArrayLike, device: Device | None = None
) -> Float64 | None:
    """Compute the root mean square error of the line position over the phases of the line in its pixel.

    The readout reads Gaussian lines without noise at 64 phases, for 48 peaks; other peaks are interpolated.

    Parameters
    ----------
    readout : LineReadout
        Readout; its triangulation has no effect.
    shape : LineShape
        Shape of the line, see `estimate_line_shape`.
    peak : array_like
        Peaks of the samples [grey levels]; NaN is not read.
    device : Device, optional
        Default `Device.best`.

    Returns
    -------
    numpy.ndarray or None
        Error of each sample [px], float64 of the shape of ``peak``. None if no line of the table can be read.

    Notes
    -----
    Systematic: lines at one place in their pixel have one error. A part without noise that is flat and parallel to the
    transport repeats it in all profiles. For lines of another shape it is an estimate.

    References
    ----------
    R. B. Fisher and D. K. Naidu, A comparison of algorithms for subpixel peak detection, in Image Technology, Springer
    1996: errors of peak estimators over the phase.
    """
    levels = np.asarray(peak, np.float64)
    known = levels[np.isfinite(levels)]
    if not known.size:
        return None
    low, high = np.quantile(known, [_TAIL, 1.0 - _TAIL])
    table = np.unique(np.linspace(low, high, _PEAKS))
    reach = readout.window + readout.fir_length + math.ceil(6.0 * shape.sigma)
    true = reach + (np.arange(_PHASES) + 0.5) / _PHASES
    distance = np.arange(2 * reach + 2)[:, None] - true
    line = np.exp(-0.5 * (distance / shape.sigma) ** 2)
    amplitudes = (table - shape.background) / np.max(line, axis=0).mean()
    frames = (shape.background + amplitudes[:, None, None] * line).astype(np.float32)
    if readout.along == "rows":
        frames = np.ascontiguousarray(frames.swapaxes(1, 2))
    bare: Any = replace(
        readout, triangulation=None, axes=SampleAxes(), outputs=("position",), precision="single", saturation=None
    )
    error = to_numpy(bare(frames, device=device).position).astype(np.float64) - true
    read = np.isfinite(error).all(axis=1)
    if not read.any():
        return None
    rms = np.sqrt(np.mean(error[read] ** 2, axis=1))
    return np.asarray(np.interp(levels, table[read], rms))
