"""Laser line readout: a camera image of a sheet of light becomes one sub-pixel line position per column (or row).

The laser line crosses the frame along its columns axis (``along="columns"``: one row coordinate per column) or along
its rows axis (``along="rows"``: one column coordinate per row). One such column or row of samples is a *profile*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from gpuvision.camera.profile_correction import ProfileCorrection
from gpuvision.host import (
    Define,
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    WorkSize,
    ceil_div,
    flags,
    round_up,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.validation import finite, integer

Method = Literal["centroid", "windowed", "gauss3", "fir", "ml"]
PeakSelection = Literal["strongest", "first", "last", "nearest"]

METHODS = ("centroid", "windowed", "gauss3", "fir", "ml")
PEAK_SELECTIONS = ("strongest", "first", "last", "nearest")
LONGEST_PROFILE = 32767  # samples: the vector variant keeps sample indices in 16 bits
WIDEST_WINDOW = 180  # samples on either side: sums of 16-bit samples times their index fit 32 bits
_SMALL_WINDOW = 15  # samples on either side: sums of bytes times their index fit 16 bits
_LANES = 16  # of a vector of the vector variant: its kernel's vectors have 16 elements
_GROUP = 64  # work-items of a work-group that selects among candidates
_STRIP = 1024  # largest number of columns of a strip: MAX_STRIP in line_strip.h
_PROFILE_BYTES = 96  # largest sum of the sizes of a profile's outputs
# Bytes of a launch that one work-item moves. Intel's runtime runs a launch of one work-group in the calling thread, as
# PoCL does with all short launches (host/bound.py). Measured on two cores: 10 us, not 16 us, for a frame of 512 KiB.
_ONE_ITEM_BYTES = 640 << 10
_FIELDS = ("position", "peak", "width", "total", "status")  # default outputs without a triangulation
_WIDE_BYTES = 64  # bytes of a wide vector (one cache line): WIDE in line_wide.h


class LineReading(NamedTuple):
    """Peaks of a laser line, one per profile: arrays of shape (batch..., samples); fields not requested are ``None``.

    Attributes
    ----------
    position
        Position of the line along the profile [px], in the real type. NaN where the status has LOW_SIGNAL,
        OUT_OF_RANGE or NOT_FINITE.
    peak
        Sample value at the peak [grey levels]; the largest sample of the profile where no peak was found.
    width
        Number of samples above the threshold [px]: in the run that contains the peak; for ``method="centroid"`` in the
        whole profile.
    total
        Sum of the light above the threshold [grey levels]: in the window; for ``method="centroid"`` in the whole
        profile.
    status
        uint8 `Status` flags, 0 where the position is good. The position is NaN under:

        - LOW_SIGNAL: no peak meets the minimum level and the width limits, or the neighbours of the peak have too
          little light for the method.
        - OUT_OF_RANGE: the image border cuts the window, or cuts a flat top wider than the window. For ``"centroid"``:
          the first or last sample has at least half of the peak's light.
        - NOT_FINITE: a sample of the profile is NaN or infinite, or a sum overflows.

        The position is kept under:

        - SATURATED: the peak is at the saturation level.
        - AMBIGUOUS: a second peak is comparable, a flat top is wider than the window, or the fit did not converge and
          the middle of the flat top or the centroid is returned.

        HORIZON and NOT_INVERTIBLE are set by the triangulation and make only ``g`` and ``h`` NaN.
    g, h
        Point in the sheet of light [m], if the readout has a triangulation.
    sigma
        Predicted standard deviation of the position by the noise of the samples [px]. NaN where the position is NaN and
        where it does not come from the estimator: a flat top wider than the window, a fit that did not converge.
    sigma_g, sigma_h
        Random error: standard deviations of ``g`` and ``h`` by ``sigma`` [m]. Both come from the same error of the
        position: g and h err together.
    systematic_g, systematic_h
        Systematic error: standard deviations of ``g`` and ``h`` by the covariance of the triangulation [m]. The error
        is the same in all frames.
    """

    position: FloatArray | None = None
    peak: FloatArray | None = None
    width: FloatArray | None = None
    total: FloatArray | None = None
    status: StatusArray | None = None
    g: FloatArray | None = None
    h: FloatArray | None = None
    sigma: FloatArray | None = None
    sigma_g: FloatArray | None = None
    sigma_h: FloatArray | None = None
    systematic_g: FloatArray | None = None
    systematic_h: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class LineReadout(VisionOperation[LineReading]):
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

    method: Method = "windowed"
    along: Literal["columns", "rows"] = "columns"
    threshold: float = 0.0
    window: int = 8
    peak_selection: PeakSelection = "strongest"
    minimum_peak: float | None = None
    minimum_width: int = 1
    maximum_width: int | None = None
    saturation: float | None = None
    ambiguity: float | None = None
    fir_length: Literal[4, 8] = 4
    read_noise: float = 1.0
    gain: float = 0.0
    speckle: float = 0.0
    triangulation: Triangulation | None = None
    axes: SampleAxes = SampleAxes()
    outputs: tuple[str, ...] | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name in ("window", "minimum_width", "maximum_width", "fir_length"):
            if getattr(self, name) is not None or name != "maximum_width":
                object.__setattr__(self, name, integer(getattr(self, name), f"LineReadout.{name}"))
        self._check_names()
        self._check_numbers()
        possible = LineReading._fields if self.triangulation is not None else (*_FIELDS, "sigma")
        for name in self.outputs or ():
            if name not in possible:
                raise ValueError(f"LineReadout.outputs has {name!r}, expected some of {', '.join(possible)}")
        if self.triangulation is not None:
            self.triangulation.check_systematic(self.outputs or (), "LineReadout")
        default = _FIELDS if self.triangulation is None else (*_FIELDS, "g", "h")
        object.__setattr__(self, "outputs", default if self.outputs is None else tuple(self.outputs))

    def _check_names(self) -> None:
        allowed: dict[str, tuple[Any, ...]] = {
            "method": METHODS,
            "along": ("columns", "rows"),
            "peak_selection": PEAK_SELECTIONS,
            "fir_length": (4, 8),
        }
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                listed = ", ".join(map(str, values))
                raise ValueError(f"LineReadout.{name} is {getattr(self, name)!r}, expected one of {listed}")
        if self.method == "centroid" and (self.peak_selection != "strongest" or self.ambiguity is not None):
            raise ValueError(
                "LineReadout: method 'centroid' finds no peaks; peak_selection and ambiguity need another method"
            )
        if self.triangulation is not None and self.triangulation.along != self.along:
            raise ValueError(
                f"LineReadout.along is {self.along!r}, its triangulation was made for {self.triangulation.along!r}"
            )

    def _check_numbers(self) -> None:
        finite(self.threshold, "LineReadout.threshold", minimum=0.0)
        if self.minimum_peak is not None and finite(self.minimum_peak, "LineReadout.minimum_peak") < self.threshold:
            raise ValueError(
                f"LineReadout.minimum_peak is {self.minimum_peak}, expected the threshold {self.threshold} or more"
            )
        if self.saturation is not None:
            finite(self.saturation, "LineReadout.saturation", above=0.0)
        for name in ("read_noise", "gain", "speckle"):
            if finite(getattr(self, name), f"LineReadout.{name}") < 0.0:
                raise ValueError(f"LineReadout.{name} is {getattr(self, name)}, expected a number >= 0")
        if self.method == "ml" and self.read_noise == 0.0 and self.gain == 0.0:
            raise ValueError("LineReadout: method 'ml' weighs samples by their noise; read_noise or gain must be > 0")
        if self.ambiguity is not None and not 0.0 < finite(self.ambiguity, "LineReadout.ambiguity") <= 1.0:
            raise ValueError(f"LineReadout.ambiguity is {self.ambiguity}, expected a share of the peak, 0 < share <= 1")
        smallest = 3 if self.method == "ml" else 1
        if not smallest <= self.window <= WIDEST_WINDOW:
            raise ValueError(
                f"LineReadout.window is {self.window}, expected a whole number from {smallest} to {WIDEST_WINDOW}"
            )
        widths = (self.minimum_width, self.minimum_width if self.maximum_width is None else self.maximum_width)
        if not 1 <= widths[0] <= widths[1]:
            raise ValueError(
                f"LineReadout: widths from {self.minimum_width} to {self.maximum_width}, expected 1 <= min <= max"
            )

    @property
    def _limits_width(self) -> bool:
        return self.minimum_width > 1 or self.maximum_width is not None

    @property
    def _passes_once(self) -> bool:
        return self.method in ("centroid", "windowed")

    @property
    def _has_candidates(self) -> bool:
        return self.method != "centroid" and (self.peak_selection != "strongest" or self._limits_width)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("uint8", "uint16", "float32", of="frames")
        build.check_shape(len(shape) >= 2 and 0 not in shape[-2:], "frames (..., rows, columns) of one pixel at least")
        build.check_no_colour("frames (..., rows, columns)")
        batch, (rows, columns) = shape[:-2], shape[-2:]
        length, samples = (rows, columns) if self.along == "columns" else (columns, rows)
        if length > LONGEST_PROFILE or rows * columns >= 2**31:
            raise ValueError(
                f"LineReadout takes profiles of up to {LONGEST_PROFILE} samples in frames below 2**31, got {shape}"
            )
        frames = math.prod(batch)
        moved = frames * (rows * columns * dtype.itemsize + _PROFILE_BYTES * samples)
        is_narrow = build.uses_vectors and not self._fits_strip(rows, columns, dtype)
        if build.uses_vectors and not is_narrow:
            work = WorkSize((self._items(device, frames, samples, moved), frames), (1, 1), vectors=True)
        else:
            work = self._groups(frames, samples, dtype, build.real, item_per_profile=is_narrow)
        chosen, of_samples = self.outputs or (), (*batch, samples)
        profiles = None
        if self.triangulation is not None:
            profiles = self.triangulation.profile_correction(build.real, self.axes, length, samples)
        return build.launch(
            "line/line.cl",
            "line_readout",
            work=work,
            more_inputs=[(of_samples, build.real)] if self.peak_selection == "nearest" else [],
            outputs=build.outputs({name: of_samples if name in chosen else None for name in LineReading._fields}),
            defines=self._defines(dtype, length, build.real, profiles)
            | self._window_defines(vectors=work.vectors)
            | flags(
                PREFETCH=work.vectors and self._prefetches(device, dtype, moved),
                ITEM_PER_PROFILE=is_narrow and not self._has_candidates,
            ),
            arguments=[
                np.int32(rows),
                np.int32(columns),
                *self._levels(dtype),
                np.int32(self.window),
                self._packed(build.real, dtype, length, device),
                None if self.triangulation is None else self.triangulation.packed(build.real, self.axes, profiles),
                None if profiles is None else profiles.blocks(build.real),
            ],
            passes_once=work.vectors and self._passes_once,
        )

    def _fits_strip(self, rows: int, columns: int, dtype: np.dtype[Any]) -> bool:
        if self._has_candidates:
            # Along rows, both variants process one profile after the other and skip dark parts in vectors of samples.
            return self.along == "columns" and columns >= _LANES
        return columns >= _WIDE_BYTES // dtype.itemsize and (self.along == "columns" or rows >= _LANES)

    def _groups(
        self, frames: int, samples: int, dtype: np.dtype[Any], real: np.dtype[Any], *, item_per_profile: bool
    ) -> WorkSize:
        """Return the work size of the work-item variant."""
        if self._has_candidates or item_per_profile:
            return WorkSize((round_up(samples, _GROUP), frames), (_GROUP, 1))
        # GROUP and PROFILES in line_group.h
        if self.method == "ml":
            group, profiles = 64, 64
        elif self.along == "columns":
            group, profiles = 256, 64 if dtype.itemsize == 1 else 32
        else:
            sums_in_double = self.method == "centroid" and dtype.kind == "f" and real == np.float64
            group, profiles = 256, 16 if sums_in_double else 32
        return WorkSize((ceil_div(samples, profiles) * group, frames), (group, 1))

    def _prefetches(self, device: Device, dtype: np.dtype[Any], moved: int) -> bool:
        """Return whether a walk down columns of bytes prefetches each cache line: the caches do not hold the frames.

        Measured: 10 to 20 % less time for 32 MiB of frames, 3 to 6 % more for 8 MiB; wider samples lose by it.
        """
        return dtype.itemsize == 1 and self.along == "columns" and moved > device.cache_bytes // 2

    def _items(self, device: Device, frames: int, samples: int, moved: int) -> int:
        """Return the work-items per frame of the vector variant: few, but two per core at least over all frames.

        The launch moves about `moved` bytes. One work-item reads a small frame.
        """
        if self.along == "rows" or self._has_candidates:
            return ceil_div(samples, _LANES)
        if frames == 1 and self._passes_once and moved <= _ONE_ITEM_BYTES:
            return 1
        units = device.compute_units
        busy = ceil_div(2 * units, max(frames, 1)) if frames < 2 * units else 1
        return min(max(ceil_div(samples, _STRIP), busy), max(samples // 128, 1))

    def _levels(self, dtype: np.dtype[Any]) -> list[Any]:
        """Return threshold, saturation and smallest peak level in the dtype of the frames."""
        if dtype.kind == "f":
            saturation = np.inf if self.saturation is None else self.saturation
            weakest = -np.inf if self.minimum_peak is None else self.minimum_peak
            return [dtype.type(level) for level in (self.threshold, saturation, weakest)]
        top = np.iinfo(dtype).max
        if self.threshold != int(self.threshold) or not 0 <= self.threshold <= top:
            raise ValueError(
                f"LineReadout.threshold is {self.threshold}, expected a whole number from 0 to {top} for {dtype} frames"
            )
        saturation = top if self.saturation is None else math.ceil(self.saturation)
        weakest = 0 if self.minimum_peak is None else math.ceil(self.minimum_peak)
        for name, level in (("saturation", saturation), ("minimum_peak", weakest)):
            if not 0 <= level <= top:
                raise ValueError(f"LineReadout.{name} is {level}, expected 0 to {top} for {dtype} frames")
        return [dtype.type(level) for level in (self.threshold, saturation, weakest)]

    def _defines(
        self, dtype: np.dtype[Any], length: int, real: np.dtype[Any], profiles: ProfileCorrection | None
    ) -> dict[str, Define]:
        bits = 8 * dtype.itemsize
        defines = type_defines("CODE", dtype, 4, 8, 16) | {"CODE_BITS": bits}
        defines |= flags(**{f"METHOD_{self.method.upper()}": True, f"SELECT_{self.peak_selection.upper()}": True})
        chosen = self.outputs or ()
        defines |= flags(**{f"WITH_{name.upper()}": True for name in chosen})
        if self.triangulation is not None:
            # Random and systematic errors are separate outputs here.
            defines |= {"WITH_SHEET": None} | self.triangulation.defines(real, profiles)
            defines.pop("SHEET_COVARIANCE", None)
        return defines | flags(
            ALONG_ROWS=self.along == "rows",
            AMBIGUITY=self.ambiguity is not None,
            CANDIDATES=self._has_candidates,
            WIDTH_LIMITS=self._limits_width,
            NOISE=any(name.startswith("sigma") for name in chosen),
            COUNT_WIDTH="width" in chosen or (self.method == "centroid" and self._limits_width),
            LONG_MOMENT=bits < 32 and length**2 // 2 * np.iinfo(f"uint{bits}").max >= 2**32,
        )

    def _window_defines(self, *, vectors: bool) -> dict[str, Define]:
        """Return the macros of the window.

        The window is an argument of the kernel where that costs nothing: in the vector variant of ``"windowed"`` down
        the columns. Elsewhere it is a constant of the build. Measured with an argument: 3 to 4 % more time for the
        fits, 9 % along rows; on GPUs the samples of the window lie in memory and not in registers.
        """
        # The centroid method has no window, and only the FIR method has a filter: fewer builds for other values.
        half = self.fir_length // 2 if self.method == "fir" else 0
        if vectors and self.method == "windowed" and self.along == "columns":
            largest = _SMALL_WINDOW if self.window <= _SMALL_WINDOW else WIDEST_WINDOW
            return {"MAX_RADIUS": largest, "WINDOW_ARGUMENT": None, "FIR_HALF": half}
        window = 1 if self.method == "centroid" else self.window
        return {"RADIUS": window, "MAX_RADIUS": window, "FIR_HALF": half}

    def _packed(self, real: np.dtype[Any], dtype: np.dtype[Any], length: int, device: Device) -> Any:
        """Return the parameter table of the kernel."""
        widest = length if self.maximum_width is None else min(self.maximum_width, length)
        noise = self.read_noise**2 + (1.0 / 12.0 if dtype.kind == "u" else 0.0)
        table = LineTable(
            min_width=min(self.minimum_width, length + 1),
            max_width=widest,
            ambiguous_ratio=self.ambiguity or 0.0,
            read_variance=self.read_noise**2,
            gain=self.gain,
            noise_variance=noise,
            lit_variance=noise + self.gain * self.threshold,
            speckle_variance=self.speckle**2,
            minimum_total=_minimum_total(length, real, device),
        )
        return np.array(table, real)


class LineTable(NamedTuple):
    """Parameters of ``kernels/line/line.cl``, in the order of its struct ``LineTable``."""

    min_width: float
    max_width: float
    ambiguous_ratio: float
    read_variance: float
    gain: float
    noise_variance: float
    lit_variance: float
    speckle_variance: float
    minimum_total: float


def _minimum_total(length: int, real: np.dtype[Any], device: Device) -> float:
    """Return the smallest total light whose centroid is accurate to rounding.

    A device without denormal numbers takes each light below the smallest normal number as 0, which moves the moment by
    at most ``length**2 / 2`` of these numbers. Rounding of the position is ``length * 2**-24``.
    """
    if device.has_denormals or real == np.float64:
        return 0.0
    return length * 2.0**23 * float(np.finfo(real).tiny)
