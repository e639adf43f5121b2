"""Reference of light clustering: light from every segment to every receiver by quadrature, and positions of strips."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_PANELS = 24


def pair_irradiance(receivers: NDArray[Any], segments: NDArray[Any]) -> NDArray[np.float64]:
    """Return the irradiance (n, m) of receivers (n, 6) by segments (m, 10) without occlusion.

    Gauss-Legendre on panels of equal width in asinh(t / rho), with t along the line from the receiver's foot and its
    distance rho from the line.
    """
    place, normal = receivers[:, None, :3].astype(float), receivers[:, None, 3:].astype(float)
    normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    start, end, lit = segments[None, :, :3], segments[None, :, 3:6], segments[None, :, 6:9]
    lit = lit / np.linalg.norm(lit, axis=2, keepdims=True)
    length = np.linalg.norm(end - start, axis=2)
    along = (end - start) / length[..., None]
    foot = np.sum((place - start) * along, axis=2)
    rho = np.maximum(np.linalg.norm(place - start - foot[..., None] * along, axis=2), 1e-12)
    height = np.sum((place - start) * lit, axis=2)
    above, slope = -np.sum((place - start - foot[..., None] * along) * normal, axis=2), np.sum(along * normal, axis=2)
    first, last = np.arcsinh(-foot / rho), np.arcsinh((length - foot) / rho)
    total = np.zeros_like(rho)
    for panel in range(_PANELS):
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            x = first + (last - first) * (panel + 0.5 + 0.5 * node) / _PANELS
            cosine = np.maximum(above + slope * rho * np.sinh(x), 0.0)
            total += weight * cosine / (rho * np.cosh(x)) ** 3
    factor = np.maximum(height, 0.0) * segments[None, :, 9] / np.pi
    return np.asarray(factor * total * (last - first) * 0.5 / _PANELS)


def is_occluded(
    origins: NDArray[Any], targets: NDArray[Any], triangles: NDArray[Any], clearance: float
) -> NDArray[Any]:
    """Return whether any triangle (t, 3, 3) lies between points (k, 3), ends excluded (Moeller and Trumbore)."""
    direction = targets - origins
    length = np.linalg.norm(direction, axis=1)
    one, two = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction[:, None], two[None])
    det = np.sum(p * one, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origins[:, None] - triangles[None, :, 0]
        u = np.sum(s * p, axis=2) / det
        q = np.cross(s, one[None])
        v = np.sum(direction[:, None] * q, axis=2) / det
        t = np.sum(two * q, axis=2) / det
        margin = (clearance / length)[:, None]
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > margin) & (t < 1 - margin)
    return np.asarray(np.any(hit, axis=1))


def visibility(
    receivers: NDArray[Any], segments: NDArray[Any], triangles: NDArray[Any], points: int = 16
) -> NDArray[np.float64]:
    """Return the visible part (n, m) of each segment, by rays to the middles of its parts.

    Parts below the receiver's plane count as visible: they contribute no light.
    """
    n, m = len(receivers), len(segments)
    at = (np.arange(points) + 0.5) / points
    on = segments[:, None, :3] + at[:, None] * (segments[:, None, 3:6] - segments[:, None, :3])
    to = np.broadcast_to(on.reshape(1, -1, 3), (n, m * points, 3)).reshape(-1, 3)
    origin = np.repeat(receivers[:, :3].astype(float), m * points, axis=0)
    seen = np.concatenate(
        [~is_occluded(origin[k : k + 20000], to[k : k + 20000], triangles, 1e-7) for k in range(0, len(origin), 20000)]
    )
    under = np.einsum("kx,kx->k", np.repeat(receivers[:, 3:], m * points, axis=0), to - origin) <= 0.0
    return np.asarray((seen | under).reshape(n, m, points).mean(axis=2))


def mean_position(power: Any, moment: Any, weights: NDArray[Any], irradiance: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean position of strips from their direct light and the light of receivers (strips, n)."""
    more = np.sum(weights * irradiance[..., None], axis=1)
    return np.asarray((moment + more[:, 1]) / (power + more[:, 0]))
