"""Chessboards: sub-pixel detection of the inner corners as saddle points, and their grid index."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import label

from gpuvision.camera.patterns.centroids import estimate_steps, sample_bilinear
from gpuvision.camera.patterns.grid_polynomial import agrees_with_grid
from gpuvision.camera.patterns.lattice import index_patches, join_patches, patch_grid
from gpuvision.camera.patterns.pattern import (
    Float32,
    Float64,
    PatternGrid,
    box_mean,
    downsample,
    estimate_localisation_noise,
    finder_image,
    trim_empty_border,
)

# Standard deviation of the blur before the search for saddle points [px], in each level of the image pyramid.
_BLUR = 1.5
_LEVELS = 3
# Distance from a corner, in grid steps, at which the grey levels of the four squares about it are sample_bilinear.
_SQUARES = 0.3
# Half the side of the window of the sub-pixel refinement, in grid steps; squares at the board's rim may be halves.
_WINDOW = 0.4
# Cells per grid step of the map of the white level (speed only).
_WHITE_CELLS = 8
# Standard deviation of the blur before the refinement, in grid steps, and its lower bound [px].
_MEASURED_BLUR = 0.03
_LEAST_BLUR = 0.5
# Refinement: largest number of iterations; step [px] that ends them; regularisation relative to the trace.
_ITERATIONS = 20
_SETTLED = 1e-4
_SINGULAR = 1e-9
# Pixels processed in one pass; limits the memory only.
_CHUNK_PIXELS = 1 << 17


@dataclass(frozen=True, kw_only=True)
class ChessboardLimits:
    """Thresholds of `find_chessboard`.

    Attributes
    ----------
    min_corners : int
        Least number of inner corners. Default 6.
    max_candidates : int
        Largest number of saddle points in a level of the image pyramid; the strongest are used. Default 40000.
    min_saddle : float
        Least curvature of a saddle point, relative to the curvature of the ``strongest``-th saddle point. Default 0.03.
    strongest : int
        Rank of the saddle point that ``min_saddle`` refers to. Default 20.
    max_asymmetry : float
        Largest difference of the two principal curvatures' magnitudes relative to their sum; 0 at an ideal corner.
        Default 0.75.
    min_contrast : float
        Least contrast of the squares about a corner relative to the median contrast of the board. Default 0.5.
    max_deviation_medians : float
        Largest deviation of a corner from its neighbours as a multiple of the median deviation. Default 7.0.
    min_position_tolerance : float
        Deviation in position that is always accepted [grid steps]. Default 0.005.
    max_shift : float
        Largest shift of a corner by the refinement [grid steps]. Default 0.3.
    max_edge_distance : float
        Largest mean square distance of the edges in a corner's window from the corner, as a multiple of the median over
        all corners: rejects windows with edges that miss the corner. Default 4.0.
    """

    min_corners: int = 6
    max_candidates: int = 40_000
    min_saddle: float = 0.03
    strongest: int = 20
    max_asymmetry: float = 0.75
    min_contrast: float = 0.5
    max_deviation_medians: float = 7.0
    min_position_tolerance: float = 0.005
    max_shift: float = 0.3
    max_edge_distance: float = 4.0


def find_chessboard(
    image: npt.NDArray[Any],
    inner_corners: tuple[int, int] | None = None,
    *,
    limits: ChessboardLimits = ChessboardLimits(),
) -> PatternGrid:
    """Find the inner corners of a chessboard.

    Candidates are saddle points of the grey levels. Their grid index grows from neighbour to neighbour; corners remain
    if the four squares about them are alternately dark and light. The sub-pixel position is Foerstner's point: the
    point nearest to all edge lines in a window, whose size follows the size of the squares.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, with squares of at least
        8 px, the board rotated by at most 45 degrees.
    inner_corners : pair of ints, optional
        Number of inner corners along both sides of the board, in any order; every row and column of them must be
        visible in part. Default: accept the board that is found.
    limits : ChessboardLimits
        Numerical limits of the detection.

    Returns
    -------
    PatternGrid
        Hidden corners are NaN. Pixel (0, 0) is the centre of the first pixel, as in OpenCV.

    Raises
    ------
    ValueError
        No chessboard was found, or it has another number of corners; the message gives the number found.
    TypeError
        The image has another type.

    References
    ----------
    W. Foerstner and E. Guelch, A fast operator for detection and precise location of distinct points, corners and
    centres of circular features, ISPRS Intercommission Conference, Interlaken 1987, 281.
    """
    grey = finder_image(image)
    rough = max((_detect_corners(grey, level, limits) for level in range(_LEVELS)), key=_count_known)
    points = _refine_corners(grey, rough, limits)
    points[~agrees_with_grid(points, limits.max_deviation_medians, limits.min_position_tolerance)] = np.nan
    points = trim_empty_border(points)
    if _count_known(points) < limits.min_corners:
        raise ValueError(
            f"{_count_known(points) or 'no'} corners of a chessboard found, expected at least {limits.min_corners}; "
            f"{_ADVICE}"
        )
    if inner_corners is not None and sorted(points.shape[:2]) != sorted(inner_corners):
        found, expected = (" x ".join(map(str, each)) for each in (points.shape[1::-1], inner_corners))
        raise ValueError(f"a chessboard of {found} inner corners found, expected {expected}; {_ADVICE}")
    return PatternGrid(points, estimate_localisation_noise(points))


_ADVICE = "check that the image shows the whole board with its light margin, and check focus and exposure"


def _count_known(points: Float64) -> int:
    """Return the number of points that are not NaN."""
    return int(np.count_nonzero(np.isfinite(points[..., 0])))


def _detect_corners(grey: Float32, level: int, limits: ChessboardLimits) -> Float64:
    """Return corners (rows, columns, 2) found in one level of the image pyramid, accurate to about a pixel."""
    small = downsample(grey, 2**level)
    places, orientation = _find_saddles(small, limits)
    patches = index_patches(places, limits.min_corners, orientation)
    if not patches:
        return np.empty((0, 0, 2))
    # The centre of pixel (0, 0) of a halved image is the common corner of four pixels.
    scale = np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
    places = (places + 0.5) * scale - 0.5
    index = patch_grid(join_patches(patches, places)[0], places)
    corners = np.where(index[..., None] < 0, np.nan, places[index])
    corners[~_has_chequered_squares(grey, corners, limits)] = np.nan
    parts, _ = label(np.isfinite(corners[..., 0]))
    corners[np.isin(parts, np.flatnonzero(np.bincount(parts.ravel()) < limits.min_corners))] = np.nan
    return trim_empty_border(corners)


def _has_chequered_squares(grey: Float32, corners: Float64, limits: ChessboardLimits) -> npt.NDArray[np.bool_]:
    """Return whether two opposite squares about each corner are darker than the other two, with sufficient contrast."""
    steps = estimate_steps(corners)
    u, v = _SQUARES * steps[:, :, 0], _SQUARES * steps[:, :, 1]
    smooth = box_mean(grey, 3)
    a, b, c, d = (sample_bilinear(smooth, corners + each) for each in (u + v, u - v, -u - v, v - u))
    parity = np.where(np.indices(corners.shape[:2]).sum(axis=0) % 2, 1.0, -1.0)
    low, high = np.minimum(a, c) - np.maximum(b, d), np.minimum(b, d) - np.maximum(a, c)
    contrast = np.where(np.fmax(low, high) > 0.0, np.where(low > high, low, -high), np.nan) * parity
    if not np.isfinite(contrast).any():
        return np.zeros(corners.shape[:2], dtype=np.bool_)
    contrast *= np.sign(np.nanmedian(contrast))
    return np.asarray(contrast > limits.min_contrast * np.nanmedian(contrast))


def _refine_corners(grey: Float32, corners: Float64, limits: ChessboardLimits) -> Float64:
    """Refine corners to Foerstner's points; NaN where the refinement is not plausible."""
    known = np.isfinite(corners[..., 0])
    # Rows that share no column with a neighbouring row have no steps.
    if min(known.shape) < 2 or not np.isfinite(steps := estimate_steps(corners)[known]).all():
        return np.full_like(corners, np.nan)
    # Matrices that convert (x, y) to grid steps, applied from the left.
    to_steps = np.asarray(np.linalg.inv(steps).transpose(0, 2, 1), dtype=np.float64)
    step = float(np.median(np.linalg.norm(steps, axis=-1)))
    smooth = cv2.GaussianBlur(grey, (0, 0), max(_LEAST_BLUR, _MEASURED_BLUR * step)) / _white_level(grey, step)
    slope = [
        np.asarray(cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32), dtype=np.float32) for order in ((1, 0), (0, 1))
    ]
    at, rest = corners[known], np.empty(len(steps))
    reach = math.ceil(_WINDOW * float(np.abs(steps).sum(axis=1).max())) + 1
    chunk = max(1, _CHUNK_PIXELS // (2 * reach + 1) ** 2)
    for start in range(0, len(at), chunk):
        part = slice(start, start + chunk)
        at[part], rest[part] = _foerstner_points(slope, at[part], to_steps[part], reach)
    away = np.abs(np.einsum("nij,nj->ni", to_steps, at - corners[known])).max(axis=1) > limits.max_shift
    at[away | (rest > limits.max_edge_distance * np.median(rest))] = np.nan
    moved = np.full_like(corners, np.nan)
    moved[known] = at
    return moved


def _white_level(grey: Float32, step: float) -> Float32:
    """Return the local grey level of light squares; dividing by it removes gradients of the illumination."""
    factor = max(1, int(step / _WHITE_CELLS))
    side = 2 * math.ceil(step / factor) + 1
    high = cv2.dilate(downsample(grey, factor), np.ones((side, side), np.uint8))
    smooth = box_mean(np.asarray(high, dtype=np.float32), side)
    white = cv2.resize(smooth, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.maximum(white, 1e-3 * white.max()), dtype=np.float32)


def _foerstner_points(slope: list[Float32], start: Float64, to_steps: Float64, reach: int) -> tuple[Float64, Float64]:
    """Return Foerstner's points, iterated in windows about them, and the edges' mean square distances [px^2]."""
    rows, columns = slope[0].shape
    offsets = np.arange(-reach, reach + 1)
    nearest = np.rint(start).astype(np.int64)
    x, y = (nearest[:, each, None] + offsets for each in (0, 1))
    inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
    where = np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]
    gx, gy = (np.where(inside, each[where], 0.0).astype(np.float64) for each in slope)
    # Weighting by the squared gradient emphasises edges and suppresses noise.
    square = gx * gx + gy * gy
    xx, xy, yy = square * gx * gx, square * gx * gy, square * gy * gy
    at = start.copy()
    for _ in range(_ITERATIONS):
        dx, dy = (x - at[:, :1])[:, None, :], (y - at[:, 1:])[:, :, None]
        s, t = (to_steps[:, k, 0, None, None] * dx + to_steps[:, k, 1, None, None] * dy for k in (0, 1))
        window = np.maximum(1.0 - (s / _WINDOW) ** 2, 0.0) * np.maximum(1.0 - (t / _WINDOW) ** 2, 0.0)
        normal = _window_sums(window * xx, window * xy, window * xy, window * yy).reshape(-1, 2, 2)
        # The regularisation keeps the point fixed if all edges are parallel, or if the window has no edge.
        normal += (_SINGULAR * np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny)[:, None, None] * np.eye(2)
        right = _window_sums(window * (xx * dx + xy * dy), window * (xy * dx + yy * dy))
        move = np.linalg.solve(normal, right[..., None])[..., 0]
        at += move
        if np.abs(move).max() < _SETTLED:
            break
    residual = _window_sums(window * (xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy))[:, 0]
    return at, residual / np.trace(normal, axis1=1, axis2=2)


