"""Triangulation in float64 NumPy, from the equations: undo the lens, multiply by the homography, divide."""

from __future__ import annotations

import numpy as np

NOT_FINITE, HORIZON, NOT_INVERTIBLE = 8, 32, 128


def undistort(column, row, k1, k2, centre):
    """F. de Jong, eq. 3.11-3.13."""
    square = (column - centre[0]) ** 2 + (row - centre[1]) ** 2
    factor = 1.0 + k1 * square + k2 * square**2
    return centre[0] + (column - centre[0]) * factor, centre[1] + (row - centre[1]) * factor


def beyond_fold(column, row, k1, k2, centre):
    """True where some radius up to the point's own has the polynomial's slope at or below zero."""
    square = (column - centre[0]) ** 2 + (row - centre[1]) ** 2
    roots = np.roots([5.0 * k2, 3.0 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real if len(roots) else roots
    positive = real[real > 0.0]
    return square >= (positive.min() if len(positive) else np.inf)


def triangulate(u, v, homography, region, *, horizon=1e-3, lens=None, along="columns"):
    """(G, H, status) of float64 arrays; lens = (k1, k2, (C_c, R_c))."""
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    matrix = np.asarray(homography, dtype=np.float64)
    status = np.zeros(u.shape, dtype=np.uint8)
    middle = np.array([np.mean(region[0]), np.mean(region[1]), 1.0])
    straight_u, straight_v = u, v
    with np.errstate(all="ignore"):
        if lens is not None:
            k1, k2, centre = lens
            column, row = (v, u) if along == "columns" else (u, v)
            status = np.where(beyond_fold(column, row, k1, k2, centre), NOT_INVERTIBLE, status)
            column, row = undistort(column, row, k1, k2, centre)
            straight_u, straight_v = (row, column) if along == "columns" else (column, row)
        g, h, w = (line[0] * straight_u + line[1] * straight_v + line[2] for line in matrix)
        hidden = w / (matrix[2] @ middle) <= horizon
        g, h = g / w, h / w
    status = np.where(hidden & (status == 0), HORIZON, status)
    status = np.where(np.isfinite(u) & np.isfinite(v), status, NOT_FINITE).astype(np.uint8)
    return np.where(status == 0, g, np.nan), np.where(status == 0, h, np.nan), status
