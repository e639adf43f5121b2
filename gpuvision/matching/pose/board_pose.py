"""Fused board pose: from an image to a board's pose without work of the host in between.

The kernels find edges along calipers (rulers) placed across lines of the artwork, fit a robust line to the edges of
each line, and solve a robust pose from the lines, with its covariance at the placement point.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Bound,
    Define,
    Device,
    DeviceArray,
    FitStatusArray,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Layout,
    Operation,
    OperationSequence,
    Specs,
    Stage,
    StatusArray,
    capacity,
    flags,
    type_defines,
    uses_vectors,
)
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.motion import apply_homography
from gpuvision.matching.pose.pose import BoardPose, SolvePose
from gpuvision.matching.robust import sample_subsets
from gpuvision.operation import KERNEL_FOLDER, VisionOperation

Float64 = npt.NDArray[np.float64]
RULER = ("x_px", "y_px", "cosine", "sine", "u", "v", "u_per_px", "v_per_px", "projective")
LINE = ("normal_x", "normal_y", "x", "y", "sigma", "etch_factor")
_GROUP, _MAX_RULERS = 64, 2048
_MIN_SCALE = 1e-3  # least scale of the residuals in the pose, as in board_pose.cl
# Build options of `SolvePose` that the fits of lines do not read.
_OPTIONS_OF_POSE = ("POSE_PARAMETERS", "FREEDOMS", "START_STEPS", "CAPACITY")
# Least sizes of the arrays of the vector variant, so that boards of many sizes share programs.
_MIN_RULERS_PER_LINE, _MIN_RULERS = 32, 512


class BoardPoseEstimate(NamedTuple):
    """Pose of a board, and the measurements that determine it.

    Attributes
    ----------
    pose, deformation, placement, covariance, scale, residual_scale, condition, rank, inliers, status, etch_bias,
    inlier_fraction
        As in `BoardPose`, of one pose. Each line gives two rows, or one where it has one ruler.
    leverage : float32, ()
        As in `BoardPose`; of a line with both its rows where at most half of the rows are inliers: the two rows of a
        displaced line do not check each other.
    residuals, weights : float32, (lines, 2)
        Of the two rows of each line, on either side of its centre [m]; (lines, 1) where a line has one ruler.
    edges : float32, (lines, rulers_per_line)
        Positions of the edges along the rulers [px]; NaN where no edge was found.
    edge_status : uint8, (lines, rulers_per_line)
        `Status` flags of the rulers, as in `Edges`.
    edge_weights : float32, (lines, rulers_per_line)
        Weight of each edge in the fit of its line, 0 to 1.
    line_status : uint16, (lines,)
        `Status` flags of the fits of the lines, as in `LineFits`. A line with one edge is NO_DATA: it has no direction,
        and takes part with its offset.
    """

    pose: FloatArray
    deformation: FloatArray
    placement: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    weights: FloatArray
    scale: FloatArray
    residual_scale: FloatArray
    condition: FloatArray
    rank: IntArray
    inliers: IntArray
    status: FitStatusArray
    etch_bias: FloatArray
    inlier_fraction: FloatArray
    leverage: FloatArray
    edges: FloatArray
    edge_status: StatusArray
    edge_weights: FloatArray
    line_status: FitStatusArray


def place_rulers(
    normal: npt.ArrayLike,
    point: npt.ArrayLike,
    offsets: npt.ArrayLike,
    board_to_image: npt.ArrayLike,
    sigma: npt.ArrayLike = 0.0,
    etch_factor: npt.ArrayLike = 0.0,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Place calipers (rulers) across lines of the artwork.

    Parameters
    ----------
    normal, point : array_like, (lines, 2)
        Unit normals of the lines, and a point on each line [m].
    offsets : array_like, (lines, rulers_per_line)
        Positions of the rulers on each line, from its point along (normal_y, -normal_x) [m]; NaN: no ruler.
    board_to_image : array_like, (3, 3)
        Homography from the expected board to the (undistorted) image [m to px].
    sigma : array_like, (lines,)
        Standard deviation of the position of a line on the board [m], common to all its rulers and independent of the
        other lines: rough edges, offset of a mask opening or of the silk. Default 0.0.
    etch_factor : array_like, (lines,)
        Shift of a line along its normal per etch bias, for a solver with ``etch_bias_sigma``: 1 for an edge with the
        normal out of the copper, 0 for the middle of a trace. Default 0.0.

    Returns
    -------
    rulers : numpy.ndarray
        float32 (lines, rulers_per_line, 9) with the columns `RULER`: centre and direction in the image, and the
        coefficients that take a position on the ruler to the frame of its line.
    lines : numpy.ndarray
        float32 (lines, 6) with the columns `LINE`.
    """
    normal, point, offsets = (np.asarray(each, np.float64) for each in (normal, point, offsets))
    matrix = np.asarray(board_to_image, np.float64)
    way = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)[:, None]
    across, origin = normal[:, None], point[:, None]
    on = origin + offsets[..., None] * way
    centre = apply_homography(matrix, on)
    # Derivative of the homography along the normal: the direction of the ruler in the image.
    weight = on @ matrix[2, :2] + matrix[2, 2]
    step = (across @ matrix[:2, :2].T - centre * (across @ matrix[2, :2])[..., None]) / weight[..., None]
    direction = step / np.linalg.norm(step, axis=-1, keepdims=True)
    # The inverse homography along the ruler: (start + s slope) / (1 + s projective), s pixels from the ruler's centre.
    back = np.linalg.inv(matrix)
    start, slope = centre @ back[:, :2].T + back[:, 2], direction @ back[:, :2].T
    per = 1.0 / start[..., 2:]
    projective = slope[..., 2:] * per
    offset = start[..., :2] * per - origin
    moved = slope[..., :2] * per - origin * projective
    frame = [np.sum(each * axis, axis=-1, keepdims=True) for each in (offset, moved) for axis in (way, across)]
    rulers = np.concatenate([centre, direction, *frame, projective], axis=-1).astype(np.float32)
    more = [np.broadcast_to(np.asarray(each, np.float64), normal.shape[:1])[:, None] for each in (sigma, etch_factor)]
    return rulers, np.concatenate([normal, point, *more], axis=-1).astype(np.float32)


