"""Smooth residuals: found where they are, not where there is noise alone, and covered by the uncertainties."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.camera.lines import lack_of_fit
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.vanishing_points import LensFit, fit_lens
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
