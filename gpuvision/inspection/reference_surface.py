"""Robust low-order surface through the board around an aperture."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpuvision.matching.artwork.shapes import Float64
from gpuvision.normal_distribution import MAD_TO_SIGMA

MAX_ORDER = 2
_TUKEY = 4.685  # tuning constant of Tukey's biweight: 95 % efficiency for normal residuals (Holland and Welsch 1977)
_LEAST_SCALE = 1e-12  # [m]: residuals of a noise-free plane are rounding errors
_LAD_STEPS, _TUKEY_STEPS = 15, 30
_LAD_TOLERANCE = 0.1  # change of the residuals, in their scale: the result is only the start of the second fit
_TOLERANCE = 1e-5  # of the weights


class ReferenceSurface(NamedTuple):
    """Polynomial surface z(x, y) of low order, with its covariance.

    Attributes
    ----------
    centre : (2,)
        Origin of the polynomial [m].
    length
        Unit of its coordinates [m]: the largest distance from the centre.
    order
        Order of the polynomial: 0, 1 or 2.
    coefficients : (n,)
        Coefficients [m] of `basis`.
    covariance : (n, n)
        Covariance of the coefficients [m^2] for independent cells.
    scale
        Robust standard deviation of the cells about the surface [m].
    cells
        Number of fitted cells.
    """

    centre: Float64
    length: float
    order: int
    coefficients: Float64
    covariance: Float64
    scale: float
    cells: int

    def basis(self, x: Float64, y: Float64) -> Float64:
        """Return the terms of the polynomial (n, ...) at places [m]."""
        return _basis((x - self.centre[0]) / self.length, (y - self.centre[1]) / self.length, self.order)

    def heights(self, x: Float64, y: Float64) -> Float64:
        """Return the heights [m] at places [m]."""
        return np.asarray(np.tensordot(self.coefficients, self.basis(x, y), axes=1))


def _basis(u: Float64, v: Float64, order: int) -> Float64:
    terms = [np.ones_like(u), u, v, u * u, u * v, v * v]
    return np.stack(terms[: (order + 1) * (order + 2) // 2])


def fit_reference(x: Float64, y: Float64, z: Float64, order: int) -> ReferenceSurface | None:
    """Fit a polynomial surface by M-estimation: least absolute deviations, then Tukey's biweight.

    Parameters
    ----------
    x, y, z : numpy.ndarray
        Cells (n,) [m], finite.
    order : int
        Order of the polynomial, 0 to 2.

    Returns
    -------
    ReferenceSurface or None
        None if the cells do not determine the surface.

    Notes
    -----
    Up to about a third of the cells may lie on another level (a trace, a component, smeared paste). The covariance is
    the one of an M-estimator (Huber, *Robust Statistics*, 1981, section 7.6): it holds for independent residuals.
    """
    if not len(x):
        return None
    centre = np.array([x.mean(), y.mean()])
    length = float(np.max(np.hypot(x - centre[0], y - centre[1]))) or 1.0
    design = _basis((x - centre[0]) / length, (y - centre[1]) / length, order).T
    if len(x) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    level = float(np.median(z))
    coefficients = np.zeros(design.shape[1])
    residual = z - level
    for _ in range(_LAD_STEPS):
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), _LEAST_SCALE)
        coefficients = _weighted(design, z - level, 1.0 / np.maximum(np.abs(residual), 1e-2 * scale))
        before, residual = residual, z - level - design @ coefficients
        if np.max(np.abs(residual - before)) < _LAD_TOLERANCE * scale:
            break
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), _LEAST_SCALE)
    weights = np.zeros_like(residual)
    for _ in range(_TUKEY_STEPS):
        ratio = np.minimum((residual / (_TUKEY * scale)) ** 2, 1.0)
        former, weights = weights, (1.0 - ratio) ** 2
        if np.max(np.abs(weights - former)) < _TOLERANCE:
            break
        coefficients = _weighted(design, z - level, weights)
        residual = z - level - design @ coefficients
    share = np.minimum((residual / (_TUKEY * scale)) ** 2, 1.0)
    influence = np.mean((residual * (1.0 - share) ** 2) ** 2)
    slope = float(np.mean((1.0 - share) * (1.0 - 5.0 * share)))
    freedom = len(x) / (len(x) - design.shape[1])
    if not slope > 0:
        return None
    covariance = freedom * influence / slope**2 * np.linalg.inv(design.T @ design)
    coefficients[0] += level
    return ReferenceSurface(centre, length, order, coefficients, covariance, scale, len(x))


def _weighted(design: Float64, values: Float64, weights: Float64) -> Float64:
    """Return the coefficients of a weighted least-squares fit."""
    # Normal equations: the coordinates are centred and at most 1, so that they are well conditioned.
    weighted = design * (weights / np.max(weights))[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ values))
