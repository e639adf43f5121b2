"""Planning of the localization of a board: try feature sets on an image, and choose the fastest accurate one.

The error of the pose comes from its covariance and from repeated noise, the time from the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, check_time, fastest_within, time_limit
from gpuvision.accuracy.trial import median_times
from gpuvision.camera.camera import Camera
from gpuvision.camera.image import grey_image
from gpuvision.camera.lens import Lens
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork, Side
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.measurement_result import Copper
from gpuvision.matching.board.view_features import find_features_in_view
from gpuvision.matching.features.candidates import FeatureCandidates
from gpuvision.matching.features.feature_set import FeatureSet, select_feature_set
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.pose.bound_features import BoundFeatures
from gpuvision.matching.pose.feature_pose import FeaturePose
from gpuvision.status import Status
from gpuvision.validation import finite
from gpuvision.workflows.locating_board import locate_board
from gpuvision.workflows.location_plan import FeaturesTrial, LocationPlan, LocationPlanLimits, usable_feature_sets

Float64 = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]

# Settings to try: numbers of rulers a factor of 2 apart (the time changes by 1.2), widths [px] and smoothings over blur
# few, because each is a build of the kernel. The smoothing is the best for isolated edges, or that for dense edges.
_BUDGETS = (15, 30, 60, 120, 240, 480)
_BEST, _DENSE = math.sqrt(5.0), 1.0
_RULERS = ((3, _BEST), (5, _BEST), (9, _BEST), (5, _DENSE))
_ROUNDS = 15  # of the timing, of which the median counts
# Standard deviation of errors that all rulers share, such as errors by neighbouring edges [px]. Measured: the
# unexplained part of the true errors in `gpuvision.profiling.location_plans` is up to 0.006 px.
_COMMON_PX = 0.005
_UNKNOWNS = 4  # x, y, theta and the etch bias
_CHANCE = 2.0  # standard deviations of a residual scale that is significantly above 1. Chosen
_MAX_SHIFT = 4.0  # standard deviations between the pose of a feature set and the located one. Chosen


def plan_location(
    image: npt.NDArray[Any],
    artwork: Artwork,
    *,
    scale: float,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    initial_pose: tuple[float, float, float] | None = None,
    search_range: tuple[float, float] | None = None,
    model: Lens | Camera | None = None,
    blur_px: float = 1.0,
    etch_bias_sigma: float = 10e-6,
    threshold: float | None = None,
    noise: float | None = None,
    copper: Copper = "auto",
    device: Device | None = None,
    limits: LocationPlanLimits = LocationPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> LocationPlan:
    """Choose the fastest features of a board whose predicted error of the pose meets a tolerance.

    Numbers, widths and smoothings of calipers (rulers) are tried, with all fiducials in view and without fiducials. A
    ruler is as long as the search range and its smoothing require.

    Parameters
    ----------
    image
        Image of the board, as in `locate_board`.
    artwork
        Artwork of the side that faces the camera.
    scale
        Size of a pixel on the board [m].
    tolerance
        Largest error of the pose [m], above 0: distance by which it moves the features of the board in view, root mean
        square over the features and over images.
    rate
        Frame rate that a loop over `FeatureSet.bind` must keep up with [frames/s]. Default: any.
    latency
        Longest acceptable time from a frame to its pose [s]; needs a rate.
    initial_pose, search_range, model, blur_px, etch_bias_sigma, threshold, noise, copper
        As in `locate_board`. The features have the search range that remains after a coarse registration.
    device
        Default `Device.best`.
    limits
        Margins of the choice.
    progress
        Called with the number of tried feature sets and the number of all.

    Returns
    -------
    LocationPlan

    Raises
    ------
    PlanError
        No feature set meets the tolerance, or none of them keeps up with the rate.
    ValueError
        The tolerance is not above 0, a latency has no rate, or the board is not located in the image.

    Notes
    -----
    The prediction is the covariance of the pose: noise of the pixels at the heights of the edges in the image, bilinear
    sampling, and the etch bias. Residuals that are significantly larger raise it. Images with additional noise of the
    same standard deviation, measured from expected poses anywhere in the search range, test it: a larger scatter takes
    its place. An error of 0.005 px along x and along y, which all rulers share, is added. A feature set is not used if
    one of these images has no pose, if its pose differs from the located one by more than 4 standard deviations, or if
    it depends on a single feature (``LocationPlanLimits.max_leverage``). Not covered: a wrong scale, a wrong lens
    model, and boards that differ from the artwork.
    """
    finite(tolerance, "tolerance", above=0.0)
    time_limit(rate, latency, limits.rate_margin, LocationPlan.unit)  # refuses wrong values before the work
    device = Device.best() if device is None else device
    grey = grey_image(image)
    located = locate_board(
        grey,
        artwork,
        scale=scale,
        initial_pose=initial_pose,
        search_range=search_range,
        model=model,
        blur_px=blur_px,
        etch_bias_sigma=etch_bias_sigma,
        threshold=threshold,
        noise=noise,
        copper=copper,
        device=device,
    )
    if located.reason:
        raise ValueError(f"no pose to plan from: {located.reason}")
    tests = _Tests.of(grey, artwork, located, blur_px, etch_bias_sigma, device, limits.draws)
    trials = _try_features(tests, artwork, progress)
    return choose_features(located, trials, tolerance=tolerance, rate=rate, latency=latency, limits=limits)


def choose_features(
    located: LocatedBoard,
    trials: Sequence[FeaturesTrial],
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    limits: LocationPlanLimits = LocationPlanLimits(),
) -> LocationPlan:
    """Choose the fastest of the feature sets that a plan tried for another tolerance, rate or latency.

    Parameters
    ----------
    located, trials
        `LocationPlan.located` and `LocationPlan.trials`.
    tolerance
        Largest error of the pose [m], above 0.
    rate, latency, limits
        As in `plan_location`.

    Raises
    ------
    PlanError, ValueError
        As `plan_location`.
    """
    finite(tolerance, "tolerance", above=0.0)
    limit = time_limit(rate, latency, limits.rate_margin, LocationPlan.unit)
    usable = usable_feature_sets(trials, limits)
    if not usable:
        message = "each feature set has no pose in some images with additional noise, or depends on a single feature"
        raise PlanError(message, trials, usable)
    chosen = fastest_within(trials, usable, tolerance, limits.margin, LocationPlan.kind)
    check_time(chosen, trials, usable, limit, limits.margin, LocationPlan.kind)
    return LocationPlan(chosen=chosen, trials=tuple(trials), tolerance=tolerance, located=located, limits=limits)


@dataclass(frozen=True, kw_only=True)
class _Tests:
    """Images that each feature set measures, and the points at which errors of its poses count.

    Attributes
    ----------
    images : numpy.ndarray
        (draws + 1, rows, columns): the image, and images with additional noise.
    expected : numpy.ndarray
        (draws + 1, 3) expected poses [m], [rad]: the pose of the image, and poses within the search range about it.
    located : LocatedBoard
        Pose of the image.
    points : numpy.ndarray
        (n, 2) features of the board in view, relative to the image centre [m].
    blur_px, etch_bias_sigma, device
        As in `plan_location`.
    """

    images: npt.NDArray[Any]
    expected: Float64
    located: LocatedBoard
    points: Float64
    blur_px: float
    etch_bias_sigma: float
    device: Device

    @classmethod
    def of(
        cls,
        grey: npt.NDArray[Any],
        artwork: Artwork,
        located: LocatedBoard,
        blur_px: float,
        etch_bias_sigma: float,
        device: Device,
        draws: int,
    ) -> _Tests:
        imaging = located.features.imaging
        rulers, fiducials = find_features_in_view(artwork, located.view, imaging, np.array(located.view.pose[:2]))
        rng = np.random.default_rng(1)
        away = rng.uniform(-1.0, 1.0, (draws, 3)) * (imaging.shift, imaging.shift, imaging.angle)
        return cls(
            images=np.concatenate([grey[None], _with_noise(grey, located.noise, draws, rng)]),
            expected=located.view.pose + np.concatenate([np.zeros((1, 3)), away]),
            located=located,
            points=np.concatenate([rulers.point, fiducials.point]) - located.view.pose[:2],
            blur_px=blur_px,
            etch_bias_sigma=etch_bias_sigma,
            device=device,
        )

    def bind(self, features: FeatureSet) -> BoundFeatures:
        """Bind features to the image."""
        located, (_, rows, columns) = self.located, self.images.shape
        return features.bind(
            self.device,
            (rows, columns),
            self.images.dtype,
            copper="bright" if located.copper == "bright" else "dark",
            threshold=located.threshold,
            noise=located.noise,
            pixel_size=located.view.scale,
            blur_px=self.blur_px,
            etch_bias_sigma=self.etch_bias_sigma,
            model=located.view.model,
        )

    def measure(self, features: FeatureSet, bound: BoundFeatures) -> FeaturesTrial:
        """Return the errors of a feature set, without its time."""
        poses, leverage = np.full((len(self.images), 3), np.nan), 0.0
        covariance = np.full((3, 3), np.nan)
        for number, (image, expected) in enumerate(zip(self.images, self.expected, strict=True)):
            found = bound(image, expected)
            if int(to_numpy(found.status)) == Status.OK:
                poses[number] = to_numpy(found.pose)
                leverage = max(leverage, float(to_numpy(found.leverage)))
                if not number:
                    covariance = _covariance(found)
        predicted = pose_error(covariance, self.points)
        if self._is_elsewhere(poses[0], predicted):
            predicted = math.nan
        known = poses[1:][np.isfinite(poses[1:, 0])]
        scatter = pose_error(np.cov(known.T), self.points) if len(known) > 1 else math.nan
        common = math.sqrt(2.0) * _COMMON_PX * self.located.view.scale  # along x and along y
        error = math.hypot(np.fmax(predicted, scatter), common) if math.isfinite(predicted) else math.nan
        refused = 1.0 - len(known) / (len(poses) - 1)
        return FeaturesTrial(features, math.nan, error, predicted, scatter, leverage, refused)

    def _is_elsewhere(self, pose: Float64, predicted: float) -> bool:
        """Return whether a pose differs from the located one by more than both errors allow."""
        away = pose - self.located.view.pose
        away[2] = math.remainder(away[2], 2.0 * math.pi) if math.isfinite(away[2]) else math.nan
        distance = pose_error(np.outer(away, away), self.points)
        return distance > _MAX_SHIFT * math.hypot(predicted, pose_error(self.located.covariance, self.points))


def pose_error(covariance: Float64, points: Float64) -> float:
    """Return the root mean square distance by which errors of a pose move points [m].

    Parameters
    ----------
    covariance : (3, 3)
        Covariance of x, y [m] at the image centre and theta [rad]: of errors about 0.
    points : (n, 2)
        Points relative to the image centre [m].
    """
    x, y = points.mean(axis=0)
    # A turn t about the image centre moves a point at (x, y) by t (-y, x).
    turned = 2.0 * (x * covariance[1, 2] - y * covariance[0, 2]) + covariance[2, 2] * float(np.mean(points**2)) * 2.0
    return math.sqrt(covariance[0, 0] + covariance[1, 1] + turned)


def _covariance(found: FeaturePose) -> Float64:
    """Return the covariance of a pose; a residual scale that few features may have by chance does not raise it."""
    scale, degrees = float(to_numpy(found.residual_scale)), int(to_numpy(found.inliers)) - _UNKNOWNS
    # The residual scale has a standard deviation of 1 / sqrt(2 degrees).
    by_chance = 1.0 + _CHANCE / math.sqrt(2.0 * max(degrees, 1))
    factor = max(scale, 1.0) if scale <= by_chance else 1.0
    return np.asarray(to_numpy(found.covariance), np.float64) / factor**2


def _with_noise(grey: npt.NDArray[Any], noise: float, draws: int, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return images (draws, rows, columns) with additional noise, of the dtype of the image."""
    noisy = grey + rng.normal(0.0, noise, (draws, *grey.shape))
    if grey.dtype.kind == "f":
        return noisy.astype(grey.dtype)
    return np.clip(np.rint(noisy), 0, np.iinfo(grey.dtype).max).astype(grey.dtype)


