"""A real recording: a sheet of light rotates over a room's corner with boxes, a cylinder and a sphere."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import pytest
import scipy.optimize

from conftest import DATA
from gpuvision import Status
from gpuvision.ranging.height_map import Grid
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import LineReading
from gpuvision.ranging.range_image import RangeImage, RangePoints
from gpuvision.ranging.regrid import Regrid
from gpuvision.ranging.sheet_motion import RotatingSheet

pytestmark = [pytest.mark.realdata, pytest.mark.slow]

# x right, y up from the floor, z from the back wall towards the camera, which is 0.1 m beside the sheet's axis.
GEOMETRY = RotatingSheet(
    focal_length_px=960 / np.tan(np.radians(24)),
    principal_point_px=(539.5, 959.5),
    axis_point=(0.1, 0.0, 0.0),
    axis_direction=(0.0, 1.0, 0.0),
    sheet_normal=(1.0, 0.0, 0.0),
    first_angle=np.radians(-17),
    angle_step=np.radians(30 / 127),
    scene_axes=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    scene_origin=(0.0, 0.7, 3.5),
)
LIMITS = ((-1.5, 1.5), (-0.2, 2.2), (-0.2, 3.4))
# Parts of the frame, as (first row, last row, first column, last column).
WALL = ((180, 500, 10, 270), (180, 480, 520, 1060), (500, 1250, 15, 200), (860, 1050, 950, 1060))
FLOOR = ((1610, 1910, 20, 1060),)
CEILING = ((5, 140, 520, 1060),)
BOXES = (((1125, 1560, 250, 712),), ((850, 1075, 500, 912),), ((1300, 1480, 742, 1030),), ((1340, 1530, 32, 220),))


class Scan(NamedTuple):
    reading: LineReading
    points: RangePoints

    def inside(self, parts: tuple[tuple[int, int, int, int], ...]) -> np.ndarray:
        """Return the valid points of parts of the frame, (n, 3)."""
        row = np.arange(self.points.z.shape[1])
        column = self.reading.position
        in_parts = np.zeros(self.points.z.shape, bool)
        for top, bottom, left, right in parts:
            in_parts |= (row >= top) & (row < bottom) & (column > left) & (column < right)
        in_parts &= np.isfinite(self.points.z) & (self.points.status == 0)
        return np.stack([each[in_parts] for each in self.points[:3]], axis=-1)


@pytest.fixture(scope="module")
def scan() -> Scan:
    path = DATA / "laser" / "corner_scene_sweep.mp4"
    if not path.exists():
        pytest.skip("the recordings in ../shared/data are not here")
    video, frames = cv2.VideoCapture(str(path)), []
    while (frame := video.read()[1]) is not None:
        # Red is saturated along the whole line.
        frames.append(np.ascontiguousarray(frame[..., 1]))
    readout = LineReadout(
        method="ml",
        along="rows",
        window=6,
        threshold=120,
        minimum_peak=150,
        minimum_width=3,
        maximum_width=14,
        ambiguity=0.5,
        outputs=("position", "status"),
    )
    reading = readout(np.stack(frames))
    transport = GEOMETRY.transport(len(frames)).astype(np.float32)
    return Scan(reading, RangeImage(geometry=GEOMETRY, limits=LIMITS)(reading.position, transport, reading.status))


def plane(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the normal of the plane through points, and their root-mean-square distance from it."""
    centred = points.astype(np.float64) - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    return axes[2], float(spread[2] / np.sqrt(len(points)))


def degrees_between(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(abs(first @ second), 0, 1))))


def test_most_rows_have_a_point_and_the_others_a_reason(scan):
    good = np.isfinite(scan.points.z)
    assert 0.88 < good.mean() < 0.95
    assert np.all(scan.points.status[~good] != 0)
    # Behind the left edge of the cylinder and of the boxes the light is hidden, and the sweep begins and ends outside.
    assert 0.03 < np.mean((scan.points.status & Status.LOW_SIGNAL) != 0) < 0.12


