"""PSD readout: light over the dark current that is subtracted, and position of the spot."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.ranging.psd import PsdReadout
from gpuvision.reference.psd import read_out

_LENGTH, _DARK = 6e-3, 1e-9  # [m], [A]
_EPS = float(np.finfo(np.float32).eps)
_READOUT: Any = PsdReadout(strip_length=_LENGTH, dark=(_DARK, _DARK), layout="planar", outputs=("position", "status"))


def problem() -> Problem:
    """Return the error of the position over the sum of the currents and the position."""
    axes = (
        Axis("light / dark current of a channel", 1e-5, 1e4),
        Axis("position / half of the strip", -0.99, 0.99, False),
    )
    return Problem(axes, "half of the strip length", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    total, balance = places[:, 0] * _DARK * rng.uniform(0.97, 1.03, len(places)), places[:, 1]
    currents = (0.5 * total * np.stack([1.0 - balance, 1.0 + balance]) + _DARK).astype(np.float32)
    found = _READOUT(currents, device=device)
    expected = read_out(_READOUT, *currents)
    return np.asarray(np.abs(found.position - expected.position) / (0.5 * _LENGTH), np.float64)


def _bound(places: Floats) -> Floats:
    light, balance = places.T
    # Error model of the readout: 4 epsilon. The dark current is rounded to half an epsilon, the same in both channels:
    # the sum is off by an epsilon of it, which moves the position in proportion. Each difference is rounded once.
    return np.asarray(4.0 * _EPS + _EPS * (1.0 + np.abs(balance) / light))
