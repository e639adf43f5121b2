"""Simulated images of boards from their artwork: 8 x 8 samples per pixel, blurred, then resampled for many poses."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Shape, area, capsule

Float64 = npt.NDArray[np.float64]

SAMPLES = 8
FINE = 4  # stored values per pixel side
# Eight rows of samples are shifted by multiples of 1/8 sample, in this order, and eight columns likewise: an edge along
# a row or a column then crosses a pixel at 64 different places instead of 8.
_ASIDE = (np.array([0, 4, 2, 6, 1, 5, 3, 7]) + 0.5) / SAMPLES


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera that looks straight down on a board's top.

    Parameters
    ----------
    corner
        x, y [m] at the centre of the first pixel (upper left).
    pixel Size on the board [m]. shape
        Rows and columns.
    blur_px, motion_px
        Standard deviation of the Gaussian blur, and length of a smear along the rows.
    noise
        Standard deviation [grey levels].
    mask_shift, silk_shift
        x, y [m] Displacement of the mask openings and of the silk.
    etch_bias
        Distance from the drawn edge to the copper's edge [m]: > 0 for under-etched copper, < 0 for over-etched.
    levels
        Grey levels of laminate and copper under the mask, laminate and copper in its openings, silk, holes.
    """

    corner: tuple[float, float]
    pixel: float
    shape: tuple[int, int]
    blur_px: float = 1.0
    motion_px: float = 0.0
    noise: float = 0.0
    mask_shift: tuple[float, float] = (0.0, 0.0)
    silk_shift: tuple[float, float] = (0.0, 0.0)
    etch_bias: float = 0.0
    levels: tuple[float, float, float, float, float, float] = (60.0, 110.0, 90.0, 200.0, 240.0, 15.0)

    @property
    def edge_blur_px(self) -> float:
        """Standard deviation of an edge's blur without motion blur, including the extent of a pixel."""
        return math.hypot(self.blur_px, math.sqrt(1 / 12))