class BoardEdges(NamedTuple):
    """Edges along the rulers of a board.

    Attributes
    ----------
    edges : float32, (lines, rulers_per_line)
        Positions of the edges along the rulers [px]; NaN where no edge was found.
    status : uint8, (lines, rulers_per_line)
        `Status` flags of the rulers.
    places : float32, (lines, rulers_per_line, 2)
        Positions along and across their lines [m].
    sigmas : float32, (lines, rulers_per_line)
        Standard deviations across the lines [m]; NaN where no edge was found.
    """

    edges: FloatArray
    status: StatusArray
    places: FloatArray
    sigmas: FloatArray


class BoardLines(NamedTuple):
    """Lines of a board, fitted through their edges.

    Attributes
    ----------
    rows : float32, (rows, 7 or 8)
        Feature rows as `SolvePose` takes them: two of each line, or one where a line has one ruler.
    edge_weights : float32, (lines, rulers_per_line)
        Weight of each edge in the fit of its line, 0 to 1.
    status : uint16, (lines,)
        `Status` flags of the fits, as in `LineFits`.
    """

    rows: FloatArray
    edge_weights: FloatArray
    status: FitStatusArray


@dataclass(frozen=True, kw_only=True)
class MeasureBoardEdges(VisionOperation[BoardEdges]):
    """Edges along the rulers of a board: ``op(image, rulers) -> BoardEdges``; first stage of `BoardPoseEstimator`.

    Parameters
    ----------
    ruler : RulerEdges
        Edge measurement, in its work-item variant.
    lines, rulers_per_line : int
        As in `BoardPoseEstimator`.
    """

    Result: ClassVar[type[Any]] = BoardEdges
    takes_single_frames: ClassVar[bool] = True

    ruler: RulerEdges
    lines: int
    rulers_per_line: int

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        found, real = (self.lines, self.rulers_per_line), np.dtype(np.float32)
        edges = replace(self.ruler, count=math.prod(found), variant="work_item").launch(device, shape, dtype)
        return replace(
            edges,
            source="board_pose/board_pose.cl",
            kernel="board_edges",
            inputs=[edges.inputs[0], ((*found, len(RULER)), real)],
            outputs={
                "edges": (found, real),
                "status": (found, np.dtype(np.uint8)),
                "places": ((*found, 2), real),
                "sigmas": (found, real),
            },
            defines={**edges.defines, "BOARD_EDGES": None},
            arguments=[*edges.arguments[:4], np.uint32(math.prod(found))],
        )


