"""Scan lines of a view of the floor: where rulers lie on them, and which points are kept."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.image import estimate_pixel_noise
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.field.line_detection import (
    _find_stripes,
    _rays,
    _room,
    _Run,
    _runs,
    _scan_lines,
    _ScanLines,
    default_threshold,
    end_margin_px,
    place_rulers_along,
    stripe_ruler,
    unique_points,
)

FLAT = np.zeros((8, 8), np.uint8)


def test_rays_leave_the_blind_area_and_end_before_the_border() -> None:
    """An image of 100 x 60 px about (49.5, 29.5): rulers stay 3 px inside, at whole distances from the centre."""
    view = BoardView(scale=0.01, shape=(60, 100), pose=(0.0, 0.0, 0.0))
    starts, ends = _rays(view, 8, 0.055)
    turns = np.arange(8) * math.pi / 4
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    np.testing.assert_allclose(starts, [49.5, 29.5] + 5.5 * directions)
    # 46 px to the sides, 26 px up and down, and 37 px at 45 degrees, of which sqrt(2) 26.5 = 37.5 px are inside.
    far = np.array([46, 37, 26, 37, 46, 37, 26, 37])
    np.testing.assert_allclose(ends, [49.5, 29.5] + far[:, None] * directions)
    # Rays that do not reach beyond the blind area are left out, as are those that end at its border.
    for blind, count in ((0.25, 8), (0.26, 6), (0.365, 6), (0.375, 2), (0.46, 0)):
        assert len(_rays(view, 8, blind)[0]) == count


def test_rulers_cover_a_scan_line_from_end_to_end() -> None:
    """Rulers of 254 px see 234 px; stripes of 16 px, up to three times as wide, lie wholly on one: a hop of 186 px."""
    rulers = stripe_ruler(FLAT, 16.0, 5.0, None)
    assert (rulers.length, rulers.step_px, end_margin_px(rulers)) == (128, 2.0, 10.0)
    along = np.array([0.6, 0.8])
    starts = np.array([[10.0, 20.0], [5.0, 6.0], [1.0, 2.0]])
    ends = starts + np.array([[1000.0], [253.9], [260.0]]) * along
    pieces, path = place_rulers_along(starts, ends, rulers, 16.0)
    middles = [127.0, 313.0, 499.0, 685.0, 871.0, 873.0]
    expected = [*(starts[0] + each * along for each in middles), *(starts[2] + each * along for each in (127.0, 133.0))]
    np.testing.assert_allclose(pieces[:, :2], expected, rtol=1e-6)
    np.testing.assert_allclose(pieces[:, 2:], np.tile(along, (8, 1)), rtol=1e-6)
    assert path.tolist() == [0] * 6 + [2] * 2
    one, _ = place_rulers_along(np.zeros((1, 2)), np.array([[254.0, 0.0]]), rulers, 16.0)
    np.testing.assert_array_equal(one, [[127.0, 0.0, 1.0, 0.0]])
    # Wide stripes leave nothing of the hop: it is a quarter of the length at least.
    pieces, _ = place_rulers_along(starts[:1], starts[:1] + 400.0 * along, rulers, 80.0)
    np.testing.assert_allclose((pieces[:, :2] - starts[0]) @ along, [127.0, 190.5, 254.0, 273.0], rtol=1e-6)
    none, path = place_rulers_along(starts[1:2], ends[1:2], rulers, 16.0)
    assert (none.shape, none.dtype, path.shape) == ((0, 4), np.float32, (0,))


@pytest.mark.parametrize(("width", "step"), [(4.0, 1.0), (8.0, 1.0), (20.0, 2.5)])
def test_ruler_of_a_stripe(width: float, step: float) -> None:
    white = np.random.default_rng(3).normal(50.0, 4.0, (40, 50)).astype(np.float32)
    ruler = stripe_ruler(white, width, 7.0, None)
    expected = RulerEdges(
        threshold=7.0,
        length=128,
        width=3,
        step_px=step,
        smoothing_px=1.5 * step,
        polarity="rising",
        edge_selection="all",
        max_edges=8,
        pairs=True,
        spacing_px=(0.4 * width, 3.0 * width),
        noise=ruler.noise,
    )
    assert ruler == expected
    assert ruler.noise == pytest.approx(4.0, rel=0.15)
    # Three standard deviations of the smoothing, as a number of whole steps: 4.5 steps are 5.
    assert end_margin_px(ruler) == 5 * step
    assert end_margin_px(replace(ruler, smoothing_px=4.0 / 3.0 * step)) == 4 * step


def test_threshold_is_above_the_noise_and_a_part_of_the_range() -> None:
    ramp = np.tile(np.arange(101.0), (60, 1))
    # From the first to the 99th percentile: 1 to 99. A ramp has no noise.
    assert default_threshold(ramp) == pytest.approx(9.8)
    noisy = np.random.default_rng(5).normal(0.0, 3.0, (60, 80))
    assert default_threshold(noisy) == pytest.approx(4.0 * estimate_pixel_noise(noisy))
    assert default_threshold(noisy) == pytest.approx(12.0, rel=0.15)
    assert default_threshold(np.full((60, 80), 7.0)) == 1e-6


def test_points_of_overlapping_rulers_are_kept_once() -> None:
    """Nearer than half a line width on one scan line; points of two scan lines stay, and are sorted along them."""
    points = np.array([[3.0, 0.0], [1.0, 0.0], [1.24, 0.0], [1.5, 0.0], [3.25, 0.0], [3.0, 4.0], [3.0, 4.125]])
    path = np.array([1, 1, 1, 1, 2, 0, 0])
    kept = unique_points(points, path, np.hypot(*points.T), 0.5)
    # 0.25 is no duplicate; 1.5 is 0.26 from 1.24, which is one of 1.0.
    assert kept.tolist() == [5, 1, 3, 0, 4]
    assert unique_points(points[3:5], path[3:5], np.zeros(2), 8.0).tolist() == [0, 1]
    apart = np.array([[0.0, 0.0], [0.25, 0.0]])
    assert unique_points(apart, np.zeros(2), apart[:, 0], 0.5).tolist() == [0, 1]
    assert unique_points(apart, np.zeros(2), -apart[:, 0], 0.5 + 1e-9).tolist() == [1]
    assert unique_points(apart[:0], np.zeros(0), np.zeros(0), 0.5).tolist() == []


@pytest.mark.parametrize(
    ("cut", "length", "expected"),
    [
        ((True, True), 99.0, (0.0, 100.0, 4.0, 96.0)),
        ((True, True), 100.0, None),
        ((False, False), 110.0, (-7.0, 107.0, 0.0, 100.0)),
        ((False, False), 120.0, (-13.0, 107.0, 0.0, 100.0)),
        ((True, False), 105.0, (0.0, 107.0, 4.0, 100.0)),
        ((True, False), 120.0, (0.0, 120.0, 4.0, 100.0)),
        ((False, True), 120.0, (-20.0, 100.0, 0.0, 96.0)),
    ],
)
def test_rulers_go_beyond_a_part_where_the_image_does(cut: Any, length: float, expected: Any) -> None:
    run = _Run(np.array([10.0, 20.0]), np.array([70.0, 100.0]), 1, cut)
    found = _room(run, 4.0, 7.0, length)
    assert found == (None if expected is None else pytest.approx(expected, abs=2e-6 * length))


def test_stripes_are_those_between_the_ends_of_their_scan_lines() -> None:
    """Two scan lines of 100 and 50 px; rulers at 20 and 90 px of the first, and at 10 px of the second one."""
    along = np.array([[0.6, 0.8], [-1.0, 0.0]])
    start = np.array([[10.0, 20.0], [300.0, 40.0]])
    runs = [
        _Run(each, each + far * way, 0, (True, True))
        for each, far, way in zip(start, (100.0, 50.0), along, strict=True)
    ]
    lines = _ScanLines.of(runs, [(0.0, 100.0, 4.0, 96.0), (-3.0, 50.0, 0.0, 46.0)])
    np.testing.assert_allclose(lines.length, [100.0, 50.0])
    np.testing.assert_allclose(lines.direction, along)
    np.testing.assert_allclose(lines.at(2), [[12.4, 23.2], [300.0, 40.0]])
    np.testing.assert_allclose(lines.at(0), [[10.0, 20.0], [303.0, 40.0]])
    path = np.array([0, 0, 1])
    at = np.array([20.0, 90.0, 10.0])
    pieces = np.concatenate([start[path] + at[:, None] * along[path], along[path]], axis=1).astype(np.float32)
    position = np.array([[-20.5, 5.0], [9.75, 10.5], [np.nan, -10.0]], np.float32)
    edges: Any = SimpleNamespace(
        position=position, sigma=0.01 * np.arange(6, dtype=np.float32).reshape(3, 2), spacing=position * 0 + 6.0
    )
    edges.spacing[2, 1] = 9.0
    found = _find_stripes(edges, pieces, path, lines)
    # -0.5 px and 100.5 px are outside, 0 px is inside.
    np.testing.assert_allclose(found.away, [25.0, 99.75, 0.0], atol=1e-4)
    assert found.path.tolist() == [0, 0, 1]
    np.testing.assert_allclose(found.place, start[found.path] + found.away[:, None] * along[found.path], atol=1e-4)
    np.testing.assert_allclose(found.half, [[1.8, 2.4], [1.8, 2.4], [-4.5, 0.0]], atol=1e-6)
    np.testing.assert_allclose(found.sigma, [0.01, 0.02, 0.05])
    np.testing.assert_allclose(found.spacing, [6.0, 6.0, 9.0])


# 1.2 m above the floor, tilted by 35 degrees, at (0.3, -0.2) m of the robot, turned by 0.4 rad.
CAMERA = MountedCamera(
    height=1.2, tilt=math.radians(35.0), focal_px=150.0, centre_px=(99.5, 74.5), position=(0.3, -0.2), heading=0.4
)


def test_scan_lines_are_rays_from_below_the_camera_and_lines_across_them() -> None:
    """Within a range of 3 m; rays are spaced evenly in their angle below the camera, as are the lines across."""
    shape, lines = (150, 200), 7
    found = _scan_lines(CAMERA, shape, lines, 3.0)
    assert found.shape == (21, 512, 2)
    c, s = math.cos(0.4), math.sin(0.4)
    away = found - CAMERA.position
    ahead, left = away @ (c, s), away @ (-s, c)
    # What the image shows of the floor, on a dense grid.
    grid = np.stack(np.meshgrid(np.linspace(0, 199, 64), np.linspace(0, 149, 64)), axis=-1)
    on_floor = CAMERA.to_floor(grid).reshape(-1, 2) - CAMERA.position
    on_floor = on_floor[np.hypot(*on_floor.T) <= 3.0]
    far = np.hypot(*on_floor.T)
    bearing = np.arctan2(on_floor @ (-s, c), on_floor @ (c, s))
    rays = slice(0, lines)
    turns = np.linspace(bearing.min(), bearing.max(), 7)
    np.testing.assert_allclose(np.arctan2(left[rays], ahead[rays]), np.tile(turns[:, None], 512), atol=1e-12)
    below = np.arctan(np.hypot(ahead, left)[rays] / 1.2)
    ends = np.arctan(np.array([far.min(), far.max()]) / 1.2)
    np.testing.assert_allclose(below, np.tile(np.linspace(*ends, 512), (7, 1)))
    across = slice(lines, None)
    ends = np.arctan(np.array([(on_floor @ (c, s)).min(), (on_floor @ (c, s)).max()]) / 1.2)
    np.testing.assert_allclose(ahead[across], np.tile(1.2 * np.tan(np.linspace(*ends, 14))[:, None], 512), atol=1e-12)
    wide = on_floor @ (-s, c)
    np.testing.assert_allclose(left[across], np.tile(np.linspace(wide.min(), wide.max(), 512), (14, 1)), atol=1e-12)
    assert _scan_lines(CAMERA, shape, lines, 0.01).shape == (0, 512, 2)


def test_scan_lines_are_cut_where_the_width_doubles_and_at_the_border() -> None:
    """Each part has one octave of the width of a line across it, inside a border of 3 px."""
    shape, line_width = (150, 200), 0.1
    floors = _scan_lines(CAMERA, shape, 5, 3.0)
    runs = _runs(CAMERA, floors, shape, line_width)
    pixels = CAMERA.to_pixels(floors)
    steps, moves = np.gradient(pixels, axis=1), np.gradient(floors, axis=1)
    width = line_width * np.linalg.norm(steps, axis=-1) / np.linalg.norm(moves, axis=-1)
    expected: list[Any] = []
    for line in range(len(floors)):
        column, row = pixels[line].T
        inside = (column >= 3) & (column <= 196) & (row >= 3) & (row <= 146)
        pairs = zip(width[line], inside, strict=True)
        kinds = [math.floor(math.log2(w / 3.0)) if i and w >= 3.0 else -1 for w, i in pairs]
        first = 0
        for at in range(1, 513):
            if at < 512 and kinds[at] == kinds[first]:
                continue
            if kinds[first] >= 0 and at - first > 2:
                begins = first == 0 or kinds[first - 1] < 0
                ends = at == 512 or kinds[at] < 0
                expected.append(
                    (pixels[line, first], pixels[line, at - 1 if ends else at], kinds[first], (begins, ends))
                )
            first = at
    assert len(runs) == len(expected) > 10
    assert len({run.octave for run in runs}) > 1
    for run, (start, end, octave, cut) in zip(runs, expected, strict=True):
        np.testing.assert_allclose(run.start, start)
        np.testing.assert_allclose(run.end, end)
        assert (run.octave, run.cut) == (octave, cut)
