"""Where a robot is on a field: a top view of the floor around it, or points on lines, become candidates for its pose.

Rays from the image's middle cross the white lines of the floor; the middles of the stripes along them are points on
lines, and `gpuvision.matching.field.field_pose` finds the poses that fit them.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.image import grey_image
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.recordings import read_image
from gpuvision.matching.field.distance_map import DistanceMap, Field
from gpuvision.matching.field.evidence import Evidence, evidence
from gpuvision.matching.field.field_pose import Candidate, locate
from gpuvision.matching.field.line_detection import FloorScan, least_edge, scan_ahead, scan_top_view
from gpuvision.matching.field.located_robot import LocatedRobot

Float32 = npt.NDArray[np.float32]

POINT_FILES = (".npy", ".csv")
RAYS = 128
_MOST_POINTS = 4096
_FEWEST = 4
_FARTHEST = 12.0  # [m]: further away pixels tell little, and errors of the tilt much
_STARTS = 24  # so many poses are refined
_BY_CHANCE, _MISSING = math.log(1e-3), 1.0 / 3.0
_SMALL_FIELD, _SMALL_LINES, _LARGE_LINES = 5.0, 0.02, 0.125  # [m]: a field's length; a junior's lines, and others'


def locate_robot(
    points: Float32 | FloorScan,
    field: Field,
    *,
    near: tuple[float, float, float] | None = None,
    scale: float | None = None,
    most: int = 6,
    outside: float | None = None,
    device: Device | None = None,
) -> LocatedRobot:
    """Locate a robot on a field by points on its lines.

    Parameters
    ----------
    points
        float32 (points, 2), in the robot's frame: x ahead, y to its left [m]; or what `scan_floor` found: then lines
        that should be seen and are not count, too.
    field
        Its lines.
    near
        About where it is, x, y [m] and heading [rad]: then nothing else is searched.
    scale
        Of the pixels that the points are from [m], for the report.
    most
        Candidates, at most.
    outside
        How far beside the field the robot may be [m]; None: a twentieth of its length.
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Refused is what random points would reach by chance in more than one of a thousand searches; and, of scans, a pose
    at which more of the lines is missing than a third of what it explains of the points (`Evidence.missing`): clutter
    leaves points unexplained, robots in the way hide lines, but the wrong field does both.
    """
    device = Device.best() if device is None else device
    start = time.perf_counter()
    scan = points if isinstance(points, FloorScan) else None
    used = _usable(points.points if isinstance(points, FloorScan) else points)
    kept: dict[str, Any] = {"points": used, "field": field, "scale": scale, "device": device}
    if len(used) < _FEWEST:
        reason = f"{len(used)} points on lines, expected {_FEWEST} or more"
        return LocatedRobot(candidates=(), doubtful=(), evidence=None, reason=reason, seconds={}, **kept)
    size = max(field.length, field.width)
    bend = min(0.25, 0.02 * size)  # a quarter of a metre in a field of 20 m, as the map's own
    beside = 0.05 * size if outside is None else outside
    reach = min(float(np.hypot(*used.T).max()) * 1.001 + bend, 1.5 * size)
    field_map = DistanceMap(field=field, cell=0.4 * bend, scale=bend, reach=reach, outside=beside, device=device)
    mapped = time.perf_counter()
    found = locate(field_map, used, near=near, most=max(most, _STARTS), device=device)
    paths, wide = (None, line_width_of(field)) if scan is None else (scan.paths, scan.line_width)
    looked: dict[str, Any] = {"scale": bend, "reach": reach, "outside": beside if near is None else None}
    weights = [evidence(used, paths, field, each.pose, near=0.5 * wide, **looked) for each in found]
    ordered, weights = _by_weight(found, weights, most)
    reason = _doubt(weights[0] if weights else None, len(used))
    return LocatedRobot(
        candidates=() if reason else ordered,
        doubtful=ordered[:1] if reason else (),
        evidence=weights[0] if weights else None,
        reason=reason,
        seconds={"map": mapped - start, "search": time.perf_counter() - mapped},
        **kept,
    )


def _usable(points: Float32) -> Float32:
    """Return those that are finite; where they are too many, one of every few."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.ascontiguousarray(finite[:: -(-max(len(finite), 1) // _MOST_POINTS)], np.float32)


