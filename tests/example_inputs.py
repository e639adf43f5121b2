"""Random inputs for the examples of all operations, for tests that compare two runs of an operation bit by bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Operations to which random images, rays and rows show nothing: their numbers are NaN, only their flags are compared.
WITHOUT_NUMBERS = frozenset(
    {
        "ClosestHit",
        "FieldPoseRefinement",
        "FindBlobs",
        "MeasureBoardEdges",
        "MeasureDeposits",
        "MirrorPoints",
        "RulerEdges",
        "SolveFeatures",
        "_AlongProfiles",
        "_AlongSamples",
    }
)


def random_values(shape: tuple[int, ...], dtype: np.dtype[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Return positive numbers or grey levels; zeros for integers of 4 bytes and more, which are indices."""
    if dtype.kind == "f":
        return rng.uniform(0.1, 1.0, shape).astype(dtype)
    if dtype.itemsize < 4:
        return rng.integers(0, 200, shape).astype(dtype)
    return np.zeros(shape, dtype)


def assert_has_numbers(operation: Any, results: Any) -> None:
    """Assert that each result in floating point has a finite number: equal NaN would prove nothing."""
    if type(operation).__name__ in WITHOUT_NUMBERS:
        return
    for name, values in zip(results._fields, results, strict=True):
        assert values is None or np.isfinite(values).any(), f"{type(operation).__name__}.{name} is nowhere finite"
