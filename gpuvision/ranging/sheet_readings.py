"""Readings of a laser line on known planes: points of the sheet of light, and a first plane through them.

The viewing ray of each reading meets the plane of its target. A robust plane of all points gives the frame in which
`gpuvision.ranging.sheet_calibration.fit_sheet` starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.pose_response import PoseResponse, ray_derivatives

Along = Literal["columns", "rows"]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class SheetLimits:
    """Thresholds of `fit_sheet`.

    Attributes
    ----------
    significance : float
        p-value of the F test below which the sheet is bent; as for the lens models. Default 0.001.
    min_readings : int
        Fewest readings of a view that are used: they must show a line. The readings of shorter lines count as outliers.
        Default 16.
    trials : int
        Number of random triples of readings that the robust start tries. Derived: with 30 % outliers the chance that
        every triple has an outlier is 0.66^200 < 1e-36. Default 200.
    max_iterations : int
        Largest number of steps of the robust fit and of the final fit. Default 30.
    noise_floor_px : float
        Least noise of a reading [px] that is assumed: real lines are not read better. Default 1e-4.
    max_scatter_px : float
        Robust standard deviation of the readings about the sheet [px] above which they show no sheet. Chosen: real
        lines are read within a pixel; a laser image in a wrong pose is off by many. Default 2.0.
    min_spread : float
        Ratio of the second to the first principal extent of the points below which all lines coincide: a plane needs
        targets at different distances. Default 0.02.
    """

    significance: float = 0.001
    min_readings: int = 16
    trials: int = 200
    max_iterations: int = 30
    noise_floor_px: float = 1e-4
    max_scatter_px: float = 2.0
    min_spread: float = 0.02


DEFAULT_LIMITS = SheetLimits()


class LaserLine(NamedTuple):
    """Readings of the laser line on one target.

    Attributes
    ----------
    points : numpy.ndarray
        (n, 2): measured (column, row) of the line [px].
    target : PoseResponse
        Pose of the target (its plane is Z = 0), the covariance of the pose, and its derivative by the camera. Lines
        with the same object share its error.
    height : numpy.ndarray or float
        (n,) or one number: height of the lit surface over the target's plane, towards the camera [m]. Default 0; a
        stepped block on the plane has other heights.
    """

    points: Float64
    target: PoseResponse
    height: Float64 | float = 0.0


class SheetFrame(NamedTuple):
    """Frame of the sheet: origin and axes g, h (rows of ``axes``: g, h, normal)."""

    origin: Float64
    axes: Float64

    def moved(self, change: Float64) -> SheetFrame:
        """Return the frame whose plane is d = offset + slope_g G + slope_h H of this frame."""
        offset, slope_g, slope_h = change[:3]
        g, h, n = self.axes
        normal = n - slope_g * g - slope_h * h
        normal /= np.linalg.norm(normal)
        along = g - (g @ normal) * normal
        along /= np.linalg.norm(along)
        return SheetFrame(self.origin + offset * n, np.stack([along, np.cross(normal, along), normal]))


@dataclass(frozen=True, kw_only=True)
class SheetReadings:
    """Readings of all views, and derivatives of their points.

    ``ray`` are unit viewing directions, ``slope`` the change of a ray by a pixel across the line, and ``by_camera`` the
    change of a ray by the camera's parameters. ``view`` is the number of the line. ``targets`` are the poses without
    repetition, and ``pose`` is the number of the pose of each line: lines on one pose share its error.
    """

    lines: tuple[LaserLine, ...]
    view: npt.NDArray[np.intp]
    targets: tuple[PoseResponse, ...]
    pose: tuple[int, ...]
    ray: Float64
    slope: Float64
    by_camera: Float64
    point: Float64
    normal: Float64
    along: Float64
    weight: Float64


def triangulate(
    camera: Camera, lines: Sequence[LaserLine], along: Along, names: tuple[str, ...], limits: SheetLimits
) -> SheetReadings:
    """Intersect the viewing rays of all readings with their target's plane.

    Parameters
    ----------
    camera, lines, along, names, limits
        As in `gpuvision.ranging.sheet_calibration.fit_sheet`.

    Returns
    -------
    SheetReadings
        Readings without a viewing ray, or of a line that is too short, have the weight 0.

    Raises
    ------
    ValueError
        The line was read on fewer than two targets.
    """
    used = [each for each in lines if len(each.points) >= limits.min_readings]
    if len(used) < 2 and not any(np.ptp(each.height) > 0.0 for each in used):
        raise ValueError(
            f"the laser line was read on {len(used)} targets, expected two at least, at different distances"
        )
    pixels = np.concatenate([each.points for each in lines])
    view = np.repeat(np.arange(len(lines)), [len(each.points) for each in lines])
    across = np.array([0.0, 0.5]) if along == "columns" else np.array([0.5, 0.0])
    ray = camera.rays(pixels)
    normal = np.stack([each.target.pose.rotation[:, 2] for each in lines])[view]
    place = np.stack([each.target.pose.translation for each in lines])[view]
    height = np.concatenate([np.broadcast_to(each.height, len(each.points)) for each in lines])
    reach = np.sum(normal * place, axis=1)
    distance = (reach - np.sign(reach) * height) / np.sum(normal * ray, axis=1)
    slope = camera.rays(pixels + across) - camera.rays(pixels - across)
    by_camera = ray_derivatives(camera, names, pixels)
    # Past the fold of the lens a pixel has no ray; next to the fold its derivatives are missing.
    known = np.isfinite(distance) & (distance > 0.0)
    known &= np.isfinite(slope).all(axis=1) & np.isfinite(by_camera).all(axis=(1, 2))
    known &= np.array([len(each.points) >= limits.min_readings for each in lines])[view]
    targets = {id(each.target): each.target for each in lines}
    return SheetReadings(
        lines=tuple(lines),
        view=view,
        targets=tuple(targets.values()),
        pose=tuple(list(targets).index(id(each.target)) for each in lines),
        ray=ray,
        slope=slope,
        by_camera=by_camera,
        point=ray * distance[:, None],
        normal=normal,
        along=pixels[:, 0 if along == "columns" else 1],
        weight=known.astype(np.float64),
    )


def robust_plane(readings: SheetReadings, limits: SheetLimits) -> SheetFrame:
    """Return a plane by least median of squares over random triples of points.

    Parameters
    ----------
    readings : SheetReadings
        Readings with their points.
    limits : SheetLimits
        Number of triples, and least extent of the points.

    Returns
    -------
    SheetFrame
        Axes: the principal axes of the points near the plane.

    Raises
    ------
    ValueError
        All points lie on one line.

    References
    ----------
    P. J. Rousseeuw, Least median of squares regression, J. American Statistical Association 79 (1984) 871.
    """
    points = readings.point[readings.weight > 0.0]
    random = np.random.default_rng(0)
    triples = points[np.stack([random.permutation(len(points))[:3] for _ in range(limits.trials)])]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    some = points[:: max(len(points) // 1000, 1)]
    distances = np.abs(some @ normals.T - np.sum(normals * triples[:, 0], axis=1))
    best = int(np.argmin(np.median(distances, axis=0)))
    inside = some[distances[:, best] <= 3.0 * np.median(distances[:, best]) + np.finfo(float).tiny]
    middle = inside.mean(axis=0)
    _, extents, axes = np.linalg.svd(inside - middle, full_matrices=False)
    if extents[1] < limits.min_spread * extents[0]:
        raise ValueError(
            "all laser lines lie on one line in space, so that the sheet is not determined; move or tilt the target "
            "between the images"
        )
    return SheetFrame(middle, axes)


def turn_to_image(frame: SheetFrame, readings: SheetReadings) -> SheetFrame:
    """Turn g along the samples of the image and h towards the camera; the normal is g x h.

    Parameters
    ----------
    frame : SheetFrame
        Frame with any axes in the plane.
    readings : SheetReadings
        Readings with their samples.

    Returns
    -------
    SheetFrame
        The same plane with the axes of `sheet_axes`.
    """
    inside = readings.weight > 0.0
    axes = sheet_axes(frame.origin, frame.axes, readings.point[inside], readings.along[inside])
    return SheetFrame(frame.origin, axes)


def sheet_axes(origin: Float64, axes: Float64, points: Float64, sample: Float64) -> Float64:
    """Return the axes g, h and g x h of a plane: g along the samples of the image, h towards the camera.

    Parameters
    ----------
    origin : numpy.ndarray
        (3,): point of the plane in the camera's frame [m].
    axes : numpy.ndarray
        (3, 3): two unit vectors in the plane and the normal.
    points : numpy.ndarray
        (n, 3): points near the plane [m].
    sample : numpy.ndarray
        (n,): place of each point along the laser line in the image [px].

    Returns
    -------
    numpy.ndarray
        (3, 3): the axes as rows.
    """
    flat = (points - origin) @ axes[:2].T
    # G is the direction in the sheet in which the sample number grows fastest.
    growth = np.linalg.lstsq(flat - flat.mean(axis=0), sample - sample.mean(), rcond=None)[0]
    g = growth @ axes[:2]
    g /= np.linalg.norm(g)
    h = np.cross(axes[2], g)
    h = h if h @ origin < 0.0 else -h
    return np.stack([g, h, np.cross(g, h)])
