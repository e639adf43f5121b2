"""Fused pose of a board: background over the contrast of the edges, and spread of the directions of the lines.

A frame has a tile for each line, with one blurred edge and two calipers (rulers) across it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator, place_rulers
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.ruler import find_edges, profile

PIXEL, SHAPE, LINES = 1e-5, (96, 144), 6  # [m], [px]
EXTENT = PIXEL * SHAPE[1]
OFFSETS = 8.0 * PIXEL * np.array([-1.0, 1.0])  # of the rulers of a line
RULER = RulerEdges(threshold=2.0, length=31, width=3, smoothing_px=1.5)
_TILE, _BLUR, _CONTRAST = 48, 1.0, 100.0  # [px], [px], [levels]
_SOLVER = SolvePose(loss="least_squares", max_iterations=20)
_ESTIMATE = BoardPoseEstimator(ruler=RULER, lines=LINES, rulers_per_line=len(OFFSETS), solver=_SOLVER)
_BOARD_TO_IMAGE = np.array(
    [[1.0 / PIXEL, 0.0, 0.5 * (SHAPE[1] - 1)], [0.0, -1.0 / PIXEL, 0.5 * (SHAPE[0] - 1)], [0.0, 0.0, 1.0]]
)
_STEPS = 12
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the position of the board's middle over the background and the spread of the normals."""
    axes = Axis("background / contrast", 1e-2, 1e4), Axis("spread of the normals [rad]", 3e-3, 1.5)
    return Problem(axes, "extent of the lines", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    for number, (ratio, spread) in enumerate(places):
        normal, point = draw_lines(spread, rng)
        pose = draw_motion(rng)
        image = edge_image(normal, point, pose, ratio)
        rulers, lines = place_rulers(normal, point, np.tile(OFFSETS, (LINES, 1)), _BOARD_TO_IMAGE)
        found = to_numpy(_ESTIMATE(image, rulers, lines, device=device).placement)
        exact = reference_motion(image, rulers.reshape(-1, rulers.shape[-1])[:, :4], normal, point, pose)
        errors[number] = np.linalg.norm(found - exact[:2]) / EXTENT
    return errors


def draw_lines(spread: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Draw unit normals (lines, 2) and points (lines, 2) [m] of lines, one in each tile of the frame."""
    angle = rng.uniform(-np.pi, np.pi) + spread * rng.permutation(np.linspace(-1.0, 1.0, LINES))
    row, column = np.divmod(np.arange(LINES), SHAPE[1] // _TILE)
    centre = np.stack([column - 1.0, 0.5 - row], axis=-1) * _TILE + rng.uniform(-2.0, 2.0, (LINES, 2))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1), PIXEL * centre


def draw_motion(rng: np.random.Generator) -> Floats:
    """Draw a motion of up to 1 px and 0.01 rad about the middle of the frame: x, y [m] and angle."""
    return np.asarray(rng.uniform(-1.0, 1.0, 3) * (PIXEL, PIXEL, 0.01))


def edge_image(normal: Floats, point: Floats, motion: Floats, ratio: float) -> npt.NDArray[np.float32]:
    """Return the frame of the moved lines, on a background of `ratio` contrasts."""
    c, s = np.cos(motion[2]), np.sin(motion[2])
    turn = np.array([[c, -s], [s, c]])
    moved, across = point @ turn.T + motion[:2], normal @ turn.T
    image = np.empty(SHAPE)
    for number in range(LINES):
        row, column = np.multiply(np.divmod(number, SHAPE[1] // _TILE), _TILE)
        y, x = np.mgrid[row : row + _TILE, column : column + _TILE].astype(np.float64)
        seen = np.stack([x - 0.5 * (SHAPE[1] - 1), 0.5 * (SHAPE[0] - 1) - y], axis=-1) - moved[number] / PIXEL
        level = _CONTRAST * (ratio + ndtr(seen @ across[number] / _BLUR))
        image[row : row + _TILE, column : column + _TILE] = level
    return image.astype(np.float32)


def reference_motion(
    image: npt.NDArray[np.float32], rulers: npt.NDArray[Any], normal: Floats, point: Floats, motion: Floats
) -> Floats:
    """Return the motion of least squares through the edges along the rulers (n, 4), by Gauss-Newton from the true one.

    The rulers of a line follow one another. The variance of an edge follows from its gradients.
    """
    edges = []
    for ruler in rulers.astype(np.float64):
        grey, _ = profile(image.astype(np.float64), ruler, RULER.length, RULER.width)
        found = find_edges(grey, RULER.smoothing_px, RULER.threshold, 1.0, ruler, RULER.width)
        edges.append(max(found, key=lambda edge: abs(edge["gradient"])))
    position, variance, gradient = (np.array([e[name] for e in edges]) for name in ("position", "variance", "gradient"))
    pixel = rulers[:, :2] + position[:, None] * rulers[:, 2:].astype(np.float64)
    seen = PIXEL * np.stack([pixel[:, 0] - 0.5 * (SHAPE[1] - 1), 0.5 * (SHAPE[0] - 1) - pixel[:, 1]], axis=-1)
    across, on = (np.repeat(each, len(rulers) // LINES, axis=0) for each in (normal, point))
    certainty = np.abs(gradient) / (variance * np.exp(0.5 / variance))
    pose = np.array(motion)
    for _ in range(_STEPS):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        back = (seen - pose[:2]) @ np.array([[c, -s], [s, c]])
        by = across @ np.array([[c, s], [-s, c]])  # minus the derivative by the shift
        turn = across[:, 0] * back[:, 1] - across[:, 1] * back[:, 0]  # the derivative by the angle
        design = np.column_stack([by, -turn / EXTENT]) * certainty[:, None]
        residual = np.sum(across * (back - on), axis=-1) * certainty
        pose = pose + np.linalg.lstsq(design, residual, rcond=None)[0] * (1.0, 1.0, 1.0 / EXTENT)
    return pose


def edge_error(ratio: npt.ArrayLike) -> Floats:
    """Return the error of an edge [px] by the error model of the rulers, on a background of `ratio` contrasts."""
    # 1e-4 px, and 4 epsilon of the levels in the gradients (map of the rulers).
    spread = np.hypot(_BLUR, RULER.smoothing_px)
    return np.asarray(1e-4 + 4.0 * _EPS * (1.0 + np.asarray(ratio)) * np.sqrt(2.0 * np.pi) * spread**3)


def condition(spread: Floats) -> Floats:
    """Return the ratio of the standard deviations of shifts along and across lines of nearly one direction."""
    return np.asarray(1.0 + np.sqrt(3.0) / spread)


def _bound(places: Floats) -> Floats:
    # Each edge errs by the error model of the rulers, and moves the offset and the angle of its line by up to as much.
    # Least squares multiplies the errors by the condition at most.
    return np.asarray(2.0 * PIXEL * edge_error(places[:, 0]) * condition(places[:, 1]) / EXTENT)
