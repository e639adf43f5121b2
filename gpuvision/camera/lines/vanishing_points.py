"""Lens calibration from straight lines: the vanishing-point method, and plumb lines that need not meet.

Straight lines stay straight in any pinhole image, tilted sensor or not, so what bends them is the lens alone
(F. de Jong, 3.3.5-3.3.6). The thesis asks parallel lines to meet in one vanishing point as well and alternates
between vanishing points and lens (`gpuvision.camera.lines.alternating_minimisation`). Here all is minimised at once:
the lines are eliminated in closed form, vanishing points are unit vectors, so that one at infinity is a point like any
other, and distances are those in the measured image (`gpuvision.camera.lines.straightness`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.alternating_minimisation import STRATEGIES, alternate
from gpuvision.camera.lines.lens_fit import (
    MODELS,
    REJECTED,
    LensAlternative,
    LensFit,
    LensModel,
    Meeting,
    centre_px,
    parameters_px,
    points_px,
    residuals_px,
    rms_px,
    warnings_of,
)
from gpuvision.camera.lines.line_families import Float64, LineFamilies, PackedLines, pack
from gpuvision.camera.lines.line_statistics import (
    Loss,
    chance,
    covariance,
    line_parameters,
    noise_dimensions,
    reweighted,
    robust_covariance,
    robust_start,
    same_points,
)
from gpuvision.camera.lines.straightness import Evaluation, Parameters, evaluate
from gpuvision.camera.lines.variable_projection import Minimum, linear_start, minimise, vanishing_start
from gpuvision.validation import finite, numbers

Strategy = Literal["variable_projection", "nelder_mead", "steepest_descent", "gauss_newton"]


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
    strategy: Strategy = "variable_projection",
) -> LensFit:
    """Find the lens that makes measured lines straight.

    Parameters
    ----------
    families
        Families of lines that are parallel in the scene, each line an array (points, 2) of (column, row) in pixels,
        in any image that the lens took: `gpuvision.camera.lines.line_families.grid_lines` makes them from a grid. NaN
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
    if model not in ("auto", *MODELS):
        raise ValueError(f"model is {model!r}, expected 'auto' or one of {', '.join(map(repr, MODELS))}")
    for name, value, choices in (
        ("lines", lines, ("auto", "vanishing", "free")),
        ("loss", loss, ("squared", "huber", "tukey")),
        ("strategy", strategy, ("variable_projection", *STRATEGIES)),
    ):
        if value not in choices:
            raise ValueError(f"{name} is {value!r}, expected one of {', '.join(map(repr, choices))}")
    if sigma is not None and not finite(sigma, "sigma") > 0.0:
        raise ValueError(f"sigma is {sigma}, expected more than 0 pixels")
    packed = pack(families)
    known = None if centre is None else (np.array(numbers(centre, (2,), "centre")) - packed.origin) / packed.unit
    search = _Search(packed, known, None if sigma is None else sigma / packed.unit, loss)
    if strategy != "variable_projection":
        if lines != "vanishing" or model in ("auto", "none") or loss != "squared" or centre is not None:
            raise ValueError(f"strategy {strategy!r} needs lines='vanishing', a model with k1, and the squared loss")
        order, meet = MODELS.index(model), True
        search.check(order, meet=True)
        search.fits[order, meet] = alternate(packed, order, strategy).minimum
    else:
        order, meet = search.choose(search.possible_orders() if model == "auto" else [MODELS.index(model)], lines)
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
        self.linear = linear_start(packed, centre)

    @property
    def can_meet(self) -> bool:
        """Whether a family has lines that could meet."""
        return bool(np.max(np.bincount(self.packed.family)) > 1)

    @property
    def left(self) -> int:
        """Numbers that free lines leave for a lens and the errors."""
        return len(self.packed.x) - 2 * len(self.packed.counts)

    def sought(self, order: int) -> int:
        """How many parameters a lens has."""
        return order + (2 if order and not self.keep_centre else 0)

    def parameters(self, order: int, meet: bool) -> int:
        """How many there are, those of the lines among them."""
        return self.sought(order) + line_parameters(self.packed, self.fits[order, meet].at)

    def freedom(self, order: int, meet: bool) -> int:
        """Residuals less parameters."""
        return len(self.packed.x) - self.parameters(order, meet)

    def check(self, order: int, *, meet: bool) -> None:
        """Check that the lines can fix a model.

        Raises
        ------
        ValueError
            They cannot; says what they lack.
        """
        needed = 1 if self.keep_centre else 2
        if order and self.linear.rank < needed:
            raise ValueError(
                "all lines go through the centre, where no lens bends them; expected lines beside it"
                if self.keep_centre
                else "all points lie along one line, whose bend k1 and the centre share; expected lines at several "
                "distances from each other, or a known centre"
            )
        if meet and not self.can_meet:
            raise ValueError("no family has two lines, so none has a vanishing point; expected more, or lines='free'")
        if not meet and self.left <= self.sought(order):
            raise ValueError(
                f"{len(self.packed.x)} points on {len(self.packed.counts)} lines leave {self.left} numbers for "
                f"{self.sought(order)} parameters and the errors; expected more points on the lines"
            )

    def possible_orders(self) -> list[int]:
        """Return what "auto" chooses from; at least none and k1 have to be possible."""
        self.check(1, meet=False)
        return [order for order in (0, 1, 2) if self.left > self.sought(order)]

    def fit(self, order: int, meet: bool) -> Minimum:
        """Fit a model."""
        if (order, meet) not in self.fits:
            self.fits[order, meet] = self._fitted(order, meet)
        return self.fits[order, meet]

    def _fitted(self, order: int, meet: bool) -> Minimum:
        self.check(order, meet=meet)
        robust = self.loss != "squared" and self.weight is None
        if robust:
            start, self.weight = robust_start(self.packed, self.centre if self.keep_centre else None)
            self.linear = self.linear._replace(at=start)
        start, here = self._beginning(order, meet)
        found = minimise(self.packed, start, here, weight=self.weight, keep_centre=self.keep_centre)
        if order and not self.keep_centre and np.hypot(*found.at.centre) > 1.0:
            found = self._from_the_middle(found, order, meet)
        if robust:
            found, self.weight, self.scale = reweighted(
                self.packed, found, self.loss, self.sigma, keep_centre=self.keep_centre
            )
            # Sums of squares compare under the same weights only.
            self.fits.clear()
        return found

    def _from_the_middle(self, found: Minimum, order: int, meet: bool) -> Minimum:
        """Look for a better minimum than one whose centre left the data: there are others far out, with k1 near 0."""
        about = linear_start(self.packed, np.zeros(2), self.weight).at
        start = about._replace(k=np.append(about.k, np.zeros(order - 1)))
        if meet:
            lines = evaluate(self.packed, start, weight=self.weight).lines
            start = start._replace(vanishing=vanishing_start(self.packed, lines))
        other = minimise(self.packed, start, weight=self.weight)
        return min(found, other, key=lambda each: each.here.cost)

    def _beginning(self, order: int, meet: bool) -> tuple[Parameters, Evaluation | None]:
        if meet:
            at, here = self._beginning(order, False)
            if self.left > self.sought(order):
                at, here = self.fit(order, False).at, self.fit(order, False).here
            lines = (here or evaluate(self.packed, at, weight=self.weight)).lines
            return at._replace(vanishing=vanishing_start(self.packed, lines)), None
        if order == 0:
            return Parameters(np.empty(0), self.centre, None), None
        smaller = self.fits.get((order - 1, False))
        if order == 2 and smaller is not None:
            return smaller.at._replace(k=np.append(smaller.at.k, 0.0)), smaller.here
        start = self.linear.at
        return start._replace(k=np.append(start.k, np.zeros(order - 1))), None

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
            meet = self.can_meet and self.chance((largest, True), (largest, False)) > REJECTED
        else:
            meet = lines == "vanishing"
        for order in orders[:-1]:
            if self.chance((order, meet), (largest, meet)) > REJECTED:
                return order, meet
        return largest, meet


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
    names, values, scaled = parameters_px(packed, found, spread)
    lens = None
    if order:
        lens = Lens(k1=values[0], k2=values[1] if order > 1 else 0.0, centre=centre_px(packed, found))
    fit = LensFit(
        lens=lens,
        model=MODELS[order],
        lines="vanishing" if meet else "free",
        vanishing_points=points_px(packed, found),
        names=names,
        values=values,
        covariance=scaled,
        residuals_px=residuals_px(packed, found, families),
        rms_px=rms_px(packed, found, search.weight),
        sigma_px=sigma * packed.unit,
        degrees_of_freedom=freedom,
        iterations=sum(each.steps for each in search.fits.values()),
        alternatives=_alternatives(search, order, meet),
        warnings=(),
    )
    residuals = (len(packed.x), search.independent)
    straight = chance(search.linear.gain, 0.0, search.sought(1), residuals, 0, sigma**2)
    bends = search.linear.gain / sigma**2 * residuals[1] / residuals[0]
    return replace(fit, warnings=tuple(warnings_of(fit, packed, found, straight, bends)))


def _alternatives(search: _Search, order: int, meet: bool) -> tuple[LensAlternative, ...]:
    chosen = search.fit(order, meet)
    largest = max(number for number, _ in search.fits)
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
                model=MODELS[number],
                lines="vanishing" if with_points else "free",
                rms_px=rms_px(search.packed, other, search.weight),
                p_value=search.chance((number, with_points), (largest, meet and with_points)),
                aic=search.independent * math.log(ratio) + 2.0 * more if ratio > 0.0 else -math.inf,
                centre=centre_px(search.packed, other) if number else None,
                centre_distance_px=apart,
            )
        )
    return tuple(found)
