"""Filter of a robot's pose over time: odometry, delayed views with several candidates, robots that are carried away.

The state is a mixture of Gaussians: hypotheses, each a pose with covariance and probability. A view gives the candidate
poses of `gpuvision.matching.field.field_pose`. Each hypothesis may belong to each candidate, or the view may be wrong,
or somebody may have put the robot elsewhere (kidnapping): then any candidate is a new hypothesis. The probabilities
follow from Bayes' rule; unlikely hypotheses are dropped. On a field that is symmetric under half a turn both poses
remain, with equal probabilities, unless the first pose is known.

References
----------
.. [1] S. Thrun, W. Burgard and D. Fox, *Probabilistic Robotics*, MIT Press 2005, chapter 7 (multi-hypothesis tracking).
.. [2] D. B. Reid, "An algorithm for tracking multiple targets", IEEE Transactions on Automatic Control 24, 1979.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.field_pose import PoseCandidate
from gpuvision.matching.field.odometry import PoseEstimate, correct, predict, squared_mahalanobis_distance
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RobotFilterLimits:
    """Probabilities and thresholds of a `RobotFilter`.

    Parameters
    ----------
    wrong_view : float
        Probability that no candidate of a view is the pose, 0 to 1, exclusive (chosen). Default 0.05.
    carried : float
        Probability that the robot was carried elsewhere between two views, 0 to 1, exclusive (chosen). Default 1e-3.
    gate : float
        Squared Mahalanobis distance beyond which a candidate is not the pose of a hypothesis: a right one exceeds the
        default with a probability of 0.001 (chi square, 3 degrees of freedom).
    min_probability : float
        Least probability of a pose that is not AMBIGUOUS (chosen). Default 0.9.
    dropped : float
        Probability below which a hypothesis is dropped (chosen). Default 1e-6.
    max_hypotheses : int
        Largest number of hypotheses (cost). Default 16.
    merged : float
        Squared Mahalanobis distance below which two hypotheses are one (chosen). Default 1.0.
    view_delay : float
        Longest time from the exposure of a view until it is given to the filter [s], above 0; an older view is not
        used (chosen: 10 frame times at 5 frames per second). Default 2.0.
    """

    wrong_view: float = 0.05
    carried: float = 1e-3
    gate: float = 16.27
    min_probability: float = 0.9
    dropped: float = 1e-6
    max_hypotheses: int = 16
    merged: float = 1.0
    view_delay: float = 2.0


class Hypothesis(NamedTuple):
    """Pose of a robot with its covariance, and the probability of this hypothesis."""

    estimate: PoseEstimate
    probability: float


class RobotState(NamedTuple):
    """State of a robot at one time.

    Attributes
    ----------
    time : float
        Time [s].
    pose, covariance : (3,) and (3, 3)
        Most probable pose x, y [m], heading [rad] with its covariance; NaN without a hypothesis.
    probability : float
        Its probability; 0 without a hypothesis.
    status : Status
        NO_DATA: no view gave a pose yet. AMBIGUOUS: other hypotheses are too probable.
    hypotheses : tuple of Hypothesis
        All of them, most probable first.
    """

    time: float
    pose: Float64
    covariance: Float64
    probability: float
    status: Status
    hypotheses: tuple[Hypothesis, ...]


class _Motion(NamedTuple):
    """Motion (forward, left, turn) from one time to another, with its covariance."""

    start: float
    end: float
    motion: Float64
    covariance: Float64

    def until(self, time: float) -> _Motion:
        """Return the first part of the motion, at constant velocity; the covariance grows with time."""
        share = (time - self.start) / (self.end - self.start)
        return _Motion(self.start, time, share * self.motion, share * self.covariance)

    def since(self, time: float) -> _Motion:
        """Return the second part of the motion: after the first one it gives the pose of the whole motion."""
        first, share = self.until(time).motion, (self.end - time) / (self.end - self.start)
        c, s = math.cos(first[2]), math.sin(first[2])
        back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return _Motion(time, self.end, back @ (self.motion - first), share * back @ self.covariance @ back.T)


class RobotFilter:
    """Filter of a robot's pose: odometry as it comes, views when their candidates arrive.

    Parameters
    ----------
    field : Field
        The field, for the density of poses that nothing is known about.
    initial : PoseEstimate, optional
        First pose with its covariance. None: the first view gives the hypotheses.
    time : float
        Time of the first pose [s], default 0.
    limits : RobotFilterLimits
        Probabilities and thresholds.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    Motions are kept for ``limits.view_delay`` seconds, so that a late view counts at its time. Memory and time of a
    call grow with the number of motions in this time, not with the time since the last view.
    """

    def __init__(
        self,
        field: Field,
        initial: PoseEstimate | None = None,
        time: float = 0.0,
        limits: RobotFilterLimits = RobotFilterLimits(),
    ) -> None:
        finite(limits.view_delay, "view_delay [s]", above=0.0)
        self.limits = limits
        self._time = self._end = finite(time, "time [s]")
        self._hypotheses: list[Hypothesis] = [] if initial is None else [Hypothesis(initial, 1.0)]
        self._motions: list[_Motion] = []
        self._seen = -math.inf  # time of the last view [s]
        # Density of a pose anywhere on the field [1 / (m^2 rad)].
        self._anywhere = 1.0 / (field.length * field.width * 2.0 * math.pi)

    def move(self, time: float, motion: npt.ArrayLike, covariance: npt.ArrayLike) -> None:
        """Take the motion since the last one: (forward, left, turn) [m], [m], [rad], with its covariance (3, 3).

        Parameters
        ----------
        time : float
            End of the motion [s], after the end of the last one.
        motion, covariance : array_like
            As in `predict`.

        Raises
        ------
        ValueError
            The time does not increase.
        """
        if not finite(time, "time [s]") > self._end:
            raise ValueError(f"the motion ends at {time} s, expected a time after {self._end} s")
        values = np.asarray(motion, np.float64), np.asarray(covariance, np.float64)
        self._motions.append(_Motion(self._end, time, *values))
        self._end = time
        oldest = time - self.limits.view_delay
        kept = next(number for number, each in enumerate(self._motions) if each.end > oldest)
        if kept:
            self._advance(self._motions[:kept], self._motions[kept:])

    def see(self, time: float, candidates: Sequence[PoseCandidate]) -> bool:
        """Take the candidates of a view that was exposed at a time, which may lie before later motions.

        Parameters
        ----------
        time : float
            Middle of the exposure [s].
        candidates : sequence of PoseCandidate
            Candidates of the view; none for a view that was refused. A candidate that is NOT_CONVERGED is left out: its
            covariance holds for the pose of least cost.

        Returns
        -------
        bool
            False for a view that is not used: it is not newer than the last one, or older than
            ``limits.view_delay`` and the motions of its time are no longer kept.

        Raises
        ------
        ValueError
            The time is after the last motion.
        """
        if finite(time, "time [s]") > self._end:
            raise ValueError(f"the view is of {time} s, after the last motion at {self._end} s; give the motion first")
        if time < self._time or time <= self._seen:
            return False
        self._seen = time
        self._advance(*self._split(time))
        self._time = time
        candidates = [each for each in candidates if not each.status & Status.NOT_CONVERGED]
        known = [each for each in candidates if not each.status & Status.AMBIGUOUS]
        if known:
            self._hypotheses = self._reduced(self._children(known))
        elif candidates:
            self._hypotheses = [self._with_part(each, candidates) for each in self._hypotheses]
        return True

    def state(self, time: float | None = None) -> RobotState:
        """Return the state at a time up to the last motion; None: after the last motion.

        The time is not before the last view, nor more than ``limits.view_delay`` before the last motion.
        """
        time = self._end if time is None else finite(time, "time [s]", minimum=self._time, maximum=self._end)
        motions, _ = self._split(time)
        found = tuple(_moved(each, motions) for each in self._hypotheses)
        if not found:
            unknown = np.full((3, 3), np.nan)
            return RobotState(time, unknown[0], unknown, 0.0, Status.NO_DATA, ())
        best = found[0]
        status = Status.OK if best.probability >= self.limits.min_probability else Status.AMBIGUOUS
        return RobotState(time, best.estimate.pose, best.estimate.covariance, best.probability, status, found)

    def _advance(self, before: Sequence[_Motion], after: list[_Motion]) -> None:
        """Move the hypotheses by the first motions, and keep the others."""
        self._hypotheses = [_moved(each, before) for each in self._hypotheses]
        self._motions = after
        if before:
            self._time = before[-1].end

    def _split(self, time: float) -> tuple[list[_Motion], list[_Motion]]:
        """Return the kept motions until a time, and after it."""
        before: list[_Motion] = []
        after: list[_Motion] = []
        for each in self._motions:
            if each.start < time:
                before.append(each if each.end <= time else each.until(time))
            if each.end > time:
                after.append(each if each.start >= time else each.since(time))
        return before, after

    def _children(self, candidates: Sequence[PoseCandidate]) -> list[Hypothesis]:
        """Return the hypotheses after a view with their probabilities, not normalised."""
        limits, count = self.limits, len(candidates)
        total = sum(each.probability for each in self._hypotheses)
        elsewhere = (limits.carried if total else 1.0) * (1.0 - limits.wrong_view) / count * self._anywhere
        children = [Hypothesis(PoseEstimate(each.pose, each.covariance), elsewhere) for each in candidates]
        for estimate, probability in self._hypotheses:
            stays = (1.0 - limits.carried) * probability
            children.append(Hypothesis(estimate, stays * limits.wrong_view * self._anywhere))
            for each in candidates:
                distance = squared_mahalanobis_distance(estimate, each.pose, each.information)
                if distance <= limits.gate:
                    spread = np.linalg.det(2.0 * math.pi * (estimate.covariance + each.covariance))
                    density = math.exp(-0.5 * distance) / math.sqrt(spread)
                    share = stays * (1.0 - limits.wrong_view) / count * density
                    children.append(Hypothesis(correct(estimate, each.pose, each.information), share))
        return children

    def _with_part(self, hypothesis: Hypothesis, candidates: Sequence[PoseCandidate]) -> Hypothesis:
        """Correct a hypothesis by the nearest candidate that determines a part of the pose only."""
        estimate = hypothesis.estimate
        distances = [squared_mahalanobis_distance(estimate, each.pose, each.information) for each in candidates]
        nearest = int(np.argmin(distances))
        if distances[nearest] > self.limits.gate:
            return hypothesis
        best = candidates[nearest]
        return hypothesis._replace(estimate=correct(estimate, best.pose, best.information))

    def _reduced(self, children: list[Hypothesis]) -> list[Hypothesis]:
        """Merge equal hypotheses, drop unlikely ones, and normalise the probabilities."""
        total = sum(each.probability for each in children)
        kept: list[Hypothesis] = []
        for estimate, probability in sorted(children, key=lambda each: -each.probability):
            for number, other in enumerate(kept):
                information = np.linalg.inv(estimate.covariance)
                if squared_mahalanobis_distance(other.estimate, estimate.pose, information) < self.limits.merged:
                    kept[number] = other._replace(probability=other.probability + probability)
                    break
            else:
                kept.append(Hypothesis(estimate, probability))
        kept = [each for each in kept if each.probability >= self.limits.dropped * total]
        kept = sorted(kept, key=lambda each: -each.probability)[: self.limits.max_hypotheses]
        total = sum(each.probability for each in kept)
        return [each._replace(probability=each.probability / total) for each in kept]


def _moved(hypothesis: Hypothesis, motions: Sequence[_Motion]) -> Hypothesis:
    estimate = hypothesis.estimate
    for each in motions:
        estimate = predict(estimate, each.motion, each.covariance)
    return hypothesis._replace(estimate=estimate)
