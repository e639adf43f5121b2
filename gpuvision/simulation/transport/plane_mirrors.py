"""Windows of plane mirrors: the part of a line that the lens can see in a mirror triangle, without occlusion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Default height above a mirror's plane, in parts of the lens' distance, below which a point counts as in the plane.
# Derived: some thousand roundings of double.
MIN_HEIGHT = 1e-12


class MirrorWindows(NamedTuple):
    """Parts of lines that are visible from the lens in mirrors.

    Attributes
    ----------
    line, mirror
        int64 (k,): index of the line, and of the mirror.
    share
        float64 (k, 2): begin and end as fractions of the line, 0 to 1.
    """

    line: Integers
    mirror: Integers
    share: Float64


def triangle_planes(corners: Float64) -> Float64:
    """Return the planes n x = d of triangles (m, 3, 3): unit normal n and offset d, (m, 4)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.column_stack([normal, np.sum(normal * corners[:, 0], axis=1)])


def heights_above(points: Float64, planes: Float64) -> Float64:
    """Return the heights of points above planes [m]; the two broadcast."""
    return np.asarray(np.sum(points * planes[..., :3], axis=-1) - planes[..., 3])


def reflect_points(points: Float64, planes: Float64) -> Float64:
    """Return the mirror images of points (..., 3) in planes."""
    return np.asarray(points - 2.0 * heights_above(points, planes)[..., None] * planes[..., :3])


def mirror_windows(
    lens: Float64,
    ends: Float64,
    corners: Float64,
    planes: Float64,
    line: Integers,
    mirror: Integers,
    *,
    min_height: float = MIN_HEIGHT,
) -> MirrorWindows:
    """Return the parts of lines that are visible from the lens in mirror triangles.

    The ray from the lens to the mirror image of the point meets the triangle. Line and lens lie on the same side of the
    mirror; both sides reflect. Exact to rounding. Occlusion is not considered.

    Parameters
    ----------
    lens
        (3,): position of the lens [m].
    ends
        (k, 2, 3): ends of the lines [m].
    corners, planes
        (m, 3, 3) and (m, 4): mirrors [m], each with an area, and their `triangle_planes`.
    line, mirror
        (n,): pairs of a line and a mirror to test.
    min_height
        As `MirrorLimits.min_height`.
    """
    from_lens, planes = corners[mirror] - lens, planes[mirror]
    lens_height = heights_above(lens, planes)
    usable = np.abs(lens_height) > min_height * np.linalg.norm(from_lens[:, 0], axis=1)
    # Normals are turned to the lens' side, and the planes through lens and edges so that the triangle is on their
    # positive side.
    normal, lens_height = planes[:, :3] * np.sign(lens_height)[:, None], np.abs(lens_height)
    sides = np.cross(from_lens, np.roll(from_lens, -1, axis=1))
    sides *= np.sign(np.sum(sides * np.roll(from_lens, 1, axis=1), axis=2))[..., None]
    points = ends[line] - lens
    height = np.einsum("nek,nk->ne", points, normal) + lens_height[:, None]
    low, high = np.zeros(len(line)), np.ones(len(line))
    _clip_positive(low, high, height - min_height * lens_height[:, None])
    # The mirror image of a point: the point minus twice its height along the normal.
    image = points - 2.0 * height[..., None] * normal[:, None]
    for n in range(3):
        _clip_positive(low, high, np.einsum("nek,nk->ne", image, sides[:, n]))
    kept = (low < high) & usable
    return MirrorWindows(line[kept], mirror[kept], np.stack([low, high], axis=1)[kept])


def _clip_positive(low: Float64, high: Float64, value: Float64) -> None:
    """Clip (low, high) to where a function that is linear on each line is positive; ``value`` (n, 2) at both ends."""
    start, end = value.T
    with np.errstate(divide="ignore", invalid="ignore"):
        place = start / (start - end)
    np.maximum(low, place, out=low, where=start < 0.0)
    np.minimum(high, place, out=high, where=end < 0.0)
    high[(start < 0.0) & (end < 0.0)] = -1.0
