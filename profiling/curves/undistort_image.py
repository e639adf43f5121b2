"""Undistortion of images: interpolation, and positions from a map or computed in the kernel.

The scene is a known pattern of sines, finer in one image than in the other; the image has noise of one level.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with

_SIZE = 512
_CAMERA = Camera(
    matrix=((600.0, 0.0, 255.5), (0.0, 600.0, 255.5), (0.0, 0.0, 1.0)), distortion=(-0.15, 0.05, *12 * (0.0,))
)
_BORDER = 8  # margin without missing neighbours [px]
_SOURCES: tuple[dict[str, Any], ...] = (
    {"coordinates": "map"},
    {"coordinates": "computed", "precision": "single"},
    {"coordinates": "computed", "precision": "double"},
)
_NOISE = 1.0  # [levels]


def settings(device: Device) -> Iterator[Setting]:
    """Yield interpolations, sources of the positions, and precisions for a coarse and a fine pattern."""
    row, column = np.mgrid[:_SIZE, :_SIZE].astype(np.float64)
    pixels = np.stack([column, row], axis=-1).reshape(-1, 2)
    for period in (24.0, 6.0):
        seen = _pattern(_CAMERA.undistort(pixels), period).reshape(_SIZE, _SIZE)
        true = _pattern(pixels, period).reshape(_SIZE, _SIZE)
        noisy = seen + np.random.default_rng(11).normal(0.0, _NOISE, seen.shape)
        image = np.rint(noisy).astype(np.uint8)
        for interpolation in ("bilinear", "bicubic"):
            for parameters in _SOURCES if device.has_double else _SOURCES[:2]:
                operation: Any = UndistortImage(model=_CAMERA, interpolation=interpolation, **parameters)
                bound = bind_with(operation, device, image)
                deviation = to_numpy(bound.outputs.image).astype(np.float64) - true
                deviation[to_numpy(bound.outputs.status) != 0] = np.nan
                inner = Errors(deviation[_BORDER:-_BORDER, _BORDER:-_BORDER])
                named = {"interpolation": interpolation, **parameters}
                yield Setting("undistort_image", f"period {period:.0f} px", named, bound.run, inner, "levels")


def _pattern(points: npt.NDArray[np.float64], period: float) -> npt.NDArray[np.float64]:
    x, y = points.T * (2.0 * np.pi / period)
    return np.asarray(120.0 + 50.0 * np.sin(x + 0.3 * y) + 50.0 * np.sin(y - 0.2 * x + 1.0))
