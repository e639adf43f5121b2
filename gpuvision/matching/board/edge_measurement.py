"""Rulers and marks in an image of a board, and the pose that they make: once, and again where the board was found."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.fiducial_detection import FoundMarks, find_marks
from gpuvision.matching.features.feature_set import FeatureSet, chosen_of
from gpuvision.matching.features.fiducials import marks_of, reach_of
from gpuvision.matching.features.ruler import LONGEST, RulerEdges, best_smoothing
from gpuvision.matching.features.selection import Candidates, Imaging, candidates
from gpuvision.matching.pose.pose import BoardPose, SolvePose, line_rows
from gpuvision.status import Status

Copper = Literal["auto", "bright", "dark"]
Float64 = npt.NDArray[np.float64]

_AGAIN_PX = 4.0  # reach of rulers that are laid at a pose that was found
_SAMPLED_PX = 0.02  # [px] standard deviation of what bilinear samples cost an edge; neighbours have some in common
_LEAST_SHARE = 0.3  # of the rulers and marks in the image that must agree
_WORST_PX = 0.5  # by so much edges may disagree with a pose
_USUAL_CANDIDATES = 2500
_MOST_MARKS = 40
_MOST_SEARCHED_PX = 190.0  # rulers of marks are no longer
_SLACK_PX = 1.0  # by which marks may lie further out than expected, besides how they are etched
_BEYOND, _TURN = 2.0, 5e-3  # times as far as the rulers reach, and a least angle [rad]: a pose there is none of theirs
_TRIALS = 256  # poses to start from: of four rows, all miss half of them bad in 7 of 1e8 boards


class Rulers(NamedTuple):
    """What each ruler measured, (n, ...); pixels in the undistorted image.

    Attributes
    ----------
    point, normal
        (n, 2) on the board, as in `FeatureSet`.
    length_px
        (n,) along the normal.
    position_px
        (n,) of the edge from the ruler's middle, along the normal; NaN where there is none.
    sigma
        (n,) of its place on the board [m].
    weight
        (n,) in the pose, 0 (rejected, or no edge) to 1.
    residual
        (n,) what the pose leaves of it, along the normal [m].
    status
        (n,) uint8 `Status` flags, as in `gpuvision.matching.features.ruler.Edges`.
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
    def laid(self) -> npt.NDArray[np.bool_]:
        """Which lie in the image."""
        return np.asarray((self.status & Status.OUT_OF_RANGE) == 0)

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which found an edge."""
        return np.isfinite(self.position_px)

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which found one that the pose agrees with."""
        return self.weight > 0.05


class Solution(NamedTuple):
    """What one pass made: where the board is seen, and its covariance at the placement point."""

    pose: Float64
    covariance: Float64
    growth: float
    spread: float
    condition: float
    rulers: Rulers
    marks: FoundMarks
    reason: str


class Fix(NamedTuple):
    """Two passes, or one that was refused."""

    view: BoardView
    before: BoardView
    solution: Solution

    @property
    def rulers(self) -> Rulers:
        """What they measured in the last pass."""
        return self.solution.rulers

    @property
    def agreeing(self) -> int:
        """How many rulers and marks the pose agrees with."""
        return _count(self.solution.rulers.used, self.solution.marks.used)

    @property
    def reason(self) -> str:
        """Why the pose is refused; empty where it is not."""
        return self.solution.reason


