"""Points that drawn shapes cover, and area and centroid of shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.shapes import Float64, Shape, area

_SAMPLES = 512  # along each side of the bounding box, for several shapes: the area is right to 0.2 %
_MOST_CROSSINGS = 1 << 22  # (rows x sides) that are compared at once: 64 MiB


def covered(shapes: Sequence[Shape], x: Float64, y: Float64) -> npt.NDArray[np.bool_]:
    """Return which points of a grid the shapes cover, in drawing order: later shapes add to or clear earlier ones.

    Parameters
    ----------
    shapes : sequence of Shape
        Areas in drawing order.
    x, y : numpy.ndarray
        Coordinates of columns (ascending) and rows of the grid [m].

    Returns
    -------
    numpy.ndarray
        bool, (len(y), len(x)).
    """
    found = np.zeros((len(y), len(x)), np.bool_)
    for shape in shapes:
        inside = _inside(shape.outline, x, y)
        for hole in shape.holes:
            inside &= ~_inside(hole, x, y)
        found[inside] = shape.dark
    return found


def _inside(outline: Float64, x: Float64, y: Float64) -> npt.NDArray[np.bool_]:
    """Return the points with an odd number of sides of the outline on their left."""
    crossings = np.zeros((len(y), len(x) + 1), np.int32)
    after = np.roll(outline, -1, axis=0)
    chunk = max(_MOST_CROSSINGS // len(outline), 1)
    for first in range(0, len(y), chunk):
        rows = y[first : first + chunk, None]
        row, side = np.nonzero((outline[:, 1] <= rows) != (after[:, 1] <= rows))
        start, end = outline[side], after[side]
        share = (rows[row, 0] - start[:, 1]) / (end[:, 1] - start[:, 1])
        column = np.searchsorted(x, start[:, 0] + share * (end[:, 0] - start[:, 0]))
        np.add.at(crossings, (row + first, column), 1)
    return np.asarray(np.cumsum(crossings, axis=1)[:, :-1] % 2 == 1)


def area_and_centroid(shapes: Sequence[Shape]) -> tuple[float, Float64]:
    """Return the area [m^2] that shapes cover, and its centroid (2,) [m]; NaN for no area.

    Exact for one shape without holes; several shapes are sampled at 512 x 512 points.
    """
    if len(shapes) == 1 and not shapes[0].holes:
        return _of_polygon(shapes[0].outline)
    corners = np.concatenate([each.outline for each in shapes])
    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    middles = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    x, y = low[0] + middles * size[0], low[1] + middles * size[1]
    inside = covered(shapes, x, y)
    count = int(np.count_nonzero(inside))
    if not count:
        return 0.0, np.full(2, np.nan)
    centroid = np.array([inside.sum(axis=0) @ x, inside.sum(axis=1) @ y]) / count
    return float(np.prod(size)) * count / _SAMPLES**2, centroid


def _of_polygon(outline: Float64) -> tuple[float, Float64]:
    local = outline - outline[0]
    after = np.roll(local, -1, axis=0)
    cross = local[:, 0] * after[:, 1] - after[:, 0] * local[:, 1]
    signed = area(outline)
    if signed == 0:
        return 0.0, np.full(2, np.nan)
    return abs(signed), outline[0] + cross @ (local + after) / (6 * signed)
