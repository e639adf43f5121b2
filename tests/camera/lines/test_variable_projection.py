"""Closed-form start, and convergence to the minimum from that start or from any other."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.line_families import grid_lines, pack
from gpuvision.camera.lines.normal_equations import NormalEquations
from gpuvision.camera.lines.straightness import Parameters, evaluate, is_monotonic, pencil_basis
from gpuvision.camera.lines.variable_projection import (
    MinimisationLimits,
    _damped_step,
    apply_step,
    farthest_corner_square,
    linear_start,
    minimise,
    vanishing_start,
)
from straight_lines import plane_grid, radial_lens


@pytest.mark.parametrize("border", [0.1, -0.1])
def test_start_is_right_to_first_order(rng: np.random.Generator, border: float) -> None:
    lens = radial_lens(border, k2_part=0.0)
    packed = pack(grid_lines(lens.distort(plane_grid(rng, 20.0))))
    start = linear_start(packed)
    assert start.rank == 3
    # The neglected terms are of second order: the square of the relative distortion, 0.1 of 600 pixels.
    assert start.parameters.k[0] == pytest.approx(lens.k1 * packed.unit**2, rel=1e-3)
    assert packed.origin + packed.unit * start.parameters.centre == pytest.approx(lens.centre, abs=0.3)


def bends(place: np.ndarray, along: np.ndarray, normal: np.ndarray, about: np.ndarray | None) -> np.ndarray:
    """Return the bends (n, 3) of a line by k1 and by k1 times the centre, or (n, 1) about a known centre."""
    middle = place.mean(axis=0)
    at = middle + np.outer((place - middle) @ along, along) - (np.zeros(2) if about is None else about)
    square, across = np.sum(at**2, axis=1), at @ normal
    first = (across * square)[:, None]
    return first if about is not None else np.hstack([first, -square[:, None] * normal - 2.0 * across[:, None] * at])


@pytest.mark.parametrize("centre", [None, (0.1, -0.2)])
@pytest.mark.parametrize("border", [12.0, -5.0])
def test_start_is_the_least_squares_fit_of_bends(
    rng: np.random.Generator, border: float, centre: tuple[float, float] | None
) -> None:
    """Line by line, by NumPy: what a line absorbs, a shift and a turn, is projected out of bends and distances."""
    ideal = plane_grid(rng, 25.0, rows=6, columns=8)
    packed = pack(grid_lines(radial_lens(border, k2_part=0.0).distort(ideal) + rng.normal(0.0, 0.03, ideal.shape)))
    about = None if centre is None else np.array(centre)
    design, values = [], []
    for line in range(len(packed.counts)):
        place = np.stack([packed.x, packed.y], axis=-1)[packed.line == line]
        along, normal = np.linalg.svd(place - place.mean(axis=0))[2]
        own = np.stack([np.ones(len(place)), place @ along], axis=1)
        out = np.eye(len(place)) - own @ np.linalg.pinv(own)
        design.append(out @ bends(place, along, normal, about))
        values.append(out @ place @ normal)
    design, values = np.concatenate(design), np.concatenate(values)
    found, rest, *_ = np.linalg.lstsq(design, -values, rcond=None)
    start = linear_start(packed, about)
    expected = found[1:] / found[0] if centre is None else about
    np.testing.assert_allclose(start.parameters.centre, expected, rtol=1e-6, atol=1e-9)
    assert start.parameters.k == pytest.approx(found[0], rel=1e-6)
    assert start.gain == pytest.approx(values @ values - rest[0], rel=1e-6)
    assert start.rank == (3 if centre is None else 1)


def test_a_centre_beyond_the_data_is_noise() -> None:
    """Lines whose bends ask for a centre farther than half a diagonal: k1 is that about the middle."""
    along = np.linspace(-1.0, 1.0, 9)
    centre = np.array([3.0, 0.0])
    lines: list[list[np.ndarray]] = [[], []]
    for offset in (-0.7, -0.2, 0.4, 0.8):
        for axis, family in enumerate(lines):
            place = np.stack([along, np.full(9, offset)] if axis == 0 else [np.full(9, offset), along], axis=1)
            away = place - centre
            family.append(place - 1e-3 * away * np.sum(away**2, axis=1, keepdims=True))
    packed = pack(lines)
    start = linear_start(packed)
    np.testing.assert_array_equal(start.parameters.centre, 0.0)
    assert start.parameters.k == pytest.approx(linear_start(packed, np.zeros(2)).parameters.k, rel=1e-9)
    assert start.rank == 3


def test_a_start_that_folds_is_reduced_until_it_does_not() -> None:
    """By factors of 0.7 from the closed form."""
    along = np.linspace(-1.0, 1.0, 9)
    lines = []
    for offset in (-0.9, -0.3, 0.5, 1.0):
        place = np.stack([along, np.full(9, offset)], axis=1)
        lines.append(place + 0.5 * place * np.sum(place**2, axis=1, keepdims=True))
    packed = pack([lines])
    start = linear_start(packed, np.zeros(2))
    k = start.mixed[0]
    factors = 0
    while 1.0 + 3.0 * k * farthest_corner_square(packed, np.zeros(2)) <= 1e-3:
        k, factors = 0.7 * k, factors + 1
    assert factors > 0
    assert start.parameters.k == pytest.approx(k, rel=1e-12)


def test_steps_and_their_bounds(rng: np.random.Generator) -> None:
    """The centre ends 4 half-diagonals from the middle; a fold is tested at the corner, then at the farthest point."""
    packed = pack(grid_lines(plane_grid(rng, 0.0, rows=4, columns=5)))
    at = Parameters(np.array([0.05, 0.01]), np.array([0.3, -0.4]), None)
    moved, bound = apply_step(packed, at, np.array([0.01, -0.02, 0.1, 0.2]))
    np.testing.assert_allclose(np.concatenate([moved.k, moved.centre]), [0.06, -0.01, 0.4, -0.2])
    assert bound == ""
    kept, bound = apply_step(packed, at, np.array([0.01, -0.02]), keep_centre=True)
    np.testing.assert_allclose(np.concatenate([kept.k, kept.centre]), [0.06, -0.01, 0.3, -0.4])
    still = Parameters(np.zeros(1), np.zeros(2), None)
    for distance, ending, expected in ((3.99, 3.99, ""), (4.01, 4.0, "centre"), (50.0, 4.0, "centre")):
        moved, bound = apply_step(packed, still, np.array([1e-6, 0.6 * distance, -0.8 * distance]))
        np.testing.assert_allclose(moved.centre, [0.6 * ending, -0.8 * ending])
        assert bound == expected
    # 1 + 3 k r^2 is 0.001 or more at the farthest point, 1 from the middle of a square grid.
    farthest = float(np.max(packed.x**2 + packed.y**2))
    for share, expected in ((1.0001, "fold"), (0.9999, "")):
        k = -share * 0.999 / (3.0 * farthest)
        assert apply_step(packed, still, np.array([k, 0.0, 0.0]))[1] == expected
    no_lens = Parameters(np.empty(0), np.zeros(2), np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]))
    moved, bound = apply_step(packed, no_lens, np.array([0.1, -0.2, 0.3, 0.05]))
    basis = pencil_basis(no_lens.vanishing)
    for number, step in enumerate(([0.1, -0.2], [0.3, 0.05])):
        expected = no_lens.vanishing[number] + np.array(step) @ basis[number]
        np.testing.assert_allclose(moved.vanishing[number], expected / np.linalg.norm(expected), rtol=1e-12)


def test_damped_steps_are_those_of_levenberg_and_marquardt(rng: np.random.Generator) -> None:
    root = rng.normal(size=(4, 9)) * np.array([[1.0], [1e-4], [100.0], [3.0]])
    matrix, gradient = root @ root.T, np.array([1.0, 2e-4, -300.0, 2.0])
    normal = NormalEquations(matrix, gradient, np.empty((2, 0, 0)))
    for damping in (1e-12, 0.1, 30.0):
        expected = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), -gradient)
        np.testing.assert_allclose(_damped_step(normal, damping), expected, rtol=1e-9)
    # A parameter without effect stays.
    matrix[1], matrix[:, 1], gradient[1] = 0.0, 0.0, 0.0
    step = _damped_step(NormalEquations(matrix, gradient, np.empty((2, 0, 0))), 0.1)
    assert step[1] == 0.0
    assert np.isfinite(step).all()


def test_the_number_of_steps_is_limited(rng: np.random.Generator) -> None:
    ideal = plane_grid(rng, 30.0, rows=6, columns=8)
    packed = pack(grid_lines(radial_lens(40.0).distort(ideal) + rng.normal(0.0, 0.1, ideal.shape)))
    start = Parameters(np.zeros(2), np.array([0.3, 0.2]), None)
    costs = []
    for most in (1, 2, 60):
        found = minimise(packed, start, limits=MinimisationLimits(max_iterations=most))
        assert found.iterations == most or most == 60
        assert found.converged == (most == 60)
        costs.append(found.evaluation.cost)
    assert 2 < found.iterations < 12
    assert costs[0] > costs[1] > costs[2]
    fixed = minimise(packed, start, keep_centre=True)
    np.testing.assert_array_equal(fixed.parameters.centre, [0.3, 0.2])
    assert costs[2] < fixed.evaluation.cost < evaluate(packed, start).cost


def test_gain_and_distances_are_those_of_the_linear_model(rng: np.random.Generator) -> None:
    ideal = plane_grid(rng, 20.0)
    packed = pack(grid_lines(radial_lens(0.5).distort(ideal) + rng.normal(0.0, 0.05, ideal.shape)))
    start = linear_start(packed)
    before = evaluate(packed, Parameters(np.empty(0), np.zeros(2), None)).cost
    left = start.distances(packed, np.ones(len(packed.x)))
    assert np.sum(left**2) == pytest.approx(before - start.gain, rel=1e-9)
    assert np.sum(left**2) == pytest.approx(evaluate(packed, start.parameters).cost, rel=1e-2)


@pytest.mark.parametrize(("rows", "rank"), [([5], 1), ([5, 5], 1), ([2, 9], 2), ([0, 4, 8, 12], 2)])
def test_rank_of_parallel_lines(rows: list[int], rank: int) -> None:
    """A single line determines one curvature; parallel lines do not determine the centre along them."""
    along = np.linspace(0.0, 600.0, 15)
    rng = np.random.default_rng(1)
    lines = [np.column_stack([along, 40.0 * row + rng.normal(0.0, 0.01, 15)]) for row in rows]
    assert linear_start(pack([lines])).rank == rank


def test_a_wide_valley_leads_to_the_minimum(rng: np.random.Generator) -> None:
    """From coefficients of any size up to the fold, and centres in the middle half of the image."""
    lens = radial_lens(20.0)
    ideal = plane_grid(rng, 30.0)
    packed = pack(grid_lines(lens.distort(ideal) + rng.normal(0.0, 0.1, ideal.shape)))
    parameters = linear_start(packed).parameters
    best = minimise(packed, parameters._replace(k=np.append(parameters.k, 0.0)))
    assert best.iterations < 8
    for _ in range(30):
        centre = rng.uniform(-0.25, 0.25, 2)
        k = rng.uniform(-0.2, 0.2, 2)
        while not is_monotonic(k, farthest_corner_square(packed, centre), least=1e-3):
            k *= 0.5
        found = minimise(packed, Parameters(k, centre, None))
        # Both stop within some hundredths of a standard deviation.
        assert found.evaluation.cost == pytest.approx(best.evaluation.cost, rel=1e-5)
        assert found.at_bound == ""


def test_vanishing_points_of_straight_lines(rng: np.random.Generator) -> None:
    """Finite, infinite, and of a family that has no line."""
    ideal = plane_grid(rng, 40.0)
    flat = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1) * 90.0 + 100.0
    packed = pack([grid_lines(ideal)[0], [], grid_lines(flat)[1]])
    evaluation = evaluate(packed, Parameters(np.empty(0), np.zeros(2), None))
    points = vanishing_start(packed, evaluation.lines)
    lines = np.stack(evaluation.lines, axis=-1)
    for family in (0, 2):
        np.testing.assert_allclose(lines[packed.family == family] @ points[family], 0.0, atol=1e-7)
    np.testing.assert_allclose(np.abs(points[2]), [0.0, 1.0, 0.0], atol=1e-7)


def test_a_lens_that_would_fold_stays_just_inside(rng: np.random.Generator) -> None:
    """A model with one coefficient instead of two would fold inside the points."""
    lens = Lens(k1=-9e-7, k2=4e-13, centre=(512.0, 512.0))
    packed = pack(grid_lines(lens.distort(512.0 + (plane_grid(rng, 0.0) - 512.0) * 0.8)))
    found = minimise(packed, linear_start(packed).parameters)
    square = np.max((packed.x - found.parameters.centre[0]) ** 2 + (packed.y - found.parameters.centre[1]) ** 2)
    assert is_monotonic(found.parameters.k, square)
