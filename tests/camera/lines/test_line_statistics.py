"""Statistics of fits to lines against SciPy and numerical derivatives."""

from __future__ import annotations

import types
from typing import Any

import numpy as np
import pytest
import scipy.stats

from gpuvision.camera.lines import line_statistics
from gpuvision.camera.lines.line_families import grid_lines, pack
from gpuvision.camera.lines.line_statistics import (
    Loss,
    count_independent_errors,
    influence_slope,
    p_value_of_gain,
    point_identifiers,
    robust_weights,
)
from gpuvision.camera.lines.straightness import Parameters
from gpuvision.camera.lines.variable_projection import minimise
from straight_lines import plane_grid


def test_a_point_on_several_lines_has_one_identifier() -> None:
    points = np.array([[0.1, 0.2], [0.2, 0.1], [0.1, 0.2], [0.3, 0.2], [0.1, 0.2], [0.2, 0.1]])
    packed: Any = types.SimpleNamespace(x=points[:, 0], y=points[:, 1])
    found = point_identifiers(packed)
    same = (points[:, None] == points[None]).all(axis=2)
    np.testing.assert_array_equal(found[:, None] == found[None], same)
    assert set(found.tolist()) == {0, 1, 2}
    assert count_independent_errors(found) == 2 + 2 + 1  # at most two of a point


@pytest.mark.parametrize("repeated", [1, 3])
def test_p_values_are_those_of_scipy(repeated: int) -> None:
    """Residuals that are repeated count once: sums of squares and degrees of freedom are larger by the factor."""
    residuals = (40 * repeated, 40)
    for worse, better, more in ((60.0, 50.0, 2), (52.0, 50.0, 3), (49.0, 50.0, 1)):
        sums, freedom = (worse * repeated, better * repeated), 35 * repeated
        gain = max(worse - better, 0.0)
        found = p_value_of_gain(*sums, more, residuals, freedom, None)
        assert found == pytest.approx(scipy.stats.f.sf(gain / more / (better / 35.0), more, 35), rel=1e-9)
        known = p_value_of_gain(*sums, more, residuals, freedom, 1.3)
        assert known == pytest.approx(scipy.stats.chi2.sf(gain / 1.3, more), rel=1e-9)
    assert p_value_of_gain(60.0, 50.0, 0, residuals, 35, None) == 1.0
    assert p_value_of_gain(60.0, 50.0, 2, residuals, 0, None) == 1.0
    assert p_value_of_gain(60.0, 50.0, 2, residuals, 1, None) < 1.0


@pytest.mark.parametrize(("loss", "rounds"), [("huber", 1), ("tukey", 2)])
def test_reweighting_ends_when_the_weights_stay(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, loss: Loss, rounds: int
) -> None:
    """Exact lines have weights of 1 in the first round of each stage: Tukey's loss starts from Huber's minimum."""
    packed = pack(grid_lines(plane_grid(rng, 20.0)))
    calls = []

    def counted(*arguments: Any, **more: Any) -> Any:
        calls.append(more)
        return minimise(*arguments, **more)

    monkeypatch.setattr(line_statistics, "minimise", counted)
    start = minimise(packed, Parameters(np.empty(0), np.zeros(2), None))
    _, weight, scale = line_statistics.fit_reweighted(packed, start, loss, 0.01, keep_centre=True)
    assert [each["keep_centre"] for each in calls] == [True] * rounds
    np.testing.assert_allclose(weight, 1.0)
    assert scale == 0.01
    calls.clear()
    # Errors with one outlier: weights by the final residuals.
    for coordinate in (packed.x, packed.y):
        coordinate[:] += rng.normal(0.0, 1e-3, len(coordinate))
    packed.y[5] += 0.1
    start = minimise(packed, Parameters(np.empty(0), np.zeros(2), None))
    found, weight, scale = line_statistics.fit_reweighted(packed, start, loss, None, keep_centre=False)
    assert rounds < len(calls) < 20 * rounds
    assert found.converged
    monkeypatch.setattr(line_statistics, "_MAX_ROUNDS", 1)
    assert not line_statistics.fit_reweighted(packed, start, loss, None, keep_centre=False)[0].converged
    distance = found.evaluation.distance
    limit = {"huber": 1.345, "tukey": 4.685}[loss] * scale
    huber, tukey = limit / np.maximum(np.abs(distance), limit), np.maximum(1.0 - (distance / limit) ** 2, 1e-4) ** 2
    expected = huber if loss == "huber" else tukey
    np.testing.assert_allclose(weight, expected, atol=0.01)
    assert weight[5] < {"huber": 0.2, "tukey": 1e-7}[loss]


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_slope_is_the_derivative_of_the_weighted_residual(loss: Loss) -> None:
    limit, scale = {"huber": 1.345, "tukey": 4.685}[loss], 0.2
    ratio = np.concatenate([np.linspace(-6.0, 6.0, 37), limit * np.array([-0.999, 0.999, 1.001])])

    def weighted(at: np.ndarray) -> np.ndarray:
        return np.asarray(robust_weights(at * scale, scale, loss) * at)

    slope = (weighted(ratio + 1e-6) - weighted(ratio - 1e-6)) / 2e-6
    np.testing.assert_allclose(influence_slope(ratio, loss), slope, atol=1e-4)
    assert influence_slope(np.array([limit]), loss)[0] == 0.0
    np.testing.assert_allclose(robust_weights(np.array([0.0]), scale, loss), 1.0)
    # Beyond Tukey's limit a residual keeps a weight of 1e-8.
    far = {"huber": limit / 50.0, "tukey": 1e-8}[loss]
    np.testing.assert_allclose(robust_weights(np.array([50.0 * scale]), scale, loss), far)
