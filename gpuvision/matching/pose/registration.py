"""The first fix of a board from its artwork, and of a picture from another one, from far away.

`register_board` prepares for all pictures of a board; `register` takes a template's own edges. Both look for them with
`gpuvision.matching.pose.coarse_registration.CoarseRegistration`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.ruler import RulerEdges, best_smoothing
from gpuvision.matching.features.selection import Imaging, candidates
from gpuvision.matching.pose.coarse_registration import (
    MOST_RULERS,
    CoarseRegistration,
    KnownEdges,
    Registration,
    through,
)
from gpuvision.matching.pose.pose import Freedom

Float64 = npt.NDArray[np.float64]
_RULERS, _POINTS = 512, 512
_ENOUGH = 128  # of them: where the best smoothing leaves room for fewer, it is less
_PLACES = 24  # that are verified of a picture: of larger cells there are fewer than of a board's
_TILE = 8  # px, in which a template has one edge

__all__ = ["CoarseRegistration", "KnownEdges", "Registration", "register", "register_board", "template_edges"]


# ---- a board -------------------------------------------------------------------------------------------------


def register_board(
    artwork: Artwork,
    board_to_image: npt.ArrayLike,
    shape: tuple[int, int],
    *,
    placement: tuple[float, float] | None = None,
    shift: float = 2e-3,
    angle: float = math.radians(5.0),
    blur_px: float = 1.0,
    threshold: float = 10.0,
    tolerance_px: float = 1.0,
    cell_px: int = 2,
) -> CoarseRegistration:
    """Prepare the first fix of a board, for all its pictures.

    Parameters
    ----------
    artwork
        The side that the camera sees.
    board_to_image
        3 x 3, the board where it is nominally to the (undistorted) image [m to px].
    shape
        Rows and columns of the images.
    placement
        Point of the artwork [m] whose pose counts; None: the one nominally in the image's middle.
    shift, angle
        How far the placement point may be off in x and in y [m], and the board's angle [rad].
    blur_px
        Standard deviation of the edges' blur.
    threshold
        Least height of an edge [grey levels].
    tolerance_px, cell_px
        As in `CoarseRegistration`; etching moves edges, too.

    Returns
    -------
    CoarseRegistration
        Its lengths are metres. Without enough straight edges about the image it answers NO_DATA.
    """
    matrix = np.asarray(board_to_image, np.float64)
    rows, columns = shape
    corners = np.array([(0, 0), (columns - 1, 0), (0, rows - 1), (columns - 1, rows - 1)], np.float64)
    if matrix.shape != (3, 3) or np.linalg.matrix_rank(matrix) < 3:
        raise ValueError("board_to_image must be 3 x 3 and invertible")
    seen = through(np.asarray(np.linalg.inv(matrix)), np.concatenate([corners, corners.mean(axis=0)[None]]))
    place = tuple(seen[4]) if placement is None else placement
    pixel = math.sqrt(abs(_area(seen[:4])) / max((columns - 1) * (rows - 1), 1))
    low, high = seen[:4].min(axis=0), seen[:4].max(axis=0)
    reach = shift + 2.0 * math.sin(min(angle, math.pi) / 2.0) * np.hypot(*(high - low)) / 2.0
    region = (low - reach, high + reach)
    smoothing_px = best_smoothing(blur_px)
    single = _singles(artwork, region, place, Imaging(pixel=pixel, blur_px=blur_px, shift=2.0 * pixel, angle=0.0))
    if len(single.point) < _ENOUGH:
        # Neighbours are too near. Smoothed half as much, they are not: by the blur again, root 3 less than best in all.
        smoothing_px = blur_px
        near = Imaging(pixel=pixel, blur_px=blur_px / math.sqrt(3.0), shift=2.0 * pixel, angle=0.0)
        single = _singles(artwork, region, place, near)
    chosen = _some(np.arange(len(single.point)), _RULERS)
    return CoarseRegistration(
        search=_edge_points(artwork, low, high, cell_px * pixel),
        rulers=KnownEdges(single.point[chosen], single.normal[chosen]),
        to_image=matrix,
        placement=place,
        shift=shift,
        angle=angle,
        ruler=RulerEdges(threshold=threshold, width=5, smoothing_px=smoothing_px),
        tolerance_px=tolerance_px,
        cell_px=cell_px,
    )


def _singles(artwork: Artwork, region: tuple[Float64, Float64], place: Any, imaging: Imaging) -> KnownEdges:
    """Return where rulers may lie across one edge."""
    laid = candidates(artwork, region, place, imaging)
    return KnownEdges(laid.point[~laid.pair], laid.normal[~laid.pair])


def _area(corners: Float64) -> float:
    """Return the area of the image on the board, of its corners in reading order."""
    a, b = corners[3] - corners[0], corners[2] - corners[1]
    return float(a[0] * b[1] - a[1] * b[0]) / 2.0


def _some(numbers: npt.NDArray[np.int64], most: int) -> npt.NDArray[np.int64]:
    """Pick evenly from all, the same ones every time."""
    if len(numbers) <= most:
        return numbers
    return np.sort(np.random.default_rng(len(numbers)).choice(numbers, most, replace=False))


def _edge_points(artwork: Artwork, low: Float64, high: Float64, step: float) -> KnownEdges:
    """Points along straight edges and round lands, within bounds."""
    edges = artwork.edges
    count = np.ceil(edges.length / step).astype(np.int64)
    which = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    points = [edges.start[which] + part[:, None] * (edges.end - edges.start)[which]]
    normals = [edges.normal[which]]
    for land in artwork.lands:
        if land.shape == "circle" and not land.opening < 0.0:
            turn = np.linspace(0.0, 2.0 * math.pi, math.ceil(math.pi * land.size[0] / step), endpoint=False)
            way = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            points.append(land.centre + 0.5 * land.size[0] * way)
            normals.append(way)
    point, normal = np.concatenate(points), np.concatenate(normals)
    inside = np.flatnonzero(np.all((point >= low) & (point <= high), axis=1))
    chosen = _some(inside, _POINTS)
    return KnownEdges(point[chosen], normal[chosen])


# ---- a picture -----------------------------------------------------------------------------------------------


def register(
    image: npt.NDArray[Any],
    template: npt.NDArray[Any],
    *,
    placement: tuple[float, float] | None = None,
    shift_px: float = 64.0,
    angle: float = math.radians(10.0),
    blur_px: float = 1.0,
    threshold: float = 20.0,
    freedom: Freedom = "affine",
    tolerance_px: float = 1.0,
    cell_px: int = 4,
    device: Device | None = None,
) -> Registration:
    """Find where a template's points are seen in an image; lengths are pixels, theta turns from x towards y.

    Parameters
    ----------
    image, template
        uint8, uint16 or float32 (rows, columns). Of two sizes their middles are expected to coincide.
    placement
        Point of the template that the covariance holds for, about which shift and turn are looked for; None: its
        middle.
    shift_px, angle
        How far the placement point may be off in x and in y, and how far turned the image [rad].
    blur_px, threshold
        As in `register_board`.
    freedom, tolerance_px, cell_px
        As in `CoarseRegistration`; of two pictures by line cameras, or of two boards, the scales along x and y differ,
        too.
    device
        Where; None: the best.

    Raises
    ------
    TypeError, ValueError
        An array or a parameter is not what was expected.
    """
    place = ((template.shape[1] - 1) / 2.0, (template.shape[0] - 1) / 2.0) if placement is None else placement
    ruler = RulerEdges(threshold=threshold, width=7, smoothing_px=best_smoothing(blur_px), ambiguity=0.7)
    edges = template_edges(template, ruler, device=device)
    away = (np.array(image.shape[::-1], np.float64) - template.shape[::-1]) / 2.0
    fix = CoarseRegistration(
        search=KnownEdges(*(each[:_POINTS] for each in edges)),
        rulers=KnownEdges(*(each[:MOST_RULERS] for each in edges)),
        to_image=np.array([[1.0, 0.0, away[0]], [0.0, 1.0, away[1]], [0.0, 0.0, 1.0]]),
        placement=place,
        shift=shift_px,
        angle=angle,
        ruler=replace(ruler, ambiguity=None),
        freedom=freedom,
        tolerance_px=tolerance_px,
        cell_px=cell_px,
        most=_PLACES,
    )
    found, start = fix(image, device=device), np.array([*away, 0.0])
    return found._replace(
        pose=found.pose + start, placement=found.placement + away, runner_up_pose=found.runner_up_pose + start
    )


def template_edges(template: npt.NDArray[Any], ruler: RulerEdges, *, device: Device | None = None) -> KnownEdges:
    """Find edges in a picture: the steepest place of each tile, measured by a ruler across it; in random order.

    Those stay that one edge alone makes: where a ruler finds exactly one, as near as a pixel and a half.
    """
    smooth = cv2.GaussianBlur(template.astype(np.float32), (0, 0), ruler.smoothing_px, borderType=cv2.BORDER_REPLICATE)
    gradient = np.stack([cv2.Scharr(smooth, cv2.CV_32F, *way, scale=1 / 32) for way in ((1, 0), (0, 1))], axis=-1)
    steep = np.hypot(gradient[..., 0], gradient[..., 1])
    rows, columns = (each // _TILE for each in steep.shape)
    tiles = steep[: rows * _TILE, : columns * _TILE].reshape(rows, _TILE, columns, _TILE).swapaxes(1, 2)
    place = np.argmax(tiles.reshape(rows, columns, -1), axis=-1)
    at = np.stack([np.arange(columns) * _TILE + place % _TILE, np.arange(rows)[:, None] * _TILE + place // _TILE], -1)
    at = at.reshape(-1, 2)
    slope = gradient[at[:, 1], at[:, 0]].astype(np.float64)
    height = np.hypot(*slope.T)
    # Half of what a sharp step of the threshold has: the ruler decides.
    good = height > 0.5 * ruler.threshold / (math.sqrt(2.0 * math.pi) * ruler.smoothing_px)
    at, way = at[good].astype(np.float64), slope[good] / height[good, None]
    if not len(at):
        return KnownEdges(np.empty((0, 2)), np.empty((0, 2)))
    taps = math.ceil(3.0 * ruler.smoothing_px / ruler.step_px)
    across = replace(ruler, length=2 * taps + 9)
    edges = across(template, np.concatenate([at, way], axis=1).astype(np.float32), device=device)
    kept = np.flatnonzero((edges.status == 0) & (np.abs(edges.position) < 1.5))
    kept = np.random.default_rng(len(kept)).permutation(kept)
    return KnownEdges(at[kept] + edges.position[kept, None] * way[kept], way[kept])
