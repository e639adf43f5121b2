"""Plan of a placement, made before the head moves: camera pose, features of the artwork, predicted covariance.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.3
   (artwork selection) and 8.2.3 (offline and online software).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.board.view_features import select_features_in_view
from gpuvision.matching.features.exposure import sensor_imaging
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.imaging import Imaging
from gpuvision.servoing.frames import compose_poses, invert_pose, move_covariance
from gpuvision.servoing.placement.machine import Machine
from gpuvision.validation import numbers

Float64 = npt.NDArray[np.float64]

# Least height of an edge that counts, as a fraction of the step of copper under the mask (chosen: half of it).
_THRESHOLD = 0.5


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
        Rulers and fiducials in view.
    threshold, noise : float
        Least height of an edge, and standard deviation of a pixel [grey levels].
    vision : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle by the noise of one frame.
    fixed_pattern : float
        Part of the variance of ``vision`` by the differences between the pixels, 0 to 1: frames of a head at rest have
        this error in common.
    etch_bias : numpy.ndarray
        (3, 3): predicted covariance of the pose of the nozzle by the etch bias of the board, common to all frames.
    """

    target: Float64
    camera_pose: Float64
    features: FeatureSet
    threshold: float
    noise: float
    vision: Float64
    fixed_pattern: float
    etch_bias: Float64


def plan_placement(
    artwork: Artwork,
    target: npt.ArrayLike,
    machine: Machine,
    *,
    budget: float = 60,
    reflectance: BoardReflectance | None = None,
) -> PlacementPlan:
    """Select the features of the artwork that guide a placement.

    Parameters
    ----------
    artwork : Artwork
        Top side of the board, read with the clearance of `placement_imaging`.
    target : array_like
        (3,): pose of the part (and of the nozzle) on the board, x, y [m], theta [rad].
    machine : Machine
        Machine.
    budget : float
        Number of rulers, default 60; fiducials in view are used in addition.
    reflectance : BoardReflectance, optional
        Reflectances of the board, for contrast and thresholds. Default: `BoardReflectance`.

    Returns
    -------
    PlacementPlan

    Raises
    ------
    ValueError
        The side is the bottom, or the camera sees too few edges at the target.
    """
    if artwork.side != "top":
        raise ValueError("the artwork is that of the bottom side; the camera frame is defined for the top side")
    place = np.array(numbers(target, (3,), "target"))
    calibrated = machine.pipette_in_camera.pose
    camera_pose = compose_poses(place, invert_pose(calibrated))
    view = BoardView(scale=machine.camera.pixel, shape=machine.camera.window, pose=tuple(camera_pose.tolist()))
    features = select_features_in_view(artwork, view, placement_imaging(machine, reflectance), budget)
    noise, etch_bias = _split_covariance(features)
    sensor, board = machine.camera.sensor, reflectance or BoardReflectance()
    white = machine.camera.white_electrons
    step = abs(board.copper_masked - board.laminate_masked) * white * sensor.gain
    bright = max(board.copper_masked, board.laminate_masked) * white
    total, temporal = (float(sensor.noise(bright, machine.camera.exposure, spatial=each)) for each in (True, False))
    return PlacementPlan(
        target=place,
        camera_pose=camera_pose,
        features=features,
        threshold=_THRESHOLD * step,
        noise=total * sensor.gain,
        vision=move_covariance(noise, camera_pose, calibrated),
        fixed_pattern=1.0 - (temporal / total) ** 2,
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


def _split_covariance(features: FeatureSet) -> tuple[Float64, Float64]:
    """Return the covariances (3, 3) of the pose by the noise of the features and by the etch bias.

    The pose and the etch bias e are estimated together, with the prior of e: the error of the estimate is
    ``C R' W noise - C P e`` with the information ``R' W R``, the prior P, and ``C = (R' W R + P)^-1``.
    """
    marks = features.fiducials
    x, y = np.concatenate([features.point, marks.point, marks.point]).T - features.placement[:, None]
    along = np.tile([1.0, 0.0], (len(marks.sigma), 1))
    normal = np.concatenate([features.normal, along, along[:, ::-1]])
    single = np.concatenate([np.where(features.spacing > 0.0, 0.0, 1.0), np.zeros(2 * len(marks.sigma))])
    sigma = np.concatenate([features.sigma, marks.sigma, marks.sigma])
    lever = normal[:, 1] * x - normal[:, 0] * y
    rows = np.column_stack([normal, lever, single]) / sigma[:, None]
    information, prior = rows.T @ rows, np.zeros((4, 4))
    prior[3, 3] = 1.0 / max(features.imaging.etch_bias_sigma, 1e-9) ** 2
    covariance = np.linalg.inv(information + prior)
    noise, common = (covariance @ each @ covariance for each in (information, prior))
    return noise[:3, :3], common[:3, :3]
