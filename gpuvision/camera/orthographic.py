"""How a camera that looks straight at a board, or down at a floor, sees it: places there to pixels and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """A camera that looks straight down on a plane.

    Parameters
    ----------
    scale
        Of a pixel on the plane [m].
    shape
        Rows and columns of the image.
    pose
        Place on the plane that the image's centre sees, x, y [m], and the direction there of the image's columns from
        left to right, theta [rad], counter-clockwise; up in the image is a quarter turn further.
    mirrored
        The plane is seen from behind, as a board's bottom is: columns run against that direction.
    model
        The lens. Pixels of this class are those of the undistorted image, but for those of `measured`.
    """

    scale: float
    shape: tuple[int, int]
    pose: tuple[float, float, float]
    mirrored: bool = False
    model: Lens | Camera | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"the scale is {self.scale}, expected metres per pixel, above 0")
        if len(self.pose) != 3 or not all(math.isfinite(each) for each in self.pose):
            raise ValueError(f"the pose is {self.pose}, expected x, y [m] and theta [rad], finite")

    @property
    def centre_px(self) -> Float64:
        """(2,) column and row of the image's middle."""
        return (np.array(self.shape[::-1], np.float64) - 1) / 2

    @property
    def matrix(self) -> Float64:
        """3 x 3: places on the plane [m] to pixels."""
        x, y, theta = self.pose
        turned = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
        linear = np.diag([-1.0 if self.mirrored else 1.0, -1.0]) / self.scale @ turned
        matrix = np.eye(3)
        matrix[:2, :2] = linear
        matrix[:2, 2] = self.centre_px - linear @ np.array([x, y])
        return matrix

    def pixels(self, places: npt.ArrayLike) -> Float64:
        """(..., 2) column, row [px] of places [m]."""
        matrix = self.matrix
        return np.asarray(np.asarray(places, np.float64) @ matrix[:2, :2].T + matrix[:2, 2])

    def places(self, pixels: npt.ArrayLike) -> Float64:
        """(..., 2) places [m] that pixels see."""
        matrix = self.matrix
        return np.asarray((np.asarray(pixels, np.float64) - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T)

    def measured(self, places: npt.ArrayLike) -> Float64:
        """(..., 2) column, row in the image as it was taken, through the lens; NaN where it has none."""
        pixels = self.pixels(places)
        return pixels if self.model is None else np.asarray(self.model.distort(pixels))

    @property
    def bounds(self) -> Float64:
        """(2, 2) least and greatest x, y [m] of what the undistorted image sees."""
        rows, columns = self.shape
        corners = self.places(np.array([[0, 0], [columns - 1, 0], [0, rows - 1], [columns - 1, rows - 1]]))
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def within(self, places: npt.ArrayLike, margin_px: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether places are in the image as it was taken, a margin [px] from its border."""
        pixels, margin = self.measured(places), np.asarray(margin_px)[..., None]
        with np.errstate(invalid="ignore"):
            inside = (pixels >= margin) & (pixels <= np.array(self.shape[::-1]) - 1 - margin)
        return np.asarray(inside.all(axis=-1))
