"""View of a plane at right angles: pixels in closed form, field of view, and the margin of the measured image."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView

VIEW = BoardView(scale=2e-5, shape=(101, 201), pose=(0.03, -0.02, 0.4))


@pytest.mark.parametrize("mirrored", [False, True])
def test_pixels_of_points_of_the_plane(mirrored: bool) -> None:
    """In complex numbers: columns along theta, mirrored against it, and rows a quarter turn clockwise from theta."""
    view = BoardView(scale=2e-5, shape=(101, 201), pose=(0.03, -0.02, 0.4), mirrored=mirrored)
    points = np.array([[[0.03, -0.02], [0.031, -0.018]], [[0.0, 0.0], [-0.2, 0.7]]])
    turned = [[(complex(*each) - (0.03 - 0.02j)) * cmath.exp(-0.4j) / 2e-5 for each in row] for row in points]
    sign = -1.0 if mirrored else 1.0
    expected = [[[100.0 + sign * each.real, 50.0 - each.imag] for each in row] for row in turned]
    np.testing.assert_allclose(view.to_pixels(points), expected, rtol=1e-12)
    np.testing.assert_allclose(view.to_plane(expected), points, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(view.to_measured_pixels(points), view.to_pixels(points))
    np.testing.assert_array_equal(view.centre_px, [100.0, 50.0])


def test_field_of_view() -> None:
    """The centres of the corner pixels, 2 x 1 mm from the middle, turned by 0.4 rad."""
    corners = [complex(x, y) * cmath.exp(0.4j) for x in (-2e-3, 2e-3) for y in (-1e-3, 1e-3)]
    across, up = ([part(each) for each in corners] for part in (lambda z: z.real, lambda z: z.imag))
    expected = [[0.03 + min(across), -0.02 + min(up)], [0.03 + max(across), -0.02 + max(up)]]
    np.testing.assert_allclose(VIEW.bounds, expected, rtol=1e-12)


@pytest.mark.parametrize("lens", [None, Lens(k1=2e-6, centre=(90.0, 60.0))])
def test_a_margin_from_the_border_of_the_measured_image(lens: Lens | None) -> None:
    """On each side, a little more and a little less than the margin; the lens moves the border by some pixels."""
    view = BoardView(scale=2e-5, shape=(101, 201), pose=(0.03, -0.02, 0.4), model=lens)
    margin = np.array([[5.0, 5.0], [7.0, 7.0], [3.0, 3.0], [6.0, 6.0]])
    for shift in (0.01, -0.01):
        pixels = np.array(
            [
                [[5.0 + shift, 20.0], [60.0, 5.0 + shift]],
                [[193.0 - shift, 20.0], [60.0, 93.0 - shift]],
                [[3.0 + shift, 97.0 - shift], [197.0 - shift, 50.0]],
                [[6.0 + shift, 6.0 + shift], [194.0 - shift, 94.0 - shift]],
            ]
        )
        points = view.to_plane(pixels if lens is None else lens.undistort(pixels))
        np.testing.assert_array_equal(view.contains(points, margin), np.full((4, 2), shift > 0.0))
    assert view.contains(view.to_plane([[100.0, 50.0]]), 0.0).all()
    assert not view.contains([[math.nan, 0.0]], 0.0).any()
