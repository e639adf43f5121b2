"""Light of a lit line with occlusion: exact hidden intervals, or shadow rays to samples of the line.

Truth is the irradiance by intervals in double precision, which the tests compare with rays in float64. Errors are
relative to the mean irradiance of the receivers that get light.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.profiling.occluded_irradiance import CLEARANCE, Board
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows


def settings(device: Device) -> Iterator[Setting]:
    """Yield the methods on a board with parts; nothing on a device without doubles, which has no truth."""
    if not device.has_double:
        return
    board = Board.of()
    rows, weights = segment_rows(board.segments), np.ones((*board.receivers.shape[:2], 2))

    def bound_with(parameters: dict[str, Any], dtype: str) -> Any:
        operation: Any = OccludedIrradiance(scene=board.scene, segments=len(rows), clearance=CLEARANCE, **parameters)
        return bind_with(operation, device, *(each.astype(dtype) for each in (board.receivers, weights, rows)))

    exact = bound_with({}, "float64")
    true = to_numpy(exact.outputs.irradiance).astype(np.float64)
    unit = true[true > 0.0].mean()
    methods: list[dict[str, Any]] = [{"visibility": "intervals"}, {"visibility": "none"}]
    methods += [{"visibility": "rays", "samples": samples} for samples in (1, 2, 4, 8, 16, 32)]
    for parameters in methods:
        for dtype in ("float32", "float64") if parameters["visibility"] == "intervals" else ("float32",):
            bound = bound_with(parameters, dtype)
            deviation = (to_numpy(bound.outputs.irradiance) - true) / unit
            named = {**parameters, "precision": "single" if dtype == "float32" else "double"}
            yield Setting("occluded_irradiance", "board with 40 parts", named, bound.run, Errors(deviation), "")
