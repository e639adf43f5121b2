"""Range error of strips by light that is missing or added, against the readings with and without the light."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.simulation.errors.range_error import StripErrorModel, interreflection_power_bound, select_paths
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from lights import gaussian, psd_view

# Strips: light off the middle, light at the upper end, no light, little light.
MODEL = StripErrorModel(
    power=np.array([4.0, 2.0, 0.0, 0.25]),
    moment=np.array([-2.0, 6.0, 0.0, 0.5]),
    slope=np.array([0.5, -3.0, 2.0, 1.5]),
    limits=(np.array([-1.0, -2.0, -3.0, -4.0]), np.array([5.0, 3.0, 9.0, 6.0])),
)


def test_position_is_the_centroid_within_the_limits() -> None:
    np.testing.assert_array_equal(MODEL.position, [-0.5, 3.0, 3.0, 2.0])
    np.testing.assert_array_equal(
        replace(MODEL, moment=np.array([-8.0, 9.0, 1.0, -2.0])).position, [-1.0, 3.0, 3.0, -4.0]
    )
    np.testing.assert_array_equal(MODEL.max_error(), [3.0, 15.0, 24.0, 15.0])


def test_weights_are_power_and_moment_within_the_limits() -> None:
    u = np.array([[-1.0, -1.25, 5.0], [3.25, -2.0, 3.0], [0.0, 10.0, -3.0], [6.5, -4.5, 1.0]])
    seen = np.arange(1.0, 13.0).reshape(4, 3)
    power = [[1.0, 0.0, 3.0], [0.0, 5.0, 6.0], [7.0, 0.0, 9.0], [0.0, 0.0, 12.0]]
    found = MODEL.weights(seen, u)
    np.testing.assert_array_equal(found[..., 0], power)
    np.testing.assert_array_equal(found[..., 1], power * u)


@pytest.mark.parametrize(("min_power", "least"), [(0.0, [4.0, 2.0, 0.0, 0.25]), (1.0, [4.0, 2.0, 1.0, 1.0])])
def test_bound_of_the_error_by_added_power(min_power: float, least: list[float]) -> None:
    """Power anywhere within the limits moves the reading by q / (1 + q) of their distance at most."""
    model = replace(MODEL, min_power=min_power)
    more = np.array([2.0, 0.0, 3.0, 0.5])
    q = more / np.maximum(least, 1e-300)
    np.testing.assert_allclose(model.error_bound(more), model.max_error() * [q[0] / (1 + q[0]), 0, *(q / (1 + q))[2:]])
    np.testing.assert_allclose(model.error_bound(1.5), model.max_error() * 1.5 / (1.5 + np.array(least)))


@pytest.mark.parametrize("max_shift", [math.inf, 0.5, np.array([2.0, 0.25, 1.0, 8.0])])
def test_error_per_irradiance_is_that_of_the_farthest_reading(max_shift: float | np.ndarray) -> None:
    """Light p at u in addition to light P at x: the reading without p has the error p (u - x) / P."""
    model = replace(MODEL, min_power=0.5, max_shift=max_shift)
    u = np.array([[-0.75, 4.0], [2.5, -1.5], [8.0, -2.0], [5.5, -3.5]])
    weights = model.weights(np.array([[1.0, 2.0], [3.0, 0.5], [0.25, 2.0], [1.5, 0.75]]), u)
    found = model.error_per_irradiance(weights)
    least = [4.0, 2.0, 0.5, 0.5]
    shift = np.broadcast_to(max_shift, 4)
    for strip, number in np.ndindex(u.shape):
        low, high = (each[strip] for each in model.limits)
        x = model.position[strip] + np.linspace(-1.0, 1.0, 5) * min(shift[strip], 100.0)
        arm = np.abs(u[strip, number] - np.clip(x, low, high)).max()
        expected = abs(model.slope[strip]) * weights[strip, number, 0] * arm / least[strip]
        assert found[strip, number] == pytest.approx(expected, rel=1e-14)
    dark = MODEL.error_per_irradiance(weights)
    assert np.isinf(dark[2]).all()
    assert np.isfinite(dark[[0, 1, 3]]).all()
    np.testing.assert_array_equal(MODEL.error_per_irradiance(0.0 * weights), 0.0)


def _height(view: SensorView, u: Any, v: float) -> Any:
    return view.sheet_coordinates(view.points_in_sheet(u, v))[..., 1]


def test_model_of_an_exposure() -> None:
    """Each strip has its own light, and its largest derivative of the height, at an edge of its bins."""
    view = psd_view()
    light = gaussian(view, np.linspace(-1e-3, 5e-4, view.samples), 1e-6, 1e-4)
    factor = np.arange(1.0, view.samples + 1.0)[:, None]
    light = Exposure(light.power * factor, light.moment * factor)
    model = StripErrorModel.from_exposure(view, light, min_power=2e-7, max_shift=1e-4)
    np.testing.assert_allclose(model.power, 1e-6 * np.arange(1.0, view.samples + 1.0), rtol=1e-9)
    np.testing.assert_allclose(model.position, np.linspace(-1e-3, 5e-4, view.samples), atol=1e-7)
    assert (model.min_power, model.max_shift) == (2e-7, 1e-4)
    for strip, v in enumerate(view.v_centres):
        # Central differences at the edges; those at fine steps inside show that no position has a larger derivative.
        step = 1e-6 * (view.u_edges[-1] - view.u_edges[0])
        slopes = [abs(_height(view, u + step, v) - _height(view, u - step, v)) / (2.0 * step) for u in view.u_edges]
        assert model.slope[strip] == pytest.approx(max(slopes), rel=1e-8)
        inside = _height(view, np.linspace(view.u_edges[0], view.u_edges[-1], 1001), v)
        secants = np.abs(np.diff(inside)) * 1000.0 / (view.u_edges[-1] - view.u_edges[0])
        assert secants.max() < model.slope[strip] < 1.01 * secants.max()
        assert [each[strip] for each in model.limits] == [view.u_edges[0], view.u_edges[-1]]
    plain = StripErrorModel.from_exposure(view, light)
    assert (plain.min_power, plain.max_shift) == (0.0, math.inf)


def test_paths_are_omitted_up_to_half_of_the_tolerance() -> None:
    bounds = {"a": [0.5, 2.0], "b": 1.0, "c": math.inf, "d": 0.0, "e": [1.0]}
    found = select_paths(bounds, 8.0)
    assert found.omitted == {"d": 0.0, "b": 1.0, "e": 1.0, "a": 2.0}  # 4.0 is exactly half of the tolerance
    assert found.modelled == {"c": None}
    assert found.remaining_tolerance == 4.0
    less = select_paths(bounds, 7.5)
    assert less.omitted == {"d": 0.0, "b": 1.0, "e": 1.0}
    assert less.modelled == {"a": 2.0, "c": None}
    assert less.remaining_tolerance == 5.5
    none = select_paths({"a": 3.0, "d": 0.0, "empty": []}, 0.0)
    assert none.omitted == {"d": 0.0, "empty": 0.0}
    assert none.remaining_tolerance == 0.0


def test_bound_of_the_power_after_many_reflections() -> None:
    """The sum of received albedo^k, k >= 1, times albedo / pi and the solid angle."""
    received, albedo, solid_angle = 3.0, 0.75, 0.125
    series = sum(received * albedo**k for k in range(1, 400))
    expected = series * albedo / math.pi * solid_angle
    assert interreflection_power_bound(received, albedo, solid_angle) == pytest.approx(expected, rel=1e-12)
    assert interreflection_power_bound(received, 1.0, solid_angle) == math.inf
    assert interreflection_power_bound(0.0, 1.0, solid_angle) == 0.0
    assert interreflection_power_bound(received, 0.0, solid_angle) == 0.0
    assert interreflection_power_bound(received, albedo, 0.0) == 0.0
    for wrong in ((-1e-9, 0.5, 1.0), (1.0, -1e-9, 1.0), (1.0, 1.0 + 1e-9, 1.0), (1.0, 0.5, -1e-9)):
        with pytest.raises(ValueError, match=f"got {wrong[1]}; power and solid angle"):
            interreflection_power_bound(*wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"moment": np.zeros(3)}, r"moment has shape \(3,\), expected \(strips,\)"),
        ({"slope": np.zeros((4, 1))}, r"slope has shape \(4, 1\)"),
        ({"power": np.zeros((2, 2))}, r"power has shape \(2, 2\)"),
        ({"power": np.array([1.0, 0.0, -1e-300, 1.0])}, "power >= 0"),
        ({"limits": (1.0, 1.0)}, "u_low < u_high"),
        ({"limits": (-1.0, [2.0, 2.0, 2.0, -1.0])}, "u_low < u_high"),
    ],
)
def test_refusals(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(MODEL, **change)
