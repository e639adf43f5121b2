"""Robust line fits: loss, numbers of trials and iterations, and precision, with and without gross errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with

_LINES, _POINTS = 2000, 20
_SIGMA = 0.05  # [px]
_CHANGES: tuple[dict[str, Any], ...] = (
    {"loss": "least_squares"},
    {"loss": "huber"},
    *({"loss": "tukey", "max_trials": trials} for trials in (4, 16, 64, 190)),
    *({"loss": "tukey", "max_iterations": iterations} for iterations in (1, 2, 5)),
    {"loss": "ransac"},
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings without outliers and with 30 % of them."""
    for outliers in (0.0, 0.3):
        points, middle, normal = _lines(outliers)
        for change in _CHANGES:
            for dtype in ("float32", "float64") if device.has_double else ("float32",):
                operation = FitLines(scale=1.0, weighted=True, **change)
                sigma = np.full(points.shape[:2], _SIGMA, dtype)
                bound = bind_with(operation, device, points.astype(dtype), sigma)
                fits: Any = bound.outputs
                of_fit, distance = to_numpy(fits.normal).astype(np.float64), to_numpy(fits.distance)
                side = np.sign(np.sum(of_fit * normal, axis=-1))
                deviation = side * (np.sum(of_fit * middle, axis=-1) - distance)
                parameters = {"max_trials": 64, "max_iterations": 12, **change}
                parameters["precision"] = "single" if dtype == "float32" else "double"
                yield Setting("line_fit", f"{outliers:.0%} outliers", parameters, bound.run, Errors(deviation), "px")


def _lines(outliers: float) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return points (lines, points, 2), a point (lines, 2) of each true line, and the true normals (lines, 2)."""
    rng = np.random.default_rng(13)
    angle, middle = rng.uniform(-np.pi / 2, np.pi / 2, _LINES), rng.uniform(0.0, 1000.0, (_LINES, 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal = along[:, ::-1] * (-1.0, 1.0)
    u, v = rng.uniform(-30.0, 30.0, (_LINES, _POINTS, 1)), rng.normal(0.0, _SIGMA, (_LINES, _POINTS, 1))
    bad = round(outliers * _POINTS)
    v[:, :bad] += rng.uniform(1.0, 20.0, (_LINES, bad, 1))
    return middle[:, None] + u * along[:, None] + v * normal[:, None], middle, normal
