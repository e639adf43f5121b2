"""Sub-pixel centres of a lattice's dots: grey-weighted centres of gravity over a sloping ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates, uniform_filter

from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, cross
from gpuvision.camera.patterns.pattern import Float32, Float64, boxed, nan_mean

# Pixels with less of a dot than this count as ground: noise on the ground stays out, and the weight is 0 where the
# window ends.
_GROUND = 0.2
# Pixels around the bounding box at half height that may still hold some of the dot.
_MARGIN = (1.0, 4.0)
# Boxes that ground and dot are averaged over: a part of the pitch about the corners of a cell, which no dot reaches,
# and of the dot.
_GROUND_BOX = 0.25
_DOT_BOX = 0.5
_CHUNK_PIXELS = 1 << 17


class Centroids(NamedTuple):
    """What was measured at every node of a lattice, (rows, columns); NaN where there is nothing."""

    points: Float64
    mass: Float64
    """Covered pixels."""
    spread: Float64
    """(rows, columns, 2) variance of the covered pixels' column and row."""
    contrast: Float64
    """Dot less ground, in grey levels."""
    unevenness: Float64
    """How far the ground's four corners are from a plane, as a part of the contrast."""


def lattice_steps(values: Float64) -> Float64:
    """Return the steps (rows, columns, 2, n) of n values from a node to the next column and to the next row.

    They are means of what is known, first on both sides, else around.
    """
    steps = []
    for axis in (1, 0):
        forward = np.diff(values, axis=axis)
        none = np.full_like(np.take(values, [0], axis), np.nan)
        pair = np.stack([np.concatenate([forward, none], axis), np.concatenate([none, forward], axis)])
        steps.append(_filled(nan_mean(pair)))
    return np.stack(steps, axis=2)


