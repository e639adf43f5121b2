"""Copper that the check of a located board draws around the image."""

from __future__ import annotations

import types
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import correlate

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.board.copper_support import (
    _TILE_PX,
    _best_other_shift,
    _draw_copper,
    _residuals_of_tiles,
    _sum_tiles,
    find_other_pose,
)


def test_copper_beyond_the_image_is_in_the_margin() -> None:
    """An image with a margin shows the copper of a larger image; one pad lies in each of the four margins."""
    view = BoardView(scale=1e-4, shape=(20, 30), pose=(0.0, 0.0, 0.0))
    margin = 8
    corners = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]) * view.scale
    middles = np.array([[-19.0, 0.0], [19.0, 1.0], [2.0, 14.0], [-3.0, -14.0]]) * view.scale
    artwork: Any = types.SimpleNamespace(copper=tuple(Shape(corners + middle) for middle in middles))
    share = _draw_copper(artwork, view, margin, blur_px=0.5)
    larger = _draw_copper(artwork, replace(view, shape=(20 + 2 * margin, 30 + 2 * margin)), 0, blur_px=0.5)
    np.testing.assert_allclose(share, larger, atol=1e-6)
    rows, columns = np.mgrid[:36, :46] - np.array([17.5, 22.5])[:, None, None]
    for x, y in middles / view.scale:
        inside = (np.abs(columns - x) < 1.0) & (np.abs(rows + y) < 1.0)
        assert (share[inside] > 0.95).all()


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 2), (1, 3)])
def test_sums_of_tiles_of_any_image(shape: tuple[int, int]) -> None:
    """Whole tiles and parts of tiles at the right and at the bottom, of numbers whose sums are exact."""
    rows, columns = (each * _TILE_PX - 3 for each in shape)
    values = np.random.default_rng(4).integers(0, 9, (rows, columns)).astype(np.float32)
    expected = [
        [values[i : i + _TILE_PX, j : j + _TILE_PX].sum() for j in range(0, columns, _TILE_PX)]
        for i in range(0, rows, _TILE_PX)
    ]
    np.testing.assert_array_equal(_sum_tiles(values), expected)
    assert _sum_tiles(values).shape == shape


def correlation_of(**peaks: float) -> np.ndarray:
    """Return correlations of shifts of up to 6 px, by names such as r0_c3 (row 0, column 3; m is a minus)."""
    found = np.zeros((13, 13), np.float32)
    for name, value in peaks.items():
        row, column = (int(each[1:].replace("m", "-")) for each in name.split("_"))
        found[row + 6, column + 6] = value
    return found


@pytest.mark.parametrize(
    ("peaks", "shift"),
    [
        ({"r0_c0": 0.8, "r0_c3": 0.57}, (0, 3)),
        ({"r0_c0": 0.8, "r0_c3": 0.55}, None),  # less than 0.7 of the correlation of the found pose
        ({"r0_c0": 0.8, "r1_c2": 0.75}, None),  # nearer than 2.5 px
        ({"r0_c0": 0.8, "r2_c2": 0.75}, (2, 2)),
        ({"r0_c0": 0.8, "rm4_c5": 0.6, "r3_cm2": 0.7}, (3, -2)),
        ({"r0_c0": 0.8, "rm4_c5": 0.6, "r3_cm2": -0.7}, (3, -2)),  # copper of the other polarity
        ({"r0_c0": 0.8, "r0_c2": 0.79, "r0_c3": 0.78}, None),  # no maximum of its surroundings
        ({"r0_c0": -0.8, "r0_c5": 0.01}, (0, 5)),
    ],
)
def test_other_shift_is_the_largest_peak_away_from_the_centre(peaks: dict[str, float], shift: Any) -> None:
    assert _best_other_shift(correlation_of(**peaks), 6) == shift


@pytest.mark.parametrize("is_bright", [True, False])
def test_residuals_of_tiles_are_those_of_least_squares(is_bright: bool, rng: np.random.Generator) -> None:
    """An image of two strips of rows; offset, contrast, shift, rotation and etch bias are fitted by NumPy."""
    margin, shift, shape = 5, (2, -3), (290, 45)
    drawn = cv2.GaussianBlur(rng.uniform(0.0, 1.0, (300, 55)).astype(np.float32), (0, 0), 1.5)
    part = np.float64(drawn[7:297, 2:47]) * (1.0 if is_bright else -1.0)
    step, smooth = np.array([-1.0, 0.0, 1.0]), np.array([3.0, 10.0, 3.0]) / 32.0
    along = correlate(part, np.outer(smooth, step), mode="mirror")
    down = correlate(part, np.outer(step, smooth), mode="mirror")
    y, x = np.indices(shape) - np.array([145.0, 22.5])[:, None, None]
    design = np.stack([np.ones(shape), part, along, down, down * x - along * y, np.hypot(along, down)], axis=-1)
    # Each term explains much more than the noise.
    exact = design @ np.array([40.0, 30.0, 300.0, -250.0, 20.0, 200.0])
    grey = (exact + rng.normal(0.0, 1.0, shape)).astype(np.float32)
    values = (grey - grey.mean()).ravel()
    fitted = np.linalg.lstsq(design.reshape(-1, 6), values, rcond=None)[0]
    left = ((values - design.reshape(-1, 6) @ fitted) ** 2).reshape(shape)
    expected = [[left[i : i + 16, j : j + 16].sum() for j in range(0, 45, 16)] for i in range(0, 290, 16)]
    found = _residuals_of_tiles(drawn, grey, margin, shift, is_bright=is_bright)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("is_bright", [True, False])
@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_the_other_pose_of_a_repeated_pattern_is_a_pitch_away(
    is_bright: bool, heading: float, rng: np.random.Generator
) -> None:
    """Six pads in a row, 12 px apart, along the rows of the image: the end of the row tells the poses apart."""
    view = BoardView(scale=1e-4, shape=(40, 120), pose=(3e-3, -1e-3, heading))
    corners = np.array([[-3.0, -4.0], [3.0, -4.0], [3.0, 4.0], [-3.0, 4.0]])
    pads = tuple(Shape(view.to_plane(view.centre_px + corners + [12.0 * k - 20.0, 3.0])) for k in range(6))
    artwork: Any = types.SimpleNamespace(copper=pads)
    share = _draw_copper(artwork, view, 0, blur_px=1.2)
    image = (100.0 + (40.0 if is_bright else -40.0) * share + rng.normal(0.0, 2.0, share.shape)).astype(np.float32)
    found = find_other_pose(image, artwork, view, 1.5e-3, 1.2, is_bright=is_bright)
    assert found is not None
    assert found.distance == pytest.approx(12e-4)
    assert found.is_bright == is_bright
    # The poses differ in the two tiles at the ends of the row.
    assert 1.0 < found.preference < 3.0
    away = view.to_pixels(np.array(found.view.pose[:2])) - view.centre_px
    np.testing.assert_allclose(np.abs(away), [12.0, 0.0], atol=1e-6)
    assert (found.view.pose[2], found.view.scale) == (heading, 1e-4)
    # From the other pose, the right one fits better: a pitch back.
    back = find_other_pose(image, artwork, found.view, 1.5e-3, 1.2, is_bright=is_bright)
    assert back is not None
    assert back.preference < -1.0
    np.testing.assert_allclose(back.view.pose, view.pose, atol=1e-9)
    # One row of pads without another one within reach.
    assert find_other_pose(image, artwork, view, 5e-4, 1.2, is_bright=is_bright) is None
