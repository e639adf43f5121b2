"""Distance map of a field, compared with Numba, NumPy and OpenCV's distance transform.

Distance, four nearest lines and cost of 3.5e5 cells of a field of 22 m with 17 lines and 5 arcs. Numba does the same in
vectorised loops over columns, on all cores: with all lines in each row ("rows"), or in square tiles with the lines that
can be nearest to one of their cells ("tiles"), as the kernel does. NumPy computes in arrays over all cells, without the
nearest lines.
OpenCV draws the lines and transforms the image, which has only the distance, to the centres of the drawn pixels;
`opencv_error_m` is its largest error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device, to_numpy
from gpuvision.matching.field.distance_map import COST_LEVELS, DistanceMapBuilder, Field
from gpuvision.profiling.harness import Case, Peer

Array = NDArray[Any]

_SCALE = 0.25  # c of the cost d^2 / (c^2 + d^2) [m]
_NEAREST, _SUBPIXELS = 4, 10  # bits of a fine pixel in OpenCV's drawing
_TILE = 32  # side of the tiles of the peer numba [cells]


@numba.njit(inline="always")
def _far(dx, dy, c, s, half, end, radius):
    """Return the distance to a shape, from the vector between its middle and the point."""
    along, across = c * dx + s * dy, c * dy - s * dx
    if radius == np.float32(0.0):
        over = max(abs(along) - half, np.float32(0.0))
        return np.sqrt(over * over + across * across)
    away = np.sqrt(along * along + across * across)
    u, v = along - radius * half, abs(across) - radius * end
    return np.sqrt(u * u + v * v) if along < away * half else abs(away - radius)


@numba.njit(inline="always")
def _row(at_x, y, shapes, used, diagonal, scale_squared, best, which, distance, nearest, level):
    """Insert the distance of each shape into the four smallest ones, by exchanges without a branch."""
    columns = at_x.shape[0]
    for place in range(4):
        for x in range(columns):
            best[place, x], which[place, x] = np.float32(np.inf), 0
    for k in used:
        c, s, half, end, radius = shapes[k, 2], shapes[k, 3], shapes[k, 4], shapes[k, 5], shapes[k, 6]
        middle, dy = shapes[k, 0], y - shapes[k, 1]
        for x in range(columns):
            far, index = _far(at_x[x] - middle, dy, c, s, half, end, radius), np.int32(k)
            for place in range(4):
                is_less = far < best[place, x]
                held, of = best[place, x], which[place, x]
                best[place, x], which[place, x] = (far, index) if is_less else (held, of)
                far, index = (held, of) if is_less else (far, index)
    for x in range(columns):
        least = best[0, x]
        for place in range(4):
            nearest[x, place] = which[place if best[place, x] <= least + diagonal else 0, x]
        distance[x] = least
        square = least * least
        level[x] = np.uint16(square / (scale_squared + square) * np.float32(1023.0) + np.float32(0.5))


@numba.njit(parallel=True, error_model="numpy")
def _numba_rows(at_x, at_y, shapes, diagonal, scale_squared, distance, nearest, level):
    every = np.arange(shapes.shape[0])
    for row in numba.prange(at_y.shape[0]):
        columns = at_x.shape[0]
        best, which = np.empty((4, columns), np.float32), np.empty((4, columns), np.int32)
        _row(
            at_x, at_y[row], shapes, every, diagonal, scale_squared, best, which,
            distance[row], nearest[row], level[row],
        )  # fmt: skip


@numba.njit(parallel=True, error_model="numpy")
def _numba_tiles(at_x, at_y, shapes, diagonal, scale_squared, distance, nearest, level):
    """Visit in a tile the shapes whose distance from its centre is within twice its radius of the least one."""
    bands = (at_y.shape[0] + _TILE - 1) // _TILE
    for band in numba.prange(bands):
        first, end = band * _TILE, min(band * _TILE + _TILE, at_y.shape[0])
        best, which = np.empty((4, _TILE), np.float32), np.empty((4, _TILE), np.int32)
        far, used = np.empty(shapes.shape[0], np.float32), np.empty(shapes.shape[0], np.int64)
        for left in range(0, at_x.shape[0], _TILE):
            right = min(left + _TILE, at_x.shape[0])
            x, y = (at_x[left] + at_x[right - 1]) * np.float32(0.5), (at_y[first] + at_y[end - 1]) * np.float32(0.5)
            for k in range(shapes.shape[0]):
                of = shapes[k]
                far[k] = _far(x - of[0], y - of[1], of[2], of[3], of[4], of[5], of[6])
            radius = np.hypot(x - at_x[left], y - at_y[first])
            limit = far.min() + np.float32(2.001) * radius + diagonal
            count = 0
            for k in range(shapes.shape[0]):
                if far[k] <= limit:
                    used[count] = k
                    count += 1
            for row in range(first, end):
                _row(
                    at_x[left:right], at_y[row], shapes, used[:count], diagonal, scale_squared, best, which,
                    distance[row, left:right], nearest[row, left:right], level[row, left:right],
                )  # fmt: skip


def _numpy(at_x: Array, at_y: Array, shapes: Array) -> tuple[Array, Array]:
    """Return distances and levels of all cells, in the type of the coordinates."""
    x, y = np.meshgrid(at_x, at_y)
    distance = np.full(x.shape, np.inf, x.dtype)
    for mx, my, c, s, half, end, radius in shapes:
        dx, dy = x - mx, y - my
        along, across = c * dx + s * dy, np.abs(c * dy - s * dx)
        if radius == 0.0:
            far = np.hypot(np.maximum(np.abs(along) - half, 0.0), across)
        else:
            away = np.hypot(along, across)
            ends = np.hypot(along - radius * half, across - radius * end)
            far = np.where(along < away * half, ends, np.abs(away - radius))
        np.minimum(distance, far, out=distance)
    square = distance * distance
    return distance, np.rint(COST_LEVELS * square / (_SCALE**2 + square)).astype(np.uint16)


def _opencv(field: Field, at_x: Array, at_y: Array, cell: float) -> Array:
    """Return distances [m] to the pixels of the drawn lines."""
    drawn = np.full((len(at_y), len(at_x)), 255, np.uint8)

    def pixels(points: Array) -> Array:
        return np.asarray(np.rint((points - [at_x[0], at_y[0]]) / cell * 2**_SUBPIXELS), np.int32)

    parts = [np.reshape(line, (2, 2)) for line in field.lines]
    for arc in field.arcs:
        turn = np.linspace(arc.start, arc.end, 200)
        parts.append(np.array([arc.x, arc.y]) + arc.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    cv2.polylines(drawn, [pixels(each) for each in parts], False, 0, 1, cv2.LINE_8, _SUBPIXELS)
    return np.asarray(cv2.distanceTransform(drawn, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)) * np.float32(cell)


def cases(device: Device) -> Iterator[Case]:
    """Yield the map of a large field with cells of 5 cm."""
    yield _case(device, 0.05)


def _case(device: Device, cell: float) -> Case:
    field = read_field("robocup_msl")
    columns, rows = round(34.0 / cell), round(26.0 / cell)  # the field and 6 m around it
    at_x = (cell * (np.arange(columns) - 0.5 * (columns - 1))).astype(np.float32)
    first = -0.5 * cell * (rows - 1)
    at_y = (first + cell * np.arange(rows)).astype(np.float32)
    operation = DistanceMapBuilder(field=field, first_y=first, cell=cell, rows=rows, scale=_SCALE)
    bound = operation.bind(device, at_x.shape, np.float32)
    bound.inputs[0].set(at_x)
    shapes = field.shapes.astype(np.float32)
    distance, nearest = np.empty((rows, columns), np.float32), np.empty((rows, columns, _NEAREST), np.uint8)
    level = np.empty((rows, columns), np.uint16)

    made = (distance, nearest, level)

    def by_numba(form: Callable[..., None]) -> Callable[[], None]:
        return lambda: form(at_x, at_y, shapes, np.float32(1.42 * cell), np.float32(_SCALE**2), *made)

    bound.run()
    forms = {"rows": by_numba(_numba_rows), "tiles": by_numba(_numba_tiles)}
    exact, _ = _numpy(at_x.astype(np.float64), at_y.astype(np.float64), field.shapes)
    ours, drawn = to_numpy(bound.outputs.distance), _opencv(field, at_x, at_y, cell)
    for name, form in forms.items():
        distance.fill(np.nan)
        nearest.fill(255)
        level.fill(0)
        form()
        # Rounding decides about the order of lines at equal distances, as on the axes of a symmetric field.
        same = np.mean(nearest == to_numpy(bound.outputs.nearest))
        steps = np.abs(level.astype(np.int32) - to_numpy(bound.outputs.level))
        agrees = same > 0.98 and steps.max() <= 1
        if not (agrees and np.allclose(distance, exact, atol=1e-5) and np.allclose(ours, exact, atol=1e-5)):
            raise AssertionError(f"the map of the peer numba ({name}) differs from ours")
    peers: dict[str, Peer] = {
        "numba": forms,
        "numpy": lambda: _numpy(at_x, at_y, shapes),
        "opencv": lambda: _opencv(field, at_x, at_y, cell),
    }
    metadata = {"cells": rows * columns, "opencv_error_m": float(np.max(np.abs(drawn - exact)))}
    error = float(np.max(np.abs(ours - exact)))
    traffic = (at_x.nbytes, rows * columns * (4 + _NEAREST + 2))
    return Case("field", f"map/{cell:g}", bound.run, peers, error, traffic, metadata=metadata)
