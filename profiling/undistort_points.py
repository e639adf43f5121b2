"""Undistortion of points, compared with OpenCV's undistortPoints and with Numba.

The peer ``numba`` reads a point as one complex number, starts at a series of the radius, and takes two quasi-Newton
steps, five in double precision; ``numba-plain`` takes four Newton steps from the measured point. Both write the status
and NaN as gpuvision does, with one test of the radius: the fold of the camera lies far outside of the points of the
case.

OpenCV's default of five fixed-point steps does not converge for every camera; the column ``peer_error`` has its error
on the points of the case. Case names contain the camera; in ``converged`` cases OpenCV runs up to 200 steps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case, Peer

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
_FAST = {"contract", "arcp", "reassoc", "nsz"}  # fused multiply-add, sums in any order
_OK, _NOT_FINITE, _NOT_INVERTIBLE = np.uint8(0), np.uint8(8), np.uint8(128)  # flags of gpuvision
_CHUNK = 8192  # points of a chunk of the peer
_TERMS = 7  # of the series of the peer
_STEPS = {"float32": 2, "float64": 5}  # of the peer
# Largest error of the peer [px]: in single precision two roundings of a pixel above 1024, as ours.
_AGREEMENT = {"float32": 2.5e-4, "float64": 1e-11}
# The plain loop subtracts the measured point from a distorted one and adds the step to a position of order 1: it has
# about twice the roundings in single precision (measured: 2.7e-4 px for 1e6 points).
_PLAIN_AGREEMENT = {name: 2.0 * limit for name, limit in _AGREEMENT.items()}
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


@numba.njit(error_model="numpy")
def _flags(column, row, inside):
    """Return the status of a point; without a branch, so that LLVM vectorises the loops below."""
    finite = (np.abs(column) < np.inf) & (np.abs(row) < np.inf)
    return _OK if inside else (_NOT_INVERTIBLE if finite else _NOT_FINITE)


@numba.njit(parallel=True, error_model="numpy")
def _plain(columns, rows, table, far, ideal_columns, ideal_rows, status):
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
        inside = x * x + y * y < far
        ideal_columns[i] = cx + f * a if inside else np.nan
        ideal_rows[i] = cy + f * b if inside else np.nan
        status[i] = _flags(columns[i], rows[i], inside)


@numba.njit(error_model="numpy", fastmath=_FAST)
def _one_thread(points, table, far, series, steps, ideal, status):
    """Undistort points (complex numbers) on one core by quasi-Newton steps from a series of the radius.

    The inverse displacement of the radial terms is nearly m q s(q) at the measured point m, with q = |m|^2. The
    Jacobian of this series replaces the inverse Jacobian of the lens, so that a step has no division. `steps` is a
    tuple: its length is known when the loop is compiled, so that the steps are unrolled and the points vectorised. The
    series holds for squared radii below `far`, in normalised coordinates.
    """
    lost = points.dtype.type(complex(np.nan, np.nan))
    cx, cy, f, k1, k2, p1, p2, k3 = table[0], table[1], table[2], table[3], table[4], table[5], table[6], table[7]
    per = table[8]
    s0, s1, s2, s3, s4, s5, s6 = series[0], series[1], series[2], series[3], series[4], series[5], series[6]
    d0, d1, d2, d3, d4, d5, d6 = series[7], series[8], series[9], series[10], series[11], series[12], series[13]
    for i in range(points.shape[0]):
        column, row = points[i].real, points[i].imag
        x, y = (column - cx) * per, (row - cy) * per
        q = x * x + y * y
        g = q * (s0 + q * (s1 + q * (s2 + q * (s3 + q * (s4 + q * (s5 + q * s6))))))
        slope = d0 + q * (d1 + q * (d2 + q * (d3 + q * (d4 + q * (d5 + q * d6)))))
        a, b = x * g, y * g
        for _ in range(len(steps)):
            u, v = x + a, y + b
            r = u * u + v * v
            aside = p1 * v + p2 * u
            e = r * (k1 + r * (k2 + r * k3)) + (aside + aside)
            left, below = u * e + r * p2 + a, v * e + r * p1 + b
            turn = slope * (x * left + y * below)
            a -= left + (g * left + x * turn)
            b -= below + (g * below + y * turn)
        inside = q < far
        ideal[i] = complex(column + f * a, row + f * b) if inside else lost
        status[i] = _flags(column, row, inside)


@numba.njit(parallel=True, error_model="numpy")
def _chunks(points, table, far, series, steps, ideal, status):
    """Undistort chunks of points on all cores."""
    for chunk in numba.prange((points.shape[0] + _CHUNK - 1) // _CHUNK):
        first, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, points.shape[0])
        _one_thread(points[first:end], table, far, series, steps, ideal[first:end], status[first:end])


# Operations of a point in kernels/common/camera.h: normalised place 4, moved pixel 4, tilt 17 and its sums 4.
_PLACE, _TILT = 8, 21


def _bend_flops(camera: Camera) -> int:
    """Return the operations of the displacement of an ideal point by the lens."""
    defines: dict[str, Any] = camera.defines()
    over, under = (defines[f"CAMERA_{name}"] for name in ("RADIAL", "RATIONAL"))
    total = 3 + max(2 * over - 1, 0) + 2  # squared radius, polynomial, products
    if under:
        total += 2 * under - 1 + 4  # 1 + under and its inverse, difference, product
    if "CAMERA_DECENTRED" in defines:
        total += 5 + 2 * 2  # 2 (p1 y + p2 x) and its sum, offsets in x and y
    return int(total + (4 if "CAMERA_PRISM" in defines else 0))


def undistort_flops(camera: Camera, dtype: npt.DTypeLike, *, inverse: bool = False) -> int:
    """Return the operations of a point that the start polynomials solve: least number for the measured points.

    The start: squared radius 4, polynomials of 8 and of 6 terms 25, place 2, inverse Jacobian 7; for a decentred lens
    polynomials of four vectors 24, its place 10, inverse Jacobian 22. A step: lens, place 2, residual 2, change 8.
    """
    tilt = _TILT if "CAMERA_TILTED" in camera.defines() else 0
    if inverse:
        return _PLACE + tilt + _bend_flops(camera)
    start = 85 if "CAMERA_DECENTRED" in camera.defines() else 38
    step = _bend_flops(camera) + 12
    steps: Any = camera.undistort_defines(dtype)["CAMERA_STEPS"]
    return int(_PLACE + tilt + start + steps * step)


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

    peers: dict[str, Peer] = {"opencv": opencv}
    exact = camera.distort(points) if inverse else camera.undistort(points)
    metadata = {"peer_error": _worst(opencv()[:, 0], exact)}
    if camera is STANDARD:
        peers |= _numba_peers(points, camera, exact)
    if np.any(to_numpy(bound.outputs.status)):
        raise AssertionError("a point within the invertible region was flagged")
    traffic = (points.nbytes, points.nbytes + len(points))
    error = _worst(to_numpy(bound.outputs.points), exact)
    flops = len(points) * undistort_flops(camera, dtype, inverse=inverse)
    return Case("points", name, bound.run, peers, error, traffic, metadata=metadata, flops=flops)


def _numba_peers(points: NDArray[Any], camera: Camera, exact: NDArray[np.float64]) -> dict[str, Peer]:
    """Return the peers ``numba`` and ``numba-plain``, after a comparison of their results with float64."""
    (f, _, cx), (_, _, cy), _ = camera.matrix
    table = np.array([cx, cy, f, *camera.distortion[:5], 1.0 / f], points.dtype)
    columns, rows = (np.ascontiguousarray(each) for each in points.T)
    ideal, status = np.empty_like(points), np.empty(len(points), np.uint8)
    pairs, targets = (each.reshape(-1).view(np.result_type(points, np.complex64)) for each in (points, ideal))
    far = _farthest(camera, points)
    series, steps = _inverse_series(camera, far).astype(points.dtype), (0,) * _STEPS[points.dtype.name]
    square = points.dtype.type(far**2)
    given = pairs, table, square, series, steps, targets, status
    forms: dict[str, Callable[[], object]] = {
        "one-thread": functools.partial(_one_thread, *given),
        "chunks": functools.partial(_chunks, *given),
    }
    for form in forms.values():
        ideal[:], status[:] = np.nan, 255
        form()
        if not _worst(ideal, exact) < _AGREEMENT[points.dtype.name] or np.any(status):
            raise AssertionError("the Numba loop and float64 differ")
    moved = np.full_like(columns, np.nan), np.full_like(rows, np.nan)
    plain = functools.partial(_plain, columns, rows, table, square, *moved, status)
    status[:] = 255
    plain()
    if not _worst(np.stack(moved, axis=-1), exact) < _PLAIN_AGREEMENT[points.dtype.name] or np.any(status):
        raise AssertionError("the plain Numba loop and float64 differ")
    return {"numba": forms, "numba-plain": plain}


def _farthest(camera: Camera, points: NDArray[Any]) -> float:
    """Return the radius of the farthest of the points from the principal point, and 1 % more, over the focal length."""
    (f, _, cx), (_, _, cy), _ = camera.matrix
    return 1.01 * float(np.max(np.hypot(*(points.astype(np.float64) - (cx, cy)).T))) / f


def _inverse_series(camera: Camera, far: float) -> NDArray[np.float64]:
    """Return the coefficients of the series of `_one_thread`, and of twice its derivative by q.

    The series is fitted to the radial terms of the lens, up to the radius `far`.
    """
    k1, k2, _, _, k3 = camera.distortion[:5]
    ideal = np.linspace(1e-3, 2.0 * far, 8000)
    measured = ideal * (1.0 + ideal**2 * (k1 + ideal**2 * (k2 + ideal**2 * k3)))
    used = (measured <= far) & (ideal < camera.invertible_radius)
    q, powers = measured[used] ** 2, np.arange(1, _TERMS + 1)
    series = np.linalg.lstsq(q[:, None] ** powers, ideal[used] / measured[used] - 1.0, rcond=1e-13)[0]
    return np.concatenate([series, 2.0 * powers * series])


def _worst(result: NDArray[Any], exact: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(result - exact)))
