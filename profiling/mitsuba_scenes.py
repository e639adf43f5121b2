"""Scenes with lit strips for Mitsuba and for the closed forms: irradiance in the pixels of a picture.

A strip lies on the surface and emits light. Mitsuba samples it by next-event estimation, with one sample of the light
per path and none of the surface. Its rays start at a distance of 1e-4 times the coordinates, at least 1e-4 units, from
a surface; therefore it gets the scenes in millimetres.
"""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from gpuvision.host import Device, Precision, to_numpy
from gpuvision.profiling.occluded_irradiance import Board
from gpuvision.ranging.sheet_motion import Vector
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.view_rays import unit_normals
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows

Float64 = NDArray[np.float64]
Picture = NDArray[np.float64]

_MILLI = 1e-3
_LIFT = 1e-6  # distance of a strip from its surface [m]
_ACROSS = 3  # lines that represent a strip
_TRY = "import mitsuba as mi; mi.set_variant({0!r}); mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()"


class Receivers(NamedTuple):
    """Receivers of the pixels.

    Attributes
    ----------
    rows
        (rows, columns, nodes squared, 6): position [m] and normal.
    weights
        (nodes squared,): weights of the mean over a pixel.
    whole
        bool (rows, columns): the pixel images a single plane and is some pixels away from every strip.
    """

    rows: Float64
    weights: Float64
    whole: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class LitScene:
    """Triangles with strips of light on them, and an orthographic picture of them.

    Parameters
    ----------
    scene
        Triangles with outward winding: the outer side is white and diffuse, the inner side black.
    segments
        Centre lines of the strips, all with the same exitance [W/m].
    width
        Width of the strips [m].
    middle, right, up
        Centre of the picture in the scene, and the vectors from it to the middles of the right and upper edges [m].
    pixels
        Numbers of rows and columns.
    """

    scene: Scene
    segments: LitSegments
    width: float
    middle: Vector
    right: Vector
    up: Vector
    pixels: tuple[int, int]

    @property
    def towards(self) -> Float64:
        """Viewing direction of the camera, a unit vector."""
        across = np.cross(self.up, self.right)
        return np.asarray(across / np.linalg.norm(across))

    @property
    def before(self) -> Float64:
        """Camera position on the optical axis from which the whole scene is in view."""
        return np.asarray(np.array(self.middle) - 4.0 * float(np.ptp(self.scene.corners)) * self.towards)

    def lines(self, across: int = _ACROSS) -> LitSegments:
        """Return `across` lines for each strip, at the Gauss-Legendre nodes of its width."""
        node, weight = np.polynomial.legendre.leggauss(across)
        along = self.segments.ends[:, 1] - self.segments.ends[:, 0]
        beside = np.cross(self.segments.normals, along / np.linalg.norm(along, axis=1, keepdims=True))
        moved = self.segments.ends[:, None] + 0.5 * self.width * (node[:, None] * beside[:, None])[:, :, None]
        return LitSegments(
            moved.reshape(-1, 2, 3),
            np.repeat(self.segments.normals, across, axis=0),
            (self.segments.exitance[:, None] * (0.5 * weight)).ravel(),
        )

    def receivers(self, nodes: int = 4, off: float = 3.0) -> Receivers:
        """Return the receivers of the pixels; pixels closer than ``off`` pixels to a strip are not ``whole``."""
        node, weight = np.polynomial.legendre.leggauss(nodes)
        inside = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2)
        corners = 0.999 * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
        rows, columns = self.pixels
        row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        at = np.stack([row, column], axis=-1)[..., None, :] + 0.5 + 0.5 * np.concatenate([inside, corners])
        film = (
            self.before + (2.0 * at[..., 1:] / columns - 1.0) * self.right + (1.0 - 2.0 * at[..., :1] / rows) * self.up
        )
        places, normals, seen = self._seen(film)
        level = np.sum(normals * places, axis=-1)
        flat = (np.ptp(normals, axis=2) < 1e-6).all(axis=-1) & (np.ptp(level, axis=2) < 1e-6)
        size = 2.0 * max(np.linalg.norm(self.up) / rows, np.linalg.norm(self.right) / columns)
        pixel = places[:, :, 0]
        clear = np.full(pixel.shape[:2], True)
        for start, end in self.segments.ends:
            share = np.clip((pixel - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
            clear &= np.linalg.norm(pixel - start - share[..., None] * (end - start), axis=-1) > off * size
        held = np.concatenate([places, normals], axis=-1)[:, :, : nodes * nodes]
        weights = 0.25 * np.outer(weight, weight).ravel()
        return Receivers(np.ascontiguousarray(held), weights, flat & clear & seen.all(axis=-1))

    def _seen(self, film: Float64) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        rays = np.concatenate([film, np.broadcast_to(self.towards, film.shape)], axis=-1)
        triangle = to_numpy(ClosestHit(scene=self.scene)(rays).triangle)
        seen = triangle >= 0
        normal, corner = unit_normals(self.scene)[triangle], self.scene.corners[triangle, 0]
        slope = np.where(seen, normal @ self.towards, -1.0)
        distance = np.where(seen, np.sum(normal * (corner - film), axis=-1) / slope, 0.0)
        return film + distance[..., None] * self.towards, normal, seen & (slope < -1e-6)


def groove(angle: float, pixels: tuple[int, int] = (64, 64)) -> LitScene:
    """Return two walls at an angle [rad] with a strip on one of them that runs into the common edge.

    The camera looks along the bisector of the angle and sees 80 mm x 120 mm of the other wall.
    """
    one = np.array([0.0, math.sin(0.5 * angle), math.cos(0.5 * angle)])
    other = one * (1.0, -1.0, 1.0)
    left, right = np.array([-0.2, 0.0, 0.0]), np.array([0.2, 0.0, 0.0])
    walls = [[left, right, right + 0.15 * one], [left, right + 0.15 * one, left + 0.15 * one]]
    walls += [[right, left, left + 0.15 * other], [right, left + 0.15 * other, right + 0.15 * other]]
    normal = np.cross(right, one) / np.linalg.norm(right)
    ends = np.array([[np.zeros(3), 0.1 * one]])
    high = 0.5 * 0.08 * math.sin(0.5 * angle)
    return LitScene(
        scene=Scene(np.array(walls)),
        segments=LitSegments(ends, normal[None], np.ones(1)),
        width=1e-4,
        middle=(0.0, -high, 0.05),
        right=(0.06, 0.0, 0.0),
        up=(0.0, high, 0.0),
        pixels=pixels,
    )


def board(pixels: tuple[int, int] = (40, 184)) -> LitScene:
    """Return a board with parts and a line of strips over them, viewed at 45 degrees: the sides that face the line."""
    of = Board.of()
    slope = math.sqrt(0.5)
    return LitScene(
        scene=of.scene,
        segments=of.segments,
        width=1e-4,
        middle=(0.0, 0.011, 0.003),
        right=(0.046, 0.0, 0.0),
        up=(0.0, 0.01 * slope, 0.01 * slope),
        pixels=pixels,
    )


def by_closed_form(
    lit: LitScene, receivers: Receivers, device: Device, *, occluding: bool, precision: Precision = "double"
) -> Picture:
    """Return the mean irradiance [W/m^2] of every pixel; with ``occluding``, parts occlude strips."""
    made = bound_closed_form(lit, receivers, device, occluding=occluding, precision=precision).run()
    return np.asarray(made.irradiance.get(), np.float64).reshape(*lit.pixels, -1) @ receivers.weights


def bound_closed_form(
    lit: LitScene,
    receivers: Receivers,
    device: Device,
    *,
    occluding: bool,
    precision: Precision = "single",
    across: int = _ACROSS,
) -> Any:
    """Return a bound operation for the irradiance of all receivers; a strip is represented by `across` lines."""
    lines = lit.lines(across)
    places = receivers.rows.reshape(lit.pixels[0], -1, 6)
    light: Any = LineIrradiance(segments=lines, precision=precision)
    if occluding:
        light = OccludedIrradiance(scene=lit.scene, segments=len(lines.exitance), precision=precision)
    bound = light.bind(device, places.shape, places.dtype)
    if occluding:
        bound.inputs[1].set(np.zeros((*places.shape[:2], 2)))
        bound.inputs[2].set(segment_rows(lines))
    bound.inputs[0].set(places)
    return bound


def best_variant() -> str:
    """Return Mitsuba's fastest variant that runs here: "llvm_ad_rgb", or "scalar_rgb".

    The variant is tried in a separate process, because an LLVM that does not know the processor aborts the process.
    """
    tried = subprocess.run([sys.executable, "-c", _TRY.format("llvm_ad_rgb")], capture_output=True, check=False)
    return "scalar_rgb" if tried.returncode else "llvm_ad_rgb"


def by_mitsuba(lit: LitScene, variant: str = "scalar_rgb") -> Callable[[int, int], Picture]:
    """Return a function ``picture(samples, seed)`` that renders the irradiance [W/m^2] with samples per pixel."""
    mi: Any = importlib.import_module("mitsuba")
    mi.set_variant(variant)
    rows, columns = lit.pixels
    transform = mi.ScalarTransform4f
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    emission = float(lit.segments.exitance[0]) / (math.pi * lit.width)
    # The film spans [-1, 1] in width; its height follows from square pixels.
    half = [
        float(np.linalg.norm(each)) / _MILLI * times for each, times in ((lit.right, 1.0), (lit.up, columns / rows))
    ]
    looks = transform().look_at(
        (lit.before / _MILLI).tolist(), ((lit.before + lit.towards) / _MILLI).tolist(), list(lit.up)
    )
    with tempfile.TemporaryDirectory() as folder:
        scene = mi.load_dict(
            {
                "type": "scene",
                "part": _mesh(lit.scene.corners, Path(folder), "part") | {"bsdf": white},
                "strips": _mesh(_strips(lit), Path(folder), "strips")
                | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": emission}}},
                "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
                "sensor": {
                    "type": "orthographic",
                    "to_world": looks @ transform().scale([*half, 1.0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": columns,
                        "height": rows,
                        "rfilter": {"type": "box"},
                        "pixel_format": "luminance",
                        "component_format": "float32",
                    },
                    "sampler": {"type": "independent"},
                },
            }
        )

    def picture(samples: int, seed: int) -> Picture:
        made = np.array(mi.render(scene, spp=samples, seed=seed), np.float64)
        return math.pi * made.reshape(rows, columns)

    return picture


def _strips(lit: LitScene) -> Float64:
    """Return two triangles for each strip, a little above the surface, wound to emit along the normal."""
    start, end = lit.segments.ends[:, 0], lit.segments.ends[:, 1]
    along = end - start
    across = np.cross(lit.segments.normals, along / np.linalg.norm(along, axis=1, keepdims=True))
    lift, half = _LIFT * lit.segments.normals, 0.5 * lit.width * across
    corners = [start - half + lift, end - half + lift, end + half + lift, start + half + lift]
    return np.concatenate([np.stack([corners[k] for k in three], axis=1) for three in ((0, 1, 2), (0, 2, 3))])


def _mesh(corners: Float64, folder: Path, name: str) -> dict[str, Any]:
    path = folder / f"{name}.ply"
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    trimesh.Trimesh(corners.reshape(-1, 3) / _MILLI, faces, process=False).export(path)
    return {"type": "ply", "filename": os.fspath(path), "face_normals": True}
