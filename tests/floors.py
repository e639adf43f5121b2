"""Top views of a field's floor, as a robot over it sees them."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.field_picture import field_lines
from gpuvision.matching.artwork_shapes import capsule
from gpuvision.matching.field_map import Field

_FINE = 4  # samples of a pixel, along each side
_SHIFT = 6  # bits of a fine pixel
GREEN, WHITE = (60.0, 120.0, 40.0), (235.0, 240.0, 238.0)


def floor_image(
    field: Field,
    pose: tuple[float, float, float],
    *,
    scale: float,
    shape: tuple[int, int],
    line_width: float,
    noise: float = 3.0,
    rng: np.random.Generator,
) -> npt.NDArray[np.uint8]:
    """uint8 (rows, columns, 3): blue, green, red; the robot in the middle, heading to the right."""
    rows, columns = (_FINE * each for each in shape)
    white = np.zeros((rows, columns), np.uint8)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    middle = (np.array([columns, rows]) - 1) / 2
    for line in field_lines(field):
        seen = (line - pose[:2]) @ np.array([[c, -s], [s, c]])
        for start, end in itertools.pairwise(seen):
            corners = middle + capsule(start, end, line_width / 2) * (_FINE / scale) * (1, -1)
            cv2.fillPoly(white, [np.rint(corners * 2**_SHIFT).astype(np.int32)], 1, shift=_SHIFT)
    fine = np.where(white[..., None] > 0, np.array(WHITE), np.array(GREEN)).astype(np.float32)
    picture = fine.reshape(shape[0], _FINE, shape[1], _FINE, 3).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
