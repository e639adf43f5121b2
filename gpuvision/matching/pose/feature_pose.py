"""Pose of a camera over a board from one frame: single edges, pairs of edges and fiducials together.

A sequence of launches without work of the host in between: the features are placed where a camera at the expected pose
sees them, calipers (rulers) and blobs are measured there, and a robust pose is solved from all of them.
`gpuvision.matching.features.feature_set.FeatureSet.bind` makes the operation from a feature set.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 8.3 and 8.6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera, Direction
from gpuvision.camera.lens import Lens
from gpuvision.host import (
    Define,
    Device,
    FitStatusArray,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Layout,
    OperationSequence,
    Stage,
    StatusArray,
    Variant,
    flags,
    type_defines,
)
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]

RULER_FEATURE = ("x", "y", "normal_x", "normal_y", "polarity", "least_px", "greatest_px", "etch_factor")
FIDUCIAL_FEATURE = ("x", "y", "radius")
VIEW = ("scale", "side", "middle_x", "middle_y", "placement_x", "placement_y")
_MAX_ROWS = 1024
_ITEMS = 64


class FeaturePose(NamedTuple):
    """Pose of a camera over a board, with the residuals of the features.

    Attributes
    ----------
    pose : float64, (3,)
        x, y [m]: the point of the artwork at the middle of the full image; theta [rad]: counter-clockwise angle from
        the artwork's x axis to the direction of increasing columns, -pi to pi. float32 on devices without double
        precision.
        Where the status is neither OK nor NOT_CONVERGED, all fields are NaN unless their description says otherwise.
    covariance : float64, (3, 3)
        Covariance of the pose. Residuals smaller than the sigmas of the features do not reduce it. float32 on devices
        without double precision.
    status : uint16
        `Status` flags, as in `BoardPose`: NO_DATA, AMBIGUOUS, OUT_OF_RANGE, NOT_FINITE, NOT_CONVERGED (with a pose).
        AMBIGUOUS also where too few features in the image agree, or their residuals are too large (`SolveFeatures`).
    residuals, weights : float32, (rows,)
        Residual along the normal in the artwork [m], and weight in the pose, 0 to 1: of each ruler, then of the two
        principal axes of each fiducial.
    feature_status : uint8, (features,)
        `Status` flags of the rulers (`Edges`), then of the fiducials (`Blobs`); one of another size is AMBIGUOUS.
    scale, residual_scale, condition, rank, inliers, etch_bias, inlier_fraction, leverage
        As in `BoardPose`, of one pose.
    motion : float32, (3,)
        Motion of the artwork about the placement point [m], [rad] that the expected camera sees.
    motion_covariance : float32, (3, 3)
        Covariance of the measured place of the expected image centre [m] and of the turn [rad], not limited by the
        residual scale.
    """

    pose: FloatArray
    covariance: FloatArray
    status: FitStatusArray
    residuals: FloatArray
    weights: FloatArray
    feature_status: StatusArray
    scale: FloatArray
    residual_scale: FloatArray
    condition: FloatArray
    rank: IntArray
    inliers: IntArray
    etch_bias: FloatArray
    inlier_fraction: FloatArray
    leverage: FloatArray
    motion: FloatArray
    motion_covariance: FloatArray


class PlacedFeatures(NamedTuple):
    """Features in the frame of a camera at a pose.

    Attributes
    ----------
    rulers : float32, (n, 7)
        As `RulerEdges` takes them with ``per_ruler``; None without rulers.
    matched, drilled : float32, (n, 3)
        Fiducials as `FindBlobs` takes them: x, y, radius [px]; None without such fiducials.
    """

    rulers: FloatArray | None
    matched: FloatArray | None
    drilled: FloatArray | None


@dataclass(frozen=True, kw_only=True)
class CameraFeatures:
    """Features of a board in numbers, and the camera that looks straight at it.

    Parameters
    ----------
    rulers : tuple of tuples
        For each ruler the numbers `RULER_FEATURE`: centre relative to the placement point [m], unit normal, sign of the
        step along it (of the first edge of a pair), least and greatest spacing of a pair [px] (0 and 0: single edge),
        etch factor.
    matched, drilled : tuple of tuples
        For each fiducial the numbers `FIDUCIAL_FEATURE`: centre relative to the placement point, and radius [m]. The
        grey levels of matched ones are matched; of drilled ones only the contour is measured.
    placement : (float, float)
        Placement point on the artwork [m].
    pixel_size : float
        Size of a pixel on the board [m]. Range: above 0.
    frame_shape : (int, int)
        Rows and columns of the full image, whose middle the pose refers to.
    mirrored : bool
        Whether the camera sees the artwork from behind. Default False.
    model : Lens or Camera, optional
        Lens distortion, in pixels of the full image; frames are then distorted. None: no distortion.
    """

    rulers: Rows
    matched: Rows
    drilled: Rows
    placement: tuple[float, float]
    pixel_size: float
    frame_shape: tuple[int, int]
    mirrored: bool = False
    model: Lens | Camera | None = None

    def __post_init__(self) -> None:
        if self.model is not None and not isinstance(self.model, Lens | Camera):
            raise TypeError(f"CameraFeatures.model is {self.model!r}, expected a Lens or a Camera")
        finite(self.pixel_size, "CameraFeatures.pixel_size [m]", above=0.0)
        numbers(self.placement, (2,), "CameraFeatures.placement [m]")
        if not 3 <= self.rows <= _MAX_ROWS:
            raise ValueError(f"{self.rows} rows (a fiducial has two), a pose takes 3 to {_MAX_ROWS}")

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of rulers, matched and drilled fiducials."""
        return len(self.rulers), len(self.matched), len(self.drilled)

    @property
    def rows(self) -> int:
        """Number of rows of the pose: one of a ruler, two of a fiducial."""
        rulers, matched, drilled = self.counts
        return rulers + 2 * (matched + drilled)

    def tables(self, wide: np.dtype[Any]) -> list[Any]:
        """Return the tables and numbers that both kernels of ``feature_pose.cl`` take."""
        rows, columns = self.frame_shape
        middle = ((columns - 1) / 2, (rows - 1) / 2)
        view = (self.pixel_size, -1.0 if self.mirrored else 1.0, *middle, *self.placement)
        return [
            _table(self.rulers, RULER_FEATURE),
            _table((*self.matched, *self.drilled), FIDUCIAL_FEATURE),
            np.array(view, wide),
            *map(np.int32, self.counts),
        ]

    def model_defines(self, real: np.dtype[Any]) -> dict[str, Define]:
        """Return the build options of ``feature_lens.h``."""
        if isinstance(self.model, Camera):
            return {**self.model.defines(), **self.model.undistort_defines(real)}
        return {} if self.model is None else dict(self.model.defines)

    def model_table(self, real: np.dtype[Any], direction: Direction) -> npt.NDArray[Any] | None:
        """Return a table of ``feature_lens.h``; None without a model."""
        if isinstance(self.model, Camera):
            return self.model.packed(real, direction)
        with np.errstate(over="ignore"):
            return None if self.model is None else self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(real)

    @property
    def present(self) -> dict[str, Define]:
        """Build options of ``feature_pose.cl``: the kinds of features that exist."""
        return flags(WITH_RULERS=bool(self.rulers), WITH_MATCHED=bool(self.matched), WITH_DRILLED=bool(self.drilled))


