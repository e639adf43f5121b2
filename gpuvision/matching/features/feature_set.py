"""Features of a board that are chosen before it is seen, and the file that keeps them.

``gpuvision select`` writes what ``gpuvision locate --features`` reads: rulers, and the imaging they were chosen for.
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
from gpuvision.matching.features.fiducials import SPOKES, Marks, marks_of, with_marks
from gpuvision.matching.features.ruler import LONGEST, RulerEdges, best_smoothing
from gpuvision.matching.features.selection import Candidates, Imaging, Selection, candidates, select

Float64 = npt.NDArray[np.float64]
BudgetUnit = Literal["rulers", "px", "us"]
UNITS: tuple[str, ...] = get_args(BudgetUnit)
_TIMED_RULERS, _TIMED_CALLS = 256, 20
_PER_SOURCE = 4
_NOTHING = 1e-9  # of the budget
MOST_ROWS = 1000  # that one pose is solved from: one of a ruler, two of a mark


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureSet:
    """Rulers and round marks on one side of a board, and what they promise.

    Attributes
    ----------
    side
        Of the board.
    placement
        (2,) the point whose pose counts [m].
    point, normal
        (n, 2) middles on the board [m], and unit directions along which the rulers look: out of the copper.
    spacing
        (n,) of the two edges that a ruler lies across [m]; 0 where it is one.
    length
        (n,) along the normal [m].
    sigma
        (n,) of the place that each measures [m], predicted.
    imaging
        What they were chosen for.
    covariance
        (3, 3) predicted, of the placement point's x, y [m] and theta [rad].
    condition
        Worst standard deviation over best.
    region
        (2, 2) least and greatest x, y [m] that they sample: what the camera must read.
    marks
        Vias, fiducials and other round lands.
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
    marks: Marks = field(default_factory=Marks.none)

    @classmethod
    def of(
        cls, rulers: Candidates, chosen: Selection, imaging: Imaging, side: Side, marks: Marks | None = None
    ) -> FeatureSet:
        """Return what was chosen of rulers, and of marks that come after them (`with_marks`)."""
        is_mark = rulers.radius[chosen.chosen] > 0
        kept, first = chosen.chosen[~is_mark], len(rulers.radius) - (0 if marks is None else len(marks.radius))
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
            marks=Marks.none() if marks is None else marks.only(chosen.chosen[is_mark] - first),
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
        """Return what was chosen and what it promises, in two lines."""
        sx, sy, turn = self.sigmas
        pairs = int(np.sum(self.spacing > 0))
        columns, rows = self.region_px
        marks = f" and {len(self.marks.radius)} marks" if len(self.marks.radius) else ""
        return (
            f"{len(self.length)} rulers ({pairs} across traces){marks}, {int(self._pixels().sum())} px, in a region of "
            f"{columns} x {rows} px\n"
            f"predicted at ({1e3 * self.placement[0]:.3f}, {1e3 * self.placement[1]:.3f}) mm: sigma x {1e6 * sx:.2f} "
            f"µm, y {1e6 * sy:.2f} µm, theta {1e3 * turn:.4f} mrad"
        )

    def _pixels(self) -> Float64:
        return np.asarray(np.ceil(self.length / self.imaging.pixel) * self.imaging.width_px)


