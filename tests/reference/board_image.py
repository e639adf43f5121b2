"""Reference of `gpuvision.RenderBoard`: reflectance of a pixel, its noise and its grey level, in double precision."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

Float64 = npt.NDArray[np.float64]


def centred_pixels(shape: tuple[int, int]) -> Float64:
    """Return column and row (rows, columns, 2) of each pixel from the image's centre [px]."""
    rows, columns = shape
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.stack([x, y], axis=-1)


def reflectance(
    values: npt.NDArray[Any],
    origin: npt.ArrayLike,
    cell: float,
    pixel: float,
    pixels: Float64,
    poses: Float64,
    *,
    mirrored: bool = False,
) -> Float64:
    """Return the mean reflectance (rows, columns) of pixels over the sub-poses of one exposure.

    Parameters
    ----------
    values : numpy.ndarray
        Map (rows, columns), 65535 for a reflectance of 1.
    origin, cell
        x, y of its first node, and the distance between nodes [m].
    pixel : float
        Size of a pixel on the board [m].
    pixels : numpy.ndarray
        (rows, columns, 2) undistorted pixels from the image's centre.
    poses : numpy.ndarray
        (sub-poses, 3) x, y [m], theta [rad].
    mirrored : bool
        The camera sees the board from behind.
    """
    total = np.zeros(pixels.shape[:2])
    for x, y, theta in poses:
        right = np.array([math.cos(theta), math.sin(theta)]) * (-1.0 if mirrored else 1.0)
        up = np.array([-math.sin(theta), math.cos(theta)])
        points = np.array([x, y]) + pixel * (pixels[..., :1] * right - pixels[..., 1:] * up)
        total += interpolated(values, (points - np.asarray(origin)) / cell)
    return total / (65535.0 * len(poses))


def interpolated(values: npt.NDArray[Any], at: Float64) -> Float64:
    """Return bilinear values at (column, row) (..., 2); outside the values of the nearest place on the border."""
    rows, columns = values.shape
    u, v = (np.clip(at[..., axis], 0, last) for axis, last in ((0, columns - 1), (1, rows - 1)))
    left, below = np.minimum(np.floor(u), columns - 2).astype(int), np.minimum(np.floor(v), rows - 2).astype(int)
    a, b = u - left, v - below
    nodes = values.astype(np.float64)
    lower = (1 - a) * nodes[below, left] + a * nodes[below, left + 1]
    upper = (1 - a) * nodes[below + 1, left] + a * nodes[below + 1, left + 1]
    return np.asarray((1 - b) * lower + b * upper)


def philox(first: npt.ArrayLike, second: int, key: int) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.uint64]]:
    """Return Philox2x32-10 of counters (first, second), by the definition of Salmon and others (2011)."""
    word = np.uint64(0xFFFFFFFF)
    a = np.asarray(first, np.uint64)
    b = np.full_like(a, second)
    for _ in range(10):
        product = a * np.uint64(0xD256D193)
        a, b = (product >> np.uint64(32)) ^ np.uint64(key) ^ b, product & word
        key = (key + 0x9E3779B9) & 0xFFFFFFFF
    return a, b


def normal_numbers(shape: tuple[int, int], frame: int, key: int) -> Float64:
    """Return a standard normal number for each pixel (rows, columns) of a frame, by Box and Muller."""
    a, b = philox(np.arange(math.prod(shape)), frame, key)
    radius = np.sqrt(-2.0 * np.log((a.astype(np.float64) + 0.5) / 2.0**32))
    return np.asarray(radius * np.cos(2.0 * np.pi * b.astype(np.float64) / 2.0**32)).reshape(shape)


def grey_levels(
    electrons: Float64, numbers: npt.ArrayLike, sensor: Mapping[str, float], offset: npt.ArrayLike = 0.0
) -> Float64:
    """Return grey levels (rows, columns), not yet rounded, of the linear model of EMVA 1288 with a bend.

    Parameters
    ----------
    electrons : numpy.ndarray
        Mean electrons with dark current.
    numbers
        Standard normal number of each pixel.
    sensor : mapping
        dark_noise, full_well [e-], gain, dark_level, max_level, nonlinearity.
    offset
        Dark offset of each pixel [e-].
    """
    collected = electrons + np.sqrt(electrons + sensor["dark_noise"] ** 2) * np.asarray(numbers)
    held = np.minimum(collected, sensor["full_well"])
    read = held * (1.0 - sensor["nonlinearity"] * held / sensor["full_well"]) + np.asarray(offset)
    return np.asarray(np.clip(sensor["dark_level"] + sensor["gain"] * read, 0.0, sensor["max_level"]))


def edge_response(distance: npt.ArrayLike, angle: float, blur_px: float) -> Float64:
    """Return the part of the light from the bright side of a straight edge, in closed form.

    The edge is blurred by a Gaussian and by a square pixel whose sides lie at an angle to the edge's normal.

    Parameters
    ----------
    distance
        Distance of the pixel's centre from the edge, on the bright side positive [px].
    angle : float
        Angle between the normal and a side of the square [rad].
    blur_px : float
        Standard deviation of the Gaussian [px], above 0.

    Notes
    -----
    Projected to the normal, the square is the convolution of two boxes of widths abs(cos) and abs(sin). The integral of
    the normal distribution is z Phi(z) + phi(z), its integral ((z^2 + 1) Phi(z) + z phi(z)) / 2.
    """
    d = np.asarray(distance, np.float64)
    wide, narrow = sorted((abs(math.cos(angle)), abs(math.sin(angle))), reverse=True)

    def once(z: Float64) -> Float64:
        return np.asarray(z * ndtr(z) + np.exp(-z * z / 2) / math.sqrt(2 * math.pi))

    def twice(z: Float64) -> Float64:
        return np.asarray(((z * z + 1) * ndtr(z) + z * np.exp(-z * z / 2) / math.sqrt(2 * math.pi)) / 2)

    s = blur_px
    if narrow < 1e-4:
        return np.asarray((once((d + wide / 2) / s) - once((d - wide / 2) / s)) * s / wide)
    ends = [(a * wide / 2 + b * narrow / 2, a * b) for a in (1, -1) for b in (1, -1)]
    return np.asarray(sum(sign * twice((d + end) / s) for end, sign in ends) * s * s / (wide * narrow))
