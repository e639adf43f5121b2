"""Calipers (rulers) and fiducials in an image of a board, and the pose that they determine.

A measurement has two passes: the first one looks where the board is expected, the second one, with shorter rulers,
where the first one found the board.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 6.3 and 8.6.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device, to_numpy
from gpuvision.matching.board.fiducial_detection import FoundFiducials, find_fiducials
from gpuvision.matching.board.measurement_result import (
    BoardMeasurement,
    Copper,
    MeasurementLimits,
    PoseSolution,
    RulerMeasurements,
    ScaleError,
    count_true,
    refuse_measurement,
)
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.fiducials import search_distance
from gpuvision.matching.features.ruler import MAX_LENGTH, RulerEdges
from gpuvision.matching.pose.pose import BoardPose, SolvePose, Transform, line_rows
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

_MAX_SEARCH_PX = 190.0  # largest search range of fiducials: their rulers fit into `MAX_LENGTH` samples
_SPACING_GROUP = 1.2  # largest by smallest spacing of a group of rulers (chosen: launches against room for edges)
# Start candidates of the robust pose: with 50 % outliers all four rows of a candidate are good often enough, so that
# all candidates contain an outlier on 7 of 1e8 boards (derived).
_TRIALS = 256
_NOT_CONVERGED = "the fit of the pose ended more than a tenth of its standard deviation from the best pose"


class BoardMeasurer:
    """Measurement of the rulers and fiducials of a feature set in one image.

    Parameters
    ----------
    grey
        Image (rows, columns), uint8, uint16 or float32.
    features
        Rulers and fiducials, with their expected search range.
    noise, threshold
        Standard deviation of a pixel, and least height of an edge [grey levels].
    blur_px
        Standard deviation of the edges' blur [px].
    etch_bias_sigma
        Standard deviation of the etch bias [m].
    device
        Where to run.
    limits
        Thresholds.
    """

    def __init__(
        self,
        grey: npt.NDArray[Any],
        features: FeatureSet,
        noise: float,
        threshold: float,
        blur_px: float,
        etch_bias_sigma: float,
        device: Device,
        limits: MeasurementLimits = MeasurementLimits(),
    ) -> None:
        self.grey, self.features, self.noise, self.threshold = grey, features, noise, threshold
        self.blur_px, self.etch_bias_sigma, self.device, self.limits = blur_px, etch_bias_sigma, device, limits

    def measure(self, view: BoardView, copper: Copper) -> BoardMeasurement:
        """Measure the features where a view expects the board, and again where the board was found.

        Parameters
        ----------
        view
            Expected pose of the camera over the board.
        copper
            "bright" or "dark", relative to the surroundings of the copper.
        """
        reach = np.minimum(self.features.length / view.scale, MAX_LENGTH)
        imaging, limits = self.features.imaging, self.limits
        search_range = (limits.range_factor * imaging.shift, limits.range_factor * max(imaging.angle, limits.min_angle))
        first = self._measure_once(view, copper, reach, search_range)
        if first.reason:
            return BoardMeasurement(view, view, self._test_scale(first, view.scale))
        second_view = move_view(view, first.pose)
        second = self._measure_once(second_view, copper, np.minimum(reach, self._second_length_px(view.scale)))
        second = self._test_scale(second, view.scale)
        return BoardMeasurement(
            second_view if second.reason else move_view(second_view, second.pose), second_view, second
        )

    @property
    def _smoothing_px(self) -> float:
        """Smoothing of the rulers [px]: that for which the features were selected, at this blur."""
        return self.features.imaging.smoothing_ratio * self.blur_px

    def _second_length_px(self, scale: float) -> Float64:
        """(n,) lengths of the rulers of the second pass [px]."""
        taps = 3 * self._smoothing_px
        return 2 * (self.limits.second_range_px + taps) + 3 + self.features.spacing / scale

    def _measure_once(
        self, view: BoardView, copper: Copper, length_px: Float64, search_range: tuple[float, float] | None = None
    ) -> PoseSolution:
        """Measure all features at one view and solve the pose; the search range [m], [rad] applies to a first pass."""
        rulers = self._measure_rulers(view, copper, length_px)
        fiducials = self._find_fiducials(view, copper, is_first=search_range is not None)
        features = "rulers and fiducials" if len(fiducials.in_image) else "rulers"
        in_image, found = count_true(rulers.in_image, fiducials.in_image), count_true(rulers.found, fiducials.found)
        least = self.limits.min_count
        if in_image < least:
            count = len(rulers.in_image) + len(fiducials.in_image)
            reason = f"{in_image} of {count} {features} lie in the image, expected {least} or more"
            return refuse_measurement(rulers, fiducials, reason)
        if found < least:
            return refuse_measurement(
                rulers,
                fiducials,
                f"{found} of {in_image} {features} found an edge of {self.threshold:.3g} grey levels or more, expected "
                f"{least}; is this the right side of the right board, near the initial pose, at this scale?",
            )
        solution = self._solve(rulers, fiducials, view.scale, search_range)
        if not solution.reason or not fiducials.found.any():
            return solution
        # A fiducial may have more information than all other features together. Where the pose is refused, solve again
        # with the sigmas of the fiducials raised to the median, so that a wrong fiducial is an outlier.
        sigmas = np.concatenate([rulers.sigma, *fiducials.axes[0].T])
        limited = fiducials.with_min_sigma(float(np.nanmedian(sigmas)))
        again = self._solve(rulers, limited, view.scale, search_range)
        return solution if again.reason else again

    def _find_fiducials(self, view: BoardView, copper: Copper, *, is_first: bool) -> FoundFiducials:
        """Find the fiducials within the search range of the first or of the second pass."""
        features = self.features
        distance = search_distance(features.fiducials.point, features.placement, features.imaging).max(initial=0.0)
        reach = distance / view.scale + (3 * self.etch_bias_sigma / view.scale + self.limits.fiducial_slack_px)
        return find_fiducials(
            self.grey,
            features.fiducials,
            view,
            is_bright=copper == "bright",
            search_px=float(min(reach, _MAX_SEARCH_PX if is_first else self.limits.second_range_px)),
            threshold=self.threshold,
            noise=self.noise,
            blur_px=self.blur_px,
            etch_bias_sigma=self.etch_bias_sigma,
            device=self.device,
        )

    def _measure_rulers(self, view: BoardView, copper: Copper, length_px: Float64) -> RulerMeasurements:
        """Measure edges along all rulers: single edges in one launch, traces in one launch for each range of widths."""
        features = self.features
        matrix = view.matrix
        direction = features.normal @ matrix[:2, :2].T * view.scale
        placed = np.concatenate([view.to_pixels(features.point), direction], axis=1).astype(np.float32)
        count = len(placed)
        position, sigma = np.full(count, np.nan), np.full(count, np.nan)
        status = np.zeros(count, np.uint8)
        spacing_px = features.spacing / view.scale
        smoothing = self._smoothing_px
        # All rulers have the same length, a multiple of 16: every further length would need another build of the
        # kernel.
        longest = max(float(length_px.max(initial=0.0)), 2 * math.ceil(3 * smoothing) + 3)
        length = min(16 * math.ceil(longest / 16), MAX_LENGTH)
        for low, high in _group_spacings(spacing_px):
            group = np.flatnonzero((spacing_px >= low) & (spacing_px <= high))
            is_pair = low > 0
            edges = RulerEdges(
                threshold=self.threshold,
                length=length,
                width=features.imaging.width_px,
                smoothing_px=smoothing,
                polarity="rising" if (copper == "bright") == is_pair else "falling",
                pairs=is_pair,
                spacing_px=(max(0.6 * low - 2, 1.0), 1.4 * high + 2) if is_pair else None,
                noise=self.noise,
                model=view.model,
            )(self.grey, np.ascontiguousarray(placed[group]), device=self.device)
            position[group], sigma[group] = to_numpy(edges.position), to_numpy(edges.sigma)
            status[group] = to_numpy(edges.status)
        sigma = np.hypot(sigma, self.limits.sampling_sigma_px) * view.scale
        zeros, missing = np.zeros(count), np.full(count, np.nan)
        return RulerMeasurements(features.point, features.normal, length_px, position, sigma, zeros, missing, status)

    def _solve(
        self,
        rulers: RulerMeasurements,
        fiducials: FoundFiducials,
        scale: float,
        search_range: tuple[float, float] | None,
    ) -> PoseSolution:
        """Solve the pose, and the etch bias where single edges were measured."""
        has_etch_bias = self._has_etch_bias(rulers)
        fit = self._fit(rulers, fiducials, scale, search_range, "rigid")
        count = len(rulers.sigma)
        weights, residuals = (np.asarray(to_numpy(each), np.float64) for each in (fit.weights, fit.residuals))
        rulers = rulers._replace(weight=np.nan_to_num(weights[:count]), residual=residuals[:count])
        fiducials = fiducials.with_pose(weights[count:], residuals[count:])
        status = Status(int(to_numpy(fit.status)))
        if status & ~Status.NOT_CONVERGED:
            found = count_true(rulers.found, fiducials.found, fiducials.found)
            return refuse_measurement(rulers, fiducials, _reason_of(fit, found, self.limits))
        residual_scale = float(to_numpy(fit.residual_scale))
        if residual_scale == 0.0:
            reason = (
                "all edges agree exactly, so that the covariance of the pose is unknown; is the image without noise?"
            )
            return refuse_measurement(rulers, fiducials, reason)
        solution = PoseSolution(
            pose=_about_origin(np.asarray(to_numpy(fit.pose), np.float64), self.features.placement),
            covariance=_covariance_of(fit),
            etch_bias=float(to_numpy(fit.etch_bias)) if has_etch_bias else math.nan,
            residual_scale=residual_scale,
            condition=float(to_numpy(fit.condition)),
            rulers=rulers,
            fiducials=fiducials,
            reason="",
            warnings=(_NOT_CONVERGED,) if status else (),
        )
        return self._check(solution, scale)

    def _has_etch_bias(self, rulers: RulerMeasurements) -> bool:
        return bool(((self.features.spacing == 0) & rulers.found).any()) and self.etch_bias_sigma > 0

    def _fit(
        self,
        rulers: RulerMeasurements,
        fiducials: FoundFiducials,
        scale: float,
        search_range: tuple[float, float] | None,
        transform: Transform,
    ) -> BoardPose:
        """Return the robust pose of the features, about the placement point."""
        placement = self.features.placement
        has_etch_bias = self._has_etch_bias(rulers)
        measured = rulers.point + rulers.normal * (rulers.position_px * scale)[:, None]
        etch_factor = np.where(self.features.spacing == 0, 1.0, 0.0)
        edges = line_rows(rulers.normal, rulers.point - placement, measured - placement, rulers.sigma, etch_factor)
        rows = np.concatenate([edges, fiducials.rows(placement)])
        real = np.float64 if self.device.has_double else np.float32
        return SolvePose(
            transform=transform,
            scale=None,
            min_scale=1.0,
            etch_bias_sigma=self.etch_bias_sigma if has_etch_bias else None,
            min_inlier_fraction=self.limits.min_share,
            search_range=search_range,
            max_trials=_TRIALS,
        )(np.ascontiguousarray(rows if has_etch_bias else rows[:, :-1], real), device=self.device)

    def _test_scale(self, solution: PoseSolution, scale: float) -> PoseSolution:
        """Test the given scale: solve again with the scale as one more unknown (nested model).

        A wrong scale moves the pose where the features do not surround the placement point. Where the error of the
        scale is significant, warn, and add that motion to the covariance; refuse where it is also larger than the
        tolerance of boards and moves the pose by more than its standard deviations allow. Where large residuals refuse
        the pose already, name the scale.
        """
        if not np.all(np.isfinite(solution.covariance)):
            return solution
        fit = self._fit(solution.rulers, solution.fiducials, scale, None, "similarity")
        if int(to_numpy(fit.status)) & ~Status.NOT_CONVERGED or float(to_numpy(fit.residual_scale)) == 0.0:
            return solution
        limits = self.limits
        covariance = _covariance_of(fit)
        error = ScaleError(float(to_numpy(fit.deformation)[..., 0]), math.sqrt(covariance[3, 3]))
        solution = solution._replace(scale_error=error)
        if not abs(error.value) > limits.scale_significance * error.sigma:
            return solution
        pose = _about_origin(np.asarray(to_numpy(fit.pose), np.float64), self.features.placement)
        moved = self._placement_motion(pose) - self._placement_motion(solution.pose)
        effect = math.sqrt(float(moved @ np.linalg.solve(solution.covariance, moved)))
        wrong = (
            f"the board is {100 * error.value:+.3f} % (standard deviation {100 * error.sigma:.3f} %) larger in the "
            f"image than in the artwork; is the scale {1e6 * scale / (1 + error.value):.5g} um, not "
            f"{1e6 * scale:.5g} um?"
        )
        is_wrong = abs(error.value) > limits.max_board_scale and effect > limits.max_scale_effect
        if solution.reason or is_wrong:
            before = solution.reason or f"a wrong scale moves the pose by {effect:.1f} standard deviations"
            return solution._replace(reason=f"{before}: {wrong}")
        warnings = (*solution.warnings, wrong)
        return solution._replace(warnings=warnings, covariance=solution.covariance + np.outer(moved, moved))

    def _placement_motion(self, pose: Float64) -> Float64:
        """Return the motion of the placement point x, y [m] and the turn [rad] of a pose."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = self.features.placement
        return np.array([pose[0] + c * x - s * y - x, pose[1] + s * x + c * y - y, pose[2]])

    def _check(self, solution: PoseSolution, scale: float) -> PoseSolution:
        """Refuse a pose with which too few rulers and fiducials agree, or agree too badly."""
        rulers, fiducials, limits = solution.rulers, solution.fiducials, self.limits
        used, in_image = count_true(rulers.used, fiducials.used), count_true(rulers.in_image, fiducials.in_image)
        if used < max(limits.min_count, limits.min_share * in_image):
            features = "rulers and fiducials" if len(fiducials.in_image) else "rulers"
            return solution._replace(
                reason=f"{used} of {in_image} {features} agree, expected {limits.min_share:.0%} or more"
            )
        sigma = float(np.nanmedian(np.concatenate([rulers.sigma, *fiducials.axes[0].T])))
        # Errors explain a reduced chi-square of up to 1 and three of its standard deviations.
        unknowns = 3 + math.isfinite(solution.etch_bias)
        degrees = max(count_true(rulers.used, fiducials.used, fiducials.used) - unknowns, 1)
        explained = 1.0 + 3.0 * math.sqrt(2.0 / degrees)
        unexplained_px = math.sqrt(max(solution.residual_scale**2 - explained, 0.0)) * sigma / scale
        if unexplained_px > limits.max_residual_px:
            reason = (
                f"the edges differ from the best pose by {unexplained_px:.1f} px more than their errors explain; "
                f"expected {limits.max_residual_px} px or less"
            )
            return solution._replace(reason=reason)
        return solution


