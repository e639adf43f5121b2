"""Candidates of the feature selection: places on a board's artwork where calipers (rulers) have room."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.matching.artwork.visible_layers import VisibleLayer, layer_edges_along, visible_layers
from gpuvision.matching.features.imaging import Imaging

SAME_EDGE = 2e-6
"""Distance [m] within which a step of a layer is the measured edge itself: four times the chords' error of arcs."""


class FeatureCandidates(NamedTuple):
    """Rulers, and fiducials after them, that can be selected.

    Attributes
    ----------
    point : (n, 2)
        Centre on the board [m]: on the edge, or between the two edges of a trace.
    normal : (n, 2)
        Unit direction of the ruler; at a single edge it points out of the copper.
    sigma : (n,)
        Standard deviation of the measured position along the normal [m].
    pair : (n,), bool
        Whether the ruler lies across both edges of a trace.
    length : (n,)
        Length [m] at which the ruler covers the edge within the whole search range.
    ambiguity : (n,)
        Probability that another edge of the same sense (copper, ink or a mask opening that ends, or a hole that begins)
        is found instead, for shifts along the normal equally distributed over the search range.
    source : (n,)
        Equal numbers for rulers on one trace, or on one side of a pad.
    spacing : (n,)
        Distance between the two edges of a pair, as drawn [m]; 0 at a single edge.
    radius : (n,)
        Radius of a fiducial [m], of which x and y are measured, each with ``sigma``; 0 for a ruler. The normal of a
        fiducial is the x axis, its length the side of its search window, and ``pair`` is True: etching does not move
        it.
    placement : (2,)
        Point whose pose counts [m].
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
        """Return the pixels (n,) that each ruler samples, or of a fiducial's search window: a cost of the selection."""
        long = np.ceil(self.length / imaging.pixel)
        return np.asarray(long * np.where(self.radius > 0, long, imaging.width_px))


_FINER_PIXELS = (0.8, 0.65, 0.5, 0.35, 0.25)  # pixel sizes that a hint tries, relative to the given one (chosen)
_MIN_RULERS = 3  # as many as unknowns of a pose


def find_ruler_candidates(
    artwork: Artwork, region: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging
) -> FeatureCandidates:
    """Return rulers across every edge of a region, side by side, and across both edges of traces.

    The whole width of a ruler stays on the edge at every board position within ``imaging.shift``. The artwork has edges
    cut where the mask, silk or other copper ends them (its clearance should be ``imaging.registration`` and two blurs,
    see `edge_clearance`). Edges are excluded where another border of copper, ink, a hole or a mask opening is nearer
    than ``imaging.room_px`` plus ``registration``: it would shift the measurement. All rulers may have the
    length of the longest.

    Parameters
    ----------
    artwork
        Result of `read_artwork`.
    region
        (2, 2) least and greatest x, y [m] of the rulers' centres.
    placement
        (2,) point whose pose counts [m].
    imaging
        Image quality and search range.

    Raises
    ------
    ValueError
        The region has no extent, or the placement point is not finite.
    """
    box, place = np.asarray(region, dtype=np.float64), np.asarray(placement, dtype=np.float64)
    if box.shape != (2, 2) or not np.all(np.isfinite(box)) or not np.all(box[1] > box[0]):
        raise ValueError("region must be finite ((x, y), (x, y)), the least first and the greatest second")
    if place.shape != (2,) or not np.all(np.isfinite(place)):
        raise ValueError("placement must be a finite x, y")
    layers = visible_layers(artwork, imaging.registration)
    in_region = [*_single_rows(artwork, box, imaging), *_pair_rows(artwork, box, imaging)]
    rows = [row for row in in_region if _is_isolated(layers, row, imaging)]
    point = np.array([row[0] for row in rows]).reshape(-1, 2)
    normal = np.array([row[1] for row in rows]).reshape(-1, 2)
    pair = np.array([row[2] > 0 for row in rows], dtype=np.bool_)
    across = np.array([row[2] for row in rows], dtype=np.float64)
    bare = np.array([row[3] for row in rows], dtype=np.bool_)
    sigma = imaging.sigma(bare, normal) / np.where(pair, math.sqrt(2.0), 1.0)
    reach = imaging.shift * np.abs(normal).sum(axis=1) + imaging.angle * np.abs(lever_arm(point - place, normal))
    tails = 4 * math.hypot(imaging.max_blur_px, imaging.smoothing_px) * imaging.pixel
    length = 2 * (reach + tails) + across
    # An edge is found where the whole filter lies on the ruler. Of a trace's two edges the first one counts.
    found = (np.max(length - across, initial=0.0) / 2) - 3 * imaging.smoothing_px * imaging.pixel
    ambiguity = [
        _ambiguity(layers, *each, found)
        for each in zip(point + normal * across[:, None] / 2, normal, reach, strict=True)
    ]
    source = np.array([row[4] for row in rows], dtype=np.int64)
    probability = np.array(ambiguity, dtype=np.float64)
    return FeatureCandidates(
        point, normal, sigma, pair, length, probability, source, across, np.zeros(len(rows)), place
    )