def _window_sums(*parts: Float64) -> Float64:
    """Sum every array (n, height, width) over its windows; return (n, arrays)."""
    return np.stack([each.sum(axis=(1, 2)) for each in parts], axis=1)


def _find_saddles(grey: Float32, limits: ChessboardLimits) -> tuple[Float64, Float64]:
    """Return saddle points (n, 2) of the blurred image [whole px], and unit vectors (n, 2) at twice their angle."""
    smooth = cv2.GaussianBlur(grey, (0, 0), _BLUR)
    # The Sobel kernels scale all second derivatives, pure and mixed, by 4: a scale of 0.25 corrects all.
    xx, xy, yy = (cv2.Sobel(smooth, cv2.CV_32F, *orders, ksize=3, scale=0.25) for orders in ((2, 0), (1, 1), (0, 2)))
    strength = xy * xy - xx * yy
    reach = 2 * math.ceil(_BLUR) + 1
    peak = cv2.dilate(strength, np.ones((2 * reach + 1,) * 2, np.uint8))
    # The principal curvatures of a corner have opposite signs and similar magnitudes.
    even = (xx + yy) ** 2 < limits.max_asymmetry**2 * ((xx - yy) ** 2 + 4.0 * xy * xy)
    y, x = np.nonzero((strength == peak) & (strength > 0.0) & even)
    inside = (np.minimum(x, y) >= reach) & (x < grey.shape[1] - reach) & (y < grey.shape[0] - reach)
    x, y = x[inside], y[inside]
    value = strength[y, x]
    order = np.argsort(-value)[: limits.max_candidates]
    if order.size:
        order = order[value[order] > limits.min_saddle * value[order[min(limits.strongest, order.size) - 1]]]
    x, y = x[order], y[order]
    double = np.stack([xx[y, x] - yy[y, x], 2.0 * xy[y, x]], axis=1).astype(np.float64)
    return np.stack([x, y], axis=1).astype(np.float64), double / np.linalg.norm(double, axis=1, keepdims=True)