def _table(rows: Rows, names: tuple[str, ...]) -> npt.NDArray[np.float32]:
    """Return rows as a table for a kernel: one row of zeros for no rows, because a buffer cannot be empty."""
    return np.array(rows or [(0.0,) * len(names)], np.float32).reshape(-1, len(names))


@dataclass(frozen=True, kw_only=True)
class PlaceFeatures(VisionOperation[PlacedFeatures]):
    """Places of features in a frame: ``op(pose, corner) -> PlacedFeatures``.

    The pose is x, y [m], theta [rad] of the camera, (3,) float64 (float32 on a device without double precision). The
    corner is the column and row of the frame's first pixel in the full image, (2,) float32.

    Parameters
    ----------
    features : CameraFeatures
    variant : {"auto", "vector", "work_item"}
        Kernel variant.
    """

    Result: ClassVar[type[Any]] = PlacedFeatures

    features: CameraFeatures
    variant: Variant = "auto"

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision="single", narrows=True, variant=self.variant)
        build.check_dtype(build.widest.name, of="poses")
        build.check_shape(shape == (3,), "a pose (3,)")
        of = self.features
        work = build.work(1, each=1, group=_ITEMS)
        sizes = zip(PlacedFeatures._fields, of.counts, (7, 3, 3), strict=True)
        shapes = {name: (count, size) if count else None for name, count, size in sizes}
        return build.launch(
            "feature_pose/feature_pose.cl",
            "place_features",
            work=work,
            more_inputs=[((2,), build.real)],
            outputs=build.outputs(shapes),
            defines={**type_defines("WIDE", dtype), **flags(PLACE_FEATURES=True), **of.model_defines(build.real)},
            arguments=[*of.tables(dtype), *(of.model_table(build.real, each) for each in ("distort", "undistort"))],
            passes_once=work.vectors,
        )


