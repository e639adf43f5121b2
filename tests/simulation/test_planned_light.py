"""PlannedLight: what the plan leaves is computed, and readings keep the tolerance, with everything in the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.ranging.range_image import StraightTransport
from gpuvision.simulation.planned_light import PlannedLight
from gpuvision.simulation.range_error import StripReading
from gpuvision.simulation.scene import Scene
from gpuvision.simulation.sight import Exposure
from gpuvision.simulation.visible_light import VisibleLight
from reference import tolerance as reference
from simulation.test_sight import sight


def boxes(rng: np.random.Generator, count: int) -> Any:
    """Boxes on a board: triangles; and lit lines over all of it along y = 0, on the tops and on the board."""
    low = np.column_stack([np.linspace(-0.09, 0.08, count), np.full((count, 2), [-0.01, 0.0])])
    high = low + np.column_stack([np.full(count, 0.008), np.full(count, 0.02), rng.uniform(0.002, 0.012, count)])
    corner = np.stack([np.where(np.array(bits), high, low) for bits in np.ndindex(2, 2, 2)], axis=1)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [1, 5, 7, 3]])
    board = np.array([[-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [0.2, 0.2, 0.0], [-0.2, 0.2, 0.0]])
    sides = np.concatenate([board[None], corner[:, quads].reshape(-1, 4, 3)])
    tops = np.column_stack([low[:, 0], 0 * low[:, 0], high[:, 2], high[:, 0], 0 * low[:, 0], high[:, 2]])
    between = np.column_stack([high[:-1, 0], 0 * low[1:, :2], low[1:, 0], 0 * low[1:, :2]])
    lines = np.concatenate([tops, between])
    up = np.tile([0.0, 0.0, 1.0, 1e-2], (len(lines), 1))
    return np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]), np.hstack([lines, up])


def strips(triangles: Any, count: int, each: int) -> Any:
    """Receivers on the boxes' sides that look along x, and on the board, by strips."""
    rng = np.random.default_rng(1)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sides = np.flatnonzero(np.abs(normal[:, 0]) > 0.5)
    number = np.repeat(rng.choice(sides, count), each).reshape(count, each)
    number[:, each // 2 :] = 0
    weights = np.sort(rng.random((count, each, 2)), axis=2)
    corners = triangles[number]
    place = corners[:, :, 0] + np.sum(
        np.diff(weights, axis=2, prepend=0.0)[..., None] * (corners[:, :, 1:] - corners[:, :, :1]), axis=2
    )
    return np.concatenate([place, np.where(normal[number][..., 2:] < -0.5, -1.0, 1.0) * normal[number]], axis=2)


@pytest.mark.parametrize("tolerance", [0.0, 1e-6, 1e-5, 1e-4])
def test_readings_keep_the_tolerance(device: Device, tolerance: float) -> None:
    triangles, segments = boxes(np.random.default_rng(0), 12)
    receivers = strips(triangles, 6, 50)
    scene = Scene(triangles)
    power = np.full(receivers.shape[:2], 1e-4)
    u = np.linspace(-0.03, 0.03, 50)
    weights = np.stack([power, power * u], axis=2)
    direct = np.full(6, 0.01)
    reading = StripReading(power=direct, moment=0.005 * direct, slope=np.ones(6), limits=(-0.03, 0.03))
    ours = PlannedLight(scene=scene, tolerance=tolerance, device=device)(segments, receivers, weights, reading)
    exact = VisibleLight(scene=scene, segments=len(segments), precision="single")(
        receivers, np.zeros_like(weights), segments, device=device
    ).irradiance
    shift = [reference.reading(direct, 0.005 * direct, weights, light) for light in (ours.irradiance, exact)]
    # The kernel's own rounding on top.
    assert np.all(np.abs(shift[0] - shift[1]) <= ours.plan.bound + 1e-9)
    assert np.all(ours.plan.bound <= tolerance)
    if tolerance == 0.0:
        np.testing.assert_allclose(ours.irradiance, exact, rtol=2e-5, atol=1e-6 * exact.max())


def test_what_is_not_modelled_is_dark(device: Device) -> None:
    triangles, segments = boxes(np.random.default_rng(0), 3)
    receivers = strips(triangles, 2, 16)
    weights = np.full((2, 16, 2), 1e-9)
    reading = StripReading(power=np.ones(2), moment=np.zeros(2), slope=np.ones(2), limits=(-0.03, 0.03))
    result = PlannedLight(scene=Scene(triangles), tolerance=1e-3, device=device)(segments, receivers, weights, reading)
    assert not result.plan.modelled
    assert not result.irradiance.any()


def test_a_sensor_says_how_its_readings_follow_light() -> None:
    one = sight()
    assert isinstance(one.transport, StraightTransport)
    exposure = Exposure(np.ones((one.samples, one.bins)), np.zeros((one.samples, one.bins)))
    reading = StripReading.of(one, exposure, floor=1e-3)
    u, v = np.meshgrid(one.u_edges, one.v_middles)
    height = one.sheet_coordinates(one.points_in_sheet(u, v))[..., 1]
    steps = np.abs(np.diff(height, axis=1)) / np.diff(one.u_edges)
    np.testing.assert_allclose(reading.slope, steps.max(axis=1))
    np.testing.assert_allclose(reading.power, one.bins)
    np.testing.assert_allclose(reading.position, one.u_middles.mean(), atol=1e-12)
    seen = np.ones((one.samples, one.bins))
    weights = reading.weights(seen, one.u_middles)
    np.testing.assert_allclose(weights[..., 1], np.broadcast_to(one.u_middles, seen.shape))
    costs = reading.costs(weights)
    middle = 0.5 * (one.u_edges[0] + one.u_edges[-1])
    span = one.u_edges[-1] - one.u_edges[0]
    expected = reading.slope[:, None] * (0.5 * span + np.abs(one.u_middles - middle)) / one.bins
    np.testing.assert_allclose(costs, expected)
