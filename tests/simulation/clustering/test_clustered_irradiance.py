"""ClusteredIrradiance: the pairs of the cut are computed, and readings keep the tolerance, with occlusion."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference import light_clustering as reference
from gpuvision.simulation.clustering.clustered_irradiance import ClusteredIrradiance, PairCounts, estimate_pairs
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance
from sensor_views import sensor_view


def boxes(rng: np.random.Generator, count: int) -> Any:
    """Return the triangles of boxes on a board, and lit lines along y = 0 on the tops and on the board."""
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
    """Return receivers by strips, on the sides of the boxes that face along x, and on the board."""
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


@pytest.mark.double
@pytest.mark.parametrize("tolerance", [0.0, 1e-6, 1e-5, 1e-4])
def test_readings_keep_the_tolerance(device: Device, tolerance: float) -> None:
    triangles, segments = boxes(np.random.default_rng(0), 12)
    receivers = strips(triangles, 6, 50)
    scene = Scene(triangles)
    power = np.full(receivers.shape[:2], 1e-4)
    u = np.linspace(-0.03, 0.03, 50)
    weights = np.stack([power, power * u], axis=2)
    direct = np.full(6, 0.01)
    reading = StripErrorModel(power=direct, moment=0.005 * direct, slope=np.ones(6), limits=(-0.03, 0.03))
    light = ClusteredIrradiance(scene=scene, tolerance=tolerance, min_facing_pairs=None, device=device)
    ours = light(segments, receivers, weights, reading)
    exact = OccludedIrradiance(scene=scene, segments=len(segments), precision="single")(
        receivers, np.zeros_like(weights), segments, device=device
    ).irradiance
    shift = [reference.mean_position(direct, 0.005 * direct, weights, light) for light in (ours.irradiance, exact)]
    # Plus the rounding of the kernel.
    assert np.all(np.abs(shift[0] - shift[1]) <= ours.cut.bound + 1e-9)
    assert np.all(ours.cut.bound <= tolerance)
    if tolerance == 0.0:
        np.testing.assert_allclose(ours.irradiance, exact, rtol=2e-5, atol=1e-6 * exact.max())


@pytest.mark.parametrize("vectors", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_device_without_doubles_takes_receivers_in_double(device: Device, vectors: bool) -> None:
    single = copy.copy(device) if vectors else device.without_vectors()
    single.has_double = single.has_fast_double = False
    triangles, segments = boxes(np.random.default_rng(0), 12)
    receivers = strips(triangles, 6, 50)
    weights = np.full((6, 50, 2), 1e-4)
    reading = StripErrorModel(power=np.full(6, 0.01), moment=np.zeros(6), slope=np.ones(6), limits=(-0.03, 0.03))
    scene = Scene(triangles)
    light = ClusteredIrradiance(scene=scene, tolerance=0.0, min_facing_pairs=None, device=single)
    assert receivers.dtype == np.float64
    result = light(segments, receivers, weights, reading)
    assert result.cut.has_pairs
    every = light.compute_all(segments, receivers)
    np.testing.assert_allclose(result.irradiance, every, rtol=2e-5, atol=1e-6 * every.max())
    assert every.max() > 0.0


@pytest.mark.double
def test_pairs_that_are_left_out_are_dark(device: Device) -> None:
    triangles, segments = boxes(np.random.default_rng(0), 3)
    receivers = strips(triangles, 2, 16)
    weights = np.full((2, 16, 2), 1e-9)
    reading = StripErrorModel(power=np.ones(2), moment=np.zeros(2), slope=np.ones(2), limits=(-0.03, 0.03))
    light = ClusteredIrradiance(scene=Scene(triangles), tolerance=1e-3, min_facing_pairs=None, device=device)
    result = light(segments, receivers, weights, reading)
    assert not result.cut.has_pairs
    assert not result.irradiance.any()


def groove(strips: int, each: int, segments: int) -> Any:
    """Return a groove of 90 degrees: triangles, lit segments along y = 0, receivers on both sides, their reading.

    Half of the pairs face each other: the pairs with segment and receiver on different sides.
    """
    a, b, c, d, e, f = ([x, y, abs(x)] for y in (-0.05, 0.05) for x in (-0.12, 0.0, 0.12))
    x = np.linspace(-0.1, 0.1, segments + 1)
    at = np.column_stack([x, 0.0 * x, np.abs(x)])
    side = np.sign(x[1:] + x[:-1])
    rows = np.column_stack([at[:-1], at[1:], -side, 0.0 * side, np.ones(segments), np.full(segments, 0.01)])
    X, Y = np.meshgrid(
        *(width * ((np.arange(n) + 0.5) / n - 0.5) for width, n in ((0.2, strips), (0.06, each))), indexing="ij"
    )
    receivers = np.stack([X, Y, np.abs(X), -np.sign(X), 0.0 * X, 1.0 + 0.0 * X], axis=2)
    power = np.full((strips, each), 0.012 / (strips * each))
    direct = np.full(strips, 0.002 / strips)
    reading = StripErrorModel(power=direct, moment=0.0 * direct, slope=np.ones(strips), limits=(-0.03, 0.03))
    triangles = np.array([[a, b, e], [a, e, d], [b, c, f], [b, f, e]])
    return Scene(triangles), rows, receivers, np.stack([power, power * Y], axis=2), reading


@pytest.mark.double
def test_where_clustering_costs_more_all_pairs_are_computed(device: Device) -> None:
    scene, segments, receivers, weights, reading = groove(8, 40, 50)
    exact = OccludedIrradiance(scene=scene, segments=len(segments), precision="single")(
        receivers, np.zeros_like(weights), segments, device=device
    ).irradiance
    light = ClusteredIrradiance(scene=scene, tolerance=1e-4, device=device)
    ours = light(segments, receivers, weights, reading)
    # Rows without exitance after the last segment do not contribute.
    np.testing.assert_array_equal(ours.irradiance, exact)
    np.testing.assert_array_equal(light.compute_all(segments, receivers), exact)
    report = ours.cut.report()
    assert not report["traversed"]
    assert report["has pairs"]
    assert report["bound"] == report["left out"] == report["clustered"] == 0
    assert report["exact"] == report["work"] == report["pairs"] == receivers[..., 0].size * len(segments)
    # The report of the cut agrees with the computed pairs.
    rows, starts, selected = ours.cut.padded_tables(np.float64)
    selected_of = OccludedIrradiance(scene=scene, segments=len(rows), selected=len(selected), precision="single")
    by_cut = selected_of(receivers, np.zeros_like(weights), rows, starts, selected, device=device).irradiance
    # The same sums in a different order.
    np.testing.assert_allclose(by_cut, exact, rtol=2e-5, atol=1e-6 * exact.max())


@pytest.mark.double
def test_what_faces_each_other_decides_whether_there_is_a_plan(device: Device) -> None:
    scene, segments, receivers, weights, reading = groove(8, 40, 50)
    facing, pairs = estimate_pairs(segments, receivers, weights)
    assert pairs == receivers[..., 0].size * len(segments)
    gain = facing - pairs // 4
    assert 0 < gain < pairs // 2
    results = [
        ClusteredIrradiance(scene=scene, tolerance=1e-4, min_facing_pairs=least, device=device)(
            segments, receivers, weights, reading
        )
        for least in (gain, gain + 1)
    ]
    assert [each.cut.traversed for each in results] == [True, False]
    assert results[0].cut.counts["work"] < pairs // 2
    shift = [reference.mean_position(reading.power, reading.moment, weights, each.irradiance) for each in results]
    # Both computations agree within the bound plus the rounding of the kernel.
    assert np.all(np.abs(shift[0] - shift[1]) <= results[0].cut.bound + 1e-9)
    assert np.all(results[0].cut.bound <= 1e-4)
    exact = ClusteredIrradiance(scene=scene, tolerance=0.0, min_facing_pairs=gain, device=device)
    assert not exact(segments, receivers, weights, reading).cut.traversed
    assert exact(segments, receivers, weights, reading, tolerance=1e-4).cut.traversed


@pytest.mark.double
def test_few_pairs_are_not_estimated(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, segments, receivers, weights, reading = groove(2, 40, 50)
    pairs = receivers[..., 0].size * len(segments)
    estimated = []

    def all_face(*given: Any) -> PairCounts:
        estimated.append(given)
        return PairCounts(pairs, pairs)

    monkeypatch.setattr("gpuvision.simulation.clustering.clustered_irradiance.estimate_pairs", all_face)
    for least, is_estimated in ((pairs // 4, True), (pairs // 4 + 1, False)):
        light = ClusteredIrradiance(scene=scene, tolerance=1e-4, min_facing_pairs=least, device=device)
        assert light(segments, receivers, weights, reading).cut.traversed == is_estimated
        assert len(estimated) == 1


def test_few_pairs_face_each_other_on_a_board() -> None:
    triangles, segments = boxes(np.random.default_rng(0), 12)
    receivers = strips(triangles, 1, 60)
    weights = np.ones((1, 60, 2))
    middle = 0.5 * (segments[:, :3] + segments[:, 3:6])
    offset = receivers.reshape(-1, 1, 6)[..., :3] - middle
    faces = (np.sum(offset * segments[:, 6:9], axis=2) > 0.0) & (
        np.sum(offset * receivers.reshape(-1, 1, 6)[..., 3:], axis=2) < 0.0
    )
    weights[0, :10] = 0.0
    weights[0, 10:20, 1] = 0.0
    expected = int(np.count_nonzero(faces[10:]))
    # The sample contains all of 60 receivers and 23 segments.
    assert estimate_pairs(segments, receivers, weights) == (expected, 50 * len(segments))
    assert 0 < expected < faces.size // 4


def test_facing_pairs_are_estimated_where_there_are_many() -> None:
    _, segments, receivers, weights, _ = groove(40, 40, 200)
    pairs = receivers[..., 0].size * len(segments)
    # Half of the pairs; the counts of receivers and segments of each side are exact to one in a sample of 60 and 33.
    facing, counted = estimate_pairs(segments, receivers, weights)
    assert abs(facing - pairs / 2) <= pairs * (1 / 60 + 1 / 33)
    assert counted == pairs
    weights[20:] = 0.0
    facing, counted = estimate_pairs(segments, receivers, weights)
    assert abs(facing - pairs / 4) <= pairs * (1 / 60 + 1 / 33)
    assert abs(counted - pairs / 2) <= pairs / 60


@pytest.mark.parametrize("each", [8, 30, 61, 64])
def test_the_sample_has_receivers_from_all_parts_of_a_strip(each: int) -> None:
    count = 20 * each  # strips: the step without this condition would be a multiple of the length of a strip
    segments = np.array([[-1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]])
    receivers = np.tile([0.0, 1.0, 1.0, 0.0, 1.0, 0.0], (count, each, 1))
    for half in (slice(each // 2), slice(each // 2, each)):
        facing = receivers.copy()
        facing[:, half, 4] = -1.0
        share = len(range(each)[half]) / each
        found, pairs = estimate_pairs(segments, facing, np.ones((count, each, 2)))
        assert pairs == count * each
        assert abs(found - share * pairs) <= 0.1 * pairs


def test_without_light_or_receivers_nothing_is_lit(device: Device) -> None:
    scene, segments, receivers, weights, reading = groove(2, 16, 20)
    light = ClusteredIrradiance(scene=scene, tolerance=1e-4, device=device)
    assert not light(segments[:0], receivers, weights, reading).irradiance.any()
    assert estimate_pairs(segments[:0], receivers, weights) == (0, 0)
    assert estimate_pairs(segments, receivers, 0.0 * weights) == (0, 0)


def test_a_sensor_says_how_its_readings_follow_light() -> None:
    one = sensor_view()
    assert isinstance(one.transport, StraightTransport)
    exposure = Exposure(np.ones((one.samples, one.bins)), np.zeros((one.samples, one.bins)))
    reading = StripErrorModel.from_exposure(one, exposure, min_power=1e-3)
    u, v = np.meshgrid(one.u_edges, one.v_centres)
    step = 1e-6 * (one.u_edges[-1] - one.u_edges[0])
    above, below = (one.sheet_coordinates(one.points_in_sheet(u + each, v))[..., 1] for each in (step, -step))
    np.testing.assert_allclose(reading.slope, np.abs((above - below) / (2.0 * step)).max(axis=1), rtol=1e-7)
    np.testing.assert_allclose(reading.power, one.bins)
    np.testing.assert_allclose(reading.position, one.u_centres.mean(), atol=1e-12)
    seen = np.ones((one.samples, one.bins))
    weights = reading.weights(seen, one.u_centres)
    np.testing.assert_allclose(weights[..., 1], np.broadcast_to(one.u_centres, seen.shape))
    costs = reading.error_per_irradiance(weights)
    middle = 0.5 * (one.u_edges[0] + one.u_edges[-1])
    span = one.u_edges[-1] - one.u_edges[0]
    expected = reading.slope[:, None] * (0.5 * span + np.abs(one.u_centres - middle)) / one.bins
    np.testing.assert_allclose(costs, expected)
