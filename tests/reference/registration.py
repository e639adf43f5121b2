"""Reference of the coarse registration: cell means, costs of edges, and costs of poses, by definition."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def cell_means(image: NDArray[Any], cell: int) -> Float64:
    """Return the means of squares of ``cell`` x ``cell`` pixels."""
    rows, columns = (each // cell for each in image.shape)
    cut = image[: rows * cell, : columns * cell].astype(np.float64)
    return np.asarray(cut.reshape(rows, cell, columns, cell).mean(axis=(1, 3)))


def edge_costs(means: Float64, threshold: float, border: int, channels: int = 8) -> Float64:
    """Return the cost of an edge, (channels, rows, columns), 0 to 1, not rounded."""
    rows, columns = means.shape
    # Only where all eight neighbours exist and are finite.
    share = np.zeros((channels, rows + 2 * border, columns + 2 * border))
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            at = means[y - 1 : y + 2, x - 1 : x + 2]
            gx = np.array([1, 2, 1]) @ (at[:, 2] - at[:, 0]) / 8
            gy = np.array([1, 2, 1]) @ (at[2] - at[0]) / 8
            if not np.isfinite(gx + gy):
                continue
            strength = np.hypot(gx, gy)
            away = np.arctan2(gy, gx) - np.arange(channels) * np.pi / channels
            share[:, y + border, x + border] = (strength * np.cos(away)) ** 2 / (strength**2 + (threshold / 4) ** 2)
    padded = np.pad(share, ((0, 0), (1, 1), (1, 1)))
    best = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2)).max(axis=(-1, -2))
    return np.asarray(1.0 - best**2)


def pose_costs(level: NDArray[np.uint16], shifts: NDArray[np.int32], rows: int, columns: int) -> Float64:
    """Return the mean cost over the points with a shift >= 0, summed in integers: (headings, rows, columns)."""
    flat, stride = level.ravel().astype(np.int64), level.shape[2]
    at = np.arange(rows)[:, None] * stride + np.arange(columns)
    scores = np.full((len(shifts), rows, columns), np.nan)
    for turn, each in enumerate(shifts):
        used = each[each >= 0]
        if len(used):
            scores[turn] = flat[used[:, None, None] + at].sum(axis=0) / (1023.0 * len(used))
    return scores
