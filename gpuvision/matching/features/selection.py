"""Where to put rulers on a board, chosen before it is seen: the few that fix its pose best.

An edge with the unit normal n through p, measured with the standard deviation sigma along n, says one thing of the
board's shift t and turn theta about the placement point: n . t + n . J p theta + e, p from that point and J a quarter
turn. e is how much wider than drawn all copper was etched on each side, one unknown for the whole board: an edge
measures it along with the pose, a ruler across both edges of a trace does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.matching.artwork.visible_layers import Sheet, sheets_of, steps_along

_ITSELF = 2e-6  # [m] within which a step is the edge that is looked for, to the chords of arcs
_WORST_CONDITION = 1e4  # worst standard deviation over best: beyond it a pose is refused


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """What the camera makes of an edge, and how far the board may be from where it is looked for.

    Parameters
    ----------
    pixel
        On the board [m].
    blur_px
        Standard deviation of the edges' blur [px], the extent of the pixels included (12^-1/2 px).
    motion_px
        x, y by which the picture is smeared [px]: edges across it are blurred more than the smoothing is for.
    contrast_bare, contrast_masked
        Step at an edge over the noise of a pixel, of bare copper and of copper under the mask.
    width_px
        Lines that a ruler averages.
    etch
        Standard deviation of how far copper was etched beside its drawn edge, the same all over the board [m].
    registration
        Greatest distance, along x and along y, of the mask, the silk and the holes from where they belong on the copper
        [m].
    shift, angle
        Greatest distance [m], along x and along y, and greatest angle [rad] from where the board is looked for.

    Raises
    ------
    ValueError
        A parameter that is not finite, or not positive (``motion_px``, ``etch``, ``registration``, ``angle`` may be 0).
    """

    pixel: float
    blur_px: float = 1.0
    motion_px: tuple[float, float] = (0.0, 0.0)
    contrast_bare: float = 40.0
    contrast_masked: float = 15.0
    width_px: int = 5
    etch: float = 10e-6
    registration: float = 50e-6
    shift: float = 100e-6
    angle: float = 5e-3

    def __post_init__(self) -> None:
        positive = (self.pixel, self.blur_px, self.contrast_bare, self.contrast_masked, self.width_px, self.shift)
        if not all(math.isfinite(each) and each > 0 for each in positive):
            raise ValueError("pixel, blur, contrasts, width and shift must be positive and finite")
        if not all(math.isfinite(each) and each >= 0 for each in (self.etch, self.registration, self.angle)):
            raise ValueError("etch, registration and angle must be finite and not negative")
        if len(self.motion_px) != 2 or not all(map(math.isfinite, self.motion_px)):
            raise ValueError("motion_px must be a finite x, y")

    @property
    def smoothing_px(self) -> float:
        """Best smoothing for an edge without motion: sqrt(5) blurs."""
        return math.sqrt(5.0) * self.blur_px

    @property
    def most_blur_px(self) -> float:
        """Standard deviation of the blur of edges across the motion [px]."""
        return math.hypot(self.blur_px, math.hypot(*self.motion_px) / math.sqrt(12.0))

    def sigma(self, bare: npt.ArrayLike, normal: npt.ArrayLike = (1.0, 0.0)) -> Float64:
        """Return the standard deviation [m] of an isolated edge with a normal (..., 2), at ``smoothing_px``.

        1.883 sqrt(blur) / (contrast sqrt(width)) pixels is the bound for Gaussian edges in white noise. A gradient's
        peak has (3/8) (a^2 + s^2)^3 / (a^5 s) of its variance for a smoothing a and a blur s: 1.2 times the bound
        without motion. A smear of a length m blurs edges across it by m / sqrt(12) more.
        """
        contrast = np.where(bare, self.contrast_bare, self.contrast_masked)
        smear = np.asarray(normal, dtype=np.float64) @ np.asarray(self.motion_px) / math.sqrt(12.0)
        blur = np.hypot(self.blur_px, smear)
        bound = np.sqrt(2 * math.sqrt(math.pi) * blur / self.width_px) / contrast
        worse = np.sqrt(3 / 8 * (self.smoothing_px**2 + blur**2) ** 3 / (self.smoothing_px**5 * blur))
        return np.asarray(worse * bound * self.pixel)


class Candidates(NamedTuple):
    """Rulers that could be laid.

    Attributes
    ----------
    point
        (n, 2) middle on the board [m]: on the edge, or between the two edges of a trace.
    normal
        (n, 2) unit, along which the ruler looks; out of the copper at a single edge.
    sigma
        (n,) of the measured place along the normal [m].
    pair
        (n,) bool: across both edges of a trace.
    length
        (n,) [m] so that the edge lies on it wherever the board is.
    ambiguity
        (n,) how likely another edge of the same sense lies on the ruler, and may be taken for the one that is meant:
        copper, ink or an opening that ends, or a hole that begins, for shifts along the normal that are all equally
        likely; 0 where none can.
    source
        (n,) the same number for rulers on one trace, or on one side of a land.
    spacing
        (n,) of the two edges of a pair, as drawn [m]; 0 at a single edge.
    radius
        (n,) of a round mark [m], of which x and y are measured, each with its sigma; 0 for a ruler. Its normal is the
        x axis, its length how far across it is looked for, in x and in y; it is a pair: etching does not move it.
    placement
        (2,) [m] the point whose pose counts.
    """

    point: Float64
    normal: Float64
    sigma: Float64
    pair: npt.NDArray[np.bool_]
    length: Float64
    ambiguity: Float64
    source: npt.NDArray[np.int64]
    spacing: Float64
    radius: Float64
    placement: Float64

    def pixels(self, imaging: Imaging) -> Float64:
        """(n,) how many pixels each ruler samples, or lie about a mark: a cost for :func:`select`."""
        long = np.ceil(self.length / imaging.pixel)
        return np.asarray(long * np.where(self.radius > 0, long, imaging.width_px))


class Selection(NamedTuple):
    """What was chosen, and what it promises.

    Attributes
    ----------
    chosen
        (k,) indices of the candidates, in the order in which they were chosen.
    covariance
        (3, 3) of the placement point's x, y [m] and theta [rad].
    cost
        Sum of the chosen costs.
    condition
        Worst standard deviation over best, the angle's at the mean distance of the chosen points.
    region
        (2, 2) least and greatest x, y [m] that the rulers sample: what the camera must read.
    """

    chosen: npt.NDArray[np.int64]
    covariance: Float64
    cost: float
    condition: float
    region: Float64

    @property
    def sigmas(self) -> Float64:
        """(3,) standard deviations of x, y [m] and theta [rad] at the placement point."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def candidates(artwork: Artwork, region: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging) -> Candidates:
    """Rulers across every edge of a region, side by side, and across both edges of traces where both can be seen.

    A ruler lies so that its whole width stays on the edge wherever the board is within ``imaging.shift``; edges cut by
    the mask, by silk or by other copper are cut already (:func:`~gpuvision.matching.artwork.artwork.read_artwork`; its
    clearance should be ``imaging.registration`` and two blurs). Edges with copper's, ink's, a hole's or an opening's
    next border nearer than 3 times the best smoothing, sqrt(5) blurs, and ``registration``, are left out: it would
    pull at them. All rulers may be laid as long as the longest.

    Parameters
    ----------
    artwork
        From :func:`~gpuvision.matching.artwork.artwork.read_artwork`.
    region
        (2, 2) least and greatest x, y [m]: the middles lie in it.
    placement
        (2,) [m] the point whose pose counts.
    imaging
        The camera.

    Raises
    ------
    ValueError
        A region without extent, or a placement that is not finite.
    """
    box, place = np.asarray(region, dtype=np.float64), np.asarray(placement, dtype=np.float64)
    if box.shape != (2, 2) or not np.all(np.isfinite(box)) or not np.all(box[1] > box[0]):
        raise ValueError("region must be finite ((x, y), (x, y)), the least first and the greatest second")
    if place.shape != (2,) or not np.all(np.isfinite(place)):
        raise ValueError("placement must be a finite x, y")
    layers = sheets_of(artwork, imaging.registration)
    rows = [
        row
        for row in [*_single_rows(artwork, imaging), *_pair_rows(artwork, imaging)]
        if np.all((row[0] >= box[0]) & (row[0] <= box[1])) and _is_isolated(layers, row, imaging)
    ]
    point = np.array([row[0] for row in rows]).reshape(-1, 2)
    normal = np.array([row[1] for row in rows]).reshape(-1, 2)
    pair = np.array([row[2] > 0 for row in rows], dtype=np.bool_)
    across = np.array([row[2] for row in rows], dtype=np.float64)
    bare = np.array([row[3] for row in rows], dtype=np.bool_)
    sigma = imaging.sigma(bare, normal) / np.where(pair, math.sqrt(2.0), 1.0)
    reach = imaging.shift * np.abs(normal).sum(axis=1) + imaging.angle * np.abs(_lever(point - place, normal))
    tails = 4 * math.hypot(imaging.most_blur_px, imaging.smoothing_px) * imaging.pixel
    length = 2 * (reach + tails) + across
    # An edge is found where the smoothing's reach is on the ruler. Of a trace's two edges the first one counts.
    found = (np.max(length - across, initial=0.0) / 2) - 3 * imaging.smoothing_px * imaging.pixel
    ambiguity = [
        _ambiguity(layers, *each, found)
        for each in zip(point + normal * across[:, None] / 2, normal, reach, strict=True)
    ]
    source = np.array([row[4] for row in rows], dtype=np.int64)
    chances = np.array(ambiguity, dtype=np.float64)
    return Candidates(point, normal, sigma, pair, length, chances, source, across, np.zeros(len(rows)), place)


