"""Sub-pixel location of blobs: vias, fiducials and pads near their expected places.

Calipers (rulers) across the expected contour find edges, and a robust fit of the shape through the edges gives centre,
size and angle. From there, a model of a blurred blob on a plane background is matched to the grey levels of the pixels,
which is as accurate as their noise allows:

    operation = FindBlobs(threshold=20.0, shape="circle", polarity="bright", search_px=6.0)
    blobs = operation(image, places)  # places: float32 (n, 3): x, y, radius [px]
    good = blobs.status == 0
    centres = np.stack([blobs.x, blobs.y], axis=-1)[good]
    covariances = blobs.covariance[good, :2, :2]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.host import (
    Define,
    Device,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    StatusArray,
    Variant,
    flags,
    round_up,
    type_defines,
)
from gpuvision.matching.features.ruler import RulerEdges, RulerTable
from gpuvision.matching.robust import efficiency, loss_defines
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite

Shape = Literal["circle", "ring", "square", "cross"]
Contrast = Literal["bright", "dark", "either"]

SHAPES = ("circle", "ring", "square", "cross")
CONTRASTS = ("bright", "dark", "either")
TUNING_CONSTANT = 6.0
"""Of Tukey's loss, in standard deviations: 98 % efficiency."""
MAX_SPOKES = 256
_LANES, _GROUP = 16, 64
_SHARES_PER_CORE = 4  # work-items per core: balances the cores
_INLINE = 24  # blobs up to which one thread is faster than waking a second one (measured)
# Polarity along a ruler across the contour, which points out of the blob.
_POLARITIES: dict[str, Literal["falling", "rising", "any"]] = {"bright": "falling", "dark": "rising", "either": "any"}


