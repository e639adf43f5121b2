"""Where a camera is over a board: an image and the board's artwork become a pose with a covariance.

Rulers find edges, from what is measured along them a robust pose is solved, and rulers laid anew at that pose measure
it again. Where the board is not known to a few pixels, `gpuvision.matching.registration` finds it first.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.board_view import BoardView, grey_image, noise_of
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.features import FeatureSet, chosen_of
from gpuvision.host import Device
from gpuvision.matching.artwork import Artwork
from gpuvision.matching.pose import BoardPose, SolvePose, line_rows
from gpuvision.matching.registration import Registration, board_fix
from gpuvision.matching.ruler import LONGEST, RulerEdges, best_smoothing
from gpuvision.matching.selection import Candidates, Imaging, candidates
from gpuvision.status import Status

Copper = Literal["auto", "bright", "dark"]
COPPER = ("auto", "bright", "dark")
Float64 = npt.NDArray[np.float64]

SURE = (1e-4, 0.3 * math.pi / 180)  # [m], [rad] that a board is within, where it is said where it is
SEARCHED = (2e-3, 5 * math.pi / 180)  # and where it is not
_MOST_RULED = (2.5e-4, 1.0 * math.pi / 180)  # what rulers alone are asked to bridge
_AFTER_SEARCH = (6e-5, 2e-3)
_AGAIN_PX = 4.0  # reach of rulers that are laid at a pose that was found
_SAMPLED_PX = 0.02  # [px] standard deviation of what bilinear samples cost an edge; neighbours have some in common
_LEAST_SHARE = 0.3  # of the rulers in the image that must agree
_WORST_PX = 0.5  # by so much edges may disagree with a pose
_USUAL_CANDIDATES = 2500


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
        (n,) uint8 `Status` flags, as in `gpuvision.matching.ruler.Edges`.
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


class Etching(NamedTuple):
    """How much narrower copper is on each side than drawn [m], and its standard deviation; without single edges NaN."""

    value: float
    sigma: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedBoard:
    """Where a camera is over a board, or why that is not known.

    Attributes
    ----------
    view
        With the pose that was found; where it is refused, the one last looked at.
    covariance
        (3, 3) of the pose's x, y [m] and theta [rad]; NaN where it is refused.
    placement, placement_px
        (2,) the artwork's placement point [m], and where it is seen in the image as it was taken [px].
    placement_covariance
        (3, 3) of the place on the board seen where the placement point is [m], and of theta [rad].
    rulers
        `Rulers` of the last pass.
    features
        What was looked for.
    etching
        `Etching`, as it was solved for along with the pose.
    spread
        Of what the pose leaves of the edges, in standard deviations: about 1 where these are right.
    condition
        Worst standard deviation over best.
    copper
        Whether copper is brighter or darker than what lies beside it.
    noise, threshold
        Of a pixel, and the least edge looked for [grey levels].
    reason
        Why the pose is refused; ``""`` where it is not.
    first
        What the search found; None where none was made.
    device
        Where it ran.
    seconds
        Of the steps, by name.
    """

    view: BoardView
    covariance: Float64
    placement: Float64
    placement_px: Float64
    placement_covariance: Float64
    rulers: Rulers
    features: FeatureSet
    etching: Etching
    spread: float
    condition: float
    copper: Copper
    noise: float
    threshold: float
    reason: str
    first: Registration | None
    device: Device
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def pose(self) -> tuple[float, float, float]:
        """What the image's centre sees, x, y [m], and theta [rad]; NaN where it is refused."""
        return (math.nan,) * 3 if self.reason else self.view.pose

    @property
    def sigmas(self) -> Float64:
        """(3,) standard deviations of the pose [m], [m], [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def summary(self) -> str:
        """Return the pose in a line or two, or why there is none."""
        told = self.rulers
        counts = f"{np.sum(told.used)} of {np.sum(told.laid)} rulers agree, {np.sum(told.found)} found an edge"
        if self.reason:
            return f"refused: {self.reason}"
        (x, y, theta), (sx, sy, turn) = self.pose, self.sigmas
        return (
            f"x {1e3 * x:.4f} mm, y {1e3 * y:.4f} mm, theta {math.degrees(theta):.4f} degrees\n"
            f"sigmas {1e6 * sx:.2f} µm, {1e6 * sy:.2f} µm, {math.degrees(turn):.5f} degrees; {counts}"
        )

    def report(self) -> dict[str, Any]:
        """Return what ``pose.json`` holds: metres, radians; what is not known is null."""
        told, first = self.rulers, self.first
        points = told.point + told.normal * np.nan_to_num(told.position_px * self.view.scale)[:, None]
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
            "side": self.features.side,
            "pose": _named(self.pose),
            "sigmas": _named(self.sigmas),
            "covariance": _plain(self.covariance),
            "placement": {
                "board": _plain(self.placement),
                "image_px": _plain(self.placement_px),
                "covariance": _plain(self.placement_covariance),
            },
            "predicted_covariance": _plain(self.features.covariance),
            "etching": {"value": _plain(self.etching.value), "sigma": _plain(self.etching.sigma)},
            "spread": _plain(self.spread),
            "condition": _plain(self.condition),
            "scale": self.view.scale,
            "copper": self.copper,
            "noise": self.noise,
            "threshold": self.threshold,
            "search": None
            if first is None
            else {name: _plain(getattr(first, name)) for name in ("score", "runner_up")},
            "counts": {name: int(np.sum(getattr(told, name))) for name in ("laid", "found", "used")},
            "rulers": [
                {
                    "point": _plain(told.point[number]),
                    "image_px": _plain(self.view.measured(points[number])),
                    "found": bool(told.found[number]),
                    "weight": _plain(told.weight[number]),
                    "residual": _plain(told.residual[number]),
                    "sigma": _plain(told.sigma[number]),
                    "status": str(Status(int(told.status[number])).name or "OK"),
                }
                for number in range(len(told.weight))
            ],
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "seconds": self.seconds,
        }


def _named(values: Any) -> dict[str, float | None]:
    return dict(zip(("x", "y", "theta"), _plain(values), strict=True))


def _plain(value: Any) -> Any:
    """Return numbers as JSON has them, None for NaN."""
    array = np.asarray(value, np.float64)
    if array.ndim:
        return [_plain(each) for each in array]
    return float(array) if np.isfinite(array) else None


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
    """Locate a camera over a board.

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
        What to look for; None: as many rulers as the budget says are chosen now. They say how far they reach.
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

    Returns
    -------
    LocatedBoard
        Its ``reason`` says why a pose is refused.

    Raises
    ------
    ValueError
        A parameter is out of its range, or no rulers that fix the pose can be laid in the image.
    RecordingError
        The image is none that rulers take.
    """
    grey = grey_image(image)
    if copper not in COPPER:
        raise ValueError(f"copper is {copper!r}, expected one of {', '.join(COPPER)}")
    device = Device.best() if device is None else device
    x, y = artwork.bounds.mean(axis=0) if near is None else near[:2]
    view = BoardView(
        scale=scale,
        shape=grey.shape,
        pose=(float(x), float(y), 0.0 if near is None else float(near[2])),
        mirrored=artwork.side == "bottom",
        model=model,
    )
    level = noise_of(grey) if noise is None else noise
    low, high = np.percentile(grey, [1, 99])
    least = max(4.0 * level, 0.05 * float(high - low), 1e-6) if threshold is None else threshold
    reach = _reach(within, near is not None, scale, features)
    clock = _Clock()
    view, reach, first, reason = _searched(grey, artwork, view, reach, blur_px, least, device, clock)
    if features is None:
        imaging = Imaging(pixel=scale, blur_px=blur_px, etch=etch, shift=reach[0], angle=reach[1])
        features = features_in_view(artwork, view, imaging, budget)
        clock.told("features")
    looked = _Looking(grey, features, level, least, blur_px, etch, device)
    kinds: tuple[Copper, ...] = ("bright", "dark") if copper == "auto" else (copper,)
    fixes = [(kind, looked.located(view, kind)) for kind in kinds]
    kind, fix = max(fixes, key=lambda each: (not each[1].reason, np.sum(each[1].rulers.used)))
    clock.told("rulers")
    return _result(fix, kind, features, looked, first, reason or fix.reason, device, clock)


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


def _searched(
    grey: npt.NDArray[Any],
    artwork: Artwork,
    view: BoardView,
    reach: tuple[float, float],
    blur_px: float,
    least: float,
    device: Device,
    clock: _Clock,
) -> tuple[BoardView, tuple[float, float], Registration | None, str]:
    """Find the board where rulers alone would not reach: the view, what is left to reach, and what was found."""
    if reach[0] <= max(_MOST_RULED[0], 10 * view.scale) and reach[1] <= _MOST_RULED[1]:
        return view, reach, None, ""
    search = board_fix(
        artwork, view.matrix, view.shape, shift=reach[0], angle=reach[1], blur_px=blur_px, threshold=least
    )
    clock.told("search prepared")
    straight = grey
    if view.model is not None:
        straight = UndistortImage(model=view.model, border="replicate")(grey, device=device).image
    found = search(straight, device=device)
    clock.told("search")
    left = (max(_AFTER_SEARCH[0], 3 * view.scale), _AFTER_SEARCH[1])
    if not np.all(np.isfinite(found.pose)):
        best = f"the best one has {found.score:.0%} of its edges" if found.rulers else "there are too few edges"
        return view, left, found, f"the search found no place for the board: {best}; is it in view, is the scale right?"
    there = _moved(view, found.pose)
    if found.status & Status.AMBIGUOUS:
        places = (there.pose, _moved(view, found.runner_up_pose).pose)
        told = " and ".join(f"x {1e3 * x:.2f} mm, y {1e3 * y:.2f} mm" for x, y, _ in places)
        shares = f"with {found.score:.0%} and {found.runner_up:.0%} of its edges"
        return there, left, found, f"the search found the board at {told}, {shares}; say near which of them it is"
    return there, left, found, ""


def _moved(view: BoardView, pose: npt.ArrayLike) -> BoardView:
    """Return where the camera is, over a board that is seen moved by a pose of its artwork: q = R p + t."""
    x, y, theta = (float(each) for each in np.asarray(pose, np.float64))
    c, s = math.cos(theta), math.sin(theta)
    off = np.array(view.pose[:2]) - (x, y)
    turned = math.remainder(view.pose[2] - theta, 2 * math.pi)
    return replace(view, pose=(float(c * off[0] + s * off[1]), float(-s * off[0] + c * off[1]), turned))


def _flags(status: Any) -> str:
    return str(Status(int(status)).name or "OK")


def features_in_view(artwork: Artwork, view: BoardView, imaging: Imaging, budget: float = 60) -> FeatureSet:
    """Choose rulers that lie in an image wherever the board is within ``imaging.shift``.

    Of a view with thousands of places only five windows of it are looked at, its corners and its middle.

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
    rulers = Candidates(*(np.concatenate(each) for each in zip(*(part[:-1] for part in parts), strict=True)), placement)
    margin = (rulers.length / 2 + imaging.shift) / imaging.pixel + imaging.width_px
    fits = view.within(rulers.point, margin) & (rulers.length < (LONGEST - 2) * imaging.pixel)
    rulers = Candidates(*(each[fits] for each in rulers[:-1]), placement)
    if len(rulers.sigma) < 3:
        raise ValueError(
            f"{len(rulers.sigma)} edges of the {artwork.side} artwork in view stand free enough for a ruler, expected "
            "3 or more; is the board there (near), is the scale right, is the blur less?"
        )
    return chosen_of(rulers, imaging, artwork.side, budget=budget)


