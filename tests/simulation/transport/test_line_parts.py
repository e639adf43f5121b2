"""Parts of lit segments: projection to the sensor, clipping to the view, division at edges, against single points."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LitLine
from gpuvision.simulation.transport.line_parts import (
    LineProjector,
    Parts,
    concatenate_parts,
    parts_within_radius,
    points_on,
    whole_parts,
)
from sensor_views import sensor_view

TRANSPORT = 2e-3
LENSES = {
    "none": None,
    "barrel": Lens(k1=-6e3, centre=(4e-4, -3e-4)),  # folds at 7.5 mm, the image of 5 mm
    "pincushion": Lens(k1=3e3, centre=(-5e-4, 2e-4)),
}


def segments(rng: np.random.Generator, count: int = 25, sizes: tuple[float, ...] = (2e-3, 0.02, 0.4)) -> np.ndarray:
    """Return segments around the sheet; of the largest some leave the image, or end behind the lens."""
    middle = rng.uniform([-0.02, -0.02, -0.015], [0.02, 0.02, 0.02], (count, 3))
    half = rng.normal(size=(count, 3)) * rng.choice(sizes, (count, 1))
    return np.stack([middle - half, middle + half], axis=1)


def images(view: Any, ends: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return (u, v) of the points at fractions of one segment."""
    return np.asarray(view.project(ends[0] + share[:, None] * (ends[1] - ends[0]), TRANSPORT))