class Looking:
    """Rulers and marks in an image, and the poses they make."""

    def __init__(
        self,
        grey: npt.NDArray[Any],
        features: FeatureSet,
        noise: float,
        threshold: float,
        blur_px: float,
        etch: float,
        device: Device,
    ) -> None:
        self.grey, self.features, self.noise, self.threshold = grey, features, noise, threshold
        self.blur_px, self.etch, self.device = blur_px, etch, device

    def located(self, view: BoardView, copper: Copper) -> Fix:
        """Look where the board should be, then once more where it was found, with shorter rulers."""
        reach = np.minimum(self.features.length / view.scale, LONGEST)
        imaging = self.features.imaging
        first = self._pass(view, copper, reach, (_BEYOND * imaging.shift, _BEYOND * max(imaging.angle, _TURN)))
        if first.reason:
            return Fix(view, view, first)
        there = moved(view, first.pose)
        second = self._pass(there, copper, np.minimum(reach, self._short(view.scale)))
        return Fix(there if second.reason else moved(there, second.pose), there, second)

    def _short(self, scale: float) -> Float64:
        """(n,) lengths [px] that the edge lies on where the board is known to a few pixels."""
        return 2 * (_AGAIN_PX + 3 * best_smoothing(self.blur_px)) + 3 + self.features.spacing / scale

    def _pass(
        self, view: BoardView, copper: Copper, length_px: Float64, within: tuple[float, float] | None = None
    ) -> Solution:
        rulers, marks = self._measured(view, copper, length_px), self._found(view, copper, is_first=within is not None)
        what = "rulers and marks" if len(marks.laid) else "rulers"
        laid, found = _count(rulers.laid, marks.laid), _count(rulers.found, marks.found)
        if laid < 3:
            told = f"{laid} of {len(rulers.laid) + len(marks.laid)} {what} lie in the image, expected 3 or more"
            return _refused(rulers, marks, told)
        if found < 3:
            return _refused(
                rulers,
                marks,
                f"{found} of {laid} {what} found an edge of {self.threshold:.3g} grey levels or more, expected 3; is "
                "it this side of this board, near there, at this scale?",
            )
        solution = self._solved(rulers, marks, view.scale, within)
        if not solution.reason or not marks.found.any():
            return solution
        # A mark may say as much as all the rest together. Where it disagrees with the rest, all are asked alike.
        sigmas = np.concatenate([rulers.sigma, *marks.axes[0].T])
        alike = marks.known_to(float(np.nanmedian(sigmas)))
        again = self._solved(rulers, alike, view.scale, within)
        return solution if again.reason else again

    def _found(self, view: BoardView, copper: Copper, *, is_first: bool) -> FoundMarks:
        """Find marks as far as the board may be off, and nearer where it was found."""
        features = self.features
        reach = reach_of(features.marks.point, features.placement, features.imaging).max(initial=0.0) / view.scale
        reach += 3 * self.etch / view.scale + _SLACK_PX
        return find_marks(
            self.grey,
            features.marks,
            view,
            is_bright=copper == "bright",
            search_px=float(min(reach, _MOST_SEARCHED_PX if is_first else _AGAIN_PX)),
            threshold=self.threshold,
            noise=self.noise,
            blur_px=self.blur_px,
            etch=self.etch,
            device=self.device,
        )

    def _measured(self, view: BoardView, copper: Copper, length_px: Float64) -> Rulers:
        """Look along all rulers: those across single edges together, those across traces by the traces' widths."""
        features = self.features
        matrix = view.matrix
        direction = features.normal @ matrix[:2, :2].T * view.scale
        laid = np.concatenate([view.to_pixels(features.point), direction], axis=1).astype(np.float32)
        count = len(laid)
        position, sigma = np.full(count, np.nan), np.full(count, np.nan)
        status = np.zeros(count, np.uint8)
        spacing_px = features.spacing / view.scale
        smoothing = best_smoothing(self.blur_px)
        # One length for all, of few that there are: every other one would be a build of its own.
        room = max(float(length_px.max(initial=0.0)), 2 * math.ceil(3 * smoothing) + 3)
        length = min(16 * math.ceil(room / 16), LONGEST)
        for low, high in _alike(spacing_px):
            group = np.flatnonzero((spacing_px >= low) & (spacing_px <= high))
            across = low > 0
            edges = RulerEdges(
                threshold=self.threshold,
                length=length,
                width=features.imaging.width_px,
                smoothing_px=smoothing,
                polarity="rising" if (copper == "bright") == across else "falling",
                pairs=across,
                spacing_px=(max(0.6 * low - 2, 1.0), 1.4 * high + 2) if across else None,
                noise=self.noise,
                model=view.model,
            )(self.grey, np.ascontiguousarray(laid[group]), device=self.device)
            position[group], sigma[group], status[group] = edges.position, edges.sigma, edges.status
        sigma = np.hypot(sigma, _SAMPLED_PX) * view.scale
        nothing = np.zeros(count)
        return Rulers(features.point, features.normal, length_px, position, sigma, nothing, nothing * np.nan, status)

    def _solved(self, rulers: Rulers, marks: FoundMarks, scale: float, within: tuple[float, float] | None) -> Solution:
        """Solve for the pose, and along with it for the etching where single edges were measured."""
        placement = self.features.placement
        single = self.features.spacing == 0
        is_etched = bool((single & rulers.found).any()) and self.etch > 0
        seen = rulers.point + rulers.normal * (rulers.position_px * scale)[:, None]
        across = line_rows(
            rulers.normal, rulers.point - placement, seen - placement, rulers.sigma, np.where(single, 1.0, 0.0)
        )
        rows = np.concatenate([across, marks.rows(placement)])
        fit = SolvePose(
            scale=None,
            smallest_scale=1.0,
            etch=self.etch if is_etched else None,
            least_agreement=_LEAST_SHARE,
            within=within,
            trials=_TRIALS,
            precision="double" if self.device.has_double else "single",
        )(np.ascontiguousarray(rows if is_etched else rows[:, :-1]), device=self.device)
        count = len(rulers.sigma)
        told = rulers._replace(weight=np.nan_to_num(fit.weights[:count]), residual=fit.residuals[:count])
        marks = marks.judged(fit.weights[count:], fit.residuals[count:])
        if int(fit.status):
            return _refused(told, marks, _why(fit, _count(rulers.found, marks.found, marks.found)))
        solution = Solution(
            pose=_about(np.asarray(fit.pose, np.float64), placement),
            # Of few edges that happen to agree better than they should the scatter is not to be trusted.
            covariance=np.asarray(fit.covariance, np.float64) / min(float(fit.spread), 1.0) ** 2,
            growth=float(fit.etch) if is_etched else math.nan,
            spread=float(fit.spread),
            condition=float(fit.condition),
            rulers=told,
            marks=marks,
            reason="",
        )
        return self._judged(solution, float(fit.scale), scale)

    def _judged(self, solution: Solution, spread: float, scale: float) -> Solution:
        """Refuse what too few rulers and marks agree with, or what they disagree with too much."""
        rulers, marks = solution.rulers, solution.marks
        used, laid = _count(rulers.used, marks.used), _count(rulers.laid, marks.laid)
        if used < max(3, _LEAST_SHARE * laid):
            what = "rulers and marks" if len(marks.laid) else "rulers"
            return solution._replace(reason=f"{used} of {laid} {what} agree, expected {_LEAST_SHARE:.0%} or more")
        off = spread * float(np.nanmedian(np.concatenate([rulers.sigma, *marks.axes[0].T]))) / scale
        if off > _WORST_PX:
            return solution._replace(reason=f"the edges lie {off:.1f} px off any pose, expected {_WORST_PX} px or less")
        return solution


