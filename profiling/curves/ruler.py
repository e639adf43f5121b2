"""Calipers (rulers) across a blurred edge at any angle: length, width, smoothing, and the step between samples.

The edge has 100 grey levels, blurred by 1.2 px, and white noise; see `ruler_accuracy`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.profiling.ruler_accuracy import SIDE, scenes

_IMAGES = 4  # per angle
_NOISES = (1.0, 8.0)  # [levels]
_USUAL = {"length": 41, "width": 5, "smoothing_px": 1.2, "step_px": 1.0}
_CHANGES: tuple[dict[str, Any], ...] = (
    {},
    *({"width": width} for width in (1, 3, 9, 15)),
    *({"length": length} for length in (21, 31, 64)),
    *({"smoothing_px": smoothing} for smoothing in (0.7, 1.0, 1.5, 2.5)),
    {"length": 81, "step_px": 0.5},
    {"length": 21, "width": 1, "smoothing_px": 1.0},
    {"length": 31, "width": 15, "smoothing_px": 1.5},
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings of the caliper at a high and a low ratio of signal to noise."""
    for noise in _NOISES:
        image, rulers, true = _one_image(noise)
        for change in _CHANGES:
            parameters: dict[str, Any] = {**_USUAL, **change}
            operation = RulerEdges(threshold=20.0, noise=noise, count=len(rulers), **parameters)
            bound = bind_with(operation, device, image, rulers)
            deviation = to_numpy(bound.outputs.position) - true
            yield Setting("ruler", f"SNR {100.0 / noise:.0f}", parameters, bound.run, Errors(deviation), "px")


def _one_image(noise: float) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Return the scenes below each other in one image, their rulers (n, 4), and the true positions (n,) [px]."""
    images, rulers, true = zip(*scenes(noise, _IMAGES, seed=11), strict=True)
    placed = [each + np.array([0.0, SIDE * number, 0.0, 0.0]) for number, each in enumerate(rulers)]
    return np.concatenate(images), np.concatenate(placed).astype(np.float32), np.concatenate(true)
