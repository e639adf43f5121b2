"""Detection of white stripes on a floor along scan lines: points on field lines, and where they were looked for.

Calipers (rulers) that measure pairs of edges are placed along the scan lines.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.image import estimate_pixel_noise, finite_percentiles
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import Edges, RulerEdges

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

MIN_LINE_WIDTH_PX = 3.0
"""Least width of a line in the image [px]: below, its two edges blur into one another."""
_RULER_LENGTH = 128  # samples of a part of a scan line
_TAPS_PER_SIGMA = 3.0  # largest length of a ruler of `RulerEdges`
_MARGIN_PX = 3.0  # distance of rulers from the image border
# Widths of accepted stripes relative to the expected width (chosen).
_MIN_WIDTH_RATIO, _MAX_WIDTH_RATIO = 0.4, 3.0


class FloorScan(NamedTuple):
    """Result of a scan of the floor, in the robot's frame: x ahead, y to its left [m].

    Attributes
    ----------
    points : float32, (points, 2)
        Centres of white stripes [m].
    sigmas : float32, (points,)
        Standard deviations along the scan lines due to the noise of the image [m].
    paths : float32, (paths, 4)
        x, y of both ends of the scanned lines [m]: a stripe across one of them would have been found.
    line_width : float
        Width of the stripes [m].
    """

    points: Float32
    sigmas: Float32
    paths: Float32
    line_width: float


def scan_top_view(
    white: npt.NDArray[Any],
    view: BoardView,
    *,
    line_width: float,
    rays: int,
    blind: float,
    threshold: float,
    device: Device | None,
) -> FloorScan:
    """Scan a top view along rays from its centre.

    Parameters
    ----------
    white
        Grey levels (rows, columns).
    view
        Pose and scale of the camera over the floor.
    line_width
        Width of the stripes [m].
    rays
        Number of rays, all around.
    blind
        Distance from the centre at which the rays begin [m].
    threshold
        Least height of an edge [grey levels].
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        The lines are too narrow in the image, or the image is too small.
    """
    width_px = line_width / view.scale
    if not width_px >= MIN_LINE_WIDTH_PX:
        raise ValueError(
            f"lines of {line_width:.3g} m are {width_px:.1f} px wide at {view.scale:.3g} m per pixel, expected "
            f"{MIN_LINE_WIDTH_PX:g} px or more; is the scale right?"
        )
    rulers = stripe_ruler(white, width_px, threshold, view.model)
    starts, ends = _rays(view, rays, blind)
    directions = (ends - starts) / np.linalg.norm(ends - starts, axis=-1, keepdims=True)
    # Near a ruler's ends no edge is found: the rulers extend by this much beyond the scanned part of a ray.
    unseen = end_margin_px(rulers) * directions
    pieces, path = place_rulers_along(starts - unseen, ends, rulers, width_px)
    if not len(pieces):
        raise ValueError(
            f"the image of {white.shape[1]} x {white.shape[0]} px has no room for a ray of "
            f"{(_RULER_LENGTH - 1) * rulers.step_px:.0f} px outside the blind area; give a larger image"
        )
    edges = rulers(white, pieces, device=device)
    position, sigma = to_numpy(edges.position), to_numpy(edges.sigma)
    places = pieces[:, None, :2] + position[..., None] * pieces[:, None, 2:]
    found = np.isfinite(position)
    points = view.to_plane(places[found])
    kept = unique_points(points, np.broadcast_to(path[:, None], found.shape)[found], np.hypot(*points.T), line_width)
    used = np.unique(path)
    paths = np.concatenate([view.to_plane(starts), view.to_plane(ends - unseen)], axis=-1)
    return FloorScan(
        points=np.ascontiguousarray(points[kept], np.float32),
        sigmas=np.ascontiguousarray(view.scale * sigma[found][kept], np.float32),
        paths=np.ascontiguousarray(paths[used], np.float32),
        line_width=line_width,
    )


def default_threshold(white: npt.NDArray[Any]) -> float:
    """Return the default threshold [grey levels]: 4 times the noise, at least a tenth of the image's range."""
    low, high = finite_percentiles(white, (1.0, 99.0))
    return max(4.0 * estimate_pixel_noise(white), 0.1 * (high - low), 1e-6)


