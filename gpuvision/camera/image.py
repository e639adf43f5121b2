"""Grey images and their noise: conversion of camera images for measurement."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import RecordingError


def grey_image(image: npt.NDArray[Any], what: str = "the image") -> npt.NDArray[Any]:
    """Return an image as rulers take it: grey, contiguous, uint8, uint16 or float32.

    Raises
    ------
    RecordingError
        It is of another kind.
    """
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.dtype not in (np.uint8, np.uint16, np.float32) or image.ndim not in (2, 3):
        raise RecordingError(
            f"{what}: {image.dtype} of shape {image.shape}, expected a grey or colour image of uint8, uint16 or float32"
        )
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3:
        if image.shape[2] not in (3, 4):
            raise RecordingError(f"{what}: {image.shape[2]} channels, expected 1, 3 or 4")
        image = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
    if min(image.shape) < 16:
        raise RecordingError(f"{what}: {image.shape[1]} x {image.shape[0]} px, expected 16 or more each way")
    return np.ascontiguousarray(image)


def noise_of(image: npt.NDArray[Any]) -> float:
    """Return the standard deviation of a pixel's noise [grey levels], from the median of a second difference.

    Edges are few among the pixels and do not count. An image that was smoothed, or sampled anew, has more noise than
    neighbouring pixels tell.
    """
    kernel = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
    rough = cv2.filter2D(image.astype(np.float32), -1, kernel)[1:-1, 1:-1]
    finite = np.abs(rough[np.isfinite(rough)])
    # 0.6745 sigma is the median of |N(0, sigma)|, and 6 the root of the sum of the kernel's squares.
    return float(np.median(finite) / (0.6745 * 6.0)) if finite.size else 0.0
