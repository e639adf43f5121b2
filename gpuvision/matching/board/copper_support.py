"""Support of a board's pose by the whole image, against the pose that fits second best.

Copper that repeats fits nearly as well a pitch away, or half a pitch away with the other polarity. The rulers of such
a pose agree; the ends of the repetition do not. The copper is drawn in the image at the found pose and correlated with
the image, which gives the best other shift. Both drawings are then compared by the residuals of their fits.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.artwork import Artwork

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

_SAMPLES = 2  # of the drawing, along each side of a pixel
_FRACTION_BITS = 8  # of the corners that OpenCV fills
_TILE_PX = 16  # tiles that err independently of each other. Chosen: wider than the blur and than narrow traces
_STRIP_ROWS = 16 * _TILE_PX
_SEPARATION_PX = 2.5  # least distance of another pose. Chosen: half of the least pitch that an image resolves
# Least correlation of another pose, relative to the correlation at the found pose. Chosen: below it, more than half of
# the variance that the copper explains is gone.
_LEAST_CORRELATION = 0.7


class OtherPose(NamedTuple):
    """Best other pose of a board in an image.

    Attributes
    ----------
    view
        Camera at the other pose.
    distance
        Distance of the board from the found pose [m].
    is_bright
        Whether copper is bright at the other pose.
    preference
        Preference of the image for the found pose [standard deviations]; negative if the other pose fits better.
    """

    view: BoardView
    distance: float
    is_bright: bool
    preference: float


def find_other_pose(
    image: npt.NDArray[Any], artwork: Artwork, view: BoardView, reach: float, blur_px: float, *, is_bright: bool
) -> OtherPose | None:
    """Find the shift of the board that fits the image best besides the found pose, and compare the two.

    Parameters
    ----------
    image
        Undistorted grey image (rows, columns).
    artwork
        Artwork of the side that faces the camera.
    view
        Camera at the found pose.
    reach
        Largest shift along the rows and along the columns [m].
    blur_px
        Standard deviation of the edges' blur [px].
    is_bright
        Whether copper is bright at the found pose.

    Returns
    -------
    OtherPose or None
        None where no other shift has 0.7 of the correlation of the found pose.

    Notes
    -----
    The heading of the found pose is kept. Each drawing is fitted to the image by its contrast, and to first order by a
    shift, a rotation and an etch bias. The preference is the sum over tiles of 16 x 16 px of the difference of the
    squared residuals, divided by the root of the sum of its squares.
    """
    margin = math.ceil(reach / view.scale) + 1
    drawn = _draw_copper(artwork, view, margin, blur_px)
    grey = np.asarray(image, np.float32)
    correlation = np.asarray(cv2.matchTemplate(drawn, grey, cv2.TM_CCOEFF_NORMED), np.float32)
    shift = _best_other_shift(correlation if is_bright else -correlation, margin)
    if shift is None:
        return None
    row, column = shift
    other_bright = bool(correlation[margin + row, margin + column] > 0)
    by_tile = _residuals_of_tiles(drawn, grey, margin, shift, is_bright=other_bright)
    by_tile -= _residuals_of_tiles(drawn, grey, margin, (0, 0), is_bright=is_bright)
    preference = float(by_tile.sum() / max(math.sqrt(float(np.sum(by_tile**2))), np.finfo(float).tiny))
    # Image pixel p corresponds to pixel p + shift of the drawing, so the image centre views that place of the board.
    x, y = view.to_plane(view.centre_px + np.array([column, row]))
    other = replace(view, pose=(float(x), float(y), view.pose[2]))
    return OtherPose(other, math.hypot(row, column) * view.scale, other_bright, preference)


def _draw_copper(artwork: Artwork, view: BoardView, margin: int, blur_px: float) -> Float32:
    """Return the share of copper in each pixel, blurred, in the image with a margin [px] on all sides."""
    rows, columns = (each + 2 * margin for each in view.shape)
    canvas = np.zeros((rows * _SAMPLES, columns * _SAMPLES), np.uint8)
    low, high = np.full(2, -margin - 1.0), np.array(view.shape[::-1]) + float(margin)
    for shape in artwork.copper:
        outlines = [view.to_pixels(each) for each in (shape.outline, *shape.holes)]
        if np.all(outlines[0].max(axis=0) >= low) and np.all(outlines[0].min(axis=0) <= high):
            corners = [
                np.rint((((each + margin + 0.5) * _SAMPLES) - 0.5) * 2**_FRACTION_BITS).astype(np.int32)
                for each in outlines
            ]
            cv2.fillPoly(canvas, corners, 255 if shape.dark else 0, shift=_FRACTION_BITS)
    share = cv2.resize(canvas.astype(np.float32) / 255.0, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(share, (0, 0), blur_px), np.float32)


def _best_other_shift(correlation: Float32, margin: int) -> tuple[int, int] | None:
    """Return the shift (rows, columns) of the largest local maximum of the magnitude besides the centre."""
    magnitude = np.abs(correlation)
    is_peak = magnitude >= cv2.dilate(magnitude, np.ones((3, 3), np.uint8))
    rows, columns = np.indices(correlation.shape) - margin
    is_peak &= np.hypot(rows, columns) >= _SEPARATION_PX
    least = _LEAST_CORRELATION * max(float(correlation[margin, margin]), 0.0)
    magnitude = np.where(is_peak, magnitude, 0.0)
    row, column = np.unravel_index(int(np.argmax(magnitude)), magnitude.shape)
    if not magnitude[row, column] > least:
        return None
    return int(row) - margin, int(column) - margin


def _residuals_of_tiles(
    drawn: Float32, grey: Float32, margin: int, shift: tuple[int, int], *, is_bright: bool
) -> Float64:
    """Return the sum of squared residuals in each tile of the image after the fit of a drawing at a shift.

    The image is taken in strips of rows: the terms of the fit take six times the memory of their pixels.
    """
    rows, columns = grey.shape
    top, left = margin + shift[0], margin + shift[1]
    part = drawn[top : top + rows, left : left + columns] * (1.0 if is_bright else -1.0)
    along, down = (cv2.Scharr(part, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    x = (np.arange(columns, dtype=np.float32) - columns / 2) / columns
    y = (np.arange(rows, dtype=np.float32)[:, None] - rows / 2) / columns
    values = grey - grey.mean()

    def terms(strip: slice) -> Float32:
        """Return the terms of the fit: offset, contrast, shift along x and y, rotation, etch bias."""
        a, d = along[strip], down[strip]
        stacked = np.stack([np.ones_like(a), part[strip], a, d, d * x - a * y[strip], np.hypot(a, d)])
        return stacked.reshape(len(stacked), -1)

    strips = [slice(first, first + _STRIP_ROWS) for first in range(0, rows, _STRIP_ROWS)]
    normal = sum(each @ each.T for each in map(terms, strips))
    moments = sum(terms(strip) @ values[strip].ravel() for strip in strips)
    fitted = np.linalg.lstsq(np.asarray(normal, np.float64), np.asarray(moments, np.float64), rcond=None)[0]
    coefficients = fitted.astype(np.float32)
    return np.concatenate(
        [_sum_tiles((values[strip] - (coefficients @ terms(strip)).reshape(-1, columns)) ** 2) for strip in strips]
    )


def _sum_tiles(values: Float32) -> Float64:
    """Return the sums over the tiles of an image; tiles at the right and at the bottom may be smaller."""
    rows, columns = (np.arange(0, each, _TILE_PX) for each in values.shape)
    return np.asarray(np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1), np.float64)
