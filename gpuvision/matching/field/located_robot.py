"""Result of locating a robot on a field: candidate poses, and the evidence for the best one."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.evidence import Evidence
from gpuvision.matching.field.field_pose import PoseCandidate
from gpuvision.matching.field.point_scale import PointScale
from gpuvision.status import Status

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedRobot:
    """Pose candidates of a robot on a field, best first, or the reason why they are refused.

    Attributes
    ----------
    candidates
        Results of `gpuvision.matching.field.field_pose.find_pose_candidates`, ordered by `Evidence.missing`.
    doubtful
        Where the pose is refused: the best candidate, which the evidence does not support.
    evidence
        Evidence for the first candidate; None without a candidate.
    points
        float32 (points, 2), points on lines in the robot's frame [m].
    field
        The field.
    scale
        Size of a pixel of the top view [m]; None where points were given.
    reason
        Why the pose is refused; ``""`` where it is accepted.
    point_scale
        Error of the scale of the points, fitted about the best pose; None where it is not determined or not tested.
    warnings
        Messages that do not refuse the pose, such as a small but significant error of the scale.
    device
        Device of the search.
    seconds
        Duration of each step, by name [s]. "choose device" is the time of `StepDevices.choose`, with its measurements.
    steps
        Device of each step, and the measured times of the devices that it was chosen from, by name; see
        `StepDevices.report`.
    """

    candidates: tuple[PoseCandidate, ...]
    doubtful: tuple[PoseCandidate, ...]
    evidence: Evidence | None
    points: Float32
    field: Field
    scale: float | None
    reason: str
    device: Device
    seconds: dict[str, float]
    steps: dict[str, Any] = dataclasses.field(default_factory=dict)
    point_scale: PointScale | None = None
    warnings: tuple[str, ...] = ()

    def summary(self) -> str:
        """Return one line for each candidate, or the reason of the refusal."""
        if self.reason:
            return f"refused: {self.reason}"
        assert self.evidence is not None  # there are candidates
        found = f"{len(self.points)} points, {self.evidence.on_lines:.0%} of them on lines"
        if self.evidence.expected:
            found += f"; {max(self.evidence.seen, 0.0):.0%} of what should be seen of the lines is"
        return "\n".join([found, *map(self._line, range(len(self.candidates)))])

    def _line(self, number: int) -> str:
        each = self.candidates[number]
        x, y, heading = each.pose
        sx, sy, sigma_heading = np.sqrt(np.diag(each.covariance))
        sigmas = f"sigmas {1e3 * sx:.2g} mm, {1e3 * sy:.2g} mm, {math.degrees(sigma_heading):.2g} degrees"
        if each.status & Status.AMBIGUOUS:
            sigmas = "the points fix a part of it only"
        if each.status & Status.NOT_CONVERGED:
            sigmas += ", not converged"
        symmetric_twin = "" if each.symmetric_twin is None else f"; twin of {each.symmetric_twin + 1}"
        return (
            f"{number + 1}: x {x:.3f} m, y {y:.3f} m, heading {math.degrees(heading):.2f} degrees; {sigmas}; "
            f"score {each.score:.3f}, {each.inlier_fraction:.0%} of the points on lines{symmetric_twin}"
        )

    def report(self) -> dict[str, Any]:
        """Return the content of ``pose.json``: metres, radians; unknown numbers are null."""
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
            "field": self.field.name,
            "symmetric": self.field.is_symmetric,
            "candidates": [_candidate_report(each) for each in self.candidates],
            "evidence": _evidence_report(self.evidence),
            "scale": self.scale,
            "point_scale": _scale_report(self.point_scale),
            "warnings": list(self.warnings),
            "points": self.points.tolist(),
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "steps": self.steps,
            "seconds": self.seconds,
        }


def _scale_report(scale: PointScale | None) -> dict[str, float] | None:
    return None if scale is None else {"error": scale.error, "sigma": scale.sigma}


def _evidence_report(evidence: Evidence | None) -> dict[str, Any] | None:
    if evidence is None:
        return None
    return {
        "log10_nfa": evidence.log_nfa / math.log(10.0),
        "on_lines": evidence.on_lines,
        "expected": evidence.expected,
        "seen": evidence.seen if evidence.expected else None,
    }


def _candidate_report(each: PoseCandidate) -> dict[str, Any]:
    sigmas = np.sqrt(np.diag(each.covariance))
    names = ("x", "y", "theta")
    is_known = bool(np.all(np.isfinite(each.covariance)))
    return {
        "pose": dict(zip(names, each.pose.tolist(), strict=True)),
        "sigmas": dict(zip(names, sigmas.tolist(), strict=True)) if is_known else None,
        "covariance": each.covariance.tolist() if is_known else None,
        "information": each.information.tolist(),
        "score": each.score,
        "inlier_fraction": each.inlier_fraction,
        "residual_std": each.residual_std,
        "symmetric_twin": each.symmetric_twin,
        "status": str(each.status.name or "OK"),
    }
