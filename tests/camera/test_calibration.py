"""Residuals of a calibration, assigned to the points of the images."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from gpuvision.camera.calibration import Calibration


def test_distances_from_lines_belong_to_the_points_of_their_image(rng: np.random.Generator) -> None:
    """Two images with families of lines of different sizes; the residual of a point is here its column."""
    families = [
        [[rng.uniform(0.0, 640.0, (points, 2)) for points in family] for family in image]
        for image in ([(3, 5), (2, 4, 7)], [(6,), (5, 2)])
    ]
    residuals = [[line[:, 0] for line in family] for image in families for family in image]
    calibration = SimpleNamespace(
        fit=SimpleNamespace(residuals_px=residuals),
        detected_targets=[SimpleNamespace(families=image) for image in families],
    )
    images = Calibration.residuals.fget(calibration)
    assert [len(points) for points, _ in images] == [21, 13]
    for points, distances in images:
        np.testing.assert_array_equal(distances, points[:, 0])
