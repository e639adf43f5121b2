"""Patches of a scene with constant exitance, and exact form factors from points to their triangles."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    Spec,
    StatusArray,
    Variant,
    flags,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.bvh import MIN_STACK_SIZE
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import Irradiance
from gpuvision.simulation.transport.patch_meshing import MeshingLimits, mesh_scene
from gpuvision.simulation.transport.triangle_division import bisect_triangles

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
R = TypeVar("R", bound=tuple[Any, ...])
# Lanes of a vector and work-items of a work-group (speed only; the kernel's build options).
_LANES, _GROUP = 16, 64
# In roundings of the largest coordinate: height up to which a receiver counts as in a triangle's plane, and default
# clearance of rays (`FormFactors.clearance`). Chosen: a few times the rounding of a transformed point, and above it.
_PLANE_ROUNDINGS, _CLEARANCE_ROUNDINGS = 16.0, 64.0
# Quadrature: a patch of fewer triangles than this gets three nodes on each; other patches get the centroids of this
# number of their largest triangles.
_TRIANGLES_PER_PATCH = 4
_MESHING_LIMITS = MeshingLimits()
# Nodes of Gauss' rule of second degree on a triangle, in barycentric coordinates.
_THREE_POINTS = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6.0


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of one or more triangles that emit diffuse light from their front; compared by identity.

    Parameters
    ----------
    corners
        (m, 3, 3): triangles [m], corners counter-clockwise seen from the front.
    patch
        (m,) integers, ascending from 0 without a gap: patch of each triangle. Default: one patch per triangle.
    origin
        (m,) integers: triangle of a scene that each triangle is a part of. Default: the triangle's own index.
    slack
        (count,) metres: distance before a patch within which no surface occludes it, because the patch represents a
        surface there. Default 0.
    nodes
        Receivers (r, 6), their patches (r,), and weights (r,) that add up to 1 for each patch: quadrature nodes for the
        light that arrives on some patches, which replace the nodes on the triangles of the patches (`quadrature`).

    Raises
    ------
    ValueError
        A shape is wrong; a corner is not finite; a triangle has no area; the patches are not numbered as required.
    """

    corners: Reals
    patch: npt.NDArray[Any] | None = None
    origin: npt.NDArray[Any] | None = None
    slack: npt.NDArray[Any] | None = None
    nodes: tuple[Reals, Integers, Reals] | None = None

    def __post_init__(self) -> None:
        corners = np.array(self.corners, np.float64)
        if corners.ndim != 3 or corners.shape[1:] != (3, 3) or not len(corners):
            raise ValueError(f"Patches.corners has shape {corners.shape}, expected (m, 3, 3): triangles in metres")
        if not np.isfinite(corners).all():
            raise ValueError("Patches.corners has numbers that are not finite")
        every = np.arange(len(corners))
        patch = every if self.patch is None else np.asarray(self.patch)
        origin = every if self.origin is None else np.asarray(self.origin)
        for name, values in (("patch", patch), ("origin", origin)):
            if values.shape != (len(corners),) or values.dtype.kind not in "iu":
                raise ValueError(
                    f"Patches.{name} is {values.dtype} {values.shape}, expected integers ({len(corners)},)"
                )
        steps = np.diff(patch.astype(np.int64), prepend=-1)
        if steps[0] != 1 or steps.min() < 0 or steps.max() > 1:
            raise ValueError("Patches.patch must ascend from 0 without a gap")
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "patch", patch.astype(np.int64))
        object.__setattr__(self, "origin", origin.astype(np.int64))
        slack = np.zeros(self.count) if self.slack is None else np.array(self.slack, np.float64)
        if slack.shape != (self.count,) or not np.all(slack >= 0.0):
            raise ValueError(f"Patches.slack has shape {slack.shape}, expected ({self.count},): metres, 0 or more")
        object.__setattr__(self, "slack", slack)
        flat = self._areas == 0.0
        if flat.any():
            raise ValueError(f"Patches: triangle {int(np.argmax(flat))} has no area")

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        *,
        size: float,
        graded: bool = False,
        both_sides: bool | None = None,
        limits: MeshingLimits = _MESHING_LIMITS,
    ) -> Patches:
        """Divide a scene's triangles until no edge is longer than ``size``, and join small triangles.

        Triangles are halved at their longest edge, so that long thin ones give few patches. Triangles smaller than half
        the size are joined where they are connected, have one material, lie in one cell of that size, and face roughly
        one way. More than eight triangles that are joined this way are replaced by an octagon of the same area if they
        are nearly flat, so that a fine mesh costs no more than a coarse one; the light that arrives is still sampled on
        the triangles.

        Parameters
        ----------
        scene
            Surfaces; degenerate triangles are omitted.
        size
            Largest edge of a patch [m], more than 0.
        graded
            Whether triangles become smaller towards concave edges: the longest edge is then at most the distance
            from the nearest surface that faces it, but not below a quarter of ``size`` (`MeshingLimits.grading`,
            `MeshingLimits.least_size`). Default False.
        both_sides
            Whether the back of every triangle is also a surface. None: all backs except the backs of closed surfaces
            whose front is outside.
        limits
            Limits of joining and outlining.

        Raises
        ------
        ValueError
            The size is not a positive number, or the scene has no triangles.
        """
        if not (math.isfinite(size) and size > 0.0):
            raise ValueError(f"Patches.from_scene: size is {size!r}, expected metres, more than 0")
        if not len(scene.bvh.numbers):
            raise ValueError("Patches.from_scene: the scene has no triangles")
        return cls(*mesh_scene(scene, size, both_sides, limits, graded=graded))

    @property
    def count(self) -> int:
        """Number of patches."""
        return int(self._patch[-1]) + 1

    @functools.cached_property
    def area(self) -> Reals:
        """Areas of the patches, (count,) [m^2]."""
        return np.asarray(np.bincount(self._patch, self._areas), np.float64)

    @functools.cached_property
    def quadrature(self) -> tuple[Reals, Integers, Reals]:
        """Quadrature nodes for the light that arrives on patches: receivers (r, 6), their patches (r,), weights (r,).

        The given `nodes`; else Gauss' three nodes on each triangle, or the centroids of the largest triangles for
        patches of more than three.
        """
        given = (np.zeros((0, 6)), np.zeros(0, np.int64), np.zeros(0)) if self.nodes is None else self.nodes
        has_own = np.isin(self._patch, given[1])
        order = np.lexsort((-self._areas, self._patch))
        rank = np.arange(len(order)) - np.searchsorted(self._patch, self._patch)
        order = order[(rank < _TRIANGLES_PER_PATCH) & ~has_own[order]]
        has_few = (np.bincount(self._patch) < _TRIANGLES_PER_PATCH)[self._patch[order]]
        inside = np.einsum("pk,mkd->mpd", _THREE_POINTS, self.corners[order[has_few]]).reshape(-1, 3)
        places = np.concatenate([self.corners[order[~has_few]].mean(axis=1), inside])
        chosen = np.concatenate([order[~has_few], np.repeat(order[has_few], 3)])
        share = self._areas[chosen]
        weight = share / np.bincount(self._patch[chosen], share, self.count)[self._patch[chosen]]
        receivers = np.concatenate([given[0], np.concatenate([places, self.normals[chosen]], axis=1)])
        owner = np.concatenate([given[1], self._patch[chosen]])
        by_patch = np.argsort(owner, kind="stable")
        return receivers[by_patch], owner[by_patch], np.concatenate([given[2], weight])[by_patch]

    @functools.cached_property
    def normals(self) -> Reals:
        """Unit normals on the front of the triangles, (m, 3)."""
        return self._area_vectors / (2.0 * self._areas[:, None])

    def bisected(self, wanted: npt.NDArray[np.bool_]) -> Patches:
        """Return the patches with the triangles of chosen patches halved at their longest edge.

        Each half becomes a new patch. Patches with given `nodes` stay as they are.

        Parameters
        ----------
        wanted
            (count,) bool: patches to halve.

        Raises
        ------
        ValueError
            ``wanted`` has another shape.
        """
        if np.shape(wanted) != (self.count,):
            raise ValueError(f"Patches.bisected takes a mask ({self.count},) of patches, got shape {np.shape(wanted)}")
        selected = np.array(wanted, bool)
        if self.nodes is not None:
            selected[self.nodes[1]] = False
        is_bisected = selected[self._patch]
        halves = bisect_triangles(self.corners[is_bisected])
        number = np.cumsum(~selected) - 1
        first = int(np.count_nonzero(~selected))
        nodes = self.nodes
        return Patches(
            np.concatenate([self.corners[~is_bisected], halves]),
            np.concatenate([number[self._patch[~is_bisected]], first + np.arange(len(halves))]),
            np.concatenate([self._origin[~is_bisected], np.tile(self._origin[is_bisected], 2)]),
            np.concatenate([self._slack[~selected], np.repeat(self._slack[self._patch[is_bisected]], 2)]),
            None if nodes is None else (nodes[0], number[nodes[1]], nodes[2]),
        )

    @property
    def _patch(self) -> Integers:
        return np.asarray(self.patch)

    @property
    def _origin(self) -> Integers:
        return np.asarray(self.origin)

    @property
    def _slack(self) -> Reals:
        return np.asarray(self.slack)

    @functools.cached_property
    def _area_vectors(self) -> Reals:
        return np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])

    @functools.cached_property
    def _areas(self) -> Reals:
        return np.asarray(0.5 * np.linalg.norm(self._area_vectors, axis=1))

    def tables(self, middle: Reals, real: np.dtype[Any]) -> tuple[npt.NDArray[Any], ...]:
        """Return the triangles, the patches' starts and slacks as kernels/patches/patches.cl takes them."""
        edges = np.diff(self.corners, axis=1)
        triangles = PatchTriangle(
            corner=self.corners[:, 0] - middle, edge_1=edges[:, 0], edge_2=edges[:, 1], normal=self.normals
        )
        rows = np.concatenate(triangles, axis=1)
        starts = np.searchsorted(self._patch, np.arange(self.count + 1))
        return rows.astype(real), starts.astype(np.int32), self._slack.astype(real)


