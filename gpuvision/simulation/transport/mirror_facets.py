"""Which plane mirrors may show which lines: facets in blocks, so that most are never looked at."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.transport.mirror_points import Blocks

Float64 = npt.NDArray[np.float64]

_GROUP, _LANES = 64, 16
# How far apart facets of other directions are put to be blocked, in sizes of all.
_APART = 100.0


class NearFacets(NamedTuple):
    """Which blocks of plane mirrors may show lines.

    Attributes
    ----------
    near
        uint8 (..., blocks): 1 where the lens may see a part of the line in one of the block's mirrors, else 0.
    """

    near: Any


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorFacets(VisionOperation[NearFacets]):
    """Which blocks of plane mirrors may show lines: ``op(lines, lens) -> NearFacets``; compared by identity.

    Lines are float32 or float64 (..., 6), two ends in metres; the lens is a place, (3,).

    Parameters
    ----------
    corners
        (m, 3, 3): the mirrors [m], each with an area.
    precision
        Of the arithmetic; None follows the input.
    variant
        "vector" (16 lines in a vector, for CPU runtimes), "work_item" (for GPUs), "auto".

    Raises
    ------
    ValueError
        The corners are not what is said here.

    Notes
    -----
    No block is left out that shows something: a block is a ball and a cone of normals (`Blocks`), widened by some
    roundings, and the line's way through the cone of what these may show is bounded by tangents.
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
    def blocks(self) -> Blocks:
        """The facets by blocks, each of one direction as far as that goes."""
        corners = self.corners
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        reach = _APART * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
        normals = np.repeat(normal[:, None], 3, axis=1)
        # Put apart by direction, then measured where they are.
        return Blocks.of(corners, normals, corners + reach * normals)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"MirrorFacets takes float32 or float64, got {dtype}")
        if not shape or shape[-1] != 6:
            raise ValueError(f"MirrorFacets takes lines (..., 6), both ends, got shape {shape}")
        real = real_of(self.precision, dtype)
        strip, where = uses_vectors(self.variant, device), shape[:-1]
        count, blocks = math.prod(where), len(self.blocks.radius)
        items = -(-count // _LANES) if strip else -(-count // _GROUP) * _GROUP
        middle = (0.5 * (self.corners.min((0, 1)) + self.corners.max((0, 1)))).astype(dtype)
        return Launch(
            source="mirrors/mirrors.cl",
            kernel="mirror_facets",
            defines={
                **real_defines(device, real),
                **({"VECTOR_VARIANT": None} if strip else {}),
                "INPUT": "float" if dtype == np.float32 else "double",
            },
            inputs=[(shape, dtype), ((3,), dtype)],
            outputs={"near": ((*where, blocks), np.dtype(np.uint8))},
            arguments=[
                self.blocks.table(middle.astype(np.float64)).astype(real),
                middle,
                np.uint32(blocks),
                np.uint64(count),
            ],
            global_size=(items,),
            local_size=(1,) if strip else (_GROUP,),
        )
