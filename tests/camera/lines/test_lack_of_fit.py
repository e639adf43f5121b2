"""Smooth residuals: found where they are, not where there is noise alone, and covered by the uncertainties."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.special import eval_legendre
from scipy.stats import chi2, f

from gpuvision.camera.lines import lack_of_fit
from gpuvision.camera.lines.line_families import grid_lines, pack
from gpuvision.camera.lines.straightness import Parameters
from gpuvision.camera.lines.vanishing_points import LensFit, fit_lens
from gpuvision.camera.lines.variable_projection import minimise
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from straight_lines import HALF, plane_grid, radial_lens

LENS = radial_lens(10.0)
Families = list[list[np.ndarray]]


def smooth_field(rng: np.random.Generator, points: np.ndarray, rms: float, *, waves: int = 40) -> np.ndarray:
    """Return a random smooth displacement (..., 2): plane waves whose lengths are about the size of the image."""
    field = np.zeros(points.shape)
    for _ in range(waves):
        direction, phase = rng.normal(0.0, 3.0, 2), rng.uniform(0.0, 2.0 * np.pi)
        wave = np.cos((points - 512.0) @ direction / HALF + phase)
        field += wave[..., None] * rng.normal(size=2)
    return field * rms / np.sqrt(waves)


def errors(fit: LensFit) -> np.ndarray:
    """Errors of k1, k2 and the centre in standard deviations."""
    true = np.array([LENS.k1, LENS.k2, *LENS.centre])
    return np.asarray((fit.values[:4] - true) / np.sqrt(np.diag(fit.covariance))[:4])


@pytest.mark.parametrize("lines", ["free", "vanishing"])
def test_noise_alone_is_no_lack_of_fit(rng: np.random.Generator, lines: str) -> None:
    ideal = LENS.distort(plane_grid(rng, 30.0))
    fits = [
        fit_lens(grid_lines(ideal + rng.normal(0.0, 0.1, ideal.shape)), model="k1,k2", lines=lines) for _ in range(60)
    ]
    p_values = np.array([fit.lack_of_fit.p_value for fit in fits])
    # Expected shares 0.1 and 0.5, with standard deviations of 0.04 and 0.065.
    assert np.mean(p_values < 0.1) < 0.25
    assert 0.25 < np.mean(p_values < 0.5) < 0.75
    assert np.mean([fit.error_model == "independent" for fit in fits]) >= 0.85
    assert np.mean([fit.lack_of_fit.noise_px for fit in fits]) == pytest.approx(0.1, rel=0.03)


def test_a_bent_target_is_said(rng: np.random.Generator) -> None:
    """A smooth field of 0.1 px beside noise of 0.02 px. The F test between lens models accepts a lens regardless."""
    ideal = LENS.distort(plane_grid(rng, 20.0))
    points = ideal + smooth_field(rng, ideal, 0.1) + rng.normal(0.0, 0.02, ideal.shape)
    fit = fit_lens(grid_lines(points))
    assert fit.error_model == "correlated"
    assert any("smooth pattern" in each for each in fit.warnings)
    assert fit.lack_of_fit.noise_px == pytest.approx(0.02, rel=0.15)
    assert fit.rms_px**2 == pytest.approx(fit.lack_of_fit.rms_px**2 + 0.02**2, rel=0.2)
    plain = fit_lens(grid_lines(ideal + rng.normal(0.0, 0.02, ideal.shape)))
    assert not any("smooth pattern" in each for each in plain.warnings)


def test_errors_that_are_taken_as_independent_are_not_tested(rng: np.random.Generator) -> None:
    """The lens is the same; the covariance is smaller by what the smooth field adds."""
    ideal = LENS.distort(plane_grid(rng, 20.0))
    points = grid_lines(ideal + smooth_field(rng, ideal, 0.1) + rng.normal(0.0, 0.02, ideal.shape))
    tested = fit_lens(points, model="k1,k2", lines="free")
    quick = fit_lens(points, model="k1,k2", lines="free", error_model="independent")
    assert (quick.lack_of_fit, quick.error_model) == (None, "independent")
    assert quick.lens == tested.lens
    assert np.all(np.diag(quick.covariance) < 0.25 * np.diag(tested.covariance))
    with pytest.raises(ValueError, match="error_model is 'white', expected one of 'auto', 'independent'"):
        fit_lens(points, error_model="white")


def test_a_wide_angle_lens_of_two_coefficients_is_said_to_be_too_small(rng: np.random.Generator) -> None:
    wide = radial_lens(0.0)
    wide = type(wide)(k1=-0.14 / HALF**2, k2=0.06 / HALF**4, k3=0.1 / HALF**6, centre=(530.0, 500.0))
    ideal = wide.distort(plane_grid(rng, 20.0, rows=31, columns=41))
    points = grid_lines(ideal + rng.normal(0.0, 0.02, ideal.shape))
    small = fit_lens(points, model="k1,k2")
    assert any("smooth pattern" in each and "model k1,k2;" in each for each in small.warnings)
    assert fit_lens(points).lens.k3 != 0.0


def test_covariance_adds_the_field_and_two_jackknives(monkeypatch: pytest.MonkeyPatch) -> None:
    """By lines and by blocks, less that by both; known and undetermined parameters stay as they are."""
    rng = np.random.default_rng(3)
    columns, modes, seen, residual, rest = (rng.normal(size=size) for size in ((5, 40), (4, 40), (3, 40), 40, 40))
    white = np.diag([4.0, np.inf, 9.0, 0.0, 25.0])
    white[0, 2] = white[2, 0] = 1.5
    place = np.linspace(-1.0, 1.0, 40)
    packed: Any = types.SimpleNamespace(x=2.0 * place, y=np.flip(place), corner=np.array([2.0, 1.0]))
    packed.line = np.repeat(np.arange(8), 5)
    degree = np.array([2, 2, 3, 3])
    smooth: Any = types.SimpleNamespace(
        columns=modes, seen=seen, residual=residual, rest=rest, variance=0.5, degree=degree
    )
    kept, sizes = [0, 2, 4], np.array([2.0, 3.0, 5.0])
    scaled = columns[kept] * sizes[:, None]
    by_degree = np.array([0.0, 0.0, 0.3, 0.7])
    block = np.clip(((place + 1.0) * 2.0).astype(int), 0, 3)
    block = 4 * np.flip(block) + block
    parts = {"line": 20.0, "block": 30.0, "both": 7.0}
    labels = {"line": packed.line, "block": block, "both": packed.line * 16 + block}

    def jackknife(given: Any, normal: Any, errors: Any, clusters: Any) -> np.ndarray:
        np.testing.assert_allclose(given, scaled)
        np.testing.assert_allclose(normal, scaled @ scaled.T)
        assert errors is rest
        (name,) = (name for name, each in labels.items() if np.array_equal(each, clusters))
        return parts[name] * np.eye(3)

    def variances(*arguments: Any) -> np.ndarray:
        for found, expected in zip(arguments, (degree, seen @ seen.T, seen @ residual, 0.5, 40), strict=True):
            np.testing.assert_allclose(found, expected)
        return by_degree

    monkeypatch.setattr(lack_of_fit, "_lens_columns", lambda *_: columns)
    monkeypatch.setattr(lack_of_fit, "cluster_jackknife", jackknife)
    monkeypatch.setattr(lack_of_fit, "mode_variances", variances)
    found = lack_of_fit.correlated_covariance(packed, types.SimpleNamespace(), smooth, white)
    shifts = np.linalg.pinv(scaled.T) @ modes.T
    field = shifts @ np.diag(by_degree[degree]) @ shifts.T
    expected = white.copy()
    expected[np.ix_(kept, kept)] = (field + 43.0 * np.eye(3)) * np.outer(sizes, sizes)
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(
    ("freedom", "count"), [(0, 0), (47, 0), (48, 6), (111, 6), (112, 14), (192, 24), (399, 36), (400, 50), (10**6, 66)]
)
def test_number_of_modes_of_the_field(rng: np.random.Generator, freedom: int, count: int) -> None:
    """Degrees 2 to 7 have 6, 8, 10 ... modes: each needs 4 degrees of freedom, here of errors that count twice."""
    packed = pack(grid_lines(plane_grid(rng, 20.0, rows=9, columns=8)))
    found = minimise(packed, Parameters(np.empty(0), np.zeros(2), None))
    smooth = lack_of_fit.smooth_residuals(packed, found, freedom, len(packed.x) // 2, None)
    degrees = [n for n in range(2, 8) for _ in range(2 * (n + 1))]
    np.testing.assert_array_equal(smooth.degree, degrees[:count])
    assert smooth.columns.shape == smooth.seen.shape == (count, len(packed.x))


def test_modes_are_products_of_legendre_polynomials(rng: np.random.Generator) -> None:
    """Each moves the points across their straight lines, which follow: what is linear along a line is not left over."""
    points = rng.uniform((0.0, 0.0), (900.0, 400.0), (12, 7, 2))
    packed = pack([list(points)])
    found = minimise(packed, Parameters(np.empty(0), np.zeros(2), None))
    smooth = lack_of_fit.smooth_residuals(packed, found, 10**6, len(packed.x), None)
    place = np.stack([packed.x, packed.y], axis=-1)
    u, v = (place / packed.corner).T
    shapes = [
        np.sqrt((2 * power + 1) * (2 * (n - power) + 1)) * eval_legendre(power, u) * eval_legendre(n - power, v)
        for n in range(2, 8)
        for power in range(n + 1)
    ]
    expected = np.zeros((66, len(place)))
    for line in range(12):
        (inside,) = np.nonzero(packed.line == line)
        along, normal = np.linalg.svd(place[inside] - place[inside].mean(axis=0))[2]
        normal = normal * np.sign(normal @ (found.evaluation.nx[inside[0]], found.evaluation.ny[inside[0]]))
        design = np.stack([np.ones(7), place[inside] @ along], axis=1)
        for number, shape in enumerate(shapes):
            for axis in (0, 1):
                moved = shape[inside] * normal[axis]
                fitted = design @ np.linalg.lstsq(design, moved, rcond=None)[0]
                expected[2 * number + axis, inside] = moved - fitted
    np.testing.assert_allclose(smooth.columns, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(smooth.seen, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("freedom", "variance"), [(20, None), (20, 0.3), (4, None), (3, None), (2, None)])
def test_the_residuals_are_compared_with_the_modes_that_are_seen(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, freedom: int, variance: float | None
) -> None:
    """A mode counts if lens and lines leave more than 1e-3 of its mean square of 1: here three of six."""
    lens = rng.normal(size=(2, 30))
    basis = np.linalg.qr(np.vstack([lens, rng.normal(size=(6, 30))]).T)[0].T
    share = np.array([1.0, 0.3, 1.01e-3, 0.99e-3, 1e-5, 0.0])
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    seen = turn @ (np.sqrt(30.0 * share)[:, None] * basis[2:])
    columns = seen + rng.normal(size=(6, 2)) @ lens
    residual = 0.1 * rng.normal(size=30) + basis[2:5].T @ [1.0, -0.5, 0.25]
    evaluation = types.SimpleNamespace(residual=residual, cost=float(residual @ residual))
    found: Any = types.SimpleNamespace(evaluation=evaluation)
    asked = []
    monkeypatch.setattr(lack_of_fit, "_lens_columns", lambda *_: lens)
    monkeypatch.setattr(lack_of_fit, "_field", lambda *given: asked.append(given[2]) or (columns, np.full(6, 2)))
    smooth = lack_of_fit.smooth_residuals(types.SimpleNamespace(unit=500.0), found, freedom, 12, variance)
    assert asked == [freedom * 12 // 120]
    np.testing.assert_allclose(smooth.seen, seen, atol=1e-9)
    fitted = basis[2:5].T @ (basis[2:5] @ residual)
    np.testing.assert_allclose(smooth.rest, residual - fitted, atol=1e-9)
    gain, left = fitted @ fitted, max(freedom - 3, 1)
    noise = (residual @ residual - gain) / left
    assert smooth.variance == pytest.approx(noise)
    lack = smooth.lack_of_fit
    assert (lack.modes, lack.noise_px) == (3, pytest.approx(500.0 * np.sqrt(noise)))
    surplus = max(gain - 3.0 * noise, 0.0) / 30.0
    assert lack.rms_px == pytest.approx(500.0 * np.sqrt(surplus))
    # Of 30 residuals 12 are independent.
    if variance is not None:
        assert lack.p_value == pytest.approx(chi2.sf(gain / 2.5 / variance, 3))
    elif freedom > 3:
        ratio = (gain / 3.0) / ((residual @ residual - gain) / (freedom - 3))
        assert lack.p_value == pytest.approx(f.sf(ratio / 2.5, 3, (freedom - 3) / 2.5))
    else:
        assert lack.p_value == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("rms", [0.03, 0.2])
def test_uncertainties_cover_correlated_errors(rms: float) -> None:
    """Monte Carlo: random smooth fields on the target. Independent errors would claim several times too little."""
    rng = np.random.default_rng(5)
    found, independent = [], []
    for _ in range(40):
        ideal = LENS.distort(plane_grid(rng, 20.0))
        points = ideal + smooth_field(rng, ideal, rms) + rng.normal(0.0, 0.02, ideal.shape)
        fit = fit_lens(grid_lines(points), model="k1,k2", lines="free")
        found.append(errors(fit))
        exact = fit_lens(grid_lines(ideal), model="k1,k2", lines="free", sigma=fit.sigma_px)
        scale = np.sqrt(np.diag(fit.covariance) / np.diag(exact.covariance))[:4]
        independent.append(found[-1] * scale)
    assert np.mean(np.abs(found) < 3.0) >= 0.95
    assert np.mean(np.abs(independent) < 3.0) < 0.7


def halves(families: Families) -> list[tuple[str, list[Families]]]:
    """Return the families split by alternate lines, left and right, top and bottom."""
    points = np.concatenate([line for family in families for line in family])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    result = [("lines", [[list(family[first::2]) for family in families] for first in (0, 1)])]
    for axis, name in enumerate(("columns", "rows")):
        parts = []
        for side in (False, True):
            cut = [[line[(line[:, axis] > middle[axis]) == side] for line in family] for family in families]
            parts.append([[line for line in family if len(line) > 4] for family in cut])
        result.append((name, parts))
    return result


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("name", ["dot_pattern_01", "dot_pattern_02", "line_pattern_01"])
def test_halves_of_real_targets_agree(data: Path, name: str) -> None:
    """Independent errors would have the halves differ by up to 48 standard deviations."""
    image = cv2.imread(str(data / "calibration" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    families = find_lines(image) if name.startswith("line") else grid_lines(find_dots(image).points)
    model = fit_lens(families).model
    found = []
    for _, parts in halves(families):
        one, other = (fit_lens(part, model=model, lines="free") for part in parts)
        count = model.count(",") + 3
        sigma = np.sqrt(np.diag(one.covariance) + np.diag(other.covariance))
        found += list(((one.values - other.values) / sigma)[:count])
    assert np.mean(np.abs(found) < 3.0) >= 0.95
