"""Line readout compared with Numba (forms of `line_peers`) and with NumPy: position, total and status.

The frames have 512 rows, 1024 columns and 8 bits; the line moves over half the height of the frame. A single frame is
read in an inline queue, which runs in the thread of the caller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device, host_view, to_numpy
from gpuvision.profiling.harness import Case, Peer
from gpuvision.profiling.line_peers import expert_forms, plain_form
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import Method
from gpuvision.ranging.triangulation import Triangulation

ROWS, COLUMNS, THRESHOLD, SATURATION, WINDOW = 512, 1024, 25, 255, 8
GAIN = 0.1  # gain of the noise model of the likelihood
OUTPUTS = ("position", "total", "status")
_FIT_DIFFERENCE = 2e-4  # px: largest difference between two likelihood fits of a column
_DISTINCT = 8  # different frames in a batch
Frames = NDArray[np.uint8]


def _numpy_centroid(frames: Frames) -> tuple[NDArray[Any], ...]:
    light = np.maximum(frames, THRESHOLD) - np.uint8(THRESHOLD)
    total = light.sum(axis=1, dtype=np.uint32)
    moment = np.einsum("frc,r->fc", light, np.arange(frames.shape[1], dtype=np.uint32), dtype=np.uint32)
    with np.errstate(invalid="ignore"):
        return moment / total.astype(np.float32), total, (total == 0) | (frames.max(axis=1) >= SATURATION)


def _numpy_windowed(frames: Frames) -> tuple[NDArray[Any], ...]:
    at = frames.argmax(axis=1)
    around = np.arange(-WINDOW, WINDOW + 1)
    index = np.clip(at[:, None, :] + around[None, :, None], 0, frames.shape[1] - 1)
    in_window = np.take_along_axis(frames, index, axis=1)
    light = np.maximum(in_window, THRESHOLD).astype(np.float32) - np.float32(THRESHOLD)
    total = light.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return at + np.einsum("fkc,k->fc", light, around.astype(np.float32)) / total, total, total == 0


def _windows(frames: Frames, reach: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the rows of the peaks, and the samples around them: float64 (frames, 2 reach + 1, columns)."""
    at = frames.argmax(axis=1)
    index = np.clip(at[:, None, :] + np.arange(-reach, reach + 1)[None, :, None], 0, frames.shape[1] - 1)
    return at, np.take_along_axis(frames, index, axis=1).astype(np.float64)


