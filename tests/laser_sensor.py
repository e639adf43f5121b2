"""Synthetic laser sensor with known geometry: tilted camera, bent sheet, target poses, and the light on targets.

Points are projected with OpenCV. The light on a target is found by sampling the curve in which the sheet cuts the plane
of the target, not by intersecting viewing rays as the calibration does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.planar_calibration import fit_camera
from gpuvision.camera.views.pose_response import pose_responses
from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_calibration import fit_sheet
from gpuvision.ranging.sheet_readings import LaserLine
from gpuvision.ranging.transport_calibration import fit_transport
from target_images import chessboard, dots

Float64 = npt.NDArray[np.float64]
SIZE = (480, 360)
GRID = (11, 8)  # columns and rows of the target's points
CORNERS = (9, 6)  # columns and rows of a chessboard's inner corners: its border lies on the outer points
PITCH = 0.01
STEP = 0.2e-3
PROFILES_BETWEEN = 40


@dataclass(frozen=True, eq=False)
class LaserSensor:
    """Camera (OpenCV's matrix and coefficients), sheet d = bend(G, H) about (origin, g, h), and step per profile."""

    matrix: Float64
    distortion: Float64
    origin: Float64
    g: Float64
    h: Float64
    bend: tuple[float, float, float]
    step: Float64

    @property
    def normal(self) -> Float64:
        return np.cross(self.g, self.h)

    def project(self, points: Float64) -> Float64:
        """Project points (n, 3) of the camera's frame."""
        none = np.zeros(3)
        return cv2.projectPoints(points.reshape(-1, 1, 3), none, none, self.matrix, self.distortion)[0].reshape(-1, 2)

    def surface(self, flat: Float64) -> Float64:
        """Return the points (n, 3) of the sheet at (G, H), (n, 2)."""
        g, h = flat.T
        d = self.bend[0] * g * g + self.bend[1] * g * h + self.bend[2] * h * h
        return self.origin + np.outer(g, self.g) + np.outer(h, self.h) + np.outer(d, self.normal)

    def line(self, normal: Float64, place: Float64) -> Float64:
        """Return rows of the light on the plane through `place` for all columns, NaN outside: (columns,)."""
        g = np.linspace(-0.12, 0.12, 241)
        h = np.zeros_like(g)
        for _ in range(20):  # Newton for H on the plane; the bend is small
            points = self.surface(np.stack([g, h], axis=1))
            slope = (self.h + np.outer(self.bend[1] * g + 2.0 * self.bend[2] * h, self.normal)) @ normal
            h = h - ((points - place) @ normal) / slope
        column, row = self.project(self.surface(np.stack([g, h], axis=1))).T
        order = np.argsort(column)
        rows = CubicSpline(column[order], row[order], extrapolate=False)(np.arange(float(SIZE[0])))
        return np.where((rows >= 0.0) & (rows <= SIZE[1] - 1.0), rows, np.nan)


def sensor(tilt_degrees: float, bend: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> LaserSensor:
    """Return a sensor 0.25 m from its sheet, 35 degrees off it, with a sensor tilted by an angle about the columns."""
    alpha, beta = math.radians(tilt_degrees), math.radians(35.0)
    f = 750.0
    # The virtual principal point stays near the middle of the image, which moves the axis by f tan(alpha).
    centre = (0.5 * SIZE[0] + 6.0, 0.5 * SIZE[1] + 0.3 * f * math.tan(alpha) - 4.0)
    distortion = np.zeros(14)
    distortion[[0, 1, 12, 13]] = -0.15, 0.08, 0.95 * alpha, 0.1 * alpha
    matrix = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
    middle = cv2.undistortPoints(np.array([[SIZE]]) * 0.5, matrix, distortion)[0, 0]
    ray = np.array([*middle, 1.0])
    turn = Rotation.from_euler("zyx", [2.0, -3.0, 0.0], degrees=True).as_matrix()
    g, h = turn @ np.array([1.0, 0.0, 0.0]), turn @ np.array([0.0, math.sin(beta), -math.cos(beta)])
    normal = np.cross(g, h)
    step = STEP * Rotation.from_rotvec([0.03, 0.0, 0.02]).as_matrix() @ -normal
    return LaserSensor(matrix, distortion, 0.25 * ray, g, h, bend, step)


def target() -> Float64:
    """Return the points (n, 3) of the target, its rows one after the other."""
    row, column = np.indices(GRID[::-1]).reshape(2, -1) * PITCH
    return np.stack([column, row, np.zeros_like(row)], axis=1)


def pose(
    truth: LaserSensor, tilts: tuple[float, float, float], height: float, shift: float = 0.0
) -> tuple[Float64, Float64]:
    """Return rotation and translation of a target about the image's axes, its middle at H = height of the sheet."""
    rotation = Rotation.from_euler("xyz", tilts, degrees=True).as_matrix()
    middle = truth.origin + height * truth.h + shift * truth.g
    return rotation, middle - rotation @ target().mean(axis=0)


def up(truth: LaserSensor) -> Float64:
    """Return the normal of the stage: perpendicular to the transport, as near to h as possible."""
    along = truth.step / np.linalg.norm(truth.step)
    normal = truth.h - (truth.h @ along) * along
    return normal / np.linalg.norm(normal)


def on_stage(truth: LaserSensor, profile: float) -> tuple[Float64, Float64]:
    """Return the pose of a target that lies on the stage at height 0, at a number of profiles from the sheet."""
    z = -up(truth)
    x = truth.g - (truth.g @ z) * z
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return rotation, truth.origin + profile * truth.step - rotation @ target().mean(axis=0)


def poses(truth: LaserSensor, rng: np.random.Generator, count: int = 12) -> list[tuple[Float64, Float64]]:
    """Return random poses of the target in view of the camera, at heights over the measuring range."""
    found: list[tuple[Float64, Float64]] = []
    while len(found) < count:
        tilts = (*rng.uniform(-32.0, 32.0, 2), rng.uniform(-8.0, 8.0))
        rotation, translation = pose(truth, tilts, rng.uniform(-0.03, 0.03), rng.uniform(-0.01, 0.01))
        seen = truth.project(target() @ rotation.T + translation)
        if (seen > 8.0).all() and (seen < np.array(SIZE) - 9.0).all():
            found.append((rotation, translation))
    return found


def readings(truth: LaserSensor, rotation: Float64, translation: Float64) -> Float64:
    """Return the exact (column, row) of the light within the target, one per column."""
    rows = truth.line(rotation[:, 2], translation)
    hull = cv2.convexHull(truth.project(target() @ rotation.T + translation).astype(np.float32))
    columns = np.arange(float(SIZE[0]))
    inside = [
        np.isfinite(row) and cv2.pointPolygonTest(hull, (float(column), float(row)), False) > 0
        for column, row in zip(columns, rows, strict=True)
    ]
    return np.stack([columns, rows], axis=1)[inside]


@cache
def rays(truth: LaserSensor) -> Float64:
    """Return the directions (rows, columns, 3) of all pixels, z = 1."""
    pixels = np.stack(np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1]))), axis=-1)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
    ideal = cv2.undistortPoints(flat, truth.matrix, truth.distortion, None, np.eye(3), np.eye(3), criteria)
    return np.concatenate([ideal.reshape(-1, 2), np.ones((len(flat), 1))], axis=1).reshape(SIZE[1], SIZE[0], 3)


