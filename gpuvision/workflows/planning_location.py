"""Planning of the localization of a board: try feature sets on an image, and choose the fastest accurate one.

The error of the pose comes from repeated noise and from unexplained residuals, the time from the device.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, check_time, fastest_within, time_limit
from gpuvision.accuracy.trial import loop_times
from gpuvision.camera.camera import Camera
from gpuvision.camera.image import PixelNoise, estimate_noise_model, grey_image
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
_ROUNDS = 31  # of the timing, of which median and upper quartile count
# Standard deviation of errors that all rulers share, such as errors by neighbouring edges [px]. Measured: the part of
# the true errors of `gpuvision.profiling.location_plans` beyond the scatter is up to 0.003 px in both directions
# together, where the poses are most accurate (jobs 0 to 8 of seed 11).
_COMMON_PX = 0.002
_UNKNOWNS = 4  # x, y, theta and the etch bias
_CHANCE = 2.0  # standard deviations of unexplained residuals that are significant. Chosen
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
    The prediction is the scatter of the poses in images with additional noise about the poses in the image, measured
    from expected poses anywhere in the search range. The noise is that of the image and depends on the grey level
    (`gpuvision.camera.image.estimate_noise_model`), unless ``noise`` is given. Residuals of the image that are
    significantly larger than the noise explains raise the prediction, as far as they move the pose. An error of 0.002
    px along x and along y, which all rulers share, is added. A feature set is not used if too many of these images have
    no pose (``LocationPlanLimits.max_refused``), if its pose differs from the located one by more than 4 standard
    deviations, or if it depends on a single feature (``LocationPlanLimits.max_leverage``). Not covered: a wrong scale,
    a wrong lens model, and boards that differ from the artwork.

    The time is measured with another image in each call, as from a camera: it includes loading the frame into the
    caches. Memory: 128 copies of the image. A rate must be kept by the upper quartile of the times.
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
    level_noise = estimate_noise_model(grey) if noise is None else PixelNoise(noise, 0.0)
    noisy = _with_noise(grey, level_noise, limits.draws)
    tests = _Tests.of(grey, noisy, artwork, located, blur_px, etch_bias_sigma, device)
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
        message = (
            "no feature set is usable: each has no pose in too many images with additional noise, depends on a single "
            "feature, or differs from the pose of the whole board; show more of the board, or give a sharper image"
        )
        raise PlanError(message, trials, usable)
    # The order by median times can be another than that by the times that must keep the limit.
    in_time = [each for each in usable if limit is not None and each.slow_seconds <= limit.seconds]
    meets = any(limits.margin * each.error <= tolerance for each in in_time)
    chosen = fastest_within(trials, in_time if meets else usable, tolerance, limits.margin, LocationPlan.kind)
    check_time(chosen, trials, usable, limit, limits.margin, LocationPlan.kind, lambda each: each.slow_seconds)
    return LocationPlan(chosen=chosen, trials=tuple(trials), tolerance=tolerance, located=located, limits=limits)


class _Measured(NamedTuple):
    """Poses of a feature set in images.

    Attributes
    ----------
    poses : (n, 3)
        x, y [m], theta [rad]; NaN without a pose.
    scales : (n,)
        Residual scales; NaN without a pose.
    leverage : float
        Largest leverage.
    covariance : (3, 3)
        Covariance of the first pose for a residual scale of 1; NaN without a pose.
    degrees : int
        Degrees of freedom of the residuals of the first pose.
    """

    poses: Float64
    scales: Float64
    leverage: float
    covariance: Float64
    degrees: int


@dataclass(frozen=True, kw_only=True)
class _Tests:
    """Images that each feature set measures, and the points at which errors of its poses count.

    Attributes
    ----------
    image : numpy.ndarray
        (rows, columns) image of the board.
    noisy : numpy.ndarray
        (draws, rows, columns) images with additional noise.
    expected : numpy.ndarray
        (draws, 3) expected poses [m], [rad]: the pose of the image, and poses within the search range about it.
    located : LocatedBoard
        Pose of the image.
    points : numpy.ndarray
        (n, 2) features of the board in view, relative to the image centre [m].
    blur_px, etch_bias_sigma, device
        As in `plan_location`.
    """

    image: npt.NDArray[Any]
    noisy: npt.NDArray[Any]
    expected: Float64
    located: LocatedBoard
    points: Float64
    blur_px: float
    etch_bias_sigma: float
    device: Device

    @classmethod
    def of(
        cls,
        image: npt.NDArray[Any],
        noisy: npt.NDArray[Any],
        artwork: Artwork,
        located: LocatedBoard,
        blur_px: float,
        etch_bias_sigma: float,
        device: Device,
    ) -> _Tests:
        imaging = located.features.imaging
        rulers, fiducials = find_features_in_view(artwork, located.view, imaging, np.array(located.view.pose[:2]))
        rng = np.random.default_rng(1)
        away = rng.uniform(-1.0, 1.0, (len(noisy) - 1, 3)) * (imaging.shift, imaging.shift, imaging.angle)
        return cls(
            image=image,
            noisy=noisy,
            expected=located.view.pose + np.concatenate([np.zeros((1, 3)), away]),
            located=located,
            points=np.concatenate([rulers.point, fiducials.point]) - located.view.pose[:2],
            blur_px=blur_px,
            etch_bias_sigma=etch_bias_sigma,
            device=device,
        )

    def bind(self, features: FeatureSet) -> BoundFeatures:
        """Bind features to the image."""
        located, (rows, columns) = self.located, self.image.shape
        return features.bind(
            self.device,
            (rows, columns),
            self.image.dtype,
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
        own = self._measured(bound, [self.image] * len(self.expected))
        noisy = self._measured(bound, self.noisy)
        # At the same expected pose, so that only the additional noise differs: rulers elsewhere sample other pixels.
        away = noisy.poses - own.poses
        away = away[np.isfinite(away[:, 0])]
        away[:, 2] = np.remainder(away[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        scatter = pose_error(np.cov(away.T), self.points) if len(away) > 1 else math.nan
        unexplained = pose_error(own.covariance, self.points) * unexplained_scale(own.scales, noisy.scales, own.degrees)
        common = math.sqrt(2.0) * _COMMON_PX * self.located.view.scale  # along x and along y
        error = math.hypot(scatter, unexplained, common)
        return FeaturesTrial(
            features=features,
            seconds=math.nan,
            slow_seconds=math.nan,
            error=math.nan if self._is_elsewhere(own.poses[0], error) else error,
            scatter=scatter,
            unexplained=unexplained,
            leverage=max(own.leverage, noisy.leverage),
            refused=float(np.mean(np.isnan(noisy.poses[:, 0]))),
        )

    def _measured(self, bound: BoundFeatures, images: Iterable[npt.NDArray[Any]]) -> _Measured:
        """Return the poses of images, each from the expected pose of its number."""
        poses, scales = np.full((len(self.expected), 3), np.nan), np.full(len(self.expected), np.nan)
        leverage, covariance, degrees = 0.0, np.full((3, 3), np.nan), 0
        for number, (image, expected) in enumerate(zip(images, self.expected, strict=True)):
            found = bound(image, expected)
            if int(to_numpy(found.status)) in (Status.OK, Status.NOT_CONVERGED):  # as `locate_board` accepts poses
                poses[number] = to_numpy(found.pose)
                scales[number] = float(to_numpy(found.residual_scale))
                leverage = max(leverage, float(to_numpy(found.leverage)))
                if not number:
                    covariance, degrees = _covariance(found), int(to_numpy(found.inliers)) - _UNKNOWNS
        return _Measured(poses, scales, leverage, covariance, degrees)

    def _is_elsewhere(self, pose: Float64, error: float) -> bool:
        """Return whether a pose differs from the located one by more than both errors allow."""
        away = pose - self.located.view.pose
        away[2] = math.remainder(away[2], 2.0 * math.pi) if math.isfinite(away[2]) else math.nan
        distance = pose_error(np.outer(away, away), self.points)
        return distance > _MAX_SHIFT * math.hypot(error, pose_error(self.located.covariance, self.points))


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


def unexplained_scale(scales: Float64, noisy_scales: Float64, degrees: int) -> float:
    """Return the residual scale of an image that its noise does not explain; 0 if it may be chance.

    Parameters
    ----------
    scales, noisy_scales : (n,)
        Residual scales of the image, and of images with as much additional noise; NaN where unknown.
    degrees : int
        Degrees of freedom of the residuals.

    Notes
    -----
    Additional noise raises the square of the scale by the part that noise explains. By chance, the square of an image
    without other residuals differs from this part by sqrt(2 / degrees) of it (standard deviation).
    """
    known = np.isfinite(scales) & np.isfinite(noisy_scales)
    if degrees < 1 or not np.any(known):
        return 0.0
    square = float(np.mean(scales[known] ** 2))
    explained = float(np.mean(noisy_scales[known] ** 2)) - square
    rest = square - explained
    return math.sqrt(rest) if rest > _CHANCE * explained * math.sqrt(2.0 / degrees) else 0.0


def _covariance(found: FeaturePose) -> Float64:
    """Return the covariance of a pose for a residual scale of 1."""
    scale = float(to_numpy(found.residual_scale))
    return np.asarray(to_numpy(found.covariance) / np.fmax(scale, 1.0) ** 2, np.float64)


def _with_noise(grey: npt.NDArray[Any], noise: PixelNoise, draws: int) -> npt.NDArray[Any]:
    """Return images (draws, rows, columns) with additional noise, of the dtype of the image."""
    rng, sigma = np.random.default_rng(2), noise.sigma(grey)
    images = np.empty((draws, *grey.shape), grey.dtype)
    for each in images:
        noisy = grey + sigma * rng.standard_normal(grey.shape, np.float32)
        each[...] = noisy if grey.dtype.kind == "f" else np.clip(np.rint(noisy), 0, np.iinfo(grey.dtype).max)
    return images


def _try_features(tests: _Tests, artwork: Artwork, progress: Progress) -> tuple[FeaturesTrial, ...]:
    """Return the feature sets with their errors and times on the image, fastest first."""
    feature_sets = list(_feature_sets(artwork, tests.located))
    trials, calls = [], []
    images = itertools.cycle(tests.noisy)  # of all calls in turn: a frame of a camera is in no cache
    for number, features in enumerate(feature_sets):
        bound = tests.bind(features)
        trials.append(tests.measure(features, bound))
        calls.append(_call(bound, images, tests.expected[0]))
        progress(number + 1, len(feature_sets))
    times = loop_times(calls, _ROUNDS)
    timed = [
        each._replace(seconds=time.median, slow_seconds=time.upper) for each, time in zip(trials, times, strict=True)
    ]
    return tuple(sorted(timed, key=lambda each: each.seconds))


def _call(bound: BoundFeatures, images: Iterator[npt.NDArray[Any]], pose: Float64) -> Callable[[], object]:
    return lambda: bound(next(images), pose)


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
