"""Line readout: method, window and filter length, for a bright and a dim line.

The line is a Gaussian of sigma 2 px with shot noise, read noise and rounding to 8 bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.ranging.line import LineReadout

_FRAMES, _ROWS, _COLUMNS = 4, 256, 1024
_SIGMA = 2.0  # width of the line [px]
_READ_NOISE, _GAIN = 1.5, 0.05  # [levels], [levels per electron]
_BACKGROUND = 6.0  # [levels]
_THRESHOLD = 11.0  # three standard deviations of the noise above the background [levels]
_CHANGES: tuple[dict[str, Any], ...] = (
    {"method": "centroid"},
    *({"method": "windowed", "window": window} for window in (3, 5, 8, 12)),
    {"method": "gauss3"},
    {"method": "fir", "fir_length": 4},
    {"method": "fir", "fir_length": 8},
    *({"method": "ml", "window": window} for window in (5, 8)),
)


def settings(device: Device) -> Iterator[Setting]:
    """Yield the methods for two light levels, in single precision; the best ones also in double precision."""
    precisions = ("single", "double") if device.has_double else ("single",)
    for peak in (180.0, 30.0):
        frames, true = _frames(peak)
        for change in _CHANGES:
            for precision in precisions if change["method"] in ("windowed", "ml") else ("single",):
                operation = LineReadout(
                    threshold=_THRESHOLD,
                    read_noise=_READ_NOISE,
                    gain=_GAIN,
                    outputs=("position", "status"),
                    precision=None if precision == "single" else "double",
                    **change,
                )
                bound = bind_with(operation, device, frames)
                position = to_numpy(bound.outputs.position).astype(np.float64)
                parameters = {**change, "precision": precision}
                yield Setting("line", f"peak {peak:.0f} levels", parameters, bound.run, Errors(position - true), "px")


def _frames(peak: float) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], np.ndarray[Any, np.dtype[np.float64]]]:
    """Return frames (frames, rows, columns), and the true positions (frames, columns) [px]."""
    rng = np.random.default_rng(5)
    column, row = np.arange(_COLUMNS), np.arange(_ROWS)[:, None]
    phase = rng.uniform(0.0, 6.0, (_FRAMES, 1))
    true = _ROWS * (0.5 + 0.25 * np.sin(6.0 * column / _COLUMNS + phase))
    light = peak * np.exp(-0.5 * ((row - true[:, None]) / _SIGMA) ** 2) + _BACKGROUND
    noisy = rng.poisson(light / _GAIN) * _GAIN + rng.normal(0.0, _READ_NOISE, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), true
