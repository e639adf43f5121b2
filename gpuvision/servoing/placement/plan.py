"""Plan of a placement, made before the head moves: camera pose, features of the artwork, predicted covariance.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.3
   (artwork selection) and 8.2.3 (offline and online software).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.board.view_features import features_in_view, select_features_in_view
from gpuvision.matching.features.exposure import sensor_imaging
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.fiducials import FiducialLimits
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import SAMPLING_SIGMA_PX
from gpuvision.matching.pose.motion import rotation
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.matching.pose.registration import CoarseRegistration, prepare_board_registration
from gpuvision.servoing.frames import compose_poses, invert_pose, move_covariance
from gpuvision.servoing.placement.landing import refused_starts
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.refusal import explain_refusal
from gpuvision.validation import numbers

Float64 = npt.NDArray[np.float64]

# Least height of an edge that counts, as a fraction of the step of copper under the mask (chosen: half of it).
_THRESHOLD = 0.5
# Largest distance of an edge from the coarse pose [px]: the default of `CoarseRegistration`.
_TOLERANCE_PX = 1.0
# Starts at which the features in view must determine the pose, as parts of the landing zone in x, y and theta (chosen):
# its corners, the middles of its sides, and the target.
_VIEWED = np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(-1, 3)
# Error of a predicted motion as a part of the motion (chosen): the plant's gain is calibrated far better.
_MOTION_ERROR = 0.1
_MIN_ROWS = 3  # as many as unknowns of a pose
# Least eigenvalue of the information, scaled to a diagonal of 1, of rows that determine the pose (chosen):
# `SolvePose.max_condition` is far above, rounding far below.
_SINGULAR = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementPlan:
    """Plan of a placement.

    Attributes
    ----------
    target : numpy.ndarray
        (3,): pose of the nozzle on the board at the release, x, y [m], theta [rad].
    camera_pose : numpy.ndarray
        (3,): pose of the camera over the board at the release, as `BoardView.pose`.
    features : FeatureSet
        Rulers and fiducials in view. Their search range is the landing zone, or with ``landing`` the motion between
        two frames.
    landing : CoarseRegistration or None
        Search for the pose of the first frame; None: the features find it.
    threshold, noise : float
        Least height of an edge, and standard deviation of a pixel [grey levels].
    vision : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle by the noise of one frame.
    fixed_pattern : float
        Part of the variance of ``vision`` by the differences between the pixels, 0 to 1: frames of a head at rest have
        this error in common.
    sampling : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle by the bilinear sampling along rulers and by the error
        that fiducials have without noise: common to the frames of a head at rest, different from place to place.
    reported : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle that a measurement reports to the observer, by noise and
        sampling together.
    etch_bias : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle by the etch bias of the board, common to all frames.
    """

    target: Float64
    camera_pose: Float64
    features: FeatureSet
    landing: CoarseRegistration | None
    threshold: float
    noise: float
    vision: Float64
    fixed_pattern: float
    sampling: Float64
    reported: Float64
    etch_bias: Float64

    @property
    def camera_to_board(self) -> Float64:
        """(3, 3) matrix that turns errors x, y, theta of the nozzle in the camera frame into the axes of the board."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(float(self.camera_pose[2]))
        return turn


