"""A board's pose from features that were found: edges on rulers, lines, points, all mixed, some of them wrong.

A pose takes a point p of the artwork to where it is seen, q = (I + D) p + t, with I + D a rotation (and a deformation
where one is asked for). A feature is one equation, or two: an edge with the unit normal n through p that is seen to run
through q says n . (T^-1(q) - p) = 0, to first order n . (t + theta J p) = n . (q - p). A point says so for two normals
at right angles. Copper that was etched wider or narrower than drawn, all over the board alike, moves edges along their
normals by one more unknown e: n . (T^-1(q) - p) = g e, g 1 at an edge with its normal out of the copper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Define, Device, Launch, LaunchBuilder, Precision, Variant, capacity, flags, type_defines
from gpuvision.matching.robust import Loss, efficiency, loss_defines, subsets, tuning_constant_of
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, numbers

Freedom = Literal["rigid", "scale", "affine"]
Float64 = npt.NDArray[np.float64]

FREEDOMS = {"rigid": 3, "scale": 4, "affine": 6}
ROW = ("normal_x", "normal_y", "x", "y", "displacement_x", "displacement_y", "sigma")
_LANES, _GROUP = 16, 64
_MOST_ROWS = 1024
_START_STEPS = 3  # of Gauss and Newton, for the pose through a few features


class BoardPose(NamedTuple):
    """Poses, each array of shape (poses..., what is said).

    Attributes
    ----------
    pose
        (..., 3): x, y [m] of the artwork's origin, and theta [rad]; NaN where the status is not OK, and so are the
        others unless they say why.
    deformation
        (..., 3): scales along the artwork's axes less 1, and shear: I + D = R(theta) ((1 + kx, shear), (0, 1 + ky)).
    placement
        (..., 2) where the placement point is seen [m].
    covariance
        (..., f, f) of the placement point's x, y [m], theta [rad], and of the deformation that is free.
    residuals
        (..., rows) along the normal in the artwork's frame [m]; NaN where a row is missing.
    weights
        (..., rows) what the loss makes of each row, 0 to 1; 0 where it is missing.
    scale
        (...,) of the residuals in sigmas, that the loss bends at: as given, or their median's.
    spread
        (...,) standard deviation of the rows that count, in sigmas: about 1 where the sigmas are right.
    condition
        (...,) the worst standard deviation over the best, of shifts and of turns times the features' mean distance
        from their middle; not NaN where it is what the pose is refused for.
    rank
        (...,) int32, how many combinations of the freedoms the features fix.
    inliers
        (...,) int32, how many rows weigh anything.
    status
        uint8 `Status` flags, (...,). NO_DATA: fewer rows than freedoms. AMBIGUOUS: refused, the features leave a
        freedom open (``rank``), too few of them agree (``agreement``), or one has none to check it (``leverage``).
        OUT_OF_RANGE: refused, not ``within`` what was asked for. NOT_FINITE: the pose to start from is not.
    etch
        (...,) how far copper reaches beyond its drawn edge, all over the board [m]; 0 where it is not asked for.
    agreement
        (...,) which share of what the rows together say agrees with the pose, of the combination of freedoms of which
        least does; not NaN where it is what the pose is refused for, and so the next.
    leverage
        (...,) the largest share of its own error that a row which counts pulls the pose along by: 1 where a freedom
        hangs on that row alone; 0 for ``"least_squares"``.
    """

    pose: Any
    deformation: Any
    placement: Any
    covariance: Any
    residuals: Any
    weights: Any
    scale: Any
    spread: Any
    condition: Any
    rank: Any
    inliers: Any
    status: Any
    etch: Any
    agreement: Any
    leverage: Any


def line_rows(normal: Any, point: Any, seen: Any, sigma: Any, grows: Any = None) -> Float64:
    """Return rows for edges: seen to run through a point, of which only the part along the normal was measured.

    Parameters
    ----------
    normal
        (..., 2) unit normals in the artwork.
    point
        (..., 2) points of the edges in the artwork [m].
    seen
        (..., 2) where the edges were seen [m], anywhere along them.
    sigma
        (...,) standard deviations along the normal [m].
    grows
        (...,) by how much of the etching the edge lies further along its normal: 1 out of the copper, 0 where it does
        not matter (the middle of a trace, a drilled hole). None: the rows have no such number.

    Returns
    -------
    numpy.ndarray
        float64 (n, 7), as `SolvePose` takes them, or (n, 8) as it does with ``etch``.
    """
    normal, point, seen = (np.asarray(each, np.float64) for each in (normal, point, seen))
    more = [np.asarray(each, np.float64) for each in ([sigma] if grows is None else [sigma, grows])]
    shape = np.broadcast_shapes(normal.shape, point.shape, seen.shape, *((*each.shape, 2) for each in more))
    parts = [np.broadcast_to(each, shape) for each in (normal, point, seen - point)]
    parts += [np.broadcast_to(each[..., None], (*shape[:-1], 1)) for each in more]
    return np.concatenate(parts, axis=-1).reshape(-1, 6 + len(more))


def point_rows(point: Any, seen: Any, sigma: Any) -> Float64:
    """Return two rows for each point: where it is in the artwork and where it was seen, (..., 2) [m].

    ``sigma`` is the standard deviation of either coordinate, (...,) [m].
    """
    point, seen = np.asarray(point, np.float64)[..., None, :], np.asarray(seen, np.float64)[..., None, :]
    return line_rows(np.eye(2), point, seen, np.asarray(sigma, np.float64)[..., None])


def fitted_line_rows(normal: Any, point: Any, centre: Any, covariance: Any, angle: Any = 0.0) -> Float64:
    """Return two rows for each line that was fitted (`LineFits`): they carry its offset and its angle.

    Offset and angle are uncorrelated at the middle of the points, so that two places either side of it, as far away
    as the offset's sigma over the angle's, have offsets that are uncorrelated too.

    Parameters
    ----------
    normal, point
        (..., 2) of the line in the artwork, and a point of it [m].
    centre, covariance
        (..., 2) and (..., 2, 2), of the fit, in metres where lines are seen.
    angle
        (...,) of the fitted line less that of the artwork's line [rad], small.
    """
    normal, point, centre, covariance = (np.asarray(each, np.float64) for each in (normal, point, centre, covariance))
    along = np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
    variance = covariance[..., 1, 1]
    reach = np.sqrt(variance / covariance[..., 0, 0])
    foot = point + np.sum((centre - point) * along, axis=-1)[..., None] * along
    angle = np.asarray(angle, np.float64)
    rows = []
    for side in (-1.0, 1.0):
        way = (side * reach)[..., None]
        turned = along * np.cos(angle)[..., None] + normal * np.sin(angle)[..., None]
        rows.append(line_rows(normal, foot + way * along, centre + way * turned, np.sqrt(2.0 * variance)))
    return np.stack(rows, axis=1).reshape(-1, len(ROW))


@dataclass(frozen=True, kw_only=True)
class SolvePose(VisionOperation[BoardPose]):
    """Poses from rows: ``op(rows) -> BoardPose``, rows float32 or float64 of (..., rows, 7), with ``etch`` 8.

    A row is a normal, a place in the artwork [m], how far from it the feature was seen [m], and the standard deviation
    along the normal [m] (`line_rows`, `point_rows`, `fitted_line_rows`). A row with a number that is not finite, or a
    sigma that is not positive, is missing. With ``etch`` a row has one more number, how much the etching moves it.

    The solution starts from the pose, through as few rows as make one, that has the least loss over all rows (where the
    scale is None: the least median), and iterates reweighted Gauss-Newton from there.

    Parameters
    ----------
    freedom : {"rigid", "scale", "affine"}
        What may differ: x, y, theta; a scale too; or scales along both axes and a shear.
    loss : {"tukey", "huber", "ransac", "least_squares"}
        As in `FitLines`; ``"least_squares"`` starts from no motion, or ``near``.
    bend
        Where the loss bends, in scales; None: 4.685 for Tukey, 1.345 for Huber (95 % efficiency), 3 for RANSAC.
    scale
        Of the residuals in sigmas; 1 trusts the sigmas, None takes it from the residuals' median.
    smallest_scale
        The scale is not taken to be less.
    etch
        Standard deviation of how far copper was etched beyond or short of its drawn edges, the same all over the board
        [m]: one more unknown, that all edges tell together. None: edges are where they are drawn.
    placement
        Point of the artwork for which the covariance holds [m].
    near
        Whether there is a second input of shape (..., 3): x, y, theta to start from; else there is no motion. Edges
        fix the turn from within some 30 degrees, points from within 90.
    largest_condition
        A pose is refused where a standard deviation is that many times another one (`BoardPose.condition`).
    least_agreement
        A pose is refused where a smaller share of what the rows say agrees, of any combination of freedoms
        (`BoardPose.agreement`): of four rows that fix x, one that agrees with a pose says little, however many fix y.
    largest_leverage
        A pose is refused where a row that counts has a larger leverage: nothing could tell that it is an outlier; or
        half as large a one where a quarter or more disagrees (two outliers may agree by chance). 1 asks for neither.
        Losses other than ``"least_squares"`` only.
    within
        How far the placement point may have moved [m] and the board may have turned [rad]: a pose beyond is refused.
        Where features were only looked for so far, others were taken for them there. None: anywhere.
    trials
        Poses that are tried for the start, a multiple of 16. 64 of three rows miss all good ones among 50 % bad ones
        in 2 of 1e4 boards, 256 in 1e-15; with ``etch`` they have four rows, and 256 miss them in 7 of 1e8.
    steps
        Of the iteration.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16 rows at once, for CPU runtimes), "work_item" (a work-item per pose, for GPUs), or "auto".

    Raises
    ------
    ValueError, TypeError
        A parameter is out of its range.

    Notes
    -----
    Error: displacements are solved for, not positions, about the middle of the rows. Single precision costs a
    millionth of the displacement and 3e-7 of the size in the pose; a placement point outside, as much as it is
    farther away.
    """

    Result: ClassVar[type[Any]] = BoardPose

    freedom: Freedom = "rigid"
    loss: Loss = "tukey"
    bend: float | None = None
    scale: float | None = 1.0
    etch: float | None = None
    smallest_scale: float = 1e-3
    placement: tuple[float, float] = (0.0, 0.0)
    near: bool = False
    largest_condition: float = 300.0
    least_agreement: float = 0.3
    largest_leverage: float = 0.95
    within: tuple[float, float] | None = None
    trials: int = 64
    steps: int = 12
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if self.freedom not in FREEDOMS:
            raise ValueError(f"SolvePose.freedom is {self.freedom!r}, expected one of {', '.join(FREEDOMS)}")
        object.__setattr__(self, "bend", tuning_constant_of(self.loss, self.bend, "SolvePose"))
        object.__setattr__(self, "placement", numbers(self.placement, (2,), "SolvePose.placement"))
        if self.scale is not None and finite(self.scale, "SolvePose.scale") <= 0.0:
            raise ValueError(f"SolvePose.scale is {self.scale}, expected a number > 0, or None")
        if self.etch is not None and finite(self.etch, "SolvePose.etch") <= 0.0:
            raise ValueError(f"SolvePose.etch is {self.etch}, expected metres above 0, or None")
        if self.scale is None and self.loss == "ransac":
            raise ValueError("SolvePose: loss 'ransac' cuts at bend times the scale; give the scale")
        for name in ("smallest_scale", "largest_condition"):
            if finite(getattr(self, name), f"SolvePose.{name}") <= 0.0:
                raise ValueError(f"SolvePose.{name} is {getattr(self, name)}, expected a number > 0")
        if not 0.0 <= finite(self.least_agreement, "SolvePose.least_agreement") <= 1.0:
            raise ValueError(f"SolvePose.least_agreement is {self.least_agreement}, expected a share, 0 to 1")
        if not 0.0 < finite(self.largest_leverage, "SolvePose.largest_leverage") <= 1.0:
            raise ValueError(f"SolvePose.largest_leverage is {self.largest_leverage}, expected a share above 0, to 1")
        if self.within is not None:
            object.__setattr__(self, "within", numbers(self.within, (2,), "SolvePose.within"))
            if min(self.within) < 0.0:
                raise ValueError(f"SolvePose.within is {self.within}, expected metres and radians, not below 0")
        if not isinstance(self.trials, int) or self.trials < 1 or self.trials % _LANES:
            raise ValueError(f"SolvePose.trials is {self.trials!r}, expected a multiple of {_LANES}")
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"SolvePose.steps is {self.steps!r}, expected a whole number > 0")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="rows")
        numbers_of_row = len(ROW) + (self.etch is not None)
        is_valid = len(shape) >= 2 and shape[-1] == numbers_of_row and self.unknowns <= shape[-2] <= _MOST_ROWS
        build.check_shape(is_valid, f"rows (..., {self.unknowns} to {_MOST_ROWS}, {numbers_of_row})")
        batch, count = shape[:-2], shape[-2]
        poses = math.prod(batch)
        work = build.work(poses, each=1, group=_GROUP)
        limits = (self.smallest_scale, *self.limits, *self.placement, self.certainty_of_etch)
        return build.launch(
            "pose/pose.cl",
            "pose_sets",
            work=work,
            more_inputs=[((*batch, 3), dtype)] if self.near else [],
            outputs=build.outputs(self.shapes(batch, (*batch, count)), rank=np.int32, inliers=np.int32),
            defines={**self.defines(count), **type_defines("INPUT", dtype), **flags(WITH_NEAR=self.near)},
            arguments=[
                np.int64(poses),
                np.int32(count),
                self.starts(count, vectors=work.vectors),
                np.int32(self.trials),
                np.int32(self.steps),
                *map(build.real.type, limits),
            ],
            passes_once=work.vectors and poses == 1,
        )

    def shapes(self, batch: tuple[int, ...], rows: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the fields of `BoardPose` for poses `batch` from rows `rows`, in the kernels' order."""
        freedoms = FREEDOMS[self.freedom]
        return {
            "pose": (*batch, 3),
            "deformation": (*batch, 3),
            "placement": (*batch, 2),
            "covariance": (*batch, freedoms, freedoms),
            "residuals": rows,
            "weights": rows,
            **dict.fromkeys(("scale", "spread", "condition", "rank", "inliers", "status"), batch),
            **dict.fromkeys(("etch", "agreement", "leverage"), batch),
        }

    @property
    def unknowns(self) -> int:
        """How many numbers the rows are solved for."""
        return FREEDOMS[self.freedom] + (self.etch is not None)

    @property
    def limits(self) -> tuple[float, ...]:
        """What a pose is refused for, as the kernels have it."""
        checked = self.largest_leverage if self.largest_leverage < 1.0 else math.inf
        return self.largest_condition**-2, self.least_agreement, checked, *(self.within or (math.inf, math.inf))

    @property
    def certainty_of_etch(self) -> float:
        """One over the standard deviation of the etching [1/m], 0 where it is not asked for."""
        return 0.0 if self.etch is None else 1.0 / self.etch

    def defines(self, count: int) -> dict[str, Define]:
        """Return what selects the code of ``pose.h`` for so many rows."""
        assert self.bend is not None
        return {
            **loss_defines(self.loss, self.bend),
            **({} if self.scale is None else {"GIVEN_SCALE": self.scale}),
            "EFFICIENCY": efficiency(self.loss, self.bend),
            "OF_POSE": FREEDOMS[self.freedom],
            "FREEDOMS": self.unknowns,
            "START_STEPS": _START_STEPS,
            "CAPACITY": capacity(count, least=_LANES),
            **flags(ETCHED=self.etch is not None),
        }

    def starts(self, count: int, *, vectors: bool) -> npt.NDArray[np.int32]:
        """Return the rows that the poses to start from go through, in the order of ``pose_start``."""
        chosen = subsets(count, self.unknowns, self.trials)
        lanes = _LANES if vectors else 1
        return np.ascontiguousarray(chosen.reshape(-1, lanes, chosen.shape[1]).swapaxes(1, 2)).ravel()
