"""Images of points in curved mirrors, and the concentration of light by the curvature (caustics)."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.bvh import Bvh
from gpuvision.simulation.scene.connected_surfaces import vertex_numbers
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
# Work-items of a group; lanes of a vector.
_GROUP, _LANES = 64, 16
# Default angle between neighbouring triangles above which their edge is sharp [rad] (chosen).
CREASE = math.radians(40.0)


def smooth_normals(scene: Scene, crease: float = CREASE) -> Float64:
    """Return unit normals of a smooth surface at the corners of triangles, (n, 3, 3).

    The normal at a corner is the weighted mean over all triangles that share the corner, without triangles that are
    tilted by more than the crease angle against the triangle itself: a sharp edge stays sharp. With Max's weights the
    normals of a sphere are exact; errors on other smooth surfaces are of second order in the triangles' size.

    Parameters
    ----------
    scene
        Triangles; neighbours share corners bit for bit. The normals of a triangle without area are zero.
    crease
        Angle between triangles above which their edge is sharp [rad]. Default 40 degrees.

    References
    ----------
    N. Max, *Weights for computing vertex normals from facet normals*, Journal of Graphics Tools 4(2), 1999.
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
    # All pairs of corners at one position.
    place = vertex_numbers(np.where(np.isfinite(corners), corners, 0.0)).ravel()
    order, counts = np.argsort(place, kind="stable"), np.bincount(place)
    partners = counts[place]
    corner = np.repeat(np.arange(len(place)), partners)
    other = order[concatenated_ranges((np.cumsum(counts) - counts)[place], partners)]
    smooth = np.sum(flat[corner // 3] * flat[other // 3], axis=1) > math.cos(crease)
    corner, share = corner[smooth], weighted.reshape(-1, 3)[other[smooth]]
    total = np.stack([np.bincount(corner, column, minlength=len(place)) for column in share.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    lonely = length[:, 0] == 0.0
    total[lonely], length[lonely] = np.repeat(flat, 3, axis=0)[lonely], 1.0
    return np.asarray((total / length).reshape(-1, 3, 3))


class MirrorImages(NamedTuple):
    """Images of points in curved mirrors.

    Attributes
    ----------
    place
        float (..., kept, 3): position on the mirror at which the point is seen [m].
    move
        float (..., kept, 3): displacement of that position as the point moves by its step [m].
    density
        float (..., kept), 1/m^2: solid angle of rays at the lens per area across the rays at the point, or at the point
        per area at the lens (the two are equal). For a flat mirror it is 1 / (way to the mirror + way on)^2; near a
        caustic it is unbounded.
    triangle
        int32 (..., kept): index of the triangle in the scene; -1 behind the last image.
    image_count
        uint8 (...,): number of images.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a component of the input is not finite), AMBIGUOUS (there are more
        images than are kept).
    """

    place: FloatArray
    move: FloatArray
    density: FloatArray
    triangle: IntArray
    image_count: StatusArray
    status: StatusArray


class MirrorTriangle(NamedTuple):
    """Columns of the triangles' table of ``kernels/mirrors/mirrors.cl``; its struct has the same fields."""

    corner: Float64
    edges: Float64
    normals: Float64
    f_by_x: Float64
    f_by_y: Float64
    f1_at_first: Float64
    f2_at_first: Float64
    one_sided: Float64


class MirrorBlock(NamedTuple):
    """Columns of the blocks' table of ``kernels/mirrors/mirrors.cl``; its struct has the same fields."""

    middle: Float64
    radius: Float64
    axis: Float64
    cosine_of_twice: Float64
    sine_of_twice: Float64
    one_sided: Float64
    sine: Float64


class TriangleBlocks(NamedTuple):
    """Blocks of triangles (the leaves of a tree), each with a bounding ball and a cone of normals.

    Attributes
    ----------
    order
        int64 (m,): indices of the triangles, block by block.
    start
        int64 (b + 1,): index into `order` at which each block begins, and the end of the last.
    middle, radius
        float64 (b, 3), (b,): bounding ball of the triangles and their bulge (`max_bulge`) [m].
    axis, cone
        float64 (b, 3), (b,): unit vector, and the largest angle to it of any normal at a corner [rad].
    outside
        bool (b,): whether all triangles reflect only on the side of their normals.
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
        sorted_by: Float64 | None = None,
        outside: npt.NDArray[np.bool_] | None = None,
    ) -> TriangleBlocks:
        """Return the blocks of triangles and of the normals at their corners, each (m, 3, 3).

        Parameters
        ----------
        corners, normals
            (m, 3, 3): corners [m] and unit normals.
        sorted_by
            (m, 3, 3): corners that the tree is built over; None: ``corners``.
        outside
            (m,) bool: triangles that reflect only on the side of their normals; None: none.
        """
        if not len(corners):
            empty = np.zeros(0)
            return cls(
                empty.astype(int), np.zeros(1, int), empty.reshape(0, 3), empty, empty.reshape(0, 3), empty, empty > 0.0
            )
        members = Bvh.build(corners if sorted_by is None else sorted_by).members
        order, count = members[members >= 0], (members >= 0).sum(axis=1)
        start = np.append(0, np.cumsum(count))
        each = np.repeat(np.arange(len(count)), count)
        points, directions = corners[order], normals[order]
        low, high = (f.reduceat(g(points, axis=1), start[:-1]) for f, g in ((np.minimum, np.min), (np.maximum, np.max)))
        middle = 0.5 * (low + high)
        away = np.linalg.norm(points - middle[each][:, None], axis=2).max(axis=1) + max_bulge(points, directions)
        axis = np.add.reduceat(directions.sum(axis=1), start[:-1])
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        # Where the normals cancel, the cone is wide and its axis is arbitrary.
        axis = np.where(length > 0.0, axis / np.where(length > 0.0, length, 1.0), (0.0, 0.0, 1.0))
        lean = np.arctan2(
            np.linalg.norm(np.cross(directions, axis[each][:, None]), axis=2),
            np.sum(directions * axis[each][:, None], axis=2),
        )
        radius, cone = (np.maximum.reduceat(value, start[:-1]) for value in (away, lean.max(axis=1)))
        one_sided = np.zeros(len(order), bool) if outside is None else outside[order]
        return cls(order, start, middle, radius, axis, cone, np.logical_and.reduceat(one_sided, start[:-1]))

    def table(self, middle: Float64) -> Float64:
        """Return the table of kernels/mirrors/mirrors.cl, one row or more (see `rows`)."""
        rows = np.column_stack(self.rows(middle))
        return rows if len(rows) else np.zeros((1, rows.shape[1]))

    def rows(self, middle: Float64) -> MirrorBlock:
        """Return the columns of kernels/mirrors/mirrors.cl; balls and cones are widened beyond rounding."""
        twice = np.minimum(2.0 * self.cone * (1.0 + 1e-5) + 1e-6, math.pi)
        radius = self.radius * (1.0 + 1e-5)
        one_sided = self.outside & (twice < 0.5 * math.pi)
        return MirrorBlock(
            middle=self.middle - middle,
            radius=radius,
            axis=self.axis,
            cosine_of_twice=np.cos(twice),
            sine_of_twice=np.sin(twice),
            one_sided=np.asarray(one_sided, np.float64),
            sine=np.sin(0.5 * twice),
        )


def max_bulge(corners: Float64, normals: Float64) -> Float64:
    """Return the bound of the distance between triangles and the smooth surface over them, (m,) [m].

    The smooth surface is the surface that `MirrorPoints` uses: the point with barycentric weights b is lifted by half
    the weighted sum of its depths below the tangent planes at the corners, along the corners' normals.

    Parameters
    ----------
    corners, normals
        (m, 3, 3): corners [m] and unit normals.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    rise = np.abs(np.sum(edges * normals, axis=2)) + np.abs(np.sum(edges * np.roll(normals, -1, axis=1), axis=2))
    # The lift is at most half the sum over pairs of corners of b_i b_j times their heights over each other's tangent
    # planes, and the sum of b_i b_j over the pairs is at most 1 / 3.
    return np.asarray(rise.max(axis=1, initial=0.0) / 6.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorPoints(VisionOperation[MirrorImages]):
    """Images of points in curved mirrors: ``op(points, lens) -> MirrorImages``; compared by identity.

    Points are float32 or float64 (..., 6): a position and a step (any vector) [m]. The lens is a position (3,) [m]. On
    each triangle Newton's method finds the point at which the half vector between the directions to the lens and to the
    point is parallel to the normal, interpolated from the corners. The point is lifted off the flat triangle by the
    bulge that the normals imply. Occlusion is not computed.

    Parameters
    ----------
    corners, normals
        (m, 3, 3): triangles of the mirrors [m], and the normals at their corners.
    numbers
        (m,): index of each triangle in the scene.
    outside
        (m,) bool: triangles that reflect only on the side of their normals; None: all reflect on both sides.
    kept
        Largest number of images of a point, 1 to 255. Default 8.
    precision
        Precision of the arithmetic and of all outputs except `MirrorImages.place`; None follows the input.
    variant
        "vector" (16 points in a vector, for CPU runtimes), "work_item" (for GPUs), "auto".

    Raises
    ------
    ValueError
        A parameter lies outside its range.

    Notes
    -----
    Normal and surface are exact to second degree, so the error of an image is of third order in the triangles' size
    over the radius of curvature, and the error of its density of first order. One image per triangle is found:
    triangles must be small compared with distances and radii, at least a few across each image. An image on the edge of
    two triangles is found on both. At grazing incidence, within about the angle that a triangle turns, an image may be
    missed (measured on a sphere of 1280 triangles: 1 point in 300). Near a caustic the density is unbounded.

    References
    ----------
    D. P. Mitchell and P. Hanrahan, *Illumination from curved reflectors*, SIGGRAPH 1992, for images and caustics of
    smooth reflectors by Newton's method.
    """

    Result: ClassVar[type[Any]] = MirrorImages

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
        """Return the table of kernels/mirrors/mirrors.cl, one row or more (see `rows`)."""
        rows = np.column_stack(self.rows(middle))
        return rows if len(rows) else np.zeros((1, rows.shape[1]))

    def rows(self, middle: Float64) -> MirrorTriangle:
        """Return the columns of kernels/mirrors/mirrors.cl."""
        corners, normals = (self.corners - middle)[self._blocks.order], self.normals[self._blocks.order]
        first, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        return MirrorTriangle(
            corner=first,
            edges=np.hstack([one, two]),
            normals=normals.reshape(-1, 9),
            f_by_x=np.einsum("mk,mnk->mn", one, normals),
            f_by_y=np.einsum("mk,mnk->mn", two, normals),
            f1_at_first=-np.sum(one * normals[:, 1], axis=1),
            f2_at_first=-np.sum(two * normals[:, 2], axis=1),
            one_sided=np.asarray(self.outside, np.float64)[self._blocks.order],
        )

    @functools.cached_property
    def _blocks(self) -> TriangleBlocks:
        return TriangleBlocks.of(self.corners, self.normals, outside=self.outside)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="points")
        build.check_shape(shape[-1:] == (6,), "points (..., 6), place and step")
        where, count = shape[:-1], math.prod(shape[:-1])
        middle = 0.5 * (self.corners.min((0, 1)) + self.corners.max((0, 1))) if len(self.corners) else np.zeros(3)
        # The kernel subtracts the middle in the type of its input.
        middle = middle.astype(dtype)
        found = (*where, self.kept)
        shapes = {"place": (*found, 3), "move": (*found, 3), "density": found, "triangle": found}
        return build.launch(
            "mirrors/mirrors.cl",
            "mirror_points",
            work=build.work(count, each=_LANES, group=_GROUP),
            more_inputs=[((3,), dtype)],
            outputs=build.outputs(
                {**shapes, "image_count": where, "status": where}, place=dtype, triangle=np.int32, image_count=np.uint8
            ),
            defines=type_defines("INPUT", dtype),
            arguments=[
                self._table(middle.astype(np.float64)).astype(build.real),
                np.append(self.numbers[self._blocks.order], -1).astype(np.int32),
                self._blocks.table(middle.astype(np.float64)).astype(build.real),
                self._blocks.start.astype(np.int32),
                middle,
                np.uint32(len(self._blocks.radius)),
                np.uint32(self.kept),
                np.uint64(count),
            ],
        )
