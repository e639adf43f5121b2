"""Power that surfaces with reflectances reflect from a sheet of light to a sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, Phong, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import Parts
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
# Function from light that arrives at points of segments [W] to power on the sensor [W], by kind of reflection.
ReflectedPower = Callable[[LitLine, Integers, Float64, Float64], dict[str, Float64]]


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceReflection:
    """Reflection of a sheet's light to a sensor by the materials of a scene; compared by identity.

    Parameters
    ----------
    view, scene, materials, sheet
        As for `gpuvision.simulation.transport.direct.DirectLight`.
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    sheet: LightSheet

    def material_numbers(self, line: LitLine) -> npt.NDArray[np.int32]:
        """Return the material of each segment of a line."""
        assert self.scene.material is not None  # set by Scene itself
        return self.scene.material[line.triangle]

    def power(self, line: LitLine, segment: Integers, points: Float64, arriving: Float64) -> dict[str, Float64]:
        """Return the power on the sensor [W] by kind of reflection, from light that arrives at points [W]."""
        normal = line.normals[segment]
        eye = _unit(np.array(self.view.lens) - points)
        arriving = arriving * np.maximum(np.sum(normal * eye, axis=1), 0.0) * self.view.aperture_solid_angle(points)
        sent = {"even": arriving / math.pi, "diffuse": np.zeros(len(points)), "gloss": np.zeros(len(points))}
        material = self.material_numbers(line)[segment]
        for number in np.unique(material):
            mine, made_of = np.flatnonzero(material == number), self.materials[number]
            if isinstance(made_of.diffuse, Lambert):
                sent["diffuse"][mine] = made_of.albedo * sent["even"][mine]
                if made_of.gloss is None:
                    continue
            directions = _to_surface_frames(normal[mine], self.sheet.direction_to_light(points[mine]), eye[mine])
            if not isinstance(made_of.diffuse, Lambert):
                sent["diffuse"][mine] = arriving[mine] * made_of.diffuse.value(directions)
            if made_of.gloss is not None:
                sent["gloss"][mine] = arriving[mine] * made_of.gloss.value(directions)
        return sent

    def split_lobes(self, parts: Parts, line: LitLine, *, lobe_turn: float, max_parts: int) -> Parts:
        """Split parts on glossy surfaces until the half vector turns little within each."""
        widths = np.array([math.inf if each.gloss is None else _lobe_width(each.gloss) for each in self.materials])
        if np.isinf(widths).all():
            return parts
        width = widths[self.material_numbers(line)][parts.segment]
        ends = parts.ends(line)
        half_way = _unit(self.sheet.direction_to_light(ends) + _unit(np.array(self.view.lens) - ends))
        angle = np.linalg.norm(half_way[:, 1] - half_way[:, 0], axis=1) / width
        count = np.clip(np.ceil(angle / lobe_turn), 1, max_parts).astype(np.int64)
        owner, number = np.repeat(np.arange(len(count)), count), concatenated_ranges(np.zeros_like(count), count)
        size = ((parts.end - parts.start) / count)[owner]
        start = parts.start[owner] + number * size
        return parts.select(owner)._replace(start=start, end=start + size)


def mirrored_power(line: LitLine, segment: Integers, points: Float64, arriving: Float64) -> dict[str, Float64]:
    """Return the power of light that a mirror reflects straight into the lens [W]: all of it."""
    return {"diffuse": np.zeros(len(arriving)), "gloss": arriving}


def _lobe_width(lobe: Brdf) -> float:
    """Return the approximate width of a lobe as an angle of the half vector [rad]."""
    if isinstance(lobe, Ggx):
        return lobe.alpha
    if isinstance(lobe, Ward):
        return min(lobe.alpha_x, lobe.alpha_y)
    return 0.5 / math.sqrt(lobe.exponent + 1.0) if isinstance(lobe, Phong) else math.inf


def _to_surface_frames(normal: Float64, light: Float64, eye: Float64) -> Float64:
    """Return the directions to the light and to the eye, (n, 6), in frames whose z axis is the normal."""
    axis = np.where((np.abs(normal[:, 0]) < 0.9)[:, None], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    x = _unit(axis - np.sum(axis * normal, axis=1, keepdims=True) * normal)
    frame = np.stack([x, np.cross(normal, x), normal], axis=1)
    return np.concatenate([np.einsum("nij,nj->ni", frame, each) for each in (light, eye)], axis=1)


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
