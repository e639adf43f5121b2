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
    Precision,
    StatusArray,
    Variant,
    real_defines,
    real_of,
    uses_vectors,
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

    def _real(self, dtype: np.dtype[Any]) -> np.dtype[Any]:
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"{type(self).__name__} takes float32 or float64, got {dtype}")
        return real_of(self.precision, dtype, narrows=True)

    def _launch_of(
        self, kernel: str, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any], outputs: dict[str, Spec]
    ) -> Launch:
        real = self._real(dtype)
        count = math.prod(shape[:-1])
        strip = uses_vectors(self.variant, device)
        each = _RAYS_PER_STRIP if strip else 1
        items = -(-count // each)
        tree = self.scene.bvh
        place = np.dtype(np.float64 if device.has_double else np.float32)
        present = {"VECTOR_VARIANT": strip, "SEGMENTS": kernel == "any_hit", "WIDE_PLACES": device.has_double}
        return Launch(
            source="rays/rays.cl",
            kernel=kernel,
            defines={
                **real_defines(device, real),
                **{name: None for name, is_present in present.items() if is_present},
                "INPUT": "float" if dtype == np.float32 else "double",
                "BVH_DEPTH": tree.depth,
            },
            inputs=[(shape, dtype)],
            outputs=outputs,
            arguments=[
                *tree.tables(real),
                tree.middle.astype(place),
                place.type(tree.radius),
                real.type(self.clearance),
                np.uint64(count),
                np.uint64(each),
            ],
            global_size=(items,) if strip else (-(-items // _GROUP) * _GROUP,),
            local_size=(1,) if strip else (_GROUP,),
        )


@dataclass(frozen=True, kw_only=True)
class ClosestHit(_Rays[Hits]):
    """Closest hit of each ray: ``op(rays) -> Hits``, with rays float32 or float64 (..., 6).

    A ray is its origin [m] and a direction of any length. Both sides of a triangle are hit. A ray in the plane of a
    triangle misses it. No ray passes between two triangles at their common edge.

    Parameters
    ----------
    scene
        Scene that the rays intersect.
    clearance
        Intersections closer to the origin are ignored [m], 0 or more. Triangles through the origin are always ignored.
    precision
        "single" or "double" arithmetic and outputs; None: the type of the input. "single" takes float64 rays too: the
        centre of the scene is subtracted in double, and a distant ray is clipped to the scene.
    variant
        "vector" (one ray against 16 boxes per vector, for CPU runtimes), "work_item" (one work-item per ray, for GPUs)
        or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Error: coordinates are rounded once to the real type, relative to the centre of the scene. The error of the distance
    is a few roundings of the scene's size and of the distance, divided by the cosine of incidence. On devices with
    doubles it does not depend on the distance of the origin.
    """

    Result: ClassVar[type[Any]] = Hits

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        where = _shape_of("ClosestHit", "rays", shape)
        real = self._real(dtype)
        outputs: dict[str, Spec] = {
            "triangle": (where, np.dtype(np.int32)),
            "distance": (where, real),
            "barycentric": ((*where, 2), real),
            "status": (where, np.dtype(np.uint8)),
        }
        return self._launch_of("closest_hit", device, shape, dtype, outputs)


@dataclass(frozen=True, kw_only=True)
class AnyHit(_Rays[Occlusion]):
    """Occlusion of segments by a scene: ``op(segments) -> Occlusion``, with segments float32 or float64 (..., 6).

    A segment is its two end points [m]. Both sides of a triangle occlude. A triangle whose plane contains the segment
    does not occlude it.

    Parameters
    ----------
    scene
        Scene that can occlude the segments.
    clearance
        Intersections closer to either end are ignored [m], 0 or more: the surfaces on which the ends lie. Triangles
        through an end are ignored up to rounding.
    precision, variant
        As for `ClosestHit`.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.
    """

    Result: ClassVar[type[Any]] = Occlusion

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        where = _shape_of("AnyHit", "segments", shape)
        flags = (where, np.dtype(np.uint8))
        return self._launch_of("any_hit", device, shape, dtype, {"occluded": flags, "status": flags})


def _shape_of(name: str, what: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Check the shape (..., 6) of an input and return its leading dimensions."""
    if not shape or shape[-1] != 6:
        raise ValueError(f"{name} takes {what} (..., 6), got shape {shape}")
    return shape[:-1]
