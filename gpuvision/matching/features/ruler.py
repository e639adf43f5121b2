"""Caliper (ruler): sub-pixel edges along short lines of samples anywhere in an image.

A ruler is a centre and a direction in the image. The operation averages the grey levels of several parallel lines and
differentiates the profile with the derivative of a Gaussian. An edge is a local extremum of the gradient. A parabola
through the logarithms of the extremum and its two neighbours gives its position; this is exact for a Gaussian edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import (
    Define,
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    StatusArray,
    Variant,
    ceil_div,
    flags,
    opencl_type,
    table_offsets,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, integer

Polarity = Literal["any", "rising", "falling"]
EdgeSelection = Literal["strongest", "first", "last", "all"]

POLARITIES = ("any", "rising", "falling")
EDGE_SELECTIONS = ("strongest", "first", "last", "all")
RULER_COLUMNS = ("x_px", "y_px", "cosine", "sine", "polarity", "least_spacing_px", "greatest_spacing_px")
"""Columns of the rulers with ``RulerEdges.per_ruler``; without it the first four."""
MAX_LENGTH = 512
"""Largest number of samples: the larger capacity of the kernel's arrays of samples."""
SAMPLING_SIGMA_PX = 0.02
"""Standard deviation of the error that bilinear sampling adds to an edge [px]; neighbours share a part (measured)."""
MAX_WIDTH = 255
MAX_EDGES = 64
_LANES, _GROUP = 16, 64
_SAMPLES_PER_GROUP = 512  # capacity for samples of a work-group, 8 for each item: 4 KiB of local memory
# Sizes of the kernel's arrays of samples: the length is an argument of the kernel, not a compilation for each length.
_CAPACITIES = (128, MAX_LENGTH)
_SIGNS = {"any": 0.0, "rising": 1.0, "falling": -1.0}
_SHARES_PER_CORE = 4  # work-items per core: balances the cores
_INLINE = 128  # rulers up to which one thread is faster than waking a second one (measured)
# Binary places of fixed-point positions, of 31 bits: a side of an image takes 15; a float's mantissa has 23.
_LEAST_BITS, _MOST_BITS = 15, 23
_REAL = np.dtype(np.float32)


class RulerTable(NamedTuple):
    """Parameters of ``kernels/ruler/ruler.h``, which reads them by name; the taps of the filter follow.

    Attributes
    ----------
    threshold
        Least gradient of an edge, of sums over the lines [grey levels].
    saturation
        Least saturated sample [grey levels].
    noise
        Standard deviation of half the difference of the gradients next to a maximum, of sums over the lines.
    smoothing
        Variance of the smoothing [samples^2].
    ambiguity
        Ratio of the second strongest edge to the strongest from which on an edge is ambiguous.
    nearest, farthest
        Least and greatest spacing of the edges of a pair [samples].
    curvature
        1 / (2 radius) of the edge [1/px].
    across
        Variance of the positions of the lines across the ruler [px^2].
    step
        Distance between samples [px].
    per_line
        Reciprocal of the number of lines.
    length
        Number of samples.
    polarity
        Sign of the edges, of the first edge of a pair: -1, 1, or 0 for both.
    """

    threshold: float
    saturation: float
    noise: float
    smoothing: float
    ambiguity: float
    nearest: float
    farthest: float
    curvature: float
    across: float
    step: float
    per_line: float
    length: float
    polarity: float


RULER_OFFSETS = table_offsets("RULER", {**dict.fromkeys(RulerTable._fields, 1), "taps": 0})


