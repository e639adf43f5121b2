"""Step 5: device times of operations at three sizes, against a copy kernel with their traffic, and other libraries."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device
from gpuvision.host.launch import nbytes_of
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling import ceiling
from gpuvision.profiling.gpu_run import peers
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation

_HOMOGRAPHY = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 1e-5, 1.0))
_REGION = ((0.0, 511.0), (0.0, 1023.0))
_DISTORTION = (-0.1, 0.02, 1e-4, -2e-4, -1e-3)
_LEAST = 1e-7  # shortest credible launch [s]: an empty kernel takes about 1 us on a GPU
_CALLS = 21  # timed launches, of which the median counts
_FEWEST_CALLS, _SLOW_SECONDS = 3, 5.0  # timed launches of slow kernels, and the time after which no more are started
_GROWTH = 4.0  # time of the next measurement over the longest one before (chosen): sizes grow 4 to 100 times
_FRAME = (480, 640)


class Sample(NamedTuple):
    """Operation at one size, and a function that makes its inputs."""

    name: str
    size: str
    operation: Any
    make_inputs: Callable[[], tuple[Any, ...]]


def run(device: Device, seconds: float) -> dict[str, Any]:
    """Return the rows of all operations and sizes; leave out what may not end within `seconds`."""
    rows: list[dict[str, Any]] = []
    end = time.monotonic() + seconds
    skipped, longest = 0, 0.0
    for sample in samples():
        begun = time.monotonic()
        if begun + _GROWTH * longest > end:
            skipped += 1
            continue
        try:
            rows.append(measure(device, sample))
        except Exception as error:  # the other operations are measured all the same
            failure = " ".join(str(error).split())[:600]
            rows.append(
                {"operation": sample.name, "size": sample.size, "failure": f"{type(error).__name__}: {failure}"}
            )
        longest = max(longest, time.monotonic() - begun)
    return {"not_reached": skipped, "rows": rows}


def samples() -> Iterator[Sample]:
    """Yield the operations, each at three sizes."""
    for count in (10**5, 10**6, 10**7):
        size = f"{count:.0e}"
        yield Sample("psd", size, PsdReadout(strip_length=6e-3), functools.partial(_pairs, count))
        triangulation = Triangulation(homography=_HOMOGRAPHY, region=_REGION)
        yield Sample("triangulation", size, triangulation, functools.partial(_positions, count))
        yield Sample("points", size, UndistortPoints(model=camera(1024, 512)), functools.partial(_points, count))
    for count in (4, 16, 64):
        line = LineReadout(method="centroid", threshold=20)
        yield Sample("line", f"{count} frames", line, functools.partial(_pixels, count, 512, 1024))
    for rows in (1024, 2048, 4096):
        undistort = UndistortImage(model=camera(rows, rows))
        yield Sample("undistort", f"{rows} px", undistort, functools.partial(_pixels, rows, rows))
        moved = RangeImage(geometry=StraightTransport(step=1e-4))
        yield Sample("range_image", f"{rows} profiles", moved, functools.partial(_profiles, rows))
    for count in (100, 10_000, 1_000_000):
        rulers = functools.partial(_rulers, count)
        yield Sample("ruler", f"{count:.0e}", RulerEdges(threshold=12.0, count=count), rulers)


def _uniform(low: float, high: float, *shape: int) -> Any:
    return np.random.default_rng(1).uniform(low, high, shape).astype(np.float32)


def _pairs(count: int) -> tuple[Any, ...]:
    return (_uniform(0.1, 1.0, count, 2),)


def _positions(count: int) -> tuple[Any, ...]:
    return tuple(_uniform(*bounds, count) for bounds in _REGION)


def _points(count: int) -> tuple[Any, ...]:
    return (_uniform(0.0, 511.0, count, 2),)


def _pixels(*shape: int) -> tuple[Any, ...]:
    return (np.random.default_rng(1).integers(0, 255, shape, np.uint8),)


def _profiles(rows: int) -> tuple[Any, ...]:
    g, h = _uniform(-0.05, 0.05, rows, 1024), _uniform(0.0, 0.05, rows, 1024)
    return g, h, np.arange(rows, dtype=np.float32), np.zeros((rows, 1024), np.uint8)


def camera(columns: int, rows: int) -> Camera:
    """Return a camera with five distortion coefficients."""
    focal = 1.2 * columns
    matrix = ((focal, 0.0, 0.5 * (columns - 1)), (0.0, focal, 0.5 * (rows - 1)), (0.0, 0.0, 1.0))
    return Camera(matrix=matrix, distortion=(*_DISTORTION, *(0.0,) * 9))


def _rulers(count: int) -> tuple[Any, ...]:
    """Return a frame with a bright disc, and rulers across its border at evenly distributed angles."""
    row, column = np.mgrid[: _FRAME[0], : _FRAME[1]]
    disc = np.where(np.hypot(column - 320.0, row - 240.0) < 150.0, 200, 30).astype(np.uint8)
    angle = 2.0 * np.pi * np.arange(count) / count
    cosine, sine = np.cos(angle), np.sin(angle)
    rulers = np.stack([320.0 + 150.0 * cosine, 240.0 + 150.0 * sine, cosine, sine], 1)
    return disc, rulers.astype(np.float32)


def measure(device: Device, sample: Sample) -> dict[str, Any]:
    """Return the device time of an operation, of a copy with its traffic, and the times of other libraries [us]."""
    queue = device.new_queue(profiling=True)
    inputs = sample.make_inputs()
    first = inputs[0]
    bound = sample.operation.bind(device, first.shape, first.dtype, queue=queue)
    for array, values in zip(bound.inputs, inputs, strict=True):
        array.set(values, queue=queue)
    read = sum(each.nbytes for each in inputs)
    specs = sample.operation.specs(device, first.shape, first.dtype)
    written = nbytes_of(specs.outputs.values())
    ours, clock = launch_seconds(bound)
    copy, _ = launch_seconds(ceiling.mover(device, queue, read, written))
    row = {
        "operation": sample.name,
        "size": sample.size,
        "clock": clock,
        "us": round(1e6 * ours, 2),
        "copy_us": round(1e6 * copy, 2),
        "of_copy": round(copy / ours, 4),
        "gb_per_second": round(1e-9 * (read + written) / ours, 2),
    }
    return row | {f"{name}_us": round(1e6 * each, 2) for name, each in peers.times(sample.name, inputs).items()}


def launch_seconds(call: Callable[[], Any]) -> tuple[float, str]:
    """Return the median time of a launch [s] and its clock.

    The clock is ``device`` (profiling events), or ``host`` (launch and wait) where the runtime gives no device times:
    events of rusticl on llvmpipe last 1 ns.
    """
    on_device: list[float] = []
    on_host: list[float] = []
    while len(on_host) < _CALLS + 2 and (len(on_host) < _FEWEST_CALLS + 2 or sum(on_host) < _SLOW_SECONDS):
        start = time.perf_counter()
        event = call()
        event.wait()
        on_host.append(time.perf_counter() - start)
        on_device.append(1e-9 * (event.profile.end - event.profile.start))
    seconds = float(np.median(on_device[2:]))
    return (seconds, "device") if seconds > _LEAST else (float(np.median(on_host[2:])), "host")
