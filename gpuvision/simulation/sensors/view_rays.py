"""What surface every bin of a sensor sees: the receivers of secondary light, and what each sends to the sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Float64 = npt.NDArray[np.float64]


class VisibleSurface(NamedTuple):
    """Surface elements that a sensor sees; n = bins times nodes of a bin, those of a bin side by side.

    Attributes
    ----------
    receivers
        (samples, n, 6): places on the surface [m] and its unit normals, on the side that the lens sees; zero where
        nothing is seen.
    weights
        (samples, n): power on the sensor [W] per irradiance [W/m^2] of the element; 0 where nothing is seen.
    triangle
        int32 (samples, n): number in the scene, -1 where nothing is seen.
    """

    receivers: Float64
    weights: Float64
    triangle: npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewRays:
    """Rays through the bins of a sensor, Gauss and Legendre's nodes in each; compared by identity.

    Parameters
    ----------
    view
        The sensor.
    scene, materials
        What it sees; a material for every number in `Scene.material`.
    nodes
        Rays per bin along u and along v. What is smooth across a bin is integrated to order 2 n; the rim of a surface
        within a bin to first order.
    device
        Where rays are traced; None: `Device.best`.

    Raises
    ------
    ValueError
        A triangle's material is missing.

    Notes
    -----
    An element sends albedo / pi of its irradiance towards the lens: that light comes from all around, so a rough
    surface (`OrenNayar`) is taken for `Lambert`'s of the same albedo.
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    nodes: tuple[int, int] = (1, 1)
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
        # (samples, nodes along v, bins, nodes along u) to (samples, bins * nodes).
        v, by_v = (each.reshape(view.samples, along_v, 1, 1) for each in (v, by_v))
        u, by_u = (each.reshape(1, 1, view.bins, along_u) for each in (u, by_u))
        weights = view.etendue(u, v) * by_u * by_v / math.pi
        rays = view.rays(u, v)
        n = view.bins * along_u * along_v
        object.__setattr__(self, "u", np.ascontiguousarray(_side_by_side(np.broadcast_to(u, weights.shape))[0].ravel()))
        object.__setattr__(self, "_weights", _side_by_side(weights).reshape(view.samples, n))
        object.__setattr__(self, "_rays", _side_by_side(rays).reshape(view.samples, n, 6))
        object.__setattr__(self, "_table", _table_of(self.scene, self.materials))
        device = Device.best() if self.device is None else self.device
        real = np.dtype(np.float64 if device.has_double else np.float32)
        cast = ClosestHit(scene=self.scene, precision="single")
        object.__setattr__(self, "_closest", cast.bind(device, (view.samples, n, 6), real))

    def visible_surface(self, L: float) -> VisibleSurface:
        """Return what is seen at a transport L [m]."""
        rays = self._rays + np.concatenate([L * np.array(self.view.transport.direction), np.zeros(3)])
        self._closest.inputs[0].set(rays.astype(self._closest.inputs[0].dtype))
        hits = self._closest.run()
        triangle = hits.triangle.get()
        seen = triangle >= 0
        at = np.where(seen, triangle, 0)
        corner, normal, albedo = (each[at] for each in self._table)
        origin, towards = rays[..., :3], rays[..., 3:]
        # On the ray and on the triangle in double, however single the ray that found it was.
        slope = np.sum(normal * towards, axis=-1)
        way = np.sum(normal * (corner - origin), axis=-1) / np.where(seen, slope, 1.0)
        places = origin + np.where(seen, way, 0.0)[..., None] * towards
        receivers = np.concatenate([places, np.where(slope[..., None] > 0.0, -normal, normal)], axis=-1)
        receivers = np.where((seen & (self._weights > 0.0))[..., None], receivers, 0.0)
        return VisibleSurface(receivers, np.where(seen, self._weights * albedo, 0.0), triangle)

    def exposure(self, seen: VisibleSurface, irradiance: Float64) -> Exposure:
        """Return what the sensor gets from the irradiance [W/m^2] of what it sees, (samples, n)."""
        power = np.where(seen.weights > 0.0, seen.weights * irradiance, 0.0)
        shape = (self.view.samples, self.view.bins, -1)
        beside = self.u.reshape(self.view.bins, -1) - self.view.u_centres[:, None]
        held = power.reshape(shape)
        return Exposure(held.sum(axis=-1), np.sum(held * beside, axis=-1))


def _table_of(scene: Scene, materials: Sequence[Material]) -> tuple[Float64, Float64, Float64]:
    """Return a corner, the normal and the albedo of every triangle; of one without area where there is none."""
    if not len(scene.corners):
        return np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1)
    assert scene.material is not None  # set by Scene itself
    return scene.corners[:, 0], unit_normals(scene), np.array([each.albedo for each in materials])[scene.material]


def check_materials(scene: Scene, materials: Sequence[Material]) -> None:
    """Check that every triangle has a material.

    Raises
    ------
    ValueError
        One has none.
    """
    assert scene.material is not None  # set by Scene itself
    highest = int(scene.material.max(initial=-1))
    if highest >= len(materials):
        raise ValueError(f"the scene has materials 0 to {highest}, {len(materials)} are given; expected one for each")


def unit_normals(scene: Scene) -> Float64:
    """Return the normals of a scene's triangles as they are wound, (n, 3); zero where one has no area."""
    one, two = scene.corners[:, 1] - scene.corners[:, 0], scene.corners[:, 2] - scene.corners[:, 0]
    normal = np.cross(one, two)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0.0, length, 1.0))


def _nodes(edges: Float64, count: int) -> tuple[Float64, Float64]:
    """Return Gauss and Legendre's nodes between edges, and their weights, (slots, count)."""
    node, weight = np.polynomial.legendre.leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    return 0.5 * (edges[1:] + edges[:-1])[:, None] + half * node, half * weight


def _side_by_side(array: Float64) -> Float64:
    """Turn (samples, nodes along v, bins, nodes along u, ...): both nodes of a bin last."""
    return np.ascontiguousarray(array.swapaxes(1, 2))
