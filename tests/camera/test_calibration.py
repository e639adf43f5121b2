"""Residuals of a calibration, assigned to the points of the images."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.calibration import Calibration, DetectedTarget, image_coverage
from gpuvision.camera.correction_uncertainty import CorrectionMap
from gpuvision.camera.lines.lens_fit import LensAlternative, LensFit
from gpuvision.camera.smooth_field import LackOfFit


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


def square(left: float, top: float) -> tuple[np.ndarray, ...]:
    """Return two lines of three points on the sides of a square of 10 px."""
    return tuple(np.array([[left, row], [left + 4.0, row], [left + 10.0, row]]) for row in (top, top + 10.0))


def calibrated() -> Calibration:
    """Return a calibration of two images whose numbers all differ."""
    fit: dict[str, Any] = dict.fromkeys(LensFit.__dataclass_fields__)
    fit |= {
        "model": "k1",
        "lines": "vanishing",
        "names": ("k1", "C_c", "v1"),
        "values": np.array([1e-7, 50.0, 3.0]),
        "covariance": np.diag([4e-18, 0.25, 1.0]),
        "residuals_px": tuple((np.array([0.3, -0.4, np.nan]), np.full(3, k)) for k in (0.0, 0.1)),
        "rms_px": 0.05,
        "sigma_px": 0.06,
        "lack_of_fit": LackOfFit(p_value=0.01, rms_px=0.02, noise_px=0.03, modes=4),
        "error_model": "correlated",
        "alternatives": (
            LensAlternative(
                model="none",
                lines="free",
                rms_px=1.5,
                p_value=0.001,
                aic=20.0,
                centre=(7.0, 8.0),
                centre_distance_px=9.0,
            ),
        ),
        "warnings": ("few images",),
    }
    sigma = np.array([[0.05, 0.2], [0.08, np.nan]])
    inside = np.array([[True, False], [True, True]])
    found = Calibration(
        fit=LensFit(**fit),
        pattern="lines",
        image_size=(40, 20),
        detected_targets=tuple(DetectedTarget(Path(f"in/{k}.png"), None, (square(10.0 * k, 5.0),)) for k in (0, 1)),
        skipped_images=((Path("in/dark.png"), "no lines"),),
        straightness_px=(1.25, 0.0625),
    )
    found.__dict__["correction_map"] = CorrectionMap(np.zeros((2, 2, 2)), sigma, inside, ~inside | np.isnan(sigma))
    return found


def test_report_of_a_lens() -> None:
    found = calibrated()
    assert found.coverage == pytest.approx(200.0 / 800.0)
    assert found.report() == {
        "pattern": "lines",
        "image_size": [40, 20],
        "coverage": pytest.approx(0.25),
        "model": "k1",
        "rms_px": 0.05,
        "straightness_px": {"measured": 1.25, "corrected": 0.0625},
        "parameters": {"k1": {"value": 1e-7, "sigma": pytest.approx(2e-9)}, "C_c": {"value": 50.0, "sigma": 0.5}},
        "covariance": {"names": ["k1", "C_c", "v1"], "matrix": np.diag([4e-18, 0.25, 1.0]).tolist()},
        "alternatives": [
            {
                "model": "none (lines free)",
                "rms_px": 1.5,
                "p_value": 0.001,
                "aic": 20.0,
                "centre": (7.0, 8.0),
                "centre_distance_px": 9.0,
            }
        ],
        "warnings": ["few images"],
        "error_model": "correlated",
        "lack_of_fit": {"p_value": 0.01, "rms_px": 0.02, "noise_px": 0.03, "modes": 4},
        "correction": {
            "max_sigma_px": 0.2,
            "max_sigma_inside_px": 0.08,
            "extrapolated": 0.5,
            "max_allowed_sigma_px": 0.1,
        },
        "images": [
            {"name": "0.png", "rms_px": pytest.approx(np.sqrt(0.25 / 5.0))},
            {"name": "1.png", "rms_px": pytest.approx(np.sqrt((0.25 + 3 * 0.01) / 5.0))},
        ],
        "skipped_images": {"dark.png": "no lines"},
        "sigma_px": 0.06,
        "lines": "vanishing",
    }


def test_summary_of_a_lens() -> None:
    assert calibrated().summary() == (
        "lines in 2 of 3 images, 12 points over 25 % of the image; model k1: residual 0.05 px rms; deviation from "
        "straight lines 1.25 px, corrected 0.0625 px; the correction is known to 0.08 px, and extrapolated in 50 % of "
        "the image"
    )


def test_points_on_a_line_cover_nothing() -> None:
    line = np.array([[0.0, 0.0], [5.0, 5.0], [9.0, 9.0], [np.nan, 1.0]])
    assert image_coverage([DetectedTarget(Path("a.png"), None, ((line,),))], (10, 10)) == 0.0
    grid = np.full((3, 2, 2), 4.0)
    grid[1, 0, 0] = np.nan
    assert DetectedTarget(Path("a.png"), grid, ()).points == 5
