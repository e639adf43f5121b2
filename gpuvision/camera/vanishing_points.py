"""Lens calibration from straight lines: the vanishing-point method, and plumb lines that need not meet.

Straight lines stay straight in any pinhole image, tilted sensor or not, so what bends them is the lens alone
(F. de Jong, 3.3.5-3.3.6). The thesis asks parallel lines to meet in one vanishing point as well and alternates
between vanishing points and lens (`gpuvision.camera.strategies`). Here all is minimised at once: the lines are
eliminated in closed form, vanishing points are unit vectors, so that one at infinity is a point like any other, and
distances are those in the measured image (`gpuvision.camera.straightness`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.camera.line_families import Float64, LineFamilies, PackedLines, pack
from gpuvision.camera.line_statistics import (
    Loss,
    chance,
    covariance,
    line_parameters,
    noise_dimensions,
    reweighted,
    robust_covariance,
    same_points,
)
from gpuvision.camera.strategies import STRATEGIES, alternate
from gpuvision.camera.straightness import Evaluation, Parameters, evaluate, pencil_basis
from gpuvision.camera.variable_projection import Minimum, linear_start, minimise, vanishing_start
from gpuvision.tables import finite, numbers

LensModel = Literal["none", "k1", "k1,k2"]
Meeting = Literal["auto", "vanishing", "free"]
Strategies = Literal["variable_projection", "nelder_mead", "steepest_descent", "gauss_newton"]

_ORDERS: dict[str, int] = {"none": 0, "k1": 1, "k1,k2": 2}
_MODELS: tuple[LensModel, ...] = ("none", "k1", "k1,k2")
_REJECTED = 0.01
"""Probability below which a smaller model does not suffice."""
_AS_WELL = 1.01
"""Ratio of rms up to which an alternative fits as well."""
_VAGUE = 0.25
"""Standard deviation of the centre, in half-diagonals, from which the data are said not to fix it."""


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
        Probability that the largest model fits that much better though this one is true: it is rejected below 0.01.
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
        Root mean square of these distances.
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
    def standard_errors(self) -> dict[str, float]:
        """Standard deviation of each parameter by its name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def straightness_px(lines: LineFamilies, model: Any = None) -> float:
    """Root mean square distance of corrected points from the best straight lines, free of the correction's scale.

    Parameters
    ----------
    lines
        Families of measured lines.
    model
        Anything with ``undistort(points)``; None: the points as they are.

    Returns
    -------
    float
        Pixels: the distances are divided by the ratio of the points' spread after to before.
    """
    packed = pack(lines)
    before = np.stack([packed.x, packed.y], axis=-1) * packed.unit + packed.origin
    after = before if model is None else np.asarray(model.undistort(before))
    scale = math.sqrt(np.sum(np.var(after, axis=0)) / np.sum(np.var(before, axis=0))) * packed.unit
    x, y = ((after - np.mean(after, axis=0)) / scale).T
    here = evaluate(replace(packed, x=x, y=y), Parameters(np.empty(0), np.zeros(2), None))
    return math.sqrt(here.cost / len(x)) * packed.unit


