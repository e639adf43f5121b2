"""The thesis' alternating minimisation reaches the minimum of variable projection, with more evaluations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines import alternating_minimisation
from gpuvision.camera.lines.alternating_minimisation import (
    ALTERNATING_SOLVERS,
    _Objective,
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


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_extremes_of_curvature_beyond_the_lines_do_not_count(side: float) -> None:
    """The curvature of the first lines is extreme at 0.9 of their half length, of the others beyond their ends."""
    along = np.linspace(-1.0, 1.0, 31)
    lines: list[list[np.ndarray]] = [[], []]
    for offset, extreme in ((-0.7, 0.9), (0.6, 0.9), (-0.3, 1.1), (0.2, 1.1)):
        for axis, family in enumerate(lines):
            bent = offset + 1e-3 * (along - side * extreme) ** 4
            family.append(np.stack([along, bent] if axis == 0 else [bent, along], axis=1))
    packed = pack(lines)
    found = packed.origin + packed.unit * centre_from_curvature(packed)
    # The point nearest to the normals at the extremes: their slopes are up to 0.005.
    np.testing.assert_allclose(found, [side * 0.9] * 2, atol=0.01)
    far = pack([family[2:] for family in lines])
    np.testing.assert_array_equal(centre_from_curvature(far), 0.0)


def test_lines_of_six_points_have_a_curvature() -> None:
    """A quartic through five points leaves nothing over; lines in one direction do not determine a centre."""
    lines = []
    for count in (6, 5):
        along = np.linspace(-1.0, 1.0, count)
        curves = [offset * (1.0 + 0.01 * (along - 0.1) ** 4) for offset in (-0.6, 0.7)]
        lines.append(
            ([np.stack([along, bent], axis=1) for bent in curves], [np.stack([bent, along], axis=1) for bent in curves])
        )
    packed = pack(lines[0])
    np.testing.assert_allclose(packed.origin + packed.unit * centre_from_curvature(packed), [0.1, 0.1], atol=1e-3)
    np.testing.assert_array_equal(centre_from_curvature(pack(lines[1])), 0.0)
    np.testing.assert_array_equal(centre_from_curvature(pack(lines[0][:1])), 0.0)


def test_straight_lines_have_no_centre(rng: np.random.Generator) -> None:
    packed = pack(grid_lines(plane_grid(rng, 20.0)))
    assert np.all(np.abs(centre_from_curvature(packed)) < packed.corner)
    np.testing.assert_array_equal(centre_from_curvature(pack([[np.arange(8.0).reshape(4, 2)]])), 0.0)


def test_a_line_without_any_curvature_is_left_out() -> None:
    along = np.linspace(-1.0, 1.0, 9)
    flat = [[np.stack([along, np.full(9, offset)], axis=1) for offset in (-0.5, 0.5)]]
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(centre_from_curvature(pack(flat)), 0.0)


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
    assert not found.minimum.converged
    # Convergence ends the solvers, not the limit of 2000 evaluations a round.
    assert found.evaluations < 2000


@pytest.fixture
def few(rng: np.random.Generator) -> tuple[PackedLines, np.ndarray, np.ndarray]:
    """Lines of a grid of 4 x 5 points, a lens beside their minimum, and their vanishing points."""
    ideal = plane_grid(rng, 40.0, rows=4, columns=5)
    packed = pack(grid_lines(radial_lens(40.0).distort(ideal) + rng.normal(0.0, 0.02, ideal.shape)))
    return packed, np.array([0.01, 0.01, 0.3, -0.3]), mean_intersections(packed)


def gradient_of(packed: PackedLines, lens: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the derivatives of the sum of squares by the lens, by central differences."""
    steps = 1e-5 * np.eye(4)
    return np.array(
        [(distance_sum(packed, lens + h, points) - distance_sum(packed, lens - h, points)) / 2e-5 for h in steps]
    )


