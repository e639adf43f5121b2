"""Radiosity: diffuse interreflection between patches of a scene, all bounces in one linear solve."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Precision, to_numpy
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import Irradiance, LitSegments
from gpuvision.simulation.transport.patches import FormFactors, Patches, PatchLight

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
# Receivers per batch: the form factors of a batch are in memory together. Batches are padded to multiples of the second
# number, so that few kernels are bound.
_ROWS_PER_BATCH, _ROW_MULTIPLE = 2048, 128
# Gauss-Legendre nodes of a segment: a base number, and more per patch size of its length.
_NODES_PER_SEGMENT, _NODES_PER_PATCH = 8, 2.0


@dataclass(frozen=True, kw_only=True)
class RadiosityLimits:
    """Numerical limits of `Radiosity`.

    Attributes
    ----------
    short_segment
        Segments shorter than this part of a patch's size count as points, and points within it as one; chosen. Default
        0.0625.
    tolerance
        Relative residual at which GMRES stops; measured: the exitances then agree with the factored solution within
        3e-5 (tests). Default 3e-6.
    max_iterations
        Largest number of GMRES iterations. Default 400.
    least_condition
        Reciprocal condition number of the matrix, in roundings, below which there is no steady state. Default 1e3.
    clearance
        Distance from a point within which nothing covers it, in roundings of the scene's extent. Default 64.0.
    covered_view
        Part of a point's view below which fronts of surfaces count as not seen: the point is inside a body. Default
        0.01.
    close_factor
        Form factor from which on `refine_corners` halves a patch: the light on it is not nearly that in its middle.
        Default 0.15.
    """

    short_segment: float = 0.0625
    tolerance: float = 3e-6
    max_iterations: int = 400
    least_condition: float = 1e3
    clearance: float = 64.0
    covered_view: float = 0.01
    close_factor: float = 0.15


@dataclass(frozen=True, eq=False, kw_only=True)
class Radiosity:
    """Radiosity solution between the patches of a scene; compared by identity.

    The irradiance E and the exitance B of the patches satisfy B = albedo (E0 + F B), with the form factors F and the
    irradiance E0 that arrives straight from the light. The linear system is solved, the bounces are not summed: an
    albedo of 1 is no harder than others as long as light can leave the scene.

    Parameters
    ----------
    patches : Patches
        Surfaces that exchange light.
    albedo : numpy.ndarray
        (count,): albedo of each patch, 0 to 1.
    scene : Scene, optional
        Triangles that may occlude; None: nothing occludes (the inside of a convex room).
    device : Device, optional
        Device of the form factors, in double where doubles are fast (`Device.has_fast_double`), else in single; None:
        `Device.best`.
    max_dense : int
        Up to this number of patches the matrix is kept in double and factored once for all lights. With more patches it
        is kept in single, four bytes per pair of patches, and each light is solved iteratively (GMRES). Default 4096.
    limits : RadiosityLimits
        Numerical limits.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or lies outside its range.

    Notes
    -----
    Exitance is constant on a patch, arriving light is averaged over three nodes of it, form factors are exact apart
    from partly hidden triangles (`FormFactors`). In a closed convex room the factors of each point add up to 1 to
    rounding, so that energy is conserved for any number of bounces. Errors are of second order in the patches' size
    where the light is smooth, of first order at shadow edges. Next to a lit line that runs into a wall, the light is
    proportional to 1 / distance: `direct_irradiance` is the exact mean over each patch, and `refine_corners` makes the
    patches in corners smaller.

    References
    ----------
    C. M. Goral et al., *Modeling the interaction of light between diffuse surfaces*, SIGGRAPH 1984.
    M. F. Cohen and J. R. Wallace, *Radiosity and Realistic Image Synthesis*, Academic Press 1993.
    """

    patches: Patches
    albedo: npt.NDArray[Any]
    scene: Scene | None = None
    device: Device | None = None
    max_dense: int = 4096
    limits: RadiosityLimits = RadiosityLimits()

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
    def from_scene(
        cls,
        scene: Scene,
        albedo: Sequence[float],
        *,
        size: float,
        refinements: int = 0,
        graded: bool = False,
        both_sides: bool | None = None,
        device: Device | None = None,
        max_dense: int = 4096,
        limits: RadiosityLimits = RadiosityLimits(),
    ) -> Radiosity:
        """Divide a scene into patches of a size, with the albedos of its materials.

        Parameters
        ----------
        scene, albedo : Scene, sequence of float
            The scene, and an albedo for every number in `Scene.material`.
        size, both_sides : float, bool or None
            As of `Patches.from_scene`; size in metres.
        refinements : int
            Number of times that patches close to others are halved (`refine_corners`). Default 0.
        graded : bool
            Whether patches become smaller towards concave edges, as `Patches.from_scene` says. Default False.
        device, max_dense, limits : Device or None, int, RadiosityLimits
            As of `Radiosity`.

        Raises
        ------
        ValueError
            A parameter lies outside its range, or an albedo is missing.
        """
        patches = Patches.from_scene(scene, size=size, graded=graded, both_sides=both_sides)
        if refinements:
            patches = refine_corners(patches, refinements, scene, device=device, limits=limits)
        of_material = np.asarray(albedo, np.float64)
        first = np.searchsorted(np.asarray(patches.patch), np.arange(patches.count))
        material = np.asarray(scene.material)[np.asarray(patches.origin)[first]]
        if of_material.ndim != 1 or len(of_material) <= material.max():
            raise ValueError(f"Radiosity.from_scene: {of_material.size} albedos for {material.max() + 1} materials")
        return cls(
            patches=patches,
            albedo=of_material[material],
            scene=scene,
            device=device,
            max_dense=max_dense,
            limits=limits,
        )

    def direct_irradiance(self, lit: LitSegments) -> Reals:
        """Return the mean irradiance of the free area of each patch by lit segments, (count,) [W/m^2].

        The power that a patch gets from a point of a line is the point's power times its form factor to the patch. So
        the mean over the patch needs no nodes on it, only along the line.
        """
        size = math.sqrt(float(np.median(self.patches.area)))
        receivers, power = _line_samples(lit, size, self.limits.short_segment)
        got = np.zeros(self.patches.count)
        for rows, begin in self._form_factor_rows(receivers):
            got += power[begin : begin + len(rows)] @ rows
        area = self._surface.area
        return np.where(area > 0.0, got / np.where(area > 0.0, area, 1.0), 0.0)

    def solve(self, arrival: npt.ArrayLike) -> Reals:
        """Return the exitance of each patch after all bounces, (count,) [W/m^2].

        Parameters
        ----------
        arrival : array_like
            (count,): irradiance straight from the light [W/m^2].

        Raises
        ------
        ValueError
            The shape is wrong; or there is no steady state: no light leaves the scene and hardly any is absorbed.
        """
        first = np.asarray(arrival, np.float64)
        if first.shape != (self.patches.count,) or not np.isfinite(first).all():
            raise ValueError(f"Radiosity.solve takes finite irradiances ({self.patches.count},), got {first.shape}")
        return self._solve_system(self.albedo * first)

    def irradiance(
        self, receivers: npt.NDArray[Any], exitance: npt.NDArray[Any], *, min_exitance: float = 0.0
    ) -> Irradiance:
        """Return the irradiance of receivers by the patches, as `PatchLight` does.

        Parameters
        ----------
        receivers : numpy.ndarray
            (..., 6), float32 or float64: position [m] and normal. Computed in single where doubles are slow or missing.
        exitance : numpy.ndarray
            (count,): exitance of the patches [W/m^2].
        min_exitance : float
            Patches of less exitance are omitted [W/m^2]. With exact visibility no receiver loses more than this,
            because its form factors to patches that do not overlap add up to at most 1; sampled visibility
            (`FormFactors`) may exceed that. Default 0.0.
        """
        is_double = receivers.dtype == np.float64
        operation = PatchLight(patches=self.patches, scene=self.scene, precision=self._precision)
        strong = np.where(exitance >= min_exitance, exitance, 0.0).astype(self._real if is_double else np.float32)
        return operation(
            receivers.astype(self._input if is_double else np.float32, copy=False), strong, device=self.device
        )

    @functools.cached_property
    def form_factors(self) -> Reals:
        """Form factors (count, count): share of the column's exitance that arrives on the row's patch."""
        return self._matrix(np.float64)

    def _matrix(self, kind: Any) -> npt.NDArray[Any]:
        points, owner, weight, _ = self._surface
        matrix = np.zeros((self.patches.count, self.patches.count), kind)
        for rows, begin in self._form_factor_rows(points):
            patch, share = owner[begin : begin + len(rows)], weight[begin : begin + len(rows), None]
            starts = np.flatnonzero(np.diff(patch, prepend=-1))
            matrix[patch[starts]] += np.add.reduceat(share * rows, starts, axis=0)
        return matrix

    def _form_factor_rows(self, receivers: Reals) -> Iterator[tuple[Reals, int]]:
        """Yield form factors of batches of receivers, and the index of each batch's first receiver."""
        operation = FormFactors(patches=self.patches, scene=self.scene, precision=self._precision)
        for begin in range(0, len(receivers), _ROWS_PER_BATCH):
            some = receivers[begin : begin + _ROWS_PER_BATCH]
            padded = np.resize(some, (-(-len(some) // _ROW_MULTIPLE) * _ROW_MULTIPLE, 6)).astype(self._input)
            yield operation(padded, device=self.device).factors[: len(some)].astype(np.float64), begin

    @functools.cached_property
    def _surface(self) -> _Surface:
        """Quadrature nodes and areas of the patches without the parts that another body covers."""
        points, owner, weight = self.patches.quadrature
        if self.scene is None:
            return _Surface(points, owner, weight, self.patches.area)
        covered = self._is_covered(self.scene, points)
        points, owner, weight = points[~covered], owner[~covered], weight[~covered]
        part = np.bincount(owner, weight, self.patches.count)
        return _Surface(points, owner, weight / part[owner], self.patches.area * part)

    def _is_covered(self, scene: Scene, points: Reals) -> npt.NDArray[np.bool_]:
        """Return whether points see only backs of surfaces: such points are inside a body."""
        extent = float(np.ptp(scene.bvh.corners, axis=(0, 1)).max())
        clearance = self.limits.clearance * float(np.finfo(self._real).eps) * extent
        closest = ClosestHit(scene=scene, clearance=clearance, precision=self._precision)
        hits = closest(points.astype(self._input), device=self.device)
        hit = to_numpy(hits.triangle)
        a, b, c = np.moveaxis(scene.corners[hit], 1, 0)
        back_hits = np.flatnonzero((hit >= 0) & (np.sum(np.cross(b - a, c - a) * points[:, 3:], axis=1) > 0.0))
        everything = np.ones(self.patches.count, self._real)
        light = PatchLight(patches=self.patches, scene=scene, precision=self._precision)
        seen = np.ascontiguousarray(points[back_hits], self._input)
        received = light(seen, everything, device=self.device).irradiance
        covered = np.zeros(len(points), bool)
        covered[back_hits] = received < self.limits.covered_view
        return covered

    @property
    def _real(self) -> Any:
        """Type of the arithmetic: double where doubles are fast."""
        assert self.device is not None
        return np.float64 if self.device.has_fast_double else np.float32

    @property
    def _input(self) -> Any:
        """Type of receivers: with slow doubles the kernels subtract positions in double, and compute in single."""
        assert self.device is not None
        return np.float64 if self.device.has_double else np.float32

    @property
    def _precision(self) -> Precision:
        return "single" if self._real == np.float32 else None

    def _solve_system(self, emitted: Reals) -> Reals:
        if self.patches.count > self.max_dense:
            return self._solve_iteratively(emitted)
        from scipy.linalg import lu_solve

        factored, condition = self._factored
        if condition < self.limits.least_condition * float(np.finfo(self._real).eps):
            raise ValueError(_NO_STEADY_STATE)
        return np.asarray(lu_solve(factored, emitted))

    @functools.cached_property
    def _factored(self) -> tuple[Any, float]:
        """Factored matrix I - albedo F, and the reciprocal of its condition number."""
        from scipy.linalg import lapack, lu_factor

        matrix = np.eye(self.patches.count) - self.albedo[:, None] * self.form_factors
        norm = float(np.abs(matrix).sum(axis=0).max())
        factored = lu_factor(matrix, overwrite_a=True, check_finite=False)
        return factored, float(lapack.dgecon(factored[0], norm)[0])

    @functools.cached_property
    def _compact(self) -> npt.NDArray[np.float32]:
        """Form factors in single precision: half of the memory, for scenes of many patches."""
        return self._matrix(np.float32)

    def _solve_iteratively(self, emitted: Reals) -> Reals:
        from scipy.sparse.linalg import LinearOperator, gmres

        size, factors = self.patches.count, self._compact

        def without_bounced(exitance: Reals) -> Reals:
            return np.asarray(exitance - self.albedo * (factors @ exitance.astype(np.float32)))

        operator = LinearOperator((size, size), without_bounced, dtype=np.float64)
        limits = self.limits
        solution, failed = gmres(operator, emitted, rtol=limits.tolerance, restart=limits.max_iterations, maxiter=1)
        if failed:
            raise ValueError(_NO_STEADY_STATE)
        return np.asarray(solution)


class _Surface(NamedTuple):
    """Nodes on patches (r, 6), their patches and weights (r,), and the patches' free areas (count,)."""

    points: Reals
    owner: Integers
    weight: Reals
    area: Reals


_NO_STEADY_STATE = (
    "Radiosity: no steady state: hardly any light leaves the scene or is absorbed; "
    "expected an opening, or an albedo below 1"
)


def refine_corners(
    patches: Patches,
    times: int,
    scene: Scene | None = None,
    *,
    device: Device | None = None,
    limits: RadiosityLimits = RadiosityLimits(),
) -> Patches:
    """Halve patches that see others close by, ``times`` times: in corners, where the light changes fastest.

    A patch is halved where a single other patch fills more than 0.15 of its view (`RadiosityLimits.close_factor`), or
    where it fills as much of the other's.

    Parameters
    ----------
    patches
        Patches to start from.
    times
        Number of passes, 0 or more; each computes all form factors anew.
    scene
        Triangles that may occlude; None: nothing occludes.
    device
        Device of the form factors; None: `Device.best`.
    limits
        Numerical limits.
    """
    for _ in range(times):
        every = Radiosity(patches=patches, albedo=np.zeros(patches.count), scene=scene, device=device).form_factors
        close = every > limits.close_factor
        patches = patches.bisected(np.asarray(close.any(axis=1) | close.any(axis=0)))
    return patches


def _line_samples(lit: LitSegments, size: float, short_segment: float) -> tuple[Reals, Reals]:
    """Return points along segments as receivers (n, 6), and the power that each stands for [W].

    Long segments get Gauss-Legendre nodes that are denser towards the ends. Segments that are short compared with the
    patches are grouped: one segment represents all segments in its neighbourhood that face roughly the same way.
    """
    length = np.linalg.norm(lit.ends[:, 1] - lit.ends[:, 0], axis=1)
    power = lit.exitance * length
    short = (length < short_segment * size) & (power > 0.0)
    middles = lit.ends[short].mean(axis=1)
    keys = np.column_stack([np.floor(middles / (short_segment * size)), np.rint(1.5 * lit.normals[short])])
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
