"""Sub-pixel centres of dots: grey-level centres of gravity over a planar background."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates, uniform_filter

from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, cross
from gpuvision.camera.patterns.pattern import Float32, Float64, box_mean, nan_mean

# Coverage of a pixel by the dot below which the pixel counts as background: noise of the background gets no weight, and
# the weight is 0 at the window's border.
_BACKGROUND_COVER = 0.2
# Least and largest margin [px] about the bounding box at half height; the blurred edge of the dot lies within it.
_MARGIN = (1.0, 4.0)
# Sides of the averaging boxes: of the background at the corners of a cell [pitches], and of the dot's centre [dot
# sizes].
_BACKGROUND_BOX = 0.25
_DOT_BOX = 0.5
# Pixels processed in one pass; limits the memory only.
_CHUNK_PIXELS = 1 << 17


class Centroids(NamedTuple):
    """Measurements at the nodes of a lattice, (rows, columns); NaN at nodes without a dot."""

    points: Float64
    """(rows, columns, 2) centres of gravity, column and row [px]."""
    dot_area: Float64
    """Area of the dot [px]."""
    variance: Float64
    """(rows, columns, 2) variance of the covered pixels' column and row [px^2]."""
    contrast: Float64
    """Grey level of the dot minus grey level of the background."""
    background_residual: Float64
    """Deviation of the background's four corners from a plane [contrasts]."""


def estimate_steps(values: Float64) -> Float64:
    """Return the steps of n values from a node to the next column and to the next row, (rows, columns, 2, n).

    A step is the mean of the known differences on both sides; without any, the mean of the nearest known steps.
    """
    steps = []
    for axis in (1, 0):
        forward = np.diff(values, axis=axis)
        missing = np.full_like(np.take(values, [0], axis), np.nan)
        pair = np.stack([np.concatenate([forward, missing], axis), np.concatenate([missing, forward], axis)])
        steps.append(_fill_missing(nan_mean(pair)))
    return np.stack(steps, axis=2)


def _fill_missing(values: Float64) -> Float64:
    """Replace NaN by the mean of the nearest known values; (rows, columns, channels), NaN if none is known."""
    values = values.copy()
    known = np.asarray(np.isfinite(values).all(axis=-1))
    reach = 1
    while known.any() and not known.all():
        reach = 2 * reach + 1
        box = (reach, reach, 1)
        weight = uniform_filter(known[..., None].astype(np.float64), box, mode="constant")
        total = uniform_filter(np.where(known[..., None], values, 0.0), box, mode="constant")
        reached = np.asarray(~known & (weight[..., 0] > 0.5 / reach**2))
        values[reached] = total[reached] / weight[reached]
        known |= reached
    return values


