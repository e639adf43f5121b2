"""Noise of the modified Laplacian, the focus measure of textured surfaces."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.special

Float64 = npt.NDArray[np.float64]

BEND = (-1.0, 2.0, -1.0)
"""Weights of a second difference of neighbouring pixels."""
_BEND_VARIANCE = 6.0  # sum of the squared weights: variance of a second difference over the variance of a pixel
# Sums of products of the weights with themselves, shifted by 0, 1 and 2 pixels along the same axis; and with the
# weights along the other axis, shifted by -1, 0 and 1 pixel along one axis: the products of two of these.
_SAME_AXIS = (6.0, -4.0, 1.0)
_OTHER_AXIS = {-1: -1.0, 0: 2.0, 1: -1.0}


def laplacian_variance(image: npt.ArrayLike, noise: float | Float64, window: int) -> Float64:
    """Compute the variance of the modified Laplacian of each pixel by the noise of the image.

    The measure of a pixel is the mean of ``|L_x| + |L_y|`` over N = (2 window + 1)^2 pixels, with the second
    differences L_x and L_y.

    Parameters
    ----------
    image : (rows, columns) array_like
        Grey levels.
    noise : float or (rows, columns) array
        Standard deviation of a pixel [grey levels], above 0: one for all pixels, or of each pixel (shot noise). Pixels
        err independently.
    window : int
        Half size of the window [px].

    Returns
    -------
    (rows, columns) float64
        [grey levels^2]. NaN in the ``window + 1`` outermost rows and columns, whose windows reach beyond the image.

    Notes
    -----
    A second difference L = m + e has noise e of the variance t^2 = 6 noise^2. Two of them have the covariance R, the
    sum of the products of their weights times noise^2. With a standard deviation of each pixel, both are sums over the
    pixels of the differences. The Hermite series of the absolute value gives, to second order,
    ``Cov(|L_1|, |L_2|) = g_1 g_2 R + 2 f_1 f_2 R^2 / (t_1 t_2)``, with ``g = erf(m / (sqrt(2) t))`` and ``f`` the
    normal density at m / t. The first term is the propagation to first order, with a sign that fades where L is noise;
    the second one is the noise of L without a signal (0.88 of its variance). The sum runs over all pairs in the window.

    m is not known: it is estimated from the observed L by ``m^2 = max(L^2 - t^2, 0)``, which removes the noise from the
    power. For L without a signal the estimate of the variance is 1.07 of the true one on average.
    """
    levels = np.asarray(image, dtype=np.float64)
    pixels = None if np.ndim(noise) == 0 else np.asarray(noise, dtype=np.float64) ** 2
    deviations = _deviations(noise, pixels)
    gains, densities = [], []
    for axis, deviation in enumerate(deviations):
        bend = scipy.ndimage.correlate1d(levels, BEND, axis, mode="nearest")
        relative = np.sign(bend) * np.sqrt(np.maximum((bend / deviation) ** 2 - 1.0, 0.0))
        gains.append(scipy.special.erf(relative / math.sqrt(2.0)))
        densities.append(np.exp(-0.5 * relative**2) / math.sqrt(2.0 * math.pi))
    size, margin = 2 * window + 1, window + 1
    variance = np.full(levels.shape, np.nan)
    if min(levels.shape) <= 2 * margin:
        return variance
    total: Float64 = np.zeros(())
    for (down, across), pairs in _PAIRS.items():
        if max(down, across) < size:
            summed: float | Float64 = 0
            for pair, r, weight in pairs:
                first, second = (r, 2.0 / _BEND_VARIANCE * r**2) if pixels is None else _terms(pixels, deviations, pair)
                summed = summed + weight * (first * _shifted(gains, pair) + second * _shifted(densities, pair))
            total = total + _moving_sum(_moving_sum(np.asarray(summed), size - down, 0), size - across, 1)
    unit = noise if pixels is None else 1.0
    variance[margin:-margin, margin:-margin] = (unit / size**2) ** 2 * total[1:-1, 1:-1]
    return variance


def _deviations(noise: float | Float64, pixels: Float64 | None) -> tuple[Any, Any]:
    """Return the standard deviations of the second differences along both axes, for variances of the pixels."""
    if pixels is None:
        return (math.sqrt(_BEND_VARIANCE) * noise,) * 2
    squares = np.square(BEND)
    along = [np.sqrt(scipy.ndimage.correlate1d(pixels, squares, axis, mode="nearest")) for axis in (0, 1)]
    return along[0], along[1]


def _terms(pixels: Float64, deviations: tuple[Float64, Float64], pair: _Pair) -> tuple[Float64, Float64]:
    """Return the covariances R of a pair of second differences, and 2 R^2 / (t_1 t_2), (rows - |shift|, columns - ...).

    R is the sum of the variances of the pixels that both differences have, times both weights.
    """
    first, second, down, across = pair
    rows, columns = pixels.shape[0] - abs(down), pixels.shape[1] - abs(across)
    top, left = max(-down, 0) + 1, max(-across, 0) + 1  # of the first difference in the padded variances
    padded = np.pad(pixels, 1, mode="edge")
    covariance = np.zeros((rows, columns))
    for k, m in itertools.product((-1, 0, 1), repeat=2):
        here = (k, 0) if first == 0 else (0, k)
        there = (down + m, across) if second == 0 else (down, across + m)
        if here == there:
            part = padded[top + here[0] : top + here[0] + rows, left + here[1] : left + here[1] + columns]
            covariance += BEND[k + 1] * BEND[m + 1] * part
    inverse = [1.0 / each for each in deviations]
    return covariance, 2.0 * covariance**2 * _shifted(inverse, pair)


# A pair of second differences: axis of the first one, axis of the second one, and its shift (rows, columns).
_Pair = tuple[int, int, int, int]


def _pairs() -> dict[tuple[int, int], list[tuple[_Pair, float, float]]]:
    """Return the pairs by the size of their shift, each with its covariance over noise^2 and its multiplicity."""
    groups: dict[tuple[int, int], list[tuple[_Pair, float, float]]] = {}
    for shift, r in enumerate(_SAME_AXIS):
        for axis in (0, 1):
            down, across = (shift, 0) if axis == 0 else (0, shift)
            groups.setdefault((down, across), []).append(((axis, axis, down, across), r, 2.0 if shift else 1.0))
    for down, of_rows in _OTHER_AXIS.items():
        for across, of_columns in _OTHER_AXIS.items():
            pair = (0, 1, down, across)
            groups.setdefault((abs(down), abs(across)), []).append((pair, of_rows * of_columns, 2.0))
    return groups


_PAIRS = _pairs()


def _shifted(values: list[Float64], pair: _Pair) -> Float64:
    """Return the products of a pair of values, (rows - |shift|, columns - |shift|)."""
    first, second, down, across = pair
    rows, columns = values[0].shape

    def part(value: Float64, down: int, across: int) -> Float64:
        return value[max(down, 0) : rows + min(down, 0), max(across, 0) : columns + min(across, 0)]

    return part(values[first], -down, -across) * part(values[second], down, across)


def _moving_sum(values: Float64, size: int, axis: int) -> Float64:
    """Return the sums of ``size`` neighbours along an axis, without padding."""
    total = np.insert(np.cumsum(values, axis=axis), 0, 0.0, axis=axis)
    along = np.moveaxis(total, axis, 0)
    return np.moveaxis(along[size:] - along[:-size], 0, axis)
