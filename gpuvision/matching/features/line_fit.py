"""Robust fit of straight lines to sets of points, many sets in one launch, each with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpuvision.host import (
    Device,
    FitStatusArray,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Precision,
    Variant,
    capacity,
    flags,
    type_defines,
)
from gpuvision.matching.robust import Loss, efficiency, loss_defines, resolve_tuning_constant, sample_subsets
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, integer

_LANES, _GROUP = 16, 64  # _GROUP: up to PARTS of common/group.h
_LARGEST_SET = 1024
_MIN_CAPACITY = 64  # of the point arrays on CPUs, so that sets of many sizes share programs; on GPUs it costs memory


class LineFits(NamedTuple):
    """Fitted lines; ``...`` stands for the shape of the batch of lines.

    Attributes
    ----------
    normal : float, (..., 2)
        Unit normal (-sin a, cos a) of the direction (cos a, sin a), -pi/2 < a <= pi/2.
    distance : float, (...,)
        n . q of every point q on the line, in the unit of the points.
    centre : float, (..., 2)
        Weighted mean of the inliers; it lies on the line. Angle and offset are uncorrelated at this point.
    covariance : float, (..., 2, 2)
        Covariance of the angle [rad] and of the offset along the normal at ``centre``.
    scale : float, (...,)
        Standard deviation of the distance of an inlier; in units of the points' sigma with ``weighted``.
    inliers : int32, (...,)
        Number of points with a weight above 0.
    weights : float, (..., points), optional
        Weight of each point in the fit, 0 to 1. None unless ``with_weights``.
    status : uint16, (...,)
        `Status` flags. NO_DATA: fewer than two points. AMBIGUOUS: all points coincide, so that the direction is
        undefined (results are NaN), or fewer than half of the points are inliers (results are valid numbers).
        NOT_CONVERGED (with results): ``max_iterations`` ended the fit at a line from which the next step to the
        solution exceeds a tenth of its standard deviations, and the rounding of the points.
    """

    normal: FloatArray
    distance: FloatArray
    centre: FloatArray
    covariance: FloatArray
    scale: FloatArray
    inliers: IntArray
    weights: FloatArray | None
    status: FitStatusArray


@dataclass(frozen=True, kw_only=True)
class FitLines(VisionOperation[LineFits]):
    """Robust line fit: ``op(points) -> LineFits``, points float32 or float64 of shape (..., points, 2).

    A point with a non-finite coordinate counts as missing. With ``weighted`` the operation takes a second input of
    shape (..., points), the standard deviation of each point; a point whose sigma is not positive or not finite counts
    as missing.

    The start is the line through two of the points that has the least loss (the least median of distances where
    ``scale`` is None). Iteratively reweighted total least squares refines it.

    Parameters
    ----------
    loss : {"tukey", "huber", "ransac", "least_squares"}
        Tukey's biweight gives outliers weight 0; Huber's loss gives them a small weight; ``"ransac"`` (truncated
        quadratic) gives points within ``tuning_constant`` times the scale weight 1 and all others weight 0, and needs
        ``scale``.
    tuning_constant : float, optional
        Residual at which the loss stops being quadratic, in units of the scale, above 0. None: 4.685 for Tukey and
        1.345 for Huber (95 % efficiency), 3 for RANSAC.
    scale : float, optional
        Standard deviation of an inlier's distance in the unit of the points, above 0; with ``weighted`` in sigmas, so
        that 1 trusts the given sigmas. None: 1.4826 times the median absolute distance, raised by 1 + 5 / (points - 2)
        for small sets, then computed again from the points within 2.5 scales.
    min_scale : float
        Lower limit of the scale, 0 or more, default 0: points that lie on a line exactly have scale 0.
    max_trials : int
        Number of point pairs tried for the start, 1 or more, default 64; all pairs where there are not more. 64 random
        pairs all contain an outlier once in 1e19 sets with 30 % outliers, once in 1e8 sets with 50 % outliers.
    max_iterations : int
        Number of reweighted fits, 1 or more, default 12. A line that has not converged after them has the flag
        NOT_CONVERGED.
    weighted : bool
        Whether the operation takes the standard deviations of the points as a second input. Default False.
    with_weights : bool
        Whether to return `LineFits.weights`. Default False.
    precision : {None, "single", "double"}
        Precision of the arithmetic and of the results; None follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" fits 16 lines at once (CPU runtimes), "work_item" one line per work-group (GPUs).

    Raises
    ------
    ValueError, TypeError
        A parameter is out of its range or of a wrong type.

    Notes
    -----
    Error: distances are computed relative to one of the points, so that rounding adds 3e-7 of the points' extent in
    single precision, and half a unit in the last place of the coordinates. The rounding over sigma changes the weights,
    which moves the centre along the line. The covariance is the asymptotic one of an M-estimator [1]_, computed from
    the residuals unless ``scale`` is given. With twenty points its standard deviations are right to 15 %; with six or
    fewer they are rough; with two points it is NaN.

    References
    ----------
    .. [1] P. J. Huber, *Robust Statistics*, Wiley 1981.
    .. [2] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.6.4.
    """

    Result: ClassVar[type[Any]] = LineFits

    loss: Loss = "tukey"
    tuning_constant: float | None = None
    scale: float | None = None
    min_scale: float = 0.0
    max_trials: int = 64
    max_iterations: int = 12
    weighted: bool = False
    with_weights: bool = False
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "tuning_constant", resolve_tuning_constant(self.loss, self.tuning_constant, "FitLines")
        )
        if self.scale is not None and finite(self.scale, "FitLines.scale") <= 0.0:
            raise ValueError(f"FitLines.scale is {self.scale}, expected a number > 0, or None")
        if self.scale is None and self.loss == "ransac":
            raise ValueError("FitLines: loss 'ransac' cuts at bend times the scale; give the scale")
        if finite(self.min_scale, "FitLines.min_scale") < 0.0:
            raise ValueError(f"FitLines.min_scale is {self.min_scale}, expected a number >= 0")
        for name in ("max_trials", "max_iterations"):
            integer(getattr(self, name), f"FitLines.{name}", minimum=1)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="points")
        is_valid = len(shape) >= 2 and shape[-1] == 2 and 2 <= shape[-2] <= _LARGEST_SET
        build.check_shape(is_valid, f"points (..., 2 to {_LARGEST_SET}, 2)")
        batch, count = shape[:-2], shape[-2]
        lines, pairs = math.prod(batch), sample_subsets(count, 2, self.max_trials)
        work = build.work(lines, each=_LANES, group=_GROUP, grouping="per_element")
        assert self.tuning_constant is not None
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
            problem_per_group=True,
            more_inputs=[(shape[:-1], dtype)] if self.weighted else [],
            outputs=build.outputs(shapes, inliers=np.int32, status=np.uint16),
            defines={
                **type_defines("INPUT", dtype),
                **loss_defines(self.loss, self.tuning_constant),
                **flags(WITH_SIGMA=self.weighted, WITH_WEIGHTS=self.with_weights),
                **({} if self.scale is None else {"GIVEN_SCALE": self.scale}),
                "EFFICIENCY": efficiency(self.loss, self.tuning_constant),
                "CAPACITY": capacity(count, least=_MIN_CAPACITY if work.vectors else 8),
            },
            arguments=[
                np.int64(lines),
                np.int32(count),
                pairs.ravel(),
                np.int32(len(pairs)),
                np.int32(self.max_iterations),
                build.real.type(self.min_scale),
            ],
            passes_once=work.vectors and lines <= _LANES,
        )
