"""Sheet of light from known points of a fixture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpuvision.camera.camera import Camera
from gpuvision.ranging.sheet_from_points import sheet_from_points
from laser_sensor import sensor

TRUTH = sensor(20.0)
CAMERA = Camera(matrix=tuple(tuple(row) for row in TRUTH.matrix.tolist()), distortion=tuple(TRUTH.distortion.tolist()))
FLAT = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 4), np.linspace(-0.02, 0.02, 3)), axis=-1).reshape(-1, 2)


def known(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points in the frame of a fixture, and their noisy pixels."""
    points = TRUTH.surface(FLAT)
    turn = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    return (points - [0.1, 0.02, 0.3]) @ turn, TRUTH.project(points) + rng.normal(0.0, sigma, (len(points), 2))


def test_sheet_has_its_predicted_covariance(rng: np.random.Generator) -> None:
    chi_squares, variances = [], []
    for _ in range(40):
        found = sheet_from_points(CAMERA, *known(rng, 0.1))
        offset = TRUTH.surface(FLAT) - found.origin
        g, h, d = (offset @ np.stack([found.g_axis, found.h_axis, found.normal]).T).T
        error = np.linalg.lstsq(np.stack([np.ones_like(g), g, h], axis=1), d, rcond=None)[0]
        variances.append(found.sigma_px**2)
        chi_squares.append(error @ np.linalg.solve(found.covariance(np.zeros((0, 0))), error))
    # Three times F(3, 18): mean 3.4, standard deviation 3.4 per draw.
    assert 1.5 < np.mean(chi_squares) < 3.4 + 4.0 * 3.4 / np.sqrt(40)
    assert found.g_axis @ TRUTH.g > 0.999
    assert found.h_axis @ TRUTH.h > 0.999
    # 40 fits with 24 coordinates and 6 parameters: the variance is known to 5 %.
    assert np.mean(variances) == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_the_fit_is_in_the_frame_of_the_sheet(along: str, rng: np.random.Generator) -> None:
    """Coordinates and residuals of each point; G grows along the samples of the image."""
    points, pixels = known(rng, 0.1)
    found = sheet_from_points(CAMERA, points, pixels, along=along)
    (coordinates,), (residuals,) = found.coordinates, found.residuals
    placed = found.origin + coordinates @ np.stack([found.g_axis, found.h_axis])
    np.testing.assert_allclose(placed, TRUTH.surface(FLAT), rtol=0, atol=3e-4)
    np.testing.assert_allclose(coordinates.mean(axis=0), 0.0, atol=1e-15)
    sample, across = (0, 1) if along == "columns" else (1, 0)
    assert np.all(np.corrcoef(coordinates[:, 0], pixels[:, sample])[0, 1] > 0.9)
    assert found.h_axis @ found.origin < 0.0
    seen = TRUTH.project(placed)
    np.testing.assert_allclose(np.abs(residuals), np.abs(pixels - seen)[:, across], rtol=0, atol=1e-6)
    assert found.names == ("offset", "slope_g", "slope_h")
    assert found.bend is None
    assert found.view_ratio == 1.0


def test_points_on_a_line_or_in_no_plane_are_refused(rng: np.random.Generator) -> None:
    points, pixels = known(rng, 0.0)
    with pytest.raises(ValueError, match="do not lie on one line"):
        sheet_from_points(CAMERA, points[:4], pixels[:4])
    with pytest.raises(ValueError, match="3 points, expected 4"):
        sheet_from_points(CAMERA, points[3:6], pixels[3:6])
    raised = points + rng.normal(0.0, 0.01, points.shape)
    with pytest.raises(ValueError, match="lie in no plane"):
        sheet_from_points(CAMERA, raised, pixels)


def test_points_almost_on_a_line_are_refused() -> None:
    """Four points 1 um off a line of 80 mm: their noise would decide on the pose."""
    flat = np.stack([np.linspace(-0.04, 0.04, 4), [1e-6, -1e-6, -1e-6, 1e-6]], axis=1)
    points = TRUTH.surface(flat)
    with pytest.raises(ValueError, match="do not lie on one line"):
        sheet_from_points(CAMERA, points, TRUTH.project(points))
