"""Light lines in camera frames: every column (or row) of a frame becomes a sub-pixel position of the light.

The line crosses the frame along its columns axis (``along="columns"``: a row coordinate for every column) or along
its rows axis (``along="rows"``: a column coordinate for every row). One such column or row of samples is a *profile*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from gpuvision.host import (
    Define,
    Device,
    Launch,
    LaunchBuilder,
    Precision,
    Variant,
    WorkSize,
    ceil_div,
    flags,
    round_up,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging.triangulation import SampleAxes, Triangulation
from gpuvision.validation import finite, integer

Method = Literal["centroid", "windowed", "gauss3", "fir", "ml"]
PeakSelection = Literal["strongest", "first", "last", "nearest"]

METHODS = ("centroid", "windowed", "gauss3", "fir", "ml")
PEAK_SELECTIONS = ("strongest", "first", "last", "nearest")
LONGEST_PROFILE = 32767  # samples: indices of narrow lanes are 16 bits
WIDEST_WINDOW = 180  # samples either side: moments of 16-bit samples in 32 bits
_LANES = 16
_GROUP = 64  # items of a work-group
_STRIP = 1024  # columns of a strip at most, MAX_STRIP in line_strip.h
_WIDE_BYTES = 64  # of neighbouring samples that a strip works on at once


class LineReading(NamedTuple):
    """What a frame's line says, each array of shape (batch..., samples); fields not asked for are ``None``.

    Attributes
    ----------
    position
        Place of the light along the profile [pixel]; NaN where the status has LOW_SIGNAL, OUT_OF_RANGE or NOT_FINITE.
    peak
        The peak's sample as recorded; the strongest sample where there is no peak.
    width
        Samples over the threshold: in the run that holds the peak, for ``method="centroid"`` in the whole profile.
    total
        Light over the threshold [grey levels]: in the window, for ``method="centroid"`` in the whole profile.
    status
        uint8 `Status` flags. LOW_SIGNAL: no peak that the parameters allow, or too little light beside it for the
        method. OUT_OF_RANGE: the border cuts the window, or a flat top wider than it (for ``"centroid"``: a border sample
        has half the peak's light or more). NOT_FINITE: a sample of the profile is NaN or infinite, or the sums are
        beyond the largest number. With a value:
        SATURATED (the peak is at the saturation level), AMBIGUOUS (a second peak is comparable, a flat top is wider
        than the window, or the fit fell back to the middle of a flat top). HORIZON and NOT_INVERTIBLE come from the
        triangulation.
    g, h
        The point in the sheet of light [m], where the readout has a triangulation.
    """

    position: Any = None
    peak: Any = None
    width: Any = None
    total: Any = None
    status: Any = None
    g: Any = None
    h: Any = None


@dataclass(frozen=True, kw_only=True)
class LineReadout(VisionOperation[LineReading]):
    """Light lines to positions: ``readout(frames) -> LineReading``.

    Takes uint8, uint16 or float32 frames of shape (..., rows, columns). Light is what a sample has over the
    threshold. Of samples that tie for the peak the first one counts. It and the neighbours after it that equal it are
    a flat top, which counts by its middle; one wider than the window is read as that middle and flagged AMBIGUOUS.

    Parameters
    ----------
    method : {"windowed", "centroid", "gauss3", "fir", "ml"}
        ``"centroid"``: centre of gravity of all light in the profile. The others look at the window around one peak:
        ``"windowed"`` takes its centre of gravity, ``"gauss3"`` a parabola through the logarithms of the peak and
        its neighbours, ``"fir"`` the zero crossing of a derivative filter (Blais and Rioux, 1986), ``"ml"`` the most
        likely pixel-integrated Gaussian on an unknown background, for noise of variance
        ``read_noise**2 + gain * level``.
    along : {"columns", "rows"}
        Which axis of the frame the line runs along: a profile is a column, or a row.
    threshold
        Level below which a sample counts as no light [grey levels]; for integer frames a whole number.
    window
        Samples either side of the peak that count.
    peak_selection : {"strongest", "first", "last", "nearest"}
        Which peak, where there are several. A peak is the strongest sample of a run of samples over the threshold.
        ``"nearest"``: to the position of an earlier reading, given as a second input of shape (..., samples) in the
        readout's precision, rounded to whole pixels; where that is NaN, the strongest.
    minimum_peak
        Weakest sample that can be a peak [grey levels].
    minimum_width, maximum_width
        Of the run of samples over the threshold (for ``"centroid"``: of their number) [pixel]. A hot pixel is a run
        of 1.
    saturation
        Level at which a sample is saturated; ``None``: the highest code of integer frames, no limit for float32.
        ``"ml"`` leaves saturated samples out of the fit.
    ambiguity
        Share of the peak's light from which on a sample outside the window makes the reading AMBIGUOUS;
        ``None`` does not look.
    fir_length : {4, 8}
        Taps of the derivative filter.
    read_noise, gain
        For ``"ml"``: standard deviation of a dark sample [grey levels], and variance per grey level of light (grey
        levels per electron).
    triangulation, axes
        Fuses sensor -> sheet into the same pass (outputs ``g`` and ``h``): u is the position, v the number of the
        profile, as ``axes`` places them.
    outputs
        Names of the `LineReading` fields to compute; what is not asked for is not compiled. ``None``: all.
    precision
        Of the arithmetic and the outputs; ``None`` is single.
    variant
        Wide strips or one item per profile; ``"auto"`` follows the device. Frames smaller than a strip's vectors
        are walked by items.

    Raises
    ------
    TypeError
        A parameter is no number, or a count no whole one.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: integer samples are summed exactly, float32 samples with their rounding kept, so that the position has a
    few roundings of its own size at most.
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
    triangulation: Triangulation | None = None
    axes: SampleAxes = SampleAxes()  # noqa: RUF009 (frozen, no state)
    outputs: tuple[str, ...] | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name in ("window", "minimum_width", "maximum_width", "fir_length"):
            if getattr(self, name) is not None or name != "maximum_width":
                object.__setattr__(self, name, integer(getattr(self, name), f"LineReadout.{name}"))
        self._check_names()
        self._check_numbers()
        possible = LineReading._fields if self.triangulation is not None else LineReading._fields[:5]
        for name in self.outputs or ():
            if name not in possible:
                raise ValueError(f"LineReadout.outputs has {name!r}, expected some of {', '.join(possible)}")
        object.__setattr__(self, "outputs", possible if self.outputs is None else tuple(self.outputs))

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
        finite(self.threshold, "LineReadout.threshold")
        for name in ("minimum_peak", "saturation"):
            if getattr(self, name) is not None:
                finite(getattr(self, name), f"LineReadout.{name}")
        for name in ("read_noise", "gain"):
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
    def _judges_width(self) -> bool:
        return self.minimum_width > 1 or self.maximum_width is not None

    @property
    def _has_candidates(self) -> bool:
        return self.method != "centroid" and (self.peak_selection != "strongest" or self._judges_width)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("uint8", "uint16", "float32", of="frames")
        build.check_shape(len(shape) >= 2 and 0 not in shape[-2:], "frames (..., rows, columns) of one pixel at least")
        batch, (rows, columns) = shape[:-2], shape[-2:]
        length, samples = (rows, columns) if self.along == "columns" else (columns, rows)
        if length > LONGEST_PROFILE or rows * columns >= 2**31:
            raise ValueError(
                f"LineReadout takes profiles of up to {LONGEST_PROFILE} samples in frames below 2**31, got {shape}"
            )
        frames = math.prod(batch)
        if build.uses_vectors and self._fits_strip(rows, columns, dtype):
            work = WorkSize((self._items(device, frames, samples), frames), (1, 1), vectors=True)
        else:
            work = WorkSize((round_up(samples, _GROUP), frames), (_GROUP, 1))
        chosen, of_samples = self.outputs or (), (*batch, samples)
        return build.launch(
            "line/line.cl",
            "line_readout",
            work=work,
            more_inputs=[(of_samples, build.real)] if self.peak_selection == "nearest" else [],
            outputs=build.outputs({name: of_samples if name in chosen else None for name in LineReading._fields}),
            defines=self._defines(dtype, length) | flags(PREFETCH=device.is_cpu),
            arguments=[
                np.int32(rows),
                np.int32(columns),
                *self._levels(dtype),
                self._packed(build.real, dtype, length),
                None if self.triangulation is None else self.triangulation.packed(build.real, self.axes),
            ],
            passes_once=work.vectors and self.method in ("centroid", "windowed"),
        )

    def _fits_strip(self, rows: int, columns: int, dtype: np.dtype[Any]) -> bool:
        if self._has_candidates:
            # Along a row one profile is walked at a time, whatever the variant: its dark parts are passed by in
            # vectors.
            return self.along == "columns" and columns >= _LANES
        return columns >= _WIDE_BYTES // dtype.itemsize and (self.along == "columns" or rows >= _LANES)

    def _items(self, device: Device, frames: int, samples: int) -> int:
        """Return the work-items per frame of the vector variant: few wide ones, but enough to keep every core busy."""
        if self.along == "rows" or self._has_candidates:
            return ceil_div(samples, _LANES)
        units = device.compute_units
        busy = ceil_div(2 * units, max(frames, 1)) if frames < 2 * units else 1
        return min(max(ceil_div(samples, _STRIP), busy), max(samples // 128, 1))

    def _levels(self, dtype: np.dtype[Any]) -> list[Any]:
        """Return threshold, saturation and weakest peak in the frames' own type."""
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

    def _defines(self, dtype: np.dtype[Any], length: int) -> dict[str, Define]:
        bits = 8 * dtype.itemsize
        defines = type_defines("CODE", dtype, 4, 8, 16) | {"CODE_BITS": bits}
        defines |= flags(**{f"METHOD_{self.method.upper()}": True, f"SELECT_{self.peak_selection.upper()}": True})
        reach = self.window + (self.fir_length // 2 if self.method == "fir" else 0)
        defines |= {"RADIUS": self.window, "REACH": reach, "FIR_HALF": self.fir_length // 2}
        chosen = self.outputs or ()
        defines |= flags(**{f"WITH_{name.upper()}": True for name in chosen})
        if self.triangulation is not None:
            defines |= {"WITH_SHEET": None} | self.triangulation.defines
        return defines | flags(
            ALONG_ROWS=self.along == "rows",
            AMBIGUITY=self.ambiguity is not None,
            CANDIDATES=self._has_candidates,
            WIDTH_LIMITS=self._judges_width,
            WITH_LIT="width" in chosen or (self.method == "centroid" and self._judges_width),
            LONG_MOMENT=bits < 32 and length**2 // 2 * np.iinfo(f"uint{bits}").max >= 2**32,
        )

    def _packed(self, real: np.dtype[Any], dtype: np.dtype[Any], length: int) -> Any:
        """Return the parameters of ``line.cl``, in its order."""
        widest = length if self.maximum_width is None else min(self.maximum_width, length)
        return np.array(
            [min(self.minimum_width, length + 1), widest, self.ambiguity or 0.0, self.read_noise**2, self.gain],
            real,
        )