def plan_placement(
    artwork: Artwork,
    target: npt.ArrayLike,
    machine: Machine,
    *,
    budget: float = 60,
    reflectance: BoardReflectance | None = None,
    device: Device | None = None,
    advises: bool = True,
) -> PlacementPlan:
    """Select the features of the artwork that guide a placement.

    Parameters
    ----------
    artwork : Artwork
        Side of the board in view, read with the clearance of `placement_imaging`.
    target : array_like
        (3,): pose of the part (and of the nozzle) in the frame of the board's files, x, y [m], theta [rad]. On the
        bottom side a positive theta is clockwise as the camera sees it.
    machine : Machine
        Machine over this side: `Machine.for_side`.
    budget : float
        Number of rulers, default 60; fiducials in view are used in addition.
    reflectance : BoardReflectance, optional
        Reflectances of the board, for contrast and thresholds. Default: `BoardReflectance`.
    device : Device, optional
        Where to check the coarse registration, if one is needed; None: `Device.best`.
    advises : bool
        Search for the nearest targets and the window that work, for the message of a refusal. Default True. The search
        can take seconds.

    Returns
    -------
    PlacementPlan

    Raises
    ------
    ValueError
        The machine is over the other side, the camera sees too few edges at the target, or a coarse registration is
        needed and is ambiguous, or the camera sees too few edges from a start in the landing zone. The message names
        the nearest targets and the window that work, where there are any.

    Notes
    -----
    Rulers whose search range is the landing zone need no landing stage. Where they have no room, or give a pose that
    is worse than the tolerance (3 standard deviations of a frame), a coarse registration finds the pose of the first
    frame and rulers with a search range of `tracking_imaging` follow it. The registration is tried on ideal images from
    the target and from four corners of the landing zone, see `refused_starts`: a repeated pattern, such as equal traces
    at a pitch below twice the landing zone, makes it ambiguous. In plans with a coarse registration the camera must see
    enough features from 27 starts in the landing zone, its corners among them: from a corner it does not see those at
    the border of the window. Rulers that cover the landing zone are checked from the target only. If the coarse
    registration is refused they are used where there are enough, even for a pose that is worse than the tolerance.
    """
    if machine.camera.mirrored != (artwork.side == "bottom"):
        raise ValueError(f"the artwork shows the {artwork.side} side; use machine.for_side({artwork.side!r})")
    place = np.array(numbers(target, (3,), "target"))
    calibrated = machine.pipette_in_camera.pose
    camera_pose = compose_poses(place, invert_pose(calibrated))
    sensor, board = machine.camera.sensor, reflectance or BoardReflectance()
    white = machine.camera.white_electrons
    step = abs(board.copper_masked - board.laminate_masked) * white * sensor.gain
    guidance = _Guidance(
        artwork=artwork, machine=machine, reflectance=board, budget=budget, threshold=_THRESHOLD * step, device=device
    )
    try:
        features, landing = guidance.at(camera_pose)
    except ValueError as error:
        if not advises:
            raise
        raise ValueError(explain_refusal(str(error), artwork, place, camera_pose, machine, guidance)) from error
    noise, etch_bias = _split_covariance(features)
    sampling, reported = _sampling_and_reported(features)
    bright = max(board.copper_masked, board.laminate_masked) * white
    total, temporal = (float(sensor.noise(bright, machine.camera.exposure, spatial=each)) for each in (True, False))
    return PlacementPlan(
        target=place,
        camera_pose=camera_pose,
        features=features,
        landing=landing,
        threshold=_THRESHOLD * step,
        noise=total * sensor.gain,
        vision=move_covariance(noise, camera_pose, calibrated),
        fixed_pattern=1.0 - (temporal / total) ** 2,
        sampling=move_covariance(sampling, camera_pose, calibrated),
        reported=move_covariance(reported, camera_pose, calibrated),
        etch_bias=move_covariance(etch_bias, camera_pose, calibrated),
    )


def placement_imaging(machine: Machine, reflectance: BoardReflectance | None = None) -> Imaging:
    """Return image quality and search range of a machine: the landing zone is the search range."""
    camera, tolerance = machine.camera, machine.tolerance
    return sensor_imaging(
        camera.sensor,
        pixel=camera.pixel,
        white_electrons=camera.white_electrons,
        exposure=camera.exposure,
        reflectance=reflectance,
        blur_px=camera.edge_blur_px,
        shift=tolerance.landing_zone,
        angle=tolerance.landing_angle,
    )


def tracking_imaging(machine: Machine, reflectance: BoardReflectance | None = None) -> Imaging:
    """Return image quality and search range of the frames after the landing.

    The rulers of a frame are placed at the predicted pose. The head moves by the gain times the error at most between
    two frames; the largest error is the landing zone, seen at the camera. An observer that predicts the motion of the
    axes leaves a tenth of it, the observer "latest" the whole motion. The tolerance of the coarse registration is
    added.
    """
    wide, tolerance = placement_imaging(machine, reflectance), machine.tolerance
    part = machine.loop_gain * (_MOTION_ERROR if _predicts_motion(machine) else 1.0)
    shift = part * landing_range(machine) + _TOLERANCE_PX * machine.camera.pixel
    angle = part * tolerance.landing_angle + _TOLERANCE_PX / (min(machine.camera.window) / 2.0)
    return replace(wide, shift=min(shift, wide.shift), angle=min(angle, wide.angle))


def _predicts_motion(machine: Machine) -> bool:
    """Return whether the observer predicts the motion of the axes: delay and lag, but no friction and no resonance."""
    is_modelled = all(axis.is_linear and not axis.resonance and not axis.viscous for axis in machine.axes)
    return machine.control.observer != "latest" and is_modelled


