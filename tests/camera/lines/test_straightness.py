"""Distances from straight lines: derivatives, eliminated line parameters, pencils at infinity."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from gpuvision.camera.lines import normal_equations, straightness
from gpuvision.camera.lines.line_families import PackedLines, grid_lines, pack
from gpuvision.camera.lines.straightness import LineSet, Parameters
from gpuvision.camera.lines.variable_projection import apply_step, farthest_corner_square
from straight_lines import plane_grid, radial_lens

STEP = 1e-6
# Central differences of functions of about 1: the error is about STEP^2 plus rounding / STEP.
CLOSE = 1e-8


@pytest.fixture
def packed(rng: np.random.Generator) -> PackedLines:
    """Lines bent by 20 pixels, with errors of the same size, so that every term is large enough for the test."""
    points = radial_lens(20.0).distort(plane_grid(rng, 30.0, rows=7, columns=9))
    return pack(grid_lines(points + rng.normal(0.0, 15.0, points.shape), diagonals=True))


@pytest.fixture
def anywhere(rng: np.random.Generator) -> Parameters:
    """An arbitrary lens and arbitrary vanishing points (not a minimum); one point is at infinity."""
    points = rng.normal(size=(4, 3)) * [1.0, 1.0, 0.4]
    points[2, 2] = 0.0
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Parameters(np.array([0.1, -0.05]), np.array([0.1, -0.2]), points)


def distances(packed: PackedLines, k: np.ndarray, centre: np.ndarray, lines: LineSet) -> np.ndarray:
    """Compute (n.u + rho)/|J'n| with J by the chain rule."""
    d = np.stack([packed.x, packed.y], axis=-1) - centre
    s = np.sum(d**2, axis=-1)
    scale, slope = 1.0 + s * (k[0] + k[1] * s), k[0] + 2.0 * k[1] * s
    jacobian = scale[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * d[:, :, None] * d[:, None, :]
    normal = np.stack([lines.nx, lines.ny], axis=-1)[packed.line]
    value = np.sum(normal * (centre + d * scale[:, None]), axis=-1) + lines.offset[packed.line]
    return value / np.linalg.norm(np.einsum("nij,ni->nj", jacobian, normal), axis=-1)


@pytest.mark.parametrize("free", [False, True])
def test_slopes_are_those_of_the_distances(packed: PackedLines, anywhere: Parameters, free: bool) -> None:
    parameters = anywhere._replace(vanishing=None) if free else anywhere
    evaluation = straightness.evaluate(packed, parameters)
    slopes = normal_equations.residual_jacobian(2, evaluation)
    np.testing.assert_allclose(
        evaluation.residual, distances(packed, parameters.k, parameters.centre, evaluation.lines), atol=1e-14
    )
    turn = np.arctan2(evaluation.lines.ny, evaluation.lines.nx)

    def moved(change: np.ndarray) -> np.ndarray:
        lines = LineSet(np.cos(turn + change[5]), np.sin(turn + change[5]), evaluation.lines.offset + change[4])
        return distances(packed, parameters.k + change[:2], parameters.centre + change[2:4], lines)

    for number, column in enumerate([*slopes.lens[:4], *slopes.line]):
        change = STEP * np.eye(6)[number]
        np.testing.assert_allclose(column, (moved(change) - moved(-change)) / (2.0 * STEP), atol=CLOSE)


def test_slopes_of_a_lens_of_four_coefficients(packed: PackedLines) -> None:
    """Derivatives by k1 to k4 and by the centre, against differences of distances computed by the chain rule."""
    k, centre = np.array([0.1, -0.05, 0.03, 0.02]), np.array([0.1, -0.2])

    def residual(change: np.ndarray, lines: LineSet) -> np.ndarray:
        d = np.stack([packed.x, packed.y], axis=-1) - (centre + change[4:])
        s = np.sum(d**2, axis=-1)
        terms = [each * s**power for power, each in enumerate(k + change[:4], 1)]
        scale, slope = 1.0 + sum(terms), sum(power * term / s for power, term in enumerate(terms, 1))
        jacobian = scale[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * d[:, :, None] * d[:, None, :]
        normal = np.stack([lines.nx, lines.ny], axis=-1)[packed.line]
        value = np.sum(normal * (centre + change[4:] + d * scale[:, None]), axis=-1) + lines.offset[packed.line]
        return value / np.linalg.norm(np.einsum("nij,ni->nj", jacobian, normal), axis=-1)

    evaluation = straightness.evaluate(packed, Parameters(k, centre, None))
    np.testing.assert_allclose(evaluation.residual, residual(np.zeros(6), evaluation.lines), atol=1e-14)
    slopes = normal_equations.residual_jacobian(4, evaluation)
    for number, column in enumerate(slopes.lens[:6]):
        change = STEP * np.eye(6)[number]
        difference = (residual(change, evaluation.lines) - residual(-change, evaluation.lines)) / (2.0 * STEP)
        np.testing.assert_allclose(column, difference, atol=CLOSE)


def test_lines_move_with_their_points(packed: PackedLines, anywhere: Parameters) -> None:
    """The derivatives of a line by its vanishing point keep the line in the pencil of the point."""
    lines = straightness.evaluate(packed, anywhere).lines
    change = normal_equations.pencil_changes(anywhere.vanishing, packed.family, lines)
    for axis in (0, 1):
        step = np.zeros(2 + 2 + 8)
        step[4 + axis :: 2] = STEP
        moved, _ = apply_step(packed, anywhere, step)
        point = moved.vanishing[packed.family]
        offset, turn = change[:, 1 + axis] * STEP
        nx, ny = lines.nx - turn * lines.ny, lines.ny + turn * lines.nx
        missed = nx * point[:, 0] + ny * point[:, 1] + (lines.offset + offset) * point[:, 2]
        np.testing.assert_allclose(missed, 0.0, atol=10.0 * STEP**2)
    on_point = np.sum(np.stack(lines, axis=-1) * anywhere.vanishing[packed.family], axis=-1)
    np.testing.assert_allclose(on_point, 0.0, atol=1e-13)


@pytest.mark.parametrize("free", [False, True])
def test_lines_are_projected_out(packed: PackedLines, anywhere: Parameters, free: bool) -> None:
    """The reduced normal equations agree with the full Jacobian that has columns for the parameters of each line."""
    parameters = anywhere._replace(vanishing=None) if free else anywhere
    evaluation = straightness.evaluate(packed, parameters)
    slopes = normal_equations.residual_jacobian(2, evaluation)
    normal = normal_equations.normal_equations(packed, parameters, evaluation, slopes)
    count_lens_parameters, line_columns = list(slopes.lens[:4]), []
    change = np.zeros((2, 3, len(packed.counts)))
    if not free:
        change = normal_equations.pencil_changes(parameters.vanishing, packed.family, evaluation.lines)
        for family in range(4):
            inside = packed.family[packed.line] == family
            for axis in (1, 2):
                count_lens_parameters.append(inside * np.sum(slopes.line * change[:, axis, packed.line], axis=0))
    for line in range(len(packed.counts)):
        inside = packed.line == line
        columns = slopes.line if free else [np.sum(slopes.line * change[:, 0, packed.line], axis=0)]
        line_columns += [inside * column for column in columns]
    basis = np.linalg.qr(np.array(line_columns).T)[0]
    expected = np.array(count_lens_parameters).T
    expected = expected - basis @ (basis.T @ expected)
    scale = np.max(np.abs(normal.matrix))
    np.testing.assert_allclose(normal.matrix, expected.T @ expected, atol=1e-13 * scale)
    np.testing.assert_allclose(normal.gradient, expected.T @ evaluation.residual, atol=1e-13 * scale)
    columns = normal_equations.projected_columns(packed, parameters, evaluation, slopes, normal.line_coefficients)
    np.testing.assert_allclose(columns, expected.T, atol=1e-12 * np.sqrt(scale))


def test_pencil_lines_are_the_best(packed: PackedLines, anywhere: Parameters) -> None:
    """No line through the vanishing point, at infinity or not, has a smaller sum of squares."""
    lines = straightness.evaluate(packed, anywhere._replace(k=np.empty(0))).lines
    change = normal_equations.pencil_changes(anywhere.vanishing, packed.family, lines)

    def cost(turn: float) -> np.ndarray:
        angle = np.arctan2(lines.ny, lines.nx) + change[1, 0] * turn
        offset = lines.offset + change[0, 0] * turn
        each = np.cos(angle)[packed.line] * packed.x + np.sin(angle)[packed.line] * packed.y + offset[packed.line]
        return packed.sums(each**2)

    # The first-order rotation leaves the pencil by 1e-8, which changes a sum of squares by less than 1e-10 of it.
    assert np.all(cost(0.0) < cost(1e-4) * (1.0 + 1e-10))
    assert np.all(cost(0.0) < cost(-1e-4) * (1.0 + 1e-10))


@pytest.mark.parametrize("weighted", [False, True])
def test_lines_of_least_squares(packed: PackedLines, rng: np.random.Generator, weighted: bool) -> None:
    """Free lines against the singular vectors of their points, pencils against SciPy's generalised eigenvectors."""
    weight = rng.uniform(0.5, 2.0, len(packed.x)) if weighted else None
    each = np.ones(len(packed.x)) if weight is None else weight
    sums = straightness.moments(packed, packed.x, packed.y, weight)
    points = rng.normal(size=(len(packed.counts), 3)) * [0.5, 2.0, 1.0]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    free = straightness.free_lines(sums)
    bound = straightness.pencil_lines(sums, straightness.pencil_basis(points))
    for line, point in enumerate(points):
        inside = packed.line == line
        places = np.stack([packed.x, packed.y, np.ones_like(packed.x)], -1)[inside]
        root = np.sqrt(each[inside])
        middle = np.average(places[:, :2], axis=0, weights=each[inside])
        normal = np.linalg.svd((places[:, :2] - middle) * root[:, None])[2][1]
        expected = np.array([*normal, -normal @ middle])
        found = np.array([part[line] for part in free])
        np.testing.assert_allclose(found * np.sign(found[:2] @ normal), expected, atol=1e-12)
        basis = scipy.linalg.null_space(point[None]).T
        design = places @ basis.T * root[:, None]
        mix = scipy.linalg.eigh(design.T @ design, basis[:, :2] @ basis[:, :2].T)[1][:, 0]
        expected = mix @ basis / np.linalg.norm((mix @ basis)[:2])
        found = np.array([part[line] for part in bound])
        np.testing.assert_allclose(found * np.sign(found[:2] @ expected[:2]), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("k", "square", "holds"),
    [
        ((-0.3,), 1.0, True),
        ((-0.3,), 1.2, False),
        ((-1.0, 1.0), 1.0, True),
        ((-1.5, 0.9), 1.0, False),
        ((), 9.0, True),
        ((-1.0, 1.0, -0.3), 1.0, True),
        ((-1.0, 1.0, -0.45), 1.0, False),
        ((-1.2, 1.2, -0.6, 0.15), 1.0, True),
        ((-1.6, 1.0, 0.0, 0.2), 1.0, False),
        ((-1.1, 0.5, 0.0, 0.0), 1.0, False),  # the slope is least within: highest coefficients of 0 do not count
        ((-0.8, 0.7, 0.0), 1.0, True),
    ],
)
def test_monotone(k: tuple[float, ...], square: float, holds: bool) -> None:
    radius = np.linspace(0.0, np.sqrt(square), 2001)
    powers = sum(each * radius ** (2 * power) for power, each in enumerate(k, 1))
    assert bool(np.all(np.diff(radius * (1.0 + powers)) > 0.0)) is holds
    assert straightness.is_monotonic(np.array(k), square) is holds


def test_reach_covers_every_point(packed: PackedLines) -> None:
    for centre in np.array([[0.0, 0.0], [0.7, -0.2], [-3.0, 1.0]]):
        corners = [[a * packed.corner[0], b * packed.corner[1]] for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
        exact = np.max(np.sum((np.array(corners) - centre) ** 2, axis=1))
        assert farthest_corner_square(packed, centre) == pytest.approx(exact, rel=1e-12)
        farthest = np.max((packed.x - centre[0]) ** 2 + (packed.y - centre[1]) ** 2)
        assert farthest <= farthest_corner_square(packed, centre) * (1.0 + 1e-12)
