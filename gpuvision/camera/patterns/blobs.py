"""Blobs of one size on a ground, where neither size nor brightness is known: the dots of a pattern, or its cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from gpuvision.camera.patterns.lattice import local_bases
from gpuvision.camera.patterns.pattern import Float32, Float64, boxed, shrunk

# Cells of the map of thresholds in a window.
_CELLS = 16
# Light and dark must differ by this part of what they do in most of the image, and by so many times the noise: the
# extremes of noise alone lie 6 times its sigma apart in a window.
_CONTRAST = 0.15
_ABOVE_NOISE = 8.0
_SMALLEST_AREA = 6
# Of its bounding box a disc fills 0.785, an ellipse at 45 degrees half as wide as long 0.63.
_LEAST_FILLED = 0.4
_LONGEST = 3.5
_AREAS = (0.4, 2.5)
# A window holds two steps of a regular grid each way: blobs and ground are in all of them.
_WINDOW_PITCHES = 2.0
# Half the side of the smoothing before blobs are told from the ground, in steps.
_SMOOTHED = 0.04
# Windows to try, as parts of the image's smaller side.
_WINDOWS = (1 / 3, 1 / 6, 1 / 12, 1 / 24, 1 / 48)
_TRIAL_SMOOTHING = 3
_TRIAL_PIXELS = 3e6
_FEWEST_BLOBS = 5
_MOST_BLOBS = 60_000
# So many blobs amid symmetric neighbours, and such a share of all, need no further trial.
_CLEAR_COUNT = 50
_CLEAR_SHARE = 0.6


class Blobs(NamedTuple):
    """Connected regions beyond the local threshold."""

    points: Float64
    """(n, 2) centres of gravity, in pixels."""
    area: Float64
    """(n,) in pixels."""
    size: Float64
    """(n, 2) width and height of the bounding boxes."""


class PatternBlobs(NamedTuple):
    """Blobs of a pattern, all of about one size."""

    points: Float64
    """(n, 2) centres, right to about half a pixel."""
    size: Float64
    """(n, 2) width and height in pixels."""
    bright: bool
    """They are brighter than the ground."""
    cover: float
    """Part of the pattern that they cover."""


class Scale(NamedTuple):
    """What an image's blobs look like."""

    bright: bool
    pitch: float
    """Usual distance of neighbours along the longer one of the two steps, in pixels."""
    cell: float
    """Usual area that the two steps span, in square pixels."""
    number: int
    """Blobs that lie amid symmetric neighbours."""


def find_pattern_blobs(grey: Float32) -> PatternBlobs:
    """Find the blobs that a regular pattern is made of, of any size and brightness; maybe none."""
    scale = find_scale(grey)
    if scale.number == 0:
        return PatternBlobs(np.empty((0, 2)), np.empty((0, 2)), False, math.nan)
    smoothing = 2 * round(_SMOOTHED * scale.pitch) + 1
    blobs = find_blobs(grey, _WINDOW_PITCHES * scale.pitch, scale.bright, smoothing)
    kept = alike(blobs.area)
    cover = float(np.median(blobs.area[kept])) / scale.cell if kept.any() else math.nan
    return PatternBlobs(blobs.points[kept], blobs.size[kept], scale.bright, cover)


def find_blobs(grey: Float32, window: float, bright: bool, smoothing: int) -> Blobs:
    """Find regions brighter (darker) than the middle between the lightest and the darkest within a window.

    Those that touch the border, and those that fill their bounding box as no ellipse does, are left out.

    Parameters
    ----------
    grey
        The image.
    window
        Side in pixels; light and dark are in every window that counts.
    bright
        The blobs are brighter than the ground.
    smoothing
        Side in pixels, odd, of a box that the image is smoothed with.
    """
    grey = boxed(grey, smoothing)
    level, usable = _threshold(grey, window)
    mask = cv2.compare(grey, level, cv2.CMP_GT if bright else cv2.CMP_LT)
    cv2.bitwise_and(mask, usable, dst=mask)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_32S)
    left, top, width, height, area = stats[1:].T
    rows, columns = grey.shape
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    filled = area / (width * height)
    shaped = (filled > _LEAST_FILLED) | (area < 4 * _SMALLEST_AREA)
    shaped &= np.maximum(width, height) < _LONGEST * np.minimum(width, height)
    kept = inside & shaped & (area >= _SMALLEST_AREA)
    box = np.stack([width, height], axis=1)
    return Blobs(centroids[1:][kept], area[kept].astype(np.float64), box[kept].astype(np.float64))