def stripe_ruler(white: npt.NDArray[Any], width_px: float, threshold: float, model: Lens | Camera | None) -> RulerEdges:
    """Return the caliper (ruler) for bright stripes of about a width [px], for one piece of a scan line."""
    step = max(width_px / 8.0, 1.0)
    return RulerEdges(
        threshold=threshold,
        length=_RULER_LENGTH,
        width=3,
        step_px=step,
        smoothing_px=1.5 * step,
        polarity="rising",
        edge_selection="all",
        max_edges=8,
        pairs=True,
        spacing_px=(_MIN_WIDTH_RATIO * width_px, _MAX_WIDTH_RATIO * width_px),
        noise=estimate_pixel_noise(white),
        model=model,
    )


def end_margin_px(rulers: RulerEdges) -> float:
    """Return the distance from a ruler's ends within which no edge is found [px]."""
    return math.ceil(_TAPS_PER_SIGMA * rulers.smoothing_px / rulers.step_px) * rulers.step_px


def place_rulers_along(
    starts: Float64, ends: Float64, rulers: RulerEdges, width_px: float
) -> tuple[Float32, npt.NDArray[np.intp]]:
    """Return rulers (n, 4) along scan lines, and the scan line of each ruler.

    The rulers overlap so that each stripe lies wholly on one of them. Scan lines shorter than a ruler have no rulers.
    """
    length = (rulers.length - 1) * rulers.step_px
    hop = max(length - 2.0 * end_margin_px(rulers) - 3.0 * width_px, 0.25 * length)
    rulers_along: list[tuple[float, ...]] = []
    path: list[int] = []
    for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
        far = float(np.linalg.norm(end - start))
        if not far >= length:
            continue
        direction = (end - start) / far
        middles = [*np.arange(length / 2, far - length / 2, hop), far - length / 2]
        rulers_along += [(*(start + middle * direction), *direction) for middle in middles]
        path += [number] * len(middles)
    return np.array(rulers_along, np.float32).reshape(-1, 4), np.array(path, np.intp)


def unique_points(points: Float64, path: npt.NDArray[Any], away: Float64, line_width: float) -> npt.NDArray[np.intp]:
    """Return the indices of the points without duplicates of overlapping rulers, sorted along their scan lines."""
    order = np.lexsort((away, path))
    points, path = points[order], path[order]
    removed = np.zeros(len(points), np.bool_)
    if len(points) > 1:
        removed[1:] = (np.hypot(*(points[1:] - points[:-1]).T) < 0.5 * line_width) & (path[1:] == path[:-1])
    return order[~removed]


def _rays(view: BoardView, rays: int, blind: float) -> tuple[Float64, Float64]:
    """Return where rays from the centre of a view begin and where they leave the image, (n, 2) each [px]."""
    turns = np.arange(rays) * (2 * math.pi / rays)
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    away = np.arange(math.ceil(0.5 * math.hypot(*view.shape)) + 2)
    inside = view.contains(view.to_plane(view.centre_px + away[:, None, None] * directions), _MARGIN_PX)
    last = np.where(inside.all(axis=0), len(away), np.argmin(inside, axis=0)) - 1.0
    first = blind / view.scale
    starts, ends = view.centre_px + first * directions, view.centre_px + last[:, None] * directions
    ahead = last > first
    return starts[ahead], ends[ahead]


# ---- through a tilted camera -------------------------------------------------------------------------------------

_SHORT_LENGTH = 64  # samples of a ruler
_SAMPLES = 512  # of a scan line, to find its parts in the image


def scan_tilted_view(
    white: npt.NDArray[Any],
    camera: MountedCamera,
    *,
    line_width: float,
    lines: int,
    max_range: float,
    threshold: float,
    device: Device | None,
) -> FloorScan:
    """Scan the floor in the image of a tilted camera: along rays from the place below it, and across them.

    A line across the view direction is soon thinner than pixels resolve, a line along it is not: the scan lines across
    find it as far as it is three pixels wide. The length of the rulers follows the width of the lines in the image, by
    octaves.

    Parameters
    ----------
    white
        Grey levels (rows, columns).
    camera
        Camera mounted on the robot.
    line_width
        Width of the stripes [m].
    lines
        Number of rays; the number of lines across them is twice as large.
    max_range
        Largest distance from the camera [m].
    threshold
        Least height of an edge [grey levels].
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        On no part of the floor in view lines are wide enough.
    """
    runs = _runs(camera, _scan_lines(camera, white.shape, lines, max_range), white.shape, line_width)
    octaves = [[run for run in runs if run.octave == each] for each in sorted({run.octave for run in runs})]
    scans = [_octave(white, camera, each, line_width, threshold, device) for each in octaves]
    parts = [each for each in scans if each is not None]
    if not parts:
        raise ValueError(
            f"lines of {line_width:.3g} m are nowhere on the floor {MIN_LINE_WIDTH_PX:g} px wide in this image; "
            f"are height, "
            "tilt and focal length right?"
        )
    return FloorScan(
        points=np.concatenate([each.points for each in parts]),
        sigmas=np.concatenate([each.sigmas for each in parts]),
        paths=np.concatenate([each.paths for each in parts]),
        line_width=line_width,
    )


