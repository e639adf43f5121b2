"""Device times of CuPy and OpenCV's CUDA module for the same inputs, where they are installed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np

_CALLS = 21


def times(name: str, inputs: tuple[Any, ...]) -> dict[str, float]:
    """Return the median device times [s] of the peers of an operation; empty where no peer is installed."""
    found: dict[str, float] = {}
    cupy = _cupy()
    if cupy is not None and name == "psd":
        found["cupy"] = _cupy_psd(cupy, inputs[0])
    cv2 = _opencv_cuda()
    if cv2 is not None and name == "undistort":
        found["opencv_cuda"] = _opencv_remap(cv2, inputs[0])
    return found


def _cupy() -> Any:
    if importlib.util.find_spec("cupy") is None:
        return None
    cupy = importlib.import_module("cupy")
    return cupy if cupy.cuda.runtime.getDeviceCount() else None


def _opencv_cuda() -> Any:
    cv2 = importlib.import_module("cv2")
    return cv2 if hasattr(cv2, "cuda") and cv2.cuda.getCudaEnabledDeviceCount() else None


def _cupy_psd(cupy: Any, pairs: Any) -> float:
    """Position and sum of pairs of currents, by one fused element-wise kernel."""
    kernel = cupy.ElementwiseKernel(
        "float32 a, float32 b", "float32 position, float32 total", "total = a + b; position = (b - a) / total", "psd"
    )
    given = cupy.asarray(pairs)
    left, right = given[:, 0], given[:, 1]
    position, total = cupy.empty(len(given), np.float32), cupy.empty(len(given), np.float32)
    start, end = cupy.cuda.Event(), cupy.cuda.Event()
    return _median(lambda: kernel(left, right, position, total), start, end, cupy.cuda.get_elapsed_time)


def _opencv_remap(cv2: Any, image: Any) -> float:
    """Bilinear remap with maps in device memory; the maps move by a fraction of a pixel."""
    rows, columns = image.shape
    x, y = np.meshgrid(np.arange(columns, dtype=np.float32) + 0.25, np.arange(rows, dtype=np.float32) + 0.25)
    given, map_x, map_y = (cv2.cuda.GpuMat(each) for each in (image, x, y))
    stream = cv2.cuda.Stream()
    start, end = cv2.cuda.Event(), cv2.cuda.Event()
    made = cv2.cuda.GpuMat(image.shape, cv2.CV_8UC1)

    def call() -> None:
        cv2.cuda.remap(given, map_x, map_y, cv2.INTER_LINEAR, dst=made, stream=stream)

    times = []
    for _ in range(_CALLS):
        start.record(stream)
        call()
        end.record(stream)
        stream.waitForCompletion()
        times.append(cv2.cuda.Event.elapsedTime(start, end))
    return 1e-3 * float(np.median(times))


def _median(call: Callable[[], object], start: Any, end: Any, elapsed: Callable[[Any, Any], float]) -> float:
    times = []
    for _ in range(_CALLS):
        start.record()
        call()
        end.record()
        end.synchronize()
        times.append(elapsed(start, end))
    return 1e-3 * float(np.median(times))
