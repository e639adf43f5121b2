"""Straight lines through points of which some may be far off: many sets at once, each with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpuvision.host import Device, Launch, LaunchBuilder, Precision, Variant, capacity, flags, type_defines
from gpuvision.matching.robust import Loss, efficiency, loss_defines, subsets, tuning_constant_of
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite

_LANES, _GROUP = 16, 64
_LARGEST_SET = 1024


class LineFits(NamedTuple):
    """Lines, each array of shape (lines..., what is said).

    Attributes
    ----------
    normal
        (..., 2) unit normal (-sin a, cos a) of the direction (cos a, sin a), -pi/2 < a <= pi/2.
    distance
        (...,) n . q of every point q of the line, in the points' unit.
    centre
        (..., 2) weighted middle of the points that count; it lies on the line. Angle and offset are uncorrelated here.
    covariance
        (..., 2, 2) of the angle [rad] and of the offset along the normal at the centre.
    scale
        (...,) standard deviation of a point's distance, of one without outliers; in units of the points' sigma where
        that was given.
    inliers
        (...,) int32, how many points weigh anything.
    weights
        (..., points) what the loss makes of each point, 0 to 1; None unless asked for.
    status
        uint8 `Status` flags, (...,). NO_DATA: fewer than two points. AMBIGUOUS: all points are one, so that there is no
        direction (NaN), or fewer than half of the points lie along the line (with a value).
    """

    normal: Any
    distance: Any
    centre: Any
    covariance: Any
    scale: Any
    inliers: Any
    weights: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class FitLines(VisionOperation[LineFits]):
    """Lines through sets of points: ``op(points) -> LineFits``, points float32 or float64 of (..., points, 2).

    A point with a coordinate that is not finite is missing. With ``weighted`` there is a second input of shape
    (..., points): each point's standard deviation; a point for which it is not positive or not finite is missing.

    The fit starts at the line through two of the points that has the least loss (where the scale is None: the least
    median of distances) and iterates reweighted total least squares from there.

    Parameters
    ----------
    loss : {"tukey", "huber", "ransac", "least_squares"}
        Tukey's gives far points no weight at all, Huber's a little; ``"ransac"`` counts points within ``bend`` scales
        fully and others not, and needs the scale.
    bend
        Where the loss bends, in scales; None: 4.685 for Tukey, 1.345 for Huber (95 % efficiency), 3 for RANSAC.
    scale
        Standard deviation of a good point's distance in the points' unit; with ``weighted`` in sigmas: 1 trusts them.
        None: 1.4826 of the median of the absolute distances, raised by 1 + 5 / (points - 2) for few points;
        then of those within 2.5 of it.
    smallest_scale
        The scale is not taken to be less (in its unit): points that lie on a line exactly leave none.
    trials
        Pairs that are tried for the start; all pairs where there are no more. 64 miss all good pairs among 30 % bad
        points once in 1e19 sets, among 50 % once in 1e8.
    steps
        Of the iteration.
    weighted
        Whether the points' standard deviations are given.
    with_weights
        Whether `LineFits.weights` is asked for.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16 lines at once, for CPU runtimes), "work_item" (a work-item per line, for GPUs), or "auto".

    Raises
    ------
    ValueError, TypeError
        A parameter is out of its range.

    Notes
    -----
    Error: distances are taken from one of the points, so that rounding adds 3e-7 of the points' extent in single
    precision, and half a spacing of their coordinates. The covariance is the asymptotic one (Huber, 1981), from the
    residuals unless ``scale`` is given: with twenty points its standard deviations are right to 15 %, with six or
    fewer they are rough, and with two there is none (NaN).
    """

    Result: ClassVar[type[Any]] = LineFits

    loss: Loss = "tukey"
    bend: float | None = None
    scale: float | None = None
    smallest_scale: float = 0.0
    trials: int = 64
    steps: int = 12
    weighted: bool = False
    with_weights: bool = False
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "bend", tuning_constant_of(self.loss, self.bend, "FitLines"))
        if self.scale is not None and finite(self.scale, "FitLines.scale") <= 0.0:
            raise ValueError(f"FitLines.scale is {self.scale}, expected a number > 0, or None")
        if self.scale is None and self.loss == "ransac":
            raise ValueError("FitLines: loss 'ransac' cuts at bend times the scale; give the scale")
        if finite(self.smallest_scale, "FitLines.smallest_scale") < 0.0:
            raise ValueError(f"FitLines.smallest_scale is {self.smallest_scale}, expected a number >= 0")
        for name in ("trials", "steps"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(f"FitLines.{name} is {getattr(self, name)!r}, expected a whole number > 0")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="points")
        is_valid = len(shape) >= 2 and shape[-1] == 2 and 2 <= shape[-2] <= _LARGEST_SET
        build.check_shape(is_valid, f"points (..., 2 to {_LARGEST_SET}, 2)")
        batch, count = shape[:-2], shape[-2]
        lines, pairs = math.prod(batch), subsets(count, 2, self.trials)
        work = build.work(lines, each=_LANES, group=_GROUP)
        assert self.bend is not None
        shapes = {
            "normal": (*batch, 2),
            "distance": batch,
            "centre": (*batch, 2),
            "covariance": (*batch, 2, 2),
            "scale": batch,
            "inliers": batch,
            "weights": (*batch, count) if self.with_weights else None,
            "status": batch,
        }
        return build.launch(
            "line_fit/line_fit.cl",
            "line_fit_sets",
            work=work,
            more_inputs=[(shape[:-1], dtype)] if self.weighted else [],
            outputs=build.outputs(shapes, inliers=np.int32),
            defines={
                **type_defines("INPUT", dtype),
                **loss_defines(self.loss, self.bend),
                **flags(WITH_SIGMA=self.weighted, WITH_WEIGHTS=self.with_weights),
                **({} if self.scale is None else {"GIVEN_SCALE": self.scale}),
                "EFFICIENCY": efficiency(self.loss, self.bend),
                "CAPACITY": capacity(count, least=8),
            },
            arguments=[
                np.int64(lines),
                np.int32(count),
                pairs.ravel(),
                np.int32(len(pairs)),
                np.int32(self.steps),
                build.real.type(self.smallest_scale),
            ],
            passes_once=work.vectors and lines <= _LANES,
        )
