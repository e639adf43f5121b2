"""PackedViews of a flat target: target points with their image points, checked and packed for the fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.pattern import PatternGrid
from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import PackedViews
from gpuvision.validation import finite

Mask: TypeAlias = npt.NDArray[np.bool_]

# Points that determine a homography.
_MIN_POINTS = 4
# Ratio of the singular values of centred points, below which the points are collinear. Derived: above double rounding.
_COLLINEAR = 1e-9


class View(NamedTuple):
    """Points of a flat target in one image.

    Attributes
    ----------
    target : numpy.ndarray
        (n, 2) or (n, 3): points on the target [m]; the third coordinate is 0.
    image : numpy.ndarray
        (n, 2): measured (column, row) [px]; NaN where missing.
    """

    target: npt.NDArray[np.float64]
    image: npt.NDArray[np.float64]


def make_view(grid: PatternGrid | npt.ArrayLike, pitch: float) -> View:
    """Return the view of a regular grid, such as `find_dots` and `find_chessboard` return.

    Parameters
    ----------
    grid : PatternGrid or array_like
        Grid, or its points (rows, columns, 2) [px], NaN where missing.
    pitch : float
        Distance between neighbouring points on the target [m].

    Returns
    -------
    View

    Raises
    ------
    ValueError
        The points have another shape, or the pitch is not finite.
    """
    points = np.asarray(grid.points if isinstance(grid, PatternGrid) else grid, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 2:
        raise ValueError(f"points have shape {points.shape}, expected (rows, columns, 2)")
    row, column = np.indices(points.shape[:2]) * finite(pitch, "pitch")
    return View(np.stack([column, row, np.zeros_like(row)], axis=-1).reshape(-1, 3), points.reshape(-1, 2))


def pack(views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]) -> tuple[PackedViews, tuple[Mask, ...]]:
    """Pack views of different lengths into arrays; return them with the mask of known points of each view.

    Raises
    ------
    ValueError
        No view is given, or a view shows no flat target; the message names the view.
    """
    if not len(views):
        raise ValueError("no views given, expected at least one")
    pairs, masks = [], []
    for index, (target, image) in enumerate(views):
        points, measured = np.asarray(target, dtype=np.float64), np.asarray(image, dtype=np.float64).reshape(-1, 2)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) != len(measured):
            raise ValueError(
                f"view {index}: target points have shape {points.shape} for {len(measured)} image points, "
                "expected (n, 2|3)"
            )
        if points.shape[1] == 3 and np.any(np.abs(points[:, 2]) > 0.0):
            raise ValueError(f"view {index}: target points leave the plane Z = 0, expected a flat target")
        mask = np.isfinite(np.concatenate([measured, points], axis=1)).all(axis=1)
        pairs.append((points[mask, :2], measured[mask]))
        masks.append(mask)
        _check_spread(f"view {index}", pairs[-1][0])
        _check_spread(f"view {index}, image", pairs[-1][1])
    longest = max(len(target) for target, _ in pairs)
    packed = PackedViews(
        np.zeros((len(pairs), 3, longest)), np.zeros((len(pairs), 2, longest)), np.zeros((len(pairs), longest))
    )
    for index, (target, measured) in enumerate(pairs):
        packed.target[index, :2, : len(target)] = target.T
        # Pad with a copy of the first point at weight 0, so that all derivatives stay finite.
        packed.target[index, :2, len(target) :] = target[:1].T
        packed.image[index, :, : len(measured)] = measured.T
        packed.weight[index, : len(measured)] = 1.0
    return packed, tuple(masks)


def _check_spread(name: str, target: Floats) -> None:
    """Refuse too few points, and points that lie on one line, all or all but one."""
    if len(target) < _MIN_POINTS:
        raise ValueError(f"{name}: {len(target)} measured points, expected at least {_MIN_POINTS}")
    # A single point off a line does not determine a homography either: test without the farthest point as well.
    for points in (target, _without_farthest(target)):
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if sizes[1] <= _COLLINEAR * sizes[0]:
            raise ValueError(f"{name}: all points lie on one line, points off this line are needed")


def _without_farthest(points: Floats) -> Floats:
    """Remove the point farthest from the best line."""
    offset = points - points.mean(axis=0)
    distance = offset @ np.linalg.svd(offset, full_matrices=False)[2][1]
    return np.delete(points, np.argmax(np.abs(distance)), axis=0)
