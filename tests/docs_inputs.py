"""Files and variables that the code blocks of the documentation use without creating them."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

import board_images
import gpuvision as gv
import laser_sensor
import paste_maps
import target_images
from boards import LAYERS, board_folder
from floors import floor_image
from gpuvision.formats.range_image import write_tiff
from gpuvision.inspection.apertures import BoardPlacement
from scanning import line_frames


def _dots(tilt: float, towards: float) -> np.ndarray[Any, Any]:
    """Image of 18 x 14 dots through a lens."""
    camera = target_images.view((640, 480), 14, 18, 30.0, tilt=tilt, towards=towards, barrel=4.0)
    covered = target_images.dots(camera, np.ones((14, 18), np.bool_))
    return np.rint(220.0 - 180.0 * covered).astype(np.uint8)


def _recording(folder: Path) -> dict[str, Any]:
    rows = 40.0 + 3.0 * np.sin(np.arange(480) / 60.0)
    np.save(folder / "recording.npy", line_frames(np.tile(rows, (32, 1))))
    return {}


def _recording_with_noise(folder: Path) -> dict[str, Any]:
    """Also write a sensor file that gives the noise."""
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text(encoding="utf-8")
    (folder / "sensor.toml").write_text(text.replace("[line]", "[line]\nread_noise = 0.5\ngain = 0.1"))
    return _recording(folder)


def _one_image(folder: Path) -> dict[str, Any]:
    cv2.imwrite(str(folder / "dots.png"), _dots(10.0, 0.3))
    return {}


def _images(folder: Path) -> dict[str, Any]:
    return {"images": [_dots(25.0, towards) for towards in (0.2, 1.7, 3.3, 4.9)]}


def _laser_images(folder: Path) -> dict[str, Any]:
    shots = folder / "shots"
    shots.mkdir()
    laser_sensor.write_images(shots, laser_sensor.sensor(20.0), np.random.default_rng(6), 4, 2)
    (shots / "moved").rename(folder / "moved")
    return {}


def _part(folder: Path) -> dict[str, Any]:
    trimesh.creation.box((20.0, 10.0, 4.0)).export(folder / "part.stl")
    return {}


def _board(folder: Path) -> dict[str, Any]:
    gerbers = folder / "gerbers"
    gerbers.mkdir()
    artwork = gv.read_artwork(board_folder(gerbers), layers=LAYERS)
    corner = (10e-3 - 199.5 * 40e-6, 8e-3 + 149.5 * 40e-6)
    view = board_images.View(corner=corner, pixel=40e-6, shape=(300, 400), noise=2.0)
    image = board_images.BoardPicture(artwork, view).seen((20e-6, -30e-6, 1e-3), np.random.default_rng(1))
    cv2.imwrite(str(folder / "board.png"), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return {}


def _gerbers(folder: Path) -> dict[str, Any]:
    (folder / "gerbers").mkdir()
    board_folder(folder / "gerbers")
    return {}


def _floor(folder: Path) -> dict[str, Any]:
    field = gv.read_field("robocup_msl")
    shape, rng = (400, 440), np.random.default_rng(1)
    image = floor_image(field, (2.0, -1.5, 0.4), scale=0.03, shape=shape, line_width=0.125, rng=rng)
    cv2.imwrite(str(folder / "top_view.png"), image)
    return {}


def _paste(folder: Path) -> dict[str, Any]:
    gerbers = folder / "gerbers"
    gerbers.mkdir()
    places = [(1.0, 1.0), (2.0, 1.1), (1.4, 1.8), (2.3, 2.1)]
    flashes = "".join(f"X{round(x * 1e6)}Y{round(y * 1e6)}D03*\n" for x, y in places)
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n%ADD10C,0.4*%\nD10*\n"
    (gerbers / "paste.gbr").write_text(f"{head}{flashes}M02*\n")
    grid = paste_maps.board_grid(160, 150, cell=20e-6)
    here = BoardPlacement(x=-30e-6, y=20e-6, theta=0.01)
    caps = [(paste_maps.Cap(200e-6, 130e-6), (1e-3 * x, 1e-3 * y)) for x, y in places]
    z = paste_maps.paste_map(grid, here, caps) + np.random.default_rng(1).normal(0.0, 1e-6, grid.shape)
    write_tiff(folder / "heights.tiff", z, grid)
    return {}


INPUTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "docs/guides/plan_scan.md": _recording_with_noise,
    "docs/guides/scan_recording.md": _recording,
    "docs/guides/calibrate_lens.md": _one_image,
    "docs/guides/calibrate_tilted_camera.md": _images,
    "docs/guides/calibrate_sensor.md": _laser_images,
    "docs/guides/plan_simulation.md": _part,
    "docs/guides/simulate_part.md": _part,
    "docs/guides/locate_board.md": _board,
    "docs/guides/plan_location.md": _board,
    "docs/guides/plan_placement.md": _gerbers,
    "docs/guides/locate_robot.md": _floor,
    "docs/guides/inspect_paste.md": _paste,
}
