"""Contract of calipers (rulers): edges at any angle, weak and blurred edges, rulers beyond the image and holes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference.ruler import find_edges, profile, random_rulers, step_image
from gpuvision.status import Status

LIMITS = {
    "RulerEdges": (
        equal("status", reason="comparisons only, except within rounding of the threshold or of the image's sides"),
        Limit(
            ("position",), 1e-4, 1e-4, "1 px for contrasts above 10 times the threshold",
            "error model of the docstring: samples relative to a pixel at the ruler",
        ),
        Limit(
            ("amplitude",), 2e-4, 2e-4, "contrast [levels]",
            "error of a sample's place at both ends of the edge, at slopes of the contrast per pixel",
        ),
    )
}  # fmt: skip
_SHAPE, _MIDDLE, _COUNT = (120, 150), (75.0, 60.0), 40
_CONTRAST, _THRESHOLD = 100.0, 3.0  # levels, levels per pixel


def cases() -> Iterator[Case]:
    """Yield noisy edges in images of each type, an odd step between samples, and rulers without an edge."""
    for number, dtype in enumerate(("uint8", "uint16", "float32")):
        yield _case(f"edges, {dtype}", dtype, angle=0.4 + number)
    yield _case("edges, step of 0.75 px", "float32", angle=2.5, length=51, width=4, step_px=0.75, smoothing_px=1.5)
    yield _case("blurred edges", "float32", angle=-1.2, blur=4.0)
    yield _case("beyond the image, and holes", "float32", angle=0.9, holes=True)


def _case(name: str, dtype: str, *, angle: float, blur: float = 1.2, holes: bool = False, **settings: Any) -> Case:
    rng = np.random.default_rng(33)
    distance = float(np.dot(_MIDDLE, (math.cos(angle), math.sin(angle))))
    values = step_image(_SHAPE, angle, distance, blur, 50.0, 50.0 + _CONTRAST) + rng.normal(0.0, 0.5, _SHAPE)
    image = values.astype(dtype) if dtype == "float32" else np.rint(values).astype(dtype)
    rulers = random_rulers(angle, distance, _COUNT, rng, _MIDDLE)
    status = np.zeros(_COUNT, np.uint8)
    if holes:
        rulers[::5, 0] += 500.0
        rulers[1::5, 3] = np.nan
        status[::5], status[1::5] = int(Status.OUT_OF_RANGE), int(Status.NOT_FINITE)
    given = rulers.astype(np.float32)
    parameters: dict[str, Any] = {"length": 41, "width": 5, "smoothing_px": 1.2, "step_px": 1.0, **settings}
    operation = RulerEdges(threshold=_THRESHOLD, count=_COUNT, **parameters)
    position, amplitude = (np.full(_COUNT, np.nan) for _ in range(2))
    for number in np.flatnonzero(status == 0):
        edge = strongest_edge(image, given[number], operation)
        position[number], amplitude[number] = edge["position"], edge["amplitude"]
    exact: dict[str, npt.NDArray[Any]] = {"position": position, "amplitude": amplitude, "status": status}
    quantities = {"position": 1.0, "amplitude": _CONTRAST}
    return Case("RulerEdges", name, operation, (image, given), exact, quantities)


def strongest_edge(image: npt.NDArray[Any], ruler: npt.NDArray[Any], operation: RulerEdges) -> dict[str, float]:
    """Return position, amplitude, gradient and variance of the strongest edge of an image along a ruler, in float64."""
    grey, _ = profile(image, ruler, operation.length, operation.width, operation.step_px)
    options = (operation.smoothing_px, operation.threshold, operation.step_px)
    return max(find_edges(grey, *options, ruler, operation.width), key=lambda edge: abs(edge["gradient"]))
