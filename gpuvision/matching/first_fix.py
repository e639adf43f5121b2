"""The engine of first fixes: known edges, looked for in a picture from far away. Hypothesise and verify.

All shifts and headings of a grid are scored on the device (`gpuvision.matching.edge_search`); over the best ones rulers
are laid, whose edges make a pose each; the one that most rulers agree with is measured again, along shorter rulers
that lie where the edges are. What is known is a board or another picture (`gpuvision.matching.registration`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.edge_search import (
    CellMeans,
    EdgeLevels,
    SearchEdges,
    best_shifts,
    shifts_of,
)
from gpuvision.matching.pose import BoardPose, Freedom, SolvePose, line_rows
from gpuvision.matching.ruler import RulerEdges
from gpuvision.status import Status
from gpuvision.tables import finite, numbers

Float64 = npt.NDArray[np.float64]
MOST_RULERS = 1024  # rows of one pose
_VERIFYING = 512
_FEWEST = 12  # rulers and edges that a pose is believed from
_TRIALS = {"rigid": 64, "scale": 128, "affine": 256}  # one of them all good, of 30 % bad rows: all but 1e-11
_ROUNDS = 3


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
        Share of the rulers in the picture whose edge lies within the tolerance, 0 to 1.
    runner_up
        Score of the best other pose, 0 without one.
    runner_up_pose
        (3,); NaN without one.
    rulers
        How many lay in the picture, of those that verify.
    status
        OK. With a pose: AMBIGUOUS (the runner-up is close). Refused: DARK (nothing fits), HOLE (too few known edges in
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
    """A motion (2, 3), of points relative to the placement point, and what its rulers say."""

    motion: Float64
    score: float
    rulers: int


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstFix:
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
    ambiguity
        Share of the best score from which on another pose's makes it AMBIGUOUS; so does one that is less by 1.5 over
        the root of the rulers' number.

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
    most: int = 24
    least_score: float = 0.4
    ambiguity: float = 0.9

    def __post_init__(self) -> None:
        matrix = np.asarray(self.to_image, np.float64)
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix) < 3:
            raise ValueError("FirstFix.to_image must be 3 x 3, finite and invertible")
        object.__setattr__(self, "to_image", matrix)
        object.__setattr__(self, "placement", numbers(self.placement, (2,), "FirstFix.placement"))
        for name, limit in (("search", 4096), ("rulers", MOST_RULERS)):
            point, normal = (np.asarray(each, np.float64) for each in getattr(self, name))
            if point.shape != normal.shape or point.ndim != 2 or point.shape[1] != 2 or len(point) > limit:
                raise ValueError(f"FirstFix.{name} must have up to {limit} points (n, 2) and as many normals")
            if not (np.all(np.isfinite(point)) and np.allclose(np.hypot(*normal.T), 1.0)):
                raise ValueError(f"FirstFix.{name} must have finite points and unit normals")
            object.__setattr__(self, name, KnownEdges(point, normal))
        for name, most in (("shift", math.inf), ("tolerance_px", 64.0), ("least_score", 1.0), ("ambiguity", 1.0)):
            if not 0.0 < finite(getattr(self, name), f"FirstFix.{name}") <= most:
                raise ValueError(f"FirstFix.{name} is {getattr(self, name)}, expected above 0 and up to {most}")
        if not 0.0 <= finite(self.angle, "FirstFix.angle") <= math.pi:
            raise ValueError(f"FirstFix.angle is {self.angle}, expected 0 to pi")
        if not isinstance(self.ruler, RulerEdges) or self.ruler.choice == "all" or self.ruler.pairs:
            raise TypeError("FirstFix.ruler must be a RulerEdges that chooses one single edge")
        if not isinstance(self.most, int) or self.most < 1:
            raise ValueError(f"FirstFix.most is {self.most!r}, expected 1 or more")

    def __call__(self, image: npt.NDArray[Any], *, device: Device | None = None) -> Registration:
        """Look for the edges in a picture, on a device (None: the best).

        Raises
        ------
        TypeError, ValueError
            The picture is not one, or is smaller than five cells or than a ruler.
        """
        if len(self.rulers.point) < _FEWEST or len(self.search.point) < _FEWEST:
            return _refused(Status.HOLE)
        tried = self._verified(image, self._searched(image, device), device)
        if not tried:
            return _refused(Status.HOLE)
        best, other = self._best_two(tried)
        if not best.score >= self.least_score + _chance(best):
            return _refused(Status.DARK, best, other, self.placement)
        return self._measured(image, best, other, device)

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
        points, normals = (np.stack(each) for each in zip(*map(self._turned, headings), strict=True))
        middle = self._pixels(np.array(self.placement))
        turned = 2.0 * math.sin(min(self.angle, math.pi) / 2.0) * np.linalg.norm(points[0] - middle, axis=-1).max()
        border = max(positions) // 2 + 2 + math.ceil(min(turned, max(image.shape)) / self.cell_px)
        means = CellMeans(cell_px=self.cell_px)(image, device=device).means
        level = EdgeLevels(threshold=self.ruler.threshold, border=border)(means, device=device).level
        shifts = shifts_of(points, normals, self.cell_px, border, level.shape, positions)
        search = SearchEdges(
            rows=positions[0], columns=positions[1], headings=len(headings), points=len(self.search.point)
        )
        rough = best_shifts(search(level, shifts, device=device), positions, self.most, (3, 2))
        places = self._known(middle + self.cell_px * rough.cells)
        return [np.column_stack([_rotation(headings[k]), at]) for at, k in zip(places, rough.heading, strict=True)]

    def _turned(self, heading: float) -> tuple[Float64, Float64]:
        """Points and normals in the picture of the edges to search with, turned about the placement point."""
        return self._seen(self.search, np.column_stack([_rotation(heading), self.placement]))

    # ---- rulers ----------------------------------------------------------------------------------------------

    @property
    def _window(self) -> float:
        """How far an edge is from where the search has it [px]: a cell and a half, its turn another cell."""
        return 2.5 * self.cell_px + self.tolerance_px

    def _ruler(self, window_px: float) -> RulerEdges:
        taps = math.ceil(3.0 * self.ruler.smoothing_px / self.ruler.step_px)
        return replace(self.ruler, length=2 * (taps + 1 + math.ceil(window_px / self.ruler.step_px)) + 1)

    def _laid(
        self,
        image: npt.NDArray[Any],
        known: KnownEdges,
        motions: list[Float64],
        ruler: RulerEdges,
        device: Device | None,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """Rows for `SolvePose` about where each motion has the placement point, and how many rulers see the picture."""
        seen = [self._seen(known, motion) for motion in motions]
        laid = np.concatenate([np.concatenate(each, axis=1) for each in seen]).astype(np.float32)
        edges = ruler(image, laid, device=device)
        parts = (np.split(each, len(motions)) for each in (edges.position, edges.amplitude, edges.status))
        sigma = np.full(len(known.point), self.tolerance_px / self._scale)
        rows, counts = [], []
        for motion, (centre, direction), position, amplitude, status in zip(motions, seen, *parts, strict=True):
            # Copper is brighter than laminate everywhere, or darker: what goes the other way is something else.
            rising = amplitude > 0
            way = np.where(rising == (2 * rising.sum() > np.isfinite(position).sum()), position, np.nan)
            found = self._known(centre + direction * way.astype(np.float64)[:, None])
            point, normal = _moved(known, motion, self.placement)
            rows.append(line_rows(normal, point - motion[:, 2], found - motion[:, 2], sigma))
            counts.append(np.count_nonzero((status & Status.OUT_OF_RANGE) == 0))
        return np.stack(rows).astype(np.float32), np.array(counts)

    def _verified(self, image: npt.NDArray[Any], starts: list[Float64], device: Device | None) -> list[_Tried]:
        """Motions that most edges agree with, one from each start."""
        step = -(-len(self.rulers.point) // _VERIFYING)
        known = KnownEdges(*(each[::step] for each in self.rulers))
        rows, counts = self._laid(image, known, starts, self._ruler(self._window), device)
        solver = SolvePose(
            loss="ransac", bend=1.0, least_agreement=0.0, freedom=self.freedom, trials=_TRIALS[self.freedom]
        )
        fits = solver(rows, device=device)
        tried = []
        for number in np.flatnonzero(counts >= _FEWEST):
            failed, count = bool(fits.status[number]), int(counts[number])
            motion = starts[number] if failed else _composed(fits, int(number), starts[number])
            tried.append(_Tried(motion, 0.0 if failed else float(fits.inliers[number]) / count, count))
        return tried

    def _best_two(self, tried: list[_Tried]) -> tuple[_Tried, _Tried | None]:
        """Return the best motion, and the best of those that are another one: that put the rulers elsewhere."""
        ordered = sorted(tried, key=lambda each: -each.score)
        best, limit = ordered[0], (2.0 * self.tolerance_px + 1.0) / self._scale
        points = _moved(self.rulers, best.motion, self.placement).point

        def is_other(each: _Tried) -> bool:
            away = np.linalg.norm(_moved(self.rulers, each.motion, self.placement).point - points, axis=-1)
            return bool(np.median(away) > limit)

        return best, next(filter(is_other, ordered[1:]), None)

    def _measured(
        self, image: npt.NDArray[Any], best: _Tried, other: _Tried | None, device: Device | None
    ) -> Registration:
        """Measure the best pose again, a few times, along rulers about where it has the edges."""
        ruler = self._ruler(2.0 * self.tolerance_px)
        # Huber's solution is the only one, whatever it starts from: pictures that differ little give poses that do.
        # What is no edge of the board cannot pull more than the rulers are long.
        solver = SolvePose(loss="huber", scale=1.0, freedom=self.freedom, trials=_TRIALS[self.freedom])
        motion = best.motion
        for _ in range(_ROUNDS):
            rows, _ = self._laid(image, self.rulers, [motion], ruler, device)
            fit = solver(rows, device=device)
            if fit.status[0]:
                return _refused(Status(int(fit.status[0])), best, other, self.placement)
            motion = _composed(fit, 0, motion)
        limit = min(self.ambiguity * best.score, best.score - _chance(best))
        close = other is not None and other.score >= limit
        pose, deformation = _described(motion, self.placement)
        return _refused(Status.AMBIGUOUS if close else Status.OK, best, other, self.placement)._replace(
            pose=pose,
            deformation=deformation if self.freedom != "rigid" else np.zeros(3),
            placement=motion[:, 2],
            covariance=fit.covariance[0].astype(np.float64) * float(fit.spread[0]) ** 2,
        )

    # ---- places ----------------------------------------------------------------------------------------------

    @property
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

    def _seen(self, edges: KnownEdges, motion: Float64) -> tuple[Float64, Float64]:
        """Points and unit normals of edges in the picture: what is along an edge stays along it."""
        point, normal = _moved(edges, motion, self.placement)
        matrix = np.asarray(self.to_image)
        pixels = self._pixels(point)
        weight = point @ matrix[2, :2] + matrix[2, 2]
        along = np.stack([-normal[:, 1], normal[:, 0]], axis=-1)
        way = (along @ matrix[:2, :2].T - pixels * (along @ matrix[2, :2])[:, None]) / weight[:, None]
        across = np.stack([way[:, 1], -way[:, 0]], axis=-1)
        return pixels, across / np.linalg.norm(across, axis=-1, keepdims=True)


def _chance(tried: _Tried) -> float:
    """Return what a score may differ by without a reason: three standard deviations of a share of half."""
    return 1.5 / math.sqrt(tried.rulers)


def through(matrix: Float64, points: Float64) -> Float64:
    """Return where a homography takes points (..., 2)."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


def _rotation(angle: float) -> Float64:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _moved(edges: KnownEdges, motion: Float64, placement: tuple[float, float]) -> KnownEdges:
    """Edges where a motion of points relative to the placement point has them."""
    turn = motion[:, :2]
    normal = edges.normal @ np.linalg.inv(turn)
    return KnownEdges(
        (edges.point - placement) @ turn.T + motion[:, 2], normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    )


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


def _refused(
    status: Status, best: _Tried | None = None, other: _Tried | None = None, placement: tuple[float, float] = (0.0, 0.0)
) -> Registration:
    """Say no pose, and what scores there were."""
    nothing = np.full(3, np.nan)
    return Registration(
        pose=nothing,
        deformation=nothing,
        placement=np.full(2, np.nan),
        covariance=np.full((3, 3), np.nan),
        score=0.0 if best is None else best.score,
        runner_up=0.0 if other is None else other.score,
        runner_up_pose=nothing if other is None else _described(other.motion, placement)[0],
        rulers=0 if best is None else best.rulers,
        status=status,
    )
