"""Pictures of placements, features and measured delays: all coordinates, the target, and no empty panel."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scipy.stats
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from gpuvision.camera.orthographic import BoardView
from gpuvision.plots.board import draw_features
from gpuvision.plots.placement import draw_placements, draw_repeatability
from gpuvision.plots.servoing import draw_measured_delay
from gpuvision.servoing.delay_measurement import MeasuredDelay


def test_errors_of_position_and_angle_are_drawn_as_outlines(drawn: list[Figure], tmp_path: Path) -> None:
    error = np.array([[1e-6, 0.0, 0.2e-3], [1.1e-6, 0.1e-6, -0.1e-3], [np.nan] * 3])
    motion = [np.array([[3e-5, 4e-5, 5e-3], [3e-6, 4e-6, -1e-3]])]
    draw_placements(
        tmp_path / "placements.png",
        period=1e-3,
        motion=motion,
        response=np.array([[1.0] * 3, [0.2, 0.1, 0.4], [0.04] * 3]),
        error=error,
        sigmas=np.array([1e-6, 1e-6, 1e-4]),
        delay={"exposure": 1e-3},
        tolerance=(5e-6, 2e-3),
    )
    panels: dict[str, Any] = {each.get_xlabel() + each.get_ylabel(): each for each in drawn[0].axes}
    (distance, theory, position_limit) = panels["time [ms]distance from the target [µm]"].lines
    (angle, angle_theory, angle_limit) = panels["time [ms]angle from the target [mrad]"].lines
    np.testing.assert_allclose(distance.get_ydata(), [50.0, 5.0])
    np.testing.assert_allclose(theory.get_ydata(), [50.0, math.hypot(0.2 * 30.0, 0.1 * 40.0)])
    np.testing.assert_allclose(angle_theory.get_ydata(), [5.0, 2.0])
    np.testing.assert_allclose(angle.get_ydata(), [5.0, 1.0])
    assert (position_limit.get_ydata()[0], angle_limit.get_ydata()[0]) == pytest.approx((5.0, 2.0))
    for unit, coordinates in (("µm", 2), ("mrad", 1)):
        panel = panels[f"error at the release [{unit}]number of placements"]
        outlines = [each for each in panel.patches if isinstance(each, Polygon)]
        assert len(outlines) == len(panel.patches) == coordinates
        assert not any(each.get_fill() for each in outlines)
        assert max(each.get_xy()[:, 1].max() for each in outlines) in (1.0, 2.0)
        # The expected numbers of two placements, normally distributed with the predicted sigmas.
        sigmas, bins = ([1.0, 1.0], 8.0) if unit == "µm" else ([0.1], 0.8)
        width = bins / (len(outlines[0].get_xy()) // 2 - 1)
        assert len(panel.lines) == len(sigmas)
        for line, sigma in zip(panel.lines, sigmas, strict=True):
            expected = 2.0 * width * scipy.stats.norm.pdf(line.get_xdata(), scale=sigma)
            np.testing.assert_allclose(line.get_ydata(), expected)
            assert np.ptp(line.get_xdata()) == pytest.approx(bins)
        ticks = panel.get_yticks()
        np.testing.assert_array_equal(ticks, np.round(ticks))


def test_repeatability_is_drawn_with_its_prediction(drawn: list[Figure], tmp_path: Path) -> None:
    error = np.array([[1e-6, 0.0, 0.1e-3], [3e-6, 1e-6, 0.2e-3], [2e-6, -1e-6, 0.3e-3]])
    sigma = np.array([1e-6, 2e-6, 1e-4])
    draw_repeatability(
        tmp_path / "repeatability.png", error=error, frame_sigma=sigma, pixel_sigma=0.5 * sigma, period=1e-3
    )
    assert [*drawn[0].get_size_inches(), drawn[0].dpi] == [13.0, 9.2, 120]
    panels = {each.get_ylabel(): each for each in drawn[0].axes}
    points, mean = panels["error of x [µm]"].lines
    np.testing.assert_allclose(points.get_ydata(), [1.0, 3.0, 2.0])
    np.testing.assert_allclose(points.get_xdata(), [0.0, 1.0, 2.0])
    assert mean.get_ydata()[0] == pytest.approx(2.0)
    for number, (name, unit, factor) in enumerate((("x", "µm", 1e6), ("y", "µm", 1e6), ("theta", "mrad", 1e3))):
        middle, spread = factor * error[:, number].mean(), factor * sigma[number]
        (band,) = panels[f"error of {name} [{unit}]"].patches
        edges = np.asarray(band.get_corners())[:, 1]
        assert (edges.min(), edges.max()) == pytest.approx((middle - 3.0 * spread, middle + 3.0 * spread))
        (predicted,) = drawn[0].axes[2 * number + 1].lines
        (outline,) = drawn[0].axes[2 * number + 1].patches
        places = np.asarray(predicted.get_ydata())
        assert (places[0], places[-1]) == pytest.approx((middle - 4.0 * spread, middle + 4.0 * spread))
        width = 8.0 * spread / (len(outline.get_xy()) // 2 - 1)
        expected = 3.0 * width * scipy.stats.norm.pdf(places, middle, spread)
        np.testing.assert_allclose(predicted.get_xdata(), expected)
    assert panels["error of theta [mrad]"].get_title() == "theta: sigma 0.100 mrad, predicted 0.100 mrad"
    assert panels["error of y [µm]"].get_legend().get_texts()[1].get_text().endswith("predicted sigma 1.000")


def test_a_delay_without_jitter_has_no_empty_panel(drawn: list[Figure], tmp_path: Path) -> None:
    time = 1e-3 * np.arange(5)
    for number, delays in enumerate((np.zeros(0), np.array([2e-3, 2.1e-3]))):
        delay = MeasuredDelay(2e-3, 1e-6, 0.0, np.inf, 1.0, 1e-9, 2.0, delays)
        draw_measured_delay(tmp_path / f"{number}.png", time, time, time, delay)
    assert [len(each.axes) for each in drawn] == [1, 2]


def test_features_show_the_target_and_the_turned_image(drawn: list[Figure], tmp_path: Path) -> None:
    """A camera at (3, 2) mm, turned by 30 degrees, for a nozzle target 2.5 mm beside it, out of the image."""
    features = SimpleNamespace(
        region=np.array([[2.5e-3, 1.5e-3], [3.5e-3, 2.5e-3]]),
        normal=np.array([[1.0, 0.0]]),
        length=np.array([1e-4]),
        point=np.array([[3e-3, 2e-3]]),
        spacing=np.zeros(1),
        fiducials=SimpleNamespace(point=np.zeros((0, 2)), radius=np.zeros(0)),
        placement=np.array([3e-3, 2e-3]),
        summary=lambda: "features",
    )
    holes = SimpleNamespace(start=np.zeros((0, 2)), end=np.zeros((0, 2)), diameter=np.zeros(0))
    board = SimpleNamespace(copper=(), mask=(), silk=(), holes=holes, side="top")
    view = BoardView(scale=1e-5, shape=(101, 201), pose=(3e-3, 2e-3, np.pi / 6))
    draw_features(
        tmp_path / "features.png",
        cast(Any, board),
        cast(Any, features),
        features.region,
        view=view,
        target=(5.5e-3, 2e-3),
    )
    (axes,) = drawn[0].axes
    crosses: dict[Any, Any] = {each.get_marker(): each for each in axes.lines}
    assert [float(each[0]) for each in crosses["+"].get_data()] == pytest.approx([3.0, 2.0])
    assert [float(each[0]) for each in crosses["x"].get_data()] == pytest.approx([5.5, 2.0])
    assert axes.get_xlim()[1] > 5.5
    (border,) = (each for each in axes.patches if isinstance(each, Polygon))
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    corners = np.array([[-1.0, 0.5], [1.0, 0.5], [1.0, -0.5], [-1.0, -0.5]]) @ [[c, s], [-s, c]] + [3.0, 2.0]
    np.testing.assert_allclose(border.get_xy()[:4], corners, atol=1e-9)
    assert {each.get_text() for each in drawn[0].legends[0].get_texts()} >= {"image centre", "target"}
