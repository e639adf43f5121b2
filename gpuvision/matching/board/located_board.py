"""Result of locating a board in an image: pose, covariance, and every measured feature."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.matching.board.fiducial_detection import FoundFiducials
from gpuvision.matching.board.measurement_result import Copper, RulerMeasurements, ScaleError
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.pose.registration import Registration
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedBoard:
    """Pose of a camera over a board, or the reason why it is refused.

    Attributes
    ----------
    view
        Pose, scale and lens of the camera; where the pose is refused, the last expected one.
    covariance : (3, 3)
        Covariance of the pose's x, y [m] and theta [rad]; NaN where the pose is refused.
    placement, placement_px : (2,)
        Placement point in the artwork [m], and its position in the measured image [px].
    placement_covariance : (3, 3)
        Covariance of the board's position at the placement point, x, y [m], and of theta [rad].
    rulers
        `RulerMeasurements` of the last pass.
    fiducials
        `FoundFiducials` of the last pass.
    features
        Features that were searched.
    etch_bias
        Distance from the drawn edges to the copper's edges [m], negative for over-etched copper, solved together with
        the pose; NaN where only centres of traces and fiducials were measured.
    residual_scale
        Scale of the residuals in standard deviations: about 1 where these are right.
    condition
        Largest over smallest standard deviation of the pose.
    copper
        Whether copper is "bright" or "dark" relative to its surroundings.
    noise, threshold
        Standard deviation of a pixel, and least height of an edge [grey levels].
    reason
        Why the pose is refused; ``""`` where it is accepted.
    coarse_registration
        Result of the coarse registration; None if it was not needed.
    scale_error
        Error of the scale with its standard deviation: size of the board in the image over its size in the artwork,
        less 1; NaN where the features do not determine it.
    device
        Device of the rulers, the fiducials and the pose.
    steps
        Device of each step, and the measured times of the devices that it was chosen from, by name; see
        `StepDevices.report`.
    seconds
        Duration of each step, by name [s]. "choose device" is the time of `StepDevices.choose`, with its measurements.
    warnings
        What may be wrong although a pose was found: layers of the board that are missing, a wrong scale.
    """

    view: BoardView
    covariance: Float64
    placement: Float64
    placement_px: Float64
    placement_covariance: Float64
    rulers: RulerMeasurements
    fiducials: FoundFiducials
    features: FeatureSet
    etch_bias: float
    residual_scale: float
    condition: float
    copper: Copper
    noise: float
    threshold: float
    reason: str
    coarse_registration: Registration | None
    scale_error: ScaleError
    device: Device
    steps: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def pose(self) -> tuple[float, float, float]:
        """Place on the board at the image centre, x, y [m], and theta [rad]; NaN where the pose is refused."""
        return (math.nan,) * 3 if self.reason else self.view.pose

    @property
    def sigmas(self) -> Float64:
        """(3,) standard deviations of the pose [m], [m], [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> str:
        """Return the pose with its standard deviations in two lines, or the reason of the refusal."""
        if self.reason:
            return f"refused: {self.reason}"
        rulers, fiducials = self.rulers, self.fiducials
        counts = (
            f"; {np.sum(rulers.used)} of {np.sum(rulers.in_image)} rulers agree, {np.sum(rulers.found)} found an edge"
        )
        if fiducials.in_image.any():
            counts = counts if rulers.in_image.any() else ""
            counts += f"; {np.sum(fiducials.used)} of {np.sum(fiducials.in_image)} fiducials agree, "
            counts += f"{np.sum(fiducials.found)} were found"
        (x, y, theta), (sx, sy, sigma_theta) = self.pose, self.sigmas
        return (
            f"x {1e3 * x:.4f} mm, y {1e3 * y:.4f} mm, theta {math.degrees(theta):.4f} degrees\n"
            f"sigmas {1e6 * sx:.2f} µm, {1e6 * sy:.2f} µm, {math.degrees(sigma_theta):.5f} degrees{counts}"
        )

    def report(self) -> dict[str, Any]:
        """Return the content of ``pose.json``: metres, radians; unknown numbers are null."""
        rulers, fiducials, coarse = self.rulers, self.fiducials, self.coarse_registration
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
            "warnings": list(self.warnings),
            "side": self.features.side,
            "pose": _named(self.pose),
            "sigmas": _named(self.sigmas),
            "covariance": _plain(self.covariance),
            "placement": {
                "board": _plain(self.placement),
                "image_px": _plain(self.placement_px),
                "covariance": _plain(self.placement_covariance),
            },
            "predicted_covariance": _plain(self.features.covariance),
            "etch_bias": _plain(self.etch_bias),
            "residual_scale": _plain(self.residual_scale),
            "condition": _plain(self.condition),
            "scale": self.view.scale,
            "scale_error": {name: _plain(each) for name, each in self.scale_error._asdict().items()},
            "copper": self.copper,
            "noise": self.noise,
            "threshold": self.threshold,
            "coarse_registration": None
            if coarse is None
            else {name: _plain(getattr(coarse, name)) for name in ("score", "runner_up")},
            "counts": {name: int(np.sum(getattr(rulers, name))) for name in ("in_image", "found", "used")}
            | {f"fiducials_{name}": int(np.sum(getattr(fiducials, name))) for name in ("in_image", "found", "used")},
            "rulers": self._ruler_reports(),
            "fiducials": self._fiducial_reports(),
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "steps": self.steps,
            "seconds": self.seconds,
        }

    def _ruler_reports(self) -> list[dict[str, Any]]:
        """Return the entry of each ruler in the report."""
        rulers = self.rulers
        points = rulers.point + rulers.normal * np.nan_to_num(rulers.position_px * self.view.scale)[:, None]
        return [
            {
                "point": _plain(rulers.point[number]),
                "image_px": _plain(self.view.to_measured_pixels(points[number])),
                "found": bool(rulers.found[number]),
                "weight": _plain(rulers.weight[number]),
                "residual": _plain(rulers.residual[number]),
                "sigma": _plain(rulers.sigma[number]),
                "status": str(Status(int(rulers.status[number])).name or "OK"),
            }
            for number in range(len(rulers.weight))
        ]

    def _fiducial_reports(self) -> list[dict[str, Any]]:
        """Return the entry of each fiducial in the report."""
        fiducials = self.fiducials
        return [
            {
                "point": _plain(fiducials.point[number]),
                "image_px": _plain(fiducials.image_px[number]),
                "found": bool(fiducials.found[number]),
                "weight": _plain(fiducials.weight[number]),
                "residual": _plain(fiducials.residual[number]),
                "sigmas": _plain(np.sqrt(np.diag(fiducials.covariance[number]))),
                "radius": _plain(fiducials.size[number]),
                "status": str(Status(int(fiducials.status[number])).name or "OK"),
            }
            for number in range(len(fiducials.weight))
        ]


def _named(values: Any) -> dict[str, float | None]:
    return dict(zip(("x", "y", "theta"), _plain(values), strict=True))


def _plain(value: Any) -> Any:
    """Return numbers as JSON types, None for NaN."""
    array = np.asarray(value, np.float64)
    if array.ndim:
        return [_plain(each) for each in array]
    return float(array) if np.isfinite(array) else None
