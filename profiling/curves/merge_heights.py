"""Merge of two height maps with noise and outliers: weights by the sigmas, treatment of disagreement, and precision."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.ranging.merge_heights import DISAGREEMENTS, MergeHeights

_CELLS = 100_000
_CHANGES: tuple[dict[str, Any], ...] = (
    {"sigma": False, "tolerance": 3e-5},
    *({"disagreement": each} for each in DISAGREEMENTS),
    *({"max_sigmas": limit} for limit in (2.0, 6.0)),
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings on maps in which 2 % of the heights are off by up to 1 mm."""
    rng = np.random.default_rng(6)
    surface = rng.uniform(-5e-3, 5e-3, _CELLS)
    spread = 10.0 ** rng.uniform(-6.0, -5.0, (2, _CELLS))
    heights = surface + spread * rng.normal(size=spread.shape)
    wrong = rng.random(spread.shape) < 0.02
    heights[wrong] += rng.uniform(-1e-3, 1e-3, int(wrong.sum()))
    light, good = np.ones((2, _CELLS)), np.zeros((2, _CELLS), np.uint8)
    for change in _CHANGES:
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            operation = MergeHeights(**{"sigma": True, **change})
            maps = [(heights[k].astype(dtype), light[k].astype(dtype), good[k]) for k in (0, 1)]
            sigmas = [each.astype(dtype) for each in spread] if operation.sigma else []
            bound = bind_with(operation, device, *maps[0], *maps[1], *sigmas)
            parameters = {
                "sigma": operation.sigma,
                "disagreement": operation.disagreement,
                "max_sigmas": operation.max_sigmas,
                "precision": "single" if dtype == "float32" else "double",
            }
            deviation = to_numpy(bound.outputs.z) - surface
            yield Setting("merge_heights", "2% of the heights wrong", parameters, bound.run, Errors(deviation), "m")
