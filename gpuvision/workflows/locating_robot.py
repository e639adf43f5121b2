"""Locate a robot on a field: from a top view of the floor, or from points on lines, to candidates for its pose.

Rays from the image's centre cross the white lines of the floor. The centres of the stripes are points on lines;
`gpuvision.matching.field.field_pose` finds the poses that fit them.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.4.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
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
from gpuvision.host import Device, StepDevices
from gpuvision.host.array_files import read_array
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_files import read_image
from gpuvision.host.reading import reading
from gpuvision.matching.field.distance_map import DistanceMap, Field
from gpuvision.matching.field.evidence import Evidence, evidence
from gpuvision.matching.field.field_pose import PoseCandidate, find_pose_candidates
from gpuvision.matching.field.line_detection import FloorScan, default_threshold, scan_tilted_view, scan_top_view
from gpuvision.matching.field.located_robot import LocatedRobot
from gpuvision.matching.field.point_scale import PointScale, point_scale
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.validation import finite, integer

Float32 = npt.NDArray[np.float32]

POINT_FILES = (".npy", ".csv")
RAYS = 128  # default number of rays of a scan (chosen: speed against points on lines)
_MAX_POINTS = 4096  # of `FieldPoseSearch`
# Scale of a point's cost: the default of `DistanceMap` [m]; on small fields this fraction of the field (chosen).
_MAX_COST_SCALE, _COST_SCALE = 0.25, 0.02
_CELL = 0.4  # cell of the distance map, as a fraction of the cost scale: 0.1 m for 0.25 m (chosen: memory and time)
_MARGIN = 0.05  # default width of the border around the field, as a fraction of the field's length (chosen)
_MAX_DIAGONAL = 1.5  # range of the map in lengths of the field; the diagonal of a field is at most sqrt(2) lengths
# Default range of a mounted camera [m]: farther away pixels resolve little and errors of the tilt grow (chosen).
_MAX_RANGE = 12.0
# Step of the directions of a mounted camera in the key of kept times [rad]: the count of rulers changes little within
# one (chosen).
_DIRECTION_STEP = math.pi / 32
# Fields shorter than the first number [m] have lines of the second width, others of the third (RoboCup rules).
_SMALL_FIELD, _SMALL_LINES, _LARGE_LINES = 5.0, 0.02, 0.125


@dataclass(frozen=True, kw_only=True)
class RobotLimits:
    """Thresholds of the localization of a robot.

    Parameters
    ----------
    min_points
        Least number of points on lines: one more than unknowns. Default 4.
    max_log_nfa
        Largest accepted `Evidence.log_nfa`: natural logarithm of the expected number of false alarms per search
        (chosen: one in a thousand searches).
    max_missing
        Largest accepted `Evidence.missing` (chosen; tests with wrong fields and clutter confirm it).
    max_missing_thinned, min_share, min_least_seen
        A larger `Evidence.missing`, up to the first number, is accepted where the image is only thinned out by clutter:
        at least ``min_share`` of the points are on lines, at least as many of the expected lines are seen, and of the
        line that is seen least (`Evidence.least_seen`) at least ``min_least_seen`` (chosen; tests with 30 % of the
        points replaced, and with wrong fields, confirm it). Defaults 0.7, 0.55 and 0.25.
    min_refined
        Least number of poses of the search grid that are refined (chosen: cost against the chance to miss the best
        one). Default 24.
    scale_significance
        Error of the scale of the points that is significant [standard deviations] (chosen: one right view in 16 000).
        Default 4.0.
    min_scale_gain
        A significant error counts as not determined where it brings fewer points to lines than this multiple of the
        square root of their number: clutter then determines the scale (measured on 4000 simulated views with up to half
        of their points in clutter: of 87 wrong errors of a right scale 5 remain, of 661 right errors of 3 to 5 % 567).
        Default 0.5.
    max_scale_error, max_scan_scale_error
        Largest accepted error of the scale of points, and of the points of a scan, where it is significant. A larger
        limit for scans (chosen: a camera whose tilt is wrong by a quarter of a degree changes the distances by up to
        5 %, and missing lines refuse larger errors, too). Defaults 0.02 and 0.05.
    """

    min_points: int = 4
    max_log_nfa: float = math.log(1e-3)
    max_missing: float = 1.0 / 3.0
    max_missing_thinned: float = 0.7
    min_share: float = 0.55
    min_least_seen: float = 0.25
    min_refined: int = 24
    scale_significance: float = 4.0
    min_scale_gain: float = 0.5
    max_scale_error: float = 0.02
    max_scan_scale_error: float = 0.05


def locate_robot(
    points: Float32 | FloorScan,
    field: Field,
    *,
    initial_pose: tuple[float, float, float] | None = None,
    scale: float | None = None,
    max_candidates: int = 6,
    margin: float | None = None,
    device: Device | StepDevices | None = None,
    limits: RobotLimits = RobotLimits(),
) -> LocatedRobot:
    """Locate a robot on a field by points on its lines.

    Parameters
    ----------
    points
        float32 (points, 2) in the robot's frame: x ahead, y to its left [m]; or the result of `scan_floor`: then
        expected lines that are missing also count.
    field
        The field.
    initial_pose
        Expected pose, x, y [m] and heading [rad]: no search elsewhere. None: search everywhere.
    scale
        Size of a pixel of the image that the points are from [m], for the report.
    max_candidates
        Largest number of candidates, default 6.
    margin
        Width of the border around the field in which the robot may be [m]; None: a twentieth of the field's length.
    device
        Where to run; None: `Device.best`, and beside a GPU the faster device for the search. A `StepDevices` that
        `scan_floor` has used: its choices are in the result, too.
    limits
        Thresholds of the decisions.

    Returns
    -------
    LocatedRobot
        Its ``reason`` says why a pose is refused.

    Raises
    ------
    ValueError
        A parameter is out of its range.

    Notes
    -----
    A pose is refused where random points reach it by chance in more than one of a thousand searches. A pose of a scan
    is also refused where the share of missing lines is more than a third of the share of explained points
    (`Evidence.missing`): clutter leaves points unexplained and robots in the way hide lines, but a wrong field does
    both. Clutter that replaces points on lines also does both, but it thins out all lines alike: such a pose is
    accepted where no whole line is missing (`RobotLimits.min_least_seen`).

    The scale of the points is fitted about the best pose, as one more unknown. Where its error is significant, the pose
    is refused if the error is above `RobotLimits.max_scale_error`; otherwise `LocatedRobot.warnings` names it, and the
    covariance of each candidate contains the square of the motion of its pose by the scale. Mirrored points are
    accepted: most fields equal their mirror image.
    """
    devices = _step_devices(device)
    start = time.perf_counter()
    scan = points if isinstance(points, FloorScan) else None
    used = _usable(points.points if isinstance(points, FloorScan) else points)
    kept: dict[str, Any] = {"points": used, "field": field, "scale": scale, "device": devices.first}
    if len(used) < limits.min_points:
        reason = f"{len(used)} points on lines, expected {limits.min_points} or more"
        return LocatedRobot(
            candidates=(), doubtful=(), evidence=None, reason=reason, seconds={}, steps=devices.report(), **kept
        )
    field_map = _search_map(field, used, margin, devices.first)
    mapped = time.perf_counter()
    most = max(max_candidates, limits.min_refined)

    def search(device: Device) -> tuple[PoseCandidate, ...]:
        return find_pose_candidates(field_map, used, initial_pose=initial_pose, max_candidates=most, device=device)

    size = (field_map.cells.level.shape, float(len(used)), initial_pose is None, most)
    kept["device"] = devices.choose("search", search, *size)
    chosen = time.perf_counter()
    found = search(kept["device"])
    weights = _weigh(found, used, scan, field_map, is_anywhere=initial_pose is None)
    ordered, weights = _order(found, weights, max_candidates)
    reason, warning, fitted = _doubt(weights[0] if weights else None, len(used), limits), "", None
    if not reason:
        fitted = _fit_scale(used, field, ordered[0], field_map.scale, limits)
    if fitted is not None and _is_significant(fitted, limits):
        largest = limits.max_scale_error if scan is None else limits.max_scan_scale_error
        message = _scale_message(fitted, scale)
        reason, warning = (message, "") if abs(fitted.error) > largest else ("", message)
        ordered = tuple(_add_scale_error(each, used, field, field_map.scale, limits) for each in ordered)
    return LocatedRobot(
        candidates=() if reason else ordered,
        doubtful=ordered[:1] if reason else (),
        evidence=weights[0] if weights else None,
        reason=reason,
        point_scale=fitted,
        warnings=(warning,) if warning else (),
        steps=devices.report(),
        seconds={"map": mapped - start, "choose device": chosen - mapped, "search": time.perf_counter() - chosen},
        **kept,
    )


def _search_map(field: Field, points: Float32, margin: float | None, device: Device) -> DistanceMap:
    """Return the distance map for a search with points in the robot's frame."""
    size = max(field.length, field.width)
    cost_scale = min(_MAX_COST_SCALE, _COST_SCALE * size)
    # The factor keeps the farthest point inside the map after rounding to single precision.
    max_range = min(float(np.hypot(*points.T.astype(np.float64)).max()) * 1.001 + cost_scale, _MAX_DIAGONAL * size)
    return DistanceMap(
        field=field,
        cell=_CELL * cost_scale,
        scale=cost_scale,
        max_range=max_range,
        margin=_MARGIN * size if margin is None else margin,
        device=device,
    )


