"""Simulated views of a robot's field: from above, and through a tilted camera."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.matching.artwork.shapes import capsule
from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.evidence import Crossings, robot_to_field
from gpuvision.plots.field import field_lines

_FINE = 4  # samples along each side of a pixel
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
    """Return a top view, uint8 (rows, columns, 3: blue, green, red); the robot in the middle heads to the right."""
    rows, columns = (_FINE * each for each in shape)
    white = np.zeros((rows, columns), np.uint8)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    middle = (np.array([columns, rows]) - 1) / 2
    for line in field_lines(field):
        seen = (line - pose[:2]) @ np.array([[c, -s], [s, c]])
        for start, end in itertools.pairwise(seen):
            corners = middle + capsule(start, end, line_width / 2) * (_FINE / scale) * (1, -1)
            cv2.fillPoly(white, [np.rint(corners * 2**_SHIFT).astype(np.int32)], 1, shift=_SHIFT)
    share = cv2.resize(white.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)[..., None]
    picture = (np.array(GREEN) + share * (np.array(WHITE) - GREEN)).astype(np.float32)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def carpet_of(field: Field, line_width: float, pixel: float = 0.01, margin: float = 3.0) -> npt.NDArray[np.float32]:
    """Return the whiteness, 0 to 1, of a field and its surroundings from above, x to the right and y up."""
    columns, rows = (math.ceil((size + 2.0 * margin) / pixel) for size in (field.length, field.width))
    white = np.zeros((rows, columns), np.uint8)
    for line in field_lines(field):
        for start, end in itertools.pairwise(line):
            corners = capsule(start, end, line_width / 2) / pixel * (1, -1) + (np.array([columns, rows]) - 1) / 2
            cv2.fillPoly(white, [np.rint(corners * 2**_SHIFT).astype(np.int32)], 255, cv2.LINE_AA, _SHIFT)
    return (white / 255).astype(np.float32)


def seen_ahead(
    carpet: npt.NDArray[np.float32],
    camera: MountedCamera,
    pose: tuple[float, float, float],
    *,
    shape: tuple[int, int],
    pixel: float = 0.01,
    noise: float = 3.0,
    samples: int = 5,
    rng: np.random.Generator,
) -> npt.NDArray[np.uint8]:
    """Return the view of a carpet through a tilted camera and its lens, uint8 (rows, columns), by ray tracing."""
    pixels = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(np.float64)
    ideal = pixels if camera.model is None else camera.model.undistort(pixels)
    down, across = np.gradient(ideal, axis=0), np.gradient(ideal, axis=1)
    middle = (np.array(carpet.shape[::-1]) - 1) / 2
    total = np.zeros(shape)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    for a, b in itertools.product(offsets, offsets):
        at = robot_to_field(camera.to_floor(ideal + a * across + b * down), pose) / pixel * (1, -1) + middle
        at = np.where(np.isfinite(at), at, -9.0).clip(-9.0, 1e5).astype(np.float32)
        total += cv2.remap(carpet, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    grey = cv2.GaussianBlur(60.0 + 170.0 * total / samples**2, (0, 0), 0.7) + rng.normal(0, noise, shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def detected_fraction(crossings: Crossings, points: npt.NDArray[np.float32], tolerance: float) -> float:
    """Return the share of the crossings with a point within ``tolerance`` [m] of the line."""
    away = np.hypot(*(points - crossings.places[:, None]).T).min(axis=0)
    return float(np.mean(away * crossings.sines <= tolerance))