@pytest.mark.parametrize("lens", LENSES)
def test_points_and_their_motion_are_imaged_as_by_the_sensor(lens: str, rng: np.random.Generator) -> None:
    view, ends = sensor_view(tilt=0.2, distortion=LENSES[lens]), segments(rng)
    lines = LineProjector(view).project(ends, TRANSPORT)
    segment, share = np.tile(np.arange(len(ends)), 4), rng.random(4 * len(ends))
    points = points_on(ends[segment], share)
    expected = view.project(points, TRANSPORT)
    seen = np.isfinite(expected).all(axis=1)
    assert 0.3 < seen.mean() < 1.0
    found = lines.image_points(segment, share)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-9, atol=1e-12)
    near = seen & (np.abs(expected) < 8e-3).all(axis=1)
    assert near.sum() > 20
    moved = 1e-3 * rng.normal(size=(len(segment), 3))
    ahead, behind = (view.project(points + step * moved, TRANSPORT)[:, 0] for step in (1e-5, -1e-5))
    rates = lines.u_rates(segment[near], share[near], expected[near], moved[near])
    np.testing.assert_allclose(rates, ((ahead - behind) / 2e-5)[near], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_clipped_parts_are_those_that_the_sensor_images(lens: str, rng: np.random.Generator) -> None:
    view, ends = sensor_view(tilt=0.2, distortion=LENSES[lens]), segments(rng, 30)
    count = len(ends)
    lines = LineProjector(view).project(ends, TRANSPORT)
    start, end = np.where(np.arange(count) % 3 == 0, 0.25, 0.0), np.where(np.arange(count) % 4 == 0, 0.5, 1.0)
    parts = lines.clip_to_view(Parts(np.arange(count), start, end, np.ones(count, bool)))
    assert np.all(parts.start < parts.end)
    assert np.any(end[parts.segment] > parts.end)
    share = (np.arange(200) + 0.5) / 200
    kept = 0
    for number in range(count):
        mine = parts.segment == number
        expected = np.isfinite(images(view, ends[number], share)).all(axis=1)
        expected &= (share > start[number]) & (share < end[number])
        inside = (share[:, None] > parts.start[mine]) & (share[:, None] < parts.end[mine])
        assert np.all(inside.sum(axis=1) <= 1)
        # A place within a step of an end may be on either side.
        near = (
            np.abs(share[:, None] - np.concatenate([parts.start[mine], parts.end[mine], [2.0]])).min(axis=1) < 1 / 200
        )
        np.testing.assert_array_equal(inside.any(axis=1)[~near], expected[~near])
        kept += int(expected.sum())
    assert 0.2 * share.size * count < kept < 0.8 * share.size * count


@pytest.mark.parametrize("lens", LENSES)
def test_the_ends_of_clipped_parts_are_the_limits_of_the_image(lens: str, rng: np.random.Generator) -> None:
    """A millionth of the segment inside an end has an image, a millionth outside has none; other ends stay as given."""
    view, ends = sensor_view(tilt=0.2, distortion=LENSES[lens]), segments(rng, 60)
    count = len(ends)
    start, end = rng.uniform(0.0, 0.3, count), rng.uniform(0.7, 1.0, count)
    parts = (
        LineProjector(view)
        .project(ends, TRANSPORT)
        .clip_to_view(Parts(np.arange(count), start, end, rng.random(count) < 0.5))
    )
    clipped = 0
    for segment, first, last, _ in zip(*parts, strict=True):
        assert first == start[segment] or first > start[segment] + 1e-9
        assert last == end[segment] or last < end[segment] - 1e-9
        for place, given, inwards in ((first, start[segment], 1e-6), (last, end[segment], -1e-6)):
            inside, outside = np.isfinite(images(view, ends[segment], place + np.array([inwards, -inwards]))).all(
                axis=1
            )
            assert inside
            assert not outside or place == given
            clipped += place != given
    assert clipped > 10
    kept = (parts.start == start[parts.segment]) & (parts.end == end[parts.segment])
    assert kept.sum() > 10


@pytest.mark.parametrize(
    ("lens", "axis"),
    [
        (None, 0),
        (None, 1),
        (Lens(k1=-400.0, k2=2e6, centre=(4e-4, -3e-4)), 0),
        (Lens(k1=300.0, centre=(-5e-4, 2e-4)), 1),
    ],
)
def test_each_part_is_in_one_bin(lens: Lens | None, axis: int, rng: np.random.Generator) -> None:
    """The cuts are at the edges, to rounding, and all parts together are the points within the outer edges.

    Of segments whose images turn back, which distortion makes of lines along an edge, this is not asked.
    """
    view, ends = sensor_view(tilt=0.2, distortion=lens), segments(rng, 40, (2e-3, 8e-3))
    edges, share = (view.u_edges, view.v_edges)[axis], (np.arange(100) + 0.5) / 100
    steps = [np.diff(images(view, each, share)[:, axis]) for each in ends]
    ends = ends[[not (np.any(each > 0.0) and np.any(each < 0.0)) for each in steps]]
    count = len(ends)
    assert count > 20
    lines = LineProjector(view).project(ends, TRANSPORT)
    whole = lines.clip_to_view(Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool)))
    parts = lines.split_at_edges(whole, edges, axis)
    assert len(parts.segment) > 50
    places = lines.image_points(parts.segment, np.stack([parts.start, parts.end]))[..., axis]
    middle = lines.image_points(parts.segment, 0.5 * (parts.start + parts.end))[:, axis]
    number = np.searchsorted(edges, middle) - 1
    rounding = (1e-12 if lens is None else 1e-8) * (edges[-1] - edges[0])
    assert np.all((places >= edges[number] - rounding) & (places <= edges[number + 1] + rounding))
    is_cut = ~np.isin(np.stack([parts.start, parts.end]), np.concatenate([whole.start, whole.end]))
    assert is_cut.sum() > 50
    assert np.abs(edges - places[is_cut][:, None]).min(axis=1).max() < rounding
    for segment in range(count):
        mine, of_whole = parts.segment == segment, whole.segment == segment
        place = images(view, ends[segment], share)[:, axis]
        with np.errstate(invalid="ignore"):
            expected = (place > edges[0]) & (place < edges[-1])
        expected &= ((share[:, None] > whole.start[of_whole]) & (share[:, None] < whole.end[of_whole])).any(axis=1)
        inside = ((share[:, None] > parts.start[mine]) & (share[:, None] < parts.end[mine])).sum(axis=1)
        cut = np.concatenate([parts.start[mine], parts.end[mine], [2.0]])
        near = np.abs(share[:, None] - cut).min(axis=1) < 1e-6
        np.testing.assert_array_equal(inside[~near], expected[~near])


