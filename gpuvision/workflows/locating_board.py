"""Where a camera is over a board: an image and the board's artwork become a pose with a covariance.

Rulers find edges, round marks are found by their contours, from both a robust pose is solved, and looked for anew at
that pose they measure it again. Where the board is not known to a few pixels, `gpuvision.matching.pose.registration`
finds it first.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.image import estimate_pixel_noise, grey_image
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.edge_measurement import Copper, Fix, Looking, features_in_view, moved
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.selection import Imaging
from gpuvision.matching.pose.registration import Registration, register_board
from gpuvision.status import Status

COPPER = ("auto", "bright", "dark")
Float64 = npt.NDArray[np.float64]

SURE = (1e-4, 0.3 * math.pi / 180)  # [m], [rad] that a board is within, where it is said where it is
SEARCHED = (2e-3, 5 * math.pi / 180)  # and where it is not
_MOST_RULED = (2.5e-4, 1.0 * math.pi / 180)  # what rulers alone are asked to bridge
_AFTER_SEARCH = (6e-5, 2e-3)
_OTHER_SHARE = 0.6  # of the rulers, up to which another place that the search likes is not believed


def locate_board(
    image: npt.NDArray[Any],
    artwork: Artwork,
    *,
    scale: float,
    near: tuple[float, float, float] | None = None,
    within: tuple[float, float] | None = None,
    features: FeatureSet | None = None,
    model: Lens | Camera | None = None,
    budget: int = 60,
    blur_px: float = 1.0,
    etch: float = 10e-6,
    threshold: float | None = None,
    noise: float | None = None,
    copper: Copper = "auto",
    device: Device | None = None,
) -> LocatedBoard:
    """Locate a camera over a board, by rulers and round marks; ``reason`` of the result says why a pose is refused.

    Parameters
    ----------
    image
        Grey or colour (blue, green, red), uint8, uint16 or float32; the camera looks straight at the board.
    artwork
        The side that it sees.
    scale
        Of a pixel on the board [m].
    near
        About where it is: the place on the board that the image's centre sees, x, y [m], and theta [rad], by which
        the image's columns are turned from the artwork's x, counter-clockwise. None: over the board's middle.
    within
        How far from there it may be, along x and along y [m], and in angle [rad]. None: 0.1 mm (or 4 pixels) and 0.3
        degrees; where ``near`` is None, 2 mm and 5 degrees. Beyond 0.25 mm (or 10 pixels) or 1 degree it is searched.
    features
        What to look for, and how far away; None: marks, and as many rulers as the budget says, are chosen now.
    model
        The lens; None: there is none.
    budget
        Rulers, where no features are given.
    blur_px
        Standard deviation of the edges' blur [px].
    etch
        Standard deviation of how far copper is etched beside its drawn edges, everywhere the same [m].
    threshold
        Least edge [grey levels]; None: 4 times the noise, and a twentieth of the image's range.
    noise
        Standard deviation of a pixel [grey levels]; None: as the image shows it.
    copper
        "bright" or "dark" beside what surrounds it; "auto": as more rulers agree.
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        A parameter is out of its range, the image's shape is not accepted, or the image shows no features that fix the
        pose.
    TypeError
        The pixels are not uint8, uint16 or float32.
    """
    grey = grey_image(image)
    if copper not in COPPER:
        raise ValueError(f"copper is {copper!r}, expected one of {', '.join(COPPER)}")
    levels = _levels(grey, noise, threshold)
    job = _Job(grey, artwork, *levels, blur_px, etch, Device.best() if device is None else device)
    view = _view_near(near, artwork, scale, grey.shape, model)
    searched = job.searched(view, _reach(within, near is not None, scale, features))
    return job.located(searched, job.chosen(searched, budget) if features is None else features, copper)


def _levels(grey: npt.NDArray[Any], noise: float | None, threshold: float | None) -> tuple[float, float]:
    """Return a pixel's noise and the least edge [grey levels], as they are given or as the image shows them."""
    level = estimate_pixel_noise(grey) if noise is None else noise
    low, high = np.percentile(grey, [1, 99])
    return level, max(4.0 * level, 0.05 * float(high - low), 1e-6) if threshold is None else threshold


def _view_near(
    near: tuple[float, float, float] | None,
    artwork: Artwork,
    scale: float,
    shape: tuple[int, int],
    model: Lens | Camera | None,
) -> BoardView:
    x, y = artwork.bounds.mean(axis=0) if near is None else near[:2]
    pose = (float(x), float(y), 0.0 if near is None else float(near[2]))
    return BoardView(scale=scale, shape=shape, pose=pose, mirrored=artwork.side == "bottom", model=model)


def _reach(
    within: tuple[float, float] | None, known: bool, scale: float, features: FeatureSet | None
) -> tuple[float, float]:
    """Return how far, and how much turned, the board may be [m], [rad]."""
    if within is not None:
        if not (0 < within[0] < math.inf and 0 <= within[1] <= math.pi):
            raise ValueError(f"within is {within}, expected metres above 0, and an angle of 0 to pi [rad]")
        return within
    if not known:
        return SEARCHED
    if features is not None:
        return features.imaging.shift, features.imaging.angle
    return max(SURE[0], 4 * scale), SURE[1]


