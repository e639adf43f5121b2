"""Lens calibration from straight lines: vanishing-point method and plumb-line method.

Straight lines are straight in every pinhole image, with a tilted sensor as well, so only the lens bends them. The
plumb-line method uses no other constraint. The vanishing-point method also constrains lines that are parallel in the
scene to meet in one vanishing point. The thesis alternates between vanishing points and lens
(`gpuvision.camera.lines.alternating_minimisation`). `fit_lens` minimises over both at once: the lines are eliminated in
closed form, vanishing points are unit vectors (regular at infinity), and distances are measured in the distorted image
(`gpuvision.camera.lines.straightness`).

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.5-3.3.6.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from scipy.special import fdtrc

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.alternating_minimisation import ALTERNATING_SOLVERS, minimise_alternating
from gpuvision.camera.lines.lack_of_fit import SmoothResiduals, correlated_covariance, smooth_residuals
from gpuvision.camera.lines.lens_fit import (
    MODELS,
    LensAlternative,
    LensFit,
    LensFitLimits,
    LensModel,
    LineConstraint,
    centre_px,
    fit_warnings,
    parameters_px,
    residuals_px,
    rms_px,
    vanishing_points_px,
)
from gpuvision.camera.lines.line_families import Float64, LineFamilies, PackedLines, pack
from gpuvision.camera.lines.line_statistics import (
    Loss,
    count_independent_errors,
    count_line_parameters,
    covariance,
    fit_reweighted,
    p_value_of_gain,
    point_identifiers,
    robust_covariance,
    robust_start,
)
from gpuvision.camera.lines.straightness import Evaluation, Parameters, evaluate
from gpuvision.camera.lines.variable_projection import Minimum, linear_start, minimise, vanishing_start
from gpuvision.validation import finite, numbers

# Largest number of coefficients that are fitted from the closed-form start.
_MAX_DIRECT_ORDER = 2

Solver = Literal["variable_projection", "nelder_mead", "steepest_descent", "gauss_newton"]


def straightness_px(lines: LineFamilies, model: Any = None) -> float:
    """Return the root mean square distance of corrected points from the best straight lines, independent of scale.

    Parameters
    ----------
    lines : sequence
        Families of measured lines, each line an array (n, 2) of (column, row) [px].
    model : Lens, Camera or any object with ``undistort(points)``, optional
        Correction. Default: none.

    Returns
    -------
    float
        Distance [px], divided by the ratio of the points' standard deviations after and before the correction.
    """
    packed = pack(lines)
    before = np.stack([packed.x, packed.y], axis=-1) * packed.unit + packed.origin
    after = before if model is None else np.asarray(model.undistort(before))
    scale = math.sqrt(np.sum(np.var(after, axis=0)) / np.sum(np.var(before, axis=0))) * packed.unit
    x, y = ((after - np.mean(after, axis=0)) / scale).T
    evaluation = evaluate(replace(packed, x=x, y=y), Parameters(np.empty(0), np.zeros(2), None))
    return math.sqrt(evaluation.cost / len(x)) * packed.unit


def fit_lens(
    families: LineFamilies,
    *,
    model: LensModel | Literal["auto"] = "auto",
    lines: LineConstraint = "auto",
    centre: tuple[float, float] | None = None,
    sigma: float | None = None,
    loss: Loss = "squared",
    solver: Solver = "variable_projection",
    error_model: Literal["auto", "independent"] = "auto",
    limits: LensFitLimits = LensFitLimits(),
) -> LensFit:
    """Fit the lens that makes measured lines straight.

    Parameters
    ----------
    families : sequence
        Families of lines that are parallel in the scene, each line an array (n, 2) of (column, row) [px], from one or
        several images of one lens. `gpuvision.camera.lines.line_families.grid_lines` makes them from a grid. NaN points
        and lines of fewer than three points are ignored.
    model : {"auto", "none", "k1", "k1,k2", "k1,k2,k3", "k1,k2,k3,k4"}
        Distortion coefficients. "auto" (default): the smallest model that an F test accepts against the largest.
    lines : {"auto", "vanishing", "free"}
        "vanishing": the undistorted lines of a family meet in one point, possibly at infinity. "free": the lines are
        straight without further constraint, as on a target that is not quite regular. "auto" (default): by an F test.
    centre : (float, float), optional
        Known column and row of the distortion centre [px]. Default: estimated.
    sigma : float, optional
        Known standard deviation of a measured coordinate [px]. Default: estimated from the residuals.
    loss : {"squared", "huber", "tukey"}
        Loss of a residual; "huber" and "tukey" reduce the weight of outliers. Default "squared".
    solver : {"variable_projection", "nelder_mead", "steepest_descent", "gauss_newton"}
        Solver. "variable_projection" (default), or one of the thesis' alternating minimisations for comparison; these
        need ``lines="vanishing"``, a model with k1 and the squared loss.
    error_model : {"auto", "independent"}
        "auto" (default): test the residuals for lack of fit, and include a smooth field in the covariance if they have
        one. "independent": no test; the covariance holds for independent errors. It is too small for a lens that
        the model does not describe. It takes a fifth of the time for 10 000 points.
    limits : LensFitLimits
        Thresholds of the model choice and of the warnings.

    Returns
    -------
    LensFit

    Raises
    ------
    ValueError
        The lines do not determine the lens; the message names the missing data.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.5-3.3.6.
    """
    _check_options(model, lines, loss, solver, error_model, sigma)
    packed = pack(families)
    known = None if centre is None else (np.array(numbers(centre, (2,), "centre")) - packed.origin) / packed.unit
    search = _ModelSearch(packed, known, None if sigma is None else sigma / packed.unit, loss, limits)
    search.tests_residuals = error_model == "auto"
    if solver != "variable_projection":
        if lines != "vanishing" or model in ("auto", "none") or loss != "squared" or centre is not None:
            raise ValueError(f"solver {solver!r} needs lines='vanishing', a model with k1, and the squared loss")
        order, concurrent = MODELS.index(model), True
        search.check(order, concurrent=True)
        search.fits[order, concurrent] = minimise_alternating(packed, order, solver).minimum
    else:
        order, concurrent = search.choose(search.possible_orders() if model == "auto" else [MODELS.index(model)], lines)
    return _report(search, order, concurrent, families)


def _check_options(model: str, lines: str, loss: str, solver: str, error_model: str, sigma: float | None) -> None:
    if model not in ("auto", *MODELS):
        raise ValueError(f"model is {model!r}, expected 'auto' or one of {', '.join(map(repr, MODELS))}")
    for name, value, choices in (
        ("lines", lines, ("auto", "vanishing", "free")),
        ("loss", loss, ("squared", "huber", "tukey")),
        ("solver", solver, ("variable_projection", *ALTERNATING_SOLVERS)),
        ("error_model", error_model, ("auto", "independent")),
    ):
        if value not in choices:
            raise ValueError(f"{name} is {value!r}, expected one of {', '.join(map(repr, choices))}")
    if sigma is not None and not finite(sigma, "sigma") > 0.0:
        raise ValueError(f"sigma is {sigma}, expected more than 0 pixels")


class _ModelSearch:
    """Fits of several models to one set of lines, computed on demand; each starts from a smaller model's fit."""

    def __init__(
        self, packed: PackedLines, centre: Float64 | None, sigma: float | None, loss: Loss, limits: LensFitLimits
    ) -> None:
        self.packed, self.sigma, self.loss, self.limits = packed, sigma, loss, limits
        self.keep_centre = centre is not None
        self.centre = np.zeros(2) if centre is None else centre
        self.fits: dict[tuple[int, bool], Minimum] = {}
        self.owner = point_identifiers(packed)
        self.independent = count_independent_errors(self.owner)
        self.weight: Float64 | None = None
        self.scale = 0.0
        self.linear = linear_start(packed, centre)
        self.smooth: dict[tuple[int, bool], SmoothResiduals] = {}
        self.tests_residuals = True

    @property
    def can_be_concurrent(self) -> bool:
        """Whether a family has two lines or more."""
        return bool(np.max(np.bincount(self.packed.family)) > 1)

    @property
    def free_dimensions(self) -> int:
        """Degrees of freedom that free lines leave for a lens and the errors."""
        return len(self.packed.x) - 2 * len(self.packed.counts)

    def count_lens_parameters(self, order: int) -> int:
        """Return the number of free parameters of a lens."""
        return order + (2 if order and not self.keep_centre else 0)

    def parameters(self, order: int, concurrent: bool) -> int:
        """Return the number of parameters, including the parameters of the lines."""
        return self.count_lens_parameters(order) + count_line_parameters(
            self.packed, self.fits[order, concurrent].parameters
        )

    def degrees_of_freedom(self, order: int, concurrent: bool) -> int:
        """Return the degrees of freedom: residuals minus parameters."""
        return len(self.packed.x) - self.parameters(order, concurrent)

    def check(self, order: int, *, concurrent: bool) -> None:
        """Check that the lines determine a model.

        Raises
        ------
        ValueError
            They do not; the message names the missing data.
        """
        needed = 1 if self.keep_centre else 2
        if order and self.linear.rank < needed:
            raise ValueError(
                "all lines go through the centre, where no lens bends them; expected lines off the centre"
                if self.keep_centre
                else "all points lie along one line, whose bend k1 and the centre share; expected lines at several "
                "distances from each other, or a known centre"
            )
        if concurrent and not self.can_be_concurrent:
            raise ValueError("no family has two lines, so none has a vanishing point; expected more, or lines='free'")
        if not concurrent and self.free_dimensions <= self.count_lens_parameters(order):
            raise ValueError(
                f"{len(self.packed.x)} points on {len(self.packed.counts)} lines leave "
                f"{self.free_dimensions} numbers for "
                f"{self.count_lens_parameters(order)} parameters and the errors; expected more points on the lines"
            )

    def possible_orders(self) -> list[int]:
        """Return the orders that "auto" chooses from; at least 0 and 1 must be possible."""
        self.check(1, concurrent=False)
        return [order for order in range(len(MODELS)) if self.free_dimensions > self.count_lens_parameters(order)]

    def fit(self, order: int, concurrent: bool) -> Minimum:
        """Return the fit of a model."""
        if (order, concurrent) not in self.fits:
            self.fits[order, concurrent] = self._fitted(order, concurrent)
        return self.fits[order, concurrent]

    def _fitted(self, order: int, concurrent: bool) -> Minimum:
        self.check(order, concurrent=concurrent)
        robust = self.loss != "squared" and self.weight is None
        if robust:
            start, self.weight = robust_start(self.packed, self.centre if self.keep_centre else None)
            self.linear = self.linear._replace(parameters=start)
        start, evaluation = self._starting_point(order, concurrent)
        found = minimise(self.packed, start, evaluation, weight=self.weight, keep_centre=self.keep_centre)
        if order and not self.keep_centre and np.hypot(*found.parameters.centre) > 1.0:
            found = self._fit_from_middle(found, order, concurrent)
        if robust:
            found, self.weight, self.scale = fit_reweighted(
                self.packed, found, self.loss, self.sigma, keep_centre=self.keep_centre
            )
            # Sums of squares are comparable under the same weights only.
            self.fits.clear()
            self.smooth.clear()
        return found

    def _fit_from_middle(self, found: Minimum, order: int, concurrent: bool) -> Minimum:
        """Search for a better minimum if the centre left the data (k1 then tends to 0)."""
        about = linear_start(self.packed, np.zeros(2), self.weight).parameters
        start = about._replace(k=np.append(about.k, np.zeros(order - 1)))
        if concurrent:
            lines = evaluate(self.packed, start, weight=self.weight).lines
            start = start._replace(vanishing=vanishing_start(self.packed, lines))
        other = minimise(self.packed, start, weight=self.weight)
        return min(found, other, key=lambda each: each.evaluation.cost)

    def _starting_point(self, order: int, concurrent: bool) -> tuple[Parameters, Evaluation | None]:
        if concurrent:
            parameters, evaluation = self._starting_point(order, False)
            if self.free_dimensions > self.count_lens_parameters(order):
                parameters, evaluation = self.fit(order, False).parameters, self.fit(order, False).evaluation
            lines = (evaluation or evaluate(self.packed, parameters, weight=self.weight)).lines
            return parameters._replace(vanishing=vanishing_start(self.packed, lines)), None
        if order == 0:
            return Parameters(np.empty(0), self.centre, None), None
        # The first-order start is far from the minimum of a wide-angle lens: approach it one coefficient at a time.
        smaller = self.fit(order - 1, False) if order > _MAX_DIRECT_ORDER else self.fits.get((order - 1, False))
        if order > 1 and smaller is not None:
            return smaller.parameters._replace(k=np.append(smaller.parameters.k, 0.0)), smaller.evaluation
        start = self.linear.parameters
        return start._replace(k=np.append(start.k, np.zeros(order - 1))), None

    def p_value(self, smaller: tuple[int, bool], larger: tuple[int, bool]) -> float:
        """Return the p-value of the smaller model against the larger one.

        The F test assumes independent errors. If the residuals of the larger model are correlated, it would accept any
        coefficient that follows the pattern of the residuals. Wald's test compares the further coefficients with their
        covariance for correlated errors. Whether there is a lens at all remains a question for the F test.
        """
        worse, better = self.fit(*smaller), self.fit(*larger)
        more = self.parameters(*larger) - self.parameters(*smaller)
        if 0 < smaller[0] < larger[0] and smaller[1] == larger[1] and self.is_correlated(*larger):
            further = slice(smaller[0], larger[0])
            value = better.parameters.k[further]
            statistic = float(value @ np.linalg.solve(self.covariance(*larger)[further, further], value)) / len(value)
            return float(fdtrc(len(value), self.smooth_residuals(*larger).lack_of_fit.modes, statistic))
        residuals = (len(self.packed.x), self.independent)
        variance = None if self.sigma is None else self.sigma**2
        return p_value_of_gain(
            worse.evaluation.cost, better.evaluation.cost, more, residuals, self.degrees_of_freedom(*larger), variance
        )

    def choose(self, orders: list[int], lines: LineConstraint) -> tuple[int, bool]:
        """Fit the requested models and return the smallest one that the F test accepts."""
        largest = orders[-1]
        if lines == "auto":
            self.fit(largest, False)
            concurrent = (
                self.can_be_concurrent and self.p_value((largest, True), (largest, False)) > self.limits.significance
            )
        else:
            concurrent = lines == "vanishing"
        for order in orders[:-1]:
            if self.p_value((order, concurrent), (largest, concurrent)) > self.limits.significance:
                return order, concurrent
        return largest, concurrent

    def noise(self, order: int, concurrent: bool) -> float:
        """Return the standard deviation of a residual: given, robust, or from the degrees of freedom."""
        given = self.sigma or self.scale
        return given or math.sqrt(
            self.fit(order, concurrent).evaluation.cost / self.degrees_of_freedom(order, concurrent)
        )

    def is_correlated(self, order: int, concurrent: bool) -> bool:
        """Return whether the residuals of a model are known to contain a smooth field."""
        if not self.tests_residuals:
            return False
        lack = self.smooth_residuals(order, concurrent).lack_of_fit
        return lack.p_value < self.limits.lack_of_fit_significance

    def covariance(self, order: int, concurrent: bool) -> Float64:
        """Return the covariance of (k..., centre, two tangents per vanishing point) in packed coordinates."""
        packed, found = self.packed, self.fit(order, concurrent)
        if self.weight is None:
            variance = self.noise(order, concurrent) ** 2
            white = covariance(packed, found, self.owner, variance, keep_centre=self.keep_centre)
        else:
            white = robust_covariance(
                packed, found, self.owner, self.weight, self.loss, self.scale, keep_centre=self.keep_centre
            )
        if not len(white) or not self.is_correlated(order, concurrent):
            return white
        return correlated_covariance(packed, found, self.smooth_residuals(order, concurrent), white)

    def smooth_residuals(self, order: int, concurrent: bool) -> SmoothResiduals:
        """Return the smooth field in the residuals of a model, and its test."""
        key = (order, concurrent)
        found = self.fit(*key)
        if key not in self.smooth:
            variance = None if self.sigma is None else self.sigma**2
            self.smooth[key] = smooth_residuals(
                self.packed, found, self.degrees_of_freedom(*key), self.independent, variance
            )
        return self.smooth[key]


