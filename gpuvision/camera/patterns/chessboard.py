"""Chessboards: their inner corners, found as saddles of the grey levels and told apart by walking."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import label

from gpuvision.camera.patterns.centroids import lattice_steps, sampled
from gpuvision.camera.patterns.grid_polynomial import on_grid
from gpuvision.camera.patterns.lattice import as_grid, charts, joined
from gpuvision.camera.patterns.pattern import (
    Float32,
    Float64,
    PatternGrid,
    boxed,
    finder_image,
    localisation_noise,
    shrunk,
    trimmed,
)

_FEWEST = 6
# Blur that corners are looked for with, in pixels of the image and of its half and its quarter.
_BLUR = 1.5
_LEVELS = 3
# A corner's curvature is at least this part of that of the strongest ones, which so many are.
_LEAST_SADDLE = 0.03
_STRONGEST = 20
_UNEVEN = 0.75
_MOST_CANDIDATES = 40_000
# Where the four squares about a corner are looked at, in steps; and the part of the usual contrast that they have.
_SQUARES = 0.3
_LEAST_CONTRAST = 0.5
# Limits of what a corner may lie off the others: times what is usual, but a small part of a step always.
_OFF_USUAL = 7.0
_OFF_STEP = 0.005
# Half the side of the window that a corner is measured in, in steps: the squares at the rim may be halves.
_WINDOW = 0.4
# Cells in a step of the map of what is white.
_WHITE_CELLS = 8
# Blur before it is measured, in steps, and in pixels at least.
_MEASURED_BLUR = 0.03
_LEAST_BLUR = 0.5
# A corner is none that moves farther, in steps, or whose window holds edges that lead by it: the mean square distance
# of all edges in it is so many times the usual.
_AWAY = 0.3
_OTHER_EDGES = 4.0
_ITERATIONS = 20
_SETTLED = 1e-4
_SINGULAR = 1e-9
_CHUNK_PIXELS = 1 << 17


def find_chessboard(image: npt.NDArray[Any], inner: tuple[int, int] | None = None) -> PatternGrid:
    """Find the inner corners of a chessboard.

    Corners are saddles of the grey levels, indexed by walking from neighbour to neighbour and kept where the four
    squares about them are dark and light by turns. Each is the point that the grey levels' gradients around it lead
    past, as all gradients of two crossing edges do (W. Foerstner), in a window as wide as the squares allow.

    Parameters
    ----------
    image
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, squares of at least 8
        pixels, the board turned by at most 45 degrees.
    inner
        Number of inner corners along both sides of the board, in any order; every row and column of them must be
        seen in part. Without, what is found is the board.

    Returns
    -------
    PatternGrid
        Corners that are hidden are NaN. Pixel (0, 0) is the centre of the first pixel, as with OpenCV.

    Raises
    ------
    ValueError
        If there is no chessboard, or it has not this number of corners; says how many were found.
    TypeError
        If the image is of another type.
    """
    grey = finder_image(image)
    rough = max((_board(grey, level) for level in range(_LEVELS)), key=_known)
    points = _measured(grey, rough)
    points[~on_grid(points, _OFF_USUAL, _OFF_STEP)] = np.nan
    points = trimmed(points)
    if _known(points) < _FEWEST:
        raise ValueError(
            f"{_known(points) or 'no'} corners of a chessboard found, expected at least {_FEWEST}; {_ADVICE}"
        )
    if inner is not None and sorted(points.shape[:2]) != sorted(inner):
        found, expected = (" x ".join(map(str, each)) for each in (points.shape[1::-1], inner))
        raise ValueError(f"a chessboard of {found} inner corners found, expected {expected}; {_ADVICE}")
    return PatternGrid(points, localisation_noise(points))


_ADVICE = "check that all of the board is seen, its light margin too, and focus and exposure"


def _known(points: Float64) -> int:
    return int(np.count_nonzero(np.isfinite(points[..., 0])))


def _board(grey: Float32, level: int) -> Float64:
    """Corners (rows, columns, 2) of the board as it shows in the image, halved so many times; to about a pixel."""
    small = shrunk(grey, 2**level)
    places, turning = _saddles(small)
    pieces = charts(places, _FEWEST, turning)
    if not pieces:
        return np.empty((0, 0, 2))
    # Pixel (0, 0) of a halved image is the middle of four.
    scale = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    places = (places + 0.5) * scale - 0.5
    index = as_grid(joined(pieces, places)[0], places)
    corners = np.where(index[..., None] < 0, np.nan, places[index])
    corners[~_chequered(grey, corners)] = np.nan
    parts, _ = label(np.isfinite(corners[..., 0]))
    corners[np.isin(parts, np.flatnonzero(np.bincount(parts.ravel()) < _FEWEST))] = np.nan
    return trimmed(corners)


def _chequered(grey: Float32, corners: Float64) -> npt.NDArray[np.bool_]:
    """Where two opposite squares about a corner are darker than the two others, by about as much as elsewhere."""
    steps = lattice_steps(corners)
    u, v = _SQUARES * steps[:, :, 0], _SQUARES * steps[:, :, 1]
    smooth = boxed(grey, 3)
    a, b, c, d = (sampled(smooth, corners + each) for each in (u + v, u - v, -u - v, v - u))
    parity = np.where(np.indices(corners.shape[:2]).sum(axis=0) % 2, 1.0, -1.0)
    low, high = np.minimum(a, c) - np.maximum(b, d), np.minimum(b, d) - np.maximum(a, c)
    contrast = np.where(np.fmax(low, high) > 0.0, np.where(low > high, low, -high), np.nan) * parity
    if not np.isfinite(contrast).any():
        return np.zeros(corners.shape[:2], dtype=np.bool_)
    contrast *= np.sign(np.nanmedian(contrast))
    return np.asarray(contrast > _LEAST_CONTRAST * np.nanmedian(contrast))


def _measured(grey: Float32, corners: Float64) -> Float64:
    """Move corners to where the gradients around them lead past."""
    known = np.isfinite(corners[..., 0])
    # Rows that nothing joins have no steps from one to the other.
    if min(known.shape) < 2 or not np.isfinite(steps := lattice_steps(corners)[known]).all():
        return np.full_like(corners, np.nan)
    # (x, y) to steps, from the left
    to_steps = np.asarray(np.linalg.inv(steps).transpose(0, 2, 1), dtype=np.float64)
    step = float(np.median(np.linalg.norm(steps, axis=-1)))
    smooth = cv2.GaussianBlur(grey, (0, 0), max(_LEAST_BLUR, _MEASURED_BLUR * step)) / _white(grey, step)
    slope = [
        np.asarray(cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32), dtype=np.float32) for order in ((1, 0), (0, 1))
    ]
    at, rest = corners[known], np.empty(len(steps))
    reach = math.ceil(_WINDOW * float(np.abs(steps).sum(axis=1).max())) + 1
    chunk = max(1, _CHUNK_PIXELS // (2 * reach + 1) ** 2)
    for start in range(0, len(at), chunk):
        part = slice(start, start + chunk)
        at[part], rest[part] = _settled(slope, at[part], to_steps[part], reach)
    away = np.abs(np.einsum("nij,nj->ni", to_steps, at - corners[known])).max(axis=1) > _AWAY
    at[away | (rest > _OTHER_EDGES * np.median(rest))] = np.nan
    moved = np.full_like(corners, np.nan)
    moved[known] = at
    return moved


def _white(grey: Float32, step: float) -> Float32:
    """Grey level of light squares, everywhere: a slope of the illumination would turn the gradients."""
    factor = max(1, int(step / _WHITE_CELLS))
    side = 2 * math.ceil(step / factor) + 1
    high = boxed(np.asarray(cv2.dilate(shrunk(grey, factor), np.ones((side, side), np.uint8)), dtype=np.float32), side)
    white = cv2.resize(high, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.maximum(white, 1e-3 * white.max()), dtype=np.float32)


def _settled(slope: list[Float32], start: Float64, to_steps: Float64, reach: int) -> tuple[Float64, Float64]:
    """Iterate Foerstner's point in windows about it; and the mean square distance of edges from it, in pixels."""
    rows, columns = slope[0].shape
    offsets = np.arange(-reach, reach + 1)
    nearest = np.rint(start).astype(np.int64)
    x, y = (nearest[:, each, None] + offsets for each in (0, 1))
    inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
    where = np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]
    gx, gy = (np.where(inside, each[where], 0.0).astype(np.float64) for each in slope)
    # Weighed with its square once more, a gradient counts for an edge, and noise for little.
    square = gx * gx + gy * gy
    xx, xy, yy = square * gx * gx, square * gx * gy, square * gy * gy
    at = start.copy()
    for _ in range(_ITERATIONS):
        dx, dy = (x - at[:, :1])[:, None, :], (y - at[:, 1:])[:, :, None]
        s, t = (to_steps[:, k, 0, None, None] * dx + to_steps[:, k, 1, None, None] * dy for k in (0, 1))
        window = np.maximum(1.0 - (s / _WINDOW) ** 2, 0.0) * np.maximum(1.0 - (t / _WINDOW) ** 2, 0.0)
        normal = _sums(window * xx, window * xy, window * xy, window * yy).reshape(-1, 2, 2)
        # Where all edges run one way, or there are none, the point stays.
        normal += (_SINGULAR * np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny)[:, None, None] * np.eye(2)
        right = _sums(window * (xx * dx + xy * dy), window * (xy * dx + yy * dy))
        move = np.linalg.solve(normal, right[..., None])[..., 0]
        at += move
        if np.abs(move).max() < _SETTLED:
            break
    apart = _sums(window * (xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy))[:, 0]
    return at, apart / np.trace(normal, axis1=1, axis2=2)


