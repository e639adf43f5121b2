"""Where curved mirrors show points, and how concentrated their light arrives."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.bvh import Bvh
from gpuvision.simulation.scene.closed_surfaces import vertex_numbers
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.sheet_cut import ranges

Float64 = npt.NDArray[np.float64]
_ROW, _BLOCK, _GROUP, _LANES = 27, 11, 64, 16
_CREASE = math.radians(40.0)


def smooth_normals(scene: Scene, crease: float = _CREASE) -> Float64:
    """Return a unit normal for every corner of every triangle, (n, 3, 3), as if the surface were smooth.

    At a corner the normals of all triangles that share it are joined, but for those that lean more than the crease
    from the triangle's own: an edge stays an edge. With Max's weights (Weights for computing vertex normals, 1999)
    the normals of a sphere are exact; of other smooth surfaces they are off by the square of the triangles' size.

    Parameters
    ----------
    scene
        Triangles that touch share corners, to the last digit. Of one without area the normals are zero.
    crease
        Radians.
    """
    corners = scene.corners
    ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = np.cross(ahead, back)
    squares = np.sum(ahead * ahead, axis=2) * np.sum(back * back, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        weighted = across / squares[..., None]
        flat = across[:, 0] / np.linalg.norm(across[:, 0], axis=1, keepdims=True)
    bad = ~(np.isfinite(weighted).all(axis=(1, 2)) & np.isfinite(flat).all(axis=1))
    weighted[bad], flat[bad] = 0.0, 0.0
    # All pairs of corners in one place.
    place = vertex_numbers(np.where(np.isfinite(corners), corners, 0.0)).ravel()
    order, counts = np.argsort(place, kind="stable"), np.bincount(place)
    partners = counts[place]
    own = np.repeat(np.arange(len(place)), partners)
    other = order[ranges((np.cumsum(counts) - counts)[place], partners)]
    smooth = np.sum(flat[own // 3] * flat[other // 3], axis=1) > math.cos(crease)
    own, share = own[smooth], weighted.reshape(-1, 3)[other[smooth]]
    total = np.stack([np.bincount(own, column, minlength=len(place)) for column in share.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    lonely = length[:, 0] == 0.0
    total[lonely], length[lonely] = np.repeat(flat, 3, axis=0)[lonely], 1.0
    return np.asarray((total / length).reshape(-1, 3, 3))


class MirroredPoints(NamedTuple):
    """Images of points in curved mirrors.

    Attributes
    ----------
    place
        (..., kept, 3), metres: where on the mirrors they are seen.
    move
        (..., kept, 3): how these places move with the points' steps.
    density
        (..., kept), 1/m^2: the lens' solid angle per area across the rays at the point, or the point's per area at
        the lens: 1 / (way to the mirror + way on) ** 2 where the mirror is flat.
    triangle
        int32 (..., kept): number in the scene, -1 behind the last.
    count
        uint8 (...,): how many there are.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number is not), AMBIGUOUS (there are more images than are kept).
    """

    place: Any
    move: Any
    density: Any
    triangle: Any
    count: Any
    status: Any


class Blocks(NamedTuple):
    """Triangles by the leaves of a tree, and what holds each leaf's: a ball, and a cone of normals.

    Attributes
    ----------
    order
        (m,): the triangles.
    start
        (b + 1,): where blocks begin in it, and the end of the last.
    middle, radius
        (b, 3), (b,): a ball about the triangles, as they bulge.
    axis, cone
        (b, 3), (b,): unit vector, and the angle to it within which all normals lie [rad].
    outside
        (b,): whether all reflect only on the side of their normals.
    """

    order: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    middle: Float64
    radius: Float64
    axis: Float64
    cone: Float64
    outside: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        corners: Float64,
        normals: Float64,
        radix_argsort: Float64 | None = None,
        outside: npt.NDArray[np.bool_] | None = None,
    ) -> Blocks:
        """Return the blocks of triangles and the normals at their corners, each (m, 3, 3).

        They are sorted as if they stood where ``radix_argsort`` says, (m, 3, 3); None: where they do.
        """
        if not len(corners):
            none = np.zeros(0)
            return cls(
                none.astype(int), np.zeros(1, int), none.reshape(0, 3), none, none.reshape(0, 3), none, none > 0.0
            )
        members = Bvh.build(corners if radix_argsort is None else radix_argsort).members
        order, count = members[members >= 0], (members >= 0).sum(axis=1)
        start = np.append(0, np.cumsum(count))
        each = np.repeat(np.arange(len(count)), count)
        points, directions = corners[order], normals[order]
        low, high = (f.reduceat(g(points, axis=1), start[:-1]) for f, g in ((np.minimum, np.min), (np.maximum, np.max)))
        middle = 0.5 * (low + high)
        away = np.linalg.norm(points - middle[each][:, None], axis=2).max(axis=1) + bulge_of(points, directions)
        axis = np.add.reduceat(directions.sum(axis=1), start[:-1])
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        # Where all cancel, any will do: the cone is wide.
        axis = np.where(length > 0.0, axis / np.where(length > 0.0, length, 1.0), (0.0, 0.0, 1.0))
        lean = np.arctan2(
            np.linalg.norm(np.cross(directions, axis[each][:, None]), axis=2),
            np.sum(directions * axis[each][:, None], axis=2),
        )
        radius, cone = (np.maximum.reduceat(value, start[:-1]) for value in (away, lean.max(axis=1)))
        one_sided = np.zeros(len(order), bool) if outside is None else outside[order]
        return cls(order, start, middle, radius, axis, cone, np.logical_and.reduceat(one_sided, start[:-1]))

    def table(self, middle: Float64) -> Float64:
        """Return rows of kernels/mirrors/mirrors.cl, at least one; balls and cones hold what rounding moves."""
        if not len(self.radius):
            return np.zeros((1, _BLOCK))
        twice = np.minimum(2.0 * self.cone * (1.0 + 1e-5) + 1e-6, math.pi)
        radius = self.radius * (1.0 + 1e-5)
        one_sided = self.outside & (twice < 0.5 * math.pi)
        columns = [
            self.middle - middle,
            radius,
            self.axis,
            np.cos(twice),
            np.sin(twice),
            one_sided,
            np.sin(0.5 * twice),
        ]
        return np.column_stack(columns)


def bulge_of(corners: Float64, normals: Float64) -> Float64:
    """Return how far smooth surfaces leave their triangles at most, (m, 3, 3) each to (m,) [m]."""
    edges = np.roll(corners, -1, axis=1) - corners
    rise = np.abs(np.sum(edges * normals, axis=2)) + np.abs(np.sum(edges * np.roll(normals, -1, axis=1), axis=2))
    # Half the sum over pairs of corners of b_i b_j times what they rise above each other's tangents; b_i b_j <= 1 / 3.
    return np.asarray(rise.max(axis=1, initial=0.0) / 6.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorPoints(VisionOperation[MirroredPoints]):
    """Where a lens sees points in curved mirrors: ``op(points, lens) -> MirroredPoints``; compared by identity.

    Points are float32 or float64 (..., 6): a place and a step, any vector, in metres. The lens is a place, (3,). On
    each triangle the place is found by Newton's method at which the direction half way between lens and point is along
    the normal, interpolated from the corners; the place is lifted off the flat triangle as the normals say it bulges.
    Nothing is in the way.

    Parameters
    ----------
    corners, normals
        (m, 3, 3): the mirrors' triangles [m], and the normals at their corners.
    numbers
        (m,): what the triangles are called.
    outside
        (m,) bool: which reflect only on the side that their normals point to; None: all do on both.
    kept
        At most so many images of a point.
    precision
        Of the arithmetic and the outputs but places; None follows the input.
    variant
        "vector" (16 points in a vector, for CPU runtimes), "work_item" (for GPUs), "auto".

    Raises
    ------
    ValueError
        A parameter is not what is said here.

    Notes
    -----
    Normal and surface are exact to the second degree, so images are off by the third power of the triangles' size over
    the radius of curvature, their density by its first. One image per triangle is found: triangles must be small
    beside the distances and radii, at least a few across each image. An image on the edge of two triangles is found on
    both. At grazing incidence, within about what a triangle turns, an image may be missed (of a sphere of 1280
    triangles, of 1 point in 300). Near a caustic the density is unbounded.
    """

    Result: ClassVar[type[Any]] = MirroredPoints

    corners: Float64
    normals: Float64
    numbers: npt.NDArray[np.int32]
    outside: npt.NDArray[np.bool_] | None = None
    kept: int = 8
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name in ("corners", "normals"):
            array = np.asarray(getattr(self, name), np.float64)
            if array.ndim != 3 or array.shape[1:] != (3, 3) or not np.isfinite(array).all():
                raise ValueError(f"MirrorPoints.{name} has shape {array.shape}, expected finite numbers (m, 3, 3)")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "numbers", np.asarray(self.numbers, np.int32))
        outside = np.zeros(len(self.corners), bool) if self.outside is None else np.asarray(self.outside, bool)
        object.__setattr__(self, "outside", outside)
        if not len(self.normals) == len(self.numbers) == len(outside) == len(self.corners) or self.numbers.ndim != 1:
            raise ValueError("MirrorPoints: corners, normals, numbers and outside differ in length, expected one each")
        if not 1 <= self.kept <= 255:
            raise ValueError(f"MirrorPoints.kept is {self.kept}, expected 1 to 255")

    def _table(self, middle: Float64) -> Float64:
        """Return rows of kernels/mirrors/mirrors.cl, at least one."""
        corners, normals = (self.corners - middle)[self._blocks.order], self.normals[self._blocks.order]
        first, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        columns = [
            first,
            one,
            two,
            normals.reshape(-1, 9),
            np.einsum("mk,mnk->mn", one, normals),
            np.einsum("mk,mnk->mn", two, normals),
            -np.sum(one * normals[:, 1], axis=1, keepdims=True),
            -np.sum(two * normals[:, 2], axis=1, keepdims=True),
            np.asarray(self.outside, np.float64)[self._blocks.order, None],
        ]
        return np.hstack(columns) if len(corners) else np.zeros((1, _ROW))

    @functools.cached_property
    def _blocks(self) -> Blocks:
        return Blocks.of(self.corners, self.normals, outside=self.outside)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"MirrorPoints takes float32 or float64, got {dtype}")
        if not shape or shape[-1] != 6:
            raise ValueError(f"MirrorPoints takes points (..., 6), place and step, got shape {shape}")
        real = real_of(self.precision, dtype)
        strip, where = uses_vectors(self.variant, device), shape[:-1]
        count = math.prod(where)
        items = -(-count // _LANES) if strip else -(-count // _GROUP) * _GROUP
        middle = 0.5 * (self.corners.min((0, 1)) + self.corners.max((0, 1))) if len(self.corners) else np.zeros(3)
        # The kernel subtracts the middle as its input's type holds it.
        middle = middle.astype(dtype)
        return Launch(
            source="mirrors/mirrors.cl",
            kernel="mirror_points",
            defines={
                **real_defines(device, real),
                **({"VECTOR_VARIANT": None} if strip else {}),
                "INPUT": "float" if dtype == np.float32 else "double",
            },
            inputs=[(shape, dtype), ((3,), dtype)],
            outputs={
                "place": ((*where, self.kept, 3), dtype),
                "move": ((*where, self.kept, 3), real),
                "density": ((*where, self.kept), real),
                "triangle": ((*where, self.kept), np.dtype(np.int32)),
                "count": (where, np.dtype(np.uint8)),
                "status": (where, np.dtype(np.uint8)),
            },
            arguments=[
                self._table(middle.astype(np.float64)).astype(real),
                np.append(self.numbers[self._blocks.order], -1).astype(np.int32),
                self._blocks.table(middle.astype(np.float64)).astype(real),
                self._blocks.start.astype(np.int32),
                middle,
                np.uint32(len(self._blocks.radius)),
                np.uint32(self.kept),
                np.uint64(count),
            ],
            global_size=(items,),
            local_size=(1,) if strip else (_GROUP,),
        )
