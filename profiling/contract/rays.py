"""Contract of rays: closest hits and occlusion in triangle soups, near and far origins, misses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.reference import rays as reference
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.status import Status

_EDGE = "comparisons only, except within rounding of an edge"
LIMITS = {
    "ClosestHit": (
        equal("triangle", "status", reason=_EDGE),
        roundings(
            8, "distance", of="(size of the scene + distance) / cosine of incidence x (longest edge / height)^2 [m]",
            reason="error model of the docstring: a few roundings of the scene's size and of the distance",
        ),
    ),
    "AnyHit": (equal("occluded", "status", reason=_EDGE + ", or of a triangle through an end"),),
}  # fmt: skip
_SIZE = 4.0  # of the scene: corners lie within 2 m of the centre [m]


def cases() -> Iterator[Case]:
    """Yield soups of 1 to 2000 triangles with rays from within, from outside and from far away."""
    rng = np.random.default_rng(28)
    for count, size in ((1, 0.5), (17, 0.5), (2000, 0.2)):
        corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, size, (count, 3, 3))
        corners = corners.astype(np.float32).astype(np.float64)
        rays = np.hstack([rng.uniform(-1.5, 1.5, (307, 3)), rng.normal(0.0, 1.0, (307, 3))])
        segments = rng.uniform(-1.0, 1.0, (307, 6))
        for dtype in ("float32", "float64"):
            yield _closest(f"{count} triangles, {dtype}", corners, rays.astype(dtype))
            yield _any(f"{count} triangles, {dtype}", corners, segments.astype(dtype))
        if count == 2000:
            targets = corners.mean(axis=1)[rng.integers(0, count, 307)]
            away = rng.normal(size=(307, 3))
            far = 1000.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
            yield _closest("far origins, float64", corners, np.hstack([far, targets - far]))


def _at_an_edge(
    corners: npt.NDArray[Any], dtype: Any, starts: npt.NDArray[Any], ways: npt.NDArray[Any]
) -> npt.NDArray[np.bool_]:
    """Return which rays pass an edge of any triangle within rounding.

    Positions are rounded by a few epsilon of the scene's size, seen at the cosine of incidence: a barycentric weight by
    this over the height of the triangle.
    """
    _, u, v = reference.crossings(corners, starts, ways)
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(one, two), axis=1)
    longest = np.maximum.reduce([np.linalg.norm(each, axis=1) for each in (one, two, two - one)])
    cosine = np.abs(ways @ np.cross(one, two).T) / np.linalg.norm(ways, axis=1)[:, None] / area
    reached = _SIZE + np.linalg.norm(starts, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        rounding = 8.0 * np.finfo(dtype).eps * reached * longest / (area * cosine)
        return np.asarray((np.abs(np.minimum(np.minimum(u, v), 1.0 - u - v)) <= rounding).any(axis=1))


def _closest(name: str, corners: npt.NDArray[Any], rays: npt.NDArray[Any]) -> Case:
    wide = rays.astype(np.float64)
    triangle, distance, *_ = reference.closest(corners, wide)
    one, two = (corners[triangle, n] - corners[triangle, 0] for n in (1, 2))
    along = wide[:, 3:] / np.linalg.norm(wide[:, 3:], axis=1, keepdims=True)
    normal = np.cross(one, two)
    longest = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1))
    thin = np.abs(np.sum(along * normal, axis=1)) / longest**2
    quantity = (_SIZE + np.where(triangle < 0, 0.0, distance)) / thin
    status = np.where(triangle < 0, int(Status.NO_DATA), 0)
    exact = {"triangle": triangle, "distance": distance, "status": status}
    undecided = _at_an_edge(corners, rays.dtype, wide[:, :3], wide[:, 3:])
    return Case("ClosestHit", name, ClosestHit(scene=Scene(corners)), (rays,), exact, {"distance": quantity}, undecided)


def _any(name: str, corners: npt.NDArray[Any], segments: npt.NDArray[Any]) -> Case:
    wide = segments.astype(np.float64)
    occluded = reference.occluded(corners, wide)
    undecided = _at_an_edge(corners, segments.dtype, wide[:, :3], wide[:, 3:] - wide[:, :3])
    undecided |= reference.occluded(corners, wide, -1e-4) != reference.occluded(corners, wide, 1e-4)
    exact = {"occluded": occluded.astype(np.uint8), "status": np.zeros(len(wide), np.uint8)}
    return Case("AnyHit", name, AnyHit(scene=Scene(corners)), (segments,), exact, {}, undecided)
