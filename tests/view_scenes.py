"""Views of a flat grid through a camera, exact or with smooth errors that differ from view to view."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.tilted_projection import rotation_matrix

SIZE = (1280, 960)
RADIAL = (-0.2, 0.08)
Views = list[tuple[np.ndarray, np.ndarray]]


def camera(*distortion: float) -> Camera:
    return Camera(
        matrix=((900.0, 0.0, 650.0), (0.0, 900.0, 470.0), (0.0, 0.0, 1.0)),
        distortion=(*distortion, *(0.0,) * (14 - len(distortion))),
    )


def exact_views(rng: np.random.Generator, seen: Camera, views: int = 10) -> Views:
    """Return views of a grid of 11 x 8 points that fills most of the image."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 11), np.linspace(-0.22, 0.22, 8))
    target = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    result = []
    while len(result) < views:
        turn = rotation_matrix(rng.normal(0.0, 0.3, 3))
        points = seen.project(target @ turn.T + rng.normal((0.0, 0.0, 0.55), (0.04, 0.04, 0.04)))
        inside = np.isfinite(points).all(axis=1) & (points > 0.0).all(axis=1) & (points < SIZE).all(axis=1)
        if inside.sum() > 40:
            result.append((target[inside], points[inside]))
    return result


def bent(rng: np.random.Generator, views: Views, rms: float, noise: float) -> Views:
    """Return the views with a smooth field, different in each view, and noise."""
    result = []
    for target, points in views:
        field = np.zeros_like(points)
        for _ in range(20):
            wave = np.cos(points @ rng.normal(0.0, 3.0, 2) / 800.0 + rng.uniform(0.0, 2.0 * np.pi))
            field += wave[:, None] * rng.normal(size=2)
        result.append((target, points + field * rms / np.sqrt(20.0) + rng.normal(0.0, noise, points.shape)))
    return result