def _threshold(grey: Float32, window: float) -> tuple[Float32, npt.NDArray[np.uint8]]:
    """Middle of the local extremes, and where they lie far enough apart (255)."""
    rows, columns = grey.shape
    step = max(1, math.floor(window / _CELLS))
    small = shrunk(grey, step)
    side = 2 * round(0.5 * window / step) + 1
    kernel = np.ones((side, side), np.uint8)
    extremes = (cv2.dilate(small, kernel), cv2.erode(small, kernel))
    high, low = (boxed(np.asarray(each, dtype=np.float32), side) for each in extremes)
    span = high - low
    least = max(_CONTRAST * float(np.percentile(span, 90)), _ABOVE_NOISE * _noise(small))
    middle = cv2.resize(0.5 * (high + low), (columns, rows), interpolation=cv2.INTER_LINEAR)
    usable = cv2.resize((span > least).astype(np.uint8) * 255, (columns, rows), interpolation=cv2.INTER_NEAREST)
    return np.asarray(middle, dtype=np.float32), np.asarray(usable, dtype=np.uint8)


def _noise(image: Float32) -> float:
    """Sigma of an image's noise, from the quarter of its second differences that is smallest: there are no edges."""
    step = np.abs(image[:, 2:] - 2.0 * image[:, 1:-1] + image[:, :-2])
    return float(np.percentile(step, 25)) / (0.3186 * math.sqrt(6.0)) if step.size else 0.0


def alike(area: Float64) -> npt.NDArray[np.bool_]:
    """Which blobs are about as large as most; perspective leaves a factor between them."""
    usual = np.median(area) if area.size else math.nan
    return (area > _AREAS[0] * usual) & (area < _AREAS[1] * usual)


def find_scale(grey: Float32) -> Scale:
    """Try windows and both kinds of contrast; most blobs that lie amid symmetric neighbours win."""
    shrink = math.ceil(math.sqrt(grey.size / _TRIAL_PIXELS))
    best = Scale(False, math.nan, math.nan, 0)
    for factor in sorted({shrink, 1}, reverse=True):
        small = shrunk(grey, factor)
        for part in _WINDOWS:
            for bright in (False, True):
                blobs = find_blobs(small, part * min(small.shape), bright, _TRIAL_SMOOTHING)
                trial = _judge(blobs, bright)
                if trial.number > best.number:
                    best = trial._replace(pitch=trial.pitch * factor, cell=trial.cell * factor**2)
                if trial.number > max(_CLEAR_COUNT, _CLEAR_SHARE * len(blobs.area)):
                    return best
        if best.number > _CLEAR_COUNT:
            break
    return best


def _judge(blobs: Blobs, bright: bool) -> Scale:
    """Tell what is usual about those blobs that lie amid symmetric neighbours."""
    points = blobs.points[alike(blobs.area)]
    if not _FEWEST_BLOBS <= len(points) <= _MOST_BLOBS:
        return Scale(bright, math.nan, math.nan, 0)
    bases = local_bases(points, cKDTree(points))
    bases = bases[np.isfinite(bases[:, 0, 0])]
    if len(bases) == 0:
        return Scale(bright, math.nan, math.nan, 0)
    length = np.linalg.norm(bases, axis=-1).max(axis=1)
    return Scale(bright, float(np.median(length)), float(np.median(np.abs(np.linalg.det(bases)))), len(bases))
