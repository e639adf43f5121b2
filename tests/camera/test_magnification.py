from __future__ import annotations

import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.magnification import largest_magnification

SHAPE, CENTRE = (200, 240), (119.5, 99.5)
CORNER = 119.5**2 + 99.5**2  # squared distance of a corner from the centre


def test_a_pincushion_lens_magnifies_its_corners() -> None:
    """Measured radius r (1 + k r^2): the magnification along a radius is 1 + 3 k r^2."""
    matrix = ((300.0, 0.0, CENTRE[0]), (0.0, 300.0, CENTRE[1]), (0.0, 0.0, 1.0))
    pincushion = Camera(matrix=matrix, distortion=(0.2, *13 * (0.0,)))
    assert largest_magnification(pincushion, SHAPE) == pytest.approx(1 + 0.6 * CORNER / 300**2, rel=1e-5)


def test_a_barrel_lens_magnifies_its_middle() -> None:
    assert largest_magnification(Lens(k1=2e-6, centre=CENTRE), SHAPE) == pytest.approx(1.0, abs=1e-4)


def test_pixels_past_the_fold_do_not_count() -> None:
    """The undistorted radius r (1 - r^2 / 3 R^2) is at most 2/3 R: with R = 100 px no corner has an image."""
    assert 1 < largest_magnification(Lens(k1=-1 / (3 * 100.0**2), centre=CENTRE), SHAPE) < 1e3
