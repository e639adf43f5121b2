"""Locate a camera over a board: from an image and the board's artwork to a pose with a covariance.

Calipers (rulers) measure edges and blobs give the fiducials; a robust pose is solved from both, and they are measured
again at that pose. Where the board is not known to a few pixels, `gpuvision.matching.pose.registration` finds it first.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 6.3 and 8.6.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.image import estimate_pixel_noise, finite_percentiles, grey_image
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device, StepDevices, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.copper_support import find_other_pose
from gpuvision.matching.board.edge_measurement import BoardMeasurer, move_view
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.measurement_result import BoardMeasurement, Copper
from gpuvision.matching.board.view_features import select_features_in_view
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import best_smoothing
from gpuvision.matching.pose.registration import Registration, prepare_board_registration
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.status import Status

COPPER = ("auto", "bright", "dark")
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class LocalizationLimits:
    """Thresholds of the localization of a board.

    Parameters
    ----------
    known_range
        Default search range [m], [rad] with an initial pose (chosen).
    known_range_px
        The shift as a number of pixels [px]; the larger of the two is used (chosen). Default 4.0.
    unknown_range
        Default search range [m], [rad] without an initial pose (chosen).
    ruler_range
        Largest search range [m], [rad] without a coarse registration: rulers alone find the board within it (chosen).
    ruler_range_px
        The same shift in pixels, where that is more [px]. Default 10.0.
    registered_range
        Search range [m], [rad] after a coarse registration (chosen: several times its error). Default ``(6e-05,
        0.002)``.
    registered_range_px
        The same shift in pixels, where that is more [px]. Default 3.0.
    support_range
        Largest shift of a second pose that is compared with the found one, as a multiple of the search range (chosen:
        rulers accept poses up to twice the search range off; as far on the other side lies the right one). Default 4.0.
    min_preference
        Preference of the image for the found pose over a second one that decides [standard deviations] (3: one error in
        700 for normal errors). Default 3.0.
    max_other_share
        The second best pose of an ambiguous coarse registration is excluded if its number of agreeing rulers and
        fiducials is at most this fraction of the number for the best pose (chosen). Default 0.6.
    """

    known_range: tuple[float, float] = (1e-4, 0.3 * math.pi / 180)
    known_range_px: float = 4.0
    unknown_range: tuple[float, float] = (2e-3, 5 * math.pi / 180)
    ruler_range: tuple[float, float] = (2.5e-4, 1.0 * math.pi / 180)
    ruler_range_px: float = 10.0
    registered_range: tuple[float, float] = (6e-5, 2e-3)
    registered_range_px: float = 3.0
    support_range: float = 4.0
    min_preference: float = 3.0
    max_other_share: float = 0.6


def locate_board(
    image: npt.NDArray[Any],
    artwork: Artwork,
    *,
    scale: float,
    initial_pose: tuple[float, float, float] | None = None,
    search_range: tuple[float, float] | None = None,
    features: FeatureSet | None = None,
    model: Lens | Camera | None = None,
    budget: int = 60,
    blur_px: float = 1.0,
    etch_bias_sigma: float = 10e-6,
    threshold: float | None = None,
    noise: float | None = None,
    copper: Copper = "auto",
    device: Device | None = None,
    limits: LocalizationLimits = LocalizationLimits(),
) -> LocatedBoard:
    """Locate a camera over a board by calipers (rulers) and round fiducials.

    Parameters
    ----------
    image
        Grey or colour (blue, green, red) image, uint8, uint16 or float32; the optical axis is perpendicular to the
        board.
    artwork
        Artwork of the side that faces the camera.
    scale
        Size of a pixel on the board [m].
    initial_pose
        Expected pose: the place on the board at the image centre, x, y [m], and theta [rad], the angle from the
        artwork's x axis to the image's columns, counter-clockwise. None: the centre of the board, theta 0.
    search_range
        Largest offset of the board from the expected pose, along x and along y [m], and largest angle [rad]. None: 0.1
        mm (or 4 pixels) and 0.3 degrees; without ``initial_pose`` 2 mm and 5 degrees; the range of the features where
        they are given. Beyond 0.25 mm (or 10 pixels) or 1 degree a coarse registration is done first.
    features
        Features to measure, with their search range. None: fiducials, and as many rulers as the budget allows, are
        selected now.
    model
        Lens or camera model; None: no distortion.
    budget
        Number of rulers where no features are given, default 60.
    blur_px
        Standard deviation of the edges' blur [px], default 1.
    etch_bias_sigma
        Standard deviation of the etch bias [m], default 10 um.
    threshold
        Least height of an edge [grey levels]; None: 4 times the noise, at least a twentieth of the image's range.
    noise
        Standard deviation of a pixel [grey levels]; None: estimated from the image.
    copper
        Whether copper is "bright" or "dark" relative to its surroundings; "auto": the polarity with more agreeing
        rulers.
    device
        Where to run; None: `Device.best`, and beside a GPU the faster device for each step (`StepDevices`).
    limits
        Thresholds of the decisions.

    Returns
    -------
    LocatedBoard
        Its ``reason`` says why a pose is refused.

    Raises
    ------
    ValueError
        A parameter is out of its range, the image's shape is not accepted, or the view has no features that determine
        the pose.
    TypeError
        The pixels are not uint8, uint16 or float32.
    """
    grey = grey_image(image)
    if copper not in COPPER:
        raise ValueError(f"copper is {copper!r}, expected one of {', '.join(COPPER)}")
    levels = _levels(grey, noise, threshold)
    devices = StepDevices(device, kernel_folders=(KERNEL_FOLDER,))
    job = _Job(grey, artwork, *levels, blur_px, etch_bias_sigma, devices, limits)
    view = _initial_view(initial_pose, artwork, scale, grey.shape, model)
    expected = job.register(view, _search_range(search_range, initial_pose is not None, scale, features, limits))
    return job.locate(expected, job.select_features(expected, budget) if features is None else features, copper)


def _levels(grey: npt.NDArray[Any], noise: float | None, threshold: float | None) -> tuple[float, float]:
    """Return the noise of a pixel and the least height of an edge [grey levels], given or estimated from the image."""
    level = estimate_pixel_noise(grey) if noise is None else noise
    low, high = finite_percentiles(grey, (1.0, 99.0))
    return level, max(4.0 * level, 0.05 * (high - low), 1e-6) if threshold is None else threshold


def _initial_view(
    initial_pose: tuple[float, float, float] | None,
    artwork: Artwork,
    scale: float,
    shape: tuple[int, int],
    model: Lens | Camera | None,
) -> BoardView:
    """Return the camera at the expected pose."""
    x, y = artwork.bounds.mean(axis=0) if initial_pose is None else initial_pose[:2]
    pose = (float(x), float(y), 0.0 if initial_pose is None else float(initial_pose[2]))
    return BoardView(scale=scale, shape=shape, pose=pose, mirrored=artwork.side == "bottom", model=model)


def _search_range(
    search_range: tuple[float, float] | None,
    known: bool,
    scale: float,
    features: FeatureSet | None,
    limits: LocalizationLimits,
) -> tuple[float, float]:
    """Return the search range [m], [rad]: as given, or its default."""
    if search_range is not None:
        if not (0 < search_range[0] < math.inf and 0 <= search_range[1] <= math.pi):
            raise ValueError(f"search_range is {search_range}, expected metres above 0, and an angle of 0 to pi [rad]")
        return search_range
    if not known:
        return limits.unknown_range
    if features is not None:
        return features.imaging.shift, features.imaging.angle
    return max(limits.known_range[0], limits.known_range_px * scale), limits.known_range[1]


class _ExpectedPose(NamedTuple):
    """Expected pose of the camera, remaining search range [m], [rad], and the reason of a refusal.

    ``found`` is the result of the coarse registration, None without one; ``other`` is its runner-up where it is
    ambiguous.
    """

    view: BoardView
    reach: tuple[float, float]
    found: Registration | None = None
    reason: str = ""
    other: BoardView | None = None


class _Clock:
    """Duration of each step [s]."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def record(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step], self._last = now - self._last, now

    def record_apart(self, step: str, seconds: float) -> None:
        """Add a time to a step, and leave it out of the step that is recorded next."""
        self.seconds[step] = self.seconds.get(step, 0.0) + seconds
        self._last += seconds


