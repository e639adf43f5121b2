"""Light that went from surface to surface more than once: all bounces at once, solved for, not summed."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import Irradiance, LitSegments
from gpuvision.simulation.transport.patches import FormFactors, Patches, PatchLight

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
# Receivers whose rows of the matrix stand in memory at a time; quadratures come in multiples of the smaller number, so
# that few shapes are bound.
_ROWS, _ROUND = 2048, 128
_NODES_PER_SEGMENT, _NODES_PER_PATCH = 8, 2.0
# Of patches: segments below that are points, and points within that are one.
_SHORT = 0.0625
_TOLERANCE, _ROUNDS = 3e-6, 400
# Roundings of the scene's extent around a place within which nothing covers it, and which part of a view is none.
_CLEARANCE, _NOTHING = 64.0, 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class Radiosity:
    """Diffuse light between the patches of a scene, every bounce of it; compared by identity.

    The irradiances E and exitances B of patches satisfy B = albedo (E0 + F B), E0 being what arrives straight from the
    light. This is solved, not summed: albedos up to 1 are no harder than others as long as light can get out.

    Parameters
    ----------
    patches
        The surfaces that light goes between.
    albedo
        (count,), of each patch, 0 to 1.
    scene
        What may stand between; None: nothing does (the inside of a convex room).
    device
        Where form factors are computed, in double where it can; None takes `Device.best`.
    dense
        Up to so many patches the matrix is kept in double and factored, once for all lights; beyond, in single, four
        bytes for a pair of patches, and each light is solved for by iteration (GMRES, to 3e-6).

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Exitances that are constant on a patch, arriving light that is averaged over three points of it, and exact form
    factors: in a closed convex room each point's factors add to 1 to rounding, so that no light appears or is lost
    however often it bounces. Errors are of second order in the patches' size where the light is smooth, of first order
    at shadow edges. Beside a lit line that runs into a wall light goes as 1 / distance: `arrival` is the exact mean
    over each patch, and `graded` patches follow what is in corners.
    """

    patches: Patches
    albedo: npt.NDArray[Any]
    scene: Scene | None = None
    device: Device | None = None
    dense: int = 4096

    def __post_init__(self) -> None:
        if not isinstance(self.patches, Patches):
            raise TypeError(f"Radiosity.patches is {type(self.patches).__name__}, expected Patches")
        albedo = np.array(self.albedo, np.float64)
        if albedo.shape != (self.patches.count,):
            raise ValueError(
                f"Radiosity.albedo has shape {albedo.shape}, expected ({self.patches.count},): of each patch"
            )
        if not np.all((albedo >= 0.0) & (albedo <= 1.0)):
            raise ValueError("Radiosity.albedo has values outside 0 to 1")
        object.__setattr__(self, "albedo", albedo)
        object.__setattr__(self, "device", Device.best() if self.device is None else self.device)

    @classmethod
    def of(
        cls,
        scene: Scene,
        albedo: Sequence[float],
        *,
        size: float,
        grades: int = 0,
        both_sides: bool | None = None,
        device: Device | None = None,
        dense: int = 4096,
    ) -> Radiosity:
        """Cut a scene into patches of such a size, albedos being those of its materials.

        Parameters
        ----------
        scene, albedo
            The scene, and an albedo for every number in `Scene.material`.
        size, both_sides
            As of `Patches.of`; metres.
        grades
            How often patches that stand close to each other for their size are halved: in corners (`graded`).
        device, dense
            As of `Radiosity`.

        Raises
        ------
        ValueError
            A parameter is not what is said here.
        """
        patches = Patches.of(scene, size=size, both_sides=both_sides)
        if grades:
            patches = graded(patches, grades, scene, device=device)
        of_material = np.asarray(albedo, np.float64)
        first = np.searchsorted(np.asarray(patches.patch), np.arange(patches.count))
        material = np.asarray(scene.material)[np.asarray(patches.origin)[first]]
        if of_material.ndim != 1 or len(of_material) <= material.max():
            raise ValueError(f"Radiosity.of: {of_material.size} albedos for {material.max() + 1} materials")
        return cls(patches=patches, albedo=of_material[material], scene=scene, device=device, dense=dense)

    def arrival(self, lit: LitSegments) -> Reals:
        """Return (count,) W/m^2: the mean irradiance of what is free of each patch, straight from lit segments.

        What a patch gets from a point of a line is the point's form factor with the patch, so the mean over the patch
        needs no samples on it: only along the line.
        """
        receivers, power = _samples(lit, math.sqrt(float(np.median(self.patches.area))))
        got = np.zeros(self.patches.count)
        for rows, begin in self._rows(receivers):
            got += power[begin : begin + len(rows)] @ rows
        area = self._surface.area
        return np.where(area > 0.0, got / np.where(area > 0.0, area, 1.0), 0.0)

    def exitance(self, arrival: npt.ArrayLike) -> Reals:
        """Return (count,) W/m^2: what leaves each patch of the light that arrives first as ``arrival``, all bounces.

        Raises
        ------
        ValueError
            Wrong shape; or no steady state is near: no light gets out of the scene, and none is absorbed.
        """
        first = np.asarray(arrival, np.float64)
        if first.shape != (self.patches.count,) or not np.isfinite(first).all():
            raise ValueError(f"Radiosity.exitance takes finite irradiances ({self.patches.count},), got {first.shape}")
        return self._solved(self.albedo * first)

    def light(self, receivers: npt.NDArray[Any], exitance: npt.NDArray[Any], *, leave_out: float = 0.0) -> Irradiance:
        """Return what receivers (..., 6), float32 or float64, get from patches of such exitances, by `PatchLight`.

        Parameters
        ----------
        leave_out
            Patches of less exitance are left out [W/m^2]. No receiver gets less by more than that: form factors add to
            1 at most.
        """
        operation = PatchLight(patches=self.patches, scene=self.scene)
        real = np.float64 if receivers.dtype == np.float64 else np.float32
        strong = np.where(exitance >= leave_out, exitance, 0.0).astype(real)
        return operation(receivers, strong, device=self.device)

    @functools.cached_property
    def factors(self) -> Reals:
        """(count, count): which part of each column's exitance arrives on the row's patch."""
        return self._matrix(np.float64)

    def _matrix(self, kind: Any) -> npt.NDArray[Any]:
        points, owner, weight, _ = self._surface
        matrix = np.zeros((self.patches.count, self.patches.count), kind)
        for rows, begin in self._rows(points):
            own, share = owner[begin : begin + len(rows)], weight[begin : begin + len(rows), None]
            starts = np.flatnonzero(np.diff(own, prepend=-1))
            matrix[own[starts]] += np.add.reduceat(share * rows, starts, axis=0)
        return matrix

    def _rows(self, receivers: Reals) -> Iterator[tuple[Reals, int]]:
        """Yield form factors of some receivers after others, and the number of their first."""
        operation, real = FormFactors(patches=self.patches, scene=self.scene), self._real
        for begin in range(0, len(receivers), _ROWS):
            some = receivers[begin : begin + _ROWS]
            padded = np.resize(some, (-(-len(some) // _ROUND) * _ROUND, 6)).astype(real)
            yield operation(padded, device=self.device).factors[: len(some)].astype(np.float64), begin

    @functools.cached_property
    def _surface(self) -> _Surface:
        """What of the patches can be lit: not where a body stands on them."""
        points, owner, weight = self.patches.points
        if self.scene is None:
            return _Surface(points, owner, weight, self.patches.area)
        covered = self._is_covered(self.scene, points)
        points, owner, weight = points[~covered], owner[~covered], weight[~covered]
        part = np.bincount(owner, weight, self.patches.count)
        return _Surface(points, owner, weight / part[owner], self.patches.area * part)

    def _is_covered(self, scene: Scene, points: Reals) -> npt.NDArray[np.bool_]:
        """Whether all that places see is backs of surfaces: they are inside of something."""
        clearance = _CLEARANCE * float(np.finfo(self._real).eps) * float(np.ptp(scene.bvh.corners, axis=(0, 1)).max())
        hit = ClosestHit(scene=scene, clearance=clearance)(points.astype(self._real), device=self.device).triangle
        a, b, c = np.moveaxis(scene.corners[hit], 1, 0)
        behind = np.flatnonzero((hit >= 0) & (np.sum(np.cross(b - a, c - a) * points[:, 3:], axis=1) > 0.0))
        everything = np.ones(self.patches.count, self._real)
        light = PatchLight(patches=self.patches, scene=scene)
        seen = light(np.ascontiguousarray(points[behind], self._real), everything, device=self.device).irradiance
        covered = np.zeros(len(points), bool)
        covered[behind] = seen < _NOTHING
        return covered

    @property
    def _real(self) -> Any:
        assert self.device is not None
        return np.float64 if self.device.has_double else np.float32

    def _solved(self, emitted: Reals) -> Reals:
        if self.patches.count > self.dense:
            return self._iterated(emitted)
        from scipy.linalg import lu_solve

        factored, condition = self._factored
        if condition < 1e3 * float(np.finfo(self._real).eps):
            raise ValueError(_NO_WAY_OUT)
        return np.asarray(lu_solve(factored, emitted))

    @functools.cached_property
    def _factored(self) -> tuple[Any, float]:
        """The factored matrix, and one over its condition."""
        from scipy.linalg import lapack, lu_factor

        matrix = np.eye(self.patches.count) - self.albedo[:, None] * self.factors
        norm = float(np.abs(matrix).sum(axis=0).max())
        factored = lu_factor(matrix, overwrite_a=True, check_finite=False)
        return factored, float(lapack.dgecon(factored[0], norm)[0])

    @functools.cached_property
    def _compact(self) -> npt.NDArray[np.float32]:
        """The factors in single precision: half of the memory, for scenes of many patches."""
        return self._matrix(np.float32)

    def _iterated(self, emitted: Reals) -> Reals:
        from scipy.sparse.linalg import LinearOperator, gmres

        size, factors = self.patches.count, self._compact

        def without_bounced(exitance: Reals) -> Reals:
            return np.asarray(exitance - self.albedo * (factors @ exitance.astype(np.float32)))

        operator = LinearOperator((size, size), without_bounced, dtype=np.float64)
        solution, failed = gmres(operator, emitted, rtol=_TOLERANCE, restart=_ROUNDS, maxiter=1)
        if failed:
            raise ValueError(_NO_WAY_OUT)
        return np.asarray(solution)


class _Surface(NamedTuple):
    """Receivers on patches, whose they are, their weights, and the patches' free areas (count,)."""

    points: Reals
    owner: Integers
    weight: Reals
    area: Reals


