"""Undistortion of points, compared with OpenCV's undistortPoints and Newton's method in Numba.

OpenCV's default of five fixed-point steps does not converge for every camera; the column ``peer_error`` has its error
on the points of the case. Case names contain the camera; in ``converged`` cases OpenCV runs up to 200 steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case

SIZE = (1280, 1024)
TWENTY_DEGREES = float(np.radians(20.0))
STANDARD = Camera(
    matrix=((1000.0, 0.0, 640.0), (0.0, 1000.0, 512.0), (0.0, 0.0, 1.0)),
    distortion=(-0.28, 0.11, 5e-4, -3e-4, -0.02, *(0.0,) * 9),
)
# Scheimpflug camera.
TILTED = Camera(
    matrix=((1200.0, 0.0, 640.0), (0.0, 1200.0, 512.0), (0.0, 0.0, 1.0)),
    distortion=(-0.25, 0.05, *(0.0,) * 10, TWENTY_DEGREES, 0.0),
)
# Wide-angle camera whose lens model folds within the image.
FOLDING = Camera(
    matrix=((800.0, 0.0, 640.0), (0.0, 800.0, 512.0), (0.0, 0.0, 1.0)),
    distortion=(-0.4, *(0.0,) * 11, TWENTY_DEGREES, 0.0),
)
FULL = Camera(
    matrix=((1700.0, 0.0, 640.0), (0.0, 1700.0, 512.0), (0.0, 0.0, 1.0)),
    distortion=(-0.12, 0.08, 1e-3, -2e-3, 0.01, 0.02, 0.03, 1e-3, 1e-3, 2e-3, -1e-3, 3e-3, TWENTY_DEGREES, -0.2),
)
_DEFAULT = (cv2.TERM_CRITERIA_COUNT, 5, 0.01)
_CONVERGED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


@numba.njit(error_model="numpy")
def _newton_step(x, y, at_x, at_y, one, k1, k2, p1, p2, k3):
    q = at_x * at_x + at_y * at_y
    scale = one + q * (k1 + q * (k2 + q * k3)) + (one + one) * (p1 * at_y + p2 * at_x)
    slope = (one + one) * (k1 + q * (k2 + k2 + (one + one + one) * q * k3))
    by_x, by_y = slope * at_x + (p2 + p2), slope * at_y + (p1 + p1)
    left_x, left_y = at_x * scale + q * p2 - x, at_y * scale + q * p1 - y
    xx, xy = scale + at_x * (by_x + (p2 + p2)), at_x * by_y + at_y * (p2 + p2)
    yx, yy = at_y * by_x + at_x * (p1 + p1), scale + at_y * (by_y + (p1 + p1))
    per = one / (xx * yy - xy * yx)
    return at_x - (yy * left_x - xy * left_y) * per, at_y - (xx * left_y - yx * left_x) * per


@numba.njit(parallel=True, error_model="numpy")
def _numba(columns, rows, table, ideal_columns, ideal_rows):
    """Take four Newton steps from the measured point, on all cores.

    The loop is unrolled, with separate arrays of columns and rows (ours takes pairs), so that LLVM vectorises it.
    """
    one = table.dtype.type(1)
    cx, cy, f, k1, k2, p1, p2, k3 = table[0], table[1], table[2], table[3], table[4], table[5], table[6], table[7]
    per = one / f
    for i in numba.prange(columns.shape[0]):
        x, y = (columns[i] - cx) * per, (rows[i] - cy) * per
        a, b = _newton_step(x, y, x, y, one, k1, k2, p1, p2, k3)
        a, b = _newton_step(x, y, a, b, one, k1, k2, p1, p2, k3)
        a, b = _newton_step(x, y, a, b, one, k1, k2, p1, p2, k3)
        a, b = _newton_step(x, y, a, b, one, k1, k2, p1, p2, k3)
        ideal_columns[i] = cx + f * a
        ideal_rows[i] = cy + f * b


def cases(device: Device) -> Iterator[Case]:
    """Yield cases of 1e5 and 1e6 points for several cameras; also double precision, converged OpenCV and distortion."""
    for count, size in ((100_000, "1e5"), (1_000_000, "1e6")):
        yield _case(device, STANDARD, count, f"opencv/{size}")
        yield _case(device, TILTED, count, f"tilted/{size}")
    yield _case(device, FULL, 1_000_000, "full/1e6")
    yield _case(device, FOLDING, 1_000_000, "folding/1e6")
    yield _case(device, TILTED, 1_000_000, "distort/1e6", inverse=True)
    yield _case(device, STANDARD, 100_000, "opencv-converged/1e5", stop=_CONVERGED)
    yield _case(device, TILTED, 100_000, "tilted-converged/1e5", stop=_CONVERGED)
    if device.has_double:
        yield _case(device, STANDARD, 1_000_000, "float64/1e6", dtype="float64")


def _points(camera: Camera, count: int, inverse: bool) -> NDArray[np.float64]:
    """Return measured points, or ideal ones, all over the image and within 0.99 of the fold radius."""
    rng = np.random.default_rng(1)
    ideal = rng.uniform(0.0, 1.0, (2 * count, 2)) * SIZE
    middle, focal = np.array(camera.matrix)[:2, 2], camera.matrix[0][0]
    radius = np.hypot(*(ideal - middle).T) / focal
    ideal = ideal[radius < 0.99 * camera.invertible_radius][:count]
    return ideal if inverse else camera.distort(ideal)


def _case(
    device: Device,
    camera: Camera,
    count: int,
    name: str,
    *,
    dtype: str = "float32",
    stop: tuple[int, int, float] = _DEFAULT,
    inverse: bool = False,
) -> Case:
    points = _points(camera, count, inverse).astype(dtype)
    bound = UndistortPoints(model=camera, inverse=inverse).bind(device, points.shape, points.dtype)
    bound.inputs[0].set(points)
    bound.run()
    matrix, coefficients = camera.to_opencv()
    if inverse:
        lifted = np.pad(points, ((0, 0), (0, 1)), constant_values=1.0)
        rays, zero = np.ascontiguousarray(lifted @ np.linalg.inv(matrix).T)[:, None], np.zeros(3)

        def opencv() -> Any:
            return cv2.projectPoints(rays, zero, zero, matrix, coefficients)[0]
    else:
        pairs, out = points[:, None], np.empty((len(points), 1, 2), dtype)

        def opencv() -> Any:
            return cv2.undistortPoints(pairs, matrix, coefficients, out, None, matrix, stop)

    peers: dict[str, Callable[[], object]] = {"opencv": opencv}
    exact = camera.distort(points) if inverse else camera.undistort(points)
    metadata = {"peer_error": _worst(opencv()[:, 0], exact)}
    if camera is STANDARD:
        peers["numba"] = _newton(points, camera)
    if np.any(to_numpy(bound.outputs.status)):
        raise AssertionError("a point within the invertible region was flagged")
    traffic = (points.nbytes, points.nbytes + len(points))
    return Case(
        "points", name, bound.run, peers, _worst(to_numpy(bound.outputs.points), exact), traffic, metadata=metadata
    )


def _newton(points: NDArray[Any], camera: Camera) -> Callable[[], object]:
    (f, _, cx), (_, _, cy), _ = camera.matrix
    table = np.array([cx, cy, f, *camera.distortion[:5]], points.dtype)
    columns, rows = (np.ascontiguousarray(each) for each in points.T)
    ideal = np.empty_like(columns), np.empty_like(rows)
    return lambda: _numba(columns, rows, table, *ideal)


def _worst(result: NDArray[Any], exact: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(result - exact)))
