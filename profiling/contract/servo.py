"""Contract of poses of a camera over a board: rulers across a square, in a region of the image and from behind.

The reference places the rulers in float64, finds their edges with the reference of the rulers, and is the fixed point
of reweighted least squares from the true motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.feature_pose import CameraFeatures, EstimateFeaturePose
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.profiling.contract.board_pose import edge_sigmas, fixed_point
from gpuvision.profiling.contract.ruler import strongest_edge
from gpuvision.profiling.feature_pose import MOTION, PIXEL, PREDICTED, scene
from gpuvision.status import Status

LIMITS = {
    "EstimateFeaturePose": (
        equal("status", "feature_status", "inliers", reason="comparisons only, except within rounding of a threshold"),
        Limit(
            ("pose",), 1e-4, 1e-4, "size of a pixel x sum over the rulers of their influence on the pose [m], [rad]",
            "error of RulerEdges on each edge, in the worst combination of signs; the rounding of the pose is a "
            "thousandth of it",
        ),
    )
}  # fmt: skip
_SIZE, _THRESHOLD, _NOISE = 128, 20.0, 2.0
_RULER = RulerEdges(threshold=_THRESHOLD, length=41, width=5, smoothing_px=1.0, noise=_NOISE)
_SOLVER = SolvePose(max_iterations=60)
Floats = npt.NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Yield a frame, a frame in floats with rulers that see no edge, a region of an image, and a board from behind."""
    yield _case("frame, uint8", "uint8")
    yield _case("edges of the other polarity, float32", "float32", absent=5)
    yield _case("region of an image", "uint8", full=(200, 180))
    yield _case("board from behind", "uint8", mirrored=True)


def _case(
    name: str, dtype: str, *, full: tuple[int, int] = (_SIZE, _SIZE), mirrored: bool = False, absent: int = 0
) -> Case:
    frame, features = scene(_SIZE)
    if mirrored:
        frame = np.ascontiguousarray(frame[:, ::-1])
    given = frame.astype(dtype)
    point, normal = features.point - features.placement, features.normal
    kinds = np.zeros((len(point), 4))  # polarity, least and greatest spacing, etch factor
    kinds[:, 0] = -1.0
    kinds[:absent, 0] = 1.0
    blobs = FindBlobs(threshold=_THRESHOLD)
    operation = EstimateFeaturePose(
        features=CameraFeatures(
            rulers=tuple(map(tuple, np.concatenate([point, normal, kinds], axis=1).tolist())),
            matched=(),
            drilled=(),
            placement=(float(features.placement[0]), float(features.placement[1])),
            pixel_size=PIXEL,
            frame_shape=full,
            mirrored=mirrored,
        ),
        ruler=replace(_RULER, per_ruler=True, polarity="any"),
        matched=blobs,
        drilled=blobs,
        solver=_SOLVER,
    )
    seen = kinds[:, 0] < 0.0
    pose, influence, inliers = _pose(given, point[seen], normal[seen], mirrored)
    exact: dict[str, npt.NDArray[Any]] = {
        "pose": pose,
        "status": np.array(0),
        "inliers": np.array(inliers),
        "feature_status": np.where(seen, 0, int(Status.LOW_SIGNAL)),
    }
    # The frame lies around the middle of the full image.
    corner = np.array([(full[1] - _SIZE) / 2, (full[0] - _SIZE) / 2], np.float32)
    return Case("EstimateFeaturePose", name, operation, (given, PREDICTED, corner), exact, {"pose": PIXEL * influence})


def _pose(frame: npt.NDArray[Any], point: Floats, normal: Floats, mirrored: bool) -> tuple[Floats, Floats, int]:
    """Return the pose of the camera, the sum over its rows of their influence on it, and their number of inliers.

    The camera is expected above the placement point, with its columns along x.
    """
    side = np.array([-1.0 if mirrored else 1.0, -1.0])
    placed = np.concatenate([0.5 * (_SIZE - 1) + point * side / PIXEL, normal * side], axis=1)
    edges = [strongest_edge(frame, each, _RULER) for each in placed]
    moved = normal * (PIXEL * np.array([each["position"] for each in edges])[:, None])
    rows = line_rows(normal, point, point + moved, PIXEL * edge_sigmas(edges, _RULER, frame.dtype))
    turn = -MOTION[2]
    start = np.array([*(-_turned(MOTION[:2], turn)), turn])
    extent = float(np.max(np.ptp(point, axis=0)))
    fit = fixed_point(np.asarray(rows, np.float64), start, _SOLVER, extent)
    x, y, turn = fit.placed
    c, s = np.cos(turn), np.sin(turn)
    moved_camera = np.array([*(-_turned(fit.placed[:2], -turn)), -turn])
    # Derivative of the camera's pose by the motion (the signs do not matter).
    by_motion = np.abs([[c, s, c * y - s * x], [-s, c, -c * x - s * y], [0.0, 0.0, 1.0]])
    return np.asarray(PREDICTED + moved_camera), by_motion @ fit.influence.sum(axis=1), fit.inliers


def _turned(point: Floats, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
