"""Coarse registration: find known edges in an image from a large initial error, by hypothesis and verification.

1. Score all shifts and headings of a grid on the device (`gpuvision.matching.pose.edge_search`).
2. Place calipers (rulers) over the best candidates; a robust pose from their edges refines each candidate.
3. Verify: count the rulers that find an edge where the candidate has one.
4. Measure the best candidate again along shorter rulers, and compare it with the runner-up.

The known edges are edges of a board or of another image (`gpuvision.matching.pose.registration`).

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.3.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.edge_search import (
    CellMeans,
    EdgeCostMap,
    EdgeSearch,
    cell_offsets,
    find_best_shifts,
)
from gpuvision.matching.pose.motion import (
    KnownEdges,
    apply_homography,
    compose,
    decompose,
    move_edges,
    project_edges,
    rotation,
)
from gpuvision.matching.pose.pose import BoardPose, SolvePose, Transform, line_rows
from gpuvision.matching.pose.registration_errors import FittedEdges, registration_errors
from gpuvision.matching.pose.registration_result import (
    NOT_FOUND,
    Registration,
    RegistrationLimits,
    ScoredMotion,
)
from gpuvision.status import Status
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]

MAX_RULERS = 1024  # largest number of rows of one `SolvePose`
_VERIFICATION_RULERS = 512  # rulers of each candidate in step 3 (cost)
_REFINEMENT_ROWS = 128  # rulers of each candidate in step 2 (cost)
# Start candidates of a robust pose: of half bad rows all contain an outlier with a probability of 6e-8 (derived).
_TRIALS = {"rigid": 128, "similarity": 256, "affine": 512}
# With the etch bias, one more unknown: probability of 3e-4 (derived), for each of the verified candidates.
_ETCH_TRIALS = {"rigid": 128, "similarity": 256, "affine": 1024}
_SEPARATION = (3, 2)  # distances in cells and headings within which two candidates of the grid count as the same


class _MeasuredRulers(NamedTuple):
    """Rulers of each motion (k, n, 2) in the image, offset of the edge [px] or NaN, and which rulers lie inside."""

    centre: Float64
    direction: Float64
    offset_px: Float64
    inside: npt.NDArray[np.bool_]

    def of(self, chosen: npt.NDArray[np.intp]) -> _MeasuredRulers:
        """Return rulers of each motion by their numbers (k, m)."""
        at = (np.arange(len(chosen))[:, None], chosen)
        return _MeasuredRulers(self.centre[at], self.direction[at], self.offset_px[at], self.inside[at])


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseRegistration:
    """Search for known edges in an image: ``registration(image) -> Registration``.

    The image is uint8, uint16 or float32 of shape (rows, columns).

    Parameters
    ----------
    search : KnownEdges
        Edges of the grid search, 4096 at most, spread evenly over the image and its surroundings.
    rulers : KnownEdges
        Edges on which rulers are placed, 1024 at most. Up to 512 of them, spread evenly, verify each candidate.
    to_image : array_like, (3, 3)
        Homography from the known edges, where they are expected, to pixels of the (undistorted) image.
    placement : (float, float)
        Known point to which the covariance refers; the search range is about it.
    shift, angle : float
        Search range: largest offset of the placement point along x and along y (unit of the known edges, above 0), and
        largest angle [rad], 0 to pi.
    ruler : RulerEdges
        Edge measurement of single edges; this class sets its length.
    transform : {"rigid", "similarity", "affine"}
        Unknowns of the pose. A deformation may be a percent or two.
    tolerance_px : float
        Largest distance of an edge from the pose at which the edge agrees with it [px], above 0 to 64, default 1.
    cell_px : int
        Side of a cell of the grid search [px], default 2: about the width of the finest structure, or less.
    max_candidates : int
        Number of verified candidates, default 48.
    min_score : float
        Least accepted score, above 0 to 1, default 0.4. 1.5 / sqrt(rulers), three standard deviations of a share of one
        half, is added: among few rulers many may agree by chance.
    etch_bias_sigma : float, optional
        Standard deviation of the etch bias (unit of the known edges, above 0): a displacement of all edges along their
        normals becomes one more unknown. The normals of all ``rulers`` must then point to the same side of their edges:
        out of the copper, or from dark to bright. None: edges are where they are known.
    limits : RegistrationLimits
        Thresholds of the other decisions.

    Raises
    ------
    TypeError, ValueError
        A parameter is out of its range or of a wrong type.
    """

    search: KnownEdges
    rulers: KnownEdges
    to_image: npt.ArrayLike
    placement: tuple[float, float]
    shift: float
    angle: float
    ruler: RulerEdges
    transform: Transform = "rigid"
    tolerance_px: float = 1.0
    cell_px: int = 2
    max_candidates: int = 48
    min_score: float = 0.4
    etch_bias_sigma: float | None = None
    limits: RegistrationLimits = RegistrationLimits()

    def __post_init__(self) -> None:
        matrix = np.asarray(self.to_image, np.float64)
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix) < 3:
            raise ValueError("CoarseRegistration.to_image must be 3 x 3, finite and invertible")
        object.__setattr__(self, "to_image", matrix)
        object.__setattr__(self, "placement", numbers(self.placement, (2,), "CoarseRegistration.placement"))
        for name, max_count in (("search", 4096), ("rulers", MAX_RULERS)):
            object.__setattr__(self, name, _checked_edges(getattr(self, name), name, max_count))
        for name, limit in (("shift", math.inf), ("tolerance_px", 64.0), ("min_score", 1.0)):
            if not 0.0 < finite(getattr(self, name), f"CoarseRegistration.{name}") <= limit:
                raise ValueError(
                    f"CoarseRegistration.{name} is {getattr(self, name)}, expected above 0 and up to {limit}"
                )
        if not 0.0 <= finite(self.angle, "CoarseRegistration.angle") <= math.pi:
            raise ValueError(f"CoarseRegistration.angle is {self.angle}, expected 0 to pi")
        if self.etch_bias_sigma is not None:
            finite(self.etch_bias_sigma, "CoarseRegistration.etch_bias_sigma", above=0.0)
        if not isinstance(self.ruler, RulerEdges) or self.ruler.edge_selection == "all" or self.ruler.pairs:
            raise TypeError("CoarseRegistration.ruler must be a RulerEdges that returns one single edge")
        if not isinstance(self.max_candidates, int) or self.max_candidates < 1:
            raise ValueError(f"CoarseRegistration.max_candidates is {self.max_candidates!r}, expected 1 or more")

    def __call__(self, image: npt.NDArray[Any], *, device: Device | None = None) -> Registration:
        """Search for the edges in an image.

        Parameters
        ----------
        image
            uint8, uint16 or float32 (rows, columns).
        device
            Where to run; None: `Device.best`.

        Raises
        ------
        TypeError, ValueError
            The array is not such an image, or the image is smaller than five cells or than a ruler.
        """
        if min(len(self.rulers.point), len(self.search.point)) < self.limits.min_rulers:
            return NOT_FOUND
        tried = self._verify(image, self._search_grid(image, device), device)
        if not tried:
            return NOT_FOUND
        best = max(tried, key=lambda each: each.score)
        others = self._distinct_from(best, tried)
        if not self._is_accepted(best):
            return self._refuse(Status.LOW_SIGNAL, best, others)
        return self._measure(image, best, others, device)

    # ---- grid search -----------------------------------------------------------------------------------------

    def headings(self) -> Float64:
        """Return the angles of the grid [rad]: one step moves the points by a cell in the median."""
        away = np.linalg.norm(self._to_pixels(self.search.point) - self._to_pixels(np.array(self.placement)), axis=-1)
        step = self.cell_px / max(float(np.median(away)), 4.0 * self.cell_px)
        half = math.ceil(self.angle / step)
        return np.asarray(np.arange(-half, half + 1) * (self.angle / max(half, 1)))

    def positions(self) -> tuple[int, int]:
        """Return the rows and columns of shifts of the grid [cells]."""
        place = np.array(self.placement)
        corners = place + self.shift * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
        reach = np.abs(self._to_pixels(corners) - self._to_pixels(place)).max(axis=0)
        columns, rows = (2 * math.ceil(each / self.cell_px) + 1 for each in reach)
        return rows, columns

    def _search_grid(self, image: npt.NDArray[Any], device: Device | None) -> list[Float64]:
        """Return the motions of the best poses of the grid, best first."""
        headings, positions = self.headings(), self.positions()
        motions = [np.column_stack([rotation(k), self.placement]) for k in headings]
        points, normals = project_edges(self.search, motions, self.placement, np.asarray(self.to_image))
        middle = self._to_pixels(np.array(self.placement))
        turned = 2.0 * math.sin(min(self.angle, math.pi) / 2.0) * np.linalg.norm(points[0] - middle, axis=-1).max()
        border = max(positions) // 2 + 2 + math.ceil(min(turned, max(image.shape)) / self.cell_px)
        means = CellMeans(cell_px=self.cell_px)(image, device=device).means
        level = to_numpy(EdgeCostMap(threshold=self.ruler.threshold, border=border)(means, device=device).level)
        _fill_border(level, border, self.limits.border_cost)
        offsets = cell_offsets(points, normals, self.cell_px, border, level.shape, positions)
        search = EdgeSearch(
            rows=positions[0], columns=positions[1], headings=len(headings), points=len(self.search.point)
        )
        best = find_best_shifts(search(level, offsets, device=device), positions, self.max_candidates, _SEPARATION)
        places = self._from_pixels(middle + self.cell_px * best.cells)
        return [np.column_stack([rotation(headings[k]), at]) for at, k in zip(places, best.heading, strict=True)]

    # ---- rulers ----------------------------------------------------------------------------------------------

    @property
    def _candidate_error_px(self) -> float:
        """Largest distance of an edge from a candidate of the grid [px]: 1.5 cells by shift, 1 cell by turn."""
        return 2.5 * self.cell_px + self.tolerance_px

    def _ruler(self, range_px: float) -> RulerEdges:
        """Return the ruler that finds edges up to a distance from its centre."""
        taps = math.ceil(3.0 * self.ruler.smoothing_px / self.ruler.step_px)
        return replace(self.ruler, length=2 * (taps + 1 + math.ceil(range_px / self.ruler.step_px)) + 1)

    def _measure_rulers(
        self,
        image: npt.NDArray[Any],
        known: KnownEdges,
        motions: list[Float64],
        etch_biases: npt.ArrayLike,
        ruler: RulerEdges,
        device: Device | None,
    ) -> _MeasuredRulers:
        """Measure edges along rulers placed where each motion, with its etch bias, has the known edges."""
        centre, direction = project_edges(known, motions, self.placement, np.asarray(self.to_image))
        centre = centre + direction * (self._etch_px * np.asarray(etch_biases, np.float64))[:, None, None]
        placed = np.concatenate([centre, direction], axis=-1).reshape(-1, 4).astype(np.float32)
        edges = ruler(image, placed, device=device)
        position, amplitude = (to_numpy(each).reshape(centre.shape[:2]) for each in (edges.position, edges.amplitude))
        status = to_numpy(edges.status).reshape(centre.shape[:2])
        # Copper is brighter than laminate everywhere, or darker everywhere: edges of the minority sign are clutter.
        rising = amplitude > 0
        is_bright = 2 * rising.sum(axis=1) > np.isfinite(position).sum(axis=1)
        offset = np.where(rising == is_bright[:, None], position, np.nan)
        return _MeasuredRulers(centre, direction, offset.astype(np.float64), (status & Status.OUT_OF_RANGE) == 0)

    def _pose_rows(
        self, known: KnownEdges, motions: list[Float64], measured: _MeasuredRulers
    ) -> npt.NDArray[np.float32]:
        """Return rows for `SolvePose`, (k, n, 7), relative to where each motion has the placement point.

        The known edges are (n, 2) of all motions, or (k, n, 2) of each one.
        """
        found = self._from_pixels(measured.centre + measured.direction * measured.offset_px[..., None])
        point, normal = move_edges(known, motions, self.placement)
        place = np.stack(motions)[:, None, :, 2]
        sigma = np.full(point.shape[:2], self.tolerance_px / self._pixels_per_unit)
        etch_factor = None if self.etch_bias_sigma is None else np.ones_like(sigma)
        rows = line_rows(normal, point - place, found - place, sigma, etch_factor)
        return rows.reshape(*point.shape[:2], -1).astype(np.float32)

    def _verify(self, image: npt.NDArray[Any], starts: list[Float64], device: Device | None) -> list[ScoredMotion]:
        """Refine each start by the pose that most edges agree with, and score the refined motions."""
        known = self._verification_edges
        range_px = self._candidate_error_px
        measured = self._measure_rulers(image, known, starts, np.zeros(len(starts)), self._ruler(range_px), device)
        chosen = _select_found(measured.offset_px)
        edges = KnownEdges(known.point[chosen], known.normal[chosen])
        rows = self._pose_rows(edges, starts, measured.of(chosen))
        solver = SolvePose(
            loss="ransac",
            tuning_constant=1.0,
            min_inlier_fraction=0.0,
            transform=self.transform,
            etch_bias_sigma=self.etch_bias_sigma,
            max_trials=self._trials,
        )
        fits = solver(rows, device=device)
        pose, deformation = to_numpy(fits.pose), to_numpy(fits.deformation)
        refused = (to_numpy(fits.status) & ~Status.NOT_CONVERGED) != 0
        motions = [
            start if refused[number] else compose(start, pose[number], deformation[number])
            for number, start in enumerate(starts)
        ]
        etch_biases = np.where(refused, 0.0, to_numpy(fits.etch_bias))
        return self._score(image, motions, etch_biases, device)

    @functools.cached_property
    def _verification_edges(self) -> KnownEdges:
        step = -(-len(self.rulers.point) // _VERIFICATION_RULERS)
        return KnownEdges(*(each[::step] for each in self.rulers))

    def _score(
        self, image: npt.NDArray[Any], motions: list[Float64], etch_biases: Float64, device: Device | None
    ) -> list[ScoredMotion]:
        """Score motions by the share of rulers, placed where each motion has the edges, that find an edge there.

        The rulers are placed again: from the start of a refined motion, some edges lie beyond the ends of its rulers.
        """
        known = self._verification_edges
        ruler = self._ruler(self._candidate_error_px)
        measured = self._measure_rulers(image, known, motions, etch_biases, ruler, device)
        agrees = np.abs(measured.offset_px) <= self.tolerance_px
        scored = map(ScoredMotion, motions, etch_biases, measured.inside, agrees)
        return [each for each in scored if each.rulers >= self.limits.min_rulers]

    def _distinct_from(self, best: ScoredMotion, tried: list[ScoredMotion]) -> list[ScoredMotion]:
        """Return the motions whose rulers lie at other places than the rulers of the best motion, best first."""
        limit = (2.0 * self.tolerance_px + 1.0) / self._pixels_per_unit
        change = (np.stack([each.motion for each in tried]) - best.motion)[..., None]
        px, py = (self.rulers.point - self.placement).T
        x, y = (change[:, k, 0] * px + change[:, k, 1] * py + change[:, k, 2] for k in range(2))
        is_other = np.median(np.sqrt(x * x + y * y), axis=1) > limit
        return sorted(itertools.compress(tried, is_other), key=lambda each: -each.score)

    def _measure(
        self, image: npt.NDArray[Any], best: ScoredMotion, others: list[ScoredMotion], device: Device | None
    ) -> Registration:
        """Measure the best pose again, along short rulers placed where it has the edges."""
        ruler = self._ruler(2.0 * self.tolerance_px)
        # Huber's loss is convex: its solution does not depend on the start, so that similar images give similar poses.
        # A wrong edge has a bounded influence, since the rulers are short.
        solver = SolvePose(
            loss="huber",
            scale=1.0,
            transform=self.transform,
            etch_bias_sigma=self.etch_bias_sigma,
            max_trials=self._trials,
        )
        motion, etch_bias = best.motion, best.etch_bias
        for _ in range(self.limits.refinements):
            measured = self._measure_rulers(image, self.rulers, [motion], [etch_bias], ruler, device)
            fit = solver(self._pose_rows(self.rulers, [motion], measured), device=device)
            status = Status(int(to_numpy(fit.status)[0]))
            if status & ~Status.NOT_CONVERGED:
                return self._refuse(status, best, others)
            motion = compose(motion, to_numpy(fit.pose)[0], to_numpy(fit.deformation)[0])
            etch_bias = float(to_numpy(fit.etch_bias)[0])
        scored = self._score(image, [motion], np.array([etch_bias]), device)
        if not scored:
            return self._refuse(Status.NO_DATA, best, others)
        (last,) = scored
        if not self._is_accepted(last):
            return self._refuse(Status.LOW_SIGNAL, last, others)
        close = [other for other in others if not last.is_better_than(other, self.limits)]
        pose, deformation = decompose(motion, self.placement)
        errors = registration_errors(self._fitted_edges(motion, fit), self.transform)
        status |= Status.AMBIGUOUS if close else Status.OK
        return self._refuse(status, last, close or others)._replace(
            pose=pose,
            deformation=deformation if self.transform != "rigid" else np.zeros(3),
            placement=motion[:, 2],
            covariance=errors.covariance,
            etch_bias=etch_bias,
            misfit=errors.misfit,
        )

    def _fitted_edges(self, motion: Float64, fit: BoardPose) -> FittedEdges:
        """Return the edges of the last fit under the motion."""
        place, normal = (each[0] for each in move_edges(self.rulers, [motion], self.placement))
        return FittedEdges(
            known=self.rulers.point - self.placement,
            place=place - motion[:, 2],
            normal=normal,
            residual=to_numpy(fit.residuals)[0].astype(np.float64),
            weight=to_numpy(fit.weights)[0].astype(np.float64),
            rotation=rotation(math.atan2(motion[1, 0], motion[0, 0])),
            etch_bias_sigma=self.etch_bias_sigma or 0.0,
            sigma=self.tolerance_px / self._pixels_per_unit,
        )

    def _refuse(self, status: Status, best: ScoredMotion, others: list[ScoredMotion]) -> Registration:
        """Return the scores without a pose."""
        refused = NOT_FOUND._replace(score=best.score, rulers=best.rulers, status=status)
        if not others:
            return refused
        pose, _ = decompose(others[0].motion, self.placement)
        return refused._replace(runner_up=others[0].score, runner_up_pose=pose)

    def _is_accepted(self, tried: ScoredMotion) -> bool:
        # A share of one half has the standard deviation 0.5 / sqrt(n).
        return tried.score >= self.min_score + 0.5 * self.limits.significance / math.sqrt(tried.rulers)

    @property
    def _trials(self) -> int:
        """Number of start candidates of a robust pose."""
        return (_TRIALS if self.etch_bias_sigma is None else _ETCH_TRIALS)[self.transform]

    @property
    def _etch_px(self) -> float:
        """Displacement of an edge along its direction in the image per etch bias [px per unit]."""
        matrix = np.asarray(self.to_image)
        return math.copysign(self._pixels_per_unit, float(np.linalg.det(matrix)) * matrix[2, 2])

    # ---- coordinates -----------------------------------------------------------------------------------------

    @functools.cached_property
    def _pixels_per_unit(self) -> float:
        """Pixels per unit of length at the placement point: root of the determinant of the derivative."""
        place = np.array(self.placement)
        step = 1e-6 * self.shift
        x, y = (self._to_pixels(place + each) - self._to_pixels(place) for each in np.eye(2) * step)
        return float(np.sqrt(abs(x[0] * y[1] - x[1] * y[0]))) / step

    def _to_pixels(self, points: Float64) -> Float64:
        return apply_homography(np.asarray(self.to_image), points)

    def _from_pixels(self, pixels: Float64) -> Float64:
        return apply_homography(np.linalg.inv(np.asarray(self.to_image)), pixels)


def _checked_edges(edges: KnownEdges, name: str, max_count: int) -> KnownEdges:
    """Return known edges as float64 arrays, or raise an error that states the defect."""
    point, normal = (np.asarray(each, np.float64) for each in edges)
    if point.shape != normal.shape or point.ndim != 2 or point.shape[1] != 2 or len(point) > max_count:
        raise ValueError(f"CoarseRegistration.{name} must have up to {max_count} points (n, 2) and as many normals")
    if not (np.all(np.isfinite(point)) and np.allclose(np.hypot(*normal.T), 1.0)):
        raise ValueError(f"CoarseRegistration.{name} must have finite points and unit normals")
    return KnownEdges(point, normal)


def _fill_border(level: npt.NDArray[np.uint16], border: int, border_cost: float) -> None:
    """Set the cost of edges beyond the image to a share of their mean cost in the image, for each direction.

    At the full cost, poses that keep more edges in the image would win over the right pose; on boards with repeated
    patterns they do so even at the mean cost. Below half the mean cost, poses that keep few edges in the image win.
    """
    inside = level[:, border:-border, border:-border]
    cost = np.rint(border_cost * inside.mean(axis=(1, 2)))[:, None, None]
    level[:, :border] = level[:, -border:] = level[:, :, :border] = level[:, :, -border:] = cost


def _select_found(offset_px: Float64) -> npt.NDArray[np.intp]:
    """Return the numbers of `_REFINEMENT_ROWS` rulers of each start, evenly picked from the rulers with an edge.

    Missing rows would waste start candidates of the robust fit. A start without edges gets a ruler without one.
    """
    is_found = np.isfinite(offset_px)
    found_first = np.argsort(~is_found, axis=1, kind="stable")
    picked = np.arange(_REFINEMENT_ROWS) * np.count_nonzero(is_found, axis=1)[:, None] // _REFINEMENT_ROWS
    return np.take_along_axis(found_first, picked, axis=1)