@dataclass(frozen=True)
class TargetView:
    """View of the target: pixels to coordinates on the target [pitches], as `target_images` renders it."""

    truth: LaserSensor
    rotation: Float64
    translation: Float64

    width = SIZE[0]
    height = SIZE[1]

    @cached_property
    def scene(self) -> Float64:
        """Points (rows, columns, 3) of the target's plane that the pixels see, in the camera's frame."""
        ray, normal = rays(self.truth), self.rotation[:, 2]
        return ray * ((normal @ self.translation) / (ray @ normal))[..., None]

    def pattern(self, pixels: Float64) -> Float64:
        assert pixels.shape[:2] == (self.height, self.width), "the renderer asks for all pixels at once"
        return ((self.scene - self.translation) @ self.rotation)[..., :2] / PITCH

    def light(self, thickness: float = 0.2e-3) -> Float64:
        """Return the light on every pixel, 1 in the middle of the sheet: a Gaussian over the distance from it."""
        offset = self.scene - self.truth.origin
        g, h, d = np.moveaxis(offset @ np.stack([self.truth.g, self.truth.h, self.truth.normal]).T, -1, 0)
        gg, gh, hh = self.truth.bend
        return np.exp(-0.5 * ((d - gg * g * g - gh * g * h - hh * h * h) / thickness) ** 2)


@dataclass(frozen=True)
class Chessboard:
    """View of a chessboard whose inner corners are the target's points without the outer ones."""

    view: TargetView

    width = SIZE[0]
    height = SIZE[1]

    def pattern(self, pixels: Float64) -> Float64:
        return self.view.pattern(pixels) - 1.0