_NO_WAY_OUT = (
    "Radiosity: no steady state: hardly any light gets out of the scene or is absorbed; "
    "expected an opening, or an albedo below 1"
)
# From here on a patch sees another one too large: the light on it is not nearly that in its middle.
_CLOSE = 0.15


def graded(patches: Patches, times: int, scene: Scene | None = None, *, device: Device | None = None) -> Patches:
    """Halve patches that see others close by, ``times`` times: in corners, where light changes fastest.

    A patch is halved where a single other one fills more than 0.15 of its view, or has it fill so much of its own.

    Parameters
    ----------
    patches
        To begin with.
    times
        How often; each computes all form factors anew.
    scene
        What may stand between; None: nothing does.
    device
        Where; None: `Device.best`.
    """
    for _ in range(times):
        every = Radiosity(patches=patches, albedo=np.zeros(patches.count), scene=scene, device=device).factors
        close = every > _CLOSE
        patches = patches.halved(np.asarray(close.any(axis=1) | close.any(axis=0)))
    return patches


def _samples(lit: LitSegments, size: float) -> tuple[Reals, Reals]:
    """Return points along segments as receivers (n, 6), and the power in W that each stands for.

    Long segments get the nodes of Gauss and Legendre, closer to each other towards the ends. Of those that are short
    beside the patches, one stands for all in its neighbourhood that face roughly the same way.
    """
    length = np.linalg.norm(lit.ends[:, 1] - lit.ends[:, 0], axis=1)
    power = lit.exitance * length
    short = (length < _SHORT * size) & (power > 0.0)
    middles = lit.ends[short].mean(axis=1)
    keys = np.column_stack([np.floor(middles / (_SHORT * size)), np.rint(1.5 * lit.normals[short])])
    group = np.asarray(np.unique(keys, axis=0, return_inverse=True)[1]).reshape(-1)
    powers = [np.bincount(group, power[short])]
    mean = np.column_stack([np.bincount(group, power[short] * each) for each in middles.T]) / powers[0][:, None]
    order = np.lexsort((np.sum((middles - mean[group]) ** 2, axis=1), group))
    chosen = order[np.diff(group[order], prepend=-1) > 0]
    places = [np.column_stack([middles[chosen], lit.normals[short][chosen]])]
    for k in np.flatnonzero(~short & (power > 0.0)):
        (start, stop), count = lit.ends[k], _NODES_PER_SEGMENT + math.ceil(_NODES_PER_PATCH * length[k] / size)
        nodes, weights = np.polynomial.legendre.leggauss(count)
        s = 0.5 + 0.5 * nodes
        along = s * s * (3.0 - 2.0 * s)
        places.append(np.column_stack([start + along[:, None] * (stop - start), np.tile(lit.normals[k], (count, 1))]))
        powers.append(power[k] * 0.5 * weights * 6.0 * s * (1.0 - s))
    return np.concatenate(places), np.concatenate(powers)