def _by_weight(
    found: tuple[Candidate, ...], weights: list[Evidence], most: int
) -> tuple[tuple[Candidate, ...], list[Evidence]]:
    """Return candidates by how little is missing that they would show; of those that are alike in that, by score."""
    order = sorted(range(len(found)), key=lambda number: (round(max(weights[number].missing, 0.0), 1), number))[:most]
    place = {number: rank for rank, number in enumerate(order)}
    moved = [found[number] for number in order]
    ordered = [each._replace(twin=None if each.twin is None else place.get(each.twin)) for each in moved]
    return tuple(ordered), [weights[number] for number in order]


def _doubt(best: Evidence | None, count: int) -> str:
    """Return why the best pose is none, or nothing."""
    if best is None:
        return "no pose on the field fits the points; are they in metres, is it this field?"
    if best.chance > _BY_CHANCE:
        return f"{count} points fit the field no better than random ones would; is it a field, are they in metres?"
    if best.missing > _MISSING:
        return (
            f"it does not look like this field: where it fits best, {max(best.seen, 0.0):.0%} of what should be seen "
            f"of its lines is, and {best.on_lines:.0%} of the points are on them; is the scale right?"
        )
    return ""


def read_points(path: Path) -> Float32:
    """Read points (n, 2) [m] of an NPY array, or of a CSV file of two columns.

    Raises
    ------
    OSError
        The file cannot be read.
    RecordingError
        It holds something else.
    """
    try:
        if path.suffix.lower() == ".npy":
            points = np.load(path, allow_pickle=False)
        else:
            points = np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise RecordingError(f"{path}: no points: {error}") from error
    if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: {points.dtype} of shape {points.shape}, expected points (n, 2) in metres")
    return np.ascontiguousarray(points, np.float32)


def white_of(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return how white an image is: the darkest of its three colours, or its grey levels."""
    if image.ndim == 3 and image.shape[2] in (3, 4):
        return grey_image(np.ascontiguousarray(image[:, :, :3].min(axis=2)))
    return grey_image(image)


def line_width_of(field: Field) -> float:
    """Return how wide a field's lines usually are [m]."""
    return _SMALL_LINES if max(field.length, field.width) < _SMALL_FIELD else _LARGE_LINES


def scan_floor(
    image: npt.NDArray[Any],
    *,
    scale: float | None = None,
    line_width: float,
    rays: int = RAYS,
    blind: float = 0.0,
    threshold: float | None = None,
    model: Lens | Camera | MountedCamera | None = None,
    reach: float = _FARTHEST,
    device: Device | None = None,
) -> FloorScan:
    """Find the middles of white stripes on the floor, along rays from the robot's place (and, tilted, across them).

    Parameters
    ----------
    image
        Grey or colour (blue, green, red): the floor from above, the robot in its middle, ahead to the right; or what a
        `MountedCamera` sees.
    scale
        Of a pixel on the floor [m]; a mounted camera has none.
    line_width
        Of the stripes [m].
    rays
        How many, all around.
    blind
        So far from its middle the image shows the robot itself [m].
    threshold
        Least edge [grey levels]; None: 4 times the noise, and a tenth of the image's range.
    model
        The lens, or a camera that is mounted on the robot; None: the image is free of distortion.
    reach
        Of a mounted camera: how far from it lines are looked for [m].
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        Lines are too narrow in the image, it is too small, or a scale is given where it is not known, or none.
    """
    white = white_of(image)
    least = least_edge(white) if threshold is None else threshold
    if isinstance(model, MountedCamera):
        if scale is not None:
            raise ValueError("a mounted camera has no scale: its height and its focal length tell; leave it out")
        return scan_ahead(white, model, line_width=line_width, lines=rays, reach=reach, threshold=least, device=device)
    if scale is None:
        raise ValueError("the scale is missing: how wide a pixel is on the floor [m]")
    return scan_top_view(
        white,
        BoardView(scale=scale, shape=white.shape, pose=(0.0, 0.0, 0.0), model=model),
        line_width=line_width,
        rays=rays,
        blind=blind,
        threshold=least,
        device=device,
    )


def floor_points(image: npt.NDArray[Any], **how: Any) -> Float32:
    """Return the points on lines that `scan_floor` finds, float32 (points, 2) [m]: it says what can be given."""
    return scan_floor(image, **how).points


def read_floor(path: Path) -> npt.NDArray[Any]:
    """Read a top view as `floor_points` takes it.

    Raises
    ------
    RecordingError
        It is no image.
    """
    image = read_image(path)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGRA2BGR) if image.shape[2] == 4 else image
