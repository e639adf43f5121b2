"""Copper that the check of a located board draws around the image."""

from __future__ import annotations

import types
from dataclasses import replace
from typing import Any

import numpy as np

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.board.copper_support import _draw_copper


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
