"""Contract of undistorted images: pixel types, interpolations, borders and odd sizes; positions beyond the image."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference.camera import distort_pixels
from gpuvision.reference.undistort_image import undistort

_WIDE = "uint16 and float32 images"
_OF_LARGEST = 2 * 2 * (1e-5 + 4 * 32 * 6e-8) + 10 * 6e-8
LIMITS = {
    "UndistortImage": (
        equal("status", reason="comparisons only, except within rounding of the image's sides"),
        equal("image", reason="uint8 pixels are rounded to nearest, except within the limit of float32 of a half"),
        Limit(
            ("image",), _OF_LARGEST, _OF_LARGEST, "largest value; half a level more in uint16 images", when=_WIDE,
            reason="error of the positions in x and y (1e-5 px, and four roundings of 32 px) times a slope of at most "
            "twice the range for each pixel; ten roundings of the value",
        ),
    )
}  # fmt: skip
_SHAPE = (83, 117)
_CAMERA = Camera(
    matrix=((130.0, 0.0, 60.0), (0.0, 130.0, 41.0), (0.0, 0.0, 1.0)), distortion=(0.12, 0.03, 2e-3, -1e-3, *10 * (0.0,))
)
_LARGEST = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}
_EDGE = 1e-3  # distance from a side of the image within which the status is undecided [px]


def cases() -> Iterator[Case]:
    """Yield both interpolations for each pixel type, and all borders."""
    for dtype in _LARGEST:
        for interpolation in ("bilinear", "bicubic"):
            yield _case(f"{interpolation}, {dtype}", dtype, interpolation=interpolation)
    for border in ("constant", "replicate", "reflect"):
        yield _case(f"border {border}, float32", "float32", border=border, border_value=0.75)


def _case(name: str, dtype: str, **settings: Any) -> Case:
    rng, largest = np.random.default_rng(32), _LARGEST[dtype]
    values = rng.uniform(0.0, largest, _SHAPE)
    image = (values if dtype == "float32" else np.rint(values)).astype(dtype)
    rows, columns = _SHAPE
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    positions = distort_pixels(pixels, _CAMERA.matrix, _CAMERA.distortion).astype(np.float64).reshape(rows, columns, 2)
    found, status = undistort(image.astype(np.float64)[..., None], positions, **settings)
    exact = found[..., 0]
    sides = np.array([[-0.5, columns - 0.5], [-0.5, rows - 0.5]])
    undecided = (np.abs(positions[..., None] - sides) < _EDGE).any(axis=(-1, -2))
    clipped = exact if dtype == "float32" else np.clip(np.nan_to_num(exact), 0.0, largest)
    quantity = largest + (0.5 / _OF_LARGEST if dtype == "uint16" else 0.0)
    if dtype == "uint8":
        undecided |= np.abs(clipped - np.floor(clipped) - 0.5) <= _OF_LARGEST * largest
        clipped = np.rint(clipped)
    operation, when = UndistortImage(model=_CAMERA, **settings), "" if dtype == "uint8" else _WIDE
    exacts: dict[str, npt.NDArray[Any]] = {"image": clipped, "status": status}
    return Case("UndistortImage", name, operation, (image,), exacts, {"image": quantity}, undecided, when)
