"""View of a board whose artwork is moved, against complex numbers."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board.edge_measurement import move_view

LENGTHS = st.floats(-0.2, 0.2)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.tuples(LENGTHS, LENGTHS, ANGLES)


@given(place=POSES, moved=POSES)
def test_a_moved_board_is_seen_by_the_moved_view(place, moved) -> None:
    """The camera at q = R p + t sees the artwork point p; its angle on the artwork is less by the rotation."""
    seen = move_view(BoardView(scale=20e-6, shape=(400, 600), pose=place), moved)
    point = complex(*seen.pose[:2]) * cmath.exp(1j * moved[2]) + complex(*moved[:2])
    assert point == pytest.approx(complex(*place[:2]), abs=1e-12)
    assert cmath.exp(1j * seen.pose[2]) == pytest.approx(cmath.exp(1j * (place[2] - moved[2])), abs=1e-12)
    assert abs(seen.pose[2]) <= math.pi


def test_pixels_of_a_moved_board_are_those_of_the_board() -> None:
    view = BoardView(scale=20e-6, shape=(400, 600), pose=(0.05, -0.02, 2.9), mirrored=True)
    x, y, theta = 0.01, 0.03, -1.7
    points = np.array([[0.04, 0.01], [-0.02, 0.03], [0.0, 0.0]])
    on_board = np.exp(1j * theta) * (points @ [1.0, 1j]) + complex(x, y)
    pixels = move_view(view, (x, y, theta)).to_pixels(points)
    np.testing.assert_allclose(pixels, view.to_pixels(np.stack([on_board.real, on_board.imag], -1)), atol=1e-6)
