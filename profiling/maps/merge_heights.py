"""Merge of height maps: ratio of the standard deviations, and difference of the heights."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.ranging.merge_heights import MergeHeights

_HEIGHT, _SIGMA = 1e-3, 1e-6  # [m]
_EPS = float(np.finfo(np.float32).eps)
_MERGE = MergeHeights(sigma=True, tolerance=1e6)  # all heights agree


def problem() -> Problem:
    """Return the error of the height over the ratio of the sigmas and the difference of the heights."""
    axes = Axis("sigma of the second / first map", 1e-6, 1e6), Axis("difference / height", 1e-6, 1e6)
    return Problem(axes, "larger height", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    ratio, away = places.T
    first = _HEIGHT * rng.uniform(0.5, 1.0, len(places)) * rng.choice([-1.0, 1.0], len(places))
    heights = np.stack([first, first + _HEIGHT * away * rng.choice([-1.0, 1.0], len(places))]).astype(np.float32)
    sigmas = (_SIGMA * np.stack([np.ones_like(ratio), ratio]) * rng.uniform(0.5, 1.0, heights.shape)).astype(np.float32)
    light, good = np.ones(len(places), np.float32), np.zeros(len(places), np.uint8)
    found = _MERGE(heights[0], light, good, heights[1], light, good, *sigmas, device=device)
    z, weights = heights.astype(np.float64), sigmas.astype(np.float64) ** -2
    exact = np.sum(weights * z, axis=0) / np.sum(weights, axis=0)
    return np.asarray(np.abs(np.asarray(found.z, np.float64) - exact) / np.abs(z).max(axis=0))


def _bound(places: Floats) -> Floats:
    # Contract of the merge: 4 epsilon of the larger height and of the difference, which is at most twice as large.
    return np.full(len(places), 3.0 * 4.0 * _EPS)
