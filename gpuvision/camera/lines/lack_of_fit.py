"""Lack of fit of a lens model: smooth residual fields, correlated residuals, and the covariance that includes them.

The F test between nested lens models cannot see an error that no model describes: a bent target, a decentred lens, a
dot finder that pulls. Such an error is smooth over the image. `smooth_residuals` compares the residuals with a free
smooth displacement field: products of Legendre polynomials of both coordinates, of total degree 2 to 7, in both
components. Lines and lens absorb a part of the field; the test sees the rest.

An error of this kind is one draw of a random field, not one draw per point, so more points do not average it out.
`correlated_covariance` adds two parts:

- The smooth field with a falling spectrum. The variance per mode is estimated for every degree. Degrees that lens and
  lines absorb cannot be seen; their amplitude is extrapolated from the higher degrees by the spectrum 1/degree^2, of
  surfaces with equal bending energy in all modes.
- The remaining residuals, clustered by line and by image block (two-way clusters, each with the delete-one jackknife,
  which is the sandwich estimator with the small-sample correction CR3).

References
----------
M. Kennedy and A. O'Hagan, Bayesian calibration of computer models, J. R. Statist. Soc. B 63 (2001) 425. A. Cameron, J.
Gelbach and D. Miller, Robust inference with multiway clustering, J. Bus. Econ. Stat. 29 (2011) 238. R. Bell and D.
McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples, Survey Methodology 28
(2002) 169.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from gpuvision.camera.lines.line_families import Float64, Index, PackedLines
from gpuvision.camera.lines.line_statistics import image_normals, p_value_of_gain
from gpuvision.camera.lines.normal_equations import ResidualJacobian, line_coefficients, projected_columns
from gpuvision.camera.lines.variable_projection import Minimum
from gpuvision.camera.smooth_field import LackOfFit, mode_variances, not_below
from gpuvision.jackknife import cluster_jackknife

# Degrees of the smooth field. Lines absorb the linear part. Degree 7 resolves a third of the image.
_DEGREES = (2, 7)
# Degrees of freedom per mode of the field, at least: with fewer, the noise is not known.
_FREEDOM_PER_MODE = 4
# Mean square of a mode that lines and lens leave over, relative to the mode, below which the data do not show the mode.
# Measured: below 1e-4 the rest of a mode is its nonlinearity, which follows the noise of the lines' directions.
_SEEN_MODE = 1e-3
# Blocks along each side of the image for the clusters.
_BLOCKS = 4


@dataclass(frozen=True)
class SmoothResiduals:
    """Smooth field fitted to the residuals, in packed coordinates.

    Attributes
    ----------
    lack_of_fit
        Result of the test.
    degree
        Degree of each mode (modes,).
    columns
        Effect of each mode on the residuals, with the lines projected out (modes, n).
    seen
        The same with the lens and the vanishing points projected out as well (modes, n).
    variance
        Variance of the remaining residuals.
    residual, rest
        Residuals (n,), and residuals less the fitted field (n,).
    """

    lack_of_fit: LackOfFit
    degree: npt.NDArray[np.intp]
    columns: Float64
    seen: Float64
    variance: float
    residual: Float64
    rest: Float64


def smooth_residuals(
    packed: PackedLines, found: Minimum, degrees_of_freedom: int, independent: int, variance: float | None
) -> SmoothResiduals:
    """Fit a free smooth displacement field to the residuals and test it.

    Parameters
    ----------
    packed, found
        Packed points and minimum.
    degrees_of_freedom : int
        Residuals minus parameters of the fit.
    independent : int
        Number of independent errors among the residuals.
    variance : float or None
        Known variance of a residual, if any.
    """
    residual = found.evaluation.residual
    columns, degree = _field(packed, found, degrees_of_freedom * independent // (len(residual) * _FREEDOM_PER_MODE))
    lens = _lens_columns(packed, found)
    basis = np.linalg.qr(lens.T)[0] if len(lens) else np.empty((len(residual), 0))
    seen = columns - (columns @ basis) @ basis.T
    values, vectors = np.linalg.eigh(seen @ seen.T) if len(seen) else (np.empty(0), np.empty((0, 0)))
    kept = values > _SEEN_MODE * len(residual)
    modes = int(np.count_nonzero(kept))
    # Least-squares field: residual less its projection on the kept modes.
    turned = vectors[:, kept] / np.sqrt(values[kept])
    coefficients = turned.T @ (seen @ residual)
    rest = residual - (turned @ coefficients) @ seen if modes else residual
    gain, left = float(coefficients @ coefficients), max(degrees_of_freedom - modes, 1)
    noise = max(found.evaluation.cost - gain, 0.0) / left
    p_value = p_value_of_gain(
        found.evaluation.cost,
        found.evaluation.cost - gain,
        modes,
        (len(residual), independent),
        degrees_of_freedom - modes,
        variance,
    )
    surplus = max(gain - modes * noise, 0.0) / len(residual)
    lack = LackOfFit(
        p_value=p_value,
        rms_px=packed.unit * math.sqrt(surplus),
        noise_px=packed.unit * math.sqrt(noise),
        modes=modes,
    )
    return SmoothResiduals(lack, degree, columns, seen, noise, residual, rest)


def correlated_covariance(packed: PackedLines, found: Minimum, smooth: SmoothResiduals, white: Float64) -> Float64:
    """Return the covariance of the parameters for correlated residuals; in no direction is it below ``white``.

    Parameters
    ----------
    packed, found
        Packed points and minimum.
    smooth : SmoothResiduals
        Result of `smooth_residuals`.
    white : numpy.ndarray
        (m, m): covariance of (k..., centre, two tangents per vanishing point) for independent errors. Its infinite and
        zero variances stay: parameters that the data do not determine, and known ones.
    """
    kept = np.flatnonzero(np.isfinite(white.diagonal()) & (white.diagonal() > 0.0))
    scale = np.sqrt(white.diagonal()[kept])
    # In units of the standard deviations for independent errors.
    columns = _lens_columns(packed, found)[kept] * scale[:, None]
    normal = columns @ columns.T
    shifts = np.linalg.lstsq(normal, columns @ smooth.columns.T, rcond=None)[0]
    seen = smooth.seen @ smooth.seen.T
    by_degree = mode_variances(
        smooth.degree, seen, smooth.seen @ smooth.residual, smooth.variance, len(smooth.residual)
    )
    field = (shifts * by_degree[smooth.degree]) @ shifts.T
    block = _blocks(packed)
    clusters = (packed.line, block, packed.line * _BLOCKS**2 + block)
    by_line, by_block, by_both = (cluster_jackknife(columns, normal, smooth.rest, each) for each in clusters)
    least = white[np.ix_(kept, kept)] / np.outer(scale, scale)
    total = np.array(white)
    total[np.ix_(kept, kept)] = (field + not_below(by_line + by_block - by_both, least)) * np.outer(scale, scale)
    return total


def _lens_columns(packed: PackedLines, found: Minimum) -> Float64:
    """Return the Jacobian (parameters, n) of lens and vanishing points, with the lines projected out."""
    return projected_columns(packed, found.parameters, found.evaluation, found.slopes, found.normal.line_coefficients)


def _field(packed: PackedLines, found: Minimum, most: int) -> tuple[Float64, npt.NDArray[np.intp]]:
    """Return the effects (modes, n) of at most ``most`` modes on the residuals, lines projected out, and degrees."""
    first, last = _DEGREES
    while last >= first and sum(2 * (n + 1) for n in range(first, last + 1)) > most:
        last -= 1
    if last < first:
        return np.empty((0, len(packed.x))), np.empty(0, dtype=np.intp)
    corner = np.maximum(packed.corner, np.finfo(np.float64).tiny)
    # Legendre polynomials with a mean square of 1 over the bounding box.
    norm = np.sqrt(2.0 * np.arange(last + 1) + 1.0)
    x, y = (
        legendre.legvander(np.clip(a, -1.0, 1.0), last).T * norm[:, None]
        for a in (packed.x / corner[0], packed.y / corner[1])
    )
    normals = image_normals(found)
    rows, degree = [], []
    for n in range(first, last + 1):
        for power in range(n + 1):
            shape = x[power] * y[n - power]
            rows += [normals[0] * shape, normals[1] * shape]
            degree += [n, n]
    field = np.array(rows)
    slopes = ResidualJacobian(field, found.slopes.line)
    coefficients = line_coefficients(packed, found.parameters, found.evaluation, slopes)
    for column, part in zip(slopes.line, coefficients, strict=True):
        field -= column * np.repeat(part, packed.counts, axis=1)
    return field, np.array(degree)


def _blocks(packed: PackedLines) -> Index:
    """Return the image block (n,) of each point: 4 x 4 equal parts of the bounding box."""
    column, row = (
        np.clip(((place / corner + 1.0) * (0.5 * _BLOCKS)).astype(np.intp), 0, _BLOCKS - 1)
        for place, corner in zip((packed.x, packed.y), np.maximum(packed.corner, np.finfo(float).tiny), strict=True)
    )
    return np.asarray(row * _BLOCKS + column)
