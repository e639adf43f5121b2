"""Statistics of flat and dark frames for the photon transfer method: means, temporal and spatial variances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


class FrameStatistics(NamedTuple):
    """Statistics of stacks of frames, arrays of shape (stacks,), in grey levels.

    Attributes
    ----------
    mean
        Mean over pixels and frames.
    temporal
        Mean over the pixels of the variance from frame to frame, without the changes of the mean of a frame.
    spatial
        Variance over the pixels of the mean frame, less the part of the temporal variance.
    freedom
        Degrees of freedom of the temporal variance.
    frames, pixels
        Number of frames of each stack, and of pixels of a frame.
    """

    mean: Float64
    temporal: Float64
    spatial: Float64
    freedom: Float64
    frames: Float64
    pixels: Float64

    @property
    def mean_variance(self) -> Float64:
        """Variance of the mean by the temporal noise."""
        return np.asarray(self.temporal / (self.frames * self.pixels))

    @property
    def temporal_variance(self) -> Float64:
        """Variance of the temporal variance for normal noise."""
        return np.asarray(2.0 * self.temporal**2 / self.freedom)

    @property
    def spatial_variance(self) -> Float64:
        """Variance of the spatial variance by the temporal noise, for equal differences between the pixels."""
        rest = self.temporal / self.frames
        return np.asarray((4.0 * np.maximum(self.spatial, 0.0) * rest + 2.0 * rest**2) / (self.pixels - 1.0))


def frame_statistics(stacks: Sequence[npt.NDArray[Any]], what: str) -> FrameStatistics:
    """Return the statistics of stacks (frames, rows, columns) of one irradiance and exposure each.

    Parameters
    ----------
    stacks
        Stacks of 2 frames or more; their numbers of frames may differ.
    what
        Name of the stacks for messages.

    Raises
    ------
    TypeError
        A stack is not an array of numbers.
    ValueError
        A stack has another shape, or a pixel is not finite.

    Notes
    -----
    Of two frames the temporal variance is half the variance of their difference, as in EMVA 1288.
    """
    if not len(stacks):
        raise ValueError(f"{what}: there are no frames")
    rows = [_statistics(each, f"{what}[{number}]") for number, each in enumerate(stacks)]
    return FrameStatistics(*np.array(rows, np.float64).T)


def _statistics(stack: npt.NDArray[Any], what: str) -> tuple[float, ...]:
    if not isinstance(stack, np.ndarray) or stack.dtype.kind not in "uif":
        raise TypeError(f"{what} must be an array of numbers, got {type(stack).__name__}")
    if stack.ndim != 3 or stack.shape[0] < 2 or stack.shape[1] * stack.shape[2] < 2:
        raise ValueError(f"{what} has the shape {stack.shape}, expected (frames, rows, columns) with 2 frames or more")
    values = stack.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{what} has pixels that are not finite")
    frames, pixels = len(values), values[0].size
    mean = values.mean()
    image = values.mean(axis=0)
    freedom = (frames - 1.0) * (pixels - 1.0)
    changes = values - image - (values.mean(axis=(1, 2), keepdims=True) - mean)
    temporal = float(np.sum(changes**2)) / freedom
    spatial = float(np.var(image, ddof=1)) - temporal / frames
    return float(mean), temporal, spatial, freedom, float(frames), float(pixels)