def camera_view() -> SensorView:
    """Return the view of a camera with distortion, 160 mm from the sheet; rows are u, columns v."""
    lens = np.array([0.01, 0.08, 0.14])
    z = -lens / np.linalg.norm(lens)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    camera = Camera(
        matrix=((900.0, 0.0, 60.0), (0.0, 880.0, 35.0), (0.0, 0.0, 1.0)),
        distortion=(-0.6, 0.3, 0.01, -0.02, *(0.0,) * 10),
    )
    triangulation = Triangulation.from_camera(
        camera, rotation, -rotation @ lens, along="columns", region=((0.0, 89.0), (0.0, 159.0))
    )
    return SensorView(
        triangulation=triangulation,
        transport=StraightTransport(),
        lens=lens,
        u_edges=np.linspace(-0.5, 89.5, 10),
        v_edges=np.linspace(-0.5, 159.5, 6),
    )


def test_a_camera_images_the_points_around_its_sensor(rng: np.random.Generator) -> None:
    """All points on the sensor are in the parts; none is beyond 1.01 of the circle around the undistorted sensor."""
    view = camera_view()
    edges = np.stack(np.meshgrid(view.u_edges[[0, -1]], np.linspace(-0.5, 159.5, 65)), axis=-1).reshape(-1, 2)
    more = np.stack(np.meshgrid(np.linspace(-0.5, 89.5, 65), view.v_edges[[0, -1]]), axis=-1).reshape(-1, 2)
    border = view.triangulation.distortion.undistort(np.concatenate([edges, more]))
    centre = 0.5 * (border.min(axis=0) + border.max(axis=0))
    radius = 1.01 * np.linalg.norm(border - centre, axis=1).max()
    ends = segments(rng, 40, (8e-3, 0.03))
    count = len(ends)
    lines = LineProjector(view).project(ends, TRANSPORT)
    parts = lines.clip_to_view(Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool)))
    share = (np.arange(200) + 0.5) / 200
    straight = replace(view, triangulation=replace(view.triangulation, camera=None))
    seen = kept = clipped = 0
    for number in range(count):
        mine = parts.segment == number
        place = images(view, ends[number], share)
        inside = ((share[:, None] > parts.start[mine]) & (share[:, None] < parts.end[mine])).any(axis=1)
        low, high = np.array([view.u_edges[0], view.v_edges[0]]), np.array([view.u_edges[-1], view.v_edges[-1]])
        on_sensor = ((place > low) & (place < high)).all(axis=1)
        assert inside[on_sensor].all()
        distance = np.linalg.norm(images(straight, ends[number], share) - centre, axis=1)
        near = np.abs(distance - radius) < 1e-3 * radius
        np.testing.assert_array_equal(inside[~near], (distance < radius)[~near])
        shown = np.full(on_sensor.sum(), number)
        np.testing.assert_allclose(lines.image_points(shown, share[on_sensor]), place[on_sensor], rtol=0, atol=1e-6)
        seen, kept, clipped = seen + on_sensor.sum(), kept + inside.sum(), clipped + np.count_nonzero(~inside)
    assert min(seen, kept - seen, clipped) > 200


@pytest.mark.parametrize("axis", [0, 1])
def test_parts_off_the_sensor_and_between_two_edges(axis: int) -> None:
    """Edges far from the image give no part; two edges around it give the whole part as it was."""
    view = sensor_view()
    lines = LineProjector(view).project(np.array([[[0.0, 0.0, 0.0], [1e-3, 2e-3, 1e-3]]]), 0.0)
    whole = Parts(np.array([0]), np.array([0.125]), np.array([0.75]), np.array([False]))
    low, high = np.sort(lines.image_points(np.zeros(2, int), np.array([0.125, 0.75]))[:, axis])
    kept = lines.split_at_edges(whole, np.array([low - 1e-4, high + 1e-4]), axis)
    assert [each.tolist() for each in kept] == [[0], [0.125], [0.75], [False]]
    for edges in ((high + 1e-4, high + 2e-4), (low - 2e-4, low - 1e-4)):
        assert len(lines.split_at_edges(whole, np.array(edges), axis).segment) == 0
    middle = 0.5 * (low + high)
    half = lines.split_at_edges(whole, np.array([low - 1e-4, middle]), axis)
    assert lines.image_points(half.segment, np.stack([half.start, half.end]).max(axis=0))[0, axis] <= middle + 1e-12
    assert half.visible.tolist() == [False]


