"""The calibration benchmark: gpuvision and the peer get the same lines; the result is their straightness."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.profiling import calibration, calibration_tables


@pytest.fixture(autouse=True)
def _without_recordings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setattr(calibration, "_DATA", tmp_path)
    for cached in (calibration.case_of, calibration._measured):
        cached.cache_clear()
    yield
    calibration.case_of.cache_clear()


@pytest.mark.slow
def test_cases_without_recordings(device: Device) -> None:
    cases = list(calibration.cases(device))
    assert [case.name for case in cases] == [
        f"{kind}/{target}" for target in ("66x96", "33x39", "lines") for kind in ("fit", "tested")
    ]
    for case in cases:
        assert set(case.peers) == {"discorpy"}
        assert case.metadata["data"] == "synthetic"
        # The noise is 0.05 px; four parameters and the lines reduce the residual only slightly.
        assert 0.045 < case.error < 0.051
        assert case.error < case.metadata["error_discorpy"] < case.metadata["error_raw"]


def test_the_peers_model_is_inverted() -> None:
    model = calibration.Radial(500.0, 400.0, np.array([1.0, 1e-5, -3e-8, 2e-12, 0.0]))
    ideal = np.random.default_rng(1).uniform(0.0, 900.0, (50, 2))
    offset = ideal - (500.0, 400.0)
    radius = np.hypot(*offset.T)[:, None]
    seen = (500.0, 400.0) + offset * np.polynomial.polynomial.polyval(radius, model.coefficients)
    np.testing.assert_allclose(model.undistort(seen), ideal, atol=1e-9)


def test_a_grid_fills_its_image() -> None:
    for degrees in (0.0, 45.0):
        grid = calibration.tilted_grid((9, 12), degrees, (1000, 800))
        assert grid.shape == (9, 12, 2)
        widest = np.max(np.abs(grid - (500.0, 400.0)) / (1000.0, 800.0), axis=(0, 1))
        assert np.max(widest) == pytest.approx(0.425)


def test_a_draw_compares_both_sides() -> None:
    ours, theirs = calibration_tables.draw(1, 20.0, 10.0, 0.05)
    assert theirs is not None
    assert all(mine <= other for mine, other in zip(ours[::2], theirs[::2], strict=True))
    lens = calibration_tables.radial_lens(10.0)
    points = calibration.tilted_grid((9, 12), 0.0, (1024, 1024))
    assert calibration_tables.correction_error(lens, lens, points) < 1e-6
