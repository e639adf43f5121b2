"""Distortion terms of OpenCV's camera model, in normalised coordinates; see `gpuvision.camera.camera`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gpuvision.camera.fold import InvertibleRegion, invertible_region
from gpuvision.camera.newton import determinant, invert_displacement

Float64 = npt.NDArray[np.float64]

# Factor on the largest squared distorted radius of the sampled fold points: the fold of a decentred lens can lie
# farther out between the sampled directions.
_FOLD_SAMPLING = 1.05


@dataclass(frozen=True, kw_only=True)
class LensTerms:
    """Distortion by a lens and a tilted sensor.

    All points (..., 2) are normalised: pixels minus the principal point, divided by the focal length.

    Parameters
    ----------
    coefficients : sequence of 14 floats
        `Camera.distortion`.
    """

    coefficients: tuple[float, ...]

    @property
    def radial(self) -> tuple[float, ...]:
        """k1 .. k6."""
        return (*self.coefficients[:2], *self.coefficients[4:8])

    @property
    def tangential(self) -> tuple[float, ...]:
        """p1, p2."""
        return self.coefficients[2:4]

    @property
    def prism(self) -> tuple[float, ...]:
        """s1 .. s4."""
        return self.coefficients[8:12]

    @property
    def is_decentred(self) -> bool:
        """Whether the distortion is not symmetric about the principal point."""
        return any(self.tangential) or any(self.prism)

    @cached_property
    def invertible_region(self) -> InvertibleRegion:
        """Region of ideal points before the fold."""
        return invertible_region(self.radial, self.tangential, self.prism)

    @cached_property
    def max_distorted_square(self) -> float:
        """Squared normalised radius beyond which no distorted point lies."""
        with np.errstate(all="ignore"):
            edge = self.invertible_region.edge
            square = np.sum((edge + self.displacement(edge)[0]) ** 2, axis=-1)
        return (
            float(np.max(square)) * (_FOLD_SAMPLING if self.is_decentred else 1.0)
            if np.isfinite(square).all()
            else math.inf
        )

    @cached_property
    def tilt(self) -> Float64:
        """Homography (3, 3) of the tilt, normalised to a last element of 1; it maps the origin to itself."""
        (cos_x, cos_y), (sin_x, sin_y) = np.cos(self.coefficients[12:]), np.sin(self.coefficients[12:])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_x, sin_x], [0.0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0.0, -sin_y], [0.0, 1.0, 0.0], [sin_y, 0.0, cos_y]])
        rotation = about_y @ about_x
        r = rotation[2, 2]
        projection = np.array([[r, 0.0, -rotation[0, 2]], [0.0, r, -rotation[1, 2]], [0.0, 0.0, 1.0]])
        tilt: Float64 = projection @ rotation / r
        # These elements are 0 up to rounding.
        tilt[:2, 2] = 0.0
        return tilt

    @cached_property
    def untilt(self) -> Float64:
        """Inverse of `tilt`."""
        return np.asarray(np.linalg.inv(self.tilt), dtype=np.float64)

    def displacement(self, points: Float64) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
        """Return displacements, Jacobians and invertibility at normalised ideal points, as `newton.Displacement`."""
        q = np.sum(points**2, axis=-1, keepdims=True)
        k1, k2, k3, k4, k5, k6 = self.radial
        (p1, p2), (s1, s2, s3, s4) = self.tangential, self.prism
        under = q * (k4 + q * (k5 + q * k6))
        stretch = (q * (k1 + q * (k2 + q * k3)) - under) / (1.0 + under)
        slope = k1 + q * (2.0 * k2 + 3.0 * q * k3) - (1.0 + stretch) * (k4 + q * (2.0 * k5 + 3.0 * q * k6))
        slope = slope / (1.0 + under)
        e = stretch + 2.0 * points @ np.array([[p2], [p1]])
        e_slope = 2.0 * (slope * points + np.array([p2, p1]))
        second = np.array([s2, s4])
        decentring = np.array([p2 + s1, p1 + s3]) + second * q
        jacobian = (1.0 + e)[..., None] * np.eye(2) + points[..., :, None] * e_slope[..., None, :]
        jacobian += 2.0 * (decentring + second * q)[..., :, None] * points[..., None, :]
        inside = (q[..., 0] < self.invertible_region.limit) & (determinant(jacobian) > 0.0)
        return points * e + q * decentring, jacobian, inside

    def distort(self, points: Float64) -> Float64:
        """Return the images of ideal points on an untilted sensor; NaN past the fold."""
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            move, _, inside = self.displacement(points)
            return np.where(inside[..., None], points + move, np.nan)

    def measure(self, points: Float64) -> Float64:
        """Return the measured points of ideal ones; NaN past the fold or behind the tilted sensor."""
        return apply_tilt(self.tilt, self.distort(points))

    def undistort(self, measured: Float64) -> Float64:
        """Return the ideal points of measured ones: the inverse of `measure`; NaN past the fold."""
        return invert_displacement(self.displacement, apply_tilt(self.untilt, measured))

    def jacobian(self, ideal: Float64) -> Float64:
        """Return d(measured) / d(ideal), (..., 2, 2), at ideal points."""
        _, lens, _ = self.displacement(ideal)
        depth = 1.0 + self.distort(ideal) @ self.tilt[2, :2]
        tilt = (self.tilt[:2, :2] - self.measure(ideal)[..., :, None] * self.tilt[2, :2]) / depth[..., None, None]
        return np.asarray(tilt @ lens)


def apply_tilt(tilt: Float64, points: Float64) -> Float64:
    """Map points through a homography that keeps the origin; NaN behind the plane."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        w = 1.0 + points @ tilt[2, :2]
        return np.asarray(points @ tilt[:2, :2].T / np.where(w > 0.0, w, np.nan)[..., None])
