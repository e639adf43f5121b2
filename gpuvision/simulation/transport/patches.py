"""Patches of a scene, each of one exitance, and the light from them: exact form factors of points and polygons."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import Irradiance
from gpuvision.simulation.transport.patch_meshing import cut, in_two

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
R = TypeVar("R", bound=tuple[Any, ...])
_LANES, _GROUP = 16, 64
# What rounding may lift a surface above itself, in units in the last place of the largest coordinate.
_LIFT, _CLEARANCE = 16.0, 64.0
# Of patches of many triangles, so many of the largest say what arrives; a few give three points each.
_TRIANGLES_PER_PATCH = 4
_THREE_POINTS = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6.0


@dataclass(frozen=True, eq=False)
class Patches:
    """Triangles that send diffuse light from their front, some to a patch; compared by identity.

    Parameters
    ----------
    corners
        (m, 3, 3), metres; they turn left seen from the front.
    patch
        (m,) integers, ascending from 0 without a gap: which patch each triangle belongs to; each its own if left out.
    origin
        (m,) integers: which triangle of a scene each is a part of; the triangles themselves if left out.
    slack
        (count,), metres: how far before a patch nothing occludes it, because it stands for a surface there; 0 if left
        out.
    looked_at
        Receivers (r, 6), their patches, and their weights (r,), 1 together for a patch: where to look at what arrives
        on some patches, instead of on their own triangles (`points`).

    Raises
    ------
    ValueError
        Wrong shapes; corners that are not finite; a triangle without area; patches that are not numbered so.
    """

    corners: Reals
    patch: npt.NDArray[Any] | None = None
    origin: npt.NDArray[Any] | None = None
    slack: npt.NDArray[Any] | None = None
    looked_at: tuple[Reals, Integers, Reals] | None = None

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
    def of(cls, scene: Scene, *, size: float, both_sides: bool | None = None) -> Patches:
        """Cut a scene's triangles until no edge is longer than ``size``, and join small ones.

        Triangles are halved at their longest edge, so that long thin ones give few patches. What is less than half the
        size is joined where it hangs together, of one material, in one cell of that size, and faces roughly one way.
        More than eight triangles so joined, if they are nearly flat, are replaced by an octagon of their area, so that
        a fine mesh costs no more than a coarse one; light on it is still looked at on the triangles themselves.

        Parameters
        ----------
        scene
            Its degenerate triangles are left out.
        size
            Metres.
        both_sides
            Whether the back of every triangle is a surface, too. None: but for closed surfaces that have their front
            outside, seen from outside.

        Raises
        ------
        ValueError
            The size is no length.
        """
        if not (math.isfinite(size) and size > 0.0):
            raise ValueError(f"Patches.of: size is {size!r}, expected metres, more than 0")
        if not len(scene.bvh.numbers):
            raise ValueError("Patches.of: the scene has no triangles")
        return cls(*cut(scene, size, both_sides))

    @property
    def count(self) -> int:
        """How many patches."""
        return int(self._patch[-1]) + 1

    @functools.cached_property
    def area(self) -> Reals:
        """(count,), m^2."""
        return np.asarray(np.bincount(self._patch, self._areas), np.float64)

    @functools.cached_property
    def points(self) -> tuple[Reals, Integers, Reals]:
        """Where the light that arrives on patches is looked at: receivers (r, 6), their patches, their weights (r,).

        As given; else three points of each triangle, by Gauss, or of patches of more than three triangles the centroids
        of the largest.
        """
        given = (np.zeros((0, 6)), np.zeros(0, np.int64), np.zeros(0)) if self.looked_at is None else self.looked_at
        has_own = np.isin(self._patch, given[1])
        order = np.lexsort((-self._areas, self._patch))
        rank = np.arange(len(order)) - np.searchsorted(self._patch, self._patch)
        order = order[(rank < _TRIANGLES_PER_PATCH) & ~has_own[order]]
        few = (np.bincount(self._patch) < _TRIANGLES_PER_PATCH)[self._patch[order]]
        inside = np.einsum("pk,mkd->mpd", _THREE_POINTS, self.corners[order[few]]).reshape(-1, 3)
        places = np.concatenate([self.corners[order[~few]].mean(axis=1), inside])
        chosen = np.concatenate([order[~few], np.repeat(order[few], 3)])
        share = self._areas[chosen]
        weight = share / np.bincount(self._patch[chosen], share, self.count)[self._patch[chosen]]
        receivers = np.concatenate([given[0], np.concatenate([places, self.normals[chosen]], axis=1)])
        owner = np.concatenate([given[1], self._patch[chosen]])
        by_patch = np.argsort(owner, kind="stable")
        return receivers[by_patch], owner[by_patch], np.concatenate([given[2], weight])[by_patch]

    @functools.cached_property
    def normals(self) -> Reals:
        """(m, 3), of unit length, to the triangles' front."""
        return self._area_vectors / (2.0 * self._areas[:, None])

    def halved(self, wanted: npt.NDArray[np.bool_]) -> Patches:
        """Cut the triangles of some patches (count,) in two at their longest edge, each half a patch of its own.

        Patches that stand for others' triangles (`looked_at`) stay as they are.

        Raises
        ------
        ValueError
            ``wanted`` has another shape.
        """
        if np.shape(wanted) != (self.count,):
            raise ValueError(f"Patches.halved takes which patches, ({self.count},), got shape {np.shape(wanted)}")
        apart = np.array(wanted, bool)
        if self.looked_at is not None:
            apart[self.looked_at[1]] = False
        cut_up = apart[self._patch]
        halves = in_two(self.corners[cut_up])
        number = np.cumsum(~apart) - 1
        first = int(np.count_nonzero(~apart))
        looked_at = self.looked_at
        return Patches(
            np.concatenate([self.corners[~cut_up], halves]),
            np.concatenate([number[self._patch[~cut_up]], first + np.arange(len(halves))]),
            np.concatenate([self._origin[~cut_up], np.tile(self._origin[cut_up], 2)]),
            np.concatenate([self._slack[~apart], np.repeat(self._slack[self._patch[cut_up]], 2)]),
            None if looked_at is None else (looked_at[0], number[looked_at[1]], looked_at[2]),
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
        edges = np.diff(self.corners, axis=1).reshape(-1, 6)
        rows = np.concatenate([self.corners[:, 0] - middle, edges, self.normals], axis=1)
        starts = np.searchsorted(self._patch, np.arange(self.count + 1))
        return rows.astype(real), starts.astype(np.int32), self._slack.astype(real)


class Factors(NamedTuple):
    """Which parts of the patches' exitances reach receivers.

    Attributes
    ----------
    factors
        (..., count): irradiance over exitance; NaN where the status is not OK.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a number of the receiver is not, or its normal is zero).
    """

    factors: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class _FromPatches(VisionOperation[R]):
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

    def _real(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.dtype[Any]:
        name = type(self).__name__
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"{name} takes float32 or float64 receivers, got {dtype}")
        if not shape or shape[-1] != 6:
            raise ValueError(f"{name} takes receivers (..., 6), place and normal, got shape {shape}")
        if dtype == np.float64 and not device.has_double:
            raise ValueError(f"device {device.label} has no double precision; give receivers as float32")
        return real_of(self.precision, dtype, narrows=True)

    def _launch_of(
        self,
        kernel: str,
        device: Device,
        inputs: list[tuple[tuple[int, ...], np.dtype[Any]]],
        outputs: dict[str, Any],
        real: np.dtype[Any],
    ) -> Launch:
        (shape, dtype), count = inputs[0], math.prod(inputs[0][0][:-1])
        strip = uses_vectors(self.variant, device) and count >= _LANES
        each = _LANES if strip else max(min(count, _GROUP), 1)
        tree = None if self.scene is None or not len(self.scene.bvh.numbers) else self.scene.bvh
        low, high = self.patches.corners.min(axis=(0, 1)), self.patches.corners.max(axis=(0, 1))
        place = np.result_type(dtype, real)
        middle = (0.5 * (low + high) if tree is None else tree.middle).astype(place)
        eps, reach = float(np.finfo(real).eps), float(np.abs([low - middle, high - middle]).max())
        clearance = _CLEARANCE * eps * reach if self.clearance is None else self.clearance
        present = {"VECTOR_VARIANT": strip, "FACTORS": kernel == "form_factors", "OCCLUSION": tree is not None}
        return Launch(
            source="patches/patches.cl",
            kernel=kernel,
            defines={
                **real_defines(device, real),
                **{name: None for name, is_present in present.items() if is_present},
                "INPUT": "float" if dtype == np.float32 else "double",
                "PLACE": "float" if place == np.float32 else "double",
                "BVH_DEPTH": 1 if tree is None else tree.depth,
            },
            inputs=inputs,
            outputs={**outputs, "status": (shape[:-1], np.dtype(np.uint8))},
            arguments=[
                *self.patches.tables(middle, real),
                *([None] * 5 if tree is None else tree.tables(real)),
                middle,
                real.type(_LIFT * eps * reach),
                real.type(clearance),
                real.type(self.rays),
                np.uint32(self.patches.count),
                np.uint64(count),
                np.uint64(each),
            ],
            global_size=(-(-count // each) * (1 if strip else each),),
            local_size=(1,) if strip else (each,),
        )


@dataclass(frozen=True, kw_only=True)
class FormFactors(_FromPatches[Factors]):
    """Form factors of receivers and patches: ``op(receivers) -> Factors``, receivers float32 or float64 (..., 6).

    A receiver is a place in metres and a normal of any length. What lies behind its plane does not count, nor does a
    patch from behind.

    Parameters
    ----------
    patches
        What shines.
    scene
        What may stand between; None: nothing does (the inside of a convex room).
    rays
        To a triangle of form factor F go ceil(sqrt(rays F))^2 rays, 1 to 256, so a receiver casts few more than it sees
        triangles.
    clearance
        Metres from either end of a ray within which nothing occludes; None: 64 roundings of the largest coordinate.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16-wide vectors, for CPU runtimes), "work_item" (a work-item per receiver, for GPUs), or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Lambert's sum over the edges of each triangle, cut at the receiver's plane, in a form that does not cancel for
    triangles that are small beside their distance (kernels/patches/patches.h). The error is below 32 f (s + c / d + c /
    h) roundings: f is the factor that a receiver in that place would have if it faced the triangle best, s the longest
    edge over the smallest altitude, c the distance of the farthest corner, d that of the nearest line through an edge,
    h the height above the triangle. Heights of less than 16 roundings of the largest coordinate count as in its plane,
    where the factor is 0.

    Rays go to the middles of equal fields of what of a triangle lies above the receiver's plane; the part of them that
    get through, weighted by what they carry, times the exact factor is the answer. A triangle that is seen whole or not
    at all is exact; half-hidden ones are off by about F / sqrt(rays F) each, either way.
    """

    Result: ClassVar[type[Any]] = Factors

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        real = self._real(device, shape, dtype)
        outputs = {"factors": ((*shape[:-1], self.patches.count), real)}
        return self._launch_of("form_factors", device, [(shape, dtype)], outputs, real)


@dataclass(frozen=True, kw_only=True)
class PatchLight(_FromPatches[Irradiance]):
    """Light from patches: ``op(receivers, exitance) -> Irradiance``, receivers (..., 6), exitance (count,) in W/m^2.

    The sum of `FormFactors` times exitances, without the matrix; the exitance is of the type of the arithmetic.
    Parameters, what is raised and errors are those of `FormFactors`.
    """

    Result: ClassVar[type[Any]] = Irradiance

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        real = self._real(device, shape, dtype)
        inputs = [(shape, dtype), ((self.patches.count,), real)]
        return self._launch_of("patch_light", device, inputs, {"irradiance": (shape[:-1], real)}, real)