_Row = tuple[Float64, Float64, float, bool, int]


def _single_rows(artwork: Artwork, imaging: Imaging) -> list[_Row]:
    edges = artwork.edges
    rows: list[_Row] = []
    for index in range(len(edges.width)):
        source = int(edges.trace[index]) if edges.trace[index] >= 0 else -1 - index
        for point in _along(edges.start[index], edges.end[index], imaging):
            rows.append((point, edges.normal[index], 0.0, bool(edges.bare[index]), source))
    return rows


def _pair_rows(artwork: Artwork, imaging: Imaging) -> list[_Row]:
    """Across both edges of a trace, where they can be seen side by side and are alike."""
    edges = artwork.edges
    rows: list[_Row] = []
    for first in np.flatnonzero(edges.trace >= 0):
        normal, origin = edges.normal[first], edges.start[first]
        axis = np.array([-normal[1], normal[0]])
        opposite = (edges.trace == edges.trace[first]) & (edges.normal @ normal < 0) & (edges.bare == edges.bare[first])
        span = np.sort([0.0, float((edges.end[first] - origin) @ axis)])
        if normal[0] < 0 or (normal[0] == 0 and normal[1] < 0):
            continue  # its opposite edge comes with the other normal
        for second in np.flatnonzero(opposite):
            ends = np.sort([(edges.start[second] - origin) @ axis, (edges.end[second] - origin) @ axis])
            low, high = max(span[0], ends[0]), min(span[1], ends[1])
            width = float(edges.width[first])
            middle = origin - normal * (width / 2)
            if high > low:
                for point in _along(middle + low * axis, middle + high * axis, imaging):
                    rows.append((point, normal, width, bool(edges.bare[first]), int(edges.trace[first])))
    return rows


