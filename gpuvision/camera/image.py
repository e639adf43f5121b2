"""Grey images and their noise: conversion and checks of camera images before a measurement."""

from __future__ import annotations

import math
from collections.abc import Collection
from statistics import NormalDist
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.normal_distribution import MAD_TO_SIGMA

# Smallest width and height [px] in which rulers and blobs have room.
_MIN_SIZE = 16
_QUANTISATION = 1.0 / 12.0  # variance of rounding to integers
_LEVELS = 16  # intervals of grey levels in which noise is estimated. Chosen: edges fall between the levels of surfaces
_MIN_PIXELS = 256  # of an interval: 256 independent differences give its variance to 15 %, adjacent ones to 28 %


def grey_image(
    image: npt.NDArray[Any],
    *,
    channels: Collection[int] = (1, 3, 4),
    min_size: int = _MIN_SIZE,
    convert_float64: bool = True,
) -> npt.NDArray[Any]:
    """Return an image as a contiguous grey image of uint8, uint16 or float32.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width) or (height, width, channels). Three channels are blue, green, red, as OpenCV reads them. A
        fourth channel (alpha) is ignored.
    channels : collection of int
        Accepted numbers of channels of a three-dimensional array. Default ``(1, 3, 4)``.
    min_size : int
        Smallest accepted height and width [px]. Default 16.
    convert_float64 : bool
        Convert float64 pixels to float32 (default), or refuse them.

    Returns
    -------
    numpy.ndarray
        (height, width) of the input's pixel type; float32 for float64.

    Raises
    ------
    TypeError
        The image is no NumPy array, or its pixels have another type.
    ValueError
        The shape is not accepted, or the image is smaller than `min_size`.
    """
    if isinstance(image, np.ndarray) and image.dtype == np.float64 and convert_float64:
        image = image.astype(np.float32)
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16, np.float32):
        given = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise TypeError(f"image is {given}, expected an array of uint8, uint16 or float32")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in channels) or 0 in image.shape:
        depths = " or ".join(map(str, channels))
        raise ValueError(
            f"image has the shape {image.shape}, expected (height, width) or (height, width, channels) with {depths} "
            "channels"
        )
    if min(image.shape[:2]) < min_size:
        raise ValueError(f"image has {image.shape[1]} x {image.shape[0]} px, expected at least {min_size} x {min_size}")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3:
        image = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image)


def estimate_pixel_noise(image: npt.NDArray[Any]) -> float:
    """Estimate the standard deviation of a pixel's noise from the median of second differences.

    Edges cover few pixels, so the median ignores them. Smoothing and resampling correlate neighbouring pixels: the
    noise of such an image is underestimated.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width), any real pixel type. Pixels that are not finite are ignored.

    Returns
    -------
    float
        Standard deviation [grey levels]; 0 for an image without finite second differences. It includes the rounding of
        the pixels to integers, whose variance is 1/12.

    Notes
    -----
    The median of the differences of an image of integers is an integer or a half: steps of 0.25 grey levels of noise.
    For such an image the quantile of a normal distribution is interpolated between the edges of the median's bin. The
    estimate is then within 2 % from 0.5 grey levels of noise, and within 12 % from 0.3 where the levels of the image
    differ by fractions of a grey level.

    References
    ----------
    J. Immerkaer, Fast noise variance estimation, Computer Vision and Image Understanding 64 (1996) 300: the same
    kernel, with the mean instead of the median.
    """
    differences = _second_differences(image)
    return _deviation(np.abs(differences[np.isfinite(differences)]))


def finite_percentiles(image: npt.NDArray[Any], percentiles: tuple[float, float]) -> tuple[float, float]:
    """Return two percentiles of the finite pixels of an image [grey levels]; zeros if no pixel is finite.

    Parameters
    ----------
    image : numpy.ndarray
        Any shape, any real pixel type.
    percentiles : tuple of float
        Low and high, 0 to 100.
    """
    finite = image[np.isfinite(image)]
    low, high = np.percentile(finite, percentiles) if finite.size else (0.0, 0.0)
    return float(low), float(high)