class Edges(NamedTuple):
    """Edges found by calipers (rulers): arrays of shape (n,), with ``edge_selection="all"`` (n, max_edges).

    Attributes
    ----------
    position : float32
        Position of the edge along the ruler, from its centre [px]; of a pair the middle of both edges. NaN where the
        status has LOW_SIGNAL, OUT_OF_RANGE, NOT_FINITE or NOT_INVERTIBLE, like all other fields.
    amplitude : float32
        Height of the step [grey levels], positive where the grey level rises along the ruler. Of a pair the mean height
        of both edges, with the sign of the first.
    width : float32
        Standard deviation of the edge's blur [px]. It includes the blur of bilinear sampling (0.4 px on average).
    sigma : float32
        Predicted standard deviation of the position [px] for the given ``noise``.
    status : uint8
        `Status` flags. LOW_SIGNAL: no edge above the threshold. OUT_OF_RANGE: the ruler leaves the image. NOT_FINITE: a
        number of the ruler or a pixel under it is not finite, or grey level times ``width`` exceeds 1e37.
        NOT_INVERTIBLE: the inverse of the lens model has no solution at the ruler. With a value: SATURATED (a sample of
        the ruler reached ``saturation``; the edge may be displaced), AMBIGUOUS (a second edge is comparable; with
        ``edge_selection="all"`` in the last column: there are more edges than ``max_edges``).
    spacing : float32, optional
        Distance between the two edges of a pair [px]; None without ``pairs`` and ``per_ruler``. NaN for a single edge.
    """

    position: FloatArray
    amplitude: FloatArray
    width: FloatArray
    sigma: FloatArray
    status: StatusArray
    spacing: FloatArray | None = None


def best_smoothing(blur_px: float) -> float:
    """Return the smoothing that locates an isolated edge of a given blur best: sqrt(5) times the blur.

    Parameters
    ----------
    blur_px : float
        Standard deviation of the edge's blur [px].

    Returns
    -------
    float
        Standard deviation of the Gaussian whose derivative is taken [px].

    Notes
    -----
    With smoothing a and blur s the variance of the gradient's maximum is (3/8) (a^2 + s^2)^3 / (a^5 s) times the
    Cramer-Rao bound (derived for white noise). Its minimum lies at a = sqrt(5) s, where the standard deviation is 1.20
    times the bound.
    """
    return math.sqrt(5.0) * blur_px