class _Run(NamedTuple):
    """Part of a scan line with one octave of line width: both ends [px], octave, and whether the image ends there."""

    start: Float64
    end: Float64
    octave: int
    cut: tuple[bool, bool]


def _scan_lines(camera: MountedCamera, shape: tuple[int, ...], lines: int, max_range: float) -> Float64:
    """Return scan lines on the floor, (lines, samples, 2) [m]: rays from below the camera, and lines across them."""
    rows, columns = shape
    grid = np.stack(np.meshgrid(np.linspace(0, columns - 1, 64), np.linspace(0, rows - 1, 64)), axis=-1)
    on_floor = (
        camera.to_floor(grid if camera.model is None else camera.model.undistort(grid)).reshape(-1, 2) - camera.position
    )
    far = np.hypot(*on_floor.T)
    on_floor = on_floor[far <= max_range]
    if not len(on_floor):
        return np.empty((0, _SAMPLES, 2))
    far = np.hypot(*on_floor.T)
    # Evenly spaced in the angle below the camera, about as the pixels are.
    angle = np.linspace(np.arctan(far.min() / camera.height), np.arctan(far.max() / camera.height), _SAMPLES)
    c, s = math.cos(camera.heading), math.sin(camera.heading)
    ahead, left = on_floor @ (c, s), on_floor @ (-s, c)
    bearing = np.arctan2(left, ahead)
    turns = np.linspace(bearing.min(), bearing.max(), lines) + camera.heading
    rays = camera.height * np.tan(angle)[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)[:, None]
    nearest, farthest = (math.atan(each / camera.height) for each in (float(ahead.min()), float(ahead.max())))
    tilts = np.linspace(nearest, farthest, 2 * lines)
    wide = np.linspace(left.min(), left.max(), _SAMPLES)
    across = camera.height * np.tan(tilts)[:, None, None] * np.array([c, s]) + wide[:, None] * np.array([-s, c])
    return np.asarray(camera.position + np.concatenate([rays, across]))


def _runs(camera: MountedCamera, floors: Float64, shape: tuple[int, ...], line_width: float) -> list[_Run]:
    """Return the parts of scan lines in the image, cut where the width of lines across them doubles."""
    pixels = camera.to_pixels(floors)
    measured = camera.distort(pixels)
    with np.errstate(invalid="ignore"):
        inside = (measured >= _MARGIN_PX) & (measured <= np.array(shape[::-1]) - 1 - _MARGIN_PX)
        steps = np.gradient(pixels, axis=1), np.gradient(floors, axis=1)
        width = line_width * np.hypot(*np.moveaxis(steps[0], -1, 0)) / np.hypot(*np.moveaxis(steps[1], -1, 0))
        octave = np.floor(np.log2(width / MIN_LINE_WIDTH_PX))
        shown = inside.all(axis=-1) & (octave >= 0)
    runs = []
    for line, kind in zip(pixels, np.where(shown, octave, -1).astype(int), strict=True):
        cuts = [0, *(np.flatnonzero(np.diff(kind)) + 1), len(kind)]
        for first, last in itertools.pairwise(cuts):
            if kind[first] >= 0 and last - first > 2:
                cut = (first == 0 or kind[first - 1] < 0, last == len(kind) or kind[last] < 0)
                # The part ends where the next one begins.
                runs.append(_Run(line[first], line[last - 1 if cut[1] else last], int(kind[first]), cut))
    return runs


