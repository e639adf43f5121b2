"""Local magnification of a lens: ratio of measured to undistorted distances in an image."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens

_GRID = 17  # samples along each side of an image: the magnification of a lens varies over many pixels


def largest_magnification(model: Lens | Camera, shape: tuple[int, int]) -> float:
    """Return the largest ratio of a measured to an undistorted distance in an image, at least 1.

    Derivatives are differences over 1 px, on a grid of 17 x 17 undistorted pixels. Pixels past the fold of the lens
    have no image and are left out.

    Parameters
    ----------
    model : Lens or Camera
        Lens model in pixels.
    shape : (int, int)
        Rows and columns of the image.
    """
    rows, columns = (np.linspace(0.0, size - 1.0, _GRID) for size in shape)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    ahead, backward = (
        np.stack([model.distort(pixels + step) for step in half * np.eye(2)], axis=-1) for half in (0.5, -0.5)
    )
    jacobian = ahead - backward
    known = np.isfinite(jacobian).all(axis=(-2, -1))
    return float(np.linalg.norm(jacobian[known], ord=2, axis=(-2, -1)).max(initial=1.0))
