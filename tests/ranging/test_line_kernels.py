"""Each kernel of the line readout for centroids and windows: every output, with the standard deviation, in float64.

`test_line.py` compares the kernels with more frames; its fast tier takes some of them.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.reference.line import AMBIGUOUS, LOW_SIGNAL, OUT_OF_RANGE, read_lines

TOP = {"uint8": 180.0, "uint16": 40_000.0, "float32": 100.0}
LEVEL = {"uint8": 20, "uint16": 4000, "float32": 8.5}
WINDOW = 6
KERNELS = [
    ("centroid", "uint8", "columns", "vector"),
    ("centroid", "uint8", "columns", "work_item"),
    ("centroid", "uint8", "rows", "vector"),
    ("centroid", "uint16", "columns", "vector"),
    ("centroid", "uint16", "rows", "vector"),
    ("centroid", "float32", "columns", "vector"),
    ("centroid", "float32", "rows", "work_item"),
    ("windowed", "uint8", "columns", "work_item"),
    ("windowed", "uint8", "rows", "vector"),
    ("windowed", "uint16", "rows", "vector"),
    ("windowed", "float32", "columns", "vector"),
    ("windowed", "float32", "columns", "work_item"),
]


def profiles_of(rng: np.random.Generator, dtype: str, samples: int, length: int) -> NDArray[Any]:
    """Return profiles (samples, length): a line anywhere, a second one, dark ones, and light at each border."""
    k, place = np.arange(length), rng.uniform(-2.0, length + 2.0, samples)
    place[:12] = [0.0, 3.0, 5.4, 5.6, 6.4, 7.0, length - 1.0, length - 4.0, length - 6.6, length - 7.4, 20.0, 40.0]
    light = rng.uniform(0.3, 1.0, samples)
    light[12:15] = 0.0
    frames = light[:, None] * np.exp(-((k - place[:, None]) ** 2) / (2.0 * 1.7**2))
    second = (place + rng.uniform(8.0, length - 8.0, samples)) % length
    share = rng.choice([0.0, 0.3, 0.7], samples)
    frames += (share * light)[:, None] * np.exp(-((k - second[:, None]) ** 2) / (2.0 * 1.3**2))
    # Single bright samples, at all numbers of a vector; some samples are equal to the threshold.
    frames[np.arange(samples), rng.integers(0, length, samples)] += np.where(light > 0.0, 0.15, 0.0)
    profiles = TOP[dtype] * (frames + rng.uniform(0.0, 0.07, frames.shape))
    profiles[:, ::7] = np.where(profiles[:, ::7] < LEVEL[dtype], LEVEL[dtype], profiles[:, ::7])
    return np.minimum(profiles, np.iinfo(dtype).max if dtype != "float32" else np.inf).astype(dtype)


def sigmas(profiles: NDArray[Any], position: Any, method: str, threshold: float, noise: float, gain: float) -> Any:
    """Return the standard deviations by the noise of the samples above the threshold, to first order."""
    x = profiles.astype(np.float64)
    k = np.arange(x.shape[1])
    v = np.maximum(x - threshold, 0.0)
    if method == "windowed":
        # Of equally bright neighbours the middle one is the peak.
        peak = x.argmax(axis=1)
        equal = np.array(
            [np.flatnonzero(np.append(row[at:] != row[at], True))[0] for row, at in zip(x, peak, strict=True)]
        )
        peak += (equal - 1) // 2
        v = np.where(np.abs(k - peak[:, None]) <= WINDOW, v, 0.0)
    variance = np.where(v > 0.0, noise**2 + gain * x, 0.0) * (k - position[:, None]) ** 2
    return np.sqrt(variance.sum(axis=1)) / v.sum(axis=1)


@pytest.mark.parametrize("kernel", KERNELS, ids="-".join)
def test_every_output(device: Device, kernel: tuple[Any, str, Any, Any], rng: np.random.Generator) -> None:
    """Profiles of many blocks and a rest, more of them than a vector and no multiple of it, in two frames."""
    method, dtype, along, variant = kernel
    samples, length = (41, 1431) if along == "rows" else (75, 143)
    profiles = np.stack([profiles_of(rng, dtype, samples, length) for _ in range(2)])
    frames = profiles if along == "rows" else np.ascontiguousarray(np.swapaxes(profiles, 1, 2))
    noise, gain = 0.02 * TOP[dtype], 0.001 * TOP[dtype]
    parameters: dict[str, Any] = {"method": method, "along": along, "threshold": LEVEL[dtype], "window": WINDOW}
    parameters |= {"ambiguity": 0.5} if method == "windowed" else {}
    parameters |= {"saturation": round(0.9 * TOP[dtype])}
    expected = read_lines(frames, **parameters)
    for flag in (0, LOW_SIGNAL, OUT_OF_RANGE, *([AMBIGUOUS] if method == "windowed" else [])):
        assert np.any(expected["status"] == flag)
    outputs = ("position", "peak", "width", "total", "status", "sigma")
    readout = LineReadout(variant=variant, read_noise=noise, gain=gain, outputs=outputs, **parameters)
    reading = readout(frames, device=device)
    for name in ("status", "peak", "width"):
        np.testing.assert_array_equal(getattr(reading, name), expected[name], err_msg=name)
    eps = np.finfo(np.float32).eps
    # Light far from the line weighs by its distance.
    np.testing.assert_allclose(reading.position, expected["position"], rtol=4 * eps, atol=200 * eps)
    np.testing.assert_allclose(reading.total, expected["total"], rtol=20 * eps)
    quantised = np.hypot(noise, np.sqrt(1.0 / 12.0)) if dtype != "float32" else noise
    for found, rows, positions in zip(reading.sigma, profiles, expected["position"], strict=True):
        exact = sigmas(rows, positions, method, LEVEL[dtype], quantised, gain)
        np.testing.assert_allclose(found, exact, rtol=3e-4)


@pytest.mark.vectors
@pytest.mark.parametrize("method", ["centroid", "windowed"])
def test_prefetching_changes_no_result(device: Device, method: Any, rng: np.random.Generator) -> None:
    """On a device with small caches the kernel prefetches the frames: strips of 1024 columns, the last block a part."""
    profiles = np.stack([profiles_of(rng, "uint8", 1024, 75) for _ in range(2 * device.compute_units)])
    frames = np.ascontiguousarray(np.swapaxes(profiles, 1, 2))
    readout = LineReadout(method=method, threshold=LEVEL["uint8"], window=WINDOW, variant="vector")
    small = copy.copy(device)
    small.cache_bytes = frames.nbytes
    builds = [readout.launch(each, frames.shape, frames.dtype).defines for each in (device, small)]
    assert ["PREFETCH" in build for build in builds] == [False, True]
    plain, prefetched = readout(frames, device=device), readout(frames, device=small)
    for name in ("position", "peak", "width", "total", "status"):
        np.testing.assert_array_equal(getattr(prefetched, name), getattr(plain, name), err_msg=name)
    assert np.any(plain.status == 0)
