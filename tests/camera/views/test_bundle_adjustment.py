"""Bundle adjustment: robust losses, normal equations against differences, steps and the minimum."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from gpuvision.camera.tilted_projection import rotation_matrix
from gpuvision.camera.views import camera_fit
from gpuvision.camera.views.bundle_adjustment import (
    FitState,
    NormalEquations,
    PackedViews,
    RobustLoss,
    adjust,
    apply_step,
    linearise,
    residuals,
    robust_scale,
    solve_step,
)
from gpuvision.camera.views.camera_fit import residual_sigma, residual_variance_factor
from gpuvision.camera.views.parameters import FreeParameters


@pytest.mark.parametrize("kind", ["squared", "huber", "tukey"])
@pytest.mark.parametrize("scale", [0.3, 2.0])
def test_weights_and_slopes_are_derivatives_of_the_loss(kind: str, scale: float) -> None:
    """For the loss L / 2 of a residual r in a plane: w r = L' / 2, and the mean curvature (L'' + L' / r) / 4."""
    loss, step = RobustLoss(kind, scale), 1e-4 * scale
    length = scale * np.linspace(0.06, 7.06, 141)  # no sample within a step of the ends of the losses
    below, here, above = (loss.cost(length + sign * step) for sign in (-1.0, 0.0, 1.0))
    first, second = (above - below) / (2.0 * step), (above - 2.0 * here + below) / step**2
    np.testing.assert_allclose(loss.weight(length) * length, 0.5 * first, atol=1e-6 * scale)
    np.testing.assert_allclose(loss.slope(length), 0.25 * (second + first / length), atol=1e-5)
    assert loss.weight(np.array([1e-9 * scale])) == pytest.approx(1.0)
    assert loss.cost(np.array([1e-3 * scale])) == pytest.approx(1e-6 * scale**2, rel=1e-4)


def test_variance_of_residuals(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """Of 3 views with 12, 10 and 7 points a camera takes 5 parameters and each pose 6; padding does not count."""
    weight = np.arange(12) < np.array([12, 10, 7])[:, None]
    errors = rng.normal(0.0, 0.3, (3, 2, 12))
    views = PackedViews(np.zeros((3, 3, 12)), np.zeros((3, 2, 12)), weight.astype(float))
    known = np.sum(errors**2, axis=1)[weight]
    state: Any = SimpleNamespace(cost=float(np.sum(known)))
    free: Any = SimpleNamespace(count=5)
    monkeypatch.setattr(camera_fit, "residuals", lambda *_: errors)
    squared = RobustLoss("squared", 1.0)
    expected = np.sum(known) / (58 - 5 - 18)
    assert residual_sigma(views, free, state, squared) == pytest.approx(math.sqrt(expected))
    assert residual_variance_factor(views, free, state, squared) == pytest.approx(expected)
    assert residual_variance_factor(views, free, state, squared, 0.7) == pytest.approx(0.49)
    # Losses whose edge lies far beyond all residuals are the squared loss.
    for kind in ("huber", "tukey"):
        assert residual_variance_factor(views, free, state, RobustLoss(kind, 1e6)) == pytest.approx(expected)
    # Huber's sandwich: the influences are clipped at 1.5 scales, the curvature is 1 within and half of it along a
    # clipped residual.
    length, edge = np.sqrt(known), 1.5 * 0.2
    inside = length < edge
    assert 5 < np.count_nonzero(inside) < 25
    influence = np.where(inside, length, edge)
    curvature = np.mean(np.where(inside, 1.0, 0.5 * edge / length))
    found = residual_variance_factor(views, free, state, RobustLoss("huber", 0.2))
    assert found == pytest.approx(np.sum(influence**2) / (58 - 5 - 18) / curvature)
    free.count = 58 - 18
    assert math.isnan(residual_sigma(views, free, state, squared))


@pytest.mark.parametrize("damping", [0.0, 1e-4, 2.5])
def test_a_step_solves_the_whole_system(damping: float, rng: np.random.Generator) -> None:
    """Camera and poses in one matrix, whose diagonal is larger by the damping; units of very different sizes."""
    m, count = 5, 3
    root = rng.normal(size=(m + 6 * count, 60)) * 10.0 ** rng.uniform(-4.0, 4.0, (m + 6 * count, 1))
    whole, side = root @ root.T, root @ rng.normal(size=60)
    blocks = [slice(m + 6 * view, m + 6 * view + 6) for view in range(count)]
    for one in blocks:
        for other in blocks:
            if one != other:
                whole[one, other] = 0.0
    system = NormalEquations(
        camera=whole[:m, :m],
        mixed=np.array([whole[:m, each] for each in blocks]),
        pose=np.array([whole[each, each] for each in blocks]),
        camera_side=side[:m],
        pose_side=np.array([side[each] for each in blocks]),
        cost=0.0,
    )
    damped = whole + damping * np.diag(np.diag(whole))
    scale = 1.0 / np.sqrt(np.diag(damped))
    expected = scale * np.linalg.solve(damped * np.outer(scale, scale), scale * side)
    camera, poses, reduced = solve_step(system, damping)
    np.testing.assert_allclose(camera, expected[:m], rtol=1e-6)
    np.testing.assert_allclose(poses, expected[m:].reshape(count, 6), rtol=1e-6)
    others = damped[m:, m:]
    schur = damped[:m, :m] - damped[:m, m:] @ np.linalg.solve(others, damped[m:, :m])
    np.testing.assert_allclose(
        reduced * np.outer(scale[:m], scale[:m]), schur * np.outer(scale[:m], scale[:m]), atol=1e-8
    )


def scene(rng: np.random.Generator) -> tuple[PackedViews, FitState]:
    """Return two views of 9 and 7 points, a state near them, and errors of some pixels."""
    target = np.zeros((2, 3, 9))
    target[:, :2] = rng.uniform(-0.2, 0.2, (2, 2, 9))
    values = np.array([900.0, 1.05, 630.0, 500.0, 660.0, 470.0, -0.2, 0.1, *[0.0] * 6])
    turns = rotation_matrix(rng.normal(0.0, 0.3, (2, 3)))
    state = FitState(values, turns, rng.normal((0.0, 0.0, 1.0), 0.05, (2, 3)))
    empty = PackedViews(target, np.zeros((2, 2, 9)), np.ones((2, 9)))
    image = -residuals(empty, state) + rng.normal(0.0, 2.0, (2, 2, 9))
    weight = np.ones((2, 9))
    weight[1, 7:] = 0.0
    return PackedViews(target, image, weight), state


@pytest.mark.parametrize("kind", ["squared", "huber", "tukey"])
def test_normal_equations_are_those_of_differences(kind: str, rng: np.random.Generator) -> None:
    """Derivatives of the residuals by free parameters and poses, by differences; padding has no weight."""
    views, state = scene(rng)
    free = FreeParameters(coefficients=("k1", "k2"), tilt=True, aspect=True)
    loss = RobustLoss(kind, 1.0)
    system = linearise(views, free, state, loss)
    assert system is not None
    steps = [*np.diag(np.where(np.arange(free.count) < 6, 1e-4, 1e-7)), *np.zeros((12, free.count))]
    steps[1] *= 1e-3  # the aspect
    moves = [*np.zeros((free.count, 2, 6)), *(1e-7 * np.eye(12).reshape(12, 2, 6))]
    columns = []
    for camera, poses in zip(steps, moves, strict=True):
        ends = [residuals(views, apply_step(free, state, sign * camera, sign * poses)) for sign in (1.0, -1.0)]
        size = np.abs(camera).max() + np.abs(poses).max()
        columns.append((ends[1] - ends[0]) / (2.0 * size))
    jacobian, error = np.array(columns).reshape(len(columns), 2, 2, 9), residuals(views, state)
    length = np.hypot(error[:, 0], error[:, 1])
    weight = views.weight * loss.weight(length)
    whole = np.einsum("avcn,bvcn,vn->ab", jacobian, jacobian, weight)
    side = np.einsum("avcn,vcn,vn->a", jacobian, error, weight)
    scale = 1.0 / np.sqrt(np.diag(whole))
    m = free.count
    for found, expected in (
        (system.camera, whole[:m, :m]),
        (system.mixed[1], whole[:m, m + 6 :]),
        (system.pose[0], whole[m : m + 6, m : m + 6]),
    ):
        rows = scale[:m] if len(found) == m else scale[m : m + 6]
        ends = scale[:m] if found.shape[1] == m else scale[m + 6 :] if len(found) == m else scale[m : m + 6]
        np.testing.assert_allclose(found * np.outer(rows, ends), expected * np.outer(rows, ends), atol=1e-5)
    np.testing.assert_allclose(system.camera_side * scale[:m], side[:m] * scale[:m], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(system.pose_side.ravel() * scale[m:], side[m:] * scale[m:], rtol=1e-5, atol=1e-4)
    assert system.cost == pytest.approx(np.sum(views.weight * loss.cost(length)))
    stiff = linearise(views, free, state, loss, stiffness=True)
    assert stiff is not None
    expected = np.einsum("avcn,bvcn,vn->ab", jacobian[:m], jacobian[:m], views.weight * loss.slope(length))
    np.testing.assert_allclose(
        stiff.camera * np.outer(scale[:m], scale[:m]), expected * np.outer(scale[:m], scale[:m]), atol=1e-5
    )


def test_states_without_a_projection(rng: np.random.Generator) -> None:
    views, state = scene(rng)
    free = FreeParameters(coefficients=(), tilt=True)
    for place, value in ((0, 0.0), (0, -900.0), (1, 0.0), (3, math.nan)):
        values = state.values.copy()
        values[place] = value
        assert linearise(views, free, replace(state, values=values), RobustLoss()) is None
    behind = replace(state, translations=-state.translations)
    assert linearise(views, free, behind, RobustLoss()) is None
    assert adjust(views, free, behind, RobustLoss()).cost == math.inf
    known = np.hypot(*residuals(views, state).transpose(1, 0, 2))[views.weight > 0.0]
    assert robust_scale(views, state) == pytest.approx(np.median(known) / math.sqrt(2.0 * math.log(2.0)), rel=1e-4)


def test_the_adjustment_ends_at_the_minimum(rng: np.random.Generator) -> None:
    """SciPy finds no smaller sum of squares; the result says how many steps it took."""
    views, start = scene(rng)
    free = FreeParameters(coefficients=("k1",), tilt=False)
    found = adjust(views, free, start, RobustLoss())
    assert found.converged
    assert 2 < found.iterations < 100
    np.testing.assert_array_equal(found.values[2:4], found.values[4:6])

    def errors(step: np.ndarray) -> np.ndarray:
        scaled = step[: free.count] * np.array([10.0, 10.0, 10.0, 0.01])
        return residuals(views, apply_step(free, found, scaled, 0.01 * step[free.count :].reshape(2, 6))).ravel()

    best = scipy.optimize.least_squares(errors, np.zeros(free.count + 12), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert found.cost == pytest.approx(2.0 * best.cost, rel=1e-6)
    assert found.cost == pytest.approx(np.sum(residuals(views, found) ** 2), rel=1e-9)
