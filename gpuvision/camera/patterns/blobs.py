"""Detection of blobs of one size (dots, or cells between lines) whose size and polarity are unknown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from gpuvision.camera.patterns.lattice import estimate_local_steps
from gpuvision.camera.patterns.pattern import Float32, Float64, box_mean, downsample

# Cells per window of the downsampled image on which the threshold is computed (speed only).
_CELLS = 16
# Scale search: windows to try, as fractions of the image's shorter side; smoothing box [px]; pixels of the downsampled
# image of a first trial (speed only).
_WINDOWS = (1 / 3, 1 / 6, 1 / 12, 1 / 24, 1 / 48)
_TRIAL_SMOOTHING = 3
_TRIAL_PIXELS = 3e6


@dataclass(frozen=True, kw_only=True)
class BlobLimits:
    """Thresholds of the blob detection.

    Attributes
    ----------
    min_contrast : float
        Least local contrast, as a fraction of the 90th percentile of the contrast in the image. Measured on photographs
        with uneven illumination. Default 0.15.
    min_contrast_sigmas : float
        Least local contrast [standard deviations of the noise]. Derived: the extremes of noise alone lie about 6 sigma
        apart in a window. Default 8.0.
    min_area : int
        Least area of a blob [px]. Default 6.
    min_fill : float
        Least fraction of its bounding box that a blob covers. Derived: a disc covers 0.785, an ellipse at 45 degrees
        with axes 1:2 covers 0.63. Default 0.4.
    max_elongation : float
        Largest ratio of the sides of the bounding box. Default 3.5.
    area_range : (float, float)
        Accepted areas relative to the median area; perspective varies the areas of one pattern. Default ``(0.4, 2.5)``.
    window_pitches : float
        Side of the threshold window [pitches]. Derived: two pitches contain blobs and background everywhere. Default
        2.0.
    smoothing_pitches : float
        Half the side of the smoothing box before thresholding [pitches]. Default 0.04.
    blob_count : (int, int)
        Accepted numbers of blobs in a trial of the scale search. Default ``(5, 60000)``.
    sufficient_count : int
        Number of blobs with symmetric neighbours that ends the scale search. Default 50.
    sufficient_share : float
        Share of such blobs among all blobs that ends the scale search. Default 0.6.
    """

    min_contrast: float = 0.15
    min_contrast_sigmas: float = 8.0
    min_area: int = 6
    min_fill: float = 0.4
    max_elongation: float = 3.5
    area_range: tuple[float, float] = (0.4, 2.5)
    window_pitches: float = 2.0
    smoothing_pitches: float = 0.04
    blob_count: tuple[int, int] = (5, 60_000)
    sufficient_count: int = 50
    sufficient_share: float = 0.6


class Blobs(NamedTuple):
    """Connected regions beyond the local threshold."""

    points: Float64
    """(n, 2) centres of gravity, column and row [px]."""
    area: Float64
    """(n,) areas [px]."""
    size: Float64
    """(n, 2) width and height of the bounding boxes [px]."""


class PatternBlobs(NamedTuple):
    """Blobs of a target pattern, of similar size."""

    points: Float64
    """(n, 2) centres, column and row [px], accurate to about half a pixel."""
    size: Float64
    """(n, 2) width and height [px]."""
    bright: bool
    """The blobs are brighter than the background."""
    coverage: float
    """Fraction of the pattern's area that the blobs cover."""


class PatternScale(NamedTuple):
    """Scale and polarity of the pattern in an image."""

    bright: bool
    """The blobs are brighter than the background."""
    pitch: float
    """Median length of the longer one of the two lattice steps [px]."""
    cell_area: float
    """Median area that the two lattice steps span [px^2]."""
    blob_count: int
    """Number of blobs with symmetric neighbours."""


def find_pattern_blobs(grey: Float32, limits: BlobLimits = BlobLimits()) -> PatternBlobs:
    """Find the blobs of a regular target pattern, of any size and polarity; the result may be empty.

    Parameters
    ----------
    grey : numpy.ndarray
        (height, width) float32 grey levels.
    limits : BlobLimits
        Thresholds of the detection.
    """
    scale = estimate_scale(grey, limits)
    if scale.blob_count == 0:
        return PatternBlobs(np.empty((0, 2)), np.empty((0, 2)), False, math.nan)
    smoothing = 2 * round(limits.smoothing_pitches * scale.pitch) + 1
    blobs = find_blobs(grey, limits.window_pitches * scale.pitch, scale.bright, smoothing, limits)
    kept = is_typical_area(blobs.area, limits)
    coverage = float(np.median(blobs.area[kept])) / scale.cell_area if kept.any() else math.nan
    return PatternBlobs(blobs.points[kept], blobs.size[kept], scale.bright, coverage)