def clearance_of(imaging: Imaging) -> float:
    """Return how far edges must be from silk and from the mask's openings [m], as `read_artwork` takes it.

    Both may be printed off by ``imaging.registration``, and blur.
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
    """Choose the features of a region that fix a board's pose best.

    Parameters
    ----------
    artwork, imaging
        The board's side, and the camera.
    region
        (2, 2) least and greatest x, y [m].
    placement
        (2,) the point whose pose counts [m]; None: the region's middle.
    budget, unit
        What may be spent: a number of rulers, pixels that they sample, or microseconds as rulers take them on the
        device (measured now, a launch counted once).
    missing
        Share of the features that will not be found.
    device
        For microseconds; None: the best.

    Raises
    ------
    ValueError
        What is there does not fix x, y and theta, or the budget is too small.
    """
    box = np.asarray(region, np.float64)
    place = box.mean(axis=0) if placement is None else np.asarray(placement, np.float64)
    rulers, marks = candidates(artwork, box, place, imaging), marks_of(artwork, box, place, imaging)
    if len(rulers.sigma) + 2 * len(marks.sigma) < 3:
        raise ValueError(
            f"{len(rulers.sigma)} edges of the region stand free enough for a ruler, expected 3 or more; give a larger "
            "region, a smaller pixel or blur, or less shift"
        )
    return chosen_of(
        rulers, imaging, artwork.side, marks=marks, budget=budget, unit=unit, missing=missing, device=device
    )


def chosen_of(
    rulers: Candidates,
    imaging: Imaging,
    side: Side,
    *,
    budget: float,
    marks: Marks | None = None,
    are_free: bool = False,
    unit: BudgetUnit = "rulers",
    missing: float = 0.0,
    device: Device | None = None,
) -> FeatureSet:
    """Choose among rulers that could be laid, and marks: all of them where they are free; see `choose_features`."""
    if unit not in UNITS:
        raise ValueError(f"the budget's unit is {unit!r}, expected one of {', '.join(UNITS)}")
    marks = Marks.none() if marks is None else marks
    both = with_marks(rulers, marks, imaging)
    costs = np.where(both.radius > 0, SPOKES, 1.0)
    if unit == "px":
        costs = both.pixels(imaging)
    elif unit == "us":
        launch, per_pixel = _microseconds(rulers, imaging, device)
        costs, budget = per_pixel * both.pixels(imaging), budget - launch
    if unit == "rulers":
        budget = min(budget, MOST_ROWS - (2 * len(marks.radius) if are_free else 0))
    if budget <= 0:
        raise ValueError("the budget is used up before the first ruler; give a larger one")
    # Enough of each trace for the budget, where there are few.
    affordable = budget / float(costs[both.radius == 0].mean()) if len(rulers.radius) else 0.0
    each = max(_PER_SOURCE, math.ceil(2 * affordable / max(len(np.unique(rulers.source)), 1)))
    if are_free and len(marks.radius):
        costs = np.where(both.radius > 0, _NOTHING * budget, costs)
        budget *= 1 + (len(marks.radius) + 1) * _NOTHING
    chosen = select(both, imaging, budget, costs=costs, missing=missing, per_source=each)
    rows = len(chosen.chosen) + int(np.sum(both.radius[chosen.chosen] > 0))
    if rows > MOST_ROWS:
        raise ValueError(f"{rows} rulers (marks twice) fit the budget, one pose takes {MOST_ROWS} at most")
    return FeatureSet.of(both, chosen, imaging, side, marks)


def _microseconds(rulers: Candidates, imaging: Imaging, device: Device | None) -> tuple[float, float]:
    """Return what a launch takes, and each pixel of a ruler: from a few rulers and from many, the fastest of 20."""
    device = Device.best() if device is None else device
    usual = float(np.median(rulers.length)) if len(rulers.length) else 0.0
    length = min(max(math.ceil(usual / imaging.pixel), 2 * math.ceil(3 * best_smoothing(imaging.blur_px)) + 3), LONGEST)
    smoothing = min(best_smoothing(imaging.blur_px), (length - 3) / 6.5)
    ruler = RulerEdges(threshold=10.0, length=length, width=imaging.width_px, smoothing_px=smoothing)
    image = np.random.default_rng(1).integers(0, 255, (600, 800), np.uint8)
    lain = np.tile(np.array([400.3, 300.6, 0.8, 0.6], np.float32), (_TIMED_RULERS, 1))
    taken = []
    for count in (_TIMED_RULERS // 8, _TIMED_RULERS):
        bound = replace(ruler, count=count).bind(device, image.shape, image.dtype)
        bound.inputs[0].set(image)
        bound.inputs[1].set(lain[:count])
        times = []
        for _ in range(_TIMED_CALLS):
            start = time.perf_counter()
            bound.run()
            times.append(time.perf_counter() - start)
        taken.append(1e6 * min(times))
    per_ruler = max((taken[1] - taken[0]) / (_TIMED_RULERS - _TIMED_RULERS // 8), 1e-3)
    return max(taken[0] - per_ruler * (_TIMED_RULERS // 8), 0.0), per_ruler / (length * imaging.width_px)