def fit_lens(
    families: LineFamilies,
    *,
    model: LensModel | Literal["auto"] = "auto",
    lines: Meeting = "auto",
    centre: tuple[float, float] | None = None,
    sigma: float | None = None,
    loss: Loss = "squared",
    strategy: Strategies = "variable_projection",
) -> LensFit:
    """Find the lens that makes measured lines straight.

    Parameters
    ----------
    families
        Families of lines that are parallel in the scene, each line an array (points, 2) of (column, row) in pixels,
        in any image that the lens took: `gpuvision.camera.line_families.grid_lines` makes them from a grid. NaN
        points and lines of fewer than three points are left out.
    model
        Distortion coefficients; "auto": the smallest model that an F test does not reject against the largest.
    lines
        "vanishing": the undistorted lines of a family meet in one point, which may be at infinity; "free": they are
        straight, no more, as on a target that is not quite regular; "auto": by an F test.
    centre
        (column, row) of the distortion's centre in pixels if it is known.
    sigma
        Standard deviation of a measured coordinate in pixels; None: estimated from the residuals.
    loss
        "squared", or "huber" or "tukey" against outliers.
    strategy
        "variable_projection", or one of the thesis' alternating minimisations, for comparison: they need
        ``lines="vanishing"``, a model and the squared loss.

    Returns
    -------
    LensFit

    Raises
    ------
    ValueError
        If the lines cannot fix the lens: the message says what they lack.
    """
    if model not in ("auto", *_MODELS):
        raise ValueError(f"model is {model!r}, expected 'auto' or one of {', '.join(map(repr, _MODELS))}")
    for name, value, known in (
        ("lines", lines, ("auto", "vanishing", "free")),
        ("loss", loss, ("squared", "huber", "tukey")),
        ("strategy", strategy, ("variable_projection", *STRATEGIES)),
    ):
        if value not in known:
            raise ValueError(f"{name} is {value!r}, expected one of {', '.join(map(repr, known))}")
    if sigma is not None and not finite(sigma, "sigma") > 0.0:
        raise ValueError(f"sigma is {sigma}, expected more than 0 pixels")
    packed = pack(families)
    known = None if centre is None else (np.array(numbers(centre, (2,), "centre")) - packed.origin) / packed.unit
    search = _Search(packed, known, None if sigma is None else sigma / packed.unit, loss)
    if strategy != "variable_projection":
        if lines != "vanishing" or model in ("auto", "none") or loss != "squared" or centre is not None:
            raise ValueError(f"strategy {strategy!r} needs lines='vanishing', a model with k1, and the squared loss")
        search.check(_ORDERS[model], meet=True)
        search.fits[_ORDERS[model], True] = alternate(packed, _ORDERS[model], strategy).minimum
    orders = [_ORDERS[model]] if model != "auto" else search.possible_orders()
    order, meet = search.choose(orders, lines)
    return _report(search, order, meet, families)


class _Search:
    """Fits of one set of lines, made when they are asked for; each starts from a smaller one."""

    def __init__(self, packed: PackedLines, centre: Float64 | None, sigma: float | None, loss: Loss) -> None:
        self.packed, self.sigma, self.loss = packed, sigma, loss
        self.keep_centre = centre is not None
        self.centre = np.zeros(2) if centre is None else centre
        self.fits: dict[tuple[int, bool], Minimum] = {}
        self.owner = same_points(packed)
        self.independent = noise_dimensions(self.owner)
        self.weight: Float64 | None = None
        self.scale = 0.0
        self.start, self.rank = linear_start(packed, self.centre if self.keep_centre else None)

    @property
    def can_meet(self) -> bool:
        """Whether a family has lines that could meet."""
        return bool(np.max(np.bincount(self.packed.family)) > 1)

    def parameters(self, order: int, meet: bool) -> int:
        """How many there are, those of the lines among them."""
        at = self.fits[order, meet].at
        return order + (2 if order and not self.keep_centre else 0) + line_parameters(self.packed, at)

    def freedom(self, order: int, meet: bool) -> int:
        """Residuals less parameters."""
        return len(self.packed.x) - self.parameters(order, meet)

    def check(self, order: int, *, meet: bool) -> None:
        """Raise a ValueError if the lines cannot fix a model."""
        needed = 1 if self.keep_centre else 2
        if order and self.rank < needed:
            raise ValueError(
                f"the lines ({len(self.packed.counts)}, all on one straight line) bend in one way only, which k1 and "
                "the centre share; expected lines at several distances from the centre, or the centre"
                if not self.keep_centre
                else "all lines go through the centre, where no lens bends them; expected lines beside it"
            )
        if meet and not self.can_meet:
            raise ValueError("no family has two lines, so none has a vanishing point; expected more, or lines='free'")
        sought = order + (2 if order and not self.keep_centre else 0)
        left = len(self.packed.x) - 2 * len(self.packed.counts)
        if not meet and left <= sought:
            raise ValueError(
                f"{len(self.packed.x)} points on {len(self.packed.counts)} lines leave {left} numbers for "
                f"{sought} parameters and the errors; expected more points on the lines"
            )

    def possible_orders(self) -> list[int]:
        """Return what "auto" chooses from; at least none and k1 have to be possible."""
        self.check(1, meet=False)
        left = len(self.packed.x) - 2 * len(self.packed.counts)
        return [0, 1, 2] if left > 4 else [0, 1]

    def fit(self, order: int, meet: bool) -> Minimum:
        """Fit a model."""
        if (order, meet) not in self.fits:
            self.fits[order, meet] = self._fitted(order, meet)
        return self.fits[order, meet]

    def _fitted(self, order: int, meet: bool) -> Minimum:
        self.check(order, meet=meet)
        start, here = self._beginning(order, meet)
        found = minimise(self.packed, start, here, weight=self.weight, keep_centre=self.keep_centre)
        if self.loss == "squared" or self.weight is not None:
            return found
        found, self.weight, self.scale = reweighted(
            self.packed, found, self.loss, self.sigma, keep_centre=self.keep_centre
        )
        # Squared sums compare under the same weights only.
        self.fits.clear()
        return found

    def _beginning(self, order: int, meet: bool) -> tuple[Parameters, Evaluation | None]:
        if meet:
            free = self.fit(order, False) if (order, True) not in self.fits else self.fits[order, True]
            return free.at._replace(vanishing=vanishing_start(self.packed, free.here.lines)), None
        if order == 0:
            return Parameters(np.empty(0), self.centre, None), None
        smaller = self.fits.get((order - 1, False))
        if order == 2 and smaller is not None:
            return smaller.at._replace(k=np.append(smaller.at.k, 0.0)), smaller.here
        return self.start._replace(k=np.append(self.start.k, np.zeros(order - 1))), None

    def chance(self, smaller: tuple[int, bool], larger: tuple[int, bool]) -> float:
        """Probability of the larger fit's gain if the smaller one is true."""
        worse, better = self.fit(*smaller), self.fit(*larger)
        more = self.parameters(*larger) - self.parameters(*smaller)
        residuals = (len(self.packed.x), self.independent)
        variance = None if self.sigma is None else self.sigma**2
        return chance(worse.here.cost, better.here.cost, more, residuals, self.freedom(*larger), variance)

    def choose(self, orders: list[int], lines: Meeting) -> tuple[int, bool]:
        """Fit what is asked for and return the smallest sufficient model."""
        largest = orders[-1]
        if lines == "auto":
            self.fit(largest, False)
            meet = self.can_meet and self.chance((largest, True), (largest, False)) > _REJECTED
        else:
            meet = lines == "vanishing"
        for order in orders:
            if self.chance((order, meet), (largest, meet)) > _REJECTED:
                return order, meet
        raise AssertionError("the largest model is not rejected against itself")