def test_floor_ceiling_and_wall_are_planes_at_right_angles(scan):
    floor, ceiling, wall = (scan.inside(each) for each in (FLOOR, CEILING, WALL))
    # A tenth of a pixel in the readout is 0.5 mm of height at the floor's far end, 1 mm at the ceiling's, and 6 mm of
    # depth at the wall.
    assert abs(np.median(floor[:, 1])) < 0.5e-3
    assert abs(np.median(ceiling[:, 1]) - 2.0) < 1e-3
    assert abs(np.median(wall[:, 2])) < 3e-3
    normals, spreads = zip(*(plane(each) for each in (floor, ceiling, wall)), strict=True)
    assert np.all(np.array(spreads) < (0.5e-3, 1e-3, 6e-3))
    assert degrees_between(normals[0], normals[1]) < 0.1
    assert abs(90 - degrees_between(normals[0], normals[2])) < 0.1
    assert abs(90 - degrees_between(normals[1], normals[2])) < 0.1


@pytest.mark.parametrize(("box", "height"), list(zip(BOXES, (1.104, 0.864, 0.785, 0.980), strict=True)))
def test_boxes_stand_parallel_to_the_wall(scan, box, height):
    points = scan.inside(box)
    normal, spread = plane(points)
    assert len(points) > 3000
    assert abs(np.median(points[:, 2]) - height) < 3e-3
    assert spread < 5e-3
    assert degrees_between(normal, plane(scan.inside(WALL))[0]) < 1.0


def test_the_sphere_is_one(scan):
    row, column = np.arange(1920), scan.reading.position
    on_sphere = (np.hypot(column - 712, row - 682) < 140) & np.isfinite(scan.points.z) & (row < 800)
    points = np.stack([each[on_sphere] for each in scan.points[:3]], axis=-1).astype(np.float64)

    def misfit(sphere: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - sphere[:3], axis=1) - sphere[3]

    fit = scipy.optimize.least_squares(misfit, [0.23, 1.07, 0.6, 0.2], loss="soft_l1", f_scale=0.003)
    assert len(points) > 5000
    # Its outline in the frame, 165 pixels, says 0.224 m: depth and width agree, although the fit did not require it.
    assert abs(fit.x[3] - 0.222) < 0.005
    assert np.sqrt(np.mean(misfit(fit.x) ** 2)) < 4e-3


def test_the_cylinder_is_one(scan):
    points = scan.inside(((180, 900, 300, 480),)).astype(np.float64)

    def misfit(cylinder: np.ndarray) -> np.ndarray:
        return np.hypot(points[:, 0] - cylinder[0], points[:, 2] - cylinder[1]) - cylinder[2]

    fit = scipy.optimize.least_squares(misfit, [-0.2, 0.5, 0.15], loss="soft_l1", f_scale=0.003)
    # Its outline: 100 pixels on either side.
    assert abs(fit.x[2] - 0.137) < 0.003
    assert np.median(np.abs(misfit(fit.x))) < 3e-3


def test_the_height_map_shows_them(scan):
    grid = Grid(left=-0.85, top=1.99, cell_x=0.005, cell_y=0.005, columns=340, rows=398)
    regrid = Regrid(grid=grid, max_gap=0.03, max_step=0.05, along="-y", fold_tolerance=0.006, folded="top")
    made = regrid(*scan.points[:3], np.zeros_like(scan.points.z), scan.points.status)
    assert 0.7 < np.isfinite(made.z).mean() < 0.9
    for x, y, height in (
        (0.6, 1.5, 0.0),
        (-0.1, 0.3, 1.104),
        (0.2, 0.6, 0.864),
        (-0.2, 1.2, 0.696),
        (0.23, 1.07, 0.812),
    ):
        column, row = round((x - grid.left) / grid.cell_x), round((grid.top - y) / grid.cell_y)
        assert abs(np.nanmedian(made.z[row - 2 : row + 3, column - 2 : column + 3]) - height) < 0.01
    # The shadow of the sphere has no points.
    column, row = round((0.23 - grid.left) / grid.cell_x), round((grid.top - 1.35) / grid.cell_y)
    assert np.all(made.status[row - 3 : row + 4, column - 3 : column + 4] == Status.NO_DATA)
