"""Images of a board under a camera, compared with Numba on all cores and with OpenCV.

A region of interest of 256 x 256 pixels of 10 um, 8 bits, with shot noise and dark noise; in the case ``motion`` the
mean of 8 sub-poses. All candidates sample the same map, which holds the blur and the area of a pixel already.

Numba does the same work: bilinear samples, a normal number by Philox2x32-10 and the method of Box and Muller, rounding.
OpenCV resamples with ``warpAffine`` (its coordinates are rounded to 1/32 node), draws the noise with ``randn`` (a
stateful generator without a counter) and rounds with ``convertTo``. The error refers to a noise-free reflectance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.reference import board_image as reference
from gpuvision.simulation.board_image.board_image import RenderBoard, exposure_poses
from gpuvision.simulation.board_image.reflectance_map import WHITE, ReflectanceMap

Array = NDArray[Any]

SIDE, PIXEL, FINE = 256, 10e-6, 4
_WHITE_ELECTRONS = 8000.0
_SENSOR = CmosSensor(
    rows=1024, columns=1024, pitch=10e-6, quantum_efficiency=0.5, gain=0.025, dark_noise=20.0, full_well=20e3, bits=8
)
_MULTIPLIER, _WEYL = np.uint64(0xD256D193), np.uint32(0x9E3779B9)


def textured_map() -> ReflectanceMap:
    """Return a map of 4 mm x 4 mm of smooth random reflectance."""
    noise = np.random.default_rng(5).standard_normal((400 * FINE, 400 * FINE)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0 * FINE)
    values = np.clip(0.5 + 0.12 * smooth / smooth.std(), 0.0, 1.0) * WHITE
    return ReflectanceMap(
        values=np.rint(values).astype(np.uint16), origin=(0.0, 0.0), cell=PIXEL / FINE, pixel=PIXEL, blur_px=0.5
    )


@numba.njit(parallel=True, error_model="numpy", fastmath=True)
def _numba(values, poses, frame, numbers, image):
    """Render one frame; poses (sub-poses, 4): u, v of the centre [nodes], and the steps of a pixel along and across."""
    electrons, dark_variance, gain = numbers[0], numbers[1], numbers[2]
    rows, columns = image.shape
    flat, pitch = values.reshape(-1), values.shape[1]
    centre = np.float32(0.5) * np.float32(columns - 1)
    for row in numba.prange(rows):
        dy = np.float32(row) - np.float32(0.5) * np.float32(rows - 1)
        seen = np.zeros(columns, np.float32)
        for k in range(len(poses)):
            u0, v0, along, across = poses[k, 0], poses[k, 1], poses[k, 2], poses[k, 3]
            for column in range(columns):
                dx = np.float32(column) - centre
                u, v = u0 + along * dx + across * dy, v0 + across * dx - along * dy
                i, j = np.int32(u), np.int32(v)
                a, b, at = u - np.float32(i), v - np.float32(j), j * pitch + i
                below = np.float32(flat[at]) + a * (np.float32(flat[at + 1]) - np.float32(flat[at]))
                at += pitch
                above = np.float32(flat[at]) + a * (np.float32(flat[at + 1]) - np.float32(flat[at]))
                seen[column] += below + b * (above - below)
        for column in range(columns):
            first, second, key = np.uint32(row * columns + column), np.uint32(frame), np.uint32(0)
            for _ in range(10):
                product = np.uint64(first) * _MULTIPLIER
                first = np.uint32(product >> np.uint64(32)) ^ key ^ second
                second = np.uint32(product)
                key = np.uint32(key + _WEYL)
            radius = np.sqrt(np.float32(-2.0) * np.log((np.float32(first) + np.float32(0.5)) * np.float32(2.0**-32)))
            normal = radius * np.cos(np.float32(2.0 * np.pi * 2.0**-32) * np.float32(second))
            e = seen[column] * electrons
            level = gain * (e + np.sqrt(e + dark_variance) * normal) + np.float32(0.5)
            image[row, column] = np.uint8(min(max(level, np.float32(0.0)), np.float32(255.0)))


def _opencv(values: Array, matrices: list[Array], electrons: float, scratch: Array) -> Array:
    """Return one frame: the mean of warped maps, with noise."""
    e: Array = np.zeros((SIDE, SIDE), np.float32)
    for matrix in matrices:
        cv2.accumulate(cv2.warpAffine(values, matrix, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP), e)
    e *= np.float32(electrons)
    cv2.randn(scratch, np.zeros(1), np.ones(1))
    e += cv2.multiply(cv2.sqrt(e + np.float32(_SENSOR.dark_noise**2)), scratch)
    return np.asarray(cv2.convertScaleAbs(np.maximum(e, 0.0), alpha=_SENSOR.gain))


def _placed(board: ReflectanceMap, poses: Array) -> Array:
    """Return u, v of the image's centre [nodes] and the steps of a pixel along and across, (sub-poses, 4)."""
    u, v = (poses[:, axis] / board.cell for axis in (0, 1))
    return np.stack([u, v, FINE * np.cos(poses[:, 2]), FINE * np.sin(poses[:, 2])], axis=1)


