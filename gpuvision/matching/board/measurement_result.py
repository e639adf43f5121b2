"""Results of the measurement of a board: calipers (rulers), fiducials and the solved pose, and its thresholds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board.fiducial_detection import MIN_WEIGHT, FoundFiducials
from gpuvision.matching.features.ruler import SAMPLING_SIGMA_PX
from gpuvision.status import Status

Copper = Literal["auto", "bright", "dark"]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MeasurementLimits:
    """Thresholds of the measurement of a board.

    Parameters
    ----------
    second_range_px
        Search range of the second pass [px] (chosen: several times the error of a first pass). Default 4.0.
    sampling_sigma_px
        Standard deviation of the error that bilinear sampling adds to an edge [px]; neighbouring rulers share a part of
        it (measured).
    min_share
        Least share of the rulers and fiducials in the image that must agree with the pose, and least inlier fraction of
        the pose (chosen). Default 0.3.
    min_count
        Least number of rulers and fiducials that must agree: as many as unknowns of a rigid pose. Default 3.
    max_residual_px
        Largest accepted standard deviation of the residuals beyond the errors of the features [px]: more is another
        board or a wrong scale (chosen). Default 0.5.
    fiducial_slack_px
        Largest accepted distance of a fiducial beyond its expected search range, besides the etch bias [px] (chosen).
        Default 1.0.
    range_factor, min_angle
        A pose of the first pass is refused beyond this multiple of the expected search range (rulers find no edge
        farther away), with at least this angle [rad] (chosen). Defaults 2.0 and 5e-3.
    scale_significance
        Error of the scale that is significant [standard deviations] (4: one false alarm in 16 000 for normal errors).
        Default 4.0.
    max_board_scale, max_scale_effect
        A pose is refused if the error of the scale is larger than the first number (chosen: laminate shrinks by up to
        0.1 %) and moves the pose by more than the second one [standard deviations] (chosen). Defaults 2e-3 and 3.0.
    """

    second_range_px: float = 4.0
    sampling_sigma_px: float = SAMPLING_SIGMA_PX
    min_share: float = 0.3
    min_count: int = 3
    max_residual_px: float = 0.5
    fiducial_slack_px: float = 1.0
    range_factor: float = 2.0
    min_angle: float = 5e-3
    scale_significance: float = 4.0
    max_board_scale: float = 2e-3
    max_scale_effect: float = 3.0


class RulerMeasurements(NamedTuple):
    """Measurements of calipers (rulers), (n, ...); pixel coordinates refer to the undistorted image.

    Attributes
    ----------
    point, normal : (n, 2)
        On the board, as in `FeatureSet`.
    length_px : (n,)
        Length along the normal [px].
    position_px : (n,)
        Position of the edge from the ruler's centre, along the normal [px]; NaN where no edge was found.
    sigma : (n,)
        Standard deviation of the edge's position on the board [m].
    weight : (n,)
        Weight in the pose, 0 (outlier, or no edge) to 1.
    residual : (n,)
        Residual of the pose along the normal [m].
    status : (n,), uint8
        `Status` flags, as in `gpuvision.matching.features.ruler.Edges`.
    """

    point: Float64
    normal: Float64
    length_px: Float64
    position_px: Float64
    sigma: Float64
    weight: Float64
    residual: Float64
    status: npt.NDArray[np.uint8]

    @property
    def in_image(self) -> npt.NDArray[np.bool_]:
        """(n,) which rulers lie in the image."""
        return np.asarray((self.status & Status.OUT_OF_RANGE) == 0)

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """(n,) which rulers found an edge."""
        return np.isfinite(self.position_px)

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """(n,) which rulers found an edge that agrees with the pose."""
        return self.weight > MIN_WEIGHT


class ScaleError(NamedTuple):
    """Relative error of the given image scale, and its sigma: 0.001 for a board that appears 0.1 % larger."""

    value: float
    sigma: float


class PoseSolution(NamedTuple):
    """Result of one pass: pose, covariance at the placement point, and the reason of a refusal or ``""``.

    ``scale_error`` has NaN where the features do not determine it, and in the first pass.
    """

    pose: Float64
    covariance: Float64
    etch_bias: float
    residual_scale: float
    condition: float
    rulers: RulerMeasurements
    fiducials: FoundFiducials
    reason: str
    scale_error: ScaleError = ScaleError(math.nan, math.nan)
    warnings: tuple[str, ...] = ()


class BoardMeasurement(NamedTuple):
    """Result of two passes, or of a refused first pass: the camera's pose after and before the last pass."""

    view: BoardView
    before: BoardView
    solution: PoseSolution

    @property
    def rulers(self) -> RulerMeasurements:
        """Measurements of the last pass."""
        return self.solution.rulers

    @property
    def agreeing(self) -> int:
        """Number of rulers and fiducials that agree with the pose."""
        return count_true(self.solution.rulers.used, self.solution.fiducials.used)

    @property
    def reason(self) -> str:
        """Why the pose is refused; empty where it is accepted."""
        return self.solution.reason


def refuse_measurement(rulers: RulerMeasurements, fiducials: FoundFiducials, reason: str) -> PoseSolution:
    """Return the measurements without a pose, with the reason of the refusal."""
    unknown = np.full((3, 3), np.nan)
    return PoseSolution(unknown[0], unknown, math.nan, math.nan, math.nan, rulers, fiducials, reason)


def count_true(*masks: npt.NDArray[np.bool_]) -> int:
    """Return the number of true elements of all masks."""
    return int(sum(each.sum() for each in masks))
