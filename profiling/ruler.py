"""Calipers (rulers) against Numba on all cores, OpenCV's remap of all rulers in one call, and NumPy.

Numba sums the lines of a sample in a register, so that LLVM vectorises over samples. Cases named ``flat`` use a form
that LLVM compiles to faster code: 32-bit indices into a flat image.

The rulers have 64 samples, 5 lines and a smoothing of 1 px; each crosses the border of a disc once, at any angle, in an
8-bit frame of 640 x 480. All candidates return position, amplitude, width, predicted standard deviation and status of
the strongest edge. We correct the position for the bias of linear interpolation; the peers do not. We measure 16 rulers
in an inline queue, which runs in the thread of the caller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling.harness import Case

ROWS, COLUMNS, RADIUS = 480, 640, 150.0
LENGTH, WIDTH, SMOOTHING, THRESHOLD = 64, 5, 1.0, 20.0
_FEW = 16  # largest number of rulers that are measured in an inline queue
_REACH = 3
_OPENCV_ROWS = 32767  # largest number of rows of an image from remap
_TAPS = np.arange(1, _REACH + 1) * np.exp(-0.5 * np.arange(1, _REACH + 1) ** 2)
_TAPS /= 2.0 * np.sum(_TAPS * np.arange(1, _REACH + 1))
_VARIANCE = float(np.sum(2.0 * _TAPS * np.arange(1, _REACH + 1) ** 3)) / 3.0
_LEAST = THRESHOLD / math.sqrt(2.0 * math.pi * _VARIANCE)


@numba.njit(error_model="numpy", fastmath={"contract"})
def _sample(image, pixels, pitch, x, y):
    """Return a bilinear sample. Unsigned indices avoid the test for negative ones."""
    column, row = np.int32(x), np.int32(y)
    dx, dy = x - np.float32(column), y - np.float32(row)
    u, v, one = np.uint64(row), np.uint64(column), np.uint64(1)
    a, b = np.float32(image[u, v]), np.float32(image[u, v + one])
    c, d = np.float32(image[u + one, v]), np.float32(image[u + one, v + one])
    a += dx * (b - a)
    c += dx * (d - c)
    return a + dy * (c - a)


@numba.njit(error_model="numpy", fastmath={"contract"})
def _sample_flat(image, pixels, pitch, x, y):
    """Return a bilinear sample by 32-bit indices into a flat image."""
    column, row = np.int32(x), np.int32(y)
    dx, dy = x - np.float32(column), y - np.float32(row)
    one, at = np.uint32(1), np.uint32(row) * pitch + np.uint32(column)
    a, b = np.float32(pixels[at]), np.float32(pixels[at + one])
    c, d = np.float32(pixels[at + pitch]), np.float32(pixels[at + pitch + one])
    a += dx * (b - a)
    c += dx * (d - c)
    return a + dy * (c - a)


def _compiled(sample: Any) -> Any:
    """Return a Numba function ``(image, rulers, taps, numbers, edges, status)`` that fills the edges (4, n)."""

    @numba.njit(parallel=True, error_model="numpy", fastmath={"contract"})
    def measure(image, rulers, taps, numbers, edges, status):
        pixels, pitch = image.reshape(-1), np.uint32(image.shape[1])
        half, one = np.float32(0.5), np.float32(1.0)
        least, smoothing, noise = numbers[0], numbers[1], numbers[2]
        first, second, third = taps[0], taps[1], taps[2]
        for r in numba.prange(rulers.shape[0]):
            profile, slopes = np.zeros(LENGTH, np.float32), np.zeros(LENGTH, np.float32)
            cosine, sine = rulers[r, 2], rulers[r, 3]
            middle = half * np.float32(LENGTH - 1)
            first_x = rulers[r, 0] - middle * cosine + half * np.float32(WIDTH - 1) * sine
            first_y = rulers[r, 1] - middle * sine - half * np.float32(WIDTH - 1) * cosine
            for i in range(LENGTH):
                along_x, along_y = first_x + np.float32(i) * cosine, first_y + np.float32(i) * sine
                total = np.float32(0.0)
                for line in range(WIDTH):
                    x, y = along_x - np.float32(line) * sine, along_y + np.float32(line) * cosine
                    total += sample(image, pixels, pitch, x, y)
                profile[i] = total
            for i in range(3, LENGTH - 3):
                slopes[i] = (
                    first * (profile[i + 1] - profile[i - 1])
                    + second * (profile[i + 2] - profile[i - 2])
                    + third * (profile[i + 3] - profile[i - 3])
                )
            best, at_best = np.float32(0.0), 4
            for i in range(4, LENGTH - 4):
                strength = abs(slopes[i])
                if strength > best:
                    best, at_best = strength, i
            found = best >= least
            sign = np.float32(np.sign(slopes[at_best]))
            before = np.log(max(sign * slopes[at_best - 1] / best, np.float32(1e-6)))
            after = np.log(max(sign * slopes[at_best + 1] / best, np.float32(1e-6)))
            variance, tilt = -one / (before + after), half * (after - before)
            shift = tilt * variance
            nan = np.float32(np.nan)
            edges[0, r] = np.float32(at_best) + shift - middle if found else nan
            height = sign * best * np.exp(half * tilt * shift) * np.sqrt(np.float32(2.0 * np.pi) * variance)
            edges[1, r] = height / np.float32(WIDTH) if found else nan
            edges[2, r] = np.sqrt(max(variance - smoothing, np.float32(0.0))) if found else nan
            edges[3, r] = noise * variance / best if found else nan
            status[r] = np.uint8(not found)

    return measure


def _gradient_matrix(dtype: Any) -> NDArray[Any]:
    """Return the matrix that maps samples (LENGTH,) to gradients; BLAS multiplies it."""
    matrix = np.zeros((LENGTH, LENGTH - 2 * _REACH))
    for k, tap in enumerate(_TAPS, 1):
        for i in range(matrix.shape[1]):
            matrix[i + _REACH + k, i] += tap
            matrix[i + _REACH - k, i] -= tap
    return matrix.astype(dtype)


def _places(rulers: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return columns and rows of all samples, (n, WIDTH, LENGTH)."""
    along = np.arange(LENGTH, dtype=rulers.dtype) - (LENGTH - 1) / 2
    across = np.arange(WIDTH, dtype=rulers.dtype)[:, None] - (WIDTH - 1) / 2
    x, y, cosine, sine = (each[:, None, None] for each in rulers.T)
    return x + (along * cosine - across * sine), y + (along * sine + across * cosine)


