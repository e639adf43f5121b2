"""Lenses from straight lines: exact data, Cramer-Rao bound, choice of model, undetermined parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.stats

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines import vanishing_points
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.vanishing_points import LensFit, _ModelSearch, fit_lens, straightness_px
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from straight_lines import bound, plane_grid, radial_lens, straightness

NAMES = ("k1", "k2", "C_c", "R_c")


def noisy_grid(rng: np.random.Generator, tilt: float, border: float, sigma: float) -> tuple[np.ndarray, Lens]:
    """Return a noisy grid of 23 x 31 points, and its true lens."""
    lens = radial_lens(border)
    points = lens.distort(plane_grid(rng, tilt))
    return points + rng.normal(0.0, sigma, points.shape), lens


def errors(fit: LensFit, lens: Lens) -> np.ndarray:
    """Errors of the parameters in standard deviations."""
    true = np.array([{"k1": lens.k1, "k2": lens.k2, "C_c": lens.centre[0], "R_c": lens.centre[1]}[n] for n in NAMES])
    return (fit.values[:4] - true) / np.sqrt(np.diag(fit.covariance))[:4]


@pytest.mark.parametrize("lines", ["free", "vanishing"])
@pytest.mark.parametrize("tilt", [0.0, 45.0])
@pytest.mark.parametrize("border", [-20.0, 0.3, 20.0])
def test_exact_lines_give_the_lens(rng: np.random.Generator, border: float, tilt: float, lines: str) -> None:
    points, lens = noisy_grid(rng, tilt, border, 0.0)
    fit = fit_lens(grid_lines(points, diagonals=True), model="k1,k2", lines=lines)
    # Rounding of the points, 1e-13 pixels, relative to the distortion: 1e-12 for the smallest distortion.
    np.testing.assert_allclose(fit.values[:4], [lens.k1, lens.k2, *lens.centre], rtol=1e-9)
    assert fit.rms_px < 1e-12
    assert fit.warnings == ()
    assert fit.names[:4] == NAMES
    ideal = lens.undistort(points)
    for number, line in ((0, ideal[0]), (1, ideal[:, 0])):
        point = fit.vanishing_points[number]
        # The point lies on the undistorted lines of its family.
        across = np.linalg.svd(line - line.mean(axis=0))[2][1]
        far = (across @ point[:2] - point[2] * (across @ line.mean(axis=0))) / np.linalg.norm(point[:2])
        assert abs(far) < 1e-7
        assert abs(np.linalg.norm(point) - 1.0) < 1e-14


@pytest.mark.parametrize("lines", ["free", "vanishing"])
@pytest.mark.parametrize("tilt", [0.0, pytest.param(20.0, marks=pytest.mark.slow), 45.0])
@pytest.mark.parametrize("border", [0.3, pytest.param(3.0, marks=pytest.mark.slow), 20.0])
def test_predicted_errors_are_the_bound(rng: np.random.Generator, border: float, tilt: float, lines: str) -> None:
    """Predicted errors are at most 10 % above the Cramer-Rao bound."""
    lens = radial_lens(border)
    ideal = plane_grid(rng, tilt)
    fit = fit_lens(grid_lines(lens.distort(ideal)), model="k1,k2", lines=lines, sigma=0.05)
    ratio = np.sqrt(np.diag(fit.covariance))[:4] / bound(ideal, lens, 0.05, meet=lines == "vanishing")
    assert np.all(ratio > 0.999)
    assert np.all(ratio < 1.1)


class Search(_ModelSearch):
    """Fits with given costs (order, concurrent), coefficients k_n = n and covariance; 90 residuals of 60 errors."""

    def __init__(self, *, correlated: bool, sigma: float | None) -> None:
        self.packed: Any = SimpleNamespace(x=np.zeros(90))
        self.independent, self.sigma, self.correlated = 60, sigma, correlated
        self.costs = {(0, False): 120.0, (1, False): 80.0, (3, False): 50.0, (3, True): 75.0, (1, True): 95.0}

    def fit(self, order: int, concurrent: bool) -> Any:
        k = np.arange(1.0, order + 1.0)
        return SimpleNamespace(
            evaluation=SimpleNamespace(cost=self.costs[order, concurrent]), parameters=SimpleNamespace(k=k)
        )

    def parameters(self, order: int, concurrent: bool) -> int:
        return (order + 2 if order else 0) + (10 if concurrent else 20)

    def is_correlated(self, order: int, concurrent: bool) -> bool:
        return self.correlated

    def covariance(self, order: int, concurrent: bool) -> np.ndarray:
        return np.array([[9.0, 1.0, 2.0, 0.5], [1.0, 4.0, 1.0, 0.2], [2.0, 1.0, 6.0, 0.1], [0.5, 0.2, 0.1, 3.0]])

    def smooth_residuals(self, order: int, concurrent: bool) -> Any:
        return SimpleNamespace(lack_of_fit=SimpleNamespace(modes=11))


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("sigma", [None, 0.8])
def test_which_test_compares_two_models(correlated: bool, sigma: float | None) -> None:
    """Wald's test of the further coefficients where errors are correlated; without a lens, or of lines, the F test."""
    search = Search(correlated=correlated, sigma=sigma)
    value, covariance = np.array([2.0, 3.0]), np.array([[4.0, 1.0], [1.0, 6.0]])
    wald = scipy.stats.f.sf(value @ np.linalg.solve(covariance, value) / 2.0, 2, 11)

    def by_cost(worse: float, better: float, more: int, parameters: int) -> float:
        """Each of the 60 independent errors counts 1.5 times."""
        gain = (worse - better) / 1.5
        if sigma is not None:
            return float(scipy.stats.chi2.sf(gain / sigma**2, more))
        freedom = 90 - parameters
        return float(scipy.stats.f.sf(gain / more / (better / freedom), more, freedom / 1.5))

    expected = by_cost(80.0, 50.0, 2, 25)
    assert search.p_value((1, False), (3, False)) == pytest.approx(wald if correlated else expected, rel=1e-9)
    assert search.p_value((1, True), (3, True)) == pytest.approx(
        wald if correlated else by_cost(95.0, 75.0, 2, 15), rel=1e-9
    )
    assert search.p_value((0, False), (3, False)) == pytest.approx(by_cost(120.0, 50.0, 5, 25), rel=1e-9)
    assert search.p_value((3, True), (3, False)) == pytest.approx(by_cost(75.0, 50.0, 10, 25), rel=1e-9)
    assert search.p_value((1, True), (3, False)) == pytest.approx(by_cost(95.0, 50.0, 12, 25), rel=1e-9)


