"""Mirrors of a scene: which triangles reflect, which of them are plane or curved, and their normals."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.closed_surfaces import visible_sides
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.mirror_facets import MirrorFacets
from gpuvision.simulation.transport.mirror_points import CREASE, max_bulge, smooth_normals
from gpuvision.simulation.transport.plane_mirrors import MIN_HEIGHT, triangle_planes

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class MirrorLimits:
    """Numerical limits of `Mirrors`.

    Attributes
    ----------
    flat_angle
        Sine of the angle between a corner's normal and the triangle's above which the triangle is part of a curved
        mirror; rounding of normals with a wide margin. Default 1e-6.
    max_halvings
        Number of times that a segment with more visible parts than the kernel returns is halved. Default 12.
    clearance
        Distance from a surface within which nothing occludes a ray, as part of the scene's reach; about one rounding in
        single. Default 1e-7.
    crease
        Angle between neighbouring triangles above which their edge is sharp [rad], of `smooth_normals`; chosen.
    min_height
        Least height of the lens above a mirror's plane, and of a point relative to the height of the lens; in parts of
        the lens' distance. Lower ones count as in the plane; derived: some thousand roundings of double.
    """

    flat_angle: float = 1e-6
    max_halvings: int = 12
    clearance: float = 1e-7
    crease: float = CREASE
    min_height: float = MIN_HEIGHT


DEFAULT_LIMITS = MirrorLimits()


@dataclass(frozen=True, eq=False)
class MirrorSurfaces:
    """Surfaces of a scene that reflect; each property is computed once, at its first use.

    Attributes
    ----------
    view
        Sensor; its lens and transport decide which sides of triangles can be visible.
    scene, materials
        Surfaces, and a material for every number in `Scene.material`.
    given_normals
        Normals at the corners of all triangles, (n, 3, 3); None: `smooth_normals` of the mirrors.
    limits
        Numerical limits.
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    given_normals: Float64 | None
    limits: MirrorLimits

    @functools.cached_property
    def material(self) -> npt.NDArray[np.int32]:
        """Number of the material of each triangle."""
        assert self.scene.material is not None  # set by Scene itself
        return self.scene.material

    @functools.cached_property
    def reflects(self) -> npt.NDArray[np.bool_]:
        """Whether each triangle is a mirror that light can meet."""
        mirror = np.array([each.mirror for each in self.materials])
        is_mirror = np.zeros(len(self.material), bool)
        is_mirror[self.scene.bvh.numbers] = True
        return is_mirror & (mirror[self.material] > 0.0)

    @functools.cached_property
    def normals(self) -> Float64:
        """Normals at the corners, (n, 3, 3), outwards on closed surfaces; only the normals of mirrors are used."""
        if self.given_normals is not None:
            found = np.array(self.given_normals, np.float64)
        else:
            found = np.zeros(self.scene.corners.shape)
            some = np.flatnonzero(self.reflects)
            if len(some):
                found[some] = smooth_normals(Scene(self.scene.corners[some]), self.limits.crease)
        with np.errstate(invalid="ignore"):
            inward = np.sum(found.sum(axis=1) * self.normal_of, axis=1) * self.sides < 0.0
        found[inward] *= -1.0
        return found

    @functools.cached_property
    def sides(self) -> npt.NDArray[np.int8]:
        """Sides of each triangle that can be visible, as `visible_sides`."""
        return visible_sides(self.scene, self.view.lens, self.view.transport.direction)

    @functools.cached_property
    def is_curved(self) -> npt.NDArray[np.bool_]:
        """Whether each triangle is part of a curved mirror."""
        lean = np.linalg.norm(np.cross(self.normals, self.normal_of[:, None]), axis=2).max(axis=1, initial=0.0)
        return np.asarray(self.reflects & (lean > self.limits.flat_angle))

    @functools.cached_property
    def normal_of(self) -> Float64:
        """Unit normals of the triangles, (n, 3)."""
        with np.errstate(all="ignore"):
            return triangle_planes(self.scene.corners)[:, :3]

    @functools.cached_property
    def flat(self) -> Integers:
        """Numbers of the triangles that are plane mirrors."""
        return np.flatnonzero(self.reflects & ~self.is_curved)

    @functools.cached_property
    def curved(self) -> Integers:
        """Numbers of the triangles that are parts of curved mirrors."""
        return np.flatnonzero(self.is_curved)

    @functools.cached_property
    def facets(self) -> MirrorFacets:
        """Blocks of plane mirrors."""
        return MirrorFacets(corners=self.scene.corners[self.flat])

    @functools.cached_property
    def planes(self) -> Float64:
        """Planes of the plane mirrors, (flat, 4)."""
        return triangle_planes(self.facets.corners)

    @functools.cached_property
    def bulge(self) -> Float64:
        """Height of the smooth surface over each triangle, as `max_bulge` [m]."""
        return max_bulge(self.scene.corners, self.normals)

    @functools.cached_property
    def clearance(self) -> float:
        """Distance from a surface within which nothing occludes a ray [m]."""
        corners = self.scene.bvh.corners
        return self.limits.clearance * float(np.abs(corners).max(initial=0.0))

    def reflectance_of(self, triangle: Integers) -> Float64:
        """Return the specular reflectance of triangles, 0 to 1."""
        return np.array([each.mirror for each in self.materials])[self.material[triangle]]