def find_blobs(
    grey: Float32,
    window: float,
    bright: bool,
    smoothing: int,
    limits: BlobLimits = BlobLimits(),
) -> Blobs:
    """Find regions brighter (darker) than the mean of the extreme grey levels within a window.

    Regions that touch the image's border, and regions that cover too little of their bounding box for an ellipse,
    are ignored.

    Parameters
    ----------
    grey : numpy.ndarray
        (height, width) float32 grey levels.
    window : float
        Side of the window [px]. Blobs and background must both be present in every window on the pattern.
    bright : bool
        The blobs are brighter than the background.
    smoothing : int
        Side of the smoothing box [px], odd.
    limits : BlobLimits
        Thresholds of the detection.
    """
    grey = box_mean(grey, smoothing)
    level, usable = _threshold(grey, window, limits)
    mask = cv2.compare(grey, level, cv2.CMP_GT if bright else cv2.CMP_LT)
    cv2.bitwise_and(mask, usable, dst=mask)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_32S)
    left, top, width, height, area = stats[1:].T
    rows, columns = grey.shape
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    filled = area / (width * height)
    shaped = (filled > limits.min_fill) | (area < 4 * limits.min_area)
    shaped &= np.maximum(width, height) < limits.max_elongation * np.minimum(width, height)
    kept = inside & shaped & (area >= limits.min_area)
    box = np.stack([width, height], axis=1)
    return Blobs(centroids[1:][kept], area[kept].astype(np.float64), box[kept].astype(np.float64))


def _threshold(grey: Float32, window: float, limits: BlobLimits) -> tuple[Float32, npt.NDArray[np.uint8]]:
    """Return the mean of the local extremes, and a mask (255) of sufficient local contrast."""
    rows, columns = grey.shape
    step = max(1, math.floor(window / _CELLS))
    small = downsample(grey, step)
    side = 2 * round(0.5 * window / step) + 1
    kernel = np.ones((side, side), np.uint8)
    extremes = (cv2.dilate(small, kernel), cv2.erode(small, kernel))
    high, low = (box_mean(np.asarray(each, dtype=np.float32), side) for each in extremes)
    span = high - low
    least = max(limits.min_contrast * float(np.percentile(span, 90)), limits.min_contrast_sigmas * _noise(small))
    middle = cv2.resize(0.5 * (high + low), (columns, rows), interpolation=cv2.INTER_LINEAR)
    usable = cv2.resize((span > least).astype(np.uint8) * 255, (columns, rows), interpolation=cv2.INTER_NEAREST)
    return np.asarray(middle, dtype=np.float32), np.asarray(usable, dtype=np.uint8)


def _noise(image: Float32) -> float:
    """Estimate the noise's standard deviation from the lower quartile of second differences, free of edges."""
    # The lower quartile of |N(0, 1)| is 0.3186; the second difference has 6 times the variance of a pixel.
    step = np.abs(image[:, 2:] - 2.0 * image[:, 1:-1] + image[:, :-2])
    return float(np.percentile(step, 25)) / (0.3186 * math.sqrt(6.0)) if step.size else 0.0


def is_typical_area(area: Float64, limits: BlobLimits) -> npt.NDArray[np.bool_]:
    """Return which areas lie within the accepted range about the median."""
    median = np.median(area) if area.size else math.nan
    return (area > limits.area_range[0] * median) & (area < limits.area_range[1] * median)


def estimate_scale(grey: Float32, limits: BlobLimits) -> PatternScale:
    """Try window sizes and both polarities; return the trial with the most blobs that have symmetric neighbours."""
    shrink = math.ceil(math.sqrt(grey.size / _TRIAL_PIXELS))
    best = PatternScale(False, math.nan, math.nan, 0)
    for factor in sorted({shrink, 1}, reverse=True):
        small = downsample(grey, factor)
        for part in _WINDOWS:
            for bright in (False, True):
                blobs = find_blobs(small, part * min(small.shape), bright, _TRIAL_SMOOTHING, limits)
                trial = _rate_trial(blobs, bright, limits)
                if trial.blob_count > best.blob_count:
                    best = trial._replace(pitch=trial.pitch * factor, cell_area=trial.cell_area * factor**2)
                if trial.blob_count > max(limits.sufficient_count, limits.sufficient_share * len(blobs.area)):
                    return best
        if best.blob_count > limits.sufficient_count:
            break
    return best


def _rate_trial(blobs: Blobs, bright: bool, limits: BlobLimits) -> PatternScale:
    """Return the median lattice steps of the blobs that have symmetric neighbours."""
    points = blobs.points[is_typical_area(blobs.area, limits)]
    if not limits.blob_count[0] <= len(points) <= limits.blob_count[1]:
        return PatternScale(bright, math.nan, math.nan, 0)
    bases = estimate_local_steps(points, cKDTree(points))
    bases = bases[np.isfinite(bases[:, 0, 0])]
    if len(bases) == 0:
        return PatternScale(bright, math.nan, math.nan, 0)
    length = np.linalg.norm(bases, axis=-1).max(axis=1)
    return PatternScale(bright, float(np.median(length)), float(np.median(np.abs(np.linalg.det(bases)))), len(bases))