@dataclass(frozen=True, kw_only=True)
class FitBoardLines(VisionOperation[BoardLines]):
    """Lines through the edges of a board: ``op(places, sigmas, lines) -> BoardLines``.

    Second stage of `BoardPoseEstimator`.

    Parameters
    ----------
    solver : SolvePose
        Its loss, tuning constant and scale apply to the fits.
    """

    Result: ClassVar[type[Any]] = BoardLines

    solver: SolvePose

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, variant="work_item")
        solver, (lines, rulers, _) = self.solver, shape
        rows, pairs = lines * rows_of_line(rulers), start_pairs(rulers, solver.max_trials)
        options = solver.defines(rows, vectors=False)
        numbers = 7 + (solver.etch_bias_sigma is not None)
        return build.launch(
            "board_pose/board_pose.cl",
            "board_lines",
            work=build.work(lines, each=1, group=_GROUP, grouping="per_element"),
            problem_per_group=True,
            more_inputs=[((lines, rulers), build.real), ((lines, len(LINE)), build.real)],
            outputs=build.outputs(
                {"rows": (rows, numbers), "edge_weights": (lines, rulers), "status": (lines,)}, status=np.uint16
            ),
            defines={
                **{name: value for name, value in options.items() if name not in _OPTIONS_OF_POSE},
                **type_defines("INPUT", build.real),
                **({"CAPACITY": capacity(rulers)} if solver.scale is None else {}),
                "BOARD_LINES": None,
            },
            arguments=[
                np.int32(lines),
                np.int32(rulers),
                pairs.ravel(),
                np.int32(len(pairs)),
                np.int32(solver.max_iterations),
            ],
        )


@dataclass(frozen=True, kw_only=True)
class SolveBoardLines(VisionOperation[BoardPose]):
    """Pose of a board from rows of its lines: ``op(rows) -> BoardPose``; last stage of `BoardPoseEstimator`.

    Parameters
    ----------
    solver : SolvePose
    lines : int
        Number of lines; the residuals and weights have the shape (lines, rows of a line).
    """

    Result: ClassVar[type[Any]] = BoardPose

    solver: SolvePose
    lines: int

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        solved = replace(self.solver, min_scale=_MIN_SCALE, variant="work_item").launch(device, shape, dtype)
        each = shape[0] // self.lines
        of_rows = ((self.lines, each), np.dtype(np.float32))
        return replace(
            solved,
            outputs={**solved.outputs, "residuals": of_rows, "weights": of_rows},
            defines={**solved.defines, **flags(ROWS_IN_PAIRS=each == 2)},
        )


def rows_of_line(rulers: int) -> int:
    """Return the number of rows that a line with some rulers gives: offset and angle, or the offset only."""
    return 2 if rulers > 1 else 1


def start_pairs(rulers: int, max_trials: int) -> npt.NDArray[np.int32]:
    """Return the pairs of rulers (n, 2) of a line that give its start candidates."""
    return sample_subsets(rulers, 2, max_trials) if rulers > 1 else np.zeros((1, 2), np.int32)


