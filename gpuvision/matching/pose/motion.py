"""Motions in the plane: homographies, rotations, known edges under a motion, composition with a measured pose.

A motion is a (2, 3) matrix that maps points, relative to the placement point, to their measured positions: its first
two columns are the linear part, its last column is the measured position of the placement point.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


class KnownEdges(NamedTuple):
    """Edges that an image should show: (n, 2) points and their (n, 2) unit normals.

    The sign of a normal matters only where an etch bias is solved for.
    """

    point: Float64
    normal: Float64


def apply_homography(matrix: Float64, points: Float64) -> Float64:
    """Return where a 3 x 3 homography takes points (..., 2)."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


def rotation(angle: float) -> Float64:
    """Return the 2 x 2 rotation by an angle [rad], counter-clockwise from x to y."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def move_edges(edges: KnownEdges, motions: list[Float64], placement: tuple[float, float]) -> KnownEdges:
    """Return the edges under each motion, (k, n, 2) points and unit normals."""
    motion = np.stack(motions)
    linear = motion[..., :2]
    normal = edges.normal @ np.linalg.inv(linear)
    point = (edges.point - placement) @ linear.swapaxes(1, 2) + motion[:, None, :, 2]
    return KnownEdges(point, normal / np.hypot(normal[..., 0], normal[..., 1])[..., None])


def project_edges(
    edges: KnownEdges, motions: list[Float64], placement: tuple[float, float], to_image: Float64
) -> tuple[Float64, Float64]:
    """Return points [px] and unit normals of the edges in the image under each motion, (k, n, 2) each.

    The tangent of an edge is taken to the image by the derivative of the homography at its point; the normal is at
    right angles to it there.
    """
    moved = np.zeros((len(motions), 3, 3))
    moved[:, :2], moved[:, 2, 2] = motions, 1.0
    # Rows of the homographies, with arrays of x and of y: products with small matrices, and np.hypot, take longer.
    rows = (to_image @ moved)[..., None]
    (px, py), (nx, ny) = (edges.point - placement).T, edges.normal.T
    x, y, w = (rows[:, k, 0] * px + rows[:, k, 1] * py + rows[:, k, 2] for k in range(3))
    # The tangent is (-ny, nx).
    along_x, along_y, along_w = (rows[:, k, 1] * nx - rows[:, k, 0] * ny for k in range(3))
    x, y = x / w, y / w
    u, v = (along_y - y * along_w) / w, (x * along_w - along_x) / w
    length = np.sqrt(u * u + v * v)
    return np.stack([x, y], axis=-1), np.stack([u / length, v / length], axis=-1)


def compose(motion: Float64, pose: npt.ArrayLike, deformation: npt.ArrayLike) -> Float64:
    """Return a motion followed by a pose (3,) with a deformation (3,), both about the measured placement point."""
    x, y, theta = np.asarray(pose, np.float64)
    kx, ky, shear = np.asarray(deformation, np.float64)
    linear = rotation(theta) @ np.array([[1.0 + kx, shear], [0.0, 1.0 + ky]])
    return np.column_stack([linear @ motion[:, :2], motion[:, 2] + (x, y)])


def decompose(motion: Float64, placement: tuple[float, float]) -> tuple[Float64, Float64]:
    """Return the pose of the origin (3,), x, y, theta, and the deformation (3,): scales less 1, and shear."""
    linear = motion[:, :2]
    theta = math.atan2(linear[1, 0], linear[0, 0])
    bent = rotation(theta).T @ linear
    pose = np.array([*(motion[:, 2] - linear @ placement), theta])
    return pose, np.array([bent[0, 0] - 1, bent[1, 1] - 1, bent[0, 1]])
