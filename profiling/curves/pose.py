"""Robust poses from edges: loss, numbers of trials and iterations, and precision; a fifth of the edges are wrong."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with

_POSES, _EDGES, _WRONG = 200, 60, 12
_HALF = 5e-3  # half of the size of the board [m]
_SIGMA = 2e-6  # of an edge [m]
_PLACEMENT = (2e-3, -1e-3)  # [m]
_CHANGES: tuple[dict[str, Any], ...] = (
    {"loss": "least_squares"},
    {"loss": "huber"},
    *({"max_trials": trials} for trials in (16, 32, 64, 128)),
    *({"max_iterations": iterations} for iterations in (1, 3, 6)),
    {"loss": "ransac"},
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings; the error is that of the placement point."""
    rows, true = _rows()
    for change in _CHANGES:
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            parameters = {"loss": "tukey", "max_trials": 64, "max_iterations": 12, **change}
            bound = bind_with(SolvePose(placement=_PLACEMENT, **parameters), device, rows.astype(dtype))
            deviation = distance(to_numpy(bound.outputs.placement), true)
            parameters["precision"] = "single" if dtype == "float32" else "double"
            yield Setting("pose", "a fifth of the edges wrong", parameters, bound.run, Errors(deviation), "m")


def _rows() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return rows of edges (poses, edges, 7), and the true positions (poses, 2) of the placement point [m]."""
    rng = np.random.default_rng(17)
    rows, places = [], []
    for x, y, theta in rng.normal(0.0, (3e-5, 3e-5, 4e-3), (_POSES, 3)):
        angle, point = rng.uniform(0.0, 2.0 * np.pi, _EDGES), rng.uniform(-_HALF, _HALF, (_EDGES, 2))
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        away = rng.normal(0.0, _SIGMA, (_EDGES, 1))
        away[:_WRONG] += rng.uniform(50.0, 200.0, (_WRONG, 1)) * _SIGMA
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        rows.append(line_rows(normal, point, (point + away * normal) @ turn.T + (x, y), np.full(_EDGES, _SIGMA)))
        places.append(turn @ _PLACEMENT + (x, y))
    return np.stack(rows), np.array(places)
