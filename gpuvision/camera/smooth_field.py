"""Smooth field in the residuals of a calibration: result of the test, its variance, and a bound of covariances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Float64: TypeAlias = npt.NDArray[np.float64]

# Share of a degree's field that must be seen for an estimate of its variance; else it is extrapolated.
_SEEN_DEGREE = 0.05
# Exponent of the amplitude over the degree: bending energy grows with the fourth power of the degree.
_SPECTRUM = 2.0


@dataclass(frozen=True, kw_only=True)
class LackOfFit:
    """Smooth field in the residuals of a lens fit.

    Attributes
    ----------
    p_value : float
        p-value of the test that the residuals are independent noise, against a free smooth field.
    rms_px : float
        Root mean square of the smooth field in the residuals [px], less the part that noise explains.
    noise_px : float
        Standard deviation of the remaining residuals [px].
    modes : int
        Number of modes of the field that the data show; 0 if there are too few points for the test.
    """

    p_value: float
    rms_px: float
    noise_px: float
    modes: int


def mode_variances(
    degree: npt.NDArray[np.intp], seen: Float64, product: Float64, variance: float, count: int
) -> Float64:
    """Return the variance of a mode by its degree, index 0 to the largest degree.

    Of a degree that is seen: by moments, sum of squared products with the residuals less the part of the noise, plus
    one standard error, since the few modes of a low degree give a rough estimate. Each variance is at least the
    variance of each higher degree, extrapolated by the spectrum.

    Parameters
    ----------
    degree
        Degree of each mode (modes,).
    seen
        (modes, modes): inner products of the effects of the modes on the residuals, with all parameters projected out.
    product
        (modes,): inner products of these effects with the residuals.
    variance
        Variance of the residuals without the field.
    count
        Number of residuals.
    """
    found = np.zeros(int(degree.max(initial=0)) + 1)
    for each in np.unique(degree):
        modes = degree == each
        gram = seen[np.ix_(modes, modes)]
        if np.trace(gram) < _SEEN_DEGREE * len(gram) * count:
            continue
        squares = float(np.sum(gram * gram))
        surplus = float(product[modes] @ product[modes] - variance * np.trace(gram))
        estimate = max(surplus / squares, 0.0)
        # Covariance of the products; the sum of their squares has the variance 2 |covariance|^2.
        of_products = estimate * (gram @ gram) + variance * gram
        found[each] = estimate + math.sqrt(2.0) * float(np.linalg.norm(of_products)) / squares
    degrees = np.arange(1, len(found))
    for each in degrees[::-1]:
        higher = np.arange(each, len(found))
        found[each] = np.max(found[higher] * (higher / each) ** (2.0 * _SPECTRUM))
    return found


def not_below(matrix: Float64, least: Float64) -> Float64:
    """Return a covariance that is at least ``least`` in every direction: raise the variances that are smaller."""
    values, vectors = np.linalg.eigh(least)
    root = vectors * np.sqrt(np.maximum(values, np.finfo(np.float64).eps * values[-1]))
    inner = np.linalg.solve(root, np.linalg.solve(root, matrix).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    raised = root @ vectors
    return np.asarray((raised * np.maximum(values, 1.0)) @ raised.T)