def _group_spacings(spacing_px: Float64) -> list[tuple[float, float]]:
    """Return intervals of spacings, each up to 20 % wide; 0 (single edges) is an interval for itself."""
    groups: list[tuple[float, float]] = []
    for each in np.unique(spacing_px):
        value = float(each)
        if groups and groups[-1][0] > 0 and value <= _SPACING_GROUP * groups[-1][0]:
            groups[-1] = (groups[-1][0], value)
        else:
            groups.append((value, value))
    return groups


def _reason_of(fit: BoardPose, found: int, limits: MeasurementLimits) -> str:
    """Return why the solver refused a pose."""
    status = Status(int(to_numpy(fit.status)))
    inlier_fraction, leverage = float(to_numpy(fit.inlier_fraction)), float(to_numpy(fit.leverage))
    if status & Status.OUT_OF_RANGE:
        return (
            "the features agree on a pose outside the search range; give a better initial pose or a larger search range"
        )
    if not status & Status.AMBIGUOUS:
        return f"{found} edges (a fiducial counts as two) were found, too few for a pose ({status.name or 'OK'})"
    if math.isfinite(inlier_fraction) and inlier_fraction < limits.min_share:
        return (
            f"{int(to_numpy(fit.inliers))} of the {found} edges found (a fiducial counts as two) agree on a pose, with "
            f"{inlier_fraction:.0%} of their information, expected {limits.min_share:.0%} or more"
        )
    if math.isfinite(leverage) and leverage > 0.0:
        return "a part of the pose depends on a single edge that no other edge checks; use more features"
    return "the edges found do not determine x, y and theta (all parallel, or all through one point)"


def _covariance_of(fit: BoardPose) -> Float64:
    """Return the covariance of a pose; small residuals, which few edges may have by chance, do not reduce it."""
    # fmin: the residual scale is NaN without degrees of freedom, where the covariance follows from the sigmas alone.
    factor = np.fmin(float(to_numpy(fit.residual_scale)), 1.0)
    return np.asarray(np.asarray(to_numpy(fit.covariance), np.float64) / factor**2)


def _about_origin(pose: Float64, point: Float64) -> Float64:
    """Return a pose (3,) that is given for places relative to a point as a pose for places relative to the origin."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
    return np.array([*(pose[:2] + point - turned), pose[2]])


def move_view(view: BoardView, pose: npt.ArrayLike) -> BoardView:
    """Return the view of the camera over a board whose artwork is moved by a pose: q = R p + t."""
    x, y, theta = (float(each) for each in np.asarray(pose, np.float64))
    c, s = math.cos(theta), math.sin(theta)
    offset = np.array(view.pose[:2]) - (x, y)
    turned = math.remainder(view.pose[2] - theta, 2 * math.pi)
    return replace(view, pose=(float(c * offset[0] + s * offset[1]), float(-s * offset[0] + c * offset[1]), turned))
