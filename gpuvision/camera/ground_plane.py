"""Camera mounted on a robot above a floor: pixels to floor positions and back (inverse perspective mapping)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]

_RIGHT_ANGLE = 0.5 * math.pi
# Downward component of a unit-depth viewing direction, at and below which a pixel shows the horizon or the sky.
_HORIZON = 1e-9


@dataclass(frozen=True, kw_only=True)
class MountedCamera:
    """Pinhole camera with a lens, at a known height and orientation above a floor.

    Pixel coordinates refer to the undistorted image, except for the result of `distort`.

    Parameters
    ----------
    height : float
        Height of the pinhole above the floor [m], above 0.
    tilt : float
        Angle of the viewing direction below the horizon [rad], -pi/2 to pi/2; pi/2 looks straight down.
    roll : float
        Clockwise rotation of the camera about its viewing direction [rad]. Default 0.
    heading : float
        Counter-clockwise angle from the robot's forward direction to the viewing direction [rad]. Default 0.
    position : (float, float)
        Position of the camera in the robot's frame, forward and to the left [m]. Default (0, 0).
    focal_px : float, optional
        Focal length [px], above 0. Required unless ``model`` is a `Camera`.
    centre_px : (float, float), optional
        Column and row of the principal point [px]. Default: the centre of ``model``.
    model : Lens or Camera, optional
        Lens distortion. A `Camera` also gives focal length and principal point. Default: no distortion.

    Raises
    ------
    ValueError
        A number is out of its range, the focal length or the centre is missing, or both ``model`` and ``focal_px`` or
        ``centre_px`` give them.
    """

    height: float
    tilt: float
    roll: float = 0.0
    heading: float = 0.0
    position: tuple[float, float] = (0.0, 0.0)
    focal_px: float | None = None
    centre_px: tuple[float, float] | None = None
    model: Lens | Camera | None = None

    def __post_init__(self) -> None:
        if finite(self.height, "MountedCamera.height") <= 0.0:
            raise ValueError(f"MountedCamera.height is {self.height}, expected metres above 0")
        if not abs(finite(self.tilt, "MountedCamera.tilt")) <= _RIGHT_ANGLE:
            raise ValueError(f"MountedCamera.tilt is {self.tilt} rad, expected a right angle at most")
        for name in ("roll", "heading"):
            finite(getattr(self, name), f"MountedCamera.{name}")
        object.__setattr__(self, "position", numbers(self.position, (2,), "MountedCamera.position"))
        if isinstance(self.model, Camera):
            if self.focal_px is not None or self.centre_px is not None:
                raise ValueError("MountedCamera.model is a Camera, which gives focal_px and centre_px; leave them out")
            return
        if self.focal_px is None or finite(self.focal_px, "MountedCamera.focal_px") <= 0.0:
            raise ValueError(f"MountedCamera.focal_px is {self.focal_px}, expected pixels above 0")
        if self.centre_px is None and self.model is None:
            raise ValueError("MountedCamera.centre_px is missing: column and row of the optical axis")
        if self.centre_px is not None:
            object.__setattr__(self, "centre_px", numbers(self.centre_px, (2,), "MountedCamera.centre_px"))

    @property
    def matrix(self) -> Float64:
        """Camera matrix (3, 3) of the pinhole [px]."""
        if isinstance(self.model, Camera):
            return np.array(self.model.matrix)
        centre = self.model.centre if self.model is not None else (0.0, 0.0)
        column, row = centre if self.centre_px is None else self.centre_px
        focal = float(self.focal_px or 0.0)
        return np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> Float64:
        """Rotation (3, 3) from the robot's frame (forward, left, up) to the camera's (right, down, forward)."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        down, level = math.sin(self.tilt), math.cos(self.tilt)
        right = np.array([s, -c, 0.0])
        below = np.array([-down * c, -down * s, -level])
        ahead = np.array([level * c, level * s, -down])
        a, b = math.cos(self.roll), math.sin(self.roll)
        return np.stack([a * right + b * below, a * below - b * right, ahead])

    def to_floor(self, pixels: npt.ArrayLike) -> Float64:
        """Intersect the viewing rays of undistorted pixels with the floor.

        Parameters
        ----------
        pixels : array_like
            (..., 2): column, row [px].

        Returns
        -------
        numpy.ndarray
            (..., 2) float64: floor positions in the robot's frame, forward and left [m]; NaN on and above the horizon.
        """
        homogeneous = np.concatenate([np.asarray(pixels, np.float64), np.ones((*np.shape(pixels)[:-1], 1))], axis=-1)
        rays = homogeneous @ (np.linalg.inv(self.matrix).T @ self.rotation)
        with np.errstate(divide="ignore", invalid="ignore"):
            length = np.where(rays[..., 2:] < -_HORIZON, self.height / -rays[..., 2:], np.nan)
        return np.asarray(self.position + length * rays[..., :2])

    def to_pixels(self, positions: npt.ArrayLike) -> Float64:
        """Project floor positions (..., 2) [m] of the robot's frame to undistorted pixels (..., 2); NaN behind it."""
        offset = np.asarray(positions, np.float64) - self.position
        points = np.concatenate([offset, np.full((*offset.shape[:-1], 1), -self.height)], axis=-1) @ self.rotation.T
        depth = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        projected = points / depth @ self.matrix.T
        return np.asarray(projected[..., :2])

    def distort(self, pixels: npt.ArrayLike) -> Float64:
        """Measured (column, row) of undistorted pixels (..., 2), through the lens; NaN past the fold of the lens."""
        return np.asarray(pixels, np.float64) if self.model is None else np.asarray(self.model.distort(pixels))
