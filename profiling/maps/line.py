"""Line readout: light over the background that the threshold removes, and width of the line."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.ranging.line import LineReadout
from gpuvision.reference.line import read_lines

_ROWS, _WINDOW, _BACKGROUND = 48, 8, 1.0  # lengths in pixels, background in levels
_EPS = float(np.finfo(np.float32).eps)
_READOUT = LineReadout(method="windowed", window=_WINDOW, threshold=_BACKGROUND, outputs=("position", "status"))


def problem() -> Problem:
    """Return the error of the position over the light and the width of the line."""
    axes = Axis("light at the peak / background", 1e-5, 1e30), Axis("sigma of the line [px]", 0.5, 6.0)
    return Problem(axes, "half of the window", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    light, sigma = places.T
    middle = rng.uniform(20.0, 28.0, len(places))
    profiles = np.exp(-0.5 * ((np.arange(_ROWS)[:, None] - middle) / sigma) ** 2)
    frame = (_BACKGROUND * (1.0 + light * profiles)).astype(np.float32)[None]
    found = _READOUT(frame, device=device)
    expected = read_lines(frame, method="windowed", window=_WINDOW, threshold=_BACKGROUND)
    return np.asarray(np.abs(to_numpy(found.position) - expected["position"])[0] / _WINDOW, np.float64)


def _bound(places: Floats) -> Floats:
    # Contract of the line readout: 3 epsilon of the position and of the window. The threshold is a float, and the
    # difference of a sample and the threshold is exact or rounded to the light.
    return np.full(len(places), 3.0 * _EPS * (28.0 + _WINDOW) / _WINDOW)
