"""Result of locating a robot on a field: candidate poses, and the evidence for the best one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.evidence import Evidence
from gpuvision.matching.field.field_pose import Candidate
from gpuvision.status import Status

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedRobot:
    """Where a robot may be, best first, or why that is not known.

    Attributes
    ----------
    candidates
        As `gpuvision.matching.field.field_pose.locate` gives them, those that explain best what is seen, and what is
        not, first.
    doubtful
        Where it is refused: what the points would fit best, but do not carry.
    evidence
        What speaks for the first of them; None where there is none.
    points
        float32 (points, 2), on lines, in the robot's frame [m].
    field
        The field.
    scale
        Of a pixel of the top view [m]; None where points were given.
    reason
        Why there is no pose; ``""`` where there is one.
    device
        Where it ran.
    seconds
        Of the steps, by name.
    """

    candidates: tuple[Candidate, ...]
    doubtful: tuple[Candidate, ...]
    evidence: Evidence | None
    points: Float32
    field: Field
    scale: float | None
    reason: str
    device: Device
    seconds: dict[str, float]

    def summary(self) -> str:
        """Return the candidates, a line for each, or why there are none."""
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
        sx, sy, turn = np.sqrt(np.diag(each.covariance))
        sigmas = f"sigmas {1e3 * sx:.2g} mm, {1e3 * sy:.2g} mm, {math.degrees(turn):.2g} degrees"
        if each.status & Status.AMBIGUOUS:
            sigmas = "the points fix a part of it only"
        twin = "" if each.twin is None else f"; twin of {each.twin + 1}"
        return (
            f"{number + 1}: x {x:.3f} m, y {y:.3f} m, heading {math.degrees(heading):.2f} degrees; {sigmas}; "
            f"score {each.score:.3f}, {each.share:.0%} of the points on lines{twin}"
        )

    def report(self) -> dict[str, Any]:
        """Return what ``pose.json`` holds: metres, radians; what is not known is null."""
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
            "field": self.field.name,
            "symmetric": self.field.is_symmetric,
            "candidates": [_told(each) for each in self.candidates],
            "evidence": _weighed(self.evidence),
            "scale": self.scale,
            "points": self.points.tolist(),
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "seconds": self.seconds,
        }


def _weighed(evidence: Evidence | None) -> dict[str, Any] | None:
    if evidence is None:
        return None
    return {
        "log10_chance": evidence.chance / math.log(10.0),
        "on_lines": evidence.on_lines,
        "expected": evidence.expected,
        "seen": evidence.seen if evidence.expected else None,
    }


def _told(each: Candidate) -> dict[str, Any]:
    sigmas = np.sqrt(np.diag(each.covariance))
    names = ("x", "y", "theta")
    is_known = bool(np.all(np.isfinite(each.covariance)))
    return {
        "pose": dict(zip(names, each.pose.tolist(), strict=True)),
        "sigmas": dict(zip(names, sigmas.tolist(), strict=True)) if is_known else None,
        "covariance": each.covariance.tolist() if is_known else None,
        "information": each.information.tolist(),
        "score": each.score,
        "share": each.share,
        "scatter": each.scale,
        "twin": each.twin,
        "status": str(each.status.name or "OK"),
    }
