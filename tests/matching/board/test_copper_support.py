"""Copper that the check of a located board draws around the image."""

from __future__ import annotations

import types
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.board.copper_support import _TILE_PX, _draw_copper, _sum_tiles


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
