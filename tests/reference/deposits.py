"""Reference of the measurement of deposits, float64: one aperture after the other, sums over its valid cells.

Formulas of the kernel ``deposits.cl``, without its expansions of the sums.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Float64 = NDArray[np.float64]


class ReferenceDeposit(NamedTuple):
    """Numbers of a deposit [m, m^2, m^3], and its status: "measured", "missing" or "holes"."""

    area: float
    area_sigma: float
    volume: float
    volume_sigma: float
    height_mean: float
    height_mean_sigma: float
    offset: Float64
    offset_sigma: Float64
    valid: float
    status: str


class Plane(NamedTuple):
    """Surface of second order: coefficients and covariance (6, 6) of the terms 1, u, v, u^2, uv, v^2.

    u and v are (x - centre) / length.
    """

    coefficients: Float64
    covariance: Float64
    centre: Float64
    length: float

    def basis(self, x: Float64, y: Float64) -> Float64:
        """Return the terms (6, n)."""
        u, v = (x - self.centre[0]) / self.length, (y - self.centre[1]) / self.length
        return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])


def measure_deposit(
    z: Float64,
    sigma: Float64,
    x: Float64,
    y: Float64,
    core: NDArray[np.bool_],
    margin: NDArray[np.bool_],
    surface: Plane,
    centroid: Float64,
    *,
    cell_area: float,
    threshold: float,
    correlation_area: float = 1.0,
    least_valid: float = 0.8,
    significance: float = 3.0,
    to_board: Any = ((1.0, 0.0), (0.0, 1.0)),
) -> ReferenceDeposit:
    """Measure a deposit in cells (n,) with places x, y; core and margin say which cells belong to it."""
    board, finite = np.asarray(to_board, np.float64), np.isfinite(z)
    count, used = np.count_nonzero(core | margin), (core | margin) & finite
    valid, none, nowhere = float(np.count_nonzero(used)) / float(count), math.nan, np.full(2, math.nan)
    share = np.zeros(z.shape)
    for part in (core, margin):
        if np.count_nonzero(part & finite) < least_valid * np.count_nonzero(part):
            return ReferenceDeposit(none, none, none, none, none, none, nowhere, nowhere, valid, "holes")
        share[part & finite] = int(np.count_nonzero(part)) / max(int(np.count_nonzero(part & finite)), 1)
    weight, noise, basis = share[used], sigma[used], surface.basis(x[used], y[used])
    height = z[used] - surface.coefficients @ basis

    def spread(own: Float64, gradient: Float64) -> float:
        return math.sqrt(correlation_area * (float(np.sum(own)) + float(gradient @ surface.covariance @ gradient)))

    volume_sigma = cell_area * spread((weight * noise) ** 2, basis @ weight)
    total = float(np.sum(weight * height))
    above = height > threshold
    ratio = (threshold - height) / noise
    chance, density = ndtr(-ratio), np.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi)
    crossing = basis @ (weight * density / noise)
    number = float(np.sum(weight[above]))
    area_sigma = cell_area * spread(weight**2 * chance * (1 - chance), crossing)
    mean = mean_sigma = math.nan
    if number:
        mean = float(np.sum((weight * height)[above]) / number)
        centred = height - mean
        first = centred * chance + noise * density
        second = centred**2 * chance + 2 * centred * noise * density + noise**2 * (chance + ratio * density)
        gradient = -(basis @ (weight * above)) - (threshold - mean) * crossing
        mean_sigma = spread(weight**2 * np.maximum(second - first**2, 0.0), gradient) / number
    offset, offset_sigma, status = nowhere, nowhere, "missing"
    if cell_area * total > significance * volume_sigma:
        place = np.stack([x[used], y[used]]) - centroid[:, None]
        centre = place @ (weight * height) / total
        arms = board @ (place - centre[:, None]) * weight / total
        offset, status = board @ centre, "measured"
        offset_sigma = np.array([spread((arm * noise) ** 2, basis @ arm) for arm in arms])
    return ReferenceDeposit(
        cell_area * number,
        area_sigma,
        cell_area * total,
        volume_sigma,
        mean,
        mean_sigma,
        offset,
        offset_sigma,
        valid,
        status,
    )