def pixel_hint(artwork: Artwork, region: npt.ArrayLike, placement: npt.ArrayLike, imaging: Imaging) -> str:
    """Return a hint for a region without rulers: the room that an edge needs, and a pixel size that leaves it.

    See `find_ruler_candidates` for the parameters.
    """
    room = imaging.room_px * imaging.pixel + imaging.registration
    hint = f"an edge needs {1e6 * room:.0f} um without another edge on both sides"
    hint += f" at {1e6 * imaging.pixel:.3g} um per pixel"
    for factor in _FINER_PIXELS:
        pixel = factor * imaging.pixel
        count = len(find_ruler_candidates(artwork, region, placement, replace(imaging, pixel=pixel)).sigma)
        if count >= _MIN_RULERS:
            return f"{hint}; at {1e6 * pixel:.3g} um, {count} rulers have room"
    return hint


_Row = tuple[Float64, Float64, float, bool, int]


def _single_rows(artwork: Artwork, box: Float64, imaging: Imaging) -> list[_Row]:
    """Return rulers across single edges in a region (2, 2): point, normal, spacing, whether bare, source."""
    edges = artwork.edges
    rows: list[_Row] = []
    for index in np.flatnonzero(_touches(artwork, box)).tolist():
        source = int(edges.trace[index]) if edges.trace[index] >= 0 else -1 - index
        for point in _inside(_ruler_centres(edges.start[index], edges.end[index], imaging), box):
            rows.append((point, edges.normal[index], 0.0, bool(edges.bare[index]), source))
    return rows


def _pair_rows(artwork: Artwork, box: Float64, imaging: Imaging) -> list[_Row]:
    """Return rulers across both edges of a trace, where both are visible side by side, and both bare or both masked."""
    edges = artwork.edges
    rows: list[_Row] = []
    for first in np.flatnonzero((edges.trace >= 0) & _touches(artwork, box, edges.width)):
        normal, origin = edges.normal[first], edges.start[first]
        axis = np.array([-normal[1], normal[0]])
        opposite = (edges.trace == edges.trace[first]) & (edges.normal @ normal < 0) & (edges.bare == edges.bare[first])
        span = np.sort([0.0, float((edges.end[first] - origin) @ axis)])
        if normal[0] < 0 or (normal[0] == 0 and normal[1] < 0):
            continue  # the opposite edge is a candidate with the other normal
        for second in np.flatnonzero(opposite):
            ends = np.sort([(edges.start[second] - origin) @ axis, (edges.end[second] - origin) @ axis])
            low, high = max(span[0], ends[0]), min(span[1], ends[1])
            width = float(edges.width[first])
            middle = origin - normal * (width / 2)
            if high > low:
                for point in _inside(_ruler_centres(middle + low * axis, middle + high * axis, imaging), box):
                    rows.append((point, normal, width, bool(edges.bare[first]), int(edges.trace[first])))
    return rows


def _touches(artwork: Artwork, box: Float64, margin: npt.ArrayLike = 0.0) -> npt.NDArray[np.bool_]:
    """Return which edges may have a point in a region (2, 2) that is larger by a margin on all sides [m]."""
    ends = np.stack([artwork.edges.start, artwork.edges.end])
    more = np.expand_dims(np.asarray(margin, np.float64), -1)
    return np.asarray(np.all((ends.max(axis=0) >= box[0] - more) & (ends.min(axis=0) <= box[1] + more), axis=1))


def _inside(points: Float64, box: Float64) -> Float64:
    """Return the points (n, 2) in a region (2, 2)."""
    return points[np.all((points >= box[0]) & (points <= box[1]), axis=1)]


def _ruler_centres(start: Float64, end: Float64, imaging: Imaging) -> Float64:
    """Return (k, 2) centres of rulers side by side that stay on an edge at every board position."""
    length = math.dist(start, end)
    width = imaging.width_px * imaging.pixel
    free = length - width - 2 * imaging.shift
    if free < 0:
        return np.empty((0, 2))
    count = math.floor(free / width) + 1
    offset = (length - (count - 1) * width) / 2 + np.arange(count) * width
    return np.asarray(start + offset[:, None] * ((end - start) / length))


def _is_isolated(layers: tuple[VisibleLayer, ...], row: _Row, imaging: Imaging) -> bool:
    """Return whether no other step of any layer is near enough to shift an edge (see `RulerEdges.smoothing_px`)."""
    point, normal, across, _, _ = row
    reach = imaging.room_px * imaging.pixel
    if 0 < across < reach:
        return False
    edges = (point,) if not across else (point - normal * across / 2, point + normal * across / 2)
    slope = float(np.abs(normal).sum())
    for each in layers:
        away = reach + each.max_offset * slope
        for edge in edges:
            places, _ = layer_edges_along(each.layer, edge, normal, away)
            if np.abs(places).max(initial=0.0) > SAME_EDGE:
                return False
    return True


def _ambiguity(layers: tuple[VisibleLayer, ...], point: Float64, normal: Float64, reach: float, found: float) -> float:
    """Return the probability that another edge of the same polarity lies within the range of detection.

    An edge at the distance a from the right one does so where the shift exceeds a minus the range, for shifts equally
    distributed over the search range.
    """
    chance, slope = 0.0, float(np.abs(normal).sum())
    for each in layers:
        margin = each.max_offset * slope
        place, ends = layer_edges_along(each.layer, point, normal, reach + found + margin)
        if not len(place):
            continue
        away = np.abs(place[(ends != each.dark) & (np.abs(place) > SAME_EDGE)]) - margin
        chance += float(np.sum(np.clip((reach + found - away) / (2 * reach), 0.0, 1.0)))
    return min(1.0, chance)


def lever_arm(point: Float64, normal: Float64) -> Float64:
    """Return n . (J p): the derivative of a measurement along n at p with respect to the angle."""
    return np.asarray(point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0])
