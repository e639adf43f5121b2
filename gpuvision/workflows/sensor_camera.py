"""Camera of a laser sensor's calibration: fitted to the target views, or read from a camera file.

Both give the pose of the target in every view with its noise and its dependence on the camera's parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import Calibration, DetectedTarget, TargetPattern
from gpuvision.camera.camera import Camera
from gpuvision.camera.lines.line_statistics import Loss
from gpuvision.camera.lines.vanishing_points import straightness_px
from gpuvision.camera.views.planar_calibration import fit_camera
from gpuvision.camera.views.pose_response import PoseResponse, fit_pose, pose_responses
from gpuvision.camera.views.target_views import make_view
from gpuvision.formats.camera_file import check_calibrated_size, read_calibrated_camera

Float64 = npt.NDArray[np.float64]


class DetectedViews(NamedTuple):
    """Target views of a sensor calibration.

    Attributes
    ----------
    pattern : {"dots", "chessboard"}
        Pattern of the target.
    pitch : float
        Distance between neighbouring points on the target [m].
    detected : tuple of DetectedTarget
        Detected targets.
    skipped : tuple of (Path, str)
        Skipped images, each with the reason.
    size : (int, int)
        Columns and rows of the images.
    """

    pattern: TargetPattern
    pitch: float
    detected: tuple[DetectedTarget, ...]
    skipped: tuple[tuple[Path, str], ...]
    size: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class KnownCamera:
    """Camera that was calibrated before, and the target views whose poses it gave.

    Attributes
    ----------
    file : Path
        Camera file.
    names : tuple of str
        Parameters with a covariance; empty if the file has no covariance.
    covariance : numpy.ndarray
        (m, m): covariance of these parameters [px], [rad].
    pattern : {"dots", "chessboard"}
        Pattern of the target.
    image_size : (int, int)
        Columns and rows of the images.
    detected_targets : tuple of DetectedTarget
        Detected target of each image used.
    skipped_images : tuple of (Path, str)
        Images without a detected target, each with the reason.
    residuals : tuple of numpy.ndarray
        Per view (n, 2): measured minus projected points at the fitted pose [px].
    """

    file: Path
    names: tuple[str, ...]
    covariance: Float64
    pattern: TargetPattern
    image_size: tuple[int, int]
    detected_targets: tuple[DetectedTarget, ...]
    skipped_images: tuple[tuple[Path, str], ...]
    residuals: tuple[Float64, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square distance between measured and projected points [px]."""
        return _rms(np.concatenate(self.residuals))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the camera."""
        if self.names:
            return ()
        return (
            f"{self.file.name} has no table [covariance]: the camera counts as exact, and the uncertainties leave out "
            "its error",
        )

    def summary(self) -> str:
        """Return one line: camera file, images and points used, and residual."""
        used = len(self.detected_targets)
        points = sum(each.points for each in self.detected_targets)
        return (
            f"camera of {self.file.name}; {self.pattern} in {used} of {used + len(self.skipped_images)} images, "
            f"{points} points: residual {self.rms_px:.3g} px rms"
        )

    def report(self) -> dict[str, Any]:
        """Return camera file, covariance and residuals as a tree of numbers and strings for JSON."""
        return {
            "file": self.file.name,
            "pattern": self.pattern,
            "image_size": list(self.image_size),
            "rms_px": self.rms_px,
            "covariance": {"names": list(self.names), "matrix": self.covariance.tolist()},
            "images": [
                {"name": each.image.name, "rms_px": _rms(errors)}
                for each, errors in zip(self.detected_targets, self.residuals, strict=True)
            ],
            "skipped_images": {path.name: reason for path, reason in self.skipped_images},
            "warnings": list(self.warnings),
        }


class SensorCamera(NamedTuple):
    """Camera of a sensor with the poses of the target.

    Attributes
    ----------
    camera : Camera
        Camera.
    names : tuple of str
        Parameters with a covariance.
    covariance : numpy.ndarray
        (m, m): covariance of these parameters.
    targets : dict of Path to PoseResponse
        Pose of the target in each image.
    calibration : Calibration or KnownCamera
        Origin of the camera, with the detected targets.
    """

    camera: Camera
    names: tuple[str, ...]
    covariance: Float64
    targets: dict[Path, PoseResponse]
    calibration: Calibration | KnownCamera


def fitted_camera(views: DetectedViews, *, model: str, focal_length: float | None, loss: Loss) -> SensorCamera:
    """Calibrate the camera from the target views.

    Parameters
    ----------
    views : DetectedViews
        Target views.
    model, focal_length, loss
        As in `gpuvision.camera.views.planar_calibration.fit_camera`.

    Returns
    -------
    SensorCamera

    Raises
    ------
    ValueError
        The views do not determine the camera; the message names the missing data.
    """
    points = [make_view(known_grid(each), views.pitch) for each in views.detected]
    fit = fit_camera(points, views.size, model=model, focal_length=focal_length, loss=loss)
    targets = dict(zip((each.image for each in views.detected), pose_responses(fit, points), strict=True))
    families = tuple(family for each in views.detected for family in each.families)
    calibration = Calibration(
        fit=fit,
        pattern=views.pattern,
        image_size=views.size,
        detected_targets=views.detected,
        skipped_images=views.skipped,
        straightness_px=(straightness_px(families), straightness_px(families, fit.camera)),
    )
    return SensorCamera(fit.camera, fit.names, fit.covariance, targets, calibration)


def known_camera(views: DetectedViews, file: Path) -> SensorCamera:
    """Read the camera from a camera file, and fit the pose of the target in every view.

    Parameters
    ----------
    views : DetectedViews
        Target views.
    file : Path
        Camera file with a table ``[camera]``, as ``gpuvision calibrate`` writes it.

    Returns
    -------
    SensorCamera

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        The file has no ``[camera]``, the images have another size than the calibrated ones, or a view gives no pose.
    """
    known = read_calibrated_camera(file)
    check_calibrated_size(
        views.detected[0].image, views.size, known.size, hint="take images of the whole sensor, or calibrate the camera"
    )
    targets, residuals = {}, []
    for each in views.detected:
        points, pixels = make_view(known_grid(each), views.pitch)
        found = np.isfinite(pixels).all(axis=1)
        try:
            targets[each.image], errors = fit_pose(known.camera, known.names, points[found], pixels[found])
        except ValueError as error:
            raise ValueError(f"{each.image}: {error}") from error
        residuals.append(errors)
    calibration = KnownCamera(
        file=file,
        names=known.names,
        covariance=known.covariance,
        pattern=views.pattern,
        image_size=views.size,
        detected_targets=views.detected,
        skipped_images=views.skipped,
        residuals=tuple(residuals),
    )
    return SensorCamera(known.camera, known.names, known.covariance, targets, calibration)


def known_grid(target: DetectedTarget) -> Float64:
    """Return the grid of a target with one (rows, columns, 2) [px]; only grids have poses."""
    assert target.grid is not None, "only grids have poses"
    return target.grid


def _rms(errors: Float64) -> float:
    """Return the root mean square length of residuals (n, 2)."""
    return math.sqrt(float(np.mean(np.sum(errors**2, axis=1))))
