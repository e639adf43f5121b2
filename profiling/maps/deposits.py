"""Volume of deposits: height of the reference surface above 0, and its slope, over the height of the paste."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.inspection.deposits import MeasureDeposits
from gpuvision.profiling.maps.stability import Axis, Floats, Problem

_CELLS, _CELL, _PASTE = 8, 1e-5, 1e-4  # cells along each side of an aperture; [m]
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the volume over the height and the slope of the reference surface."""
    axes = (
        Axis("height of the surface / height of the paste", 0.1, 1e5),
        Axis("rise of the surface across the aperture / height of the paste", 1e-3, 1e3),
    )
    return Problem(axes, "volume", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    count = len(places)
    terms = np.zeros((count, 6))
    terms[:, 0], terms[:, 1] = _PASTE * places.T
    terms[:, 2] = terms[:, 1] * rng.uniform(-1.0, 1.0, count)
    terms = terms.astype(np.float32)
    at = (np.arange(_CELLS) + 0.5) / _CELLS - 0.5
    u, v = np.broadcast_arrays(at, -at[:, None])
    wide = terms.astype(np.float64)[:, :3, None, None]
    level = wide[:, 0] + wide[:, 1] * u + wide[:, 2] * v
    heights = (level + _PASTE * rng.uniform(0.5, 1.5, level.shape)).astype(np.float32)
    first = np.arange(count, dtype=np.int32)[:, None] * _CELLS
    boxes = np.concatenate([first, first + _CELLS, 0 * first, 0 * first + _CELLS], axis=1)
    owner = np.repeat(np.arange(1, count + 1, dtype=np.int32), _CELLS)[:, None] * np.ones(_CELLS, np.int32)
    row = np.array([-0.5 + 0.5 / _CELLS, 1.0 / _CELLS, 0.5 - 0.5 / _CELLS, -1.0 / _CELLS, 0.0, 0.0, _CELLS * _CELL])
    table = np.concatenate([terms, np.tile(row, (count, 1)), np.zeros((count, 36))], axis=1).astype(np.float32)
    operation = MeasureDeposits(apertures=count, cell_area=_CELL**2, threshold=0.1 * _PASTE)
    sigma = np.full((count * _CELLS, _CELLS), 1e-6, np.float32)
    found = operation(heights.reshape(sigma.shape), sigma, owner, boxes, table, device=device)
    exact = _CELL**2 * np.sum(heights - level, axis=(1, 2))
    return np.asarray(np.abs(np.asarray(found.volume, np.float64) / exact - 1.0))


def _bound(places: Floats) -> Floats:
    # Contract of the deposits: 4 epsilon of the distances of the heights from 0, over the heights, which are half of
    # the paste or more.
    return np.asarray(4.0 * _EPS * (places.sum(axis=1) + 1.5) / 0.5)
