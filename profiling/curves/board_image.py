"""Images of a moving board: number of sub-poses of an exposure, and type of the poses.

The truth is the mean of 256 sub-poses in double precision.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.reference.board_image import centred_pixels, reflectance
from gpuvision.simulation.board_image.board_image import RenderBoard, exposure_poses
from gpuvision.simulation.board_image.reflectance_map import WHITE, ReflectanceMap

_SHAPE, _NODES, _CELL, _PIXEL = (64, 64), 480, 2.5e-6, 1e-5  # [px], nodes of the map, [m], [m]
_MOTIONS = {"motion of 1 px": 1e-5, "motion of 8 px": 8e-5}  # [m]
_MANY = 256


def settings(device: Device) -> Iterator[Setting]:
    """Yield numbers of sub-poses for slow and fast motion; the error is that of the reflectance."""
    noise = np.random.default_rng(4).standard_normal((_NODES, _NODES)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 6.0)
    values = np.rint(WHITE * np.clip(0.5 + 0.15 * smooth / smooth.std(), 0.0, 1.0)).astype(np.uint16)
    board = ReflectanceMap(values=values, origin=(0.0, 0.0), cell=_CELL, pixel=_PIXEL, blur_px=0.5)
    middle = 0.5 * _NODES * _CELL
    for data, motion in _MOTIONS.items():
        ends = (middle, middle, 0.1), (middle + motion, middle + 0.5 * motion, 0.1 + 100.0 * motion)
        exact = reflectance(values, (0.0, 0.0), _CELL, _PIXEL, centred_pixels(_SHAPE), exposure_poses(*ends, _MANY))
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            for count in (1, 2, 4, 8, 16):
                poses = exposure_poses(*ends, count)[None].astype(dtype)
                bound = bind_with(RenderBoard(board=board, shape=_SHAPE), device, poses, np.zeros(1, np.uint32))
                errors = Errors(to_numpy(bound.outputs.image)[0] - exact)
                yield Setting("board_image", data, {"sub-poses": count, "dtype": dtype}, bound.run, errors, "")
