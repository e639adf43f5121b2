"""What of a segment is visible from a point, exactly, also by way of a plane mirror."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene

_NUMBERS, _GROUP = 11, 64
_SLACK = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 1e-10}


class Intervals(NamedTuple):
    """Parts of segments, as shares of their lengths.

    Attributes
    ----------
    intervals
        (..., kept, 2), from 0 to 1, in order; NaN behind the last.
    count
        uint8 (...,): how many there are.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number is not), AMBIGUOUS (there are more parts than are kept: none
        is given).
    """

    intervals: Any
    count: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class VisibleIntervals(VisionOperation[Intervals]):
    """Which parts of segments are visible from points: ``op(fans) -> Intervals``, float32 or float64 (..., 11).

    A fan is the rays from an apex to a segment: the apex, the two ends, in metres, and the shares of the ways to the
    two ends from which on something may be in the way. 0 and 0: the apex sees the segment itself. A lens that sees it
    in a plane mirror is an apex behind the mirror, at its mirror image; there the ways begin at the mirror.

    Parameters
    ----------
    scene
        What may be in the way; both sides of a triangle are. What lies in the segment itself is not, nor is the
        mirror, nor a triangle in the plane of the fan.
    max_intervals
        At most so many parts.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16 boxes or triangles in a vector, for CPU runtimes), "work_item" (for GPUs), "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Every triangle that cuts the fan hides an interval, so the ends of the parts are exact to rounding: 1e-10 of the
    segment in double, 1e-5 in single; what is shorter, or as near to the segment or the mirror in shares of the way,
    does not count. Of a segment seen end on nothing is visible.
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
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"VisibleIntervals takes float32 or float64, got {dtype}")
        if not shape or shape[-1] != _NUMBERS:
            raise ValueError(f"VisibleIntervals takes fans (..., {_NUMBERS}), got shape {shape}")
        real = real_of(self.precision, dtype)
        strip, tree, where = uses_vectors(self.variant, device), self.scene.bvh, shape[:-1]
        count = math.prod(where)
        return Launch(
            source="visible_intervals/visible_intervals.cl",
            kernel="fan_intervals",
            defines={
                **real_defines(device, real),
                **({"VECTOR_VARIANT": None} if strip else {}),
                "INPUT": "float" if dtype == np.float32 else "double",
                "BVH_DEPTH": tree.depth,
            },
            inputs=[(shape, dtype)],
            outputs={
                "intervals": ((*where, self.max_intervals, 2), real),
                "count": (where, np.dtype(np.uint8)),
                "status": (where, np.dtype(np.uint8)),
            },
            arguments=[
                *tree.tables(real),
                tree.middle.astype(dtype),
                real.type(_SLACK[real]),
                np.uint32(self.max_intervals),
                np.uint64(count),
            ],
            global_size=(count,) if strip else (-(-count // _GROUP) * _GROUP,),
            local_size=(1,) if strip else (_GROUP,),
        )
