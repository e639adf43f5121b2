"""Centres of gravity of dots: steps of a grid, sums of weights and backgrounds by loops, images of discs."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from gpuvision.camera.patterns.centroids import (
    _fit_background,
    _moments,
    disc_centre_offset,
    estimate_steps,
    measure_dots,
    sample_bilinear,
)


def mean_step(values: np.ndarray, row: int, column: int, along: tuple[int, int]) -> np.ndarray:
    """Return the mean of the differences to the next and to the previous node; NaN without both."""
    steps = []
    for side in (0, -1):
        ends = [(row + k * along[0], column + k * along[1]) for k in (side, side + 1)]
        if all(0 <= i < values.shape[0] and 0 <= j < values.shape[1] for i, j in ends):
            steps.append(values[ends[1]] - values[ends[0]])
    known = [each for each in steps if np.isfinite(each).all()]
    return np.mean(known, axis=0) if known else np.full(values.shape[2], np.nan)


def filled(steps: np.ndarray) -> np.ndarray:
    """Replace unknown steps by the mean of the known ones in boxes of 3, 7, 15 nodes."""
    steps, reach = steps.copy(), 1
    while np.isnan(steps).any():
        reach = 2 * reach + 1
        before, half = steps.copy(), reach // 2
        for i, j in np.argwhere(np.isnan(before).any(axis=-1)):
            box = before[max(i - half, 0) : i + half + 1, max(j - half, 0) : j + half + 1].reshape(-1, before.shape[2])
            known = box[np.isfinite(box).all(axis=1)]
            if len(known):
                steps[i, j] = known.mean(axis=0)
    return steps


def test_steps_of_a_grid_with_holes(rng: np.random.Generator) -> None:
    points = np.stack(np.meshgrid(11.0 * np.arange(12.0), 7.0 * np.arange(9.0)), axis=-1)
    points += rng.normal(0.0, 1.0, points.shape)
    points[2:8, 4:11] = np.nan
    points[5, 7] = 1.0  # far from any known step
    points[0, ::2] = np.nan
    expected = [
        filled(np.array([[mean_step(points, i, j, along) for j in range(12)] for i in range(9)]))
        for along in ((0, 1), (1, 0))
    ]
    np.testing.assert_allclose(estimate_steps(points), np.stack(expected, axis=2), rtol=1e-9)
    assert np.isnan(estimate_steps(np.full((3, 4, 2), np.nan))).all()


def test_sums_of_weights_are_those_of_loops(rng: np.random.Generator) -> None:
    """Windows that differ in width and height, also beyond the border; background and contrast have slopes."""
    grey = rng.uniform(0.0, 100.0, (40, 50)).astype(np.float32)
    at = np.array([[20.3, 15.6], [3.4, 37.2], [47.8, 1.1]])
    half = np.array([[4.5, 3.2], [5.0, 6.0], [3.0, 2.5]])
    background = np.array([[20.0, 0.5, -0.3], [30.0, 0.1, 0.2], [10.0, -0.4, 0.6]])
    contrast = np.array([[60.0, -0.4, 0.2], [50.0, 0.3, 0.1], [-40.0, 0.2, -0.5]])
    expected = np.zeros((3, 5))
    for n, ((column, row), (wide, high)) in enumerate(zip(at, half, strict=True)):
        for y in range(40):
            for x in range(50):
                dx, dy = x - column, y - row
                if abs(dx) <= wide and abs(dy) <= high:
                    level, step = (each[n] @ (1.0, dx, dy) for each in (background, contrast))
                    weight = max((grey[y, x] - level) / step - 0.2, 0.0) / 0.8
                    u, v = x - round(column), y - round(row)
                    expected[n] += weight * np.array([1.0, u, v, u * u, v * v])
    found = _moments(grey, at, half, [background, contrast], 7)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


def test_background_of_a_cell() -> None:
    """A plane is exact on oblique cells; a saddle is the residual; a corner beyond the image leaves the other three."""
    y, x = np.mgrid[:60, :80].astype(np.float32)
    at = np.array([[40.0, 30.0], [2.0, 3.0]])
    steps = np.array([[[9.0, 2.0], [-1.0, 8.0]], [[8.0, 0.0], [0.0, 8.0]]])
    level, slope, residual = _fit_background(5.0 + 0.25 * x - 0.5 * y, at, steps)
    np.testing.assert_allclose(level[0], 5.0 + 10.0 - 15.0, atol=1e-5)
    np.testing.assert_allclose(slope[0], [0.25, -0.5], atol=1e-5)
    np.testing.assert_allclose(residual, 0.0, atol=1e-5)
    # At (-2, -1) and (-2, 7) there is no image.
    np.testing.assert_allclose(level[1], np.mean([5.0 + 0.25 * 6 + 0.5, 5.0 + 0.25 * 6 - 3.5][1:]), atol=1e-5)
    square = np.array([[[8.0, 0.0], [0.0, 6.0]]])
    level, slope, residual = _fit_background((x - 40.0) * (y - 30.0), at[:1], square)
    np.testing.assert_allclose([level[0], *slope[0]], 0.0, atol=1e-5)
    np.testing.assert_allclose(residual, 12.0 + 12.0, atol=1e-4)


def test_samples_between_pixels_and_beyond_the_image() -> None:
    y, x = np.mgrid[:6, :9].astype(np.float32)
    at = np.array([[[2.25, 3.5], [8.0, 5.0]], [[8.01, 1.0], [3.0, -0.01]]])
    np.testing.assert_allclose(sample_bilinear(10.0 * y + x, at), [[37.25, 58.0], [np.nan, np.nan]], rtol=1e-6)


def test_dots_of_a_grid() -> None:
    """Boxes whose centres lie on pixels or between them, on a slope; a missing node stays missing."""
    y, x = np.mgrid[:90, :120].astype(float)
    centre = np.stack(np.meshgrid(20.5 + 26.0 * np.arange(4), 22.0 + 23.0 * np.arange(3)), axis=-1)
    grey = 50.0 + 0.2 * x - 0.1 * y
    for column, row in centre.reshape(-1, 2):
        parts = [np.clip(half + 0.5 - np.abs(z - m), 0.0, 1.0) for z, m, half in ((x, column, 5.0), (y, row, 3.5))]
        grey += 120.0 * parts[0] * parts[1]
    places = np.floor(centre)
    places[1, 2] = np.nan
    size = np.broadcast_to([10.0, 7.0], (3, 4, 2))
    found = measure_dots(grey.astype(np.float32), places, size)
    assert np.isnan(found.points[1, 2]).all()
    known = np.isfinite(found.contrast)
    assert np.count_nonzero(known) == 11
    np.testing.assert_allclose(found.points[known], centre[known], atol=1e-3)
    np.testing.assert_allclose(found.contrast[known], 120.0, rtol=0.01)
    # Pixels that are covered by less than 0.2 count as background: edges lose at most that.
    np.testing.assert_allclose(found.dot_area[known], 70.0, rtol=0.08)
    np.testing.assert_allclose(found.variance[known], [[100.0 / 12.0, 49.0 / 12.0]] * 11, rtol=0.08)
    np.testing.assert_allclose(found.background_residual[known], 0.0, atol=1e-3)


def test_contrast_of_bars() -> None:
    """The contrast is averaged over half the shorter side of a dot, here of 4 px."""
    y, x = np.mgrid[:100, :300].astype(float)
    centre = np.stack(np.meshgrid(50.0 + 80.0 * np.arange(3), 20.0 + 20.0 * np.arange(4)), axis=-1)
    grey = np.full(x.shape, 30.0)
    for column, row in centre.reshape(-1, 2):
        grey += 90.0 * np.clip(30.5 - abs(x - column), 0.0, 1.0) * np.clip(2.5 - abs(y - row), 0.0, 1.0)
    found = measure_dots(grey.astype(np.float32), centre, np.broadcast_to([60.0, 4.0], centre.shape))
    np.testing.assert_allclose(found.contrast, 90.0, rtol=1e-4)
    np.testing.assert_allclose(found.points, centre, atol=1e-3)


def test_centre_of_gravity_of_a_disc_under_curvature() -> None:
    """Against an integral over the disc: points of the plane with their area in the image as weight."""
    radius = 0.3
    terms = np.array([[0.0, 0.0], [30.0, 2.0], [-3.0, 25.0], [0.6, -0.3], [0.4, 0.5], [-0.2, 0.7]])

    def image(u: Any, v: Any) -> np.ndarray:
        return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1) @ terms

    def slopes(u: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
        zero, one = np.zeros_like(u), np.ones_like(u)
        return (
            np.stack([zero, one, zero, 2.0 * u, v, zero], axis=-1) @ terms,
            np.stack([zero, zero, one, zero, u, 2.0 * v], axis=-1) @ terms,
        )

    centre = np.array([0.7, -0.4])
    ring, angle = np.meshgrid((np.arange(200) + 0.5) / 200.0, 2.0 * math.pi * np.arange(64) / 64)
    u, v = centre[0] + radius * ring * np.cos(angle), centre[1] + radius * ring * np.sin(angle)
    along, down = slopes(u, v)
    weight = ring * (along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    gravity = np.sum(weight[..., None] * image(u, v), axis=(0, 1)) / weight.sum()
    first, second = slopes(*centre)
    derivative = {(1, 0): first, (0, 1): second, (2, 0): 2.0 * terms[3], (1, 1): terms[4], (0, 2): 2.0 * terms[5]}
    model: Any = SimpleNamespace(derivative=lambda *orders: derivative[orders][None, None])
    area = math.pi * radius**2 * abs(first[0] * second[1] - first[1] * second[0])
    found = disc_centre_offset(model, np.array([[area]]))[0, 0]
    np.testing.assert_allclose(found, gravity - image(*centre), rtol=2e-3)
