"""Range image assembly in float64: planes that are turned and met by rays, written from the geometry's parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpuvision import Status
from gpuvision.ranging.range_image import Limits, RotatingSheet, StraightTransport

_INFORMS = Status.SATURATED | Status.AMBIGUOUS


def rotation(axis: Any, angle: float) -> np.ndarray:
    """Right-handed rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def straight(geometry: StraightTransport, g: np.ndarray, h: np.ndarray, transport: np.ndarray) -> np.ndarray:
    """Points (profiles, samples, 3)."""
    g, h, travelled = (np.asarray(each, np.float64)[..., None] for each in (g, h, transport))
    return (
        np.array(geometry.origin)
        + g * np.array(geometry.g_axis)
        + h * np.array(geometry.h_axis)
        + travelled[:, None] * np.array(geometry.direction)
    )


def rotating(
    geometry: RotatingSheet, position: np.ndarray, transport: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (profiles, samples, 3), n . r signed so that it is positive in front, and whether beyond the fold."""
    profiles, samples = position.shape
    across = np.broadcast_to(np.arange(samples, dtype=np.float64), position.shape)
    pixels = [position.astype(np.float64), across]
    if geometry.along == "columns":
        pixels.reverse()
    pixel = np.stack(pixels, axis=-1)
    folded = np.zeros(position.shape, bool)
    if geometry.lens is not None:
        radius = np.linalg.norm(pixel - geometry.lens.centre, axis=-1)
        folded = radius >= geometry.lens.fold_radius
        pixel = geometry.lens.undistort(pixel)
    rays = np.ones((profiles, samples, 3))
    rays[..., :2] = (pixel - geometry.principal_point_px) / geometry.focal_length_px

    points, facing = np.empty_like(rays), np.empty(position.shape)
    for profile, angle in enumerate(transport.astype(np.float64)):
        normal = rotation(geometry.axis_direction, angle) @ geometry.sheet_normal
        reach = normal @ geometry.axis_point + geometry.sheet_offset
        toward = rays[profile] @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            points[profile] = (reach / toward)[:, None] * rays[profile]
        facing[profile] = toward * np.sign(reach)
    return (points - geometry.scene_origin) @ np.array(geometry.scene_axes).T, facing, folded


def judged(
    points: np.ndarray, given: np.ndarray, unknown: np.ndarray, missed: np.ndarray, folded: np.ndarray, limits: Limits
) -> tuple[np.ndarray, np.ndarray]:
    """Apply the flags: points with NaN, and the status."""
    low, high = np.array(limits).T
    status = given.astype(np.uint8)
    with np.errstate(invalid="ignore"):
        outside = np.any((points < low) | (points > high), axis=-1)
    causes = [
        (unknown, Status.NOT_FINITE),
        (folded, Status.NOT_INVERTIBLE),
        (missed, Status.HORIZON),
        (~np.isfinite(points).all(axis=-1), Status.NOT_FINITE),
        (outside, Status.OUT_OF_RANGE),
    ]
    free = (given & ~np.uint8(_INFORMS)) == 0
    for where, flag in causes:
        status[where & free] |= np.uint8(flag)
        free &= ~where
    return np.where(free[..., None], points, np.nan), status
