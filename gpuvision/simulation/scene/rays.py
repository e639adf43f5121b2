"""Intersection of rays and segments with the triangles of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from gpuvision.host import (
    Device,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    flags,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene

# Rays of a work-item of the vector variant, and work-items of a group of the other variant: both tuned for speed.
_RAYS_PER_STRIP, _GROUP = 256, 64
Spec = tuple[tuple[int, ...], np.dtype[Any]]
R = TypeVar("R", bound=tuple[Any, ...])


class Hits(NamedTuple):
    """Closest intersections of rays with a scene.

    Attributes
    ----------
    triangle
        int32 (...,), number of the triangle in the scene; -1 without an intersection.
    distance
        Real (...,), distance along the ray [m]; NaN where the status is not OK.
    barycentric
        Real (..., 2), barycentric weights u, v of the triangle's second and third corner; NaN where the status is not
        OK.
    status
        uint8 `Status` flags, (...,): NO_DATA (no intersection), NOT_FINITE (a number of the ray is not finite, or its
        direction is zero).
    """

    triangle: IntArray
    distance: FloatArray
    barycentric: FloatArray
    status: StatusArray


class Occlusion(NamedTuple):
    """Occlusion of segments.

    Attributes
    ----------
    occluded
        uint8 (...,), 1 where a triangle lies between the two ends, else 0.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number of the segment is not finite; it counts as not occluded).
    """

    occluded: StatusArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class _Rays(VisionOperation[R]):
    """Common part of the operations on rays and segments."""

    scene: Scene
    clearance: float = 0.0
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.scene, Scene):
            raise TypeError(f"{type(self).__name__}.scene is {self.scene!r}, expected a Scene")
        if not (math.isfinite(self.clearance) and self.clearance >= 0.0):
            raise ValueError(f"{type(self).__name__}.clearance is {self.clearance!r}, expected metres, 0 or more")

    def _trace(
        self, kernel: str, build: LaunchBuilder, of: str, shapes: dict[str, tuple[int, ...]], **types: type[np.generic]
    ) -> Launch:
        """Check the input and describe the launch of a kernel of ``rays.cl``.

        Parameters
        ----------
        kernel : str
        build : LaunchBuilder
        of : str
            Name of the input in messages.
        shapes : dict of str to tuple of int
            Shapes of the outputs, without the shape of the rays.
        **types : type
            Dtypes of outputs that are not of the real type.
        """
        build.check_dtype("float32", "float64", of=of)
        build.check_shape(build.shape[-1:] == (6,), f"{of} (..., 6)")
        where = build.shape[:-1]
        count = math.prod(where)
        work = build.work(count, each=_RAYS_PER_STRIP, group=_GROUP)
        tree = self.scene.bvh if work.vectors else self.scene.gpu_bvh
        # The vector variant traces rays one by one, too: two floats are built for one ray per work-item.
        two_floats = not (build.doubles_positions or work.vectors)
        place = build.widest if not two_floats else np.dtype(np.float32)
        return build.launch(
            "rays/rays.cl",
            kernel,
            work=work,
            outputs=build.outputs({name: (*where, *shape) for name, shape in shapes.items()}, **types),
            defines={
                **type_defines("INPUT", build.dtype),
                "BVH_DEPTH": tree.stack_size,
                **flags(
                    FOUR_WIDE=not work.vectors,
                    ANY_HIT=kernel == "any_hit",
                    DOUBLE_POSITIONS=place == np.float64,
                    TWO_FLOAT_POSITIONS=two_floats,
                ),
            },
            arguments=[
                *tree.tables(build.real),
                build.positions(tree.middle) if two_floats else tree.middle.astype(place),
                place.type(tree.radius),
                build.real.type(self.clearance),
                np.uint64(count),
                np.uint64(work.each),
            ],
        )

    def _builder(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> LaunchBuilder:
        return LaunchBuilder(self, device, shape, dtype, precision=self.precision, narrows=True, variant=self.variant)


@dataclass(frozen=True, kw_only=True)
class ClosestHit(_Rays[Hits]):
    """Closest hit of each ray: ``op(rays) -> Hits``, with rays float32 or float64 (..., 6).

    A ray is its origin [m] and a direction of any length. Both sides of a triangle are hit. A ray in the plane of a
    triangle misses it. No ray passes between two triangles at their common edge.

    Parameters
    ----------
    scene : Scene
        Scene that the rays intersect.
    clearance : float
        Intersections closer to the origin are ignored [m], 0 or more. Triangles through the origin are always ignored.
    precision : {None, "single", "double"}
        "single" or "double" arithmetic and outputs; None: the type of the input. "single" takes float64 rays too: the
        centre of the scene is subtracted in double, and a distant ray is clipped to the scene.
    variant : {"auto", "vector", "work_item"}
        "vector" (one ray against 16 boxes per vector, for CPU runtimes), "work_item" (one work-item per ray, which
        tests the four boxes of a node with vector loads, for GPUs) or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Error: coordinates are rounded once to the real type, relative to the centre of the scene. The error of the distance
    is a few roundings of the scene's size and of the distance, divided by the cosine of incidence. It does not depend
    on the distance of the origin, up to a million scene sizes: positions outside of the scene are doubles, or two
    floats (kernels/common/two_float.h) on GPUs without fast doubles.
    """

    Result: ClassVar[type[Any]] = Hits

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        shapes = {"triangle": (), "distance": (), "barycentric": (2,), "status": ()}
        return self._trace("closest_hit", build, "rays", shapes, triangle=np.int32)


@dataclass(frozen=True, kw_only=True)
class AnyHit(_Rays[Occlusion]):
    """Occlusion of segments by a scene: ``op(segments) -> Occlusion``, with segments float32 or float64 (..., 6).

    A segment is its two end points [m]. Both sides of a triangle occlude. A triangle whose plane contains the segment
    does not occlude it.

    Parameters
    ----------
    scene : Scene
        Scene that can occlude the segments.
    clearance : float
        Intersections closer to either end are ignored [m], 0 or more: the surfaces on which the ends lie. Triangles
        through an end are ignored up to rounding.
    precision, variant : {None, "single", "double"}, {"auto", "vector", "work_item"}
        As for `ClosestHit`.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.
    """

    Result: ClassVar[type[Any]] = Occlusion

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        return self._trace("any_hit", build, "segments", {"occluded": (), "status": ()}, occluded=np.uint8)
