"""Weighted linear least squares with named parameters: directions that the data does not determine are named.

References
----------
.. [1] G. H. Golub and C. F. Van Loan, *Matrix Computations*, 4th ed. 2013, section 5.5 (rank-deficient least squares).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.homography_fit import DegenerateError

Float64 = npt.NDArray[np.float64]

# Singular values of the normalised Jacobian below this fraction of the largest one count as 0: float64 rounding is
# 2e-16, and a machine whose moves fill a millionth of their range gives no usable result (chosen).
_RANK_TOLERANCE = 1e-9
# A parameter belongs to an undetermined direction if its share of the direction is at least this large (chosen).
_SHARE = 0.1


class LinearFit(NamedTuple):
    """Estimate of linear parameters.

    Attributes
    ----------
    values : numpy.ndarray
        Parameters (p,).
    covariance : numpy.ndarray
        Covariance (p, p) for the stated covariance of the observations.
    residual_scale : float
        Root of the reduced chi-square: 1 if the stated covariance is right, NaN without degrees of freedom.
    degrees_of_freedom : int
        Number of observations minus number of parameters.
    """

    values: Float64
    covariance: Float64
    residual_scale: float
    degrees_of_freedom: int


def whiten(rows: Float64, covariance: npt.ArrayLike) -> Float64:
    """Return rows (n, r, ...) divided by the standard deviations of a covariance (r, r) or (n, r, r).

    Raises
    ------
    ValueError
        A covariance is not finite or not positive definite.
    """
    given = np.asarray(covariance, np.float64)
    size = rows.shape[1]
    if given.shape not in ((size, size), (len(rows), size, size)):
        raise ValueError(f"covariance has shape {given.shape}, expected ({size}, {size}) or (n, {size}, {size})")
    if not np.isfinite(given).all():
        raise ValueError("covariance is not finite; drop refused measurements first")
    try:
        factor = np.linalg.cholesky(given)
    except np.linalg.LinAlgError:
        raise ValueError("covariance is not positive definite") from None
    broadcast = np.broadcast_to(factor, (len(rows), size, size))
    whitened = np.linalg.solve(broadcast, rows.reshape(len(rows), size, math.prod(rows.shape[2:])))
    return np.asarray(whitened.reshape(rows.shape))


def undetermined(design: Float64, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the parameters that a design (m, p) does not determine, in their order."""
    length = np.linalg.norm(design, axis=0)
    normalised = design / np.where(length > 0.0, length, 1.0)
    missing = max(design.shape[1] - len(design), 0)
    _, values, vectors = np.linalg.svd(np.vstack([normalised, np.zeros((missing, design.shape[1]))]))
    null = vectors[values <= _RANK_TOLERANCE * max(values[0], 1e-300)]
    share = np.linalg.norm(null, axis=0)
    return tuple(name for name, each in zip(names, share, strict=True) if each >= _SHARE)


def fit_linear(
    design: Float64, observed: Float64, covariance: npt.ArrayLike, names: Sequence[str], advice: str
) -> LinearFit:
    """Fit linear parameters by weighted least squares.

    Parameters
    ----------
    design : numpy.ndarray
        Derivatives (n, r, p) of r coordinates of n observations by p parameters.
    observed : numpy.ndarray
        Observations (n, r).
    covariance : array_like
        Covariance of an observation, (r, r) or (n, r, r).
    names : sequence of str
        Names of the parameters, for the message.
    advice : str
        End of the message about undetermined parameters.

    Raises
    ------
    DegenerateError
        The observations do not determine all parameters; the message names them.
    """
    rows = whiten(design, covariance).reshape(-1, len(names))
    values = whiten(observed, covariance).ravel()
    missing = undetermined(rows, names)
    if missing:
        raise DegenerateError(f"{', '.join(missing)} cannot be found: {advice}")
    # Columns of unit length: parameters in metres and without unit have very different sizes.
    length = np.linalg.norm(rows, axis=0)
    orthogonal, triangle = np.linalg.qr(rows / length)
    factor = np.linalg.inv(triangle) / length[:, None]
    solution = factor @ (orthogonal.T @ values)
    freedom = len(values) - len(names)
    rest = values - rows @ solution
    scale = math.sqrt(float(rest @ rest) / freedom) if freedom else math.nan
    return LinearFit(solution, np.asarray(factor @ factor.T), scale, freedom)