def test_points_are_exact_at_both_ends() -> None:
    ends = np.array([[[0.1, 0.2, 0.3], [1e8, -1e8, 0.7]]])
    np.testing.assert_array_equal(points_on(ends, np.array([0.0])), ends[:, 0])
    np.testing.assert_array_equal(points_on(ends, np.array([1.0])), ends[:, 1])
    for share in (0.25, 0.5, 0.75):
        expected = (1.0 - share) * ends[:, 0] + share * ends[:, 1]
        np.testing.assert_allclose(points_on(ends, np.array([share])), expected, rtol=1e-12)


def test_parts_keep_their_order() -> None:
    line = LitLine(np.arange(12.0).reshape(2, 2, 3), np.zeros((2, 3)), np.arange(2), np.ones(2))
    whole = whole_parts(line)
    assert [each.tolist() for each in whole] == [[0, 1], [0.0, 0.0], [1.0, 1.0], [True, True]]
    part = Parts(np.array([1]), np.array([0.25]), np.array([0.5]), np.array([False]))
    np.testing.assert_array_equal(part.ends(line), [[[6.75, 7.75, 8.75], [7.5, 8.5, 9.5]]])
    both = concatenate_parts([part, whole])
    assert [each.tolist() for each in both] == [[1, 0, 1], [0.25, 0.0, 0.0], [0.5, 1.0, 1.0], [False, True, True]]
    assert [each.tolist() for each in both.select(np.array([2, 0]))] == [[1, 1], [0.0, 0.25], [1.0, 0.5], [True, False]]


def test_parts_within_a_radius_are_those_of_dense_points(rng: np.random.Generator) -> None:
    """Vectors and radii that vary linearly; a vector of constant length, a growing radius, and none inside."""
    count = 60
    start, end = rng.normal(size=(2, count, 2))
    low, high = rng.uniform(-0.2, 1.5, (2, count))
    start[0], end[0], low[0], high[0] = (0.6, 0.8), (0.6, 0.8), 0.5, 2.0
    start[1], end[1], low[1], high[1] = (0.0, 1.0), (0.0, 1.0), 1.5, 1.5
    start[2], end[2], low[2], high[2] = (3.0, 1.0), (-3.0, 1.0), 1.0, 1.0  # touches
    start[3], end[3], low[3], high[3] = (0.0, 2.0), (0.0, 4.0), 1.0, 3.0  # both grow alike
    start[4], end[4], low[4], high[4] = (0.0, 2.0), (0.0, 4.0), 2.5, 4.5
    start[5], end[5], low[5], high[5] = (-1.0, 0.0), (1.0, 0.0), 0.5, 0.5
    parts = parts_within_radius(start, end, low, high)
    assert np.all(parts.visible)
    share = (np.arange(2000) + 0.5) / 2000
    inside = np.zeros((count, share.size), int)
    for segment, first, last, _ in zip(*parts, strict=True):
        inside[segment] += (share > first) & (share < last)
    length = np.linalg.norm(start[:, None] + share[:, None] * (end - start)[:, None], axis=-1)
    margin = low[:, None] + share * (high - low)[:, None] - length
    near = np.abs(margin) < 1e-9
    np.testing.assert_array_equal(inside[~near], margin[~near] > 0.0)
    assert math.isclose(parts.start[parts.segment == 0][0], 1.0 / 3.0)
    np.testing.assert_allclose(np.stack(parts[1:3])[:, parts.segment == 5], [[0.25], [0.75]])
    assert not np.isin([2, 3], parts.segment).any()
