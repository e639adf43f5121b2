"""Robust losses of the matching fits: weights, tuning constants and statistical efficiency.

The losses are functions of a residual divided by the scale of the residuals. ``robust.h`` has the same losses for the
kernels.

References
----------
.. [1] P. J. Huber, *Robust Statistics*, Wiley 1981.
.. [2] A. E. Beaton and J. W. Tukey, "The fitting of power series, meaning polynomials, illustrated on
   band-spectroscopic data", Technometrics 16, 1974 (the biweight loss).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import ndtr

from gpuvision.validation import finite

Loss = Literal["least_squares", "huber", "tukey", "ransac"]

# In units of the residuals' scale. Huber and Tukey: 95 % efficiency for normal residuals (Huber 1981).
# "ransac": 3 standard deviations keep 99.7 % of the inliers.
TUNING_CONSTANTS = {"least_squares": 1.0, "huber": 1.345, "tukey": 4.685, "ransac": 3.0}
_DEFINES = {"huber": "LOSS_HUBER", "tukey": "LOSS_TUKEY", "ransac": "LOSS_CUT"}


def resolve_tuning_constant(loss: str, tuning_constant: float | None, owner: str) -> float:
    """Return the given tuning constant, or the default of the loss.

    Parameters
    ----------
    loss
        One of `TUNING_CONSTANTS`.
    tuning_constant
        Residual at which the loss stops being quadratic, in units of the residuals' scale, above 0. None: the default.
    owner
        Name of the operation, for error messages.

    Raises
    ------
    ValueError
        The loss is unknown, or the tuning constant is not positive.
    """
    if loss not in TUNING_CONSTANTS:
        raise ValueError(f"{owner}.loss is {loss!r}, expected one of {', '.join(TUNING_CONSTANTS)}")
    if tuning_constant is None:
        return TUNING_CONSTANTS[loss]
    if finite(tuning_constant, f"{owner}.tuning_constant") <= 0.0:
        raise ValueError(f"{owner}.tuning_constant is {tuning_constant}, expected a number > 0")
    return float(tuning_constant)


def loss_defines(loss: str, tuning_constant: float) -> dict[str, float | None]:
    """Return the build options that select the loss in ``robust.h``."""
    return {"TUNING_CONSTANT": tuning_constant} | ({_DEFINES[loss]: None} if loss in _DEFINES else {})


def efficiency(loss: str, tuning_constant: float) -> float:
    """Return the statistical efficiency of a loss for normally distributed residuals, 0 to 1.

    The efficiency is the variance of least squares divided by the variance of the M-estimator: ``E[psi']**2 /
    E[psi**2]`` with psi the derivative of the loss (Huber 1981).
    """
    inside = 2.0 * float(ndtr(tuning_constant)) - 1.0
    density = float(np.exp(-0.5 * tuning_constant**2) / np.sqrt(2.0 * np.pi))
    if loss == "least_squares":
        return 1.0
    if loss == "huber":
        return inside**2 / (inside - 2.0 * tuning_constant * density + tuning_constant**2 * (1.0 - inside))
    if loss == "ransac":
        return inside - 2.0 * tuning_constant * density
    z = np.linspace(0.0, min(tuning_constant, 12.0), 20001)
    part, normal = (z / tuning_constant) ** 2, np.exp(-0.5 * z**2) * np.sqrt(2.0 / np.pi)
    slope = np.trapezoid((1.0 - part) * (1.0 - 5.0 * part) * normal, z)
    square = np.trapezoid((z * (1.0 - part) ** 2) ** 2 * normal, z)
    return float(slope**2 / square)


def sample_subsets(count: int, size: int, max_trials: int) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Return the minimal subsets from which a robust fit takes its start candidates.

    Parameters
    ----------
    count
        Number of points or rows.
    size
        Points in a subset.
    max_trials
        Number of subsets. Pairs are enumerated completely where there are not more of them.

    Returns
    -------
    numpy.ndarray
        int32 (trials, size) indices below ``count``; random subsets are the same in every run (seeded by ``count``).
    """
    if size == 2 and count * (count - 1) // 2 <= max_trials:
        return np.stack(np.triu_indices(count, 1), axis=-1).astype(np.int32)
    rng = np.random.default_rng(count)
    order = np.argsort(rng.random((max_trials, count)), axis=-1)
    return np.ascontiguousarray(order[:, :size], np.int32)