class Blobs(NamedTuple):
    """Blobs found near their expected places.

    Arrays of shape (n,) unless stated otherwise, NaN where a blob was refused.

    Attributes
    ----------
    x, y : float32
        Centre [px].
    shift : float32, (n, 2)
        Centre relative to the expected place [px]: the same information with more digits.
    size : float32
        Radius of a circle, outer radius of a ring, half the side of a square, half the length of a cross [px].
    angle : float32, optional
        Angle of squares and crosses [rad], from x towards y, near the expected one; None for circles and rings.
    covariance : float32, (n, 3, 3) or (n, 4, 4)
        Covariance of x, y, size; of squares and crosses of x, y, size, angle [px, rad]. From the residuals of the
        pixels; without ``match`` from the predicted noise of the edges or from their residuals, whichever is larger.
    residual : float32
        Weighted root mean square distance of the edges from the shape [px].
    inliers : int32
        Number of edges in the fit; 0 without a fit.
    symmetry : float32
        Agreement of opposite edges, 0 to 1: mean over all rulers of the root of the product of the two weights, times
        the ratio of the two heights. 1 for an undisturbed blob, lower by the share that is hidden.
    gravity_x, gravity_y : float32
        Centre of gravity of the grey levels within the contour and its blur, minus their mean in a ring of 2 px around
        it: a second estimate of the centre [px]. NaN also where the ring leaves the image.
    distance : float32
        Distance from the expected place [px].
    contrast : float32
        Grey level of the blob minus the grey level of its background.
    blur : float32
        Standard deviation of the edges' blur [px]; without ``match`` the blur of bilinear sampling (0.4 px on average)
        is included.
    status : uint8
        `Status` flags. LOW_SIGNAL: too few rulers found an edge above the threshold, of the polarity, within the search
        distance. OUT_OF_RANGE: too many rulers leave the image, or the blob is farther than the search distance from
        its expected place. NOT_FINITE: a place or radius is not finite, the radius is not above 0, or too many pixels
        are not finite. AMBIGUOUS: too few edges agree on one shape, or the match of the pixels has no minimum there.
        With a value: SATURATED (a ruler of the fit has reached the saturation).
    """

    x: FloatArray
    y: FloatArray
    shift: FloatArray
    size: FloatArray
    angle: FloatArray | None
    covariance: FloatArray
    residual: FloatArray
    inliers: IntArray
    symmetry: FloatArray
    gravity_x: FloatArray
    gravity_y: FloatArray
    distance: FloatArray
    contrast: FloatArray
    blur: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class FindBlobs(VisionOperation[Blobs]):
    """Blobs near their expected places: ``op(image, places) -> Blobs``.

    The image is uint8, uint16 or float32 of shape (rows, columns) with 16 columns or more. The places are float32: (n,
    3) x, y and radius of circles and rings, (n, 4) x, y, half side or half length, and angle [rad] of squares and
    crosses [px].

    Parameters
    ----------
    threshold : float
        Least height of an edge [grey levels], above 0: the height of a sharp step with the same maximum of the smoothed
        gradient.
    shape : {"circle", "ring", "square", "cross"}
        A ring has two concentric edges, a cross two bars of equal length and width.
    ratio : float
        Inner over outer radius of a ring; width over length of a bar of a cross; 0 to 1, exclusive, default 0.5.
    polarity : {"bright", "dark", "either"}
        Contrast of the blobs; "either": any contrast for each blob.
    search_px : float
        Largest distance of a blob from its expected place, and of an edge from the expected contour [px], above 0 to
        200, default 6.
    spokes : int
        Number of rulers of a blob, evenly over its contour: a multiple of 4 (of a ring 8), 8 to 256, default 16. With
        32, less of the contour is lost next to an object that hides a part of it.
    width : int
        Number of lines, 1 px apart, that a ruler averages, default 1. Without ``match`` the whole contour is used where
        spokes times width equals its length. Above a third of the radius it blurs the edge.
    smoothing_px : float
        Standard deviation of the Gaussian whose derivative finds the edges [px], default 1.5. `best_smoothing` is the
        optimum where it is below half the radius (of rings and crosses below half the width of the bar).
    passes : int
        Largest number of passes, 1 to 10, default 2: rulers are placed again where the blob was found more than 2 px
        (without ``match`` 0.1 px) from where they were.
    match : bool
        Whether to match the pixels; otherwise the result is the fit to the edges. Default True.
    min_inlier_fraction : float
        Least share of the rulers whose edges must agree on the shape, 0 to 1, exclusive, default 0.5.
    saturation : float, optional
        Grey level from which on a sample is saturated. None: no check.
    noise : float
        Standard deviation of a pixel [grey levels], default 1. The rounding of integer images is added.
    count : int, optional
        Number of blobs, n. None takes the number from the places of a call; `bind` needs a number.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 16 rulers at a time (CPU runtimes), "work_item" one work-group per blob
        (GPUs).

    Raises
    ------
    TypeError
        A parameter is not a number, or a count is not an integer.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    The fit starts from the shape, through three edges, that most edges agree with. Gauss-Newton with Tukey's weights
    follows; the range of accepted edges shrinks to the scale of the residuals (from their median). In every pass, edges
    farther than the search distance from the *expected* contour are excluded, so that the fit cannot drift to another
    blob.

    The match has these unknowns: centre, size and angle, blur, contrast, and level and slopes of the background. It
    uses Gauss-Newton with Tukey's weights (0 beyond a tenth of the contrast plus four standard deviations of the noise)
    over all pixels within five blurs and 2 px of the blob, except near the parts of the contour whose rulers do not
    agree. At signal to noise ratios of 6 to 200 and blurs of 0.5 px to a third of the radius, the centre's standard
    deviation is 1.0 to 1.25 times the Cramer-Rao bound of a disc on a known background, and the radius is right to 0.01
    px. A blur over a third of the radius makes the radius undetermined.

    To second order, a blurred edge of radius R is measured at sqrt(R^2 - v), with v the variance of the blur plus the
    variance of the averaged lines: the mean of sqrt(R^2 - u^2) over the position u across the ruler. The fit corrects
    the radius by it, with the mean blur of the blob's own edges. The match uses the profile of a blurred disc, to first
    order in blur over radius.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 6.3.2
       and 6.3.3.
    """

    Result: ClassVar[type[Any]] = Blobs
    takes_single_frames: ClassVar[bool] = True

    threshold: float
    shape: Shape = "circle"
    ratio: float = 0.5
    polarity: Contrast = "bright"
    search_px: float = 6.0
    spokes: int = 16
    width: int = 1
    smoothing_px: float = 1.5
    passes: int = 2
    match: bool = True
    min_inlier_fraction: float = 0.5
    saturation: float | None = None
    noise: float = 1.0
    count: int | None = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, allowed in (("shape", SHAPES), ("polarity", CONTRASTS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"FindBlobs.{name} is {getattr(self, name)!r}, expected one of {', '.join(allowed)}")
        for name, low, high in (("ratio", 0.0, 1.0), ("min_inlier_fraction", 0.0, 1.0), ("search_px", 0.0, 200.0)):
            if not low < finite(getattr(self, name), f"FindBlobs.{name}") < high:
                raise ValueError(f"FindBlobs.{name} is {getattr(self, name)}, expected a number in ({low:g}, {high:g})")
        multiple = 8 if self.shape == "ring" else 4
        for name, least, limit, of in (("spokes", 8, MAX_SPOKES, multiple), ("passes", 1, 10, 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"FindBlobs.{name} must be a whole number, got {value!r}")
            if not least <= value <= limit or value % of:
                raise ValueError(f"FindBlobs.{name} is {value}, expected {least} to {limit}, a multiple of {of}")
        self._ruler()

    def _ruler(self) -> RulerEdges:
        """Return the caliper (ruler) that finds the edges; it checks the parameters that both have."""
        ruler = RulerEdges(
            threshold=self.threshold,
            length=511,
            width=self.width,
            smoothing_px=self.smoothing_px,
            polarity=_POLARITIES[self.polarity],
            saturation=self.saturation,
            noise=self.noise,
            variant=self.variant,
            count=self.count,
        )
        return replace(ruler, length=2 * (math.ceil(self.search_px) + math.ceil(3.0 * self.smoothing_px)) + 3)

    def __call__(self, *inputs: Any, device: Device | None = None, out: Blobs | None = None) -> Blobs:
        """Run once on the places of this call; ``count=None`` takes their number."""
        if self.count is None and len(inputs) == 2 and getattr(inputs[1], "ndim", 0) == 2:
            return replace(self, count=len(inputs[1]))(*inputs, device=device, out=out)
        return super().__call__(*inputs, device=device, out=out)

    @property
    def _round(self) -> bool:
        return self.shape in ("circle", "ring")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if self.count is None:
            raise ValueError(
                "FindBlobs takes an image and nominal blobs; to bind it, set FindBlobs.count to the number of blobs"
            )
        edges = self._ruler().launch(device, shape, dtype)
        build = LaunchBuilder(self, device, shape, dtype, variant=self.variant)
        build.check_shape(shape[1] >= _LANES, f"images of {_LANES} columns or more")
        each = max(build.share(self.count, per_core=_SHARES_PER_CORE), 1)
        work = build.work(self.count, each=each, group=_GROUP, grouping="per_element")
        freedoms = 3 if self._round else 4
        shapes: dict[str, tuple[int, ...] | None] = dict.fromkeys(Blobs._fields, (self.count,))
        shapes |= {"shift": (self.count, 2), "covariance": (self.count, freedoms, freedoms)}
        noise = math.hypot(self.noise, math.sqrt(1.0 / 12.0) if dtype.kind == "u" else 0.0)
        numbers = ((self.width**2 - 1) / 12.0, self._overlap(), self._extent(), noise, self._contour() / self.spokes)
        least = max(math.ceil(self.min_inlier_fraction * self.spokes), freedoms + 1)
        return build.launch(
            "blob/blob.cl",
            "find_blobs",
            work=work,
            more_inputs=[((self.count, freedoms), build.real)],
            outputs=build.outputs(shapes | ({"angle": None} if self._round else {}), inliers=np.int32),
            defines={**edges.defines, **type_defines("CODE", dtype, 16), **self._defines(freedoms)},
            arguments=[
                self._table(edges),
                self._layout().astype(build.real),
                *map(np.int32, shape),
                np.uint32(self.count),
                np.uint32(each),
                np.float32(self.search_px),
                np.int32(least),
                *map(np.float32, numbers),
                np.int32(self.passes),
            ],
            passes_once=work.vectors and self.count <= _INLINE,
            by_team=True,
        )

    def _table(self, edges: Launch) -> npt.NDArray[Any]:
        """Return the table of ``ruler.h`` with the smoothing's variance as it acts on the maximum of an edge.

        The filter is cut at three standard deviations, which reduces the variance of the filter, but not the curvature
        at the maximum. With the filter's variance, the curvature correction would take the difference for blur. The
        value is exact for the blur whose best smoothing this is.
        """
        table = np.array(edges.arguments[0])
        taps, blur = table[len(RulerTable._fields) :].astype(np.float64), self.smoothing_px / math.sqrt(5.0)
        k = np.arange(-taps.size, taps.size + 1)
        weights = np.concatenate([-taps[::-1], [0.0], taps])
        peak, neighbour = (float(np.sum(weights * ndtr((k + at) / blur))) for at in (0.0, 1.0))
        table[RulerTable._fields.index("smoothing")] = 0.5 / math.log(peak / neighbour) - blur**2
        return table

    def _defines(self, freedoms: int) -> dict[str, Define]:
        return {
            **loss_defines("tukey", TUNING_CONSTANT),
            "EFFICIENCY": efficiency("tukey", TUNING_CONSTANT),
            "FREEDOMS": freedoms,
            "SPOKES": self.spokes,
            "PADDED_SPOKES": round_up(self.spokes, _LANES),
            **({"RATIO": float(self.ratio)} if self.shape in ("ring", "cross") else {}),
            **flags(ROUND=self._round, EITHER_POLARITY=self.polarity == "either", MATCH_IMAGE=self.match),
        }

    def _layout(self) -> npt.NDArray[np.float64]:
        """Return the table of ``blob.cl``: six rows; the rulers k and k + spokes / 2 are opposite."""
        half = _half_layout(self.shape, self.ratio, self.spokes // 2)
        base, normal = (np.concatenate([each, -each]) for each in half)
        height = np.abs(np.sum(base * normal, axis=-1))
        rows = np.concatenate([base.T, normal.T, [height, np.ones(self.spokes)]])
        fill = -self.spokes % _LANES
        padded = np.pad(rows, ((0, 0), (0, fill)), mode="edge")
        padded[-1, self.spokes :] = 0.0
        return padded

    def _overlap(self) -> float:
        """Return the size of a blob below which neighbouring rulers share pixels, and so their noise."""
        # Neighbouring lines share noise through the bilinear interpolation: the average of `width` lines has the noise
        # of this number of independent lines.
        lines = self.width**2 / (self.width - 1.0 / 3.0)
        return self.spokes * lines / self._contour()

    def _contour(self) -> float:
        """Return the length of the contour on which rulers lie, for a blob of size 1."""
        round_ = {"circle": 2.0 * math.pi, "ring": 2.0 * math.pi * (1.0 + self.ratio)}
        if self.shape in round_:
            return round_[self.shape]
        return 4.0 * (2.0 * _SIDE if self.shape == "square" else self._arm_length())

    def _arm_length(self) -> float:
        return _END * 2.0 * self.ratio + 2.0 * _FLANK * (1.0 - self.ratio)

    def _extent(self) -> float:
        """Return the distance of the farthest point of a blob of size 1 from its centre."""
        return {"square": math.sqrt(2.0), "cross": math.hypot(1.0, self.ratio)}.get(self.shape, 1.0)


# Share of a straight edge on which rulers lie: blur rounds the edge near its corners.
_SIDE, _END, _FLANK = 0.7, 0.5, 0.5


def _spread(count: int) -> npt.NDArray[np.float64]:
    """Return ``count`` numbers evenly over -1 to 1."""
    return (2.0 * np.arange(count) + 1.0) / count - 1.0


def _half_layout(shape: str, ratio: float, count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return centres and directions of the rulers of half a blob of size 1."""
    if shape == "circle":
        directions = _circle(np.arange(count) * math.pi / count)
        return directions, directions
    if shape == "ring":
        outer, inner = (
            _circle(np.arange(count // 2) * 2.0 * math.pi / count),
            _circle((np.arange(count // 2) + 0.5) * 2.0 * math.pi / count),
        )
        return np.concatenate([outer, ratio * inner]), np.concatenate([outer, -inner])
    arm = _side(count // 2) if shape == "square" else _arm(ratio, count // 2)
    turned = [np.stack([-each[:, 1], each[:, 0]], axis=-1) for each in arm]
    return np.concatenate([arm[0], turned[0]]), np.concatenate([arm[1], turned[1]])


def _circle(angle: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _side(count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    along = _SIDE * _spread(count)
    return np.stack([np.ones(count), along], axis=-1), np.tile([1.0, 0.0], (count, 1))


def _arm(ratio: float, count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return rulers across the end and the two flanks of the bar along x."""
    flank = max(round(0.375 * count), 0 if count < 3 else 1)
    end = count - 2 * flank
    out = 0.5 * (1.0 + ratio) + 0.5 * (1.0 - ratio) * _FLANK * _spread(flank)
    base = [(1.0, each) for each in ratio * _END * _spread(end)]
    base += [(each, side * ratio) for side in (1.0, -1.0) for each in out]
    normal = [(1.0, 0.0)] * end + [(0.0, 1.0)] * flank + [(0.0, -1.0)] * flank
    return np.array(base), np.array(normal)