def _filled(values: Float64) -> Float64:
    """Fill what is NaN with the mean of what is known nearby; (rows, columns, channels), NaN if nothing is known."""
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
    """Measure the centres of gravity of dots.

    The ground is a plane through the corners of the dot's cell, the contrast grows as it does from dot to dot. A
    pixel's weight is the part of it that the dot covers, less a fifth.

    Parameters
    ----------
    grey
        The image.
    points
        (rows, columns, 2) about right; NaN where there is none.
    size
        (rows, columns, 2) width and height of the dots.
    """
    nodes = np.isfinite(points[..., 0])
    steps = lattice_steps(points)[nodes]
    at, box = points[nodes], size[nodes]
    pitch = np.linalg.norm(steps, axis=-1).min(axis=-1)
    ground, slope, unevenness = _ground(_smoothed(grey, _GROUND_BOX * pitch), at, steps)
    contrast = sampled(_smoothed(grey, _DOT_BOX * box.min(axis=-1)), at) - ground
    whole_contrast = _laid_out(contrast, nodes)
    growth = np.linalg.solve(steps, lattice_steps(whole_contrast[..., None])[nodes])[..., 0]
    margin = np.clip(0.5 * (pitch - box.max(axis=-1)), *_MARGIN)
    half = 0.5 * box + margin[:, None]
    reach = math.ceil(float(half.max())) + 1
    chunk = max(1, _CHUNK_PIXELS // (2 * reach + 1) ** 2)
    moments = np.empty((len(at), 5))
    for start in range(0, len(at), chunk):
        part = slice(start, start + chunk)
        planes = [np.column_stack([each[part], by[part]]) for each, by in ((ground, slope), (contrast, growth))]
        moments[part] = _moments(grey, at[part], half[part], planes, reach)
    mass = moments[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, square = moments[:, 1:3] / mass[:, None], moments[:, 3:] / mass[:, None]
    values = (np.rint(at) + mean, mass, square - mean**2, contrast, np.abs(unevenness / contrast))
    return Centroids(*(_laid_out(each, nodes) for each in values))


def _laid_out(values: Float64, nodes: npt.NDArray[np.bool_]) -> Float64:
    """Lay values of the known nodes out on the lattice; NaN elsewhere."""
    whole = np.full((*nodes.shape, *values.shape[1:]), np.nan)
    whole[nodes] = values
    return whole


def _smoothed(grey: Float32, sides: Float64) -> Float32:
    """Smooth with a box of one of the smaller ones of these sides."""
    return boxed(grey, 2 * int(0.5 * np.percentile(sides, 10)) + 1)


def sampled(image: Float32, at: Float64) -> Float64:
    """Bilinear samples at (..., 2); NaN outside of the image."""
    where = at[..., ::-1].transpose(at.ndim - 1, *range(at.ndim - 1))
    return np.asarray(map_coordinates(image, where, np.float64, order=1, mode="constant", cval=np.nan))


def _ground(smooth: Float32, at: Float64, steps: Float64) -> tuple[Float64, Float64, Float64]:
    """Plane through the corners of the cells: level at the dot, slope per pixel, and what is left of four corners."""
    u, v = 0.5 * steps[:, 0], 0.5 * steps[:, 1]
    low, right, left, high = (sampled(smooth, at + each) for each in (-u - v, u - v, v - u, u + v))
    pairs = np.stack([0.5 * (low + high), 0.5 * (left + right)])
    level = nan_mean(pairs)
    level = np.where(np.isfinite(level), level, nan_mean(np.stack([low, right, left, high])))
    along = [nan_mean(np.stack(each)) for each in ((right - low, high - left), (left - low, high - right))]
    # along = steps @ slope
    slope = np.linalg.solve(steps, np.nan_to_num(np.stack(along, axis=1))[..., None])[..., 0]
    return level, np.asarray(slope, dtype=np.float64), np.nan_to_num(pairs[0] - pairs[1])


def _moments(grey: Float32, at: Float64, half: Float64, planes: list[Float64], reach: int) -> Float64:
    """Sum of the weights, and of the weights times x, y, x^2, y^2 from the nearest pixel, (n, 5).

    ``planes`` are ground and contrast: level at the dot and slopes along x and y, (n, 3).
    """
    rows, columns = grey.shape
    nearest = np.rint(at)
    offsets = np.arange(-reach, reach + 1)
    x, y = (nearest[:, each, None].astype(np.int64) + offsets for each in (0, 1))
    patch = grey[np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]]
    from_dot = [(nearest - at)[:, each, None] + offsets for each in (0, 1)]
    ground, contrast = (
        (plane[:, :1] + plane[:, 1:2] * from_dot[0]).astype(np.float32)[:, None, :]
        + (plane[:, 2:] * from_dot[1]).astype(np.float32)[:, :, None]
        for plane in planes
    )
    weight = (patch - ground) / contrast
    weight -= _GROUND
    np.maximum(weight, 0.0, out=weight)
    within = [
        ((np.abs(d) <= half[:, each, None]) & (p >= 0) & (p < limit)).astype(np.float32)
        for each, (d, p, limit) in enumerate(zip(from_dot, (x, y), (columns, rows), strict=True))
    ]
    by_x = np.matmul(within[1][:, None, :], weight)[:, 0] * within[0]
    by_y = np.matmul(weight, within[0][..., None])[..., 0] * within[1]
    powers = np.stack([offsets, offsets**2], axis=1)
    (x1, x2), (y1, y2) = (by_x @ powers).T, (by_y @ powers).T
    return np.stack([by_x.sum(axis=1), x1, y1, x2, y2], axis=1) / (1.0 - _GROUND)


def disc_shift(bent: GridPolynomial, mass: Float64) -> Float64:
    """Centre of gravity of a disc's image less the image of its centre, from the curvature of the grid.

    With steps M = (m_u, m_v) of the grid, J = det M, and a disc of radius r pitches: r^2/4 ((m_uu + m_vv)/2 + M grad
    log J) to second order, as the disc's second moments are r^2/4 and its parts count by their area in the image.

    Parameters
    ----------
    bent
        Polynomial through the grid.
    mass
        (rows, columns), the discs' areas in pixels; NaN where there is none.

    Returns
    -------
    numpy.ndarray
        (rows, columns, 2) in pixels.
    """
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    u, v, uu, uv, vv = (bent.derivative(*order) for order in orders)
    area = cross(u, v)
    growth = (cross(uu, v) + cross(u, uv)) / area, (cross(uv, v) + cross(u, vv)) / area
    shift = 0.5 * (uu + vv) + growth[0][..., None] * u + growth[1][..., None] * v
    return np.asarray(shift * (mass / (4.0 * math.pi * np.abs(area)))[..., None])
