"""Pictures of boards, from their artwork: sampled 8 x 8 times in a pixel, then blurred, smeared and noisy."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork import Artwork
from gpuvision.matching.artwork_shapes import Shape, capsule

SAMPLES = 8


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera that looks straight down on a board's top.

    Parameters
    ----------
    corner
        x, y [m] that the first pixel's centre sees: the picture's upper left.
    pixel
        On the board [m].
    shape
        Rows and columns.
    blur_px, motion_px
        Standard deviation of the Gaussian blur, and length of a smear along the rows.
    noise
        Standard deviation [grey levels].
    mask_shift, silk_shift
        x, y [m] by which the mask's openings and the silk are printed off.
    etch
        How far copper is etched beyond its drawn edge [m], to an eighth of a pixel.
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
    etch: float = 0.0
    levels: tuple[float, float, float, float, float, float] = (60.0, 110.0, 90.0, 200.0, 240.0, 15.0)


def board_image(
    artwork: Artwork,
    view: View,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    about: tuple[float, float] = (0.0, 0.0),
    *,
    missing: Collection[int] = (),
    rng: np.random.Generator | None = None,
) -> npt.NDArray[np.float32]:
    """float32 picture of a board that is turned about a point and shifted; of some of its copper areas none is left."""
    painter = _Painter(view, pose, about)
    copper = painter.painted([each for index, each in enumerate(artwork.copper) if index not in missing], (0.0, 0.0))
    if round(view.etch / view.pixel * SAMPLES):
        inside = cv2.distanceTransform(copper.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        copper = inside > view.etch / view.pixel * SAMPLES + 0.5
    opened = painter.painted(artwork.mask, view.mask_shift) if artwork.mask else np.ones_like(copper)
    fine = np.asarray(view.levels, dtype=np.float32)[copper + 2 * opened]
    fine[painter.painted(artwork.silk, view.silk_shift)] = view.levels[4]
    holes = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
    fine[painter.painted([Shape(capsule(start, end, across / 2)) for start, end, across in holes], (0, 0))] = (
        view.levels[5]
    )
    rows, columns = view.shape
    picture = fine.reshape(rows, SAMPLES, columns, SAMPLES).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    picture = cv2.GaussianBlur(picture, (0, 0), view.blur_px, borderType=cv2.BORDER_REPLICATE)
    if view.motion_px > 1:
        smear = _smear(view.motion_px)
        picture = cv2.filter2D(picture, -1, smear, borderType=cv2.BORDER_REPLICATE)
    if rng is not None:
        picture = picture + rng.normal(0, view.noise, picture.shape).astype(np.float32)
    return np.asarray(picture, dtype=np.float32)


def _smear(length: float) -> npt.NDArray[np.float32]:
    half = math.ceil((length - 1) / 2)
    places = np.abs(np.arange(-half, half + 1))
    weights = np.clip(length / 2 - places + 0.5, 0, 1).astype(np.float32)
    return np.asarray((weights / weights.sum())[None])


class _Painter:
    def __init__(self, view: View, pose: tuple[float, float, float], about: tuple[float, float]) -> None:
        self._view, self._about = view, np.array(about)
        self._shift = np.array(pose[:2])
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        self._turn = np.array([[cos, -sin], [sin, cos]])

    def samples(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Column and row of the fine picture, whole at the samples."""
        seen = self._about + (points - self._about) @ self._turn.T + self._shift - self._view.corner
        pixels = seen * (1 / self._view.pixel, -1 / self._view.pixel)
        return np.asarray((pixels + 0.5) * SAMPLES - 0.5)

    def painted(self, shapes: Collection[Shape], shift: tuple[float, float]) -> npt.NDArray[np.bool_]:
        rows, columns = (SAMPLES * each for each in self._view.shape)
        picture = np.zeros((rows, columns), dtype=bool)
        for each in shapes:
            corners = self.samples(each.outline + shift)
            low = np.maximum(np.ceil(corners.min(axis=0)), 0).astype(int)
            high = np.minimum(np.floor(corners.max(axis=0)), (columns - 1, rows - 1)).astype(int)
            if np.all(high >= low):
                inside = _inside(corners - low, int(high[1] - low[1] + 1), int(high[0] - low[0] + 1))
                picture[low[1] : high[1] + 1, low[0] : high[0] + 1][inside] = each.dark
        return picture


def _inside(corners: npt.NDArray[np.float64], rows: int, columns: int) -> npt.NDArray[np.bool_]:
    """Which whole places an odd number of turns of a polygon goes round: crossings to the left of each, in each row."""
    turns = np.zeros((rows, columns + 1), dtype=np.int32)
    for (x, y), (to_x, to_y) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        first, last = max(math.ceil(min(y, to_y)), 0), min(math.ceil(max(y, to_y)) - 1, rows - 1)
        if last < first:
            continue
        line = np.arange(first, last + 1)
        where = x + (line - y) * ((to_x - x) / (to_y - y))
        np.add.at(turns, (line, np.clip(np.ceil(where), 0, columns).astype(int)), 1)
    return np.asarray(np.cumsum(turns[:, :columns], axis=1) % 2 == 1)