def landing_range(machine: Machine) -> float:
    """Return the largest offset of the camera along x and along y [m] with the nozzle in the landing zone."""
    away = float(np.hypot(*machine.pipette_in_camera.pose[:2]))
    return machine.tolerance.landing_zone + machine.tolerance.landing_angle * away


@dataclass(frozen=True, kw_only=True)
class _Guidance:
    """Selection of the features and of the landing that guide a placement on a board."""

    artwork: Artwork
    machine: Machine
    reflectance: BoardReflectance
    budget: float
    threshold: float
    device: Device | None

    def at(self, camera_pose: Float64) -> tuple[FeatureSet, CoarseRegistration | None]:
        """Return the features at a pose (3,) of the camera at the release, and the search for the first pose."""
        view, machine = self.machine.camera.view(camera_pose), self.machine
        try:
            wide = self._select(view, placement_imaging(machine, self.reflectance))
            self._check_views([camera_pose], wide)  # the rulers of the first frame are placed at the target
        except ValueError:
            wide = None
        if wide is not None and _is_precise(wide, camera_pose, machine):
            return wide, None
        try:
            near = self._near(camera_pose)
            self._check(camera_pose, near[1])
            return near
        except ValueError:
            if wide is None:
                raise
            return wide, None

    def _near(self, camera_pose: Float64) -> tuple[FeatureSet, CoarseRegistration]:
        """Return features that follow the head from frame to frame, and the search for the first pose."""
        machine = self.machine
        view = machine.camera.view(camera_pose)
        features = self._select(view, tracking_imaging(machine, self.reflectance))
        self._check_views(self._starts(camera_pose), features)
        landing = prepare_board_registration(
            self.artwork,
            view.matrix,
            view.shape,
            shift=landing_range(machine),
            angle=machine.tolerance.landing_angle,
            blur_px=machine.camera.edge_blur_px,
            threshold=self.threshold,
            tolerance_px=_TOLERANCE_PX,
        )
        if len(landing.rulers.point) < landing.limits.min_rulers:
            raise ValueError(f"{len(landing.rulers.point)} places on edges have room for the coarse registration")
        return features, landing

    def _starts(self, camera_pose: Float64) -> Float64:
        """Return poses (n, 3) of the camera at starts in the landing zone."""
        calibrated, tolerance = self.machine.pipette_in_camera.pose, self.machine.tolerance
        zone = np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
        nozzle = compose_poses(camera_pose, calibrated) + zone * _VIEWED
        return compose_poses(nozzle, invert_pose(calibrated))

    def _check_views(self, poses: Iterable[Float64], features: FeatureSet) -> None:
        """Raise a `ValueError` where the features that a camera at some poses (3,) sees do not determine the pose.

        At the border of the landing zone the camera does not see all features of the target. If the pose depends on one
        of the others alone, each frame is refused, and the head never moves.
        """
        seen = [features_in_view(features, self.machine.camera.view(each)) for each in poses]
        blind = sum(_largest_leverage(each) > SolvePose.max_leverage for each in seen)
        if blind:
            raise ValueError(
                f"the features in view of {blind} of {len(seen)} starts in the landing zone do not determine the pose"
            )

    def _check(self, camera_pose: Float64, landing: CoarseRegistration) -> None:
        """Raise a `ValueError` where the registration refuses a start in the landing zone."""
        refused = refused_starts(
            self.artwork, camera_pose, self.machine, landing, reflectance=self.reflectance, device=self.device
        )
        if refused:
            flags = " and ".join(sorted({str(each.name) for each in refused}))
            raise ValueError(
                f"the coarse registration refuses {len(refused)} of 5 starts in the landing zone ({flags}), such as a "
                "pattern that repeats within the search range"
            )

    def works(self, camera_pose: Float64, machine: Machine) -> bool:
        """Return whether features guide a machine at a pose (3,) of its camera, if the registration is not refused."""
        try:
            replace(self, machine=machine)._near(camera_pose)
        except ValueError:
            return False
        return True

    def lands(self, camera_pose: Float64, machine: Machine) -> bool:
        """Return whether the registration takes all starts at a pose (3,) of the camera that `works`."""
        moved = replace(self, machine=machine)
        try:
            moved._check(camera_pose, moved._near(camera_pose)[1])
        except ValueError:
            return False
        return True

    def _select(self, view: BoardView, imaging: Imaging) -> FeatureSet:
        features = select_features_in_view(self.artwork, view, imaging, self.budget, with_hint=False)
        if _largest_leverage(features) > SolvePose.max_leverage:
            raise ValueError("a direction of the pose depends on one edge only, which no other edge checks")
        if features.condition > SolvePose.max_condition:
            raise ValueError(
                "the edges hardly separate a direction of the pose from the etch bias, or from another one"
            )
        return features


