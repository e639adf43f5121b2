"""Pose of a camera over a board: distance of the features from the placement point, and spread of their directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.pose.feature_pose import CameraFeatures, EstimateFeaturePose
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling.maps import board_pose
from gpuvision.profiling.maps.board_pose import EXTENT, OFFSETS, PIXEL, RULER, SHAPE
from gpuvision.profiling.maps.stability import Axis, Floats, Problem

_RATIO = 0.5  # background over the contrast
_BLOBS = FindBlobs(threshold=20.0)  # there are no fiducials
_SOLVER = SolvePose(loss="least_squares", max_iterations=20)
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the camera's position over the distance of the placement point and the spread of normals."""
    axes = (
        Axis("distance of the placement point / extent of the features", 0.1, 1e5),
        Axis("spread of the normals [rad]", 3e-3, 1.5),
    )
    return Problem(axes, "extent of the features", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    """Return the errors; frames of one place show the same features, which are tables of one bound operation."""
    boards: dict[tuple[float, ...], tuple[EstimateFeaturePose, Floats, Floats]] = {}
    errors = np.empty(len(places))
    for number, place in enumerate(places):
        key = tuple(place.tolist())
        if key not in boards:
            boards[key] = _board(float(place[0]), float(place[1]), rng)
        operation, normal, point = boards[key]
        motion = board_pose.draw_motion(rng)
        # The camera is expected over the origin, with its columns along x.
        image = board_pose.edge_image(normal, point, motion, _RATIO)
        expected, corner = np.zeros(3, np.float64 if device.has_double else np.float32), np.zeros(2, np.float32)
        found = to_numpy(operation(image, expected, corner, device=device).pose)
        middle, (centre, across) = 0.5 * (np.array(SHAPE[::-1]) - 1.0), _features(normal, point)
        rulers = np.concatenate([middle + centre * (1.0, -1.0) / PIXEL, across * (1.0, -1.0)], axis=1)
        x, y, turn = board_pose.reference_motion(image, rulers, normal, point, motion)
        # The camera moves against the board.
        c, s = np.cos(turn), np.sin(turn)
        errors[number] = np.linalg.norm(np.add(found[:2], (c * x + s * y, c * y - s * x))) / EXTENT
    return errors


def _board(away: float, spread: float, rng: np.random.Generator) -> tuple[EstimateFeaturePose, Floats, Floats]:
    """Draw lines, and return the operation with rulers across them, the normals and the points of the lines."""
    normal, point = board_pose.draw_lines(spread, rng)
    heading = rng.uniform(-np.pi, np.pi)
    x, y = EXTENT * away * np.cos(heading), EXTENT * away * np.sin(heading)
    centre, across = _features(normal, point)
    kind = np.tile((1.0, 0.0, 0.0, 0.0), (len(centre), 1))  # single edges, brighter along the normal
    features = CameraFeatures(
        rulers=tuple(map(tuple, np.concatenate([centre - (x, y), across, kind], axis=1).tolist())),
        matched=(),
        drilled=(),
        placement=(x, y),
        pixel_size=PIXEL,
        frame_shape=SHAPE,
    )
    operation = EstimateFeaturePose(
        features=features, ruler=replace(RULER, per_ruler=True), matched=_BLOBS, drilled=_BLOBS, solver=_SOLVER
    )
    return operation, normal, point


def _features(normal: Floats, point: Floats) -> tuple[Floats, Floats]:
    """Return centres (rulers, 2) [m] and normals (rulers, 2) of the rulers of all lines."""
    way = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)
    centre = (point[:, None] + OFFSETS[:, None] * way[:, None]).reshape(-1, 2)
    return centre, np.repeat(normal, len(OFFSETS), axis=0)


def _bound(places: Floats) -> Floats:
    # As in the map of the board's pose; in addition the features have coordinates relative to the placement point, with
    # half an epsilon of their distance, and so has the middle of the camera.
    edge = 2.0 * PIXEL * board_pose.edge_error(_RATIO) / EXTENT
    return np.asarray((edge + 2.0 * _EPS * places[:, 0]) * board_pose.condition(places[:, 1]))
