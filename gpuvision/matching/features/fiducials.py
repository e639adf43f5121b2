"""Round marks of a board, vias, fiducials and lands, of which a camera sees the copper's own contour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork, Land
from gpuvision.matching.artwork.shapes import Float64, covered
from gpuvision.matching.artwork.visible_layers import Sheet, sheets_of, steps_along
from gpuvision.matching.features.selection import Candidates, Imaging

SPOKES = 16  # rulers of a mark
LEAST_RADIUS_PX = 4.0
_SMOOTHING = 1.5  # blurs: less than the best for a lone edge, next to which more room would have to be
_ITSELF = 2e-6  # [m] within which a step is the contour that is looked for
_FREE_SHARE = 0.75  # of the contour: a trace may end in a mark
_CLEAR_BLURS = 5.0, 2.0  # and pixels, about a mark: so far out its pixels are matched
_MATCHED, _EDGES = 1.1, 1.3  # standard deviations over the bound: of matched pixels, of edges at that smoothing
_SOURCE = -(10**6)  # numbers of marks in a list of candidates


class Marks(NamedTuple):
    """Marks of a board, (n, ...).

    Attributes
    ----------
    point
        (n, 2) centres [m].
    radius
        (n,) as drawn [m].
    hole
        (n,) diameter of the hole in them [m], 0 without one; with it only their contour is known.
    sigma
        (n,) of x, and of y, predicted [m].
    """

    point: Float64
    radius: Float64
    hole: Float64
    sigma: Float64

    @classmethod
    def none(cls) -> Marks:
        """Return no marks."""
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))

    def only(self, which: npt.ArrayLike) -> Marks:
        """Return some of them: indices, or which."""
        return Marks(*(each[np.asarray(which)] for each in self))


def mark_smoothing(blur_px: float) -> float:
    """Return the smoothing [px] that marks' contours are found with."""
    return _SMOOTHING * blur_px


def reach_of(centre: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging) -> Float64:
    """(...,) how far [m] marks may be from where they are looked for."""
    arm = np.asarray(centre, np.float64) - np.asarray(placement, np.float64)
    return np.asarray(math.sqrt(2.0) * imaging.shift + imaging.angle * np.hypot(arm[..., 0], arm[..., 1]))


def marks_of(
    artwork: Artwork, region: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging, most: int | None = None
) -> Marks:
    """Return marks of a region: round lands of whose contour three quarters or more can be seen, far from all else.

    Inside there is nothing but copper, or a hole in its middle that is far enough from the contour; about it lies bare
    laminate, or laminate under the mask, as the land itself lies: what a mask's opening cuts, or ends beside, is left
    out. Where another round land is so near that one may be taken for the other, neither counts.

    Parameters
    ----------
    artwork
        From `read_artwork`.
    region
        (2, 2) least and greatest x, y [m]: they lie in it with all that is looked at.
    placement
        (2,) the point about which the board may be turned [m].
    imaging
        The camera.
    most
        No more than so many, fiducials first, then those that are farthest from those chosen. None: all.
    """
    box = np.asarray(region, np.float64)
    sheets = sheets_of(artwork, imaging.registration)
    rounds = [each for each in artwork.lands if each.shape == "circle"]
    centres = np.array([each.centre for each in rounds]).reshape(-1, 2)
    reach = reach_of(centres, placement, imaging)
    kept: list[tuple[Float64, float, float, float]] = []
    for index in _spread(rounds, centres, np.asarray(placement, np.float64)):
        land, radius = rounds[index], float(rounds[index].size[0]) / 2
        margin = radius + reach[index] + _clear(imaging)
        away = np.hypot(*(centres - centres[index]).T)
        away[index] = math.inf
        is_there = np.all(land.centre - margin >= box[0]) and np.all(land.centre + margin <= box[1])
        is_alone = away.min(initial=math.inf) > 2 * reach[index]
        if radius < LEAST_RADIUS_PX * imaging.pixel or not (is_there and is_alone):
            continue
        if _is_free(sheets, land, radius, imaging):
            is_bare = not artwork.mask or _covers(sheets[1], land.centre)
            kept.append((land.centre, radius, land.hole, _sigma(land, radius, is_bare, imaging)))
        if len(kept) == most:
            break
    if not kept:
        return Marks.none()
    return Marks(*(np.array(each, np.float64) for each in zip(*kept, strict=True)))


