"""Closed-form start, and convergence to the minimum from that start or from any other."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.line_families import grid_lines, pack
from gpuvision.camera.lines.straightness import Parameters, evaluate, is_monotonic
from gpuvision.camera.lines.variable_projection import farthest_corner_square, linear_start, minimise, vanishing_start
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
