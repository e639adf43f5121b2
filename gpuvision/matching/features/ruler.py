"""Edges along rulers: short lines of samples anywhere in a frame, at which a step of the grey level is located.

A ruler is a centre and a direction in the image. Along it the grey levels of several parallel lines are averaged and
differentiated with the derivative of a Gaussian; an edge is a peak of that gradient, refined by a parabola through the
logarithms of the peak and its neighbours (exact for a Gaussian edge).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Define, Device, Launch, LaunchBuilder, Variant, flags, opencl_type, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, integer

Polarity = Literal["any", "rising", "falling"]
Choice = Literal["strongest", "first", "last", "all"]

POLARITIES = ("any", "rising", "falling")
CHOICES = ("strongest", "first", "last", "all")
LONGEST = 512  # samples: a bit of 32 for each 16 gradients
WIDEST = 255
MOST_EDGES = 64
_LANES, _GROUP = 16, 64
_SHARES_PER_CORE = 4  # keep the cores even
_ALONE = 128  # rulers that the caller's thread does sooner than it wakes another
_LEAST_BITS, _MOST_BITS = 15, 23  # of 31, as a side of an image has 15; the most are what a mantissa has
_REAL = np.dtype(np.float32)


class Edges(NamedTuple):
    """What rulers found, each array of shape (n,), for ``choice="all"`` (n, most).

    Attributes
    ----------
    position
        Of the edge from the ruler's centre along its direction, of a pair the middle [px]; NaN where the status has
        LOW_SIGNAL, OUT_OF_RANGE, NOT_FINITE or NOT_INVERTIBLE, and so are the others.
    amplitude
        Height of the step [grey levels], above 0 where it rises along the ruler. Of a pair the mean of both, with the
        sign of the first.
    width
        Standard deviation of the edge's blur [px], that of the bilinear samples (0.4 px on average) included.
    sigma
        Predicted standard deviation of the position [px], from the noise that the operation was given.
    status
        uint8 `Status` flags. LOW_SIGNAL: no edge over the threshold. OUT_OF_RANGE: the ruler leaves the image.
        NOT_FINITE: a number of the ruler or a pixel under it is not, or grey levels times lines are beyond 1e37.
        NOT_INVERTIBLE: the lens has no such point. With a value: SATURATED (a sample of the ruler reached the
        saturation, the edge may be displaced), AMBIGUOUS (a second edge is comparable; for ``choice="all"`` in the last
        place: there are more).
    spacing
        Of the edges of a pair [px]; None without ``pairs``.
    """

    position: Any
    amplitude: Any
    width: Any
    sigma: Any
    status: Any
    spacing: Any = None


def best_smoothing(blur_px: float) -> float:
    """Return the smoothing that locates an isolated edge of such a blur best: sqrt(5) times it.

    A gradient's peak has (3/8) (a^2 + s^2)^3 / (a^5 s) times the least possible variance for a smoothing a and a
    blur s: 1.20 times its standard deviation there.
    """
    return math.sqrt(5.0) * blur_px


@dataclass(frozen=True, kw_only=True)
class RulerEdges(VisionOperation[Edges]):
    """Edges along rulers: ``op(image, rulers) -> Edges``.

    Takes a uint8, uint16 or float32 image (rows, columns) and float32 rulers (n, 4): centre x, y [px], and the cosine
    and sine of the direction along which the edge is looked for (of length 1).

    Parameters
    ----------
    threshold
        Least height of an edge [grey levels]: that of a sharp step of the same greatest gradient.
    length
        Samples of a ruler.
    width
        Lines averaged, a pixel apart.
    step_px
        From sample to sample.
    smoothing_px
        Of the Gaussian whose derivative is taken. `best_smoothing` is the optimum for isolated edges; a neighbour
        nearer than 3 times this pulls.
    polarity
        Whether edges count that rise along the ruler, fall, or any; of pairs that of the first edge (``"rising"``: a
        bright stripe).
    choice
        Which edge, where there are several.
    most
        Places for edges, for ``choice="all"``.
    pairs
        Look for two edges of opposite sign next to each other, such as the borders of a trace; how wide it was
        etched drops out of the middle.
    spacing_px
        Least and greatest distance of the edges of a pair, to whole samples; None: any.
    ambiguity
        Share of the strongest edge's gradient from which on a second one makes it AMBIGUOUS; None does not look. For
        ``choice="strongest"``.
    saturation
        Level at which a sample is saturated; None does not look.
    noise
        Standard deviation of a pixel [grey levels]; the rounding of integer images comes on top of it.
    radius_px
        Of the edge's curvature, above 0 where its centre lies ahead on the ruler, below 0 behind; the position is
        then that of the edge on the ruler's middle line, where blur and the averaged lines would have it nearer to
        the centre. None: straight.
    model
        `Lens` or `Camera`: rulers and positions are in undistorted pixels (of a `Camera`: under its own matrix), the
        image is as measured. None: no lens.
    count
        Rulers, n. None follows the rulers of a call; `bind` needs it.
    variant
        "vector" (16 samples at a time, for CPU runtimes), "work_item" (a work-group per ruler, for GPUs), or "auto".

    Raises
    ------
    TypeError
        A parameter is no number, a count no whole one, or the model none of these.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: samples are taken relative to a pixel of the ruler's own, so that single precision costs the position less
    than 1e-4 px at contrasts over 10 times the threshold; centres above 1024 px are rounded to 6e-5 px as they are
    given. With a model the samples have that rounding.

    Linear interpolation moves the sampled peak of an edge, by 0.013 px along the pixels for a smoothing of 1 px and
    0.004 px at `best_smoothing`, both for a blur of 1.2 px. That is taken back, for a Gaussian edge at right angles to
    the ruler; what is left is below 0.0035 px and 0.0015 px at any angle. With a model it is not.

    ``sigma`` is the gradient noise at the peak over the curvature there, for white noise and rulers at random places:
    within 5 % of what is measured from noise 0.5 at a step of 100 on, at any angle. At `best_smoothing` both are 1.2
    times the Cramer-Rao bound of isolated edges, or less (1.17 to 1.18 from a step of 6 to 200 times the noise).
    """

    Result: ClassVar[type[Any]] = Edges

    threshold: float
    length: int = 64
    width: int = 5
    step_px: float = 1.0
    smoothing_px: float = 2.0
    polarity: Polarity = "any"
    choice: Choice = "strongest"
    most: int = 8
    pairs: bool = False
    spacing_px: tuple[float, float] | None = None
    ambiguity: float | None = None
    saturation: float | None = None
    noise: float = 1.0
    radius_px: float | None = None
    model: Lens | Camera | None = None
    count: int | None = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, least, limit in (("length", 5, LONGEST), ("width", 1, WIDEST), ("most", 1, MOST_EDGES)):
            object.__setattr__(
                self, name, integer(getattr(self, name), f"RulerEdges.{name}", minimum=least, maximum=limit)
            )
        if self.count is not None:
            object.__setattr__(self, "count", integer(self.count, "RulerEdges.count", minimum=0, maximum=2**31 - 1))
        for name in ("threshold", "step_px", "smoothing_px"):
            if finite(getattr(self, name), f"RulerEdges.{name}") <= 0.0:
                raise ValueError(f"RulerEdges.{name} is {getattr(self, name)}, expected a number above 0")
        if finite(self.noise, "RulerEdges.noise") < 0.0:
            raise ValueError(f"RulerEdges.noise is {self.noise}, expected a number >= 0")
        if self.saturation is not None:
            finite(self.saturation, "RulerEdges.saturation")
        self._check_choices()
        if self.length < 2 * self._reach + 3:
            raise ValueError(
                f"RulerEdges.length is {self.length}, expected {2 * self._reach + 3} samples or more for a smoothing "
                f"of {self.smoothing_px} px; make it longer or smooth less"
            )

    def _check_choices(self) -> None:
        for name, allowed in (("polarity", POLARITIES), ("choice", CHOICES)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"RulerEdges.{name} is {getattr(self, name)!r}, expected one of {', '.join(allowed)}")
        if self.ambiguity is not None:
            if not 0.0 < finite(self.ambiguity, "RulerEdges.ambiguity") <= 1.0:
                raise ValueError(f"RulerEdges.ambiguity is {self.ambiguity}, expected a share, 0 < share <= 1")
            if self.choice != "strongest":
                raise ValueError("RulerEdges.ambiguity goes with choice='strongest' only; leave it out")
        if self.spacing_px is not None:
            if not self.pairs:
                raise ValueError("RulerEdges.spacing_px goes with pairs=True only; leave it out")
            low, high = (finite(each, "RulerEdges.spacing_px") for each in self.spacing_px)
            if not 0.0 <= low <= high:
                raise ValueError(f"RulerEdges.spacing_px is {self.spacing_px}, expected 0 <= least <= greatest")
        if self.radius_px is not None and finite(self.radius_px, "RulerEdges.radius_px") == 0.0:
            raise ValueError("RulerEdges.radius_px is 0, expected a radius, or None for straight edges")
        if self.model is not None and not isinstance(self.model, Lens | Camera):
            raise TypeError(f"RulerEdges.model is {self.model!r}, expected a Lens or a Camera")

    @property
    def _reach(self) -> int:
        """Taps either side."""
        return math.ceil(3.0 * self.smoothing_px / self.step_px)

    @property
    def _binary_places(self) -> int:
        """Return how many a fixed-point place along a ruler, or with a model in the image, has below a pixel."""
        if self.model is not None:
            return _LEAST_BITS
        extent = (self.length - 1) * self.step_px + self.width + 2
        return min(max(30 - math.ceil(math.log2(extent)), _LEAST_BITS), _MOST_BITS)

    @property
    def _places(self) -> int:
        return self.most if self.choice == "all" else 1

    def __call__(self, *inputs: Any, device: Device | None = None, out: Edges | None = None) -> Edges:
        """Run once, as every `Operation`; with ``count=None`` for as many rulers as there are."""
        if self.count is None and len(inputs) == 2 and getattr(inputs[1], "ndim", 0) == 2:
            return replace(self, count=len(inputs[1]))(*inputs, device=device, out=out)
        return super().__call__(*inputs, device=device, out=out)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, variant=self.variant)
        build.check_dtype("uint8", "uint16", "float32", of="images")
        is_valid = len(shape) == 2 and min(shape) >= 2 and max(shape) < 2**15
        build.check_shape(is_valid, f"images (rows, columns) of 2 to {2**15 - 1} each")
        if self.count is None:
            raise ValueError("RulerEdges.count is None; to bind it say how many rulers there will be")
        each = max(build.share(self.count, per_core=_SHARES_PER_CORE, multiple=_LANES), _LANES)
        work = build.work(self.count, each=each, group=_GROUP, grouping="per_element")
        found = (self.count, self.most) if self.choice == "all" else (self.count,)
        shapes = dict.fromkeys(("position", "amplitude", "width", "sigma"), found)
        return build.launch(
            "ruler/ruler.cl",
            "ruler_edges",
            work=work,
            more_inputs=[((self.count, 4), build.real)],
            outputs=build.outputs({**shapes, "spacing": found if self.pairs else None, "status": found}),
            defines=self._defines(dtype),
            arguments=[
                self._packed(dtype),
                self._packed_model(),
                *map(np.int32, shape),
                np.uint32(self.count),
                np.uint32(each),
            ],
            passes_once=work.vectors and self.count <= _ALONE,
        )

    def _defines(self, dtype: np.dtype[Any]) -> dict[str, Define]:
        chosen = [f"CODE_{opencl_type(dtype)}", f"CHOOSE_{self.choice.upper()}"]
        chosen += [] if self.polarity == "any" else [self.polarity.upper()]
        return {
            **({} if self.model is None else self._model_defines(self.model)),
            **type_defines("CODE", dtype),
            "LENGTH": self.length,
            "WIDTH": self.width,
            "TAPS": self._reach,
            "MOST": self._places,
            "RULER_GROUP": _GROUP,
            "RULER_BITS": self._binary_places,
            **dict.fromkeys(chosen),
            **flags(
                PAIRS=self.pairs,
                AMBIGUITY=self.ambiguity is not None,
                SATURATION=self.saturation is not None,
                CURVED=self.radius_px is not None,
            ),
        }

    @staticmethod
    def _model_defines(model: Lens | Camera) -> dict[str, int | None]:
        return dict(model.defines() if isinstance(model, Camera) else model.defines)

    def _packed_model(self) -> npt.NDArray[Any] | None:
        if self.model is None:
            return None
        if isinstance(self.model, Camera):
            return self.model.packed(_REAL, "distort")
        with np.errstate(over="ignore"):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(_REAL)

    def _packed(self, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return the table of ``ruler.h``."""
        taps = self._taps()
        k = np.arange(1, self._reach + 1)
        smoothing = float(np.sum(2.0 * taps * k**3)) / 3.0
        noise = math.sqrt(self.noise**2 + (1.0 / 12.0 if dtype.kind == "u" else 0.0))
        low, high = self.spacing_px or (0.0, math.inf)
        table = [
            self.threshold / math.sqrt(2.0 * math.pi * smoothing) * self.width,
            math.inf if self.saturation is None else self.saturation,
            noise * self._noise_gain(taps) * self.width,
            smoothing,
            self.ambiguity or 0.0,
            *(round(low / self.step_px), round(high / self.step_px) if math.isfinite(high) else math.inf),
            0.0 if self.radius_px is None else 0.5 / self.radius_px,
            (self.width**2 - 1) / 12.0,
            self.step_px,
            1.0 / self.width,
        ]
        return np.array([*table, *taps], _REAL)

    def _taps(self) -> npt.NDArray[np.float64]:
        """Return the derivative of the Gaussian at 1, 2, ... samples: its gradient of a ramp is the ramp's."""
        k = np.arange(1, self._reach + 1)
        taps = k * np.exp(-0.5 * (k * self.step_px / self.smoothing_px) ** 2)
        return np.asarray(taps / np.sum(2.0 * k * taps))

    def _noise_gain(self, taps: npt.NDArray[np.float64]) -> float:
        """Return the noise of half the difference of the gradients beside a peak, for pixels of noise 1.

        Bilinear samples at random places share noise as far as the cubic B-spline of their distance.
        """
        slope = np.concatenate([-taps[::-1], [0.0], taps])
        half_difference = 0.5 * (np.pad(slope, (2, 0)) - np.pad(slope, (0, 2)))
        along = np.arange(half_difference.size) * self.step_px
        across = np.arange(self.width)
        shared = _cubic_spline(along[:, None] - along)
        lines = float(np.mean(_cubic_spline(across[:, None] - across)))
        return math.sqrt(float(half_difference @ shared @ half_difference) * lines)


def _cubic_spline(distance: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the cubic B-spline: what two triangles that far apart have in common."""
    far = np.abs(distance).astype(np.float64)
    near = 2.0 / 3.0 - far**2 + 0.5 * far**3
    return np.asarray(np.where(far < 1.0, near, np.maximum(2.0 - far, 0.0) ** 3 / 6.0))