@dataclass(frozen=True, kw_only=True)
class RulerEdges(VisionOperation[Edges]):
    """Caliper (ruler), a 1-D edge measurement: ``op(image, rulers) -> Edges``.

    The image is uint8, uint16 or float32 of shape (rows, columns). The rulers are float32 of shape (n, 4): centre x, y
    [px], and cosine and sine of the direction along which the edge is measured (a unit vector). With ``per_ruler`` they
    are (n, 7): three more columns state the edge that each ruler looks for.

    Parameters
    ----------
    threshold : float
        Least height of an edge [grey levels], above 0: the height of a sharp step with the same maximum of the smoothed
        gradient.
    length : int
        Number of samples along a ruler, 5 to 512, default 64.
    width : int
        Number of averaged parallel lines, 1 px apart, 1 to 255, default 5.
    step_px : float
        Distance between samples [px], above 0, default 1.
    smoothing_px : float
        Standard deviation of the Gaussian whose derivative is taken [px], above 0, default 2. `best_smoothing` gives
        the optimum for isolated edges. A second edge nearer than 3 times this value shifts the result.
    polarity : {"any", "rising", "falling"}
        Sign of the step along the ruler; with ``pairs`` the sign of the first edge ("rising": a bright stripe).
    edge_selection : {"strongest", "first", "last", "all"}
        Which edge to return where there are several.
    max_edges : int
        Number of returned edges with ``edge_selection="all"``, 1 to 64, default 8.
    pairs : bool
        Whether to look for two adjacent edges of opposite sign, such as the borders of a trace. The middle of a pair
        does not depend on the etch bias. Default False.
    spacing_px : (float, float), optional
        Least and greatest distance between the edges of a pair [px], rounded to whole samples. None: any distance.
    per_ruler : bool
        Whether three more columns of the rulers state polarity and spacing of each ruler: sign of the step (of the
        first edge of a pair), -1 or 1; least and greatest spacing of the edges of a pair [px], 0 and 0 for a single
        edge. Single edges and pairs are then measured in one launch. With the default ``polarity``, ``pairs``,
        ``spacing_px`` and ``edge_selection`` only. Default False.
    ambiguity : float, optional
        Ratio of the second strongest to the strongest gradient from which on the edge is flagged AMBIGUOUS, above 0 to
        1, with ``edge_selection="strongest"`` only. None: no check.
    saturation : float, optional
        Grey level from which on a sample is saturated. None: no check. Range: above 0.
    noise : float
        Standard deviation of a pixel [grey levels], 0 or more, default 1. The rounding of integer images is added.
    radius_px : float, optional
        Radius of curvature of the edge [px]: positive where the centre of curvature lies ahead on the ruler, negative
        where it lies behind. The operation then corrects the bias towards the centre that blur and the averaged lines
        cause. None: straight edges.
    model : Lens or Camera, optional
        Lens model. Rulers and positions are then in undistorted pixels (of a `Camera`: with the camera matrix of the
        model), and the image is the measured one. None: no distortion.
    count : int, optional
        Number of rulers, n. None takes the number from the rulers of a call; `bind` needs a number.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 16 rulers at a time (CPU runtimes), "work_item" one work-group per four
        rulers, or per ruler of more than 128 samples (GPUs).

    Raises
    ------
    TypeError
        A parameter is not a number, a count is not an integer, or the model is neither a Lens nor a Camera.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: the samples are taken relative to a pixel at the ruler, so that single precision costs the position less than
    1e-4 px at contrasts above 10 times the threshold. Centres above 1024 px are rounded to 6e-5 px by their float32
    format. With a model the samples also have this rounding.

    Linear interpolation moves the maximum of the sampled gradient by up to 0.013 px along the pixels for a smoothing of
    1 px, and by 0.004 px at `best_smoothing`, both for a blur of 1.2 px. The operation corrects this for a Gaussian
    edge at right angles to the ruler; below 0.0035 px and 0.0015 px remain at any angle. With a model there is no such
    correction.

    A gradient of the illumination moves edges of both polarities towards the brighter side. Where the light changes by
    the fraction g per pixel along the ruler, the grey levels are (1 + g x) (m + h Phi(x / b)) for a blur b. The maximum
    of their gradient, smoothed by a, lies at g (a^2 + 2 b^2), whatever the levels m and h are; measured positions agree
    within 10 %. ``sigma`` does not contain this shift: 0.006 px for 75 % over 640 px, a = 2 and b = 0.8 px.

    ``sigma`` is the noise of the gradient at the maximum divided by the curvature there, for white noise and rulers at
    random sub-pixel positions. It agrees within 5 % with measured values from noise 0.5 at a step of 100 on, at any
    angle. At `best_smoothing` both are at most 1.2 times the Cramer-Rao bound of isolated edges (1.17 to 1.18 from a
    step of 6 to 200 times the noise).

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.6.5.

    Examples
    --------
    >>> import gpuvision as gv
    >>> caliper = gv.RulerEdges(threshold=20.0, length=48, width=5, smoothing_px=2.7, polarity="rising")
    """

    Result: ClassVar[type[Any]] = Edges
    takes_single_frames: ClassVar[bool] = True

    threshold: float
    length: int = 64
    width: int = 5
    step_px: float = 1.0
    smoothing_px: float = 2.0
    polarity: Polarity = "any"
    edge_selection: EdgeSelection = "strongest"
    max_edges: int = 8
    pairs: bool = False
    spacing_px: tuple[float, float] | None = None
    per_ruler: bool = False
    ambiguity: float | None = None
    saturation: float | None = None
    noise: float = 1.0
    radius_px: float | None = None
    model: Lens | Camera | None = None
    count: int | None = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, least, limit in (("length", 5, MAX_LENGTH), ("width", 1, MAX_WIDTH), ("max_edges", 1, MAX_EDGES)):
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
            finite(self.saturation, "RulerEdges.saturation", above=0.0)
        self._check_choices()
        if self.length < 2 * self._reach + 3:
            raise ValueError(
                f"RulerEdges.length is {self.length}, expected {2 * self._reach + 3} samples or more for a smoothing "
                f"of {self.smoothing_px} px; make it longer or smooth less"
            )

    def _check_choices(self) -> None:
        """Check the parameters that choose among edges."""
        for name, allowed in (("polarity", POLARITIES), ("edge_selection", EDGE_SELECTIONS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"RulerEdges.{name} is {getattr(self, name)!r}, expected one of {', '.join(allowed)}")
        if self.ambiguity is not None:
            if not 0.0 < finite(self.ambiguity, "RulerEdges.ambiguity") <= 1.0:
                raise ValueError(f"RulerEdges.ambiguity is {self.ambiguity}, expected a share, 0 < share <= 1")
            if self.edge_selection != "strongest":
                raise ValueError("RulerEdges.ambiguity goes with edge_selection='strongest' only; leave it out")
        if self.spacing_px is not None:
            if not self.pairs:
                raise ValueError("RulerEdges.spacing_px goes with pairs=True only; leave it out")
            low, high = (finite(each, "RulerEdges.spacing_px") for each in self.spacing_px)
            if not 0.0 <= low <= high:
                raise ValueError(f"RulerEdges.spacing_px is {self.spacing_px}, expected 0 <= least <= greatest")
        if self.per_ruler and (self.pairs or self.polarity != "any" or self.edge_selection != "strongest"):
            raise ValueError(
                "RulerEdges.per_ruler takes polarity and spacing from the rulers; leave out polarity, pairs and "
                "edge_selection"
            )
        if self.radius_px is not None and finite(self.radius_px, "RulerEdges.radius_px") == 0.0:
            raise ValueError("RulerEdges.radius_px is 0, expected a radius, or None for straight edges")
        if self.model is not None and not isinstance(self.model, Lens | Camera):
            raise TypeError(f"RulerEdges.model is {self.model!r}, expected a Lens or a Camera")

    @property
    def _reach(self) -> int:
        """Number of filter taps on either side of the centre."""
        return math.ceil(3.0 * self.smoothing_px / self.step_px)

    @property
    def _capacity(self) -> int:
        """Number of samples that the kernel's arrays hold."""
        return next(each for each in _CAPACITIES if self.length <= each)

    @property
    def _binary_places(self) -> int:
        """Number of binary places after the point of a fixed-point position [bits].

        The position runs along the ruler, or with a model through the image.
        """
        if self.model is not None:
            return _LEAST_BITS
        extent = (self.length - 1) * self.step_px + self.width + 2
        return min(max(30 - math.ceil(math.log2(extent)), _LEAST_BITS), _MOST_BITS)

    @property
    def _measures_pairs(self) -> bool:
        return self.pairs or self.per_ruler

    @property
    def _places(self) -> int:
        """Number of returned edges of a ruler."""
        return self.max_edges if self.edge_selection == "all" else 1

    def __call__(self, *inputs: Any, device: Device | None = None, out: Edges | None = None) -> Edges:
        """Run once on the rulers of this call; ``count=None`` takes their number."""
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
            raise ValueError(
                "RulerEdges takes an image and rulers; to bind it, set RulerEdges.count to the number of rulers"
            )
        each = max(build.share(self.count, per_core=_SHARES_PER_CORE, multiple=_LANES), _LANES)
        groups = ceil_div(self.count, each if build.uses_vectors else _SAMPLES_PER_GROUP // self._capacity)
        work = build.work(groups, each=1, group=_GROUP, grouping="per_element")
        found = (self.count, self.max_edges) if self.edge_selection == "all" else (self.count,)
        shapes = dict.fromkeys(("position", "amplitude", "width", "sigma"), found)
        return build.launch(
            "ruler/ruler.cl",
            "ruler_edges",
            work=work,
            more_inputs=[((self.count, len(RULER_COLUMNS) if self.per_ruler else 4), build.real)],
            outputs=build.outputs({**shapes, "spacing": found if self._measures_pairs else None, "status": found}),
            defines=self._defines(dtype),
            arguments=[
                self._packed(dtype),
                self._packed_model(),
                *map(np.int32, shape),
                np.uint32(self.count),
                np.uint32(each),
            ],
            passes_once=work.vectors and self.count <= _INLINE,
            by_team=True,
        )

    def _defines(self, dtype: np.dtype[Any]) -> dict[str, Define]:
        chosen = [f"CODE_{opencl_type(dtype)}", f"CHOOSE_{self.edge_selection.upper()}"]
        return {
            **({} if self.model is None else self._model_defines(self.model)),
            **type_defines("CODE", dtype),
            **RULER_OFFSETS,
            "RULER_CAPACITY": self._capacity,
            "RULERS_PER_GROUP": _SAMPLES_PER_GROUP // self._capacity,
            "WIDTH": self.width,
            "TAPS": self._reach,
            "MAX_EDGES": self._places,
            "RULER_GROUP": _GROUP,
            "RULER_BITS": self._binary_places,
            **dict.fromkeys(chosen),
            **flags(
                PAIRS=self._measures_pairs,
                PER_RULER=self.per_ruler,
                AMBIGUITY=self.ambiguity is not None,
                SATURATION=self.saturation is not None,
                CURVED=self.radius_px is not None,
            ),
        }

    @staticmethod
    def _model_defines(model: Lens | Camera) -> dict[str, Define]:
        return dict(model.defines() if isinstance(model, Camera) else model.defines)

    def _packed_model(self) -> npt.NDArray[Any] | None:
        if self.model is None:
            return None
        if isinstance(self.model, Camera):
            return self.model.packed(_REAL, "distort")
        with np.errstate(over="ignore"):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(_REAL)

    def _packed(self, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return the parameter table of ``ruler.h``."""
        taps = self._taps()
        k = np.arange(1, self._reach + 1)
        smoothing = float(np.sum(2.0 * taps * k**3)) / 3.0
        noise = math.sqrt(self.noise**2 + (1.0 / 12.0 if dtype.kind == "u" else 0.0))
        low, high = self.spacing_px or (0.0, math.inf)
        table = RulerTable(
            threshold=self.threshold / math.sqrt(2.0 * math.pi * smoothing) * self.width,
            saturation=math.inf if self.saturation is None else self.saturation,
            noise=noise * self._noise_gain(taps) * self.width,
            smoothing=smoothing,
            ambiguity=self.ambiguity or 0.0,
            nearest=round(low / self.step_px),
            farthest=round(high / self.step_px) if math.isfinite(high) else math.inf,
            curvature=0.0 if self.radius_px is None else 0.5 / self.radius_px,
            across=(self.width**2 - 1) / 12.0,
            step=self.step_px,
            per_line=1.0 / self.width,
            length=self.length,
            polarity=_SIGNS[self.polarity],
        )
        return np.array([*table, *taps], _REAL)

    def _taps(self) -> npt.NDArray[np.float64]:
        """Return the derivative of the Gaussian at 1, 2, ... samples; the gradient of a ramp is then its slope."""
        k = np.arange(1, self._reach + 1)
        taps = k * np.exp(-0.5 * (k * self.step_px / self.smoothing_px) ** 2)
        return np.asarray(taps / np.sum(2.0 * k * taps))

    def _noise_gain(self, taps: npt.NDArray[np.float64]) -> float:
        """Return the noise of half the difference of the two gradients next to a maximum, for pixel noise 1.

        Bilinear samples at random sub-pixel positions are correlated; the covariance of two samples is the cubic
        B-spline of their distance.
        """
        slope = np.concatenate([-taps[::-1], [0.0], taps])
        half_difference = 0.5 * (np.pad(slope, (2, 0)) - np.pad(slope, (0, 2)))
        along = np.arange(half_difference.size) * self.step_px
        across = np.arange(self.width)
        shared = _cubic_spline(along[:, None] - along)
        lines = float(np.mean(_cubic_spline(across[:, None] - across)))
        return math.sqrt(float(half_difference @ shared @ half_difference) * lines)


def _cubic_spline(distance: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the cubic B-spline of a distance [samples]: the overlap integral of two triangles at this distance."""
    far = np.abs(distance).astype(np.float64)
    inner = 2.0 / 3.0 - far**2 + 0.5 * far**3
    return np.asarray(np.where(far < 1.0, inner, np.maximum(2.0 - far, 0.0) ** 3 / 6.0))