class _Clock:
    """What each step took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def told(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step], self._last = now - self._last, now


class _Solution(NamedTuple):
    """What one pass made: where the board is seen, and its covariance at the placement point."""

    pose: Float64
    covariance: Float64
    etching: Etching
    spread: float
    condition: float
    rulers: Rulers
    reason: str


class _Fix(NamedTuple):
    """Two passes, or one that was refused."""

    view: BoardView
    before: BoardView
    solution: _Solution

    @property
    def rulers(self) -> Rulers:
        return self.solution.rulers

    @property
    def reason(self) -> str:
        return self.solution.reason


class _Looking:
    """Rulers in an image, and the poses they make."""

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

    def located(self, view: BoardView, copper: Copper) -> _Fix:
        """Look where the board should be, then once more where it was found, with shorter rulers."""
        reach = np.minimum(self.features.length / view.scale, LONGEST)
        first = self._pass(view, copper, reach)
        if first.reason:
            return _Fix(view, view, first)
        there = _moved(view, first.pose)
        second = self._pass(there, copper, np.minimum(reach, self._short(view.scale)))
        return _Fix(there if second.reason else _moved(there, second.pose), there, second)

    def _short(self, scale: float) -> Float64:
        """(n,) lengths [px] that the edge lies on where the board is known to a few pixels."""
        return 2 * (_AGAIN_PX + 3 * best_smoothing(self.blur_px)) + 3 + self.features.spacing / scale

    def _pass(self, view: BoardView, copper: Copper, length_px: Float64) -> _Solution:
        rulers = self._measured(view, copper, length_px)
        laid, found = int(rulers.laid.sum()), int(rulers.found.sum())
        if laid < 3:
            return _refused(rulers, f"{laid} of {len(rulers.laid)} rulers lie in the image, expected 3 or more")
        if found < 3:
            return _refused(
                rulers,
                f"{found} of {laid} rulers found an edge of {self.threshold:.3g} grey levels or more, expected 3",
            )
        return self._solved(rulers, view.scale)

    def _measured(self, view: BoardView, copper: Copper, length_px: Float64) -> Rulers:
        """Look along all rulers: those across single edges together, those across traces by the traces' widths."""
        features = self.features
        matrix = view.matrix
        direction = features.normal @ matrix[:2, :2].T * view.scale
        laid = np.concatenate([view.pixels(features.point), direction], axis=1).astype(np.float32)
        count = len(laid)
        position, sigma = np.full(count, np.nan), np.full(count, np.nan)
        status = np.zeros(count, np.uint8)
        spacing_px = features.spacing / view.scale
        smoothing = best_smoothing(self.blur_px)
        # One length for all, of few that there are: every other one would be a build of its own.
        room = max(float(length_px.max()), 2 * math.ceil(3 * smoothing) + 3)
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

    def _solved(self, rulers: Rulers, scale: float) -> _Solution:
        """Solve for the pose and, where single edges were measured, for the etching: by turns, robustly."""
        placement = self.features.placement
        single = self.features.spacing == 0
        off = rulers.position_px * scale
        sigma, etched = np.hypot(rulers.sigma, np.where(single, self.etch, 0.0)), Etching(0.0, self.etch)
        fit: BoardPose | None = None
        for _ in range(3):
            seen = rulers.point + rulers.normal * (off + np.where(single, etched.value, 0.0))[:, None]
            rows = line_rows(rulers.normal, rulers.point - placement, seen - placement, sigma)
            solver = SolvePose(
                scale=None, smallest_scale=1.0, precision="double" if self.device.has_double else "single"
            )
            fit = solver(rows, device=self.device)
            weight = np.nan_to_num(np.asarray(fit.weights, np.float64))
            if int(fit.status):
                return _refused(rulers._replace(weight=weight), _why(fit, int(rulers.found.sum())))
            etched, extra = self._etching(rulers, off, weight, single, float(fit.scale))
            sigma = rulers.sigma
        assert fit is not None  # the loop ran
        told = rulers._replace(weight=weight, residual=np.asarray(fit.residuals, np.float64))
        solution = _Solution(
            pose=_about(np.asarray(fit.pose, np.float64), placement),
            # Of few edges that happen to agree better than they should the scatter is not to be trusted.
            covariance=np.asarray(fit.covariance, np.float64) / min(float(fit.spread), 1.0) ** 2 + extra,
            etching=etched if single.any() else Etching(math.nan, math.nan),
            spread=float(fit.spread),
            condition=float(fit.condition),
            rulers=told,
            reason="",
        )
        return self._judged(solution, float(fit.scale), scale)

    def _etching(
        self, rulers: Rulers, off: Float64, weight: Float64, single: npt.NDArray[np.bool_], spread: float
    ) -> tuple[Etching, Float64]:
        """Return the etching, by weighted least squares for pose and etching, and what not knowing it adds."""
        used = weight > 0
        if not (single & used).any() or self.etch == 0:
            return Etching(0.0, 0.0), np.zeros((3, 3))
        arm = rulers.point - self.features.placement
        turn = arm[:, 0] * rulers.normal[:, 1] - arm[:, 1] * rulers.normal[:, 0]
        row = np.column_stack([rulers.normal, turn, np.where(single, -1.0, 0.0)])[used]
        per = (weight[used] / (spread * rulers.sigma[used]) ** 2)[:, None]
        information = (row * per).T @ row
        information[3, 3] += 1 / self.etch**2
        known = np.linalg.solve(information, (row * per).T @ off[used])
        variance = float(np.linalg.inv(information)[3, 3])
        gain = np.linalg.solve(information[:3, :3], information[:3, 3])
        return Etching(float(known[3]), math.sqrt(variance)), np.outer(gain, gain) * variance

    def _judged(self, solution: _Solution, spread: float, scale: float) -> _Solution:
        """Refuse what too few rulers agree with, or what they disagree with too much."""
        rulers = solution.rulers
        used, laid = int(rulers.used.sum()), int(rulers.laid.sum())
        if used < max(3, _LEAST_SHARE * laid):
            return solution._replace(reason=f"{used} of {laid} rulers agree, expected {_LEAST_SHARE:.0%} or more")
        off = spread * float(np.nanmedian(rulers.sigma)) / scale
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
    if int(fit.status) & Status.AMBIGUOUS:
        if int(fit.rank) < 3:
            return f"the edges found fix {int(fit.rank)} of x, y and theta (all parallel, or all through one point)"
        return f"{int(fit.inliers)} of the {found} edges found agree on a pose, expected {_LEAST_SHARE:.0%} or more"
    return f"{found} edges were found, too few for a pose ({_flags(fit.status)})"