def _along(start: Float64, end: Float64, imaging: Imaging) -> Float64:
    """(k, 2) middles of rulers side by side that stay on an edge wherever the board is."""
    length = math.dist(start, end)
    width = imaging.width_px * imaging.pixel
    free = length - width - 2 * imaging.shift
    if free < 0:
        return np.empty((0, 2))
    count = math.floor(free / width) + 1
    offset = (length - (count - 1) * width) / 2 + np.arange(count) * width
    return np.asarray(start + offset[:, None] * ((end - start) / length))


def _lever(point: Float64, normal: Float64) -> Float64:
    return np.asarray(point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0])


def _is_isolated(layers: tuple[Sheet, ...], row: _Row, imaging: Imaging) -> bool:
    """Whether no other step of any layer is so near to an edge as to pull it (see `RulerEdges.smoothing_px`)."""
    point, normal, across, _, _ = row
    reach = 3 * imaging.smoothing_px * imaging.pixel
    if 0 < across < reach:
        return False
    edges = (point,) if not across else (point - normal * across / 2, point + normal * across / 2)
    for sheet in layers:
        away = reach + sheet.off * float(np.abs(normal).sum())
        places = np.concatenate([steps_along(sheet.layer, edge, normal, away)[0] for edge in edges])
        if np.any(np.abs(places) > _ITSELF):
            return False
    return True