@dataclass(frozen=True, kw_only=True)
class BoardPoseEstimator(OperationSequence[BoardPoseEstimate]):
    """Fused board pose: ``op(image, rulers, lines) -> BoardPoseEstimate``.

    The image is as `RulerEdges` takes it. The rulers, float32 (lines, rulers_per_line, 9), and the lines, float32
    (lines, 6), are results of `place_rulers`. The pose is the motion of the artwork on the board's plane, from the
    expected to the measured position; 0 if the board is at the expected position.

    On CPU runtimes one launch computes everything. On GPUs three launches follow one another: edges, in work-groups of
    four rulers; lines, a work-group for each; and the pose, as `SolvePose` computes it.

    Parameters
    ----------
    ruler : RulerEdges
        Edge measurement, with any edge selection but ``"all"``. Its ``noise`` determines the standard deviations of the
        edges.
    lines : int
        Number of lines, 2 to 512.
    rulers_per_line : int
        Number of rulers of each line, 1 to 256; 2048 rulers in all at most.
    solver : SolvePose
        Pose solver. Its loss, tuning constant and scale also apply to the line fits. Its precision must be single, and
        ``with_initial_pose`` false.

    Raises
    ------
    TypeError, ValueError
        A parameter is out of its range or of a wrong type.

    Notes
    -----
    Error: positions are relative to the point of their line, so that single precision costs 1e-7 of a line's length.
    The pose has the error of `SolvePose`. A position on a ruler is taken to the board's plane exactly for a homography.
    With a lens (`RulerEdges.model`) rulers and homography refer to the undistorted image.

    Wrong poses: where at most half of the rows agree with the pose, ``max_leverage`` limits the leverage of each line,
    because a displaced line displaces both its rows. Of simulated frames with 12 lines in random directions, of which 8
    are displaced by 1 px (33 standard deviations), 2.5 % of the wrong poses are accepted, and 7.6 % without this rule
    (28 and 84 of 1099 poses). No limit recognises displaced lines that agree with each other and are a majority: of
    frames with 8 lines, 5 of them displaced, 2.4 % of the wrong poses are accepted (32 of 1333).
    """

    Result: ClassVar[type[Any]] = BoardPoseEstimate
    kernel_folder: ClassVar[Path | None] = KERNEL_FOLDER
    takes_single_frames: ClassVar[bool] = True

    ruler: RulerEdges
    lines: int
    rulers_per_line: int
    solver: SolvePose = field(default_factory=SolvePose)

    def __post_init__(self) -> None:
        if not isinstance(self.ruler, RulerEdges) or not isinstance(self.solver, SolvePose):
            raise TypeError("BoardPoseEstimator takes a RulerEdges as ruler and a SolvePose as solver")
        if self.ruler.edge_selection == "all":
            raise ValueError("BoardPoseEstimator.ruler has edge_selection='all', expected one edge of a ruler")
        if self.solver.precision == "double" or self.solver.with_initial_pose:
            raise ValueError("BoardPoseEstimator.solver: expected single precision, and no pose to start from")
        for name, least, limit in (("lines", 2, 512), ("rulers_per_line", 1, 256)):
            if not isinstance(getattr(self, name), int) or not least <= getattr(self, name) <= limit:
                raise ValueError(f"BoardPoseEstimator.{name} is {getattr(self, name)!r}, expected {least} to {limit}")
        if self.lines * self.rulers_per_line > _MAX_RULERS:
            raise ValueError(
                f"BoardPoseEstimator: {self.lines} lines of {self.rulers_per_line} rulers, expected up to {_MAX_RULERS}"
            )
        if self._rows_of_line * self.lines < self.solver.unknowns:
            raise ValueError(
                f"BoardPoseEstimator.lines is {self.lines}: too few for the transform '{self.solver.transform}'"
            )

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the one launch of the vector variant, as `Operation.launch` says."""
        edges = replace(self.ruler, count=self.lines * self.rulers_per_line).launch(device, shape, dtype)
        build = LaunchBuilder(self, device, shape, dtype, variant=self.ruler.variant)
        if not build.uses_vectors:
            raise ValueError(f"BoardPoseEstimator has three launches on {device.label}; see its layout")
        work = build.work(1, each=1, group=1)
        count, solver = self._rows_of_line * self.lines, self.solver
        pairs = start_pairs(self.rulers_per_line, solver.max_trials)
        found = (self.lines, self.rulers_per_line)
        shapes = solver.shapes((), (self.lines, self._rows_of_line))
        shapes |= dict.fromkeys(("edges", "edge_status", "edge_weights"), found) | {"line_status": (self.lines,)}
        flag_types = {"status": np.uint16, "edge_status": np.uint8, "line_status": np.uint16}
        limits = (*solver.limits(build.real), *solver.placement, solver.etch_bias_certainty)
        return build.launch(
            "board_pose/board_pose.cl",
            "board_pose",
            work=work,
            more_inputs=[((*found, len(RULER)), build.real), ((self.lines, len(LINE)), build.real)],
            outputs=build.outputs(shapes, rank=np.int32, inliers=np.int32, **flag_types),
            defines={
                **edges.defines,
                **solver.defines(count, vectors=True),
                **flags(ROWS_IN_PAIRS=self._rows_of_line == 2),
                **self._capacities(),
            },
            arguments=[
                *edges.arguments[:4],
                *map(np.int32, found),
                pairs.ravel(),
                np.int32(len(pairs)),
                solver.starts(count, vectors=True),
                np.int32(solver.max_trials),
                np.int32(solver.max_iterations),
                *map(np.float32, limits),
            ],
            passes_once=True,
        )

    def layout(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Layout:
        """Return the stages of the work-item variant: edges, lines, pose."""
        found, real = (self.lines, self.rulers_per_line), np.dtype(np.float32)
        inputs = {
            "image": (shape, dtype),
            "rulers": ((*found, len(RULER)), real),
            "lines": ((self.lines, len(LINE)), real),
        }
        measure = MeasureBoardEdges(ruler=self.ruler, lines=self.lines, rulers_per_line=self.rulers_per_line)
        stages = [
            Stage("edges", measure, ("image", "rulers")),
            Stage("fits", FitBoardLines(solver=self.solver), ("edges.places", "edges.sigmas", "lines")),
            Stage("pose", SolveBoardLines(solver=self.solver, lines=self.lines), ("fits.rows",)),
        ]
        outputs = {name: f"pose.{name}" for name in BoardPose._fields}
        outputs |= {"edges": "edges.edges", "edge_status": "edges.status", "edge_weights": "fits.edge_weights"}
        return Layout(inputs, stages, outputs | {"line_status": "fits.status"})

    def specs(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Specs:
        """Return inputs, outputs and memory; see `Operation.specs`."""
        is_fused = uses_vectors(self.ruler.variant, device)
        return Operation.specs(self, device, shape, dtype) if is_fused else super().specs(device, shape, dtype)

    def _bound_to(
        self,
        device: Device,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        queue: Any,
        inputs: Sequence[DeviceArray],
    ) -> Bound[BoardPoseEstimate]:
        if uses_vectors(self.ruler.variant, device):
            return Operation._bound_to(self, device, shape, dtype, queue, inputs)
        return super()._bound_to(device, shape, dtype, queue, inputs)

    @property
    def _rows_of_line(self) -> int:
        return rows_of_line(self.rulers_per_line)

    def _capacities(self) -> dict[str, Define]:
        """Return the sizes of the arrays."""
        rulers = self.rulers_per_line
        return {
            "MAX_RULERS_PER_LINE": capacity(rulers, least=_MIN_RULERS_PER_LINE),
            "MAX_RULERS": capacity(self.lines * rulers, least=_MIN_RULERS),
        }
