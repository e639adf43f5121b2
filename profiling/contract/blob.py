"""Contract of blobs: every shape, types of pixels, no match of the pixels, and places without a blob.

The images have no noise: the reference is the true place, size and angle of the shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.blob import FindBlobs
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference.blob import render
from gpuvision.status import Status

_STEP, _SIZE = 6e-4, 1e-2
LIMITS = {
    "FindBlobs": (
        equal("status", "inliers", reason="counts and comparisons of residuals far from the tuning constant"),
        Limit(
            ("x", "y"), _STEP, _STEP, "blur [px] x (1 + rounding of a pixel / (2.4e-4 of the contrast))",
            "the polynomial of a blurred step errs by 2.4e-4 of the contrast, at a slope of the contrast / (2.5 blur)",
        ),
        Limit(("size",), _SIZE, _SIZE, "1 px", "error model of the docstring"),
        Limit(("angle",), _STEP, _STEP, "quantity of the place / size [rad]", "error of the place at the contour"),
    )
}  # fmt: skip
_ACROSS, _RATIO, _POLYNOMIAL = 4, 0.4, 2.4e-4
_SHAPES = (("circle", 8.0, 1.0), ("ring", 14.0, 1.2), ("square", 9.0, 1.0), ("cross", 14.0, 1.0))  # size, blur [px]
_CONTRASTS = {"uint8": 200.0, "uint16": 40000.0, "float32": 100.0}


def cases() -> Iterator[Case]:
    """Yield each shape in float32 images, discs in images of integers, and places without a blob."""
    for shape, size, blur in _SHAPES:
        yield _case(f"{shape}, float32", shape, size, blur, "float32")
    for dtype in ("uint8", "uint16"):
        yield _case(f"circle, {dtype}", "circle", 8.0, 1.0, dtype)
    yield _case("circle, float32, blurred", "circle", 12.0, 2.5, "float32", smoothing_px=2.5)
    yield _case("holes", "circle", 8.0, 1.0, "float32", holes=True)


def _case(name: str, shape: Any, size: float, blur: float, dtype: str, *, holes: bool = False, **settings: Any) -> Case:
    rng, contrast = np.random.default_rng(36), _CONTRASTS[dtype]
    cell, is_round = int(2.0 * (size + 5.0 * blur + 16.0)), shape in ("circle", "ring")
    image, true = np.zeros((_ACROSS * cell, _ACROSS * cell)), np.empty((_ACROSS**2, 4))
    for number, row in enumerate(true):
        top, left = (cell * each for each in divmod(number, _ACROSS))
        x, y = 0.5 * cell + rng.uniform(-0.5, 0.5, 2)
        row[:] = left + x, top + y, size, 0.0 if is_round else rng.uniform(-0.1, 0.1)
        numbers = np.array([x, y, size, blur] if is_round else [x, y, size, row[3], blur])
        if not (holes and number % 4 == 0):
            image[top : top + cell, left : left + cell] = render(shape, (cell, cell), numbers, _RATIO)
    levels = contrast * (0.2 + image)
    given = levels.astype(np.float32) if dtype == "float32" else np.rint(levels).astype(dtype)
    places = true.copy()
    places[:, :2] += rng.uniform(-1.0, 1.0, (len(true), 2))
    places[:, 3] = 0.0
    status = np.zeros(len(true), np.uint8)
    if holes:
        places[1::4, 2], places[2::4, 0] = np.nan, -20.0
        for start, flag in ((0, Status.LOW_SIGNAL), (1, Status.NOT_FINITE), (2, Status.OUT_OF_RANGE)):
            status[start::4] = int(flag)
    operation = FindBlobs(
        threshold=0.2 * contrast, shape=shape, ratio=_RATIO, noise=0.01 * contrast, count=len(true), **settings
    )
    known = np.where(status[:, None] == 0, true, np.nan)
    exact: dict[str, npt.NDArray[Any]] = {"x": known[:, 0], "y": known[:, 1], "size": known[:, 2]}
    exact |= {"status": status, "inliers": np.where(status == 0, operation.spokes, 0)}
    rounded = 0.0 if dtype == "float32" else 0.5 / (_POLYNOMIAL * contrast)
    quantities = {"x": blur * (1.0 + rounded), "y": blur * (1.0 + rounded), "size": 1.0}
    if not is_round:
        exact["angle"], quantities["angle"] = known[:, 3], blur * (1.0 + rounded) / size
    rows = places[:, : 3 if is_round else 4].astype(np.float32)
    return Case("FindBlobs", name, operation, (given, rows), exact, quantities)
