"""Rendered target patterns behind a lens (dot grids, chessboards, line grids), with their true points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens

Float64 = npt.NDArray[np.float64]
_SUPERSAMPLING = 4


@dataclass(frozen=True)
class View:
    """Camera in front of a target; ``homography`` maps target coordinates [pitches] to undistorted pixels."""

    width: int
    height: int
    homography: Float64
    lens: Lens

    def pixels(self, pattern: Float64) -> Float64:
        """Return measured (column, row) of points (..., 2) on the target."""
        return self.lens.distort(_mapped(self.homography, pattern))

    def pattern(self, pixels: Float64) -> Float64:
        return _mapped(np.linalg.inv(self.homography), self.lens.undistort(pixels))

    def nodes(self, rows: int, columns: int) -> Float64:
        """Return the true points (rows, columns, 2) of a grid whose first node is (0, 0)."""
        return self.pixels(np.stack(np.meshgrid(np.arange(float(columns)), np.arange(float(rows))), axis=-1))


def _mapped(homography: Float64, points: Float64) -> Float64:
    xyw = points @ homography[:, :2].T + homography[:, 2]
    return xyw[..., :2] / xyw[..., 2:]


def view(
    size: tuple[int, int],
    rows: int,
    columns: int,
    pitch: float,
    *,
    turn: float = 0.0,
    tilt: float = 0.0,
    towards: float = 0.3,
    focal: float = 2.0,
    barrel: float = 0.0,
    mirrored: bool = False,
) -> View:
    """Return a view of a grid in the middle of the image: rotated in the plane, tilted about an axis in it, with a
    lens.

    ``pitch`` in pixels, angles in degrees (``towards`` in radians), ``focal`` in widths, ``barrel`` in pixels that a
    point at the corner moves.
    """
    width, height = size
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    angle, slope = np.radians([turn, tilt])
    shift = np.array([[1, 0, -(columns - 1) / 2], [0, 1, -(rows - 1) / 2], [0, 0, 1]], dtype=float)
    plane = np.diag([-1.0 if mirrored else 1.0, 1.0])
    plane = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ plane * pitch
    axis = np.array([np.cos(towards), np.sin(towards)])
    # A tilt shortens lengths along the direction and reduces the scale of the far side.
    shorten = np.eye(2) + (np.cos(slope) - 1.0) * np.outer(axis, axis)
    perspective = np.eye(3)
    perspective[:2, :2] = shorten
    perspective[2, :2] = np.sin(slope) * axis / (focal * width)
    lay = np.eye(3)
    lay[:2, :2] = plane
    place = np.array([[1, 0, centre[0]], [0, 1, centre[1]], [0, 0, 1]])
    corner = np.hypot(*centre)
    lens = Lens(k1=barrel / corner**3, centre=(centre[0] + 0.01 * width, centre[1] - 0.02 * height))
    return View(width, height, place @ perspective @ lay @ shift, lens)


def _length(vectors: Float64) -> Float64:
    """Return the lengths of vectors (..., 2); faster than a reduction along the short last axis."""
    return np.asarray(np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2))


def _rendered(camera: View, inside: Callable[[Float64], Float64]) -> Float64:
    """Return the covered fraction of every pixel; ``inside`` is a signed distance in pitches (below 0: inside)."""
    cover = np.empty((camera.height, camera.width))
    block = max(1, 2_000_000 // camera.width)
    for start in range(0, camera.height, block):
        y, x = np.mgrid[start : min(start + block, camera.height), 0 : camera.width].astype(float)
        at = camera.pattern(np.stack([x, y], axis=-1))
        down, across = np.gradient(at, axis=(0, 1))
        reach = np.maximum(_length(across), _length(down))
        distance = inside(at)
        part = (distance < 0).astype(float)
        edge = np.abs(distance) < reach
        offsets = (np.arange(_SUPERSAMPLING) + 0.5) / _SUPERSAMPLING - 0.5
        at, across, down, reach = at[edge], across[edge], down[edge], reach[edge]
        total = np.zeros(len(reach))
        for dx in offsets:
            for dy in offsets:
                sample = inside(at + dx * across + dy * down)
                total += np.clip(0.5 - sample * _SUPERSAMPLING / reach, 0.0, 1.0)
        part[edge] = total / _SUPERSAMPLING**2
        cover[start : start + block] = part
    return cover


def dots(camera: View, present: npt.NDArray[np.bool_], radius: float = 0.25) -> Float64:
    """Return the fraction of every pixel that dots cover; ``present`` (rows, columns) selects the dots drawn."""
    rows, columns = present.shape

    def inside(at: Float64) -> Float64:
        nearest = np.rint(np.nan_to_num(at, nan=-9.0)).astype(int)
        j, i = np.clip(nearest[..., 0], 0, columns - 1), np.clip(nearest[..., 1], 0, rows - 1)
        distance = _length(at - np.stack([j, i], axis=-1)) - radius
        return np.where(present[i, j] & np.isfinite(distance), distance, 1.0)

    return _rendered(camera, inside)


def chessboard(camera: View, inner: tuple[int, int]) -> Float64:
    """Return the fraction of every pixel that dark squares cover; inner corners (columns, rows) lie at integers."""
    columns, rows = inner

    def inside(at: Float64) -> Float64:
        at = np.nan_to_num(at, nan=-99.0)
        column, row = np.floor(at).astype(int).T
        parity = ((column + row) % 2 == 0).T
        away = np.abs(at - np.rint(at))
        distance = np.minimum(away[..., 0], away[..., 1])
        squares = np.where(parity, -distance, distance)
        border = np.abs(at + 0.5 - 0.5 * np.array([columns, rows])) - 0.5 * np.array([columns + 1, rows + 1])
        return np.maximum(squares, np.maximum(border[..., 0], border[..., 1]))

    return _rendered(camera, inside)


def line_grid(camera: View, rows: int, columns: int, width: float = 0.15, end: float = 0.5) -> Float64:
    """Return the fraction of every pixel that lines cover: at integers, ending ``end`` pitches off the grid."""

    def inside(at: Float64) -> Float64:
        at = np.nan_to_num(at, nan=-99.0)
        last = np.array([columns - 1, rows - 1])
        off = np.abs(at - np.clip(np.rint(at), 0, last)) - 0.5 * width
        beyond = np.maximum(-at, at - last) - end
        return np.minimum(np.maximum(off[..., 0], beyond[..., 1]), np.maximum(off[..., 1], beyond[..., 0]))

    return _rendered(camera, inside)


def photo(
    cover: Float64,
    rng: np.random.Generator,
    *,
    dark: bool = True,
    contrast: float = 180.0,
    blur: float = 0.8,
    noise: float = 1.8,
    shade: float = 0.0,
    dtype: type = np.uint8,
) -> npt.NDArray[np.generic]:
    """Return an image of a pattern: illumination falling by ``shade`` towards a corner, blur, noise, grey levels."""
    height, width = cover.shape
    y, x = np.mgrid[0:height, 0:width]
    light = 1.0 - shade * (x / width + y / height) / 2
    level = 40.0 + contrast * (1.0 - cover if dark else cover)
    image = cv2.GaussianBlur(level * light, (0, 0), blur) if blur else level * light
    image = image + rng.normal(0.0, noise, image.shape)
    if dtype == np.uint8:
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if dtype == np.uint16:
        return np.clip(np.rint(image * 200), 0, 65535).astype(np.uint16)
    return image.astype(dtype)


def matched(found: Float64, truth: Float64) -> tuple[tuple[int, int], Float64]:
    """Return the true index (row, column) of the first point found, and the errors (rows, columns, 2) at that shift.

    A point outside the true grid has an infinite error.
    """
    i, j = np.argwhere(np.isfinite(found[..., 0]))[len(found) // 2]
    distance = np.linalg.norm(truth - found[i, j], axis=-1)
    row, column = np.unravel_index(np.nanargmin(distance), distance.shape)
    start = (int(row - i), int(column - j))
    errors = np.full_like(found, np.inf)
    rows, columns = truth.shape[:2]
    for a in range(found.shape[0]):
        for b in range(found.shape[1]):
            if 0 <= a + start[0] < rows and 0 <= b + start[1] < columns:
                errors[a, b] = found[a, b] - truth[a + start[0], b + start[1]]
    errors[~np.isfinite(found[..., 0])] = np.nan
    return start, errors
