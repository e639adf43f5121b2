"""Feature sets: rulers and fiducials of a board, selected from its artwork before an image is taken.

``gpuvision select`` writes a feature set and the imaging for which it was selected; ``gpuvision locate --features``
reads it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from numpy.typing import DTypeLike

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.magnification import largest_magnification
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, Side
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates
from gpuvision.matching.features.fiducials import (
    SPOKES,
    FiducialLimits,
    Fiducials,
    append_fiducials,
    fiducial_smoothing,
    search_distance,
    select_fiducials,
)
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import MAX_LENGTH, SAMPLING_SIGMA_PX, RulerEdges
from gpuvision.matching.features.selection import Selection, select_rulers
from gpuvision.matching.pose.bound_features import BoundFeatures
from gpuvision.matching.pose.feature_pose import CameraFeatures, EstimateFeaturePose
from gpuvision.matching.pose.pose import SolvePose

Float64 = npt.NDArray[np.float64]
Copper = Literal["bright", "dark"]
BudgetUnit = Literal["rulers", "px", "us"]
UNITS: tuple[str, ...] = get_args(BudgetUnit)
_TIMED_RULERS, _TIMED_CALLS = 256, 20
_PER_SOURCE = 4  # default of `select_rulers`
_FREE_COST = 1e-9  # cost of a free fiducial relative to the budget: costs must be positive
# Largest accepted pose, in search ranges, and least angle of this limit [rad]: as in `MeasurementLimits`.
_RANGE_FACTOR, _MIN_ANGLE = 2.0, 5e-3
_MAX_FIDUCIAL_SEARCH_PX = 190.0  # the rulers of fiducials fit into `MAX_LENGTH` samples
_FIDUCIAL_SLACK_PX, _FIDUCIAL_SIGMAS = 1.0, 3.0  # search beyond the range: pixels, and sigmas of the etch bias
MAX_ROWS = 1000
"""Largest number of rows of one pose: one of a ruler, two of a fiducial (`SolvePose` takes 1024)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureSet:
    """Rulers and fiducials on one side of a board, and the covariance that they predict.

    Attributes
    ----------
    side
        Side of the board, "top" or "bottom".
    placement : (2,)
        Point whose pose counts [m].
    point, normal : (n, 2)
        Centres of the rulers on the board [m], and their unit directions, out of the copper.
    spacing : (n,)
        Distance between the two edges of a ruler across a trace [m]; 0 at a single edge.
    length : (n,)
        Length along the normal [m].
    sigma : (n,)
        Predicted standard deviation of the measured position [m].
    imaging
        Image quality and search range for which the features were selected.
    covariance : (3, 3)
        Predicted covariance of the placement point's x, y [m] and of theta [rad].
    condition
        Largest over smallest standard deviation.
    region : (2, 2)
        Least and greatest x, y [m] that the features sample: the region that the camera must read.
    fiducials
        Fiducials, vias and other round pads.
    """

    side: Side
    placement: Float64
    point: Float64
    normal: Float64
    spacing: Float64
    length: Float64
    sigma: Float64
    imaging: Imaging
    covariance: Float64
    condition: float
    region: Float64
    fiducials: Fiducials = field(default_factory=Fiducials.empty)

    @classmethod
    def from_selection(
        cls,
        rulers: FeatureCandidates,
        chosen: Selection,
        imaging: Imaging,
        side: Side,
        fiducials: Fiducials | None = None,
    ) -> FeatureSet:
        """Return the selected features of candidates with fiducials at their end (`append_fiducials`)."""
        is_fiducial = rulers.radius[chosen.chosen] > 0
        kept, first = (
            chosen.chosen[~is_fiducial],
            len(rulers.radius) - (0 if fiducials is None else len(fiducials.radius)),
        )
        return cls(
            side=side,
            placement=rulers.placement,
            point=rulers.point[kept],
            normal=rulers.normal[kept],
            spacing=rulers.spacing[kept],
            length=rulers.length[kept],
            sigma=rulers.sigma[kept],
            imaging=imaging,
            covariance=chosen.covariance,
            condition=chosen.condition,
            region=chosen.region,
            fiducials=Fiducials.empty() if fiducials is None else fiducials.subset(chosen.chosen[is_fiducial] - first),
        )

    @property
    def sigmas(self) -> Float64:
        """(3,) predicted standard deviations of x, y [m] and theta [rad] at the placement point."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def region_px(self) -> tuple[int, int]:
        """Columns and rows of the region, for a camera whose columns run along x."""
        columns, rows = np.ceil((self.region[1] - self.region[0]) / self.imaging.pixel).astype(int)
        return int(columns), int(rows)

    def summary(self) -> str:
        """Return the selection and its predicted standard deviations, in two lines."""
        sx, sy, sigma_theta = self.sigmas
        pairs = int(np.sum(self.spacing > 0))
        columns, rows = self.region_px
        fiducials = f" and {len(self.fiducials.radius)} fiducials" if len(self.fiducials.radius) else ""
        return (
            f"{len(self.length)} rulers ({pairs} across traces){fiducials}, {int(self._pixels().sum())} px, in "
            f"a region of "
            f"{columns} x {rows} px\n"
            f"predicted at ({1e3 * self.placement[0]:.3f}, {1e3 * self.placement[1]:.3f}) mm: sigma x {1e6 * sx:.2f} "
            f"µm, y {1e6 * sy:.2f} µm, theta {1e3 * sigma_theta:.4f} mrad"
        )

    def _pixels(self) -> Float64:
        return np.asarray(np.ceil(self.length / self.imaging.pixel) * self.imaging.width_px)

    def bind(
        self,
        device: Device | None,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        copper: Copper,
        threshold: float,
        noise: float,
        pixel_size: float | None = None,
        frame_shape: tuple[int, int] | None = None,
        blur_px: float | None = None,
        etch_bias_sigma: float | None = None,
        search_px: float | None = None,
        model: Lens | Camera | None = None,
        solver: SolvePose | None = None,
        min_share: float = EstimateFeaturePose.min_share,
        max_residual_px: float = EstimateFeaturePose.max_residual_px,
        queue: Any = None,
    ) -> BoundFeatures:
        """Bind the features to a device and a frame size: ``bound(frame, predicted_pose) -> FeaturePose``.

        Rulers across single edges and across traces, and fiducials, are placed where a camera at the predicted pose
        sees them, measured, and solved for the pose of the camera. The parameters are checked and the kernels are built
        now; calls only enqueue launches.

        Parameters
        ----------
        device : Device or None
            None: `Device.best`.
        shape : (int, int)
            Rows and columns of a frame.
        dtype : dtype
            Dtype of a frame: uint8, uint16 or float32.
        copper : {"bright", "dark"}
            Grey level of copper relative to its surroundings.
        threshold, noise : float
            Least height of an edge, above 0, and standard deviation of a pixel, 0 or more [grey levels].
        pixel_size : float, optional
            Size of a pixel on the board [m]; None: ``imaging.pixel``.
        frame_shape : (int, int), optional
            Rows and columns of the full image, of which the frame is a region; None: the frame is the full image.
        blur_px : float, optional
            Standard deviation of the blur of edges [px]; None: ``imaging.blur_px``.
        etch_bias_sigma : float, optional
            Standard deviation of the etch bias [m]; 0: edges are where they are drawn. None:
            ``imaging.etch_bias_sigma``.
        search_px : float, optional
            Largest distance of a feature from its predicted place [px], above 0. None: the search range for which the
            features were selected. A loop that follows the board needs a few pixels only; shorter rulers are faster.
        model : Lens or Camera, optional
            Lens distortion, in pixels of the full image (of a `Camera`: with the camera matrix of the model). The
            frames are then distorted; the pose and the pixel size refer to the undistorted image. None: no distortion.
        solver : SolvePose, optional
            None: Tukey's loss with the scale from the residuals, 64 start candidates, an unknown etch bias where there
            are single edges, and twice the search range as limit.
        min_share : float
            Least share of the features in the image, a fiducial counted twice, that must agree with the pose, 0 to 1:
            with fewer another pose could gather as many, and the status is AMBIGUOUS. Default 0.5.
        max_residual_px : float
            Largest accepted standard deviation of the residuals beyond the errors of the features [px], above 0: more
            is another board or a wrong scale, and the status is AMBIGUOUS. Default 0.5 (chosen).
        queue : pyopencl.CommandQueue, optional
            Queue to run in; see `BoundFeatures`.

        Raises
        ------
        TypeError, ValueError
            A parameter is out of its range, or the features do not determine a pose.

        Examples
        --------
        >>> import numpy as np
        >>> import gpuvision as gv
        >>> def follow(features: gv.FeatureSet, frames, pose):
        ...     bound = features.bind(None, (256, 256), np.uint8, copper="bright", threshold=20.0, noise=2.0)
        ...     for frame in frames:
        ...         found = bound(frame, pose)
        ...         if found.status == 0:
        ...             pose = found.pose.copy()
        ...     return pose
        """
        scale = self.imaging.pixel if pixel_size is None else pixel_size
        blur = self.imaging.blur_px if blur_px is None else blur_px
        etch = self.imaging.etch_bias_sigma if etch_bias_sigma is None else etch_bias_sigma
        full = shape if frame_shape is None else frame_shape
        camera = self._camera_features(copper, scale, full, model)
        magnification = 1.0 if model is None else largest_magnification(model, full)
        has_etch = etch > 0 and bool(np.any(self.spacing == 0)) and len(self.spacing) > 0
        levels: dict[str, Any] = {"threshold": threshold, "noise": noise}
        limits = FiducialLimits()
        matched, drilled = self._blobs(copper, scale, blur, etch, search_px, magnification, levels)
        operation = EstimateFeaturePose(
            features=camera,
            ruler=RulerEdges(
                per_ruler=True,
                length=self.ruler_length(scale, blur, search_px, magnification),
                width=self.imaging.width_px,
                smoothing_px=self.imaging.smoothing_ratio * blur,
                **levels,
            ),
            matched=matched,
            drilled=drilled,
            solver=self._solver(etch if has_etch else None, scale, search_px) if solver is None else solver,
            ruler_sigma_px=SAMPLING_SIGMA_PX,
            matched_sigma_px=limits.matched_sigma_px,
            drilled_sigma_px=limits.edges_sigma_px,
            size_tolerance=limits.size_tolerance_px * scale + limits.size_sigmas * etch,
            min_share=min_share,
            max_residual_px=max_residual_px,
        )
        return BoundFeatures(operation, Device.best() if device is None else device, shape, dtype, queue)

    def _blobs(
        self,
        copper: Copper,
        scale: float,
        blur: float,
        etch: float,
        search_px: float | None,
        magnification: float,
        levels: dict[str, Any],
    ) -> tuple[FindBlobs, FindBlobs]:
        """Return the measurements of the fiducials whose grey levels are matched, and of the drilled fiducials."""
        drilled = self.fiducials.hole > 0
        common: dict[str, Any] = levels | {
            "polarity": copper,
            "search_px": self._fiducial_search_px(scale, etch, magnification) if search_px is None else search_px,
            "spokes": SPOKES,
        }
        return (
            FindBlobs(smoothing_px=self._fiducial_smoothing(~drilled, scale, blur), **common),
            FindBlobs(smoothing_px=self._fiducial_smoothing(drilled, scale, blur), match=False, **common),
        )

    def _camera_features(
        self, copper: Copper, scale: float, frame_shape: tuple[int, int], model: Lens | Camera | None
    ) -> CameraFeatures:
        spacing = self.spacing / scale
        is_pair = spacing > 0
        # The normal points out of the copper: bright copper falls along it, a bright trace begins with a rising edge.
        polarity = np.where(is_pair, 1.0, -1.0) * (1.0 if copper == "bright" else -1.0)
        least, greatest = np.maximum(0.6 * spacing - 2.0, 1.0), 1.4 * spacing + 2.0
        columns = [
            polarity,
            np.where(is_pair, least, 0.0),
            np.where(is_pair, greatest, 0.0),
            np.where(is_pair, 0.0, 1.0),
        ]
        rulers = np.column_stack([self.point - self.placement, self.normal, *columns])
        of = self.fiducials
        fiducials, drilled = np.column_stack([of.point - self.placement, of.radius]), of.hole > 0
        return CameraFeatures(
            rulers=_tuples(rulers),
            matched=_tuples(fiducials[~drilled]),
            drilled=_tuples(fiducials[drilled]),
            placement=(float(self.placement[0]), float(self.placement[1])),
            pixel_size=scale,
            frame_shape=frame_shape,
            mirrored=self.side == "bottom",
            model=model,
        )

    def ruler_length(
        self, scale: float, blur_px: float, search_px: float | None = None, magnification: float = 1.0
    ) -> int:
        """Return the number of samples of all rulers: a multiple of 16, so that few lengths are built.

        Parameters
        ----------
        scale, blur_px, search_px
            As ``pixel_size``, ``blur_px`` and ``search_px`` of `bind`.
        magnification : float
            Largest magnification of the lens in the image. Default 1.
        """
        smoothing = self.imaging.smoothing_ratio * blur_px
        if search_px is None:
            lengths = self.length / scale * magnification
        else:
            lengths = 2 * (search_px + 3 * smoothing) + 3 + self.spacing / scale * magnification
        longest = max(float(lengths.max(initial=0.0)), 2 * math.ceil(3 * smoothing) + 3)
        return min(16 * math.ceil(longest / 16), MAX_LENGTH)

    def _fiducial_search_px(self, scale: float, etch_bias_sigma: float, magnification: float) -> float:
        distance = float(search_distance(self.fiducials.point, self.placement, self.imaging).max(initial=0.0))
        return min(
            (distance + _FIDUCIAL_SIGMAS * etch_bias_sigma) / scale * magnification + _FIDUCIAL_SLACK_PX,
            _MAX_FIDUCIAL_SEARCH_PX,
        )

    def _fiducial_smoothing(self, which: npt.NDArray[np.bool_], scale: float, blur_px: float) -> float:
        smallest = float(self.fiducials.radius[which].min(initial=math.inf)) / scale
        return min(fiducial_smoothing(blur_px), smallest / 2.5)

    def _solver(self, etch_bias_sigma: float | None, scale: float, search_px: float | None) -> SolvePose:
        shift = self.imaging.shift if search_px is None else search_px * scale
        return SolvePose(
            scale=None,
            min_scale=1.0,
            etch_bias_sigma=etch_bias_sigma,
            search_range=(_RANGE_FACTOR * shift, _RANGE_FACTOR * max(self.imaging.angle, _MIN_ANGLE)),
        )


def _tuples(rows: Float64) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, rows.tolist()))


def edge_clearance(imaging: Imaging) -> float:
    """Return the distance that edges must keep from silk and mask openings [m], a parameter of `read_artwork`.

    It is the largest offset of these layers, ``imaging.registration``, plus two blurs.
    """
    return imaging.registration + 2 * imaging.blur_px * imaging.pixel


def choose_features(
    artwork: Artwork,
    region: npt.ArrayLike,
    imaging: Imaging,
    *,
    placement: npt.ArrayLike | None = None,
    budget: float = 60,
    unit: BudgetUnit = "rulers",
    missing: float = 0.0,
    device: Device | None = None,
) -> FeatureSet:
    """Select the features of a region that determine a board's pose best.

    Parameters
    ----------
    artwork : Artwork
        The board's side.
    region : array_like
        (2, 2) least and greatest x, y [m].
    imaging : Imaging
        Image quality and search range.
    placement : array_like, optional
        (2,) point whose pose counts [m]; None: the centre of the region.
    budget, unit : float, {"rulers", "px", "us"}
        Limit of the cost: number of "rulers" (a fiducial costs 16), "px" sampled pixels, or "us" microseconds on the
        device, measured now, with one launch.
    missing : float
        Expected share of features without a measurement, 0 to below 1. Default 0.0.
    device : Device, optional
        Device for microseconds; None: `Device.best`.

    Returns
    -------
    FeatureSet
        Chosen features, with the predicted covariance of the pose.

    Raises
    ------
    ValueError
        The features of the region do not determine x, y and theta, or the budget is too small.
    """
    box = np.asarray(region, np.float64)
    place = box.mean(axis=0) if placement is None else np.asarray(placement, np.float64)
    rulers, fiducials = (
        find_ruler_candidates(artwork, box, place, imaging),
        select_fiducials(artwork, box, place, imaging),
    )
    if len(rulers.sigma) + 2 * len(fiducials.sigma) < 3:
        raise ValueError(
            f"{len(rulers.sigma)} edges of the region have room for a ruler, expected 3 or more, and "
            f"{len(fiducials.sigma)} round pads can serve as fiducials; give a larger region, a smaller pixel or blur, "
            "or less shift"
        )
    return select_feature_set(
        rulers, imaging, artwork.side, fiducials=fiducials, budget=budget, unit=unit, missing=missing, device=device
    )


def select_feature_set(
    rulers: FeatureCandidates,
    imaging: Imaging,
    side: Side,
    *,
    budget: float,
    fiducials: Fiducials | None = None,
    are_free: bool = False,
    unit: BudgetUnit = "rulers",
    missing: float = 0.0,
    device: Device | None = None,
) -> FeatureSet:
    """Select among rulers and fiducials; with ``are_free`` the fiducials have no cost. See `choose_features`."""
    if unit not in UNITS:
        raise ValueError(f"the budget's unit is {unit!r}, expected one of {', '.join(UNITS)}")
    fiducials = Fiducials.empty() if fiducials is None else fiducials
    both = append_fiducials(rulers, fiducials, imaging)
    costs = np.where(both.radius > 0, SPOKES, 1.0)
    if unit == "px":
        costs = both.pixels(imaging)
    elif unit == "us":
        launch, per_pixel = _microseconds(rulers, imaging, device)
        costs, budget = per_pixel * both.pixels(imaging), budget - launch
    if unit == "rulers":
        budget = min(budget, MAX_ROWS - (2 * len(fiducials.radius) if are_free else 0))
    if budget <= 0:
        raise ValueError("the budget is used up before the first ruler; give a larger one")
    # Where there are few traces, allow the number of rulers on each that the budget needs.
    affordable = budget / float(costs[both.radius == 0].mean()) if len(rulers.radius) else 0.0
    each = max(_PER_SOURCE, math.ceil(2 * affordable / max(len(np.unique(rulers.source)), 1)))
    if are_free and len(fiducials.radius):
        costs = np.where(both.radius > 0, _FREE_COST * budget, costs)
        budget *= 1 + (len(fiducials.radius) + 1) * _FREE_COST
    chosen = select_rulers(both, imaging, budget, costs=costs, missing=missing, per_source=each)
    rows = len(chosen.chosen) + int(np.sum(both.radius[chosen.chosen] > 0))
    if rows > MAX_ROWS:
        raise ValueError(f"{rows} rows (a fiducial has two) fit the budget, one pose takes {MAX_ROWS} at most")
    return FeatureSet.from_selection(both, chosen, imaging, side, fiducials)


def _microseconds(rulers: FeatureCandidates, imaging: Imaging, device: Device | None) -> tuple[float, float]:
    """Return the time of a launch and of a pixel of a ruler [us]: fastest of 20 calls with few and with many rulers."""
    device = Device.best() if device is None else device
    median_length = float(np.median(rulers.length)) if len(rulers.length) else 0.0
    length = min(
        max(math.ceil(median_length / imaging.pixel), 2 * math.ceil(3 * imaging.smoothing_px) + 3),
        MAX_LENGTH,
    )
    smoothing = min(imaging.smoothing_px, (length - 3) / 6.5)
    ruler = RulerEdges(threshold=10.0, length=length, width=imaging.width_px, smoothing_px=smoothing)
    image = np.random.default_rng(1).integers(0, 255, (600, 800), np.uint8)
    placed = np.tile(np.array([400.3, 300.6, 0.8, 0.6], np.float32), (_TIMED_RULERS, 1))
    durations = []
    for count in (_TIMED_RULERS // 8, _TIMED_RULERS):
        bound = replace(ruler, count=count).bind(device, image.shape, image.dtype)
        bound.inputs[0].set(image)
        bound.inputs[1].set(placed[:count])
        times = []
        for _ in range(_TIMED_CALLS):
            start = time.perf_counter()
            bound.run()
            times.append(time.perf_counter() - start)
        durations.append(1e6 * min(times))
    per_ruler = max((durations[1] - durations[0]) / (_TIMED_RULERS - _TIMED_RULERS // 8), 1e-3)
    return max(durations[0] - per_ruler * (_TIMED_RULERS // 8), 0.0), per_ruler / (length * imaging.width_px)