def _refused(rulers: Rulers, reason: str) -> _Solution:
    nothing = np.full((3, 3), np.nan)
    return _Solution(nothing[0], nothing, Etching(math.nan, math.nan), math.nan, math.nan, rulers, reason)


def _about(pose: Float64, point: Float64) -> Float64:
    """Return a pose of places about a point as one of places about the origin."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
    return np.array([*(pose[:2] + point - turned), pose[2]])


def _result(
    fix: _Fix,
    copper: Copper,
    features: FeatureSet,
    looked: _Looking,
    first: Registration | None,
    reason: str,
    device: Device,
    clock: _Clock,
) -> LocatedBoard:
    solution = fix.solution
    # The board was seen moved by a small pose, at the placement point; the camera is moved against it. What the
    # image's centre sees is off by the turn's error times its distance from there.
    arm = np.array(fix.view.pose[:2]) - features.placement
    back = -np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
    return LocatedBoard(
        view=fix.view,
        covariance=back @ solution.covariance @ back.T,
        placement=features.placement,
        placement_px=fix.view.measured(features.placement),
        placement_covariance=solution.covariance,
        rulers=solution.rulers,
        features=features,
        etching=solution.etching,
        spread=solution.spread,
        condition=solution.condition,
        copper=copper,
        noise=looked.noise,
        threshold=looked.threshold,
        reason=reason,
        first=first,
        device=device,
        seconds=clock.seconds,
    )