def _spread(lands: list[Land], centres: Float64, placement: Float64) -> Iterator[int]:
    """Fiducials, then others; of either first the one that is farthest from the placement, then from all before."""
    away = np.hypot(*(centres - placement).T)
    for is_fiducial in (True, False):
        left = np.array([(each.role == "fiducial") == is_fiducial for each in lands], np.bool_)
        while left.any():
            index = int(np.argmax(np.where(left, away, -1.0)))
            left[index] = False
            away = np.minimum(away, np.hypot(*(centres - centres[index]).T))
            yield index


def _clear(imaging: Imaging) -> float:
    """Return how far out nothing may be [m]."""
    blurs, pixels = _CLEAR_BLURS
    return (blurs * imaging.most_blur_px + pixels) * imaging.pixel


def _is_free(sheets: tuple[Sheet, ...], land: Land, radius: float, imaging: Imaging) -> bool:
    """Whether nothing but the contour, or a trace's copper, is seen along spokes, in to the middle or the hole."""
    smoothing = math.hypot(mark_smoothing(imaging.blur_px), imaging.most_blur_px)
    # Another edge 3.5 deviations of its gradient away pulls by less than a hundredth of a pixel.
    inwards = 3.5 * smoothing * imaging.pixel if land.hole > 0 else radius
    if inwards > radius - (land.hole / 2 + imaging.registration if land.hole > 0 else 0.0):
        return False
    outwards, hidden = max(_clear(imaging), inwards if land.hole > 0 else 0.0), 0
    spokes = 2 * SPOKES
    for turn in np.arange(spokes) * (2 * math.pi / spokes):
        way = np.array([math.cos(turn), math.sin(turn)])
        contours = _contours(sheets, land.centre + radius * way, way, -inwards, outwards)
        if contours is None:
            return False
        hidden += contours == 0
        if hidden > (1 - _FREE_SHARE) * spokes:
            return False
    return True


def _contours(sheets: tuple[Sheet, ...], point: Float64, way: Float64, low: float, high: float) -> int | None:
    """Return 1 where copper ends on a spoke, at the contour, and 0 where it goes on there; None where more is seen."""
    contours = 0
    for number, sheet in enumerate(sheets):
        off = math.sqrt(2.0) * sheet.off
        place, ends = steps_along(sheet.layer, point, way, max(-low, high) + off)
        near = (place > low - off) & (place < high + off)
        # Beyond the middle of a mark without a hole its other side is seen.
        place, ends = place[near], ends[near]
        if number == 0 and len(place) == 1 and ends[0] and place[0] > -_ITSELF:
            contours = int(place[0] < _ITSELF)
        elif len(place):
            return None
    return contours


def _covers(sheet: Sheet, point: Float64) -> bool:
    beside = np.array([1e-6, 0.0])
    crossings = sheet.layer.crossings(point - beside, point + beside)
    return bool(covered(crossings, np.array([0.5]))[0])


def _sigma(land: Land, radius: float, is_bare: bool, imaging: Imaging) -> float:
    """Return the standard deviation of x [m]: of lines side by side round the contour, or of as many as spokes."""
    contrast = imaging.contrast_bare if is_bare else imaging.contrast_masked
    line = math.sqrt(2.0 * math.sqrt(math.pi) * imaging.most_blur_px) / contrast
    lines = 2.0 * math.pi * radius / imaging.pixel
    over, count = (_EDGES, min(SPOKES, lines)) if land.hole > 0 else (_MATCHED, lines)
    return float(over * line / math.sqrt(count / 2.0) * imaging.pixel)


def with_marks(rulers: Candidates, marks: Marks, imaging: Imaging) -> Candidates:
    """Candidates for `select`: the rulers, and the marks after them."""
    count = len(marks.radius)
    reach = reach_of(marks.point, rulers.placement, imaging)
    more = Candidates(
        point=marks.point,
        normal=np.tile([1.0, 0.0], (count, 1)),
        sigma=marks.sigma,
        pair=np.ones(count, np.bool_),
        length=2 * (marks.radius + reach + _clear(imaging)),
        ambiguity=np.zeros(count),
        source=_SOURCE - np.arange(count),
        spacing=np.zeros(count),
        radius=marks.radius,
        placement=rulers.placement,
    )
    joined = [np.concatenate(each) for each in zip(rulers[:-1], more[:-1], strict=True)]
    return Candidates._make([*joined, rulers.placement])
