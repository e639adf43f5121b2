"""Reference of occluded irradiance: visible parts of a segment by critical points and one ray into each part."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.reference import line_irradiance, rays

Float64 = NDArray[np.float64]
RayOf = Callable[[Float64], tuple[Float64, Float64]]


def intervals(
    corners: Float64, ray_of: RayOf, points: tuple[Float64, ...], planes: list[tuple[Float64, Float64]]
) -> Float64:
    """Return the visible intervals of a segment seen from a point.

    Parameters
    ----------
    corners : numpy.ndarray
        Triangles (n, 3, 3).
    ray_of : callable
        Function of t (k,) that returns the two ends (k, 3) of the rays to t; triangles between the ends occlude.
    points : tuple
        The point, and the start and the end of the segment.
    planes : list
        Planes (point, normal) at which the rays begin or end.

    Returns
    -------
    numpy.ndarray
        (k, 2), fractions of the segment, 0 to 1.
    """
    point, start, stop = points
    along = stop - start
    view = np.cross(start - point, along)
    sides = (corners - point) @ view
    slack = 1e-9 * np.abs(sides).max(initial=0.0)
    corners = corners[(sides.min(axis=1) <= slack) & (sides.max(axis=1) >= -slack)]
    edges = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3) - point
    off = np.cross(edges[:, 0], edges[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        critical = [off @ (point - start) / (off @ along)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        critical.append(np.sum(normals * (corners[:, 0] - start), axis=1) / (normals @ along))
    for place, normal in planes:
        systems = np.stack([normals, np.tile(view, (len(normals), 1)), np.tile(normal, (len(normals), 1))], axis=1)
        intersects = np.linalg.matrix_rank(systems) == 3
        right = np.column_stack(
            [np.sum(normals * corners[:, 0], axis=1), np.tile([view @ point, normal @ place], (len(normals), 1))]
        )
        across = np.cross(view, np.linalg.solve(systems[intersects], right[intersects][..., None])[..., 0] - point)
        with np.errstate(divide="ignore", invalid="ignore"):
            critical.append(across @ (point - start) / (across @ along))
    cuts = np.concatenate(critical)
    cuts = np.unique([*np.clip(cuts[np.isfinite(cuts)], 0.0, 1.0), 0.0, 1.0])
    origins, ends = ray_of(0.5 * (cuts[1:] + cuts[:-1]))
    seen = ~rays.occluded(corners, np.hstack([origins, ends])) if len(corners) else np.ones(len(cuts) - 1, bool)
    found: list[list[float]] = []
    for low, high, is_seen in zip(cuts[:-1], cuts[1:], seen, strict=True):
        if is_seen and found and found[-1][1] == low:
            found[-1][1] = high
        elif is_seen:
            found.append([low, high])
    return np.array(found).reshape(-1, 2)


def visible_from_receiver(corners: Float64, receiver: Float64, segment: Float64, clearance: float) -> Float64:
    """Return the visible intervals of a segment (10,) from a receiver (6,); triangles above both planes occlude."""
    point, facing = receiver[:3].astype(float), receiver[3:].astype(float)
    start, stop, lit = segment[:9].astype(float).reshape(3, 3)
    along = (stop - start) / np.linalg.norm(stop - start)
    lit = lit - (lit @ along) * along
    facing, lit = facing / np.linalg.norm(facing), lit / np.linalg.norm(lit)

    def ray_of(t: Float64) -> tuple[Float64, Float64]:
        toward = start + t[:, None] * (stop - start) - point
        height, above = -(toward @ lit), toward @ facing
        end = 1.0 - clearance / height[:, None]
        first = np.minimum(clearance / np.where(above > 0.0, above, np.inf)[:, None], end)
        return point + first * toward, point + end * toward

    planes = [(point + clearance * facing, facing), (start + clearance * lit, lit)]
    return intervals(corners, ray_of, (point, start, stop), planes)


def irradiance(corners: Float64, receivers: Float64, segments: Float64, clearance: float) -> tuple[Float64, Float64]:
    """Return the irradiance (n,) of receivers (n, 6) by segments (m, 10), and the sum of E0 of facing segments."""
    total, largest = np.zeros(len(receivers)), np.zeros(len(receivers))
    for number, receiver in enumerate(receivers):
        for segment in segments:
            ends, lit = segment[:6].reshape(2, 3), segment[6:9]
            if (receiver[:3] - ends[0]) @ lit <= 0.0 or ((ends - receiver[:3]) @ receiver[3:]).max() <= 0.0:
                continue
            one, power = receiver[None], segment[9]
            largest[number] += line_irradiance.irradiance(one, ends[None], lit[None], [power])[1][0]
            seen = visible_from_receiver(corners, receiver, segment, clearance)
            parts = ends[0] + seen[..., None] * (ends[1] - ends[0])
            same = len(parts)
            total[number] += line_irradiance.irradiance(one, parts, np.tile(lit, (same, 1)), [power] * same)[0][0]
    return total, largest


def single(values: Any) -> Float64:
    """Return numbers rounded to float32, so that both precisions see the same scene."""
    return np.asarray(values).astype(np.float32).astype(np.float64)


def soup(rng: np.random.Generator, count: int, size: float = 0.2) -> Float64:
    """Return random triangles in a cube."""
    return single(rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, size, (count, 3, 3)))


def comb(teeth: int) -> Float64:
    """Return thin triangles side by side that hide half of a unit segment at twice their distance."""
    at = (np.arange(teeth) + 0.25) / teeth - 0.5
    x = 0.5 * np.stack([at, at + 0.5 / teeth, at], axis=1)
    x[:, 2] = x[:, :2].mean(axis=1)
    y = np.tile([-1.0, -1.0, 2.0e3], (teeth, 1))
    return np.stack([x, y, np.full_like(x, 0.5)], axis=-1)
