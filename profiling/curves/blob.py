"""Round marks: spokes, width of a spoke, smoothing, and passes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.profiling.blob import NOISE, THRESHOLD, scene
from gpuvision.profiling.blob_peers import SEARCH
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with

_COUNT = 400
_USUAL: dict[str, Any] = {"spokes": 16, "width": 1, "smoothing_px": 1.5, "passes": 2, "match": True}
_CHANGES: tuple[dict[str, Any], ...] = (
    {},
    *({"spokes": spokes} for spokes in (8, 12, 24, 32)),
    *({"width": width} for width in (3, 5)),
    *({"smoothing_px": smoothing} for smoothing in (0.7, 1.0, 2.5)),
    {"passes": 1},
    *({"match": False, "spokes": spokes, "passes": passes} for spokes in (8, 16, 32) for passes in (1, 2)),
    {"spokes": 32, "width": 3, "smoothing_px": 1.0},
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the settings on blurred discs with noise."""
    image, places, true = scene(_COUNT)
    for change in _CHANGES:
        parameters: dict[str, Any] = {**_USUAL, **change}
        operation = FindBlobs(threshold=THRESHOLD, search_px=SEARCH, noise=NOISE, count=_COUNT, **parameters)
        bound = bind_with(operation, device, image, places)
        found = np.stack([to_numpy(bound.outputs.x), to_numpy(bound.outputs.y)], axis=-1)
        yield Setting("blob", "discs with noise", parameters, bound.run, Errors(distance(found, true)), "px")
