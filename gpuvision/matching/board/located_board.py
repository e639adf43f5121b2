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
from gpuvision.matching.board.edge_measurement import Copper, Rulers
from gpuvision.matching.board.fiducial_detection import FoundMarks
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.pose.registration import Registration
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedBoard:
    """Where a camera is over a board, or why that is not known.

    Attributes
    ----------
    view
        With the pose that was found; where it is refused, the one last looked at.
    covariance
        (3, 3) of the pose's x, y [m] and theta [rad]; NaN where it is refused.
    placement, placement_px
        (2,) the artwork's placement point [m], and where it is seen in the image as it was taken [px].
    placement_covariance
        (3, 3) of the place on the board seen where the placement point is [m], and of theta [rad].
    rulers
        `Rulers` of the last pass.
    marks
        `FoundMarks` of the last pass.
    features
        What was looked for.
    growth
        How far copper reaches beyond its drawn edges, below 0 where too much was etched [m], solved for along with the
        pose; NaN where only the middles of traces were measured.
    spread
        Of what the pose leaves of the edges, in standard deviations: about 1 where these are right.
    condition
        Worst standard deviation over best.
    copper
        Whether copper is brighter or darker than what lies beside it.
    noise, threshold
        Of a pixel, and the least edge looked for [grey levels].
    reason
        Why the pose is refused; ``""`` where it is not.
    first
        What the search found; None where none was made.
    device
        Where it ran.
    seconds
        Of the steps, by name.
    """

    view: BoardView
    covariance: Float64
    placement: Float64
    placement_px: Float64
    placement_covariance: Float64
    rulers: Rulers
    marks: FoundMarks
    features: FeatureSet
    growth: float
    spread: float
    condition: float
    copper: Copper
    noise: float
    threshold: float
    reason: str
    first: Registration | None
    device: Device
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def pose(self) -> tuple[float, float, float]:
        """What the image's centre sees, x, y [m], and theta [rad]; NaN where it is refused."""
        return (math.nan,) * 3 if self.reason else self.view.pose

    @property
    def sigmas(self) -> Float64:
        """(3,) standard deviations of the pose [m], [m], [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> str:
        """Return the pose in a line or two, or why there is none."""
        if self.reason:
            return f"refused: {self.reason}"
        told, marks = self.rulers, self.marks
        counts = f"; {np.sum(told.used)} of {np.sum(told.laid)} rulers agree, {np.sum(told.found)} found an edge"
        if marks.laid.any():
            counts = counts if told.laid.any() else ""
            counts += f"; {np.sum(marks.used)} of {np.sum(marks.laid)} marks agree, {np.sum(marks.found)} were found"
        (x, y, theta), (sx, sy, turn) = self.pose, self.sigmas
        return (
            f"x {1e3 * x:.4f} mm, y {1e3 * y:.4f} mm, theta {math.degrees(theta):.4f} degrees\n"
            f"sigmas {1e6 * sx:.2f} µm, {1e6 * sy:.2f} µm, {math.degrees(turn):.5f} degrees{counts}"
        )

    def report(self) -> dict[str, Any]:
        """Return what ``pose.json`` holds: metres, radians; what is not known is null."""
        told, marks, first = self.rulers, self.marks, self.first
        points = told.point + told.normal * np.nan_to_num(told.position_px * self.view.scale)[:, None]
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
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
            "growth": _plain(self.growth),
            "spread": _plain(self.spread),
            "condition": _plain(self.condition),
            "scale": self.view.scale,
            "copper": self.copper,
            "noise": self.noise,
            "threshold": self.threshold,
            "search": None
            if first is None
            else {name: _plain(getattr(first, name)) for name in ("score", "runner_up")},
            "counts": {name: int(np.sum(getattr(told, name))) for name in ("laid", "found", "used")}
            | {f"marks_{name}": int(np.sum(getattr(marks, name))) for name in ("laid", "found", "used")},
            "rulers": [
                {
                    "point": _plain(told.point[number]),
                    "image_px": _plain(self.view.to_measured_pixels(points[number])),
                    "found": bool(told.found[number]),
                    "weight": _plain(told.weight[number]),
                    "residual": _plain(told.residual[number]),
                    "sigma": _plain(told.sigma[number]),
                    "status": str(Status(int(told.status[number])).name or "OK"),
                }
                for number in range(len(told.weight))
            ],
            "marks": [
                {
                    "point": _plain(marks.point[number]),
                    "image_px": _plain(marks.image_px[number]),
                    "found": bool(marks.found[number]),
                    "weight": _plain(marks.weight[number]),
                    "residual": _plain(marks.residual[number]),
                    "sigmas": _plain(np.sqrt(np.diag(marks.covariance[number]))),
                    "radius": _plain(marks.size[number]),
                    "status": str(Status(int(marks.status[number])).name or "OK"),
                }
                for number in range(len(marks.weight))
            ],
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "seconds": self.seconds,
        }


def _named(values: Any) -> dict[str, float | None]:
    return dict(zip(("x", "y", "theta"), _plain(values), strict=True))


def _plain(value: Any) -> Any:
    """Return numbers as JSON has them, None for NaN."""
    array = np.asarray(value, np.float64)
    if array.ndim:
        return [_plain(each) for each in array]
    return float(array) if np.isfinite(array) else None
