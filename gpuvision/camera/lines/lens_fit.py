"""A lens from straight lines as its user sees it: in pixels, with uncertainties, alternatives and warnings."""

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

LensModel = Literal["none", "k1", "k1,k2"]
Meeting = Literal["auto", "vanishing", "free"]

MODELS: tuple[LensModel, ...] = ("none", "k1", "k1,k2")
"""By the number of their coefficients."""
REJECTED = 0.05
"""Probability below which a smaller model does not suffice."""
_AS_WELL = 1.01
"""Ratio of rms up to which an alternative fits as well."""
_VAGUE = 0.1
"""Standard deviation of the centre, in half-diagonals, from which the data are said not to fix it."""

_NORMAL_MAD = 1.4826
_ROUNDING = 1e-9
_TAILED = 2.0
"""Ratio of rms to what half of the points suggest, from which errors are not normal."""
_FAINT = 100.0
"""Variances that bends have to explain for linear uncertainties of k1 beside k2 to hold."""


@dataclass(frozen=True, kw_only=True)
class LensAlternative:
    """A model that was fitted too.

    Attributes
    ----------
    model
        Its distortion coefficients.
    lines
        "vanishing" where the lines of a family meet in one point.
    rms_px
        As in `LensFit`.
    p_value
        Probability that the largest model fits that much better though this one is true: it is rejected below 0.05.
        Against vanishing points where both this one and the chosen one have them, otherwise against free lines.
    aic
        Akaike's criterion, less that of the chosen model: negative where this one would be preferred.
    centre
        (column, row); None for "none".
    centre_distance_px
        From the chosen model's centre; NaN where one of them has none.
    """

    model: LensModel
    lines: Meeting
    rms_px: float
    p_value: float
    aic: float
    centre: tuple[float, float] | None
    centre_distance_px: float