def _usable(points: Float32) -> Float32:
    """Return the finite points; where they are too many, every n-th of them."""
    finite = points[np.isfinite(points).all(axis=1)]
    return np.ascontiguousarray(finite[:: -(-max(len(finite), 1) // _MAX_POINTS)], np.float32)


def _weigh(
    found: tuple[PoseCandidate, ...],
    points: Float32,
    scan: FloorScan | None,
    field_map: DistanceMap,
    *,
    is_anywhere: bool,
) -> list[Evidence]:
    """Return the evidence for each candidate; of points without a scan no expected lines are counted."""
    field = field_map.field
    paths, width = (None, default_line_width(field)) if scan is None else (scan.paths, scan.line_width)
    how: dict[str, Any] = {
        "half_line_width": 0.5 * width,
        "scale": field_map.scale,
        "max_range": field_map.max_range,
        "margin": field_map.margin if is_anywhere else None,
    }
    return [evidence(points, paths, field, each.pose, **how) for each in found]


def _order(
    found: tuple[PoseCandidate, ...], weights: list[Evidence], max_candidates: int
) -> tuple[tuple[PoseCandidate, ...], list[Evidence]]:
    """Return candidates sorted by their share of missing expected lines, then by score."""
    order = sorted(range(len(found)), key=lambda number: (round(max(weights[number].missing, 0.0), 1), number))[
        :max_candidates
    ]
    place = {number: rank for rank, number in enumerate(order)}
    moved = [found[number] for number in order]
    ordered = [
        each._replace(symmetric_twin=None if each.symmetric_twin is None else place.get(each.symmetric_twin))
        for each in moved
    ]
    return tuple(ordered), [weights[number] for number in order]


def _doubt(best: Evidence | None, count: int, limits: RobotLimits) -> str:
    """Return why the best candidate is refused; empty where it is accepted."""
    if best is None:
        return "no pose on the field fits the points; are they in metres, is this the right field?"
    if best.log_nfa > limits.max_log_nfa:
        return f"{count} points fit the field no better than random points; is it a field, are they in metres?"
    is_thinned = (
        best.missing <= limits.max_missing_thinned
        and min(best.on_lines, best.seen) >= limits.min_share
        and best.least_seen >= limits.min_least_seen
    )
    if best.missing > limits.max_missing and not is_thinned:
        return (
            f"the image does not match this field: at the best pose {max(best.seen, 0.0):.0%} of the expected lines "
            f"are seen, and {best.on_lines:.0%} of the points are on lines; is the scale right?"
        )
    return ""


def _is_significant(fitted: PointScale, limits: RobotLimits) -> bool:
    return abs(fitted.error) > limits.scale_significance * fitted.sigma


def _fit_scale(
    points: Float32, field: Field, candidate: PoseCandidate, cost_scale: float, limits: RobotLimits
) -> PointScale | None:
    """Return the scale of the points about a candidate; None where they do not determine it."""
    fitted = point_scale(points, field, candidate.pose, scale=cost_scale)
    needed = limits.min_scale_gain * math.sqrt(len(points))
    return None if fitted is not None and _is_significant(fitted, limits) and fitted.gained < needed else fitted


def _add_scale_error(
    candidate: PoseCandidate, points: Float32, field: Field, cost_scale: float, limits: RobotLimits
) -> PoseCandidate:
    """Return a candidate whose covariance contains the motion of the pose by a significant error of the scale."""
    fitted = _fit_scale(points, field, candidate, cost_scale, limits)
    if fitted is None or not _is_significant(fitted, limits):
        return candidate
    x, y, turn = fitted.pose - candidate.pose
    moved = np.array([x, y, math.remainder(turn, 2.0 * math.pi)])
    return candidate._replace(covariance=candidate.covariance + np.outer(moved, moved))


def _scale_message(fitted: PointScale, scale: float | None) -> str:
    """Return the error of the scale of the points in words."""
    question = "are their scale, or height and tilt of the camera, right?"
    if scale is not None:
        question = f"is the scale {1e3 * scale / (1.0 + fitted.error):.4g} mm, not {1e3 * scale:.4g} mm?"
    return (
        f"the points are {abs(100 * fitted.error):.2f} % (standard deviation {100 * fitted.sigma:.2f} %) "
        f"{'farther from' if fitted.error > 0 else 'nearer to'} the robot than the lines of the field; {question}"
    )


def read_points(path: Path) -> Float32:
    """Read points (n, 2) [m] from an NPY array or from a CSV file of two columns.

    Raises
    ------
    OSError
        The file cannot be read.
    RecordingError
        The file has another content, or none of its points is finite.
    """
    with reading(path, "list of points", RecordingError):
        points = read_array(path) if path.suffix.lower() == ".npy" else np.loadtxt(path, delimiter=",", ndmin=2)
    if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: {points.dtype} of shape {points.shape}, expected points (n, 2) in metres")
    if len(points) and not np.isfinite(points).all(axis=1).any():
        raise RecordingError(f"{path}: none of the {len(points)} points is finite")
    return np.ascontiguousarray(points, np.float32)


def white_of(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return how white each pixel is: the darkest of the three colours, or the grey level."""
    if image.ndim == 3 and image.shape[2] in (3, 4):
        return grey_image(np.ascontiguousarray(image[:, :, :3].min(axis=2)))
    return grey_image(image)


def default_line_width(field: Field) -> float:
    """Return the usual width of the lines of a field [m]: 125 mm, on small fields 20 mm."""
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
    max_range: float = _MAX_RANGE,
    device: Device | StepDevices | None = None,
) -> FloorScan:
    """Find the centres of white stripes on the floor, along rays from the robot's place.

    Through a tilted camera, lines across the rays are also scanned.

    Parameters
    ----------
    image
        Grey or colour (blue, green, red) image: the floor from above with the robot in its centre, ahead to the right;
        or the image of a `MountedCamera`.
    scale
        Size of a pixel on the floor [m], above 0; None for a mounted camera.
    line_width
        Width of the stripes [m], above 0.
    rays
        Number of rays, all around, at least 1. Default 128.
    blind
        Distance from the centre up to which the image shows the robot itself [m], at least 0. Default 0.0.
    threshold
        Least height of an edge [grey levels]; None: 4 times the noise, at least a tenth of the image's range.
    model
        Lens or camera model, or a camera mounted on the robot. None: no distortion.
    max_range
        Of a mounted camera: largest distance from it [m], above 0. Default 12.0.
    device
        Where to run; None: `Device.best`, and beside a GPU the faster device. A `StepDevices` keeps the choice, for
        the report of `locate_robot`.

    Raises
    ------
    ValueError
        Lines are too narrow in the image, the image is too small, the scale is missing, or given for a mounted camera,
        or a number is out of its range.
    """
    finite(line_width, "line_width", above=0.0)
    integer(rays, "rays", minimum=1)
    finite(blind, "blind", minimum=0.0)
    finite(max_range, "max_range", above=0.0)
    white = white_of(image)
    least = default_threshold(white) if threshold is None else threshold
    if isinstance(model, MountedCamera):
        if scale is not None:
            raise ValueError("scale is given for a mounted camera, whose height and focal length determine it; omit it")
        mounted: MountedCamera = model

        def scan(device: Device) -> FloorScan:
            return scan_tilted_view(
                white, mounted, line_width=line_width, lines=rays, max_range=max_range, threshold=least, device=device
            )
    else:
        if scale is None:
            raise ValueError("scale is missing: the size of a pixel on the floor [m]")
        finite(scale, "scale", above=0.0)
        view = BoardView(scale=scale, shape=white.shape, pose=(0.0, 0.0, 0.0), model=model)

        def scan(device: Device) -> FloorScan:
            return scan_top_view(
                white, view, line_width=line_width, rays=rays, blind=blind, threshold=least, device=device
            )

    geometry = _scan_geometry(model, line_width=line_width, scale=scale, blind=blind, max_range=max_range)
    size = (white.shape, white.dtype.str, type(model).__name__, rays, *geometry)
    return scan(_step_devices(device).choose("scan", scan, *size))


def _scan_geometry(
    model: Lens | Camera | MountedCamera | None,
    *,
    line_width: float,
    scale: float | None,
    blind: float,
    max_range: float,
) -> tuple[object, ...]:
    """Return the numbers of a scan that determine count and length of the rulers, for the key of its kept times."""
    if not isinstance(model, MountedCamera):
        return ("from above", (scale or 0.0) / line_width, blind / line_width)
    distances = (model.height / line_width, max_range / line_width)
    directions = [round(each / _DIRECTION_STEP) for each in (model.tilt, model.roll)]
    return ("mounted", type(model.model).__name__, *distances, float(model.matrix[0, 0]), *directions)


def _step_devices(device: Device | StepDevices | None) -> StepDevices:
    return device if isinstance(device, StepDevices) else StepDevices(device, kernel_folders=(KERNEL_FOLDER,))


def read_floor(path: Path) -> npt.NDArray[Any]:
    """Read a top view as `scan_floor` takes it.

    Raises
    ------
    RecordingError
        The file is not an image.
    """
    image = read_image(path)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGRA2BGR) if image.shape[2] == 4 else image
