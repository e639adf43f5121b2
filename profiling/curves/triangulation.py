"""Triangulation through a lens: the lens that is modelled, and the precision.

A lens with five coefficients distorts exact image points; the models have no lens, k1, k1 and k2, or all coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with
from gpuvision.ranging.triangulation import Triangulation

_COUNT = 200_000
_ROWS, _COLUMNS = 512, 1024
_MATRIX = ((1000.0, 0.0, 512.0), (0.0, 1000.0, 256.0), (0.0, 0.0, 1.0))
_DISTORTION = (-0.1, 0.05, 4e-4, -3e-4, -0.01)
_HOMOGRAPHY = ((1.1e-5, 2.0e-4, -0.1), (-2.2e-4, 1.0e-6, 0.06), (2.0e-4, 1.0e-5, 1.0))
_MODELS = {"none": 0, "k1": 1, "k1, k2": 2, "5 coefficients": 5}


def settings(device: Device) -> Iterator[Setting]:
    """Yield the lens models in single and double precision."""
    rng = np.random.default_rng(7)
    ideal = rng.uniform(0.0, 1.0, (_COUNT, 2)) * (_COLUMNS - 1, _ROWS - 1)
    measured = Camera(matrix=_MATRIX, distortion=_DISTORTION + 9 * (0.0,)).distort(ideal)
    # The sensor coordinate u of the sheet is the row, v the column.
    matrix = np.array(_HOMOGRAPHY)
    lifted = np.column_stack([ideal[:, ::-1], np.ones(_COUNT)]) @ matrix.T
    true = lifted[:, :2] / lifted[:, 2:]
    for model, terms in _MODELS.items():
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            kept = _DISTORTION[:terms] + (14 - terms) * (0.0,)
            operation = Triangulation(
                homography=_HOMOGRAPHY,
                region=((-20.0, _ROWS + 20.0), (-20.0, _COLUMNS + 20.0)),
                camera=Camera(matrix=_MATRIX, distortion=kept) if terms else None,
            )
            bound = bind_with(operation, device, *(np.ascontiguousarray(measured[:, k], dtype) for k in (1, 0)))
            found = np.stack([to_numpy(bound.outputs.g), to_numpy(bound.outputs.h)], axis=-1)
            parameters = {"lens": model, "precision": "single" if dtype == "float32" else "double"}
            yield Setting(
                "triangulation", "lens of 5 coefficients", parameters, bound.run, Errors(distance(found, true)), "m"
            )