class _Searched(NamedTuple):
    """Where the board is, as far as the search knows it, what is left to reach [m], [rad], and why it is nowhere.

    ``found`` is None where none was made; ``other`` is where the board may be as well.
    """

    view: BoardView
    reach: tuple[float, float]
    found: Registration | None = None
    reason: str = ""
    other: BoardView | None = None


class _Clock:
    """What each step took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def told(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step], self._last = now - self._last, now


@dataclass(frozen=True)
class _Job:
    """An image of a board, and what is known of both."""

    grey: npt.NDArray[Any]
    artwork: Artwork
    noise: float
    threshold: float
    blur_px: float
    etch: float
    device: Device
    clock: _Clock = field(default_factory=_Clock)

    def searched(self, view: BoardView, reach: tuple[float, float]) -> _Searched:
        """Find the board where rulers alone would not reach."""
        if reach[0] <= max(_MOST_RULED[0], 10 * view.scale) and reach[1] <= _MOST_RULED[1]:
            return _Searched(view, reach)
        search = register_board(
            self.artwork,
            view.matrix,
            view.shape,
            shift=reach[0],
            angle=reach[1],
            blur_px=self.blur_px,
            threshold=self.threshold,
        )
        self.clock.told("search prepared")
        straight = self.grey
        if view.model is not None:
            undistort = UndistortImage(model=view.model, border="replicate")
            straight = to_numpy(undistort(self.grey, device=self.device).image)
        found = search(straight, device=self.device)
        self.clock.told("search")
        left = (max(_AFTER_SEARCH[0], 3 * view.scale), _AFTER_SEARCH[1])
        if not np.all(np.isfinite(found.pose)):
            best = f"the best one has {found.score:.0%} of its edges; is it in view, is the scale right?"
            if not found.rulers:
                best = (
                    "it has too few straight edges in view; say near where it is (marks will do then), or another scale"
                )
            reason = f"the search found no place for the board: {best}"
            return _Searched(view, left, found, reason)
        other = moved(view, found.runner_up_pose) if found.status & Status.AMBIGUOUS else None
        return _Searched(moved(view, found.pose), left, found, other=other)

    def chosen(self, searched: _Searched, budget: int) -> FeatureSet:
        """Choose what to look for where the board is thought to be."""
        shift, angle = searched.reach
        imaging = Imaging(pixel=searched.view.scale, blur_px=self.blur_px, etch=self.etch, shift=shift, angle=angle)
        features = features_in_view(self.artwork, searched.view, imaging, budget)
        self.clock.told("features")
        return features

    def located(self, searched: _Searched, features: FeatureSet, copper: Copper) -> LocatedBoard:
        """Look for the features, in copper of either kind where that is not known."""
        looked = Looking(self.grey, features, self.noise, self.threshold, self.blur_px, self.etch, self.device)
        kinds: tuple[Copper, ...] = ("bright", "dark") if copper == "auto" else (copper,)
        fixes = [(kind, looked.located(searched.view, kind)) for kind in kinds]
        kind, fix = max(fixes, key=lambda each: (not each[1].reason, each[1].agreeing))
        reason = searched.reason or fix.reason
        if searched.other is not None and not reason:
            reason = _undecided(searched, fix, looked.located(searched.other, kind))
        self.clock.told("rulers")
        return self._result(fix, kind, features, searched.found, reason)

    def _result(
        self, fix: Fix, copper: Copper, features: FeatureSet, first: Registration | None, reason: str
    ) -> LocatedBoard:
        solution = fix.solution
        # The board was seen moved by a small pose, at the placement point; the camera is moved against it. What the
        # image's centre sees is off by the turn's error times its distance from there.
        covariance = np.full((3, 3), math.nan) if reason else solution.covariance
        arm = np.array(fix.view.pose[:2]) - features.placement
        back = -np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
        return LocatedBoard(
            view=fix.view,
            covariance=back @ covariance @ back.T,
            placement=features.placement,
            placement_px=fix.view.to_measured_pixels(features.placement),
            placement_covariance=covariance,
            rulers=solution.rulers,
            marks=solution.marks,
            features=features,
            growth=solution.growth,
            spread=solution.spread,
            condition=solution.condition,
            copper=copper,
            noise=self.noise,
            threshold=self.threshold,
            reason=reason,
            first=first,
            device=self.device,
            seconds=self.clock.seconds,
        )


def _undecided(searched: _Searched, best: Fix, other: Fix) -> str:
    """Return why a board that the search found at two places may be at either; empty where rulers tell them apart.

    Rulers that were chosen to fix the pose look at more than at what is repeated, and at traces by their widths.
    """
    if other.reason or other.agreeing <= _OTHER_SHARE * best.agreeing:
        return ""
    places = (searched.view.pose, other.view.pose)
    told = " or ".join(f"x {1e3 * x:.2f} mm, y {1e3 * y:.2f} mm" for x, y, _ in places)
    shares = f"{best.agreeing} and {other.agreeing} rulers and marks agree"
    return f"the board may be at {told}: {shares}; say near which of them it is"