def _matrix(placed: Array) -> Array:
    """Return the affine matrix (2, 3) from pixels to nodes."""
    u, v, along, across = placed
    middle = (SIDE - 1) / 2
    linear = np.array([[along, across], [across, -along]])
    return np.concatenate([linear, (np.array([u, v]) - linear @ [middle, middle])[:, None]], axis=1)


# Operations in kernels/board_image. Of a pixel under a sub-pose: place 8, its fractions 2, bilinear value 9, sum 1. Of
# a pixel: place 1, unit 1, logarithm 16 and cosine 14 as polynomials, radius 2, noise 4, grey level 2.
_SAMPLE, _PIXEL = 20, 40


def cases(device: Device) -> Iterator[Case]:
    """Yield a frame of a camera at rest, and a frame with motion blur."""
    yield _case(device, "256", 1)
    yield _case(device, "256-motion", 8)


def _case(device: Device, name: str, count: int) -> Case:
    board = textured_map()
    poses = exposure_poses((2e-3, 2e-3, 0.1), (2.04e-3, 2.01e-3, 0.101), count)
    operation = RenderBoard(board=board, shape=(SIDE, SIDE), sensor=_SENSOR, electrons=_WHITE_ELECTRONS)
    bound = operation.bind(device, (1, count, 3), np.float64)
    bound.inputs[0].set(poses[None])
    bound.inputs[1].set(np.array([9], np.uint32))
    placed = _placed(board, poses)
    per_value = _WHITE_ELECTRONS / (WHITE * count)
    numbers = np.array([per_value, _SENSOR.dark_noise**2, _SENSOR.gain], np.float32)
    image, scratch = np.empty((SIDE, SIDE), np.uint8), np.empty((SIDE, SIDE), np.float32)
    matrices = [_matrix(each) for each in placed]
    single = placed.astype(np.float32)

    def by_numba() -> None:
        _numba(board.values, single, 9, numbers, image)

    bound.run()
    by_numba()
    ours = to_numpy(bound.outputs.image)[0].astype(np.int32)
    drawn = _opencv(board.values, matrices, per_value, scratch)
    exact = reference.reflectance(
        board.values, board.origin, board.cell, PIXEL, reference.centred_pixels((SIDE, SIDE)), poses
    )
    sigma = _SENSOR.gain * math.sqrt(0.5 * _WHITE_ELECTRONS + _SENSOR.dark_noise**2)
    mean = _SENSOR.gain * _WHITE_ELECTRONS * exact
    same = np.mean(np.abs(image - ours) <= 1) > 0.999
    if not (same and np.std(ours - mean) < 1.2 * sigma and abs(np.std(drawn - mean) / sigma - 1.0) < 0.2):
        raise AssertionError("the image of a peer differs from ours")
    peers: dict[str, Callable[[], object]] = {
        "numba": by_numba,
        "opencv": lambda: _opencv(board.values, matrices, per_value, scratch),
    }
    quiet = RenderBoard(board=board, shape=(SIDE, SIDE))(poses[None], np.zeros(1, np.uint32), device=device).image[0]
    # Each pixel lies on four nodes of two bytes; neighbouring pixels share none.
    traffic = (SIDE * SIDE * 8 * count, SIDE * SIDE)
    flops = SIDE * SIDE * (_PIXEL + _SAMPLE * count)
    return Case("board_image", name, bound.run, peers, float(np.max(np.abs(quiet - exact))), traffic, flops=flops)