def _is_precise(features: FeatureSet, camera_pose: Float64, machine: Machine) -> bool:
    """Return whether three standard deviations of the nozzle by the noise of a frame are within the tolerance."""
    noise, _ = _split_covariance(features)
    moved = move_covariance(noise, camera_pose, machine.pipette_in_camera.pose)
    limit = np.array([machine.tolerance.position] * 2 + [machine.tolerance.angle])
    return bool(np.all(3.0 * np.sqrt(np.diag(moved)) <= limit))


def _split_covariance(features: FeatureSet) -> tuple[Float64, Float64]:
    """Return the covariances (3, 3) of the pose by the noise of the features and by the etch bias.

    The pose and the etch bias e are estimated together, with the prior of e: the error of the estimate is
    ``C R' W noise - C P e`` with the information ``R' W R``, the prior P, and ``C = (R' W R + P)^-1``. The computed
    inverse is not exactly symmetric: ``C P C`` can have negative variances where the etch bias does not move the pose;
    ``C P C'`` has none.
    """
    rows, prior = _weighted_rows(features)
    information = rows.T @ rows
    covariance = np.linalg.inv(information + prior)
    noise, common = (covariance @ each @ covariance.T for each in (information, prior))
    return noise[:3, :3], common[:3, :3]


def _sampling_and_reported(features: FeatureSet) -> tuple[Float64, Float64]:
    """Return the covariance (3, 3) of the pose by the sampling of the features, and the one by sampling and noise.

    `FeatureSet.bind` weights the features by both errors, and reports the second covariance.
    """
    marks, pixel, limits = features.fiducials, features.imaging.pixel, FiducialLimits()
    along = np.full(len(features.sigma), SAMPLING_SIGMA_PX * pixel)
    without_noise = np.where(marks.hole > 0.0, limits.edges_sigma_px, limits.matched_sigma_px) * pixel
    sigma, mark_sigma = np.hypot(features.sigma, along), np.hypot(marks.sigma, without_noise)
    rows, prior = _weighted_rows(replace(features, sigma=sigma, fiducials=marks._replace(sigma=mark_sigma)))
    covariance = np.asarray(np.linalg.inv(rows.T @ rows + prior), np.float64)
    part = np.concatenate([along / sigma, without_noise / mark_sigma, without_noise / mark_sigma])
    moved = (rows * part[:, None]) @ covariance
    return np.asarray(moved.T @ moved, np.float64)[:3, :3], covariance[:3, :3]


def _largest_leverage(features: FeatureSet) -> float:
    """Return the largest leverage of a row, as `BoardPose.leverage`: 1 where an unknown depends on this row alone.

    1, too, where the rows do not determine an unknown.
    """
    rows, prior = _weighted_rows(features)
    scale = np.sqrt(np.sum(rows**2, axis=0) + np.diag(prior))
    if len(rows) < _MIN_ROWS or not np.all(scale > 0.0):  # 0 if all normals are parallel to x or y
        return 1.0
    if not np.linalg.eigvalsh((rows.T @ rows + prior) / np.outer(scale, scale))[0] > _SINGULAR:
        return 1.0
    covariance = np.linalg.inv(rows.T @ rows + prior)
    return float(np.max(np.einsum("ij,jk,ik->i", rows, covariance, rows)))


def _weighted_rows(features: FeatureSet) -> tuple[Float64, Float64]:
    """Return the rows (n, 4) of x, y, theta and the etch bias over their sigmas, and the prior (4, 4)."""
    marks = features.fiducials
    x, y = np.concatenate([features.point, marks.point, marks.point]).T - features.placement[:, None]
    along = np.tile([1.0, 0.0], (len(marks.sigma), 1))
    normal = np.concatenate([features.normal, along, along[:, ::-1]])
    single = np.concatenate([np.where(features.spacing > 0.0, 0.0, 1.0), np.zeros(2 * len(marks.sigma))])
    sigma = np.concatenate([features.sigma, marks.sigma, marks.sigma])
    lever = normal[:, 1] * x - normal[:, 0] * y
    prior = np.zeros((4, 4))
    prior[3, 3] = 1.0 / max(features.imaging.etch_bias_sigma, 1e-9) ** 2
    return np.column_stack([normal, lever, single]) / sigma[:, None], prior
