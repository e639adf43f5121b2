"""Coarse registration of a board from its artwork, and of an image to a template image, from a large initial error.

`prepare_board_registration` prepares a search for all images of a board. `register_images` takes the edges of a
template image. Both use `gpuvision.matching.pose.coarse_registration.CoarseRegistration`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.candidates import find_ruler_candidates
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import RulerEdges, best_smoothing
from gpuvision.matching.pose.coarse_registration import MAX_RULERS, CoarseRegistration
from gpuvision.matching.pose.motion import KnownEdges, apply_homography
from gpuvision.matching.pose.pose import Transform
from gpuvision.matching.pose.registration_result import Registration
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
_MAX_RULERS, _MAX_POINTS = 512, 512  # known edges for the rulers and for the grid search (cost)
# With fewer rulers at the best smoothing, a smaller one is used, which needs less room between edges (chosen).
_MIN_RULERS = 128
# Verified candidates of an image: its grid cells are larger than for a board, so that there are fewer candidates.
_IMAGE_CANDIDATES = 24
_TILE_PX = 8  # side of the squares of a template that give one edge each
_MAX_OFFSET_PX = 1.5  # largest distance of a template's edge from the steepest pixel; beyond it, it is another edge

__all__ = [
    "CoarseRegistration",
    "KnownEdges",
    "Registration",
    "find_template_edges",
    "prepare_board_registration",
    "register_images",
]


# ---- a board -------------------------------------------------------------------------------------------------


def prepare_board_registration(
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
    """Prepare the coarse registration of a board, for all its images.

    Parameters
    ----------
    artwork : Artwork
        The side in view of the camera.
    board_to_image : array_like
        (3, 3): homography from the board at its nominal pose to the (undistorted) image [m to px].
    shape : pair of ints
        Rows and columns of the images.
    placement : pair of floats, optional
        Point of the artwork [m] to which the covariance refers; None: the point that is nominally at the image centre.
    shift, angle : float
        Search range: largest offset of the placement point in x and in y [m], default 2 mm, and largest angle of the
        board [rad], default 5 degrees.
    blur_px : float
        Standard deviation of the edges' blur [px], default 1.
    threshold : float
        Least height of an edge [grey levels], default 10.
    tolerance_px, cell_px : float, int
        As in `CoarseRegistration`; the tolerance should cover the etch bias too. Defaults 1.0 and 2.

    Returns
    -------
    CoarseRegistration
        Its lengths are metres. Without enough straight edges in the image its result is NO_DATA.

    Raises
    ------
    ValueError
        The homography is not 3 x 3 and invertible.
    """
    matrix = np.asarray(board_to_image, np.float64)
    if matrix.shape != (3, 3) or np.linalg.matrix_rank(matrix) < 3:
        raise ValueError("board_to_image must be 3 x 3 and invertible")
    view = _board_in_view(matrix, shape)
    place = view.centre if placement is None else placement
    reach = shift + 2.0 * math.sin(min(angle, math.pi) / 2.0) * np.hypot(*(view.high - view.low)) / 2.0
    region = (view.low - reach, view.high + reach)
    rulers, smoothing_px = _ruler_edges(artwork, region, place, view.pixel, blur_px)
    return CoarseRegistration(
        search=_edge_points(artwork, view.low, view.high, cell_px * view.pixel),
        rulers=rulers,
        to_image=matrix,
        placement=place,
        shift=shift,
        angle=angle,
        ruler=RulerEdges(threshold=threshold, width=5, smoothing_px=smoothing_px),
        tolerance_px=tolerance_px,
        cell_px=cell_px,
    )


class _BoardInView(NamedTuple):
    """Part of the board in the image: bounding box [m], image centre on the board [m], mean size of a pixel [m]."""

    low: Float64
    high: Float64
    centre: tuple[float, float]
    pixel: float


def _board_in_view(board_to_image: Float64, shape: tuple[int, int]) -> _BoardInView:
    """Return the part of the board that an image of (rows, columns) shows."""
    rows, columns = shape
    corners = np.array([(0, 0), (columns - 1, 0), (0, rows - 1), (columns - 1, rows - 1)], np.float64)
    to_board = np.asarray(np.linalg.inv(board_to_image))
    seen = apply_homography(to_board, np.concatenate([corners, corners.mean(axis=0)[None]]))
    pixel = math.sqrt(abs(_area(seen[:4])) / max((columns - 1) * (rows - 1), 1))
    return _BoardInView(seen[:4].min(axis=0), seen[:4].max(axis=0), (seen[4, 0], seen[4, 1]), pixel)


def _ruler_edges(
    artwork: Artwork, region: tuple[Float64, Float64], place: Any, pixel: float, blur_px: float
) -> tuple[KnownEdges, float]:
    """Return edges for the rulers, at most `_MAX_RULERS`, and the smoothing of the rulers [px]."""
    smoothing_px = best_smoothing(blur_px)
    single = _singles(artwork, region, place, Imaging(pixel=pixel, blur_px=blur_px, shift=2.0 * pixel, angle=0.0))
    if len(single.point) < _MIN_RULERS:
        # Other edges are too near for the best smoothing, sqrt(5) times the blur. Smooth by the blur itself: blur and
        # smoothing are then sqrt(2) blurs together, instead of sqrt(6), as in an `Imaging` of blur / sqrt(3).
        smoothing_px = blur_px
        narrow = Imaging(pixel=pixel, blur_px=blur_px / math.sqrt(3.0), shift=2.0 * pixel, angle=0.0)
        single = _singles(artwork, region, place, narrow)
    chosen = _some(np.arange(len(single.point)), _MAX_RULERS)
    return KnownEdges(single.point[chosen], single.normal[chosen]), smoothing_px


def _singles(artwork: Artwork, region: tuple[Float64, Float64], place: Any, imaging: Imaging) -> KnownEdges:
    """Return the edges on which a ruler across a single edge has enough room."""
    placed = find_ruler_candidates(artwork, region, place, imaging)
    return KnownEdges(placed.point[~placed.pair], placed.normal[~placed.pair])


def _area(corners: Float64) -> float:
    """Return the signed area of a quadrilateral on the board from its corners in reading order."""
    a, b = corners[3] - corners[0], corners[2] - corners[1]
    return float(a[0] * b[1] - a[1] * b[0]) / 2.0


def _some(numbers: npt.NDArray[np.int64], max_count: int) -> npt.NDArray[np.int64]:
    """Return up to ``max_count`` of the numbers, spread evenly, the same ones in every run."""
    if len(numbers) <= max_count:
        return numbers
    return np.sort(np.random.default_rng(len(numbers)).choice(numbers, max_count, replace=False))


def _edge_points(artwork: Artwork, low: Float64, high: Float64, step: float) -> KnownEdges:
    """Return points on straight edges and round pads within bounds: one per step [m], ``_MAX_POINTS`` at most."""
    edges = artwork.edges
    count = np.ceil(edges.length / step).astype(np.int64)
    which = np.repeat(np.arange(len(count)), count)
    part = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    points = [edges.start[which] + part[:, None] * (edges.end - edges.start)[which]]
    normals = [edges.normal[which]]
    for pad in artwork.pads:
        if pad.shape == "circle" and not pad.opening < 0.0:
            angle = np.linspace(0.0, 2.0 * math.pi, math.ceil(math.pi * pad.size[0] / step), endpoint=False)
            direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            points.append(pad.centre + 0.5 * pad.size[0] * direction)
            normals.append(direction)
    point, normal = np.concatenate(points), np.concatenate(normals)
    inside = np.flatnonzero(np.all((point >= low) & (point <= high), axis=1))
    chosen = _some(inside, _MAX_POINTS)
    return KnownEdges(point[chosen], normal[chosen])


# ---- a picture -----------------------------------------------------------------------------------------------


def register_images(
    image: npt.NDArray[Any],
    template: npt.NDArray[Any],
    *,
    placement: tuple[float, float] | None = None,
    shift_px: float = 64.0,
    angle: float = math.radians(10.0),
    blur_px: float = 1.0,
    threshold: float = 20.0,
    transform: Transform = "affine",
    tolerance_px: float = 1.0,
    cell_px: int = 4,
    etch_bias_px: float = 1.0,
    device: Device | None = None,
) -> Registration:
    """Find the points of a template image in another image; lengths are pixels, theta turns from x towards y.

    Parameters
    ----------
    image, template : numpy.ndarray
        uint8, uint16 or float32 (rows, columns). Images of different size are expected to have the same centre.
    placement : pair of floats, optional
        Point of the template to which the covariance and the search range refer; None: its centre.
    shift_px, angle : float
        Search range: largest offset of the placement point in x and in y [px], default 64, and largest angle [rad],
        default 10 degrees.
    blur_px, threshold : float
        As in `prepare_board_registration`. Defaults 1.0 and 20.0.
    transform, tolerance_px, cell_px : {"rigid", "similarity", "affine"}, float, int
        As in `CoarseRegistration`. Images of two line cameras, or of two boards, also differ in their scales along x
        and y; the default is therefore "affine".
    etch_bias_px : float
        Standard deviation of the displacement of all edges along their normals [px], above 0, default 1: copper etched
        wider or narrower, another threshold of a binary image. It is solved for; positive where bright areas are
        smaller than in the template.
    device : Device, optional
        Where to run; None: `Device.best`.

    Returns
    -------
    Registration
        AMBIGUOUS also where its ``misfit`` exceeds the tolerance: the edges fit a larger transform significantly
        better. The scale of a pair that is registered as "rigid" shows in this way.

    Raises
    ------
    TypeError, ValueError
        An array or a parameter is out of its range or of a wrong type.

    Examples
    --------
    >>> import gpuvision as gv
    >>> found = gv.register_images(image, template, transform="rigid")  # doctest: +SKIP
    >>> x, y, theta = found.pose  # doctest: +SKIP
    """
    place = ((template.shape[1] - 1) / 2.0, (template.shape[0] - 1) / 2.0) if placement is None else placement
    ruler = RulerEdges(threshold=threshold, width=7, smoothing_px=best_smoothing(blur_px), ambiguity=0.7)
    edges = find_template_edges(template, ruler, device=device)
    away = (np.array(image.shape[::-1], np.float64) - template.shape[::-1]) / 2.0
    fix = CoarseRegistration(
        search=KnownEdges(*(each[:_MAX_POINTS] for each in edges)),
        rulers=KnownEdges(*(each[:MAX_RULERS] for each in edges)),
        to_image=np.array([[1.0, 0.0, away[0]], [0.0, 1.0, away[1]], [0.0, 0.0, 1.0]]),
        placement=place,
        shift=shift_px,
        angle=angle,
        ruler=replace(ruler, ambiguity=None),
        transform=transform,
        tolerance_px=tolerance_px,
        cell_px=cell_px,
        max_candidates=_IMAGE_CANDIDATES,
        etch_bias_sigma=etch_bias_px,
    )
    found, start = fix(image, device=device), np.array([*away, 0.0])
    if found.misfit > tolerance_px:
        found = found._replace(status=found.status | Status.AMBIGUOUS)
    return found._replace(
        pose=found.pose + start, placement=found.placement + away, runner_up_pose=found.runner_up_pose + start
    )


def find_template_edges(template: npt.NDArray[Any], ruler: RulerEdges, *, device: Device | None = None) -> KnownEdges:
    """Find isolated edges in an image: the steepest pixel of each tile, measured by a ruler across it; in random order.

    Edges are kept where the ruler finds exactly one edge, within 1.5 px of the steepest pixel.

    Parameters
    ----------
    template
        uint8, uint16 or float32 (rows, columns).
    ruler
        Edge measurement of single edges; this function sets its length.
    device
        Where to run; None: `Device.best`.
    """
    smooth = cv2.GaussianBlur(template.astype(np.float32), (0, 0), ruler.smoothing_px, borderType=cv2.BORDER_REPLICATE)
    gradient = [cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1))]
    steep = cv2.magnitude(*gradient)
    rows, columns = (each // _TILE_PX for each in steep.shape)
    tiles = steep[: rows * _TILE_PX, : columns * _TILE_PX].reshape(rows, _TILE_PX, columns, _TILE_PX).swapaxes(1, 2)
    place = np.argmax(tiles.reshape(rows, columns, -1), axis=-1)
    x = np.arange(columns) * _TILE_PX + place % _TILE_PX
    y = np.arange(rows)[:, None] * _TILE_PX + place // _TILE_PX
    at = np.stack([x, y], axis=-1).reshape(-1, 2)
    slope = np.stack([each[at[:, 1], at[:, 0]] for each in gradient], axis=-1).astype(np.float64)
    height = np.hypot(*slope.T)
    # Half of the gradient of a sharp step of the threshold: the ruler makes the decision.
    good = height > 0.5 * ruler.threshold / (math.sqrt(2.0 * math.pi) * ruler.smoothing_px)
    at, order = at[good].astype(np.float64), slope[good] / height[good, None]
    if not len(at):
        return KnownEdges(np.empty((0, 2)), np.empty((0, 2)))
    taps = math.ceil(3.0 * ruler.smoothing_px / ruler.step_px)
    across = replace(ruler, length=2 * taps + 9)
    edges = across(template, np.concatenate([at, order], axis=1).astype(np.float32), device=device)
    position = to_numpy(edges.position)
    kept = np.flatnonzero((to_numpy(edges.status) == 0) & (np.abs(position) < _MAX_OFFSET_PX))
    kept = np.random.default_rng(len(kept)).permutation(kept)
    return KnownEdges(at[kept] + position[kept, None] * order[kept], order[kept])
