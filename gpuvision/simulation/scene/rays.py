"""Rays and segments against the triangles of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene

_RAYS_PER_STRIP, _GROUP = 256, 64
Spec = tuple[tuple[int, ...], np.dtype[Any]]
R = TypeVar("R", bound=tuple[Any, ...])


class Hits(NamedTuple):
    """Where rays meet a scene first.

    Attributes
    ----------
    triangle
        int32 (...,): its number in the scene, -1 where there is none.
    distance
        (...,), metres along the ray; NaN where the status is not OK.
    barycentric
        (..., 2): weights u, v of the triangle's second and third corner; NaN where the status is not OK.
    status
        uint8 `Status` flags, (...,): NO_DATA (the ray meets nothing), NOT_FINITE (a number of the ray is not, or its
        direction is zero).
    """

    triangle: Any
    distance: Any
    barycentric: Any
    status: Any


class Occlusion(NamedTuple):
    """Whether segments are interrupted.

    Attributes
    ----------
    occluded
        uint8 (...,): 1 where a triangle lies between the ends, else 0.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number of the segment is not; it is not occluded).
    """

    occluded: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class _Rays(VisionOperation[R]):
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
    """The first triangle on each ray: ``op(rays) -> Hits``, rays float32 or float64 (..., 6).

    A ray is an origin in metres and a direction of any length. Both sides of a triangle count; a ray in its plane
    passes it, and no ray passes between two triangles at the edge they share.

    Parameters
    ----------
    scene
        What the rays meet.
    clearance
        Metres from the origin within which nothing counts; what lies in the origin never does.
    precision
        Of the arithmetic and the outputs; None follows the input. "single" takes float64 rays too: the scene's middle
        is subtracted in double, and of a ray from afar only the part about the scene is traced.
    variant
        "vector" (a ray against 16 boxes in a vector, for CPU runtimes), "work_item" (a work-item per ray, for GPUs),
        "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Error: places are rounded to the real type once, relative to the scene's middle, so the distance is off by some
    roundings of the scene's size and of the distance, over the cosine of incidence; however far the origin is, on
    devices with double.
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
    """Whether a triangle lies between two points: ``op(segments) -> Occlusion``, float32 or float64 (..., 6).

    A segment is two points in metres. Both sides of a triangle occlude; one in whose plane the segment lies does not.

    Parameters
    ----------
    scene
        What may lie between.
    clearance
        Metres from either end within which nothing occludes: the surfaces that the ends lie on. What lies in an end
        itself never does, but for rounding.
    precision, variant
        As of `ClosestHit`.

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.
    """

    Result: ClassVar[type[Any]] = Occlusion

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        where = _shape_of("AnyHit", "segments", shape)
        flags = (where, np.dtype(np.uint8))
        return self._launch_of("any_hit", device, shape, dtype, {"occluded": flags, "status": flags})


def _shape_of(name: str, what: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    if not shape or shape[-1] != 6:
        raise ValueError(f"{name} takes {what} (..., 6), got shape {shape}")
    return shape[:-1]
