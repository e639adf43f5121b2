"""Reference of the merge of two height maps: cell by cell, as the docstring of `gpuvision.MergeHeights` says."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

NOT_FINITE, AMBIGUOUS = 8, 16
_DOUBTFUL = 2 | 16 | 128  # SATURATED, AMBIGUOUS, NOT_INVERTIBLE: the height counts


class ReferenceMergedHeights(NamedTuple):
    """Merged height map: heights, intensities and standard deviations (float64), flags and sources (uint8)."""

    z: NDArray[np.float64]
    intensity: NDArray[np.float64]
    status: NDArray[np.uint8]
    sigma: NDArray[np.float64]
    source: NDArray[np.uint8]


def merge_heights(
    first: tuple[Any, Any, Any, Any],
    second: tuple[Any, Any, Any, Any],
    *,
    max_sigmas: float,
    tolerance: float,
    disagreement: str,
    require_both: bool = False,
) -> ReferenceMergedHeights:
    """Merge two maps of (z, intensity, status, sigma); a sigma of None: equal weights."""
    shape = np.shape(first[0])
    made = ReferenceMergedHeights(
        z=np.full(shape, math.nan),
        intensity=np.full(shape, math.nan),
        status=np.zeros(shape, np.uint8),
        sigma=np.full(shape, math.nan),
        source=np.zeros(shape, np.uint8),
    )
    for cell in np.ndindex(shape):
        cells = []
        for z, intensity, status, sigma in (first, second):
            spread = 1.0 if sigma is None else float(sigma[cell])
            height, flag = float(z[cell]), int(status[cell])
            known = math.isfinite(height) and math.isfinite(spread) and spread > 0.0
            if not known and flag == 0:
                flag = NOT_FINITE
            cells.append((known and not flag & ~_DOUBTFUL, height, float(intensity[cell]), spread, flag))
        taken, flag, disagrees = _decide(cells, first[3] is not None, max_sigmas, tolerance, disagreement)
        unconfirmed = require_both and len(taken) == 1 and not disagrees
        if unconfirmed:
            taken, flag = [], cells[0][4] | cells[1][4]
        made.status[cell] = flag
        made.source[cell] = sum(1 << number for number in taken) + 4 * disagrees + 8 * unconfirmed
        if taken:
            weights = np.array([1.0 / cells[number][3] ** 2 for number in taken])
            weights /= weights.sum()
            made.z[cell] = sum(weight * cells[number][1] for weight, number in zip(weights, taken, strict=True))
            made.intensity[cell] = sum(weight * cells[number][2] for weight, number in zip(weights, taken, strict=True))
            made.sigma[cell] = math.sqrt(1.0 / sum(1.0 / cells[number][3] ** 2 for number in taken))
    return made


def _decide(
    cells: list[tuple[bool, float, float, float, int]],
    with_sigma: bool,
    max_sigmas: float,
    tolerance: float,
    disagreement: str,
) -> tuple[list[int], int, bool]:
    """Return the numbers of the maps that are taken, the status, and whether the maps disagree."""
    present = [number for number in (0, 1) if cells[number][0]]
    flags = cells[0][4] | cells[1][4]
    if len(present) < 2:
        return present, cells[present[0]][4] if present else flags, False
    heights = [each[1] for each in cells]
    limit = tolerance + (max_sigmas * math.hypot(cells[0][3], cells[1][3]) if with_sigma else 0.0)
    if abs(heights[0] - heights[1]) <= limit:
        return [0, 1], flags, False
    doubtful = [each[4] != 0 for each in cells]
    if doubtful[0] != doubtful[1]:
        good = int(doubtful[0])
        return [good], cells[good][4], True
    chosen = {
        "drop": [],
        "first": [0],
        "second": [1],
        "lower": [int(heights[1] < heights[0])],
        "higher": [int(heights[1] > heights[0])],
        "mean": [0, 1],
    }[disagreement]
    return chosen, flags | AMBIGUOUS, True