def _alike(spacing_px: Float64) -> list[tuple[float, float]]:
    """Return intervals of spacings, each of a fifth at most: 0 for single edges is one of its own."""
    groups: list[tuple[float, float]] = []
    for each in np.unique(spacing_px):
        value = float(each)
        if groups and groups[-1][0] > 0 and value <= 1.2 * groups[-1][0]:
            groups[-1] = (groups[-1][0], value)
        else:
            groups.append((value, value))
    return groups


def _why(fit: BoardPose, found: int) -> str:
    if int(fit.status) & Status.OUT_OF_RANGE:
        return "what was found agrees on a pose further away than was looked; say nearer where it is, or within more"
    if not int(fit.status) & Status.AMBIGUOUS:
        return f"{found} edges (a mark for two) were found, too few for a pose ({_flags(fit.status)})"
    if np.isfinite(fit.agreement) and float(fit.agreement) < _LEAST_SHARE:
        return (
            f"{int(fit.inliers)} of the {found} edges found (a mark for two) agree on a pose, with "
            f"{float(fit.agreement):.0%} of what they say of it, expected {_LEAST_SHARE:.0%} or more"
        )
    if np.isfinite(fit.leverage) and float(fit.leverage) > 0.0:
        return "a part of the pose hangs on a single edge, which no other one checks; look at more edges"
    return "the edges found do not fix x, y and theta (all parallel, or all through one point)"


