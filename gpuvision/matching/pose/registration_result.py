"""Result of a coarse registration, its thresholds, and the comparison of two candidate poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RegistrationLimits:
    """Thresholds of the decisions of a coarse registration.

    Parameters
    ----------
    min_rulers
        Least number of rulers in the image, and of known edges, to decide on a pose (chosen: four times the three
        unknowns). Default 12.
    significance
        Difference of two counts of rulers that is significant [standard deviations] (3: one error in 700 for normal
        counts). Default 3.0.
    min_ratio
        Ratio of scores, or of the counts of rulers that speak for one pose only, from which on a pose is preferred to
        another one (chosen; tests on boards with repeated patterns confirm it). Default 2.0.
    border_cost
        Cost of an edge beyond the image, relative to the mean cost in the image (measured). With 1, poses that keep
        more edges in the image would win over the right one; below 0.5, poses that keep few edges in the image would
        win. Default 0.7.
    refinements
        Number of measurements of the best pose along short rulers, each placed at the pose of the previous one
        (chosen). Default 3.
    """

    min_rulers: int = 12
    significance: float = 3.0
    min_ratio: float = 2.0
    border_cost: float = 0.7
    refinements: int = 3


class Registration(NamedTuple):
    """Pose with its score; lengths in the unit of the known edges (metres of a board, pixels of an image).

    Attributes
    ----------
    pose : (3,)
        x, y, theta [rad]: a known point p appears at R(theta) (I + D) p + (x, y). Where the pose is refused, NaN like
        ``deformation``, ``placement`` and ``covariance``.
        With a shear, theta is the direction of the known x axis; of a rigid pose it is the angle of the nearest
        rotation, which differs by half the shear.
    deformation : (3,)
        Scales along the known axes less 1, and shear: I + D = ((1 + kx, shear), (0, 1 + ky)); 0 for a rigid transform.
    placement : (2,)
        Measured position of the placement point.
    covariance : (f, f)
        Covariance of the placement point's x, y, of theta, and of the free deformation parameters, from the residuals
        of the edges. It includes errors that neighbouring edges share (jackknife over overlapping blocks of the image)
        and, with a ``misfit``, the change of the pose by the larger transform.
    score : float
        Share of the rulers in the image whose edge lies within the tolerance of the pose, 0 to 1; of the best pose
        where it is refused.
    runner_up : float
        Score of the best other pose; where AMBIGUOUS, of the best pose that the edges do not exclude. 0 without one.
    runner_up_pose : (3,)
        NaN without one.
    rulers : int
        Number of verification rulers in the image.
    status : Status
        OK. With a pose: AMBIGUOUS (among the rulers that agree with one of the two poses only, too few more agree with
        this pose than with the runner-up), NOT_CONVERGED (the last fit of the edges, see `BoardPose`). Refused:
        LOW_SIGNAL (no pose reaches the least score), NO_DATA (too few known edges in the image), AMBIGUOUS with NaN
        (the found edges do not determine all unknowns).
    etch_bias : float
        Displacement of all edges along their normals; 0 where it is not solved for, NaN where the pose is refused.
    misfit : float
        Largest displacement of an edge by the next larger transform ("affine"; for "affine" the polynomial of second
        order), where the edges fit it significantly better; else 0. NaN where the pose is refused.
    """

    pose: Float64
    deformation: Float64
    placement: Float64
    covariance: Float64
    score: float
    runner_up: float
    runner_up_pose: Float64
    rulers: int
    status: Status
    etch_bias: float
    misfit: float


class ScoredMotion(NamedTuple):
    """A motion (2, 3), its etch bias, and (n,) which verification rulers lie in the image and which agree with it."""

    motion: Float64
    etch_bias: float
    inside: npt.NDArray[np.bool_]
    agrees: npt.NDArray[np.bool_]

    @property
    def rulers(self) -> int:
        """Number of verification rulers in the image."""
        return int(np.count_nonzero(self.inside))

    @property
    def score(self) -> float:
        """Share of the rulers in the image that agree with the motion."""
        return float(np.count_nonzero(self.agrees)) / self.rulers

    def is_better_than(self, other: ScoredMotion, limits: RegistrationLimits) -> bool:
        """Return whether the rulers prefer this motion significantly.

        Counted are the rulers in the image for both motions that agree with only one of them. With two valid motions (a
        repeated pattern), about the same number of rulers agrees with each. An edge agrees with a wrong motion by
        chance only: the counts must differ by three standard deviations of their difference, and by a factor of two. A
        factor of two between the scores is also sufficient, for images with few rulers in common.
        """
        if self.score >= limits.min_ratio * other.score:
            return True
        both = self.inside & other.inside
        only_self = np.count_nonzero(both & self.agrees & ~other.agrees)
        its = np.count_nonzero(both & other.agrees & ~self.agrees)
        return bool(
            only_self >= max(limits.min_ratio * its, its + limits.significance * math.sqrt(only_self + its), 1.0)
        )


NOT_FOUND = Registration(
    pose=np.full(3, np.nan),
    deformation=np.full(3, np.nan),
    placement=np.full(2, np.nan),
    covariance=np.full((3, 3), np.nan),
    score=0.0,
    runner_up=0.0,
    runner_up_pose=np.full(3, np.nan),
    rulers=0,
    status=Status.NO_DATA,
    etch_bias=np.nan,
    misfit=np.nan,
)