def _octave(
    white: npt.NDArray[Any],
    camera: MountedCamera,
    runs: list[_Run],
    line_width: float,
    threshold: float,
    device: Device | None,
) -> FloorScan | None:
    """Scan the parts of one octave of line width; None if no scan line has room for a ruler."""
    wide = MIN_LINE_WIDTH_PX * 2.0 ** (runs[0].octave + 0.5)
    rulers = replace(stripe_ruler(white, wide, threshold, camera.model), length=_SHORT_LENGTH)
    edge, length = end_margin_px(rulers), (rulers.length - 1) * rulers.step_px
    candidates = [(run, _room(run, edge, edge + 2.0 * wide, length)) for run in runs]
    runs, rooms = (
        [run for run, room in candidates if room is not None],
        [room for _, room in candidates if room is not None],
    )
    if not runs:
        return None
    lines = _ScanLines.of(runs, rooms)
    pieces, path = place_rulers_along(lines.at(0), lines.at(1), rulers, wide)
    stripes = _find_stripes(rulers(white, pieces, device=device), pieces, path, lines)
    sides = camera.to_floor(stripes.place - stripes.half), camera.to_floor(stripes.place + stripes.half)
    size = np.hypot(*(sides[1] - sides[0]).T)
    good = (size > _MIN_WIDTH_RATIO * line_width) & (size < _MAX_WIDTH_RATIO * line_width)
    points = (0.5 * (sides[0] + sides[1]))[good]
    kept = unique_points(points, stripes.path[good], stripes.away[good], line_width)
    per_px = (size / stripes.spacing)[good]
    ends = [camera.to_floor(lines.at(which)) for which in (2, 3)]
    is_valid = lines.room[:, 3] > lines.room[:, 2]
    return FloorScan(
        points=np.ascontiguousarray(points[kept], np.float32),
        sigmas=np.ascontiguousarray((per_px * stripes.sigma[good])[kept], np.float32),
        paths=np.ascontiguousarray(np.concatenate(ends, axis=-1)[is_valid], np.float32),
        line_width=line_width,
    )


class _ScanLines(NamedTuple):
    """Scan lines [px]: starts (n, 2), directions (n, 2), lengths (n,), and rooms (n, 4) as `_room` returns them."""

    start: Float64
    direction: Float64
    length: Float64
    room: Float64

    @classmethod
    def of(cls, runs: list[_Run], rooms: list[tuple[float, float, float, float]]) -> _ScanLines:
        """Return the scan lines of parts with room."""
        way = np.array([each.end - each.start for each in runs])
        length = np.linalg.norm(way, axis=-1)
        return cls(np.array([each.start for each in runs]), way / length[:, None], length, np.array(rooms))

    def at(self, which: int) -> Float64:
        """Return the points (n, 2) at one of the four distances of the room."""
        return np.asarray(self.start + self.room[:, which, None] * self.direction)


class _Stripes(NamedTuple):
    """Stripes found on scan lines [px], (m, ...).

    Middles (m, 2), vectors to an edge (m, 2), standard deviations and widths, numbers of the scan lines, and distances
    from their starts.
    """

    place: Float64
    half: Float64
    sigma: Float32
    spacing: Float32
    path: npt.NDArray[np.intp]
    away: Float64


def _find_stripes(edges: Edges, pieces: Float32, path: npt.NDArray[np.intp], lines: _ScanLines) -> _Stripes:
    """Return the stripes that rulers along scan lines found between the ends of their lines."""
    assert edges.spacing is not None
    position, sigma, spacing = to_numpy(edges.position), to_numpy(edges.sigma), to_numpy(edges.spacing)
    places = pieces[:, None, :2] + position[..., None] * pieces[:, None, 2:]
    away = np.sum((places - lines.start[path][:, None]) * lines.direction[path][:, None], axis=-1)
    with np.errstate(invalid="ignore"):
        found = (away >= 0.0) & (away < lines.length[path][:, None])
    half = 0.5 * spacing[found][:, None] * np.broadcast_to(pieces[:, None, 2:], places.shape)[found]
    number = np.broadcast_to(path[:, None], found.shape)[found]
    return _Stripes(places[found], half, sigma[found], spacing[found], number, away[found])


def _room(run: _Run, edge: float, over: float, length: float) -> tuple[float, float, float, float] | None:
    """Return where rulers along a part begin and end, and the range that they scan [px]; None: no room.

    Inside the image the rulers extend beyond the part, so that a stripe between two parts is sampled completely.
    """
    far = float(np.linalg.norm(run.end - run.start))
    begin, end = (0.0 if run.cut[0] else -over), far + (0.0 if run.cut[1] else over)
    lack = length * (1.0 + 1e-6) - (end - begin)
    if lack > 0.0:
        if all(run.cut):
            return None
        begin, end = (begin, end + lack) if run.cut[0] else (begin - lack, end)
    return begin, end, edge if run.cut[0] else 0.0, far - (edge if run.cut[1] else 0.0)
