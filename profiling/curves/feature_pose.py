"""Pose of a camera over a board: number of start candidates and iterations, width of the rulers, size of the frame.

Frames of the benchmark with new noise. The error is that of the position.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gpuvision.host import Device
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.feature_pose import MOTION, PREDICTED, scene

_FRAMES, _NOISE = 8, 4.0  # [levels]
_CHANGES: tuple[dict[str, Any], ...] = (
    *({"max_iterations": count} for count in (2, 4, 12)),
    *({"max_trials": count} for count in (16, 256)),
    *({"width_px": count} for count in (1, 3)),
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings, each changed alone, for a small frame and a large one."""
    true = np.broadcast_to((PREDICTED + MOTION)[:2], (_FRAMES, 2))
    for size in (128, 256):
        image, features = scene(size)
        noise = np.random.default_rng(20).normal(0.0, _NOISE, (_FRAMES, *image.shape))
        frames = np.rint(np.clip(image + noise, 0.0, 255.0)).astype(np.uint8)
        for change in _CHANGES:
            parameters = {"max_trials": 64, "max_iterations": 12, "width_px": 5, **change}
            chosen = replace(features, imaging=replace(features.imaging, width_px=parameters["width_px"]))
            solver = SolvePose(max_trials=parameters["max_trials"], max_iterations=parameters["max_iterations"])
            bound = FeatureSet.bind(
                chosen, device, image.shape, np.uint8, copper="bright", threshold=20.0, noise=4.5,
                etch_bias_sigma=0.0, solver=solver,
            )  # fmt: skip
            found = [bound(frame, PREDICTED).pose[:2].copy() for frame in frames]
            run = functools.partial(bound, frames[0], PREDICTED)
            yield Setting("feature_pose", f"frame of {size} px", parameters, run, Errors(distance(found, true)), "m")
