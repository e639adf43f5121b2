"""Undistortion of points: the coefficients that are modelled, and the precision."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with

_COUNT = 100_000
_SIZE = (1280.0, 1024.0)
_MATRIX = ((1400.0, 0.0, 640.0), (0.0, 1400.0, 512.0), (0.0, 0.0, 1.0))
# A real lens: each group of coefficients moves the points less than the group before it.
_DISTORTION = (-0.12, 0.06, 4e-4, -3e-4, -0.02, 2e-3, -1e-3, 5e-4, 2e-5, -1e-5, 1e-5, -2e-5, 2e-3, -1e-3)
_MODELS = {"k1": 1, "k1, k2": 2, "5 coefficients": 5, "8 coefficients": 8, "12 coefficients": 12, "14 coefficients": 14}


def settings(device: Device) -> Iterator[Setting]:
    """Yield the models in single and double precision."""
    rng = np.random.default_rng(9)
    ideal = rng.uniform(0.0, 1.0, (_COUNT, 2)) * _SIZE
    measured = Camera(matrix=_MATRIX, distortion=_DISTORTION).distort(ideal)
    for model, terms in _MODELS.items():
        camera = Camera(matrix=_MATRIX, distortion=_DISTORTION[:terms] + (14 - terms) * (0.0,))
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            bound = bind_with(UndistortPoints(model=camera), device, measured.astype(dtype))
            deviation = distance(to_numpy(bound.outputs.points), ideal)
            parameters = {"model": model, "precision": "single" if dtype == "float32" else "double"}
            yield Setting("undistort_points", "lens of 14 coefficients", parameters, bound.run, Errors(deviation), "px")
