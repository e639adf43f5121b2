"""Covariance of fitted triangulations and of their points, against derivatives by differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.ranging import homography
from gpuvision.ranging.homography_fit import fit_models
from gpuvision.ranging.triangulation import Triangulation

# Neither square nor about 0.
REGION = ((-2.2e-3, 3.1e-3), (-1.7e-3, 2.9e-3))
SHEET = np.stack(np.meshgrid(np.linspace(-0.02, 0.018, 7), np.linspace(-0.012, 0.01, 5)), -1).reshape(-1, 2)
SIGMA = (2e-6, 5e-6)
CONSTANTS: dict[str, tuple[float, ...]] = {
    "C4": (2.0, -1e-4, 0.3, 1.9),
    "D6": (2.0, -1e-4, 0.3, 1.9, 0.1, -2e-4),
    "H8": (0.2, 6.0, -1e-3, 5.0, 0.1, 2e-4, 0.7, -1.5),
}


def derivative(function: Callable[[np.ndarray], np.ndarray], at: Any, step: float = 1e-6) -> np.ndarray:
    """Return the derivatives (values, numbers) of a function by central differences, relative to each number."""
    at = np.array(at, float)
    columns = []
    for k in range(len(at)):
        move = np.zeros(len(at))
        move[k] = step * max(abs(at[k]), 1e-3)
        columns.append((function(at + move) - function(at - move)).ravel() / (2.0 * move[k]))
    return np.stack(columns, axis=1)


def made(constants: np.ndarray) -> Triangulation:
    return Triangulation.from_constants(tuple(constants), region=REGION)


@pytest.mark.parametrize(
    ("model", "is_known"), [(model, is_known) for model in CONSTANTS for is_known in (True, False)]
)
def test_covariance_of_the_parameters_is_that_of_least_squares(model: Any, is_known: bool) -> None:
    """(J' W J)^-1 of the constants of the model, turned into the displacement parameters over the region."""
    constants = CONSTANTS[model]
    seen = made(np.array(constants)).to_sensor(SHEET)
    rng = np.random.default_rng(3)
    noisy = seen + (0.0 if is_known else 1.0) * rng.normal(0.0, 3e-6, seen.shape)
    fitted = Triangulation.fit(noisy, SHEET, sigma=SIGMA if is_known else None, model=model, region=REGION)
    assert fitted.covariance is not None
    by_constants = derivative(lambda c: made(c).to_sensor(SHEET), constants)
    scale = np.tile(SIGMA if is_known else (1.0, 1.0), len(SHEET))[:, None]
    inverse = np.linalg.inv((by_constants / scale).T @ (by_constants / scale))
    if not is_known:
        rest = (fitted.to_sensor(SHEET) - noisy).ravel()
        inverse *= rest @ rest / (rest.size - len(constants))
    to_parameters = derivative(lambda c: made(c).conditioned(), constants)
    expected = to_parameters @ inverse @ to_parameters.T
    spread = np.sqrt(np.diag(expected))
    # Parameters that the model fixes have no spread. Without a known sigma the fit is beside the constants.
    scale = np.maximum(spread, 1e-9 * spread.max())
    difference = (np.array(fitted.covariance) - expected) / np.outer(scale, scale)
    assert np.abs(difference).max() < (1e-5 if is_known else 0.02)


def test_covariance_of_a_single_beam_is_by_u_alone() -> None:
    """The three constants of H over u; v has no residual, whatever its sigma is."""
    constants, heights = (2.0, 1e-3, 40.0), np.linspace(-0.004, 0.006, 11)
    sheet = np.stack([np.full(11, 0.003), heights], axis=1)

    def seen(values: np.ndarray) -> np.ndarray:
        return np.asarray(made(values).to_sensor(sheet)[:, 0])

    measured = np.stack([seen(np.array(constants)), np.full(11, 4e-4)], axis=1)
    fitted = Triangulation.fit(measured, sheet, sigma=SIGMA, model="C3", region=REGION)
    by_constants = derivative(seen, constants) / SIGMA[0]
    to_parameters = derivative(lambda c: made(c).conditioned(), constants)
    expected = to_parameters @ np.linalg.inv(by_constants.T @ by_constants) @ to_parameters.T
    np.testing.assert_allclose(np.array(fitted.covariance)[3:5, 3:5], expected[3:5, 3:5], rtol=1e-5)
    np.testing.assert_allclose(np.array(fitted.covariance)[6, 6], expected[6, 6], rtol=1e-5)
    (fit,) = fit_models(measured + [[2e-6, 0.0]] * np.array([[1.0], [-1.0]] * 5 + [[0.0]]), sheet, sigma=SIGMA)
    assert fit.model == "C3"
    assert fit.degrees_of_freedom == 8
    assert 0.8 < fit.rms < 1.0  # ten of eleven readings are off by one sigma of u


def on_sheet(operation: Triangulation, point: np.ndarray) -> np.ndarray:
    """Return (G, H) of a measured point, on the host."""
    straight = point if operation.distortion is None else operation.distortion.undistort(point)
    return homography.project(np.array(operation.homography), straight)


def from_parameters(values: np.ndarray, like: Triangulation) -> Triangulation:
    """Return a triangulation with other displacement parameters."""
    g0, gx, gy, h0, hx, hy, dx, dy = values
    matrix = np.array([[gx + g0 * dx, gy + g0 * dy, g0], [hx + h0 * dx, hy + h0 * dy, h0], [dx, dy, 1.0]])
    (u_min, u_max), (v_min, v_max) = REGION
    half = 0.5 * max(u_max - u_min, v_max - v_min)
    shift = np.array([[half, 0.0, 0.5 * (u_min + u_max)], [0.0, half, 0.5 * (v_min + v_max)], [0.0, 0.0, 1.0]])
    return replace(like, homography=tuple(map(tuple, (matrix @ np.linalg.inv(shift)).tolist())))


@pytest.mark.parametrize("lens", [None, Lens(k1=2e3, centre=(1e-3, -5e-4))])
def test_covariance_of_a_point_has_both_parts(lens: Lens | None, rng: np.random.Generator) -> None:
    """The noise of the readout through the derivatives by u and v, and the covariance of the parameters by theirs."""
    root = 1e-5 * rng.normal(size=(8, 8))
    operation = replace(
        Triangulation.from_stand_off(baseline=0.1, stand_off=0.2, focal_distance=0.016, region=REGION, lens=lens),
        covariance=tuple(map(tuple, (root @ root.T).tolist())),
        sigma=SIGMA,
        model="H8",
    )
    parameters = operation.conditioned()
    for point in ((0.8e-3, -1.1e-3), (-1.9e-3, 2.3e-3)):
        by_point = derivative(lambda p: on_sheet(operation, p), point, 1e-5)
        noise = by_point @ np.diag(np.square(SIGMA)) @ by_point.T
        by_parameters = derivative(lambda t, p=point: on_sheet(from_parameters(t, operation), np.array(p)), parameters)
        np.testing.assert_allclose(operation.parameter_derivatives(point), by_parameters, rtol=1e-6, atol=1e-9)
        calibration = by_parameters @ root @ root.T @ by_parameters.T
        np.testing.assert_allclose(operation.covariance_at(point), noise + calibration, rtol=1e-6)
        np.testing.assert_allclose(replace(operation, sigma=None).covariance_at(point), calibration, rtol=1e-6)
        np.testing.assert_allclose(replace(operation, covariance=None).covariance_at(point), noise, rtol=1e-6)
    many = operation.covariance_at([[(0.8e-3, -1.1e-3)], [(-1.9e-3, 2.3e-3)]])
    assert many.shape == (2, 1, 2, 2)
    np.testing.assert_allclose(many[1, 0], operation.covariance_at((-1.9e-3, 2.3e-3)), rtol=1e-12)


def test_beyond_the_horizon_there_is_no_covariance() -> None:
    """The denominator falls from 1 in the middle of the region to the horizon, where points have no covariance."""
    operation = Triangulation.from_constants(
        (2.0, 0.0, 1e-3, 1.9), region=((-0.5e-3, 2.5e-3), (-1e-3, 1e-3)), sigma=SIGMA
    )
    # u + c3 over its value in the middle, u = 1 mm: 0.2 at u = -0.6 mm.
    for horizon, known in ((0.19, True), (0.21, False)):
        limited = replace(operation, horizon=horizon)
        assert np.isfinite(limited.covariance_at((-0.6e-3, 0.0))).all() == known
        assert np.isfinite(limited.parameter_derivatives((-0.6e-3, 0.0))).all() == known


def test_a_factor_of_a_block_gives_its_covariance(rng: np.random.Generator) -> None:
    """Lower triangle, column by column, of any rows; also of a singular covariance."""
    root = rng.normal(size=(8, 3))
    covariance = root @ root.T
    for which in ((0, 1, 2, 6, 7), (3, 4, 5, 6, 7), (2, 0)):
        packed = homography.packed_covariance_factor(covariance, which)
        size = len(which)
        assert packed.shape == (size * (size + 1) // 2,)
        factor, at = np.zeros((size, size)), 0
        for column in range(size):
            factor[column:, column] = packed[at : at + size - column]
            at += size - column
        np.testing.assert_allclose(factor @ factor.T, covariance[np.ix_(which, which)], rtol=0, atol=1e-12)


def test_displacement_parameters_and_their_changes(rng: np.random.Generator) -> None:
    matrix = np.array([[3.0, 0.4, 0.2], [-0.3, 2.0, 0.5], [0.3, -0.2, 2.0]])
    g0, gx, gy, h0, hx, hy, dx, dy = homography.to_displacement(matrix)
    for x, y in ((0.0, 0.0), (0.7, -0.4), (-1.0, 1.0)):
        w = 1.0 + dx * x + dy * y
        expected = homography.project(matrix, np.array([x, y]))
        np.testing.assert_allclose([g0 + (gx * x + gy * y) / w, h0 + (hx * x + hy * y) / w], expected, rtol=1e-12)
    changes = rng.normal(size=(4, 3, 3))
    found = homography.displacement_jacobian(matrix, changes)
    for change, row in zip(changes, found, strict=True):
        ahead, behind = (homography.to_displacement(matrix + step * change) for step in (1e-6, -1e-6))
        np.testing.assert_allclose(row, (ahead - behind) / 2e-6, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("factor", "is_refused"), [(0.9, True), (1.1, False)])
def test_matrices_at_the_limit_of_their_rank(factor: float, is_refused: bool) -> None:
    """A denominator in the middle, or a second gradient, of 1e-10 of the largest one counts as 0."""
    small = factor * 1e-10
    horizon = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 1.0, small]])
    edge_on = np.array([[1.0, 0.0, 0.0], [0.0, small, 0.0], [0.0, 0.0, 1.0]])
    for matrix, message in ((horizon, "middle of the region lies on the horizon"), (edge_on, "edge-on")):
        if is_refused:
            with pytest.raises(ValueError, match=message):
                homography.to_displacement(matrix)
        elif message == "edge-on":
            homography.to_displacement(matrix)
    one_beam = np.array([[0.0, 0.0, 0.3], [1.0, 0.0, 0.0], [0.1, 0.0, 1.0]])
    np.testing.assert_allclose(homography.to_displacement(one_beam, rank=2), [0.3, -0.03, 0, 0, 1, 0, 0.1, 0])
    with pytest.raises(ValueError, match="edge-on"):
        homography.to_displacement(one_beam)


def test_extent_and_box_of_a_region() -> None:
    centre, half = homography.centre_and_half_extent(((1.0, 4.0), (-3.0, 7.0)))
    np.testing.assert_array_equal(centre, [2.5, 2.0])
    np.testing.assert_array_equal(half, [5.0, 5.0])
    points = np.array([[1.0, 5.0], [-2.0, 6.0], [0.0, 4.5]])
    assert homography.bounding_box(points) == ((-2.0, 1.0), (4.5, 6.0))
    assert math.isclose(np.linalg.det(homography.shift_and_scale((1.0, 2.0), (3.0, 4.0))), 12.0)
