"""Range images without noise: precision, for places of the scene's origin and for both kinds of motion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with
from gpuvision.profiling.range_image import ROTATING
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference.range_image import points_of_rotating_sheet, points_of_straight_transport

_SHAPE = (200, 500)


def settings(device: Device) -> Iterator[Setting]:
    """Yield both precisions; the error is the distance of a point from the point of the same inputs in float64."""
    rng = np.random.default_rng(8)
    for away in (0.1, 10.0, 1000.0):
        geometry = StraightTransport(step=1e-4, h_axis=(0.0, 0.7, 1.0), origin=(away, away, 0.0))
        g, h = rng.uniform(-0.05, 0.05, (2, *_SHAPE))
        travel = geometry.transport(_SHAPE[0])
        truth = points_of_straight_transport(geometry, g, h, travel)
        yield from _settings(device, f"origin {away:g} m away", geometry, (g, h, travel), truth)
    angles = ROTATING.transport(_SHAPE[0])
    position = 511.5 + 1700.0 * (np.tan(angles)[:, None] + rng.uniform(0.02, 0.3, _SHAPE))
    truth, *_ = points_of_rotating_sheet(ROTATING, position, angles)
    yield from _settings(device, "rotating sheet", ROTATING, (position, angles), truth)


def _settings(device: Device, data: str, geometry: Any, inputs: tuple[Any, ...], truth: Any) -> Iterator[Setting]:
    for dtype in ("float32", "float64") if device.has_double else ("float32",):
        given = [each.astype(dtype) for each in inputs]
        bound = bind_with(RangeImage(geometry=geometry), device, *given, np.zeros(_SHAPE, np.uint8))
        points = np.stack([to_numpy(getattr(bound.outputs, axis)) for axis in "xyz"], axis=-1)
        parameters = {"precision": "single" if dtype == "float32" else "double"}
        yield Setting("range_image", data, parameters, bound.run, Errors(distance(points, truth)), "m")
