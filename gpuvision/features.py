"""Features of a board that are chosen before it is seen, and the file that keeps them.

``gpuvision select`` writes what ``gpuvision locate --features`` reads: rulers, and the imaging they were chosen for.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import tomli_w

from gpuvision.description import Section, read
from gpuvision.host import Device
from gpuvision.host.files import replacing
from gpuvision.matching.artwork import Artwork, Side
from gpuvision.matching.marks import SPOKES, Marks, marks_of, with_marks
from gpuvision.matching.ruler import LONGEST, RulerEdges, best_smoothing
from gpuvision.matching.selection import Candidates, Imaging, Selection, candidates, select

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

    def write(self, path: str | Path) -> None:
        """Write them as TOML, whole or not at all.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        sx, sy, turn = (float(each) for each in self.sigmas)
        table: dict[str, Any] = {
            "side": self.side,
            "placement": self.placement.tolist(),
            "imaging": asdict(self.imaging),
            "predicted": {
                "sigma_x": sx,
                "sigma_y": sy,
                "sigma_theta": turn,
                "condition": self.condition,
                "covariance": self.covariance.tolist(),
            },
            "region": {
                "least": self.region[0].tolist(),
                "greatest": self.region[1].tolist(),
                "columns_and_rows": list(self.region_px),
            },
            "ruler": [
                {
                    "point": self.point[number].tolist(),
                    "normal": self.normal[number].tolist(),
                    "spacing": float(self.spacing[number]),
                    "length": float(self.length[number]),
                    "sigma": float(self.sigma[number]),
                }
                for number in range(len(self.length))
            ],
            "mark": [
                {"point": point.tolist(), "radius": float(radius), "hole": float(hole), "sigma": float(sigma)}
                for point, radius, hole, sigma in zip(*self.marks, strict=True)
            ],
        }
        with replacing(path) as file:
            tomli_w.dump(table, file)

    def _pixels(self) -> Float64:
        return np.asarray(np.ceil(self.length / self.imaging.pixel) * self.imaging.width_px)


def read_features(path: str | Path) -> FeatureSet:
    """Read features as `FeatureSet.write` wrote them.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        It says something else; the message names the key.
    """
    top = read(Path(path))
    side: Side = top.choice("side", get_args(Side))
    placement = np.array(top.numbers("placement", "m", (2,)))
    imaging = _imaging(top, top.section("imaging"))
    predicted, region = top.section("predicted"), top.section("region")
    covariance = np.array(predicted.rows("covariance", "m, rad", 3))
    condition = predicted.number("condition", "", at_least=1.0)
    for name in ("sigma_x", "sigma_y", "sigma_theta"):
        predicted.number(name, "m, rad", above=0.0)
    predicted.finish()
    bounds = np.array([region.numbers(name, "m", (2,)) for name in ("least", "greatest")])
    region.numbers("columns_and_rows", "pixel", (2,))
    region.finish()
    rows = [_ruler(table) for table in top.sections("ruler")]
    marks = _marks(top.sections("mark"))
    top.finish()
    if not 3 <= len(rows) + 2 * len(marks.radius) <= MOST_ROWS:
        raise top.error(
            f"{len(rows)} tables [[ruler]] and {len(marks.radius)} [[mark]], expected 3 to {MOST_ROWS}, of marks half "
            "as many"
        )
    point, normal, spacing, length, sigma = (
        np.array([row[column] for row in rows], np.float64).reshape(-1, *shape)
        for column, shape in enumerate(((2,), (2,), (), (), ()))
    )
    return FeatureSet(
        side=side,
        placement=placement,
        point=point,
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        spacing=spacing,
        length=length,
        sigma=sigma,
        imaging=imaging,
        covariance=covariance,
        condition=condition,
        region=bounds,
        marks=marks,
    )


def _imaging(top: Section, table: Section) -> Imaging:
    given: dict[str, Any] = {}
    for each in fields(Imaging):
        if isinstance(each.default, tuple):
            given[each.name] = table.numbers(each.name, "", (len(each.default),))
        elif isinstance(each.default, int):
            given[each.name] = table.integer(each.name, at_least=1)
        else:
            given[each.name] = table.number(each.name, "", at_least=0.0)
    table.finish()
    try:
        return Imaging(**given)
    except ValueError as error:
        raise top.error(f"[imaging]: {error}") from None


def _ruler(table: Section) -> tuple[Any, ...]:
    point, normal = table.numbers("point", "m", (2,)), table.numbers("normal", "", (2,))
    row = (point, normal, table.number("spacing", "m", at_least=0.0))
    row += (table.number("length", "m", above=0.0), table.number("sigma", "m", above=0.0))  # type: ignore[assignment]
    table.finish()
    if math.hypot(*normal) < 0.5:
        raise table.error(f"{table.dotted('normal')} is {normal}, expected a direction of length 1")
    return row


def _marks(tables: tuple[Section, ...]) -> Marks:
    rows = []
    for table in tables:
        row = (table.numbers("point", "m", (2,)), table.number("radius", "m", above=0.0))
        rows.append((*row, table.number("hole", "m", at_least=0.0), table.number("sigma", "m", above=0.0)))
        table.finish()
    return Marks(*(np.array(each) for each in zip(*rows, strict=True))) if rows else Marks.none()


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
