"""Secondary light near a laser line in the corner of a room: recorded, and predicted by the simulator.

The recording is corner_scene_sweep.mp4, with the geometry of the sensor file "corner_scene": a camera at rest sees the
wall (z = 0) and the ceiling, 2 m above the floor. The line on the ceiling illuminates the wall, and the line on the
wall illuminates the ceiling. The two surfaces are perpendicular, and the lines meet in the corner.

Unknown quantities and their treatment:

- Power and exposure: one fitted factor for each surface.
- Other light, of the room and of its other parts: one fitted constant for each surface.
- Albedo: 0.5. It only affects light that is reflected more than once.
- Position of the light source on its axis: the height of the camera. It determines the power along the lines.
- Tone curve: sRGB.

The red channel is saturated on the line and a few pixels beside it; these pixels are excluded.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from gpuvision.ranging.sheet_motion import RotatingSheet
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments

Float64 = NDArray[np.float64]

CEILING = 2.0  # m over the floor
ALBEDO = 0.5
LIMIT = 250.0  # grey level from which on red counts as saturated
BESIDE = 0.02  # smallest distance from the line, beyond its direct light [m]
WALL_DOWN, CEILING_OUT = 0.3, 0.3  # largest distance from the corner on wall and ceiling [m]
_PIECES = 40
_SHORTEST = 5e-3  # m, of a line's pieces, next to the corner


class Surface(NamedTuple):
    """Pixels of a frame that see one surface, and their predicted irradiance."""

    rows: slice
    places: Float64  # (rows, columns, 3)
    beside: Float64  # (rows, columns): signed distance from the plane of light, > 0 on its right [m]
    away: Float64  # (rows, columns): distance from the corner [m]
    once: Float64  # (rows, columns): irradiance by the other surface's line, for a power of 1 W/m at its foot
    more: Float64  # irradiance by all further reflections between the surfaces


@dataclass(frozen=True)
class Fit:
    """measured = factor (once + more) + constant, least squares of relative deviations."""

    factor: float
    constant: float
    deviation: float  # relative RMS deviation
    correlation: float


class Room:
    """The corner of wall and ceiling, and the camera and light of a sensor."""

    def __init__(self, geometry: RotatingSheet) -> None:
        self.geometry = geometry
        self.axes = np.array(geometry.scene_axes)
        self.eye = -self.axes @ np.array(geometry.scene_origin)
        self.pivot = self.eye + self.axes @ np.array(geometry.axis_point)
        self.height = self.eye[1]

    def angle(self, frame: int) -> float:
        return float(self.geometry.transport(1, frame)[0])

    def normal(self, frame: int) -> Float64:
        """Return the normal of the plane of light, in the scene."""
        turn, _ = cv2.Rodrigues(np.array(self.geometry.axis_direction) * self.angle(frame))
        return np.asarray(self.axes @ turn @ np.array(self.geometry.sheet_normal))

    def foot(self, frame: int) -> Float64:
        """Return the point in which the plane of light meets the corner."""
        normal = self.normal(frame)
        return np.array([self.pivot[0] + self.pivot[2] * normal[2] / normal[0], CEILING, 0.0])

    def pixels(self, rows: NDArray[np.int64], columns: NDArray[np.int64], axis: int, level: float) -> Float64:
        """Return the points that pixels image on a plane with one constant coordinate."""
        (middle, centre), focal = self.geometry.principal_point_px, self.geometry.focal_length_px
        column, row = np.meshgrid(columns, rows)
        rays = (
            np.stack([(column - middle) / focal, (row - centre) / focal, np.ones(column.shape)], axis=-1) @ self.axes.T
        )
        return np.asarray(self.eye + ((level - self.eye[axis]) / rays[..., axis])[..., None] * rays)

    def corner_row(self) -> float:
        """The row of the frame in which wall and ceiling meet."""
        return float(
            self.geometry.principal_point_px[1] - self.geometry.focal_length_px * (CEILING - self.height) / self.eye[2]
        )

    def lines(self, frame: int, down: float = 0.7) -> tuple[LitSegments, LitSegments]:
        """Return the lit lines on the wall, `down` m long, and the ceiling; 1 W/m mid-way on the wall."""
        foot, source = self.foot(frame), self.pivot * (1.0, 0.0, 1.0) + (0.0, self.height, 0.0)
        out = (source - foot) * (1.0, 0.0, 1.0)
        wall = self._line(foot, foot - [0.0, down, 0.0], np.array([0.0, 0.0, 1.0]), source)
        return wall, self._line(foot, foot + 0.9 * out, np.array([0.0, -1.0, 0.0]), source)

    @staticmethod
    def _line(start: Float64, end: Float64, normal: Float64, source: Float64) -> LitSegments:
        steps = np.append(0.0, np.geomspace(_SHORTEST, 1.0, _PIECES))[:, None]
        places = start + steps * (end - start)
        middle = 0.5 * (places[1:] + places[:-1]) - source
        along = (end - start) / np.linalg.norm(end - start)
        # The fan of light has constant power per angle.
        power = np.linalg.norm(np.cross(along, middle), axis=1) / np.sum(middle**2, axis=1)
        return LitSegments(np.stack([places[:-1], places[1:]], axis=1), np.tile(normal, (_PIECES, 1)), power)

    def predict(self, frame: int) -> dict[str, Surface]:
        """Return the predicted wall and ceiling near the corner in a frame."""
        wall, ceiling = self.lines(frame)
        corner = self.corner_row()
        columns = np.arange(1080)
        others = self._bounces(frame, wall, ceiling)
        made = {}
        for name, light, rows, axis, level, normal in (
            ("wall", ceiling, (math.ceil(corner) + 6, 420), 2, 0.0, (0.0, 0.0, 1.0)),
            ("ceiling", wall, (0, math.floor(corner) - 4), 1, CEILING, (0.0, -1.0, 0.0)),
        ):
            places = self.pixels(np.arange(*rows), columns, axis, level)
            receivers = np.concatenate([places, np.broadcast_to(normal, places.shape)], axis=-1)
            once = LineIrradiance(segments=light)(receivers).irradiance
            away = CEILING - places[..., 1] if name == "wall" else places[..., 2]
            more = others[name](np.stack([places[..., 0], away], axis=-1))
            distance = (places - self.foot(frame)) @ self.normal(frame)
            made[name] = Surface(slice(*rows), places, distance, away, once, more)
        return made

    def _bounces(self, frame: int, wall: LitSegments, ceiling: LitSegments) -> dict[str, Callable[[Float64], Float64]]:
        """Return the irradiance by the second and all further reflections, as a function of (x, corner distance).

        Solved by a midpoint rule with smaller cells near the intersection of the lines. Where cells are too close for
        the rule, the form factors are scaled to the limit of a perpendicular plane, 1/2.
        """
        x = self.foot(frame)[0] + 1.5 * np.sinh(np.linspace(-6.0, 6.0, 49)) / math.sinh(6.0)
        away = np.append(0.0, np.geomspace(3e-3, CEILING, 36))
        middles = [0.5 * (each[1:] + each[:-1]) for each in (x, away)]
        across, off = (each.ravel() for each in np.meshgrid(*middles, indexing="ij"))
        area = np.outer(np.diff(x), np.diff(away)).ravel()
        on_wall = np.stack([across, CEILING - off, 0.0 * off, *np.outer((0.0, 0.0, 1.0), np.ones(len(off)))], axis=-1)
        on_ceiling = np.stack(
            [across, 0.0 * off + CEILING, off, *np.outer((0.0, -1.0, 0.0), np.ones(len(off)))], axis=-1
        )
        first = (
            LineIrradiance(segments=ceiling)(on_wall).irradiance,
            LineIrradiance(segments=wall)(on_ceiling).irradiance,
        )
        square = (across[:, None] - across) ** 2 + off[:, None] ** 2 + off**2
        factors = off[:, None] * off * area / (math.pi * square**2)
        factors *= np.minimum(0.5 / factors.sum(axis=1, keepdims=True), 1.0)
        got = list(first)
        for _ in range(12):
            got = [first[0] + ALBEDO * factors @ got[1], first[1] + ALBEDO * factors @ got[0]]
        shape = (len(middles[0]), len(middles[1]))
        return {
            name: RegularGridInterpolator(
                middles, (all_of_it - once).reshape(shape), bounds_error=False, fill_value=None
            )
            for name, all_of_it, once in zip(("wall", "ceiling"), got, first, strict=True)
        }


def linear(codes: Float64) -> Float64:
    """Return the linear intensity of sRGB codes, 0 to 1."""
    value = np.asarray(codes, np.float64) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def red_frames(path: Path, wanted: tuple[int, ...]) -> dict[int, Float64]:
    """Return the red channel of some frames."""
    video, frames, number = cv2.VideoCapture(str(path)), {}, 0
    while (frame := video.read()[1]) is not None:
        if number in wanted:
            frames[number] = frame[..., 2].astype(np.float64)
        number += 1
    return frames


def room() -> Room:
    geometry = Sensor.load("corner_scene").transport
    assert isinstance(geometry, RotatingSheet)
    return Room(geometry)


def kept(surface: Surface, red: Float64, reach: tuple[float, float]) -> NDArray[np.bool_]:
    """Return a mask of the valid pixels: near the corner, beside the line, not saturated, and not occluded."""
    near_corner = surface.away < (WALL_DOWN if surface.rows.start else CEILING_OUT)
    off_line = (np.abs(surface.beside) > BESIDE) & (surface.beside > reach[0]) & (surface.beside < reach[1])
    return np.asarray(near_corner & off_line & (red[surface.rows] < LIMIT))


def fit(predicted: Float64, measured: Float64) -> Fit:
    table = np.column_stack([predicted, np.ones(len(predicted))]) / measured[:, None]
    (factor, constant), *_ = np.linalg.lstsq(table, np.ones(len(measured)), rcond=None)
    model = factor * predicted + constant
    deviation = float(np.sqrt(np.mean((model / measured - 1.0) ** 2)))
    return Fit(float(factor), float(constant), deviation, float(np.corrcoef(model, measured)[0, 1]))


def brightest_away(surface: Surface, light: Float64, beside: float, within: float = 0.01) -> float:
    """Return the distance from the corner of the brightest point, at a distance beside the line (< 0: left of it)."""
    in_stripe = np.abs(surface.beside - beside) < within
    bins = np.linspace(0.0, 0.4, 81)
    index = np.digitize(surface.away[in_stripe], bins)
    mean = np.array([light[in_stripe][index == n].mean() if (index == n).any() else 0.0 for n in range(1, len(bins))])
    smooth = np.convolve(mean, np.ones(5) / 5.0, mode="same")
    return float(0.5 * (bins[1:] + bins[:-1])[np.argmax(smooth)])


def fall_off(surface: Surface, light: Float64, away: float, reach: tuple[float, float] = (0.05, 0.15)) -> float:
    """Return the exponent of the fall-off of light with the distance from the line, in a stripe along the corner."""
    stripe = (np.abs(surface.away - away) < 0.2 * away) & (np.abs(surface.beside) > reach[0])
    stripe &= (np.abs(surface.beside) < reach[1]) & (light > 0.0)
    return float(np.polyfit(np.log(np.abs(surface.beside[stripe])), np.log(light[stripe]), 1)[0])


def draw(recording: Path, picture: Path, frame: int = 90, reach: tuple[float, float] = (-0.15, 0.35)) -> None:
    """Write a picture: the measured and the predicted secondary light of a frame, and profiles across the line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    red = red_frames(recording, (frame,))[frame]
    surfaces = room().predict(frame)
    measured, predicted = np.full((2, 420, 1080), np.nan)
    fits = {}
    for name, surface in surfaces.items():
        some = kept(surface, red, reach)
        light = linear(red[surface.rows])
        fits[name] = fit((surface.once + surface.more)[some], light[some])
        model = fits[name].factor * (surface.once + surface.more) + fits[name].constant
        for held, values in ((measured, light), (predicted, model)):
            held[surface.rows] = np.where(some, values, np.nan)
    figure, panels = plt.subplots(1, 3, figsize=(12.0, 4.2), width_ratios=(1.0, 1.0, 1.25), layout="constrained")
    columns = np.flatnonzero(np.isfinite(measured).any(axis=0))
    levels = np.geomspace(0.04, 0.64, 5)
    for panel, held, title in zip(panels[:2], (measured, predicted), ("measured", "predicted"), strict=True):
        panel.imshow(held, cmap="inferno", norm=matplotlib.colors.LogNorm(0.03, 0.9), interpolation="nearest")
        panel.contour(np.nan_to_num(held, nan=0.0), levels=levels, colors="white", linewidths=0.5)
        panel.set(title=title, xlim=(columns[0], columns[-1]), ylim=(345, 80), xlabel="column", ylabel="row")
    wall = surfaces["wall"]
    light = linear(red[wall.rows])
    bins = np.linspace(*reach, 101)
    middles = 0.5 * (bins[1:] + bins[:-1])
    for number, away in enumerate((0.03, 0.08, 0.2)):
        stripe = kept(wall, red, reach) & (np.abs(wall.away - away) < 0.1 * away)
        index = np.digitize(wall.beside[stripe], bins) - 1
        count = np.maximum(np.bincount(index, minlength=100), 1)
        held = fits["wall"].factor * (wall.once + wall.more) + fits["wall"].constant
        for values, style in ((light, "."), (held, "-")):
            mean = np.bincount(index, values[stripe], minlength=100) / count
            label = f"{1e3 * away:.0f} mm below the ceiling" if style == "-" else None
            panels[2].plot(1e3 * middles, np.where(mean > 0.0, mean, np.nan), style, color=f"C{number}", label=label)
    panels[2].set(xlabel="beside the line [mm]", ylabel="red light on the wall (1: at its limit)", yscale="log")
    panels[2].set_title("points: measured; lines: predicted")
    panels[2].legend()
    figure.savefig(picture, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
