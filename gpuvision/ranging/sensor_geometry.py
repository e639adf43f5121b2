"""Geometry of a calibrated laser sensor: camera, sheet of light and transport, with their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.pose_response import ray_derivatives
from gpuvision.ranging.sheet_readings import Along
from gpuvision.ranging.sheet_result import SheetFit
from gpuvision.ranging.transport_calibration import TransportFit
from gpuvision.ranging.triangulation import Triangulation

Float64 = npt.NDArray[np.float64]

TRANSPORT_PARAMETERS = ("step_g", "step_h", "step_d")
"""Names of the components of the transport's step along the axes g, h and d = g x h of the sheet [m per profile]."""

# Newton steps from the plane to a bent sheet. Derived: each step squares the error; bends are below 1 % of the range.
_BEND_STEPS = 4


@dataclass(frozen=True, kw_only=True)
class SensorGeometry:
    """Camera, sheet of light and transport of a laser sensor.

    The scene moves with the part. Its y axis is the direction from a profile to the next one, against the movement of
    the part. z is up: towards the camera, perpendicular to y, as near to the sheet's h as possible; or the normal of
    the stage. x completes a right-handed frame. The origin is the origin of the sheet, or a point on the stage.

    Parameters
    ----------
    camera : Camera
        Calibrated camera.
    camera_names : tuple of str
        Parameters of the camera with a covariance.
    camera_covariance : numpy.ndarray
        (m, m): covariance of these parameters.
    sheet : SheetFit
        Sheet of light in the camera's frame.
    transport : TransportFit or None
        Measured transport; None if the part is assumed to move along the sheet's -(g x h).
    step : float
        Transport per profile [m]: measured, or given.
    zero_at_stage : bool
        Whether z = 0 is the plane of the target in the transport views. Default False.
    """

    camera: Camera
    camera_names: tuple[str, ...]
    camera_covariance: Float64
    sheet: SheetFit
    transport: TransportFit | None
    step: float
    zero_at_stage: bool = False

    @cached_property
    def direction(self) -> Float64:
        """Unit vector from a profile to the next one on the part, in the camera's frame.

        The part moves the other way: the sensor is at rest, and the sheet moves over the part.
        """
        return self.sheet.normal if self.transport is None else -self.transport.direction

    @cached_property
    def scene_axes(self) -> Float64:
        """Axes x, y, z of the scene in the camera's frame: the rows of the rotation from camera to scene."""
        y = self.direction
        up = self.sheet.h_axis
        if self.zero_at_stage and self.transport is not None:
            up = self.transport.normal * np.sign(self.transport.normal @ up)
        z = up - (up @ y) * y
        z = z / np.linalg.norm(z)
        return np.stack([np.cross(y, z), y, z])

    @cached_property
    def scene_origin(self) -> Float64:
        """Origin of the scene in the camera's frame [m]."""
        if not self.zero_at_stage or self.transport is None:
            return self.sheet.origin
        z = self.scene_axes[2]
        return np.asarray(self.sheet.origin + ((self.transport.middle - self.sheet.origin) @ z) * z)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of `covariance`: camera, sheet, then the transport if it was measured."""
        return (*self.camera_names, *self.sheet.names, *(() if self.transport is None else TRANSPORT_PARAMETERS))

    @cached_property
    def covariance(self) -> Float64:
        """Joint covariance of camera, sheet and transport, in the order of `names`.

        Sheet and transport correlate by the error of the camera. With a stepped block both also contain the noise of
        the pose of the first transport view; the covariance leaves this correlation out.
        """
        m, parts = len(self.camera_names), [np.eye(len(self.camera_names)), self.sheet.by_camera]
        noises = [np.zeros((m, m)), self.sheet.noise_covariance]
        if self.transport is not None:
            to_sheet = np.stack([self.sheet.g_axis, self.sheet.h_axis, self.sheet.normal])
            parts.append(to_sheet @ self.transport.by_camera)
            noises.append(to_sheet @ self.transport.noise_covariance @ to_sheet.T)
        by_camera = np.concatenate(parts)
        total: Float64 = by_camera @ self.camera_covariance @ by_camera.T
        first = 0
        for each in noises:
            total[first : first + len(each), first : first + len(each)] += each
            first += len(each)
        return total

    def in_sheet(self, points: npt.ArrayLike) -> Float64:
        """Return (G, H) [m] of points (..., 3) in the camera's frame."""
        offset = np.asarray(points) - self.sheet.origin
        return np.asarray(offset @ np.stack([self.sheet.g_axis, self.sheet.h_axis]).T)

    def points(self, pixels: npt.ArrayLike) -> Float64:
        """Return the points (..., 3) [m] of the sheet in the camera's frame that measured pixels (..., 2) see.

        For a bent sheet Newton's method from the plane; three steps reach the rounding for bends far below the
        distance of the camera.
        """
        ray = self.camera.rays(pixels)
        normal = self.sheet.normal
        point = ray * ((self.sheet.origin @ normal) / (ray @ normal))[..., None]
        if self.sheet.bend is None:
            return np.asarray(point)
        for _ in range(_BEND_STEPS):
            distance, slope = self._surface(point)
            point = point - ray * (distance / np.sum(ray * slope, axis=-1))[..., None]
        return np.asarray(point)

    def derivatives(self, pixels: npt.ArrayLike) -> Float64:
        """Return the derivatives (n, 3, p) of `points` of measured pixels (n, 2) by camera and sheet.

        The parameters are the first p of `names`. With a part C of `covariance` for them and the noise of the readings,
        the covariance of a point is ``D C D'`` plus the noise.
        """
        points = self.points(pixels)
        ray = points / np.linalg.norm(points, axis=-1, keepdims=True)
        slope = self._surface(points)[1]
        steep = np.sum(ray * slope, axis=-1)[:, None, None]
        change = ray_derivatives(self.camera, self.camera_names, pixels)
        by_camera = change - ray[:, :, None] * (np.einsum("ni,nim->nm", slope, change)[:, None] / steep)
        g, h = self.in_sheet(points).T
        surface = np.stack([np.ones_like(g), g, h, g * g, g * h, h * h], axis=1)[:, : len(self.sheet.names)]
        by_sheet = ray[:, :, None] * surface[:, None] / steep
        return np.concatenate([np.linalg.norm(points, axis=-1)[:, None, None] * by_camera, by_sheet], axis=2)

    def scale_sigma(self, pixels: npt.ArrayLike) -> tuple[float, float]:
        """Return the relative standard deviations of the scales of heights and of lateral lengths by the calibration.

        Parameters
        ----------
        pixels : array_like
            (n, 2): measured (column, row) over the calibrated part of the image, such as readings.

        Returns
        -------
        height, lateral : float
            Relative standard deviation of all heights, along the sheet's h axis, and that of lengths over the part such
            that the relative standard deviation of an area is twice as large. All points share these errors.

        Notes
        -----
        The errors of the points by each parameter are fitted by linear functions of G and H; the slopes of the errors
        of G along G and of H along H are errors of scale. With a measured transport its step scales y. The pitch of the
        target is taken as exact: its relative error adds to both.
        """
        seen = np.asarray(pixels, dtype=np.float64)
        axes, slopes = np.stack([self.sheet.g_axis, self.sheet.h_axis]), self.derivatives(seen)
        known = np.isfinite(slopes).all(axis=(1, 2))
        errors = np.einsum("ij,njp->inp", axes, slopes[known])
        g, h = self.in_sheet(self.points(seen[known])).T
        design = np.stack([np.ones_like(g), g, h], axis=1)
        (_, along_g, _), (_, _, along_h) = (np.linalg.lstsq(design, each, rcond=None)[0] for each in errors)
        scales = np.zeros((2, len(self.covariance)))
        scales[0, : len(along_h)] = along_h
        scales[1, : len(along_g)] = 0.5 * along_g
        if self.transport is not None:
            to_sheet = np.stack([self.sheet.g_axis, self.sheet.h_axis, self.sheet.normal])
            scales[1, -3:] = 0.5 * (to_sheet @ self.transport.direction) / self.step
        height, lateral = np.sqrt(np.einsum("ip,pq,iq->i", scales, self.covariance, scales))
        return float(height), float(lateral)

    def triangulation(self, size: tuple[int, int], along: Along, pixels: npt.ArrayLike) -> Triangulation:
        """Return the triangulation to the mean plane of the sheet, with the covariance of its parameters.

        Parameters
        ----------
        size : (int, int)
            Columns and rows of a frame.
        along : {"columns", "rows"}
            Image axis along which the laser line runs.
        pixels : array_like
            (n, 2): measured (column, row) over the calibrated part of the image, such as readings. Pixels past the
            fold of the lens have no viewing ray, and are left out.

        Notes
        -----
        A shift or a rotation of all points (G, H) in the sheet is no error of a sensor: the covariance leaves it out.
        The eight parameters express the errors of focal length, tilt and sheet. The part of the errors of the lens
        that they cannot express is added to the offsets, with its mean square over the pixels.
        """
        v, u = ((0.0, each - 1.0) for each in (size if along == "columns" else size[::-1]))
        sheet = Triangulation.from_camera(
            self.camera,
            origin=self.sheet.origin,
            g_axis=self.sheet.g_axis,
            h_axis=self.sheet.h_axis,
            region=(u, v),
            along=along,
        )
        seen = np.asarray(pixels, dtype=np.float64)
        axes, slopes = np.stack([self.sheet.g_axis, self.sheet.h_axis]), self.derivatives(seen)
        known = np.isfinite(slopes).all(axis=(1, 2))
        seen, slopes = seen[known], slopes[known]
        errors = np.einsum("ij,njp->nip", axes, slopes).reshape(2 * len(seen), -1)
        g, h = self.in_sheet(self.points(seen)).T
        one, none = np.ones_like(g), np.zeros_like(g)
        rigid = np.stack([[one, none], [none, one], [-h, g]]).transpose(2, 1, 0).reshape(-1, 3)
        errors = errors - rigid @ np.linalg.lstsq(rigid, errors, rcond=None)[0]
        design = sheet.parameter_derivatives(seen[:, ::-1] if along == "columns" else seen).reshape(-1, 8)
        moved = np.linalg.lstsq(design, errors, rcond=None)[0]
        rest = (errors - design @ moved).reshape(len(seen), 2, -1)
        covariance = self.covariance[: errors.shape[1], : errors.shape[1]]
        total = moved @ covariance @ moved.T
        total[[0, 3], [0, 3]] += np.einsum("nip,pq,niq->i", rest, covariance, rest) / len(seen)
        rows = tuple(tuple(row) for row in (0.5 * (total + total.T)).tolist())
        return replace(sheet, covariance=rows)

    def _surface(self, points: Float64) -> tuple[Float64, Float64]:
        """Return the distances of points (..., 3) from the sheet along its normal, and their gradients (..., 3)."""
        gg, gh, hh = self.sheet.bend or (0.0, 0.0, 0.0)
        g, h = np.moveaxis(self.in_sheet(points), -1, 0)
        distance = (points - self.sheet.origin) @ self.sheet.normal - (gg * g * g + gh * g * h + hh * h * h)
        slope = self.sheet.normal - (2.0 * gg * g + gh * h)[..., None] * self.sheet.g_axis
        return distance, slope - (gh * g + 2.0 * hh * h)[..., None] * self.sheet.h_axis
