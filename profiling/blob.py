"""Blob measurement compared with fused Numba functions of the same method, and with OpenCV blob by blob.

The 8-bit frame shows bright discs with a radius of 8 px, a blur of 1 px, a contrast of 100 and noise of 2 grey levels,
each up to 2 px from its nominal position. Numba uses the same rulers, start, robust fit, match of the pixels, centre of
gravity and covariance on all cores. OpenCV crops each blob, applies Otsu's threshold, and computes the moments of the
grey levels above it, the most accurate of its fast methods; it returns only the centre. The metadata also list the
deviation of `findContours` with `fitEllipse`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.profiling import blob_peers
from gpuvision.profiling.blob_lanes import find_in_lanes
from gpuvision.profiling.blob_peers import LENGTH, REACH, SEARCH, SPOKES, TRIPLES, UNKNOWNS
from gpuvision.profiling.harness import Case, Peer, traffic_of
from gpuvision.profiling.pose import add_flops, factor_flops, solve_flops
from gpuvision.profiling.ruler import frame_bytes, ruler_flops
from gpuvision.profiling.ruler_peers import Frame

CELL, RADIUS, BLUR, CONTRAST, NOISE, OFF = 40, 8.0, 1.0, 100.0, 2.0, 2.0
_DIFFERENCE = 0.01  # px: difference of a centre by a match that takes a step more or less
THRESHOLD = 20.0
_F = np.float32


def _cut(image: NDArray[Any], place: NDArray[Any]) -> tuple[NDArray[Any], int, int]:
    half = int(RADIUS + SEARCH + 3.0)
    column, row = int(place[0] + 0.5), int(place[1] + 0.5)
    return image[row - half : row + half + 1, column - half : column + half + 1], column - half, row - half


def _moments(image: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """Return centres from the moments of the grey levels above 0.7 of Otsu's threshold."""
    centres = np.empty((len(places), 2))
    for k, place in enumerate(places):
        part, left, top = _cut(image, place)
        level, _ = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        moments = cv2.moments(cv2.addWeighted(part, 1.0, part, 0.0, -0.7 * level))
        centres[k] = left + moments["m10"] / moments["m00"], top + moments["m01"] / moments["m00"]
    return centres


def _ellipses(image: NDArray[Any], places: NDArray[Any]) -> NDArray[Any]:
    """Return centres from ellipses fitted to the contours of the pixels above Otsu's threshold."""
    centres = np.empty((len(places), 2))
    for k, place in enumerate(places):
        part, left, top = _cut(image, place)
        _, mask = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        (x, y), *_ = cv2.fitEllipse(max(contours, key=len))
        centres[k] = left + x, top + y
    return centres


def scene(count: int) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """Return a frame of discs, their nominal positions and radii (count, 3), and their true positions (count, 2)."""
    rng = np.random.default_rng(5)
    across = math.ceil(math.sqrt(count))
    image = np.full((across * CELL, across * CELL), 50.0)
    row, column = np.mgrid[:CELL, :CELL]
    true = np.empty((count, 2))
    for k in range(count):
        top, left = k // across * CELL, k % across * CELL
        x, y = CELL / 2 + rng.uniform(-0.5, 0.5, 2)
        true[k] = left + x, top + y
        distance = (RADIUS - np.hypot(column - x, row - y)) / BLUR
        density = np.exp(-0.5 * distance**2) / math.sqrt(2.0 * math.pi)
        level = 0.5 + 0.5 * np.vectorize(math.erf)(distance / math.sqrt(2.0)) - 0.5 * BLUR / RADIUS * density
        image[top : top + CELL, left : left + CELL] += CONTRAST * level
    image += rng.normal(0.0, NOISE, image.shape)
    nominal = np.column_stack([true + rng.uniform(-1.4, 1.4, true.shape), np.full(count, RADIUS)])
    return np.rint(image).astype(np.uint8), nominal.astype(np.float32), true


# Operations in kernels/blob of a disc. Of a start circle: three edges 36 in each of 3 steps, solution 54; its loss 14
# for each edge. Of an edge in a fit: residual and derivatives 17, weight 6, sums 3. Of a pixel in the match: place 7,
# blurred disc 38, equation 8, weight 5, its squares 4; of the centre of gravity 14.
_START, _LOSS, _FIT_EDGE, _MATCH_PIXEL, _GRAVITY_PIXEL = 3 * 90, 14, 26, 62, 14
_FIT_STEPS = 4  # from twice the reach: two to the least scale, two at the estimated scale