def _report(search: _Search, order: int, meet: bool, families: LineFamilies) -> LensFit:
    packed, found = search.packed, search.fit(order, meet)
    freedom = search.freedom(order, meet)
    if freedom <= 0:
        raise ValueError(
            f"{len(packed.x)} points on {len(packed.counts)} lines leave nothing to estimate the errors from; "
            "expected more points on the lines"
        )
    sigma = search.sigma or search.scale or math.sqrt(found.here.cost / freedom)
    if search.weight is None:
        spread = covariance(packed, found, search.owner, sigma**2, keep_centre=search.keep_centre)
    else:
        spread = robust_covariance(
            packed, found, search.owner, search.weight, search.loss, search.scale, keep_centre=search.keep_centre
        )
    names, values, scaled = _in_pixels(packed, found, spread)
    alternatives = _alternatives(search, order, meet)
    fit = LensFit(
        lens=None
        if order == 0
        else Lens(k1=values[0], k2=values[1] if order > 1 else 0.0, centre=_centre(packed, found)),
        model=_MODELS[order],
        lines="vanishing" if meet else "free",
        vanishing_points=_points_in_pixels(packed, found),
        names=names,
        values=values,
        covariance=scaled,
        residuals_px=_residuals(packed, found, families),
        rms_px=_rms(packed, found),
        sigma_px=sigma * packed.unit,
        degrees_of_freedom=freedom,
        iterations=sum(each.steps for each in search.fits.values()),
        alternatives=alternatives,
        warnings=(),
    )
    return replace(fit, warnings=tuple(_warnings(fit, found, packed)))


def _centre(packed: PackedLines, found: Minimum) -> tuple[float, float]:
    column, row = (packed.origin + packed.unit * found.at.centre).tolist()
    return column, row


def _rms(packed: PackedLines, found: Minimum) -> float:
    return packed.unit * math.sqrt(float(np.mean(found.here.distance**2)))


def _pixel_matrix(packed: PackedLines) -> Float64:
    """Packed -> pixel coordinates, of homogeneous points."""
    x, y = packed.origin
    return np.array([[packed.unit, 0.0, x], [0.0, packed.unit, y], [0.0, 0.0, 1.0]])


