"""White stripes on a floor along scan lines through an image of it: points on lines, and where they were looked for."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.board_view import BoardView, noise_of
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.matching.ruler import RulerEdges

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

FINEST_PX = 3.0
"""A line's width in the image, at least."""
_RULER, _TAPS = 128, 3.0  # samples of a piece of a scan line; sigmas of its smoothing either side
_MARGIN_PX = 3.0


class FloorScan(NamedTuple):
    """What scan lines over a floor found, in the robot's frame: x ahead, y to its left [m].

    Attributes
    ----------
    points
        float32 (points, 2), the middles of white stripes.
    sigmas
        float32 (points,), standard deviations along their scan lines, as the image's noise has it [m].
    paths
        float32 (paths, 4), x, y of both ends of what was scanned: a stripe across one of them would have been found.
    line_width
        Of the stripes [m].
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
    """Scan a top view along rays from its middle.

    Parameters
    ----------
    white
        Grey levels.
    view
        How the camera sees the floor.
    line_width
        Of the stripes [m].
    rays
        How many, all around.
    blind
        Where they begin [m].
    threshold
        Least edge [grey levels].
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    ValueError
        Lines are too narrow in the image, or it is too small.
    """
    width_px = line_width / view.scale
    if not width_px >= FINEST_PX:
        raise ValueError(
            f"lines of {line_width:.3g} m are {width_px:.1f} px wide at {view.scale:.3g} m per pixel, expected "
            f"{FINEST_PX:g} px or more; is the scale right?"
        )
    rulers = stripe_rulers(white, width_px, threshold, view.model)
    starts, ends = _rays(view, rays, blind)
    ways = (ends - starts) / np.linalg.norm(ends - starts, axis=-1, keepdims=True)
    # Near a ruler's ends nothing is found: rays begin so much behind the middle, and end so much before the border.
    unseen = trimmed(rulers) * ways
    pieces, path = laid_along(starts - unseen, ends, rulers, width_px)
    if not len(pieces):
        raise ValueError(
            f"the image of {white.shape[1]} x {white.shape[0]} px has no room for a ray of "
            f"{(_RULER - 1) * rulers.step_px:.0f} px beside what is blind; give a larger one"
        )
    edges = rulers(white, pieces, device=device)
    places = pieces[:, None, :2] + edges.position[..., None] * pieces[:, None, 2:]
    found = np.isfinite(edges.position)
    points = view.places(places[found])
    kept = once(points, np.broadcast_to(path[:, None], found.shape)[found], line_width)
    used = np.unique(path)
    paths = np.concatenate([view.places(starts), view.places(ends - unseen)], axis=-1)
    return FloorScan(
        points=np.ascontiguousarray(points[kept], np.float32),
        sigmas=np.ascontiguousarray(view.scale * edges.sigma[found][kept], np.float32),
        paths=np.ascontiguousarray(paths[used], np.float32),
        line_width=line_width,
    )


def least_edge(white: npt.NDArray[Any]) -> float:
    """Return the least edge that counts [grey levels]: 4 times the noise, and a tenth of the image's range."""
    low, high = np.percentile(white, [1, 99])
    return max(4.0 * noise_of(white), 0.1 * float(high - low), 1e-6)


def stripe_rulers(
    white: npt.NDArray[Any], width_px: float, threshold: float, model: Lens | Camera | None
) -> RulerEdges:
    """Return what looks for bright stripes about so wide [px], a piece of a scan line at a time."""
    step = max(width_px / 8.0, 1.0)
    return RulerEdges(
        threshold=threshold,
        length=_RULER,
        width=3,
        step_px=step,
        smoothing_px=1.5 * step,
        polarity="rising",
        choice="all",
        most=8,
        pairs=True,
        spacing_px=(0.4 * width_px, 3.0 * width_px),
        noise=noise_of(white),
        model=model,
    )


def trimmed(rulers: RulerEdges) -> float:
    """Return how far from a ruler's ends edges are found [px]."""
    return math.ceil(_TAPS * rulers.smoothing_px / rulers.step_px) * rulers.step_px


def laid_along(
    starts: Float64, ends: Float64, rulers: RulerEdges, width_px: float
) -> tuple[Float32, npt.NDArray[np.intp]]:
    """Return rulers (n, 4) along scan lines, so that each stripe lies whole on one; and which line each is along.

    Scan lines that are shorter than a ruler have none.
    """
    length = (_RULER - 1) * rulers.step_px
    hop = max(length - 2.0 * trimmed(rulers) - 3.0 * width_px, 0.25 * length)
    laid: list[tuple[float, ...]] = []
    path: list[int] = []
    for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
        far = float(np.linalg.norm(end - start))
        if not far >= length:
            continue
        way = (end - start) / far
        middles = [*np.arange(length / 2, far - length / 2, hop), far - length / 2]
        laid += [(*(start + middle * way), *way) for middle in middles]
        path += [number] * len(middles)
    return np.array(laid, np.float32).reshape(-1, 4), np.array(path, np.intp)


def once(points: Float64, path: npt.NDArray[Any], line_width: float) -> npt.NDArray[np.intp]:
    """Return which points are left where two pieces of one scan line have found the same: sorted along it."""
    order = np.lexsort((np.hypot(*points.T), path))
    points, path = points[order], path[order]
    gone = np.zeros(len(points), np.bool_)
    if len(points) > 1:
        gone[1:] = (np.hypot(*(points[1:] - points[:-1]).T) < 0.5 * line_width) & (path[1:] == path[:-1])
    return order[~gone]


def _rays(view: BoardView, rays: int, blind: float) -> tuple[Float64, Float64]:
    """Return where rays from the middle of a view begin and where they leave the image, (n, 2) each [px]."""
    turns = np.arange(rays) * (2 * math.pi / rays)
    ways = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    away = np.arange(math.ceil(0.5 * math.hypot(*view.shape)) + 2)
    inside = view.within(view.places(view.centre_px + away[:, None, None] * ways), _MARGIN_PX)
    last = np.where(inside.all(axis=0), len(away), np.argmin(inside, axis=0)) - 1.0
    first = blind / view.scale
    starts, ends = view.centre_px + first * ways, view.centre_px + last[:, None] * ways
    ahead = last > first
    return starts[ahead], ends[ahead]