@pytest.mark.parametrize("tests_residuals", [False, True])
def test_noise_and_correlation_of_a_model(tests_residuals: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    search: Any = object.__new__(_ModelSearch)
    search.packed = SimpleNamespace(x=np.zeros(90))
    search.fits = {(2, True): SimpleNamespace(evaluation=SimpleNamespace(cost=50.0))}
    monkeypatch.setattr(_ModelSearch, "parameters", lambda *_: 18)
    for sigma, scale, noise in ((None, 0.0, math.sqrt(50.0 / 72.0)), (None, 0.3, 0.3), (0.7, 0.3, 0.7)):
        search.sigma, search.scale = sigma, scale
        assert search.noise(2, True) == pytest.approx(noise)
    search.tests_residuals, search.limits = tests_residuals, SimpleNamespace(lack_of_fit_significance=0.01)
    search.owner, search.independent = None, 60
    asked: list[Any] = []
    for sigma, p_value, is_correlated in ((0.7, 0.0099, True), (None, 0.01, False)):
        search.smooth, search.sigma = {}, sigma
        smooth = SimpleNamespace(lack_of_fit=SimpleNamespace(p_value=p_value))
        monkeypatch.setattr(vanishing_points, "smooth_residuals", lambda *given, s=smooth: asked.append(given) or s)
        assert search.is_correlated(2, True) == (is_correlated and tests_residuals)
        assert search.is_correlated(2, True) == (is_correlated and tests_residuals)
    # Computed once for each model, with the given variance.
    found = search.fits[2, True]
    variances = [pytest.approx(0.49), None] if tests_residuals else []
    assert asked == [(search.packed, found, 72, 60, variance) for variance in variances]


def coverage(rng: np.random.Generator, draws: int, cases: list[tuple[float, float, float]]) -> np.ndarray:
    """Errors in standard deviations (draws, 4), over cases (tilt, border, sigma) in turn."""
    found = []
    for number in range(draws):
        points, lens = noisy_grid(rng, *cases[number % len(cases)])
        fit = fit_lens(grid_lines(points), model="k1,k2", lines=("free", "vanishing")[number % 2])
        found.append(errors(fit, lens))
    return np.array(found)


@pytest.mark.slow
def test_errors_are_as_predicted(rng: np.random.Generator) -> None:
    """No cold start fails: every error is within six standard deviations, and the mean square is 1."""
    cases = [
        (tilt, border, sigma) for tilt in (0.0, 20.0, 45.0) for border, sigma in ((0.3, 0.02), (3.0, 0.2), (20.0, 0.2))
    ]
    found = coverage(rng, 180, cases)
    assert np.all(np.abs(found) < 6.0)
    # 720 errors: the mean of their squares has a standard deviation of sqrt(2/720) = 0.053 if they were independent,
    # and about twice that because the four errors of a fit are correlated.
    assert abs(np.mean(found**2) - 1.0) < 0.4


@pytest.mark.slow
def test_uncertainties_cover_the_truth(rng: np.random.Generator) -> None:
    cases = [
        (t, b, s) for t in (0.0, 10.0, 20.0, 30.0, 45.0) for b, s in ((0.3, 0.02), (3.0, 0.02), (3.0, 0.2), (20.0, 0.2))
    ]
    found = coverage(rng, 1000, cases)
    covered = np.mean(np.abs(found) < 1.96, axis=0)
    np.testing.assert_allclose(covered, 0.95, atol=0.03)
    assert np.all(np.abs(found) < 6.0)


@pytest.mark.slow
def test_vanishing_points_have_errors_as_predicted(rng: np.random.Generator) -> None:
    """The three components have a singular covariance, so a draw has two degrees of freedom per point."""
    ideal, lens = plane_grid(rng, 30.0), radial_lens(10.0)
    exact = fit_lens(grid_lines(lens.distort(ideal)), model="k1,k2", lines="vanishing").values
    squares = []
    for _ in range(100):
        points = lens.distort(ideal) + rng.normal(0.0, 0.1, ideal.shape)
        fit = fit_lens(grid_lines(points), model="k1,k2", lines="vanishing")
        for first in (4, 7):
            part = slice(first, first + 3)
            assert fit.names[first].startswith("v")
            wrong = fit.values[part] * np.sign(fit.values[part] @ exact[part]) - exact[part]
            values, vectors = np.linalg.eigh(fit.covariance[part, part])
            assert values[0] < 1e-9 * values[2]
            squares += list((vectors[:, 1:].T @ wrong) ** 2 / values[1:])
    # 240 squares: standard deviation of the mean 0.09 to 0.18.
    assert abs(np.mean(squares) - 1.0) < 0.45


def test_rms_is_of_the_measured_image(rng: np.random.Generator) -> None:
    points, _ = noisy_grid(rng, 20.0, 20.0, 0.1)
    fit = fit_lens(grid_lines(points), model="k1,k2")
    freedom = len(np.concatenate([np.concatenate(family) for family in fit.residuals_px]))
    assert fit.rms_px == pytest.approx(0.1, rel=0.1)
    assert fit.sigma_px == pytest.approx(fit.rms_px * np.sqrt(freedom / fit.degrees_of_freedom))
    # For an undistorted line through the image centre both agree up to the scale of the lens, 3 % at the border.
    straight = straightness_px(grid_lines(points), fit.lens)
    assert straight == pytest.approx(fit.rms_px, rel=0.03)
    corrected = fit.lens.undistort(points)
    lines = [line for family in grid_lines(corrected) for line in family]
    scale = np.sqrt(np.sum(np.var(np.concatenate(lines), axis=0)))
    before = np.concatenate([line for family in grid_lines(points) for line in family])
    assert straight == pytest.approx(straightness(lines) / scale * np.sqrt(np.sum(np.var(before, axis=0))), rel=1e-12)
    assert straightness_px(grid_lines(points)) == pytest.approx(
        straightness([*points, *points.swapaxes(0, 1)]), rel=1e-9
    )


def test_distances_keep_their_place(rng: np.random.Generator) -> None:
    points, _ = noisy_grid(rng, 10.0, 5.0, 0.1)
    points[3, 4:9] = np.nan
    points[0, 2:] = np.nan
    rows = list(points)
    fit = fit_lens([rows, list(points.swapaxes(0, 1))], model="k1")
    assert [len(line) for line in fit.residuals_px[0]] == [31] * 23
    np.testing.assert_array_equal(np.isnan(fit.residuals_px[0][3]), np.isnan(points[3, :, 0]))
    assert np.all(np.isnan(fit.residuals_px[0][0]))


def test_several_images_share_a_lens(rng: np.random.Generator) -> None:
    lens, families = radial_lens(10.0), []
    for tilt in (0.0, 15.0, 30.0):
        points = lens.distort(plane_grid(rng, tilt))
        families += grid_lines(points + rng.normal(0.0, 0.1, points.shape))
    together, one = (fit_lens(each, model="k1,k2", lines="vanishing") for each in (families, families[:2]))
    assert together.vanishing_points.shape == (6, 3)
    assert np.all(np.abs(errors(together, lens)) < 4.0)
    assert np.all(np.sqrt(np.diag(together.covariance))[:4] < np.sqrt(np.diag(one.covariance))[:4])


def wide_angle_lens(order: int) -> Lens:
    """Return a lens of 3 or 4 coefficients whose highest term moves the corner of a 1024 px image by 8 px or more."""
    half = 512.0 * np.sqrt(2.0)
    shares = ((-0.14, 0.06, 0.03), (-0.20, 0.12, -0.05, 0.011))[order - 3]
    terms = {f"k{power}": share / half ** (2 * power) for power, share in enumerate(shares, 1)}
    return Lens(**terms, centre=(530.0, 500.0))


@pytest.mark.parametrize("lines", ["free", "vanishing"])
@pytest.mark.parametrize("order", [3, 4])
def test_exact_lines_give_a_wide_angle_lens(rng: np.random.Generator, order: int, lines: str) -> None:
    lens = wide_angle_lens(order)
    points = lens.distort(plane_grid(rng, 20.0))
    model = ",".join(f"k{power}" for power in range(1, order + 1))
    fit = fit_lens(grid_lines(points), model=model, lines=lines)
    assert fit.names[:order] == tuple(model.split(","))
    np.testing.assert_allclose(fit.lens.coefficients, lens.coefficients, rtol=1e-6)
    assert fit.lens.centre == pytest.approx(lens.centre, abs=1e-6)
    assert fit.rms_px < 1e-10


@pytest.mark.parametrize("order", [3, 4])
def test_a_wide_angle_lens_gets_the_coefficients_it_needs(order: int, draws: Callable[[int, int], int]) -> None:
    """The residual is the noise; k1 and k2 alone leave more."""
    rng, lens, chosen = np.random.default_rng(11), wide_angle_lens(order), []
    for _ in range(draws(5, 10)):
        ideal = plane_grid(rng, 20.0, rows=31, columns=41)
        points = lens.distort(ideal) + rng.normal(0.0, 0.02, ideal.shape)
        fit = fit_lens(grid_lines(points))
        chosen.append(len(fit.lens.coefficients))
        assert fit.sigma_px == pytest.approx(0.02, rel=0.1)
        assert fit_lens(grid_lines(points), model="k1,k2").sigma_px > 1.08 * fit.sigma_px
    assert chosen.count(order) >= 0.7 * len(chosen)


@pytest.mark.parametrize(
    ("border", "k2_part", "sigma", "model"),
    [(0.0, 0.0, 0.05, "none"), (5.0, 0.0, 0.05, "k1"), (5.0, -0.6, 0.02, "k1,k2"), (5.0, -0.6, 0.0, "k1,k2")],
)
def test_the_smallest_sufficient_model(
    border: float, k2_part: float, sigma: float, model: str, draws: Callable[[int, int], int]
) -> None:
    rng = np.random.default_rng(7)
    lens = radial_lens(border, k2_part=k2_part)
    chosen = []
    for _ in range(draws(10, 20)):
        points = lens.distort(plane_grid(rng, 20.0))
        fit = fit_lens(grid_lines(points + rng.normal(0.0, sigma, points.shape)))
        chosen.append(fit.model)
        assert {(fit.model, fit.lines)}.isdisjoint((other.model, other.lines) for other in fit.alternatives)
    # At a significance of 0.05, one model in twenty may be larger than needed.
    assert chosen.count(model) >= 0.8 * len(chosen)
    assert "none" not in chosen or model == "none"


def test_lines_that_do_not_meet_are_found_out(rng: np.random.Generator) -> None:
    """A target whose rows are turned by ten microradians to a milliradian each."""
    lens = radial_lens(5.0)
    for turn, kind in ((0.0, "vanishing"), (1e-3, "free")):
        ideal = plane_grid(rng, 20.0)
        middle = ideal.mean(axis=1, keepdims=True)
        angle = rng.normal(0.0, turn, len(ideal))[:, None]
        x, y = np.moveaxis(ideal - middle, -1, 0)
        ideal = middle + np.stack([x - angle * y, y + angle * x], axis=-1)
        points = lens.distort(ideal) + rng.normal(0.0, 0.05, ideal.shape)
        fit = fit_lens(grid_lines(points)[:1] + grid_lines(plane_grid(rng, 20.0))[1:1], model="k1")
        assert fit.lines == kind
        other = next(each for each in fit.alternatives if each.lines != kind)
        assert (other.p_value < 0.05) is (kind == "free")


def test_summary_of_the_alternatives(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of their models, against the largest one with the same lines; a cost of 0 compares with nothing."""
    search: Any = Search(correlated=False, sigma=0.8)
    search.packed.unit, search.weight = 100.0, None
    search.fits = {
        key: SimpleNamespace(
            evaluation=SimpleNamespace(cost=cost),
            parameters=SimpleNamespace(k=np.ones(key[0]), centre=np.array([0.03 * key[0], 0.04 * key[1]])),
        )
        for key, cost in search.costs.items()
    }
    search.fit = lambda order, concurrent: search.fits[order, concurrent]
    monkeypatch.setattr(vanishing_points, "rms_px", lambda _packed, found, _weight: found.evaluation.cost)
    monkeypatch.setattr(vanishing_points, "centre_px", lambda _packed, found: tuple(100.0 * found.parameters.centre))
    for chosen in ((1, False), (3, True), (0, False)):
        found = vanishing_points._alternatives(search, *chosen)
        others = [(0, False), (1, False), (1, True), (3, False), (3, True)]
        others.remove(chosen)
        assert [(each.model, each.lines) for each in found] == [
            (["none", "k1", "k1,k2", "k1,k2,k3"][order], "vanishing" if concurrent else "free")
            for order, concurrent in others
        ]
        for each, other in zip(found, others, strict=True):
            assert each.rms_px == search.costs[other]
            more = search.parameters(*other) - search.parameters(*chosen)
            ratio = search.costs[other] / search.costs[chosen]
            assert each.aic == pytest.approx(60.0 * math.log(ratio) + 2.0 * more)
            assert each.p_value == search.p_value(other, (3, chosen[1] and other[1]))
            assert each.centre == (tuple(100.0 * search.fits[other].parameters.centre) if other[0] else None)
            away = math.hypot(3.0 * (other[0] - chosen[0]), 4.0 * (other[1] - chosen[1]))
            expected = away if other[0] and chosen[0] else math.nan
            assert each.centre_distance_px == pytest.approx(expected, nan_ok=True)
    search.fits[1, False].evaluation.cost = 0.0
    assert vanishing_points._alternatives(search, 1, False)[0].aic == -2.0 * 3
    assert vanishing_points._alternatives(search, 0, False)[0].aic == -math.inf


def test_alternatives_say_how_far_their_centres_lie(rng: np.random.Generator) -> None:
    points, _ = noisy_grid(rng, 20.0, 10.0, 0.05)
    fit = fit_lens(grid_lines(points))
    assert fit.model == "k1,k2"
    by_model = {(each.model, each.lines): each for each in fit.alternatives}
    k1 = by_model["k1", "vanishing"]
    assert k1.p_value < 0.05 < by_model["k1,k2", "free"].p_value
    assert k1.rms_px > fit.rms_px
    assert k1.centre_distance_px == pytest.approx(np.hypot(*np.subtract(k1.centre, fit.lens.centre)))
    no_lens = by_model["none", "vanishing"]
    assert no_lens.centre is None
    assert np.isnan(no_lens.centre_distance_px)
    assert no_lens.aic > k1.aic > 0.0


def test_no_distortion_leaves_no_centre(rng: np.random.Generator) -> None:
    points = plane_grid(rng, 20.0) + rng.normal(0.0, 0.05, (23, 31, 2))
    assert fit_lens(grid_lines(points)).lens is None
    fit = fit_lens(grid_lines(points), model="k1")
    assert any("as straight without a lens" in each for each in fit.warnings)
    assert any("fix the centre only to" in each for each in fit.warnings)
    # The estimate is still within its (large) uncertainty.
    assert abs(fit.lens.k1) < 4.0 * fit.uncertainties["k1"]
    assert max(fit.uncertainties["C_c"], fit.uncertainties["R_c"]) > 100.0
    exact = fit_lens(grid_lines(plane_grid(rng, 20.0)), model="k1")
    assert any("as straight without a lens" in each for each in exact.warnings)


@pytest.mark.parametrize(("sigma", "faint"), [(0.2, True), (0.01, False)])
def test_a_faint_distortion_is_said_to_be_faint(
    rng: np.random.Generator, sigma: float, faint: bool, draws: Callable[[int, int], int]
) -> None:
    """0.3 pixels of distortion under 0.2 pixels of noise: the linear uncertainty is not valid, and each fit warns."""
    for _ in range(draws(8, 20)):
        points, _ = noisy_grid(rng, 20.0, 0.3, sigma)
        fit = fit_lens(grid_lines(points), model="k1,k2")
        assert any("faint" in each or "as straight" in each for each in fit.warnings) is faint


def test_mirrored_image(rng: np.random.Generator) -> None:
    points, _ = noisy_grid(rng, 20.0, 10.0, 0.05)
    plain = fit_lens(grid_lines(points))
    mirrored = fit_lens(grid_lines([1023.0, 0.0] + points * [-1.0, 1.0]))
    assert mirrored.lens.centre == pytest.approx((1023.0 - plain.lens.centre[0], plain.lens.centre[1]), rel=1e-7)
    assert mirrored.lens.k1 == pytest.approx(plain.lens.k1, rel=1e-7)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_missing_points(rng: np.random.Generator, share: float) -> None:
    points, lens = noisy_grid(rng, 20.0, 10.0, 0.05)
    points[rng.random(points.shape[:2]) < share] = np.nan
    assert np.all(np.abs(errors(fit_lens(grid_lines(points), model="k1,k2"), lens)) < 5.0)


@pytest.mark.parametrize("kept", [np.s_[:, :16], np.s_[12:], np.s_[12:, 16:]])
def test_part_of_the_grid(rng: np.random.Generator, kept: tuple[slice, ...]) -> None:
    points, lens = noisy_grid(rng, 20.0, 20.0, 0.05)
    assert np.all(np.abs(errors(fit_lens(grid_lines(points[kept]), model="k1,k2"), lens)) < 5.0)


@pytest.mark.parametrize("factor", [8.0, 1e-5])
def test_any_unit(rng: np.random.Generator, factor: float) -> None:
    """8192 pixels, or metres on a PSD; also in single precision."""
    points, _ = noisy_grid(rng, 20.0, 10.0, 0.05)
    plain, scaled = fit_lens(grid_lines(points)), fit_lens(grid_lines(factor * points))
    assert scaled.values[:4] * factor ** np.array([2.0, 4.0, -1.0, -1.0]) == pytest.approx(plain.values[:4], rel=1e-7)
    single = fit_lens(grid_lines((factor * points).astype(np.float32)))
    assert np.all(np.abs(single.values - scaled.values)[:4] < 0.05 * np.sqrt(np.diag(scaled.covariance))[:4])


@pytest.mark.parametrize("part", [0.8, 0.95])
def test_near_the_fold(rng: np.random.Generator, part: float) -> None:
    """The image extends to the given fraction of the fold radius."""
    lens = Lens(k1=-1.0 / (3.0 * 700.0**2), centre=(512.0, 512.0))
    radius = part * lens.fold_radius
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 21), np.linspace(-1.0, 1.0, 21)), axis=-1) / np.sqrt(2.0)
    points = lens.distort(512.0 + grid * radius * (1.0 + lens.k1 * radius**2))
    fit = fit_lens(grid_lines(points + rng.normal(0.0, 0.05, points.shape)), model="k1")
    true = [lens.k1, *lens.centre]
    assert np.all(np.abs(fit.values[:3] - true) < 5.0 * np.sqrt(np.diag(fit.covariance))[:3])
    assert np.all(np.isfinite(fit.lens.undistort(points)))


def test_points_beyond_a_fold_are_never_the_answer(rng: np.random.Generator) -> None:
    """Random points need no lens; a lens that is forced on them is monotone over all points."""
    for seed in range(20):
        scattered = np.random.default_rng(seed).uniform(0.0, 1000.0, (6, 8, 2))
        fit = fit_lens(grid_lines(scattered), model="k1,k2", lines="free")
        assert np.all(np.isfinite(fit.lens.undistort(scattered)))
        assert np.hypot(*np.subtract(fit.lens.centre, 500.0)) < 4.1 * np.hypot(500.0, 500.0)


def test_one_family_of_parallel_lines(rng: np.random.Generator) -> None:
    """A flat object moves along H in front of a PSD camera: few points on a line, vanishing point at infinity."""
    lens = Lens(k1=-2e-7, k2=1e-14, centre=(530.0, 500.0))
    along = np.linspace(60.0, 960.0, 16)
    lines = [np.column_stack([along, np.full(16, height)]) for height in np.linspace(80.0, 900.0, 12)]
    points = [lens.distort(line) + rng.normal(0.0, 0.05, line.shape) for line in lines]
    fit = fit_lens([points], model="k1,k2", lines="vanishing")
    assert np.all(np.abs(errors(fit, lens)) < 5.0)
    point = fit.vanishing_points[0]
    assert abs(point[2]) < 1e-5 * abs(point[0])
    assert fit.uncertainties["C_c"] > 3.0 * fit.uncertainties["R_c"]


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_outliers(loss: str, draws: Callable[[int, int], int]) -> None:
    """Two in a hundred points are 5 to 50 pixels off; the errors stay near the errors of clean data."""
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(draws(15, 30)):
        points, lens = noisy_grid(rng, 20.0, 20.0, 0.1)
        wrong = rng.random(points.shape[:2]) < 0.02
        angle = rng.uniform(0.0, 2.0 * np.pi, np.count_nonzero(wrong))
        points[wrong] += rng.uniform(5.0, 50.0, len(angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        squares.append(errors(fit_lens(grid_lines(points), model="k1,k2", lines="free", loss=loss), lens) ** 2)
    # The row and the column of an outlier are down-weighted independently: predicted errors hold to about a third.
    assert 0.6 < np.sqrt(np.mean(squares)) < 1.5


def test_outliers_are_pointed_out(rng: np.random.Generator) -> None:
    points, _ = noisy_grid(rng, 20.0, 20.0, 0.1)
    assert fit_lens(grid_lines(points)).warnings == ()
    points[5, 7] += [15.0, 0.0]
    points[10, 20] -= [0.0, 40.0]
    (warning,) = (each for each in fit_lens(grid_lines(points)).warnings if "outliers" in each)
    assert warning.endswith("there are outliers; use loss='tukey'")
    assert not any("outliers" in each for each in fit_lens(grid_lines(points), loss="tukey").warnings)


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_a_line_of_outliers(rng: np.random.Generator, loss: str) -> None:
    """A row of points on a curve instead of a straight line."""
    points, lens = noisy_grid(rng, 20.0, 20.0, 0.1)
    rows, columns = grid_lines(points)
    zigzag = rows[5] + np.where(np.arange(len(rows[5])) % 2, 30.0, -30.0)[:, None] * [0.0, 1.0]
    fit = fit_lens([(*rows[:5], zigzag, *rows[6:]), columns], model="k1,k2", lines="free", loss=loss)
    assert np.all(np.abs(errors(fit, lens)) < 5.0)
    assert fit.rms_px < (5.0 if loss == "huber" else 0.15)


def test_loss_without_outliers_costs_little(rng: np.random.Generator) -> None:
    points, lens = noisy_grid(rng, 20.0, 20.0, 0.1)
    plain = fit_lens(grid_lines(points), model="k1,k2", lines="vanishing")
    for loss in ("huber", "tukey"):
        robust = fit_lens(grid_lines(points), model="k1,k2", lines="vanishing", loss=loss)
        ratio = np.sqrt(np.diag(robust.covariance) / np.diag(plain.covariance))
        assert np.all((ratio > 0.85) & (ratio < 1.2))
        assert np.all(np.abs(errors(robust, lens)) < 5.0)


def test_known_centre(rng: np.random.Generator) -> None:
    points, lens = noisy_grid(rng, 20.0, 10.0, 0.05)
    fit = fit_lens(grid_lines(points), model="k1,k2", centre=lens.centre)
    assert fit.lens.centre == pytest.approx(lens.centre, rel=1e-12)
    assert fit.uncertainties["C_c"] == fit.uncertainties["R_c"] == 0.0
    assert np.all(np.abs(fit.values[:2] - [lens.k1, lens.k2]) < 5.0 * np.sqrt(np.diag(fit.covariance))[:2])
    # A single line is sufficient here.
    single = fit_lens([[points[3]]], model="k1", centre=lens.centre)
    assert single.lens.k1 == pytest.approx(lens.k1, abs=5.0 * single.uncertainties["k1"] + 0.15 * lens.k1)


def one_line(rng: np.random.Generator, count: int = 1) -> list[list[np.ndarray]]:
    """The same line, bent, measured several times."""
    lens = radial_lens(10.0)
    line = np.column_stack([np.linspace(50.0, 900.0, 20), np.linspace(100.0, 300.0, 20)])
    return [[lens.distort(line) + rng.normal(0.0, 0.05, line.shape) for _ in range(count)]]


@pytest.mark.parametrize("model", ["auto", "k1", "k1,k2"])
@pytest.mark.parametrize("count", [1, 4])
def test_one_line_is_not_enough(rng: np.random.Generator, model: str, count: int) -> None:
    with pytest.raises(ValueError, match="all points lie along one line, whose bend k1 and the centre share"):
        fit_lens(one_line(rng, count), model=model)
    assert fit_lens(one_line(rng, count), model="none").lens is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"model": "k3"}, "model is 'k3', expected 'auto' or one of"),
        ({"lines": "straight"}, "lines is 'straight', expected one of"),
        ({"loss": "l1"}, "loss is 'l1', expected one of"),
        ({"solver": "simplex"}, "solver is 'simplex', expected one of"),
        ({"sigma": 0.0}, "sigma is 0.0, expected more than 0 pixels"),
        ({"solver": "gauss_newton"}, "needs lines='vanishing'"),
    ],
)
def test_wrong_words_are_refused(rng: np.random.Generator, wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_lens(grid_lines(plane_grid(rng, 0.0)), **wrong)


def test_too_few_points_are_refused(rng: np.random.Generator) -> None:
    points = plane_grid(rng, 20.0)
    with pytest.raises(ValueError, match="9 points on 3 lines leave 3 numbers for 4 parameters and the errors"):
        fit_lens([[points[0, :3], points[9, :3], points[20, :3]]], model="k1,k2", lines="free")
    with pytest.raises(ValueError, match="no family has two lines, so none has a vanishing point"):
        fit_lens([[points[0]], [points[:, 0]]], model="k1", lines="vanishing")
    # As many numbers as parameters: two of the lens, two of the vanishing point and one of each line.
    with pytest.raises(ValueError, match="6 points on 2 lines leave nothing to estimate the errors from"):
        fit_lens([[points[2, :3], points[9, :3]]], model="k1,k2", lines="vanishing", centre=(320.0, 240.0))
    with pytest.raises(ValueError, match="all lines go through the centre"):
        fit_lens([[points[11]]], model="k1", centre=tuple(points[11, 3]))


def test_a_family_of_one_line_is_free(rng: np.random.Generator) -> None:
    points, lens = noisy_grid(rng, 20.0, 10.0, 0.05)
    rows, columns = grid_lines(points)
    fit = fit_lens([rows, columns[:1], ()], model="k1,k2", lines="vanishing")
    assert np.all(np.isnan(fit.vanishing_points[1:]))
    assert np.all(np.abs(errors(fit, lens)) < 5.0)
    assert any("families [1, 2] have fewer than two lines" in each for each in fit.warnings)


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "raw", "best", "centre"),
    [
        ("dot_pattern_01", 3.3, 0.079, (1257.0, 1020.0)),
        ("dot_pattern_02", 0.94, 0.695, None),
        ("line_pattern_01", 0.6, 0.117, None),
    ],
)
def test_real_targets(data: Path, name: str, raw: float, best: float, centre: tuple[float, float] | None) -> None:
    """The residual is as small as the best published one, and nearly as small with the automatic model."""
    image = cv2.imread(str(data / "calibration" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    families = find_lines(image) if name.startswith("line") else grid_lines(find_dots(image).points)
    assert straightness_px(families) == pytest.approx(raw, rel=0.2)
    for lines, model in (("free", "k1,k2"), ("auto", "auto")):
        fit = fit_lens(families, lines=lines, model=model)
        assert straightness_px(families, fit.lens) <= best
        if centre is not None:
            assert np.hypot(*np.subtract(fit.lens.centre, centre)) < 3.0
