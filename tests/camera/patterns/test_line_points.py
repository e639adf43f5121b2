"""Points of a line between two cells: position, contrast and width at their limits."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.patterns.line_pattern import LinePatternLimits, _measure_between_columns, _measure_line_points

LIMITS = LinePatternLimits()
STEP = 40.0


def line_image(depth: np.ndarray, width: np.ndarray, *, slope: float = 0.1) -> np.ndarray:
    """Return grey levels of a line x = 50 + slope y, each block of 40 rows with its depth and width, on a plane."""
    rows = int(STEP) * len(depth)
    y, x = np.mgrid[:rows, :130].astype(float)
    away = (x - 50.0 - slope * y) / np.hypot(1.0, slope)
    block = (y // STEP).astype(int)
    grey = 200.0 + 0.3 * x - 0.1 * y - depth[block] * np.exp(-0.5 * (away / width[block]) ** 2)
    return grey.astype(np.float32)


def measured(grey: np.ndarray, limits: LinePatternLimits = LIMITS, *, bright: bool = True) -> np.ndarray:
    """Return the points found from places beside the line, with steps that are not at right angles to it."""
    rows = STEP * (np.arange(len(grey) // int(STEP)) + 0.5)
    places = np.stack([50.0 + 0.1 * rows + 1.7, rows - 0.4], axis=1)
    across, along = (np.broadcast_to(each, places.shape) for each in ([42.0, -3.0], [4.0, 39.0]))
    return _measure_line_points(grey, places, across, along, bright, limits)


@pytest.mark.parametrize("bright", [True, False])
def test_points_lie_on_the_line(bright: bool) -> None:
    grey = line_image(np.full(7, 100.0), np.full(7, 2.0))
    found = measured(grey if bright else 400.0 - grey, bright=bright)
    rows = STEP * (np.arange(7) + 0.5) - 0.4
    # From the place along the step across: x = 50 + 0.1 y.
    start = 50.0 + 0.1 * (rows + 0.4) + 1.7
    part = (50.0 + 0.1 * rows - start) / (42.0 + 0.3)
    np.testing.assert_allclose(found, np.stack([start + 42.0 * part, rows - 3.0 * part], axis=1), atol=0.015)


def test_contrast_and_width_of_the_other_points() -> None:
    """A contrast of 0.4 of the median, and widths within 10 % of the median, or within medians of the deviation."""
    depth, width = np.full(11, 100.0), np.full(11, 2.0)
    depth[3], depth[5], depth[10] = 41.5, 38.5, 200.0
    width[7], width[8], width[9] = 2.0 * np.exp(0.085), 2.0 * np.exp(0.125), 2.0 * np.exp(-0.125)
    known = np.isfinite(measured(line_image(depth, width))).all(axis=1)
    assert np.flatnonzero(~known).tolist() == [5, 8, 9]
    generous = LinePatternLimits(min_contrast=0.3, min_width_tolerance=0.2)
    assert np.isfinite(measured(line_image(depth, width), generous)).all()
    # The median of the deviations is 0.05, and one width deviates by 0.24.
    width[:] = 2.0 * np.exp(0.05 * np.array([-2.0, -1.0, -1.0, 0.0, 4.8, 0.0, 1.0, 1.0, 2.0, 2.0, -2.0]))
    depth[:] = 100.0
    for medians, is_kept in ((4.0, False), (6.0, True)):
        found = measured(line_image(depth, width), LinePatternLimits(max_deviation_medians=medians))
        assert np.isfinite(found[4]).all() == is_kept


def test_lines_before_between_and_after_the_cells() -> None:
    """Four cells in a row have five lines; between two cells the line is in the middle of their half steps."""
    _, x = np.mgrid[:130, :210].astype(float)
    lines = np.array([20.3, 61.1, 100.8, 140.2, 180.6])
    grey = (200.0 - 90.0 * np.exp(-0.5 * ((x[..., None] - lines) / 2.0) ** 2).sum(axis=-1)).astype(np.float32)
    cells = np.stack(np.meshgrid(0.5 * (lines[1:] + lines[:-1]), 25.0 + 40.0 * np.arange(3)), axis=-1)
    found = _measure_between_columns(grey, cells, True, LIMITS)
    assert found.shape == (5, 3, 2)
    np.testing.assert_allclose(found[..., 0], np.repeat(lines[:, None], 3, axis=1), atol=0.015)
    np.testing.assert_allclose(found[..., 1], np.broadcast_to(cells[:, 0, 1], (5, 3)), atol=0.01)
    cells[1, 1:3] = np.nan
    part = _measure_between_columns(grey, cells, True, LIMITS)
    assert np.argwhere(np.isnan(part[..., 0])).tolist() == [[2, 1]]