@dataclass(frozen=True, kw_only=True)
class SolveFeatures(VisionOperation[FeaturePose]):
    """Pose of the camera from measured features: last stage of `EstimateFeaturePose`.

    Inputs are the expected pose and the corner; position, sigma, status and place of the rulers; shift, size,
    covariance, status and place of the matched fiducials; the same of the drilled fiducials. The places come from
    `PlaceFeatures`. A kind without features has no inputs.

    Parameters
    ----------
    features : CameraFeatures
    solver : SolvePose
        Rigid, in single precision, without initial pose; its placement is not used.
    ruler_sigma_px, matched_sigma_px, drilled_sigma_px : float
        Standard deviations that are added to the predicted ones of each kind [px].
    size_tolerance : float
        Largest difference between the measured and the drawn radius of a fiducial [m].
    min_share : float
        Least share of the rows in the image that must be inliers: fewer are another board.
    max_residual_px : float
        Largest accepted standard deviation of the residuals beyond the predicted errors [px]: sqrt(r^2 - 1 -
        3 sqrt(2 / f)) times the median sigma of the rows, with `FeaturePose.residual_scale` r and f degrees of freedom
        (inliers less unknowns); 0 where the root is of a negative number. More is another board or a wrong scale.
    """

    Result: ClassVar[type[Any]] = FeaturePose

    features: CameraFeatures
    solver: SolvePose
    ruler_sigma_px: float
    matched_sigma_px: float
    drilled_sigma_px: float
    size_tolerance: float
    min_share: float
    max_residual_px: float

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision="single", narrows=True, variant=self.solver.variant)
        of, solver = self.features, self.solver
        work = build.work(1, each=1, group=_ITEMS)
        rows, features = of.rows, sum(of.counts)
        real, flag = build.real, np.dtype(np.uint8)
        inputs: list[Any] = [((2,), real)]
        if of.rulers:
            inputs += [*(((len(of.rulers),), each) for each in (real, real, flag)), ((len(of.rulers), 7), real)]
        for count in of.counts[1:]:
            if count:
                inputs += [((count, 2), real), ((count,), real), ((count, 3, 3), real), ((count,), flag)]
                inputs.append(((count, 3), real))
        shapes: dict[str, tuple[int, ...] | None] = dict.fromkeys(FeaturePose._fields, ())
        shapes |= {"pose": (3,), "covariance": (3, 3), "motion": (3,), "motion_covariance": (3, 3)}
        shapes |= {"residuals": (rows,), "weights": (rows,), "feature_status": (features,)}
        types: dict[str, Any] = {"pose": dtype, "covariance": dtype, "feature_status": np.uint8, "status": np.uint16}
        types |= {"rank": np.int32, "inliers": np.int32}
        sigmas = (self.ruler_sigma_px, self.matched_sigma_px, self.drilled_sigma_px)
        limits = (solver.min_scale, *solver.limits(real), solver.etch_bias_certainty, *sigmas, self.size_tolerance)
        limits += (self.min_share, self.max_residual_px * of.pixel_size)
        return build.launch(
            "feature_pose/feature_pose.cl",
            "feature_pose",
            work=work,
            more_inputs=inputs,
            outputs=build.outputs(shapes, **types),
            defines={
                **type_defines("WIDE", dtype),
                **of.present,
                **of.model_defines(real),
                **solver.defines(rows, vectors=work.vectors),
            },
            arguments=[
                *of.tables(dtype),
                of.model_table(real, "undistort"),
                solver.starts(rows, vectors=work.vectors),
                np.int32(solver.max_trials),
                np.int32(solver.max_iterations),
                *map(np.float32, limits),
            ],
            passes_once=work.vectors,
        )


