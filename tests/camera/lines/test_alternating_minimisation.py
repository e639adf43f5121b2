"""The thesis' alternating minimisation reaches the minimum of variable projection, with more evaluations."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.alternating_minimisation import (
    ALTERNATING_SOLVERS,
    centre_from_curvature,
    mean_intersections,
    minimise_alternating,
)
from gpuvision.camera.lines.line_families import PackedLines, grid_lines, pack
from gpuvision.camera.lines.vanishing_points import fit_lens
from straight_lines import plane_grid, radial_lens


@pytest.fixture
def points(rng: np.random.Generator) -> np.ndarray:
    """The thesis' grid of 5 x 9 points, tilted, 20 pixels of distortion."""
    ideal = plane_grid(rng, 30.0, rows=5, columns=9)
    return radial_lens(20.0).distort(ideal) + rng.normal(0.0, 0.02, ideal.shape)


def test_centre_from_curvature(rng: np.random.Generator) -> None:
    """For strong distortion without noise, the extremes of curvature indicate the centre."""
    lens = Lens(k1=-2e-7, centre=(480.0, 530.0))
    packed = pack(grid_lines(lens.distort(plane_grid(rng, 0.0))))
    centre = packed.origin + packed.unit * centre_from_curvature(packed)
    # A quartic only approximates the curve: an error of a few pixels remains.
    assert np.hypot(*(centre - lens.centre)) < 10.0


def test_centre_of_quartic_curves() -> None:
    """Quartics, symmetric about the centre's row or column: an error only from the slope of their chords."""
    centre, along = np.array([0.2, -0.1]), np.linspace(-1.0, 1.0, 21)
    lines: list[list[np.ndarray]] = [[], []]
    for offset in (-0.6, 0.7):
        for axis, family in enumerate(lines):
            part = along - centre[axis]
            bent = offset * (1.0 + 0.01 * part**4)
            family.append(np.stack([along, bent] if axis == 0 else [bent, along], axis=1))
    packed = pack(lines)
    found = packed.origin + packed.unit * centre_from_curvature(packed)
    np.testing.assert_allclose(found, centre, atol=1e-4)


def test_straight_lines_have_no_centre(rng: np.random.Generator) -> None:
    packed = pack(grid_lines(plane_grid(rng, 20.0)))
    assert np.all(np.abs(centre_from_curvature(packed)) < packed.corner)
    np.testing.assert_array_equal(centre_from_curvature(pack([[np.arange(8.0).reshape(4, 2)]])), 0.0)


def test_points_from_intersections(rng: np.random.Generator) -> None:
    ideal = plane_grid(rng, 40.0)
    packed = pack(grid_lines(ideal))
    exact = fit_lens(grid_lines(ideal), model="none", lines="vanishing").vanishing_points
    found = packed.origin + packed.unit * mean_intersections(packed)
    np.testing.assert_allclose(found, exact[:, :2] / exact[:, 2:], rtol=1e-6)


def distance_sum(packed: PackedLines, lens: np.ndarray, points: np.ndarray) -> float:
    """Compute the sum of eq. 3.10 to 3.15; the angle of a line follows from the scatter about its vanishing point."""
    total = 0.0
    place = np.stack([packed.x, packed.y], axis=-1)
    offset = place - lens[2:]
    square = np.sum(offset**2, axis=-1, keepdims=True)
    moved = lens[2:] + offset * (1.0 + square * (lens[0] + lens[1] * square))
    for line in range(len(packed.counts)):
        about = moved[packed.line == line] - points[packed.family[line]]
        total += np.linalg.svd(about, compute_uv=False)[1] ** 2
    return total


@pytest.mark.parametrize("solver", ALTERNATING_SOLVERS)
def test_solvers_minimise_what_the_thesis_says(points: np.ndarray, solver: str) -> None:
    packed = pack(grid_lines(points))
    found = minimise_alternating(packed, 2, solver, max_rounds=3)
    parameters = found.minimum.parameters
    lens, places = (
        np.concatenate([parameters.k, parameters.centre]),
        parameters.vanishing[:, :2] / parameters.vanishing[:, 2:],
    )
    start = np.concatenate([np.zeros(2), centre_from_curvature(packed)])
    before = distance_sum(packed, start, mean_intersections(packed))
    # Three rounds of alternating fits are far from convergence.
    assert distance_sum(packed, lens, places) < 0.5 * before
    assert found.evaluations > found.minimum.iterations == 3
    # Convergence ends the solvers, not the limit of 2000 evaluations a round.
    assert found.evaluations < 2000


@pytest.mark.slow
def test_fit_by_a_solver(points: np.ndarray) -> None:
    """A fit reports the result and the rounds of its solver; variable projection is never worse."""
    families = grid_lines(points)
    ours, theirs = (
        fit_lens(families, model="k1", lines="vanishing", solver=each)
        for each in ("variable_projection", "gauss_newton")
    )
    assert theirs.rms_px > ours.rms_px * (1.0 - 1e-6)
    assert theirs.iterations > ours.iterations


@pytest.mark.nightly
def test_the_simplex_ends_where_ours_does(points: np.ndarray) -> None:
    families = grid_lines(points)
    ours = fit_lens(families, model="k1", lines="vanishing")
    theirs = fit_lens(families, model="k1", lines="vanishing", solver="nelder_mead")
    # The distances of the thesis shrink with the lens scale: the bias is less than the uncertainty.
    sigma = np.sqrt(np.diag(ours.covariance))
    assert np.all(np.abs(theirs.values - ours.values)[:3] < 0.5 * sigma[:3])
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(theirs.covariance / scale, ours.covariance / scale, atol=0.1)
