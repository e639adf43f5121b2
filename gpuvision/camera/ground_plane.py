"""A camera on a robot: a pinhole with its lens, above a floor and tilted; pixels to places on the floor and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]

_STEEPEST = 0.5 * math.pi


@dataclass(frozen=True, kw_only=True)
class MountedCamera:
    """A camera above a floor. Its pixels are those of the undistorted image, but for those of `measured`.

    Parameters
    ----------
    height
        Of its centre above the floor [m].
    tilt
        How far it looks below the horizon [rad]; a quarter turn is straight down.
    roll
        How far it is turned clockwise about the direction in which it looks [rad].
    heading
        Of that direction, counter-clockwise from the robot's ahead [rad].
    place
        Where in the robot's frame it is, ahead and to the left [m].
    focal_px
        Focal length [px]; None: of the ``model``, a `Camera`.
    centre_px
        Column, row of the optical axis; None: of the ``model``, a `Camera`; of a `Lens`, its centre.
    model
        The lens; None: the image is free of distortion.

    Raises
    ------
    ValueError
        A number is out of its range, or focal length and centre are not known.
    """

    height: float
    tilt: float
    roll: float = 0.0
    heading: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)
    focal_px: float | None = None
    centre_px: tuple[float, float] | None = None
    model: Lens | Camera | None = None

    def __post_init__(self) -> None:
        if finite(self.height, "MountedCamera.height") <= 0.0:
            raise ValueError(f"MountedCamera.height is {self.height}, expected metres above 0")
        if not abs(finite(self.tilt, "MountedCamera.tilt")) <= _STEEPEST:
            raise ValueError(f"MountedCamera.tilt is {self.tilt} rad, expected a right angle at most")
        for name in ("roll", "heading"):
            finite(getattr(self, name), f"MountedCamera.{name}")
        object.__setattr__(self, "place", numbers(self.place, (2,), "MountedCamera.place"))
        if isinstance(self.model, Camera):
            if self.focal_px is not None or self.centre_px is not None:
                raise ValueError("MountedCamera has a Camera, which knows focal length and centre; leave them out")
            return
        if self.focal_px is None or finite(self.focal_px, "MountedCamera.focal_px") <= 0.0:
            raise ValueError(f"MountedCamera.focal_px is {self.focal_px}, expected pixels above 0")
        if self.centre_px is None and self.model is None:
            raise ValueError("MountedCamera.centre_px is missing: column and row of the optical axis")
        if self.centre_px is not None:
            object.__setattr__(self, "centre_px", numbers(self.centre_px, (2,), "MountedCamera.centre_px"))

    @property
    def matrix(self) -> Float64:
        """3 x 3, of the pinhole [px]."""
        if isinstance(self.model, Camera):
            return np.array(self.model.matrix)
        own = self.model.centre if self.model is not None else (0.0, 0.0)
        column, row = own if self.centre_px is None else self.centre_px
        focal = float(self.focal_px or 0.0)
        return np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> Float64:
        """3 x 3: directions in the robot's frame (ahead, left, up) to the camera's (right, down, ahead)."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        down, level = math.sin(self.tilt), math.cos(self.tilt)
        right = np.array([s, -c, 0.0])
        below = np.array([-down * c, -down * s, -level])
        ahead = np.array([level * c, level * s, -down])
        a, b = math.cos(self.roll), math.sin(self.roll)
        return np.stack([a * right + b * below, a * below - b * right, ahead])

    def floor(self, pixels: npt.ArrayLike) -> Float64:
        """(..., 2) places on the floor that pixels see, in the robot's frame [m]; NaN on the horizon and above."""
        seen = np.concatenate([np.asarray(pixels, np.float64), np.ones((*np.shape(pixels)[:-1], 1))], axis=-1)
        ways = seen @ (np.linalg.inv(self.matrix).T @ self.rotation)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(ways[..., 2:] < -1e-9, self.height / -ways[..., 2:], np.nan)
        return np.asarray(self.place + far * ways[..., :2])

    def pixels(self, places: npt.ArrayLike) -> Float64:
        """(..., 2) column, row that show places on the floor; NaN behind the camera."""
        away = np.asarray(places, np.float64) - self.place
        seen = np.concatenate([away, np.full((*away.shape[:-1], 1), -self.height)], axis=-1) @ self.rotation.T
        depth = np.where(seen[..., 2:] > 0.0, seen[..., 2:], np.nan)
        shown = seen / depth @ self.matrix.T
        return np.asarray(shown[..., :2])

    def measured(self, pixels: npt.ArrayLike) -> Float64:
        """(..., 2) column, row in the image as it was taken, through the lens; NaN where it has none."""
        return np.asarray(pixels, np.float64) if self.model is None else np.asarray(self.model.distort(pixels))