def _points_in_pixels(packed: PackedLines, found: Minimum) -> Float64:
    points = found.at.vanishing
    if points is None:
        points = vanishing_start(packed, found.here.lines)
    moved = points @ _pixel_matrix(packed).T
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    moved[np.bincount(packed.family, minlength=packed.families) < 2] = np.nan
    return np.asarray(moved)


def _in_pixels(packed: PackedLines, found: Minimum, spread: Float64) -> tuple[tuple[str, ...], Float64, Float64]:
    """Return names, values and covariance of the parameters."""
    at = found.at
    order = len(at.k)
    powers = packed.unit ** (-2.0 * np.arange(1, order + 1))
    names = [f"k{power}" for power in range(1, order + 1)]
    values, scale = at.k * powers, powers
    if order:
        names += ["C_c", "R_c"]
        values = np.concatenate([values, _centre(packed, found)])
        scale = np.concatenate([scale, [packed.unit, packed.unit]])
    lens = len(scale)
    if at.vanishing is None:
        return tuple(names), values, spread * np.outer(scale, scale)
    matrix = _pixel_matrix(packed)
    slopes, points = [], _points_in_pixels(packed, found)
    for number, (point, tangents) in enumerate(zip(points, pencil_basis(at.vanishing), strict=True)):
        if np.all(np.isfinite(point)):
            length = np.linalg.norm(matrix @ at.vanishing[number])
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


def _residuals(packed: PackedLines, found: Minimum, families: LineFamilies) -> tuple[tuple[Float64, ...], ...]:
    every = np.full(len(packed.used), np.nan)
    every[packed.used] = found.here.distance * packed.unit
    ends = iter(np.cumsum([len(line) for family in families for line in family]))  # type: ignore[arg-type]
    start, sorted_out = 0, []
    for family in families:
        pieces = []
        for _ in family:
            end = next(ends)
            pieces.append(every[start:end])
            start = end
        sorted_out.append(tuple(pieces))
    return tuple(sorted_out)


def _alternatives(search: _Search, order: int, meet: bool) -> tuple[LensAlternative, ...]:
    chosen = search.fit(order, meet)
    largest = max(search.fits, key=lambda each: (each[0], not each[1]))
    found = []
    for number, with_points in sorted(search.fits):
        if (number, with_points) == (order, meet):
            continue
        other = search.fits[number, with_points]
        apart = math.nan
        if number and order:
            apart = search.packed.unit * float(np.hypot(*(other.at.centre - chosen.at.centre)))
        more = search.parameters(number, with_points) - search.parameters(order, meet)
        ratio = other.here.cost / chosen.here.cost if chosen.here.cost > 0.0 else 1.0
        found.append(
            LensAlternative(
                model=_MODELS[number],
                lines="vanishing" if with_points else "free",
                rms_px=_rms(search.packed, other),
                p_value=search.chance((number, with_points), largest),
                aic=search.independent * math.log(ratio) + 2.0 * more if ratio > 0.0 else -math.inf,
                centre=_centre(search.packed, other) if number else None,
                centre_distance_px=apart,
            )
        )
    return tuple(found)


def _warnings(fit: LensFit, found: Minimum, packed: PackedLines) -> Iterator[str]:
    """Say what the data cannot fix."""
    single = np.bincount(packed.family, minlength=packed.families) < 2
    if fit.lines == "vanishing" and single.any():
        yield f"families {np.flatnonzero(single).tolist()} have fewer than two lines, hence no vanishing point"
    if found.at_bound == "fold":
        yield "the best lens would fold the image inside the data; it was kept just from that: the model does not suit"
    if fit.lens is None:
        return
    errors = fit.standard_errors
    row = fit.names.index("C_c")
    values, vectors = _axes(fit.covariance[row : row + 2, row : row + 2])
    if values[1] > _VAGUE * packed.unit:
        x, y = vectors[:, 1]
        yield f"the data fix the centre only to {values[1]:.3g} pixels along ({x:.2f}, {y:.2f})"
    if found.at_bound == "centre":
        yield "the data pull the centre out of sight: there is too little distortion to find it"
    if fit.model == "k1" and abs(fit.lens.k1) < 2.0 * errors["k1"]:
        yield f"no distortion fits as well: k1 is {fit.lens.k1:.2g} +- {errors['k1']:.1g}"
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