def _numpy_gauss3(frames: Frames) -> Any:
    at, in_window = _windows(frames, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, c = np.moveaxis(np.log(np.maximum(in_window - THRESHOLD, 0.0)), 1, 0)
        return at + 0.5 * (a - c) / (a - 2.0 * b + c)


def _numpy_fir(frames: Frames) -> Any:
    at, in_window = _windows(frames, WINDOW + 2)
    balance = in_window[:, :-4] + in_window[:, 1:-3] - in_window[:, 3:-1] - in_window[:, 4:]
    before, after = balance[:, :-1], balance[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.arange(-WINDOW, WINDOW)[None, :, None] + before / (before - after)
    place = np.where((before < 0.0) & (after >= 0.0), place, np.inf)
    nearest = np.abs(place).argmin(axis=1, keepdims=True)
    return at + np.take_along_axis(place, nearest, axis=1)[:, 0]


def _numpy_ml(frames: Frames, steps: int = 12) -> Any:
    """Fit a pixel-integrated Gaussian on a background by Fisher scoring, for all columns at once."""
    at, in_window = _windows(frames, WINDOW)
    y = np.moveaxis(in_window, 1, 2)
    edge = np.arange(2 * WINDOW + 2) - WINDOW - 0.5
    background = (y[..., 0] + y[..., -1]) / 2.0
    amplitude = np.maximum(y.max(axis=-1) - background, 1.0)
    over = y - background[..., None]
    over = np.where(over > amplitude[..., None] / 4.0, over, 0.0)
    place = (over * np.arange(-WINDOW, WINDOW + 1)).sum(axis=-1) / over.sum(axis=-1)
    sigma = np.clip(over.sum(axis=-1) / (2.266 * amplitude), 0.3, WINDOW)
    for _ in range(steps):
        z = (edge - place[..., None]) / sigma[..., None]
        slope = np.exp(-0.5 * z * z)
        light = sigma[..., None] * math.sqrt(2.0 * math.pi) * np.diff(special.ndtr(z), axis=-1)
        by_sigma = light - sigma[..., None] * np.diff(z * slope, axis=-1)
        design = np.stack([-np.diff(slope, axis=-1), by_sigma, light, np.ones_like(light)], axis=-1)
        model = background[..., None] + amplitude[..., None] * light
        weight = np.where(y < SATURATION, amplitude[..., None] ** 2 / (1.0 + GAIN * np.maximum(model, 0.0)), 0.0)
        weighted = design * weight[..., None]
        normal = np.swapaxes(weighted, -1, -2) @ design + 1e-9 * np.eye(4)
        right = (weighted * ((y - model) / amplitude[..., None])[..., None]).sum(axis=-2)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        background = background + amplitude * step[..., 3]
        amplitude = amplitude * np.clip(1.0 + step[..., 2], 0.5, 2.0)
        place = place + np.clip(step[..., 0], -sigma, sigma)
        sigma = np.clip(sigma * np.exp(np.clip(step[..., 1], -0.5, 0.5)), 0.15, 2.0 * WINDOW)
    return at + place


_NUMPY_FITS = {"gauss3": _numpy_gauss3, "fir": _numpy_fir, "ml": _numpy_ml}


def line_frames(count: int) -> Frames:
    """Return frames with a Gaussian line (sigma 2 px) and noise of 3 grey levels; a few different frames repeat."""
    rng = np.random.default_rng(1)
    row, column = np.arange(ROWS)[:, None], np.arange(COLUMNS)
    distinct = np.empty((min(count, _DISTINCT), ROWS, COLUMNS), np.uint8)
    for f, frame in enumerate(distinct):
        place = ROWS * (0.5 + 0.25 * np.sin(6.0 * column / COLUMNS + f))
        light = 10.0 + 180.0 * np.exp(-((row - place) ** 2) / 8.0) + rng.normal(0.0, 3.0, frame.shape)
        frame[...] = np.clip(np.rint(light), 0, 255)
    return np.ascontiguousarray(np.resize(distinct, (count, ROWS, COLUMNS)))


def cases(device: Device) -> Iterator[Case]:
    """Yield both centroids on 1, 16 and 64 frames, the fits, readout along rows, and readout with triangulation.

    The triangulation corrects a lens ("fused"), or a calibrated camera with a tilted sensor: two radial coefficients
    ("camera"), or all 14 coefficients ("camera14"). The last cases also compute the standard deviation of the position
    ("sigma").
    """
    centres: tuple[Method, ...] = ("centroid", "windowed")
    fits: tuple[Method, ...] = ("gauss3", "fir", "ml")
    for method in centres:
        for count in (1, 16, 64):
            yield _case(device, LineReadout(method=method, **_SETTINGS), count, f"{_ROWS[method]}/{count}")
    for method in fits:
        yield _case(device, LineReadout(method=method, gain=GAIN, **_SETTINGS), 16, f"{method}/16")
    yield _case(device, LineReadout(method="windowed", along="rows", **_SETTINGS), 16, "windowed-rows/16")
    for method in centres:
        for count in (1, 16):
            yield _fused_case(device, method, count, "fused", {"lens": _LENS})
        yield _fused_case(device, method, 16, "camera", {"camera": _CAMERA})
        yield _fused_case(device, method, 16, "camera14", {"camera": _FULL_CAMERA})
    for method in (*centres, *fits):
        yield _sigma_case(device, method, 16)


# Case names in the results. "whole" (the whole profile) is older than the method name "centroid"; it stays, because
# stored results and their lowest accepted ratios refer to it.
_ROWS: Mapping[Method, str] = {"centroid": "whole", "windowed": "windowed"}
_SETTINGS: Mapping[str, Any] = {"threshold": THRESHOLD, "window": WINDOW, "outputs": OUTPUTS}


# Operations of a profile for each sample of it or of its window, and once. Centroid: light 1, sum 1, moment 2;
# quotient. Gaussian through three samples: light and logarithm 6, vertex 7. Filter of four taps: 3; crossing 3. The
# likelihood takes as many steps as its data need: no number is stated.
_SAMPLE_FLOPS: Mapping[Method, tuple[int, int]] = {
    "centroid": (4, 1), "windowed": (4, 2), "gauss3": (0, 13), "fir": (3, 3)
}  # fmt: skip


def profile_flops(method: Method) -> int | None:
    """Return the operations of a profile, on levels in integers or real numbers; None if they depend on the data."""
    if method not in _SAMPLE_FLOPS:
        return None
    each, once = _SAMPLE_FLOPS[method]
    return each * (ROWS if method == "centroid" else 2 * WINDOW + 1) + once


def _case(device: Device, readout: LineReadout, count: int, name: str) -> Case:
    frames = line_frames(count)
    if readout.along == "rows":
        frames = np.ascontiguousarray(np.swapaxes(frames, 1, 2))
    bound, frames = _bound(device, readout, frames)
    across = np.swapaxes(frames, 1, 2) if readout.along == "rows" else frames
    peers = _peers(readout, frames, across, bound.outputs)
    error = _error(bound.outputs, across, readout)
    traffic, flops = (frames.nbytes, 9 * count * COLUMNS), profile_flops(readout.method)
    total = None if flops is None else float(flops * count * COLUMNS)
    return Case("line", name, bound.run, peers, error, traffic, flops=total)


def _peers(readout: LineReadout, frames: Frames, across: Frames, ours: Any) -> dict[str, Peer]:
    """Return the peers of a readout; `across` holds the frames with the profiles in columns."""
    whole = {"centroid": _numpy_centroid, "windowed": _numpy_windowed} | _NUMPY_FITS
    results = tuple(np.empty((len(frames), COLUMNS), each) for each in (np.float32, np.uint32, np.uint8))
    fit = np.array([THRESHOLD, SATURATION, readout.read_noise**2, GAIN])
    levels = fit if readout.method == "ml" else fit[:2].astype(np.uint8)

    def call(form: Any, frames: Frames, levels: NDArray[Any]) -> Callable[[], object]:
        for each, unset in zip(results, (0.0, 0, 255), strict=True):
            each[...] = unset
        form(frames, levels, WINDOW, *results)
        _check_peer(readout, ours, results)
        return lambda: form(frames, levels, WINDOW, *results)

    forms = expert_forms(readout.method, readout.along, len(frames))
    return {
        "numpy": lambda: whole[readout.method](across),
        "numba": {name: call(form, frames, levels) for name, form in forms.items()},
        "numba-plain": call(plain_form(readout.method), across, fit),
    }


def _check_peer(readout: LineReadout, ours: Any, results: tuple[NDArray[Any], ...]) -> None:
    """Raise an AssertionError if a peer has other results than our readout."""
    position, total, status = (to_numpy(each) for each in (ours.position, ours.total, ours.status))
    limit = _FIT_DIFFERENCE if readout.method == "ml" else 1e-4
    np.testing.assert_allclose(results[0], position, rtol=0.0, atol=limit)
    np.testing.assert_array_equal(results[1], total)
    np.testing.assert_array_equal(results[2], status)


_LENS = Lens(k1=4e-8, k2=1e-14, centre=(COLUMNS / 2.0, ROWS / 2.0))
# Focal length of 1000 px, sensor tilted by 20 degrees; and all 14 coefficients.
_MATRIX = ((1000.0, 0.0, COLUMNS / 2.0), (0.0, 1000.0, ROWS / 2.0), (0.0, 0.0, 1.0))
_CAMERA = Camera(matrix=_MATRIX, distortion=(-0.1, 0.05, *(0.0,) * 10, math.radians(20.0), 0.0))
_FULL_CAMERA = Camera(
    matrix=_MATRIX,
    distortion=(-0.2, 0.12, 7e-4, -4e-4, 0.05, 0.06, -0.02, 0.01, 3e-4, -5e-4, -2e-4, 4e-4, 0.35, -0.12),
)


def _fused_case(device: Device, method: Method, count: int, name: str, distortion: Mapping[str, Any]) -> Case:
    """Return a case with undistortion and triangulation in the same pass; the peer is our readout without them.

    The case gives no traffic: the copy that measures the limit of the device evicts the caches for the function that
    is timed next, and not for the other one. The difference is a few percent.
    """
    sheet = Triangulation(
        homography=((1.1e-5, 2.0e-4, -0.1), (-2.2e-4, 1.0e-6, 0.06), (2.0e-4, 1.0e-5, 1.0)),
        region=((0.0, ROWS - 1.0), (0.0, COLUMNS - 1.0)),
        **distortion,
    )
    settings = {**_SETTINGS, "outputs": (*OUTPUTS, "g", "h")}
    alone, frames = _bound(device, LineReadout(method=method, **_SETTINGS), line_frames(count))
    fusing = LineReadout(method=method, triangulation=sheet, **settings)
    fused = fusing.bind(device, frames.shape, frames.dtype, queue=alone.queue)
    shared = alone.inputs[0]
    fused(shared).wait()
    expected = sheet(
        to_numpy(fused.outputs.position), np.tile(np.arange(COLUMNS, dtype=np.float32), (count, 1)), device=device
    )
    error = float(np.nanmax(np.abs(to_numpy(fused.outputs.h) - to_numpy(expected.h))))
    peers = {"gpuvision": lambda: alone.run(shared)}
    return Case("line", f"{_ROWS[method]}-{name}/{count}", lambda: fused.run(shared), peers, error)


def _sigma_case(device: Device, method: Method, count: int) -> Case:
    """Return a case with the standard deviation of the position; the peer is our readout without it."""
    settings: dict[str, Any] = {**_SETTINGS, "method": method, "gain": GAIN, "read_noise": 3.0}
    alone, frames = _bound(device, LineReadout(**settings), line_frames(count))
    with_sigma = {**settings, "outputs": (*OUTPUTS, "sigma")}
    predicting = LineReadout(**with_sigma).bind(device, frames.shape, frames.dtype, queue=alone.queue)
    shared = alone.inputs[0]
    predicting(shared).wait()
    expected = LineReadout(**with_sigma, precision="double")(frames[:_DISTINCT], device=device).sigma
    error = float(np.nanmax(np.abs(to_numpy(predicting.outputs.sigma)[:_DISTINCT] - np.asarray(expected))))
    peers = {"gpuvision": lambda: alone.run(shared)}
    return Case("line", f"{_ROWS.get(method, method)}-sigma/{count}", lambda: predicting.run(shared), peers, error)


def _bound(device: Device, readout: LineReadout, frames: Frames) -> tuple[Any, Frames]:
    """Return the bound readout with the frames in its input, and the frames in host memory for the peers."""
    queue = device.new_queue(inline=True) if len(frames) == 1 else None
    bound = readout.bind(device, frames.shape, frames.dtype, queue=queue)
    if device.shares_memory:
        host_view(bound.inputs[0])[...] = frames
        frames = host_view(bound.inputs[0])
    else:
        bound.inputs[0].set(frames)
    bound().wait()
    return bound, frames


def _error(reading: Any, frames: Frames, readout: LineReadout) -> float:
    """Return the largest deviation [px] from the same method in float64."""
    position, status = (each.get()[:_DISTINCT] for each in (reading.position, reading.status))
    frames = frames[:_DISTINCT]
    if readout.method in _NUMPY_FITS:
        truth = _NUMPY_FITS[readout.method](frames)
    else:
        light = np.maximum(frames.astype(np.float64) - THRESHOLD, 0.0)
        row = np.arange(frames.shape[1])[None, :, None]
        if readout.method == "windowed":
            light = light * (np.abs(row - frames.argmax(axis=1)[:, None, :]) <= WINDOW)
        truth = (light * row).sum(axis=1) / light.sum(axis=1)
    return float(np.max(np.abs(position - truth)[status == 0]))
