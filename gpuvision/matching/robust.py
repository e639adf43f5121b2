"""Losses of robust fits: how much a residual counts, and what robustness costs where there are no outliers."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import ndtr

from gpuvision.validation import finite

Loss = Literal["least_squares", "huber", "tukey", "ransac"]

# Where a loss bends, in units of the residuals' scale: 95 % efficiency for Huber and Tukey.
TUNING_CONSTANTS = {"least_squares": 1.0, "huber": 1.345, "tukey": 4.685, "ransac": 3.0}
_DEFINES = {"huber": "LOSS_HUBER", "tukey": "LOSS_TUKEY", "ransac": "LOSS_CUT"}


def tuning_constant_of(loss: str, bend: float | None, what: str) -> float:
    """Return where the loss bends: as given, or its default.

    Raises
    ------
    ValueError
        There is no such loss, or the number is not positive.
    """
    if loss not in TUNING_CONSTANTS:
        raise ValueError(f"{what}.loss is {loss!r}, expected one of {', '.join(TUNING_CONSTANTS)}")
    if bend is None:
        return TUNING_CONSTANTS[loss]
    if finite(bend, f"{what}.bend") <= 0.0:
        raise ValueError(f"{what}.bend is {bend}, expected a number > 0")
    return float(bend)


def loss_defines(loss: str, bend: float) -> dict[str, float | None]:
    """Return what selects the loss in ``robust.h``."""
    return {"TUNING_CONSTANT": bend} | ({_DEFINES[loss]: None} if loss in _DEFINES else {})


def efficiency(loss: str, bend: float) -> float:
    """Return the variance of least squares over that of the loss, for residuals that are all normal.

    It is ``E[psi']**2 / E[psi**2]`` with psi the derivative of the loss (Huber, 1981).
    """
    inside = 2.0 * float(ndtr(bend)) - 1.0
    density = float(np.exp(-0.5 * bend**2) / np.sqrt(2.0 * np.pi))
    if loss == "least_squares":
        return 1.0
    if loss == "huber":
        return inside**2 / (inside - 2.0 * bend * density + bend**2 * (1.0 - inside))
    if loss == "ransac":
        return inside - 2.0 * bend * density
    z = np.linspace(0.0, min(bend, 12.0), 20001)
    part, normal = (z / bend) ** 2, np.exp(-0.5 * z**2) * np.sqrt(2.0 / np.pi)
    slope = np.trapezoid((1.0 - part) * (1.0 - 5.0 * part) * normal, z)
    square = np.trapezoid((z * (1.0 - part) ** 2) ** 2 * normal, z)
    return float(slope**2 / square)


def subsets(count: int, size: int, trials: int) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Return which points a start is tried through, (trials, size) indices below ``count``.

    All subsets where there are no more than ``trials``; random ones otherwise, the same in every run.
    """
    if size == 2 and count * (count - 1) // 2 <= trials:
        return np.stack(np.triu_indices(count, 1), axis=-1).astype(np.int32)
    rng = np.random.default_rng(count)
    order = np.argsort(rng.random((trials, count)), axis=-1)
    return np.ascontiguousarray(order[:, :size], np.int32)
