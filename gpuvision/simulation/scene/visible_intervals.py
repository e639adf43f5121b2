"""Exact visible parts of a segment from a point, directly or in a plane mirror."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpuvision.host import Device, FloatArray, Launch, LaunchBuilder, Precision, StatusArray, Variant, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene

# Numbers of a fan; work-items of a group, tuned for speed.
_NUMBERS, _GROUP = 11, 64
# Shortest part that counts, as a fraction of the segment: about 100 roundings of single, 4e5 of double precision.
_MIN_FRACTION = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 1e-10}


class Intervals(NamedTuple):
    """Visible parts of segments, as fractions of their lengths.

    Attributes
    ----------
    intervals
        Real (..., max_intervals, 2), start and end of each part, 0 to 1, in ascending order; NaN after the last part.
    interval_count
        uint8 (...,), number of parts.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number of the input is not finite), AMBIGUOUS (there are more than
        ``max_intervals`` parts; none is returned).
    """

    intervals: FloatArray
    interval_count: StatusArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class VisibleIntervals(VisionOperation[Intervals]):
    """Visible parts of segments from points: ``op(fans) -> Intervals``, with fans float32 or float64 (..., 11).

    A fan is the set of rays from an apex to the points of a segment. Its 11 numbers are the apex, the two ends of the
    segment [m], and for each end the fraction of the ray, 0 to 1, from which on triangles can occlude. Fractions of 0
    describe a direct view. A view in a plane mirror has its apex at the mirror image of the lens, behind the mirror;
    the fractions then tell where the rays pass the mirror.

    Parameters
    ----------
    scene
        Scene that can occlude the segments; both sides of a triangle occlude. Triangles that contain the segment, the
        mirror itself, and triangles in the plane of the fan do not occlude.
    max_intervals
        Largest number of visible parts of a segment, 1 to 49. Default 16.
    precision
        "single" or "double" arithmetic and outputs; None: the type of the input.
    variant
        "vector" (16 boxes or triangles per vector, for CPU runtimes), "work_item" (for GPUs) or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Each triangle that intersects the fan occludes an interval of the segment; the visible parts are the complement of
    their union. The ends of the parts are exact to rounding: 1e-10 of the segment in double, 1e-5 in single precision;
    on a segment shorter than 1/100 of its distance from the apex, a few roundings of that distance. Shorter parts, and
    occluders closer to the segment or the mirror than this fraction of the ray, are ignored. A segment that lies on a
    line through the apex has no visible part.
    """

    Result: ClassVar[type[Any]] = Intervals

    scene: Scene
    max_intervals: int = 16
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.scene, Scene):
            raise TypeError(f"VisibleIntervals.scene is {self.scene!r}, expected a Scene")
        if not 1 <= self.max_intervals <= 49:
            raise ValueError(f"VisibleIntervals.max_intervals is {self.max_intervals}, expected 1 to 49")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="fans")
        build.check_shape(shape[-1:] == (_NUMBERS,), f"fans (..., {_NUMBERS})")
        tree, where = self.scene.bvh, shape[:-1]
        count = math.prod(where)
        shapes = {"intervals": (*where, self.max_intervals, 2), "interval_count": where, "status": where}
        return build.launch(
            "visible_intervals/visible_intervals.cl",
            "fan_intervals",
            work=build.work(count, each=1, group=_GROUP),
            outputs=build.outputs(shapes, interval_count=np.uint8),
            defines={**type_defines("INPUT", dtype), "BVH_DEPTH": tree.stack_size},
            arguments=[
                *tree.tables(build.real),
                tree.middle.astype(dtype),
                build.real.type(_MIN_FRACTION[build.real]),
                np.uint32(self.max_intervals),
                np.uint64(count),
            ],
        )