def _sums(*parts: Float64) -> Float64:
    """Sum every part over its windows, (n, parts)."""
    return np.stack([each.sum(axis=(1, 2)) for each in parts], axis=1)


def _saddles(grey: Float32) -> tuple[Float64, Float64]:
    """Places (n, 2) where the blurred image is a saddle, to the pixel, and unit vectors (n, 2) at twice its angle."""
    smooth = cv2.GaussianBlur(grey, (0, 0), _BLUR)
    # Sobel's smoothing weighs the pure derivatives four times, the mixed one twice each way and over two steps.
    xx, xy, yy = (cv2.Sobel(smooth, cv2.CV_32F, *orders, ksize=3, scale=0.25) for orders in ((2, 0), (1, 1), (0, 2)))
    strength = xy * xy - xx * yy
    reach = 2 * math.ceil(_BLUR) + 1
    peak = cv2.dilate(strength, np.ones((2 * reach + 1,) * 2, np.uint8))
    # A corner is about as dark one way as it is light the other way.
    even = (xx + yy) ** 2 < _UNEVEN**2 * ((xx - yy) ** 2 + 4.0 * xy * xy)
    y, x = np.nonzero((strength == peak) & (strength > 0.0) & even)
    inside = (np.minimum(x, y) >= reach) & (x < grey.shape[1] - reach) & (y < grey.shape[0] - reach)
    x, y = x[inside], y[inside]
    value = strength[y, x]
    order = np.argsort(-value)[:_MOST_CANDIDATES]
    if order.size:
        order = order[value[order] > _LEAST_SADDLE * value[order[min(_STRONGEST, order.size) - 1]]]
    x, y = x[order], y[order]
    double = np.stack([xx[y, x] - yy[y, x], 2.0 * xy[y, x]], axis=1).astype(np.float64)
    return np.stack([x, y], axis=1).astype(np.float64), double / np.linalg.norm(double, axis=1, keepdims=True)
