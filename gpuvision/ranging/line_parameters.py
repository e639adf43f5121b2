"""Parameters of the line readout with their checks, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from gpuvision.host import FloatArray, Precision, StatusArray, Variant
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.validation import finite, integer

Method = Literal["centroid", "windowed", "gauss3", "fir", "ml"]
PeakSelection = Literal["strongest", "first", "last", "nearest"]

METHODS = ("centroid", "windowed", "gauss3", "fir", "ml")
PEAK_SELECTIONS = ("strongest", "first", "last", "nearest")
_FIELDS = ("position", "peak", "width", "total", "status")  # default outputs without a triangulation
WIDEST_WINDOW = 180  # samples on either side: sums of 16-bit samples times their index fit 32 bits


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
        - NOT_FINITE: a sample of the profile is NaN or infinite, or a sum overflows. No other flag is set then.

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
class LineParameters:
    """Parameters of `gpuvision.LineReadout`, which documents them."""

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