def _refined(profiles: NDArray[Any], matrix: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return position, amplitude, width, deviation and status of profiles (n, LENGTH)."""
    slopes = profiles @ matrix
    at = np.argmax(np.abs(slopes[:, 1:-1]), axis=1) + 1
    each = np.arange(len(at))
    peak = slopes[each, at]
    before = np.log(np.maximum(slopes[each, at - 1] / peak, 1e-6))
    after = np.log(np.maximum(slopes[each, at + 1] / peak, 1e-6))
    variance, tilt = -1.0 / (before + after), 0.5 * (after - before)
    shift = tilt * variance
    position = at + shift + (_REACH - (LENGTH - 1) / 2)
    amplitude = peak * np.exp(0.5 * tilt * shift) * np.sqrt(2.0 * np.pi * variance)
    width = np.sqrt(np.maximum(variance - _VARIANCE, 0.0))
    return position, amplitude, width, variance / np.abs(peak), np.abs(peak) < _LEAST


def _numpy(image: NDArray[Any], rulers: NDArray[Any], matrix: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    x, y = _places(rulers)
    column, row = x.astype(np.int32), y.astype(np.int32)
    dx, dy, at, pixels = x - column, y - row, row * COLUMNS + column, image.ravel()
    a, c = pixels[at].astype(rulers.dtype), pixels[at + COLUMNS].astype(rulers.dtype)
    a += dx * (pixels[at + 1] - a)
    c += dx * (pixels[at + COLUMNS + 1] - c)
    return _refined((a + dy * (c - a)).mean(axis=1), matrix)


def _opencv(image: NDArray[Any], rulers: NDArray[Any], matrix: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Measure the rulers in blocks that do not exceed the rows of remap."""
    parts, max_rulers = [], _OPENCV_ROWS // WIDTH
    for first in range(0, len(rulers), max_rulers):
        x, y = (each.reshape(-1, LENGTH) for each in _places(rulers[first : first + max_rulers]))
        samples = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(-1, WIDTH, LENGTH)
        parts.append(samples.sum(axis=1, dtype=np.uint16).astype(np.float32))
    return _refined((parts[0] if len(parts) == 1 else np.concatenate(parts)) * np.float32(1.0 / WIDTH), matrix)


def _corrected(rulers: NDArray[np.float64], position: NDArray[Any], width: NDArray[Any]) -> NDArray[Any]:
    """Return positions corrected for the bias of linear interpolation, the formula of ``ruler_pull``, in float64."""
    blur = np.maximum(width**2, 0.05 * _VARIANCE)
    variance, common, moved = _VARIANCE + blur, _VARIANCE * blur / (_VARIANCE + blur), np.zeros_like(position)
    x, y, cosine, sine = rulers.T
    lines = np.arange(WIDTH)[:, None] - 0.5 * (WIDTH - 1)
    for centre, along, across in ((x, cosine, -sine), (y, sine, cosine)):
        for k in (1, 2):
            nearest = np.round(k * along)
            square = (2.0 * np.pi * (k * along - nearest)) ** 2
            phase = k * (centre + along * position) - nearest * (position + 0.5 * (LENGTH - 1))
            attenuation = np.mean(np.cos(2.0 * np.pi * k * across * lines), axis=0) * np.exp(-0.5 * square * common)
            even = 2.0 * np.pi * (k * along - nearest) * (1.0 + (square * common - 3.0) * common / _VARIANCE)
            odd = (3.0 + square * (variance - 6.0 * common) + (square * common) ** 2) * along / (np.pi * k * variance)
            moved += attenuation * np.sin(2.0 * np.pi * phase) * along**2 * (even + odd) / (2.0 * (np.pi * k) ** 2)
    return np.asarray(position - moved)


def scene(count: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return a noisy disc, and rulers across its border at any angle."""
    rng = np.random.default_rng(7)
    row, column = np.mgrid[:ROWS, :COLUMNS]
    distance = RADIUS - np.hypot(column - COLUMNS / 2, row - ROWS / 2)
    image = 100.0 + 50.0 * np.tanh(distance / 1.5) + rng.normal(0.0, 2.0, (ROWS, COLUMNS))
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), RADIUS + rng.uniform(-10.0, 10.0, count)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rulers = np.concatenate([[COLUMNS / 2, ROWS / 2] + radius[:, None] * direction, direction], axis=1)
    return np.rint(image).astype(np.uint8), rulers.astype(np.float32)


def cases(device: Device) -> Iterator[Case]:
    """Yield 16, 100, 1000 and 10 000 rulers."""
    plain, flat = _compiled(_sample), _compiled(_sample_flat)
    for count in (16, 100, 1000, 10_000):
        yield _case(device, count, str(count), plain)
        yield _case(device, count, f"{count}/flat", flat, alone=True)


def _case(device: Device, count: int, name: str, compiled: Any, *, alone: bool = False) -> Case:
    image, rulers = scene(count)
    operation = RulerEdges(threshold=THRESHOLD, length=LENGTH, width=WIDTH, smoothing_px=SMOOTHING, count=count)
    # A few rulers are measured faster than a worker thread starts.
    queue = device.new_queue(inline=True) if count <= _FEW else None
    bound = operation.bind(device, image.shape, image.dtype, queue=queue)
    bound.inputs[0].set(image)
    bound.inputs[1].set(rulers)
    bound.run()
    taps, matrix = _TAPS.astype(np.float32), _gradient_matrix(np.float32)
    numbers = np.array([_LEAST * WIDTH, _VARIANCE, 1.0], np.float32)
    edges, status = np.empty((4, count), np.float32), np.empty(count, np.uint8)
    plain, _, widths, _, dark = _numpy(image, rulers.astype(np.float64), _gradient_matrix(np.float64))
    exact = _corrected(rulers.astype(np.float64), plain, widths)
    if np.any(to_numpy(bound.outputs.status)) or np.any(dark):
        raise AssertionError("a ruler across an edge found no edge")
    compiled(image, rulers, taps, numbers, edges, status)
    metadata = {"peer_error": float(np.max(np.abs(edges[0] - plain))), "rulers": count}
    peers: dict[str, Callable[[], object]] = {
        "numba": lambda: compiled(image, rulers, taps, numbers, edges, status),
    }
    if not alone:
        peers["opencv"] = lambda: _opencv(image, rulers, matrix)
        peers["numpy"] = lambda: _numpy(image, rulers, matrix)
    error = float(np.max(np.abs(to_numpy(bound.outputs.position) - exact)))
    return Case("ruler", name, bound.run, peers, error, metadata=metadata)