def _ambiguity(layers: tuple[Sheet, ...], point: Float64, normal: Float64, reach: float, found: float) -> float:
    """Chance that another edge of the same sense comes as near to a ruler's middle as edges are found.

    An edge at a distance a from the one that is meant does where the board is shifted by more than a less that the
    other way.
    """
    chance = 0.0
    for sheet in layers:
        off = sheet.off * float(np.abs(normal).sum())
        place, ends = steps_along(sheet.layer, point, normal, reach + found + off)
        away = np.abs(place[(ends != sheet.dark) & (np.abs(place) > _ITSELF)]) - off
        chance += float(np.sum(np.clip((reach + found - away) / (2 * reach), 0.0, 1.0)))
    return min(1.0, chance)


def select(
    rulers: Candidates,
    imaging: Imaging,
    budget: float,
    *,
    costs: Any = None,
    criterion: Literal["determinant", "placement"] = "determinant",
    per_source: int = 4,
    missing: float = 0.0,
) -> Selection:
    """Choose rulers one after the other, each time the one that gains most for its cost.

    The gain in the logarithm of the determinant is at least 1 - 1/e of the greatest possible one where all costs are
    equal, every source has room and ``imaging.etch`` is 0; otherwise, and for the variance, no such bound is known.

    Parameters
    ----------
    rulers
        From :func:`candidates`.
    imaging
        The camera; what is known before is its ``shift`` and ``angle``, equally likely throughout. It steers the first
        choices and does not count in what is promised.
    budget
        Sum of the costs that may be spent.
    costs
        (n,) positive, of each candidate: 1 (the budget is a number of rulers) by default, ``rulers.pixels(imaging)``,
        or microseconds as they were measured.
    criterion
        ``"determinant"`` of the pose's information, or ``"placement"``: the variance of the placement point's x and y.
    per_source
        Most rulers on one trace or side: what is missing or wrong there cannot take the others along.
    missing
        Share of the rulers that will find nothing, anywhere: counts in what is promised.

    Raises
    ------
    ValueError
        What was chosen does not fix x, y and theta: traces all parallel, too small a budget, too few edges.
    """
    price = _price(rulers, costs)
    if per_source < 1:
        raise ValueError(f"per_source must be 1 or more, not {per_source}")
    if criterion not in ("determinant", "placement"):
        raise ValueError(f"criterion must be 'determinant' or 'placement', not {criterion!r}")
    weight = _weight(rulers, missing)
    chosen = _greedy(weight, price, rulers, imaging, (budget, criterion, per_source))
    return promise(rulers, imaging, chosen, costs=costs, missing=missing)


def promise(
    rulers: Candidates, imaging: Imaging, chosen: npt.ArrayLike, *, costs: Any = None, missing: float = 0.0
) -> Selection:
    """Say what rulers would deliver that were chosen in another way: by hand, or at random.

    Parameters
    ----------
    rulers, imaging, costs, missing
        As in :func:`select`.
    chosen
        (k,) indices of the candidates.

    Raises
    ------
    ValueError
        They do not fix x, y and theta.
    """
    price, weight = _price(rulers, costs), _weight(rulers, missing)
    which = np.asarray(chosen, dtype=np.int64)
    covariance, condition = _promised(weight[which], rulers, which, imaging)
    return Selection(which, covariance, float(price[which].sum()), condition, _region(rulers, which, imaging))


def _price(rulers: Candidates, costs: Any) -> Float64:
    price = np.ones(len(rulers.sigma)) if costs is None else np.asarray(costs, dtype=np.float64)
    if price.shape != rulers.sigma.shape or not np.all(price > 0):
        raise ValueError(f"costs must be {len(rulers.sigma)} positive numbers, one for each candidate")
    return price


def _weight(rulers: Candidates, missing: float) -> Float64:
    if not 0 <= missing < 1:
        raise ValueError(f"missing must be in [0, 1), not {missing}")
    return np.asarray((1 - missing) * (1 - rulers.ambiguity) / rulers.sigma**2)


def _rows(rulers: Candidates) -> Float64:
    """(n, 4): what each ruler says of x, y, theta and the etching."""
    lever = _lever(rulers.point - rulers.placement, rulers.normal)
    return np.concatenate([rulers.normal, lever[:, None], np.where(rulers.pair, 0.0, 1.0)[:, None]], axis=1)


