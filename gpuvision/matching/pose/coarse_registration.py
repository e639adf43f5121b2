"""The engine of first fixes: known edges, looked for in a picture from far away. Hypothesise and verify.

All shifts and headings of a grid are scored on the device (`gpuvision.matching.pose.edge_search`); over the best ones
rulers are laid, whose edges make a pose each; the one that most rulers agree with is measured again, along shorter
rulers that lie where the edges are. What is known is a board or another picture
(`gpuvision.matching.pose.registration`).
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.edge_search import (
    CellMeans,
    EdgeLevels,
    SearchEdges,
    best_shifts,
    shifts_of,
)
from gpuvision.matching.pose.pose import BoardPose, Freedom, SolvePose, line_rows
from gpuvision.status import Status
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]
MOST_RULERS = 1024  # rows of one pose
_VERIFYING = 512
_FEWEST = 12  # rulers and edges that a pose is believed from
_SOLVED = 128  # of the edges that were found about a start
_TRIALS = {"rigid": 128, "scale": 256, "affine": 512}  # one of them all good, of half bad rows: all but 6e-8
_ROUNDS = 3
_CLEAR = 2.0
_BEYOND = 0.7


class Registration(NamedTuple):
    """A pose and how sure it is; lengths in the unit of the known edges (metres of a board, pixels of a picture).

    Attributes
    ----------
    pose
        (3,) x, y, theta [rad]: a known point p is seen at R(theta) (I + D) p + (x, y); NaN where refused, and so are
        the next three.
    deformation
        (3,): scales along the known axes less 1, and shear, I + D = ((1 + kx, shear), (0, 1 + ky)); 0 where the freedom
        is rigid.
    placement
        (2,) where the placement point is seen.
    covariance
        (f, f) of the placement point's x, y, of theta, and of the deformation that is free, from the scatter of the
        edges themselves.
    score
        Share of the rulers in the picture whose edge lies within the tolerance of this pose, 0 to 1. Refused, of the
        best one.
    runner_up
        Score of the best other pose; where AMBIGUOUS, of those that edges do not tell from this one. 0 without one.
    runner_up_pose
        (3,); NaN without one.
    rulers
        How many lay in the picture, of those that verify.
    status
        OK. With a pose: AMBIGUOUS (of the rulers that agree with only one of the two, too few more do with this one
        than with the runner-up). Refused: LOW_SIGNAL (nothing fits), NO_DATA (too few known edges in
        the picture), AMBIGUOUS with NaN (the edges that were found leave a part of the pose open).
    """

    pose: Float64
    deformation: Float64
    placement: Float64
    covariance: Float64
    score: float
    runner_up: float
    runner_up_pose: Float64
    rulers: int
    status: Status


class KnownEdges(NamedTuple):
    """Edges that a picture should show: (n, 2) points and their unit normals, either way."""

    point: Float64
    normal: Float64


class _Tried(NamedTuple):
    """A motion (2, 3), of points relative to the placement point; which rulers lie in the picture, and which agree."""

    motion: Float64
    inside: npt.NDArray[np.bool_]
    agrees: npt.NDArray[np.bool_]

    @property
    def rulers(self) -> int:
        return int(np.count_nonzero(self.inside))

    @property
    def score(self) -> float:
        return float(np.count_nonzero(self.agrees)) / self.rulers

    def is_clear_of(self, other: _Tried) -> bool:
        """Whether the rulers that tell two motions apart, in the picture for both, speak for this one.

        Of two right ones as many agree with the one as with the other. What is gone of one place is there at another
        one by chance only: three standard deviations of their difference, and twice as many; or twice the share, where
        the picture has few rulers for both.
        """
        if self.score >= _CLEAR * other.score:
            return True
        both = self.inside & other.inside
        own = np.count_nonzero(both & self.agrees & ~other.agrees)
        its = np.count_nonzero(both & other.agrees & ~self.agrees)
        return bool(own >= max(_CLEAR * its, its + 3.0 * math.sqrt(own + its), 1.0))


class _Ruled(NamedTuple):
    """Rulers for each motion, (k, n, 2) in the picture; how far away the edge is [px], or NaN; which are inside."""

    centre: Float64
    direction: Float64
    away: Float64
    inside: npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseRegistration:
    """Look for known edges: ``fix(image) -> Registration``, of uint8, uint16 or float32 (rows, columns).

    Parameters
    ----------
    search
        Edges that are searched with, 4096 at most: spread evenly, in or near the picture.
    rulers
        Edges that rulers are laid over, 1024 at most; up to 512 of them, spread evenly, for each pose that is verified.
    to_image
        3 x 3, where known points are expected, in pixels of the (undistorted) picture.
    placement
        Known point that the covariance holds for; about it the shift and the turn are looked for.
    shift, angle
        How far it may be off, along x and along y, and the angle [rad].
    ruler
        How edges are found; its length is set here.
    freedom
        ``"rigid"``, ``"scale"`` or ``"affine"``: what rulers measure; it may differ by a percent or two.
    tolerance_px
        How far an edge may lie from where the pose has it and still agree.
    cell_px
        Cells of the search: about as wide as what is thinnest, or less.
    most
        Poses that are verified.
    least_score
        A pose that a smaller share of the rulers agrees with is refused; 1.5 over the root of the rulers' number comes
        on top: of few many may agree by chance.

    Raises
    ------
    TypeError, ValueError
        A parameter is not what was expected.
    """

    search: KnownEdges
    rulers: KnownEdges
    to_image: npt.ArrayLike
    placement: tuple[float, float]
    shift: float
    angle: float
    ruler: RulerEdges
    freedom: Freedom = "rigid"
    tolerance_px: float = 1.0
    cell_px: int = 2
    most: int = 48
    least_score: float = 0.4

    def __post_init__(self) -> None:
        matrix = np.asarray(self.to_image, np.float64)
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix) < 3:
            raise ValueError("CoarseRegistration.to_image must be 3 x 3, finite and invertible")
        object.__setattr__(self, "to_image", matrix)
        object.__setattr__(self, "placement", numbers(self.placement, (2,), "CoarseRegistration.placement"))
        for name, limit in (("search", 4096), ("rulers", MOST_RULERS)):
            point, normal = (np.asarray(each, np.float64) for each in getattr(self, name))
            if point.shape != normal.shape or point.ndim != 2 or point.shape[1] != 2 or len(point) > limit:
                raise ValueError(f"CoarseRegistration.{name} must have up to {limit} points (n, 2) and as many normals")
            if not (np.all(np.isfinite(point)) and np.allclose(np.hypot(*normal.T), 1.0)):
                raise ValueError(f"CoarseRegistration.{name} must have finite points and unit normals")
            object.__setattr__(self, name, KnownEdges(point, normal))
        for name, most in (("shift", math.inf), ("tolerance_px", 64.0), ("least_score", 1.0)):
            if not 0.0 < finite(getattr(self, name), f"CoarseRegistration.{name}") <= most:
                raise ValueError(
                    f"CoarseRegistration.{name} is {getattr(self, name)}, expected above 0 and up to {most}"
                )
        if not 0.0 <= finite(self.angle, "CoarseRegistration.angle") <= math.pi:
            raise ValueError(f"CoarseRegistration.angle is {self.angle}, expected 0 to pi")
        if not isinstance(self.ruler, RulerEdges) or self.ruler.choice == "all" or self.ruler.pairs:
            raise TypeError("CoarseRegistration.ruler must be a RulerEdges that chooses one single edge")
        if not isinstance(self.most, int) or self.most < 1:
            raise ValueError(f"CoarseRegistration.most is {self.most!r}, expected 1 or more")

    def __call__(self, image: npt.NDArray[Any], *, device: Device | None = None) -> Registration:
        """Look for the edges in a picture, on a device (None: the best).

        Raises
        ------
        TypeError, ValueError
            The picture is not one, or is smaller than five cells or than a ruler.
        """
        if len(self.rulers.point) < _FEWEST or len(self.search.point) < _FEWEST:
            return _NOTHING
        tried = self._verified(image, self._searched(image, device), device)
        if not tried:
            return _NOTHING
        best = max(tried, key=lambda each: each.score)
        others = self._others(best, tried)
        if not self._is_enough(best):
            return self._refused(Status.LOW_SIGNAL, best, others)
        return self._measured(image, best, others, device)

    # ---- the search ------------------------------------------------------------------------------------------

    def headings(self) -> Float64:
        """Return the turns that are looked at [rad]: so far apart that half the points move by a cell or less."""
        away = np.linalg.norm(self._pixels(self.search.point) - self._pixels(np.array(self.placement)), axis=-1)
        step = self.cell_px / max(float(np.median(away)), 4.0 * self.cell_px)
        half = math.ceil(self.angle / step)
        return np.asarray(np.arange(-half, half + 1) * (self.angle / max(half, 1)))

    def positions(self) -> tuple[int, int]:
        """Return rows and columns of shifts that are looked at."""
        place = np.array(self.placement)
        corners = place + self.shift * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
        reach = np.abs(self._pixels(corners) - self._pixels(place)).max(axis=0)
        columns, rows = (2 * math.ceil(each / self.cell_px) + 1 for each in reach)
        return rows, columns

    def _searched(self, image: npt.NDArray[Any], device: Device | None) -> list[Float64]:
        """Motions that are worth rulers, best first."""
        headings, positions = self.headings(), self.positions()
        points, normals = self._seen(self.search, [np.column_stack([_rotation(k), self.placement]) for k in headings])
        middle = self._pixels(np.array(self.placement))
        turned = 2.0 * math.sin(min(self.angle, math.pi) / 2.0) * np.linalg.norm(points[0] - middle, axis=-1).max()
        border = max(positions) // 2 + 2 + math.ceil(min(turned, max(image.shape)) / self.cell_px)
        means = CellMeans(cell_px=self.cell_px)(image, device=device).means
        level = EdgeLevels(threshold=self.ruler.threshold, border=border)(means, device=device).level
        _blank_border(level, border)
        shifts = shifts_of(points, normals, self.cell_px, border, level.shape, positions)
        search = SearchEdges(
            rows=positions[0], columns=positions[1], headings=len(headings), points=len(self.search.point)
        )
        rough = best_shifts(search(level, shifts, device=device), positions, self.most, (3, 2))
        places = self._known(middle + self.cell_px * rough.cells)
        return [np.column_stack([_rotation(headings[k]), at]) for at, k in zip(places, rough.heading, strict=True)]

    # ---- rulers ----------------------------------------------------------------------------------------------

    @property
    def _window(self) -> float:
        """How far an edge is from where the search has it [px]: a cell and a half, its turn another cell."""
        return 2.5 * self.cell_px + self.tolerance_px

    def _ruler(self, window_px: float) -> RulerEdges:
        taps = math.ceil(3.0 * self.ruler.smoothing_px / self.ruler.step_px)
        return replace(self.ruler, length=2 * (taps + 1 + math.ceil(window_px / self.ruler.step_px)) + 1)

    def _ruled(
        self,
        image: npt.NDArray[Any],
        known: KnownEdges,
        motions: list[Float64],
        ruler: RulerEdges,
        device: Device | None,
    ) -> _Ruled:
        """Edges along rulers about where each motion has the known ones."""
        centre, direction = self._seen(known, motions)
        laid = np.concatenate([centre, direction], axis=-1).reshape(-1, 4).astype(np.float32)
        edges = ruler(image, laid, device=device)
        position, amplitude, status = (
            each.reshape(centre.shape[:2]) for each in (edges.position, edges.amplitude, edges.status)
        )
        # Copper is brighter than laminate everywhere, or darker: what goes the other way is something else.
        rising = amplitude > 0
        is_bright = 2 * rising.sum(axis=1) > np.isfinite(position).sum(axis=1)
        away = np.where(rising == is_bright[:, None], position, np.nan)
        return _Ruled(centre, direction, away.astype(np.float64), (status & Status.OUT_OF_RANGE) == 0)

    def _rows(self, known: KnownEdges, motions: list[Float64], ruled: _Ruled) -> npt.NDArray[np.float32]:
        """Rows for `SolvePose`, (k, n, 7), about where each motion has the placement point."""
        found = self._known(ruled.centre + ruled.direction * ruled.away[..., None])
        point, normal = _moved(known, motions, self.placement)
        place = np.stack(motions)[:, None, :, 2]
        sigma = np.full(point.shape[:2], self.tolerance_px / self._scale)
        rows = line_rows(normal, point - place, found - place, sigma)
        return rows.reshape(*point.shape[:2], -1).astype(np.float32)

    def _verified(self, image: npt.NDArray[Any], starts: list[Float64], device: Device | None) -> list[_Tried]:
        """Motions that most edges agree with, one from each start."""
        known = self._verifying
        ruled = self._ruled(image, known, starts, self._ruler(self._window), device)
        rows = np.stack([_found(each) for each in self._rows(known, starts, ruled)])
        solver = SolvePose(
            loss="ransac", bend=1.0, least_agreement=0.0, freedom=self.freedom, trials=_TRIALS[self.freedom]
        )
        fits = solver(rows, device=device)
        return self._judged(
            image,
            [start if fits.status[at] else _composed(fits, at, start) for at, start in enumerate(starts)],
            device,
        )

    @functools.cached_property
    def _verifying(self) -> KnownEdges:
        step = -(-len(self.rulers.point) // _VERIFYING)
        return KnownEdges(*(each[::step] for each in self.rulers))

    def _judged(self, image: npt.NDArray[Any], motions: list[Float64], device: Device | None) -> list[_Tried]:
        """Motions with the share of the rulers, laid where each has the edges, that find one there.

        The start of a motion does not count: from there some edges lie beyond the rulers' ends, however good it was.
        """
        ruled = self._ruled(image, self._verifying, motions, self._ruler(self._window), device)
        tried = map(_Tried, motions, ruled.inside, np.abs(ruled.away) <= self.tolerance_px)
        return [each for each in tried if each.rulers >= _FEWEST]

    def _others(self, best: _Tried, tried: list[_Tried]) -> list[_Tried]:
        """Those that put the rulers elsewhere than the best one does, best first."""
        limit = (2.0 * self.tolerance_px + 1.0) / self._scale
        change = np.stack([each.motion for each in tried]) - best.motion
        points = (self.rulers.point - self.placement) @ change[..., :2].swapaxes(1, 2) + change[:, None, :, 2]
        is_other = np.median(np.hypot(points[..., 0], points[..., 1]), axis=1) > limit
        return sorted(itertools.compress(tried, is_other), key=lambda each: -each.score)

    def _measured(
        self, image: npt.NDArray[Any], best: _Tried, others: list[_Tried], device: Device | None
    ) -> Registration:
        """Measure the best pose again, a few times, along rulers about where it has the edges."""
        ruler = self._ruler(2.0 * self.tolerance_px)
        # Huber's solution is the only one, whatever it starts from: pictures that differ little give poses that do.
        # What is no edge of the board cannot pull more than the rulers are long.
        solver = SolvePose(loss="huber", scale=1.0, freedom=self.freedom, trials=_TRIALS[self.freedom])
        motion = best.motion
        for _ in range(_ROUNDS):
            ruled = self._ruled(image, self.rulers, [motion], ruler, device)
            fit = solver(self._rows(self.rulers, [motion], ruled), device=device)
            if fit.status[0]:
                return self._refused(Status(int(fit.status[0])), best, others)
            motion = _composed(fit, 0, motion)
        judged = self._judged(image, [motion], device)
        if not judged:
            return self._refused(Status.NO_DATA, best, others)
        (last,) = judged
        if not self._is_enough(last):
            return self._refused(Status.LOW_SIGNAL, last, others)
        close = [other for other in others if not last.is_clear_of(other)]
        pose, deformation = _described(motion, self.placement)
        return self._refused(Status.AMBIGUOUS if close else Status.OK, last, close or others)._replace(
            pose=pose,
            deformation=deformation if self.freedom != "rigid" else np.zeros(3),
            placement=motion[:, 2],
            covariance=fit.covariance[0].astype(np.float64) * float(fit.spread[0]) ** 2,
        )

    def _refused(self, status: Status, best: _Tried, others: list[_Tried]) -> Registration:
        """Say no pose, and what scores there were."""
        said = _NOTHING._replace(score=best.score, rulers=best.rulers, status=status)
        if not others:
            return said
        pose, _ = _described(others[0].motion, self.placement)
        return said._replace(runner_up=others[0].score, runner_up_pose=pose)

    def _is_enough(self, tried: _Tried) -> bool:
        return tried.score >= self.least_score + _chance(tried)

    # ---- places ----------------------------------------------------------------------------------------------

    @functools.cached_property
    def _scale(self) -> float:
        """Pixels of a unit, at the placement point."""
        place = np.array(self.placement)
        step = 1e-6 * self.shift
        x, y = (self._pixels(place + each) - self._pixels(place) for each in np.eye(2) * step)
        return float(np.sqrt(abs(x[0] * y[1] - x[1] * y[0]))) / step

    def _pixels(self, points: Float64) -> Float64:
        return through(np.asarray(self.to_image), points)

    def _known(self, pixels: Float64) -> Float64:
        return through(np.linalg.inv(np.asarray(self.to_image)), pixels)

    def _seen(self, edges: KnownEdges, motions: list[Float64]) -> tuple[Float64, Float64]:
        """Points and unit normals in the picture, (k, n, 2) each, of edges where each motion has them.

        What is along an edge stays along it: the way along is taken to the picture, as the map is about the point.
        """
        moved = np.zeros((len(motions), 3, 3))
        moved[:, :2], moved[:, 2, 2] = motions, 1.0
        matrix = (np.asarray(self.to_image) @ moved).swapaxes(1, 2)
        lifted = (edges.point - self.placement) @ matrix[:, :2] + matrix[:, 2:]
        x, y = edges.normal.T
        along = np.stack([-y, x], axis=-1) @ matrix[:, :2]
        pixels = lifted[..., :2] / lifted[..., 2:]
        way = (along[..., :2] - pixels * along[..., 2:]) / lifted[..., 2:]
        way /= np.hypot(way[..., 0], way[..., 1])[..., None]
        return pixels, np.stack([way[..., 1], -way[..., 0]], axis=-1)


def _blank_border(level: npt.NDArray[np.uint16], border: int) -> None:
    """Let edges beyond the picture cost somewhat less than they do on average in it.

    If they cost all, poses that keep more of the edges in the picture would do better than right ones; on boards that
    repeat themselves they still do at the average's cost, and if they cost less than half, those that keep few.
    """
    inside = (slice(None), slice(border, -border), slice(border, -border))
    own = level[inside].copy()
    level[:] = np.rint(_BEYOND * own.mean(axis=(1, 2)))[:, None, None]
    level[inside] = own


def _chance(tried: _Tried) -> float:
    """Return what a score may differ by without a reason: three standard deviations of a share of half."""
    return 1.5 / math.sqrt(tried.rulers)


def through(matrix: Float64, points: Float64) -> Float64:
    """Return where a homography takes points (..., 2)."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


