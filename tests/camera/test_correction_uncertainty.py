"""Uncertainty of the correction, against Monte Carlo."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.camera.correction_uncertainty import (
    correction_covariance,
    correction_map,
    correction_sigma,
    largest_sigma,
)
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.vanishing_points import fit_lens
from gpuvision.camera.views.planar_calibration import fit_camera
from straight_lines import plane_grid, radial_lens
from view_scenes import RADIAL, SIZE, bent, camera, exact_views

LENS = radial_lens(10.0)


def correction_errors(found: Any, true: Any, points: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the difference of two corrections at points after the homography that fits the measured points best."""
    homography, _ = cv2.findHomography(found.undistort(measured), true.undistort(measured))
    moved = cv2.perspectiveTransform(found.undistort(points)[:, None], homography)[:, 0]
    return np.asarray(moved - true.undistort(points))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lines", "views"])
def test_it_is_the_scatter_of_corrections(rng: np.random.Generator, kind: str) -> None:
    """The errors of the fits have the predicted covariance, inside and outside the measured points."""
    squares = []
    for _ in range(16):
        if kind == "lines":
            ideal = LENS.distort(plane_grid(rng, 20.0))
            fit: Any = fit_lens(
                grid_lines(ideal + rng.normal(0.0, 0.05, ideal.shape)), model="k1,k2", lines="free", sigma=0.05
            )
            model, true, measured = fit.lens, LENS, ideal.reshape(-1, 2)
        else:
            views = exact_views(rng, camera(*RADIAL), views=5)
            fit = fit_camera(bent(rng, views, 0.0, 0.05), SIZE, model="k1,k2", sigma=0.05)
            model, true, measured = fit.camera, camera(*RADIAL), np.concatenate([image for _, image in views])
        low, high = measured.min(axis=0), measured.max(axis=0)
        points = np.array([(a, b) for a in (0.0, 0.3, 1.05) for b in (0.5, 1.05)]) * (high - low) + low
        covariance = correction_covariance(fit, points, measured)
        error = correction_errors(model, true, points, measured)
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.pinv(covariance, hermitian=True), error))
    # Chi-squared of 2 degrees of freedom: the mean of 16 independent draws is 2 +- 0.5; points of one fit correlate.
    assert np.mean(squares) == pytest.approx(2.0, abs=1.2)
    assert np.mean(np.array(squares) < 9.0) >= 0.95


def test_extrapolated_areas_are_marked(rng: np.random.Generator) -> None:
    points = LENS.distort(plane_grid(rng, 0.0)) * 0.4 + 100.0
    fit = fit_lens(grid_lines(points + rng.normal(0.0, 0.02, points.shape)), model="k1")
    found = correction_map(fit, (1024, 1024), [points.reshape(-1, 2)], max_sigma_px=0.1)
    low, high = points.reshape(-1, 2).min(axis=0) - 20.0, points.reshape(-1, 2).max(axis=0) + 20.0
    outside = ((found.points < low) | (found.points > high)).any(axis=-1)
    assert found.extrapolated[outside].all()
    assert not found.inside[outside].any()
    assert not found.extrapolated[found.inside].any()
    assert largest_sigma(found, inside=True) < largest_sigma(found, inside=False)
    small = correction_map(fit, (1024, 1024), [points.reshape(-1, 2)], max_sigma_px=1e-6)
    assert small.extrapolated.all()


def test_without_a_lens_there_is_no_uncertainty(rng: np.random.Generator) -> None:
    points = plane_grid(rng, 0.0)
    fit = fit_lens(grid_lines(points + rng.normal(0.0, 0.1, points.shape)), model="none")
    assert np.all(correction_sigma(fit, points, points) == 0.0)
