"""View of a plane (board or floor) by a camera perpendicular to it: plane coordinates to pixels and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """Similarity between a plane and the image of a camera perpendicular to it.

    Pixel coordinates refer to the undistorted image, except for the result of `to_measured_pixels`.

    Parameters
    ----------
    scale : float
        Size of a pixel on the plane [m], above 0.
    shape : (int, int)
        Rows and columns of the image.
    pose : (float, float, float)
        x, y [m]: the point of the plane at the image's centre. theta [rad]: counter-clockwise angle from the plane's x
        axis to the direction of increasing columns. Decreasing rows point a quarter turn further.
    mirrored : bool
        The camera sees the plane from behind, as a board's bottom side: columns decrease along theta. Default False.
    model : Lens or Camera, optional
        Lens distortion. Default: none.

    Raises
    ------
    ValueError
        The scale or the pose is out of its range.
    """

    scale: float
    shape: tuple[int, int]
    pose: tuple[float, float, float]
    mirrored: bool = False
    model: Lens | Camera | None = None

    def __post_init__(self) -> None:
        finite(self.scale, "BoardView.scale [m/px]", above=0.0)
        numbers(self.pose, (3,), "BoardView.pose (x [m], y [m], theta [rad])")

    @property
    def centre_px(self) -> Float64:
        """Column and row (2,) of the image's centre [px]."""
        return (np.array(self.shape[::-1], np.float64) - 1) / 2

    @property
    def matrix(self) -> Float64:
        """Homogeneous transform (3, 3) from plane coordinates [m] to pixels."""
        x, y, theta = self.pose
        rotation = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
        linear = np.diag([-1.0 if self.mirrored else 1.0, -1.0]) / self.scale @ rotation
        matrix = np.eye(3)
        matrix[:2, :2] = linear
        matrix[:2, 2] = self.centre_px - linear @ np.array([x, y])
        return matrix

    def to_pixels(self, points: npt.ArrayLike) -> Float64:
        """Return undistorted (column, row) of points (..., 2) on the plane [m]."""
        matrix = self.matrix
        return np.asarray(np.asarray(points, np.float64) @ matrix[:2, :2].T + matrix[:2, 2])

    def to_plane(self, pixels: npt.ArrayLike) -> Float64:
        """Return plane coordinates (..., 2) [m] of undistorted pixels (..., 2)."""
        matrix = self.matrix
        return np.asarray((np.asarray(pixels, np.float64) - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T)

    def to_measured_pixels(self, points: npt.ArrayLike) -> Float64:
        """Return measured (column, row) of points (..., 2) on the plane [m], through the lens; NaN past its fold."""
        pixels = self.to_pixels(points)
        return pixels if self.model is None else np.asarray(self.model.distort(pixels))

    @property
    def bounds(self) -> Float64:
        """Smallest and largest x, y (2, 2) [m] in the undistorted image's field of view."""
        rows, columns = self.shape
        corners = self.to_plane(np.array([[0, 0], [columns - 1, 0], [0, rows - 1], [columns - 1, rows - 1]]))
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def contains(self, points: npt.ArrayLike, margin_px: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return whether points (..., 2) on the plane [m] lie in the measured image, a margin [px] off its border."""
        pixels, margin = self.to_measured_pixels(points), np.asarray(margin_px)[..., None]
        with np.errstate(invalid="ignore"):
            inside = (pixels >= margin) & (pixels <= np.array(self.shape[::-1]) - 1 - margin)
        return np.asarray(inside.all(axis=-1))
