"""Result of a lens fit to straight lines: parameters in pixels, uncertainties, alternatives and warnings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.line_families import Float64, LineFamilies, PackedLines
from gpuvision.camera.lines.straightness import pencil_basis
from gpuvision.camera.lines.variable_projection import Minimum, vanishing_start
from gpuvision.camera.smooth_field import LackOfFit
from gpuvision.normal_distribution import MAD_TO_SIGMA

LensModel = Literal["none", "k1", "k1,k2", "k1,k2,k3", "k1,k2,k3,k4"]
LineConstraint = Literal["auto", "vanishing", "free"]

MODELS: tuple[LensModel, ...] = ("none", "k1", "k1,k2", "k1,k2,k3", "k1,k2,k3,k4")
"""Lens models by number of distortion coefficients."""
# Standard deviation of a normal distribution over its median absolute deviation.
# Residual [half-diagonals] at rounding level.
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class LensFitLimits:
    """Thresholds of the model choice and of the warnings of `fit_lens`.

    Attributes
    ----------
    significance : float
        p-value below which an F test rejects the smaller model. Default 0.05.
    max_rms_ratio : float
        Ratio of the rms of an alternative to the rms of the chosen model, up to which the warnings treat it as equally
        good. Default 1.01.
    max_centre_sigmas : float
        Distance of the centre of an equally good alternative [standard deviations] above which a warning names it.
        Derived: Gaussian errors exceed 3 standard deviations in 0.3 % of the fits. Default 3.0.
    max_centre_sigma : float
        Standard deviation of the centre [half-diagonals] above which a warning says that the data do not determine it.
        Default 0.1.
    max_tail_ratio : float
        Ratio of the rms to the standard deviation estimated from the median, above which outliers are reported. Default
        2.0.
    min_bend_variances : float
        Decrease of the sum of squares [variances] below which the linear uncertainties of several coefficients are
        rough. Default 100.0.
    lack_of_fit_significance : float
        p-value of `LackOfFit` below which the residuals count as correlated. Default 0.05.
    max_lack_of_fit : float
        Ratio of the smooth residuals to the noise above which a warning names the lack of fit. Chosen: below 0.5 they
        add less than 12 % to the residual. Default 0.5.
    """

    significance: float = 0.05
    max_rms_ratio: float = 1.01
    max_centre_sigma: float = 0.1
    max_centre_sigmas: float = 3.0
    max_tail_ratio: float = 2.0
    min_bend_variances: float = 100.0
    lack_of_fit_significance: float = 0.05
    max_lack_of_fit: float = 0.5


@dataclass(frozen=True, kw_only=True)
class LensAlternative:
    """Alternative lens model, fitted to the same points.

    Attributes
    ----------
    model : {"none", "k1", "k1,k2", "k1,k2,k3", "k1,k2,k3,k4"}
        Distortion coefficients.
    lines : {"vanishing", "free"}
        "vanishing": the lines of a family meet in one point. "free": no constraint.
    rms_px : float
        Root mean square residual [px], as in `LensFit`.
    p_value : float
        p-value of the F test against the largest model; below 0.05 this model is rejected. The largest model has
        vanishing points if both this one and the chosen one have them. If the residuals of the largest model are
        correlated, the further coefficients are tested against their covariance for correlated errors (Wald's test).
    aic : float
        Akaike information criterion minus the criterion of the chosen model; negative favours this one.
    centre : (float, float) or None
        Column and row of the distortion centre [px]; None for "none".
    centre_distance_px : float
        Distance from the chosen model's centre [px]; NaN if one of them has no centre.
    """

    model: LensModel
    lines: LineConstraint
    rms_px: float
    p_value: float
    aic: float
    centre: tuple[float, float] | None
    centre_distance_px: float


@dataclass(frozen=True, kw_only=True)
class LensFit:
    """Lens fitted to straight lines.

    Attributes
    ----------
    lens : Lens or None
        Lens from measured to undistorted pixels; None if the data need no lens.
    model : {"none", "k1", "k1,k2", "k1,k2,k3", "k1,k2,k3,k4"}
        Distortion coefficients.
    lines : {"vanishing", "free"}
        "vanishing": the lines of each family were constrained to meet in one point. "free": no constraint.
    vanishing_points : numpy.ndarray
        (families, 3): unit homogeneous (column, row, 1), undistorted; the last component of a point at infinity is 0.
        NaN for a family of fewer than two lines.
    names, values, covariance
        Names, values (m,) and covariance (m, m) of the parameters: k1 [px^-2], k2 [px^-4], k3 [px^-6], k4 [px^-8], C_c,
        R_c [px] and, with vanishing points, the three components of each.
    residuals_px : tuple
        Per family and line an array (n,) of signed distances from the line in the measured image [px]; NaN for points
        that were not used.
    rms_px : float
        Root mean square of these distances [px], weighted under a robust loss.
    sigma_px : float
        Standard deviation of a coordinate [px]: given, or estimated from the residuals and the degrees of freedom.
    degrees_of_freedom : int
        Degrees of freedom: residuals minus parameters, the parameters of the lines included.
    lack_of_fit : LackOfFit or None
        Test of the residuals for a smooth field; None without the test.
    error_model : {"independent", "correlated"}
        Whether the covariance includes a smooth field of the residuals.
    iterations : int
        Number of steps of the minimisation.
    alternatives : tuple of LensAlternative
        Alternative models, if the model was chosen automatically.
    warnings : tuple of str
        Parameters that the data do not determine, and other doubts.
    """

    lens: Lens | None
    model: LensModel
    lines: LineConstraint
    vanishing_points: Float64
    names: tuple[str, ...]
    values: Float64
    covariance: Float64
    residuals_px: tuple[tuple[Float64, ...], ...]
    rms_px: float
    sigma_px: float
    degrees_of_freedom: int
    lack_of_fit: LackOfFit | None
    error_model: Literal["independent", "correlated"]
    iterations: int
    alternatives: tuple[LensAlternative, ...]
    warnings: tuple[str, ...]

    @property
    def uncertainties(self) -> dict[str, float]:
        """Standard deviation of each parameter, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def centre_px(packed: PackedLines, found: Minimum) -> tuple[float, float]:
    """Return column and row of the centre [px]."""
    column, row = (packed.origin + packed.unit * found.parameters.centre).tolist()
    return column, row


def rms_px(packed: PackedLines, found: Minimum, weight: Float64 | None) -> float:
    """Return the root mean square distance [px]."""
    return packed.unit * math.sqrt(float(np.average(found.evaluation.distance**2, weights=weight)))


def _pixel_matrix(packed: PackedLines) -> Float64:
    """Return the matrix (3, 3) from packed to pixel coordinates of homogeneous points."""
    x, y = packed.origin
    return np.array([[packed.unit, 0.0, x], [0.0, packed.unit, y], [0.0, 0.0, 1.0]])


def vanishing_points_px(packed: PackedLines, found: Minimum) -> Float64:
    """Return the vanishing points of `LensFit`; for free lines the points nearest to the lines of each family."""
    points = found.parameters.vanishing
    if points is None:
        points = vanishing_start(packed, found.evaluation.lines)
    moved = points @ _pixel_matrix(packed).T
    moved /= np.linalg.norm(moved, axis=1, keepdims=True) * np.where(moved[:, 2:] < 0.0, -1.0, 1.0)
    moved[np.bincount(packed.family, minlength=packed.families) < 2] = np.nan
    return np.asarray(moved)


def parameters_px(
    packed: PackedLines, found: Minimum, covariance_matrix: Float64
) -> tuple[tuple[str, ...], Float64, Float64]:
    """Return names, values and covariance of the parameters in pixels."""
    parameters = found.parameters
    order = len(parameters.k)
    powers = packed.unit ** (-2.0 * np.arange(1, order + 1))
    names = [f"k{power}" for power in range(1, order + 1)]
    values, scale = parameters.k * powers, powers
    if order:
        names += ["C_c", "R_c"]
        values = np.concatenate([values, centre_px(packed, found)])
        scale = np.concatenate([scale, [packed.unit, packed.unit]])
    lens = len(scale)
    if parameters.vanishing is None:
        return tuple(names), values, covariance_matrix * np.outer(scale, scale)
    matrix = _pixel_matrix(packed)
    slopes, points = [], vanishing_points_px(packed, found)
    for number, (point, tangents) in enumerate(zip(points, pencil_basis(parameters.vanishing), strict=True)):
        if np.all(np.isfinite(point)):
            length = point @ (matrix @ parameters.vanishing[number])
            turned = (np.eye(3) - np.outer(point, point)) @ matrix @ tangents.T / length
            row = np.zeros((3, 2 * packed.families))
            row[:, 2 * number : 2 * number + 2] = turned
            slopes.append(row)
            names += [f"v{number}_{part}" for part in "CRw"]
            values = np.concatenate([values, point])
    slope = np.concatenate(slopes)
    tangent = np.where(np.isinf(covariance_matrix[lens:, lens:]), 0.0, covariance_matrix[lens:, lens:])
    scaled_covariance = np.empty((len(names), len(names)))
    scaled_covariance[:lens, :lens] = covariance_matrix[:lens, :lens] * np.outer(scale, scale)
    scaled_covariance[lens:, :lens] = slope @ covariance_matrix[lens:, :lens] * scale
    scaled_covariance[:lens, lens:] = scaled_covariance[lens:, :lens].T
    scaled_covariance[lens:, lens:] = slope @ tangent @ slope.T
    return tuple(names), values, scaled_covariance


def residuals_px(packed: PackedLines, found: Minimum, families: LineFamilies) -> tuple[tuple[Float64, ...], ...]:
    """Return the residuals of `LensFit`."""
    every = np.full(len(packed.used), np.nan)
    every[packed.used] = found.evaluation.distance * packed.unit
    start, sorted_out = 0, []
    for family in families:
        pieces = []
        for line in family:
            end = start + len(np.asarray(line))
            pieces.append(every[start:end])
            start = end
        sorted_out.append(tuple(pieces))
    return tuple(sorted_out)


def fit_warnings(
    fit: LensFit, packed: PackedLines, found: Minimum, straight: float, bends: float, limits: LensFitLimits
) -> Iterator[str]:
    """Yield a warning for every parameter that the data do not determine, and for a fit that has not converged.

    Parameters
    ----------
    fit, packed, found
        Fit, packed points and minimum.
    straight : float
        p-value of the test that the lines are straight without a lens.
    bends : float
        Decrease of the sum of squares by the first-order bends [variances].
    limits : LensFitLimits
        Thresholds.
    """
    if not found.converged:
        yield "the fit stopped before it converged; the uncertainties were computed at its last step"
    single = np.bincount(packed.family, minlength=packed.families) < 2
    if fit.lines == "vanishing" and single.any():
        yield f"families {np.flatnonzero(single).tolist()} have fewer than two lines, hence no vanishing point"
    robust_sigma = MAD_TO_SIGMA * packed.unit * float(np.median(np.abs(found.evaluation.distance)))
    if fit.rms_px > max(limits.max_tail_ratio * robust_sigma, _ROUNDING * packed.unit):
        yield (
            f"half of the points lie within {robust_sigma / MAD_TO_SIGMA:.3g} pixels, but the rms is {fit.rms_px:.3g}: "
            "there are outliers; use loss='tukey'"
        )
    lack = fit.lack_of_fit
    if lack and lack.p_value < limits.lack_of_fit_significance and lack.rms_px > limits.max_lack_of_fit * lack.noise_px:
        yield (
            f"the residuals form a smooth pattern of {lack.rms_px:.3g} pixels rms over the image, beside "
            f"{lack.noise_px:.3g} pixels of noise: the target is not flat, or the lens is not of model {fit.model}; "
            "the uncertainties include the pattern"
        )
    if fit.lens is None:
        return
    if found.at_bound == "fold":
        yield "the best lens would fold inside the data; it was constrained to stay invertible: the model does not suit"
    if found.at_bound == "centre":
        yield "the centre moved to its bound, far outside the data: the distortion is too small to determine it"
    if straight > limits.significance:
        yield f"the lines are as straight without a lens (p = {straight:.2g}): its parameters are noise"
    elif len(found.parameters.k) > 1 and bends < limits.min_bend_variances:
        yield (
            "the distortion is faint for several coefficients: their uncertainties are rough; use more data, or model "
            "k1"
        )
    row = fit.names.index("C_c")
    values, vectors = _axes(fit.covariance[row : row + 2, row : row + 2])
    if values[1] > limits.max_centre_sigma * packed.unit:
        x, y = vectors[:, 1]
        yield f"the data fix the centre only to {values[1]:.3g} pixels along ({x:.2f}, {y:.2f})"
    for other in fit.alternatives:
        if (
            other.rms_px <= limits.max_rms_ratio * fit.rms_px
            and other.centre_distance_px > limits.max_centre_sigmas * values[1]
        ):
            yield (
                f"{other.model} with lines {other.lines} fits as well ({other.rms_px:.4g} to {fit.rms_px:.4g} pixels), "
                f"but has its centre {other.centre_distance_px:.3g} pixels away"
            )


def _axes(covariance: Float64) -> tuple[Float64, Float64]:
    """Return the standard deviations along the principal axes, the larger one last, and the axes as columns."""
    if not np.all(np.isfinite(covariance)):
        unknown = np.isinf(np.diag(covariance))
        return np.array([0.0, math.inf]), np.eye(2)[:, [1, 0]] if unknown[0] else np.eye(2)
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values, 0.0)), vectors