def _try_features(tests: _Tests, artwork: Artwork, progress: Progress) -> tuple[FeaturesTrial, ...]:
    """Return the feature sets with their errors and times on the image, fastest first."""
    feature_sets = list(_feature_sets(artwork, tests.located))
    trials, calls = [], []
    for number, features in enumerate(feature_sets):
        bound = tests.bind(features)
        trials.append(tests.measure(features, bound))
        calls.append(_call(bound, tests))
        progress(number + 1, len(feature_sets))
    timed = [each._replace(seconds=one) for each, one in zip(trials, median_times(calls, _ROUNDS), strict=True)]
    return tuple(sorted(timed, key=lambda each: each.seconds))


def _call(bound: BoundFeatures, tests: _Tests) -> Callable[[], object]:
    return lambda: bound(tests.images[0], tests.expected[0])


def _feature_sets(artwork: Artwork, located: LocatedBoard) -> Iterator[FeatureSet]:
    """Yield the feature sets to try, for the search range of the located one: with and without fiducials."""
    for width, ratio in _RULERS:
        imaging = replace(located.features.imaging, width_px=width, smoothing_ratio=ratio)
        rulers, fiducials = find_features_in_view(artwork, located.view, imaging, np.array(located.view.pose[:2]))
        for each in (fiducials, Fiducials.empty())[: 2 if len(fiducials.radius) else 1]:
            yield from _selected(rulers, each, imaging, artwork.side)


def _selected(rulers: FeatureCandidates, fiducials: Fiducials, imaging: Imaging, side: Side) -> Iterator[FeatureSet]:
    """Yield selections of different sizes, ascending."""
    count = -1
    for budget in _BUDGETS:
        try:
            chosen = select_feature_set(rulers, imaging, side, fiducials=fiducials, are_free=True, budget=budget)
        except ValueError:  # they do not determine the pose
            continue
        if len(chosen.length) > count:
            yield chosen
        count = len(chosen.length)