@dataclass(frozen=True, kw_only=True)
class EstimateFeaturePose(OperationSequence[FeaturePose]):
    """Pose of a camera over a board from a frame: ``op(frame, expected_pose, corner) -> FeaturePose``.

    The frame is as `RulerEdges` takes it. The expected pose is (3,) float64 (float32 on a device without double
    precision), the corner (2,) float32, as in `PlaceFeatures`.

    Parameters
    ----------
    features : CameraFeatures
    ruler : RulerEdges
        Edge measurement with ``per_ruler``.
    matched, drilled : FindBlobs
        Measurement of the fiducials with and without ``match``; used where there are such fiducials.
    solver : SolvePose
        As in `SolveFeatures`.
    ruler_sigma_px, matched_sigma_px, drilled_sigma_px, size_tolerance : float
        As in `SolveFeatures`.
    min_share : float
        As in `SolveFeatures`, 0 to 1. Default 0.5, a majority: with fewer, another pose could gather as many.
    max_residual_px : float
        As in `SolveFeatures` [px], above 0. Default 0.5 (chosen).

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    Error: coordinates are relative to the placement point, so that single precision costs 1e-7 of the distance of a
    feature from it. The pose has the error of `SolvePose`. With a lens two points of Gauss-Legendre integrate the lens
    along a ruler; the edge is a straight line over the width of a ruler: a curvature k [1/px] of its image shifts it by
    k (width^2 - 1) / 24 px, 5e-4 px for 5 lines, k1 = -0.2, f = 220 px and 60 px off the centre. Where a feature lies
    past the fold of the lens, its status is NOT_INVERTIBLE.

    Cost: a `Lens` takes 3 to 5 % of a call with 60 rulers, a `Camera` with k1 8 % (PoCL, medians of alternating calls
    on a machine with other load; ``gpuvision profile servo`` repeats the measurement with a `Lens`).
    """

    Result: ClassVar[type[Any]] = FeaturePose
    takes_single_frames: ClassVar[bool] = True

    features: CameraFeatures
    ruler: RulerEdges
    matched: FindBlobs
    drilled: FindBlobs
    solver: SolvePose = field(default_factory=SolvePose)
    ruler_sigma_px: float = 0.0
    matched_sigma_px: float = 0.0
    drilled_sigma_px: float = 0.0
    size_tolerance: float = math.inf
    min_share: float = 0.5
    max_residual_px: float = 0.5

    def __post_init__(self) -> None:
        solver = self.solver
        finite(self.min_share, "EstimateFeaturePose.min_share", minimum=0.0, maximum=1.0)
        finite(self.max_residual_px, "EstimateFeaturePose.max_residual_px [px]", above=0.0)
        if solver.transform != "rigid" or solver.precision == "double" or solver.with_initial_pose:
            raise ValueError(
                "EstimateFeaturePose.solver: expected a rigid transform, single precision, and no initial pose"
            )
        if not self.ruler.per_ruler:
            raise ValueError("EstimateFeaturePose.ruler: expected per_ruler=True")

    def layout(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Layout:
        """Return the stages: place the features, measure each kind, solve the pose."""
        wide, of = np.dtype(np.float64 if device.has_double else np.float32), self.features
        inputs = {"frame": (shape, dtype), "pose": ((3,), wide), "corner": ((2,), np.dtype(np.float32))}
        measured: list[str] = []
        stages = [Stage("place", PlaceFeatures(features=of, variant=self.solver.variant), ("pose", "corner"))]
        if of.rulers:
            stages.append(Stage("edges", replace(self.ruler, count=len(of.rulers)), ("frame", "place.rulers")))
            measured += [*(f"edges.{name}" for name in ("position", "sigma", "status")), "place.rulers"]
        for name, operation, rows in (("matched", self.matched, of.matched), ("drilled", self.drilled, of.drilled)):
            if rows:
                stages.append(Stage(name, replace(operation, count=len(rows)), ("frame", f"place.{name}")))
                fields = (f"{name}.{each}" for each in ("shift", "size", "covariance", "status"))
                measured += [*fields, f"place.{name}"]
        solve = SolveFeatures(
            features=of,
            solver=self.solver,
            ruler_sigma_px=self.ruler_sigma_px,
            matched_sigma_px=self.matched_sigma_px,
            drilled_sigma_px=self.drilled_sigma_px,
            size_tolerance=self.size_tolerance,
            min_share=self.min_share,
            max_residual_px=self.max_residual_px,
        )
        stages.append(Stage("solve", solve, ("pose", "corner", *measured)))
        return Layout(inputs, stages, {name: f"solve.{name}" for name in FeaturePose._fields})
