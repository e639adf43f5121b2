"""Robust pose of a board from feature rows: edges at rulers, fitted lines and points, some of them wrong.

A pose maps a point p of the artwork to its measured position, q = T(p) = (I + D) p + t. I + D is a rotation, and a
deformation where the transform has one. A feature is one equation or two. An edge with the unit normal n through p
whose measured position is q gives n . (T^-1(q) - p) = 0, to first order n . (t + theta J p) = n . (q - p) with J the
rotation by 90 degrees. A point gives this equation for two normals at right angles. Copper that is etched wider or
narrower than drawn moves all edges along their normals by the etch bias e, one more unknown: n . (T^-1(q) - p) = g e.
The etch factor g is 1 for an edge whose normal points out of the copper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Define,
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
from gpuvision.validation import finite, integer, numbers

Transform = Literal["rigid", "similarity", "affine"]
Float64 = npt.NDArray[np.float64]

TRANSFORM_PARAMETERS = {"rigid": 3, "similarity": 4, "affine": 6}
ROW = ("normal_x", "normal_y", "x", "y", "displacement_x", "displacement_y", "sigma")
_LANES, _GROUP = 16, 64  # _GROUP: up to PARTS of common/group.h
_MOST_ROWS = 1024
_MIN_CAPACITY = 128  # of the row arrays on CPUs, so that poses of many sizes share programs; on GPUs it costs memory
_START_STEPS = 3  # Gauss-Newton iterations for the pose through a few features
# Least ratio of eigenvalues of accepted normal equations [epsilons], derived in the notes of `SolvePose`.
_LEAST_EIGENVALUE = 32.0


class BoardPose(NamedTuple):
    """Poses; ``...`` stands for the shape of the batch of poses.

    Attributes
    ----------
    pose : float, (..., 3)
        x, y [m] of the artwork's origin, and theta [rad]. Where the status is neither OK nor NOT_CONVERGED, all fields
        are NaN unless their description says otherwise.
    deformation : float, (..., 3)
        Scales along the artwork's axes less 1, and shear: I + D = R(theta) ((1 + kx, shear), (0, 1 + ky)).
    placement : float, (..., 2)
        Measured position of the placement point [m].
    covariance : float, (..., f, f)
        Covariance of the placement point's x, y [m], of theta [rad], and of the free deformation parameters. Without a
        given ``scale`` it is the covariance for the given sigmas times ``residual_scale`` squared: 0 for exact rows.
        The factor is 1 where ``residual_scale`` is NaN.
    residuals : float, (..., rows)
        Residuals along the normal in the artwork's frame [m]; NaN for missing rows.
    weights : float, (..., rows)
        Weight of each row in the fit, 0 to 1; 0 for missing rows.
    scale : float, (...,)
        Scale of the residuals that the loss uses, in sigmas: the given one, or the one from the median of the
        residuals.
    residual_scale : float, (...,)
        Root of the reduced chi square of the inliers: standard deviation of their residuals in sigmas, about 1 where
        the sigmas are right. NaN with as many inliers as unknowns or fewer.
    condition : float, (...,)
        Largest over smallest standard deviation, of shifts, and of turns times the mean distance of the features from
        their centre. Valid also where it is the reason of a refusal.
    rank : int32, (...,)
        Number of parameter combinations that the features determine.
    inliers : int32, (...,)
        Number of rows with a weight above 0.
    status : uint16, (...,)
        `Status` flags. NO_DATA: fewer rows than unknowns. AMBIGUOUS (refused): the features do not determine all
        unknowns (``rank``; or with their weights, which ended the iteration), too few of them agree on one
        (``inlier_fraction``), or an unknown has no second feature that checks it (``leverage``). OUT_OF_RANGE
        (refused): the pose lies outside ``search_range``. NOT_FINITE: the initial pose is not finite. NOT_CONVERGED
        (with a pose): ``max_iterations`` ended the fit at a pose from which the next step to the solution exceeds a
        tenth of its standard deviations, and the rounding.
    etch_bias : float, (...,)
        Distance from the drawn edges to the copper's edges [m], one value for the board; 0 without ``etch_bias_sigma``.
    inlier_fraction : float, (...,)
        Share of the information of all rows that agrees with the pose, for the parameter combination with the least
        share, 0 to 1. Also valid where it is the reason of a refusal, like ``leverage``.
    leverage : float, (...,)
        Largest leverage of an inlier: the shift of the pose by the error of a row, relative to this error. 1 where an
        unknown depends on this row alone; 0 for ``"least_squares"``.
    """

    pose: FloatArray
    deformation: FloatArray
    placement: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    weights: FloatArray
    scale: FloatArray
    residual_scale: FloatArray
    condition: FloatArray
    rank: IntArray
    inliers: IntArray
    status: FitStatusArray
    etch_bias: FloatArray
    inlier_fraction: FloatArray
    leverage: FloatArray


def line_rows(normal: Any, point: Any, seen: Any, sigma: Any, etch_factor: Any = None) -> Float64:
    """Make feature rows of edges, of which only the position along the normal is measured.

    Parameters
    ----------
    normal : array_like, (..., 2)
        Unit normals in the artwork.
    point : array_like, (..., 2)
        Points on the edges in the artwork [m].
    seen : array_like, (..., 2)
        Measured points [m], anywhere along the edges.
    sigma : array_like, (...,)
        Standard deviations along the normal [m].
    etch_factor : array_like, (...,), optional
        Shift of the edge along its normal per etch bias: 1 for an edge whose normal points out of the copper, 0 where
        the etch bias has no effect (middle of a trace, drilled hole). None: the rows have no such column.

    Returns
    -------
    numpy.ndarray
        float64 (n, 7), as `SolvePose` takes them, or (n, 8) for a `SolvePose` with ``etch_bias_sigma``.
    """
    normal, point, seen = (np.asarray(each, np.float64) for each in (normal, point, seen))
    more = [np.asarray(each, np.float64) for each in ([sigma] if etch_factor is None else [sigma, etch_factor])]
    shape = np.broadcast_shapes(normal.shape, point.shape, seen.shape, *((*each.shape, 2) for each in more))
    parts = [np.broadcast_to(each, shape) for each in (normal, point, seen - point)]
    parts += [np.broadcast_to(each[..., None], (*shape[:-1], 1)) for each in more]
    return np.concatenate(parts, axis=-1).reshape(-1, 6 + len(more))


def point_rows(point: Any, seen: Any, sigma: Any) -> Float64:
    """Make two feature rows for each point.

    Parameters
    ----------
    point, seen : array_like, (..., 2)
        Position in the artwork, and measured position [m].
    sigma : array_like, (...,)
        Standard deviation of each coordinate [m].

    Returns
    -------
    numpy.ndarray
        float64 (2 n, 7).
    """
    point, seen = np.asarray(point, np.float64)[..., None, :], np.asarray(seen, np.float64)[..., None, :]
    return line_rows(np.eye(2), point, seen, np.asarray(sigma, np.float64)[..., None])


def fitted_line_rows(normal: Any, point: Any, centre: Any, covariance: Any, angle: Any = 0.0) -> Float64:
    """Make two feature rows for each fitted line (`LineFits`): they carry its offset and its angle.

    Offset and angle are uncorrelated at the centre of the fitted points. The offsets at two places on either side of
    it, at the distance sigma(offset) / sigma(angle), are therefore also uncorrelated; these offsets are the rows.

    Parameters
    ----------
    normal, point : array_like, (..., 2)
        Unit normal of the line in the artwork, and a point on it [m].
    centre, covariance : array_like, (..., 2) and (..., 2, 2)
        Results of the fit, in metres in the frame of the measurement.
    angle : array_like, (...,)
        Angle of the fitted line minus angle of the artwork's line [rad], small. Default 0.0.

    Returns
    -------
    numpy.ndarray
        float64 (2 n, 7).
    """
    normal, point, centre, covariance = (np.asarray(each, np.float64) for each in (normal, point, centre, covariance))
    along = np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
    variance = covariance[..., 1, 1]
    reach = np.sqrt(variance / covariance[..., 0, 0])
    foot = point + np.sum((centre - point) * along, axis=-1)[..., None] * along
    angle = np.asarray(angle, np.float64)
    rows = []
    for side in (-1.0, 1.0):
        offset = (side * reach)[..., None]
        turned = along * np.cos(angle)[..., None] + normal * np.sin(angle)[..., None]
        rows.append(line_rows(normal, foot + offset * along, centre + offset * turned, np.sqrt(2.0 * variance)))
    return np.stack(rows, axis=1).reshape(-1, len(ROW))


@dataclass(frozen=True, kw_only=True)
class SolvePose(VisionOperation[BoardPose]):
    """Robust least-squares pose from feature rows: ``op(rows) -> BoardPose``.

    Rows are float32 or float64 of shape (..., rows, 7), or (..., rows, 8) with ``etch_bias_sigma``. The columns are:
    unit normal (2), place in the artwork (2) [m], displacement from there to the measured position (2) [m], standard
    deviation along the normal [m], and, with ``etch_bias_sigma``, the etch factor. `line_rows`, `point_rows` and
    `fitted_line_rows` make them. A row with a non-finite number, or with a sigma that is not positive, counts as
    missing.

    The start is the pose through a minimal subset of the rows that has the least loss over all rows (the least median
    of the residuals where ``scale`` is None). Iteratively reweighted Gauss-Newton refines it.

    Parameters
    ----------
    transform : {"rigid", "similarity", "affine"}
        Unknowns: x, y, theta; one scale in addition; or scales along both axes and a shear in addition.
    loss : {"tukey", "huber", "ransac", "least_squares"}
        As in `FitLines`. ``"least_squares"`` starts from the initial pose.
    tuning_constant : float, optional
        Residual at which the loss stops being quadratic, in units of the scale, above 0. None: 4.685 for Tukey and
        1.345 for Huber (95 % efficiency), 3 for RANSAC.
    scale : float, optional
        Scale of the residuals in sigmas, above 0, default 1: trust the sigmas. None: from the median of the residuals.
    etch_bias_sigma : float, optional
        Standard deviation of the etch bias [m], above 0: the etch bias becomes one more unknown of the whole board.
        None: edges are where they are drawn.
    min_scale : float
        Lower limit of the scale, above 0, default 1e-3.
    placement : (float, float)
        Point of the artwork [m] to which the covariance refers. Default ``(0.0, 0.0)``.
    with_initial_pose : bool
        Whether there is a second input of shape (..., 3) with the initial pose x, y [m], theta [rad]. Otherwise the
        initial pose is no motion. Edges determine the turn from initial errors up to about 30 degrees, points up to 90
        degrees. Default False.
    max_condition : float
        Largest accepted `BoardPose.condition`, above 0, default 300. Range: up to 512 in single and 1.18e7 in double
        precision; a call with a larger limit raises an error.
    min_inlier_fraction : float
        Least accepted `BoardPose.inlier_fraction`, 0 to 1, default 0.3. It is checked for each parameter combination:
        where four rows determine x and only one of them agrees with the pose, x is doubtful, however many rows
        determine y.
    max_leverage : float
        Largest accepted `BoardPose.leverage`, above 0 to 1, default 0.95: beyond it no other row can tell that the row
        is an outlier. Where a quarter of the rows or more are outliers, half this value is the limit, since two
        outliers may agree by chance. 1 turns both checks off. Losses other than ``"least_squares"`` only.
    search_range : (float, float), optional
        Largest accepted shift of the placement point [m] and turn [rad]: where features were searched within this range
        only, a pose beyond it follows from wrong features. None: no limit.
    max_trials : int
        Number of start candidates, a multiple of 16, default 64. With 50 % outliers, 64 candidates of three rows all
        contain an outlier on 2 of 1e4 boards, 256 on 1e-15; with ``etch_bias_sigma`` a candidate has four rows, and 256
        all contain an outlier on 7 of 1e8 boards.
    max_iterations : int
        Number of Gauss-Newton iterations, 1 or more, default 12. A pose that has not converged after them has the flag
        NOT_CONVERGED.
    precision : {None, "single", "double"}
        Precision of the arithmetic and of the results; None follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 16 rows at once (CPU runtimes), "work_item" one pose per work-group (GPUs).

    Raises
    ------
    ValueError, TypeError
        A parameter is out of its range or of a wrong type.

    Notes
    -----
    Error: the unknowns are displacements relative to the centre of the rows, not positions. Single precision costs a
    millionth of the displacement, and in the pose 3e-7 of the extent of the rows; at a placement point outside the rows
    the error grows with its distance.
    Both grow with the condition c. The normal equations square it: their least eigenvalue is 1 / c^2 of the largest
    one, and the rounding of their sums changes it by 8 epsilon or less (assumed: a directed search with 1024 rows found
    7.6 at most). While c^2 < 1 / (32 epsilon), a step leaves at most a quarter of the distance to the solution,
    and the factorisation, which takes a pivot below 8 epsilon of its diagonal for 0, succeeds. This is the upper limit
    of ``max_condition``; beyond it, poses may be wrong without a flag.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 8.6.1
       and 8.6.2.
    .. [2] P. J. Huber, *Robust Statistics*, Wiley 1981.
    """

    Result: ClassVar[type[Any]] = BoardPose

    transform: Transform = "rigid"
    loss: Loss = "tukey"
    tuning_constant: float | None = None
    scale: float | None = 1.0
    etch_bias_sigma: float | None = None
    min_scale: float = 1e-3
    placement: tuple[float, float] = (0.0, 0.0)
    with_initial_pose: bool = False
    max_condition: float = 300.0
    min_inlier_fraction: float = 0.3
    max_leverage: float = 0.95
    search_range: tuple[float, float] | None = None
    max_trials: int = 64
    max_iterations: int = 12
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if self.transform not in TRANSFORM_PARAMETERS:
            raise ValueError(
                f"SolvePose.transform is {self.transform!r}, expected one of {', '.join(TRANSFORM_PARAMETERS)}"
            )
        object.__setattr__(
            self, "tuning_constant", resolve_tuning_constant(self.loss, self.tuning_constant, "SolvePose")
        )
        object.__setattr__(self, "placement", numbers(self.placement, (2,), "SolvePose.placement"))
        if self.scale is not None and finite(self.scale, "SolvePose.scale") <= 0.0:
            raise ValueError(f"SolvePose.scale is {self.scale}, expected a number > 0, or None")
        if self.etch_bias_sigma is not None and finite(self.etch_bias_sigma, "SolvePose.etch_bias_sigma") <= 0.0:
            raise ValueError(f"SolvePose.etch_bias_sigma is {self.etch_bias_sigma}, expected metres above 0, or None")
        if self.scale is None and self.loss == "ransac":
            raise ValueError("SolvePose: loss 'ransac' cuts at bend times the scale; give the scale")
        for name in ("min_scale", "max_condition"):
            if finite(getattr(self, name), f"SolvePose.{name}") <= 0.0:
                raise ValueError(f"SolvePose.{name} is {getattr(self, name)}, expected a number > 0")
        if not 0.0 <= finite(self.min_inlier_fraction, "SolvePose.min_inlier_fraction") <= 1.0:
            raise ValueError(f"SolvePose.min_inlier_fraction is {self.min_inlier_fraction}, expected a share, 0 to 1")
        if not 0.0 < finite(self.max_leverage, "SolvePose.max_leverage") <= 1.0:
            raise ValueError(f"SolvePose.max_leverage is {self.max_leverage}, expected a share above 0, to 1")
        if self.search_range is not None:
            object.__setattr__(self, "search_range", numbers(self.search_range, (2,), "SolvePose.search_range"))
            if min(self.search_range) < 0.0:
                raise ValueError(
                    f"SolvePose.search_range is {self.search_range}, expected metres and radians, not below 0"
                )
        if integer(self.max_trials, "SolvePose.max_trials", minimum=1) % _LANES:
            raise ValueError(f"SolvePose.max_trials is {self.max_trials!r}, expected a multiple of {_LANES}")
        integer(self.max_iterations, "SolvePose.max_iterations", minimum=1)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="rows")
        numbers_of_row = len(ROW) + (self.etch_bias_sigma is not None)
        is_valid = len(shape) >= 2 and shape[-1] == numbers_of_row and self.unknowns <= shape[-2] <= _MOST_ROWS
        build.check_shape(is_valid, f"rows (..., {self.unknowns} to {_MOST_ROWS}, {numbers_of_row})")
        batch, count = shape[:-2], shape[-2]
        poses = math.prod(batch)
        work = build.work(poses, each=1, group=_GROUP, grouping="per_element")
        limits = (self.min_scale, *self.limits(build.real), *self.placement, self.etch_bias_certainty)
        return build.launch(
            "pose/pose.cl",
            "pose_sets",
            work=work,
            problem_per_group=True,
            more_inputs=[((*batch, 3), dtype)] if self.with_initial_pose else [],
            outputs=build.outputs(
                self.shapes(batch, (*batch, count)), rank=np.int32, inliers=np.int32, status=np.uint16
            ),
            defines={
                **self.defines(count, vectors=work.vectors),
                **type_defines("INPUT", dtype),
                **flags(WITH_INITIAL_POSE=self.with_initial_pose),
            },
            arguments=[
                np.int64(poses),
                np.int32(count),
                self.starts(count, vectors=work.vectors),
                np.int32(self.max_trials),
                np.int32(self.max_iterations),
                *map(build.real.type, limits),
            ],
            passes_once=work.vectors and poses == 1,
        )

    def shapes(self, batch: tuple[int, ...], rows: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the fields of `BoardPose` for poses `batch` from rows `rows`, in the kernels' order."""
        freedoms = TRANSFORM_PARAMETERS[self.transform]
        return {
            "pose": (*batch, 3),
            "deformation": (*batch, 3),
            "placement": (*batch, 2),
            "covariance": (*batch, freedoms, freedoms),
            "residuals": rows,
            "weights": rows,
            **dict.fromkeys(("scale", "residual_scale", "condition", "rank", "inliers", "status"), batch),
            **dict.fromkeys(("etch_bias", "inlier_fraction", "leverage"), batch),
        }

    @property
    def unknowns(self) -> int:
        """Number of unknowns: parameters of the transform, and the etch bias where it is solved for."""
        return TRANSFORM_PARAMETERS[self.transform] + (self.etch_bias_sigma is not None)

    def limits(self, real: np.dtype[Any]) -> tuple[float, ...]:
        """Return the limits beyond which a pose is refused, in the order of the kernel arguments.

        Raises
        ------
        ValueError
            Numbers of this type do not resolve `max_condition`.
        """
        largest = (_LEAST_EIGENVALUE * float(np.finfo(real).eps)) ** -0.5
        if self.max_condition > largest:
            raise ValueError(
                f"SolvePose.max_condition is {self.max_condition:g}, expected up to {largest:g} in {real.name}"
            )
        checked = self.max_leverage if self.max_leverage < 1.0 else math.inf
        return self.max_condition**-2, self.min_inlier_fraction, checked, *(self.search_range or (math.inf, math.inf))

    @property
    def etch_bias_certainty(self) -> float:
        """One over the standard deviation of the etch bias [1/m]; 0 where it is not solved for."""
        return 0.0 if self.etch_bias_sigma is None else 1.0 / self.etch_bias_sigma

    def defines(self, count: int, *, vectors: bool) -> dict[str, Define]:
        """Return the build options of ``pose.h`` for a number of rows and a kernel variant."""
        assert self.tuning_constant is not None
        return {
            **loss_defines(self.loss, self.tuning_constant),
            **({} if self.scale is None else {"GIVEN_SCALE": self.scale}),
            "EFFICIENCY": efficiency(self.loss, self.tuning_constant),
            "POSE_PARAMETERS": TRANSFORM_PARAMETERS[self.transform],
            "FREEDOMS": self.unknowns,
            "START_STEPS": _START_STEPS,
            "CAPACITY": capacity(count, least=_MIN_CAPACITY if vectors else _LANES),
            **flags(WITH_ETCH_BIAS=self.etch_bias_sigma is not None),
        }

    def starts(self, count: int, *, vectors: bool) -> npt.NDArray[np.int32]:
        """Return the row indices of the start candidates, in the order of ``pose_start``."""
        chosen = sample_subsets(count, self.unknowns, self.max_trials)
        lanes = _LANES if vectors else 1
        return np.ascontiguousarray(chosen.reshape(-1, lanes, chosen.shape[1]).swapaxes(1, 2)).ravel()