def measure_dots(grey: Float32, points: Float64, size: Float64) -> Centroids:
    """Measure the grey-level centres of gravity of dots.

    The background is a plane through the corners of the dot's cell. The contrast varies linearly as it does from dot to
    dot. The weight of a pixel is the fraction that the dot covers, minus 0.2.

    Parameters
    ----------
    grey : numpy.ndarray
        (height, width) float32 grey levels.
    points : numpy.ndarray
        (rows, columns, 2): approximate positions [px]; NaN at nodes without a dot.
    size : numpy.ndarray
        (rows, columns, 2): width and height of the dots [px].

    Returns
    -------
    Centroids
    """
    nodes = np.isfinite(points[..., 0])
    steps = estimate_steps(points)[nodes]
    at, box = points[nodes], size[nodes]
    pitch = np.linalg.norm(steps, axis=-1).min(axis=-1)
    background, slope, background_residual = _fit_background(_smooth(grey, _BACKGROUND_BOX * pitch), at, steps)
    contrast = sample_bilinear(_smooth(grey, _DOT_BOX * box.min(axis=-1)), at) - background
    lattice_contrast = _to_lattice(contrast, nodes)
    contrast_slope = np.linalg.solve(steps, estimate_steps(lattice_contrast[..., None])[nodes])[..., 0]
    margin = np.clip(0.5 * (pitch - box.max(axis=-1)), *_MARGIN)
    half = 0.5 * box + margin[:, None]
    reach = math.ceil(float(half.max())) + 1
    chunk = max(1, _CHUNK_PIXELS // (2 * reach + 1) ** 2)
    moments = np.empty((len(at), 5))
    for start in range(0, len(at), chunk):
        part = slice(start, start + chunk)
        planes = [
            np.column_stack([each[part], by[part]]) for each, by in ((background, slope), (contrast, contrast_slope))
        ]
        moments[part] = _moments(grey, at[part], half[part], planes, reach)
    dot_area = moments[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, square = moments[:, 1:3] / dot_area[:, None], moments[:, 3:] / dot_area[:, None]
    values = (np.rint(at) + mean, dot_area, square - mean**2, contrast, np.abs(background_residual / contrast))
    return Centroids(*(_to_lattice(each, nodes) for each in values))


def _to_lattice(values: Float64, nodes: npt.NDArray[np.bool_]) -> Float64:
    """Write values of the known nodes into an array over the lattice; NaN elsewhere."""
    lattice = np.full((*nodes.shape, *values.shape[1:]), np.nan)
    lattice[nodes] = values
    return lattice


def _smooth(grey: Float32, sides: Float64) -> Float32:
    """Smooth with a box whose side is the 10th percentile of the given sides."""
    return box_mean(grey, 2 * int(0.5 * np.percentile(sides, 10)) + 1)


def sample_bilinear(image: Float32, at: Float64) -> Float64:
    """Sample an image bilinearly at points (..., 2) [px]; NaN outside the image."""
    where = at[..., ::-1].transpose(at.ndim - 1, *range(at.ndim - 1))
    return np.asarray(map_coordinates(image, where, np.float64, order=1, mode="constant", cval=np.nan))


def _fit_background(smooth: Float32, at: Float64, steps: Float64) -> tuple[Float64, Float64, Float64]:
    """Fit a plane to the corners of the cells; return the level at the dot, the slope per pixel, and the residual."""
    u, v = 0.5 * steps[:, 0], 0.5 * steps[:, 1]
    low, right, left, high = (sample_bilinear(smooth, at + each) for each in (-u - v, u - v, v - u, u + v))
    pairs = np.stack([0.5 * (low + high), 0.5 * (left + right)])
    level = nan_mean(pairs)
    level = np.where(np.isfinite(level), level, nan_mean(np.stack([low, right, left, high])))
    along = [nan_mean(np.stack(each)) for each in ((right - low, high - left), (left - low, high - right))]
    # along = steps @ slope
    slope = np.linalg.solve(steps, np.nan_to_num(np.stack(along, axis=1))[..., None])[..., 0]
    return level, np.asarray(slope, dtype=np.float64), np.nan_to_num(pairs[0] - pairs[1])


def _moments(grey: Float32, at: Float64, half: Float64, planes: list[Float64], reach: int) -> Float64:
    """Return the sums of the weights and of the weights times x, y, x^2, y^2 from the nearest pixel, (n, 5).

    ``planes`` are background and contrast: level at the dot and slopes along x and y, (n, 3).
    """
    rows, columns = grey.shape
    nearest = np.rint(at)
    offsets = np.arange(-reach, reach + 1)
    x, y = (nearest[:, each, None].astype(np.int64) + offsets for each in (0, 1))
    patch = grey[np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]]
    from_dot = [(nearest - at)[:, each, None] + offsets for each in (0, 1)]
    background, contrast = (
        (plane[:, :1] + plane[:, 1:2] * from_dot[0]).astype(np.float32)[:, None, :]
        + (plane[:, 2:] * from_dot[1]).astype(np.float32)[:, :, None]
        for plane in planes
    )
    weight = (patch - background) / contrast
    weight -= _BACKGROUND_COVER
    np.maximum(weight, 0.0, out=weight)
    in_window = [
        ((np.abs(d) <= half[:, each, None]) & (p >= 0) & (p < limit)).astype(np.float32)
        for each, (d, p, limit) in enumerate(zip(from_dot, (x, y), (columns, rows), strict=True))
    ]
    by_x = np.matmul(in_window[1][:, None, :], weight)[:, 0] * in_window[0]
    by_y = np.matmul(weight, in_window[0][..., None])[..., 0] * in_window[1]
    powers = np.stack([offsets, offsets**2], axis=1)
    (x1, x2), (y1, y2) = (by_x @ powers).T, (by_y @ powers).T
    return np.stack([by_x.sum(axis=1), x1, y1, x2, y2], axis=1) / (1.0 - _BACKGROUND_COVER)


def disc_centre_offset(model: GridPolynomial, dot_area: Float64) -> Float64:
    """Return the centre of gravity of each disc's image minus the image of its centre.

    With steps M = (m_u, m_v) of the grid, J = det M, and a disc of radius r pitches, the difference is
    r^2/4 ((m_uu + m_vv)/2 + M grad log J) to second order: the disc's second moments are r^2/4, and its area elements
    are weighted by their area in the image.

    Parameters
    ----------
    model : GridPolynomial
        Polynomial through the grid.
    dot_area : numpy.ndarray
        (rows, columns): areas of the discs [px]; NaN where missing.

    Returns
    -------
    numpy.ndarray
        (rows, columns, 2) [px].
    """
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    u, v, uu, uv, vv = (model.derivative(*order) for order in orders)
    area = cross(u, v)
    log_gradient = (cross(uu, v) + cross(u, uv)) / area, (cross(uv, v) + cross(u, vv)) / area
    shift = 0.5 * (uu + vv) + log_gradient[0][..., None] * u + log_gradient[1][..., None] * v
    return np.asarray(shift * (dot_area / (4.0 * math.pi * np.abs(area)))[..., None])