class BoardPicture:
    """Image of a board, rendered once: images with other small motions and noise take a millisecond.

    Parameters
    ----------
    artwork, view
        Board and camera.
    pose, about
        x, y [m] and theta [rad] of the board, rotated about a point [m].
    missing
        Numbers of the copper areas that are missing.
    more
        Areas that are drawn over the copper: splashes (dark), and scratches (not dark).
    growths
        Additional displacement of the edges of each copper area beyond ``view.etch_bias`` [m].
    margin
        Pixels outside the image that motions may move into it.
    """

    def __init__(
        self,
        artwork: Artwork,
        view: View,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        about: tuple[float, float] = (0.0, 0.0),
        *,
        missing: Collection[int] = (),
        more: Sequence[Shape] = (),
        growths: npt.ArrayLike = 0.0,
        margin: int = 12,
    ) -> None:
        self.view, self._pose, self._about, self._margin = view, pose, np.array(about), margin
        painter = _Painter(view, pose, about, margin)
        each = np.broadcast_to(np.asarray(growths, np.float64) + view.etch_bias, len(artwork.copper))
        left = [
            Shape(
                grown(shape.outline, etch_bias if shape.dark else -etch_bias),
                shape.dark,
                tuple(grown(each, -etch_bias if shape.dark else etch_bias) for each in shape.holes),
            )
            for index, (shape, etch_bias) in enumerate(zip(artwork.copper, each, strict=True))
            if index not in missing
        ]
        copper = painter.painted([*left, *more], (0.0, 0.0))
        opened = painter.painted(artwork.mask, view.mask_shift) if artwork.mask else np.ones_like(copper)
        surface = copper.view(np.uint8) + 2 * opened.view(np.uint8)  # index of the grey level
        holes = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
        drilled = [Shape(capsule(start, end, across / 2)) for start, end, across in holes]
        for level, shapes, shift in ((4, artwork.silk, view.silk_shift), (5, drilled, (0.0, 0.0))):
            if shapes:
                surface[painter.painted(shapes, shift)] = level
        levels = np.zeros(256, np.float32)
        levels[: len(view.levels)] = view.levels
        rows, columns = painter.shape
        # The mean of the samples of a stored value.
        fine = cv2.resize(cv2.LUT(surface, levels), (columns * FINE, rows * FINE), interpolation=cv2.INTER_AREA)
        along, across = (_blurs(view.blur_px, smear) for smear in (view.motion_px, 0.0))
        self._fine = cv2.sepFilter2D(fine, -1, along, across, borderType=cv2.BORDER_REPLICATE)

    def seen(
        self, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), rng: np.random.Generator | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the float32 image after a further small motion about the same point; with rng, add noise."""
        view, per = self.view, FINE / self.view.pixel
        # From image pixels to the board, back by the motion, to the rendered values.
        away = np.array(view.corner) - self._about - self._pose[:2] - pose[:2]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        back = np.array([[cos, sin], [-sin, cos]])
        flip = np.array([1.0, -1.0])
        matrix = back * flip * flip[:, None] * FINE
        first = (back @ away + self._about + self._pose[:2] - view.corner) * flip * per
        offset = first + (self._margin + 0.5) * FINE - 0.5
        warp = np.concatenate([matrix, offset[:, None]], axis=1)
        picture = cv2.warpAffine(
            self._fine,
            warp,
            view.shape[::-1],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        if rng is not None:
            picture = picture + np.float32(view.noise) * rng.standard_normal(picture.shape, dtype=np.float32)
        return np.asarray(picture, dtype=np.float32)


def board_image(
    artwork: Artwork,
    view: View,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    about: tuple[float, float] = (0.0, 0.0),
    *,
    missing: Collection[int] = (),
    rng: np.random.Generator | None = None,
) -> npt.NDArray[np.float32]:
    """Return a float32 image of a board that is rotated about a point and shifted; some copper areas are missing."""
    return BoardPicture(artwork, view, pose, about, missing=missing).seen(rng=rng)


def grown(outline: Float64, by: float) -> Float64:
    """Return the corners of an outline with sides displaced outwards [m]; sharp corners move at most twice as far."""
    if by == 0.0:
        return outline
    kept = outline[np.any(outline != np.roll(outline, 1, axis=0), axis=1)]
    side = np.roll(kept, -1, axis=0) - kept
    out = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    out *= 1.0 if area(kept) > 0 else -1.0
    corner = out + np.roll(out, 1, axis=0)
    return np.asarray(kept + by * corner / np.maximum(np.sum(corner**2, axis=1) / 2, 0.5)[:, None])


def _blurs(blur_px: float, smear_px: float) -> npt.NDArray[np.float32]:
    """Return the filters of Gaussian blur, pixel extent and motion blur for the rendered values."""
    reach = math.ceil(4 * blur_px * FINE)
    places = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (places / (blur_px * FINE)) ** 2)
    for width in (FINE, smear_px * FINE):
        if width > 0:
            half = math.ceil((width - 1) / 2)
            kernel = np.convolve(kernel, np.clip(width / 2 + 0.5 - np.abs(np.arange(-half, half + 1)), 0, 1))
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


class _Painter:
    def __init__(self, view: View, pose: tuple[float, float, float], about: tuple[float, float], margin: int) -> None:
        self.shape = (view.shape[0] + 2 * margin, view.shape[1] + 2 * margin)
        self._view, self._about, self._margin = view, np.array(about), margin
        self._shift = np.array(pose[:2])
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        self._turn = np.array([[cos, -sin], [sin, cos]])

    def samples(self, points: Float64) -> Float64:
        """Return points in samples from the upper left corner of the image, to the right and down."""
        seen = self._about + (points - self._about) @ self._turn.T + self._shift - self._view.corner
        pixels = seen * (1 / self._view.pixel, -1 / self._view.pixel)
        return np.asarray((pixels + 0.5 + self._margin) * SAMPLES)

    def _slanted(self, points: Float64) -> Float64:
        """Return points in samples, descending by one sample every eighth column."""
        corners = self.samples(points)
        corners[:, 1] += self.shape[1] - corners[:, 0] / SAMPLES
        return corners

    def painted(self, shapes: Collection[Shape], shift: tuple[float, float]) -> npt.NDArray[np.bool_]:
        """Return which samples a shape covers, (rows, columns).

        A row of samples descends by one sample every eighth column: the columns of each pixel are moved up again.
        """
        rows, columns = (SAMPLES * each for each in self.shape)
        slanted = np.zeros((rows + self.shape[1], columns), dtype=bool)
        for each in shapes:
            straight = self.samples(each.outline + shift)
            if not (np.all(straight.max(axis=0) > 0) and np.all(straight.min(axis=0) < (columns, rows))):
                continue
            corners = self._slanted(each.outline + shift)
            low = np.maximum(np.floor(corners.min(axis=0)) - 1, 0).astype(int)
            high = np.minimum(np.ceil(corners.max(axis=0)) + 1, slanted.shape[::-1]).astype(int)
            if np.all(high > low):
                inside = _inside(corners, low, high)
                for hole in each.holes:
                    inside &= ~_inside(self._slanted(hole + shift), low, high)
                slanted[low[1] : high[1], low[0] : high[0]][inside] = each.dark
        picture = np.empty((rows, columns), dtype=bool)
        for column in range(self.shape[1]):
            span = slice(SAMPLES * column, SAMPLES * (column + 1))
            first = self.shape[1] - column
            picture[:, span] = slanted[first : first + rows, span]
        return picture


def _inside(corners: Float64, low: npt.NDArray[np.int64], high: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return which samples are inside a polygon by the odd-even rule: crossings to the left of each, in each row."""
    columns, rows = high - low
    line = np.arange(low[1], high[1])
    shift = _ASIDE[line % SAMPLES]
    height = line + (0.5 - shift) / SAMPLES + 0.0
    x, y = corners.T
    to_x, to_y = np.roll(corners, -1, axis=0).T
    first = np.searchsorted(height, np.minimum(y, to_y), side="right")
    count = np.searchsorted(height, np.maximum(y, to_y), side="right") - first
    side = np.repeat(np.arange(len(x)), count)
    row = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    where = x[side] + (height[row] - y[side]) * ((to_x - x)[side] / (to_y - y)[side])
    turns = np.zeros((rows, columns + 1), dtype=np.uint8)
    at = np.clip(np.ceil(where - shift[row]) - low[0], 0, columns).astype(int)
    np.add.at(turns, (row, at), 1)
    return np.asarray(np.bitwise_xor.accumulate(turns[:, :columns] & 1, axis=1), dtype=bool)
