"""Images of boards: place on a long map, and turn."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.board_image import centred_pixels, reflectance
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

_SHAPE, _CELL, _PIXEL = (4, 4), 2.5e-6, 1e-5  # [px], [m]
_NODES = 20_000
_VALUES = np.random.default_rng(3).integers(0, 65536, (64, _NODES)).astype(np.uint16)
_MAP = ReflectanceMap(values=_VALUES, origin=(0.0, 0.0), cell=_CELL, pixel=_PIXEL, blur_px=0.5)
_RENDER = RenderBoard(board=_MAP, shape=_SHAPE)
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the reflectance over the place on the map and the turn of the camera."""
    axes = Axis("distance from the map's origin [nodes]", 20.0, 19_900.0), Axis("turn [rad]", -3.1, 3.1, False)
    return Problem(axes, "reflectance of white", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    x = _CELL * (places[:, 0] + rng.uniform(-5.0, 5.0, len(places)))
    y = _CELL * rng.uniform(20.0, 40.0, len(places))
    poses = np.stack([x, y, places[:, 1]], axis=-1)[:, None].astype(np.float32)
    found = np.asarray(_RENDER(poses, np.zeros(len(places), np.uint32), device=device).image, np.float64)
    pixels = centred_pixels(_SHAPE)
    errors = np.empty(len(places))
    for number, pose in enumerate(poses.astype(np.float64)):
        first = max(int(pose[0, 0] / _CELL) - 32, 0)  # the nodes around the image
        moved = pose - [first * _CELL, 0.0, 0.0]
        exact = reflectance(_VALUES[:, first : first + 64], (0.0, 0.0), _CELL, _PIXEL, pixels, moved)
        errors[number] = np.abs(found[number] - exact).max()
    return errors


def _bound(places: Floats) -> Floats:
    # Contract of the images: 8 epsilon of the nodes along the map, times a slope of white for each node.
    return np.asarray(8.0 * _EPS * (places[:, 0] + 32.0))
