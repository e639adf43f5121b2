"""Calipers (rulers) against Numba on all cores, OpenCV's remap of all rulers in one call, and NumPy.

The rulers have 64 samples, 5 lines and a smoothing of 1 px; each crosses the border of a disc once, at any angle, in an
8-bit frame of 640 x 480. All candidates return position, amplitude, width, predicted standard deviation and status of
the strongest edge. We correct the position for the bias of linear interpolation; the peers do not. We measure 16 rulers
in an inline queue, which runs in the thread of the caller. The Numba peers are in `gpuvision.profiling.ruler_peers`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling import ruler_peers
from gpuvision.profiling.harness import Case, Peer, traffic_of
from gpuvision.profiling.ruler_peers import LENGTH, REACH, WIDTH

ROWS, COLUMNS, RADIUS = 480, 640, 150.0
SMOOTHING, THRESHOLD = 1.0, 20.0
_FEW = 16  # largest number of rulers that are measured in an inline queue
_OPENCV_ROWS = 32767  # largest number of rows of an image from remap
_TAPS = np.arange(1, REACH + 1) * np.exp(-0.5 * np.arange(1, REACH + 1) ** 2)
_TAPS /= 2.0 * np.sum(_TAPS * np.arange(1, REACH + 1))
_VARIANCE = float(np.sum(2.0 * _TAPS * np.arange(1, REACH + 1) ** 3)) / 3.0
_LEAST = THRESHOLD / math.sqrt(2.0 * math.pi * _VARIANCE)


def _gradient_matrix(dtype: Any) -> NDArray[Any]:
    """Return the matrix that maps samples (LENGTH,) to gradients; BLAS multiplies it."""
    matrix = np.zeros((LENGTH, LENGTH - 2 * REACH))
    for k, tap in enumerate(_TAPS, 1):
        for i in range(matrix.shape[1]):
            matrix[i + REACH + k, i] += tap
            matrix[i + REACH - k, i] -= tap
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
    position = at + shift + (REACH - (LENGTH - 1) / 2)
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


# Operations in kernels/ruler. Of a sample: place 2, bilinear interpolation 9, sum over the lines 1. Of a tap of a
# gradient: difference, product, sum. Of an edge: parabola through the logarithms 12, amplitude 6, width 4, sigma 6,
# place 14. Of the bias of the interpolation along an axis: variances and end 8; of each of the 2 harmonics 42, and 15
# for each pair of lines.
_SAMPLE, _TAP, _EDGE, _BIAS, _HARMONIC, _PAIR_OF_LINES = 12, 3, 42, 8, 42, 15


def ruler_flops(length: int, width: int, taps: int) -> int:
    """Return the operations of an edge measurement along a ruler, with `taps` on each side of a gradient."""
    bias = 2 * (_BIAS + 2 * (_HARMONIC + _PAIR_OF_LINES * (width // 2)))
    return _SAMPLE * length * width + _TAP * taps * (length - 2 * taps) + _EDGE + bias


def frame_bytes(image: NDArray[Any], samples: int) -> int:
    """Return the least number of bytes of a frame that samples read: a pixel for each sample, or the whole frame."""
    return min(image.nbytes, samples * image.itemsize)


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
    for count in (16, 100, 1000, 10_000):
        yield _case(device, count)


def numba_calls(
    image: NDArray[np.uint8], rulers: NDArray[np.float32]
) -> Iterator[tuple[str, str, Callable[[], object], NDArray[Any], NDArray[Any]]]:
    """Yield the Numba peers: names of peer and form, the call, and the edges (4, n) and status (n,) that it fills."""
    frame, taps = ruler_peers.Frame.of(image), _TAPS.astype(np.float32)
    numbers = np.array([_LEAST * WIDTH, _VARIANCE, 1.0], np.float32)
    forms = [("numba", name, form) for name, form in ruler_peers.expert_forms(len(rulers)).items()]
    for peer, name, form in [*forms, ("numba-plain", "", ruler_peers.plain_form())]:
        edges, status = np.empty((4, len(rulers)), np.float32), np.empty(len(rulers), np.uint8)
        call = functools.partial(form, *frame, rulers, taps, numbers, edges, status)
        yield peer, name, call, edges, status


def _case(device: Device, count: int) -> Case:
    image, rulers = scene(count)
    operation = RulerEdges(threshold=THRESHOLD, length=LENGTH, width=WIDTH, smoothing_px=SMOOTHING, count=count)
    # A few rulers are measured faster than a worker thread starts.
    queue = device.new_queue(inline=True) if count <= _FEW else None
    bound = operation.bind(device, image.shape, image.dtype, queue=queue)
    bound.inputs[0].set(image)
    bound.inputs[1].set(rulers)
    bound.run()
    matrix = _gradient_matrix(np.float32)
    exact = _numpy(image, rulers.astype(np.float64), _gradient_matrix(np.float64))
    if np.any(to_numpy(bound.outputs.status)) or np.any(exact[4]):
        raise AssertionError("a ruler across an edge found no edge")
    numba: dict[str, Callable[[], object]] = {}
    peers: dict[str, Peer] = {"numba": numba}
    peer_error = 0.0
    for peer, name, call, edges, status in numba_calls(image, rulers):
        call()
        check_peer(f"{peer} {name}", edges, status, exact)
        peer_error = max(peer_error, float(np.max(np.abs(edges[0] - exact[0]))))
        if name:
            numba[name] = call
        else:
            peers[peer] = call
    peers["opencv"] = lambda: _opencv(image, rulers, matrix)
    peers["numpy"] = lambda: _numpy(image, rulers, matrix)
    position = _corrected(rulers.astype(np.float64), exact[0], exact[2])
    error = float(np.max(np.abs(to_numpy(bound.outputs.position) - position)))
    metadata = {"peer_error": peer_error, "rulers": count}
    traffic = (frame_bytes(image, count * LENGTH * WIDTH) + rulers.nbytes, traffic_of(bound)[1])
    flops = count * ruler_flops(LENGTH, WIDTH, REACH)
    return Case("ruler", str(count), bound.run, peers, error, traffic, metadata=metadata, flops=flops, copied=False)


def check_peer(name: str, edges: NDArray[Any], status: NDArray[Any], exact: tuple[NDArray[Any], ...]) -> None:
    """Raise an AssertionError if edges differ from those in double precision by more than rounding."""
    bounds = (5e-4, 1e-2, 5e-4, 1e-5)  # px, grey levels, px, px: some 10 times the differences of the forms
    scales = (1.0, 1.0, 1.0, float(WIDTH))  # the noise of Numba is that of the sum over the lines
    differences = [np.max(np.abs(k * a - b)) for k, a, b in zip(scales, edges, exact[:4], strict=True)]
    is_close = [difference <= bound for difference, bound in zip(differences, bounds, strict=True)]
    if np.any(status) or not all(is_close):
        raise AssertionError(f"the edges of the peer {name} differ from those in double precision")