def blob_flops() -> float:
    """Return the operations of a disc with one placement of its rulers and one step of the match: the least number."""
    starts = TRIPLES * (_START + _LOSS * SPOKES)
    fit = _FIT_STEPS * (SPOKES * (_FIT_EDGE + add_flops(3)) + factor_flops(3) + solve_flops(3))
    matched, weighed = (math.pi * (RADIUS + more) ** 2 for more in (5.0 * BLUR + 2.0, 2.5 * BLUR + 3.0))
    match = matched * (_MATCH_PIXEL + add_flops(UNKNOWNS)) + factor_flops(UNKNOWNS) + 4 * solve_flops(UNKNOWNS)
    return SPOKES * ruler_flops(LENGTH, 1, REACH) + starts + fit + match + weighed * _GRAVITY_PIXEL


def cases(device: Device) -> Iterator[Case]:
    """Yield 16, 100 and 1000 blobs."""
    for count in (16, 100, 1000):
        yield _case(device, count)


def _case(device: Device, count: int) -> Case:
    image, places, true = scene(count)
    operation = FindBlobs(threshold=THRESHOLD, search_px=SEARCH, spokes=SPOKES, noise=NOISE, count=count)
    bound = operation.bind(device, image.shape, image.dtype)
    bound.inputs[0].set(image)
    bound.inputs[1].set(places)
    blobs = bound.run()
    if np.any(to_numpy(blobs.status)):
        raise AssertionError("a blob was not found")
    table = np.asarray(operation.launch(device, image.shape, image.dtype).arguments[0])
    numbers = np.concatenate([table[[0, 3, 2]], table[-REACH:]]).astype(np.float32)
    angle = np.arange(SPOKES) * 2.0 * math.pi / SPOKES
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    found, covariance = np.empty((count, 13), np.float32), np.empty((count, 3, 3), np.float32)
    status, noise = np.empty(count, np.uint8), _F(math.hypot(NOISE, math.sqrt(1.0 / 12.0)))

    given = (places, numbers, directions, noise, found, covariance, status)
    pairs = Frame.of(image).pairs
    calls = {name: functools.partial(form, image, *given) for name, form in _FORMS.items()}
    calls |= {name: functools.partial(form, image, pairs, *given) for name, form in _WINDOW_FORMS.items()}
    for call in calls.values():
        found[...], status[...] = np.nan, 255
        call()
        _check_peer(blobs, found, status)
    ours = np.stack([to_numpy(blobs.x), to_numpy(blobs.y)], axis=-1)
    metadata = {
        "blobs": count,
        "deviation_px": _deviation(ours, true),
        "numba_deviation_px": _deviation(found[:, :2], true),
        "opencv_deviation_px": _deviation(_moments(image, places), true),
        "ellipse_deviation_px": _deviation(_ellipses(image, places), true),
    }
    peers: dict[str, Peer] = {
        "numba": calls,
        "opencv": lambda: _moments(image, places),
    }
    error = float(np.max(np.abs(ours - true)))
    taken = frame_bytes(image, math.ceil(count * math.pi * (RADIUS + 5.0 * BLUR + 2.0) ** 2))
    traffic = (taken + places.nbytes, traffic_of(bound)[1])
    flops = count * blob_flops()
    return Case("blob", str(count), bound.run, peers, error, traffic, metadata=metadata, flops=flops, copied=False)


# Forms of the Numba peer, on all cores or on one: how the first circle is found; and the form with windows of pixels.
_find_triples = blob_peers.find_form(blob_peers.start, True)
_find_lanes = blob_peers.find_form(blob_peers.start_in_lanes, True)
_find_lanes_serial = blob_peers.find_form(blob_peers.start_in_lanes, False)
_find_windows, _find_windows_serial = find_in_lanes(True), find_in_lanes(False)
_FORMS = {"triples": _find_triples, "lanes": _find_lanes, "lanes-serial": _find_lanes_serial}
_WINDOW_FORMS = {"windows": _find_windows, "windows-serial": _find_windows_serial}


def _check_peer(blobs: Any, found: NDArray[Any], status: NDArray[Any]) -> None:
    """Raise an AssertionError if a peer has other results than our measurement.

    A rounding error can take an edge into a fit or out of it: one centre of a hundred may differ by more.
    """
    np.testing.assert_array_equal(status, to_numpy(blobs.status))
    centres = np.stack([to_numpy(blobs.x), to_numpy(blobs.y)], axis=-1)
    if np.mean(np.abs(found[:, :2] - centres).max(axis=1) <= _DIFFERENCE) < 0.99:
        raise AssertionError("a peer measured other centres of blobs")


def _deviation(found: NDArray[Any], true: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean((found - true) ** 2)))
