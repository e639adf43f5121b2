"""Marks located to a fraction of a pixel: vias, fiducials and pads near places where they are expected.

Rulers lie across the contour of the expected mark, each finds an edge, and a robust fit of the shape through the edges
gives the mark's centre, size and angle. From there the grey levels of its pixels are matched to a blurred mark on a
plane background, which is as accurate as their noise allows:

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

from gpuvision.host import Define, Device, Launch, LaunchBuilder, Variant, flags, round_up
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.robust import efficiency, loss_defines
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite

Shape = Literal["circle", "ring", "square", "cross"]
Contrast = Literal["bright", "dark", "either"]

SHAPES = ("circle", "ring", "square", "cross")
CONTRASTS = ("bright", "dark", "either")
BEND = 6.0  # of Tukey's loss [sigma]: 98 % efficient
MOST_SPOKES = 256
_LANES, _GROUP = 16, 64
_SHARES_PER_CORE = 4  # keep the cores even
_ALONE = 8  # marks that the caller's thread does sooner than it wakes another
_SMOOTHING, _TAPS = 3, 11  # in the table of ruler.h
# Of rulers across a mark's edge: polarity along the ruler, which leaves the mark's area.
_POLARITIES: dict[str, Literal["falling", "rising", "any"]] = {"bright": "falling", "dark": "rising", "either": "any"}


class Blobs(NamedTuple):
    """What was found at each place, arrays of shape (n,) unless said otherwise; all are NaN unless the mark is trusted.

    Attributes
    ----------
    x, y
        Centre [px].
    shift
        (n, 2) the centre relative to the nominal place [px]: the same, with more digits.
    size
        Radius of a circle, outer radius of a ring, half of a square's side or of a cross's length [px].
    angle
        Of squares and crosses [rad], from x towards y, near the nominal one; None for round marks.
    covariance
        (n, 3, 3) of x, y, size; of squares and crosses (n, 4, 4) with the angle [px, rad]: from what the pixels differ
        from the matched mark. Without ``match`` from the noise of the edges as it is predicted, or as they differ from
        the shape, whichever is more.
    residual
        Root mean square distance of the edges from the shape [px], as they weigh in the fit.
    inliers
        int32, how many edges the fit to them has; 0 where there is none.
    symmetry
        How well opposite edges agree, 0 to 1: the mean over all rulers of the root of the weights of an edge and the
        one opposite, times the ratio of their heights. 1 for an undisturbed mark, lower by the share that is hidden.
    gravity_x, gravity_y
        Centre of gravity of what differs from the background, a second estimate [px]: of the grey levels within the
        found contour and its blur, less their mean in a ring of 2 px about that. NaN also where the ring leaves the
        image.
    distance
        From the nominal place [px].
    contrast
        Grey levels of the mark above its background.
    blur
        Standard deviation of the edges' blur [px]; without ``match`` that of bilinear samples (0.4 px on average)
        included.
    status
        uint8 `Status` flags. LOW_SIGNAL: too few rulers found an edge over the threshold, of the polarity, within the
        search radius. OUT_OF_RANGE: too many rulers leave the image, or the mark lies further than the search radius
        from its nominal place. NOT_FINITE: a place or radius is not finite, the radius not above 0, or too many
        pixels are not finite. AMBIGUOUS: too few of the edges agree on one shape, or the pixels have none there. With
        a value: SATURATED (a ruler of the fit has reached the saturation).
    """

    x: Any
    y: Any
    shift: Any
    size: Any
    angle: Any
    covariance: Any
    residual: Any
    inliers: Any
    symmetry: Any
    gravity_x: Any
    gravity_y: Any
    distance: Any
    contrast: Any
    blur: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class FindBlobs(VisionOperation[Blobs]):
    """Marks near their nominal places: ``op(image, places) -> Blobs``.

    Takes a uint8, uint16 or float32 image (rows, columns), 16 columns or more, and float32 places: (n, 3) x, y and
    radius of circles and rings, (n, 4) x, y, half side or half length, and angle [rad] of squares and crosses [px].

    Parameters
    ----------
    threshold
        Least height of an edge [grey levels]: that of a sharp step of the same greatest gradient.
    shape
        ``"circle"``, ``"ring"`` (two concentric edges), ``"square"``, ``"cross"`` (two bars of equal length and width).
    ratio
        Of a ring: inner radius to outer radius; of a cross: width to length of a bar.
    polarity
        Whether marks are ``"bright"``, ``"dark"``, or ``"either"``, each for itself.
    search_px
        How far from its nominal place a mark may be, and an edge from the nominal contour.
    spokes
        Rulers of a mark, a multiple of 4 (of a ring 8), evenly over its contour. With 32 less is lost beside what
        hides a part of the contour.
    width
        Lines averaged by a ruler, a pixel apart: without ``match`` all of the contour is used where spokes times width
        is as long as it is. More than a third of the radius blurs the edge.
    smoothing_px
        Of the edges; `best_smoothing` of the blur is the optimum where the mark is wide enough: less than half its
        radius (of rings and crosses half the width of the bar).
    passes
        How often rulers are laid, at most: again where the mark was found more than 2 px (without ``match`` 0.1 px)
        from where they were.
    match
        Match the pixels; else the fit to the edges is what is returned.
    agreement
        Share of the rulers whose edges must agree on the shape.
    saturation
        Level at which a sample is saturated; None does not look.
    noise
        Standard deviation of a pixel [grey levels]; the rounding of integer images comes on top of it.
    count
        Marks, n. None follows the places of a call; `bind` needs it.
    variant
        "vector" (16 rulers at a time, for CPU runtimes), "work_item" (a work-group per mark, for GPUs), or "auto".

    Raises
    ------
    TypeError
        A parameter is no number, or a count no whole one.
    ValueError
        A parameter is out of its range.

    Notes
    -----
    The fit starts from the shape through three edges that most edges agree with. Gauss-Newton with Tukey's weights
    follows, within a reach that shrinks to the scale of the residuals (from their median). Whatever place a later pass
    starts from, edges further than the search radius from the *nominal* contour are left out: it cannot walk away to
    another mark.

    The match has the centre, size and angle, the blur, the contrast, and level and slopes of the background as
    unknowns (Gauss-Newton, Tukey's weights, none past a tenth of the contrast and four deviations of the noise), over
    all pixels within five blurs and 2 px of the mark, but for the parts of the contour whose rulers do not agree. At
    SNR 6 to 200 and blurs of 0.5 px to a third of the radius the centre's standard deviation is 1.0 to 1.25 times the
    Cramer-Rao bound of a disc on a known background, the radius is right to 0.01 px. A blur over a third of the radius
    hides how large the mark is.

    A blurred edge of radius R is seen at sqrt(R^2 - v) to second order, v the variance of the blur and of the averaged
    lines: the mean of sqrt(R^2 - u^2) over u across the ruler. The fit corrects the radius for that, with the mean blur
    of the mark's own edges; the match has a blurred disc's own profile, to first order in blur over radius.
    """

    Result: ClassVar[type[Any]] = Blobs

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
    agreement: float = 0.5
    saturation: float | None = None
    noise: float = 1.0
    count: int | None = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, allowed in (("shape", SHAPES), ("polarity", CONTRASTS)):
            if getattr(self, name) not in allowed:
                raise ValueError(f"FindBlobs.{name} is {getattr(self, name)!r}, expected one of {', '.join(allowed)}")
        for name, low, high in (("ratio", 0.0, 1.0), ("agreement", 0.0, 1.0), ("search_px", 0.0, 200.0)):
            if not low < finite(getattr(self, name), f"FindBlobs.{name}") < high:
                raise ValueError(f"FindBlobs.{name} is {getattr(self, name)}, expected a number in ({low:g}, {high:g})")
        multiple = 8 if self.shape == "ring" else 4
        for name, least, most, of in (("spokes", 8, MOST_SPOKES, multiple), ("passes", 1, 10, 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"FindBlobs.{name} must be a whole number, got {value!r}")
            if not least <= value <= most or value % of:
                raise ValueError(f"FindBlobs.{name} is {value}, expected {least} to {most}, a multiple of {of}")
        self._ruler()

    def _ruler(self) -> RulerEdges:
        """Return what finds the edges; it checks the other parameters."""
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
        """Run once, as every `Operation`; with ``count=None`` for as many marks as there are places."""
        if self.count is None and len(inputs) == 2 and getattr(inputs[1], "ndim", 0) == 2:
            return replace(self, count=len(inputs[1]))(*inputs, device=device, out=out)
        return super().__call__(*inputs, device=device, out=out)

    @property
    def _round(self) -> bool:
        return self.shape in ("circle", "ring")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if self.count is None:
            raise ValueError("FindBlobs.count is None; to bind it say how many marks there will be")
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
        least = max(math.ceil(self.agreement * self.spokes), freedoms + 1)
        return build.launch(
            "blob/blob.cl",
            "find_blobs",
            work=work,
            more_inputs=[((self.count, freedoms), build.real)],
            outputs=build.outputs(shapes | ({"angle": None} if self._round else {}), inliers=np.int32),
            defines={**edges.defines, **self._defines(freedoms)},
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
            passes_once=work.vectors and self.count <= _ALONE,
        )

    def _table(self, edges: Launch) -> npt.NDArray[Any]:
        """Return the table of ``ruler.h`` with the smoothing's variance as the peak of an edge has it.

        The filter ends at three deviations: what its own variance lacks by that the peak does not, and the curvature
        correction would take for blur. Made exact for the blur whose best smoothing it is.
        """
        table = np.array(edges.arguments[0])
        taps, blur = table[_TAPS:].astype(np.float64), self.smoothing_px / math.sqrt(5.0)
        k = np.arange(-taps.size, taps.size + 1)
        weights = np.concatenate([-taps[::-1], [0.0], taps])
        peak, beside = (float(np.sum(weights * ndtr((k + at) / blur))) for at in (0.0, 1.0))
        table[_SMOOTHING] = 0.5 / math.log(peak / beside) - blur**2
        return table

    def _defines(self, freedoms: int) -> dict[str, Define]:
        return {
            **loss_defines("tukey", BEND),
            "EFFICIENCY": efficiency("tukey", BEND),
            "FREEDOMS": freedoms,
            "SPOKES": self.spokes,
            "ROOM": round_up(self.spokes, _LANES),
            **({"RATIO": float(self.ratio)} if self.shape in ("ring", "cross") else {}),
            **flags(ROUND=self._round, EITHER=self.polarity == "either", MATCH=self.match),
        }

    def _layout(self) -> npt.NDArray[np.float64]:
        """Return the table of ``blob.cl``: six rows; rulers k and k + spokes / 2 are opposite."""
        half = _half_layout(self.shape, self.ratio, self.spokes // 2)
        base, normal = (np.concatenate([each, -each]) for each in half)
        height = np.abs(np.sum(base * normal, axis=-1))
        rows = np.concatenate([base.T, normal.T, [height, np.ones(self.spokes)]])
        fill = -self.spokes % _LANES
        padded = np.pad(rows, ((0, 0), (0, fill)), mode="edge")
        padded[-1, self.spokes :] = 0.0
        return padded

    def _overlap(self) -> float:
        """Return the size of a mark below which neighbouring rulers see the same noise."""
        # Lines share noise with their neighbours: of the average of so many, 1/variance in pixels.
        lines = self.width**2 / (self.width - 1.0 / 3.0)
        return self.spokes * lines / self._contour()

    def _contour(self) -> float:
        """Return the length of contour that rulers lie on, of a mark of size 1."""
        round_ = {"circle": 2.0 * math.pi, "ring": 2.0 * math.pi * (1.0 + self.ratio)}
        if self.shape in round_:
            return round_[self.shape]
        return 4.0 * (2.0 * _SIDE if self.shape == "square" else self._arm_length())

    def _arm_length(self) -> float:
        return _END * 2.0 * self.ratio + 2.0 * _FLANK * (1.0 - self.ratio)

    def _extent(self) -> float:
        """Return the farthest point of a mark of size 1."""
        return {"square": math.sqrt(2.0), "cross": math.hypot(1.0, self.ratio)}.get(self.shape, 1.0)


# Which part of a straight edge has rulers: corners bend what is near them.
_SIDE, _END, _FLANK = 0.7, 0.5, 0.5


def _spread(count: int) -> npt.NDArray[np.float64]:
    """Return so many places evenly over -1 to 1."""
    return (2.0 * np.arange(count) + 1.0) / count - 1.0


def _half_layout(shape: str, ratio: float, count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return centres and directions of the rulers of half a mark of size 1."""
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
    """Return rulers across the end and the two flanks of the arm along x."""
    flank = max(round(0.375 * count), 0 if count < 3 else 1)
    end = count - 2 * flank
    out = 0.5 * (1.0 + ratio) + 0.5 * (1.0 - ratio) * _FLANK * _spread(flank)
    base = [(1.0, each) for each in ratio * _END * _spread(end)]
    base += [(each, side * ratio) for side in (1.0, -1.0) for each in out]
    normal = [(1.0, 0.0)] * end + [(0.0, 1.0)] * flank + [(0.0, -1.0)] * flank
    return np.array(base), np.array(normal)
