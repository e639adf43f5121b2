"""Reference of robust fits: a general minimiser of the same loss."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

Float64 = NDArray[np.float64]


def loss(z: Float64, name: str, tuning_constant: float) -> Float64:
    """Return the loss of residuals in units of their scale: "huber", "tukey", "ransac" or least squares."""
    if name == "huber":
        return np.where(np.abs(z) <= tuning_constant, 0.5 * z**2, tuning_constant * (np.abs(z) - 0.5 * tuning_constant))
    if name == "tukey":
        return tuning_constant**2 / 6.0 * (1.0 - np.clip(1.0 - (z / tuning_constant) ** 2, 0.0, None) ** 3)
    if name == "ransac":
        return 0.5 * np.minimum(z**2, tuning_constant**2)
    return 0.5 * z**2


def fit_line(
    points: Float64, sigma: Float64, scale: float, name: str, tuning_constant: float, start: tuple[float, float]
) -> tuple[float, float]:
    """Return angle and distance from the origin (along (-sin, cos)) of the line of least loss near a start."""

    def total(parameters: Float64) -> float:
        angle, distance = parameters
        across = points @ [-np.sin(angle), np.cos(angle)] - distance
        return float(np.sum(loss(across / (sigma * scale), name, tuning_constant)))

    found = minimize(total, start, method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-14, "maxiter": 4000})
    return float(found.x[0]), float(found.x[1])


def transform_of(parameters: Float64) -> tuple[Float64, Float64]:
    """Return matrix and shift of 3 (rigid), 4 (similarity) or 6 (affine) parameters."""
    x, y, theta = parameters[:3]
    deformation = np.eye(2)
    if len(parameters) == 4:
        deformation = deformation * (1.0 + parameters[3])
    if len(parameters) == 6:
        deformation = np.array([[1.0 + parameters[3], parameters[5]], [0.0, 1.0 + parameters[4]]])
    turned = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    return turned @ deformation, np.array([x, y])


def residuals(parameters: Float64, rows: Float64) -> Float64:
    """Return the residual [m] of every feature row (n, 7) along its normal in the artwork, at a pose."""
    matrix, shift = transform_of(parameters)
    seen = rows[:, 2:4] + rows[:, 4:6]
    artwork = np.linalg.solve(matrix, (seen - shift).T).T
    return np.asarray(np.sum(rows[:, :2] * (artwork - rows[:, 2:4]), axis=-1))


def solve_pose(
    rows: Float64, freedoms: int, scale: float, name: str, tuning_constant: float, start: Float64
) -> Float64:
    """Return the parameters of least loss near a start: least squares of the square roots of the losses."""
    size = np.array([1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 1e-2])[:freedoms]

    def roots(scaled: Float64) -> Float64:
        z = residuals(scaled * size, rows) / (rows[:, 6] * scale)
        return np.sqrt(2.0 * loss(z, name, tuning_constant))

    found: Any = least_squares(roots, start / size, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000)
    return np.asarray(np.asarray(found.x) * size)
