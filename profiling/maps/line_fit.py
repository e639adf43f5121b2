"""Line fit: size of the coordinates, and how far the set of points is from a round one, which has no direction."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.profiling.maps.stability import Axis, Floats, Problem

_POINTS, _HALF = 16, 32.0
_FIT = FitLines(loss="least_squares", scale=1.0)


def problem() -> Problem:
    """Return the error of the direction over the coordinates and the shape of the set of points."""
    axes = (
        Axis("coordinates / extent of the points", 0.1, 1e4),
        Axis("1 - variance across / along the line", 1e-6, 0.999),
    )
    return Problem(axes, "1 rad", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    size, shape = places[:, 0], np.sqrt(1.0 - places[:, 1])
    angle, middle = rng.uniform(-1.5, 1.5, len(places)), rng.uniform(-1.0, 1.0, (len(places), 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    u = np.linspace(-_HALF, _HALF, _POINTS)
    v = shape[:, None] * np.sqrt(np.mean(u**2)) * (-1.0) ** (np.arange(_POINTS) // 2 + np.arange(_POINTS))
    points = 2.0 * _HALF * size[:, None, None] * middle[:, None] + u[:, None] * along
    points = (points + v[..., None] * along[..., ::-1] * (-1.0, 1.0)).astype(np.float32)
    normal = np.asarray(_FIT(points, device=device).normal, np.float64)
    centred = points - points.mean(axis=1, keepdims=True, dtype=np.float64)
    direction = np.linalg.svd(centred)[2][:, 0]
    return np.asarray(np.abs(np.sum(normal * direction, axis=-1)))


def _bound(places: Floats) -> Floats:
    # Error model of the fit: 3e-7 of the extent for each point. The sums of products have twice this relative error;
    # the direction turns by it over the difference of the two variances, as a fraction of the larger one. The extent is
    # twice the root mean square times the root of 3.
    return np.asarray(2.0 * 3e-7 * np.sqrt(3.0) / places[:, 1])
