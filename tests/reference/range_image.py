"""Reference of range image assembly: points of a straight transport and of a rotating sheet, and their status."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.reference.camera import undistort_pixels
from gpuvision.reference.triangulation import is_beyond_fold, undistort

SATURATED, OUT_OF_RANGE, NOT_FINITE, AMBIGUOUS, HORIZON, NOT_INVERTIBLE = 2, 4, 8, 16, 32, 128
_VALUE_KEPT = SATURATED | AMBIGUOUS  # flags under which a point keeps its value

Float64 = NDArray[np.float64]


def rotation(axis: Any, angle: float) -> Float64:
    """Return the matrix of a right-handed rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def points_of_straight_transport(geometry: Any, g: NDArray[Any], h: NDArray[Any], transport: NDArray[Any]) -> Float64:
    """Return the scene points of a part on a straight transport.

    Parameters
    ----------
    geometry : gpuvision.StraightTransport
        Origin, axes of the sheet and direction of the transport.
    g, h : numpy.ndarray
        Coordinates in the sheet [m], (profiles, samples).
    transport : numpy.ndarray
        Travelled distance of each profile [m], (profiles,).

    Returns
    -------
    numpy.ndarray
        (profiles, samples, 3) [m].
    """
    g, h, travelled = (np.asarray(each, np.float64)[..., None] for each in (g, h, transport))
    return np.asarray(
        np.array(geometry.origin)
        + g * np.array(geometry.g_axis)
        + h * np.array(geometry.h_axis)
        + travelled[:, None] * np.array(geometry.direction)
    )


def points_of_bent_sheet(
    geometry: Any, g: NDArray[Any], h: NDArray[Any], transport: NDArray[Any]
) -> tuple[Float64, NDArray[np.bool_]]:
    """Return the scene points at which view rays meet a bent sheet of light, and which rays miss it.

    The intersection is searched along the ray: the first sign change of the distance from the surface on 2000 points
    between the mean plane and 3/4 of the way to the pinhole, on both sides of the plane, then bisection.
    Parameters as for `points_of_straight_transport`.
    """
    g, h = np.asarray(g, np.float64), np.asarray(h, np.float64)
    gg, gh, hh = geometry.bend.terms
    pinhole = np.array(geometry.bend.pinhole)
    start = np.stack([g, h, np.zeros_like(g)], -1)
    way = pinhole - start

    def height_over_surface(share: NDArray[Any]) -> Float64:
        at_g, at_h, d = np.moveaxis(start + share[..., None] * way, -1, 0)
        return np.asarray((d - (gg * at_g**2 + gh * at_g * at_h + hh * at_h**2)) * np.sign(pinhole[2]))

    low, high, found = np.zeros_like(g), np.zeros_like(g), np.zeros(g.shape, bool)
    previous = np.zeros_like(g)
    at_plane = height_over_surface(previous)
    # Below the plane (the surface lies on the side of the pinhole: the distance is negative there) search towards the
    # pinhole, otherwise away from it.
    side = np.where(at_plane < 0.0, 1.0, -1.0)
    for share in np.linspace(0.0, 0.75, 2001)[1:]:
        value = height_over_surface(side * share)
        crossed = ~found & (value * at_plane <= 0.0)
        low, high = np.where(crossed, previous, low), np.where(crossed, side * share, high)
        found |= crossed
        previous = np.where(found, previous, side * share)
    for _ in range(60):
        middle = 0.5 * (low + high)
        same = height_over_surface(middle) * at_plane > 0.0
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    g, h, d = np.moveaxis(start + (0.5 * (low + high))[..., None] * way, -1, 0)
    flat = points_of_straight_transport(geometry, g, h, transport)
    return flat + d[..., None] * np.cross(geometry.g_axis, geometry.h_axis), ~found


def points_of_rotating_sheet(
    geometry: Any, position: NDArray[Any], angles: NDArray[Any]
) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    """Return the scene points at which view rays meet a rotating sheet of light.

    Parameters
    ----------
    geometry : gpuvision.RotatingSheet
        Camera, axis and sheet.
    position : numpy.ndarray
        Position of the line in each profile [px], (profiles, samples).
    angles : numpy.ndarray
        Angle of the sheet at each profile [rad], (profiles,).

    Returns
    -------
    points : numpy.ndarray
        (profiles, samples, 3) [m].
    facing : numpy.ndarray
        Scalar product of the sheet's normal and the ray (x, y, 1), positive where the point is in front of the camera.
    folded : numpy.ndarray
        Whether the pixel lies beyond the fold of the lens, or behind the tilted sensor.
    """
    profiles, samples = position.shape
    across = np.broadcast_to(np.arange(samples, dtype=np.float64), position.shape)
    pixels = [position.astype(np.float64), across]
    if geometry.along == "columns":
        pixels.reverse()
    pixel = np.stack(pixels, axis=-1)
    folded = np.zeros(position.shape, bool)
    if geometry.lens is not None:
        lens = (geometry.lens.k1, geometry.lens.k2, geometry.lens.centre)
        folded = is_beyond_fold(pixel[..., 0], pixel[..., 1], *lens)
        pixel = np.stack(undistort(pixel[..., 0], pixel[..., 1], *lens), axis=-1)
    rays = np.ones((profiles, samples, 3))
    if geometry.camera is None:
        rays[..., :2] = (pixel - geometry.principal_point_px) / geometry.focal_length_px
    else:
        (fx, _, cx), (_, fy, cy), _ = geometry.camera.matrix
        ideal = undistort_pixels(pixel.reshape(-1, 2), geometry.camera.matrix, geometry.camera.distortion)
        folded = np.isnan(ideal[:, 0]).reshape(position.shape)
        rays[..., :2] = (ideal.reshape(pixel.shape) - (cx, cy)) / (fx, fy)

    points, facing = np.empty_like(rays), np.empty(position.shape)
    for profile, angle in enumerate(angles.astype(np.float64)):
        normal = rotation(geometry.axis_direction, angle) @ geometry.sheet_normal
        reach = normal @ geometry.axis_point + geometry.sheet_offset
        toward = rays[profile] @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            points[profile] = (reach / toward)[:, None] * rays[profile]
        facing[profile] = toward * np.sign(reach)
    return np.asarray((points - geometry.scene_origin) @ np.array(geometry.scene_axes).T), facing, folded


def apply_status(
    points: Float64,
    given: NDArray[np.uint8],
    unknown: NDArray[np.bool_],
    missed: NDArray[np.bool_],
    folded: NDArray[np.bool_],
    limits: Any,
) -> tuple[Float64, NDArray[np.uint8]]:
    """Return points, NaN where they are not known, and their status.

    Parameters
    ----------
    points
        (profiles, samples, 3) [m].
    given
        Status of the input; a flag other than SATURATED and AMBIGUOUS makes the point NaN.
    unknown, missed, folded
        Where the input is not finite, the ray misses the sheet, and the lens folds.
    limits
        Smallest and largest x, y and z, (3, 2) [m].
    """
    low, high = np.array(limits).T
    status = given.astype(np.uint8)
    with np.errstate(invalid="ignore"):
        outside = np.any((points < low) | (points > high), axis=-1)
    causes = [
        (unknown, NOT_FINITE),
        (folded, NOT_INVERTIBLE),
        (missed, HORIZON),
        (~np.isfinite(points).all(axis=-1), NOT_FINITE),
        (outside, OUT_OF_RANGE),
    ]
    free = (given & ~np.uint8(_VALUE_KEPT)) == 0
    for where, flag in causes:
        status[where & free] |= np.uint8(flag)
        free &= ~where
    return np.where(free[..., None], points, np.nan), status