def photographs(
    view: TargetView, rng: np.random.Generator, pattern: str = "dots"
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return images of a target of dots, or of a chessboard of the same size, without and with the laser."""
    cover = dots(view, np.ones(GRID[::-1], bool)) if pattern == "dots" else chessboard(Chessboard(view), CORNERS)
    level = 30.0 + 130.0 * (1.0 - cover)
    lit = level + 90.0 * view.light() * (1.0 - 0.7 * cover)
    dark, bright = (
        np.clip(np.rint(cv2.GaussianBlur(each, (0, 0), 0.8) + rng.normal(0.0, 1.5, each.shape)), 0, 255)
        for each in (level, lit)
    )
    return dark.astype(np.uint8), bright.astype(np.uint8)


def write_images(
    folder: Path, truth: LaserSensor, rng: np.random.Generator, views: int, moved: int, pattern: str = "dots"
) -> None:
    """Write images of a calibration: pairs without and with laser, and a folder ``moved`` of transport views."""
    (folder / "moved").mkdir()
    for number, (rotation, translation) in enumerate(poses(truth, rng, views)):
        dark, lit = photographs(TargetView(truth, rotation, translation), rng, pattern)
        cv2.imwrite(str(folder / f"pose{number}.png"), dark)
        cv2.imwrite(str(folder / f"pose{number}_laser.png"), lit)
    for number in range(moved):
        pose = on_stage(truth, (number - 1) * PROFILES_BETWEEN)
        cv2.imwrite(str(folder / "moved" / f"{number}.png"), photographs(TargetView(truth, *pose), rng, pattern)[0])


def calibrated(
    truth: LaserSensor, rng: np.random.Generator, *, count: int = 10, sigma: float = 0.05, line_sigma: float = 0.1
) -> SensorGeometry:
    """Calibrate from simulated points with normal noise [px]: `count` poses with laser lines, five transport views."""
    still = poses(truth, rng, count)
    first = pose(truth, (5.0, -4.0, 1.0), 0.0)
    moved = [(first[0], first[1] + k * PROFILES_BETWEEN * truth.step) for k in range(-2, 3)]
    views = [
        (target(), truth.project(target() @ r.T + t) + rng.normal(0.0, sigma, (len(target()), 2)))
        for r, t in (*still, *moved)
    ]
    fit = fit_camera(views, SIZE, model="tilt")
    targets = pose_responses(fit, views)
    lines = [
        LaserLine(points + rng.normal(0.0, 1.0, points.shape) * [0.0, line_sigma], each)
        for points, each in zip((readings(truth, r, t) for r, t in still), targets[:count], strict=True)
    ]
    sheet = fit_sheet(fit.camera, lines, names=fit.names, camera_covariance=fit.covariance)
    transport = fit_transport(targets[count:], np.arange(5) * PROFILES_BETWEEN, target().mean(axis=0))
    return SensorGeometry(
        camera=fit.camera,
        camera_names=fit.names,
        camera_covariance=fit.covariance,
        sheet=sheet,
        transport=transport,
        step=transport.length,
    )


COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")


def scene_axes(truth: LaserSensor) -> Float64:
    """Return the axes (rows x, y, z) of the scene in the camera's frame: y against the movement of the part, z up."""
    z, y = up(truth), -truth.step / np.linalg.norm(truth.step)
    return np.stack([np.cross(y, z), y, z])


def sensor_table(
    truth: LaserSensor, window: tuple[int, int], frame: tuple[int, int], *, turned: bool = False
) -> dict[str, Any]:
    """Return a sensor file with a light for a simulation: a window of the image at (column, row), (columns, rows).

    The camera is in the file ``camera.toml`` beside it, see `camera_table`. The scene's origin is that of the sheet.
    A turned sensor looks from the other side of the sheet, at y > 0.
    """
    to_scene = scene_axes(truth) * (np.array([[-1.0], [-1.0], [1.0]]) if turned else 1.0)
    flat = not any(truth.bend)
    return {
        "kind": "camera",
        "name": "laser sensor",
        "frame": {"columns": frame[0], "rows": frame[1]},
        # A threshold that cuts the flanks of the line moves the centroid by more than this camera's noise.
        "line": {"method": "windowed", "window": 5, "threshold": 1.0, "minimum_peak": 20.0},
        "camera": {"file": "camera.toml", "window": list(window)},
        "triangulation": {
            "sheet_origin": truth.origin.tolist(),
            "g_axis": truth.g.tolist(),
            "h_axis": truth.h.tolist(),
            **({} if flat else {"bend": list(truth.bend)}),
        },
        "transport": {
            "kind": "straight",
            "step": STEP,
            "g_axis": (to_scene @ truth.g).tolist(),
            "h_axis": (to_scene @ truth.h).tolist(),
            "direction": [0.0, 1.0, 0.0],
        },
        "output": {"cell": 0.3e-3, "max_gap": 1.2e-3, "max_step": 3e-3},
        "light": {
            "power": 1.0,
            "thickness": 0.2e-3,
            "sub_sheets": 9,
            "aperture": 2e-3,
            "blur": 0.9,
            "exposure": 2.5e-6,
            "full_well": 10_000.0,
            "read_noise": 20.0,
        },
    }


def camera_table(truth: LaserSensor) -> dict[str, Any]:
    """Return a camera file with all 14 coefficients."""
    terms = {name: float(each) for name, each in zip(COEFFICIENTS, truth.distortion, strict=True)}
    return {"image": {"size": list(SIZE)}, "camera": {"matrix": truth.matrix.tolist()} | terms}
