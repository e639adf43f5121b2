"""Surfaces visible in each bin of a sensor: receivers of secondary light, and their weights on the sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Float64 = npt.NDArray[np.float64]

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # its multiples modulo 1 are spread most evenly


class VisibleSurface(NamedTuple):
    """Surface elements that a sensor sees; n is bins times nodes per bin, the nodes of a bin contiguous.

    Attributes
    ----------
    receivers
        float64 (samples, n, 6), positions on the surface [m] and unit normals on the side of the lens; 0 where nothing
        is visible.
    weights
        float64 (samples, n), power on the sensor [W] per irradiance [W/m^2] of the element; 0 where nothing is visible.
    triangle
        int32 (samples, n), number of the triangle in the scene; -1 where nothing is visible.
    """

    receivers: Float64
    weights: Float64
    triangle: npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewRays:
    """Rays through the bins of a sensor, at the nodes of a quadrature; compared by identity.

    Parameters
    ----------
    view
        View of the sensor.
    scene, materials
        The scene, and a material for every index in `Scene.material`.
    nodes
        Nodes per bin along u and along v, 1 or more each. The quadrature of n nodes is exact to order 2 n for smooth
        light in a bin, and of first order at the edge of a surface within a bin. Default ``(1, 1)``.
    spreads_rays
        Whether rays at different places along u differ in their places along v, for readings that add up the bins; see
        the notes. Default False: each bin has the same nodes.
    device
        Device on which rays are traced; None: `Device.best`.

    Raises
    ------
    ValueError
        The material of a triangle is missing.

    Notes
    -----
    At the edge of a surface or a shadow along u, and beside a lit line, equal nodes make the errors of all bins alike.
    With ``spreads_rays`` the errors differ, and largely cancel in a reading that adds up the bins. The weights of the
    Gauss-Legendre quadrature divide a sample into cells along v. A ray lies in each cell, at a multiple of the golden
    ratio, modulo 1: these places are spread evenly. Uniform light is as exact as without it. The light of a single bin
    is further off: its error is of first order in the cell.

    An element sends albedo / pi times its irradiance towards the lens. Secondary light arrives from all directions:
    a rough diffuse surface (`OrenNayar`) is treated as `Lambert` with the same albedo.

    References
    ----------
    L. Kuipers and H. Niederreiter, *Uniform Distribution of Sequences*, Wiley 1974, chapter 2.3.
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    nodes: tuple[int, int] = (1, 1)
    spreads_rays: bool = False
    device: Device | None = None
    u: Float64 = field(init=False, repr=False)
    _rays: Float64 = field(init=False, repr=False)
    _weights: Float64 = field(init=False, repr=False)
    _table: tuple[Float64, Float64, Float64] = field(init=False, repr=False)
    _closest: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_materials(self.scene, self.materials)
        view, (along_u, along_v) = self.view, self.nodes
        u, by_u = _nodes(view.u_edges, along_u)
        v, by_v = _nodes(view.v_edges, along_v)
        start = view.v_edges[:-1, None] + np.cumsum(by_v, axis=1) - by_v  # of the cells
        # Broadcast to (samples, nodes along v, bins, nodes along u), then reorder to (samples, bins * nodes).
        v, by_v, start = (each.reshape(view.samples, along_v, 1, 1) for each in (v, by_v, start))
        u, by_u = (each.reshape(1, 1, view.bins, along_u) for each in (u, by_u))
        weights = view.etendue(u, v) * by_u * by_v / math.pi
        if self.spreads_rays:
            v = start + by_v * (_GOLDEN * np.arange(1, u.size + 1).reshape(u.shape) % 1.0)
        rays = view.rays(u, v)
        n = view.bins * along_u * along_v
        object.__setattr__(self, "u", np.ascontiguousarray(_nodes_last(np.broadcast_to(u, weights.shape))[0].ravel()))
        object.__setattr__(self, "_weights", _nodes_last(weights).reshape(view.samples, n))
        object.__setattr__(self, "_rays", _nodes_last(rays).reshape(view.samples, n, 6))
        object.__setattr__(self, "_table", _triangle_table(self.scene, self.materials))
        device = Device.best() if self.device is None else self.device
        real = np.dtype(np.float64 if device.has_double else np.float32)
        cast = ClosestHit(scene=self.scene, precision="single")
        object.__setattr__(self, "_closest", cast.bind(device, (view.samples, n, 6), real))

    def visible_surface(self, L: float) -> VisibleSurface:
        """Trace the rays at a transport L [m], and return the visible surface elements."""
        rays = self._rays + np.concatenate([L * np.array(self.view.transport.direction), np.zeros(3)])
        self._closest.inputs[0].set(rays.astype(self._closest.inputs[0].dtype))
        hits = self._closest.run()
        triangle = to_numpy(hits.triangle)
        hit = triangle >= 0
        at = np.where(hit, triangle, 0)
        corner, normal, albedo = (each[at] for each in self._table)
        origin, towards = rays[..., :3], rays[..., 3:]
        # The position is computed again in double: the tracing in single precision only selects the triangle.
        slope = np.sum(normal * towards, axis=-1)
        distance = np.sum(normal * (corner - origin), axis=-1) / np.where(hit, slope, 1.0)
        places = origin + np.where(hit, distance, 0.0)[..., None] * towards
        receivers = np.concatenate([places, np.where(slope[..., None] > 0.0, -normal, normal)], axis=-1)
        receivers = np.where((hit & (self._weights > 0.0))[..., None], receivers, 0.0)
        return VisibleSurface(receivers, np.where(hit, self._weights * albedo, 0.0), triangle)

    def exposure(self, seen: VisibleSurface, irradiance: Float64) -> Exposure:
        """Return the exposure of the sensor by irradiated surface elements.

        Parameters
        ----------
        seen
            Result of `visible_surface`.
        irradiance
            float64 (samples, n), irradiance of the elements [W/m^2].
        """
        power = np.where(seen.weights > 0.0, seen.weights * irradiance, 0.0)
        shape = (self.view.samples, self.view.bins, -1)
        offset = self.u.reshape(self.view.bins, -1) - self.view.u_centres[:, None]
        held = power.reshape(shape)
        return Exposure(held.sum(axis=-1), np.sum(held * offset, axis=-1))


