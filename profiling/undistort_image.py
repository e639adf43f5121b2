"""Image undistortion, compared with OpenCV's remap with float maps: its exact path, the fastest since version 5.

Errors are output pixels minus the float64 value at the exact source position, including the rounding to integers; each
row has the errors of both libraries. Cases without a map compare with ``cv2.undistort``, which computes its maps in
every call and rounds source positions to 1/32 px.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_image import Interpolation, UndistortImage
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case

_CORNER_SHIFT = 20.0  # px
_FILTERS = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
_LARGEST = {"uint8": 255.0, "uint16": 65535.0, "float32": 255.0}
# Margin [px]: errors are evaluated where all taps lie within the image.
_BORDER = 8
_ROWS_AT_ONCE = 256  # bounds the memory of the float64 reference

Float64 = NDArray[np.float64]


def cases(device: Device) -> Iterator[Case]:
    """Yield both interpolations at 1024 and 2048 pixels; pincushion lens, three channels, computed positions."""
    for dtype in ("uint8", "float32"):
        for interpolation in _FILTERS:
            for size in (1024, 2048):
                yield _case(device, f"{dtype}/{interpolation}/{size}", _camera(size, -_CORNER_SHIFT), dtype, size)
    barrel, pincushion = (_camera(1024, shift) for shift in (-_CORNER_SHIFT, _CORNER_SHIFT))
    yield _case(device, "uint16/bilinear/1024", barrel, "uint16", 1024)
    for dtype in ("uint8", "float32"):
        yield _case(device, f"pincushion/{dtype}/bilinear/1024", pincushion, dtype, 1024)
    yield _case(device, "three-channels/uint8/bilinear/1024", barrel, "uint8", 1024, channels=3)
    yield _case(device, "computed/uint8/bilinear/1024", barrel, "uint8", 1024, coordinates="computed")


def _camera(size: int, corner_shift: float) -> Camera:
    """Return a camera of square images whose lens moves the corners by ``corner_shift`` pixels."""
    middle, focal = 0.5 * (size - 1), 1.2 * size
    corner = np.hypot(middle, middle) / focal
    k1 = corner_shift / (focal * corner**3)
    return Camera(matrix=((focal, 0.0, middle), (0.0, focal, middle), (0.0, 0.0, 1.0)), distortion=(k1,) + 13 * (0.0,))


@functools.lru_cache(maxsize=2)
def _image(dtype: str, size: int, channels: int) -> NDArray[Any]:
    """Return a smooth texture over the full range."""
    shape = (size, size, 3) if channels == 3 else (size, size)
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(size=shape), (0, 0), 1.5)
    low, high = texture.min(), texture.max()
    values = (texture - low) / (high - low) * _LARGEST[dtype]
    image: NDArray[Any] = (values if dtype == "float32" else np.rint(values)).astype(dtype)
    return image


# Operations in kernels/undistort_image. Of a position in the map: cubic polynomials 13. Of a computed one: place 2,
# radius 3, displacement 6, moved pixel 4, and 2 for each further coefficient. Of a channel: three linear interpolations
# 9, or five cubic ones of four taps 35; cubic weights of both axes 30.
_MAPPED, _COMPUTED, _LINEAR, _CUBIC, _CUBIC_WEIGHTS = 13, 13, 9, 35, 30


def pixel_flops(operation: UndistortImage) -> int:
    """Return the operations of a pixel for a camera with radial coefficients of a polynomial."""
    more = 2 * (int(operation.model.defines()["CAMERA_RADIAL"]) - 1)
    place = _MAPPED if operation.coordinates == "map" else _COMPUTED + more
    if operation.interpolation == "bilinear":
        return place + _LINEAR * operation.channels
    return place + _CUBIC_WEIGHTS + _CUBIC * operation.channels


def _case(device: Device, name: str, camera: Camera, dtype: str, size: int, **options: Any) -> Case:
    interpolation: Interpolation = "bicubic" if "bicubic" in name else "bilinear"
    operation = UndistortImage(model=camera, interpolation=interpolation, **options)
    image = _image(dtype, size, operation.channels)
    bound = operation.bind(device, image.shape, dtype)
    bound.inputs[0].set(image)
    bound.run()
    positions = operation.source_positions((size, size))
    undistorted = np.empty_like(image)
    peer = _peer(camera, operation, image, positions, undistorted)
    peer()
    exact, inner = _exact(image, positions, interpolation)
    ours, theirs = (np.abs(each[inner] - exact[inner]) for each in (to_numpy(bound.outputs.image), undistorted))
    numbers = {"rms": _rms(ours), "peer_error": theirs.max(), "peer_rms": _rms(theirs)}
    metadata = {name: float(f"{number:.5g}") for name, number in numbers.items()}
    traffic = (image.nbytes, image.nbytes + bound.outputs.status.nbytes)
    flops = positions[..., 0].size * pixel_flops(operation)
    return Case(
        "undistort", name, bound.run, {"opencv": peer}, float(ours.max()), traffic, metadata=metadata, flops=flops
    )


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _peer(
    camera: Camera, operation: UndistortImage, image: NDArray[Any], positions: Float64, undistorted: NDArray[Any]
) -> Callable[[], object]:
    if operation.coordinates == "computed":
        matrix, distortion = camera.to_opencv()
        return lambda: cv2.undistort(image, matrix, distortion, dst=undistorted)
    x, y = (np.ascontiguousarray(positions[..., axis], dtype=np.float32) for axis in (0, 1))
    return lambda: cv2.remap(image, x, y, _FILTERS[operation.interpolation], dst=undistorted)


def _exact(image: NDArray[Any], positions: Float64, interpolation: Interpolation) -> tuple[Float64, NDArray[np.bool_]]:
    """Return exact values in float64, clipped to the pixel range, and a mask of pixels whose taps need no border."""
    rows, columns = image.shape[:2]
    x, y = np.moveaxis(positions, -1, 0)
    inner = (x > _BORDER) & (x < columns - 1 - _BORDER) & (y > _BORDER) & (y < rows - 1 - _BORDER)
    exact = np.zeros(image.shape)
    for first in range(0, len(positions), _ROWS_AT_ONCE):
        part = slice(first, first + _ROWS_AT_ONCE)
        exact[part] = _interpolated(image, x[part], y[part], interpolation)
    return exact if image.dtype.kind == "f" else np.clip(exact, 0.0, _LARGEST[image.dtype.name]), inner


def _interpolated(image: NDArray[Any], x: Float64, y: Float64, interpolation: Interpolation) -> Float64:
    rows, columns = image.shape[:2]
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    offsets, weights_of = ((-1, 0, 1, 2), _cubic) if interpolation == "bicubic" else ((0, 1), _linear)
    result: Float64 = np.zeros((*x.shape, *image.shape[2:]))
    for j, down in zip(offsets, weights_of(y - row), strict=True):
        for i, across in zip(offsets, weights_of(x - column), strict=True):
            weight = (down * across).reshape(x.shape + (1,) * (image.ndim - 2))
            result += weight * image[np.clip(row + j, 0, rows - 1), np.clip(column + i, 0, columns - 1)]
    return result


def _linear(part: Float64) -> tuple[Float64, ...]:
    return 1.0 - part, part


def _cubic(part: Float64) -> tuple[Float64, ...]:
    a = -0.75  # as in OpenCV

    def near(d: Float64) -> Float64:
        return ((a + 2.0) * d - (a + 3.0)) * d**2 + 1.0

    def far(d: Float64) -> Float64:
        return a * (((d - 5.0) * d + 8.0) * d - 4.0)

    return far(1.0 + part), near(part), near(1.0 - part), far(2.0 - part)