class PatchTriangle(NamedTuple):
    """Columns of the triangles' table of ``kernels/patches/patches.cl``, in the order of its struct `PatchTriangle`."""

    corner: Reals
    edge_1: Reals
    edge_2: Reals
    normal: Reals


class Factors(NamedTuple):
    """Form factors from receivers to patches.

    Attributes
    ----------
    factors
        float (..., count): irradiance of the receiver over exitance of the patch; NaN where the status is not OK.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a component of the receiver is not finite, or its normal is zero).
    """

    factors: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class _PatchOperation(VisionOperation[R]):
    patches: Patches
    scene: Scene | None = None
    rays: float = 256.0
    clearance: float | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        name = type(self).__name__
        if not isinstance(self.patches, Patches):
            raise TypeError(f"{name}.patches is {type(self.patches).__name__}, expected Patches")
        if self.scene is not None and not isinstance(self.scene, Scene):
            raise TypeError(f"{name}.scene is {type(self.scene).__name__}, expected a Scene, or None: nothing occludes")
        if not (math.isfinite(self.rays) and self.rays >= 0.0):
            raise ValueError(f"{name}.rays is {self.rays!r}, expected a number, 0 or more")
        if self.clearance is not None and not (math.isfinite(self.clearance) and self.clearance >= 0.0):
            raise ValueError(f"{name}.clearance is {self.clearance!r}, expected metres, 0 or more, or None")

    def _builder(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> LaunchBuilder:
        """Check the receivers and return the builder of their launch."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, narrows=True, variant=self.variant)
        build.check_dtype("float32", "float64", of="receivers")
        build.check_shape(shape[-1:] == (6,), "receivers (..., 6), place and normal")
        return build

    def _sum(
        self, kernel: str, build: LaunchBuilder, shapes: dict[str, tuple[int, ...]], more_inputs: Sequence[Spec] = ()
    ) -> Launch:
        """Describe the launch of a kernel of ``patches.cl`` with outputs of these shapes."""
        count, real = math.prod(build.shape[:-1]), build.real
        work = build.work(count, each=_LANES, group=_GROUP, least=_LANES, grouping="fitted")
        tree = None if self.scene is None or not len(self.scene.bvh.numbers) else self.scene.bvh
        low, high = self.patches.corners.min(axis=(0, 1)), self.patches.corners.max(axis=(0, 1))
        place = np.result_type(build.dtype, real)
        middle = (0.5 * (low + high) if tree is None else tree.middle).astype(place)
        eps, reach = float(np.finfo(real).eps), float(np.abs([low - middle, high - middle]).max())
        clearance = _CLEARANCE_ROUNDINGS * eps * reach if self.clearance is None else self.clearance
        return build.launch(
            "patches/patches.cl",
            kernel,
            work=work,
            more_inputs=more_inputs,
            outputs=build.outputs({**shapes, "status": build.shape[:-1]}),
            defines={
                **type_defines("INPUT", build.dtype),
                **type_defines("POSITION", place),
                "BVH_DEPTH": MIN_STACK_SIZE if tree is None else tree.stack_size,
                **flags(FACTORS=kernel == "form_factors", OCCLUSION=tree is not None),
            },
            arguments=[
                *self.patches.tables(middle, real),
                *([None] * 5 if tree is None else tree.tables(real)),
                middle,
                real.type(_PLANE_ROUNDINGS * eps * reach),
                real.type(clearance),
                real.type(self.rays),
                np.uint32(self.patches.count),
                np.uint64(count),
                np.uint64(work.each),
            ],
        )


@dataclass(frozen=True, kw_only=True)
class FormFactors(_PatchOperation[Factors]):
    """Form factors from receivers to patches: ``op(receivers) -> Factors``, receivers float32 or float64 (..., 6).

    A receiver is a position [m] and a normal of any length. Parts of a patch behind the receiver's plane do not count,
    nor does the back of a patch.

    Parameters
    ----------
    patches
        Emitters.
    scene
        Triangles that may occlude; None: nothing occludes (the inside of a convex room).
    rays
        Rays per unit of form factor: a triangle of form factor F gets ceil(sqrt(rays F))^2 rays, 1 to 256. Default 256.
    clearance
        Distance from either end of a ray within which nothing occludes [m]; None: 64 roundings of the largest
        coordinate.
    precision
        Precision of arithmetic and outputs; None follows the input.
    variant
        "vector" (16-wide vectors, for CPU runtimes), "work_item" (a work-item per receiver, for GPUs), or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or lies outside its range.

    Notes
    -----
    Lambert's sum over the edges of each triangle, clipped at the receiver's plane, in a form without cancellation for
    triangles that are small compared with their distance (kernels/patches/patches.h). The error is below 32 f (s + c /
    d + c / h) roundings: f is the factor that a receiver in that position would have if it faced the triangle best, s
    the longest edge over the smallest altitude, c the distance of the farthest corner, d that of the nearest line
    through an edge, h the height above the triangle. Below a height of 16 roundings of the largest coordinate the
    receiver counts as in the triangle's plane, where the factor is 0. The tests hold these limits.

    Rays go to the middles of equal cells of the part of a triangle above the receiver's plane. The share of them that
    reach it, weighted by the cells' factors, times the exact factor is the result. A triangle that is entirely visible
    or entirely hidden is exact; the error of a partly hidden one is about F / sqrt(rays F), an estimate and not a
    bound.

    References
    ----------
    D. R. Baum, H. E. Rushmeier and J. M. Winget, *Improving radiosity solutions through the use of analytically
    determined form-factors*, SIGGRAPH 1989, for the sum over edges (Lambert 1760).
    """

    Result: ClassVar[type[Any]] = Factors

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        return self._sum("form_factors", build, {"factors": (*shape[:-1], self.patches.count)})


@dataclass(frozen=True, kw_only=True)
class PatchLight(_PatchOperation[Irradiance]):
    """Irradiance by patches: ``op(receivers, exitance) -> Irradiance``, receivers (..., 6), exitance (count,) [W/m^2].

    The sum of `FormFactors` times exitances without the matrix. The exitance has the type of the arithmetic.
    Parameters, exceptions and errors are the same as for `FormFactors`.
    """

    Result: ClassVar[type[Any]] = Irradiance

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        exitance = ((self.patches.count,), build.real)
        return self._sum("patch_light", build, {"irradiance": shape[:-1]}, [exitance])
