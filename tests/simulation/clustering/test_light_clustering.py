"""LightClustering: validity of the bounds, tolerance, amount of work, and conservative occlusion."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.reference import light_clustering as reference
from gpuvision.simulation.clustering.light_clustering import LightClustering
from gpuvision.simulation.clustering.light_cut import BLOCK, LightCut
from gpuvision.simulation.clustering.light_tree import LightTree
from gpuvision.simulation.errors.range_error import StripErrorModel, interreflection_power_bound, select_paths
from gpuvision.simulation.scene.scene import Scene

ON_DEVICES = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
ANYWHERE = settings(max_examples=40, deadline=None)
TWO_WAYS = pytest.mark.parametrize("variant", ["vector", "work_item"])
SLOPE = 1e-3
STRIPS, COUNT = 3, 40
PLACES = st.integers(0, 2**32 - 1).map(np.random.default_rng)


def random_segments(rng: np.random.Generator, count: int, *, spread: float = 0.1, length: float = 0.005) -> Any:
    start = rng.normal(size=(count, 3)) * spread * [1.0, 1.0, 0.3]
    along = rng.normal(size=(count, 3)) * length
    normal = np.cross(along, rng.normal(size=(count, 3)))
    return np.hstack([start, start + along, normal, rng.uniform(0.0, 1.0, (count, 1))])


def random_strips(rng: np.random.Generator, count: int = COUNT) -> Any:
    """Return strips along lines; the normals within a strip are similar."""
    place = rng.normal(size=(STRIPS, 1, 3)) * [0.1, 0.1, 0.03]
    place = place + np.linspace(-0.05, 0.05, count)[:, None] * rng.normal(size=(STRIPS, 1, 3))
    normal = rng.normal(size=(STRIPS, 1, 3)) + rng.uniform(0.0, 0.3) * rng.normal(size=(STRIPS, count, 3))
    return np.concatenate([place, normal], axis=2)


def weights_of(rng: np.random.Generator, count: int = COUNT) -> Any:
    power = rng.uniform(0.0, 2e-3, (STRIPS, count)) * (rng.random((STRIPS, count)) < 0.9)
    return np.stack([power, power * np.sort(rng.uniform(-1.0, 1.0, (STRIPS, count)), axis=1)], axis=2)


def reading_of(rng: np.random.Generator, **more: Any) -> StripErrorModel:
    power = rng.uniform(0.5, 5.0, STRIPS)
    moment = power * rng.uniform(-0.5, 0.5, STRIPS)
    return StripErrorModel(power=power, moment=moment, slope=np.full(STRIPS, SLOPE), limits=(-1.0, 1.0), **more)


def selected_of(cut: LightCut, block: int) -> Any:
    return cut.selected[cut.starts[block] : cut.starts[block + 1]]


def by_cut(cut: LightCut, receivers: NDArray[Any], triangles: Any = None) -> Any:
    """Return the irradiance (strips, n) by the selected segments of each block."""
    strips, count, _ = receivers.shape
    irradiance = np.zeros((strips, count))
    of_strip = -(-count // BLOCK)
    for block in range(strips * of_strip):
        selected = selected_of(cut, block)
        segments = cut.segments[np.where(selected < 0, ~selected, selected)]
        here = block // of_strip, slice(block % of_strip * BLOCK, block % of_strip * BLOCK + BLOCK)
        if len(selected):
            light = reference.pair_irradiance(receivers[here], segments)
            if triangles is not None:
                seen = reference.visibility(receivers[here], segments, triangles)
                light = light * np.where(selected < 0, 1.0, seen)
            irradiance[here] = light.sum(axis=1)
    return irradiance


def off_by(cut: LightCut, receivers: Any, weights: Any, reading: StripErrorModel, segments: Any) -> Any:
    everything = reference.pair_irradiance(receivers.reshape(-1, 6), segments).sum(axis=1).reshape(receivers.shape[:2])
    readings = [
        reference.mean_position(reading.power, reading.moment, weights, light)
        for light in (everything, by_cut(cut, receivers))
    ]
    return SLOPE * np.abs(readings[0] - readings[1])


@pytest.mark.double
@TWO_WAYS
@given(rng=PLACES, exponent=st.floats(-8.0, -3.0), count=st.integers(1, 40))
@ON_DEVICES
def test_bounds_hold(device: Device, variant: Any, rng: Any, exponent: float, count: int) -> None:
    segments, receivers, weights, reading = (
        random_segments(rng, count),
        random_strips(rng),
        weights_of(rng),
        reading_of(rng),
    )
    tolerance = 10.0**exponent
    cut = LightClustering(tolerance=tolerance, variant=variant)(segments, receivers, weights, reading, device=device)
    error = off_by(cut, receivers, weights, reading, segments)
    assert np.all(error <= cut.bound + 1e-15)
    assert np.all(cut.bound <= tolerance)
    everything = dataclasses.replace(cut, selected=cut.selected[:0], starts=0 * cut.starts)
    assert np.all(off_by(everything, receivers, weights, reading, segments) <= cut.bound_if_omitted + 1e-15)


@given(rng=PLACES, count=st.integers(2, 24), distance=st.floats(1.2, 20.0), turned=st.floats(0.0, 0.7))
@ANYWHERE
def test_a_cluster_is_off_by_its_bound_at_most(rng: Any, count: int, distance: float, turned: float) -> None:
    """The error of a cluster is within its bound wherever cluster and receiver face each other completely."""
    segments = random_segments(rng, count, spread=0.02, length=0.01)
    along = segments[:, 3:6] - segments[:, :3]
    normal = np.array([0.0, 0.0, 1.0]) + turned * rng.uniform(-1.0, 1.0, (count, 3))
    segments[:, 6:9] = normal - along * (np.sum(normal * along, axis=1) / np.sum(along * along, axis=1))[:, None]
    tree = LightTree.build(segments)
    row, aggregate = tree.rows[1], tree.representatives[1:2]
    assume(np.isfinite(row[22]))
    direction = rng.normal(size=(50, 3))
    place = row[:3] + distance * row[12] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    receivers = np.hstack([place, row[:3] - place + 0.1 * row[12] * rng.normal(size=(50, 3))])
    ends = segments[:, :6].reshape(-1, 3)
    facing = np.all(np.einsum("nk,nmk->nm", receivers[:, 3:], ends - place[:, None]) > 0.0, axis=1)
    lit = np.repeat(segments[:, 6:9], 2, axis=0)
    facing &= np.all(np.sum(lit * (place[:, None] - ends), axis=2) > 0.0, axis=1)
    far = np.linalg.norm(place - row[:3], axis=1)
    q, arm = row[12] / far, row[22] / far
    with np.errstate(all="ignore"):
        bound = row[18] / far**3 + row[19] / far**4 + row[20] * (4 - 3 * q) / (1 - q) ** 2 / far**5
        bound = row[17] * (bound + row[21] * (5 - 4 * arm) / (1 - arm) ** 2 / far**6) / np.pi
    light = reference.pair_irradiance(receivers, segments).sum(axis=1)
    error = np.abs(light - reference.pair_irradiance(receivers, aggregate)[:, 0])
    good = facing & (q < 1.0) & (arm < 1.0)
    assume(good.any())
    assert np.all(error[good] <= bound[good] * (1.0 + 1e-9))


def test_a_cluster_keeps_the_power_of_segments_side_by_side() -> None:
    x = np.linspace(0.0, 0.1, 9)
    ends = np.zeros((8, 2, 3))
    ends[:, 0, 0], ends[:, 1, 0] = x[:-1], x[1:]
    segments = np.hstack([ends.reshape(8, 6), np.tile([0.0, 0.0, 3.0], (8, 1)), np.full((8, 1), 2.0)])
    tree = LightTree.build(segments)
    np.testing.assert_allclose(tree.representatives[1], [0, 0, 0, 0.1, 0, 0, 0, 0, 1, 2.0], atol=1e-12)
    assert tree.power == pytest.approx(0.2)


@pytest.mark.double
@TWO_WAYS
def test_tolerance_zero_leaves_out_nothing_that_shines(device: Device, variant: Any) -> None:
    rng = np.random.default_rng(3)
    segments, receivers, weights = random_segments(rng, 30), random_strips(rng), weights_of(rng)
    cut = LightClustering(tolerance=0.0, variant=variant)(segments, receivers, weights, reading_of(rng), device=device)
    assert cut.counts["clustered"] == 0
    assert not cut.bound.any()
    used = weights.any(axis=2)
    everything = reference.pair_irradiance(receivers.reshape(-1, 6), segments).sum(axis=1).reshape(used.shape)
    np.testing.assert_allclose(by_cut(cut, receivers)[used], everything[used], rtol=1e-12, atol=1e-15)


def valley(count: int, strips: int, each: int) -> tuple[Any, Any, Any, StripErrorModel]:
    """Return a lit line into and out of a groove of 90 degrees, and strips across it."""
    x = np.linspace(-0.1, 0.1, count + 1)
    ends = np.zeros((count, 2, 3))
    ends[:, 0, 0], ends[:, 1, 0] = x[:-1], x[1:]
    ends[..., 2] = np.abs(ends[..., 0])
    side = np.sign(0.5 * (x[1:] + x[:-1]))
    normal = np.column_stack([-side, 0.0 * side, np.ones(count)])
    segments = np.hstack([ends.reshape(count, 6), normal, np.full((count, 1), 1e-3)])
    at, across = (np.arange(strips) + 0.5) / strips * 0.2 - 0.1, (np.arange(each) + 0.5) / each * 0.06 - 0.03
    X, Y = np.meshgrid(at, across, indexing="ij")
    receivers = np.stack([X, Y, np.abs(X), -np.sign(X), 0.0 * X, 1.0 + 0.0 * X], axis=2)
    power = np.full((strips, each), 1e-4)
    weights = np.stack([power, power * Y], axis=2) * 0.012 / (strips * each)
    direct = np.full(strips, 2e-8 / strips * 100.0)
    reading = StripErrorModel(power=direct, moment=0.0 * direct, slope=np.ones(strips), limits=(-0.03, 0.03))
    return segments, receivers, weights, reading


def planes(*, wall: bool = False) -> Scene:
    """Return the groove as four triangles, and a wall in it."""
    a, b, c, d, e, f = ([x, y, abs(x)] for y in (-0.05, 0.05) for x in (-0.12, 0.0, 0.12))
    corners = [[a, b, e], [a, e, d], [b, c, f], [b, f, e]]
    if wall:
        corners += [[[0.0, -0.05, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.08]]]
    return Scene(np.array(corners))


@pytest.mark.double
@TWO_WAYS
def test_work_falls_as_the_tolerance_rises(device: Device, variant: Any) -> None:
    segments, receivers, weights, reading = valley(64, 8, 64)
    clustering, works = LightClustering(tolerance=1.0, scene=planes(), variant=variant), []
    for tolerance in (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 0.1):
        cut = clustering(segments, receivers, weights, reading, tolerance=tolerance, device=device)
        works.append(cut.counts["work"])
        assert np.all(cut.bound <= tolerance)
        assert cut.counts["exact"] + cut.counts["clustered"] + cut.counts["left out"] == cut.counts["pairs"]
        assert cut.tolerance == tolerance
    assert works == sorted(works, reverse=True)
    assert works[0] > 4 * works[3]
    assert works[-1] == 0
    assert not cut.has_pairs


@pytest.mark.double
@TWO_WAYS
def test_far_light_is_one_cluster_for_each_wall(device: Device, variant: Any) -> None:
    """At 50 times its size, light that cannot be left out is replaced by one segment for each wall of the groove."""
    segments, _, weights, reading = valley(32, 1, 40)
    segments[:, :6] *= 0.1
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 8), np.linspace(-0.03, 0.03, 5))
    place = np.stack([x, y, np.full_like(x, 1.0)], axis=2).reshape(1, -1, 3)
    receivers = np.concatenate([place, np.broadcast_to([0.0, 0.0, -1.0], place.shape)], axis=2)
    clustering = LightClustering(tolerance=0.0, variant=variant)
    least = clustering(segments, receivers, weights, reading, device=device).bound_if_omitted.max()
    cut = clustering(segments, receivers, weights, reading, tolerance=1e-2 * least, device=device)
    assert np.all(off_by(cut, receivers, weights, reading, segments) <= cut.bound)
    assert cut.counts["clustered"] == cut.counts["pairs"]
    assert cut.counts["work"] == 2 * receivers.shape[1]


@pytest.mark.double
@TWO_WAYS
def test_a_strip_that_rises_through_the_plane_of_the_light_is_lit(device: Device, variant: Any) -> None:
    """Its middle lies behind the plane of the lit segment, its normal is perpendicular to that of the segment."""
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        lit, facing = (np.array([side, 0.0, 1.0])[axes] / np.sqrt(2.0) for side in (1.0, -1.0))
        along = np.cross(lit, facing)
        place = 0.1 * -facing + np.linspace(-0.031, 0.02, BLOCK)[:, None] * lit
        receivers = np.concatenate([place, np.broadcast_to(facing, place.shape)], axis=1)[None]
        segments = np.concatenate([-0.002 * along, 0.002 * along, lit, [1.0]])[None]
        weights = np.stack([np.full(BLOCK, 1e-3), np.linspace(0.0, 1e-3, BLOCK)], axis=1)[None]
        reading = StripErrorModel(power=[1.0], moment=[0.0], slope=[SLOPE], limits=(-1.0, 1.0))
        cut = LightClustering(tolerance=0.0, variant=variant)(segments, receivers, weights, reading, device=device)
        light = reference.pair_irradiance(receivers[0], segments)[:, 0]
        np.testing.assert_array_equal(light > 0.0, place @ lit > 0.0)
        np.testing.assert_allclose(by_cut(cut, receivers)[0], light, rtol=1e-12)
        least = reference.mean_position(reading.power, reading.moment, weights, light[None])
        assert cut.bound_if_omitted[0] >= SLOPE * abs(least[0]) > 0.0


@pytest.mark.double
@TWO_WAYS
def test_a_roof_over_an_end_of_a_cluster_is_seen(device: Device, variant: Any) -> None:
    """The edge of the roof, of either winding and on either side, passes over the lit line off its middle."""
    _, _, weights, reading = valley(32, 1, 40)
    ends = np.linspace(-0.004, 0.004, 33)
    places = np.zeros((32, 2, 3))
    places[:, :, 0] = np.stack([ends[:-1], ends[1:]], axis=1)
    segments = np.hstack([places.reshape(-1, 6), np.tile([0.0, 0.0, 1.0, 1.0], (32, 1))])
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 8), np.linspace(-0.03, 0.03, 5))
    place = np.stack([x, y, np.full_like(x, 1.0)], axis=2).reshape(1, -1, 3)
    receivers = np.concatenate([place, np.broadcast_to([0.0, 0.0, -1.0], place.shape)], axis=2)
    free = LightClustering(tolerance=0.0, variant=variant)(segments, receivers, weights, reading, device=device)
    for side in (-1.0, 1.0):
        for edge in (-0.002, 0.001, 0.003):
            roof = np.array([[[edge, -0.5, 0.02], [edge, 0.5, 0.02], [side, 0.0, 0.02]]])
            for triangles in (roof, roof[:, ::-1]):
                clustering = LightClustering(
                    tolerance=1e-2 * free.bound_if_omitted.max(), scene=Scene(triangles), variant=variant
                )
                cut = clustering(segments, receivers, weights, reading, device=device)
                seen = reference.visibility(receivers.reshape(-1, 6), segments, triangles)
                light = reference.pair_irradiance(receivers.reshape(-1, 6), segments)
                assert 0.0 < np.sum(seen * light) < 0.95 * np.sum(light)
                sums = np.sum(seen * light, axis=1).reshape(receivers.shape[:2]), by_cut(cut, receivers, triangles)
                exact, ours = (reference.mean_position(reading.power, reading.moment, weights, each) for each in sums)
                assert np.all(SLOPE * np.abs(exact - ours) <= cut.bound + 1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_scene", [False, True])
def test_bounds_hold_far_from_the_origin(device: Device, dtype: Any, with_scene: bool) -> None:
    """Positions are rounded relative to the centre of the scene: details of micrometres in a scene of metres."""
    rng = np.random.default_rng(8)
    segments, receivers, weights, reading = (
        random_segments(rng, 20),
        random_strips(rng),
        weights_of(rng),
        reading_of(rng),
    )
    segments[:10, 3:6] = segments[:10, :3] + 1e-3 * (segments[:10, 3:6] - segments[:10, :3])
    segments[:, :6] += 7.0
    receivers[..., :3] += 7.0
    # Far below the scene: it does not occlude.
    scene = Scene(np.array([[[0.0, 0.0, 0.0], [14.0, 0.0, 0.0], [14.0, 14.0, 0.0]]])) if with_scene else None
    given = receivers.astype(dtype)
    cut = LightClustering(tolerance=1e-8, scene=scene)(segments, given, weights, reading, device=device)
    assert 0 < cut.counts["work"] < cut.counts["pairs"]
    assert np.all(cut.bound <= 1e-8)
    assert np.all(off_by(cut, given.astype(float), weights, reading, segments) <= cut.bound + 1e-13)


@pytest.mark.double
@TWO_WAYS
def test_nothing_hides_in_an_empty_groove(device: Device, variant: Any) -> None:
    """The walls of the groove are within the hulls, but never between a receiver and a lit line."""
    segments, receivers, weights, reading = valley(32, 4, 32)
    clustering = LightClustering(tolerance=0.0, scene=planes(), variant=variant)
    cut = clustering(segments, receivers, weights, reading, device=device)
    assert cut.counts["exact"] == cut.counts["clear"] > 0


def pyramids(rng: np.random.Generator, count: int) -> Any:
    """Return the triangles of pyramids on the floor z = 0."""
    base = rng.uniform(-0.1, 0.1, (count, 1, 3)) * [1.0, 1.0, 0.0]
    turn = rng.uniform(0.0, np.pi, (count, 1)) + np.array([0.0, 2.1, 4.2])
    feet = base + 0.03 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=2)
    top = np.broadcast_to(base + rng.uniform(0.01, 0.06, (count, 1, 1)) * [0.0, 0.0, 1.0], feet.shape)
    return np.stack([feet, np.roll(feet, -1, axis=1), top], axis=2).reshape(-1, 3, 3)


def on_triangles(rng: np.random.Generator, triangles: Any, count: int) -> tuple[Any, Any]:
    """Return points on triangles, in pairs close to each other, and upward normals."""
    number = rng.integers(len(triangles), size=count)
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=(count, 2)) * 0.9 + 1.0 / 30.0
    corners = triangles[number]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal *= np.sign(normal[:, 2:])
    return np.einsum("nek,nkx->nex", weights, corners), normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.double
@TWO_WAYS
@given(rng=PLACES, exponent=st.floats(-7.0, -4.0))
@ON_DEVICES
def test_what_is_clear_is_seen(device: Device, variant: Any, rng: Any, exponent: float) -> None:
    triangles = pyramids(rng, 5)
    ends, normals = on_triangles(rng, triangles, 24)
    segments = np.hstack([ends.reshape(-1, 6), normals, np.ones((len(ends), 1))])
    first, up = on_triangles(rng, triangles, STRIPS)
    part = np.linspace(0.0, 1.0, COUNT)[:, None]
    place = first[:, :1] + part * (first[:, 1:] - first[:, :1])
    receivers = np.concatenate([place, np.broadcast_to(up[:, None], place.shape)], axis=2)
    weights, reading = weights_of(rng), reading_of(rng)
    clustering = LightClustering(tolerance=10.0**exponent, scene=Scene(triangles), variant=variant)
    cut = clustering(segments, receivers, weights, reading, device=device)
    seen = reference.visibility(receivers.reshape(-1, 6), segments, triangles).reshape(STRIPS, COUNT, -1)
    light = reference.pair_irradiance(receivers.reshape(-1, 6), segments).reshape(seen.shape)
    of_strip = -(-COUNT // BLOCK)
    for block in range(STRIPS * of_strip):
        selected = selected_of(cut, block)
        clear = [~pick for pick in selected if pick < 0 and ~pick < len(segments)]
        here = block // of_strip, slice(block % of_strip * BLOCK, block % of_strip * BLOCK + BLOCK)
        used = weights[here].any(axis=1)
        hidden = (seen[here] < 1.0) & (light[here] > 1e-9 * light.max())
        assert not np.any(hidden[used][:, clear])
    exact = reference.mean_position(reading.power, reading.moment, weights, np.sum(seen * light, axis=2))
    ours = reference.mean_position(reading.power, reading.moment, weights, by_cut(cut, receivers, triangles))
    assert np.all(SLOPE * np.abs(exact - ours) <= cut.bound + 1e-15)


@pytest.mark.double
@TWO_WAYS
def test_a_wall_in_the_groove_is_seen(device: Device, variant: Any) -> None:
    segments, receivers, weights, reading = valley(32, 4, 32)
    clustering = LightClustering(tolerance=1e-5, scene=planes(wall=True), variant=variant)
    cut = clustering(segments, receivers, weights, reading, device=device)
    assert cut.counts["exact"] > cut.counts["clear"]


def test_dark_strips_get_all_and_those_below_the_floor_what_they_need() -> None:
    rng = np.random.default_rng(5)
    segments, receivers, weights = random_segments(rng, 30), random_strips(rng), weights_of(rng)
    dark = StripErrorModel(
        power=np.array([0.0, 1.0, 1.0]), moment=np.zeros(3), slope=np.full(3, SLOPE), limits=(-1.0, 1.0)
    )
    cut = LightClustering(tolerance=1e-4)(segments, receivers, weights, dark)
    exact = LightClustering(tolerance=0.0)(segments, receivers, weights, dark)
    of_strip = -(-COUNT // BLOCK)
    assert cut.starts[of_strip] == exact.starts[of_strip]
    assert cut.starts[-1] < exact.starts[-1]
    assert cut.bound[0] == 0.0
    floored = LightClustering(tolerance=1e-4)(segments, receivers, weights, dataclasses.replace(dark, min_power=1.0))
    assert floored.starts[of_strip] < exact.starts[of_strip]


def test_receivers_without_weight_and_no_receivers_do_not_count() -> None:
    rng = np.random.default_rng(6)
    segments, receivers, weights, reading = (
        random_segments(rng, 9),
        random_strips(rng),
        weights_of(rng),
        reading_of(rng),
    )
    weights[0], receivers[1, :, 3:], receivers[0, 3] = 0.0, 0.0, np.nan
    cut = LightClustering(tolerance=0.0)(segments, receivers, weights, reading)
    of_strip = -(-COUNT // BLOCK)
    assert cut.starts[2 * of_strip] == 0
    assert cut.starts[-1] > 0


def test_tables_are_padded() -> None:
    segments, receivers, weights, reading = valley(40, 4, 32)
    cut = LightClustering(tolerance=1e-5)(segments, receivers, weights, reading)
    rows, starts, selected = cut.padded_tables(np.float32, segments=100, selected=10)
    assert rows.shape == (128, 10)
    assert rows.dtype == np.float32
    assert len(selected) >= len(cut.selected)
    assert len(selected).bit_count() == 1
    assert starts[-1] == len(cut.selected)
    assert not rows[len(cut.segments) :, 9].any()
    used = np.where(cut.selected < 0, ~cut.selected, cut.selected)
    assert used.max() < len(cut.segments)
    report = cut.report()
    assert report["clusters"] == len(cut.segments) - 40
    assert report["bound"] <= 1e-5
    assert report["has pairs"] is True


def test_position_of_the_direct_light() -> None:
    """The mean within the limits; the middle of the limits without direct light."""
    reading = StripErrorModel(
        power=[2.0, 1.0, 1.0, 0.0], moment=[0.8, 0.9, 0.1, 0.0], slope=[1e-3, 1e-3, -2e-3, 1.0], limits=(0.2, 0.6)
    )
    np.testing.assert_allclose(reading.position, [0.4, 0.6, 0.2, 0.4], rtol=1e-15)
    np.testing.assert_allclose(reading.max_error(), [0.4e-3, 0.4e-3, 0.8e-3, 0.4], rtol=1e-12)


def test_error_by_light_at_a_receiver() -> None:
    """Power 0.1 at u = 0.2 beside power 2 at 0.5: 0.1 (0.2 - x) / 2, with the farthest x that the limits allow."""
    strip: dict[str, Any] = {"power": [2.0], "moment": [1.0], "slope": [-1e-3], "limits": (-1.0, 1.0)}
    weights = np.array([[[0.1, 0.02], [0.0, 0.0]]])
    for more, expected in (({}, 0.12 / 2), ({"max_shift": 0.1}, 0.04 / 2), ({"min_power": 4.0}, 0.12 / 4)):
        error = StripErrorModel(**strip, **more).error_per_irradiance(weights)
        np.testing.assert_allclose(error, [[1e-3 * expected, 0.0]], rtol=1e-12)
    dark = StripErrorModel(**{**strip, "power": [0.0], "moment": [0.0]}).error_per_irradiance(weights)
    np.testing.assert_array_equal(dark, [[np.inf, 0.0]])


def test_worst_is_reached_by_light_at_the_other_limit() -> None:
    reading = StripErrorModel(power=np.ones(1), moment=-np.ones(1), slope=np.full(1, SLOPE), limits=(-1.0, 1.0))
    assert reading.error_bound(0.25)[0] == pytest.approx(SLOPE * 2.0 * 0.25 / 1.25)
    assert reading.error_bound(np.inf)[0] == pytest.approx(SLOPE * 2.0)
    assert reading.error_bound(0.0)[0] == 0.0


def test_paths_with_the_least_bounds_are_left_out() -> None:
    choice = select_paths({"specular": 0.0, "mirrors": [1e-7, 2e-7], "multi-bounce": 1.5e-6, "diffuse": np.inf}, 4e-6)
    assert choice.omitted == {"specular": 0.0, "mirrors": 2e-7, "multi-bounce": 1.5e-6}
    assert choice.modelled == {"diffuse": None}
    assert choice.remaining_tolerance == pytest.approx(2.3e-6)
    assert select_paths({"specular": 0.0, "multi-bounce": 1e-9}, 0.0).omitted == {"specular": 0.0}


def test_paths_are_left_out_up_to_half_the_tolerance() -> None:
    """The other half is left for the paths that are computed, so that both together stay within the tolerance."""
    assert select_paths({"mirrors": 2.0}, 4.0).omitted == {"mirrors": 2.0}
    assert select_paths({"mirrors": 2.1}, 4.0) == ({"mirrors": 2.1}, {}, 4.0)
    assert select_paths({"mirrors": 1.5, "multi-bounce": 1.0}, 4.0) == ({"mirrors": 1.5}, {"multi-bounce": 1.0}, 3.0)


def test_bounces_sum_to_a_geometric_series() -> None:
    assert interreflection_power_bound(2.0, 0.5, 0.1) == pytest.approx(
        2.0 * sum(0.5**k for k in range(1, 60)) * 0.5 / np.pi * 0.1
    )
    assert interreflection_power_bound(1.0, 1.0, 0.1) == np.inf
    assert interreflection_power_bound(1.0, 0.0, 0.1) == 0.0
    with pytest.raises(ValueError, match="albedo"):
        interreflection_power_bound(1.0, 1.5, 0.1)


def test_wrong_input_is_refused() -> None:
    segments, receivers, weights, reading = valley(4, 2, 16)
    with pytest.raises(ValueError, match="tolerance"):
        LightClustering(tolerance=-1.0)
    with pytest.raises(ValueError, match=r"weights \(strips, n, 2\)"):
        LightClustering(tolerance=0.0)(segments, receivers, weights[..., 0], reading)
    with pytest.raises(ValueError, match=r"segments \(m, 10\)"):
        LightClustering(tolerance=0.0)(segments[:, :9], receivers, weights, reading)
    with pytest.raises(ValueError, match="limits"):
        dataclasses.replace(reading, limits=(1.0, 1.0))
    with pytest.raises(ValueError, match="slope"):
        dataclasses.replace(reading, slope=np.ones(3))


def test_no_segments_need_nothing() -> None:
    _, receivers, weights, reading = valley(4, 2, 16)
    cut = LightClustering(tolerance=0.0)(np.zeros((0, 10)), receivers, weights, reading)
    assert not cut.has_pairs
    assert cut.counts["pairs"] == 0
