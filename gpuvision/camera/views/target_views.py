"""Views of a flat target: points on it and where they were seen, checked and packed for the fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gpuvision.camera.patterns.pattern import PatternGrid
from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import Views
from gpuvision.validation import finite

Mask: TypeAlias = npt.NDArray[np.bool_]

_FEWEST_POINTS = 4
# Spread across a line over that along it, at which points lie on the line.
_FLAT_TARGET = 1e-9


class View(NamedTuple):
    """One image of a flat target.

    Attributes
    ----------
    target
        (n, 2) or (n, 3): points on the target, metres; the third coordinate 0.
    image
        (n, 2): where they were seen, (column, row) pixels; NaN where missing.
    """

    target: npt.NDArray[np.float64]
    image: npt.NDArray[np.float64]


def make_view(grid: PatternGrid | npt.ArrayLike, pitch: float) -> View:
    """Return the view of a regular grid, as the pattern finders return it.

    Parameters
    ----------
    grid
        The grid, or its points (rows, columns, 2): pixels, NaN where missing.
    pitch
        Distance of neighbours on the target, metres.

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


def pack(views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]) -> tuple[Views, tuple[Mask, ...]]:
    """Bring views of different lengths into arrays.

    Raises
    ------
    ValueError
        There is none, or one is no view of a flat target: says which, and what is wrong with it.
    """
    if not len(views):
        raise ValueError("no views given, expected at least one")
    pairs, masks = [], []
    for index, (target, image) in enumerate(views):
        points, seen = np.asarray(target, dtype=np.float64), np.asarray(image, dtype=np.float64).reshape(-1, 2)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) != len(seen):
            raise ValueError(
                f"view {index}: target points have shape {points.shape} for {len(seen)} image points, expected (n, 2|3)"
            )
        if points.shape[1] == 3 and np.any(np.abs(points[:, 2]) > 0.0):
            raise ValueError(f"view {index}: target points leave the plane Z = 0, expected a flat target")
        mask = np.isfinite(np.concatenate([seen, points], axis=1)).all(axis=1)
        pairs.append((points[mask, :2], seen[mask]))
        masks.append(mask)
        _check_spread(f"view {index}", pairs[-1][0])
        _check_spread(f"view {index}, image", pairs[-1][1])
    longest = max(len(target) for target, _ in pairs)
    packed = Views(
        np.zeros((len(pairs), 3, longest)), np.zeros((len(pairs), 2, longest)), np.zeros((len(pairs), longest))
    )
    for index, (target, seen) in enumerate(pairs):
        packed.target[index, :2, : len(target)] = target.T
        # What is missing repeats a point, at weight 0: it is as regular as the others.
        packed.target[index, :2, len(target) :] = target[:1].T
        packed.seen[index, :, : len(seen)] = seen.T
        packed.weight[index, : len(seen)] = 1.0
    return packed, tuple(masks)


def _check_spread(what: str, target: Floats) -> None:
    if len(target) < _FEWEST_POINTS:
        raise ValueError(f"{what}: {len(target)} measured points, expected at least {_FEWEST_POINTS}")
    # One point beside a line does not fix a homography either: the farthest from the line is left out.
    for points in (target, _without_farthest(target)):
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if sizes[1] <= _FLAT_TARGET * sizes[0]:
            raise ValueError(f"{what}: all points lie on one line, points beside it are needed")


def _without_farthest(points: Floats) -> Floats:
    offset = points - points.mean(axis=0)
    aside = offset @ np.linalg.svd(offset, full_matrices=False)[2][1]
    return np.delete(points, np.argmax(np.abs(aside)), axis=0)