@dataclass(frozen=True, kw_only=True)
class LensFit:
    """A lens from straight lines.

    Attributes
    ----------
    lens
        Measured -> undistorted, in pixels; None where the data ask for none.
    model
        Its coefficients.
    lines
        "vanishing" where the lines of each family were asked to meet in one point, or "free".
    vanishing_points
        (families, 3), unit homogeneous (column, row, 1), undistorted; the one at infinity has a last component of 0.
        NaN for a family of fewer than two lines.
    names, values, covariance
        Of the parameters: k1 [px^-2], k2 [px^-4], C_c, R_c [px] and, where lines meet, the three components of
        each vanishing point.
    residuals_px
        Per family, for each line in turn an array of distances from the line in the measured image; NaN where a
        point or its line was not used.
    rms_px
        Root mean square of these distances; of weighted ones where outliers were given less weight.
    sigma_px
        Error of a coordinate: given, or estimated from the residuals and the degrees of freedom.
    degrees_of_freedom
        Residuals less parameters, those of the lines among them.
    iterations
        Steps of the minimisation.
    alternatives
        Other models, where there was a choice.
    warnings
        What the data cannot fix.
    """

    lens: Lens | None
    model: LensModel
    lines: Meeting
    vanishing_points: Float64
    names: tuple[str, ...]
    values: Float64
    covariance: Float64
    residuals_px: tuple[tuple[Float64, ...], ...]
    rms_px: float
    sigma_px: float
    degrees_of_freedom: int
    iterations: int
    alternatives: tuple[LensAlternative, ...]
    warnings: tuple[str, ...]

    @property
    def uncertainties(self) -> dict[str, float]:
        """Standard deviation of each parameter by its name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def centre_px(packed: PackedLines, found: Minimum) -> tuple[float, float]:
    """Column and row of the centre."""
    column, row = (packed.origin + packed.unit * found.at.centre).tolist()
    return column, row


def rms_px(packed: PackedLines, found: Minimum, weight: Float64 | None) -> float:
    """Root mean square distance."""
    return packed.unit * math.sqrt(float(np.average(found.here.distance**2, weights=weight)))


def _pixel_matrix(packed: PackedLines) -> Float64:
    """Packed -> pixel coordinates, of homogeneous points."""
    x, y = packed.origin
    return np.array([[packed.unit, 0.0, x], [0.0, packed.unit, y], [0.0, 0.0, 1.0]])


def points_px(packed: PackedLines, found: Minimum) -> Float64:
    """Vanishing points as in `LensFit`; where lines were free, the points nearest to them."""
    points = found.at.vanishing
    if points is None:
        points = vanishing_start(packed, found.here.lines)
    moved = points @ _pixel_matrix(packed).T
    moved /= np.linalg.norm(moved, axis=1, keepdims=True) * np.where(moved[:, 2:] < 0.0, -1.0, 1.0)
    moved[np.bincount(packed.family, minlength=packed.families) < 2] = np.nan
    return np.asarray(moved)


def parameters_px(packed: PackedLines, found: Minimum, spread: Float64) -> tuple[tuple[str, ...], Float64, Float64]:
    """Return names, values and covariance of the parameters."""
    at = found.at
    order = len(at.k)
    powers = packed.unit ** (-2.0 * np.arange(1, order + 1))
    names = [f"k{power}" for power in range(1, order + 1)]
    values, scale = at.k * powers, powers
    if order:
        names += ["C_c", "R_c"]
        values = np.concatenate([values, centre_px(packed, found)])
        scale = np.concatenate([scale, [packed.unit, packed.unit]])
    lens = len(scale)
    if at.vanishing is None:
        return tuple(names), values, spread * np.outer(scale, scale)
    matrix = _pixel_matrix(packed)
    slopes, points = [], points_px(packed, found)
    for number, (point, tangents) in enumerate(zip(points, pencil_basis(at.vanishing), strict=True)):
        if np.all(np.isfinite(point)):
            length = point @ (matrix @ at.vanishing[number])
            turned = (np.eye(3) - np.outer(point, point)) @ matrix @ tangents.T / length
            row = np.zeros((3, 2 * packed.families))
            row[:, 2 * number : 2 * number + 2] = turned
            slopes.append(row)
            names += [f"v{number}_{part}" for part in "CRw"]
            values = np.concatenate([values, point])
    slope = np.concatenate(slopes)
    tangent = np.where(np.isinf(spread[lens:, lens:]), 0.0, spread[lens:, lens:])
    found_spread = np.empty((len(names), len(names)))
    found_spread[:lens, :lens] = spread[:lens, :lens] * np.outer(scale, scale)
    found_spread[lens:, :lens] = slope @ spread[lens:, :lens] * scale
    found_spread[:lens, lens:] = found_spread[lens:, :lens].T
    found_spread[lens:, lens:] = slope @ tangent @ slope.T
    return tuple(names), values, found_spread


def residuals_px(packed: PackedLines, found: Minimum, families: LineFamilies) -> tuple[tuple[Float64, ...], ...]:
    """Distances as in `LensFit`."""
    every = np.full(len(packed.used), np.nan)
    every[packed.used] = found.here.distance * packed.unit
    start, sorted_out = 0, []
    for family in families:
        pieces = []
        for line in family:
            end = start + len(np.asarray(line))
            pieces.append(every[start:end])
            start = end
        sorted_out.append(tuple(pieces))
    return tuple(sorted_out)


def warnings_of(fit: LensFit, packed: PackedLines, found: Minimum, straight: float, bends: float) -> Iterator[str]:
    """Say what the data cannot fix.

    Parameters
    ----------
    fit, packed, found
        The fit, its points, and the minimum that it is.
    straight
        Probability of such bends of the lines without any lens.
    bends
        By how many variances the bends lower the sum of squares.
    """
    single = np.bincount(packed.family, minlength=packed.families) < 2
    if fit.lines == "vanishing" and single.any():
        yield f"families {np.flatnonzero(single).tolist()} have fewer than two lines, hence no vanishing point"
    usual = _NORMAL_MAD * packed.unit * float(np.median(np.abs(found.here.distance)))
    if fit.rms_px > max(_TAILED * usual, _ROUNDING * packed.unit):
        yield (
            f"half of the points lie within {usual / _NORMAL_MAD:.3g} pixels, but the rms is {fit.rms_px:.3g}: "
            "there are outliers; use loss='tukey'"
        )
    if fit.lens is None:
        return
    if found.at_bound == "fold":
        yield "the best lens would fold the image inside the data; it was kept just from that: the model does not suit"
    if found.at_bound == "centre":
        yield "the data pull the centre out of sight: there is too little distortion to find it"
    if straight > REJECTED:
        yield f"the lines are as straight without a lens (p = {straight:.2g}): its parameters are noise"
    elif fit.model == "k1,k2" and bends < _FAINT:
        yield "the distortion is faint for two coefficients: their uncertainties are rough; expected more data, or k1"
    row = fit.names.index("C_c")
    values, vectors = _axes(fit.covariance[row : row + 2, row : row + 2])
    if values[1] > _VAGUE * packed.unit:
        x, y = vectors[:, 1]
        yield f"the data fix the centre only to {values[1]:.3g} pixels along ({x:.2f}, {y:.2f})"
    for other in fit.alternatives:
        if other.rms_px <= _AS_WELL * fit.rms_px and other.centre_distance_px > 3.0 * values[1]:
            yield (
                f"{other.model} with lines {other.lines} fits as well ({other.rms_px:.4g} to {fit.rms_px:.4g} pixels), "
                f"but has its centre {other.centre_distance_px:.3g} pixels away"
            )


def _axes(covariance: Float64) -> tuple[Float64, Float64]:
    """Return standard deviations along the axes of an ellipse, the longer one last, and the axes as columns."""
    if not np.all(np.isfinite(covariance)):
        unknown = np.isinf(np.diag(covariance))
        return np.array([0.0, math.inf]), np.eye(2)[:, [1, 0]] if unknown[0] else np.eye(2)
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values, 0.0)), vectors