def _second_rows(rulers: Candidates) -> Float64:
    """(n, 4): what a mark says across its normal; zeros for rulers."""
    across = np.where(rulers.radius[:, None] > 0, np.stack([-rulers.normal[:, 1], rulers.normal[:, 0]], axis=1), 0.0)
    lever = _lever(rulers.point - rulers.placement, across)
    return np.concatenate([across, lever[:, None], np.zeros((len(lever), 1))], axis=1)


def _greedy(
    weight: Float64,
    price: Float64,
    rulers: Candidates,
    imaging: Imaging,
    limits: tuple[float, str, int],
) -> npt.NDArray[np.int64]:
    budget, criterion, per_source = limits
    rows, second = _rows(rulers), _second_rows(rulers)
    # Variances of what is equally likely within limits; of nothing, where no angle or etching is expected.
    prior = np.array([imaging.shift**2 / 3, imaging.shift**2 / 3, imaging.angle**2 / 3, imaging.etch**2])
    covariance, of_etch = np.diag(np.maximum(prior, 1e-18)), 1 / max(prior[3], 1e-18)
    used: dict[int, int] = {}
    free = weight > 0
    chosen: list[int] = []
    while True:
        free &= price <= budget
        if not free.any():
            return np.array(chosen, dtype=np.int64)
        seen, also = rows @ covariance, second @ covariance
        # The determinant of I + w R C R', R the two rows of a mark; a ruler's second one is 0.
        one, two = (1 + weight * np.einsum("ij,ij->i", *each) for each in ((seen, rows), (also, second)))
        mixed = weight * np.einsum("ij,ij->i", seen, second)
        total = one * two - mixed**2
        if criterion == "determinant":
            # Of the pose alone: what is learnt of the etching is none of its information.
            gain = np.log(total) - np.log1p(weight * rows[:, 3] ** 2 / of_etch)
        else:
            products = [np.sum(a[:, :2] * b[:, :2], axis=1) for a, b in ((seen, seen), (seen, also), (also, also))]
            gain = weight * (two * products[0] - 2 * mixed * products[1] + one * products[2]) / total
        best = int(np.argmax(np.where(free, gain / price, -np.inf)))
        chosen.append(best)
        for row in (rows[best], second[best]):
            pulled = covariance @ row
            covariance -= weight[best] / (1 + weight[best] * (row @ pulled)) * np.outer(pulled, pulled)
        of_etch += weight[best] * rows[best, 3] ** 2
        budget -= price[best]
        free[best] = False
        source = int(rulers.source[best])
        used[source] = used.get(source, 0) + 1
        if used[source] >= per_source:
            free &= rulers.source != source


def _promised(
    weight: Float64, rulers: Candidates, chosen: npt.NDArray[np.int64], imaging: Imaging
) -> tuple[Float64, float]:
    """Covariance without what was known before, and its condition; the etching is taken out."""
    if len(chosen) + int(np.sum(rulers.radius[chosen] > 0)) < 3:
        raise ValueError(f"{len(chosen)} rulers do not fix x, y and theta: give a larger budget or region")
    both = (_rows(rulers)[chosen], _second_rows(rulers)[chosen])
    information = np.asarray(sum((rows * weight[:, None]).T @ rows for rows in both))
    information[3, 3] += 1 / max(imaging.etch, 1e-9) ** 2
    pose = information[:3, :3] - np.outer(information[:3, 3], information[3, :3]) / information[3, 3]
    distance = max(float(np.hypot(*(rulers.point[chosen] - rulers.placement).T).mean()), imaging.pixel)
    metres = np.array([1.0, 1.0, 1 / distance])
    values = np.linalg.eigvalsh(pose * metres * metres[:, None])
    if not values[0] * _WORST_CONDITION**2 > values[2]:
        raise ValueError("these edges do not fix x, y and theta (all parallel, or all through one point)")
    return np.linalg.inv(pose), math.sqrt(values[2] / values[0])


def _region(rulers: Candidates, chosen: npt.NDArray[np.int64], imaging: Imaging) -> Float64:
    normal = np.abs(rulers.normal[chosen])
    wide = np.where(rulers.radius[chosen] > 0, rulers.length[chosen], imaging.width_px * imaging.pixel)
    half = normal * rulers.length[chosen, None] / 2 + normal[:, ::-1] * wide[:, None] / 2
    return np.stack([(rulers.point[chosen] - half).min(axis=0), (rulers.point[chosen] + half).max(axis=0)])
