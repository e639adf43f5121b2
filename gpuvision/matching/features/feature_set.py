"""Feature sets: rulers and fiducials of a board, selected from its artwork before an image is taken.

``gpuvision select`` writes a feature set and the imaging for which it was selected; ``gpuvision locate --features``
reads it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, Side
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates
from gpuvision.matching.features.fiducials import SPOKES, Fiducials, append_fiducials, select_fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import MAX_LENGTH, RulerEdges
from gpuvision.matching.features.selection import Selection, select_rulers

Float64 = npt.NDArray[np.float64]
BudgetUnit = Literal["rulers", "px", "us"]
UNITS: tuple[str, ...] = get_args(BudgetUnit)
_TIMED_RULERS, _TIMED_CALLS = 256, 20
_PER_SOURCE = 4  # default of `select_rulers`
_FREE_COST = 1e-9  # cost of a free fiducial relative to the budget: costs must be positive
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
    artwork
        The board's side.
    region
        (2, 2) least and greatest x, y [m].
    imaging
        Image quality and search range.
    placement
        (2,) point whose pose counts [m]; None: the centre of the region.
    budget, unit
        Limit of the cost: number of "rulers" (a fiducial costs 16), "px" sampled pixels, or "us" microseconds on the
        device, measured now, with one launch.
    missing
        Expected share of features without a measurement, 0 to below 1.
    device
        Device for microseconds; None: `Device.best`.

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
            f"{len(rulers.sigma)} edges of the region have room for a ruler, expected 3 or more; give a larger "
            "region, a smaller pixel or blur, or less shift"
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
