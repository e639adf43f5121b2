"""Area of deposits with sloping sides and noise: threshold of the height, and precision."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.inspection.deposits import MeasureDeposits
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with

_WINDOW, _APERTURES, _CELL = 32, 100, 1e-5  # cells, apertures, [m]
_HEIGHT, _BASE = 1e-4, 1e-3  # of the paste, and of the surface below it [m]
_THRESHOLDS = (2e-5, 4e-5, 5e-5, 6e-5, 8e-5)  # [m]


def settings(device: Device) -> Iterator[Setting]:
    """Yield thresholds; the true area is that of the paste at half of its height, with sides of 2 to 4 cells."""
    rng = np.random.default_rng(12)
    radius, width = rng.uniform(8.0, 12.0, _APERTURES), rng.uniform(1.0, 2.0, _APERTURES)  # [cells]
    middle = 0.5 * (_WINDOW - 1) + rng.uniform(-0.5, 0.5, (_APERTURES, 2, 1, 1))
    row, column = np.indices((_WINDOW, _WINDOW))
    away = np.hypot(column - middle[:, 0], row - middle[:, 1])
    paste = _HEIGHT * np.clip(0.5 + 0.5 * (radius[:, None, None] - away) / width[:, None, None], 0.0, 1.0)
    sigma = np.full(paste.shape, 2e-6)
    z = (_BASE + paste + rng.normal(0.0, sigma)).reshape(-1, _WINDOW)
    number = np.arange(_APERTURES, dtype=np.int32)
    owner = np.repeat(number + 1, _WINDOW)[:, None] * np.ones(_WINDOW, np.int32)
    first = number[:, None] * _WINDOW
    boxes = np.concatenate([first, first + _WINDOW, 0 * first, 0 * first + _WINDOW], axis=1)
    surface = np.zeros(49)
    surface[[0, 12]] = _BASE, _WINDOW * _CELL
    true = np.pi * (radius * _CELL) ** 2
    for threshold in _THRESHOLDS:
        operation = MeasureDeposits(apertures=_APERTURES, cell_area=_CELL**2, threshold=threshold)
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            table = np.tile(surface, (_APERTURES, 1)).astype(dtype)
            maps = [each.reshape(z.shape).astype(dtype) for each in (z, sigma)]
            bound = bind_with(operation, device, *maps, owner, boxes, table)
            parameters = {"threshold": threshold, "precision": "single" if dtype == "float32" else "double"}
            errors = Errors(to_numpy(bound.outputs.area) / true - 1.0)
            yield Setting("deposits", "height 100 um, noise 2 um", parameters, bound.run, errors, "")
