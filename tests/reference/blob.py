"""Reference of blob measurement: images of blurred discs, rings, squares and crosses, and a fit to them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import i1e, ndtr

Float64 = NDArray[np.float64]


def disc_profile(radius: float, blur: float) -> tuple[Float64, Float64]:
    """Return distances from the centre, and the levels of a disc of level 1 on 0, blurred by a Gaussian.

    The slope of the level is (R / s^2) exp(-(r^2 + R^2) / (2 s^2)) I1(r R / s^2); the level is its integral from
    outside.
    """
    r = np.linspace(0.0, radius + 8.0 * blur + 1.0, 20001)
    slope = radius / blur**2 * np.exp(-((r - radius) ** 2) / (2.0 * blur**2)) * i1e(r * radius / blur**2)
    parts = 0.5 * (slope[1:] + slope[:-1]) * np.diff(r)
    return r, np.concatenate([np.cumsum(parts[::-1])[::-1], [0.0]])


def disc(shape: tuple[int, int], x: float, y: float, radius: float, blur: float) -> Float64:
    """Return levels 0 to 1 of a blurred disc."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    r, level = disc_profile(radius, blur)
    return np.asarray(np.interp(np.hypot(column - x, row - y), r, level, right=0.0))


def ring(shape: tuple[int, int], x: float, y: float, radius: float, ratio: float, blur: float) -> Float64:
    """Return levels of a blurred ring."""
    return disc(shape, x, y, radius, blur) - disc(shape, x, y, ratio * radius, blur)


def bar(shape: tuple[int, int], x: float, y: float, angle: float, long: float, wide: float, blur: float) -> Float64:
    """Return levels of a blurred rectangle with half lengths ``long`` and ``wide``."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    cosine, sine = math.cos(angle), math.sin(angle)
    u, v = (column - x) * cosine + (row - y) * sine, (row - y) * cosine - (column - x) * sine
    along = ndtr((u + long) / blur) - ndtr((u - long) / blur)
    return np.asarray(along * (ndtr((v + wide) / blur) - ndtr((v - wide) / blur)))


def square(shape: tuple[int, int], x: float, y: float, half: float, angle: float, blur: float) -> Float64:
    """Return levels of a blurred square."""
    return bar(shape, x, y, angle, half, half, blur)


def cross(shape: tuple[int, int], x: float, y: float, half: float, angle: float, ratio: float, blur: float) -> Float64:
    """Return levels of a blurred cross: the sum of two bars, minus their common square."""
    wide = ratio * half
    bars = bar(shape, x, y, angle, half, wide, blur) + bar(shape, x, y, angle, wide, half, blur)
    return bars - bar(shape, x, y, angle, wide, wide, blur)


def render(shape: str, size: tuple[int, int], numbers: Float64, ratio: float) -> Float64:
    """Return the levels, 0 to 1, of a fiducial.

    Parameters
    ----------
    shape
        "circle", "ring", "square" or "cross".
    size
        Rows and columns of the image.
    numbers
        x, y, radius and blur [px] of a circle or ring; x, y, half size [px], angle [rad] and blur [px] of the others.
    ratio
        Inner by outer radius of a ring, or width by length of a cross's bars.
    """
    if shape == "circle":
        return disc(size, *numbers)
    if shape == "ring":
        x, y, radius, blur = numbers
        return ring(size, x, y, radius, ratio, blur)
    if shape == "square":
        return square(size, *numbers)
    x, y, half, angle, blur = numbers
    return cross(size, x, y, half, angle, ratio, blur)


def fit(image: Float64, shape: str, near: Float64, ratio: float, reach: float) -> Float64:
    """Return the numbers of `render` by least squares over the pixels within ``reach`` [px] of the start ``near``.

    The image is linear in the contrast, the background and the background's slopes. These are solved at every step.
    """
    row, column = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    dx, dy = column - near[0], row - near[1]
    inside = np.hypot(dx, dy) <= reach

    def residual(numbers: Float64) -> Float64:
        level = render(shape, image.shape, numbers, ratio)
        matrix = np.stack([level, np.ones_like(level), dx, dy], axis=-1)[inside]
        return np.asarray(image[inside] - matrix @ np.linalg.lstsq(matrix, image[inside], rcond=None)[0])

    return np.asarray(least_squares(residual, near, x_scale="jac", diff_step=1e-5).x)


def circle_through(points: Float64, near: Float64) -> Float64:
    """Return x, y and radius of the circle with the least sum of squared distances from points (n, 2)."""

    def residual(circle: Float64) -> Float64:
        return np.asarray(np.hypot(*(points - circle[:2]).T) - circle[2])

    return np.asarray(least_squares(residual, near).x)


def cramer_rao(radius: float, blur: float, noise: float) -> float:
    """Return the Cramer-Rao bound of a disc's centre [px]: contrast 1, white noise, all other parameters known."""
    return noise * math.sqrt(2.0 * blur / (math.sqrt(math.pi) * radius))
