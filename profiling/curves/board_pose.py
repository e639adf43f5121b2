"""Fused pose of a board: rulers of each line, start candidates and iterations, and lines of a ruler.

Frames of the benchmark with new noise: a line is displaced, and some rulers cross a spot brighter than their edge. The
error is that of the placement point.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling import board_pose as benchmark
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with
from gpuvision.profiling.pose import PLACEMENT

_FRAMES, _NOISE = 8, 4.0  # [levels]
_CHANGES: tuple[dict[str, Any], ...] = (
    *({"rulers_per_line": count} for count in (4, 5, 10)),
    *({"max_iterations": count} for count in (2, 4)),
    {"max_trials": 16},
    {"width": 1},
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings, each changed alone."""
    image, rulers, lines = benchmark.scene()
    noise = np.random.default_rng(18).normal(0.0, _NOISE, (_FRAMES, *image.shape))
    frames = np.rint(np.clip(image + noise, 0.0, 255.0)).astype(np.uint8)
    c, s = np.cos(benchmark.TRUE_POSE[2]), np.sin(benchmark.TRUE_POSE[2])
    true = np.array([[c, -s], [s, c]]) @ PLACEMENT + benchmark.TRUE_POSE[:2]
    for change in _CHANGES:
        parameters = {"rulers_per_line": 10, "max_trials": 64, "max_iterations": 12, "width": 5, **change}
        some = np.ascontiguousarray(rulers[:, :: -(-10 // parameters["rulers_per_line"])])
        solver = SolvePose(
            placement=PLACEMENT,
            max_trials=parameters["max_trials"],
            max_iterations=parameters["max_iterations"],
        )
        edges = RulerEdges(threshold=20.0, length=64, width=parameters["width"], smoothing_px=1.0, noise=4.5)
        operation = BoardPoseEstimator(ruler=edges, lines=len(lines), rulers_per_line=some.shape[1], solver=solver)
        bound = bind_with(operation, device, frames[0], some, lines)
        found = []
        for frame in frames:
            bound.inputs[0].set(frame)
            found.append(to_numpy(bound.run().placement).copy())
        parameters["rulers_per_line"] = some.shape[1]
        deviation = distance(found, np.broadcast_to(true, (len(frames), 2)))
        yield Setting("board_pose", "a line displaced, spots", parameters, bound.run, Errors(deviation), "m")
