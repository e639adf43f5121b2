"""Where a robot is on a field: a top view of the floor around it, or points on lines, become candidates for its pose.

Rays from the image's middle cross the white lines of the floor; the middles of the stripes along them are points on
lines, and `gpuvision.matching.field` finds the poses that fit them.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.board_view import BoardView, grey_image, noise_of
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.recordings import read_image
from gpuvision.matching.field import Candidate, locate
from gpuvision.matching.field_map import Field, FieldMap
from gpuvision.matching.ruler import RulerEdges
from gpuvision.status import Status

Float32 = npt.NDArray[np.float32]

POINT_FILES = (".npy", ".csv")
RAYS = 128
_MOST_POINTS = 4096
_FEWEST = 4
_RULER, _TAPS = 128, 3.0  # samples of a piece of a ray; sigmas of its smoothing either side
_FINEST_PX = 3.0  # a line's width, at least
_SMALL_FIELD, _SMALL_LINES, _LARGE_LINES = 5.0, 0.02, 0.125  # [m]: a field's length; a junior's lines, and others'


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedRobot:
    """Where a robot may be, best first, or why that is not known.

    Attributes
    ----------
    candidates
        As `gpuvision.matching.field.locate` gives them.
    points
        float32 (points, 2), on lines, in the robot's frame [m].
    field
        The field.
    scale
        Of a pixel of the top view [m]; None where points were given.
    reason
        Why there is no pose; ``""`` where there is one.
    device
        Where it ran.
    seconds
        Of the steps, by name.
    """

    candidates: tuple[Candidate, ...]
    points: Float32
    field: Field
    scale: float | None
    reason: str
    device: Device
    seconds: dict[str, float]

    def summary(self) -> str:
        """Return the candidates, a line for each, or why there are none."""
        if self.reason:
            return f"refused: {self.reason}"
        return "\n".join([f"{len(self.points)} points on lines", *map(self._line, range(len(self.candidates)))])

    def _line(self, number: int) -> str:
        each = self.candidates[number]
        x, y, heading = each.pose
        sx, sy, turn = np.sqrt(np.diag(each.covariance))
        sigmas = f"sigmas {1e3 * sx:.2g} mm, {1e3 * sy:.2g} mm, {math.degrees(turn):.2g} degrees"
        if each.status & Status.AMBIGUOUS:
            sigmas = "the points fix a part of it only"
        twin = "" if each.twin is None else f"; twin of {each.twin + 1}"
        return (
            f"{number + 1}: x {x:.3f} m, y {y:.3f} m, heading {math.degrees(heading):.2f} degrees; {sigmas}; "
            f"score {each.score:.3f}, {each.share:.0%} of the points on lines{twin}"
        )

    def report(self) -> dict[str, Any]:
        """Return what ``pose.json`` holds: metres, radians; what is not known is null."""
        return {
            "gpuvision": version("gpuvision"),
            "status": "refused" if self.reason else "located",
            "reason": self.reason or None,
            "field": self.field.name,
            "symmetric": self.field.is_symmetric,
            "candidates": [_told(each) for each in self.candidates],
            "scale": self.scale,
            "points": self.points.tolist(),
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "seconds": self.seconds,
        }


def _told(each: Candidate) -> dict[str, Any]:
    sigmas = np.sqrt(np.diag(each.covariance))
    names = ("x", "y", "theta")
    is_known = bool(np.all(np.isfinite(each.covariance)))
    return {
        "pose": dict(zip(names, each.pose.tolist(), strict=True)),
        "sigmas": dict(zip(names, sigmas.tolist(), strict=True)) if is_known else None,
        "covariance": each.covariance.tolist() if is_known else None,
        "information": each.information.tolist(),
        "score": each.score,
        "share": each.share,
        "scatter": each.scale,
        "twin": each.twin,
        "status": str(each.status.name or "OK"),
    }


def locate_robot(
    points: Float32,
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
        float32 (points, 2), in the robot's frame: x ahead, y to its left [m]; from `floor_points`, or any camera.
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
    """
    device = Device.best() if device is None else device
    start = time.perf_counter()
    used = points[np.isfinite(points).all(axis=1)]
    used = np.ascontiguousarray(used[:: -(-max(len(used), 1) // _MOST_POINTS)], np.float32)
    if len(used) < _FEWEST:
        reason = f"{len(used)} points on lines, expected {_FEWEST} or more"
        return LocatedRobot(
            candidates=(), points=used, field=field, scale=scale, reason=reason, device=device, seconds={}
        )
    size = max(field.length, field.width)
    bend = min(0.25, 0.02 * size)  # a quarter of a metre in a field of 20 m, as the map's own
    field_map = FieldMap(
        field=field,
        cell=0.4 * bend,
        scale=bend,
        reach=min(float(np.hypot(*used.T).max()) * 1.001 + bend, 1.5 * size),
        outside=0.05 * size if outside is None else outside,
        device=device,
    )
    mapped = time.perf_counter()
    found = locate(field_map, used, near=near, most=most, device=device)
    return LocatedRobot(
        candidates=found,
        points=used,
        field=field,
        scale=scale,
        reason="" if found else "no pose on the field fits the points; are they in metres, is it this field?",
        device=device,
        seconds={"map": mapped - start, "search": time.perf_counter() - mapped},
    )


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


def floor_points(
    image: npt.NDArray[Any],
    *,
    scale: float,
    line_width: float,
    rays: int = RAYS,
    blind: float = 0.0,
    threshold: float | None = None,
    model: Lens | Camera | None = None,
    device: Device | None = None,
) -> Float32:
    """Return the middles of white stripes along rays from the middle of a top view of the floor.

    Parameters
    ----------
    image
        Grey or colour (blue, green, red): the floor from above, the robot in its middle, ahead to the right.
    scale
        Of a pixel on the floor [m].
    line_width
        Of the stripes [m].
    rays
        How many, all around.
    blind
        So far from its middle the image shows the robot itself [m].
    threshold
        Least edge [grey levels]; None: 4 times the noise, and a tenth of the image's range.
    model
        The lens; None: the image is free of distortion.
    device
        Where to run; None: `Device.best`.

    Returns
    -------
    numpy.ndarray
        float32 (points, 2), x ahead and y to the left [m].

    Raises
    ------
    ValueError
        Lines are too narrow in the image, or it is too small.
    """
    white = white_of(image)
    width_px = line_width / scale
    if not width_px >= _FINEST_PX:
        raise ValueError(
            f"lines of {line_width:.3g} m are {width_px:.1f} px wide at {scale:.3g} m per pixel, expected "
            f"{_FINEST_PX:g} px or more; is the scale right?"
        )
    view = BoardView(scale=scale, shape=white.shape, pose=(0.0, 0.0, 0.0), model=model)
    low, high = np.percentile(white, [1, 99])
    least = max(4.0 * noise_of(white), 0.1 * float(high - low), 1e-6) if threshold is None else threshold
    step = max(width_px / 8.0, 1.0)
    smoothing = 1.5 * step
    pieces, reach = _pieces(view, rays, blind, step, width_px, math.ceil(_TAPS * smoothing / step))
    if not len(pieces):
        raise ValueError(
            f"the image of {white.shape[1]} x {white.shape[0]} px has no room for a ray of {reach:.0f} px beside what "
            "is blind; give a larger one"
        )
    edges = RulerEdges(
        threshold=least,
        length=_RULER,
        width=3,
        step_px=step,
        smoothing_px=smoothing,
        polarity="rising",
        choice="all",
        most=8,
        pairs=True,
        spacing_px=(0.4 * width_px, 3.0 * width_px),
        model=model,
    )(white, pieces, device=device)
    places = pieces[:, None, :2] + edges.position[..., None] * pieces[:, None, 2:]
    ray = np.broadcast_to(np.arctan2(pieces[:, 3], pieces[:, 2])[:, None], edges.position.shape)
    found = np.isfinite(edges.position)
    return _once(view.places(places[found]), ray[found], line_width)


def _pieces(view: BoardView, rays: int, blind: float, step: float, width_px: float, taps: int) -> tuple[Float32, float]:
    """Rulers (n, 4) that follow each other along rays so that each stripe lies whole on one, and their length [px]."""
    length = (_RULER - 1) * step
    hop = length - 2 * taps * step - 3.0 * width_px
    farthest = math.hypot(*view.shape) / 2
    middles = np.arange(blind / view.scale + length / 2 - taps * step, farthest, max(hop, 0.25 * length))
    angle = np.arange(rays) * (2 * math.pi / rays)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rulers = [(*(view.centre_px + middle * way), *way) for way in turn for middle in middles]
    laid = np.array(rulers, np.float32).reshape(-1, 4)
    ends = laid[:, None, :2] + np.array([-0.5, 0.5])[:, None] * length * laid[:, None, 2:]
    fits = view.within(view.places(ends), 3.0).all(axis=1)
    return np.ascontiguousarray(laid[fits]), length


def _once(points: npt.NDArray[np.float64], ray: npt.NDArray[Any], line_width: float) -> Float32:
    """Drop what two pieces of one ray have both found."""
    order = np.lexsort((np.hypot(*points.T), ray))
    points, ray = points[order], ray[order]
    gone = np.zeros(len(points), np.bool_)
    if len(points) > 1:
        near = np.hypot(*(points[1:] - points[:-1]).T) < 0.5 * line_width
        gone[1:] = near & (np.abs(ray[1:] - ray[:-1]) < 1e-4)
    return np.ascontiguousarray(points[~gone], np.float32)


def read_floor(path: Path) -> npt.NDArray[Any]:
    """Read a top view as `floor_points` takes it.

    Raises
    ------
    RecordingError
        It is no image.
    """
    image = read_image(path)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGRA2BGR) if image.shape[2] == 4 else image
