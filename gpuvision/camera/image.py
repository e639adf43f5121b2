"""Grey images and their noise: conversion and checks of camera images before a measurement."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

# Smallest width and height [px] in which rulers and blobs have room.
_MIN_SIZE = 16


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
        Standard deviation [grey levels]; 0 for an image without finite second differences.

    References
    ----------
    J. Immerkaer, Fast noise variance estimation, Computer Vision and Image Understanding 64 (1996) 300: the same
    kernel, with the mean instead of the median.
    """
    kernel = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
    differences = cv2.filter2D(image.astype(np.float32), -1, kernel)[1:-1, 1:-1]
    finite = np.abs(differences[np.isfinite(differences)])
    # 0.6745 sigma is the median of |N(0, sigma)|; 6 is the root of the kernel's sum of squares.
    return float(np.median(finite) / (0.6745 * 6.0)) if finite.size else 0.0
