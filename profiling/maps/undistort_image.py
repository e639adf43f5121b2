"""Undistorted images: light of the background that the contrast is over, and distortion of the lens."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.camera import distort_pixels
from gpuvision.reference.undistort_image import undistort

_SIDE = 24  # [px]
_MATRIX = ((30.0, 0.0, 11.5), (0.0, 30.0, 11.5), (0.0, 0.0, 1.0))
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of a pixel over the background and the coefficient k1."""
    axes = Axis("background / contrast", 1e-2, 1e5), Axis("k1", -0.3, 0.3, False)
    return Problem(axes, "contrast", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    column, row = np.meshgrid(np.arange(_SIDE), np.arange(_SIDE))
    pixels = np.stack([column, row], axis=-1).reshape(-1, 2)
    for k1 in np.unique(places[:, 1]):
        chosen = places[:, 1] == k1
        light = places[chosen, 0][:, None, None]
        frames = (light + rng.uniform(0.0, 1.0, (chosen.sum(), _SIDE, _SIDE))).astype(np.float32)
        camera = Camera(matrix=_MATRIX, distortion=(float(k1), *(0.0,) * 13))
        found = np.asarray(UndistortImage(model=camera)(frames, device=device).image, np.float64)
        at = distort_pixels(pixels, _MATRIX, camera.distortion).astype(np.float64).reshape(_SIDE, _SIDE, 2)
        exact, status = undistort(np.moveaxis(frames, 0, -1).astype(np.float64), at)
        inside = (status == 0) & (np.abs(at - 0.5 * (_SIDE - 1)).max(axis=-1) < 0.5 * _SIDE - 1.0)
        errors[chosen] = np.abs(np.moveaxis(exact, -1, 0) - found)[:, inside].max(axis=1)
    return errors


def _bound(places: Floats) -> Floats:
    # Contract of the images: error of the positions in x and y, 1e-5 px and four roundings of 32 px, times a slope of
    # twice the contrast for each pixel; ten roundings of the value.
    slope = 2.0 * 2.0 * (1e-5 + 4.0 * 32.0 * 0.5 * _EPS)
    return np.asarray(slope + 10.0 * 0.5 * _EPS * (places[:, 0] + 1.0))
