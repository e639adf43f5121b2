"""Lines seen in plane mirrors: through which triangles a lens sees which part of a line, nothing being in the way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# What is as near to a mirror, in distances of the lens, lies in it.
_IN_IT = 1e-12


class Windows(NamedTuple):
    """What a lens sees of lines in mirrors.

    Attributes
    ----------
    line, mirror
        (k,): which line, in which mirror.
    share
        (k, 2): from where to where on the line, 0 to 1.
    """

    line: Integers
    mirror: Integers
    share: Float64


def planes_of(corners: Float64) -> Float64:
    """Return unit normals and offsets, (m, 4), of triangles (m, 3, 3): n x = d."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([normal, np.sum(normal * corners[:, 0], axis=1)])


def heights(points: Float64, planes: Float64) -> Float64:
    """Return how far points lie above planes, the two broadcast, [m]."""
    return np.asarray(np.sum(points * planes[..., :3], axis=-1) - planes[..., 3])


def mirrored(points: Float64, planes: Float64) -> Float64:
    """Return the mirror images of points, (..., 3)."""
    return np.asarray(points - 2.0 * heights(points, planes)[..., None] * planes[..., :3])


def windows(
    lens: Float64, ends: Float64, corners: Float64, planes: Float64, line: Integers, mirror: Integers
) -> Windows:
    """Return which parts of lines are seen in triangles: where the ray from the lens to the mirror image meets it.

    Line and lens lie on one side of the mirror; either side reflects. Exact to rounding.

    Parameters
    ----------
    lens
        (3,), metres.
    ends
        (k, 2, 3), metres: the lines.
    corners, planes
        (m, 3, 3), metres: the mirrors, each with an area; and `planes_of` them.
    line, mirror
        (n,): the pairs that are looked at.
    """
    from_lens, planes = corners[mirror] - lens, planes[mirror]
    lens_height = heights(lens, planes)
    usable = np.abs(lens_height) > _IN_IT * np.linalg.norm(from_lens[:, 0], axis=1)
    # Mirrors are taken with the lens above them; edges so that the triangle lies on their positive side.
    normal, lens_height = planes[:, :3] * np.sign(lens_height)[:, None], np.abs(lens_height)
    sides = np.cross(from_lens, np.roll(from_lens, -1, axis=1))
    sides *= np.sign(np.sum(sides * np.roll(from_lens, 1, axis=1), axis=2))[..., None]
    points = ends[line] - lens
    height = np.einsum("nek,nk->ne", points, normal) + lens_height[:, None]
    low, high = np.zeros(len(line)), np.ones(len(line))
    _cut(low, high, height - _IN_IT * lens_height[:, None])
    # Of the mirror image: the point, less twice its height along the normal.
    image = points - 2.0 * height[..., None] * normal[:, None]
    for n in range(3):
        _cut(low, high, np.einsum("nek,nk->ne", image, sides[:, n]))
    kept = (low < high) & usable
    return Windows(line[kept], mirror[kept], np.stack([low, high], axis=1)[kept])


def _cut(low: Float64, high: Float64, value: Float64) -> None:
    """Keep where a function, linear on each line, is positive; its values at starts and ends of lines, (n, 2)."""
    start, end = value.T
    with np.errstate(divide="ignore", invalid="ignore"):
        place = start / (start - end)
    np.maximum(low, place, out=low, where=start < 0.0)
    np.minimum(high, place, out=high, where=end < 0.0)
    high[(start < 0.0) & (end < 0.0)] = -1.0
