"""A small recording with a known truth: a part under a sheet of light, seen by a camera and by PSD strips.

The light is collimated and falls straight down: a ray cast from above finds what it hits and what the truth is. Seen
is what the ray to the lens does not find covered; it throws back what Lambert says. Photons and electronics add
their noise, the converter its steps. There is direct light only: reflections between surfaces are not in it.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh

from gpuvision.sensor import Sensor

Array = npt.NDArray[Any]

PROFILES = 160
_RAYS = 8  # per column of a camera
_RAYS_OF_STRIP = 16  # a strip is wide: what it averages over must be there
_LINE_SIGMA = 1.2  # pixel
_FULL_WELL, _READ_NOISE, _BACKGROUND, _LINE_PEAK = 20_000.0, 20.0, 400.0, 14_000.0  # electrons
_STRIP_CURRENT, _BANDWIDTH = 1.0e-6, 50e3  # A on a flat surface, Hz
_ELECTRON = 1.602176634e-19  # C
_CAST_CELL = 0.1e-3  # m, of the raster that covers what is behind
_MARCH = 96


def part() -> trimesh.Trimesh:
    """Return a plate with a box, a disc, a ball sunk into it, and three steps: 46 x 36 mm, 6 mm high."""
    create, mm = trimesh.creation, 1e-3
    solids = [
        _placed(create.box((46 * mm, 36 * mm, 2 * mm)), 0, 0, -1),
        _placed(create.box((12 * mm, 10 * mm, 6 * mm)), -13, 9, 3),
        _placed(create.cylinder(5 * mm, 4 * mm, sections=64), -13, -9, 2),
        _placed(create.icosphere(3, 8 * mm), 10, 8, -3),
    ]
    solids += [
        _placed(create.box((6 * mm, 12 * mm, height * mm)), x, -9, height / 2)
        for x, height in ((4, 1), (10, 2), (16, 3))
    ]
    joined: Any = trimesh.util.concatenate(solids)
    made: trimesh.Trimesh = joined
    return made


def _placed(solid: trimesh.Trimesh, x_mm: float, y_mm: float, z_mm: float) -> trimesh.Trimesh:
    solid.apply_translation((1e-3 * x_mm, 1e-3 * y_mm, 1e-3 * z_mm))
    return solid


def cast_down(mesh: trimesh.Trimesh, x: Array, y: Array) -> tuple[Array, Array]:
    """Cast rays straight down.

    Returns
    -------
    z, facing
        Height of the first surface [m] and the vertical part of its normal; NaN and 0 where there is none.
    """
    shape = np.shape(x)
    x, y = np.ravel(x), np.ravel(y)
    z, facing = np.full(x.size, -np.inf), np.zeros(x.size)
    order = np.argsort(y)
    sorted_y = y[order]
    upward = mesh.face_normals[:, 2] > 1e-9
    for (a, b, c), normal in zip(mesh.triangles[upward], mesh.face_normals[upward], strict=True):
        lowest, highest = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        near = order[np.searchsorted(sorted_y, lowest, "left") : np.searchsorted(sorted_y, highest, "right")]
        along, across = x[near] - a[0], y[near] - a[1]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        beta = (along * (c[1] - a[1]) - across * (c[0] - a[0])) / area
        gamma = (across * (b[0] - a[0]) - along * (b[1] - a[1])) / area
        hit = (beta >= -1e-12) & (gamma >= -1e-12) & (beta + gamma <= 1.0 + 1e-12)
        height = a[2] + beta * (b[2] - a[2]) + gamma * (c[2] - a[2])
        higher = near[hit & (height > z[near])]
        z[higher] = height[hit & (height > z[near])]
        facing[higher] = normal[2]
    return np.where(np.isfinite(z), z, np.nan).reshape(shape), facing.reshape(shape)


class Light(NamedTuple):
    """What the sheet of light hits, each array (profiles, rays).

    Attributes
    ----------
    u, v
        Where the lens images it, in sensor units.
    strength
        Light that reaches the lens, 1 from a flat surface; 0 where the light or the lens does not see it.
    """

    u: Array
    v: Array
    strength: Array


@dataclass(frozen=True)
class _Setup:
    """The camera's or the PSD's place, read from the sensor file and used without the library's triangulation."""

    baseline: float
    stand_off: float
    focal_distance: float
    tilt: float
    k1: float

    @classmethod
    def of(cls, name: str) -> _Setup:
        text = resources.files("gpuvision").joinpath("sensors", f"{name}.toml").read_text(encoding="utf-8")
        table = tomllib.loads(text)
        place = dict(table["triangulation"])
        if "tilt" not in place:
            # Scheimpflug: sensor, lens plane and sheet meet in one line.
            distance = math.hypot(place["baseline"], place["stand_off"])
            place["tilt"] = math.atan(place["focal_distance"] / distance / (place["baseline"] / place["stand_off"]))
        return cls(**place, k1=table.get("lens", {}).get("k1", 0.0))

    def image(self, G: Array, H: Array) -> tuple[Array, Array]:
        """Project points of the sheet: a ray through the lens' middle meets the tilted sensor."""
        t, distance = math.atan2(self.baseline, self.stand_off), math.hypot(self.baseline, self.stand_off)
        up, depth = H * math.sin(t), distance - H * math.cos(t)
        scale = self.focal_distance / (depth * math.cos(self.tilt) - up * math.sin(self.tilt))
        u, v = scale * up, scale * G * math.cos(self.tilt)
        return self._distorted(u, v)

    def _distorted(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Find the point that the lens' polynomial takes to this one, by repetition: the distortion is small."""
        x, y = u, v
        for _ in range(20):
            growth = 1.0 + self.k1 * (x * x + y * y)
            x, y = u / growth, v / growth
        return x, y


def _lit(mesh: trimesh.Trimesh, setup: _Setup, G: Array, L: Array) -> Light:
    """Cast the sheet's rays down, and from what they hit to the lens."""
    x, y = np.broadcast_arrays(G[None, :], L[:, None])
    z, facing = cast_down(mesh, x, y)
    u, v = setup.image(x, z)
    hidden = _covered(mesh, x, y, z, setup)
    strength = np.where(np.isfinite(z) & ~hidden, facing, 0.0)
    return Light(np.nan_to_num(u), np.nan_to_num(v), strength)


def _covered(mesh: trimesh.Trimesh, x: Array, y: Array, z: Array, setup: _Setup) -> Array:
    """Say whether the part stands between a point and the lens, by a march over its heights up to its top."""
    low, high = mesh.bounds
    columns, rows = (np.arange(low[k], high[k], _CAST_CELL) for k in (0, 1))
    heights, _ = cast_down(mesh, *np.meshgrid(columns, rows))
    heights = np.nan_to_num(heights, nan=low[2])
    hidden = np.zeros(x.shape, bool)
    towards = (-x, np.full(x.shape, setup.baseline), setup.stand_off - z)
    to_top = np.maximum(high[2] - z, 0.0) / towards[2]
    for part_of_way in np.linspace(0.0, 1.0, _MARCH)[1:]:
        px, py, pz = (start + part_of_way * to_top * way for start, way in zip((x, y, z), towards, strict=True))
        column = np.nan_to_num((px - low[0]) / _CAST_CELL).round().astype(int).clip(0, len(columns) - 1)
        row = np.nan_to_num((py - low[1]) / _CAST_CELL).round().astype(int).clip(0, len(rows) - 1)
        inside = (px <= high[0]) & (py <= high[1])
        hidden |= inside & (heights[row, column] > pz + 0.5 * _CAST_CELL)
    return hidden


def camera_frames(mesh: trimesh.Trimesh, sensor: Sensor, setup: _Setup, rng: np.random.Generator) -> Array:
    """Return uint8 frames (profiles, rows, columns) of the part moving through the sheet."""
    assert sensor.frame is not None  # the file says so
    rows, columns = sensor.frame
    axes, L = sensor.readout.axes, sensor.transport.transport(PROFILES)
    width = columns * (setup.stand_off**2 + setup.baseline**2) ** 0.5 / setup.focal_distance
    G = (np.arange(columns * _RAYS) + 0.5) / (columns * _RAYS) * width - 0.5 * width
    light = _lit(mesh, setup, G, L - L.mean())
    row = (light.u - axes.position_origin) / axes.position_pitch
    column = np.rint((light.v - axes.sample_origin) / axes.sample_pitch).astype(int)
    reach = np.arange(-6, 7)
    near = np.rint(row).astype(int)[..., None] + reach
    bell = np.exp(-0.5 * ((near - row[..., None]) / _LINE_SIGMA) ** 2) * light.strength[..., None] / _RAYS
    inside = (near >= 0) & (near < rows) & ((column >= 0) & (column < columns))[..., None]
    profile = np.arange(PROFILES)[:, None, None]
    place = (profile * rows + near) * columns + column[..., None]
    light_on = np.bincount(place[inside], bell[inside], minlength=PROFILES * rows * columns)
    electrons = rng.poisson(_LINE_PEAK * light_on + _BACKGROUND) + rng.normal(0.0, _READ_NOISE, light_on.size)
    codes = np.clip(np.rint(electrons * 255.0 / _FULL_WELL), 0, 255)
    return codes.astype(np.uint8).reshape(PROFILES, rows, columns)


def psd_currents(mesh: trimesh.Trimesh, sensor: Sensor, setup: _Setup, rng: np.random.Generator) -> Array:
    """Return uint16 codes (profiles, strips, 2) of the currents of every strip."""
    readout: Any = sensor.readout
    assert sensor.frame is not None  # the file says so
    strips, axes = sensor.frame[0], readout.axes
    L = sensor.transport.transport(PROFILES)
    scale = (setup.stand_off**2 + setup.baseline**2) ** 0.5 / setup.focal_distance
    width = strips * axes.sample_pitch * scale
    rays = strips * _RAYS_OF_STRIP
    light = _lit(mesh, setup, (np.arange(rays) + 0.5) / rays * width - 0.5 * width, L - L.mean())
    strip = np.rint((light.v - axes.sample_origin) / axes.sample_pitch).astype(int)
    inside = (strip >= 0) & (strip < strips) & (np.abs(light.u) < 0.5 * readout.strip_length)
    place = np.arange(PROFILES)[:, None] * strips + strip
    strength = _STRIP_CURRENT * light.strength[inside] / _RAYS_OF_STRIP
    size = PROFILES * strips
    total = np.bincount(place[inside], strength, minlength=size)
    moment = np.bincount(place[inside], strength * light.u[inside], minlength=size)
    share = moment / readout.strip_length
    currents = np.stack([0.5 * total - share, 0.5 * total + share], axis=-1)
    # Both ends share what one photon sets free: shot noise changes the total, the amplifiers each their own current.
    shot = np.sqrt(2.0 * _ELECTRON * _BANDWIDTH / np.maximum(total, _ELECTRON)) * rng.normal(0.0, 1.0, size)
    currents *= 1.0 + shot[:, None]
    currents += rng.normal(readout.dark, readout.noise.independent, currents.shape)
    codes: Array = np.clip(np.rint(currents / readout.ampere), 0, 65535)
    return codes.astype(np.uint16).reshape(PROFILES, strips, 2)


SENSORS: dict[str, Callable[..., Array]] = {"camera_line": camera_frames, "psd_line": psd_currents}


def record(name: str, mesh: trimesh.Trimesh, seed: int) -> Array:
    """Return the recording of a part by one of the `SENSORS`."""
    return SENSORS[name](mesh, Sensor.load(name), _Setup.of(name), np.random.default_rng(seed))
