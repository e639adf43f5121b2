"""Selection of the rulers and fiducials in view of a camera at an expected pose over a board."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gpuvision.camera.magnification import largest_magnification
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates, pixel_hint
from gpuvision.matching.features.feature_set import FeatureSet, select_feature_set
from gpuvision.matching.features.fiducials import Fiducials, search_distance, select_fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import MAX_LENGTH

# Candidates of a view; with more expected, five windows of the view are examined instead of the whole (cost).
_USUAL_CANDIDATES = 2500
_MIN_FEATURES = 3  # as many as unknowns of a pose
# Smoothing over blur where edges are too near for the best smoothing: blur and smoothing are then sqrt(2) blurs
# together instead of sqrt(6), as in the coarse registration (chosen).
_DENSE_SMOOTHING = 1.0
_MAX_FIDUCIALS = 40  # number of rulers of the first pass (cost)


def select_features_in_view(
    artwork: Artwork, view: BoardView, imaging: Imaging, budget: float = 60, *, with_hint: bool = True
) -> FeatureSet:
    """Select rulers and fiducials that lie in the image at every board position within ``imaging.shift``.

    In a view with thousands of candidates, rulers are taken from five windows of it only: its corners and its centre.
    Where fewer than three features have room, rulers that smooth less (`_DENSE_SMOOTHING`) are tried: they need less
    room between edges and are less precise, which the predicted covariance contains.

    Parameters
    ----------
    artwork
        The side in view of the camera.
    view
        Expected pose of the camera over the board.
    imaging
        Image quality and search range.
    budget
        Number of rulers, default 60; fiducials are selected in addition.
    with_hint
        Whether an error names a pixel size at which edges have room, default True. The search takes longer than the
        selection.

    Raises
    ------
    ValueError
        There are not enough edges, or they do not determine the pose.
    """
    placement = np.array(view.pose[:2])
    rulers, fiducials = find_features_in_view(artwork, view, imaging, placement)
    if len(rulers.sigma) + len(fiducials.sigma) < _MIN_FEATURES and imaging.smoothing_ratio > _DENSE_SMOOTHING:
        imaging = replace(imaging, smoothing_ratio=_DENSE_SMOOTHING)
        rulers, fiducials = find_features_in_view(artwork, view, imaging, placement)
    if len(rulers.sigma) + len(fiducials.sigma) < _MIN_FEATURES:
        hint = pixel_hint(artwork, view.bounds, placement, imaging) if with_hint else "see the pixel size"
        raise ValueError(
            f"{len(rulers.sigma)} edges of the {artwork.side} artwork in view have room for a ruler, and "
            f"{len(fiducials.sigma)} round pads can serve as fiducials, expected 3 or more together; check the "
            f"initial pose, the scale and the blur: {hint}"
        )
    return select_feature_set(rulers, imaging, artwork.side, fiducials=fiducials, are_free=True, budget=budget)


def find_features_in_view(
    artwork: Artwork, view: BoardView, imaging: Imaging, placement: npt.NDArray[np.float64]
) -> tuple[FeatureCandidates, Fiducials]:
    """Return the candidates of rulers and the fiducials that lie in the image at every board position.

    Parameters
    ----------
    artwork, view, imaging
        As in `select_features_in_view`.
    placement
        (2,) point whose pose counts [m].
    """
    parts = [find_ruler_candidates(artwork, window, placement, imaging) for window in _windows(artwork, view, imaging)]
    joined = [np.concatenate(each) for each in zip(*(part[:-1] for part in parts), strict=True)]
    rulers = FeatureCandidates._make([*joined, placement])
    margin = (rulers.length / 2 + imaging.shift) / imaging.pixel + imaging.width_px
    fits = view.contains(rulers.point, margin) & (rulers.length < (MAX_LENGTH - 2) * imaging.pixel)
    rulers = FeatureCandidates._make([*(each[fits] for each in rulers[:-1]), placement])
    fiducials = select_fiducials(artwork, view.bounds, placement, imaging, _MAX_FIDUCIALS)
    reach = fiducials.radius + search_distance(fiducials.point, placement, imaging)
    return rulers, fiducials.subset(view.contains(fiducials.point, reach / imaging.pixel))


def features_in_view(features: FeatureSet, view: BoardView) -> FeatureSet:
    """Return the features whose samples all lie in the image of a camera; others are not measured.

    All rulers have the length of the longest one (`FeatureSet.ruler_length`). ``covariance``, ``condition`` and
    ``region`` still hold for all features.

    Parameters
    ----------
    features
        Rulers and fiducials.
    view
        Camera over the board.
    """
    imaging = features.imaging
    magnification = 1.0 if view.model is None else largest_magnification(view.model, view.shape)
    samples = features.ruler_length(view.scale, imaging.blur_px, magnification=magnification)
    along = features.normal * 0.5 * (samples - 1) * view.scale
    across = along[:, ::-1] * [-1.0, 1.0] * (imaging.width_px - 1) / (samples - 1)
    corners = [features.point + one * along + other * across for one in (-1.0, 1.0) for other in (-1.0, 1.0)]
    seen = view.contains(np.stack(corners), 0.0).all(axis=0)
    marks = features.fiducials
    reach = marks.radius + search_distance(marks.point, features.placement, imaging)
    rulers = {name: getattr(features, name)[seen] for name in ("point", "normal", "spacing", "length", "sigma")}
    return replace(features, **rulers, fiducials=marks.subset(view.contains(marks.point, reach / view.scale)))


def _windows(
    artwork: Artwork, view: BoardView, imaging: Imaging
) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Return the windows (2, 2) of the board [m] in which candidates are looked for."""
    low, high = view.bounds
    edges = artwork.edges
    middle = (edges.start + edges.end) / 2
    inside = np.all((middle >= low) & (middle <= high), axis=1)
    expected = 1.5 * float(np.sum(edges.length[inside])) / (imaging.width_px * imaging.pixel)
    if expected <= _USUAL_CANDIDATES:
        return [np.stack([low, high])]
    size = (high - low) * math.sqrt(_USUAL_CANDIDATES / expected / 5)
    shares = ((0, 0), (0, 1), (1, 0), (1, 1), (0.5, 0.5))
    starts = [low + np.array(share) * (high - low - size) for share in shares]
    return [np.stack([start, start + size]) for start in starts]
