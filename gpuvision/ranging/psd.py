"""Position sensitive devices (PSD): pairs of currents become positions of the light.

The two currents of a PSD strip divide inversely to the distances of the light from its ends:
``u = (L/2) (I_right - I_left) / (I_right + I_left)``, with ``u`` in [-L/2, L/2], positive towards the right electrode.
u is the centroid (centre of gravity) of *all* light on the strip, independent of the shape and power of the light (F.
de Jong, section 4.2.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import log_ndtr

from gpuvision.host import (
    Define,
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Tunable,
    Variant,
    WorkSize,
    flags,
    strided_groups,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.validation import finite

ELECTRON = 1.602176634e-19  # elementary charge [C]
# Margin at the ends of a strip in standard deviations of the light spot. Derived: the end of a strip that cuts a
# Gaussian spot 3 standard deviations from its centre moves the reading by 0.0044 of them.
_MARGIN_SPOTS = 3.0
# Samples of a work-item of the vector variant: equal shares of the cores, within limits. With strips of 32768 samples
# and a last one of up to 65535, a core waits for the other: Intel's runtime takes 4 to 5 % more time for 1e6 samples.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 4096, 65536, 8
_BLOCK = 256  # samples that share a test in the kernel; the rest of a strip takes a test for each vector
_LANES = 16  # of a vector of the vector variant: its kernel's vectors have 16 elements
_GROUP = 64  # work-items of a group of the other variant


class PsdReading(NamedTuple):
    """Readings of a PSD: arrays of the shape of the batch; fields that were not requested are ``None``.

    Attributes
    ----------
    position
        Position u of the light [m]; NaN where the status has LOW_SIGNAL, SATURATED, OUT_OF_RANGE or NOT_FINITE.
    total
        Sum of both currents, after dark level and gain correction [A].
    status
        uint8 `Status` flags: LOW_SIGNAL (total not above the minimum), SATURATED (either channel), OUT_OF_RANGE (beyond
        the ends of the strip or within the margin at an end, where the end cuts the light spot), NOT_FINITE (a current
        is NaN or infinite). HORIZON and NOT_INVERTIBLE are set by the triangulation.
    sigma
        Predicted standard deviation of the position [m].
    g, h
        Point in the sheet of light [m], if the readout has a triangulation.
    sigma_g, sigma_h
        Random error: standard deviations of ``g`` and ``h`` by ``sigma`` [m]; g and h err together.
    systematic_g, systematic_h
        Systematic error: standard deviations of ``g`` and ``h`` by the covariance of the triangulation [m].
    """

    position: FloatArray | None = None
    total: FloatArray | None = None
    status: StatusArray | None = None
    sigma: FloatArray | None = None
    g: FloatArray | None = None
    h: FloatArray | None = None
    sigma_g: FloatArray | None = None
    sigma_h: FloatArray | None = None
    systematic_g: FloatArray | None = None
    systematic_h: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class PsdNoise:
    """Noise model of a PSD: four components of the noise of the two currents.

    Parameters
    ----------
    independent : float
        Standard deviation s of the noise of each channel as recorded, before the gain correction (amplifiers) [A],
        default 0. Its effect on the position grows towards the ends of the strip: ``(L s / S) sqrt((1 + xi^2) / 2)``,
        with ``xi = 2 u / L`` and the total S. Behind a gain g of the right channel the noise of the corrected right
        current is s / g, and the effect ``(L s / (2 S)) sqrt((1 + xi)^2 + (1 - xi)^2 / g^2)``.
    opposed : float
        Standard deviation s of noise that leaves at one electrode and enters at the other [A], default 0: the Johnson
        current of the strip resistance, ``sqrt(4 k T B / R_ie)``. Its effect is the same everywhere: ``L s / S``.
    spot : float
        Standard deviation of the width of the light spot [m], default 0. The electrons of one spot divide together, so
        shot noise contributes ``spot / sqrt(N)``, with N electrons within the time constant. It is also the default
        of the margin at the ends of the strip, see `PsdReadout`.
    bandwidth : float
        Bandwidth B [Hz], default 0; ``N = S / (2 q B)``.
    background : float
        Mean photocurrent I of background light [A], default 0: uniform over the strip, and absent from the currents on
        average, because the light is modulated and demodulated or because `PsdReadout.dark` contains it. Its shot noise
        remains: its electrons spread over the whole strip, so that it contributes
        ``sqrt(2 q B I (L^2 / 12 + u^2)) / S``.
    dark_current : float
        Mean dark current of the strip [A], default 0. Its shot noise acts as the shot noise of background light does.

    Raises
    ------
    ValueError
        A number is negative or not finite, or there is a background or a dark current without a bandwidth.

    Notes
    -----
    The components are independent of each other: their variances add up. The model is linear in the noise; it holds
    where the noise is far below the total.

    References
    ----------
    Hamamatsu Photonics, *PSD (position sensitive detectors)*, technical note: noise currents of a PSD.
    """

    independent: float = 0.0
    opposed: float = 0.0
    spot: float = 0.0
    bandwidth: float = 0.0
    background: float = 0.0
    dark_current: float = 0.0

    def __post_init__(self) -> None:
        for name in ("independent", "opposed", "spot", "bandwidth", "background", "dark_current"):
            if finite(getattr(self, name), f"PsdNoise.{name}") < 0.0:
                raise ValueError(f"PsdNoise.{name} is {getattr(self, name)}, expected a number >= 0")
        for name in ("background", "dark_current"):
            if getattr(self, name) > 0.0 and self.bandwidth == 0.0:
                raise ValueError(f"PsdNoise.{name} needs bandwidth [Hz] as well: shot noise is proportional to it")


@dataclass(frozen=True, kw_only=True)
class PsdReadout(VisionOperation[PsdReading]):
    """PSD readout: pairs of currents to positions of the light, ``readout(currents) -> PsdReading``.

    Takes float32 or float64 currents [A] or uint16 codes of shape (..., 2), pairs (left, right), or of shape (2, ...)
    with ``layout="planar"``. The axis before the pair axis (the last axis if planar) is the axis of the strips.

    Parameters
    ----------
    strip_length : float
        Length L between the electrodes [m].
    ampere : float
        Amperes per unit of the input, default 1 (currents); for codes the step of the converter.
    dark : (left, right)
        Dark currents [A], subtracted first, default 0.
    right_gain : float
        Gain of the right channel relative to the left channel, default 1; the right current is divided by it.
    interelectrode_resistance, load_resistance : float
        Resistance R_ie of the strip and load R_L at either end [Ohm]. Loads shrink the position by the factor
        R_ie / (R_ie + 2 R_L), which is corrected exactly.
    minimum_total : float
        Total current at or below which a sample is LOW_SIGNAL [A], default 0.
    saturation : float, optional
        Current at which a channel saturates, dark level included [A]. Default: the largest code of integer input, no
        limit for currents.
    linearity : array_like of shape (strips, knots), optional
        Corrections added to the position [m]. The knots divide a strip evenly from -L/2 to L/2; the correction is
        linear between knots.
    margin : float, optional
        Distance from the ends of the strip within which a reading is OUT_OF_RANGE [m], 0 or more and below L/2: the
        end cuts the light spot there, and the reading is biased (`clipping_bias`). Default: 3 ``noise.spot``, where the
        bias of a Gaussian spot is 0.0044 ``noise.spot``; 0 without a noise model.
    noise : PsdNoise, optional
        Noise model for the output ``sigma``. The quantisation of integer codes is added. The slope of the linearity
        correction is left out.
    triangulation, axes : Triangulation, SampleAxes
        Triangulate in the same kernel (outputs ``g`` and ``h``): u is the position, v the number of the strip,
        converted to sensor coordinates by ``axes``.
    layout : {"pairs", "planar"}
        Order of the input, default ``"pairs"``.
    outputs : tuple of str, optional
        Names of the `PsdReading` fields to compute; the code of other fields is not compiled. Default: position, total
        and status, with sigma if there is ``noise``, with g and h if there is a ``triangulation``.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: vectors of 16 samples (CPU runtimes) or one work-item per 4 samples (GPUs); ``"auto"`` follows
        the device.

    Raises
    ------
    TypeError
        A parameter is not a number.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: the arithmetic adds at most 4 epsilon of L/2 to the position (5e-7 L/2 in single precision), also for 16-bit
    codes. It adds less near the middle, since the difference of nearly equal currents is exact. The light of the spot
    beyond the end of the strip is lost (thesis, section 4.2.5), which moves an accepted reading by at most
    ``largest_clipping_bias``.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.2.

    Examples
    --------
    >>> import numpy as np
    >>> import gpuvision as gv
    >>> currents = np.array([[1e-6, 1e-6], [1e-6, 3e-6]])
    >>> reading = gv.PsdReadout(strip_length=6e-3)(currents)
    >>> reading.position.round(6).tolist()
    [0.0, 0.0015]
    """

    Result: ClassVar[type[Any]] = PsdReading
    # Not the variant: with a triangulation the variants round differently.
    tunable: ClassVar[Tunable | None] = Tunable(
        strips=(1024, 2048, 4096, 8192, 16384, 32768), groups=(32, 64, 128, 256)
    )

    strip_length: float
    ampere: float = 1.0
    dark: tuple[float, float] = (0.0, 0.0)
    right_gain: float = 1.0
    interelectrode_resistance: float | None = None
    load_resistance: float = 0.0
    minimum_total: float = 0.0
    saturation: float | None = None
    linearity: tuple[tuple[float, ...], ...] | None = None
    margin: float | None = None
    noise: PsdNoise | None = None
    triangulation: Triangulation | None = None
    axes: SampleAxes = SampleAxes()
    layout: Literal["pairs", "planar"] = "pairs"
    outputs: tuple[str, ...] | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name in ("strip_length", "ampere", "right_gain"):
            if finite(getattr(self, name), f"PsdReadout.{name}") <= 0.0:
                raise ValueError(f"PsdReadout.{name} is {getattr(self, name)}, expected a number > 0")
        for name in ("minimum_total", "load_resistance"):
            if finite(getattr(self, name), f"PsdReadout.{name}") < 0.0:
                raise ValueError(f"PsdReadout.{name} is {getattr(self, name)}, expected a number >= 0")
        self._check_currents()
        if self.load_resistance and not self.interelectrode_resistance:
            raise ValueError("PsdReadout.load_resistance needs interelectrode_resistance [Ohm] as well")
        if self.layout not in ("pairs", "planar"):
            raise ValueError(f"PsdReadout.layout is {self.layout!r}, expected 'pairs' or 'planar'")
        object.__setattr__(self, "outputs", self._chosen())
        self._check_linearity()
        self._check_margin()

    @property
    def largest_clipping_bias(self) -> float:
        """Largest bias of an accepted reading because the end of the strip cuts a Gaussian spot [m].

        It is the bias at the margin of a spot of the standard deviation ``noise.spot``; 0 without a spot width.
        """
        spot = self.noise.spot if self.noise is not None else 0.0
        if spot == 0.0:
            return 0.0
        end = 0.5 * self.strip_length - self.applied_margin
        # The reading increases with the centre of the spot: bisect for the centre that is read at the margin. Hardly
        # any light of a spot beyond the upper bound is on the strip.
        low, high = end, 0.5 * self.strip_length + 37.0 * spot
        for _ in range(60):
            centre = 0.5 * (low + high)
            reading = centre + float(clipping_bias(centre, spot=spot, strip_length=self.strip_length))
            low, high = (centre, high) if reading < end else (low, centre)
        return high - end

    @property
    def applied_margin(self) -> float:
        """Margin at either end of the strip [m]: ``margin``, or its default."""
        if self.margin is not None:
            return self.margin
        return _MARGIN_SPOTS * self.noise.spot if self.noise is not None else 0.0

    def _check_margin(self) -> None:
        if self.margin is not None:
            object.__setattr__(self, "margin", finite(self.margin, "PsdReadout.margin"))
        if not 0.0 <= self.applied_margin < 0.5 * self.strip_length:
            source = "" if self.margin is not None else f", {_MARGIN_SPOTS:g} times noise.spot"
            raise ValueError(
                f"PsdReadout.margin is {self.applied_margin} m{source}; expected 0 or more, and below half a strip"
            )

    def _check_currents(self) -> None:
        try:
            left, right = (finite(each, "PsdReadout.dark") for each in self.dark)
        except TypeError:
            raise TypeError(f"PsdReadout.dark is {self.dark!r}, expected two currents (left, right)") from None
        object.__setattr__(self, "dark", (left, right))
        for name in ("saturation", "interelectrode_resistance"):
            value = getattr(self, name)
            if value is not None and finite(value, f"PsdReadout.{name}") <= 0.0:
                raise ValueError(f"PsdReadout.{name} is {value}, expected a number > 0, or None")
        if self.noise is not None and not isinstance(self.noise, PsdNoise):
            raise TypeError(f"PsdReadout.noise is {self.noise!r}, expected a PsdNoise or None")

    def _chosen(self) -> tuple[str, ...]:
        sheet = ("g", "h") if self.triangulation is not None else ()
        if self.outputs is None:
            return ("position", "total", "status", *(("sigma",) if self.noise is not None else ()), *sheet)
        possible = PsdReading._fields if sheet else PsdReading._fields[:4]
        for name in self.outputs:
            if name not in possible:
                raise ValueError(f"PsdReadout.outputs has {name!r}, expected some of {', '.join(possible)}")
        if self.triangulation is not None:
            self.triangulation.check_systematic(self.outputs, "PsdReadout")
        return tuple(self.outputs)

    def _check_linearity(self) -> None:
        if self.linearity is None:
            return
        try:
            rows = tuple(tuple(finite(x, "PsdReadout.linearity") for x in row) for row in self.linearity)
        except TypeError:
            raise TypeError("PsdReadout.linearity: expected a row of corrections per strip") from None
        if not rows or min(map(len, rows)) < 2 or len(set(map(len, rows))) != 1:
            raise ValueError("PsdReadout.linearity: expected a row per strip, all of one length of at least 2 knots")
        object.__setattr__(self, "linearity", rows)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", "uint16", of="currents")
        pair_axis, expected = (-1, "(..., 2)") if self.layout == "pairs" else (0, "(2, ...)")
        build.check_shape(bool(shape) and shape[pair_axis] == 2, f"{self.layout} of shape {expected}")
        batch = shape[:-1] if self.layout == "pairs" else shape[1:]
        strips = batch[-1] if batch else 1
        if self.linearity is not None and len(self.linearity) != strips:
            raise ValueError(f"PsdReadout.linearity has {len(self.linearity)} rows, the input has {strips} strips")
        samples = math.prod(batch)
        if samples >= 2**30:
            raise ValueError(f"PsdReadout takes fewer than 2**30 samples at once, got {samples}; split the batch")
        # Rounded down: the remainder, which the last work-item takes, is small.
        share = samples // (_STRIPS_PER_CORE * device.compute_units * _BLOCK) * _BLOCK
        each = build.tuned_strip(min(max(share, _SHORTEST_STRIP), _LONGEST_STRIP))
        if build.uses_vectors and samples >= _LANES:
            # The last work-item also processes the remainder.
            work = WorkSize((max(samples // each, 1),), (1,), each, vectors=True)
        else:
            work = strided_groups(samples, build.tuned_group(_GROUP))
        chosen = self.outputs or ()
        sheet = self.triangulation
        table = None if self.linearity is None else np.array(self.linearity, build.real)
        word_pairs = work.vectors and self.layout == "pairs" and dtype == np.uint16
        return build.launch(
            "psd/psd.cl",
            "psd_readout",
            work=work,
            outputs=build.outputs({name: batch if name in chosen else None for name in PsdReading._fields}),
            defines={**self._defines(dtype, build.real), **flags(WORD_PAIRS=word_pairs)},
            arguments=[
                self._packed(build.real, dtype),
                np.int32(samples),
                np.int32(each),
                table,
                np.int32(strips),
                np.int32(0 if table is None else table.shape[1]),
                None if sheet is None else sheet.packed(build.real, self.axes),
            ],
            passes_once=work.vectors,
            streams=True,
            by_team=True,
        )

    def _defines(self, dtype: np.dtype[Any], real: np.dtype[Any]) -> dict[str, Define]:
        defines = type_defines("INPUT", dtype, 2, 4, 16)
        defines |= flags(**{f"WITH_{name.upper()}": True for name in self.outputs or ()})
        if self.triangulation is not None:
            # Random and systematic errors are separate outputs here.
            defines |= {"WITH_SHEET": None} | self.triangulation.defines(real)
            defines.pop("SHEET_COVARIANCE", None)
        return defines | flags(
            PLANAR=self.layout == "planar",
            DARK_LEVEL=any(self.dark),
            # A current can be negative or not finite, or the range is shorter than the strip.
            SIGNED=dtype.kind == "f" or any(self.dark) or self.load_resistance > 0.0 or self.applied_margin > 0.0,
            GAIN=self.right_gain != 1.0,
            BACKGROUND=self.noise is not None and self.noise.background + self.noise.dark_current > 0.0,
            LINEARITY=self.linearity is not None,
        )

    def _packed(self, real: np.dtype[Any], dtype: np.dtype[Any]) -> Any:
        """Return the parameter table of the kernel, in units of the input."""
        limit = 1.0
        if self.interelectrode_resistance:
            limit = self.interelectrode_resistance / (self.interelectrode_resistance + 2.0 * self.load_resistance)
        noise = self.noise or PsdNoise()
        if dtype.kind == "u":
            ceiling, quantisation = float(np.iinfo(dtype).max), 1.0 / 12.0
        else:
            # Twice the limit is finite, in amperes too: no sum below the limit overflows.
            ceiling, quantisation = float(np.finfo(real).max) / (4.0 * max(self.ampere, 1.0)), 0.0
        saturation = ceiling if self.saturation is None else min(self.saturation / self.ampere, ceiling)
        left_variance = (noise.independent / self.ampere) ** 2 + quantisation
        right_variance = left_variance / self.right_gain**2
        shot = 2.0 * ELECTRON * noise.bandwidth / self.ampere
        table = PsdTable(
            half_length=0.5 * self.strip_length / limit,
            limit=limit,
            range=limit * (1.0 - 2.0 * self.applied_margin / self.strip_length),
            minimum=self.minimum_total / self.ampere,
            saturation=saturation,
            ampere=self.ampere,
            dark_left=self.dark[0] / self.ampere,
            dark_right=self.dark[1] / self.ampere,
            right_gain=1.0 / self.right_gain,
            independent=0.5 * (left_variance + right_variance),
            asymmetry=0.5 * (left_variance - right_variance),
            opposed=(noise.opposed / self.ampere) ** 2,
            background=shot * (noise.background + noise.dark_current) / self.ampere,
            common_noise=noise.spot**2 * 2.0 * ELECTRON * noise.bandwidth / self.ampere,
        )
        return np.array(table, real)


def clipping_bias(centre: npt.ArrayLike, *, spot: float, strip_length: float) -> npt.NDArray[np.float64]:
    """Return the bias of a PSD reading because the ends of the strip cut a Gaussian light spot.

    Parameters
    ----------
    centre : array_like
        Centre x of the spot, from the middle of the strip [m], any shape. It may lie beyond the ends.
    spot : float
        Standard deviation s of the spot [m], > 0.
    strip_length : float
        Length L between the electrodes [m], > 0.

    Returns
    -------
    numpy.ndarray
        float64, the shape of ``centre``: reading minus centre [m]. It points away from the nearer end. The reading is
        always on the strip.

    Raises
    ------
    TypeError, ValueError
        A parameter is out of its range.

    Notes
    -----
    Only light within the strip counts. With a = (-L/2 - x) / s and b = (L/2 - x) / s the bias is
    ``s (phi(a) - phi(b)) / (Phi(b) - Phi(a))``, phi and Phi the density and the distribution of the standard normal.
    Near one end, c standard deviations inside the strip, it is ``-s phi(c) / Phi(c)``, of a signal reduced by the
    factor Phi(c): c = 3: -0.0044 s; 2: -0.055 s; 1: -0.29 s; 0: -0.80 s; -1 (centre beyond the end): -1.5 s.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.2.5.

    Examples
    --------
    >>> import gpuvision as gv
    >>> gv.clipping_bias([0.0, 2.9e-3, 3.0e-3], spot=50e-6, strip_length=6e-3).round(7).tolist()
    [0.0, -2.8e-06, -3.99e-05]
    """
    for name, value in (("spot", spot), ("strip_length", strip_length)):
        if finite(value, f"clipping_bias: {name}") <= 0.0:
            raise ValueError(f"clipping_bias: {name} is {value}, expected a length > 0")
    x = np.asarray(centre, np.float64)
    away = np.abs(x)
    # By symmetry the nearer end is the upper one: |a| >= |b|. Quotients of densities and distributions by their
    # logarithms have no underflow.
    a, b = (-0.5 * strip_length - away) / spot, (0.5 * strip_length - away) / spot
    log_share = log_ndtr(b)
    density = np.exp(-0.5 * b**2 - log_share) / math.sqrt(math.tau)  # phi(b) / Phi(b)
    beyond = np.expm1(0.5 * (b - a) * (b + a)) / np.expm1(log_ndtr(a) - log_share)
    # -0.0 becomes 0.0.
    return np.asarray(-np.sign(x) * spot * density * beyond + 0.0)


class PsdTable(NamedTuple):
    """Parameters of ``kernels/psd/psd.cl``, in the order and the units of its struct ``PsdTable``."""

    half_length: float
    limit: float
    range: float
    minimum: float
    saturation: float
    ampere: float
    dark_left: float
    dark_right: float
    right_gain: float
    independent: float
    asymmetry: float
    opposed: float
    background: float
    common_noise: float
