"""Report of the scatter of a head at rest."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.workflows.placement_cell import Repeatability

NAMES = ("x_m", "y_m", "theta_rad")


def test_report_of_the_repeatability() -> None:
    error = np.array([[1e-6, 2e-6, 1e-4], [3e-6, 2e-6, 5e-4], [5e-6, 8e-6, 3e-4]])
    frame, pixel = np.array([1e-6, 2e-6, 3e-4]), np.array([4e-6, 5e-6, 6e-4])
    report = Repeatability(error, frame, pixel).report()
    assert report.pop("frames") == 3
    expected = {
        "measured_sigma": (2e-6, np.sqrt(12.0) * 1e-6, 2e-4),
        "predicted_sigma": frame,
        "mean": (3e-6, 4e-6, 3e-4),
        "predicted_sigma_of_mean": pixel,
    }
    assert set(report) == set(expected)
    for key, values in expected.items():
        assert report[key] == pytest.approx(dict(zip(NAMES, values, strict=True)))


def test_one_frame_has_no_scatter_and_no_frame_no_mean() -> None:
    zero = np.zeros(3)
    one, none = (Repeatability(np.ones((count, 3)), zero, zero).report() for count in (1, 0))
    assert one["mean"] == dict.fromkeys(NAMES, 1.0)
    for values in (one["measured_sigma"], none["measured_sigma"], none["mean"]):
        assert np.isnan(list(values.values())).all()
