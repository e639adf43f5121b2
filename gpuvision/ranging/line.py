"""Laser line readout: a camera image of a sheet of light becomes one sub-pixel line position per column (or row).

The laser line crosses the frame along its columns axis (``along="columns"``: one row coordinate per column) or along
its rows axis (``along="rows"``: one column coordinate per row). One such column or row of samples is a *profile*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gpuvision.host import Device, Launch, LaunchBuilder
from gpuvision.operation import VisionOperation
from gpuvision.ranging.line_launch import LONGEST_PROFILE, LineLaunch
from gpuvision.ranging.line_parameters import LineParameters, LineReading


@dataclass(frozen=True, kw_only=True)
class LineReadout(LineParameters, VisionOperation[LineReading]):
    """Laser line readout: peak (centroid, Gaussian fit, derivative filter) of every column: ``readout(frames)``.

    Takes uint8, uint16 or float32 frames of shape (..., rows, columns) and returns a `LineReading`. The *light* of a
    sample is the part of its value above the threshold. If several samples of a profile are equally large, the first
    one is the peak. Neighbours that equal the peak form a flat top with it; the window is centred on the middle of the
    flat top. For a flat top wider than the window that middle is the position, with the flag AMBIGUOUS.

    Parameters
    ----------
    method : {"windowed", "centroid", "gauss3", "fir", "ml"}
        Peak estimator, default ``"windowed"``:

        - ``"centroid"``: centroid (centre of gravity) of all light in the profile.
        - ``"windowed"``: centroid of the light in a window around the peak.
        - ``"gauss3"``: parabola through the logarithms of the peak and its two neighbours (a Gaussian) [2]_.
        - ``"fir"``: zero crossing of a derivative filter [1]_.
        - ``"ml"``: maximum-likelihood fit of a pixel-integrated Gaussian on an unknown constant background, for noise
          of variance ``read_noise**2 + gain * level``.
    along : {"columns", "rows"}
        Image axis along which the line runs, default ``"columns"``: each column is a profile.
    threshold : float
        Level below which a sample has no light [grey levels], 0 or more, default 0; an integer for integer frames.
    window : int
        Number of samples on either side of the peak in its window, 1 to 180, default 8.
    peak_selection : {"strongest", "first", "last", "nearest"}
        Peak to take where a profile has several, default ``"strongest"``. A peak is the largest sample of a run of
        samples above the threshold. ``"nearest"``: nearest to the position of an earlier reading. This position is a
        second input of shape (..., samples) in the readout's precision; it is rounded to whole pixels; where it is NaN,
        the strongest peak is taken.
    minimum_peak : float, optional
        Smallest sample value that can be a peak [grey levels], the threshold or more.
    minimum_width, maximum_width : int
        Limits on the length of the run of samples above the threshold (for ``"centroid"``: on their number) [px].
        Default 1 and no limit. A hot pixel is a run of 1.
    saturation : float, optional
        Level at which a sample is saturated [grey levels]; default: the largest code of integer frames, no limit for
        float32. ``"ml"`` leaves saturated samples out of the fit. Range: above 0.
    ambiguity : float, optional
        Fraction of the peak's light, above 0, at most 1. A sample outside the window with at least this fraction sets
        the flag AMBIGUOUS. Default: no search for such samples.
    fir_length : {4, 8}
        Taps of the derivative filter, default 4.
    read_noise, gain : float
        Noise model of ``"ml"`` and of the sigmas: standard deviation of a dark sample, without quantisation [grey
        levels], default 1, and variance per grey level [grey levels per electron], default 0.
    speckle : float
        Standard deviation of the position by speckle and surface texture [px], >= 0, default 0. It adds to ``sigma`` in
        quadrature and depends on the optics only, not on the brightness of the line [3]_.
    triangulation, axes : Triangulation, SampleAxes
        Triangulate in the same kernel (outputs ``g`` and ``h``): u is the position, v the number of the profile,
        converted to sensor coordinates by ``axes``.
    outputs : tuple of str, optional
        Names of the `LineReading` fields to compute; the code of other fields is not compiled. Default: all but the
        sigmas.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` is single.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: wide vectors on strips of profiles (CPU runtimes), or work-groups that read profiles together
        (GPUs). ``"auto"`` follows the device. On CPU runtimes, narrower frames than a vector use an item per profile.

    Raises
    ------
    TypeError
        A parameter is not a number, or not an integer where one is expected.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: integer samples are summed exactly. The rounding errors of float32 sums are kept in a second number
    (compensated summation). The rounding error of the position is a few ulp.

    The position of ``"ml"`` is within 1.5e-4 px of the maximum of the likelihood in 99 % of the lines that noise
    scatters by less than 0.1 px. In some lines the iteration ends earlier: the largest of 4182 errors was 6.4e-4 px
    (lines of sigma 1.7 px, noise of 5 grey levels, random errors of 0.03 to 0.1 px). Lines with a sigma from 1.6 px
    to the smaller of 12 px and `window` are fitted as Gaussians sampled at the pixels, several times as fast as the
    integrals over pixels of other lines.

    Noise: the variance of a sample is ``read_noise**2 + gain * level``, plus 1/12 for integer frames (quantisation).
    ``sigma`` is its effect on the estimator, to first order:

    - centroids: ``sum variance_k (k - p)**2 / total**2`` over the samples above the threshold.
    - ``"gauss3"``, ``"fir"``: the derivatives with respect to the three samples, or to the taps of the two filters on
      either side of the zero crossing.
    - ``"ml"``: the Cramer-Rao bound at the fit.

    The prediction is too small where noise moves the peak by more than a pixel, so that the window loses light, and
    for flagged samples. It is too large by up to 20 % where the threshold lies within the noise of the background. If a
    background image was subtracted from the frames, ``read_noise`` must contain the noise of both.

    Cost of ``sigma`` over the readout of 16 frames (512, 1024) uint8 without it, two-core machine, PoCL and Intel:
    ``"windowed"`` 6 and 13 %, ``"gauss3"`` 3 and 5 %, ``"fir"`` 13 and 12 %, ``"ml"`` 65 and 60 %, ``"centroid"``
    15 and 25 % (medians of interleaved runs on a machine with other load; ``gpuvision profile line`` repeats them in
    the rows ``-sigma/16``). The sums of ``"centroid"`` for integer frames round ``sigma`` to 1e-4 of its value where
    the line is steep and thin.

    References
    ----------
    .. [1] F. Blais and M. Rioux, Real-time numerical peak detector, Signal Processing 11 (1986) 145-155.
    .. [2] R. B. Fisher and D. K. Naidu, A comparison of algorithms for subpixel peak detection, in Image Technology,
       Springer 1996.
    .. [3] R. G. Dorsch, G. Haeusler and J. M. Herrmann, Laser triangulation: fundamental uncertainty in distance
       measurement, Applied Optics 33 (1994) 1306-1314.

    Examples
    --------
    >>> import numpy as np
    >>> import gpuvision as gv
    >>> frame = np.zeros((9, 4), np.uint8)
    >>> frame[3:6] = np.array([[50], [100], [50]])
    >>> reading = gv.LineReadout(method="centroid", threshold=10)(frame)
    >>> reading.position.tolist()
    [4.0, 4.0, 4.0, 4.0]
    """

    Result: ClassVar[type[Any]] = LineReading

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("uint8", "uint16", "float32", of="frames")
        build.check_shape(len(shape) >= 2 and 0 not in shape[-2:], "frames (..., rows, columns) of one pixel at least")
        build.check_no_colour("frames (..., rows, columns)")
        description = LineLaunch(readout=self, build=build)
        if description.length > LONGEST_PROFILE or math.prod(shape[-2:]) >= 2**31:
            raise ValueError(
                f"LineReadout takes profiles of up to {LONGEST_PROFILE} samples in frames below 2**31, got {shape}"
            )
        return description.describe()