@dataclass(frozen=True)
class _Job:
    """An image of a board with the parameters of the localization."""

    grey: npt.NDArray[Any]
    artwork: Artwork
    noise: float
    threshold: float
    blur_px: float
    etch_bias_sigma: float
    devices: StepDevices
    limits: LocalizationLimits
    clock: _Clock = field(default_factory=_Clock)

    def register(self, view: BoardView, reach: tuple[float, float]) -> _ExpectedPose:
        """Run the coarse registration where the search range is too large for rulers alone."""
        limits = self.limits
        ruler_shift = max(limits.ruler_range[0], limits.ruler_range_px * view.scale)
        if reach[0] <= ruler_shift and reach[1] <= limits.ruler_range[1]:
            return _ExpectedPose(view, reach)
        search = prepare_board_registration(
            self.artwork,
            view.matrix,
            view.shape,
            shift=reach[0],
            angle=reach[1],
            blur_px=self.blur_px,
            threshold=self.threshold,
        )
        self.clock.record("prepare registration")
        image = self._undistorted(view.model)
        size = (reach[0] / view.scale, reach[1], float(len(search.search.point)), float(len(search.rulers.point)))
        device = self._device_of("registration", lambda device: search(image, device=device), *size)
        found = search(image, device=device)
        self.clock.record("registration")
        shift = max(limits.registered_range[0], limits.registered_range_px * view.scale)
        left = (shift, limits.registered_range[1])
        if not np.all(np.isfinite(found.pose)):
            best = f"the best candidate has {found.score:.0%} of its edges; is the board in view, is the scale right?"
            if not found.rulers:
                best = (
                    "too few straight edges are in view; give an initial pose (fiducials are enough then), or another "
                    "scale"
                )
            reason = f"the coarse registration found no pose of the board: {best}"
            return _ExpectedPose(view, left, found, reason)
        other = move_view(view, found.runner_up_pose) if found.status & Status.AMBIGUOUS else None
        return _ExpectedPose(move_view(view, found.pose), left, found, other=other)

    def _undistorted(self, model: Lens | Camera | None) -> npt.NDArray[Any]:
        """Return the image without the distortion of a lens."""
        if model is None:
            return self.grey
        undistort = UndistortImage(model=model, border="replicate")
        device = self._device_of("undistort", lambda device: undistort(self.grey, device=device), type(model).__name__)
        return np.asarray(to_numpy(undistort(self.grey, device=device).image))

    def _device_of(self, step: str, run: Callable[[Device], object], *size: object) -> Device:
        """Return the device of a step on this image; `size`: what else determines its cost."""
        start = time.perf_counter()
        device = self.devices.choose(step, run, self.grey.shape, self.grey.dtype.str, *size)
        self.clock.record_apart("choose device", time.perf_counter() - start)
        return device

    def select_features(self, expected: _ExpectedPose, budget: int) -> FeatureSet:
        """Select the features of the view at the expected pose."""
        shift, angle = expected.reach
        imaging = Imaging(
            pixel=expected.view.scale,
            blur_px=self.blur_px,
            etch_bias_sigma=self.etch_bias_sigma,
            shift=shift,
            angle=angle,
        )
        features = select_features_in_view(self.artwork, expected.view, imaging, budget)
        self.clock.record("features")
        return features

    def locate(self, expected: _ExpectedPose, features: FeatureSet, copper: Copper) -> LocatedBoard:
        """Measure the features; where it is not known whether copper is bright or dark, try both."""
        kinds: tuple[Copper, ...] = ("bright", "dark") if copper == "auto" else (copper,)

        def measurer_on(device: Device) -> BoardMeasurer:
            return BoardMeasurer(
                self.grey, features, self.noise, self.threshold, self.blur_px, self.etch_bias_sigma, device
            )

        def measure_on(device: Device) -> BoardMeasurement:
            return measurer_on(device).measure(expected.view, kinds[0])

        length, spacing = (float(np.sum(each)) / expected.view.scale for each in (features.length, features.spacing))
        rulers, fiducials = float(len(features.length)), float(len(features.fiducials.radius))
        size = (rulers, fiducials, length, spacing, features.imaging.width_px)
        measurer = measurer_on(self._device_of("rulers", measure_on, *size))
        measurements = [(kind, measurer.measure(expected.view, kind)) for kind in kinds]
        kind, measurement = max(measurements, key=lambda each: (not each[1].reason, each[1].agreeing))
        reason = expected.reason or measurement.reason
        imaging = features.imaging
        if not reason and copper == "auto" and imaging.smoothing_px < best_smoothing(imaging.blur_px):
            # Traces as wide as their gaps look the same with the other polarity, half a pitch away (measured).
            reason = (
                "the edges are too dense to tell whether copper is bright or dark: say which it is (copper, --copper)"
            )
        if expected.other is not None and not reason:
            other = measurer.measure(expected.other, kind)
            reason = _reason_of_ambiguity(expected, measurement, other, self.limits.max_other_share)
        self.clock.record("rulers")
        if not reason:
            reason = self._test_support(expected.view, measurement.view, kind, imaging.shift)
            self.clock.record("support")
        return self._result(measurement, kind, features, expected.found, reason)

    def _test_support(self, expected: BoardView, found: BoardView, copper: Copper, shift: float) -> str:
        """Return why the image does not support the found pose against a second one; empty where it does."""
        other = find_other_pose(
            self._undistorted(found.model),
            self.artwork,
            found,
            self.limits.support_range * shift,
            self.blur_px,
            is_bright=copper == "bright",
        )
        if other is None or other.preference > self.limits.min_preference:
            return ""
        x, y, _ = other.view.pose
        kind = "bright" if other.is_bright else "dark"
        place = f"{1e3 * other.distance:.2f} mm away (x {1e3 * x:.2f} mm, y {1e3 * y:.2f} mm), with {kind} copper"
        if other.preference < -self.limits.min_preference:
            return f"the copper in the image fits better {place}; check the initial pose and --copper"
        # The image shows no end of the repetition: the search range and the given polarity decide.
        found_off, other_off = (_distance(expected, each) for each in (found, other.view))
        if found_off <= shift and (other_off > shift or kind != copper):
            return ""
        return f"the copper in the image fits as well {place}; show the end of the repeated copper or a fiducial"

    def _result(
        self,
        measurement: BoardMeasurement,
        copper: Copper,
        features: FeatureSet,
        coarse_registration: Registration | None,
        reason: str,
    ) -> LocatedBoard:
        solution = measurement.solution
        # The solver gives the motion of the board at the placement point; the camera moves the other way. At the image
        # centre the error of the turn adds, times the distance from the placement point.
        covariance = np.full((3, 3), math.nan) if reason else solution.covariance
        arm = np.array(measurement.view.pose[:2]) - features.placement
        back = -np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
        return LocatedBoard(
            view=measurement.view,
            covariance=back @ covariance @ back.T,
            placement=features.placement,
            placement_px=measurement.view.to_measured_pixels(features.placement),
            placement_covariance=covariance,
            rulers=solution.rulers,
            fiducials=solution.fiducials,
            features=features,
            etch_bias=solution.etch_bias,
            residual_scale=solution.residual_scale,
            condition=solution.condition,
            copper=copper,
            noise=self.noise,
            threshold=self.threshold,
            reason=reason,
            coarse_registration=coarse_registration,
            device=self.devices.choices["rulers"].device,
            steps=self.devices.report(),
            seconds=self.clock.seconds,
            warnings=(*self.artwork.warnings, *solution.warnings),
            scale_error=solution.scale_error,
        )


def _distance(one: BoardView, other: BoardView) -> float:
    """Return the larger of the distances along x and y [m] between the centres of two views."""
    return float(np.max(np.abs(np.subtract(one.pose[:2], other.pose[:2]))))


def _reason_of_ambiguity(
    expected: _ExpectedPose, best: BoardMeasurement, other: BoardMeasurement, max_other_share: float
) -> str:
    """Return why the board may be at either of two places; empty where the rulers exclude the second one.

    The rulers differ from the rulers of the coarse registration: they were selected to determine the pose, and pairs of
    edges test the widths of traces.
    """
    if other.reason or other.agreeing <= max_other_share * best.agreeing:
        return ""
    places = (expected.view.pose, other.view.pose)
    either = " or ".join(f"x {1e3 * x:.2f} mm, y {1e3 * y:.2f} mm" for x, y, _ in places)
    counts = f"{best.agreeing} and {other.agreeing} rulers and fiducials agree"
    return f"the board may be at {either}: {counts}; give an initial pose near one of them"
