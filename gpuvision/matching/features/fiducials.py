"""Round fiducials of a board: fiducials, vias and other round pads with a visible copper contour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork, Pad
from gpuvision.matching.artwork.shapes import Float64, is_covered
from gpuvision.matching.artwork.visible_layers import VisibleLayer, layer_edges_along, visible_layers
from gpuvision.matching.features.candidates import SAME_EDGE, FeatureCandidates
from gpuvision.matching.features.imaging import Imaging

SPOKES = 16  # rulers of a fiducial
MIN_RADIUS_PX = 4.0
"""Least radius of a fiducial [px] (chosen): with less, the blur hides the radius."""
# Smoothing of the contour in blurs: less than the best for an isolated edge, which would need more room around it.
_SMOOTHING_BLURS = 1.5
_VISIBLE_SHARE = 0.75  # least share of the contour: a trace may end in a pad (chosen)
_CLEAR_BLURS, _CLEAR_PX = 5.0, 2.0  # free distance around the contour: `FindBlobs` matches the pixels within it
# Standard deviation over the Cramer-Rao bound: of matched pixels, and of edges at this smoothing (measured).
_MATCHED_RATIO, _EDGES_RATIO = 1.1, 1.3
_FIRST_SOURCE = -(10**6)  # `FeatureCandidates.source` of the first fiducial: rulers have greater numbers


@dataclass(frozen=True, kw_only=True)
class FiducialLimits:
    """Thresholds of the detection of fiducials.

    Parameters
    ----------
    matched_sigma_px, edges_sigma_px
        Standard deviation of the error that remains without noise [px], of matched pixels, and of a fit to edges, which
        a trace that ends at the contour disturbs (measured). Defaults 0.003 and 0.02.
    size_tolerance_px, size_sigmas
        Largest difference between the measured and the drawn radius: pixels, plus this multiple of the etch bias'
        standard deviation (chosen). Defaults 1.0 and 4.0.
    """

    matched_sigma_px: float = 0.003
    edges_sigma_px: float = 0.02
    size_tolerance_px: float = 1.0
    size_sigmas: float = 4.0


class Fiducials(NamedTuple):
    """Round pads that serve as fiducials, (n, ...).

    Attributes
    ----------
    point : (n, 2)
        Centres [m].
    radius : (n,)
        Radius as drawn [m].
    hole : (n,)
        Diameter of the hole [m], 0 without one; with a hole only the contour is measured.
    sigma : (n,)
        Predicted standard deviation of x, and of y [m].
    """

    point: Float64
    radius: Float64
    hole: Float64
    sigma: Float64

    @classmethod
    def empty(cls) -> Fiducials:
        """Return no fiducials."""
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))

    def subset(self, which: npt.ArrayLike) -> Fiducials:
        """Return some of the fiducials, by indices or by a mask."""
        return Fiducials(*(each[np.asarray(which)] for each in self))


def fiducial_smoothing(blur_px: float) -> float:
    """Return the smoothing of the contours of fiducials [px] for a blur [px]."""
    return _SMOOTHING_BLURS * blur_px


def search_distance(centre: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging) -> Float64:
    """Return the largest distance (...,) [m] of fiducials at centres (..., 2) [m] from their expected places."""
    arm = np.asarray(centre, np.float64) - np.asarray(placement, np.float64)
    return np.asarray(math.sqrt(2.0) * imaging.shift + imaging.angle * np.hypot(arm[..., 0], arm[..., 1]))


def select_fiducials(
    artwork: Artwork, region: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging, max_count: int | None = None
) -> Fiducials:
    """Return round pads of a region whose contour is visible for three quarters or more, with free space around it.

    Inside the contour there is only copper, or a concentric hole far enough from it. The surroundings are bare
    laminate, or laminate under the mask if the pad is also under the mask. Pads that a mask opening cuts, or that lie
    near the edge of a mask opening, are excluded. Where another round pad is so near that the two may be confused, both
    are excluded.

    Parameters
    ----------
    artwork
        Result of `read_artwork`.
    region
        (2, 2) least and greatest x, y [m]: the fiducials lie in it with their search windows.
    placement
        (2,) point about which the board may be turned [m].
    imaging
        Image quality and search range.
    max_count
        Largest number, in order: fiducials first, then the pads farthest from the pads that are already selected. None:
        all.
    """
    box = np.asarray(region, np.float64)
    layers = visible_layers(artwork, imaging.registration)
    rounds = [each for each in artwork.pads if each.shape == "circle"]
    centres = np.array([each.centre for each in rounds]).reshape(-1, 2)
    reach = search_distance(centres, placement, imaging)
    kept: list[tuple[Float64, float, float, float]] = []
    for index in _spread(rounds, centres, np.asarray(placement, np.float64)):
        pad, radius = rounds[index], float(rounds[index].size[0]) / 2
        margin = radius + reach[index] + _clear(imaging)
        away = np.hypot(*(centres - centres[index]).T)
        away[index] = math.inf
        is_there = np.all(pad.centre - margin >= box[0]) and np.all(pad.centre + margin <= box[1])
        is_alone = away.min(initial=math.inf) > 2 * reach[index]
        if radius < MIN_RADIUS_PX * imaging.pixel or not (is_there and is_alone):
            continue
        if _is_free(layers, pad, radius, imaging):
            is_bare = not artwork.mask or _covers(layers[1], pad.centre)
            kept.append((pad.centre, radius, pad.hole, _sigma(pad, radius, is_bare, imaging)))
        if len(kept) == max_count:
            break
    if not kept:
        return Fiducials.empty()
    return Fiducials(*(np.array(each, np.float64) for each in zip(*kept, strict=True)))


def _spread(pads: list[Pad], centres: Float64, placement: Float64) -> Iterator[int]:
    """Yield indices: fiducials first, then other pads, each time the one farthest from the previous ones."""
    away = np.hypot(*(centres - placement).T)
    for is_fiducial in (True, False):
        left = np.array([(each.role == "fiducial") == is_fiducial for each in pads], np.bool_)
        while left.any():
            index = int(np.argmax(np.where(left, away, -1.0)))
            left[index] = False
            away = np.minimum(away, np.hypot(*(centres - centres[index]).T))
            yield index


def _clear(imaging: Imaging) -> float:
    """Return the distance around the contour [m] that must be free of other objects."""
    return (_CLEAR_BLURS * imaging.max_blur_px + _CLEAR_PX) * imaging.pixel


def _is_free(layers: tuple[VisibleLayer, ...], pad: Pad, radius: float, imaging: Imaging) -> bool:
    """Return whether spokes, in to the centre or to the hole, cross the contour only, or copper of a trace."""
    smoothing = math.hypot(fiducial_smoothing(imaging.blur_px), imaging.max_blur_px)
    # An edge 3.5 standard deviations of its gradient away shifts the contour by less than 0.01 px.
    inwards = 3.5 * smoothing * imaging.pixel if pad.hole > 0 else radius
    if inwards > radius - pad.hole / 2:
        return False
    outwards, hidden = max(_clear(imaging), inwards if pad.hole > 0 else 0.0), 0
    spokes = 2 * SPOKES
    for angle in np.arange(spokes) * (2 * math.pi / spokes):
        direction = np.array([math.cos(angle), math.sin(angle)])
        contours = _contours(layers, pad.centre + radius * direction, direction, -inwards, outwards)
        if contours is None:
            return False
        hidden += contours == 0
        if hidden > (1 - _VISIBLE_SHARE) * spokes:
            return False
    return True


def _contours(layers: tuple[VisibleLayer, ...], point: Float64, way: Float64, low: float, high: float) -> int | None:
    """Return 1 where copper ends at the contour, 0 where a trace continues it, None where another edge is found."""
    contours = 0
    for number, visible in enumerate(layers):
        margin = math.sqrt(2.0) * visible.max_offset
        place, ends = layer_edges_along(visible.layer, point, way, max(-low, high) + margin)
        in_region = (place > low - margin) & (place < high + margin)
        # A search beyond the centre of a pad without a hole would find the opposite side of the contour.
        place, ends = place[in_region], ends[in_region]
        if number == 0 and len(place) == 1 and ends[0] and place[0] > -SAME_EDGE:
            contours = int(place[0] < SAME_EDGE)
        elif len(place):
            return None
    return contours


def _covers(visible: VisibleLayer, point: Float64) -> bool:
    micrometre = np.array([1e-6, 0.0])
    crossings = visible.layer.crossings(point - micrometre, point + micrometre)
    return bool(is_covered(crossings, np.array([0.5]))[0])


def _sigma(pad: Pad, radius: float, is_bare: bool, imaging: Imaging) -> float:
    """Return the standard deviation of x [m]: of lines side by side around the contour, or of the spokes."""
    contrast = imaging.contrast_bare if is_bare else imaging.contrast_masked
    line = math.sqrt(2.0 * math.sqrt(math.pi) * imaging.max_blur_px) / contrast
    lines = 2.0 * math.pi * radius / imaging.pixel
    over, count = (_EDGES_RATIO, min(SPOKES, lines)) if pad.hole > 0 else (_MATCHED_RATIO, lines)
    return float(over * line / math.sqrt(count / 2.0) * imaging.pixel)


def append_fiducials(rulers: FeatureCandidates, fiducials: Fiducials, imaging: Imaging) -> FeatureCandidates:
    """Return candidates for `select_rulers`: the rulers, and the fiducials after them."""
    count = len(fiducials.radius)
    reach = search_distance(fiducials.point, rulers.placement, imaging)
    more = FeatureCandidates(
        point=fiducials.point,
        normal=np.tile([1.0, 0.0], (count, 1)),
        sigma=fiducials.sigma,
        pair=np.ones(count, np.bool_),
        length=2 * (fiducials.radius + reach + _clear(imaging)),
        ambiguity=np.zeros(count),
        source=_FIRST_SOURCE - np.arange(count),
        spacing=np.zeros(count),
        radius=fiducials.radius,
        placement=rulers.placement,
    )
    joined = [np.concatenate(each) for each in zip(rulers[:-1], more[:-1], strict=True)]
    return FeatureCandidates._make([*joined, rulers.placement])