@pytest.mark.parametrize("steps", [1, 4, 12])
def test_steepest_descent_halves_and_doubles_its_steps(
    few: tuple[PackedLines, np.ndarray, np.ndarray], steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first step has the length 1e-3; a step is halved until the sum decreases, and the next one is doubled."""
    packed, lens, points = few
    monkeypatch.setattr(alternating_minimisation, "_MAX_DESCENTS", steps)
    found = ALTERNATING_SOLVERS["steepest_descent"](_Objective(packed, 2), lens, points)
    expected, length = lens, 1e-3
    for _ in range(steps):
        before, gradient = distance_sum(packed, expected, points), gradient_of(packed, expected, points)
        down = -gradient / np.linalg.norm(gradient)
        while distance_sum(packed, expected + length * down, points) >= before:
            length *= 0.5
        expected, length = expected + length * down, 2.0 * length
    np.testing.assert_allclose(found - lens, expected - lens, rtol=1e-4, atol=1e-8)


def distances_from_lines_at(packed: PackedLines, lens: np.ndarray, points: np.ndarray) -> Callable[..., np.ndarray]:
    """Return the function that gives the distances for a lens from the lines that fit best at another one."""

    def moved(at: np.ndarray) -> np.ndarray:
        offset = np.stack([packed.x, packed.y], axis=-1) - at[2:]
        square = np.sum(offset**2, axis=-1, keepdims=True)
        return np.asarray(at[2:] + offset * (1.0 + square * (at[0] + at[1] * square)))

    about = points[packed.family]
    normals = [
        np.linalg.svd(moved(lens)[packed.line == line] - about[line])[2][1] for line in range(len(packed.counts))
    ]
    return lambda at: np.sum((moved(at) - about[packed.line]) * np.array(normals)[packed.line], axis=-1)


@pytest.mark.parametrize(("start", "steps"), [((0.01, 0.01, 0.3, -0.3), 5), ((0.26, -0.58, 0.41, 0.02), 2)])
def test_gauss_newton_steps_are_those_of_fixed_lines(
    few: tuple[PackedLines, np.ndarray, np.ndarray],
    start: tuple[float, ...],
    steps: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first step from the second start is halved once."""
    packed, _, points = few
    lens = np.array(start)
    monkeypatch.setattr(alternating_minimisation, "_MAX_DESCENTS", steps)
    found = ALTERNATING_SOLVERS["gauss_newton"](_Objective(packed, 2), lens, points)
    expected = lens
    for _ in range(steps):
        distance = distances_from_lines_at(packed, expected, points)
        slopes = [(distance(expected + h) - distance(expected - h)) / 2e-5 for h in 1e-5 * np.eye(4)]
        step = -np.linalg.lstsq(np.stack(slopes, axis=-1), distance(expected), rcond=None)[0]
        while distance_sum(packed, expected + step, points) >= distance_sum(packed, expected, points):
            step = 0.5 * step
        expected = expected + step
    np.testing.assert_allclose(found - lens, expected - lens, rtol=1e-4, atol=1e-7)


def test_a_solver_takes_50_steps_at_most(few: tuple[PackedLines, np.ndarray, np.ndarray]) -> None:
    """From this start the steps of fixed lines go on; each evaluates the derivatives and the sum after the step."""
    packed, lens, points = few
    objective = _Objective(packed, 2)
    ALTERNATING_SOLVERS["gauss_newton"](objective, lens, points)
    assert objective.evaluations == 2 * 50


def test_a_simplex_ends_at_the_minimum_for_fixed_points(few: tuple[PackedLines, np.ndarray, np.ndarray]) -> None:
    packed, lens, points = few
    found = ALTERNATING_SOLVERS["nelder_mead"](_Objective(packed, 2), lens, points)
    least = distance_sum(packed, found, points)
    assert least < 1e-2 * distance_sum(packed, lens, points)
    for step in 1e-3 * np.vstack([np.eye(4), -np.eye(4)]):
        assert distance_sum(packed, found + step, points) > 0.999 * least


def test_the_sum_and_its_derivatives(few: tuple[PackedLines, np.ndarray, np.ndarray]) -> None:
    packed, lens, points = few
    objective = _Objective(packed, 2)
    assert objective.cost(lens, points) == pytest.approx(distance_sum(packed, lens, points), rel=1e-9)
    distance, slopes = objective.slopes(lens, points)
    np.testing.assert_allclose(2.0 * slopes @ distance, gradient_of(packed, lens, points), rtol=1e-6)
    assert objective.evaluations == 2


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
