"""Reference of the illumination by a sheet of light: rays of the sheet against every triangle."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.reference import rays

Float64 = NDArray[np.float64]


def first_hits(sheet: Any, corners: Float64, L: float, x: Float64) -> tuple[Float64, Float64]:
    """Return the first triangle that each ray of the sheet hits (-1: none), and the point (n, 3).

    Parameters
    ----------
    sheet : gpuvision.LightSheet
        Sheet of light: parallel rays, or a fan from a source.
    corners : numpy.ndarray
        Triangles (t, 3, 3) [m].
    L : float
        Transport [m].
    x : numpy.ndarray
        G at which each ray crosses H = 0 [m], (n,). A fan's rays begin at 0.001 of the way from the source to H = 0.
    """
    move = sheet.transport
    g_axis, h_axis = np.array(move.g_axis), np.array(move.h_axis)
    place = np.array(move.origin) + L * np.array(move.direction)
    foot = place + x[:, None] * g_axis
    if sheet.source is None:
        start, direction = foot + 100.0 * h_axis, np.broadcast_to(-h_axis, foot.shape)
    else:
        source = place + sheet.source[0] * g_axis + sheet.source[1] * h_axis
        direction = foot - source
        start = source + 1e-3 * direction
    triangle, distance, _, _ = rays.closest(corners, np.hstack([start, direction]))
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return triangle, start + distance[:, None] * unit
