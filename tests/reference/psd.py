"""Reference of the PSD readout: positions, sums, status flags and standard deviations of each sample.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ELECTRON = 1.602176634e-19  # elementary charge [C], exact since the SI of 2019 (CODATA 2018)
LOW_SIGNAL, SATURATED, OUT_OF_RANGE, NOT_FINITE = 1, 2, 4, 8

Float64 = NDArray[np.float64]


class ReferenceReading(NamedTuple):
    """Readings of PSD strips, of the currents' shape.

    Attributes
    ----------
    position
        Position of the light spot along the strip [m]; NaN where the status is not 0.
    total
        Sum of the currents [A].
    status
        Flags of `gpuvision.Status`.
    sigma
        Standard deviation of the position [m]; NaN where the status is not 0.
    """

    position: Float64
    total: Float64
    status: NDArray[np.uint8]
    sigma: Float64


def read_out(readout: Any, left: NDArray[Any], right: NDArray[Any]) -> ReferenceReading:
    """Read out the currents of PSD strips.

    Parameters
    ----------
    readout : gpuvision.PsdReadout
        Parameters of the readout.
    left, right : numpy.ndarray
        Currents of the two electrodes, (..., strips): ADC codes (unsigned integers), or floats in units of
        ``readout.ampere``.

    Returns
    -------
    ReferenceReading
        Float64 arrays of the same shape.
    """
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
        sigma = _sigma(readout, a, b, load, codes)
    status = _status(readout, raw_left, raw_right, a, b, saturation, load)
    if readout.linearity is not None:
        position = position + _correction(readout, position)
    good = status == 0
    return ReferenceReading(np.where(good, position, np.nan), total, status, np.where(good, sigma, np.nan))


def _status(
    readout: Any, raw_left: Float64, raw_right: Float64, a: Float64, b: Float64, saturation: float, load: float
) -> NDArray[np.uint8]:
    status = np.zeros(a.shape, np.uint8)
    with np.errstate(all="ignore"):
        total = a + b
        dark = total <= readout.minimum_total
        noise = readout.noise
        margin = readout.margin if readout.margin is not None else 3.0 * noise.spot if noise else 0.0
        inner = (readout.strip_length - 2.0 * margin) / readout.strip_length
        outside = (np.abs(b - a) * load > inner * total) & ~dark
        status[outside] = OUT_OF_RANGE
        status[dark] = LOW_SIGNAL
        status[(raw_left >= saturation) | (raw_right >= saturation)] |= np.uint8(SATURATED)
    status[~(np.isfinite(raw_left) & np.isfinite(raw_right))] = NOT_FINITE
    return status


def _sigma(readout: Any, a: Float64, b: Float64, load: float, codes: bool) -> Float64:
    """Propagate the noise of the corrected currents a (left) and b (right) to the position."""
    noise = readout.noise
    total, length = a + b, readout.strip_length * load
    quantisation = readout.ampere**2 / 12.0 if codes else 0.0
    left = quantisation + (noise.independent**2 if noise else 0.0)
    right = left / readout.right_gain**2
    # Derivatives of length / 2 (b - a) / (a + b).
    by_left, by_right = -length * b / total**2, length * a / total**2
    variance = by_left**2 * left + by_right**2 * right
    if noise:
        variance = variance + (by_right - by_left) ** 2 * noise.opposed**2
        per_ampere = 2.0 * ELECTRON * noise.bandwidth
        position = length / 2.0 * (b - a) / total
        spread = readout.strip_length**2 / 12.0 + position**2
        variance = variance + per_ampere * noise.spot**2 / total
        variance = variance + per_ampere * (noise.background + noise.dark_current) * spread / total**2
    return np.asarray(np.sqrt(variance))


def _correction(readout: Any, position: Float64) -> Float64:
    knots = np.linspace(-0.5, 0.5, len(readout.linearity[0])) * readout.strip_length
    correction = np.zeros_like(position)
    for strip, row in enumerate(readout.linearity):
        correction[..., strip] = np.interp(position[..., strip], knots, row)
    return correction
