"""The local fix: from a frame to a board's pose in one launch, along rulers that were laid over the artwork's lines.

Rulers find edges, the edges of a line make a robust line, and the lines make a robust pose with its covariance at the
placement point.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Define, Device, Launch, LaunchBuilder, capacity
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.matching.robust import subsets
from gpuvision.operation import VisionOperation

Float64 = npt.NDArray[np.float64]
RULER = ("x_px", "y_px", "cosine", "sine", "u", "v", "u_per_px", "v_per_px", "bend")
LINE = ("normal_x", "normal_y", "x", "y", "sigma", "grows")
_GROUP, _MOST_RULERS = 64, 2048


class Fix(NamedTuple):
    """A pose, and what it was made from.

    Attributes
    ----------
    pose, deformation, placement, covariance, scale, spread, condition, rank, inliers, status, etch, agreement, leverage
        As in `BoardPose`, of one pose; of two rows for each line, or one where a line has one ruler.
    residuals, weights
        (lines, 2): of the rows of each line, either side of its middle [m]; (lines, 1) where it has one ruler.
    edges
        (lines, each) positions along the rulers [px]; NaN where there is none.
    edge_status
        (lines, each) uint8 `Status` flags of the rulers, as in `Edges`.
    edge_weights
        (lines, each) what each edge weighs in its line, 0 to 1.
    """

    pose: Any
    deformation: Any
    placement: Any
    covariance: Any
    residuals: Any
    weights: Any
    scale: Any
    spread: Any
    condition: Any
    rank: Any
    inliers: Any
    status: Any
    etch: Any
    agreement: Any
    leverage: Any
    edges: Any
    edge_status: Any
    edge_weights: Any


def place_rulers(
    normal: Any, point: Any, along: Any, board_to_image: Any, sigma: Any = 0.0, grows: Any = 0.0
) -> tuple[Any, Any]:
    """Lay rulers across lines of the artwork.

    Parameters
    ----------
    normal, point
        (lines, 2) unit normals and points of the lines [m].
    along
        (lines, each) where on each line its rulers lie, from the point on along (normal_y, -normal_x) [m]; NaN: no
        ruler.
    board_to_image
        3 x 3, the board where it is expected to the (undistorted) image [m to px].
    sigma
        (lines,) standard deviation of a line's place on the board, all its rulers together and every line on its own
        [m]: rough edges, a mask's opening, silk.
    grows
        (lines,) by how much of the board's etching a line lies further along its normal, for a solver with ``etch``: 1
        out of the copper, 0 for the middle of a trace.

    Returns
    -------
    rulers : numpy.ndarray
        float32 (lines, each, 9): centre and direction in the image, and where its pixels lie in the line's own frame.
    lines : numpy.ndarray
        float32 (lines, 6).
    """
    normal, point, along = (np.asarray(each, np.float64) for each in (normal, point, along))
    matrix = np.asarray(board_to_image, np.float64)
    way = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)[:, None]
    across, origin = normal[:, None], point[:, None]
    on = origin + along[..., None] * way
    centre = _through(matrix, on)
    # What a short way along the normal becomes: the direction of the ruler.
    weight = on @ matrix[2, :2] + matrix[2, 2]
    step = (across @ matrix[:2, :2].T - centre * (across @ matrix[2, :2])[..., None]) / weight[..., None]
    direction = step / np.linalg.norm(step, axis=-1, keepdims=True)
    # Back on the board: (start + s slope) / (1 + s bend), s pixels from the ruler's centre.
    back = np.linalg.inv(matrix)
    start, slope = centre @ back[:, :2].T + back[:, 2], direction @ back[:, :2].T
    per = 1.0 / start[..., 2:]
    bend = slope[..., 2:] * per
    offset = start[..., :2] * per - origin
    moved = slope[..., :2] * per - origin * bend
    frame = [np.sum(each * axis, axis=-1, keepdims=True) for each in (offset, moved) for axis in (way, across)]
    rulers = np.concatenate([centre, direction, *frame, bend], axis=-1).astype(np.float32)
    more = [np.broadcast_to(np.asarray(each, np.float64), normal.shape[:1])[:, None] for each in (sigma, grows)]
    return rulers, np.concatenate([normal, point, *more], axis=-1).astype(np.float32)


def _through(matrix: Float64, points: Float64) -> Float64:
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


@dataclass(frozen=True, kw_only=True)
class BoardPoseEstimator(VisionOperation[Fix]):
    """A pose from a frame: ``op(image, rulers, lines) -> Fix``.

    The image is as `RulerEdges` takes it; the rulers float32 of (lines, each, 9) and the lines float32 of (lines, 6)
    are those of `place_rulers`. The pose is that of the artwork where it is seen on the board's plane, 0 where it is as
    expected.

    Parameters
    ----------
    ruler
        How edges are found: any choice but ``"all"``; its ``noise`` says what the edges' standard deviations are.
    lines, each
        How many lines there are, and rulers of each.
    solver
        How the lines make a pose; its loss, bend and scale hold for the edges of a line as well. Its precision must be
        single, and no pose to start from is taken.

    Raises
    ------
    TypeError, ValueError
        A parameter is not one of these.

    Notes
    -----
    Error: places are taken relative to their line's point, so that single precision costs 1e-7 of a line's length;
    the pose has the error of `SolvePose`. A ruler's pixel is taken for a straight step of the board's plane, which is
    exact for a homography; of rulers laid through a lens (`RulerEdges.model`) the undistorted image is meant.
    """

    Result: ClassVar[type[Any]] = Fix

    ruler: RulerEdges
    lines: int
    each: int
    solver: SolvePose = field(default_factory=SolvePose)

    def __post_init__(self) -> None:
        if not isinstance(self.ruler, RulerEdges) or not isinstance(self.solver, SolvePose):
            raise TypeError("BoardPoseEstimator takes a RulerEdges as ruler and a SolvePose as solver")
        if self.ruler.choice == "all":
            raise ValueError("BoardPoseEstimator.ruler has choice='all', expected one edge of a ruler")
        if self.solver.precision == "double" or self.solver.near:
            raise ValueError("BoardPoseEstimator.solver: expected single precision, and no pose to start from")
        for name, least, most in (("lines", 2, 512), ("each", 1, 256)):
            if not isinstance(getattr(self, name), int) or not least <= getattr(self, name) <= most:
                raise ValueError(f"BoardPoseEstimator.{name} is {getattr(self, name)!r}, expected {least} to {most}")
        if self.lines * self.each > _MOST_RULERS:
            raise ValueError(
                f"BoardPoseEstimator: {self.lines} lines of {self.each} rulers, expected {_MOST_RULERS} or fewer in all"
            )
        if self._rows_of_line * self.lines < self.solver.unknowns:
            raise ValueError(
                f"BoardPoseEstimator.lines is {self.lines}: too few for the freedom '{self.solver.freedom}'"
            )

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        edges = self._edges(device, shape, dtype)
        build = LaunchBuilder(self, device, shape, dtype, variant=self.ruler.variant)
        work = build.work(1, each=1, group=_GROUP, grouping="per_element")
        count, solver = self._rows_of_line * self.lines, self.solver
        pairs = subsets(max(self.each, 2), 2, solver.trials) if self.each > 1 else np.zeros((1, 2), np.int32)
        found = (self.lines, self.each)
        shapes = solver.shapes((), (self.lines, self._rows_of_line))
        shapes |= dict.fromkeys(("edges", "edge_status", "edge_weights"), found)
        limits = (*solver.limits, *solver.placement, solver.certainty_of_etch)
        return build.launch(
            "board_pose/board_pose.cl",
            "board_pose",
            work=work,
            more_inputs=[((*found, len(RULER)), build.real), ((self.lines, len(LINE)), build.real)],
            outputs=build.outputs(shapes, rank=np.int32, inliers=np.int32, edge_status=np.uint8),
            defines={**edges.defines, **solver.defines(count), **self._capacities()},
            arguments=[
                *edges.arguments[:4],
                np.int32(self.lines),
                np.int32(self.each),
                pairs.ravel(),
                np.int32(len(pairs)),
                solver.starts(count, vectors=work.vectors),
                np.int32(solver.trials),
                np.int32(solver.steps),
                *map(np.float32, limits),
            ],
            passes_once=work.vectors,
        )

    def _edges(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Return what the rulers alone would launch: their table, model and defines."""
        return replace(self.ruler, count=self.lines * self.each).launch(device, shape, dtype)

    @property
    def _rows_of_line(self) -> int:
        return 2 if self.each > 1 else 1

    def _capacities(self) -> dict[str, Define]:
        """Return the sizes of the arrays."""
        return {"EACH": capacity(self.each), "ROOM": capacity(self.lines * self.each)}