def _rotation(angle: float) -> Float64:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _moved(edges: KnownEdges, motions: list[Float64], placement: tuple[float, float]) -> KnownEdges:
    """Edges, (k, n, 2), where each motion of points relative to the placement point has them."""
    motion = np.stack(motions)
    turn = motion[..., :2]
    normal = edges.normal @ np.linalg.inv(turn)
    point = (edges.point - placement) @ turn.swapaxes(1, 2) + motion[:, None, :, 2]
    return KnownEdges(point, normal / np.hypot(normal[..., 0], normal[..., 1])[..., None])


def _found(rows: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Pick as many rows for each start, evenly, of those with an edge: a trial of a missing one is none."""
    there = np.flatnonzero(np.all(np.isfinite(rows), axis=1))
    if not len(there):
        return np.full((_SOLVED, rows.shape[1]), np.nan, np.float32)
    return rows[there[np.arange(_SOLVED) * len(there) // _SOLVED]]


def _composed(fits: BoardPose, index: int, motion: Float64) -> Float64:
    """After a motion another one, which was measured about where the placement point is."""
    x, y, theta = np.asarray(fits.pose[index], np.float64)
    kx, ky, shear = np.asarray(fits.deformation[index], np.float64)
    turn = _rotation(theta) @ np.array([[1.0 + kx, shear], [0.0, 1.0 + ky]])
    return np.column_stack([turn @ motion[:, :2], motion[:, 2] + (x, y)])


def _described(motion: Float64, placement: tuple[float, float]) -> tuple[Float64, Float64]:
    """Pose of the origin, and deformation."""
    turn = motion[:, :2]
    theta = math.atan2(turn[1, 0], turn[0, 0])
    bent = _rotation(theta).T @ turn
    return np.array([*(motion[:, 2] - turn @ placement), theta]), np.array([bent[0, 0] - 1, bent[1, 1] - 1, bent[0, 1]])


_NOTHING = Registration(
    pose=np.full(3, np.nan),
    deformation=np.full(3, np.nan),
    placement=np.full(2, np.nan),
    covariance=np.full((3, 3), np.nan),
    score=0.0,
    runner_up=0.0,
    runner_up_pose=np.full(3, np.nan),
    rulers=0,
    status=Status.NO_DATA,
)