def _refused(rulers: Rulers, marks: FoundMarks, reason: str) -> Solution:
    nothing = np.full((3, 3), np.nan)
    return Solution(nothing[0], nothing, math.nan, math.nan, math.nan, rulers, marks, reason)


def _count(*which: npt.NDArray[np.bool_]) -> int:
    return int(sum(each.sum() for each in which))


def _about(pose: Float64, point: Float64) -> Float64:
    """Return a pose of places about a point as one of places about the origin."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
    return np.array([*(pose[:2] + point - turned), pose[2]])


def moved(view: BoardView, pose: npt.ArrayLike) -> BoardView:
    """Return where the camera is, over a board that is seen moved by a pose of its artwork: q = R p + t."""
    x, y, theta = (float(each) for each in np.asarray(pose, np.float64))
    c, s = math.cos(theta), math.sin(theta)
    off = np.array(view.pose[:2]) - (x, y)
    turned = math.remainder(view.pose[2] - theta, 2 * math.pi)
    return replace(view, pose=(float(c * off[0] + s * off[1]), float(-s * off[0] + c * off[1]), turned))


def _flags(status: Any) -> str:
    return str(Status(int(status)).name or "OK")


def features_in_view(artwork: Artwork, view: BoardView, imaging: Imaging, budget: float = 60) -> FeatureSet:
    """Choose rulers and marks that lie in an image wherever the board is within ``imaging.shift``.

    Of a view with thousands of places only five windows of it are looked at for rulers, its corners and its middle.
    Marks come beside the budget.

    Raises
    ------
    ValueError
        There are not enough edges, or they do not fix the pose.
    """
    low, high = view.bounds
    edges = artwork.edges
    middle = (edges.start + edges.end) / 2
    inside = np.all((middle >= low) & (middle <= high), axis=1)
    expected = 1.5 * float(np.sum(edges.length[inside])) / (imaging.width_px * imaging.pixel)
    windows = [np.stack([low, high])]
    if expected > _USUAL_CANDIDATES:
        size = (high - low) * math.sqrt(_USUAL_CANDIDATES / expected / 5)
        shares = ((0, 0), (0, 1), (1, 0), (1, 1), (0.5, 0.5))
        starts = [low + np.array(share) * (high - low - size) for share in shares]
        windows = [np.stack([start, start + size]) for start in starts]
    placement = np.array(view.pose[:2])
    parts = [candidates(artwork, window, placement, imaging) for window in windows]
    joined = [np.concatenate(each) for each in zip(*(part[:-1] for part in parts), strict=True)]
    rulers = Candidates._make([*joined, placement])
    margin = (rulers.length / 2 + imaging.shift) / imaging.pixel + imaging.width_px
    fits = view.contains(rulers.point, margin) & (rulers.length < (LONGEST - 2) * imaging.pixel)
    rulers = Candidates._make([*(each[fits] for each in rulers[:-1]), placement])
    marks = marks_of(artwork, view.bounds, placement, imaging, _MOST_MARKS)
    reach = marks.radius + reach_of(marks.point, placement, imaging)
    marks = marks.only(view.contains(marks.point, reach / imaging.pixel))
    if len(rulers.sigma) + len(marks.sigma) < 3:
        raise ValueError(
            f"{len(rulers.sigma)} edges of the {artwork.side} artwork in view stand free enough for a ruler, and "
            f"{len(marks.sigma)} round marks, expected 3 or more; is the board there (near), is the scale right, is "
            "the blur less?"
        )
    return chosen_of(rulers, imaging, artwork.side, marks=marks, are_free=True, budget=budget)
