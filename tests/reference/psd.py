"""The PSD readout in float64, sample by sample as domain equations say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpuvision.ranging.psd import PsdReadout
from gpuvision.status import Status

ELECTRON = 1.602176634e-19  # elementary charge [C], exact by definition of the SI


@dataclass
class Reading:
    position: NDArray[np.float64]
    total: NDArray[np.float64]
    status: NDArray[np.uint8]
    sigma: NDArray[np.float64]


def read_out(readout: PsdReadout, left: NDArray, right: NDArray) -> Reading:
    """Read out currents of shape (..., strips), as they come (codes or amperes)."""
    codes = left.dtype.kind == "u"
    highest = np.iinfo(left.dtype).max * readout.ampere if codes else np.inf
    saturation = highest if readout.saturation is None else readout.saturation
    raw_left, raw_right = (np.asarray(x, np.float64) * readout.ampere for x in (left, right))
    a = raw_left - readout.dark[0]
    b = (raw_right - readout.dark[1]) / readout.right_gain
    with np.errstate(all="ignore"):
        total = a + b
        load = 1.0
        if readout.interelectrode_resistance:
            load = 1.0 + 2.0 * readout.load_resistance / readout.interelectrode_resistance
        balance = (b - a) / total
        position = 0.5 * readout.strip_length * load * balance
        sigma = _sigma(readout, balance, total, load, codes)
    status = _status(readout, raw_left, raw_right, a, b, saturation, load)
    if readout.linearity is not None:
        position = position + _correction(readout, position)
    good = status == 0
    return Reading(np.where(good, position, np.nan), total, status, np.where(good, sigma, np.nan))


def _status(readout, raw_left, raw_right, a, b, saturation, load) -> NDArray[np.uint8]:
    status = np.zeros(a.shape, np.uint8)
    with np.errstate(all="ignore"):
        total = a + b
        dark = total <= readout.minimum_total
        outside = (np.abs(b - a) * load > total) & ~dark
        status[outside] = Status.OUT_OF_RANGE
        status[dark] = Status.LOW_SIGNAL
        status[(raw_left >= saturation) | (raw_right >= saturation)] |= np.uint8(Status.SATURATED)
    status[~(np.isfinite(raw_left) & np.isfinite(raw_right))] = Status.NOT_FINITE
    return status


def _sigma(readout, balance, total, load, codes) -> NDArray[np.float64]:
    noise = readout.noise
    independent, opposed, spot, bandwidth = (
        (noise.independent, noise.opposed, noise.spot, noise.bandwidth) if noise else (0.0, 0.0, 0.0, 0.0)
    )
    each = independent**2 + (readout.ampere**2 / 12.0 if codes else 0.0)
    length = readout.strip_length * load
    variance = (length / total) ** 2 * (each * (1.0 + balance**2) / 2.0 + opposed**2)
    electrons = total / (2.0 * ELECTRON * bandwidth) if bandwidth else np.inf
    return np.sqrt(variance + spot**2 / electrons)


def _correction(readout, position) -> NDArray[np.float64]:
    knots = np.linspace(-0.5, 0.5, len(readout.linearity[0])) * readout.strip_length
    correction = np.zeros_like(position)
    for strip, row in enumerate(readout.linearity):
        correction[..., strip] = np.interp(position[..., strip], knots, row)
    return correction
