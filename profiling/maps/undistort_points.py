"""Undistortion of points: distortion of the lens, and distance of the point from the centre."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.camera import distort_pixels, undistort_pixels

_FOCAL, _CENTRE = 1000.0, (640.0, 512.0)
_MATRIX = ((_FOCAL, 0.0, _CENTRE[0]), (0.0, _FOCAL, _CENTRE[1]), (0.0, 0.0, 1.0))


def problem() -> Problem:
    """Return the error of a point over k1 and the distance of its ideal place from the centre."""
    axes = Axis("k1", -0.6, 0.6, False), Axis("ideal distance from the centre / focal length", 1e-3, 1.0)
    return Problem(axes, "focal length", _errors, _bound)


def _camera(k1: float) -> Camera:
    return Camera(matrix=_MATRIX, distortion=(k1, *13 * (0.0,)))


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.full(len(places), np.nan)
    for k1 in np.unique(places[:, 0]):
        chosen = (places[:, 0] == k1) & (_slope(places) > 0.0)
        camera, radius = _camera(float(k1)), places[chosen, 1]
        angle = rng.uniform(-np.pi, np.pi, len(radius))
        ideal = _CENTRE + _FOCAL * radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        measured = np.asarray(distort_pixels(ideal, camera.matrix, camera.distortion), np.float32)
        found = UndistortPoints(model=camera)(measured, device=device).points
        exact = undistort_pixels(measured, camera.matrix, camera.distortion)
        errors[chosen] = np.linalg.norm((found - exact).astype(np.float64), axis=-1) / _FOCAL
    return errors


def _slope(places: Floats) -> Floats:
    """Return the derivative of the measured radius by the ideal one: 0 at the fold."""
    return np.asarray(1.0 + 3.0 * places[:, 0] * places[:, 1] ** 2)


def _bound(places: Floats) -> Floats:
    k1, radius = places.T
    stretch = 1.0 + k1 * radius**2
    with np.errstate(divide="ignore"):
        # Contract of the undistortion: 1e-6 of the correction over the Jacobian, and half a spacing of each coordinate.
        correction = 1e-6 * np.abs(k1) * radius**3 / np.minimum(_slope(places) * stretch, 1.0)
    return np.where(_slope(places) > 0.0, np.sqrt(2.0) * (correction + 6e-8 * (0.64 + radius)), np.inf)
