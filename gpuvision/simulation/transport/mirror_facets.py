"""Conservative search for the plane mirrors that may show a line: facets are tested in blocks."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, LaunchBuilder, Precision, StatusArray, Variant, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.simulation.transport.mirror_points import TriangleBlocks

Float64 = npt.NDArray[np.float64]

# Work-items of a work-group and lanes of a vector (speed only; the kernel's build options).
_GROUP, _LANES = 64, 16
# Facets of different directions are moved apart by this many extents before they are sorted into blocks, so that the
# facets of a block have one direction as far as possible (speed only).
_DIRECTION_SEPARATION = 100.0


class NearFacets(NamedTuple):
    """Blocks of plane mirrors that may show lines.

    Attributes
    ----------
    near
        uint8 (..., blocks): 1 where the lens may see a part of the line in a mirror of the block, else 0.
    """

    near: StatusArray


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorFacets(VisionOperation[NearFacets]):
    """Blocks of plane mirrors that may show lines: ``op(lines, lens) -> NearFacets``; compared by identity.

    Lines are float32 or float64 (..., 6): two ends [m]. The lens is a position (3,) [m].

    Parameters
    ----------
    corners
        (m, 3, 3): mirrors [m], each with an area.
    precision
        Precision of the arithmetic; None follows the input.
    variant
        "vector" (16 lines in a vector, for CPU runtimes), "work_item" (for GPUs), "auto".

    Raises
    ------
    ValueError
        The corners have a wrong shape or are not finite.

    Notes
    -----
    The test is conservative: no block that shows a part of the line is omitted. A block is represented by a ball and a
    cone of normals (`TriangleBlocks`), widened by more than rounding; the line is tested against the cone of all points
    that these may show, bounded by tangents. Occlusion is not considered.
    """

    Result: ClassVar[type[Any]] = NearFacets

    corners: Float64
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        array = np.asarray(self.corners, np.float64)
        if array.ndim != 3 or array.shape[1:] != (3, 3) or not len(array) or not np.isfinite(array).all():
            raise ValueError(f"MirrorFacets.corners has shape {array.shape}, expected finite numbers (m, 3, 3), m > 0")
        object.__setattr__(self, "corners", array)

    @functools.cached_property
    def blocks(self) -> TriangleBlocks:
        """Facets in blocks, each of one direction as far as possible."""
        corners = self.corners
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        reach = _DIRECTION_SEPARATION * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
        normals = np.repeat(normal[:, None], 3, axis=1)
        # Sorted at the moved positions, measured at the true ones.
        return TriangleBlocks.of(corners, normals, corners + reach * normals)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="lines")
        build.check_shape(shape[-1:] == (6,), "lines (..., 6), both ends")
        count, blocks = math.prod(shape[:-1]), len(self.blocks.radius)
        middle = (0.5 * (self.corners.min((0, 1)) + self.corners.max((0, 1)))).astype(dtype)
        return build.launch(
            "mirrors/mirrors.cl",
            "mirror_facets",
            work=build.work(count, each=_LANES, group=_GROUP),
            more_inputs=[((3,), dtype)],
            outputs=build.outputs({"near": (*shape[:-1], blocks)}, near=np.uint8),
            defines=type_defines("INPUT", dtype),
            arguments=[
                self.blocks.table(middle.astype(np.float64)).astype(build.real),
                middle,
                np.uint32(blocks),
                np.uint64(count),
            ],
        )