def _report(search: _ModelSearch, order: int, concurrent: bool, families: LineFamilies) -> LensFit:
    packed, found = search.packed, search.fit(order, concurrent)
    degrees_of_freedom = search.degrees_of_freedom(order, concurrent)
    if degrees_of_freedom <= 0:
        raise ValueError(
            f"{len(packed.x)} points on {len(packed.counts)} lines leave nothing to estimate the errors from; "
            "expected more points on the lines"
        )
    sigma = search.noise(order, concurrent)
    spread = search.covariance(order, concurrent)
    names, values, scaled = parameters_px(packed, found, spread)
    lens = None
    if order:
        lens = Lens(**dict(zip(names[:order], values[:order].tolist(), strict=True)), centre=centre_px(packed, found))
    fit = LensFit(
        lens=lens,
        model=MODELS[order],
        lines="vanishing" if concurrent else "free",
        vanishing_points=vanishing_points_px(packed, found),
        names=names,
        values=values,
        covariance=scaled,
        residuals_px=residuals_px(packed, found, families),
        rms_px=rms_px(packed, found, search.weight),
        sigma_px=sigma * packed.unit,
        degrees_of_freedom=degrees_of_freedom,
        iterations=sum(each.iterations for each in search.fits.values()),
        lack_of_fit=search.smooth_residuals(order, concurrent).lack_of_fit if search.tests_residuals else None,
        error_model="correlated" if search.is_correlated(order, concurrent) else "independent",
        alternatives=_alternatives(search, order, concurrent),
        warnings=(),
    )
    residuals = (len(packed.x), search.independent)
    straight = p_value_of_gain(search.linear.gain, 0.0, search.count_lens_parameters(1), residuals, 0, sigma**2)
    bends = search.linear.gain / sigma**2 * residuals[1] / residuals[0]
    return replace(fit, warnings=tuple(fit_warnings(fit, packed, found, straight, bends, search.limits)))


def _alternatives(search: _ModelSearch, order: int, concurrent: bool) -> tuple[LensAlternative, ...]:
    chosen = search.fit(order, concurrent)
    largest = max(number for number, _ in search.fits)
    found = []
    for number, with_points in sorted(search.fits):
        if (number, with_points) == (order, concurrent):
            continue
        other = search.fits[number, with_points]
        distance = math.nan
        if number and order:
            distance = search.packed.unit * float(np.hypot(*(other.parameters.centre - chosen.parameters.centre)))
        more = search.parameters(number, with_points) - search.parameters(order, concurrent)
        ratio = other.evaluation.cost / chosen.evaluation.cost if chosen.evaluation.cost > 0.0 else 1.0
        found.append(
            LensAlternative(
                model=MODELS[number],
                lines="vanishing" if with_points else "free",
                rms_px=rms_px(search.packed, other, search.weight),
                p_value=search.p_value((number, with_points), (largest, concurrent and with_points)),
                aic=search.independent * math.log(ratio) + 2.0 * more if ratio > 0.0 else -math.inf,
                centre=centre_px(search.packed, other) if number else None,
                centre_distance_px=distance,
            )
        )
    return tuple(found)
