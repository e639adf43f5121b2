"""Patches of a scene, each of one exitance, and the light from them: exact form factors of points and polygons."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Operation, Precision, Walk, in_strips, real_defines
from gpuvision.simulation.line_irradiance import Irradiance
from gpuvision.simulation.scene import Scene

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

    Raises
    ------
    ValueError
        Wrong shapes; corners that are not finite; a triangle without area; patches that are not numbered so.
    """

    corners: Reals
    patch: npt.NDArray[Any] | None = None
    origin: npt.NDArray[Any] | None = None

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
        flat = self._areas == 0.0
        if flat.any():
            raise ValueError(f"Patches: triangle {int(np.argmax(flat))} has no area")

    @classmethod
    def of(cls, scene: Scene, *, size: float, both_sides: bool = False) -> Patches:
        """Cut a scene's triangles until no edge is longer than ``size``, and join small ones.

        Triangles are halved at their longest edge, so that long thin ones give few patches. Triangles of less than
        half the size become one patch where they have their material, their cell of that size, and roughly their
        direction in common.

        Parameters
        ----------
        scene
            Its degenerate triangles are left out.
        size
            Metres.
        both_sides
            Whether the back of every triangle is a surface, too; the outside of a closed part needs no back.
        """
        if not (math.isfinite(size) and size > 0.0):
            raise ValueError(f"Patches.of: size is {size!r}, expected metres, more than 0")
        numbers = scene.bvh.numbers
        if not len(numbers):
            raise ValueError("Patches.of: the scene has no triangles")
        corners = scene.corners[numbers]
        if both_sides:
            corners, numbers = np.concatenate([corners, corners[:, ::-1]]), np.concatenate([numbers, numbers])
        small = _longest(corners)[0] < 0.5 * size
        groups = _cells(corners[small], scene, numbers[small], size)
        large, origin = _halved(corners[~small], numbers[~small], size)
        order = np.argsort(groups, kind="stable")
        first = int(groups.max(initial=-1)) + 1
        return cls(
            np.concatenate([corners[small][order], large]),
            np.concatenate([groups[order], first + np.arange(len(large))]),
            np.concatenate([numbers[small][order], origin]),
        )

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

        Three points of each triangle, by Gauss; of patches of more than three triangles, the centroids of the largest.
        """
        order = np.lexsort((-self._areas, self._patch))
        rank = np.arange(len(order)) - np.searchsorted(self._patch, self._patch)
        order = order[rank < _TRIANGLES_PER_PATCH]
        few = (np.bincount(self._patch) < _TRIANGLES_PER_PATCH)[self._patch[order]]
        inside = np.einsum("pk,mkd->mpd", _THREE_POINTS, self.corners[order[few]]).reshape(-1, 3)
        places = np.concatenate([self.corners[order[~few]].mean(axis=1), inside])
        chosen = np.concatenate([order[~few], np.repeat(order[few], 3)])
        by_patch = np.argsort(self._patch[chosen], kind="stable")
        places, chosen = places[by_patch], chosen[by_patch]
        owner = self._patch[chosen]
        weight = self._areas[chosen] / np.bincount(owner, self._areas[chosen])[owner]
        return np.concatenate([places, self.normals[chosen]], axis=1), owner, weight

    @functools.cached_property
    def normals(self) -> Reals:
        """(m, 3), of unit length, to the triangles' front."""
        return self._area_vectors / (2.0 * self._areas[:, None])

    def halved(self, wanted: npt.NDArray[np.bool_]) -> Patches:
        """Cut the triangles of some patches (count,) in two at their longest edge, each half a patch of its own."""
        if np.shape(wanted) != (self.count,):
            raise ValueError(f"Patches.halved takes which patches, ({self.count},), got shape {np.shape(wanted)}")
        cut = np.asarray(wanted, bool)[self._patch]
        halves = _in_two(self.corners[cut])
        kept = np.unique(self._patch[~cut], return_inverse=True)[1]
        first = int(kept.max(initial=-1)) + 1
        return Patches(
            np.concatenate([self.corners[~cut], halves]),
            np.concatenate([kept, first + np.arange(len(halves))]),
            np.concatenate([self._origin[~cut], np.tile(self._origin[cut], 2)]),
        )

    @property
    def _patch(self) -> Integers:
        return np.asarray(self.patch)

    @property
    def _origin(self) -> Integers:
        return np.asarray(self.origin)

    @functools.cached_property
    def _area_vectors(self) -> Reals:
        return np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])

    @functools.cached_property
    def _areas(self) -> Reals:
        return np.asarray(0.5 * np.linalg.norm(self._area_vectors, axis=1))

    def tables(self, middle: Reals, real: np.dtype[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[np.int32]]:
        """Return the triangles and the patches' starts as kernels/patches.cl takes them."""
        edges = np.diff(self.corners, axis=1).reshape(-1, 6)
        rows = np.concatenate([self.corners[:, 0] - middle, edges, self.normals], axis=1)
        starts = np.searchsorted(self._patch, np.arange(self.count + 1))
        return rows.astype(real), starts.astype(np.int32)


def _longest(corners: Reals) -> tuple[Reals, Integers]:
    """Return the longest edge's length, and at which corner it starts."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return lengths.max(axis=1, initial=0.0), lengths.argmax(axis=1)


def _in_two(corners: Reals) -> Reals:
    """Return the first halves of triangles (n, 3, 3), then the second ones."""
    turn = (_longest(corners)[1][:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[:, :, None], axis=1), 1, 0)
    between = 0.5 * (a + b)
    return np.concatenate([np.stack([a, between, c], axis=1), np.stack([between, b, c], axis=1)])


def _halved(corners: Reals, numbers: Integers, size: float) -> tuple[Reals, Integers]:
    """Halve triangles until no edge is longer; return the pieces and the numbers of what they are of."""
    done, of = [corners[:0]], [numbers[:0]]
    while len(corners):
        fits = _longest(corners)[0] <= size
        done.append(corners[fits])
        of.append(numbers[fits])
        corners, numbers = _in_two(corners[~fits]), np.tile(numbers[~fits], 2)
    return np.concatenate(done), np.concatenate(of)


def _cells(corners: Reals, scene: Scene, numbers: Integers, size: float) -> Integers:
    """Return the same number for triangles of one material, cell, and set of signs of the normal's larger parts."""
    if not len(corners):
        return np.zeros(0, np.int64)
    cells = np.floor(corners.mean(axis=1) / size)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = np.rint(1.5 * normals / np.linalg.norm(normals, axis=1, keepdims=True))
    material = np.asarray(scene.material)[numbers]
    keys = np.column_stack([material, cells, directions])
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1]).reshape(-1)


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
class _FromPatches(Operation[R]):
    patches: Patches
    scene: Scene | None = None
    rays: float = 256.0
    clearance: float | None = None
    precision: Precision = None
    walk: Walk = "auto"

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
        if self.precision not in ("single", "double", None):
            raise ValueError(f"precision must be 'single', 'double' or None, got {self.precision!r}")
        is_double = self.precision == "double" or (self.precision is None and dtype == np.float64)
        return np.dtype(np.float64 if is_double else np.float32)

    def _launch_of(
        self,
        kernel: str,
        device: Device,
        inputs: list[tuple[tuple[int, ...], np.dtype[Any]]],
        outputs: dict[str, Any],
        real: np.dtype[Any],
    ) -> Launch:
        (shape, dtype), count = inputs[0], math.prod(inputs[0][0][:-1])
        strip = in_strips(self.walk, device) and count >= _LANES
        each = _LANES if strip else max(min(count, _GROUP), 1)
        tree = None if self.scene is None or not len(self.scene.bvh.numbers) else self.scene.bvh
        low, high = self.patches.corners.min(axis=(0, 1)), self.patches.corners.max(axis=(0, 1))
        place = np.result_type(dtype, real)
        middle = (0.5 * (low + high) if tree is None else tree.middle).astype(place)
        eps, reach = float(np.finfo(real).eps), float(np.abs([low - middle, high - middle]).max())
        clearance = _CLEARANCE * eps * reach if self.clearance is None else self.clearance
        present = {"STRIP": strip, "FACTORS": kernel == "form_factors", "OCCLUSION": tree is not None}
        return Launch(
            stem="patches",
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
    walk
        "strip" (16-wide vectors, for CPU runtimes), "item" (a work-item per receiver, for GPUs), or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Lambert's sum over the edges of each triangle, cut at the receiver's plane, in a form that does not cancel for
    triangles that are small beside their distance (kernels/patches.h). The error is below 32 f (s + c / d + c / h)
    roundings: f is the factor that a receiver in that place would have if it faced the triangle best, s the longest
    edge over the smallest altitude, c the distance of the farthest corner, d that of the nearest line through an edge,
    h the height above the triangle. Heights of less than 16 roundings of the largest coordinate count as in its plane,
    where the factor is 0.

    Rays go to the middles of equal fields of what of a triangle lies above the receiver's plane; the part of them that
    get through, weighted by what they carry, times the exact factor is the answer. A triangle that is seen whole or not
    at all is exact; half-hidden ones are off by about F / sqrt(rays F) each, either way.
    """

    Result: ClassVar[type[Any]] = Factors

    def _launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
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

    def _launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        real = self._real(device, shape, dtype)
        inputs = [(shape, dtype), ((self.patches.count,), real)]
        return self._launch_of("patch_light", device, inputs, {"irradiance": (shape[:-1], real)}, real)