def _triangle_table(scene: Scene, materials: Sequence[Material]) -> tuple[Float64, Float64, Float64]:
    """Return a corner, the normal and the albedo of each triangle; one row of zeros for an empty scene."""
    if not len(scene.corners):
        return np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1)
    assert scene.material is not None  # set by Scene itself
    return scene.corners[:, 0], unit_normals(scene), np.array([each.albedo for each in materials])[scene.material]


def check_materials(scene: Scene, materials: Sequence[Material]) -> None:
    """Check that every triangle has a material.

    Raises
    ------
    ValueError
        The material of a triangle is missing.
    """
    assert scene.material is not None  # set by Scene itself
    highest = int(scene.material.max(initial=-1))
    if highest >= len(materials):
        raise ValueError(
            f"the scene has materials 0 to {highest}, but {len(materials)} are given; expected one for each"
        )


def unit_normals(scene: Scene) -> Float64:
    """Return the unit normals of a scene's triangles by their winding, (n, 3); 0 for triangles without area."""
    one, two = scene.corners[:, 1] - scene.corners[:, 0], scene.corners[:, 2] - scene.corners[:, 0]
    normal = np.cross(one, two)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0.0, length, 1.0))


def _nodes(edges: Float64, count: int) -> tuple[Float64, Float64]:
    """Return Gauss-Legendre nodes and weights for each interval between edges, (intervals, count) each."""
    node, weight = np.polynomial.legendre.leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    return 0.5 * (edges[1:] + edges[:-1])[:, None] + half * node, half * weight


def _nodes_last(array: Float64) -> Float64:
    """Reorder (samples, nodes along v, bins, nodes along u, ...) so that the nodes of a bin are contiguous."""
    return np.ascontiguousarray(array.swapaxes(1, 2))