class PixelNoise(NamedTuple):
    """Noise of the pixels of a camera.

    The variance of a pixel is ``read_noise**2 + gain * level``, plus 1/12 for integers (quantisation).

    Attributes
    ----------
    read_noise : float
        Standard deviation at level 0 [grey levels].
    gain : float
        Variance of the shot noise per grey level [grey levels].
    """

    read_noise: float
    gain: float

    def sigma(self, image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return the standard deviation of each pixel without quantisation, in the shape of the image [grey levels]."""
        levels = np.maximum(image.astype(np.float32), 0.0)
        return np.asarray(np.sqrt(self.read_noise**2 + self.gain * levels), np.float32)


def estimate_noise_model(image: npt.NDArray[Any]) -> PixelNoise:
    """Estimate how the noise of the pixels depends on their grey level.

    The noise is estimated as in `estimate_pixel_noise`, in 16 intervals of the mean of 3 x 3 pixels. A straight line is
    fitted to the variances, each weighted by its expected scatter: edges in an interval of few pixels have a large
    variance and little weight.

    Parameters
    ----------
    image : numpy.ndarray
        (height, width), any real pixel type, without NaN.

    Returns
    -------
    PixelNoise
        Without shot noise where the variance does not increase with the level, and without read noise where the line
        has a negative variance at level 0.
    """
    differences = np.abs(_second_differences(image))
    means = cv2.blur(image.astype(np.float32), (3, 3))[1:-1, 1:-1]
    intervals = np.linspace(means.min(), means.max(), _LEVELS + 1)[1:-1]
    number = np.digitize(means, intervals)
    inside = [number == each for each in range(_LEVELS)]
    counts = np.array([np.count_nonzero(each) for each in inside])
    variances = np.array([_deviation(differences[each]) ** 2 for each in inside])
    used = (counts >= _MIN_PIXELS) & (variances > 0.0)
    if not np.any(used):
        return PixelNoise(estimate_pixel_noise(image), 0.0)
    levels = np.array([means[each].mean() for each, use in zip(inside, used, strict=True) if use])
    # The standard deviation of a variance from n pixels is proportional to the variance over the root of n.
    weights = np.sqrt(counts[used]) / variances[used]
    rounding = _QUANTISATION if np.issubdtype(image.dtype, np.integer) else 0.0
    return _line_of_noise(levels, np.maximum(variances[used] - rounding, 0.0), weights)


def _line_of_noise(levels: npt.NDArray[Any], variances: npt.NDArray[Any], weights: npt.NDArray[Any]) -> PixelNoise:
    """Fit a line to variances at levels; neither its slope nor its value at level 0 is negative."""
    levels = np.maximum(levels, 0.0)  # as `PixelNoise.sigma`
    gain, offset = np.polyfit(levels, variances, 1, w=weights) if len(levels) > 1 else (0.0, float(variances[0]))
    if gain < 0.0:
        gain, offset = 0.0, np.average(variances, weights=weights**2)
    if offset < 0.0:
        gain, offset = np.sum(weights**2 * levels * variances) / np.sum((weights * levels) ** 2), 0.0
    return PixelNoise(math.sqrt(offset), float(gain))


def _second_differences(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return the second differences along rows and columns of the pixels that have all neighbours."""
    kernel = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
    return np.asarray(cv2.filter2D(image.astype(np.float32), -1, kernel)[1:-1, 1:-1], np.float32)


def _deviation(magnitudes: npt.NDArray[np.float32]) -> float:
    """Return the standard deviation of the noise by the magnitudes of second differences; 0 without one."""
    # 6 is the root of the kernel's sum of squares.
    return _median(magnitudes) * MAD_TO_SIGMA / 6.0 if magnitudes.size else 0.0


def _median(magnitudes: npt.NDArray[np.float32]) -> float:
    """Return the median of the magnitudes of normally distributed values, which may be rounded to integers."""
    median = float(np.median(magnitudes))
    if np.any(magnitudes != np.rint(magnitudes)):
        return median
    middle = math.floor(median)
    bins = [(middle - 0.5, np.mean(magnitudes < middle)), (middle + 0.5, np.mean(magnitudes <= middle))]
    # A value of 0 had a magnitude of 0 to 0.5.
    edges = [(max(edge, 0.0), _quantile(float(share))) for edge, share in bins]
    return float(np.interp(1.0 / MAD_TO_SIGMA, [each for _, each in edges], [edge for edge, _ in edges]))


def _quantile(share: float) -> float:
    """Return the magnitude [sigma] below which a share of normally distributed values lies."""
    return NormalDist().inv_cdf((1.0 + share) / 2.0) if share < 1.0 else math.inf
