"""What a sheet of light lights, by rays of light against every triangle, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from reference import rays as reference


def first_met(sheet: Any, corners: np.ndarray, L: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle that the sheet's rays meet first (-1: none), and where, (n, 3).

    ``x`` is G of parallel rays, and where those of a fan meet H = 0. A fan's begin a thousandth of the way there from
    its source: what is nearer does not stop them.
    """
    move = sheet.transport
    g_axis, h_axis = np.array(move.g_axis), np.array(move.h_axis)
    place = np.array(move.origin) + L * np.array(move.direction)
    foot = place + x[:, None] * g_axis
    if sheet.source is None:
        start, way = foot + 100.0 * h_axis, np.broadcast_to(-h_axis, foot.shape)
    else:
        source = place + sheet.source[0] * g_axis + sheet.source[1] * h_axis
        way = foot - source
        start = source + 1e-3 * way
    rays = np.hstack([start, way])
    triangle, distance, _, _ = reference.closest(corners, rays)
    unit = way / np.linalg.norm(way, axis=1, keepdims=True)
    return triangle, start + distance[:, None] * unit
